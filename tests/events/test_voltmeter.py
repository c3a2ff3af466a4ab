"""DVS-Voltmeter: kernel = slow twin, the laws of first passage, leak rate, state."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numba
import numpy as np
import pytest
from scipy import stats

from blinkgl.config.events import VoltmeterConfig
from blinkgl.events import DvsVoltmeter, Events
from blinkgl.events.philox import normal2_and_uniform
from blinkgl.events.voltmeter import crosses, hitting_time, one_minus_exp, reached, start_voltage
from tests.events.clips import assert_same, random_clip, run
from tests.events.noise_laws import exit_survival
from tests.events.reference import ReferenceVoltmeter
from tests.events.test_esim import threads  # noqa: F401  (fixture)

MS = 10**6
VARIANTS = {
    "DVS346": {},
    "DVS240": dict(preset="DVS240"),
    "dead time": dict(refractory_us=3000.0),
    "very noisy": dict(k3=0.01, k6=0.002),
    "noiseless": dict(k3=0.0, k6=0.0),
    "leaky": dict(k4=2e-4, refractory_us=100.0),
    "starting at 0": dict(start="zero", k6=1e-3),
}


@cache
def twin(variant, dtype):
    """The slow twin's events; the same for every number of threads."""
    clip, times = random_clip(1, frames=5, dtype=dtype)
    return run(ReferenceVoltmeter(37, 45, VoltmeterConfig(**VARIANTS[variant], causes=True), seed=9), clip, times)


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
@pytest.mark.parametrize("variant", VARIANTS)
def test_equals_slow_twin(variant, dtype, threads):  # noqa: F811
    clip, times = random_clip(1, frames=5, dtype=dtype)
    config = VoltmeterConfig(**VARIANTS[variant], causes=True)
    fast = run(DvsVoltmeter(37, 45, config, seed=9), clip, times)
    assert len(fast) > 1000
    assert_same(fast, twin(variant, dtype))
    untold = run(DvsVoltmeter(37, 45, VoltmeterConfig(**VARIANTS[variant]), seed=9), clip, times)
    assert_same(replace(fast, cause=None), untold)


def test_resumes_bit_identically():
    clip, times = random_clip(2, frames=8)
    config = VoltmeterConfig(k3=0.01, refractory_us=9000.0)
    whole = run(DvsVoltmeter(37, 45, config, 3), clip, times)
    first, second = DvsVoltmeter(37, 45, config, 3), DvsVoltmeter(37, 45, config, 3)
    head = run(first, clip[:3], times[:3])
    second.load_state_dict(first.state_dict())
    assert_same(whole, Events.concatenate([head, run(second, clip[3:], times[3:])]))


def test_one_minus_exp():
    x = np.logspace(-15, 2, 500)
    assert max(abs(one_minus_exp(float(v)) / -np.expm1(-v) - 1) for v in x) < 1e-10


@numba.njit
def _hitting_times(n, distance, mu, sigma):
    out = np.empty(n)
    for i in range(n):
        z, _, u = normal2_and_uniform(np.uint64(3), np.uint64(i), np.uint64(7), np.uint64(0))
        out[i] = hitting_time(distance, mu, sigma, z, u)
    return out


N = 200_000


@pytest.mark.parametrize(
    "distance, mu, sigma", [(1.0, 2.0, 0.5), (0.3, 1e-3, 0.2), (1.7, -0.4, 3.0), (1.0, 5e-4, 1e-3)]
)
def test_hitting_times_are_inverse_gaussian(distance, mu, sigma):
    t = _hitting_times(N, distance, mu, sigma)
    mean, shape = distance / abs(mu), (distance / sigma) ** 2
    law = stats.invgauss(mu=mean / shape, scale=shape)
    assert stats.kstest(t, law.cdf).pvalue > 1e-3


def test_hitting_times_without_drift_are_levy():
    distance, sigma = 0.8, 0.3
    law = stats.levy(scale=(distance / sigma) ** 2)
    assert stats.kstest(_hitting_times(N, distance, 0.0, sigma), law.cdf).pvalue > 1e-3
    assert stats.kstest(_hitting_times(N, distance, 1e-14, sigma), law.cdf).pvalue > 1e-3  # and continuous in the drift


def test_kernel_event_times_are_first_exits():
    """Straight from the emulator: the first event of 10^5 pixels in one long step, in which both thresholds are in
    reach, against the first exit from between them; and which of the two it is."""
    h, w = 250, 400
    config = VoltmeterConfig(k1=5.0, k2=20.0, k3=0.0, k4=0.0, k5=0.0, k6=4e-3, start="zero")
    emulator = DvsVoltmeter(h, w, config, seed=8)
    emulator.step(np.full((h, w), 100 / 255, np.float32), 0)
    dt = 200_000  # us
    events = emulator.step(np.full((h, w), 200 / 255, np.float32), dt * 1000)
    mu, sigma = 5.0 * 100 / dt / 170, 4e-3
    _, first = np.unique(events.y.astype(int) * w + events.x, return_index=True)
    t = events.t[first] + 0.5
    survival = exit_survival(mu * 1e6, sigma * 1e3)
    on = events.p[first] == 1
    r = 2 * mu / sigma**2  # Lin et al. 2022, eq. 9, from the middle: P(ON first)
    expected_on = (np.exp(r) - 1) / (np.exp(r) - np.exp(-r))
    left = float(survival(np.array([dt * 1e-6]))[0])
    assert abs(1 - len(first) / (h * w) - left) < 5 * np.sqrt(left / (h * w))
    assert abs(on.mean() - expected_on) < 5 * np.sqrt(expected_on * (1 - expected_on) / len(on))
    assert stats.kstest(t, lambda x: (1 - survival(x * 1e-6)) / (1 - left)).pvalue > 1e-3


def test_crossings_of_bridges_and_thresholds_that_may_never_be_met():
    """By simulation in 20,000 small steps; and where there is no noise."""
    rng, noise = np.random.default_rng(0), 0.6
    steps = rng.normal(0, noise / 100, (2000, 10_000)).cumsum(axis=1)
    bridge = steps - np.linspace(0, 1, 10_000) * (steps[:, -1:] + 0.1)  # ends 0.1 lower
    assert abs((bridge.max(axis=1) > 0.4 - 0.58 * noise / 100).mean() - crosses(0.4, 0.5, noise)) < 0.04
    assert crosses(0.5, 0.5, 0.0) == 0.0 and crosses(0.5, -0.1, 0.0) == 1.0 and crosses(0.5, 0.0, 1.0) == 1.0
    away = (steps - np.linspace(0, 0.5, 10_000)).max(axis=1) > 0.3  # until t = 1; most never do later
    assert abs(away.mean() - reached(0.3, -0.5, noise)) < 0.08
    assert reached(0.3, 0.0, 0.0) == reached(0.3, 1.0, 0.0) == 1.0 and reached(0.3, -1e-9, 0.0) == 0.0


@pytest.mark.parametrize("r", [0.0, 1e-3, 1.0, 30.0, 5e3, np.inf])
@pytest.mark.parametrize("sign", [1, -1])
def test_start_is_the_stationary_law(r, sign):
    """Against the density of the Fokker-Planck equation, and the share of pixels in their dead time."""
    sigma = 0.0 if r == np.inf else 2e-3
    mu = 1e-5 if r == np.inf else r * sigma**2 / 2
    config = VoltmeterConfig(k3=0.0, k4=sign * mu, k5=0.0, k6=sigma, refractory_us=3e4)
    v, left = start_voltage(np.full(60_000, 100.0, np.float32), config, np.uint64(4))
    grid = np.linspace(-1, 1, 20_001)
    with np.errstate(over="ignore", invalid="ignore"):
        up = -np.expm1(-r * (1 - grid)) if 0 < r < np.inf else (np.ones_like(grid) if r else 1 - grid)
        down = np.exp(r * grid) * -np.expm1(-r * (1 + grid)) if 0 < r < np.inf else (0 * grid if r else 1 + grid)
    density = np.where(grid >= 0, up, down)
    law = np.cumsum(density) / density.sum()
    assert stats.kstest(sign * v / 2**29, lambda x: np.interp(x, grid, law)).pvalue > 1e-3
    between = 1 / mu if r == np.inf else (np.tanh(r / 2) / mu if r else sigma**-2)
    share = 3e4 / (3e4 + between)
    assert abs((left > 0).mean() - share) < 4 * np.sqrt(share / 60_000)


def test_nothing_moves_where_there_is_neither_drift_nor_noise():
    v, left = start_voltage(np.array([0, 50], np.float32), VoltmeterConfig(k3=0, k4=0, k5=0, k6=0), np.uint64(1))
    assert not v.any() and not left.any()


def test_a_look_comes_before_float32_forgets():
    """A million frames a second: the variance of one is lost beside the sum of many, unless that is spent in time."""
    config = VoltmeterConfig(k1=1.0, k3=0.0, k4=0.0, k5=0.0, k6=1e-4, start="zero")
    emulator = DvsVoltmeter(8, 128, config, seed=1)
    frame, steps = np.full((8, 128), 0.4, np.float32), 70_000
    for k in range(steps + 1):
        emulator.step(frame, k * 1000)
    assert emulator._unspent.max() < 2**16 * 1.01e-8
    total = (emulator._v / 2**29).var() + emulator._unspent.mean()
    assert abs(total / (steps * 1e-8) - 1) < 5 * np.sqrt(2 / 1024)


@pytest.mark.parametrize("frame_ms", [1, 100])
def test_leak_rate_by_temperature_and_photocurrent(frame_ms):
    """A still scene: k4 + k5 L events per us, ON, at any frame rate (V is fine enough to hold the small drift)."""
    config = VoltmeterConfig(preset="DVS240", k4=2e-6, k6=1e-5, k3=1e-5)
    emulator = DvsVoltmeter(10, 10, config, seed=4)
    frame = np.full((10, 10), 0.4, np.float32)
    seconds = 3
    events = run(emulator, [frame] * (seconds * 1000 // frame_ms + 1), range(0, seconds * 10**9 + 1, frame_ms * MS))
    rate = 2.0 + 0.05 * 102
    assert (events.p == 1).mean() > 0.99
    assert abs(len(events) / (100 * seconds * rate) - 1) < 0.03  # 21.3 events per pixel, whole ones counted


def test_effective_threshold():
    """About k1 events per unit of ln(L + k2)."""
    emulator = DvsVoltmeter(20, 20, VoltmeterConfig(k4=0, k5=0, start="zero"), seed=1)
    ramp = np.linspace(20, 200, 400)
    events = run(emulator, [np.full((20, 20), v / 255, np.float32) for v in ramp], np.arange(400) * MS)
    assert abs(len(events) / 400 - np.floor(5.265 * np.log(220 / 40))) < 0.2


def test_dead_time_and_burst(threads):  # noqa: F811
    config = VoltmeterConfig(refractory_us=700.0)
    emulator = DvsVoltmeter(30, 30, config)
    emulator.step(np.zeros((30, 30), np.float32), 0)
    events = Events.concatenate(
        [emulator.step(np.ones((30, 30), np.float32), 2 * MS), emulator.step(np.zeros((30, 30), np.float32), 3 * MS)]
    )
    pixel = events.y.astype(int) * 30 + events.x
    order = np.lexsort((events.t, pixel))
    assert np.diff(events.t[order])[np.diff(pixel[order]) == 0].min() >= 699

    emulator = DvsVoltmeter(40, 50, VoltmeterConfig(k1=100.0, k2=1e-3, max_events_per_step=20_000))
    emulator.step(np.zeros((40, 50), np.float32), 0)
    events = emulator.step(np.ones((40, 50), np.float32), MS)
    assert len(events) <= 20_000 and emulator.saturated > 2000 * 150


def test_presets():
    assert VoltmeterConfig(preset="DVS240").k2 == 23.0 and VoltmeterConfig().k1 == 5.265
    assert VoltmeterConfig(preset="DVS240", k1=6.0).k1 == 6.0 and VoltmeterConfig(preset="DVS240").k5 == 5e-8
