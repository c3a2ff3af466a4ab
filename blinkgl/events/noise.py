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

# fmt: off
RATE_SIZES = np.array([0.1, 0.125, 0.15, 0.175, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5])
RATE_K = np.array([0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
_LOG_RATE = np.array(
    [
        [-14.8010, -10.0494, -7.4615, -5.8766, -4.8219, -3.5100, -2.7065, -2.1445, -1.7173, -1.0879, -0.6275, -0.1079, 0.5147, 0.9728, 1.3351, 1.8896, 2.3072],  # k = 0.003
        [-15.1347, -10.2381, -7.5916, -5.9814, -4.9129, -3.5849, -2.7734, -2.2076, -1.7786, -1.1495, -0.6915, -0.1774, 0.4341, 0.8801, 1.2307, 1.7603, 2.1556],  # k = 0.01
        [-15.4467, -10.4845, -7.7949, -6.1534, -5.0629, -3.7078, -2.8832, -2.3107, -1.8785, -1.2485, -0.7933, -0.2863, 0.3093, 0.7389, 1.0739, 1.5773, 1.9487],  # k = 0.03
        [-16.0429, -10.9651, -8.1955, -6.4964, -5.3631, -3.9549, -3.1026, -2.5151, -2.0756, -1.4409, -0.9897, -0.4925, 0.0842, 0.4946, 0.8107, 1.2794, 1.6201],  # k = 0.1
        [-16.9121, -11.7033, -8.8303, -7.0515, -5.8573, -4.3666, -3.4675, -2.8548, -2.4005, -1.7530, -1.2981, -0.8051, -0.2439, 0.1479, 0.4453, 0.8803, 1.1938],  # k = 0.3
        [-18.1170, -12.8329, -9.8769, -8.0183, -6.7519, -5.1496, -4.1766, -3.5150, -3.0289, -2.3470, -1.8781, -1.3814, -0.8315, -0.4561, -0.1744, 0.2353, 0.5304],  # k = 1
        [-19.2282, -13.9365, -10.9690, -9.0916, -7.8014, -6.1468, -5.1281, -4.4322, -3.9217, -3.2116, -2.7299, -2.2270, -1.6785, -1.3076, -1.0304, -0.6281, -0.3383],  # k = 3
        [-20.4324, -15.1405, -12.1727, -10.2941, -9.0020, -7.3418, -6.3175, -5.6172, -5.1034, -4.3892, -3.9057, -3.4016, -2.8528, -2.4822, -2.2054, -1.8037, -1.5144],  # k = 10
    ]
)
_SPANS = np.array([40.0, 24.0, 15.3, 11.0, 7.9, 4.5, 2.45, 1.3, 0.7, 0.19, 0.06, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0])
"""ln of the rates' ratio from a ladder with a rung at half a threshold from the noise's mean to one with a rung at it."""
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


def noise_size(k: np.ndarray, events_per_time_constant: np.ndarray) -> np.ndarray:
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
