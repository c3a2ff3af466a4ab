"""A signal that arrives where Python drops exceptions ends the program all the same."""

import os
import signal
import sys
import threading
import time
import weakref

import pytest

from blinkgl.machine.interrupts import interruptible


@pytest.fixture(autouse=True)
def as_in_the_foreground():
    """Where the suite itself runs in a shell's background SIGINT is ignored, by Python, too."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class Dying:
    """Calls ``last`` where exceptions are dropped: in ``__del__``, or in a weak reference's callback."""

    def __init__(self, last):
        self.last = last

    def __del__(self):
        self.last()


class Watched:
    pass


def in_del(action):
    Dying(action)


def in_weakref_callback(action):
    watched = Watched()
    reference = weakref.ref(watched, lambda _: action())
    del watched
    assert reference() is None


def wait():
    for _ in range(60_000):  # byte codes between which a handler may run
        time.sleep(0.01)
    raise AssertionError("the signal was lost")


@pytest.mark.parametrize("where", [in_del, in_weakref_callback])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_a_callback_is_not_lost(where, number, capsys):
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), interruptible(signal.SIGTERM):
        where(lambda: os.kill(os.getpid(), number))
        wait()
    assert signal.getsignal(signal.SIGTERM) is before
    assert "Exception ignored" not in capsys.readouterr().err


def test_it_ends_a_wait_that_no_byte_code_interrupts():
    with pytest.raises(KeyboardInterrupt), interruptible():
        in_del(lambda: os.kill(os.getpid(), signal.SIGINT))
        assert threading.Event().wait(600), "the signal was lost"


def test_other_dropped_exceptions_are_still_shown(monkeypatch):
    seen = []
    monkeypatch.setattr(sys, "unraisablehook", lambda args: seen.append(args.exc_type))
    with interruptible():
        in_del(lambda: 1 / 0)
    assert seen == [ZeroDivisionError]


def test_another_thread_is_left_alone():
    found = []

    def body():
        with interruptible(signal.SIGTERM):
            found.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=body)
    thread.start()
    thread.join()
    assert found == [signal.getsignal(signal.SIGTERM)]


def test_a_signal_waits_until_what_must_not_be_interrupted_is_done():
    from blinkgl.machine.interrupts import uninterrupted

    done = []
    with pytest.raises(KeyboardInterrupt), uninterrupted(signal.SIGINT):
        signal.raise_signal(signal.SIGINT)
        done.append("whole")
    assert done == ["whole"]
