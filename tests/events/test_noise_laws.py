"""Noise is that of the stated equations at any frame rate: distribution tests of ``noise_laws.py``'s cases.

Every p-value is held to 1e-4, with fixed seeds; there are 120, so an emulator that is right would have failed one
choice of seeds in 80.
"""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.config.events import V2eConfig, VoltmeterConfig
from blinkgl.events import DvsVoltmeter, V2e
from tests.events.clips import run
from tests.events.noise_laws import FRAMES, Case, cases, judge, shot_rate, v2e_law, voltmeter_law, watch

SIDE, LEAST_P = 40, 1e-4
CASES = cases()


@pytest.mark.parametrize("frames", FRAMES)
@pytest.mark.parametrize("name", CASES)
def test_rate_intervals_and_first_event_are_of_the_stated_law(name, frames):
    case = CASES[name]
    seen = judge(watch(case, FRAMES[frames], SIDE, seed=3), case, SIDE)
    assert seen.events > 10_000
    assert seen.rate_p > LEAST_P, (seen.rate, seen.rate_law)
    assert seen.interval_p > LEAST_P, seen.interval_ks
    assert seen.first_p > LEAST_P, seen.first_ks
    assert abs(seen.on - case.law.on) < 6 * np.sqrt(0.25 / seen.events) + 1e-3


@pytest.mark.parametrize("fps, spread", [(50.0, 1.0), (500.0, 0.5), (5000.0, 0.2)])
def test_the_judge_sees_noise_that_depends_on_the_frames(fps, spread):
    """The authors' way of carrying V on loses diffusion as frames get shorter, and their start is synchronous."""
    right = CASES["Voltmeter leak and diffusion"]
    case = right._replace(config=right.config.model_copy(update={"compat": "authors"}))
    seen = judge(watch(case, fps, SIDE, seed=3), case, SIDE)
    assert seen.first_p < 1e-12
    assert seen.interval_cv < spread * 1.3 * seen.cv_law
    assert fps == 50 or seen.interval_p < 1e-12


def test_compat_authors_is_their_algorithm():
    """Against their recursion in NumPy, all pixels at once: rates, intervals, and V where nothing fired."""
    config = VoltmeterConfig(compat="authors", k3=0.0, k4=4e-5, k5=0.0, k6=3e-3)
    side, dt, frames = 60, 2000.0, 150
    rng, mu, sigma = np.random.default_rng(0), 4e-5, 3e-3
    v, counts = np.zeros(side**2), np.zeros(side**2)
    for _ in range(frames):
        left, todo = np.full(side**2, dt), np.arange(side**2)
        while todo.size:
            a, b = 1 - v[todo], 1 + v[todo]
            r = 2 * mu / sigma**2
            up = rng.random(todo.size) < (np.exp(r * b) - 1) / (np.exp(r * b) - np.exp(-r * a))
            distance = np.where(up, a, b)
            time = rng.wald(distance / mu, (distance / sigma) ** 2)
            late = time > left[todo]
            v[todo] = np.where(late, v[todo] + np.where(up, 1, -1) * distance * left[todo] / time, 0.0)
            counts[todo] += ~late
            left[todo] -= time
            todo = todo[~late]
    emulator = DvsVoltmeter(side, side, config, seed=2)
    events = run(emulator, [np.full((side, side), 0.4, np.float32)] * (frames + 1), np.arange(frames + 1) * 2_000_000)
    mine = np.bincount(events.y.astype(int) * side + events.x, minlength=side**2)
    error = np.hypot(mine.std(), counts.std()) / side
    assert abs(mine.mean() - counts.mean()) < 4 * error
    assert abs(mine.std() / counts.std() - 1) < 0.08
    from scipy import stats

    assert stats.ks_2samp(emulator._v / 2**29, v).pvalue > LEAST_P


def test_a_cameras_own_constants_hold_their_jitter():
    """DVS240 at L = 60: the spread of leak intervals, .0162 by the equation, which drift alone does not have."""
    config = VoltmeterConfig(preset="DVS240")
    case = Case(config, 60 / 255, voltmeter_law(config, 60 / 255), 2.0)
    for fps in (50.0, 500.0):
        seen = judge(watch(case, fps, SIDE, seed=1), case, SIDE)
        assert abs(seen.interval_cv / seen.cv_law - 1) < 0.08 and abs(seen.cv_law - 0.0162) < 2e-4


def test_a_flat_image_does_not_fire_all_at_once():
    """From V = 0 most pixels have their leak event in the same few milliseconds; from the stationary law, one in
    ten each tenth of the interval."""
    frame, shares = np.full((50, 50), 0.4, np.float32), {}
    for start in ("stationary", "zero"):
        emulator = DvsVoltmeter(50, 50, VoltmeterConfig(preset="DVS240", start=start), seed=1)
        events = run(emulator, [frame] * 41, np.arange(41) * 10_000_000)
        shares[start] = np.histogram(events.t, np.arange(0, 400_001, 10_000))[0].max() / 2500
    assert shares["zero"] > 0.5 and shares["stationary"] < 0.08


@pytest.mark.parametrize("start, tilt", [("stationary", (1.1, 9.0)), ("balanced", (0.9, 1.1)), ("zero", (0.99, 1.01))])
def test_start_of_v2e_tilts_on_and_off(start, tilt):
    """Half of the pixels get brighter by 1.5 thresholds, half darker: a scene that has been moving answers alike."""
    config = V2eConfig(preset="clean", threshold_sigma=0.0, leak_rate_hz=0.01, start=start)
    emulator = V2e(60, 60, config, seed=1)
    frame = np.full((60, 60), 0.4, np.float32)
    after = frame.copy()
    after[:30] *= np.exp(0.3)
    after[30:] *= np.exp(-0.3)
    events = run(emulator, [frame, after], [0, 1_000_000])
    ratio = (events.p == 1).sum() / (events.p == 0).sum()
    assert tilt[0] < ratio < tilt[1], ratio


def test_v2e_starts_as_a_scene_that_was_watched():
    """Shot noise that comes more often than leak holds leak back, from the first frame on."""
    law = v2e_law(4.0, 0.1, shot_rate(60.0, 0.4))
    config = V2eConfig(
        preset="clean",
        threshold_sigma=0.0,
        leak_rate_hz=4.0,
        leak_cov_decades=0.0,
        leak_jitter=0.1,
        shot_noise_rate_hz=60.0,
    )
    case = Case(config, 0.4, law, 0.5)
    seen = judge(watch(case, 200.0, 60, seed=1), case, 60)
    assert min(seen.rate_p, seen.first_p, seen.interval_p) > LEAST_P


def test_noisy_is_v2es():
    """v2e's `noisy` has no dead time."""
    assert V2eConfig(preset="noisy").refractory_us == 0.0 and V2eConfig().refractory_us == 500.0
