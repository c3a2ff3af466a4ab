"""What a sequence tells of the times of its poses: ``poses.npz`` (camera and objects), ``tracks.npz`` (points on
surfaces; :class:`blinkgl.render.tracks.Tracks` names the arrays) and ``lights.npz`` (light that changes)."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.images import checked_arrays

POSES, TRACKS, LIGHTS = "poses.npz", "tracks.npz", "lights.npz"
_POSES: dict[str, tuple[str, str]] = {
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
_TRACKS: dict[str, tuple[str, str]] = {
    "t_us": ("T", "i"),
    "query_points": ("N3", "f"),
    "target_points": ("NT2", "f"),
    "occluded": ("NT", "b"),
    "points_world": ("NT3", "f"),
    "depth": ("NT", "f"),
    "instance": ("N", "u"),
    "surface": ("N2", "i"),
    "weights": ("N3", "f"),
}
_LIGHTS: dict[str, tuple[str, str]] = {
    "t_ns": ("T", "i"),
    "names": ("N", "U"),
    "factors": ("NT", "f"),
    "jump_t_ns": ("J", "i"),
    "jump_light": ("J", "i"),
    "jump_factor": ("J", "f"),
}
"""Array -> its axes, T times and N objects, points or lights, J jumps, and NumPy's kinds of number."""


def read_poses(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Return the arrays of ``poses.npz`` by name: t_ns (T,) int64, of the start and every label, T_world_cam (T, 4, 4),
    K (3, 3), near; of objects object_ids (N,), object_names, object_categories and T_world_obj (N, T, 4, 4), all of
    them or none. path : the file, or the folder of its sequence.

    Raises AssetError: missing, damaged, another shape or number type, NaN, no time, times that decrease."""
    path = _file(path, POSES)
    poses = checked_arrays(path, _POSES, _OF_OBJECTS)
    if not len(poses["t_ns"]) or (np.diff(poses["t_ns"]) < 0).any():
        raise AssetError("'t_ns' is empty or decreases", where=str(path), accepted="times in order")
    return poses


def read_tracks(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Return the arrays of ``tracks.npz``, by name. path : the file, or the folder of its sequence.

    Raises AssetError: missing, damaged, another shape or number type."""
    return checked_arrays(_file(path, TRACKS), _TRACKS)


def read_lights(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Return the arrays of ``lights.npz``, by name: t_ns (T,) of the poses, the start and every label's time;
    names (N,) of the lights; factors (N, T) float64 by which they shine; jump_t_ns (J,) at which one jumps, increasing,
    jump_light (J,) its number among the names, jump_factor (J,) what it jumps to. An event of a jump has its
    microsecond, jump_t_ns // 1000, from an emulator without a low-pass.
    path : the file, or the folder of its sequence.

    Raises AssetError: missing, damaged, another shape or number type."""
    return checked_arrays(_file(path, LIGHTS), _LIGHTS)


def _file(path: str | os.PathLike, name: str) -> Path:
    return Path(path) / name if Path(path).is_dir() else Path(path)
