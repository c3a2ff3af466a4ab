"""The pin-hole picture from which a lens's picture is made: rasterisers draw only pin-hole pictures."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from blinkgl.camera.distorted import DistortedModel
from blinkgl.camera.model import CameraModel
from blinkgl.camera.pinhole import PinHole
from blinkgl.errors import ConfigError

DENSITY = 1.42
"""Pixels of the pin-hole picture per pixel of the lens's, at the place and along the direction of the smallest ratio.
It is above the square root of 2, so that no two pixels have the same nearest one."""
WIDEST = math.radians(70)
"""Largest angle from the optical axis. The size of a pin-hole picture grows with its tangent."""
LARGEST = 16384
"""Largest number of pixels along a side of the pin-hole picture."""
MARGIN = 2
"""Its additional pixels on every side of the lens's view: neighbours are read."""


def seen_through(camera: CameraModel) -> PinHole:
    """Return the pin-hole camera that is drawn for ``camera``, at the same place: ``camera`` itself, or one that
    contains the lens's whole view, with :data:`DENSITY` at least.

    Raises ConfigError for a lens whose view is too wide for one flat picture, and for models without a shader."""
    if isinstance(camera, PinHole):
        return camera
    if not camera.shader:
        camera.clip_from_cam()  # raises: it has none
    assert isinstance(camera, DistortedModel)
    return _seen_through(camera)


@lru_cache(maxsize=32)
def _seen_through(camera: DistortedModel) -> PinHole:
    x, y = np.linspace(-0.5, camera.width - 0.5, 65), np.linspace(-0.5, camera.height - 0.5, 65)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = camera.rays(xy)
    angle = float(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]).max())
    if angle > WIDEST:
        raise ConfigError(
            f"the lens sees up to {math.degrees(angle):.1f} degrees off its axis, too far for one perspective image",
            value=list(camera.distortion),
            accepted=f"at most {math.degrees(WIDEST):.0f} degrees: a longer focal length, or fewer pixels",
        )
    edges = camera.plane_edges
    assert edges is not None  # it shows less than half of space
    # d(X / Z, Y / Z) / d px: its smallest singular value tells where pixels are closest to each other.
    z = rays[:, 2, None]
    slopes = camera.ray_jacobian(xy)
    # The quotient rule on (X / Z, Y / Z).
    slopes = (slopes[:, :2] - rays[:, :2, None] / z[..., None] * slopes[:, 2:]) / z[..., None]
    focal = DENSITY / float(np.linalg.svd(slopes, compute_uv=False)[:, 1].min())
    left, right, top, bottom = edges
    x0, x1 = math.floor(left * focal) - MARGIN, math.ceil(right * focal) + MARGIN
    y0, y1 = math.floor(top * focal) - MARGIN, math.ceil(bottom * focal) + MARGIN
    if max(x1 - x0, y1 - y0) > LARGEST:
        raise ConfigError(
            f"the perspective image that this lens needs would have {x1 - x0}x{y1 - y0} px",
            value=list(camera.distortion),
            accepted=f"at most {LARGEST} along a side: less distortion, or fewer pixels",
        )
    # x0 and y0 are edges of the first pixel, whose centre, pixel 0, lies half a pixel further.
    cx, cy = -x0 - 0.5, -y0 - 0.5
    return PinHole(x1 - x0, y1 - y0, fx=focal, fy=focal, cx=cx, cy=cy, near=camera.near)
