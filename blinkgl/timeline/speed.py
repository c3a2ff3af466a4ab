"""How fast the fastest pixel is."""

from __future__ import annotations

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True)
def _largest_squared(velocity):
    largest = np.float32(0.0)
    for y in range(velocity.shape[0]):
        for x in range(velocity.shape[1]):
            # Squares are compared, one root at the end; inf and NaN fail the comparison.
            squared = velocity[y, x, 0] * velocity[y, x, 0] + velocity[y, x, 1] * velocity[y, x, 1]
            if squared > largest and squared < np.float32(np.inf):
                largest = squared
    return largest


def largest_speed(velocity: np.ndarray) -> float:
    """Of (H, W, 2) float32 px/s: px/s. Pixels without a finite velocity (a surface in the
    camera plane) are left out."""
    return float(np.sqrt(_largest_squared(velocity)))
