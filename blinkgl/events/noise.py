"""How large photoreceptor noise has to be for a wanted rate of noise events, at any frame spacing.

The noise before the comparator is white noise through the photoreceptor's low-pass: seen at the frames, a first-order
autoregression with coefficient e^-k, k time constants per frame. Sampling hides crossings, so with a fixed size the
event rate would fall with the frame rate; instead the size is chosen per k. The table holds ln(events per time
constant) for sizes s (standard deviation in thresholds) and k; it was counted in simulations of 2e8 to 5e8 steps of
the comparator (levels one threshold apart, the reference starting at a value of the noise), and is extended to rarer
events as ln r ~ a - b/s^2, the tail of a normal law.
"""

from __future__ import annotations

import numpy as np

RATE_SIZES = np.array([0.2, 0.25, 0.3, 0.4, 0.5, 0.7, 1.0, 1.5, 2.5])
RATE_K = np.array([0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
_LOG_RATE = np.array(
    [
        [-6.166, -4.029, -2.931, -1.761, -1.109, -0.277, 0.505, 1.328, 2.301],
        [-6.241, -4.118, -2.994, -1.825, -1.172, -0.346, 0.425, 1.222, 2.153],
        [-6.391, -4.259, -3.109, -1.929, -1.271, -0.452, 0.302, 1.070, 1.948],
        [-6.710, -4.518, -3.340, -2.124, -1.461, -0.650, 0.080, 0.809, 1.619],
        [-7.169, -4.903, -3.686, -2.431, -1.759, -0.953, -0.245, 0.445, 1.194],
        [-8.052, -5.690, -4.394, -3.053, -2.348, -1.527, -0.831, -0.174, 0.530],
        [-9.093, -6.691, -5.351, -3.947, -3.211, -2.373, -1.678, -1.030, -0.338],
        [-10.29, -7.887, -6.540, -5.129, -4.389, -3.548, -2.852, -2.205, -1.514],
    ]
)
TABLE_SIZE = 256
TABLE_LOW, TABLE_STEP = np.log(1e-6), np.log(1e9) / (TABLE_SIZE - 2)
"""The per-step table runs over ln k from 1e-6 to 1e3."""


def noise_size(k: np.ndarray, events_per_time_constant: np.ndarray) -> np.ndarray:
    """Standard deviation of the noise, in thresholds, elementwise; at most 2.5.

    k : time constants per frame. Beyond 10 the samples are independent and the rate per *frame* is what counts.
    """
    k, rate = np.broadcast_arrays(np.asarray(k, float), np.asarray(events_per_time_constant, float))
    wanted = np.log(np.maximum(rate, 1e-300)) + np.log(np.maximum(k / RATE_K[-1], 1.0))
    place = np.interp(np.log(np.clip(k, RATE_K[0], RATE_K[-1])), np.log(RATE_K), np.arange(len(RATE_K)))
    low = np.minimum(place.astype(int), len(RATE_K) - 2)
    rows = _LOG_RATE[low] + (place - low)[..., None] * (_LOG_RATE[low + 1] - _LOG_RATE[low])
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
    corners = np.exp(np.linspace(np.log(corner_hz.min()), np.log(corner_hz.max()) + 1e-9, 64))
    sizes = noise_size(RATE_K[0], rate_hz / (2 * np.pi * corners))
    return threshold * np.interp(np.log(corner_hz), np.log(corners), sizes)
