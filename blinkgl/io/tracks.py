"""``tracks.npz`` of a sequence: points on surfaces, followed (:class:`blinkgl.render.tracks.Tracks` names the
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
    """The arrays of ``tracks.npz``, by name. path : the file, or the folder of its sequence.

    Raises AssetError: missing, damaged, another shape or kind of number."""
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


def problem_of(arrays: dict[str, np.ndarray], height: int, width: int, instances: set[int]) -> str | None:
    """What cannot be in the tracks of a scene with these instances, in words; None: nothing."""
    if not all(np.isfinite(arrays[name]).all() for name, (_, kind) in _SHAPES.items() if kind == "f"):
        return "a number that is not finite"
    if strange := set(np.unique(arrays["instance"]).tolist()) - instances:
        return f"instance {min(strange)}, which the scene does not have"
    seen = arrays["target_points"][~arrays["occluded"]]
    if not ((seen >= -0.5) & (seen < [width - 0.5, height - 0.5])).all():
        return "a point that is seen outside the image"
    number = arrays["query_points"][:, 0]
    if len(number) and not ((number >= 0) & (number < len(arrays["t_us"])) & (number % 1 == 0)).all():
        return "a query at a time that is none of the tracks'"
    return None
