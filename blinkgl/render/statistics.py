"""Numbers that the adaptive timeline takes from a frame."""

from __future__ import annotations

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True)
def _largest_squared(velocity):
    largest = np.float32(0.0)
    for y in range(velocity.shape[0]):
        for x in range(velocity.shape[1]):
            squared = velocity[y, x, 0] * velocity[y, x, 0] + velocity[y, x, 1] * velocity[y, x, 1]
            if squared > largest and squared < np.float32(np.inf):
                largest = squared
    return largest


def largest_speed(velocity: np.ndarray, percentile: float = 100.0) -> float:
    """Of (H, W, 2) float32 px/s: the given percentile of the speeds, px/s. Pixels without a finite velocity (a surface
    in the camera plane) are left out."""
    if percentile >= 100.0:
        return float(np.sqrt(_largest_squared(velocity)))
    speeds = np.hypot(velocity[..., 0], velocity[..., 1]).ravel()
    speeds = speeds[np.isfinite(speeds)]
    return float(np.percentile(speeds, percentile)) if len(speeds) else 0.0
