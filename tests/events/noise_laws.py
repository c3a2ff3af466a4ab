"""Noise of the emulators against the equations that they state, at any frame rate.

An even scene, still or on a ramp, is watched at 50, 500 and 5,000 frames/s and at uneven steps (log-uniform from 0.1
to 40 ms), and what comes out is compared with the law of the stated equation, which is exact and knows no frames: the
rate per pixel; the interval between two events of a pixel (Kolmogorov-Smirnov distance and its probability); its
spread; the wait for the first event, which says whether the start is that of a scene watched for long.
``test_random.py`` holds the cases to error probabilities.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy import integrate, stats

from blinkgl.config.events import EmulatorConfig, EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.events import Events, make_emulator
from tests.events.clips import by_pixel

FRAMES = {"50": 50.0, "500": 500.0, "5000": 5000.0, "uneven": None}
"""Column -> frames per second; None: uneven."""


class Law(NamedTuple):
    """Of one pixel: what the equation says."""

    survival: Callable[[np.ndarray], np.ndarray]  # P(interval between two events > t), t in seconds
    longest: float  # beyond which it is 0
    on: float  # share of ON events
    fresh: bool = False  # the first frame is like an event; else it is any moment


class Case(NamedTuple):
    """One noise term of one emulator."""

    config: EmulatorConfig
    level: float  # luminance of the scene at the first frame
    law: Law
    seconds: float
    slope: float = 0.0  # ln(luminance + offset) rises by this a second
    offset: float = 0.0


class Seen(NamedTuple):
    """What came out, and how probable that is under the law."""

    rate_p: float
    interval_cv: float
    cv_law: float
    interval_p: float
    first_p: float
    on: float
    events: int


# --- laws --------------------------------------------------------------------------------------------------
def exit_survival(mu: float, sigma: float, terms: int = 120) -> Callable[[np.ndarray], np.ndarray]:
    """P(a Brownian motion from 0 with drift mu, diffusion sigma stays in (-1, 1) for longer than t).

    The eigenfunctions of the Fokker-Planck equation between two absorbing walls; for narrow laws, where their sum
    cancels, the inverse Gaussian, from which it then differs by less than 1e-9."""
    if 2 * abs(mu) / sigma**2 > 20:
        shape, mean = sigma**-2.0, 1 / abs(mu)
        return stats.invgauss(mu=mean / shape, scale=shape).sf
    n = np.arange(1, terms)
    g = mu / sigma**2
    rate = (n * np.pi / 2) ** 2 * sigma**2 / 2 + mu * g / 2
    # integral of e^(g v) sin(n pi (v + 1)/2) over (-1, 1), in closed form
    w = n * np.pi / 2
    whole = w * (np.exp(-g) - np.exp(g) * np.cos(n * np.pi)) / (g * g + w * w)
    weight = np.sin(n * np.pi / 2) * whole
    return lambda t: np.clip((weight * np.exp(-np.multiply.outer(np.maximum(t, 1e-9), rate))).sum(-1), 0, 1)


def voltmeter_law(config: VoltmeterConfig, level: float, slope: float = 0.0) -> Law:
    """Renewals of the exit from (-1, 1). slope : of ln(L + k2), per second; sigma must then not depend on L."""
    light = level * config.full_scale
    mu = (config.k4 + config.k5 * light) * 1e6 + config.k1 * slope
    sigma = (config.k3 * np.sqrt(light) / (light + config.k2) + config.k6) * 1e3
    r = 2 * mu / sigma**2
    mean = np.tanh(r / 2) / mu if mu else sigma**-2.0
    return Law(exit_survival(mu, sigma), 40 * mean, 1 / (1 + np.exp(-r)), config.start == "zero")


def _sum_of_four(x: np.ndarray) -> np.ndarray:
    """P(sum of four uniforms < x)."""
    x = np.clip(x, 0, 4)
    return sum(s * np.maximum(x - k, 0) ** 4 for k, s in enumerate((1, -4, 6, -4))) / 24


def v2e_law(leak: float, jitter: float = 0.0, shot: float = 0.0, dead_s: float = 0.0) -> Law:
    """An interval of the leak, of mean 1/leak and relative spread ``jitter`` (a sum of four uniforms), ended before its
    time by shot noise of rate ``shot``; a dead time after each event."""

    def leak_survival(t: np.ndarray) -> np.ndarray:
        if jitter == 0:
            return (t < 1 / leak).astype(float) if leak else np.ones_like(t)
        return 1 - _sum_of_four((t * leak - 1) / jitter / np.sqrt(3.0) + 2.0)

    def survival(t: np.ndarray) -> np.ndarray:
        alive = np.maximum(np.asarray(t, float) - dead_s, 0)
        return leak_survival(alive) * np.exp(-shot * alive)

    longest = dead_s + ((1 + 4 * jitter) / leak if leak else 60 / shot)
    t = np.linspace(0, longest, 100_001)
    by_shot = shot * (integrate.trapezoid(survival(t), t) - dead_s)
    return Law(survival, longest, 1 - by_shot / 2)


def esim_law(config: EsimConfig, slope: float) -> Law:
    """Thresholds that every event draws anew, passed by a straight line."""
    c, sigma = config.contrast_threshold, config.threshold_jitter
    return Law(lambda t: stats.norm.sf(np.asarray(t) * slope, c, sigma), (c + 9 * sigma) / slope, 1.0, True)


def shot_rate(rate_hz: float, level: float) -> float:
    """V2E's shot noise of a pixel with nominal thresholds, ON and OFF together."""
    return rate_hz * (1 - 0.75 * (255 * level + 20) / 275)


_NOTHING = dict(k1=5.0, k2=20.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0)
_CLEAN = dict(preset="clean", threshold_sigma=0.0)


def cases() -> dict[str, Case]:
    """Noise terms, faster than a camera's, so that a second of a few pixels tells."""

    def volt(seconds: float, level: float = 0.4, slope: float = 0.0, **keys: Any) -> Case:
        config = VoltmeterConfig(**{**_NOTHING, **keys})
        return Case(config, level, voltmeter_law(config, level, slope), seconds, slope, config.k2 / config.full_scale)

    def v2e(seconds: float, law: Law, **keys: Any) -> Case:
        return Case(V2eConfig(**{**_CLEAN, **keys}), 0.4, law, seconds)

    esim = EsimConfig(threshold_sigma=0.0, threshold_jitter=0.04, log_eps=1e-9)
    leak = dict(leak_rate_hz=30.0, leak_cov_decades=0.0)
    shot = shot_rate(40.0, 0.4)
    return {
        "ESIM jitter of C, on a ramp": Case(esim, 1e-3, esim_law(esim, 16.0), 0.5, 16.0),
        "V2E leak": v2e(0.5, v2e_law(30, 0.2), **leak, leak_jitter=0.2),
        "V2E leak, low-pass, dead time": v2e(
            0.5, v2e_law(30, 0.1, 0, 0.002), **leak, leak_jitter=0.1, cutoff_hz=300.0, refractory_us=2000.0
        ),
        "V2E shot noise": v2e(0.6, v2e_law(0, 0, shot), shot_noise_rate_hz=40.0),
        "V2E shot noise, full scale": Case(
            V2eConfig(**_CLEAN, shot_noise_rate_hz=60.0), 1.0, v2e_law(0, 0, shot_rate(60.0, 1.0)), 1.2
        ),
        "V2E shot noise, leak, dead time": v2e(
            0.6,
            v2e_law(20, 0.1, shot, 0.003),
            shot_noise_rate_hz=40.0,
            leak_rate_hz=20.0,
            leak_jitter=0.1,
            leak_cov_decades=0.0,
            refractory_us=3000.0,
        ),
        "Voltmeter leak and diffusion": volt(0.4, k4=6e-5, k6=1.5e-3),
        "Voltmeter diffusion of photons, k5": volt(0.4, k5=5e-7, k3=1.5e-2),
        "Voltmeter diffusion alone": volt(0.6, k6=6e-3),
        "Voltmeter diffusion, OFF leak": volt(0.6, k4=-2e-5, k6=6e-3),
        "Voltmeter on a ramp, from 0": volt(0.4, level=1e-2, slope=8.0, k4=1e-7, k6=1.5e-3, start="zero"),
    }


# --- what an emulator does ---------------------------------------------------------------------------------
def frame_times(fps: float | None, seconds: float, seed: int = 0) -> np.ndarray:
    """(N,) int64 ns, from 0 to ``seconds``."""
    if fps:
        return np.round(np.arange(int(seconds * fps) + 1) / fps * 1e9).astype(np.int64)
    steps = np.exp(np.random.default_rng(seed).uniform(np.log(1e-4), np.log(4e-2), int(seconds * 1000) + 10))
    times = np.concatenate([[0.0], np.cumsum(steps)])
    return np.round(np.append(times[times < seconds], seconds) * 1e9).astype(np.int64)


def watch(case: Case, fps: float | None, side: int, seed: int) -> Events:
    """Events of side x side pixels of an even scene."""
    emulator = make_emulator(case.config, side, side, seed)
    level = lambda t: (case.level + case.offset) * np.exp(case.slope * t * 1e-9) - case.offset
    times = frame_times(fps, case.seconds, seed)
    return Events.concatenate([emulator.step(np.full((side, side), level(t), np.float32), int(t)) for t in times])


def judge(events: Events, case: Case, side: int) -> Seen:
    """Compares the events of :func:`watch` with the case's law."""
    law, seconds, pixels = case.law, case.seconds, side * side
    pixel, events = by_pixel(events, side)
    t = (events.t + 0.5) * 1e-6
    start = np.flatnonzero(np.diff(pixel, prepend=-1))
    first = t[start]
    second = start[np.append(np.diff(start), len(t) - start[-1]) > 1]
    # The first whole interval of each pixel. That a pixel had none by the end is rare where the clip is long enough.
    interval = t[second + 1] - t[second]
    ks = stats.kstest(interval, lambda x: 1 - law.survival(x))
    grid = np.linspace(0, law.longest, 20_001)
    survival = law.survival(grid)
    mean = float(integrate.trapezoid(survival, grid))
    square = float(2 * integrate.trapezoid(survival * grid, grid))
    wait = integrate.cumulative_trapezoid(survival, grid, initial=0) / mean
    ks_first = stats.kstest(
        first, (lambda x: 1 - law.survival(x)) if law.fresh else (lambda x: np.interp(x, grid, wait))
    )
    counts = np.bincount(pixel, minlength=pixels)
    expected = seconds / mean + ((square / mean**2 - 2) / 2 if law.fresh else 0)  # renewal theory, long clips
    error = max(counts.std(), 1e-9) / np.sqrt(pixels)
    return Seen(
        float(2 * stats.norm.sf(abs(counts.mean() - expected) / error)),
        float(interval.std() / interval.mean()),
        float(np.sqrt(square - mean**2) / mean),
        float(ks.pvalue),
        float(ks_first.pvalue),
        float(events.p.mean()),
        len(events),
    )
