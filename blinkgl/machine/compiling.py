"""Time this process has spent compiling kernels, a clock that excludes it, and lines that report it.

A machine compiles each kernel once (:mod:`~blinkgl.machine.kernels`), so the time does not belong to any measured cost.
numba is not imported here: commands that need no kernel start without it.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

_ALL_KERNELS = "blinkgl.show.compile_kernels"
"""The program that compiles the kernels of the common commands. It uses every room, so it runs as a process."""


class Watch:
    """Wall seconds between the start of the outermost compilation and its end. numba compiles under one lock, so
    compilations nest and never overlap."""

    def __init__(self) -> None:
        self.seconds, self.kernels, self._depth, self._began = 0.0, 0, 0, 0.0
        self.say: Callable[[str], None] | None = None
        self.all_compiled = False
        """whether the kernels of the common commands need no compiling, or cannot be kept"""

    def start(self) -> None:
        self._depth += 1
        if self._depth == 1:
            self._began = time.perf_counter()

    def end(self) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._began
            self.kernels += 1

    def compile_all(self, stamp: Path) -> bool:
        """Compile the kernels of the common commands where a command line meets the first one that is not on disk, so
        that no later command waits. Returns whether it was done now.

        stamp : a file that is written when it is done; it counts until code of the package is younger."""
        if self.say is None or self.all_compiled:
            return False
        self.all_compiled = True
        code = Path(__file__).resolve().parents[1].rglob("*.py")
        if stamp.is_file() and stamp.stat().st_mtime > max(file.stat().st_mtime for file in code):
            return False
        self.say("compiling kernels, once per machine and version: about a minute")
        self.start()
        # -P: modules of the folder that the user stands in are not imported.
        done = subprocess.run([sys.executable, "-P", "-m", _ALL_KERNELS], capture_output=True, text=True, check=False)
        self.end()
        for line in done.stdout.splitlines():
            self.say(line)
        if done.returncode == 0:
            with contextlib.suppress(OSError):
                stamp.touch()
        return True


watch = Watch()
"""The watch of this process; :mod:`~blinkgl.machine.kernels` starts and stops it."""


def compiled_s() -> float:
    """Return the wall seconds spent compiling kernels in this process so far; loading them from disk does not count."""
    return watch.seconds


@contextlib.contextmanager
def announced_compiling(say: Callable[[str], None]) -> Iterator[None]:
    """Call ``say`` with a sentence when the first kernel inside is not on disk, and with another when all are compiled.
    Only the innermost of several listeners is called."""
    outer, watch.say = watch.say, say
    try:
        yield
    finally:
        watch.say = outer


def kernel_cache_failed(what: str) -> None:
    """Report the problem ``what`` of the kernels on disk to the listener of compiling, else as a warning."""
    watch.all_compiled = True
    if watch.say is not None:
        watch.say(f"warning: {what}")
    else:
        warnings.warn(what, RuntimeWarning, stacklevel=2)


def working_clock() -> float:
    """Return ``time.perf_counter()`` without the compilation."""
    return time.perf_counter() - watch.seconds
