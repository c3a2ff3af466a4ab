"""DVS-Voltmeter's voltage of one pixel: drift, noise, hitting times, and the stationary state of a still scene.

The loops of :mod:`blinkgl.events.voltmeter` use these functions; that module describes the model and its source.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from blinkgl.config.events import VoltmeterConfig
from blinkgl.events.arith import exp_f64, select
from blinkgl.events.philox import Stream, in_blocks, uniform2

_F = np.float32
# Typed constants: a float literal is float64 to numba and would widen the float32 loops.
_ZERO, _HALF, _ONE = _F(0.0), _F(0.5), _F(1.0)
V_ONE = 2**29
# V_ONE is one threshold; a drift beyond 2.25 thresholds is cut.
_V_SCALE, _V_UNIT, _DRIFT_LIMIT = _F(V_ONE), _F(1.0 / V_ONE), _F(2.25)
_START = np.uint64(Stream.START)
# Standard deviations within which a threshold counts as reachable, see the module voltmeter.
_FAR_64 = 6.5
_FAR_SQUARED = np.float32(6.5**2)
MOST_STEPS = np.float32(2.0**16)
"""Number of intervals after which the summed variance is used: beyond it, float32 would lose the increments."""
NEAREST = 1.0 - 1e-6
"""Largest |V| carried over: a threshold that the drift has passed is then reached at once."""


@register_jitable
def drift_and_noise(
    before: float, now: float, k1: float, k2: float, k3: float, k4_dt: float, k5_dt: float, k6: float, root_dt: float
) -> tuple[float, float]:
    """Return (mu dt, sigma sqrt(dt)) of an interval, elementwise; k4_dt = k4 dt, root_dt = sqrt(dt), dt in us."""
    mean = _HALF * (before + now)
    # gain: slope of the logarithm.
    gain = _ONE / (mean + k2)
    return k1 * (now - before) * gain + k4_dt + k5_dt * mean, (k3 * np.sqrt(mean) * gain + k6) * root_dt


@register_jitable
def move(v: float, drift: float) -> float:
    """Return V (int32, 2^-29) at the interval's end if nothing fires; the drift is limited to 2.25 thresholds."""
    cut = select(drift > _DRIFT_LIMIT, _DRIFT_LIMIT, select(drift < -_DRIFT_LIMIT, -_DRIFT_LIMIT, drift))
    return np.int32(v + np.int32(cut * _V_SCALE))


@register_jitable
def near_threshold(v: float, v_end: float, variance: float, here: float) -> bool:
    """Return whether a pixel must be processed: a threshold is within 6.5 standard deviations of the mean path.

    v, v_end : mean voltage at both ends, int32, 2^-29.   variance : unspent at the end, float32.   here : this
    interval's part of it."""
    # The mean path is straight, so its extremes are at its ends.
    high, low = select(v > v_end, v, v_end), select(v > v_end, v_end, v)
    above, below = _ONE - _F(high) * _V_UNIT, _ONE + _F(low) * _V_UNIT
    # room is negative where the mean path crosses a threshold.
    room = select(above < below, above, below)
    # room |room| <= 6.5^2 variance is room <= 6.5 sigma without a root, and holds for negative
    # room as well.
    return (room * abs(room) <= _FAR_SQUARED * variance) | (variance > MOST_STEPS * here)


@register_jitable
def one_minus_exp(x: float) -> float:
    """Return 1 - e^-x for x >= 0, to 1e-11 relative."""
    return select(x < 1e-4, x * (1.0 - x * (0.5 - x * (1.0 / 6.0))), 1.0 - exp_f64(-x))


@register_jitable
def hitting_time(distance: float, mu: float, sigma: float, normal: float, uniform: float) -> float:
    """Return the time to a threshold at ``distance`` > 0 that is reached: inverse Gaussian, mean distance/|mu|, shape
    distance^2/sigma^2; Levy's law without drift.

    Michael, Schucany, Haas (1976): the smaller root of a quadratic in the squared normal, or its conjugate. The root is
    written with a sum in the denominator, so that it stays accurate for small drifts and tends to distance^2/(sigma
    normal)^2, which is Levy's law.
    """
    speed = abs(mu)
    g = normal * normal * sigma * sigma / (2.0 * distance)
    denominator = speed + g + np.sqrt(g * (g + 2.0 * speed))
    # Neither drift nor noise towards the threshold: it is never met.
    if denominator == 0.0:
        return np.inf
    root = distance / denominator
    # ratio: root divided by the mean.
    ratio = root * speed / distance
    # Michael, Schucany, Haas: the smaller root with probability mean/(mean + root), else mean^2/root.
    if uniform * (1.0 + ratio) <= 1.0:
        return root
    return distance / (speed * ratio)


@register_jitable
def reach_of_part(v: float, mu: float, sigma: float, left: float) -> tuple[float, int]:
    """Return (us of the next part, the threshold that it may reach: 1, -1, or 0 where neither is reachable in the whole
    rest).

    ``left`` is halved until at most one threshold is within 6.5 sigma sqrt(part)."""
    part, rate = left, _FAR_64 * _FAR_64 * sigma * sigma
    while True:
        drift, squared = mu * part, rate * part
        # As in near_threshold, for a part of the interval.
        above, below = 1.0 - max(v, v + drift), 1.0 + min(v, v + drift)  # negative where the mean path crosses
        up, down = above * abs(above) <= squared, below * abs(below) <= squared
        if not (up and down):
            return part, 1 if up else (-1 if down else 0)
        part *= 0.5


@register_jitable
def reached(distance: float, toward: float, sigma: float) -> float:
    """Return the probability that a threshold is ever reached; ``toward`` is the drift towards it."""
    if toward >= 0.0:
        return 1.0
    # If the motion drifts away, the probability to ever arrive is exp(-2 |mu| a / sigma^2).
    return exp_f64(2.0 * toward * distance / (sigma * sigma)) if sigma > 0.0 else 0.0


@register_jitable
def crosses(before: float, after: float, noise: float) -> float:
    """Return the probability that a Brownian motion between two known ends meets a threshold: ``before`` > 0 and
    ``after`` are the distances there, ``noise`` is sigma sqrt(dt)."""
    if after <= 0.0:
        return 1.0
    # Reflection principle: exp(-2 a b / (sigma^2 dt)).
    variance = noise * noise
    return exp_f64(-2.0 * before * after / variance) if variance > 0.0 else 0.0


def start_voltage(intensity: np.ndarray, config: VoltmeterConfig, seed: np.uint64) -> tuple[np.ndarray, np.ndarray]:
    """Draw V of a scene that has been still for long, int32 (2^-29), and the rest of the dead time, µs, 0 for most.

    intensity : (H*W,) DN.   Without drift and noise V is 0.

    Between events V has the density 1 - e^{-r(1-v)} above 0 and e^{rv} - e^{-r} below, r = 2 mu/sigma^2 >= 0 (the
    Fokker-Planck equation with a source at 0; for r < 0 its mirror image). It is drawn by rejection, which keeps half
    of the candidates at any r.
    """
    pixels = np.arange(len(intensity), dtype=np.uint64)
    v, left_us = in_blocks(lambda *part: _voltage_of(config, seed, *part), pixels, intensity)
    return v, left_us


def _still(level: np.ndarray, config: VoltmeterConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return drift and noise, mu and sigma, of a scene that does not change. level : float64 DN."""
    return config.k4 + config.k5 * level, config.k3 * np.sqrt(level) / (level + config.k2) + config.k6


def _voltage_of(
    config: VoltmeterConfig, seed: np.uint64, pixels: np.ndarray, intensity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return :func:`start_voltage` of the pixels of these numbers."""
    mu, sigma = _still(intensity.astype(np.float64), config)
    with np.errstate(divide="ignore", invalid="ignore"):
        # r is infinite without noise and NaN without drift and noise.
        r = np.minimum(2.0 * np.abs(mu) / sigma**2, 1e12)
        # Mean time between events, for the share of the dead time: tanh(r/2)/mu, 1/sigma^2 without drift.
        between = np.where(r > 1e-9, one_minus_exp(r) / (2.0 - one_minus_exp(r)) / np.abs(mu), 1 / sigma**2)
    v = np.zeros(len(intensity))
    wanted = np.flatnonzero(np.isfinite(r))
    for turn in range(200):
        if not wanted.size:
            break
        a, b = uniform2(seed, pixels[wanted], _START, np.uint64(turn))
        place, rate = 2.0 * a - 1.0, r[wanted]
        # 1 - e^-r(1-v) and e^rv - e^-r, both over 1 - e^-r, their value at 0; a triangle for small r.
        flat = rate < 1e-9
        rate = np.where(flat, 1.0, rate)
        shape = one_minus_exp(rate * (1.0 - np.abs(place))) / one_minus_exp(rate)
        # Below 0 the density is that of the mirrored place times e^{rv}.
        density = np.where(place > 0, shape, shape * exp_f64(rate * np.minimum(place, 0.0)))
        kept = b < np.where(flat, 1.0 - np.abs(place), density)
        v[wanted[kept]] = place[kept]
        wanted = wanted[~kept]
    # For r < 0 the mirror image.
    v = np.where(mu < 0, -v, v)
    left = np.zeros(len(intensity))
    if config.refractory_us:
        a, b = uniform2(seed, pixels, _START, np.uint64(1000))
        # The chance to be in the dead time is its share of the whole cycle.
        dead = np.isfinite(r) & (a * (config.refractory_us + between) < config.refractory_us)
        left[dead] = b[dead] * config.refractory_us
    return (np.clip(v, -NEAREST, NEAREST) * V_ONE).astype(np.int32), left


def start_by_leak(v: np.ndarray, intensity: np.ndarray, config: VoltmeterConfig) -> np.ndarray:
    """What of the V of :func:`start_voltage` is leak's doing, float32: the share tanh(r/2) that drift has of the way
    from event to event in the mean, where V lies on the drift's side."""
    mu, sigma = _still(intensity.astype(np.float64), config)
    with np.errstate(divide="ignore", invalid="ignore"):
        # tanh(r/2) = (1 - e^-r)/(1 + e^-r).
        e = exp_f64(-np.minimum(2.0 * np.abs(mu) / sigma**2, 700.0))
    share = np.where(mu == 0, 0.0, (1.0 - e) / (1.0 + e))
    held = np.where(np.abs(v) < V_ONE, v / V_ONE, 0.0)
    return np.where(held * mu > 0, held * share, 0.0).astype(np.float32)
