"""Errors of a drawn label against the float64 reference: (drawn, true, label interval in s) -> (H, W) float64 >= 0."""

from __future__ import annotations

import numpy as np


def length(difference: np.ndarray) -> np.ndarray:
    """Return lengths, (H, W), of (H, W) or (H, W, C)."""
    return np.linalg.norm(difference, axis=-1) if difference.ndim == 3 else np.abs(difference)


def absolute(drawn: np.ndarray, true: np.ndarray, interval_s: float) -> np.ndarray:
    """Return the error in the label's unit. No error where both are infinite."""
    both = np.isinf(drawn) & (drawn == true)
    return length(np.where(both, 0.0, drawn.astype(np.float64) - np.where(both, 0.0, true)))


def relative(drawn: np.ndarray, true: np.ndarray, interval_s: float) -> np.ndarray:
    """Return the relative error of (H, W). Equal values have no error, also where both are 0 or infinite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.abs(drawn / true - 1.0)
    return np.where(drawn == true, 0.0, error)


def different(drawn: np.ndarray, true: np.ndarray, interval_s: float) -> np.ndarray:
    """Return 1 where they are not equal."""
    return (drawn != true).astype(np.float64)


def motion(drawn: np.ndarray, true: np.ndarray, interval_s: float) -> np.ndarray:
    """Return px; for motions longer than 100 px, px per 100 px, because float32 rounds in proportion."""
    return length(drawn.astype(np.float64) - true) / np.maximum(1.0, length(true) / 100.0)


def motion_per_interval(drawn: np.ndarray, true: np.ndarray, interval_s: float) -> np.ndarray:
    """Return :func:`motion` of px/s over a label interval."""
    return motion(drawn * interval_s, true * interval_s, interval_s)
