"""V2E's events of one block of pixels, all pixels at once: their first events together, then their second ones, ...

Which pixels fire, how often, and what of dead time, leak and noise comes in between, nobody can predict: pixel by pixel
these questions are branches that a processor guesses wrongly, which costs more than the arithmetic. So the quantities
of the firing pixels of a block are gathered into rows, and each question is asked of a whole row by a loop without
branches, which the compiler turns into vector instructions. A wave is one event of every pixel that has one; those that
have another go on into the next. In the end the events are put back into raster order.

Rows are pieces of two flat arrays (``floats``, ``ints``), at distances that are known when compiling: the compiler then
sees that no row overlaps another, however many of them a loop works on. Indices are unsigned: negative ones would count
from the end, and asking costs the vector instructions.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba.extending import register_jitable

from blinkgl.events.arith import fall_f64, select
from blinkgl.events.packing import CAUSE_SHIFT, JIT, T_SHIFT, cause_of
from blinkgl.events.philox import Stream, rough_normal
from blinkgl.events.v2e_model import signal_at
from blinkgl.types.events import Cause

_U = np.uint64
_U0, _U1, _U1000 = _U(0), _U(1), _U(1000)
SLOTS = 256
"""Pixels that are taken in one go: their rows stay in the first cache."""
_WIDE = _U(32)
"""Loops over rows go on to a multiple of it, over whatever stands there: what is left over from unrolled vector loops
is otherwise done one by one, and that would be most of it."""
_STRIDE = SLOTS + 8  # with SLOTS alone, a power of two, all rows would want the same lines of the cache
_ROWS = [_U(_STRIDE * row) for row in range(22)]
# z(s) = C + RISE s + FALL e^(-K s), END at s = 1; S: where the pixel's comparator looks from; E: e^(-K S) there.
_C, _RISE, _FALL, _K, _END, _S, _E, _UP, _DOWN, _ON, _OFF, _LEAK, _MEAN_LEAK, _NOISE_THEN = _ROWS[:14]
_TARGET, _SIGN, _AT, _DRAW = _ROWS[14:18]  # of the wave's event: the level that is met, 1 or -1, s, a random number
_X0, _X1, _LAG0, _LAG1, _I0, _I1, _NOISE, _SHIFT = (
    _END,
    _S,
    _FALL,
    _E,
    _K,
    _TARGET,
    _C,
    _RISE,
)  # before the curve is made of them
_KEPT = 14  # rows that go on into the next wave
# Of those that wake up and fire, until the rows of all that fire are made: levels, S and E.
_WOKEN_UP, _WOKEN_DOWN, _WOKEN_S, _WOKEN_E = _ROWS[18:22]
_LOWER, _UPPER = _WOKEN_UP, _WOKEN_DOWN  # later: the bracket of the crossing
_OF_A_TURN = (_C, _RISE, _FALL, _K, _TARGET, _SIGN, _AT, _LOWER, _UPPER)
FLOATS = 2 * 22 * _STRIDE  # the second half for those that want more turns
_TURNS = 60
# The pixel; its bits of a packed event; ns of S; place of its next shot noise; ns of its
# reference; its number in the first wave.
_PIXEL, _BITS, _NOW, _SHOT, _SINCE, _SLOT = _ROWS[:6]
_FIRES, _OPEN, _AT_NS, _POLARITY, _BY_NOISE = _ROWS[6:11]  # of the wave's event
_COUNT = _AGAIN = _OPEN
_DEAD = _BY_NOISE  # once the event is written
_KEPT_INTS = 6
# Pixels that are not in their dead time, and that wake up; of those that wake up and fire: the pixel, NOW, their place.
_AWAKE, _WAKING, _WOKEN, _WOKEN_NOW, _WOKEN_SLOT = _ROWS[11:16]
_LISTED = _AWAKE  # later: those that want another turn
INTS = 2 * 16 * _STRIDE
_LEAK_JITTER = _U(Stream.LEAK_JITTER)
_CAUSE_LEAK, _CAUSE_SHOT, _CAUSE_HOT = int(Cause.LEAK), int(Cause.SHOT), int(Cause.HOT)
_MASK41, _INF = 2**41 - 1, np.float32(np.inf)
# 0x433 << 52 is the exponent field of 2^52: from there on a float64's fraction is the integer itself.
_TWO52, _BITS52, _LOW52 = np.float64(2.0**52), np.int64(0x433 << 52), np.int64(2**52 - 1)


@register_jitable(inline="always")
def _number(ns):
    """Return an int64 of 0 to 2^52 - 1 as float64, by its bits beside the exponent of 2^52. (The conversion itself
    is no vector instruction before AVX-512.)"""
    return np.int64(ns | _BITS52).view(np.float64) - _TWO52


@register_jitable(inline="always")
def _whole(x):
    """Return a float64 of 0 to 2^52 - 1 as int64 without its fraction, in the same way."""
    return np.float64(np.floor(x) + _TWO52).view(np.int64) & _LOW52


@numba.njit(**JIT)
def _curves(floats, count, kappa, since, dt, low_pass):
    """Compute the rows C, RISE, FALL, K and END (see curve_of) from the gathered ones, with S = 0."""
    if low_pass:
        # The rows that were gathered share memory with those of the curve: all are read before the
        # first is written.
        for j in range(count):
            x, shift, leak = floats[j + _X0], floats[j + _SHIFT], floats[j + _LEAK]
            dx = floats[j + _X1] - x
            # Time constants in the interval, as in v2e_model.relax; ``behind`` is how far a low-pass
            # stays behind a ramp.
            k = kappa * (0.5 * (floats[j + _I0] + floats[j + _I1]) + 20.0)
            behind = dx / k
            base, drift = x + floats[j + _NOISE] + leak * since, shift + leak * dt
            end = base + drift + dx + floats[j + _LAG1]
            floats[j + _C] = base - behind
            floats[j + _RISE] = drift + dx
            floats[j + _FALL] = floats[j + _LAG0] + behind
            floats[j + _K] = k
            floats[j + _END] = end
            floats[j + _S] = 0.0
            floats[j + _E] = 1.0
    else:
        for j in range(count):
            x, shift, leak = floats[j + _X0], floats[j + _SHIFT], floats[j + _LEAK]
            dx = floats[j + _X1] - x
            base, drift = x + floats[j + _NOISE] + leak * since, shift + leak * dt
            floats[j + _C] = base
            floats[j + _RISE] = drift + dx
            floats[j + _FALL] = 0.0
            # K < 0 says that there is no low-pass, as in v2e_model.curve_of.
            floats[j + _K] = -1.0
            floats[j + _END] = base + drift + dx
            floats[j + _S] = 0.0
            floats[j + _E] = 1.0


@numba.njit(**JIT)
def _wake(floats, ints, count, dt_ns):
    """Set the levels of pixels whose dead time ends in the interval, from the signal at that time (NOW)."""
    for j in range(count):
        # The dead time's end as a fraction of the interval; the signal there is the new reference.
        s = _number(ints[j + _NOW]) / dt_ns
        e = fall_f64(floats[j + _K] * s)
        reference = floats[j + _C] + floats[j + _RISE] * s + floats[j + _FALL] * e
        floats[j + _S] = s
        floats[j + _E] = e
        floats[j + _UP] = reference + floats[j + _ON]
        floats[j + _DOWN] = reference - floats[j + _OFF]


@numba.njit(**JIT)
def _wake_lines(floats, ints, count, dt_ns):
    for j in range(count):
        s = _number(ints[j + _NOW]) / dt_ns
        reference = floats[j + _C] + floats[j + _RISE] * s
        floats[j + _S] = s
        floats[j + _UP] = reference + floats[j + _ON]
        floats[j + _DOWN] = reference - floats[j + _OFF]


@numba.njit(**JIT)
def _aim(floats, ints, count):
    """Find the level that each pixel reaches by the interval's end, if any (TARGET, SIGN, POLARITY, FIRES)."""
    for j in range(count):
        # At most one of both levels has been reached, so one target is enough.
        end, up, down = floats[j + _END], floats[j + _UP], floats[j + _DOWN]
        above = end >= up
        floats[j + _TARGET] = select(above, up, down)
        floats[j + _SIGN] = select(above, 1.0, -1.0)
        ints[j + _POLARITY] = np.int64(above)
        ints[j + _FIRES] = np.int64(above | (end <= down))


# crossing_fraction for all at once: its guess, a turn of its loop, and more turns for those that want them, one in ten.


@numba.njit(**JIT)
def _guess(floats, ints, count):
    """Estimate where the signal meets the level (AT) by an inverse cubic; OPEN is 1 where the signal is beyond the
    level at the start."""
    for j in range(count):
        c, rise, fall, k = floats[j + _C], floats[j + _RISE], floats[j + _FALL], floats[j + _K]
        low, e_low, target, sign = floats[j + _S], floats[j + _E], floats[j + _TARGET], floats[j + _SIGN]
        end = floats[j + _END]
        # f is negative before the crossing and 0 at it, for either sign; v is its slope. At s = 1 fall
        # e^-k is end - c - rise.
        f_low = sign * (c + rise * low + fall * e_low - target)
        f_high = sign * (end - target)
        v_low, v_high = sign * (rise - k * fall * e_low), sign * (rise - k * (end - c - rise))
        width, height = 1.0 - low, f_high - f_low
        # u: where the chord meets the level. guess: the cubic that has the slopes 1/v, as in
        # crossing_fraction.
        u = -f_low / height
        s = low + width * u
        stretch = height / (width * v_low * v_high)
        guess = u * ((1.0 - u) * stretch * ((1.0 - u) * v_high - u * v_low) + u * (3.0 - 2.0 * u))
        floats[j + _AT] = select((v_low > 0) & (v_high > 0) & (guess > 0.0) & (guess < 1.0), low + width * guess, s)
        ints[j + _OPEN] = np.int64(f_low >= 0)


@register_jitable(inline="always")
def _turn(s, low, high, target, sign, c, rise, fall, k):
    """Return (s, bracket, whether s is accurate enough) after a Newton step, or after a bisection where that leaves
    the bracket."""
    # The bracket shrinks to s on the side on which f says that it lies.
    e = fall * fall_f64(k * s)
    f = sign * (c + rise * s + e - target)
    slope = sign * (rise - k * e)
    following = s - f / slope
    low, high = select(f < 0, s, low), select(f < 0, high, s)
    newton = (slope > 0) & (low <= following) & (following <= high)
    following = select(newton, following, 0.5 * (low + high))
    moved = abs(following - s)
    # After a Newton step the error is moved^2 |z''| / (2 z'): done where that is below 1e-6 of the
    # interval.
    return following, low, high, (newton & (moved * moved * k * k * abs(e) <= 2e-6 * slope)) | (moved < 1e-9)


@numba.njit(**JIT)
def _first_turn(floats, ints, count):
    """Improve the guess once: set AT, LOWER and UPPER, and OPEN where another step is needed."""
    for j in range(count):
        # Beyond the level to begin with: the event is at S.
        low, at_once = floats[j + _S], ints[j + _OPEN] != 0
        s, lower, upper, done = _turn(
            floats[j + _AT], low, 1.0, floats[j + _TARGET], floats[j + _SIGN],
            floats[j + _C], floats[j + _RISE], floats[j + _FALL], floats[j + _K],
        )  # fmt: skip
        floats[j + _AT] = select(at_once, low, s)
        floats[j + _LOWER], floats[j + _UPPER] = lower, upper
        ints[j + _OPEN] = np.int64((ints[j + _FIRES] != 0) & (not (at_once | done)))


@numba.njit(**JIT)
def _another_turn(floats, ints, count):
    for j in range(count):
        s, lower, upper, done = _turn(
            floats[j + _AT], floats[j + _LOWER], floats[j + _UPPER], floats[j + _TARGET], floats[j + _SIGN],
            floats[j + _C], floats[j + _RISE], floats[j + _FALL], floats[j + _K],
        )  # fmt: skip
        floats[j + _AT], floats[j + _LOWER], floats[j + _UPPER] = s, lower, upper
        ints[j + _OPEN] = np.int64(not done)


@numba.njit(**JIT)
def _meet(floats, ints, count, wide):
    """Compute AT, the time of the crossing, of the pixels that fire."""
    _guess(floats, ints, wide)
    _first_turn(floats, ints, wide)
    # Those that want more turns are listed, and their rows copied together into the second half of both
    # arrays.
    left = _U0
    for j in range(count):
        ints[left + _LISTED] = j
        left += _U(ints[j + _OPEN])
    more, more_ints = floats[FLOATS // 2 :], ints[INTS // 2 :]
    for m in range(left):
        j = _U(ints[m + _LISTED])
        for row in _OF_A_TURN:
            more[m + row] = floats[j + row]
    for _ in range(_TURNS - 1):
        if left == _U0:
            break
        _another_turn(more, more_ints, _wide(left))
        kept = _U0
        # The crossing goes back to its pixel after every turn; those that still want more move
        # together.
        for m in range(left):
            j = ints[m + _LISTED]
            floats[_U(j) + _AT] = more[m + _AT]
            if more_ints[m + _OPEN]:
                ints[kept + _LISTED] = j
                for row in _OF_A_TURN:
                    more[kept + row] = more[m + row]
                kept += _U1
        left = kept


@register_jitable
def _wide(count):
    # The next multiple of _WIDE.
    return (count + _WIDE - _U1) // _WIDE * _WIDE


@numba.njit(**JIT)
def _meet_lines(floats, ints, count):
    for j in range(count):
        # max and min by select, which holds 0/0 (a signal that stands on its level) to S.
        s = (floats[j + _TARGET] - floats[j + _C]) / floats[j + _RISE]
        s = select(s > floats[j + _S], s, floats[j + _S])
        floats[j + _AT] = select(s < 1.0, s, 1.0)


@numba.njit(**JIT)
def _draw_leaks(floats, ints, count, seed, t0_ns):
    for j in range(count):
        # The draw's number is the event's time in ns, so that it does not depend on how time was cut
        # into frames.
        floats[j + _DRAW] = rough_normal(seed, _U(ints[j + _PIXEL]), _LEAK_JITTER, _U(t0_ns + ints[j + _AT_NS]))


@numba.njit(**JIT)
def _change_leaks(floats, ints, count, jitter, since_0, since_1, dt):
    """Draw a new leak after every event, and move the rest of the curve to the new drift."""
    for j in range(count):
        leak = floats[j + _LEAK]
        # The length of the next leak interval is normal around 1, at least a tenth; float32 as it will
        # be stored.
        spread = 1.0 + jitter * floats[j + _DRAW]
        drawn = np.float64(np.float32(floats[j + _MEAN_LEAK] / select(spread > 0.1, spread, 0.1)))
        change = select(ints[j + _FIRES] != 0, drawn - leak, 0.0)
        floats[j + _LEAK] = leak + change
        # The reference stays where it is; its value relative to the new drift changes.
        floats[j + _TARGET] += change * (since_0 + floats[j + _AT] * dt)
        floats[j + _C] += change * since_0
        floats[j + _RISE] += change * dt
        floats[j + _END] += change * since_1


@numba.njit(**JIT)
def _reference_after_dead_time(floats, ints, count, dt_ns):
    for j in range(count):
        # NOW may lie beyond the interval: the pixel is then dead, and its levels are not used.
        fires, s = ints[j + _FIRES] != 0, _number(ints[j + _NOW]) / dt_ns
        e = fall_f64(floats[j + _K] * s)
        floats[j + _TARGET] = floats[j + _C] + floats[j + _RISE] * s + floats[j + _FALL] * e
        floats[j + _S] = select(fires, s, floats[j + _S])
        floats[j + _E] = select(fires, e, floats[j + _E])


@numba.njit(**JIT)
def _reference_of_lines_after_dead_time(floats, ints, count, dt_ns):
    for j in range(count):
        fires, s = ints[j + _FIRES] != 0, _number(ints[j + _NOW]) / dt_ns
        floats[j + _TARGET] = floats[j + _C] + floats[j + _RISE] * s
        floats[j + _S] = select(fires, s, floats[j + _S])


@numba.njit(**JIT)
def _look_again(floats, count):
    """Compute E at S."""
    for j in range(count):
        floats[j + _E] = fall_f64(floats[j + _K] * floats[j + _S])


@numba.njit(**JIT)
def _set_levels(floats, ints, count):
    # Levels one threshold from the reference, of those that fired; the others keep theirs.
    for j in range(count):
        fires, reference = ints[j + _FIRES] != 0, floats[j + _TARGET]
        floats[j + _UP] = select(fires, reference + floats[j + _ON], floats[j + _UP])
        floats[j + _DOWN] = select(fires, reference - floats[j + _OFF], floats[j + _DOWN])


@numba.njit(**JIT)
def _go_on(floats, ints, wide, left, noise_end, dt_ns, dead_time):
    """Find which pixels that fired are in their dead time at the interval's end (DEAD) and which have another event
    (AGAIN). Return whether any has."""
    if dead_time:
        for j in range(wide):
            ints[j + _DEAD] = np.int64((ints[j + _FIRES] != 0) & (ints[j + _NOW] > dt_ns))
    else:
        for j in range(wide):
            ints[j + _DEAD] = 0
    # Another event follows if the end of the curve is beyond a level, or shot noise of the pixel is
    # left.
    for j in range(wide):
        end = floats[j + _END]
        passed = (end >= floats[j + _UP]) | (end <= floats[j + _DOWN]) | (ints[j + _SHOT] != noise_end)
        ints[j + _AGAIN] = np.int64((ints[j + _FIRES] != 0) & (ints[j + _DEAD] == 0) & passed)
    any_again = np.int64(0)
    for j in range(left):
        any_again |= ints[j + _AGAIN]
    return any_again != 0


@numba.njit(**JIT)
def _put_back(floats, ints, count, first, noise_now, dead_time, p, v):
    """Write levels and changed state of all pixels back; pixels with another event are written again after it."""
    for j in range(count):
        i, dead = _U(ints[j + _PIXEL]), ints[j + _DEAD] != 0
        # In a dead time both levels are passed, whatever comes: the pixel is looked at until it is released.
        p.upper[i] = select(dead, -_INF, np.float32(floats[j + _UP]))
        p.lower[i] = select(dead, _INF, np.float32(floats[j + _DOWN]))
    if v.leak_jitter > 0.0:
        for j in range(count):
            p.leak[_U(ints[j + _PIXEL])] = np.float32(floats[j + _LEAK])
    if dead_time:
        for j in range(count):
            i = _U(ints[j + _PIXEL])
            p.release[i] = select(ints[j + _DEAD] != 0, v.t0_ns + ints[j + _NOW], p.release[i])
    if p.since_ns.size:
        for j in range(count):
            i = _U(ints[j + _PIXEL])
            # The causes' clock begins anew with the reference.
            if ints[j + _FIRES] != 0 and ints[j + _DEAD] == 0:
                ints[j + _SINCE] = ints[j + _NOW]
                floats[j + _NOISE_THEN] = _noise_at(floats, ints, j, floats[j + _S], first, noise_now, p)
            p.since_ns[i] = v.t0_ns + ints[j + _SINCE]
            p.noise_then[i] = np.float32(floats[j + _NOISE_THEN])


@numba.njit(**JIT)
def _keep(floats, ints, count):
    """Move the rows of pixels with another event together and return their number."""
    # Compaction: rows move forwards only, so none is overwritten before it is read.
    kept = _U0
    for j in range(count):
        if ints[j + _AGAIN]:
            for row in range(_KEPT):
                floats[kept + _U(_STRIDE * row)] = floats[j + _U(_STRIDE * row)]
            for row in range(_KEPT_INTS):
                ints[kept + _U(_STRIDE * row)] = ints[j + _U(_STRIDE * row)]
            kept += _U1
    return kept


@numba.njit(**JIT)
def _part(active, p, v, ints):
    """Split the list into pixels outside their dead time (AWAKE) and pixels whose dead time ends in the interval
    (WAKING), and return both numbers. The others are left out."""
    awake, asleep, waking, end_ns = _U0, _U0, _U0, v.t0_ns + v.dt_ns
    # Both lists are written and one of them moves on, which is no branch.
    for j in range(_U(active.size)):
        i = _U(active[j])
        sleeps = p.upper[i] == -_INF
        ints[awake + _AWAKE] = ints[asleep + _WAKING] = i
        awake += _U(not sleeps)
        asleep += _U(sleeps)
    # The second pass keeps, of the pixels in their dead time, those released in the interval.
    for j in range(asleep):
        i = _U(ints[j + _WAKING])
        ints[waking + _WAKING] = i
        waking += _U(p.release[i] <= end_ns)
    return awake, waking


@numba.njit(**JIT)
def _gather(count, first, now, p, v, floats, ints):
    """Fill the rows of the pixels in PIXEL, except NOW, SHOT and SLOT."""
    intensity_now, x_now, lag_now, noise_now = now
    # A row at a time: what a feature that is off would need is not read.
    origin = _U(first)
    # The constants are not in the cache yet; a loop of their own lets the cache misses overlap.
    for j in range(count):
        i = _U(ints[j + _PIXEL])
        floats[j + _ON], floats[j + _OFF] = p.constants[i, 0], p.constants[i, 1]
        floats[j + _MEAN_LEAK] = p.constants[i, 2]
    for j in range(count):
        i = _U(ints[j + _PIXEL])
        floats[j + _UP], floats[j + _DOWN] = p.upper[i], p.lower[i]
        floats[j + _X0], floats[j + _X1] = p.x[i], x_now[i - origin]
        floats[j + _LEAK] = floats[j + _NOISE] = floats[j + _SHIFT] = 0.0
    if p.leak.size:
        for j in range(count):
            floats[j + _LEAK] = p.leak[_U(ints[j + _PIXEL])]
    if p.lag.size:
        for j in range(count):
            i = _U(ints[j + _PIXEL])
            o = i - origin
            floats[j + _LAG0], floats[j + _LAG1] = p.lag[i], lag_now[o]
            floats[j + _I0], floats[j + _I1] = p.intensity[i], intensity_now[o]
    if p.noise.size:
        for j in range(count):
            i = _U(ints[j + _PIXEL])
            floats[j + _NOISE] = p.noise[i]
            floats[j + _SHIFT] = np.float64(noise_now[i - origin]) - np.float64(p.noise[i])
    if p.since_ns.size:
        for j in range(count):
            i = _U(ints[j + _PIXEL])
            ints[j + _SINCE], floats[j + _NOISE_THEN] = p.since_ns[i] - v.t0_ns, p.noise_then[i]


@numba.njit(**JIT)
def _number_shots(count, first, keys, key, noise_end, ints):
    """Fill SHOT of pixels in raster order. ``key`` is the place of their first shot noise; return that of the next
    pixels'."""
    j = _U0
    # Keys and pixels both rise: one walk through both.
    while key < noise_end and j < count:
        pixel = first + (keys[key] >> 42)
        if pixel < ints[j + _PIXEL]:
            # This key belongs to a pixel in its dead time.
            key += 1
        else:
            if pixel == ints[j + _PIXEL]:
                ints[j + _SHOT] = key
                while key < noise_end and first + (keys[key] >> 42) == pixel:
                    key += 1
            j += _U1
    return key


@numba.njit(**JIT)
def _settle(count, first, noise_now, noise_end, p, v, floats, ints):
    """Write the levels of pixels that wake up and do not fire, a third of all listed ones. List those that do fire
    (WOKEN) and return their number."""
    woken, told = _U0, p.since_ns.size > 0
    for j in range(count):
        # Pixels that fire after waking up are put down with their levels and dealt with together with
        # the others.
        i, fires = _U(ints[j + _PIXEL]), (ints[j + _FIRES] != 0) | (ints[j + _SHOT] != noise_end)
        up, down = floats[j + _UP], floats[j + _DOWN]
        if fires:
            ints[woken + _WOKEN], ints[woken + _WOKEN_NOW] = ints[j + _PIXEL], ints[j + _NOW]
            floats[woken + _WOKEN_UP], floats[woken + _WOKEN_DOWN] = up, down
            floats[woken + _WOKEN_S], floats[woken + _WOKEN_E] = floats[j + _S], floats[j + _E]
            woken += _U1
            continue
        p.upper[i], p.lower[i] = np.float32(up), np.float32(down)
        if told:
            p.since_ns[i] = v.t0_ns + ints[j + _NOW]
            p.noise_then[i] = np.float32(_noise_at(floats, ints, j, floats[j + _S], first, noise_now, p))
    return woken


@numba.njit(**JIT)
def _merge(awake, woken, ints):
    """Merge both lists into PIXEL in raster order, and store the places of the second one's pixels (WOKEN_SLOT)."""
    a, w = _U0, _U0
    # A merge of two sorted lists.
    while w < woken:
        if a < awake and ints[a + _AWAKE] < ints[w + _WOKEN]:
            ints[a + w + _PIXEL] = ints[a + _AWAKE]
            a += _U1
        else:
            ints[a + w + _PIXEL], ints[w + _WOKEN_SLOT] = ints[w + _WOKEN], a + w
            w += _U1
    while a < awake:
        ints[a + w + _PIXEL] = ints[a + _AWAKE]
        a += _U1


@numba.njit(**JIT)
def _shots(floats, ints, count, keys, noise_end, dt_ns):
    """Replace the crossing by shot noise where that comes first."""
    for j in range(count):
        key = ints[j + _SHOT]
        ints[j + _BY_NOISE] = 0
        if key == noise_end:
            continue
        offset = keys[key] >> 42
        # Shot noise before NOW fell into the dead time or was dealt with.
        while key < noise_end and keys[key] >> 42 == offset and (keys[key] >> 1) & _MASK41 < ints[j + _NOW]:
            key += 1
        if key < noise_end and keys[key] >> 42 == offset:
            noise_ns = (keys[key] >> 1) & _MASK41
            # The earlier one is the event; at the same ns that is the noise.
            if ints[j + _FIRES] == 0 or noise_ns <= np.int64(floats[j + _AT] * dt_ns):
                ints[j + _FIRES], ints[j + _BY_NOISE], ints[j + _POLARITY] = 1, 1, keys[key] & 1
                ints[j + _AT_NS], floats[j + _AT] = noise_ns, noise_ns / dt_ns
                key += 1
        ints[j + _SHOT] = key if key < noise_end and keys[key] >> 42 == offset else noise_end


@numba.njit(**JIT)
def _cause(floats, ints, j, noise_then, p, v):
    """Return the cause of pixel j's event, shifted to its place in the word. noise_then : the photoreceptor's noise
    at the event."""
    if ints[j + _BY_NOISE]:
        return _CAUSE_SHOT << CAUSE_SHIFT
    # How far leak and noise have moved the signal since the reference was taken; light is the rest of
    # the threshold.
    sign, size = floats[j + _SIGN], floats[j + _ON] if ints[j + _POLARITY] else floats[j + _OFF]
    by_leak = sign * floats[j + _LEAK] * ((ints[j + _AT_NS] - ints[j + _SINCE]) * 1e-9)
    by_noise = sign * (noise_then - floats[j + _NOISE_THEN])
    cause = cause_of(size - by_leak - by_noise, by_leak, by_noise)
    if cause == _CAUSE_LEAK and p.hot[ints[j + _PIXEL]]:
        cause = _CAUSE_HOT
    return cause << CAUSE_SHIFT


@numba.njit(**JIT)
def _noise_at(floats, ints, j, s, first, noise_now, p):
    """Return the photoreceptor's noise of pixel j at s."""
    if not p.noise.size:
        return 0.0
    i = ints[j + _PIXEL]
    # On a straight line between the frames.
    noise = np.float64(p.noise[i])
    return noise + (np.float64(noise_now[i - first]) - noise) * s


@numba.njit(**JIT)
def _in_order(packed, begin, end, owners, slots, ints):
    """Sort events from wave by wave to pixel by pixel."""
    # A counting sort by pixel. It is stable, so the events of a pixel stay in their order.
    waves = packed[begin:end].copy()
    for j in range(slots):
        ints[j + _COUNT] = 0
    for e in range(waves.size):
        ints[_U(owners[e]) + _COUNT] += 1
    place = begin
    for j in range(slots):
        count = ints[j + _COUNT]
        ints[j + _COUNT] = place
        place += count
    for e in range(waves.size):
        packed[ints[_U(owners[e]) + _COUNT]] = waves[e]
        ints[_U(owners[e]) + _COUNT] += 1


@numba.njit(**JIT)
def emit_waves(
    active: np.ndarray,
    count: int,
    first: int,
    now: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    keys: np.ndarray,
    noise_end: int,
    p: Any,
    v: Any,
    cap: int,
    packed: np.ndarray,
    begin: int,
    floats: np.ndarray,
    ints: np.ndarray,
) -> tuple[int, int]:
    """Events of the listed pixels of one block into ``packed[begin:]``, in raster order; moves levels.

    now : (intensity, x, lag, noise) of the block at the interval's end.   keys : of ``noise_end`` shot noise events,
    sorted.   p, v : Pixels and Interval of v2e.py.   cap : most events of a pixel; there is room for so many of each.
    floats, ints : scratch of FLOATS and INTS.   Returns (end of the events, cut)."""
    # np.int64(0), because a literal 0 would compile the kernel for a second type.
    out, cut, key = begin, 0, np.int64(0)
    for start in range(0, count, SLOTS):
        here = active[start : min(start + SLOTS, count)]
        out, cut_here, key = _emit(here, first, now, keys, key, noise_end, p, v, cap, packed, out, floats, ints)
        cut += cut_here
    return out, cut


@numba.njit(**JIT)
def _emit(active, first, now, keys, key, noise_end, p, v, cap, packed, begin, floats, ints):
    """Do :func:`emit_waves` for at most SLOTS pixels. ``key`` is the place of their first shot noise; return that of
    the next pixels'."""
    noise_now, dt_ns, dt = now[3], v.dt_ns, v.dt_ns * 1e-9
    # Start of the interval after the microsecond base, 0 to 999 ns.
    start_ns = v.t0_ns - 1000 * v.base_us
    low_pass, dead_time, told = p.lag.size > 0, p.release.size > 0, p.since_ns.size > 0
    woken = _U0
    if dead_time:
        awake, waking = _part(active, p, v, ints)
        # First those that wake up: their levels are those of the signal at the end of their dead time.
        if waking > _U0:
            for j in range(waking):
                i = ints[j + _WAKING]
                ints[j + _PIXEL], ints[j + _NOW] = i, max(p.release[_U(i)] - v.t0_ns, 0)
                ints[j + _SHOT] = noise_end
            _number_shots(waking, first, keys, key, noise_end, ints)
            _gather(waking, first, now, p, v, floats, ints)
            wide = _wide(waking)
            _curves(floats, wide, v.kappa, v.since_epoch_0, dt, low_pass)
            if low_pass:
                _wake(floats, ints, wide, dt_ns)
            else:
                _wake_lines(floats, ints, wide, dt_ns)
            _aim(floats, ints, wide)
            woken = _settle(waking, first, noise_now, noise_end, p, v, floats, ints)
        slots = awake + woken
        _merge(awake, woken, ints)
    else:
        slots = _U(active.size)
        for j in range(slots):
            ints[j + _PIXEL] = active[j]
    # Row and column by counting along the raster, see esim._emit_block. All begin at the interval's
    # start.
    y = first // v.width
    row_end = (y + 1) * v.width
    for j in range(slots):
        i = ints[j + _PIXEL]
        while i >= row_end:
            y += 1
            row_end += v.width
        ints[j + _BITS] = (y << 17) | ((i - row_end + v.width) << 1)
        ints[j + _NOW], ints[j + _SHOT], ints[j + _SLOT] = 0, noise_end, j
    key = _number_shots(slots, first, keys, key, noise_end, ints)
    _gather(slots, first, now, p, v, floats, ints)
    wide = _wide(slots)
    _curves(floats, wide, v.kappa, v.since_epoch_0, dt, low_pass)
    # Those that woke up go on from the end of their dead time, with the levels from above.
    for w in range(woken):
        j = _U(ints[w + _WOKEN_SLOT])
        ints[j + _NOW] = ints[w + _WOKEN_NOW]
        floats[j + _UP], floats[j + _DOWN] = floats[w + _WOKEN_UP], floats[w + _WOKEN_DOWN]
        floats[j + _S], floats[j + _E] = floats[w + _WOKEN_S], floats[w + _WOKEN_E]
        if told:
            ints[j + _SINCE] = ints[j + _NOW]
            floats[j + _NOISE_THEN] = _noise_at(floats, ints, j, floats[j + _S], first, noise_now, p)
    out, cut, wave, left = begin, 0, 0, slots
    # Which pixel each event is of, for _in_order.
    owners = np.empty(2 * SLOTS, np.int32)
    while left > 0:
        wide = _wide(left)
        _aim(floats, ints, wide)
        if low_pass:
            # After an event without dead time S has moved, and E follows it.
            if wave > 0 and not dead_time:
                _look_again(floats, wide)
            _meet(floats, ints, left, wide)
        else:
            _meet_lines(floats, ints, wide)
        # The fraction as whole ns, rounded down.
        for j in range(wide):
            ints[j + _AT_NS] = _whole(floats[j + _AT] * dt_ns)
        if noise_end:
            _shots(floats, ints, left, keys, noise_end, dt_ns)
        # Below the cap every pixel's word is written, and the place moves on where it fires.
        if wave < cap:
            filled = out - begin
            if filled + np.int64(left) > owners.size:
                longer = np.empty(2 * (filled + np.int64(left)), np.int32)
                longer[:filled] = owners[:filled]
                owners = longer
            for j in range(left):
                word = ints[j + _BITS] | ints[j + _POLARITY]
                if told:
                    if not noise_end:
                        ints[j + _BY_NOISE] = 0
                    word |= _cause(
                        floats, ints, j, _noise_at(floats, ints, j, floats[j + _AT], first, noise_now, p), p, v
                    )
                packed[out] = (np.int64(_U(start_ns + ints[j + _AT_NS]) // _U1000) << T_SHIFT) | word
                owners[out - begin] = ints[j + _SLOT]
                out += ints[j + _FIRES]
        else:
            # Beyond the cap events are counted only.
            for j in range(left):
                cut += ints[j + _FIRES]
        if v.leak_jitter > 0.0:
            _draw_leaks(floats, ints, wide, v.seed, v.t0_ns)
            _change_leaks(floats, ints, wide, v.leak_jitter, v.since_epoch_0, v.since_epoch_1, dt)
        if dead_time:
            # After an event the pixel is looked at again from the end of its dead time, else from the
            # event itself.
            for j in range(left):
                ints[j + _NOW] = select(ints[j + _FIRES] != 0, ints[j + _AT_NS] + v.refractory_ns, ints[j + _NOW])
            if low_pass:
                _reference_after_dead_time(floats, ints, wide, dt_ns)
            else:
                _reference_of_lines_after_dead_time(floats, ints, wide, dt_ns)
        else:
            for j in range(left):
                ints[j + _NOW] = ints[j + _AT_NS]
                floats[j + _S] = floats[j + _AT]
            # After shot noise the reference is the signal itself.
            if noise_end:
                for j in range(left):
                    if ints[j + _BY_NOISE]:
                        floats[j + _TARGET] = signal_at(
                            floats[j + _AT], floats[j + _C], floats[j + _RISE], floats[j + _FALL], floats[j + _K]
                        )
        # Levels around the new reference; then state, and the pixels that have another event go on into
        # the next wave.
        _set_levels(floats, ints, wide)
        go_on = _go_on(floats, ints, wide, left, noise_end, dt_ns, dead_time)
        _put_back(floats, ints, left, first, noise_now, dead_time, p, v)
        left = _keep(floats, ints, left) if go_on else _U0
        wave += 1
    # One wave alone is in raster order already.
    if wave > 1:
        _in_order(packed, begin, out, owners, slots, ints)
    return out, cut, key
