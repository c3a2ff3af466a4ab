"""Boxes of objects (:class:`blinkgl.types.boxes.Boxes`): ``boxes/000000.npz``, all arrays by name, and
``boxes_kitti/000000.txt``, a line per object that is seen, in the fields of KITTI's labels:

    type truncated occluded alpha left top right bottom height width length x y z rotation_y

type : what the name says (spaces become _).   truncated : share of the whole box outside the picture.
occluded : 0 less than a twentieth of it is hidden, 1 less than half, 2 more.   alpha, rotation_y : rad in (-pi, pi].
left … bottom : px of the whole box, cut at the picture's edges.   height, width, length : along the box's z, y, x.
x, y, z : middle of the box's lower face, camera axes.

KITTI's boxes stand upright before a level camera: rotation_y is the turn of the box's x axis about the camera's y axis,
and says all of the turn of such boxes alone. The .npz has the whole pose.
"""

from __future__ import annotations

import os

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.images import NpzReader, encoded, numpy_errors
from blinkgl.types.boxes import SHAPES, Boxes

_PARTLY, _LARGELY = 0.05, 0.5


def encode_boxes(value: Boxes) -> bytes:
    """Return the bytes of the .npz; they do not depend on the clock."""
    return encoded(np.savez, **{name: getattr(value, name) for name in (*SHAPES, "resolution")})


def read_boxes(path: str | os.PathLike) -> Boxes:
    """Return the boxes of a file. Raises AssetError: missing, damaged, arrays of another shape or number type."""
    with numpy_errors(path), NpzReader(path) as file:
        arrays, resolution = {name: file[name] for name in SHAPES}, file["resolution"]
    if resolution.shape != (2,) or resolution.dtype.kind != "i":
        raise AssetError("no width and height", where=str(path), value=f"{resolution.dtype} {resolution.shape}")
    count = arrays["instance"].shape[:1]
    for name, (more, kind) in SHAPES.items():
        if arrays[name].shape != (*count, *more) or arrays[name].dtype.kind != kind:
            raise AssetError(
                f"'{name}' has the wrong shape or type",
                where=str(path),
                value=f"{arrays[name].dtype} {arrays[name].shape}",
                accepted=f"({', '.join(map(str, (*count, *more)))})",
            )
    return Boxes(**arrays, resolution=resolution)


def kitti_text(value: Boxes) -> str:
    """Return a line per visible object."""
    lines = []
    for k in np.flatnonzero(value.visible_pixels > 0):
        T, (length, width, height) = value.T_cam_box[k], value.size[k]
        x, y, z = T[:3, 3] - T[:3, 2] * height / 2
        # A turn by r about y takes (1, 0, 0) to (cos r, 0, -sin r).
        turn = float(-np.arctan2(T[2, 0], T[0, 0]))
        # The turn as seen along the ray to the box; sine and cosine bring the difference into (-pi, pi].
        alpha = np.arctan2(np.sin(turn - np.arctan2(x, z)), np.cos(turn - np.arctan2(x, z)))
        hidden = int(np.searchsorted([_PARTLY, _LARGELY], value.occluded[k], side="right"))
        box = value.cut_box[k]
        numbers = (alpha, *box, height, width, length, x, y, z, turn)
        kind = str(value.kind[k]).replace(" ", "_")
        lines.append(f"{kind} {value.truncated[k]:.2f} {hidden} " + " ".join(f"{number:.2f}" for number in numbers))
    return "".join(line + "\n" for line in lines)
