"""Values of labels that have more than one array."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Flow:
    """flow : (H, W, 2) float32 px, +x right, +y down, from t to t' at reference t; 0 where not valid.
    valid : (H, W) bool, something is hit and it is in front of the camera at t'.
    occluded : (H, W) bool or None, valid but not visible at t' (hidden by a surface, or outside the image)."""

    flow: np.ndarray
    valid: np.ndarray
    occluded: np.ndarray | None = None
