"""V2E: kernel = slow twin, frequency response, crossing times, leak and shot rates, dead time, state."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from blinkgl.config.events import V2eConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Events, V2e, v2e_model as v2e
from tests.events.clips import assert_same, random_clip, run
from tests.events.reference import ReferenceV2e
from tests.events.test_esim import threads  # noqa: F401  (fixture)

MS = 10**6
QUIET = dict(threshold_sigma=0.0, leak_rate_hz=0.0, shot_noise_rate_hz=0.0, refractory_us=0.0)
VARIANTS = {
    "clean": dict(preset="clean"),
    "default": {},
    "noisy": dict(preset="noisy"),
    "filter only": dict(preset="clean", cutoff_hz=40.0),
    "long dead time, noise, hot pixels": dict(
        shot_noise_rate_hz=50.0, leak_rate_hz=3.0, hot_pixel_fraction=0.05, refractory_us=20_000.0
    ),
    "photoreceptor noise": dict(shot_noise_rate_hz=20.0, photoreceptor_noise=True, leak_rate_hz=0.0, cutoff_hz=30.0),
    "photoreceptor noise, leak": dict(preset="noisy", shot_noise_rate_hz=30.0, photoreceptor_noise=True),
    "balanced": dict(start="balanced", leak_rate_hz=5.0, shot_noise_rate_hz=20.0),
    "starting at 0": dict(start="zero", leak_rate_hz=5.0, refractory_us=0.0),
    "noise without dead time": dict(
        shot_noise_rate_hz=80.0, leak_rate_hz=2.0, refractory_us=0.0, contrast_threshold_off=0.3
    ),
}


@cache
def twin(variant, dtype):
    """The slow twin's events; the same for every number of threads."""
    clip, times = random_clip(1, frames=5, dtype=dtype)
    return run(ReferenceV2e(37, 45, V2eConfig(**VARIANTS[variant], causes=True), seed=9), clip, times)


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
@pytest.mark.parametrize("variant", VARIANTS)
def test_equals_slow_twin(variant, dtype, threads):  # noqa: F811
    clip, times = random_clip(1, frames=5, dtype=dtype)
    config = V2eConfig(**VARIANTS[variant], causes=True)
    fast = run(V2e(37, 45, config, seed=9), clip, times)
    assert len(fast) > 1500
    assert_same(fast, twin(variant, dtype))
    untold = run(V2e(37, 45, V2eConfig(**VARIANTS[variant]), seed=9), clip, times)
    assert_same(replace(fast, cause=None), untold)


def test_resumes_bit_identically():
    clip, times = random_clip(2, frames=8)
    # 30 Hz: the leak clock restarts.
    config = V2eConfig(shot_noise_rate_hz=50.0, leak_rate_hz=30.0, refractory_us=9_000.0)
    whole = run(V2e(37, 45, config, 3), clip, times)
    first, second = V2e(37, 45, config, 3), V2e(37, 45, config, 3)
    head = run(first, clip[:3], times[:3])
    second.load_state_dict(first.state_dict())
    assert_same(whole, Events.concatenate([head, run(second, clip[3:], times[3:])]))


def test_lin_log_is_continuous_and_as_published():
    x = np.array([0, 10, 20, 20.001, 255, 1e5], np.float32)
    expected = np.where(x <= 20, x * np.log(20) / 20, np.log(np.maximum(x, 20)))
    np.testing.assert_allclose(v2e.lin_log(x), expected, rtol=3e-7)


def test_decay_at_the_extremes():
    k = np.concatenate([[0.0], np.logspace(-12, 12, 2000)]).astype(np.float32)
    e, g = v2e.decay(k)
    exact = k.astype(float)
    np.testing.assert_allclose(e, np.exp(-exact), rtol=3e-7, atol=2e-38)
    np.testing.assert_allclose(g[1:], -np.expm1(-exact[1:]) / exact[1:], rtol=3e-7)
    assert g[0] == 1


@pytest.mark.parametrize("k", [1e-6, 0.03, 0.7, 5.0, 300.0])
def test_crossing_is_on_the_exact_curve(k):
    """The curve solves y' = k (x - y) for x linear in time, and the crossing is where that reaches the level."""
    rng = np.random.default_rng(0)
    for _ in range(40):
        base, dx, lag, drift = rng.normal(0, 1, 4) * [1, 1, 0.5, 0.05]
        ode = solve_ivp(
            lambda s, y: k * (base + dx * s - y), (0, 1), [base + lag], rtol=1e-10, atol=1e-12, method="LSODA"
        )
        curve = v2e.curve_of(base, drift, dx, lag, k)
        z = lambda s: v2e.signal_at(s, *curve, k)
        assert abs(z(1.0) - drift - ode.y[0, -1]) < 1e-7
        start, end = z(0.0), z(1.0)
        target = start + rng.uniform(0.05, 0.95) * (end - start)
        s = v2e.crossing_fraction(0.0, target, end > start, *curve, k, end)
        exact = brentq(lambda u: z(u) - target, 0, 1, xtol=1e-14)
        assert abs(z(s) - target) < 2e-6 * abs(end - start) or abs(s - exact) < 2e-6


@pytest.mark.parametrize("ratio", [0.1, 1.0, 8.0])
def test_amplitude_and_phase_response(ratio):
    """A small sinusoid in ln I through the photoreceptor: gain 1/sqrt(1 + r^2), phase -atan r, r = f/f_corner."""
    intensity, cutoff = 100.0, 50.0
    corner = cutoff * (intensity + 20) / 275
    f, n = ratio * corner, 200
    dt = 1 / (f * n)
    emulator = V2e(1, 1, V2eConfig(**QUIET, cutoff_hz=cutoff))
    t = np.arange(int(12 * n)) * dt
    amplitude = 0.02  # small: the corner moves with the intensity
    y = []
    for k, s in enumerate(amplitude * np.sin(2 * np.pi * f * t)):
        emulator.step(np.full((1, 1), intensity / 255 * np.exp(s), np.float32), round(t[k] * 1e9))
        y.append(float(emulator._x[0]) + float(emulator._lag[0]))
    last = slice(-4 * n, None)
    response = (
        2 * np.mean((np.array(y)[last] - np.log(intensity)) * np.exp(-2j * np.pi * f * t[last])) / (amplitude / 1j)
    )
    assert abs(abs(response) - 1 / np.hypot(1, ratio)) < 0.01
    assert abs(np.angle(response) + np.arctan(ratio)) < 0.02


def test_stable_however_long_the_step():
    """Time constants of 1/1000 and 1000 frames: the output stays between the input's extremes, and settles."""
    for cutoff in (1e-2, 1e7):
        emulator = V2e(1, 2, V2eConfig(**QUIET, cutoff_hz=cutoff))
        levels = np.array([[0.02, 0.9]], np.float32)
        lin_log = v2e.lin_log(levels[0] * np.float32(255))
        for k in range(50):
            emulator.step(levels if k % 2 else levels[:, ::-1], k * 10 * MS)
            y = emulator._x + emulator._lag
            assert (y >= lin_log[0] - 1e-5).all() and (y <= lin_log[1] + 1e-5).all()  # also refuses NaN


def test_step_response_times():
    """A bright step through a 30 Hz photoreceptor: crossings at -tau ln(1 - j theta/step), fine frames."""
    bright, cutoff, theta = 120.0, 30.0, 0.2
    emulator = V2e(1, 1, V2eConfig(**QUIET, cutoff_hz=cutoff, contrast_threshold=theta))
    tau = 275 / (2 * np.pi * cutoff * (bright + 20))
    frames = [60.0] + [bright] * 2000
    times = [0, 1000] + [1000 + k * MS // 10 for k in range(1, 2000)]
    events = run(emulator, [np.full((1, 1), v / 255, np.float32) for v in frames], times)
    height = np.log(bright / 60)
    expected = -tau * np.log(1 - theta * np.arange(1, int(height / theta) + 1) / height) * 1e6
    assert len(events) == len(expected) == 3
    assert np.abs(events.t - expected).max() < 5


def test_event_times_converge_with_order_two():
    """Filtered sinusoid: event times against those of a very fine run."""

    def times(n):
        emulator = V2e(1, 1, V2eConfig(**QUIET, cutoff_hz=3.0, contrast_threshold=0.1))
        s = np.linspace(0, 1, n + 1)
        intensity = 90 * np.exp(0.9 * np.sin(2 * np.pi * 0.9 * s + 0.4)) / 255
        return (
            run(emulator, [np.full((1, 1), v, np.float32) for v in intensity], np.round(s * 4e9).astype(np.int64)).t
            * 1e-6
        )

    truth = times(20_000)
    spacings = np.array([64, 128, 256, 512])
    errors = []
    for n in spacings:
        t = times(n)
        assert len(t) == len(truth)
        errors.append(np.sqrt(np.mean((t - truth) ** 2)))
    order = -np.polyfit(np.log(spacings), np.log(errors), 1)[0]
    assert abs(order - 2) < 0.3, (order, errors)


def poisson_consistent(counts, mean):
    """Two-sided: the total against its mean, and the spread over pixels against the Poisson law (chi-square)."""
    total, expected = counts.sum(), mean * len(counts)
    assert abs(total - expected) < 4.5 * np.sqrt(expected), (total, expected)
    return stats.chi2.sf(((counts - counts.mean()) ** 2).sum() / counts.mean(), len(counts) - 1)


@pytest.mark.parametrize("frame_ms", [0.5, 10, 100])
@pytest.mark.parametrize("level", [0.0, 1.0])
def test_shot_noise_rate(frame_ms, level):
    """R (1 - 0.75 (I + 20)/275) per pixel at any frame rate, Poisson over the pixels, half ON, uniform in time."""
    rate, seconds = 20.0, 1.0
    emulator = V2e(40, 40, V2eConfig(**{**QUIET, "shot_noise_rate_hz": rate}, cutoff_hz=0.0), seed=5)
    frame = np.full((40, 40), level, np.float32)
    events = run(
        emulator,
        [frame] * (round(seconds * 1000 / frame_ms) + 1),
        range(0, round(1e9 * seconds) + 1, round(frame_ms * 1e6)),
    )
    counts = np.bincount(events.y.astype(int) * 40 + events.x, minlength=1600)
    assert poisson_consistent(counts, seconds * rate * (1 - 0.75 * (255 * level + 20) / 275)) > 1e-3
    assert abs(events.p.mean() - 0.5) < 2.5 / np.sqrt(len(events))
    assert stats.kstest(events.t / 1e6, "uniform", (0, seconds)).pvalue > 1e-3


@pytest.mark.parametrize("frame_ms", [0.5, 50])
def test_leak_rate_and_jitter(frame_ms):
    """Leak events are ON, at the configured rate, and their intervals have the configured jitter at any frame rate."""
    rate, jitter = 4.0, 0.2
    emulator = V2e(
        20, 20, V2eConfig(**{**QUIET, "leak_rate_hz": rate}, leak_jitter=jitter, leak_cov_decades=0.0, cutoff_hz=0.0)
    )
    seconds = 6
    frame = np.full((20, 20), 0.5, np.float32)
    events = run(
        emulator, [frame] * (round(seconds * 1000 / frame_ms) + 1), range(0, seconds * 10**9 + 1, round(frame_ms * 1e6))
    )
    assert (events.p == 1).all()
    assert abs(len(events) / (400 * seconds * rate) - 1) < 0.01
    pixel = events.y.astype(int) * 20 + events.x
    order = np.lexsort((events.t, pixel))
    gaps = np.diff(events.t[order])[np.diff(pixel[order]) == 0] * 1e-6
    # Long gaps are a little under-represented in a finite window.
    assert abs(gaps.mean() * rate - 1) < 0.01 and abs(gaps.std() * rate / jitter - 1) < 0.1
    counts = np.bincount(pixel, minlength=400)
    # Far more regular than Poisson.
    assert stats.chi2.sf(((counts - seconds * rate) ** 2).sum() / (seconds * rate), 400) > 0.99


@pytest.mark.parametrize("frame_ms", [0.1, 1, 10, 100])
def test_photoreceptor_noise_holds_its_rate_at_any_frame_rate(frame_ms):
    """5 Hz asked for, 5 Hz given, whether frames are 100 times faster or 10 times slower than the photoreceptor."""
    rate, pixels = 5.0, 60
    seconds = 0.6 if frame_ms < 1 else 4.0
    config = V2eConfig(**{**QUIET, "shot_noise_rate_hz": rate}, photoreceptor_noise=True, cutoff_hz=30.0)
    emulator = V2e(pixels, pixels, config, seed=1)
    frame = np.full((pixels, pixels), 0.4, np.float32)
    events = run(
        emulator,
        [frame] * (round(seconds * 1000 / frame_ms) + 1),
        [round(k * frame_ms * 1e6) for k in range(round(seconds * 1000 / frame_ms) + 1)],
    )
    assert abs(len(events) / (seconds * pixels**2) / rate - 1) < 0.1
    assert abs(events.p.mean() - 0.5) < 0.03


def test_leak_spread_over_pixels():
    leaks = v2e.draw_leaks(
        200, 200, V2eConfig(leak_rate_hz=2.0, leak_cov_decades=0.3), np.full(40_000, 0.2, np.float32), np.uint64(1)
    )
    decades = np.log10(leaks / 0.4)
    assert stats.kstest(decades / 0.3, "norm").pvalue > 1e-3


def test_hot_pixels_fire():
    config = V2eConfig(**QUIET, hot_pixel_fraction=0.1, hot_pixel_rate_hz=50.0)
    emulator = V2e(40, 50, config, seed=2)
    events = run(emulator, [np.full((40, 50), 0.3, np.float32)] * 101, range(0, 101 * 10 * MS, 10 * MS))
    counts = np.bincount(events.y.astype(int) * 50 + events.x, minlength=2000)
    assert 150 < (counts > 1).sum() < 230 and abs(counts.sum() / (200 * 50) - 1) < 0.25


def test_refractory_dead_time_on_a_ramp():
    """Intervals on a steady ramp are the dead time plus theta/slope: no backlog, no lost microsecond."""
    theta, slope, dead = 0.2, 400.0, 700.0  # ln units, ln units per second, us
    config = V2eConfig(**{**QUIET, "refractory_us": dead}, cutoff_hz=0.0, contrast_threshold=theta)
    s = np.arange(0, 60) * 1e-4
    emulator = V2e(1, 1, config)
    events = run(
        emulator, [np.full((1, 1), 25 / 255 * np.exp(slope * v), np.float32) for v in s], np.round(s * 1e9).astype(int)
    )
    gaps = np.diff(events.t)
    assert len(gaps) >= 3 and np.abs(gaps - (dead + theta / slope * 1e6)).max() <= 2


def test_refractory_histogram_and_no_backlog():
    """With dead time, gaps of noise events are dead time + exponential; a step inside the dead time never comes out."""
    dead, rate = 5_000.0, 200.0
    emulator = V2e(
        30, 30, V2eConfig(**{**QUIET, "shot_noise_rate_hz": rate, "refractory_us": dead}, cutoff_hz=0.0), seed=3
    )
    events = run(emulator, [np.zeros((30, 30), np.float32)] * 201, range(0, 201 * 5 * MS, 5 * MS))
    pixel = events.y.astype(int) * 30 + events.x
    order = np.lexsort((events.t, pixel))
    gaps = np.diff(events.t[order])[np.diff(pixel[order]) == 0]
    assert gaps.min() >= dead - 1
    assert stats.kstest((gaps - dead) * 1e-6, "expon", (0, 1 / (rate * (1 - 0.75 * 20 / 275)))).statistic < 0.03

    emulator = V2e(1, 1, V2eConfig(**{**QUIET, "refractory_us": 10_000.0}, cutoff_hz=0.0))
    frames = [0.2, 0.25, 0.9, 0.9, 0.9, 0.9]  # one event, then a large step while dead, then nothing
    events = run(
        emulator, [np.full((1, 1), v, np.float32) for v in frames], [0, 2 * MS, 4 * MS, 20 * MS, 40 * MS, 60 * MS]
    )
    assert len(events) == 1


def test_burst_and_limits(threads):  # noqa: F811
    emulator = V2e(40, 50, V2eConfig(**QUIET, contrast_threshold=0.001, cutoff_hz=0.0, max_events_per_step=20_000))
    emulator.step(np.zeros((40, 50), np.float32), 0)
    events = emulator.step(np.ones((40, 50), np.float32), MS)
    wanted = 2000 * int(np.log(255) / 0.001)
    assert len(events) <= 20_000 and abs(emulator.saturated + len(events) - wanted) <= 4000
    assert len(emulator.step(np.ones((40, 50), np.float32), 2 * MS)) == 0


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_bad_intensity(value):
    emulator = V2e(4, 4, V2eConfig())
    frame = np.full((4, 4), 0.5, np.float32)
    emulator.step(frame, 0)
    bad = frame.copy()
    bad[1, 2] = value
    with pytest.raises(EventDataError, match="frame 1: intensity at pixel x=2, y=1"):
        emulator.step(bad, MS)


def test_presets_give_way_to_explicit_keys():
    assert V2eConfig(preset="noisy").shot_noise_rate_hz == 5.0
    assert V2eConfig(preset="noisy", shot_noise_rate_hz=1.0).shot_noise_rate_hz == 1.0
    assert V2eConfig(preset="clean").cutoff_hz == 0.0 and V2eConfig().cutoff_hz == 300.0


@pytest.mark.parametrize("reference", [False, True])
def test_a_still_pixel_on_its_level_fires_at_once(reference):
    """A level is stored in single precision: where rounding puts it on the signal, the way to it is 0 / 0."""
    config = V2eConfig(preset="clean", threshold_sigma=0.0)
    emulator = (ReferenceV2e if reference else V2e)(32, 64, config, 1)
    emulator.step(np.full((32, 64), 0.5, np.float32), 0)
    bits = np.float32(0.5 * np.exp(0.4)).view(np.int32) + np.arange(-1024, 1024, dtype=np.int32)
    frame = bits.view(np.float32).reshape(32, 64)  # about the second level
    emulator.step(frame, 10**6)
    with np.errstate(invalid="ignore"):
        events = emulator.step(frame, 2 * 10**6)
    assert 1 < len(events) < 50 and (events.t == 1000).all() and (events.p == 1).all()
