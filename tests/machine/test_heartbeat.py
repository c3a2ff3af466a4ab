"""A command that shows nothing for long says that it is at work, and where."""

import time

from blinkgl.machine import heartbeat as module
from blinkgl.machine.heartbeat import Heartbeat


def beaten(capsys, monkeypatch, during, quiet=False):
    """Return the lines of a command that does ``during(heartbeat, lines)``; half a minute is a moment here."""
    monkeypatch.setattr(module, "EVERY_S", 0.01)
    beat, lines = Heartbeat(), []
    with beat.beating(quiet):
        during(beat, lines)
    return lines + capsys.readouterr().err.splitlines()


def until(condition):
    for _ in range(6000):
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError("never")


def test_it_says_where_it_is(capsys, monkeypatch):
    def during(beat, lines):
        beat.at("sequence 3 of 20")
        until(lambda: lines.extend(capsys.readouterr().err.splitlines()) or lines)

    assert beaten(capsys, monkeypatch, during)[-1] == "still at work: 0:00:00, sequence 3 of 20"


def test_who_waits_for_somebody_is_not_at_work(capsys, monkeypatch):
    def during(beat, lines):
        beat.rest()
        capsys.readouterr()
        time.sleep(0.1)

    assert beaten(capsys, monkeypatch, during) == []


def test_quietly_there_is_no_thread(capsys, monkeypatch):
    def during(beat, lines):
        time.sleep(0.1)

    assert beaten(capsys, monkeypatch, during, quiet=True) == []
