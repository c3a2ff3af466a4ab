"""Bounding boxes of the objects in a picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of N objects, in the scene's order, that would be visible in the picture if nothing hid them.

    instance : (N,) int64, as in ``ids``.   category : (N,) int64, as in ``semantics``.   kind : (N,) text, from its
    name.
    visible_box : (N, 4) float64 px, left, top, right, bottom edges of its visible pixels (the top-left pixel's are
    -0.5, -0.5, 0.5, 0.5); 0 where there are none.   visible_pixels : (N,) int64.
    amodal_box : (N, 4) float64 px, of all of it before the near plane, hidden and outside parts included.
    cut_box : (N, 4) float64 px, the same, clipped at the picture's edges.
    amodal_pixels : (N,) int64, pixels of the picture that would show it if nothing hid it.
    size : (N, 3) float64, of its 3-D box along that box's axes, world units.
    T_cam_box, T_world_box : (N, 4, 4) float64, from the box's axes, which are the object's, and its middle, to the
    camera's and to the world's.   occluded : (N,) float64, hidden fraction of ``amodal_pixels``.
    truncated : (N,) float64, fraction of ``amodal_box`` outside the picture.
    resolution : (2,) int64 width and height of the picture, px."""

    instance: np.ndarray
    category: np.ndarray
    kind: np.ndarray
    visible_box: np.ndarray
    visible_pixels: np.ndarray
    amodal_box: np.ndarray
    cut_box: np.ndarray
    amodal_pixels: np.ndarray
    size: np.ndarray
    T_cam_box: np.ndarray
    T_world_box: np.ndarray
    occluded: np.ndarray
    truncated: np.ndarray
    resolution: np.ndarray

    def __len__(self) -> int:
        return len(self.instance)


SHAPES: dict[str, tuple[tuple[int, ...], str]] = {
    "instance": ((), "i"),
    "category": ((), "i"),
    "kind": ((), "U"),
    "visible_box": ((4,), "f"),
    "visible_pixels": ((), "i"),
    "amodal_box": ((4,), "f"),
    "cut_box": ((4,), "f"),
    "amodal_pixels": ((), "i"),
    "size": ((3,), "f"),
    "T_cam_box": ((4, 4), "f"),
    "T_world_box": ((4, 4), "f"),
    "occluded": ((), "f"),
    "truncated": ((), "f"),
}
"""Array -> its shape after the objects' axis, NumPy's number type."""


def no_boxes() -> dict[str, Any]:
    """Return boxes of no object in a picture of this ``resolution``."""
    kinds = {"i": np.int64, "f": np.float64, "U": "U1"}
    return {name: np.zeros((0, *more), kinds[kind]) for name, (more, kind) in SHAPES.items()}
