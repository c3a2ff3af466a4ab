"""Kernels on several threads that sleep when they have nothing to do.

numba's own parallel loops run on OpenMP, whose threads spin for milliseconds after every loop, and at its end wait
spinning for the last one. On a machine with nothing else to do that is as fast as can be; where something else runs,
the thread that is waited for stands in the queue behind the ones that wait (two threads then took four to five times as
long as one, and twelve times the processor time). Here a thread that has no work holds no core, and nobody waits for a
thread that has not begun: work is cut in more parts than there are threads, every thread takes the next part that
nobody has (:func:`take_part`), and the caller, who takes parts like everybody else, has done them all
by itself where no helper got a core in time.
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
    """Puts ``value`` into int64 ``array[index]`` and returns what was there, in one step
    that no other thread can get between."""
    if not (isinstance(array, types.Array) and array.dtype == types.int64 and array.ndim == 1):
        raise TypingError("expected a 1-D int64 array")

    def codegen(context, builder, signature, arguments):
        data = cgutils.create_struct_proxy(signature.args[0])(context, builder, value=arguments[0]).data
        return builder.atomic_rmw("xchg", builder.gep(data, [arguments[1]]), arguments[2], "monotonic")

    return types.int64(array, types.int64, types.int64), codegen


@register_jitable
def take_part(taken: np.ndarray, start: int) -> int:
    """In a kernel: the number of a part that no thread has taken before, the next from ``start``
    on, around the end; -1 when none is left.

    A thread that starts at the same place every time finds what it left in its core's cache."""
    for k in range(taken.size):
        part = (start + k) % taken.size
        if taken[part] == 0 and _exchange(taken, part, 1) == 0:
            return part
    return -1


class _Job:
    """One kernel, run by whoever comes before it is closed."""

    def __init__(self, kernel: Callable, parts: int, arguments: tuple, threads: int):
        self._kernel, self._arguments, self._threads = kernel, arguments, threads
        self._taken = np.zeros(parts, np.int64)
        self._lock, self._all_out = threading.Lock(), threading.Lock()
        self._inside, self._helped, self._closed, self._error = 0, 0, False, None
        self._all_out.acquire()

    def help(self) -> None:
        """The part of a helper; nothing when the work is over."""
        with self._lock:
            if self._closed:
                return
            self._inside += 1
            self._helped += 1
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
        """The part of the caller: when its own run is over no part is left to take, so
        only those at work are waited for."""
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
    """``kernel(taken, start, *arguments)`` on up to ``threads`` threads at once, the calling one
    among them; over when all parts are done.

    kernel : a compiled function that releases the GIL and works on the parts that
    ``take_part(taken, start)`` gives it, until that is -1.
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
    """After fork(): the child has the list of the threads and none of them."""
    global _jobs, _growing
    _jobs, _growing = SimpleQueue(), threading.Lock()
    _helpers.clear()


os.register_at_fork(after_in_child=_forget)


def thread_count() -> int:
    """How many threads a kernel may use: ``numba.set_num_threads`` in this thread, else
    NUMBA_NUM_THREADS, else the cores."""
    return numba.get_num_threads()
