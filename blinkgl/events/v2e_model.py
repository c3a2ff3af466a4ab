"""The elements of V2E, elementwise: photoreceptor, crossing times, noise. Kernel and slow twin are built on these.

Formulas and sources are in :mod:`blinkgl.events.v2e`. Functions marked ``register_jitable`` take scalars inside a
kernel and arrays from Python.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from blinkgl.config.events import V2eConfig
from blinkgl.events.arith import exp_f32, exp_f64, fall_f64, horner, log_f32, log_f64, select
from blinkgl.events.bands import BLOCK
from blinkgl.events.noise import TABLE_LOW, TABLE_SIZE, TABLE_STEP, start_places, start_sizes
from blinkgl.events.philox import Stream, in_blocks, normal2, pixel_counters, rough_normal, uniform2

_F = np.float32
# _SLOPE is that of the chord from (0, 0) to (20, ln 20).
_ZERO, _ONE, _HALF, _JOINT, _SLOPE = _F(0), _F(1), _F(0.5), _F(20.0), _F(np.log(20.0) / 20.0)
_SHOT, _U2, _SMALLEST_K = np.uint64(Stream.SHOT), np.uint64(2), _F(1e-6)
# Place in the table of noise sizes: ln k of its first entry, entries per unit of ln k, the last
# but one entry.
_TABLE_LOW, _TABLE_PER, _TABLE_LAST = _F(TABLE_LOW), _F(1 / TABLE_STEP), _F(TABLE_SIZE - 2)
DARK, SETTLED = _F(2.0**-60), _F(2.0**-90)
"""DN below which there is no light, and ln units below which a lag is over. They avoid subnormal numbers, which take a
CPU a hundred times as long and which a GPU may treat as zero."""
REBASE = 0.02
"""Leak (ln units) after which the leak clock restarts: small compared with a threshold, so that float32 suffices."""


# --- photoreceptor -----------------------------------------------------------------------------------------
@register_jitable
def lin_log(intensity: float) -> float:
    """Return ln(I) above 20 DN, the chord from the origin below (v2e, ``lin_log``); float32."""
    dim = select(intensity < DARK, _ZERO, intensity * _SLOPE)
    # select computes both sides, so the logarithm's argument is clamped to its range.
    return select(intensity <= _JOINT, dim, log_f32(np.maximum(intensity, _JOINT)))


@register_jitable
def settled(lag: float) -> float:
    """Return a lag, 0 where it is over. float32."""
    return select(np.abs(lag) < SETTLED, _ZERO, lag)


GROWTH_32 = tuple(_F(c) for c in (1 / 5040, -1 / 720, 1 / 120, -1 / 24, 1 / 6, -1 / 2, 1))
"""Coefficients of (1 - e^-k)/k = 1 - k/2! + k^2/3! - ..., the highest power first."""


@register_jitable
def decay(k: float) -> tuple[float, float]:
    """Return (e^-k, (1 - e^-k)/k) for float32 k >= 0 without cancellation at small k."""
    # ``select`` computes both sides, so each is limited to its valid range.
    small = np.minimum(k, _HALF)
    p = horner(small, GROWTH_32)
    large = np.maximum(k, _HALF)
    e = exp_f32(-large)
    return select(k < _HALF, _ONE - small * p, e), select(k < _HALF, p, (_ONE - e) / large)


@register_jitable
def relax(lag: float, before: float, now: float, intensity_before: float, intensity_now: float, kappa: float) -> float:
    """Return the lag y - x at the interval's end; kappa = 2 pi f_c dt / 275. float32."""
    # The low-pass y' = (x - y) / tau with x on a straight line: lag(1) = lag(0) e^-k - (x1 - x0) (1 - e^-k) / k. Its
    # corner frequency is f_c (I + 20) / 275 (v2e, ``low_pass_filter``), at the interval's mean intensity.
    a, g = decay(kappa * (_HALF * (intensity_before + intensity_now) + _JOINT))
    return settled(lag * a - (now - before) * g)


# --- where the signal meets a level ------------------------------------------------------------------------
@register_jitable
def curve_of(base: float, drift: float, dx: float, lag: float, k: float) -> tuple[float, float, float]:
    """Return (c, rise, fall) of z(s) = c + rise s + fall e^{-k s} over an interval, s in [0, 1], float64.

    base: lin-log intensity and leak at the start; drift: change by leak and noise; dx: change of the lin-log intensity;
    lag: y - x at the start; k: time constants in the interval, negative without a low-pass.
    """
    if k < 0:
        return base, drift + dx, 0.0
    # behind: the final lag of a low-pass behind a ramp.
    behind = dx / k
    return base - behind, drift + dx, lag + behind


@register_jitable
def signal_at(s: float, c: float, rise: float, fall: float, k: float) -> float:
    """Return z at fraction s of the interval."""
    if k < 0:
        return c + rise * s
    return c + rise * s + fall * fall_f64(k * s)


@register_jitable
def crossing_fraction(
    start: float, target: float, polarity: int, c: float, rise: float, fall: float, k: float, end: float
) -> float:
    """Return the fraction in [start, 1] where z(s) = target, given that z(1) = ``end`` has reached it.

    The inverse cubic Hermite interpolant of z, then Newton's method inside a shrinking bracket; the error is below 1e-6
    of the interval unless the curve is flat there."""
    # 0 / 0 is NaN where the signal stands on the level; max and min then give ``start``.
    if k < 0:
        return min(max(start, (target - c) / rise), 1.0)
    # An OFF crossing is an ON crossing of -z.
    sign = 1.0 if polarity else -1.0
    low, high = start, 1.0
    e_low = 1.0 if start == 0.0 else fall_f64(k * start)
    f_low = sign * (c + rise * start + fall * e_low - target)
    if f_low >= 0:
        return start
    f_high = sign * (end - target)
    # f < 0 before the crossing, f >= 0 from it on, for either polarity.
    # z' at both ends; at the end fall e^-k follows from z itself.
    v_low, v_high = sign * (rise - k * fall * e_low), sign * (rise - k * (end - c - rise))
    width, height = high - low, f_high - f_low
    u = -f_low / height
    # The first guess is where the chord meets the level.
    s = low + width * u
    if v_low > 0 and v_high > 0:
        # s as a cubic of z: slopes 1 / z' at both ends.
        stretch = height / (width * v_low * v_high)
        guess = u * ((1.0 - u) * stretch * ((1.0 - u) * v_high - u * v_low) + u * (3.0 - 2.0 * u))
        if 0.0 < guess < 1.0:
            s = low + width * guess
    # 60 halvings exhaust the 53 bits of a double, so the loop ends even where no Newton step is accepted.
    for _ in range(60):
        e = fall * fall_f64(k * s)
        f = sign * (c + rise * s + e - target)
        if f < 0:
            low = s
        else:
            high = s
        slope = sign * (rise - k * e)
        # Where the curve falls against the crossing's direction there is no Newton step, and the bracket is halved.
        following = s - f / slope if slope > 0 else -1.0
        newton = low <= following <= high
        if not newton:
            following = 0.5 * (low + high)
        moved = abs(following - s)
        s = following
        # After a Newton step the error is moved^2 |z''| / (2 z'): no further step where that is below 1e-6.
        if (newton and moved * moved * k * k * abs(e) <= 2e-6 * slope) or moved < 1e-9:
            break
    return s


# --- shot noise --------------------------------------------------------------------------------------------
DARKEST = 1.0 - 0.75 * 20.0 / 275.0
"""Shot-noise factor at intensity 0, the largest."""


@register_jitable
def shot_factor(intensity: float) -> float:
    """Return the shot noise factor, which falls to a quarter from dark to full scale (v2e, SHOT_NOISE_INTEN_FACTOR
    0.25)."""
    return 1.0 - 0.75 * min(max((intensity + 20.0) / 275.0, 0.0), 1.0)


@register_jitable(inline="always")
def shot_draw(seed: int, block: int, index: int, rate_per_ns: float) -> tuple[int, float]:
    """Return draw number ``index`` of a block: (ns to the event after it, uniform that selects pixel and polarity)."""
    u, v = uniform2(seed, block, _SHOT, index * _U2)
    # Exponential waiting time, at least 1 ns so that the clock advances; 1e18 ns are 30 years.
    return np.int64(min(-log_f64(u) / rate_per_ns, 1e18)) + np.int64(1), v


def shot_tables(on: np.ndarray, off: np.ndarray, theta_on: float, theta_off: float) -> np.ndarray:
    """Return the cumulative noise of the pixels of each block of 1024, ON pixels then OFF pixels, (blocks, 2048)
    float32.

    One unit is a pixel with nominal threshold and one polarity; the last entry of a block is its total noise.
    """
    blocks = -(-len(on) // BLOCK)
    weights = np.zeros((blocks, 2, BLOCK))
    for polarity, (nominal, theta) in enumerate(((theta_on, on), (theta_off, off))):
        padded = np.zeros(blocks * BLOCK)
        # Shot noise is inversely proportional to the threshold; 0 beyond the last pixel.
        padded[: len(on)] = nominal / theta.astype(np.float64)
        weights[:, polarity] = padded.reshape(blocks, BLOCK)
    return np.cumsum(weights.reshape(blocks, 2 * BLOCK), axis=1).astype(np.float32)


# --- photoreceptor noise -----------------------------------------------------------------------------------
@register_jitable
def next_noise(noise: float, k: float, size: float, normal: float) -> float:
    """Return the photoreceptor noise k time constants later: the exact step of its stationary process. float32."""
    # Ornstein-Uhlenbeck: n(k) = n e^-k + size sqrt(1 - e^-2k) N(0, 1), of any step.
    a, _ = decay(k)
    return noise * a + size * np.sqrt(_ONE - a * a) * normal


@register_jitable
def noise_place(k: float) -> tuple[int, float]:
    """Return the place in the table of sizes: (entry below, fraction)."""
    # The place is clamped to the table.
    place = (log_f32(np.maximum(k, _SMALLEST_K)) - _TABLE_LOW) * _TABLE_PER
    below = np.int32(np.minimum(np.maximum(place, _ZERO), _TABLE_LAST))
    return below, _F(np.minimum(place, _TABLE_LAST) - _F(below))


def noise_threshold(config: V2eConfig) -> float:
    """Return the threshold to which the size of the noise refers: the mean of ON and OFF, as in v2e."""
    return 0.5 * sum(config.thresholds)


def corner_hz(level: np.ndarray, config: V2eConfig) -> np.ndarray:
    """Return the corner frequency of the first low-pass, f_c (I + 20)/275. level : float64 DN."""
    return config.cutoff_hz * (level + 20.0) / 275.0


# --- what is drawn once ------------------------------------------------------------------------------------
def draw_start_noise(intensity: np.ndarray, config: V2eConfig, seed: np.uint64) -> np.ndarray:
    """Draw stationary photoreceptor noise at the first frame, (H*W,) float32 ln units."""
    corner = corner_hz(intensity.astype(np.float64), config)
    pixels = np.arange(len(intensity), dtype=np.uint64)
    _, normal = in_blocks(lambda part: normal2(seed, part, np.uint64(Stream.START), np.uint64(1)), pixels)
    return (start_sizes(config.shot_noise_rate_hz, corner, noise_threshold(config)) * normal).astype(np.float32)


class Start(NamedTuple):
    """State of the comparators at the first frame, flat."""

    offset: np.ndarray  # float32: reference less signal, ln units
    leak: np.ndarray  # float32, of the current interval; [] without leak
    dead_ns: np.ndarray  # int64: the rest of the dead time; [] without one, 0 for most
    age_ns: np.ndarray  # int64: duration of the leak so far
    by_noise: np.ndarray  # float32: part of the offset caused by the photoreceptor noise


_JITTER_TURN, _TURNS, _MOST_ROUGH = 1000, 200, 3.5


def draw_start(
    config: V2eConfig,
    intensity: np.ndarray,
    on: np.ndarray,
    off: np.ndarray,
    leak: np.ndarray,
    noise: np.ndarray,
    seed: np.uint64,
) -> Start:
    """Draw the state of pixels at the first frame, see ``V2eConfig.start``.

    intensity : (H*W,) DN.   on, off : thresholds.   leak : mean drift, ln units per second; [].
    noise : the photoreceptor noise; [].

    ``stationary``: after a long time in a still scene. Leak takes a time T from one event to the next, and shot noise
    of rate R restarts it. The current T has the weight (1 - e^-RT)/R (a long one is seen more often), and its age a has
    the density e^-Ra up to T."""
    pixels = np.arange(len(on), dtype=np.uint64)
    return Start(*in_blocks(lambda *part: _start_of(config, seed, *part), pixels, intensity, on, off, leak, noise))


def _start_of(
    config: V2eConfig,
    seed: np.uint64,
    pixels: np.ndarray,
    intensity: np.ndarray,
    on: np.ndarray,
    off: np.ndarray,
    leak: np.ndarray,
    noise: np.ndarray,
) -> Start:
    """Return :func:`draw_start` of the pixels of these numbers."""
    offset, dead_ns = np.zeros(len(on), np.float32), np.zeros(len(on) if config.refractory_us else 0, np.int64)
    age_ns, by_noise = np.zeros(len(on), np.int64), np.zeros(len(on), np.float32)
    # One pair of uniforms per pixel: the first is the age of the interval or the place on the ladder of levels.
    first, second = uniform2(seed, pixels, np.uint64(Stream.START), np.uint64(0))
    if config.start == "balanced":
        # Triangular: the stationary position of a Brownian motion that returns to 0 at -1 and 1.
        place = first - second
        offset = (-place * np.where(place > 0, on, off)).astype(np.float32)
    if config.start != "stationary" or not (leak.size or config.shot_noise_rate_hz):
        return Start(offset, leak, dead_ns, age_ns, by_noise)
    shot = _shots_per_s(config, intensity, on, off)
    moving = np.flatnonzero(leak > 0) if leak.size else np.empty(0, np.int64)
    # between: mean time from one event to the next, s.
    between = np.where(shot > 0, 1.0 / np.maximum(shot, 1e-300), np.inf)
    leak = leak.copy()
    mean = on[moving].astype(np.float64) / leak[moving] if leak.size else np.empty(0)
    if moving.size:
        rate = shot[moving]
        # The mean time to the next event, of leak after T or shot noise before it: (1 - e^-RT)/R = T (1
        # - e^-q)/q, q = R T.
        weight = lambda time: time * _one_minus_exp_over(rate * time)
        # This is exact without jitter; with jitter the error is of second order in it.
        between[moving] = weight(mean)
        time = mean * _length_of_interval(config.leak_jitter, rate * mean, pixels[moving], seed)
        age = _age(first[moving], rate * time) * time
        # The signal has drifted from the reference by the share of the threshold that has leaked.
        offset[moving] = -(age / time * on[moving]).astype(np.float32)
        leak[moving] = (on[moving] / time).astype(np.float32)
        age_ns[moving] = np.minimum(age * 1e9, 2.0**61).astype(np.int64)
    if dead_ns.size:
        # The probability of the dead time is its share of the whole cycle.
        u, v = uniform2(seed, pixels, np.uint64(Stream.START), np.uint64(_TURNS))
        dead_s = config.refractory_us * 1e-6
        dead_ns = np.where(u * (dead_s + between) < dead_s, np.ceil(v * dead_s * 1e9), 0.0).astype(np.int64)
    if noise.size:
        # Where noise fires more often than leak: the rung next to its mean, or the last one that the noise has passed.
        often = np.ones(len(on), bool)
        often[moving] = mean * config.shot_noise_rate_hz > 1.0
        corner = corner_hz(intensity.astype(np.float64), config)
        place = start_places(config.shot_noise_rate_hz, corner, first) * np.where(first > 0.5, on, off)
        # Rungs, one threshold apart, that the noise has passed upwards and downwards.
        up, down = np.floor((noise - place) / on), np.floor((place - noise) / off)
        rung = place + np.maximum(up, 0.0) * on - np.maximum(down, 0.0) * off
        by_noise = np.where(often, rung - noise, 0.0).astype(np.float32)
        offset = np.where(often, by_noise, offset)
        age_ns[often] = 0
    return Start(offset, leak, dead_ns, age_ns, by_noise)


def _shots_per_s(config: V2eConfig, intensity: np.ndarray, on: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Return shot noise per second of both polarities: half the rate each, less in bright light, more at low
    thresholds."""
    if not config.shot_noise_rate_hz or config.photoreceptor_noise:
        return np.zeros(len(on))
    nominal_on, nominal_off = config.thresholds
    level = np.minimum((intensity.astype(np.float64) + 20.0) / 275.0, 1.0)
    each = nominal_on / on.astype(np.float64) + nominal_off / off.astype(np.float64)
    return 0.5 * config.shot_noise_rate_hz * (1.0 - 0.75 * level) * each


def _one_minus_exp_over(q: np.ndarray) -> np.ndarray:
    """Return (1 - e^-q)/q for q >= 0."""
    # The series (1 - q/2 + q^2/6) has the error q^3/24, below 5e-14 at this bound, where 1 - e^-q would lose digits.
    small = q < 1e-4
    safe = np.where(small, 1.0, q)
    return np.where(small, 1.0 - q * (0.5 - q / 6.0), (1.0 - exp_f64(-safe)) / safe)


def _age(uniform: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Draw an age a in (0, 1) of density e^-qa, by inverting its cumulative distribution."""
    # The inverse of F(a) = (1 - e^-qa)/(1 - e^-q), which tends to the uniform distribution for small q.
    small = q < 1e-6
    safe = np.where(small, 1.0, q)
    return np.where(small, uniform, np.minimum(-log_f64(1.0 - uniform * (1.0 - exp_f64(-safe))) / safe, 1.0))


def _length_of_interval(jitter: float, q: np.ndarray, pixels: np.ndarray, seed: np.uint64) -> np.ndarray:
    """Draw the lengths of the current leak intervals, in mean intervals. q : shot noise events per mean interval."""
    length = np.ones(len(q))
    if jitter == 0:
        return length
    # Rejection sampling: ``most`` is the largest value of the weight, at the longest interval.
    longest = 1.0 + jitter * _MOST_ROUGH
    most = longest * _one_minus_exp_over(q * longest)
    wanted = np.arange(len(q))
    # Rejection sampling keeps two of three at the largest jitter.
    for turn in range(_TURNS):
        if not wanted.size:
            break
        index = np.uint64(_JITTER_TURN + turn)
        # The normals' draw numbers follow those of the uniforms.
        normal = rough_normal(seed, pixels[wanted], np.uint64(Stream.START), np.uint64(index + _U2 * np.uint64(_TURNS)))
        tried = np.maximum(0.1, 1.0 + jitter * normal)
        u, _ = uniform2(seed, pixels[wanted], np.uint64(Stream.START), index)
        kept = u * most[wanted] < tried * _one_minus_exp_over(q[wanted] * tried)
        length[wanted[kept]] = tried[kept]
        wanted = wanted[~kept]
    return length


MAX_LEAK_HZ = 1e6
"""One event per microsecond, the resolution of event times."""


def draw_hot(height: int, width: int, config: V2eConfig, seed: np.uint64) -> np.ndarray:
    """Draw which pixels are hot, (H*W,) uint8."""
    which = lambda pixels: uniform2(seed, pixels, np.uint64(Stream.HOT), np.uint64(0))
    return (in_blocks(which, pixel_counters(height, width))[0] < config.hot_pixel_fraction).astype(np.uint8)


def draw_leaks(height: int, width: int, config: V2eConfig, on: np.ndarray, seed: np.uint64) -> np.ndarray:
    """Draw the drift of the comparator by leak, ln units per second, (H*W,) float32; empty when there is none.

    Log-normal over the pixels (v2e: 10^(cov N)); hot pixels: exponential around their mean rate.
    """
    if config.leak_rate_hz == 0 and config.hot_pixel_fraction == 0:
        return np.empty(0, np.float32)
    (leak,) = in_blocks(lambda pixels, on: (_leaks_of(config, pixels, on, seed),), pixel_counters(height, width), on)
    return leak


def _leaks_of(config: V2eConfig, pixels: np.ndarray, on: np.ndarray, seed: np.uint64) -> np.ndarray:
    """Return :func:`draw_leaks` of the pixels of these numbers."""
    spread, _ = normal2(seed, pixels, np.uint64(Stream.LEAK), np.uint64(0))
    # Log-normal tails of several decades exceed the resolution of event times, so the rate is limited. 10^(cov N) is
    # computed as a power of e.
    rate = np.minimum(config.leak_rate_hz * exp_f64(np.log(10.0) * config.leak_cov_decades * spread), MAX_LEAK_HZ)
    if config.hot_pixel_fraction:
        u, v = uniform2(seed, pixels, np.uint64(Stream.HOT), np.uint64(0))
        rate = np.where(u < config.hot_pixel_fraction, -log_f64(v) * config.hot_pixel_rate_hz, rate)
    leak = (rate * on).astype(np.float32)
    # Less than an event in 10^11 years becomes 0, so that no product is subnormal.
    leak[leak < 1e-20] = 0.0
    return leak
