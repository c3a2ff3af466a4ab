"""A rigid transform that a person gives as four rows of four."""

from __future__ import annotations

from typing import Any

import numpy as np

from blinkgl.config.base import Refused

_Row = tuple[float, float, float, float]
Matrix = tuple[_Row, _Row, _Row, _Row]
_RIGID = 1e-4


def check_rigid(matrix: Any, where: str) -> None:
    """Raises Refused for (4, 4) numbers that are no rotation and place, roundings apart."""
    T = np.array(matrix, np.float64)
    R = T[:3, :3]
    if not np.abs(T[3] - [0, 0, 0, 1]).max() < 1e-9:
        raise Refused("the last row of a pose is not 0, 0, 0, 1", where=where, value=T[3].tolist())
    orthogonal = np.abs(R @ R.T - np.eye(3)).max() < _RIGID
    if not (orthogonal and np.linalg.det(R) > 0):
        raise Refused(
            "the matrix mirrors, which no place does" if orthogonal else "the matrix is no rotation",
            where=where,
            value=np.round(R, 6).tolist(),
            accepted=f"R Rᵀ = 1 to {_RIGID:g} and determinant +1",
        )


def rigid_matrix(matrix: Any) -> np.ndarray:
    """(4, 4) float64 of what :func:`check_rigid` takes, its rounded rotation made exact."""
    T = np.array(matrix, np.float64)
    u, _, v = np.linalg.svd(T[:3, :3])
    nearest = u @ v
    if np.abs(nearest - T[:3, :3]).max() > 1e-12:
        T[:3, :3] = nearest
    T[3] = [0, 0, 0, 1]
    return T
