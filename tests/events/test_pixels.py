"""What is before the bus: dead, hot and noisy pixels; the bus against queue theory; the camera as a whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from blinkgl.config.events import EsimConfig
from blinkgl.config.readout import PixelsConfig, ReadoutConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Events
from blinkgl.events.camera import EventCamera, EventFrame, Readout
from blinkgl.events.pixels import PixelNoise
from blinkgl.types.events import Cause
from tests.events.clips import assert_same, by_pixel

H, W = 60, 80
NOISY = PixelsConfig(hot_fraction=0.02, hot_rate_hz=200.0, hot_spread_decades=0.3, rate_hz=2.0, spread_decades=0.5,
                     dead_fraction=0.05, on_share=0.7, hot_on_share=0.7)  # fmt: skip


def noise_of(config, edges_us, seed=5, causes=False):
    stage = PixelNoise(config, H, W, seed, causes)
    return stage, Events.concatenate([stage.step(Events.empty(), t) for t in edges_us])


def test_rates_of_pixels_are_the_stated_laws():
    stage = PixelNoise(NOISY, 300, 400, seed=1)
    n = 300 * 400
    assert abs(stage.hot.mean() - 0.02) < 4 * np.sqrt(0.02 / n) and abs(stage.dead.mean() - 0.05) < 4 * np.sqrt(
        0.05 / n
    )
    assert (stage.rates[stage.dead] == 0).all()
    for hot, median, decades in ((True, 200.0, 0.3), (False, 2.0, 0.5)):
        rates = stage.rates[(stage.hot == hot) & ~stage.dead]
        law = stats.lognorm(s=decades * np.log(10), scale=median)
        assert stats.kstest(rates, law.cdf).pvalue > 1e-3


@pytest.mark.parametrize("step_us", [200, 20_000, None])
def test_noise_is_poisson_at_each_pixels_rate_at_any_frame_rate(step_us):
    rng = np.random.default_rng(0)
    end = 4_000_000
    edges = np.arange(0, end + 1, step_us) if step_us else np.unique(rng.integers(0, end, 300))
    edges = np.concatenate([[0], edges[edges > 0], [end]])
    stage, events = noise_of(NOISY, edges)
    pixel = events.y.astype(int) * W + events.x
    counts, expected = np.bincount(pixel, minlength=H * W), stage.rates * end * 1e-6
    assert counts[expected == 0].sum() == 0
    busy = expected > 20
    z = (counts[busy] - expected[busy]) / np.sqrt(expected[busy])
    assert busy.sum() > 100 and stats.kstest(z, "norm").pvalue > 1e-3
    gaps = np.concatenate([np.diff(events.t[pixel == p]) * 1e-6 * stage.rates[p] for p in np.flatnonzero(busy)])
    assert stats.kstest(gaps, "expon").statistic < 0.03
    assert abs(events.p.mean() - 0.7) < 4 * 0.5 / np.sqrt(len(events)) and (np.diff(events.t) >= 0).all()


ANSWERED = PixelsConfig(
    rate_hz=3.0, spread_decades=0.4, on_share=0.7, answered=0.6, answer_ms=20, answer_spread_decades=0.4
)


def test_an_answer_is_of_the_other_polarity_and_later_by_the_stated_law():
    """Rates so low that what follows within seconds is the answer."""
    config = ANSWERED.model_copy(update={"rate_hz": 0.02, "spread_decades": 0.0})
    _, events = noise_of(config, [0, 30_000_000])
    pixel, events = by_pixel(events, W)
    p, gap = events.p, np.where(np.diff(pixel) == 0, np.diff(events.t) / 1000, np.inf)
    follows = gap < 20 * 10**1.6
    assert (p[1:][follows] != p[:-1][follows]).mean() > 0.97
    first = ~np.concatenate([[False], follows])
    n = first.sum()
    assert abs(follows.sum() / n - 0.6) < 4 * np.sqrt(0.24 / n) + 0.02
    assert abs(p[first].mean() - 0.7) < 4 * np.sqrt(0.21 / n)
    law = stats.lognorm(s=0.4 * np.log(10), scale=20.0)
    assert stats.kstest(gap[follows], law.cdf).statistic < 1.6 / np.sqrt(follows.sum()) + 0.02
    assert abs(len(events) / (H * W * 30) - 0.02) < 0.02 * 0.05


def test_a_hot_pixel_answers_nothing_and_prefers_a_polarity_of_its_own():
    """Beside others whose noise is answered. Shares by the stated law, drawn once; events of a pixel by its share."""
    config = ANSWERED.model_copy(
        update={"hot_fraction": 0.2, "hot_rate_hz": 200.0, "hot_on_share": 0.6, "hot_on_spread": 1.2}
    )
    stage, events = noise_of(config, [0, 4_000_000])
    hot, pixel = stage.hot, events.y.astype(int) * W + events.x
    n, on = np.bincount(pixel, minlength=H * W), np.bincount(pixel, weights=events.p, minlength=H * W)
    logit = np.log(stage.on_shares / (1 - stage.on_shares))[hot]
    assert stats.kstest(logit, stats.norm(np.log(0.6 / 0.4), 1.2).cdf).pvalue > 1e-3
    assert (stage.on_shares[~hot] == 0.7).all()
    share = stage.on_shares[hot]
    z = (on[hot] - n[hot] * share) / np.sqrt(n[hot] * share * (1 - share))
    usual = n[hot] * np.minimum(share, 1 - share) > 20
    assert usual.sum() > 500 and stats.kstest(z[usual], "norm").pvalue > 1e-3
    z = (n[hot] - 4 * stage.rates[hot]) / np.sqrt(4 * stage.rates[hot])
    assert stats.kstest(z, "norm").pvalue > 1e-3, "Poisson: answers would make counts scatter more"


def test_answers_do_not_depend_on_the_steps_and_resume():
    _, whole = noise_of(ANSWERED, [0, 1_000_000], causes=True)
    stage, parts = PixelNoise(ANSWERED, H, W, 5, True), []
    for t in (0, 1, 20_000, 20_001, 600_000, 1_000_000):
        parts.append(stage.step(Events.empty(), t))
        again = PixelNoise(ANSWERED, H, W, 5, True)
        again.load_state_dict(stage.state_dict())
        stage = again
    assert_same(Events.concatenate(parts), whole)


def test_dead_pixels_are_silent_and_others_untouched():
    stage = PixelNoise(PixelsConfig(dead_fraction=0.3), H, W, 2)
    rng = np.random.default_rng(1)
    events = Events(rng.integers(0, W, 5000).astype(np.uint16), rng.integers(0, H, 5000).astype(np.uint16),
                    np.sort(rng.integers(0, 1000, 5000)), rng.integers(0, 2, 5000).astype(np.uint8))  # fmt: skip
    stage.step(Events.empty(), 0)
    alive = ~stage.dead[events.y.astype(int) * W + events.x]
    assert_same(stage.step(events, 1000), events.part(alive))
    assert 0.25 < 1 - alive.mean() < 0.35


@pytest.mark.parametrize("load", [0.3, 0.6, 0.9])
def test_the_bus_waits_as_an_m_d_1_queue(load):
    """Poisson arrivals, one server of fixed time s: the wait W before service has the mean s load / (2 (1 - load))
    (Pollaczek, Khinchine) and the square 2 E[W]^2 + load s^2 / (3 (1 - load)) (Takacs)."""
    service_us, n = 50.0, 400_000
    rng = np.random.default_rng(int(load * 10))
    t = np.cumsum(rng.exponential(service_us / load, n)).astype(np.int64)
    events = Events(np.zeros(n, np.uint16), np.zeros(n, np.uint16), t, np.zeros(n, np.uint8))
    bus = Readout(ReadoutConfig(events_per_second=1e6 / service_us, queue_events=2**20))
    out = bus.step(events)
    assert len(out) == n and bus.dropped == 0
    wait = out.t - t - service_us
    mean = service_us * load / (2 * (1 - load))
    square = 2 * mean**2 + load * service_us**2 / (3 * (1 - load))
    blocks = wait[: n // 200 * 200].reshape(200, -1).mean(1)  # for the error of means of what is correlated
    assert abs(wait.mean() - mean) < 4 * blocks.std() / np.sqrt(200) + 0.5
    assert abs(wait.std() / np.sqrt(square - mean**2) - 1) < 0.12
    assert abs((wait == 0).mean() - (1 - load)) < 0.02, "the bus is idle for a share 1 - load of the time"


def test_the_bus_does_not_care_from_when_the_clock_counts():
    """A camera's file counts from 1970, and the bus counts picoseconds."""
    rng, n, shift = np.random.default_rng(2), 3000, 1_643_243_628_734_000
    t = np.sort(rng.integers(0, 20_000, n))
    x, y, p = rng.integers(0, 40, n).astype(np.uint16), rng.integers(0, 30, n).astype(np.uint16), np.zeros(n, np.uint8)
    config = ReadoutConfig(events_per_second=1e5, row_ns=300, queue_events=64)
    early, late = Readout(config), Readout(config)
    made, again = early.step(Events(x, y, t, p)), late.step(Events(x, y, t + shift, p))
    assert_same(again, replace(made, t=made.t + shift))
    assert late.dropped == early.dropped > 0
    with pytest.raises(
        EventDataError, match="the time since the first event is too long .got '110 days'.; expected at most 100"
    ):
        late.step(Events(x[:1], y[:1], np.array([shift + 110 * 86_400_000_000]), p[:1]))


def test_clock_is_the_last_tick_that_has_passed():
    events = Events(*(np.zeros(6, np.uint16),) * 2, np.array([0, 9, 10, 11, 29, 30]), np.zeros(6, np.uint8))
    assert Readout(ReadoutConfig(clock_us=10)).step(events).t.tolist() == [0, 0, 10, 10, 20, 30]
    free = Readout(ReadoutConfig())
    assert_same(free.step(events), events)
    assert free.dropped == free.late == 0, "without a rate there is no bus"


def test_a_camera_with_all_of_it():
    """Stages in order, whatever the steps: nothing late or dropped is lost to the counts."""
    readout = ReadoutConfig(events_per_second=2e6, queue_events=4096, clock_us=5, pixels=NOISY)
    rng = np.random.default_rng(0)
    frames = [rng.random((H, W)).astype(np.float32) for _ in range(8)]
    cameras = [EventCamera(EsimConfig(causes=True), r, H, W, seed=3) for r in (None, readout)]
    free, full = (
        Events.concatenate([c.step(EventFrame(10_000_000 * k, f)) for k, f in enumerate(frames)]) for c in cameras
    )
    assert (full.t % 5 == 0).all() and (np.diff(full.t) >= 0).all() and full.t[-1] <= 70_000
    assert set(np.unique(full.cause)) >= {Cause.SIGNAL, Cause.HOT}
    noise = PixelNoise(NOISY, H, W, 3)
    dead = noise.dead[full.y.astype(int) * W + full.x]
    assert not dead.any()
    camera = cameras[1]
    assert camera.late > 0
    alive = (~noise.dead[free.y.astype(int) * W + free.x]).sum()
    own = len(full) + camera.late + camera.dropped - alive
    assert abs(own - noise.rates.sum() * 0.07) < 6 * np.sqrt(noise.rates.sum() * 0.07)


def test_a_step_includes_its_last_microsecond():
    _, drawn = noise_of(NOISY, [0, 100_000])
    at = int(drawn.t[len(drawn) // 2])
    stage, until = noise_of(NOISY, [0, at])
    assert until.t[-1] == at
    assert stage.step(Events.empty(), 100_000).t[0] > at
