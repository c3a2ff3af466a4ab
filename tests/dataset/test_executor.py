"""The driver's side of worker processes, with workers that are a few lines of Python: who is ready, who is replaced,
what is said of whom, and that nothing of them is left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from blinkgl.dataset import executor
from blinkgl.dataset.executor import Local, StartError
from blinkgl.errors import BlinkGLError, ConfigError

WORKER = """
import json, os, sys, time
fd = int(sys.argv[1])
tell = lambda m: os.write(fd, json.dumps(m).encode() + b"\\n")
start = json.loads(sys.stdin.readline())
if start["job"]["how"] == "refuses": tell({"kind": "refused", "error": "no OpenGL here"})
if start["job"]["how"] == "dies": sys.exit(3)
tell({"kind": "hello", "device": start["device"], "threads": os.environ.get("NUMBA_NUM_THREADS"), "pid": os.getpid()})
for line in sys.stdin:
    order = json.loads(line)
    if order["task"] == 13: os.kill(os.getpid(), 9)
    if order["task"] == 14: time.sleep(60)
    if order["task"] == 15:
        half = json.dumps({"kind": "done", "task": 15, "report": "x" * 100_000}).encode() + b"\\n"
        for k in range(0, len(half), 30_000): os.write(fd, half[k : k + 30_000])
        continue
    tell({"kind": "progress", "task": order["task"]})
    tell({"kind": "failed" if order["task"] == 16 else "done", "task": order["task"], "attempt": order["attempt"]})
"""


@pytest.fixture
def job(tmp_path, monkeypatch):
    """What a run is, of workers as above."""

    def popen(command, **options):
        assert command[:4] == [sys.executable, "-P", "-m", "blinkgl.dataset.worker"]
        return subprocess.Popen([sys.executable, "-ISc", WORKER, command[4]], **options)

    monkeypatch.setattr(executor, "subprocess", SimpleNamespace(**{**vars(subprocess), "Popen": popen}))
    monkeypatch.setattr(executor, "several_cards", lambda job: None)
    return lambda how="works": SimpleNamespace(
        out=str(tmp_path / "out"), maker="room:Maker", to_dict=lambda: {"how": how}
    )


@pytest.fixture(autouse=True)
def nothing_is_left():
    before = os.listdir("/proc/self/fd")
    yield
    assert len(os.listdir("/proc/self/fd")) == len(before), "a pipe stayed open"


@pytest.fixture
def local():
    made = []
    yield lambda *given: made.append(Local(*given)) or made[-1]
    for pool in made:
        pool.close()
        assert pool._processes == [] and pool.free() == 0


def gathered(pool: Local, *kinds: str, seconds: float = 600.0) -> list[dict]:
    """Messages up to the first of one of these kinds."""
    found, end = [], time.monotonic() + seconds
    while not any(m["kind"] in kinds for m in found):
        found += pool.poll(0.2)
        assert time.monotonic() < end, found
    return found


def test_a_task_that_took_too_long_is_ended_for_that_reason(job, local):
    pool = local(2, [])
    pool.open(job())
    pool.submit(14, 1)
    pool.submit(14 + 100, 1)
    pool.kill(14, "more than 3 s")
    pool.kill(99, "nobody has it")
    failed = [m for m in gathered(pool, "failed") if m["kind"] == "failed"]
    assert [(m["task"], m["error"]) for m in failed] == [(14, "more than 3 s")]
    os.kill(pool._processes[-1].popen.pid, signal.SIGTERM)  # idle, the replacement: nobody's task fails
    assert gathered(pool, "hello")[-1]["kind"] == "hello"


def test_workers_that_cannot_start(job, local, tmp_path):
    with pytest.raises(BlinkGLError, match="^no OpenGL here$"):
        local(1, []).open(job("refuses"))
    started = []
    start = Local._start
    pool = local(2, [])
    pool._start = lambda slot: (started.append(slot), start(pool, slot))
    with pytest.raises(
        StartError,
        match=r"--workers: workers cannot start: the worker ended with status 3; see .*worker-\d.log",
    ):
        pool.open(job("dies"))
    assert len(started) == 4, "two, and two in their places: the third that ends ends it"
    with pytest.raises(ConfigError, match=r"--workers: too few \(got 0\); expected 1 or more"):
        Local(0)


def test_closing_ends_who_does_not_leave(job, monkeypatch):
    """SIGTERM first; SIGKILL for who does not hear it within the time that is given."""
    pool = Local(2, [])
    pids = [m["pid"] for m in pool.open(job())]
    os.kill(pids[0], signal.SIGSTOP)
    monkeypatch.setattr(executor, "_STOP_S", 0.0)
    pool.close()
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_one_pool_is_of_one_run_after_the_other(job, local, monkeypatch):
    """Of the second run it keeps nothing of the first: no closed pipes, no failed starts, no cards."""
    pool, cards = local(1), iter([[4, 5], [6, 7]])
    monkeypatch.setattr(executor, "several_cards", lambda job: next(cards))
    for device in (4, 6):
        assert [m["device"] for m in pool.open(job())] == [device]
        pool._bad_starts = 2
        pool.submit(1, 1)
        assert gathered(pool, "done")[-1]["task"] == 1
        pool.close()
