"""Log intensity between two frames as a monotone cubic, and the times at which it passes levels.

In units of the interval (time s and level y both from 0 to 1; alpha, beta the slopes at
its ends in units of the secant)

    y(s) = alpha s + (3 - 2 alpha - beta) s^2 + (alpha + beta - 2) s^3

is monotone for 0 <= alpha, beta <= 3 (Fritsch and Carlson, SIAM J. Numer. Anal. 17, 1980; the box inscribed in their
region), so it passes the levels that the straight line passes and no other: only the times differ. alpha = beta = 1
is the straight line. A slope that points against the secant becomes 0: there is an extremum inside the interval, or
another surface has come into view.

Slopes come from the neighbouring frames (``pchip``), or are given at both ends (``hermite``).
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numba.extending import register_jitable

from blinkgl.events.arith import Q_ONE
from blinkgl.events.packing import JIT

STEEPEST = 3.0
"""Steepest slope at a frame, in units of the secant, with which every cubic is monotone."""
CLOSE = 1e-9
"""Newton's last step, in intervals: its error is then the square of this."""
PER_SECOND = np.float32(Q_ONE * 1e-9)
"""From ln units per second to 2^-25 per nanosecond."""


class Curve(NamedTuple):
    """The neighbours of an interval, where slopes are taken from them."""

    older: np.ndarray  # (N,) int32 log intensity one frame before the interval
    newer: np.ndarray  # (N,) int32 one frame after it
    older_ns: float  # lengths of the intervals before and after; 0: there is no such frame
    newer_ns: float


@register_jitable
def limited(slope: float) -> float:
    """A slope in units of the secant, cut to what keeps the cubic monotone (and 0 for NaN)."""
    return min(slope, STEEPEST) if slope > 0.0 else 0.0


@register_jitable
def slope_between(before: float, after: float, before_ns: float, after_ns: float) -> float:
    """Slope at a frame, from secants (any unit) and lengths of the intervals beside it: that of the parabola through
    the three frames. Second order; the caller limits it."""
    return (before * after_ns + after * before_ns) / (before_ns + after_ns)


@register_jitable
def slope_at_end(near: float, far: float, near_ns: float, far_ns: float) -> float:
    """Slope at the first or last frame: of the parabola through it and the two frames next to it."""
    return near + (near - far) * near_ns / (near_ns + far_ns)


@register_jitable
def end_slopes(
    older: float, before: float, now: float, newer: float, dt_ns: float, older_ns: float, newer_ns: float
) -> tuple[float, float]:
    """(alpha, beta) of an interval from the log intensities of four frames; older_ns or
    newer_ns 0: there is no such frame."""
    change = np.float64(now - before)
    secant = change / dt_ns
    # Without a neighbour the slope is 1, that of the straight line.
    alpha = beta = 1.0
    if older_ns > 0.0:
        alpha = limited(slope_between(np.float64(before - older) / older_ns, secant, older_ns, dt_ns) / secant)
    if newer_ns > 0.0:
        beta = limited(slope_between(secant, np.float64(newer - now) / newer_ns, dt_ns, newer_ns) / secant)
    # The first and last frame take the slope of a one-sided parabola.
    if older_ns == 0.0 and newer_ns > 0.0:
        alpha = limited(slope_at_end(secant, np.float64(newer - now) / newer_ns, dt_ns, newer_ns) / secant)
    if newer_ns == 0.0 and older_ns > 0.0:
        beta = limited(slope_at_end(secant, np.float64(before - older) / older_ns, dt_ns, older_ns) / secant)
    return alpha, beta


@register_jitable
def curve_time(y: float, alpha: float, beta: float, low: float) -> float:
    """s in [low, 1] with y(s) = y, for a monotone cubic and ``y`` in [0, 1] not below y(low). Newton's method inside a
    bracket that shrinks at every step, bisection where it would leave it; error 1e-15 where the curve is not flat."""
    if y >= 1.0:
        return 1.0
    # y(s) = ((a s + b) s + alpha) s.
    a, b = alpha + beta - 2.0, 3.0 - 2.0 * alpha - beta
    high = 1.0
    # The straight line gives the first guess.
    s = min(max(y, low), 1.0)
    for _ in range(100):
        value = ((a * s + b) * s + alpha) * s - y
        if value > 0.0:
            # A bracket that holds the crossing: value <= 0 at ``low``, > 0 at ``high``.
            high = s
        else:
            low = s
        slope = (3.0 * a * s + 2.0 * b) * s + alpha
        # Bisection is the fallback where Newton's step leaves the bracket.
        new = 0.5 * (low + high)
        if slope > 0.0:
            newton = s - value / slope
            if low <= newton <= high:
                new = newton
        done = abs(new - s) < CLOSE
        s = new
        if done:
            break
    return s


@numba.njit(**JIT)
def slope_block(rate: np.ndarray, intensity: np.ndarray, eps: float, out: np.ndarray) -> None:
    """d ln(I + eps)/dt in 2^-25 per ns from dI/dt per second, float32."""
    # d ln(I + eps)/dt = dI/dt / (I + eps).
    for i in range(rate.size):
        out[i] = np.float32(rate[i] / np.float32(intensity[i] + eps)) * PER_SECOND
