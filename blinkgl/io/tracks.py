"""``tracks.npz`` of a sequence: points on surfaces over time (:class:`blinkgl.render.tracks.Tracks` names the
arrays)."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from blinkgl.io.images import checked_arrays

TRACKS = "tracks.npz"
_SHAPES: dict[str, tuple[str, str]] = {
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
"""Array -> its axes, N points and T times, and NumPy's kind of number."""


def read_tracks(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Return the arrays of ``tracks.npz``, by name. path : the file, or the folder of its sequence.

    Raises AssetError: missing, damaged, another shape or number type."""
    path = Path(path)
    return checked_arrays(path / TRACKS if path.is_dir() else path, _SHAPES)
