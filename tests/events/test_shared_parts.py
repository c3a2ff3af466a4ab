"""What emulators share: packing and sorting, the size of noise, what every one of them checks."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.config.events import EsimConfig, V2eConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Esim, V2e
from blinkgl.events.noise import noise_size
from blinkgl.events.packing import PackedBuffer


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
    with pytest.raises(EventDataError, match="frame 1: frame size changed"):
        esim.step(frame[:1], 0)
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
