"""V2E's events of the pixels whose signal may meet a level in an interval, one pixel after the other."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba.extending import register_jitable

from blinkgl.events.packing import CAUSE_SHIFT, JIT, T_SHIFT, cause_of
from blinkgl.events.philox import Stream, rough_normal
from blinkgl.events.v2e_model import crossing_fraction, curve_of, signal_at
from blinkgl.types.events import Cause

_U = np.uint64
_U1000 = _U(1000)
_LEAK_JITTER = _U(Stream.LEAK_JITTER)
_CAUSE_LEAK, _CAUSE_SHOT, _CAUSE_HOT = int(Cause.LEAK), int(Cause.SHOT), int(Cause.HOT)
_INF = np.float32(np.inf)
_NEVER_NS = 2**62
_NANOSECONDS = 2**41 - 1  # bits 1 to 41 of a key: its time


@numba.njit(**JIT)
def emit(
    active: np.ndarray,
    first: int,
    now: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    keys: np.ndarray,
    p: Any,
    v: Any,
    cap: int,
    packed: np.ndarray,
    begin: int,
) -> tuple[int, int]:
    """Write the events of the listed pixels into ``packed[begin:]``, pixel by pixel, and move their levels.

    active : int32, in raster order.   first : the pixel that ``now`` and the keys count from.
    now : (intensity, x, lag, noise) at the interval's end.   keys : int64, shot noise in order, see ``shot_block``.
    p, v : Pixels and Interval of v2e.py.   cap : most events of a pixel; there is room for so many of each.
    Returns (end of the events, number of events beyond the cap)."""
    dt_ns, dt = v.dt_ns, v.dt_ns * 1e-9
    # Local names: every ``p.x`` inside the loop would count references to the array, a microsecond a pixel in all.
    x_before, lag_before, intensity_before, noise_before = p.x, p.lag, p.intensity, p.noise
    upper, lower, constants, leaks, release = p.upper, p.lower, p.constants, p.leak, p.release
    since, noise_at_reference, hot = p.since_ns, p.noise_then, p.hot
    low_pass, noisy, leaking = lag_before.size > 0, noise_before.size > 0, leaks.size > 0
    dead_time, told = release.size > 0, since.size > 0
    intensity_now, x_now, lag_now, noise_now = now
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
        noise, noise_change = 0.0, 0.0
        if noisy:
            noise = np.float64(noise_before[i])
            noise_change = np.float64(noise_now[o]) - noise
        x = np.float64(x_before[i])
        dx = np.float64(x_now[o]) - x
        # k: time constants in the interval, as in v2e_model.relax; below 0 without a low-pass.
        lag, lag_end, k = 0.0, 0.0, -1.0
        if low_pass:
            lag, lag_end = np.float64(lag_before[i]), np.float64(lag_now[o])
            k = v.kappa * (0.5 * (np.float64(intensity_before[i]) + np.float64(intensity_now[o])) + 20.0)
        base, drift = x + noise + leak * v.since_epoch_0, noise_change + leak * dt
        c, rise, fall = curve_of(base, drift, dx, lag, k)
        end = base + drift + dx + lag_end
        up, down = np.float64(upper[i]), np.float64(lower[i])
        noise_then, since_ns = 0.0, np.int64(0)
        if told:
            noise_then, since_ns = np.float64(noise_at_reference[i]), since[i] - v.t0_ns
        # Where the comparator looks from: as a fraction of the interval, and in ns from its start.
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
            polarity, crosses = np.int64(end >= up), end >= up or end <= down
            if not crosses and shot_ns == _NEVER_NS:
                break
            at_ns, reference = np.int64(0), 0.0
            if crosses:
                reference = up if polarity else down
                s = crossing_fraction(s, reference, polarity, c, rise, fall, k, end)
                at_ns = np.int64(s * dt_ns)
            # The earlier one is the event; at the same ns that is the noise.
            by_shot = shot_ns != _NEVER_NS and (not crosses or shot_ns <= at_ns)
            if by_shot:
                at_ns, polarity = shot_ns, keys[key] & 1
                s = at_ns / dt_ns
                key += 1
            if emitted < cap:
                word = bits | polarity
                if told:
                    by_leak = leak * ((at_ns - since_ns) * 1e-9)
                    by_noise = noise + noise_change * s - noise_then
                    word |= _cause(by_shot, hot[i], on if polarity else -off, by_leak, by_noise) << CAUSE_SHIFT
                packed[out] = (np.int64(_U(start_ns + at_ns) // _U1000) << T_SHIFT) | word
                out += 1
                emitted += 1
            else:
                cut += 1
            if v.leak_jitter > 0.0:
                # The number of the draw is the event's time in ns, so that it does not depend on how time was cut into
                # frames. The length of the next leak interval is normal around 1, at least a tenth; float32 as it is
                # stored.
                spread = 1.0 + v.leak_jitter * rough_normal(v.seed, _U(i), _LEAK_JITTER, _U(v.t0_ns + at_ns))
                drawn = np.float64(np.float32(np.float64(constants[i, 2]) / max(spread, 0.1)))
                # The reference stays where it is; its value relative to the new drift changes.
                change = drawn - leak
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
        # In a dead time both levels are passed, whatever comes: the pixel is looked at until it is released.
        upper[i] = -_INF if dead else np.float32(up)
        lower[i] = _INF if dead else np.float32(down)
        if dead:
            release[i] = v.t0_ns + now_ns
        if v.leak_jitter > 0.0:
            leaks[i] = np.float32(leak)
        if told:
            since[i], noise_at_reference[i] = v.t0_ns + since_ns, np.float32(noise_then)
    return out, cut


@register_jitable
def _time_of(keys, key, o):
    """Return when shot noise ``key`` is, ns from the interval's start; _NEVER_NS if it is not of the pixel at ``o``."""
    if key < keys.size and keys[key] >> 42 == o:
        return (keys[key] >> 1) & _NANOSECONDS
    return _NEVER_NS


@register_jitable
def _cause(by_shot, hot, change, by_leak, by_noise):
    """Return the cause of an event. change : how far the signal has moved since the reference was taken, by_leak and
    by_noise of it by these; light is the rest."""
    if by_shot:
        return _CAUSE_SHOT
    sign = 1.0 if change > 0 else -1.0
    cause = cause_of(sign * change - sign * by_leak - sign * by_noise, sign * by_leak, sign * by_noise)
    return _CAUSE_HOT if cause == _CAUSE_LEAK and hot else cause
