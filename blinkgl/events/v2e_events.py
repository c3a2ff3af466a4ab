"""V2E's events: where the signal of a pixel meets a level in an interval, and its shot noise, pixel by pixel."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable

from blinkgl.events.packing import CAUSE_SHIFT, T_SHIFT, cause_of
from blinkgl.events.philox import Stream, rough_normal
from blinkgl.events.v2e_model import crossing_fraction, curve_of, signal_at
from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Cause

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
    keys: np.ndarray  # int64: its shot noise in the interval, sorted, see v2e_blocks.shot_block
    clock_ns: int  # of its next shot noise candidate
    clock_index: int


class Pixel(NamedTuple):
    """What stays the same for a pixel in an interval."""

    number: int
    offset: int  # in its block
    word: int  # its packed event (packing.py) without time, cause and polarity
    on: float  # thresholds, ln units
    off: float
    mean_leak: float  # ln units a second
    explained: bool  # whether its events have causes
    hot: bool  # whether its leak is a hot pixel's


class Curve(NamedTuple):
    """What the comparator sees, z(s) = c + rise s + fall e^{-k s} for the fraction s of the interval, float64."""

    c: float
    rise: float
    fall: float
    k: float  # time constants in the interval; below 0 without a low-pass
    end: float  # z(1)
    noise: float  # the photoreceptor noise in z at the start, and its change in the interval
    noise_change: float


class Comparator(NamedTuple):
    """The levels of a pixel and since when they hold. Times are ns from the interval's start."""

    s: float  # fraction of the interval at which the comparison goes on, and its time
    now_ns: int
    up: float
    down: float
    since_ns: int  # when the reference was taken, and the photoreceptor noise then
    noise_then: float


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
    # Local names: every ``p.x`` inside the loop would count references to the array, a microsecond per pixel in all.
    x, lag, intensity, noise = p.x, p.lag, p.intensity, p.noise
    upper, lower, constants, leaks, release = p.upper, p.lower, p.constants, p.leak, p.release
    since, noise_then, hot, keys = p.since_ns, p.noise_then, p.hot, at_end.keys
    intensity_end, x_end, lag_end, noise_end = at_end.intensity, at_end.x, at_end.lag, at_end.noise
    causes = since.size > 0
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
        waiting = release.size > 0 and upper[i] == -_INF
        if waiting and release[i] > v.t0_ns + v.dt_ns:
            continue
        o = i - first
        word = (y << 17) | ((i - row_end + v.width) << 1)
        pixel = _pixel(i, o, word, constants, causes, causes and hot[i] > 0)
        leak = np.float64(leaks[i]) if leaks.size else 0.0
        k = _time_constants(intensity[i], intensity_end[o], v.kappa) if lag.size else -1.0
        curve = _curve(_ends(x, x_end, i, o), _ends(lag, lag_end, i, o), _ends(noise, noise_end, i, o), k, leak, v)
        since_ns, noise_at = (since[i] - v.t0_ns, np.float64(noise_then[i])) if causes else (np.int64(0), 0.0)
        state = Comparator(0.0, np.int64(0), np.float64(upper[i]), np.float64(lower[i]), since_ns, noise_at)
        if waiting:
            # The signal at the end of the dead time is the new reference.
            now_ns = max(release[i] - v.t0_ns, 0)
            s = now_ns / v.dt_ns
            state = _restarted(pixel, curve, s, now_ns, _signal(curve, s))
        state, leak, dead, out, cut_here, key = _emit_pixel(pixel, curve, state, leak, v, cap, keys, key, packed, out)
        cut += cut_here
        # In a dead time both levels count as passed, so that the pixel is processed until its release.
        upper[i] = -_INF if dead else np.float32(state.up)
        lower[i] = _INF if dead else np.float32(state.down)
        if dead:
            release[i] = v.t0_ns + state.now_ns
        if v.leak_jitter > 0.0:
            leaks[i] = np.float32(leak)
        if causes:
            since[i], noise_then[i] = v.t0_ns + state.since_ns, np.float32(state.noise_then)
    return out, cut


@register_jitable(inline="always")
def _emit_pixel(pixel, curve, state, leak, v, cap, keys, key, packed, out):
    """Write the events of one pixel in the interval to ``packed[out:]``. Return (comparator at the end, leak at the
    end, whether the pixel is dead beyond the interval, end of the events, events beyond the cap, next key)."""
    # Start of the interval after the microsecond base, 0 to 999 ns.
    start_ns = v.t0_ns - 1000 * v.base_us
    emitted, cut, dead = 0, 0, False
    while not dead:
        # Shot noise before the comparison goes on fell into the dead time.
        while _time_of(keys, key, pixel.offset) < state.now_ns:
            key += 1
        kind, s, at_ns, polarity, level = _next_event(_time_of(keys, key, pixel.offset), v.dt_ns, curve, state)
        if kind == _NONE:
            break
        by_shot = kind == _BY_SHOT
        if by_shot:
            polarity = keys[key] & 1
            key += 1
        if emitted < cap:
            word = pixel.word | polarity
            if pixel.explained:
                # Parts of the change since the reference was taken, from which the cause is decided.
                by_leak = leak * ((at_ns - state.since_ns) * 1e-9)
                by_noise = curve.noise + curve.noise_change * s - state.noise_then
                word |= _cause(by_shot, pixel, polarity, by_leak, by_noise) << CAUSE_SHIFT
            packed[out] = (np.int64(_U(start_ns + at_ns) // _U1000) << T_SHIFT) | word
            out += 1
            emitted += 1
        else:
            cut += 1
        if v.leak_jitter > 0.0:
            # The reference stays; its value relative to the new drift changes.
            change = _drawn_leak(pixel.mean_leak, v.leak_jitter, v.seed, pixel.number, v.t0_ns + at_ns) - leak
            leak += change
            level += change * (v.since_epoch_0 + s * (v.dt_ns * 1e-9))
            curve = _with_leak(curve, change, v)
        if v.refractory_ns > 0:
            at_ns += v.refractory_ns
            dead = at_ns > v.dt_ns
            s = at_ns / v.dt_ns
        # After a dead time, and after shot noise, the reference is the signal itself.
        if v.refractory_ns > 0 or by_shot:
            level = _signal(curve, s)
        since_ns, noise_then = state.since_ns, state.noise_then
        state = _restarted(pixel, curve, s, at_ns, level)
        if dead:
            # The reference is taken at the release, in another interval.
            state = Comparator(s, at_ns, state.up, state.down, since_ns, noise_then)
    return state, leak, dead, out, cut, key


@register_jitable
def _ends(before, now, i, o):
    """Return a signal of pixel ``i`` at both ends of the interval; zeros for one that the model does without."""
    return (np.float64(before[i]), np.float64(now[o])) if before.size else (0.0, 0.0)


@register_jitable(inline="always")
def _pixel(number, offset, word, constants, explained, hot):
    """Return the :class:`Pixel` of these constants: ON threshold, OFF threshold, mean leak."""
    on, off = np.float64(constants[number, 0]), np.float64(constants[number, 1])
    mean_leak = np.float64(constants[number, 2])
    return Pixel(
        number=number,
        offset=offset,
        word=word,
        on=on,
        off=off,
        mean_leak=mean_leak,
        explained=explained,
        hot=hot,
    )


@register_jitable(inline="always")
def _time_constants(intensity, intensity_end, kappa):
    """Return the time constants of the low-pass in the interval, as in v2e_model.relax but in double precision."""
    return kappa * (0.5 * (np.float64(intensity) + np.float64(intensity_end)) + 20.0)


@register_jitable(inline="always")
def _curve(x, lag, noise, k, leak, v):
    """Return the :class:`Curve` of a pixel. x, lag, noise : at both ends; ``leak``, ln units a second, since the leak
    epoch."""
    noise_change, dx = noise[1] - noise[0], x[1] - x[0]
    base, drift = x[0] + noise[0] + leak * v.since_epoch_0, noise_change + leak * (v.dt_ns * 1e-9)
    c, rise, fall = curve_of(base, drift, dx, lag[0], k)
    end = base + drift + dx + lag[1]
    return Curve(c=c, rise=rise, fall=fall, k=k, end=end, noise=noise[0], noise_change=noise_change)


@register_jitable(inline="always")
def _with_leak(curve, change, v):
    """Return the curve with ``change`` more leak, ln units a second, since the leak epoch."""
    return Curve(
        c=curve.c + change * v.since_epoch_0,
        rise=curve.rise + change * (v.dt_ns * 1e-9),
        fall=curve.fall,
        k=curve.k,
        end=curve.end + change * v.since_epoch_1,
        noise=curve.noise,
        noise_change=curve.noise_change,
    )


@register_jitable(inline="always")
def _signal(curve, s):
    """Return what the comparator sees at the fraction ``s`` of the interval."""
    return signal_at(s, curve.c, curve.rise, curve.fall, curve.k)


@register_jitable(inline="always")
def _restarted(pixel, curve, s, now_ns, reference):
    """Return the comparator whose reference was taken at the fraction ``s``."""
    noise_then = curve.noise + curve.noise_change * s
    return Comparator(s, now_ns, reference + pixel.on, reference - pixel.off, now_ns, noise_then)


@register_jitable
def _next_event(shot_ns, dt_ns, curve, state):
    """Return (kind, fraction of the interval, ns from its start, polarity, level that is met) of a pixel's next event.

    shot_ns : of its next shot noise, or _NEVER_NS."""
    end, s = curve.end, state.s
    polarity, crosses = np.int64(end >= state.up), end >= state.up or end <= state.down
    kind, at_ns, level = _NONE, np.int64(0), 0.0
    if crosses:
        kind, level = _CROSSING, state.up if polarity else state.down
        s = crossing_fraction(s, level, polarity, curve.c, curve.rise, curve.fall, curve.k, end)
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
def _cause(by_shot, pixel, polarity, by_leak, by_noise):
    """Return the cause of an event. by_leak and by_noise : parts of the signal's change by a threshold since the
    reference was taken; light is the rest."""
    if by_shot:
        return _CAUSE_SHOT
    change = pixel.on if polarity else -pixel.off
    sign = 1.0 if change > 0 else -1.0
    cause = cause_of(sign * change - sign * by_leak - sign * by_noise, sign * by_leak, sign * by_noise)
    return _CAUSE_HOT if cause == _CAUSE_LEAK and pixel.hot else cause
