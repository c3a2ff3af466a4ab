"""ESIM: kernel = slow twin, closed forms, convergence order, state, bad input."""

from __future__ import annotations

import itertools
from functools import cache

import numba
import numpy as np
import pytest
from scipy.optimize import brentq

from blinkgl.config.events import EsimConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Esim, Events
from tests.events.clips import assert_same, random_clip, run
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


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
@pytest.mark.parametrize("variant", VARIANTS)
def test_equals_slow_twin(variant, dtype, threads):
    clip, times = random_clip(1, dtype=dtype, frames=5 if variant == "fine" else 8)
    config = EsimConfig(**VARIANTS[variant])
    fast = run(Esim(37, 45, config, seed=9), clip, times)
    assert len(fast) > 2000
    assert_same(fast, twin(variant, dtype))


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
