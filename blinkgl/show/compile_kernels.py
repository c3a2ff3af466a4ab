"""Compile the kernels of the common commands: ``blinkgl doctor --compile``, and ``make test`` before its tests."""

from __future__ import annotations

import contextlib
import importlib
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np

from blinkgl.config.events import EmulatorConfig
from blinkgl.config.run import load_run
from blinkgl.dataset.generate import generate_run
from blinkgl.errors import BlinkGLError, GLError
from blinkgl.events.table import EMULATORS
from blinkgl.front.event_files import read_events, write_events
from blinkgl.io.video import VideoWriter
from blinkgl.machine.compiling import watch
from blinkgl.machine.kernels import TURN_HELD, turn
from blinkgl.recordings.simulation import file_to_events, frames_to_events
from blinkgl.types.events import Events


def compile_ahead() -> str:
    """Compile the kernels of all emulators, for both frame types, of a sequence and of event files, on all cores.
    Return "compiled 70 kernels in 38 s", or "" where all were compiled. A second process waits for the first."""
    # The longest first; a sequence's own kernels together with its default emulator, which shares some.
    default, began = EmulatorConfig.default_member, time.perf_counter()
    parts = [(_SEQUENCE, default), *((kind,) for kind in sorted(EMULATORS) if kind != default), (_FILES,)]
    workers = min(len(os.sched_getaffinity(0)), len(parts))
    turn.begin()
    os.environ[TURN_HELD] = str(os.getpid())
    try:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            compiled = sum(pool.map(_compile_part, parts))
    finally:
        del os.environ[TURN_HELD]
        turn.end()
    return f"compiled {compiled} kernels in {time.perf_counter() - began:.0f} s" if compiled else ""


_SEQUENCE, _FILES = "a sequence", "files"


def _compile_part(what: tuple[str, ...]) -> int:
    """Compile the kernels of these emulators, of a sequence or of files. Return how many were compiled."""
    for name in what:
        if name == _SEQUENCE:
            _of_a_sequence()
        elif name == _FILES:
            _of_files()
        else:
            _of_an_emulator(name)
    return watch.kernels


def _of_an_emulator(emulator: str) -> None:
    waves = np.sin(np.arange(64 * 64, dtype=np.float32).reshape(64, 64) / 9)
    for frames in (
        [0.5 + 0.4 * np.roll(waves, k) for k in range(4)],
        [np.uint8(127 + 90 * np.roll(waves, k)) for k in range(4)],
    ):
        for _ in frames_to_events(frames, fps=100, emulator=emulator):
            pass


def _of_a_sequence() -> None:
    """Compile the kernels of paths, figures, shapes that change, occlusion, frame camera and preview."""
    small = [
        *("camera.width=64", "camera.height=48", "time.duration=0.02", "time.label_rate=50"),
        *("labels.flow=[forward,backward]", "images={preset: raw, exposure_us: 2000}"),
        *("output.compression=gzip", f"preview.enabled={str(_installed('av')).lower()}"),
    ]
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(GLError):  # `blinkgl doctor` says what is missing
        for name in ("demo", "dancers", "flexible"):
            for _ in generate_run(load_run(name, small), f"{folder}/{name}", num=1):
                pass


_TEXT: Any = {"columns": "t,x,y,p", "time_unit": "s"}
"""What a text does not say; it would be guessed, and said."""


def _installed(module: str) -> bool:
    try:
        importlib.import_module(module)
    except ImportError:
        return False
    return True


def _of_files() -> None:
    """Compile the kernels of video and of event files."""
    xy, t, p = np.arange(1, 4, dtype=np.uint16), np.arange(3, dtype=np.int64), np.ones(3, np.uint8)
    events = Events(xy, xy, t, p)
    # Without Blosc or PyAV nothing of theirs is needed.
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(BlinkGLError):
        for ending, declared in ((".raw", {}), (".txt", _TEXT), (".csv", _TEXT), (".h5", {})):
            write_events(f"{folder}/events{ending}", events, 8, 8)
            read_events(f"{folder}/events{ending}", **declared)
        with VideoWriter(f"{folder}/video.mp4", 64, 64, 30.0) as video:
            for k in range(12):
                video.write((127 + 90 * np.sin(np.indices((64, 64, 3)).sum(0) / 9 + k)).astype(np.uint8))
        file_to_events(f"{folder}/video.mp4", f"{folder}/video.h5")


if __name__ == "__main__":
    if line := compile_ahead():
        print(line)  # noqa: T201
