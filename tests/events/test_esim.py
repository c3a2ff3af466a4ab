"""ESIM: kernel = slow twin, closed forms, convergence order, state, bad input."""

from __future__ import annotations

import itertools
from functools import cache

import numba
import numpy as np
import pytest
from scipy.optimize import brentq

from blinkgl.config.events import EsimConfig, V2eConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Esim, Events, V2e
from tests.events.clips import assert_same, random_clip, run, run_cubic
from tests.events.reference import ReferenceEsim

PLAIN = dict(threshold_sigma=0.0)
VARIANTS = {
    "plain": PLAIN,
    "spread": dict(contrast_threshold=0.15, contrast_threshold_off=0.3, threshold_sigma=0.05),
    "refractory": dict(threshold_sigma=0.0, refractory_us=2500.0),
    "jitter": dict(threshold_sigma=0.02, threshold_jitter=0.05, refractory_us=100.5),
    "fine": dict(contrast_threshold=0.004, threshold_sigma=0.001),
}


@pytest.fixture(params=[1, 2])
def threads(request):
    before = numba.get_num_threads()
    if request.param > numba.config.NUMBA_NUM_THREADS:
        pytest.skip("one core only")
    numba.set_num_threads(request.param)
    yield request.param
    numba.set_num_threads(before)


@cache
def twin(variant, dtype):
    """The slow twin's events; the same for every number of threads."""
    clip, times = random_clip(1, dtype=dtype, frames=5 if variant == "fine" else 8)
    return run(ReferenceEsim(37, 45, EsimConfig(**VARIANTS[variant]), seed=9), clip, times)


def steep(variant, dtype):
    """Slopes of both signs, too large and too small: all that the limiter meets."""
    clip, times = random_clip(1, dtype=dtype)
    rates = np.random.default_rng(2).normal(0, 30, clip.shape).astype(np.float32)
    return clip, times, rates, EsimConfig(**VARIANTS[variant])


@cache
def cubic_twin(reconstruction, variant, dtype):
    clip, times, rates, config = steep(variant, dtype)
    return run_cubic(ReferenceEsim(37, 45, config, 9, reconstruction), clip, times, rates)


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
@pytest.mark.parametrize("variant", VARIANTS)
def test_equals_slow_twin(variant, dtype, threads):
    clip, times = random_clip(1, dtype=dtype, frames=5 if variant == "fine" else 8)
    config = EsimConfig(**VARIANTS[variant])
    fast = run(Esim(37, 45, config, seed=9), clip, times)
    assert len(fast) > 2000
    assert_same(fast, twin(variant, dtype))


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
@pytest.mark.parametrize("variant", ["plain", "spread", "refractory", "jitter"])
@pytest.mark.parametrize("reconstruction", ["pchip", "hermite"])
def test_cubics_equal_slow_twin(reconstruction, variant, dtype, threads):
    clip, times, rates, config = steep(variant, dtype)
    fast = run_cubic(Esim(37, 45, config, 9, reconstruction), clip, times, rates)
    assert len(fast) > 2000
    assert_same(fast, cubic_twin(reconstruction, variant, dtype))


@pytest.mark.parametrize("reconstruction", ["pchip", "hermite"])
def test_cubics_pass_the_levels_of_the_straight_line(reconstruction):
    """The same events per pixel in the same order; only the times differ, and stay inside their interval."""
    clip, times = random_clip(5, frames=12)
    rates = np.random.default_rng(2).normal(0, 30, clip.shape).astype(np.float32)
    config = EsimConfig(threshold_sigma=0.03, threshold_jitter=0.05)
    straight = run(Esim(37, 45, config, 9), clip, times)
    cubic = run_cubic(Esim(37, 45, config, 9, reconstruction), clip, times, rates)
    a, b = (np.lexsort((np.arange(len(e)), e.x, e.y)) for e in (straight, cubic))
    for name in "xyp":
        np.testing.assert_array_equal(getattr(straight, name)[a], getattr(cubic, name)[b])
    np.testing.assert_array_equal(
        np.searchsorted(times // 1000, straight.t[a]), np.searchsorted(times // 1000, cubic.t[b])
    )
    assert (straight.t[a] != cubic.t[b]).mean() > 0.5 and (np.diff(cubic.t) >= 0).all()


@pytest.mark.parametrize("reconstruction", ["pchip", "hermite"])
@pytest.mark.parametrize("cut", [1, 2, 3, 6])
def test_cubics_resume_bit_identically(reconstruction, cut):
    clip, times = random_clip(2, frames=9)
    rates = np.random.default_rng(3).normal(0, 30, clip.shape).astype(np.float32)
    config = EsimConfig(**VARIANTS["jitter"])
    whole = run_cubic(Esim(37, 45, config, 3, reconstruction), clip, times, rates)
    first, second = (Esim(37, 45, config, 3, reconstruction) for _ in range(2))
    head = [first.step(f, int(t), None, r) for f, t, r in zip(clip[:cut], times, rates)]
    second.load_state_dict(first.state_dict())
    assert_same(whole, Events.concatenate([*head, run_cubic(second, clip[cut:], times[cut:], rates[cut:])]))


def test_pchip_is_one_frame_late_and_goes_on_after_a_flush():
    clip, times = random_clip(7, frames=10)
    esim = Esim(37, 45, EsimConfig(**PLAIN), 3, "pchip")
    chunks = []
    for k, (frame, t) in enumerate(zip(clip, times)):
        chunks.append(esim.step(frame, int(t)))
        assert esim.done_ns == times[max(k - 1, 0)] and (
            len(chunks[-1]) == 0 or chunks[-1].t.max() <= esim.done_ns // 1000
        )
        if k in (4, 5):
            chunks.append(esim.flush())
            assert esim.done_ns == t and len(esim.flush()) == 0
    events = Events.concatenate([*chunks, esim.flush()])
    assert len(events) == len(run(Esim(37, 45, EsimConfig(**PLAIN), 3), clip, times)) and (np.diff(events.t) >= 0).all()


def test_hermite_without_rates_and_unknown_paths_are_refused():
    esim, frame = Esim(4, 5, EsimConfig(), 1, "hermite"), np.ones((4, 5), np.float32)
    for rate in (None, np.ones((4, 4), np.float32), np.ones((4, 5))):
        with pytest.raises(EventDataError, match="frame 0: hermite wants the rate"):
            esim.step(frame, 0, None, rate)
    with pytest.raises(EventDataError, match="timeline.reconstruction"):
        Esim(4, 5, EsimConfig(), 1, "spline")
    with pytest.raises(EventDataError, match="timeline.reconstruction"):
        V2e(4, 5, V2eConfig(), 1, "pchip")


def test_rates_that_are_not_finite_count_as_zero():
    esim, twin = (Esim(2, 3, EsimConfig(**PLAIN), 1, "hermite") for _ in range(2))
    frames = [np.full((2, 3), v, np.float32) for v in (0.1, 5.0)]
    bad = np.array([[np.nan, np.inf, -np.inf], [0, 0, 0]], np.float32)
    a, b = (
        Events.concatenate([e.step(f, 10**6 * k, None, r) for k, f in enumerate(frames)])
        for e, r in ((esim, bad), (twin, np.zeros((2, 3), np.float32)))
    )
    keep = a.x != 1  # +inf is a slope beyond the limit
    np.testing.assert_array_equal(a.t[keep], b.t[b.x != 1])
    assert len(a) == len(b)


@pytest.mark.parametrize("variant", ["plain", "jitter"])
def test_resumes_bit_identically(variant):
    clip, times = random_clip(2, frames=9)
    config = EsimConfig(**VARIANTS[variant])
    whole = run(Esim(37, 45, config, 3), clip, times)
    first = Esim(37, 45, config, 3)
    head = run(first, clip[:4], times[:4])
    second = Esim(37, 45, config, 3)
    second.load_state_dict(first.state_dict())
    tail = run(second, clip[4:], times[4:])
    assert_same(whole, Events.concatenate([head, tail]))
    assert second.frames == 9


def test_ramp_closed_form():
    """exp(a t) with no epsilon to speak of: an event every C/a seconds, to the microsecond."""
    rate, c, dt = 40.0, 0.2, 1_000_000
    esim = Esim(1, 1, EsimConfig(contrast_threshold=c, threshold_sigma=0, log_eps=1e-9))
    events = run(
        esim,
        [np.full((1, 1), 1e-3 * np.exp(rate * k * dt * 1e-9), np.float32) for k in range(101)],
        range(0, 101 * dt, dt),
    )
    expected = np.arange(1, 20) * c / rate * 1e6
    assert len(events) in (19, 20) and (events.p == 1).all()
    assert np.abs(events.t[:19] - expected).max() <= 2


def test_step_is_spread_over_its_interval():
    """A jump of 10.5 thresholds fires ten events, evenly spaced in the interval."""
    esim = Esim(1, 1, EsimConfig(contrast_threshold=0.1, threshold_sigma=0, log_eps=1e-9))
    esim.step(np.ones((1, 1), np.float32), 5_000_000)
    events = esim.step(np.full((1, 1), np.exp(-1.05), np.float32), 6_000_000)
    assert len(events) == 10 and (events.p == 0).all()
    assert np.abs(events.t - 5000 - np.arange(1, 11) / 10.5 * 1000).max() <= 1


def test_slow_ramp_fires():
    """3e-7 per frame: each step is far below what a float32 reference could follow."""
    frames, rate = 4000, 3e-7
    esim = Esim(1, 4, EsimConfig(contrast_threshold=0.001, threshold_sigma=0, log_eps=1e-9))
    events = run(
        esim, (np.full((1, 4), np.exp(rate * k), np.float32) for k in range(frames)), range(0, frames * 10**6, 10**6)
    )
    assert len(events) == 4 and (events.p == 1).all()
    assert np.abs(events.t - 0.001 / rate * 1000).max() < 1e-3 * events.t.max() + 1000


def test_exact_return_makes_as_many_off_as_on_events():
    """Back and forth between two 8-bit values, forever: no rounding decides, no drift builds up."""
    frame = np.arange(256, dtype=np.uint8).reshape(16, 16)
    esim = Esim(16, 16, EsimConfig(contrast_threshold=0.07, threshold_sigma=0))
    counts = []
    for k in range(400):
        events = esim.step(frame if k % 2 == 0 else frame[::-1, ::-1].copy(), k * 10**6)
        counts.append(((events.p == 1).sum(), (events.p == 0).sum()))
    assert len(set(counts[3::2])) == len(set(counts[4::2])) == 1
    assert counts[3] == counts[4][::-1] and counts[3][0] > 1000


def log_sinusoid(s):
    """ln intensity at time s in periods."""
    return 1.1 * np.sin(2 * np.pi * s + 0.3)


def crossings(signal, c, end):
    """Times at which levels c apart (hysteresis: from the last one passed) are passed, to 1e-12."""
    t = np.linspace(0, end, 20_001)
    reference, times = signal(0.0), []
    for a, b in itertools.pairwise(t):
        for level in (reference + c, reference - c):
            if (signal(a) - level) * (signal(b) - level) < 0:
                times.append(brentq(lambda u: signal(u) - level, a, b, xtol=1e-14))
                reference = level
                break
    return np.array(times)


@pytest.mark.parametrize("scene", ["log sinusoid", "linear ramp"])
def test_event_times_converge_with_order_two(scene):
    """Linear interpolation of a smooth log intensity: time errors fall with the square of the frame spacing."""
    c, period = 0.2, 20.0  # seconds; long, so that 1 us is far below the errors
    if scene == "log sinusoid":
        intensity = lambda s: np.exp(log_sinusoid(0.95 * s))
        truth = crossings(log_sinusoid, c, 0.95) / 0.95
    else:
        intensity = lambda s: 1 + 4 * s
        truth = (np.exp(c * np.arange(1, 9)) - 1) / 4
        truth = truth[truth <= 1]
    spacings, errors = [], []
    for n in (64, 128, 256, 512):
        esim = Esim(1, 1, EsimConfig(contrast_threshold=c, threshold_sigma=0, log_eps=1e-9))
        events = run(
            esim,
            [np.full((1, 1), intensity(k / n), np.float32) for k in range(n + 1)],
            [round(k / n * period * 1e9) for k in range(n + 1)],
        )
        assert len(events) == len(truth)
        spacings.append(1 / n)
        errors.append(np.sqrt(np.mean((events.t * 1e-6 / period - truth) ** 2)))
    order = np.polyfit(np.log(spacings), np.log(errors), 1)[0]
    assert abs(order - 2) < 0.3, (order, errors)


def test_refractory_dead_time():
    """No two events of a pixel are closer than the dead time, and the levels passed in it are lost."""
    clip, times = random_clip(4, frames=20)
    free = run(Esim(37, 45, EsimConfig(**PLAIN)), clip, times)
    dead = run(Esim(37, 45, EsimConfig(threshold_sigma=0, refractory_us=3000)), clip, times)
    pixel = dead.y.astype(int) * 45 + dead.x
    order = np.lexsort((dead.t, pixel))
    same = np.diff(pixel[order]) == 0
    gaps = np.diff(dead.t[order])[same]
    assert gaps.min() >= 2999 and 0.2 < len(dead) / len(free) < 0.9


def test_threshold_spread_is_frozen_and_normal():
    esim = Esim(100, 100, EsimConfig(contrast_threshold=0.3, threshold_sigma=0.03), seed=0)
    on = esim._on / 2**25
    assert abs(on.mean() - 0.3) < 0.0015 and abs(on.std() - 0.03) < 0.001
    assert abs(np.corrcoef(on, esim._off)[0, 1]) < 0.04
    assert (Esim(100, 100, EsimConfig(contrast_threshold=0.3, threshold_sigma=0.03), seed=1)._on != esim._on).any()


def test_event_count_does_not_depend_on_frame_rate_with_spread():
    """The same ramp in 10 or 1000 frames: thresholds are not redrawn per frame, so no event is lost."""
    counts = []
    for n in (10, 1000):
        esim = Esim(20, 20, EsimConfig(threshold_sigma=0.05, log_eps=1e-9))
        counts.append(
            len(
                run(
                    esim,
                    [np.full((20, 20), np.exp(3 * k / n), np.float32) for k in range(n + 1)],
                    [round(k / n * 1e9) for k in range(n + 1)],
                )
            )
        )
    assert abs(counts[0] - counts[1]) <= 4


def test_burst_saturates_honestly(threads):
    """10^4 events per pixel wanted in one interval: bounded memory, every pixel cut alike, the rest counted."""
    config = EsimConfig(contrast_threshold=0.001, threshold_sigma=0, log_eps=1e-9, max_events_per_step=20_000)
    esim = Esim(40, 50, config)
    esim.step(np.full((40, 50), 1e-5, np.float32), 0)
    events = esim.step(np.full((40, 50), np.exp(-1.5), np.float32), 10**6)
    assert 16_000 < len(events) <= 20_000 and len(np.unique(events.y.astype(int) * 50 + events.x)) == 2000
    wanted = int((np.log(np.exp(-1.5)) - np.log(1e-5)) / 0.001)
    assert abs(esim.saturated + len(events) - 2000 * wanted) <= 4000
    again = esim.step(np.full((40, 50), np.exp(-1.5), np.float32), 2 * 10**6)
    assert len(again) == 0  # levels moved: no backlog


def test_long_intervals():
    esim = Esim(1, 1, EsimConfig(threshold_sigma=0, log_eps=1e-9))
    slow = ReferenceEsim(1, 1, EsimConfig(threshold_sigma=0, log_eps=1e-9))
    frames, times = [np.full((1, 1), v, np.float32) for v in (0.1, 5.0, 0.2)], [0, 17 * 60 * 10**9, 34 * 60 * 10**9 - 1]
    assert_same(run(esim, frames, times), run(slow, frames, times))
    with pytest.raises(EventDataError, match="17 minutes"):
        esim.step(frames[0], times[-1] + 18 * 60 * 10**9)


@pytest.mark.parametrize("value", [-0.5, np.nan, np.inf, -np.inf, 1e20])
@pytest.mark.parametrize("first", [True, False])
def test_bad_intensity_names_frame_and_value(value, first, threads):
    esim, good = Esim(30, 70, EsimConfig(**PLAIN)), np.full((30, 70), 0.5, np.float32)
    if not first:
        esim.step(good, 0)
    before = esim.state_dict()
    bad = good.copy()
    bad[12, 34] = value
    with pytest.raises(EventDataError, match=rf"frame {0 if first else 1}: .*x=34, y=12.*{str(value)[0]}"):
        esim.step(bad, 10**6)
    after = esim.state_dict()
    assert all((before[k] == after[k]).all() for k in before)
    assert len(esim.step(good, 2 * 10**6)) == 0  # and it goes on


def test_bad_times_sizes_and_types():
    esim, good = Esim(3, 4), np.full((3, 4), 0.5, np.float32)
    esim.step(good, 1000)
    for t in (1000, 999):
        with pytest.raises(EventDataError, match="frame 1: time stamps must increase"):
            esim.step(good, t)
    with pytest.raises(EventDataError, match="frame 1: frame size changed"):
        esim.step(good[:2], 2000)
    with pytest.raises(EventDataError, match="float64"):
        esim.step(good.astype(float), 2000)
    with pytest.raises(EventDataError):
        Esim(0, 4)
    with pytest.raises(EventDataError, match="another emulator"):
        Esim(3, 5).load_state_dict(esim.state_dict())


def test_zero_and_negative_zero_are_dark():
    esim = Esim(1, 2, EsimConfig(threshold_sigma=0))
    esim.step(np.array([[0.0, -0.0]], np.float32), 0)
    events = esim.step(np.array([[1.0, 1.0]], np.float32), 10**6)
    assert len(events) == 2 * int(np.log(1.001 / 0.001) / 0.2)


def test_seed_zero_is_a_seed():
    clip, times = random_clip(6)
    a, b, c = (run(Esim(37, 45, EsimConfig(threshold_sigma=0.05), s), clip, times) for s in (0, 0, 1))
    assert_same(a, b)
    assert len(a) != len(c) or (a.t != c.t).any()


@pytest.mark.parametrize("reconstruction, order, intervals", [("pchip", 3, (12, 24, 48)), ("hermite", 4, (2, 3, 4, 6))])
def test_cubics_converge_faster_than_the_straight_line(reconstruction, order, intervals):
    """A smooth log intensity, away from its turning points (where any monotone curve is of second order in time), and
    in so few intervals that the errors stay far above float32's rounding of the frames."""
    c, period = 0.02, 2000.0  # seconds; so long that 1 us is far below the errors
    signal = lambda s: np.sin(2 * np.pi * s - 1.0)  # steep from 0 to 0.3
    slope = lambda s: 2 * np.pi * np.cos(2 * np.pi * s - 1.0)
    end = 0.3
    spacings, errors = [], []
    truth = (np.arcsin(np.sin(-1.0) + c * np.arange(1, 200).clip(max=int((signal(end) - signal(0)) / c))) + 1.0) / (
        2 * np.pi
    )
    truth = np.unique(truth)
    for n in intervals:
        s = np.linspace(0, end, n + 1)
        emulator = Esim(1, 1, EsimConfig(contrast_threshold=c, threshold_sigma=0, log_eps=1e-9), 1, reconstruction)
        frames = [np.full((1, 1), np.exp(signal(u)), np.float32) for u in s]
        rates = [f * np.float32(slope(u) / period) for f, u in zip(frames, s)]
        events = run_cubic(emulator, frames, [round(u * period * 1e9) for u in s], rates)
        assert len(events) == len(truth)
        # pchip's outer intervals have one neighbour only.
        inner = (truth > end / 6) & (truth < end * 5 / 6) | (reconstruction == "hermite")
        spacings.append(end / n)
        errors.append(np.sqrt(np.mean((events.t * 1e-6 / period - truth)[inner] ** 2)))
    found = np.polyfit(np.log(spacings), np.log(errors), 1)[0]
    assert abs(found - order) < 0.35, (found, errors)
