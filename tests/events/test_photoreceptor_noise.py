"""Photoreceptor noise with a dead time: the events of the stated equation, at the rate that is asked for.

The equation: stationary Gaussian noise of the low-pass's correlation, seen at the frames and on straight lines between
them; an event where it has gone a threshold from the reference; for the dead time nothing, then the reference is
the noise. It is simulated here in NumPy, all pixels at once, without the emulator's kernels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from blinkgl.config.events import V2eConfig
from blinkgl.events import V2e
from blinkgl.events.noise import noise_size

LEVEL, THETA, DEAD_S, SIDE = 0.4, 0.2, 1e-3, 30
FRAMES = {"50": 50.0, "500": 500.0, "5000": 5000.0, "uneven": None}


def frame_times(fps: float | None, seconds: float) -> np.ndarray:
    """int64 ns; None: from 0.2 to 20 ms apart, log-uniform."""
    if fps:
        return np.round(np.arange(round(seconds * fps) + 1) * 1e9 / fps).astype(np.int64)
    steps = np.exp(np.random.default_rng(8).uniform(np.log(0.2), np.log(20), round(seconds * 1200))) * 1e6
    times = np.concatenate([[0], np.cumsum(steps.astype(np.int64))])
    return times[times <= seconds * 1e9]


def exact(times_ns: np.ndarray, rate_hz: float, cutoff_hz: float, pixels: int, seed: int) -> list[np.ndarray]:
    """Times of events of each pixel, s."""
    rng, corner = np.random.default_rng(seed), 2 * np.pi * cutoff_hz * (255 * LEVEL + 20) / 275
    noise = THETA * noise_size(0.0, rate_hz / corner) * rng.normal(size=pixels)
    reference, asleep, release = noise.copy(), np.zeros(pixels, bool), np.zeros(pixels)
    fired: list[tuple[np.ndarray, np.ndarray]] = []
    for t0, t1 in zip(times_ns[:-1] * 1e-9, times_ns[1:] * 1e-9):
        dt = t1 - t0
        k = corner * dt
        size = THETA * noise_size(k, rate_hz / corner, DEAD_S / dt)
        now = np.exp(-k) * noise + size * np.sqrt(-np.expm1(-2 * k)) * rng.normal(size=pixels)
        line = lambda t, noise=noise, now=now, t0=t0, dt=dt: noise + (now - noise) * (t - t0) / dt
        look = np.full(pixels, t0)
        while True:
            wakes = asleep & (release <= t1)
            reference, look = np.where(wakes, line(release), reference), np.where(wakes, release, look)
            asleep &= ~wakes
            fires = np.flatnonzero(~asleep & (np.abs(now - reference) >= THETA))
            if not fires.size:
                break
            level = reference[fires] + THETA * np.sign(now - reference)[fires]
            at = t0 + dt * (level - noise[fires]) / (now - noise)[fires]
            at = np.maximum(at, look[fires])
            fired.append((fires, at))
            asleep[fires], release[fires] = True, at + DEAD_S
        noise = now
    who, when = (np.concatenate([part[i] for part in fired]) for i in (0, 1))
    order = np.lexsort((when, who))
    return np.split(when[order], np.cumsum(np.bincount(who, minlength=pixels))[:-1])


def emulated(times_ns: np.ndarray, rate_hz: float, cutoff_hz: float, side: int, seed: int, **keys) -> list[np.ndarray]:
    config = V2eConfig(
        preset="clean", contrast_threshold=THETA, threshold_sigma=0.0, cutoff_hz=cutoff_hz, photoreceptor_noise=True,
        shot_noise_rate_hz=rate_hz, refractory_us=DEAD_S * 1e6, **keys,
    )  # fmt: skip
    emulator, frame = V2e(side, side, config, seed=seed), np.full((side, side), LEVEL, np.float32)
    parts = [emulator.step(frame, int(t)) for t in times_ns]
    when = np.concatenate([e.t for e in parts]) * 1e-6 + 0.5e-6  # they are floored
    who = np.concatenate([e.y.astype(int) * side + e.x for e in parts])
    order = np.lexsort((when, who))
    return np.split(when[order], np.cumsum(np.bincount(who, minlength=side**2))[:-1])


def one_interval(pixels: list[np.ndarray], after: float) -> np.ndarray:
    """The first whole interval of each pixel after a time: independent of one another."""
    late = [t[np.searchsorted(t, after) :] for t in pixels]
    return np.array([t[1] - t[0] for t in late if len(t) > 1])


@pytest.mark.parametrize("frames", FRAMES)
def test_rate_intervals_and_spread_are_the_equations(frames):
    times, rate, cutoff = frame_times(FRAMES[frames], 1.2), 25.0, 300.0
    ours, theirs = emulated(times, rate, cutoff, SIDE, 3, start="zero"), exact(times, rate, cutoff, SIDE**2, 4)
    counts = [np.array([(t > 0.3).sum() for t in pixels]) for pixels in (ours, theirs)]
    error = np.hypot(*(c.std() / SIDE for c in counts))
    assert abs(counts[0].mean() - counts[1].mean()) < 4 * error
    assert counts[0].std() == pytest.approx(counts[1].std(), rel=0.15)
    mine, exacts = (one_interval(pixels, 0.3) for pixels in (ours, theirs))
    assert min(len(mine), len(exacts)) > 500 and min(mine.min(), exacts.min()) >= DEAD_S - 2e-6
    assert stats.ks_2samp(mine, exacts).pvalue > 1e-4
