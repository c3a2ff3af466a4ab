"""V2E's loops over one block of pixels: photoreceptor, comparison, shot noise. They take slices and index them from 0,
see :mod:`blinkgl.events.packing`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable

from blinkgl.events.arith import select
from blinkgl.events.bands import BLOCK
from blinkgl.events.packing import CAUSE_SHIFT, T_SHIFT, cause_of
from blinkgl.events.philox import Stream, normal2, rough_normal, uniform2
from blinkgl.events.v2e_model import (
    DARKEST,
    crossing_fraction,
    curve_of,
    lin_log,
    next_noise,
    noise_place,
    relax,
    shot_draw,
    shot_factor,
    signal_at,
)
from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Cause

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
                key = (offset << 42) | (after << 1) | np.int64(on)
                slot = count
                # A few keys are inserted in order; many are sorted at the end.
                if count < _INSERTION_LIMIT:
                    while slot > 0 and keys[slot - 1] > key:
                        keys[slot] = keys[slot - 1]
                        slot -= 1
                keys[slot] = key
                count += 1
        index += 1
        t_ns += gap
    if count > _INSERTION_LIMIT:
        keys[:count].sort()
    return count, t_ns, index


# ---------------------------------------------------------------------------------------------------------------------
# V2E's events of the pixels whose signal may meet a level in an interval, pixel by pixel.

_U = np.uint64
_U1000 = _U(1000)
_LEAK_JITTER = _U(Stream.LEAK_JITTER)
_CAUSE_LEAK, _CAUSE_SHOT, _CAUSE_HOT = int(Cause.LEAK), int(Cause.SHOT), int(Cause.HOT)
_INF = np.float32(np.inf)
_NEVER_NS = 2**62
_NONE, _CROSSING, _BY_SHOT = 0, 1, 2
_NANOSECONDS = 2**41 - 1  # bits 1 to 41 of a key: its time


class End(NamedTuple):
    """State of one block at the interval's end, as in :class:`~blinkgl.events.v2e.Pixels`."""

    intensity: np.ndarray
    x: np.ndarray
    lag: np.ndarray
    noise: np.ndarray
    keys: np.ndarray  # int64: its shot noise in the interval, sorted, see shot_block
    clock_ns: int  # of its next shot noise candidate
    clock_index: int


@kernel(error_model="numpy")
def emit(
    active: np.ndarray,
    first: int,
    at_end: End,
    p: Any,
    v: Any,
    cap: int,
    packed: np.ndarray,
    begin: int,
) -> tuple[int, int]:
    """Write the events of the listed pixels to ``packed[begin:]``, pixel by pixel, and move their levels.

    active : int32, in raster order.   first : the pixel that the block's arrays and keys count from.
    p, v : Pixels and Interval of v2e.py.   cap : most events of a pixel; there is room for as many of each. Returns
    (end of the events, number of events beyond the cap)."""
    dt_ns, dt = v.dt_ns, v.dt_ns * 1e-9
    # Local names: every ``p.x`` inside the loop would count references to the array, a microsecond per pixel in all.
    x_before, lag_before, intensity_before, noise_before = p.x, p.lag, p.intensity, p.noise
    upper, lower, constants, leaks, release = p.upper, p.lower, p.constants, p.leak, p.release
    since, noise_at_reference, hot = p.since_ns, p.noise_then, p.hot
    low_pass, leaking = lag_before.size > 0, leaks.size > 0
    dead_time, causes = release.size > 0, since.size > 0
    intensity_now, x_now, lag_now, noise_now = at_end.intensity, at_end.x, at_end.lag, at_end.noise
    keys = at_end.keys
    # Start of the interval after the microsecond base, 0 to 999 ns.
    start_ns = v.t0_ns - 1000 * v.base_us
    out, cut, key = begin, 0, 0
    y = first // v.width
    row_end = (y + 1) * v.width
    for j in range(active.size):
        i = np.int64(active[j])
        while i >= row_end:
            y += 1
            row_end += v.width
        # Keys are in the order of their pixels; those before belong to pixels in their dead time.
        while key < keys.size and first + (keys[key] >> 42) < i:
            key += 1
        waiting = dead_time and upper[i] == -_INF
        if waiting and release[i] > v.t0_ns + dt_ns:
            continue
        # The packed word (packing.py) without its time, cause and polarity.
        bits = (y << 17) | ((i - row_end + v.width) << 1)
        o = i - first
        on, off = np.float64(constants[i, 0]), np.float64(constants[i, 1])
        leak = np.float64(leaks[i]) if leaking else 0.0
        noise, noise_end = _ends(noise_before, noise_now, i, o)
        noise_change = noise_end - noise
        x, x_end = _ends(x_before, x_now, i, o)
        dx = x_end - x
        # k: time constants in the interval, as in v2e_model.relax; below 0 without a low-pass.
        (lag, lag_end), k = _ends(lag_before, lag_now, i, o), -1.0
        if low_pass:
            k = v.kappa * (0.5 * (np.float64(intensity_before[i]) + np.float64(intensity_now[o])) + 20.0)
        base, drift = x + noise + leak * v.since_epoch_0, noise_change + leak * dt
        c, rise, fall = curve_of(base, drift, dx, lag, k)
        end = base + drift + dx + lag_end
        up, down = np.float64(upper[i]), np.float64(lower[i])
        noise_then, since_ns = 0.0, np.int64(0)
        if causes:
            noise_then, since_ns = np.float64(noise_at_reference[i]), since[i] - v.t0_ns
        # Start of the comparison: as a fraction of the interval, and in ns from its start.
        s, now_ns = 0.0, np.int64(0)
        if waiting:
            # The signal at the end of the dead time is the new reference.
            now_ns = max(release[i] - v.t0_ns, 0)
            s = now_ns / dt_ns
            reference = signal_at(s, c, rise, fall, k)
            up, down = reference + on, reference - off
            since_ns, noise_then = now_ns, noise + noise_change * s
        emitted, dead = 0, False
        while not dead:
            # Shot noise before ``now_ns`` fell into the dead time.
            while _time_of(keys, key, o) < now_ns:
                key += 1
            shot_ns = _time_of(keys, key, o)
            kind, s, at_ns, polarity, reference = _next_event(shot_ns, dt_ns, s, c, rise, fall, k, end, up, down)
            if kind == _NONE:
                break
            by_shot = kind == _BY_SHOT
            if by_shot:
                polarity = keys[key] & 1
                key += 1
            if emitted < cap:
                # A packed word (packing.py); the time is added below.
                word = bits | polarity
                if causes:
                    # Parts of the change since the reference was taken, from which the cause is decided.
                    by_leak = leak * ((at_ns - since_ns) * 1e-9)
                    by_noise = noise + noise_change * s - noise_then
                    word |= _cause(by_shot, hot[i], on if polarity else -off, by_leak, by_noise) << CAUSE_SHIFT
                packed[out] = (np.int64(_U(start_ns + at_ns) // _U1000) << T_SHIFT) | word
                out += 1
                emitted += 1
            else:
                cut += 1
            if v.leak_jitter > 0.0:
                # The reference stays; its value relative to the new drift changes.
                change = _drawn_leak(np.float64(constants[i, 2]), v.leak_jitter, v.seed, i, v.t0_ns + at_ns) - leak
                leak += change
                reference += change * (v.since_epoch_0 + s * dt)
                c += change * v.since_epoch_0
                rise += change * dt
                end += change * v.since_epoch_1
            now_ns = at_ns
            if dead_time:
                now_ns += v.refractory_ns
                dead = now_ns > dt_ns
                s = now_ns / dt_ns
            # After a dead time, and after shot noise, the reference is the signal itself.
            if dead_time or by_shot:
                reference = signal_at(s, c, rise, fall, k)
            up, down = reference + on, reference - off
            if not dead:
                since_ns, noise_then = now_ns, noise + noise_change * s
        # In a dead time both levels count as passed, so that the pixel is processed until its release.
        upper[i] = -_INF if dead else np.float32(up)
        lower[i] = _INF if dead else np.float32(down)
        if dead:
            release[i] = v.t0_ns + now_ns
        if v.leak_jitter > 0.0:
            leaks[i] = np.float32(leak)
        if causes:
            since[i], noise_at_reference[i] = v.t0_ns + since_ns, np.float32(noise_then)
    return out, cut


@register_jitable
def _ends(before, now, i, o):
    """Return a signal of pixel ``i`` at both ends of the interval; zeros for one that the model does without."""
    return (np.float64(before[i]), np.float64(now[o])) if before.size else (0.0, 0.0)


@register_jitable
def _next_event(shot_ns, dt_ns, s, c, rise, fall, k, end, up, down):
    """Return (kind, fraction of the interval, ns from its start, polarity, level that is met) of a pixel's next event.

    shot_ns : of its next shot noise, or _NEVER_NS.   s : fraction from which the signal (c, rise, fall, k; at last
    ``end``) is compared with the levels ``up`` and ``down``."""
    polarity, crosses = np.int64(end >= up), end >= up or end <= down
    kind, at_ns, level = _NONE, np.int64(0), 0.0
    if crosses:
        kind, level = _CROSSING, up if polarity else down
        s = crossing_fraction(s, level, polarity, c, rise, fall, k, end)
        at_ns = np.int64(s * dt_ns)
    # The earlier one is the event; at the same ns that is the noise.
    if shot_ns != _NEVER_NS and (not crosses or shot_ns <= at_ns):
        return _BY_SHOT, shot_ns / dt_ns, shot_ns, polarity, level
    return kind, s, at_ns, polarity, level


@register_jitable
def _drawn_leak(nominal, jitter, seed, pixel, at_ns):
    """Return the leak, ln units a second, until the next event. The number of the draw is the event's time, so that it
    does not depend on the frame times; the interval is normal around 1, at least a tenth; float32 as it is stored."""
    spread = 1.0 + jitter * rough_normal(seed, _U(pixel), _LEAK_JITTER, _U(at_ns))
    return np.float64(np.float32(nominal / max(spread, 0.1)))


@register_jitable
def _time_of(keys, key, o):
    """Return the time of shot noise ``key``, ns from the interval's start; _NEVER_NS if it is not of the pixel at
    ``o``."""
    # A key: the pixel from bit 42 up, the time from bit 1, the polarity in bit 0.
    if key < keys.size and keys[key] >> 42 == o:
        return (keys[key] >> 1) & _NANOSECONDS
    return _NEVER_NS


@register_jitable
def _cause(by_shot, hot, change, by_leak, by_noise):
    """Return the cause of an event. change : of the signal since the reference was taken; by_leak and by_noise : parts
    of it; light is the rest."""
    if by_shot:
        return _CAUSE_SHOT
    sign = 1.0 if change > 0 else -1.0
    cause = cause_of(sign * change - sign * by_leak - sign * by_noise, sign * by_leak, sign * by_noise)
    return _CAUSE_HOT if cause == _CAUSE_LEAK and hot else cause
