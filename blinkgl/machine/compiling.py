"""How long this process has spent compiling kernels, and a clock that stands still meanwhile.

numba compiles a kernel the first time it is called with arguments of some types and keeps the result on disk (beside
the source, in the user's cache folder where that is not writable, or in NUMBA_CACHE_DIR); on a machine that has done so
the figure is 0. It is no part of what anything costs, so it must not be in anybody's seconds.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

from numba.core import event


class _Watch(event.Listener):
    """Wall seconds between the start of the outermost compilation and its end. numba compiles under
    one lock, so they nest and never overlap."""

    def __init__(self) -> None:
        self.seconds, self._depth, self._began = 0.0, 0, 0.0
        self.say: Callable[[str], None] | None = None

    def on_start(self, event: event.Event) -> None:
        self._depth += 1
        if self._depth == 1:
            self._began = time.perf_counter()
            if self.say is not None:
                say, self.say = self.say, None
                say("compiling kernels, once per machine: this may take a minute or two")

    def on_end(self, event: event.Event) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._began


_watch = _Watch()
event.register("numba:compile", _watch)


def compiled_s() -> float:
    """Wall seconds spent compiling kernels in this process so far; loading them from disk does not count."""
    return _watch.seconds


@contextlib.contextmanager
def announced_compiling(say: Callable[[str], None]) -> Iterator[None]:
    """Calls ``say`` with a sentence when a kernel is compiled inside, once: a program that prints nothing for a minute
    looks as if it hung."""
    _watch.say = say
    try:
        yield
    finally:
        _watch.say = None


def working_clock() -> float:
    """``time.perf_counter()`` without the compilation."""
    return time.perf_counter() - _watch.seconds


def compiling_line(seconds: float) -> str:
    """ "compiling kernels, once per machine: 14 s"; "" where there was next to nothing to compile."""
    return f"compiling kernels, once per machine: {seconds:.0f} s" if seconds >= 0.5 else ""
