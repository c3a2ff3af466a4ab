"""V2E with `compat: authors`: kernel = slow twin = the published recursion, its noise by closed forms, refusals.

``tools/peer_v2e.py`` compares it with their program itself, event by event, where that is at hand.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats

from blinkgl.config.base import validate
from blinkgl.config.events import EmulatorConfig, V2eConfig
from blinkgl.errors import ConfigError, EventDataError
from blinkgl.events import Events, V2e, emulator_of, make_emulator
from blinkgl.events.reference import ReferenceV2eAuthors
from blinkgl.events.v2e_authors import V2eAuthors, noise_share, noise_size
from tests.events.clips import assert_same, random_clip, run
from tests.events.test_esim import threads  # noqa: F401  (fixture)
from tests.events.test_v2e import QUIET

VARIANTS = {
    "clean": dict(preset="clean"),
    "default": {},
    "noisy": dict(preset="noisy"),
    "long dead time, noise, hot pixels": dict(
        shot_noise_rate_hz=50.0, leak_rate_hz=3.0, hot_pixel_fraction=0.05, refractory_us=20_000.0
    ),
    "photoreceptor noise": dict(preset="noisy", shot_noise_rate_hz=30.0, photoreceptor_noise=True),
    "unlike thresholds, no leak": dict(contrast_threshold_off=0.3, leak_rate_hz=0.0, shot_noise_rate_hz=80.0),
}
STILL = np.full((40, 40), 100 / 255, np.float32)


def authors(**values):
    return V2eConfig(compat="authors", **values)


@cache
def twin(variant, dtype):
    clip, times = random_clip(1, frames=7, dtype=dtype)
    return run(ReferenceV2eAuthors(37, 45, authors(**VARIANTS[variant], causes=True), seed=9), clip, times)


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
@pytest.mark.parametrize("variant", VARIANTS)
def test_equals_slow_twin(variant, dtype, threads):  # noqa: F811
    clip, times = random_clip(1, frames=7, dtype=dtype)
    fast = run(make_emulator(authors(**VARIANTS[variant], causes=True), 37, 45, 9), clip, times)
    assert len(fast) > 1500
    assert_same(fast, twin(variant, dtype))
    assert_same(replace(fast, cause=None), run(make_emulator(authors(**VARIANTS[variant]), 37, 45, 9), clip, times))


@pytest.mark.parametrize("variant", VARIANTS)
def test_resumes_bit_identically(variant):
    clip, times = random_clip(2, frames=8)
    config = authors(**VARIANTS[variant], causes=True)
    whole = run(V2eAuthors(37, 45, config, 3), clip, times)
    first, second = V2eAuthors(37, 45, config, 3), V2eAuthors(37, 45, config, 3)
    head = run(first, clip[:3], times[:3])
    second.load_state_dict(first.state_dict())
    assert_same(whole, Events.concatenate([head, run(second, clip[3:], times[3:])]))


def test_the_configuration_decides_which_program():
    assert emulator_of(V2eConfig()) is V2e
    assert emulator_of(authors()) is V2eAuthors
    assert type(make_emulator(authors(), 3, 4)) is V2eAuthors
    with pytest.raises(EventDataError, match="V2e does not do this.*make_emulator"):
        V2e(3, 4, authors())
    with pytest.raises(EventDataError, match="V2eAuthors does not do this"):
        V2eAuthors(3, 4, V2eConfig())


def test_times_are_shared_out_by_the_busiest_pixel():
    """One pixel rises by 4.5 thresholds, another falls by 2.5: at fractions of a quarter."""
    emulator = make_emulator(authors(**QUIET, cutoff_hz=0.0), 1, 3)
    first = np.full((1, 3), 100 / 255)
    emulator.step(first.astype(np.float32), 0)
    events = emulator.step((first * np.exp([[0.9, -0.5, 0.1]])).astype(np.float32), 8_000_000)
    assert events.t.tolist() == [2000, 2000, 4000, 4000, 6000, 8000]
    assert events.x.tolist() == [0, 1, 0, 1, 0, 0]
    assert events.p.tolist() == [1, 0, 1, 0, 1, 1]


def test_what_a_dead_time_drops_comes_later():
    """Its reference stays behind: theirs has the backlog that a pixel whose reference is taken anew does not."""
    emulator = make_emulator(authors(**{**QUIET, "refractory_us": 2500.0}, cutoff_hz=0.0), 1, 1)
    light = lambda change: np.full((1, 1), 100 / 255 * np.exp(change), np.float32)
    emulator.step(light(0), 0)
    assert emulator.step(light(0.9), 8_000_000).t.tolist() == [2000, 6000]
    # What is left is two and a half thresholds, though nothing moves any more; so many share the next frame.
    assert emulator.step(light(0.9), 16_000_000).t.tolist() == [12_000, 16_000]
    # A dead time shorter than the spacing of events is not looked at.
    emulator = make_emulator(authors(**{**QUIET, "refractory_us": 1500.0}, cutoff_hz=0.0), 1, 1)
    emulator.step(light(0), 0)
    assert emulator.step(light(0.9), 8_000_000).t.tolist() == [2000, 4000, 6000, 8000]


@pytest.mark.parametrize("fps", [50, 500, 5000])
def test_jitter_of_the_leak_averages_out_as_theirs_does(fps):
    """After n frames the reference has fallen by rate theta t (1 +- jitter / sqrt(n)): a spread that depends on n."""
    values = {**QUIET, "leak_rate_hz": 2.0}
    emulator = make_emulator(authors(**values, cutoff_hz=0.0, leak_cov_decades=0.0, leak_jitter=0.3), 40, 40, 1)
    n = fps * 2 // 5
    for k in range(n + 1):
        assert not len(emulator.step(STILL, k * 10**9 // fps))
    fallen = (emulator._signal - emulator._reference).astype(float)
    drift = 2.0 * 0.2 * 0.4
    assert abs(fallen.mean() / drift - 1) < 5 * 0.3 / np.sqrt(n * fallen.size) + 1e-4
    ratio = fallen.var() / (drift * 0.3) ** 2 * n
    assert 1e-4 < stats.chi2(fallen.size - 1).cdf(ratio * (fallen.size - 1)) < 1 - 1e-4


@pytest.mark.parametrize("fps", [50, 500])
def test_shot_noise_is_one_draw_a_frame(fps):
    """Binomial in the number of frames, on whole frames, by the threshold of the pixel."""
    rate, n = 40.0, 200
    values = {**QUIET, "shot_noise_rate_hz": rate, "threshold_sigma": 0.04}
    emulator = make_emulator(authors(**values, cutoff_hz=0.0), 40, 40, 2)
    events = run(emulator, [STILL] * (n + 1), np.arange(n + 1) * (10**9 // fps))
    assert not np.any(events.t % (10**6 // fps))
    each = 0.5 * rate / fps * (1 - 0.75 * 120 / 275)
    for polarity, theta in ((1, emulator._on), (0, emulator._off)):
        wanted = n * np.minimum(each * 0.2 / theta.astype(float), 1.0)
        count = np.bincount((events.y.astype(int) * 40 + events.x)[events.p == polarity], minlength=1600)
        spread = wanted * (1 - wanted / n)
        assert abs((count - wanted).sum()) < 4 * np.sqrt(spread.sum())
        squares = ((count - wanted) ** 2 / spread).sum()
        assert abs(squares - 1600) < 5 * np.sqrt(2 * 1600)


@pytest.mark.parametrize("fps", [100, 1000])
def test_photoreceptor_noise_is_their_autoregression(fps):
    """Its spread is that of a first-order recursion, whose correlation from frame to frame is 1 - share."""
    config = authors(**{**QUIET, "shot_noise_rate_hz": 5.0}, cutoff_hz=30.0, photoreceptor_noise=True)
    emulator, share = make_emulator(config, 40, 40, 3), noise_share(30.0, 1 / fps)
    emulator.step(STILL, 0)
    seen = []
    for k in range(1, 401):
        emulator.step(STILL, k * 10**9 // fps)
        seen.append(emulator._noise.copy())
    seen = np.array(seen[100:])
    size = noise_size(5.0, 30.0, 1 / fps, 0.2, 0.2, 0.0)
    assert abs(seen.std() / (size * np.sqrt(share / (2 - share))) - 1) < 0.03
    correlation = (seen[1:] * seen[:-1]).mean() / seen.var()
    assert abs(correlation - (1 - share)) < 0.02


def test_the_size_of_the_noise():
    # Their fit by hand: x = log10(2.5/30), 10^-(-0.0026 x^3 - 0.036 x^2 - 0.1949 x + 0.321) thresholds.
    x = np.log10(2.5 / 30)
    alone = 0.2 / 10 ** (-0.0026 * x**3 - 0.036 * x**2 - 0.1949 * x + 0.321)
    share = 2 * np.pi * 30e-4
    assert noise_size(5.0, 30.0, 1e-4, 0.2, 0.2, 0.0) == pytest.approx(alone * np.sqrt((2 - share) / share))
    # The smaller of two drawn thresholds, against drawing them.
    rng = np.random.default_rng(0)
    drawn = np.minimum(0.2 + 0.05 * rng.standard_normal(10**6), 0.25 + 0.05 * rng.standard_normal(10**6)).mean()
    ratio = noise_size(5.0, 30.0, 1e-4, 0.2, 0.25, 0.05) / noise_size(5.0, 30.0, 1e-4, 0.2, 0.2, 0.0)
    assert ratio == pytest.approx(drawn / 0.2, rel=2e-3)
    assert noise_share(30.0, 1.0) == 1.0  # theirs would grow without end


def test_noise_that_would_grow_without_end_is_held():
    config = authors(**{**QUIET, "shot_noise_rate_hz": 5.0}, cutoff_hz=300.0, photoreceptor_noise=True)
    emulator = make_emulator(config, 20, 20)
    for k in range(200):
        emulator.step(STILL[:20, :20], k * 20_000_000)
    assert np.abs(emulator._noise).max() < 1.0


def test_more_events_than_a_step_may_emit():
    emulator = make_emulator(authors(**QUIET, contrast_threshold=0.001, max_events_per_step=1000), 40, 40)
    emulator.step(np.full((40, 40), 1e-3, np.float32), 0)
    events = emulator.step(np.full((40, 40), 1.0, np.float32), 1_000_000_000)
    assert 1000 <= len(events) <= 2 * 1024
    assert emulator.saturated + len(events) == np.abs(emulator._counts).sum()
    assert not len(emulator.step(np.full((40, 40), 1.0, np.float32), 2_000_000_000))  # levels have moved all the way


@pytest.mark.parametrize(
    "values, message",
    [
        ({"second_cutoff_hz": 30.0}, "the authors' program has no second low-pass"),
        ({"device": "cuda"}, "compat: authors is made on the processor alone"),
    ],
)
def test_refusals(values, message):
    with pytest.raises(ConfigError, match=message):
        validate(EmulatorConfig, {"emulator": "v2e", "compat": "authors", **values})
