"""What kernels and slow twins share, against something that shares nothing with it: NumPy's sorting, roots of cubics,
simulated comparators, laws of chance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from blinkgl.config.events import EsimConfig, V2eConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Esim, V2e, v2e_model
from blinkgl.events.blocks import compact_flags, lookup_block, scale_block
from blinkgl.events.noise import noise_size, noise_table, start_sizes
from blinkgl.events.packing import PackedBuffer

# --- packing --------------------------------------------------------------------------------------------------------


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


def test_spans_of_one_and_of_two_passes_take_turns():
    buffer = PackedBuffer()
    for span in (10, 2**20, 10, 2**25, 2**14):
        rows = buffer.rows(1, 50)
        t = np.random.default_rng(span).integers(0, span + 1, 50)
        rows[0, :50] = t << 33
        assert buffer.to_events(np.array([50]), 0, span).t.tolist() == sorted(t.tolist())


def test_rows_keep_what_is_in_them_when_they_grow():
    buffer = PackedBuffer()
    rows = buffer.rows(3, 4)
    rows[:, :4] = np.arange(12).reshape(3, 4)
    assert buffer.rows(3, 2) is rows, "never smaller"
    buffer.grow(3, 10, np.array([4, 0, 2]))
    grown = buffer.rows(3, 10)
    assert grown.shape == (3, 10) and grown[0, :4].tolist() == [0, 1, 2, 3] and grown[2, :2].tolist() == [8, 9]
    assert (
        buffer.rows(5, 2).shape == (5, 6)
        and buffer.rows(5, 7).shape == (5, 7)
        and PackedBuffer().rows(2, 0).shape == (2, 1)
    )


# --- blocks ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 1.0])
def test_set_flags_in_their_order(share):
    rng = np.random.default_rng(1)
    for n in (8, 64, 1024):
        flags = (rng.random(n) < share).astype(np.uint8)
        out = np.full(n + 8, -1, np.int32)
        assert compact_flags(flags, np.empty(n // 8, np.int64), 5000, out) == flags.sum()
        assert out[: flags.sum()].tolist() == (5000 + np.flatnonzero(flags)).tolist()


def test_every_byte_of_flags():
    for mask in range(256):
        flags = np.array([mask >> b & 1 for b in range(8)], np.uint8)
        out = np.empty(16, np.int32)
        assert out[: compact_flags(flags, np.empty(1, np.int64), 0, out)].tolist() == np.flatnonzero(flags).tolist()


def test_frames_are_scaled_and_looked_up():
    out = np.empty(4, np.float32)
    scale_block(np.float32([0, 0.5, 1, 3]), np.float32(255), out)
    assert out.tolist() == [0, 127.5, 255, 765]
    lookup_block(np.uint8([3, 0, 255, 3]), np.arange(256, dtype=np.float32) / 2, out)
    assert out.tolist() == [1.5, 0, 127.5, 1.5]


# --- photoreceptor noise ---------------------------------------------------------------------------------------------


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


def test_the_size_of_noise_is_smooth_and_grows_with_the_rate():
    """Rates too rare for a simulation: 1 / s^2 is nearly linear in ln r, so neighbours do not differ by much."""
    rates = np.exp(np.arange(-11.0, 2.0, 0.05))
    for k in np.exp(np.linspace(np.log(0.003), np.log(10.0), 60)):
        q = 1 / noise_size(np.full(len(rates), k), rates) ** 2
        inner = q > 1 / 2.5**2 + 1e-9
        steps = -np.diff(q[inner])
        assert (steps > 0).all() and (steps[1:-1] / steps[:-2] > 0.4).all() and (steps[1:] / steps[:-1] < 1.2).all(), k
    for rate in (1e-4, 1e-2, 0.3):
        sizes = noise_size(np.exp(np.linspace(np.log(0.003), np.log(10.0), 200)), rate)
        growth = np.diff(np.log(sizes[sizes < 2.5]))
        assert (growth > 0).all() and growth.max() < 0.05


def test_beyond_the_table_of_noise():
    few, fewer, none = (noise_size(k, 0.1) for k in (0.003, 1e-5, 0.0))
    assert few > fewer > none > 0.97 * few, "finer frames see little new, down to a limit"
    assert fewer == pytest.approx(none, rel=2e-3)
    assert noise_size(100.0, 0.01) == pytest.approx(noise_size(10.0, 0.1)), (
        "samples are independent: the rate per frame counts"
    )
    assert noise_size(1.0, 1e9) == pytest.approx(2.5) and 0 < noise_size(1.0, 0.0) < 0.05
    assert noise_size(np.array([0.1, 1.0]), 0.2).shape == (2,)


def test_the_tables_of_an_interval_and_of_the_start():
    table = noise_table(5.0, 1e-3, 0.2)
    assert table.shape == (256,) and table.dtype == np.float32
    k = np.exp(np.linspace(np.log(1e-6), np.log(1e3), 255))  # the entry after the last is there to be interpolated to
    np.testing.assert_allclose(table[:255], 0.2 * noise_size(k, 5.0 * 1e-3 / k), rtol=1e-5)
    corners = np.random.default_rng(0).uniform(3, 300, 200)
    np.testing.assert_allclose(
        start_sizes(5.0, corners, 0.2), 0.2 * noise_size(np.zeros(200), 5.0 / (2 * np.pi * corners)), rtol=2e-3
    )


@pytest.mark.parametrize("k", [1e-8, 1e-6, 3e-4, 0.7, 900.0, 1e3, 1e5])
def test_a_place_in_the_table_of_sizes(k):
    below, part = v2e_model.noise_place(np.float32(k))
    step = np.log(1e9) / 254
    expected = min(max((np.log(k) - np.log(1e-6)) / step, 0.0), 254.0)
    assert 0 <= below <= 254 and below + part == pytest.approx(expected, abs=2e-4)


@pytest.mark.parametrize("k", [0.01, 0.4, 0.7, 5.0])
def test_noise_is_stationary_and_forgets_by_its_time_constant(k):
    rng = np.random.default_rng(0)
    first = np.float32(0.3) * rng.normal(size=100_000).astype(np.float32)
    second = v2e_model.next_noise(first, np.float32(k), np.float32(0.3), rng.normal(size=100_000).astype(np.float32))
    assert second.std() == pytest.approx(0.3, rel=0.01) and np.corrcoef(first, second)[0, 1] == pytest.approx(
        np.exp(-k), abs=0.01
    )


def test_noise_at_the_first_frame():
    config = V2eConfig(
        shot_noise_rate_hz=20.0, photoreceptor_noise=True, leak_rate_hz=0.0, cutoff_hz=30.0, contrast_threshold=0.2
    )
    light = np.repeat(np.float32([0, 100, 255]), 20_000)
    noise = v2e_model.draw_start_noise(light, config, np.uint64(3)).reshape(3, -1)
    for row, level in zip(noise, (0, 100, 255)):
        corner = 30.0 * (level + 20) / 275
        assert row.std() == pytest.approx(0.2 * noise_size(0.0, 20.0 / (2 * np.pi * corner)), rel=0.02)
        assert stats.kstest(row / row.std(), "norm").pvalue > 1e-3


# --- shot noise and leak ---------------------------------------------------------------------------------------------


def test_shot_noise_is_drawn_by_its_law():
    rate = 2e-6  # per ns
    draws = [v2e_model.shot_draw(np.uint64(1), np.uint64(7), np.uint64(k), rate) for k in range(4000)]
    waits, picks = (np.array(column, float) for column in zip(*draws))
    assert waits.min() >= 1 and stats.kstest(waits, "expon", (0, 1 / rate)).pvalue > 1e-3
    assert stats.kstest(picks, "uniform").pvalue > 1e-3 and abs(np.corrcoef(waits, picks)[0, 1]) < 0.05
    assert abs(np.corrcoef(picks[:-1], picks[1:])[0, 1]) < 0.05 and len(np.unique(picks)) == 4000
    assert v2e_model.shot_draw(np.uint64(1), np.uint64(7), np.uint64(0), 1e-30)[0] == 10**18 + 1


def test_shot_noise_falls_to_a_quarter_from_dark_to_full_scale():
    assert [v2e_model.shot_factor(v) for v in (-100.0, -20.0, 117.5, 255.0, 1e9)] == [1.0, 1.0, 0.625, 0.25, 0.25]
    assert v2e_model.DARKEST == v2e_model.shot_factor(0.0) == pytest.approx(1 - 0.75 * 20 / 275)


def test_tables_of_who_makes_noise():
    """A pixel counts by how much lower its threshold is than the nominal one; ON pixels of
    a block first, then OFF ones."""
    rng = np.random.default_rng(0)
    on, off = (np.float32(nominal) * rng.uniform(0.5, 2, 1500).astype(np.float32) for nominal in (0.2, 0.3))
    tables = v2e_model.shot_tables(on, off, 0.2, 0.3)
    assert tables.shape == (2, 2048) and tables.dtype == np.float32
    for block, pixels in enumerate((slice(0, 1024), slice(1024, 1500))):
        each = np.diff(np.concatenate([[0], tables[block]]))
        n = len(on[pixels])
        np.testing.assert_allclose(each[:n], 0.2 / on[pixels], atol=2e-4)
        np.testing.assert_allclose(each[1024 : 1024 + n], 0.3 / off[pixels], atol=2e-4)
        assert (each[n:1024] == 0).all() and (each[1024 + n :] == 0).all()


def test_leaks():
    on = np.full(40_000, 0.2, np.float32)
    draw = lambda **keys: v2e_model.draw_leaks(
        200, 200, V2eConfig(**{**dict(leak_rate_hz=0.0, leak_cov_decades=0.0), **keys}), on, np.uint64(1)
    )
    assert draw().shape == (0,) and draw().dtype == np.float32
    np.testing.assert_allclose(draw(leak_rate_hz=2.0), 0.4, rtol=1e-6)
    hot = draw(leak_rate_hz=2.0, hot_pixel_fraction=0.1, hot_pixel_rate_hz=50.0)
    is_hot = np.abs(hot - 0.4) > 1e-6
    assert (
        is_hot.mean() == pytest.approx(0.1, abs=0.01)
        and stats.kstest(hot[is_hot] / 0.2, "expon", (0, 50.0)).pvalue > 1e-3
    )
    only = draw(hot_pixel_fraction=0.1, hot_pixel_rate_hz=50.0)
    assert (only > 0).mean() == pytest.approx(0.1, abs=0.01) and (only[only > 0] == hot[only > 0]).all()
    wild = draw(leak_rate_hz=100.0, leak_cov_decades=3.0)
    assert wild.max() == pytest.approx(0.2e6), "no more than one event per microsecond"


# --- what every emulator checks --------------------------------------------------------------------------------------


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


def test_times_that_an_emulator_takes():
    frame, esim = np.ones((2, 2), np.float32), Esim(2, 2, EsimConfig(), 0)
    for bad in (2**61, -(2**61)):
        with pytest.raises(EventDataError, match=f"frame 0: time stamp out of range .got '{bad} ns'"):
            Esim(2, 2, EsimConfig(), 0).step(frame, bad)
    for bad in ("soon", None, float("nan"), float("inf")):
        with pytest.raises(EventDataError, match="frame 0: not a time stamp"):
            esim.step(frame, bad)
    esim.step(frame, -(2**61) + 1)
    assert esim.t_ns == -(2**61) + 1
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
