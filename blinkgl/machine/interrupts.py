"""Ctrl-C and SIGTERM that are never lost.

Python runs a signal's handler between any two byte codes of the main thread, also in a weak reference's callback, in
``__del__`` and in callbacks of C libraries. An exception raised there goes to ``sys.unraisablehook``, is printed as
"Exception ignored in" and lost: a run that was told to end continues. Here the signal is sent again.
"""

from __future__ import annotations

import _thread
import contextlib
import signal
import sys
import threading
import time
from collections.abc import Iterator

_AGAIN_AFTER_S = 0.05
STOPS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that end a command as Ctrl-C does: of batch systems and containers, and of a terminal that is closed."""


class Stop:
    """The signal that ends this process's work: ``number``, or None."""

    number: int | None = None

    @classmethod
    def status(cls) -> int:
        """Return the exit status that a shell gives for it."""
        return 128 + (cls.number or signal.SIGINT)


@contextlib.contextmanager
def interruptible(*numbers: int) -> Iterator[None]:
    """Inside, signals ``numbers`` raise KeyboardInterrupt as SIGINT does, and one that was raised where Python drops
    exceptions is sent again 50 ms later, until it takes effect. A signal that is ignored (nohup, a script's background)
    stays so. :class:`Stop` keeps the number. This works only in a main thread; in another nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # ``inside`` is read by the thread below: it must not send a signal after the block has ended.
    main, inside, last = threading.get_ident(), True, signal.SIGINT

    def interrupt(number: int, _) -> None:
        nonlocal last
        last = Stop.number = number
        raise KeyboardInterrupt

    def again() -> None:
        time.sleep(_AGAIN_AFTER_S)
        if inside:  # else the signal has taken effect, or its default action is restored, which would kill the process
            signal.pthread_kill(main, last)  # a real signal also ends a blocking system call

    def unraisable(unraisable: sys.UnraisableHookArgs) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            _thread.start_new_thread(again, ())  # not threading's, whose locks the interrupted code may hold
        else:
            hook_before(unraisable)

    # An exception raised in a destructor or a callback of C code is reported here and lost: the interrupt
    # is sent again.
    hook_before, sys.unraisablehook = sys.unraisablehook, unraisable
    heard = [n for n in numbers if signal.getsignal(n) not in (signal.SIG_IGN, None)]
    # A program of the user may have its own way with Ctrl-C.
    heard += [signal.SIGINT] if signal.getsignal(signal.SIGINT) is signal.default_int_handler else []
    before = {number: signal.signal(number, interrupt) for number in heard}
    try:
        yield
    finally:
        inside = False
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = hook_before


@contextlib.contextmanager
def uninterrupted(*numbers: int) -> Iterator[None]:
    """Signals ``numbers`` that come inside take effect at the end: an exception in the middle of the import of
    extension modules leaves them half initialised, and they end the process later. In another thread than the main one,
    which no handler interrupts, nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    ours = [number for number in numbers if signal.getsignal(number) is not None]  # None: a C library's
    before = {number: signal.signal(number, lambda number, _: came.append(number)) for number in ours}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        # Handlers are the former ones again, so each signal does what it would have done at once.
        for number in came:
            signal.raise_signal(number)
