"""How long this process has spent compiling kernels, and a clock that stands still meanwhile.

numba compiles a kernel the first time it is called with arguments of some types and keeps the result on disk (beside
the source, in the user's cache folder where that is not writable, or in NUMBA_CACHE_DIR); on a machine that has done so
the figure is 0. It is no part of what anything costs, so it must not be in anybody's seconds.
"""

from __future__ import annotations

import os
import time

from numba.core import event


class _Watch(event.Listener):
    """Wall seconds between the start of the outermost compilation and its end. numba compiles under
    one lock, so they nest and never overlap."""

    def __init__(self) -> None:
        self.seconds, self._depth, self._began = 0.0, 0, 0.0

    def on_start(self, event: event.Event) -> None:
        self._depth += 1
        if self._depth == 1:
            self._began = time.perf_counter()

    def on_end(self, event: event.Event) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._began


_watch = _Watch()
event.register("numba:compile", _watch)


def compiled_s() -> float:
    """Wall seconds spent compiling kernels in this process so far; loading them from disk does not count."""
    return _watch.seconds


def working_clock() -> float:
    """``time.perf_counter()`` without the compilation."""
    return time.perf_counter() - _watch.seconds


def compiling_line(seconds: float) -> str:
    """ "compiling kernels, once per machine: 14 s"; "" where there was next to nothing to compile."""
    return f"compiling kernels, once per machine: {seconds:.0f} s" if seconds >= 0.5 else ""


def compile_ahead() -> float:
    """Compiles the kernels of all emulators, for frames of either type, and what else a sequence needs, on all cores,
    so that no later process has to. Wall seconds that it took, 0 where there was nothing to compile."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    from blinkgl.config.events import EmulatorConfig
    from blinkgl.events.table import EMULATORS

    # The longest first; a sequence's own beside the emulator that it has by default.
    default, began = EmulatorConfig.members.default, time.perf_counter()
    parts = [*((kind,) for kind in sorted(EMULATORS) if kind != default), (default, None)]
    workers = min(len(os.sched_getaffinity(0)), len(parts))
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        compiled = sum(pool.map(_compile_part, parts))
    return time.perf_counter() - began if compiled >= 0.5 else 0.0


def _compile_part(emulators: tuple[str | None, ...]) -> float:
    """The kernels of these emulators; None: of a sequence. Seconds spent compiling."""
    before = compiled_s()
    for emulator in emulators:
        if emulator is None:
            _of_a_sequence()
        else:
            _of_an_emulator(emulator)
    return compiled_s() - before


def _of_an_emulator(emulator: str) -> None:
    import numpy as np

    from blinkgl.recordings.simulation import frames_to_events

    waves = np.sin(np.arange(64 * 64, dtype=np.float32).reshape(64, 64) / 9)
    for frames in (
        [0.5 + 0.4 * np.roll(waves, k) for k in range(4)],
        [np.uint8(127 + 90 * np.roll(waves, k)) for k in range(4)],
    ):
        for _ in frames_to_events(frames, fps=100, emulator=emulator):
            pass


def _of_a_sequence() -> None:
    """Paths, occlusion, preview."""
    import tempfile
    from pathlib import Path

    from blinkgl.config.sequence import RunTemplate
    from blinkgl.dataset.generate import generate_run
    from blinkgl.errors import GLError

    small = {
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
            pass  # `blinkgl doctor` says what is missing; this is not the place


if __name__ == "__main__":
    # The module that numba's events are told, not this second copy of it.
    from blinkgl.machine import compiling  # noqa: PLW0406

    print(compiling.compiling_line(compiling.compile_ahead()) or "kernels: compiled before")  # noqa: T201
