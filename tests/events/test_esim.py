"""ESIM: closed forms, convergence order, spread of thresholds, saturation. Its twin is tests/tensors."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.optimize import brentq

from blinkgl.config.events import EsimConfig
from blinkgl.events import Esim
from tests.events.clips import run


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


def test_threshold_spread_is_frozen_and_normal():
    esim = Esim(100, 100, EsimConfig(contrast_threshold=0.3, threshold_sigma=0.03), seed=0)
    on = esim._on / 2**25
    assert abs(on.mean() - 0.3) < 0.0015 and abs(on.std() - 0.03) < 0.001
    assert abs(np.corrcoef(on, esim._off)[0, 1]) < 0.04
    assert (Esim(100, 100, EsimConfig(contrast_threshold=0.3, threshold_sigma=0.03), seed=1)._on != esim._on).any()


@pytest.mark.parametrize("threshold", [0.001, 0.01, 0.2, 1.0, 5.0])
def test_the_default_spread_is_a_share_of_the_threshold(threshold):
    """A rise by 40 thresholds makes 40 events a pixel at every threshold, but for the rest below one threshold."""
    esim = Esim(64, 64, EsimConfig(contrast_threshold=threshold, log_eps=1e-9), seed=3)
    on = esim._on / 2**25
    assert on.std() == pytest.approx(0.105 * threshold, rel=0.05)
    if threshold <= 0.2:
        frames = [np.full((64, 64), light, np.float32) for light in (1e-3, 1e-3 * np.exp(40 * threshold))]
        assert len(run(esim, frames, [0, 10**9])) / 64**2 == pytest.approx(
            (40 * threshold / on).astype(int).mean(), abs=0.5
        )


def test_burst_saturates_honestly():
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
