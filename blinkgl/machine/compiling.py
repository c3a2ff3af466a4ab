"""Time this process has spent compiling kernels, a clock that excludes it, and lines that report it.

A machine compiles each kernel once (:mod:`~blinkgl.machine.kernels`), so the time does not belong to any measured cost.
numba is not imported here: commands that need no kernel start without it.
"""

from __future__ import annotations

import contextlib
import time
import warnings
from collections.abc import Callable, Iterator


class Watch:
    """Wall seconds between the start of the outermost compilation and its end. numba compiles under one lock, so
    compilations nest and never overlap."""

    def __init__(self) -> None:
        self.seconds, self.kernels, self._depth, self._began = 0.0, 0, 0, 0.0
        self.say: Callable[[str], None] | None = None
        self._announced = False
        self.reported = 0, 0.0
        """Kernels and seconds that have been reported."""

    @property
    def compiles(self) -> bool:
        """Return whether a compilation is going on."""
        return self._depth > 0

    def start(self) -> None:
        self._depth += 1
        # A kernel that calls others compiles them inside its own compilation: only the outermost is timed.
        if self._depth == 1:
            self._began = time.perf_counter()
            if self.say is not None and not self._announced:
                self._announced = True
                self.say("compiling the kernels that this needs, once per machine and version: up to a minute")

    def end(self) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._began
            self.kernels += 1


watch = Watch()
"""The watch of this process; :mod:`~blinkgl.machine.kernels` starts and stops it."""


def compiled_s() -> float:
    """Return the wall seconds spent compiling kernels in this process so far; loading them from disk does not count."""
    return watch.seconds


@contextlib.contextmanager
def announced_compiling(say: Callable[[str], None]) -> Iterator[None]:
    """Call ``say`` with a sentence when this process compiles its first kernel, and with another at the end of what
    compiled any. Only the innermost of several listeners is called."""
    outer, watch.say = watch.say, say
    try:
        yield
    finally:
        watch.say = outer
        kernels, seconds = watch.kernels - watch.reported[0], watch.seconds - watch.reported[1]
        # An outer listener does not report once more what this one has.
        watch.reported = watch.kernels, watch.seconds
        if kernels:
            say(f"compiled {kernels} kernels in {seconds:.0f} s")


def kernel_cache_failed(what: str) -> None:
    """Report the problem ``what`` of the kernels on disk to the listener of compiling, else as a warning."""
    if watch.say is not None:
        watch.say(f"warning: {what}")
    else:
        warnings.warn(what, RuntimeWarning, stacklevel=2)


def working_clock() -> float:
    """Return ``time.perf_counter()`` without the compilation."""
    return time.perf_counter() - watch.seconds
