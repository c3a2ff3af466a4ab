"""How large photoreceptor noise has to be for a wanted rate of noise events, at any frame spacing.

The noise before the comparator is white noise through the photoreceptor's low-pass: seen at the frames, a first-order
autoregression with coefficient e^-k, k time constants per frame. Sampling hides crossings, so with a fixed size the
event rate would fall with the frame rate; instead the size is chosen per k.

The table holds ln(events per time constant) for sizes s (standard deviation in thresholds) and k. Levels are one
threshold apart and an event puts the reference on the level that was passed, so a pixel is on a ladder of levels, and a
ladder with a rung at the noise's mean is the quietest. Thresholds for ON and OFF that differ, as they do in every pixel
once they are spread, move the ladder a little with every pair of events: a pixel is on a ladder for the longer, the
quieter it is, and its rate in the end is the harmonic mean over where the ladder may stand. That is the rate of the
table, and pixels start on ladders as they are found then (:func:`start_places`). It was solved for as the stationary
state of Markov chains, without throwing dice (``tools/noise_rates.py``).
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import PchipInterpolator

RATE_SIZES = np.array([0.15, 0.175, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5])
RATE_K = np.array([0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
# fmt: off
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


# Sampling pushes the levels away by a length in proportion to the root of k (Chernoff 1965), so that the rate is smooth
# in that root: down to k = 0 its last two rows go on in a straight line.
_ROOTS = np.sqrt(RATE_K)
_SLOPE = (_LOG_RATE[1] - _LOG_RATE[0]) / (_ROOTS[1] - _ROOTS[0])
_OVER_K = PchipInterpolator(
    np.concatenate([[0.0], _ROOTS]), np.concatenate([[_LOG_RATE[0] - _SLOPE * _ROOTS[0]], _LOG_RATE])
)


def noise_size(k: np.ndarray | float, events_per_time_constant: np.ndarray) -> np.ndarray:
    """Standard deviation of the noise, in thresholds, elementwise; at most 2.5.

    k : time constants per frame. Beyond 10 the samples are independent and the rate per *frame* is what counts.
    """
    k, rate = np.broadcast_arrays(np.asarray(k, float), np.asarray(events_per_time_constant, float))
    wanted = np.log(np.maximum(rate, 1e-300)) + np.log(np.maximum(k / RATE_K[-1], 1.0))
    rows = _OVER_K(np.sqrt(np.minimum(k, RATE_K[-1])))
    q = 1 / RATE_SIZES**2  # ln r is nearly linear in it
    out = np.empty(k.shape)
    for index in np.ndindex(k.shape):
        row, w = rows[index], wanted[index]
        out[index] = q[0] + (w - row[0]) * (q[1] - q[0]) / (row[1] - row[0]) if w < row[0] else np.interp(w, row, q)
    return 1 / np.sqrt(out)


def noise_table(rate_hz: float, dt_s: float, threshold: float) -> np.ndarray:
    """(TABLE_SIZE,) float32 noise sizes in ln units over ln k, for frames ``dt_s`` apart."""
    k = np.exp(TABLE_LOW + TABLE_STEP * np.arange(TABLE_SIZE))
    return (threshold * noise_size(k, rate_hz * dt_s / k)).astype(np.float32)


def start_sizes(rate_hz: float, corner_hz: np.ndarray, threshold: float) -> np.ndarray:
    """Noise sizes in ln units for pixels with these corner frequencies, whatever the frame spacing will be."""
    corners = _some_corners(corner_hz)
    sizes = noise_size(0.0, rate_hz / (2 * np.pi * corners))
    return threshold * np.interp(np.log(corner_hz), np.log(corners), sizes)


def start_places(rate_hz: float, corner_hz: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """The rung next to the noise's mean, in thresholds from it, -1/2 to 1/2, of pixels after a long time.

    The time on a ladder is in inverse proportion to its rate, which grows from 0 to 1/2 as e^{span h}, h nearly the
    same for all sizes: that of the way back to a rung, 1 - (1 - place)^2. uniform : (N,) in (0, 1)."""
    corners = _some_corners(corner_hz)
    which = np.searchsorted(np.sqrt(corners[1:] * corners[:-1]), corner_hz)
    spans = np.interp(noise_size(0.0, rate_hz / (2 * np.pi * corners)), RATE_SIZES, _SPANS)
    places, out = np.linspace(0, 0.5, 129), np.empty(len(uniform))
    side, depth = np.where(uniform < 0.5, -1.0, 1.0), np.abs(2 * uniform - 1)
    for number in np.unique(which):
        time = np.exp(-spans[number] * (1 - (1 - places) ** 2) / 0.75)
        law = np.concatenate([[0.0], np.cumsum(time[1:] + time[:-1])])
        here = which == number
        out[here] = side[here] * np.interp(depth[here], law / law[-1], places)
    return out


def _some_corners(corner_hz: np.ndarray) -> np.ndarray:
    """64 frequencies that span these."""
    return np.exp(np.linspace(np.log(corner_hz.min()), np.log(corner_hz.max()) + 1e-9, 64))
