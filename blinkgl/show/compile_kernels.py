"""Compile the kernels in advance, once per machine: ``python -m blinkgl.show.compile_kernels``, which ``make`` runs."""

from __future__ import annotations

import importlib
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from blinkgl.config.events import EmulatorConfig
from blinkgl.config.run import RunTemplate
from blinkgl.dataset.generate import generate_run
from blinkgl.errors import GLError
from blinkgl.events.table import EMULATORS
from blinkgl.machine.compiling import compiled_s, compiling_line
from blinkgl.recordings.simulation import frames_to_events


def compile_ahead() -> float:
    """Compile the kernels of all emulators, for both frame types, and the other kernels of a sequence, on all cores, so
    that no later process has to. Returns the wall time, s; 0 where there was nothing to compile."""
    # The longest first; a sequence's own kernels together with its default emulator.
    default, began = EmulatorConfig.default_member, time.perf_counter()
    parts = [*((kind,) for kind in sorted(EMULATORS) if kind != default), (default, None)]
    workers = min(len(os.sched_getaffinity(0)), len(parts))
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        compiled = sum(pool.map(_compile_part, parts))
    return time.perf_counter() - began if compiled >= 0.5 else 0.0


def _compile_part(emulators: tuple[str | None, ...]) -> float:
    """Compile the kernels of these emulators; None: of a sequence. Returns the time, s."""
    before = compiled_s()
    for emulator in emulators:
        if emulator is None:
            _of_a_sequence()
        else:
            _of_an_emulator(emulator)
    return compiled_s() - before


def _of_an_emulator(emulator: str) -> None:
    waves = np.sin(np.arange(64 * 64, dtype=np.float32).reshape(64, 64) / 9)
    for frames in (
        [0.5 + 0.4 * np.roll(waves, k) for k in range(4)],
        [np.uint8(127 + 90 * np.roll(waves, k)) for k in range(4)],
    ):
        for _ in frames_to_events(frames, fps=100, emulator=emulator):
            pass


def _of_a_sequence() -> None:
    """Compile the kernels of paths, occlusion and, where PyAV can write one, preview."""
    small = {
        "output": {"compression": "gzip"},
        "preview": {"enabled": _installed("av")},
        "camera": {"width": 64, "height": 48},
        "time": {"duration": 0.02, "label_rate": 50},
        "labels": {"flow": ["forward", "backward"]},
        "images": {"preset": "raw", "exposure_us": 2000},
        "scene": {"objects": {"count": 3}, "textures": {"variants": 2, "photographs": False, "max_size": 32}},
    }
    with tempfile.TemporaryDirectory() as folder:
        try:
            for _ in generate_run(RunTemplate(small, Path(".")), folder + "/out"):
                pass
        except GLError:
            pass  # `blinkgl doctor` reports what is missing


def _installed(module: str) -> bool:
    try:
        importlib.import_module(module)
    except ImportError:
        return False
    return True


if __name__ == "__main__":
    print(compiling_line(compile_ahead()) or "kernels: compiled before")  # noqa: T201
