"""Time this process has spent compiling kernels, a clock that excludes it, and lines that report it.

A machine compiles each kernel once (:mod:`~blinkgl.machine.kernels`), so the time does not belong to any measured cost.
numba is not imported here: commands that need no kernel start without it.
"""

from __future__ import annotations

import contextlib
import time
import warnings
from collections.abc import Callable, Iterator

SAY_EVERY_S = 10.0
"""Seconds of compiling between two lines, so that a program does not seem to hang."""


class Watch:
    """Wall seconds between the start of the outermost compilation and its end. numba compiles under one lock, so
    compilations nest and never overlap."""

    def __init__(self) -> None:
        self.seconds, self.kernels, self._depth, self._began = 0.0, 0, 0, 0.0
        self._next_line_s = 0.0
        self.say: Callable[[str], None] | None = None

    def start(self) -> None:
        self._depth += 1
        if self._depth == 1:
            self._began = time.perf_counter()
            if self.say is not None and not self._next_line_s:
                self.say("compiling kernels, once per machine: this may take a minute or two")
                self._next_line_s = self.seconds + SAY_EVERY_S

    def end(self) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._began
            self.kernels += 1
            if self.say is not None and self.seconds >= self._next_line_s:
                self.say(f"compiling kernels: {self.kernels} done in {self.seconds:.0f} s")
                self._next_line_s = self.seconds + SAY_EVERY_S


watch = Watch()
"""The watch of this process; :mod:`~blinkgl.machine.kernels` starts and stops it."""


def compiled_s() -> float:
    """Return the wall seconds spent compiling kernels in this process so far; loading them from disk does not count."""
    return watch.seconds


@contextlib.contextmanager
def announced_compiling(say: Callable[[str], None]) -> Iterator[None]:
    """Call ``say`` with a sentence when the first kernel is compiled inside, and with another every :data:`SAY_EVERY_S`
    seconds of compiling. Only the innermost of several listeners is called."""
    outer, watch.say = watch.say, say
    try:
        yield
    finally:
        watch.say = outer


def kernel_cache_failed(what: str) -> None:
    """Report the problem ``what`` of the kernels on disk to the listener of compiling, else as a warning."""
    if watch.say is not None:
        watch.say(f"warning: {what}")
    else:
        warnings.warn(what, RuntimeWarning, stacklevel=2)


def working_clock() -> float:
    """Return ``time.perf_counter()`` without the compilation."""
    return time.perf_counter() - watch.seconds


def compiling_line(seconds: float) -> str:
    """Return "compiling kernels, once per machine: 14 s"; "" where almost nothing was compiled."""
    return f"compiling kernels, once per machine: {seconds:.0f} s" if seconds >= 0.5 else ""
