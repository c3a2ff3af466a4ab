"""The kernels' threads: every part is done once, by whoever is free; nobody waits for a thread that has not begun."""

import os
import threading
from queue import SimpleQueue

import numba
import numpy as np
import pytest

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.events import make_emulator, threads


@numba.njit(nogil=True)
def _count(taken, start, counts):
    part = threads.take_part(taken, start)
    while part >= 0:
        counts[part] += 1
        part = threads.take_part(taken, start)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_every_part_is_done_once(count):
    for parts in (1, 3, 10_000):
        counts = np.zeros(parts, np.int64)
        for _ in range(20):
            threads.run(_count, parts, (counts,), count)
        assert (counts == 20).all()


def test_the_caller_does_not_wait_for_who_has_not_begun(monkeypatch):
    """No helper ever gets a core here: the work is done all the same."""
    monkeypatch.setattr(threads, "_helpers", [None])
    monkeypatch.setattr(threads, "_jobs", SimpleQueue())
    counts = np.zeros(100, np.int64)
    threads.run(_count, 100, (counts,), 2)
    assert (counts == 1).all()
    late = threads._jobs.get_nowait()
    late.help()
    assert (counts == 1).all() and late._arguments == (), "one who comes too late does nothing and keeps nothing alive"


def test_an_error_in_a_helper_is_raised_in_the_caller():
    both = threading.Barrier(2)

    def kernel(taken, start):
        both.wait(10)
        if start:
            raise MemoryError("no room")

    with pytest.raises(MemoryError, match="no room"):
        threads.run(kernel, 2, (), 2)
    counts = np.zeros(10, np.int64)
    threads.run(_count, 10, (counts,), 2)
    assert (counts == 1).all(), "the helper is alive"


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_child_has_threads_of_its_own():
    counts = np.zeros(1000, np.int64)
    threads.run(_count, 1000, (counts,), 2)
    if not (child := os.fork()):
        ok = False
        try:
            threads.run(_count, 1000, (counts,), 2)
            ok = (counts == 2).all() and threads._helpers[0].is_alive()
        finally:
            os._exit(0 if ok else 1)
    assert os.waitpid(child, 0)[1] == 0


@pytest.mark.parametrize(
    "config",
    [EsimConfig(threshold_sigma=0.05), V2eConfig(preset="noisy"), VoltmeterConfig()],
    ids=["esim", "v2e", "voltmeter"],
)
def test_events_do_not_depend_on_the_number_of_threads(config, monkeypatch):
    """Large enough for several threads in the kernel and in the sort; more threads than cores,
    so that they get in each other's way."""
    from blinkgl.events import emulator as emulators

    frames = np.random.default_rng(3).random((5, 400, 500), np.float32)
    used = []

    def run(kernel, parts, arguments, count):
        used.append((kernel.__name__, count))
        threads.run(kernel, parts, arguments, count)

    results = []
    for count in (1, 2, 3):
        monkeypatch.setattr(emulators, "thread_count", lambda count=count: count)
        monkeypatch.setattr(emulators, "run", run)
        model = make_emulator(config, 400, 500, 7)
        results.append([model.step(f, 10**6 * k) for k, f in enumerate(frames)])
    assert {count for name, count in used} == {1, 2, 3}
    assert sum(len(e) for e in results[0]) > 100_000
    for other in results[1:]:
        for a, b in zip(results[0], other):
            assert all(np.array_equal(getattr(a, k), getattr(b, k)) for k in "xytp")
