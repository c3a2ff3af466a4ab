"""What emulators share: packing and sorting, the size of noise, what every one of them checks."""

from __future__ import annotations

import itertools
import os
import threading
from queue import SimpleQueue

import numba
import numpy as np
import pytest

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Esim, V2e, make_emulator, threads
from blinkgl.events.noise import noise_size
from blinkgl.events.packing import PackedBuffer
from blinkgl.types.events import Events, count_causes, named_causes
from tests.events.clips import assert_same


@pytest.mark.parametrize("span_us", [0, 1, 255, 2**14 - 1, 2**14, 2**22 - 1, 2**22, 2**30 - 1])
@pytest.mark.parametrize(
    "counts, threads",
    [([7], 1), ([0, 900, 0, 2, 1100], 1), ([9_000, 30_000, 0, 33_000, 40_000], 2), ([1, 120_000, 5, 4], 3)],
)
def test_sorted_by_time_and_within_a_microsecond_in_the_order_of_the_rows(span_us, counts, threads):
    rng = np.random.default_rng(span_us % 1000 + len(counts))
    buffer, counts = PackedBuffer(), np.array(counts)
    for base in (0, 5_000_000_123):  # the second time in memory that is there already
        rows = buffer.rows(len(counts), 100)
        buffer.grow(len(counts), int(counts.max()) + 3, np.minimum(counts, 0))
        rows = buffer.rows(len(counts), 100)
        t = [rng.choice(np.unique([0, span_us, *rng.integers(0, span_us + 1, 400)]), n) for n in counts]
        x, y, p = ([rng.integers(0, top, n) for n in counts] for top in (65536, 65536, 2))
        for b, n in enumerate(counts):
            rows[b, :n] = t[b] << 33 | y[b] << 17 | x[b] << 1 | p[b]
        events = buffer.to_events(counts.copy(), base, span_us, threads)
        x, y, t, p = (np.concatenate(columns) for columns in (x, y, t, p))
        order = np.argsort(t, kind="stable")
        for got, wanted in ((events.x, x), (events.y, y), (events.t, t + base), (events.p, p)):
            np.testing.assert_array_equal(got, wanted[order])
        assert (events.x.dtype, events.y.dtype, events.t.dtype, events.p.dtype) == (
            np.uint16,
            np.uint16,
            np.int64,
            np.uint8,
        )
    assert len(buffer.to_events(np.zeros(len(counts), np.int64), 0, span_us, threads)) == 0


def simulated_rate(size: float, k: float) -> float:
    """Events per time constant of a comparator with levels one threshold apart that watches a first-order
    autoregression, e^-k per frame."""
    rng = np.random.default_rng(int(1000 * size + 10 * k))
    pixels, steps = 3000, 450
    noise = size * rng.normal(size=pixels)
    reference, events, warm = size * rng.normal(size=pixels), 0, 100
    a, fresh = np.exp(-k), size * np.sqrt(1 - np.exp(-2 * k))
    for step in range(steps):
        noise = a * noise + fresh * rng.normal(size=pixels)
        crossed = np.trunc(noise - reference)
        reference += crossed
        if step >= warm:
            events += np.abs(crossed).sum()
    return events / (pixels * (steps - warm) * k)


@pytest.mark.parametrize("k", [0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 0.055, 1.7])
def test_the_size_of_noise_is_what_a_simulated_comparator_needs(k):
    """Within 3 % at the sizes and spacings that were counted, 8 % in between."""
    for size in (0.5, 0.7, 0.85, 1.0, 1.5, 2.0, 2.5):
        rate = simulated_rate(size, k)
        if rate * 3000 * 350 * k > 600:
            assert noise_size(k, rate) == pytest.approx(
                size, rel=0.08 if size in (0.85, 2.0) or k in (0.055, 1.7) else 0.03
            ), size


@pytest.mark.parametrize(
    "size, fits",
    [
        ((1, 1), True),
        ((65_535, 1), True),
        ((1, 65_535), True),
        ((65_536, 1), False),
        ((1, 65_536), False),
        ((0, 5), False),
        ((5, 0), False),
        ((46_341, 46_341), False),
    ],
)
def test_sizes_of_frames(size, fits):
    """Coordinates are 16 bits; a side of 65,536 would still fit them, but not a count of columns."""
    if fits:
        assert (Esim(*size, EsimConfig(), 0).height, Esim(*size, EsimConfig(), 0).width) == size
    else:
        with pytest.raises(
            EventDataError,
            match=rf"frame size out of range .got \({size[0]}, {size[1]}\).; expected 1 to 65535 rows and columns",
        ):
            Esim(*size, EsimConfig(), 0)


def test_frames_and_times_that_an_emulator_takes():
    frame, esim = np.ones((2, 2), np.float32), Esim(2, 2, EsimConfig(), 0)
    for bad in (2**61, -(2**61)):
        with pytest.raises(EventDataError, match=f"frame 0: time stamp out of range .got '{bad} ns'"):
            Esim(2, 2, EsimConfig(), 0).step(frame, bad)
    for bad in ("soon", None, float("nan"), float("inf")):
        with pytest.raises(EventDataError, match="frame 0: not a time stamp"):
            esim.step(frame, bad)
    with pytest.raises(EventDataError, match="float64"):
        esim.step(frame.astype(float), 0)
    esim.step(frame, -(2**61) + 1)
    assert esim.t_ns == -(2**61) + 1
    with pytest.raises(EventDataError, match="frame 1: time stamps must increase"):
        esim.step(frame, esim.t_ns)
    with pytest.raises(EventDataError, match="frame 1: a frame of another shape"):
        esim.step(frame[:1], 0)
    for colours in (np.ones((2, 2, 3), np.float32), np.full((2, 2, 3), 200, np.uint8)):
        with pytest.raises(EventDataError, match="frame 0: a frame of another shape") as failed:
            Esim(2, 2, EsimConfig(), 0).step(colours, 0)
        remedy = f"numpy.{colours.dtype}(frame @ [0.2126, 0.7152, 0.0722])"
        assert remedy in str(failed.value)
        Esim(2, 2, EsimConfig(), 0).step(getattr(np, str(colours.dtype))(colours @ [0.2126, 0.7152, 0.0722]), 0)
    longest = (2**30 - 1) * 1000
    esim.step(frame, esim.t_ns + longest)
    with pytest.raises(
        EventDataError, match="frame 2: time stamp out of range .*at most 17 minutes between two frames"
    ):
        esim.step(frame, esim.t_ns + longest + 1)


def test_the_largest_intensity():
    esim = Esim(1, 2, EsimConfig(), 0)
    esim.step(np.float32([[0.0, 2.0**30]]), 0)
    with pytest.raises(EventDataError, match=r"frame 1: intensity at pixel x=1, y=0 cannot be used") as caught:
        esim.step(np.array([[-0.0, np.nextafter(np.float32(2.0**30), np.float32(np.inf))]], np.float32), 1000)
    assert caught.value.pixel == (1, 0)


@pytest.mark.parametrize(
    "table", [np.ones(255), np.full(256, -1.0), np.full(256, np.nan), np.full(256, 2.0**31), np.ones((2, 256))]
)
def test_tables_of_luminance_that_are_refused(table):
    with pytest.raises(EventDataError, match="decode table must hold 256 finite values >= 0"):
        Esim(2, 2, EsimConfig(), 0).set_decode(table)


@pytest.mark.parametrize("kind, config", [(Esim, EsimConfig(threshold_sigma=0.0)), (V2e, V2eConfig(preset="clean"))])
def test_codes_are_looked_up_in_the_table(kind, config):
    """By default k / 255; any other table is that luminance."""
    codes = np.random.default_rng(0).integers(0, 256, (3, 9, 11), np.uint8)
    table = np.linspace(0.2, 1.4, 256).astype(np.float32) ** 2
    for set_to in (None, table):
        by_code, by_value = kind(9, 11, config, 5), kind(9, 11, config, 5)
        if set_to is not None:
            by_code.set_decode(set_to)
        values = np.arange(256, dtype=np.float32) / np.float32(255) if set_to is None else set_to
        for k, frame in enumerate(codes):
            a, b = by_code.step(frame, k * 10**6), by_value.step(values[frame], k * 10**6)
            assert all(np.array_equal(getattr(a, c), getattr(b, c)) for c in "xytp") and (k == 0) == (len(a) == 0)


def test_a_saved_state_is_refused_by_another_emulator():
    one = Esim(3, 4, EsimConfig(threshold_sigma=0.0), 0)
    one.step(np.ones((3, 4), np.float32), 5)
    state = one.state_dict()
    assert state["clock"].tolist() == [1, 5, 1, 0] and state["shape"].tolist() == [3, 4]
    name = next(k for k in state if k not in ("clock", "shape"))
    for wrong in (
        {**state, "more": np.zeros(1)},
        {k: v for k, v in state.items() if k != name},
        {**state, "shape": np.array([4, 3])},
        {**state, name: state[name].astype(np.float64)},
        {**state, name: state[name][1:]},
    ):
        with pytest.raises(EventDataError, match="saved state is of another emulator"):
            Esim(3, 4, EsimConfig(threshold_sigma=0.0), 0).load_state_dict(wrong)
    fresh = Esim(3, 4, EsimConfig(threshold_sigma=0.0), 0)
    assert fresh.state_dict()["clock"].tolist() == [0, 0, 0, 0]
    one.load_state_dict(fresh.state_dict())
    assert one.t_ns is None and one.frames == 0


# --- Rows that the caller knows to be unchanged may be skipped: same events, same state.

H, W = 53, 70


def clip():
    """A bright bar wandering up and down over a still background, and the rows that differ from frame to frame."""
    rng = np.random.default_rng(3)
    background = rng.uniform(0.1, 1.0, (H, W)).astype(np.float32)
    frames, places = [background], [(0, 0)]
    for k in range(12):
        y0 = 5 * k % 40
        frame = background.copy()
        frame[y0 : y0 + 6, 10:40] *= np.float32(2.5)
        frames.append(frame)
        places.append((y0, y0 + 6))
    rows = [None] + [(min(a[0], b[0]), max(a[1], b[1])) for a, b in itertools.pairwise(places)]
    rows[1] = places[1]
    frames += [frames[-1], frames[-1]]
    rows += [(0, 0), (0, 0)]  # nothing changed at all
    return frames, rows


@pytest.mark.parametrize(
    "config",
    [
        EsimConfig(),
        EsimConfig(threshold_sigma=0.0),
        EsimConfig(threshold_jitter=0.05, refractory_us=300.0),
        V2eConfig(preset="noisy"),
        VoltmeterConfig(),
    ],
)
def test_same_events_and_state(config):
    frames, rows = clip()
    told, undetermined = (make_emulator(config, H, W, seed=9) for _ in range(2))
    count = 0
    for k, (frame, changed) in enumerate(zip(frames, rows)):
        a, b = told.step(frame, k * 1_000_000, changed), undetermined.step(frame, k * 1_000_000)
        assert_same(a, b)
        count += len(a)
    assert count > 500
    for name, value in undetermined.state_dict().items():
        np.testing.assert_array_equal(told.state_dict()[name], value)


def test_bad_values_in_the_changed_rows_are_still_found():
    emulator = make_emulator(EsimConfig(), H, W, seed=1)
    frame = np.ones((H, W), np.float32)
    emulator.step(frame, 0)
    frame[20, 7] = np.nan
    with pytest.raises(EventDataError, match="x=7, y=20"):
        emulator.step(frame, 1000, rows=(18, 24))


# --- Events that ``max_events_per_step`` cuts are counted, and no others: nothing is lost, nothing is reported as
# lost.

KINDS = {
    "esim": EsimConfig(threshold_sigma=0.0),
    "v2e": V2eConfig(preset="clean"),
    "voltmeter": VoltmeterConfig(),
}


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_cut_is_counted(kind):
    """One step of 30 events a pixel into room for four: as many are given as fit, and with those that are counted as
    cut there are as many as without a limit, to an event of each pixel."""
    frames = [np.full((24, 30), v, np.float32) for v in (0.01, 1.0)]
    counts = []
    for limit in (3000, 10**6):
        emulator = make_emulator(KINDS[kind].model_copy(update={"max_events_per_step": limit}), 24, 30, 3)
        emulator.step(frames[0], 0)
        made = len(emulator.step(frames[1], 10**8))
        assert made <= limit and (emulator.saturated > 0) == (limit == 3000)
        counts.append(made + emulator.saturated)
        if limit == 3000:
            assert made > 2000
    assert abs(counts[0] - counts[1]) <= (0.1 if kind == "voltmeter" else 0.05) * counts[1]


# --- The kernels' threads: every part is done once, by whoever is free; nobody waits for a thread that has not
# begun.


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
        both.wait(600)
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


@pytest.mark.parametrize("config", [EsimConfig(), V2eConfig(), VoltmeterConfig()])
@pytest.mark.parametrize("t", [33.3, 33.0, np.float64(5e6), "5", None, True])
def test_times_are_whole_nanoseconds(config, t):
    """Milliseconds as a float would be cut to a few nanoseconds, and make no event."""
    emulator = make_emulator(config, 8, 8, 0)
    emulator.step(np.full((8, 8), 0.2, np.float32), 0)
    with pytest.raises(EventDataError, match=r"not a time stamp .*expected whole nanoseconds"):
        emulator.step(np.full((8, 8), 0.9, np.float32), t)
    assert emulator.frames == 1


def test_an_emulator_that_changes_frames_sees_all_of_them():
    """A subclass that lets the light flicker: the source promises that no row has changed, and all pixels fire."""

    class Flickers(Esim):
        def _advance(self, frame, t_ns):
            return super()._advance(frame * np.float32(2.0 if t_ns % 2_000_000 else 1.0), t_ns)

    class Inherits(Esim):
        pass

    config, frame = EsimConfig(threshold_sigma=0.0), np.full((8, 8), 0.2, np.float32)
    for kind, due in ((Flickers, 64 * 3), (Inherits, 0)):
        emulator = kind(8, 8, config)
        emulator.step(frame, 0)
        assert len(emulator.step(frame, 1_000_000, rows=(0, 0))) == due


def test_what_comes_after_a_cut_has_its_own_cause():
    """A still bright picture after a jump too large for one step: the leak alone makes events, as without a limit."""
    causes = []
    for limit in (10**6, 1024):
        config = VoltmeterConfig(causes=True, max_events_per_step=limit)
        emulator = make_emulator(config, 32, 32, 1)
        for t_ns, light in ((0, 0.05), (10**7, 0.9)):
            emulator.step(np.full((32, 32), light, np.float32), t_ns)
        assert (emulator.saturated > 0) == (limit == 1024)
        later = [emulator.step(np.full((32, 32), 0.9, np.float32), 4 * 10**7 * (k + 1)) for k in range(25)]
        causes.append(named_causes(count_causes(Events.concatenate(later))))
    # What V holds at the end of the cut step is no light any more.
    whole, cut = causes
    assert cut["leak"] > 100 and cut["signal"] == 0 and whole["signal"] > 0
