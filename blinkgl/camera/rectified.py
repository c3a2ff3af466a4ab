"""The pin-hole camera that a distorted one becomes when its pictures are rectified, and the map from the one's pixels
to the other's."""

from __future__ import annotations

import numpy as np

from blinkgl.camera.model import CameraModel
from blinkgl.camera.pinhole import PinHole


def rectified(camera: CameraModel) -> PinHole:
    """The pin-hole camera of the same size and intrinsics at the same place. What of the distorted picture lies outside
    of its picture (the corners, of a lens that draws them in) is not in it."""
    return PinHole(camera.width, camera.height, *camera.intrinsics, camera.near)


def rectify_map(camera: CameraModel, to: PinHole | None = None) -> np.ndarray:
    """(H, W, 2) float32, DSEC's convention: ``map[y, x] = (x_rect, y_rect)``, where what the camera's pixel (x, y)
    shows is in the rectified picture, px; also outside of it. nan where a ray does not point forward.

    to : the rectified camera; default :func:`rectified`'s."""
    to = rectified(camera) if to is None else to
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return to.project(camera.rays(np.stack([x, y], axis=-1))).astype(np.float32)
