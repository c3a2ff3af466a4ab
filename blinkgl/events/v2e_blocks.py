"""V2E's loops over one block of pixels: photoreceptor, comparison, shot noise. They take slices and index them from 0,
see :mod:`blinkgl.events.packing`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import register_jitable

from blinkgl.events.arith import select
from blinkgl.events.bands import BLOCK
from blinkgl.events.philox import Stream, normal2, uniform2
from blinkgl.events.v2e_model import (
    DARKEST,
    lin_log,
    next_noise,
    noise_place,
    relax,
    shot_draw,
    shot_factor,
)
from blinkgl.machine.kernels import kernel

_F = np.float32
# Typed constants keep the loops in float32. _JOINT: the 20 DN that v2e adds to the intensity.
_ZERO, _HALF, _JOINT = _F(0), _F(0.5), _F(20.0)
_SHOT, _NOISE = np.uint64(Stream.SHOT), np.uint64(Stream.NOISE)
_U2, _U1 = np.uint64(2), np.uint64(1)
# Up to this many shot noise events are sorted by insertion. _FAR_BELOW is the smallest int32.
_INSERTION_LIMIT, _FAR_BELOW = 32, np.int32(-(2**31))
DRAWS = 16
"""Largest number of shot noise candidates drawn at once."""


@kernel(error_model="numpy")
def lin_log_block(intensity: np.ndarray, out: np.ndarray) -> None:
    """Set ``out[:]`` to the lin-log of ``intensity`` (DN)."""
    for i in range(intensity.size):
        out[i] = lin_log(intensity[i])


@kernel(error_model="numpy")
def relax_block(
    lag: np.ndarray,
    before: np.ndarray,
    now: np.ndarray,
    intensity_before: np.ndarray,
    intensity_now: np.ndarray,
    kappa: float,
    out: np.ndarray,
    z: np.ndarray,
) -> None:
    """Write the low-pass's lag at the interval's end to ``out``, and its output to ``z``."""
    # z = x + (y - x) is the low-pass's output y.
    for i in range(now.size):
        lag_now = relax(lag[i], before[i], now[i], intensity_before[i], intensity_now[i], kappa)
        out[i] = lag_now
        z[i] = now[i] + lag_now


@kernel(error_model="numpy")
def add_scaled_block(a: np.ndarray, scale: float, out: np.ndarray) -> None:
    """Set ``out[:] += a * scale``."""
    for i in range(a.size):
        out[i] += a[i] * scale


@kernel(error_model="numpy")
def noise_block(
    noise: np.ndarray,
    intensity_before: np.ndarray,
    intensity_now: np.ndarray,
    kappa: float,
    sizes: np.ndarray,
    seed: int,
    step: int,
    first: int,
    normals: np.ndarray,
    out: np.ndarray,
    z: np.ndarray,
) -> None:
    """Write the photoreceptor's noise at the interval's end to ``out``, and add it to ``z``.   normals : scratch, at
    least as long."""
    # Blocks begin at even pixels, so pairs do not straddle them.
    for j in range((out.size + 1) // 2):  # pixels 2j and 2j + 1 share a draw
        a, b = normal2(seed, np.uint64(first // 2 + j), _NOISE, np.uint64(step))
        normals[2 * j], normals[2 * j + 1] = np.float32(a), np.float32(b)
    for i in range(out.size):
        # k: time constants in the interval, of the mean intensity. The size is interpolated in ln k.
        k = np.float32(kappa * (_HALF * (intensity_before[i] + intensity_now[i]) + _JOINT))
        below, part = noise_place(k)
        size = np.float32(sizes[below] + part * (sizes[below + 1] - sizes[below]))
        value = np.float32(next_noise(noise[i], k, size, normals[i]))
        out[i] = value
        z[i] += value


@kernel(error_model="numpy")
def flag_block(z: np.ndarray, upper: np.ndarray, lower: np.ndarray, flags: np.ndarray) -> float:
    """Set flags (uint8) of the pixels at or beyond a level; return how far the farthest is beyond (negative: none
    is)."""
    farthest = _FAR_BELOW
    for i in range(z.size):
        # Levels of a pixel in its dead time are infinite: it is then always beyond.
        above, below = np.float32(z[i] - upper[i]), np.float32(lower[i] - z[i])
        beyond = np.float32(select(above > below, above, below))
        flags[i] = np.uint8(beyond >= _ZERO)
        # Floats >= 0 are ordered as their bits; this loop vectorises.
        farthest = max(farthest, beyond.view(np.int32))
    return np.int32(farthest).view(np.float32)


@kernel(error_model="numpy")
def _shot_draws(seed, block, index, rate_per_ns, gaps, picks, accepts):
    """Draw the candidates from number ``index`` on: more than needed, but in vector instructions."""
    for j in range(gaps.size):
        number = index + np.uint64(j)
        gaps[j], picks[j] = shot_draw(seed, block, number, rate_per_ns)
        # Odd: shot_draw has the even numbers.
        accepts[j], _ = uniform2(seed, block, _SHOT, number * _U2 + _U1)


@register_jitable(inline="always")
def _insert(keys, count, in_order, key):
    """Put ``key`` behind the first ``count`` keys, or in order among them, which then are sorted."""
    slot = count
    while in_order and slot > 0 and keys[slot - 1] > key:
        keys[slot] = keys[slot - 1]
        slot -= 1
    keys[slot] = key


@kernel(error_model="numpy")
def shot_block(
    block: int,
    pixels_in_block: int,
    p: Any,
    v: Any,
    intensity_now: np.ndarray,
    keys: np.ndarray,
    draws: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> tuple[int, int, int]:
    """Write the shot noise of one block in the interval to ``keys`` (pixel in block << 42 | ns from the interval's
    start << 1 | polarity), sorted. Return (events, time and number of the next candidate); -1 events when ``keys`` is
    too small."""
    # The clock stands at the next candidate, whose number is ``index``.
    count, first, end_ns = 0, block * BLOCK, v.t0_ns + v.dt_ns
    table = p.shot_table[block]
    whole = np.float64(table[table.size - 1])
    t_ns, index = p.clock_ns[block], p.clock_index[block]
    # A Poisson process of candidates for the whole block, at the rate of dark pixels, thinned below to the rate
    # at their intensities (Lewis and Shedler, Naval Research Logistics 26, 1979). One clock per block instead
    # of one per pixel.
    rate = v.shot_unit_per_ns * whole
    gaps, picks, accepts = draws
    # The expected number of candidates and two standard deviations more.
    expected = rate * v.dt_ns
    # The count is rounded up to whole vectors of four.
    wanted = min(gaps.size, (np.int64(min(expected + 2.0 * np.sqrt(expected), 1e6)) + 5) // 4 * 4)
    drawn = wanted
    while t_ns <= end_ns:
        if drawn == wanted:
            _shot_draws(v.seed, np.uint64(block), np.uint64(index), rate, gaps[:wanted], picks, accepts)
            drawn = 0
        gap, pick, accept = gaps[drawn], picks[drawn], accepts[drawn]
        drawn += 1
        # How many entries are <= weight. Weights are similar, so the proportional guess is a cache line away.
        weight, place = np.float32(pick * whole), np.int64(pick * table.size)
        while place > 0 and table[place - 1] > weight:
            place -= 1
        while place < table.size - 1 and table[place] <= weight:
            place += 1
        # The table holds the ON half of all pixels, then the OFF half.
        offset, on = place & (BLOCK - 1), place < BLOCK
        if offset < pixels_in_block:
            i = first + offset
            # Time after the interval's start and the intensity there, on the straight line
            # between the frames.
            after = max(t_ns - v.t0_ns, 0)
            intensity = p.intensity[i] + (intensity_now[offset] - p.intensity[i]) * (after / v.dt_ns)
            # Thinning: the candidate's rate is that of the dark, DARKEST.
            if accept * DARKEST < shot_factor(intensity):
                if count == keys.size:
                    # The caller doubles ``keys`` and repeats the block; draws have no state, so they are the same.
                    return -1, t_ns, index
                # A few keys are inserted in order; many are sorted at the end.
                _insert(keys, count, count < _INSERTION_LIMIT, (offset << 42) | (after << 1) | np.int64(on))
                count += 1
        index += 1
        t_ns += gap
    if count > _INSERTION_LIMIT:
        keys[:count].sort()
    return count, t_ns, index
