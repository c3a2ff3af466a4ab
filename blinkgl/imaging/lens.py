"""A thin lens by sampling its aperture.

Through the point (a, b) of the lens a scene point (X, Y, Z), camera axes, is seen where the line from it through that
point meets the plane in focus, depth F: for a pin-hole camera at (a, b, 0) that is its own picture, moved by fx a / F
and fy b / F pixels, so that what lies at F does not move whatever the point. The mean over all points of the lens is
the image; a point at depth Z is spread over a disc of diameter ``aperture * f * |1 / Z - 1 / F|`` (fx wide, fy high).
Of a camera that distorts this is done in the flat picture that is drawn for it (:mod:`blinkgl.render.lens`).
"""

from __future__ import annotations

import math

import numpy as np

from blinkgl.camera import CameraModel, PinHole
from blinkgl.config.images import LensConfig


def blur_px(lens: LensConfig, camera: CameraModel, depth: np.ndarray) -> np.ndarray:
    """(…) diameter, px, of the disc that a point at (…) depth Z > 0 becomes; inf is a depth."""
    with np.errstate(divide="ignore"):
        return lens.aperture * camera.px_per_slope * np.abs(1.0 / np.asarray(depth, np.float64) - 1.0 / lens.focus)


def samples(largest_px: float, spacing_px: float) -> int:
    """How many points of the lens make the samples of discs of at most this diameter so far apart in the image; 1 where
    nothing is spread over a quarter of that."""
    return 1 if largest_px < spacing_px / 4 else max(4, math.ceil(math.pi / 4 * min(largest_px / spacing_px, 1e4) ** 2))


def points(count: int, diameter: float) -> np.ndarray:
    """(count, 2) float64 evenly spread over the disc, in an order in which every stretch of them is spread, too.

    Vogel's spiral, sqrt(k + 1/2) at k golden angles, in the order of the bit-reversed numbers: instants are taken in
    the order of time, and what is seen through the lens's rim must not be what is seen late."""
    bits = max(1, (count - 1).bit_length())
    order = [int(f"{k:0{bits}b}"[::-1], 2) for k in range(1 << bits)]
    k = np.array([number for number in order if number < count], np.float64)
    radius, angle = diameter / 2 * np.sqrt((k + 0.5) / count), k * math.pi * (3 - math.sqrt(5))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def through(camera: CameraModel, point: np.ndarray, focus: float) -> CameraModel:
    """The pin-hole camera at ``point`` (2,) of the lens, whose picture is in place at depth ``focus``."""
    a, b = (float(v) for v in point)
    return _drawn(camera).from_lens_point(a, b, focus)


def _drawn(camera: CameraModel) -> PinHole:
    assert isinstance(camera, PinHole)  # a renderer draws no other
    return camera


def at_point(T_world_cam: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(4, 4) pose of that camera."""
    moved = T_world_cam.copy()
    moved[:3, 3] += T_world_cam[:3, :2] @ point
    return moved


def vignette(camera: CameraModel, strength: float) -> np.ndarray:
    """(H, W) float64: share of the light that arrives, 1 - strength (1 - cos^4) of the angle between a pixel's ray and
    the optical axis."""
    y, x = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(np.stack([x, y], axis=-1))
    cosine = rays[..., 2] / np.linalg.norm(rays, axis=-1)
    return 1.0 - strength * (1.0 - np.maximum(cosine, 0.0) ** 4)
