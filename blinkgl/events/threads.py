"""Kernels on several threads that sleep when they have no work.

numba's parallel loops run on OpenMP, whose threads spin for milliseconds after every loop and while they wait for the
last thread. On an idle machine that is the fastest way. On a busy one the last thread waits for a core behind the
spinning ones (two threads then took four to five times as long as one, and twelve times the CPU time). Here a thread
without work uses no core, and nobody waits for a thread that has not begun: work is cut into more parts than there are
threads, every thread takes the next free part (:func:`take_part`), and the caller also takes parts, so it does all of
them if no helper gets a core in time.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from queue import SimpleQueue

import numba
import numpy as np
from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.extending import intrinsic, register_jitable


@intrinsic
def _exchange(typingctx, array, index, value):
    """Put ``value`` into int64 ``array[index]`` and return the old value, as one atomic operation."""
    if not (isinstance(array, types.Array) and array.dtype == types.int64 and array.ndim == 1):
        raise TypingError("expected a 1-D int64 array")

    def codegen(context, builder, signature, arguments):
        data = cgutils.create_struct_proxy(signature.args[0])(context, builder, value=arguments[0]).data
        # "monotonic" sets no order with other memory: it is enough that no part is taken twice.
        return builder.atomic_rmw("xchg", builder.gep(data, [arguments[1]]), arguments[2], "monotonic")

    return types.int64(array, types.int64, types.int64), codegen


@register_jitable
def take_part(taken: np.ndarray, start: int) -> int:
    """Return, in a kernel, the number of a part that no thread has taken: the next from ``start`` on, wrapping at the
    end; -1 when none is left.

    A thread that starts at the same place every time finds its last data in its core's cache."""
    for k in range(taken.size):
        # Threads begin at different parts, so they rarely ask for the same one.
        part = (start + k) % taken.size
        # The plain read spares the atomic exchange for parts that are taken already.
        # (an intrinsic's first parameter is numba's own)
        if taken[part] == 0 and _exchange(taken, part, 1) == 0:  # type: ignore[missing-argument]
            return part
    return -1


class _Job:
    """One kernel, run by every thread that joins before it is closed."""

    def __init__(self, kernel: Callable, parts: int, arguments: tuple, threads: int):
        self._kernel, self._arguments, self._threads = kernel, arguments, threads
        self._taken = np.zeros(parts, np.int64)
        self._lock, self._all_out = threading.Lock(), threading.Lock()
        self._inside, self._helped, self._closed = 0, 0, False
        self._error: BaseException | None = None
        # This lock is released by the last helper that leaves after the work is closed.
        self._all_out.acquire()

    def help(self) -> None:
        """Run a helper's share; nothing when the work is over."""
        with self._lock:
            if self._closed:
                return
            self._inside += 1
            self._helped += 1
            # Helpers start at different parts, so that they rarely reach for the same one.
            start = len(self._taken) * self._helped // self._threads
        error = None
        try:
            self._kernel(self._taken, start, *self._arguments)
        except BaseException as raised:  # noqa: BLE001 - the caller raises it
            error = raised
        with self._lock:
            self._error = self._error or error
            self._inside -= 1
            if self._closed and not self._inside:
                self._all_out.release()

    def lead(self) -> None:
        """Run the caller's share. After it no part is left, so it waits only for the threads at work."""
        try:
            self._kernel(self._taken, 0, *self._arguments)
        finally:
            with self._lock:
                self._closed, busy = True, self._inside
            if busy:
                self._all_out.acquire()
            self._arguments = ()  # a helper that comes too late must not keep frames alive
        if self._error is not None:
            raise self._error


_jobs: SimpleQueue[_Job] = SimpleQueue()
_helpers: list[threading.Thread] = []
_growing = threading.Lock()


def _help_for_ever(jobs: SimpleQueue[_Job]) -> None:
    while True:
        jobs.get().help()


def run(kernel: Callable, parts: int, arguments: tuple, threads: int) -> None:
    """Run ``kernel(taken, start, *arguments)`` on up to ``threads`` threads including the caller; return when all parts
    are done.

    kernel : a compiled function that releases the GIL and works on the parts that ``take_part(taken, start)`` returns,
    until that is -1.
    Raises what the kernel raised in any thread."""
    if threads <= 1:
        kernel(np.zeros(parts, np.int64), 0, *arguments)
        return
    while len(_helpers) < threads - 1:
        with _growing:
            _helpers.append(threading.Thread(target=_help_for_ever, args=(_jobs,), name="blinkgl kernels", daemon=True))
            _helpers[-1].start()
    job = _Job(kernel, parts, arguments, threads)
    for _ in range(threads - 1):
        _jobs.put(job)
    job.lead()


def _forget() -> None:
    """Reset the list of threads after fork(): the child has none of them."""
    global _jobs, _growing
    _jobs, _growing = SimpleQueue(), threading.Lock()
    _helpers.clear()


os.register_at_fork(after_in_child=_forget)


def thread_count() -> int:
    """Return how many threads a kernel may use: ``numba.set_num_threads`` in this thread, else NUMBA_NUM_THREADS, else
    the number of cores."""
    return numba.get_num_threads()
