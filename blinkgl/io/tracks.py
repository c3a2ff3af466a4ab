"""``tracks.npz`` of a sequence: points on surfaces over time (:class:`blinkgl.render.tracks.Tracks` names the
arrays)."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError

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
    path = path / TRACKS if path.is_dir() else path
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in _SHAPES}
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise AssetError(f"no tracks: {' '.join(str(error).split())[:120]}", where=str(path)) from None
    sizes = {"N": len(arrays["query_points"]), "T": len(arrays["t_us"])}
    for name, (axes, kind) in _SHAPES.items():
        shape = tuple(sizes[a] if a in sizes else int(a) for a in axes)
        if arrays[name].shape != shape or arrays[name].dtype.kind != kind:
            raise AssetError(
                f"'{name}' has the wrong shape or type",
                where=str(path),
                value=f"{arrays[name].dtype} {arrays[name].shape}",
                accepted=str(shape),
            )
    return arrays
