"""Rigid poses as (4, 4) float64 matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def pose_of(position: ArrayLike = (0.0, 0.0, 0.0), axes: ArrayLike | None = None) -> np.ndarray:
    """Return the (4, 4) float64 matrix with these ``axes``, (3, 3), in its columns (None: unchanged), at
    ``position``, (3,)."""
    T = np.eye(4)
    T[:3, 3] = position
    if axes is not None:
        T[:3, :3] = axes
    return T
