"""The size of photoreceptor noise that gives a wanted rate of noise events at any frame spacing.

The noise before the comparator is white noise through the photoreceptor's low-pass. At the frames it is a first-order
autoregression with coefficient e^-k, k time constants per frame. Sampling hides crossings, so with a fixed size the
event rate would fall with the frame rate; therefore the size is chosen per k.

The table holds ln(events per time constant) for sizes s (standard deviation in thresholds) and k. Levels are one
threshold apart and an event sets the reference to the level that was passed, so a pixel is on a ladder of levels. A
ladder with a rung at the noise's mean has the lowest rate. Thresholds that differ for ON and OFF, as in every pixel
with spread, move the ladder a little with every pair of events. A pixel stays longer on a ladder with a lower rate, so
its long-term rate is the harmonic mean over the positions of the ladder. That is the rate of the table, and pixels
start on ladders with the same distribution (:func:`start_places`). The table was computed as the stationary state of
Markov chains, without random numbers, by ``tools/noise_rates.py``.

With a dead time the reference is taken again at the noise's value at its end, and pixels leave their ladder. A dead
time shorter than a frame moves them to ladders with a high rate, where noise crosses one level in both directions
(three times the events, and more where they are rare). One of several frames puts the reference near the noise's mean
and hides the events after an event (a third). A second table has the factor.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import PchipInterpolator

RATE_SIZES = np.array([0.15, 0.175, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5])
RATE_K = np.array([0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
# fmt: off
# ln(events per time constant): rows by RATE_K, columns by RATE_SIZES.
_LOG_RATE = np.array(
    [
        [
            -16.8686, -11.7826, -8.5239, -4.8978, -3.1767, -2.2869, -1.7528, -1.0851,
            -0.6235, -0.1039, 0.5182, 0.9759, 1.3382, 1.8927, 2.3081,
        ],
        [
            -17.5020, -12.1560, -8.7690, -5.0281, -3.2697, -2.3617, -1.8188, -1.1471,
            -0.6877, -0.1737, 0.4371, 0.8824, 1.2307, 1.7603, 2.1556,
        ],
        [
            -17.8843, -12.4805, -9.0470, -5.2356, -3.4243, -2.4847, -1.9265, -1.2476,
            -0.7900, -0.2844, 0.3093, 0.7389, 1.0739, 1.5773, 1.9487,
        ],
        [
            -18.6023, -13.1025, -9.5881, -5.6460, -3.7357, -2.7325, -2.1419, -1.4456,
            -0.9898, -0.4925, 0.0842, 0.4946, 0.8107, 1.2794, 1.6201,
        ],
        [
            -19.5992, -14.0091, -10.4043, -6.2996, -4.2579, -3.1576, -2.5075, -1.7626,
            -1.2986, -0.8051, -0.2439, 0.1479, 0.4453, 0.8803, 1.1938,
        ],
        [
            -20.8805, -15.2433, -11.5964, -7.3751, -5.1856, -3.9555, -3.2114, -2.3724,
            -1.8806, -1.3814, -0.8315, -0.4561, -0.1744, 0.2353, 0.5304,
        ],
        [
            -22.0077, -16.3626, -12.7072, -8.4674, -6.2427, -4.9614, -4.1659, -3.2572,
            -2.7369, -2.2273, -1.6785, -1.3076, -1.0304, -0.6281, -0.3383,
        ],
        [
            -23.2122, -17.5669, -13.9114, -9.6711, -7.4441, -6.1580, -5.3567, -4.4386,
            -3.9137, -3.4020, -2.8528, -2.4822, -2.2054, -1.8037, -1.5144,
        ],
    ]
)
_SPANS = np.array(
    [
        14.14, 9.88, 7.08, 3.79, 2.06, 1.11, 0.57, 0.12,
        0.02, 0.00, 0.00, -0.00, -0.00, -0.00, -0.00,
    ]
)
"""ln of the rates' ratio from a ladder with a rung half a threshold from the noise's mean to one with a rung at it."""
# fmt: on
TABLE_SIZE = 256
TABLE_LOW, TABLE_STEP = np.log(1e-6), np.log(1e9) / (TABLE_SIZE - 2)
"""The per-step table runs over ln k from 1e-6 to 1e3."""


# Axes of _DEAD: dead time in frames, time constants per frame, noise in thresholds.
DEAD_FRAMES = np.array([0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 16.0])
DEAD_K = np.array([0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
DEAD_SIZES = np.array([0.25, 0.3, 0.45, 0.7, 1.0, 2.5])
# fmt: off
_DEAD = np.array(
    [
        [
            [2.01, 0.92, 0.10, -0.01, -0.02, -0.03],
            [2.03, 1.00, 0.10, -0.05, -0.03, -0.10],
            [1.86, 0.88, 0.08, -0.02, -0.03, -0.16],
            [1.96, 0.98, 0.21, -0.01, -0.05, -0.24],
            [2.28, 1.18, 0.20, 0.01, -0.07, -0.27],
            [2.34, 1.34, 0.29, 0.00, -0.08, -0.28],
        ],
        [
            [1.55, 0.62, 0.04, -0.02, -0.02, -0.09],
            [1.78, 0.67, 0.04, -0.03, -0.04, -0.20],
            [1.86, 0.92, 0.10, -0.03, -0.07, -0.32],
            [2.10, 1.11, 0.20, -0.03, -0.13, -0.49],
            [2.08, 1.15, 0.27, -0.01, -0.17, -0.56],
            [2.06, 1.16, 0.28, -0.01, -0.18, -0.57],
        ],
        [
            [1.22, 0.51, 0.01, -0.01, -0.02, -0.16],
            [1.49, 0.67, 0.07, -0.03, -0.05, -0.34],
            [1.50, 0.72, 0.11, -0.04, -0.13, -0.55],
            [1.39, 0.72, 0.16, -0.07, -0.23, -0.78],
            [1.05, 0.54, 0.13, -0.09, -0.30, -0.89],
            [0.92, 0.45, 0.12, -0.09, -0.31, -0.91],
        ],
        [
            [0.77, 0.31, 0.03, -0.05, -0.04, -0.25],
            [1.00, 0.26, 0.04, -0.06, -0.11, -0.50],
            [0.69, 0.29, 0.02, -0.09, -0.23, -0.81],
            [-0.22, -0.21, -0.15, -0.19, -0.38, -1.14],
            [-0.93, -0.80, -0.33, -0.32, -0.51, -1.31],
            [-1.04, -0.86, -0.38, -0.33, -0.52, -1.32],
        ],
        [
            [0.52, 0.27, -0.01, -0.04, -0.07, -0.41],
            [0.66, 0.19, -0.02, -0.12, -0.20, -0.77],
            [0.01, -0.12, -0.13, -0.22, -0.42, -1.19],
            [-0.95, -0.77, -0.44, -0.45, -0.71, -1.58],
            [-1.18, -0.92, -0.54, -0.60, -0.86, -1.79],
            [-1.19, -0.93, -0.57, -0.62, -0.88, -1.82],
        ],
        [
            [0.65, 0.19, -0.04, -0.09, -0.16, -0.65],
            [0.15, -0.08, -0.12, -0.21, -0.36, -1.17],
            [-0.68, -0.60, -0.32, -0.42, -0.69, -1.65],
            [-1.12, -0.96, -0.56, -0.71, -1.07, -2.10],
            [-1.14, -0.89, -0.67, -0.87, -1.26, -2.32],
            [-1.08, -0.90, -0.68, -0.90, -1.28, -2.34],
        ],
        [
            [-0.13, -0.15, -0.18, -0.30, -0.52, -1.49],
            [-0.85, -0.75, -0.45, -0.65, -1.01, -2.23],
            [-1.21, -0.89, -0.65, -1.08, -1.59, -2.84],
            [-1.14, -1.00, -0.93, -1.55, -2.10, -3.35],
            [-1.18, -1.01, -1.04, -1.75, -2.33, -3.58],
            [-1.18, -1.06, -1.06, -1.78, -2.36, -3.60],
        ],
    ]
)
# fmt: on
"""ln of the factor by which a dead time of so many frames changes the rate: [dead time][k][size]."""
IN_SECONDS = 0.5
"""Part of a factor above 1 (of its logarithm) that appears in a clip of seconds: pixels leave their first ladder by
events, which are rare on quiet ladders. Chosen on clips of 2 s at 5 Hz; it is the best of 0, 1/4, 1/2 and 1 on other
clips, too, with spread thresholds, not with equal ones."""


# ln rate is nearly linear in 1/s^2, so sizes are interpolated in that.
_DEAD_Q = 1 / DEAD_SIZES**2
# A matrix from a row over DEAD_SIZES to one over RATE_SIZES.
_TO_SIZES = np.array([np.interp(1 / RATE_SIZES**2, _DEAD_Q[::-1], row[::-1]) for row in np.eye(len(DEAD_SIZES))])
# Below the smallest size: a straight line in 1 / s^2.
_BEYOND = np.maximum(1 / RATE_SIZES**2 - _DEAD_Q[0], 0.0) / (_DEAD_Q[0] - _DEAD_Q[1])
_TO_SIZES[0] += _BEYOND
_TO_SIZES[1] -= _BEYOND


# Sampling shifts the levels by a length proportional to the root of k (Chernoff 1965), so the rate is smooth in that
# root: down to k = 0 the last two rows continue as a straight line.
_ROOTS = np.sqrt(RATE_K)
_SLOPE = (_LOG_RATE[1] - _LOG_RATE[0]) / (_ROOTS[1] - _ROOTS[0])
_OVER_K = PchipInterpolator(
    np.concatenate([[0.0], _ROOTS]), np.concatenate([[_LOG_RATE[0] - _SLOPE * _ROOTS[0]], _LOG_RATE])
)


def noise_rate(size: float, k: float) -> float:
    """Return events per time constant, without a dead time, interpolated from the table. size : in thresholds."""
    # Beyond the last k samples are independent, and the rate per time constant falls as 1/k.
    row, q = _OVER_K(np.sqrt(min(k, RATE_K[-1]))), 1 / RATE_SIZES**2
    return float(np.exp(np.interp(1 / size**2, q[::-1], row[::-1]))) / max(k / RATE_K[-1], 1.0)


def noise_size(k: np.ndarray | float, events_per_time_constant: np.ndarray, dead_frames: float = 0.0) -> np.ndarray:
    """Return the standard deviation of the noise, in thresholds, elementwise; at most 2.5.

    k : time constants per frame. Beyond 10 the samples are independent and the rate per *frame* counts.
    dead_frames : the dead time after an event.
    """
    k, rate = np.broadcast_arrays(np.asarray(k, float), np.asarray(events_per_time_constant, float))
    wanted = np.log(np.maximum(rate, 1e-300)) + np.log(np.maximum(k / RATE_K[-1], 1.0))
    rows = _OVER_K(np.sqrt(np.minimum(k, RATE_K[-1])))
    if dead_frames:
        # Where noise is large the dead time decides the rate, and the size hardly matters.
        rows = np.maximum.accumulate(rows + _dead_time_factors(k, dead_frames), axis=-1)
    # ln r is nearly linear in it.
    q = 1 / RATE_SIZES**2
    out = np.empty(k.shape)
    for index in np.ndindex(k.shape):
        row, w = rows[index], wanted[index]
        # Below the first entry the table continues as a straight line.
        out[index] = q[0] + (w - row[0]) * (q[1] - q[0]) / (row[1] - row[0]) if w < row[0] else np.interp(w, row, q)
    return 1 / np.sqrt(out)


def _dead_time_factors(k: np.ndarray, dead_frames: float) -> np.ndarray:
    """Return ln of the factor by which a dead time changes the rate of each of RATE_SIZES, k.shape + (15,)."""
    by_k = np.empty((len(DEAD_K), len(DEAD_SIZES)))
    # Factors above 1 apply only partly within seconds, see IN_SECONDS.
    table = np.where(_DEAD > 0, IN_SECONDS * _DEAD, _DEAD)
    # Without a dead time the logarithm of the factor is 0.
    for i, j in np.ndindex(by_k.shape):
        by_k[i, j] = np.interp(np.log1p(dead_frames), np.log1p([0, *DEAD_FRAMES]), [0, *table[:, i, j]])
    # Linear in ln k between the rows, constant beyond the ends.
    places = np.interp(np.log(np.maximum(k, 1e-300)), np.log(DEAD_K), np.arange(len(DEAD_K)))
    below = np.minimum(places.astype(int), len(DEAD_K) - 2)
    part = (places - below)[..., None]
    return (by_k[below] * (1 - part) + by_k[below + 1] * part) @ _TO_SIZES


def noise_table(rate_hz: float, dt_s: float, threshold: float, dead_s: float = 0.0) -> np.ndarray:
    """Return (TABLE_SIZE,) float32 noise sizes in ln units over ln k, for frames ``dt_s`` apart and a dead time."""
    k = np.exp(TABLE_LOW + TABLE_STEP * np.arange(TABLE_SIZE))
    return (threshold * noise_size(k, rate_hz * dt_s / k, dead_s / dt_s)).astype(np.float32)


def start_sizes(rate_hz: float, corner_hz: np.ndarray, threshold: float) -> np.ndarray:
    """Return noise sizes in ln units for pixels with these corner frequencies, independent of the frame spacing."""
    corners = _some_corners(corner_hz)
    # k = 0: frames so dense that only the corner frequency counts.
    sizes = noise_size(0.0, rate_hz / (2 * np.pi * corners))
    return threshold * np.interp(np.log(corner_hz), np.log(corners), sizes)


def start_places(rate_hz: float, corner_hz: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Return the distance of the noise's mean to the next rung, in thresholds, -1/2 to 1/2, of pixels after a long
    time.

    The time on a ladder is inversely proportional to its rate, which grows from 0 to 1/2 as e^{span h}, h nearly the
    same for all sizes: that of the way back to a rung, 1 - (1 - place)^2. uniform : (N,) in (0, 1)."""
    corners = _some_corners(corner_hz)
    # Each pixel takes the nearest of the corner frequencies, in the logarithm.
    which = np.searchsorted(np.sqrt(corners[1:] * corners[:-1]), corner_hz)
    spans = np.interp(noise_size(0.0, rate_hz / (2 * np.pi * corners)), RATE_SIZES, _SPANS)
    places, out = np.linspace(0, 0.5, 129), np.empty(len(uniform))
    side, depth = np.where(uniform < 0.5, -1.0, 1.0), np.abs(2 * uniform - 1)
    for number in np.unique(which):
        # 0.75 is 1 - (1 - 1/2)^2, so that the exponent is the whole span at half a threshold.
        time = np.exp(-spans[number] * (1 - (1 - places) ** 2) / 0.75)
        # The cumulative law by the trapezoidal rule.
        law = np.concatenate([[0.0], np.cumsum(time[1:] + time[:-1])])
        here = which == number
        out[here] = side[here] * np.interp(depth[here], law / law[-1], places)
    return out


def _some_corners(corner_hz: np.ndarray) -> np.ndarray:
    """Return 64 frequencies that span these, evenly spaced in the logarithm."""
    return np.exp(np.linspace(np.log(corner_hz.min()), np.log(corner_hz.max()) + 1e-9, 64))
