"""The decorator of every compiled function.

numba compiles a kernel the first time it is called with arguments of some types and stores the result on disk: beside
the source, in the user's cache folder where that is not writable, or in NUMBA_CACHE_DIR. Its files have no checksum, so
a damaged one raises unpickling errors, or runs wrong code. Here an entry is read only if its checksum is right; any
other is compiled again.
"""

from __future__ import annotations

import contextlib
import os
import sys
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any, Literal

import numba
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile

from blinkgl.machine.compiling import kernel_cache_failed, watch

_reported: set[str] = set()
"""Folders that have been reported; "" where there is none."""


class _Listener(event.Listener):
    def on_start(self, event: event.Event) -> None:
        watch.start()

    def on_end(self, event: event.Event) -> None:
        watch.end()
        # What was compiled is kept after this event; what failed is not. (``is_failed`` says the opposite in numba.)
        if sys.exc_info()[0] is not None:
            turn.end()


TURN_HELD = "BLINKGL_COMPILES"
"""Set in the environment of processes that compile together on purpose (:mod:`blinkgl.show.compile_kernels`)."""


class _Turn:
    """One process of a machine compiles at a time: others wait, and then find the kernel on disk. The system gives the
    turn to the next where a process ends."""

    def __init__(self) -> None:
        self._file: int | None = None

    def begin(self) -> bool:
        """Wait for the turn. Return whether it began now, so that another process may have compiled meanwhile."""
        if self._file is not None or TURN_HELD in os.environ:
            return False
        try:
            import fcntl

            self._file = os.open(_turn_file(), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except (ImportError, OSError, RuntimeError):  # no locks, or nothing can be kept there
            return False
        with contextlib.suppress(OSError):  # a file system without locks
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if watch.say is not None:
                    watch.say("waiting for another process, which compiles kernels")
                fcntl.flock(self._file, fcntl.LOCK_EX)
        return True

    def end(self) -> None:
        # A kernel that was called is kept before its caller is: the turn lasts until both are.
        if self._file is not None and not watch.compiles:
            os.close(self._file)
            self._file = None


turn = _Turn()


event.register("numba:compile", _Listener())


class _CheckedFile(IndexDataCacheFile):
    """numba's files of one kernel. Each entry ends with a checksum and names its key, so that a damaged index cannot
    lead to the code of other types."""

    def save(self, key: object, data: object) -> None:
        super().save(key, (key, data))

    def load(self, key: object) -> object:
        entry = super().load(key)
        if entry is None:
            return None
        # A wrong entry would be machine code for other types: it would crash, not fail.
        its_key, data = entry
        if its_key != key:
            raise ValueError("the index of the kernel cache leads to another entry")
        return data

    def _dump(self, obj: object) -> bytes:
        content = super()._dump(obj)
        return content + _checksum(content)  # pickle stops reading where an object ends

    def _load_data(self, name: str) -> object:
        content = Path(self._data_path(name)).read_bytes()
        if _checksum(content[:-4]) != content[-4:]:
            raise ValueError("an entry of the kernel cache does not fit its check sum")
        return super()._load_data(name)


def _checksum(content: bytes) -> bytes:
    return zlib.crc32(content).to_bytes(4, "little")


class _Cache(FunctionCache):
    """numba's cache of one kernel. A file that cannot be read or written costs a compilation and is reported."""

    def __init__(self, function: Callable):
        super().__init__(function)
        # numba's own stamp covers only the kernel's file, and a kernel inlines functions of others.
        stamp = self._impl.locator.get_source_stamp(), _stamps_of_imports(function.__module__)
        self._cache_file = _CheckedFile(self._cache_path, self._impl.filename_base, stamp)

    def load_overload(self, sig: object, target_context: object) -> object:
        try:
            overload = super().load_overload(sig, target_context)
            # Whoever had the turn before may have compiled and kept this very kernel.
            if overload is None and turn.begin():
                overload = super().load_overload(sig, target_context)
                if overload is not None:
                    turn.end()
            return overload
        except Exception:  # noqa: BLE001 - damaged bytes raise anything
            _report(self.cache_path, "the kernels kept there are damaged or unreadable and are compiled again")
            with contextlib.suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: object, data: object) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _report(
                self.cache_path, f"kernels cannot be kept there ({error.strerror}) and are compiled in every process"
            )
        finally:
            turn.end()


def _report(folder: str, what: str) -> None:
    if folder not in _reported:
        _reported.add(folder)
        kernel_cache_failed(f"{folder}: {what}" if folder else what)


def kept() -> tuple[Path, int]:
    """Return the folder of this package's kernels, which may be one beside each of its folders, and the number of
    kernels that are kept there. Raises RuntimeError where none can be."""
    folder = _turn_file().parent
    beside = folder.name == "__pycache__"
    root = Path(__file__).resolve().parents[1] if beside else folder.parent
    return (root if beside else folder), sum(1 for _ in root.rglob("*.nbc"))


@cache
def _turn_file() -> Path:
    """Return the file whose lock is the turn to compile, where kernels are kept."""
    folder = Path(FunctionCache(_turn_file.__wrapped__).cache_path)
    folder.mkdir(parents=True, exist_ok=True)
    return folder / "compiling.lock"


@cache
def _stamps_of_imports(module: str) -> tuple[tuple[str, float, int], ...]:
    """Return (module, time of change, size) of all our modules whose functions ``module`` imports, directly or
    indirectly. numba checks only the kernel's own file and would use old code of a called function. No kernel calls a
    function of the configuration."""
    seen, waiting = {module}, [module]
    while waiting:
        for value in vars(sys.modules[waiting.pop()]).values():
            function = getattr(value, "py_func", value)
            name = function.__module__ if isinstance(function, FunctionType) else ""
            if name.startswith(("blinkgl.", "eflow.")) and "config" not in name and name not in seen:
                seen.add(name)
                waiting.append(name)
    files = {name: os.stat(file) for name in sorted(seen) if (file := getattr(sys.modules.get(name), "__file__", None))}
    return tuple((name, status.st_mtime, status.st_size) for name, status in files.items())


def kernel(function: Callable | None = None, *, error_model: Literal["python", "numpy"] = "python") -> Any:
    """Decorate a function that numba compiles, without the interpreter's lock, and stores on disk.

    error_model : "numpy" divides by zero as NumPy does, without a branch; "python" raises ZeroDivisionError."""
    if function is None:
        return lambda f: kernel(f, error_model=error_model)
    # nogil: bands of a frame run in threads, and Python threads go on meanwhile.
    dispatcher: Any = numba.njit(nogil=True, error_model=error_model)(function)
    try:
        dispatcher._cache = _Cache(function)  # noqa: SLF001 - what njit(cache=True) does, with a class of its own
    except RuntimeError:  # numba found no writable folder
        _report(
            "",
            "kernels cannot be kept, since neither the package's folder nor the home folder can be written: they "
            "are compiled in every process. NUMBA_CACHE_DIR=FOLDER keeps them in a folder of yours",
        )
    return dispatcher
