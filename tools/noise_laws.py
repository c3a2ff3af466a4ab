"""Noise of the emulators against the equations that they state, at any frame rate.

    python -m blinkgl.tools.noise_laws [--quick] [--json FILE]

A still scene is watched at 50, 500 and 5,000 frames/s and at uneven steps (log-uniform from 0.1 to 40 ms), and what
comes out is compared with the law of the stated equation, which is exact and knows no frames: the rate per pixel; the
interval between two events of a pixel (Kolmogorov–Smirnov distance and its probability); its spread; the wait for the
first event, which says whether the start is that of a scene watched for long; how evenly the events lie in time
(chi-square over ten parts). A row of the table that is flat from column to column is noise that does not depend on
the frames. ``tests/events/test_noise_laws.py`` holds the same cases to error probabilities.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy import integrate, stats

from blinkgl.config.events import EmulatorConfig, V2eConfig, VoltmeterConfig
from blinkgl.events import Events, make_emulator

FRAMES = {"50": 50.0, "500": 500.0, "5000": 5000.0, "uneven": None}
"""Column -> frames per second; None: uneven."""


class Law(NamedTuple):
    """Of one pixel: what the equation says."""

    rate: float  # events per second
    survival: Callable[[np.ndarray], np.ndarray]  # P(interval between two events > t), t in seconds
    on: float  # share of ON events


class Case(NamedTuple):
    """One noise term of one emulator."""

    config: EmulatorConfig
    level: float  # luminance of the scene
    law: Law
    seconds: float


class Seen(NamedTuple):
    """What came out, and how probable that is under the law."""

    rate: float
    rate_p: float
    interval_mean: float
    interval_cv: float
    interval_ks: float
    interval_p: float
    first_ks: float
    first_p: float
    flat_p: float
    on: float
    events: int


# --- laws --------------------------------------------------------------------------------------------------
def exit_survival(mu: float, sigma: float, terms: int = 400) -> Callable[[np.ndarray], np.ndarray]:
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


def voltmeter_law(config: VoltmeterConfig, level: float) -> Law:
    """Renewals of the exit from (-1, 1)."""
    light = level * config.full_scale
    mu = (config.k4 + config.k5 * light) * 1e6
    sigma = (config.k3 * np.sqrt(light) / (light + config.k2) + config.k6) * 1e3
    r = 2 * mu / sigma**2
    mean = np.tanh(r / 2) / mu if mu else sigma**-2.0
    return Law(1 / mean, exit_survival(mu, sigma), 1 / (1 + np.exp(-r)))


def leak_law(rate: float, jitter: float, shot: float = 0.0, dead_s: float = 0.0) -> Law:
    """V2E: an interval of the leak, of mean 1/rate and relative spread ``jitter`` (a sum of four uniforms), ended
    before its time by shot noise of rate ``shot``; a dead time after each event."""

    def leak_survival(t: np.ndarray) -> np.ndarray:
        if rate == 0:
            return np.ones_like(t)
        if jitter == 0:
            return (t < 1 / rate).astype(float)
        sum_of_four = (t * rate - 1) / jitter / np.sqrt(3.0) + 2.0
        x = np.clip(sum_of_four, 0, 4)
        below = sum(s * c * np.maximum(x - k, 0) ** 4 for k, (s, c) in enumerate(((1, 1), (-1, 4), (1, 6), (-1, 4))))
        return 1 - below / 24

    survival = lambda t: np.where(t < dead_s, 1.0, leak_survival(t - dead_s) * np.exp(-shot * np.maximum(t - dead_s, 0)))
    end = dead_s + (1 + 4 * jitter) / rate if rate else dead_s + 60 / shot
    t = np.linspace(0, end, 400_001)
    mean = integrate.trapezoid(survival(t), t)
    ends_by_shot = shot * (mean - dead_s)
    return Law(1 / mean, survival, 1 - ends_by_shot / 2)


# --- what an emulator does ---------------------------------------------------------------------------------
def frame_times(fps: float | None, seconds: float, seed: int = 0) -> np.ndarray:
    """(N,) int64 ns, from 0 to ``seconds``."""
    if fps:
        return np.round(np.arange(int(seconds * fps) + 1) / fps * 1e9).astype(np.int64)
    steps = np.exp(np.random.default_rng(seed).uniform(np.log(1e-4), np.log(4e-2), int(seconds * 1000) + 10))
    times = np.concatenate([[0.0], np.cumsum(steps)])
    return np.round(np.append(times[times < seconds], seconds) * 1e9).astype(np.int64)


def watch(case: Case, fps: float | None, side: int, seed: int) -> Events:
    """Events of side x side pixels of a still scene."""
    emulator = make_emulator(case.config, side, side, seed)
    frame = np.full((side, side), case.level, np.float32)
    return Events.concatenate([emulator.step(frame, int(t)) for t in frame_times(fps, case.seconds, seed)])


def judge(events: Events, case: Case, pixels: int, side: int) -> Seen:
    """Compares events of a still scene with the case's law."""
    law, seconds = case.law, case.seconds
    pixel = events.y.astype(np.int64) * side + events.x
    order = np.lexsort((events.t, pixel))
    pixel, t = pixel[order], (events.t[order] + 0.5) * 1e-6
    start = np.flatnonzero(np.diff(pixel, prepend=-1))
    first = t[start]
    second = start[np.append(np.diff(start), len(t) - start[-1]) > 1]
    # The first whole interval of each pixel. That a pixel had none by the end is rare where the clip is long enough.
    interval = t[second + 1] - t[second]
    ks = stats.kstest(interval, lambda x: 1 - law.survival(x))
    grid = np.linspace(0, seconds, 20_001)
    wait = integrate.cumulative_trapezoid(law.survival(grid), grid, initial=0) * law.rate
    ks_first = stats.kstest(first, lambda x: np.interp(x, grid, wait) / wait[-1])
    counts = np.bincount(pixel, minlength=pixels)
    rate = counts.mean() / seconds
    error = max(counts.std(), 1e-9) / np.sqrt(pixels) / seconds
    # Renewals in disjoint pixels: the counts' own spread judges how evenly they lie in time.
    parts = np.array(
        [np.bincount(pixel[(t >= a) & (t < a + seconds / 10)], minlength=pixels) for a in np.arange(10) * seconds / 10]
    )
    spread = parts.var(axis=1).mean() / pixels
    flat = ((parts.mean(axis=1) - rate * seconds / 10) ** 2).sum() / max(spread, 1e-12)
    return Seen(
        rate,
        float(2 * stats.norm.sf(abs(rate - law.rate) / error)),
        float(interval.mean()),
        float(interval.std() / interval.mean()),
        float(ks.statistic),
        float(ks.pvalue),
        float(ks_first.statistic),
        float(ks_first.pvalue),
        float(stats.chi2.sf(flat, 10)),
        float(events.p.mean()),
        len(events),
    )
