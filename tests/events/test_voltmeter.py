"""DVS-Voltmeter: the events of a slow twin, the laws of first passage, the start, dead time.

``tests/golden/voltmeter.json`` holds how many events each variant makes of :func:`clip` and the SHA-256 of their
columns. It was made at commit 21f2ecb4, where a twin that drew one pixel and one event at a time, without blocks,
packing, threads or compiled code, made the same.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
from scipy import stats

from blinkgl.config.events import VoltmeterConfig
from blinkgl.events import DvsVoltmeter, Events
from blinkgl.events.philox import normal2_and_uniform
from blinkgl.events.voltmeter_model import crosses, hitting_time, reached, start_voltage
from tests.events.clips import assert_same, by_pixel, run

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
GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "voltmeter.json").read_text())


def clip():
    """Frames of codes with still pixels, exact returns and irregular times."""
    rng = np.random.default_rng(1)
    codes = rng.integers(0, 256, (5, 37, 45), np.uint8)
    codes[2] = codes[0]
    codes[:, 3, :5] = 0
    codes[3] = np.where(rng.random((37, 45)) < 0.5, codes[2], codes[3])
    return codes, 7_123 + np.cumsum(rng.integers(1_000, 40_000_000, 5))


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_events_of_the_slow_twin(variant):
    codes, times = clip()
    events = run(DvsVoltmeter(37, 45, VoltmeterConfig(**VARIANTS[variant], causes=True), seed=9), codes, times)
    columns = np.stack([events.x, events.y, events.t, events.p, events.cause]).astype("<i8")
    assert [len(events), hashlib.sha256(columns.tobytes()).hexdigest()] == GOLDEN[variant]
    undetermined = DvsVoltmeter(37, 45, VoltmeterConfig(**VARIANTS[variant]), seed=9)
    assert_same(run(undetermined, codes / np.float32(255), times), replace(events, cause=None))


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


def test_a_pixel_rests_for_its_dead_time():
    config = VoltmeterConfig(refractory_us=700.0)
    emulator = DvsVoltmeter(30, 30, config)
    emulator.step(np.zeros((30, 30), np.float32), 0)
    events = Events.concatenate(
        [emulator.step(np.ones((30, 30), np.float32), 2 * MS), emulator.step(np.zeros((30, 30), np.float32), 3 * MS)]
    )
    pixel, events = by_pixel(events, 30)
    assert np.diff(events.t)[np.diff(pixel) == 0].min() >= 699
