"""``poses.npz`` of a sequence: the camera's and the objects' poses at the start and at every label."""

from __future__ import annotations

import os

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.images import checked_arrays

POSES = "poses.npz"
_SHAPES: dict[str, tuple[str, str]] = {
    "t_ns": ("T", "i"),
    "T_world_cam": ("T44", "f"),
    "K": ("33", "f"),
    "near": ("", "fi"),
}
_OF_OBJECTS: dict[str, tuple[str, str]] = {
    "object_ids": ("N", "i"),
    "object_names": ("N", "U"),
    "object_categories": ("N", "U"),
    "T_world_obj": ("NT44", "f"),
}
"""Array -> its axes, N objects and T times, and NumPy's kinds of number."""


def read_poses(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Return the arrays of ``poses.npz`` by name: t_ns (T,) int64, T_world_cam (T, 4, 4), K (3, 3), near; of objects
    object_ids (N,), object_names, object_categories and T_world_obj (N, T, 4, 4), all of them or none.

    Raises AssetError: missing, damaged, another shape or number type, NaN, no time, times that decrease."""
    poses = checked_arrays(path, _SHAPES, _OF_OBJECTS)
    if not len(poses["t_ns"]) or (np.diff(poses["t_ns"]) < 0).any():
        raise AssetError("'t_ns' is empty or decreases", where=str(path), accepted="times in order")
    return poses
