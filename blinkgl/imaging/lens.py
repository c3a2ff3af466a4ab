"""A thin lens, by sampling its aperture.

Through the point (a, b) of the lens, a scene point (X, Y, Z), camera axes, is imaged where the line between them meets
the plane in focus, at depth F. For a pinhole camera at (a, b, 0) that is its own picture, shifted by fx a / F and fy b
/ F pixels, so that points at depth F do not move for any lens point. The mean over all points of the lens is the image;
a point at depth Z becomes a disc of diameter ``aperture * f * |1 / Z - 1 / F|`` (fx wide, fy high). For a camera with
distortion this is done in its pinhole picture (:mod:`blinkgl.render.lens`).
"""

from __future__ import annotations

import math

import numpy as np

from blinkgl.camera import CameraModel, PinHole
from blinkgl.config.images import LensConfig


def blur_px(lens: LensConfig, camera: CameraModel, depth: np.ndarray) -> np.ndarray:
    """Return the diameter, px, of the disc of a point at depth Z > 0, (…); inf is a depth."""
    with np.errstate(divide="ignore"):
        return lens.aperture * camera.px_per_slope * np.abs(1.0 / np.asarray(depth, np.float64) - 1.0 / lens.focus)


def samples(largest_px: float, spacing_px: float) -> int:
    """Return the number of lens points that gives discs of at most this diameter samples with this spacing; 1 where the
    diameter is below a quarter of it."""
    # A disc of diameter D has room for pi / 4 (D / d)^2 points at a spacing of d.
    return 1 if largest_px < spacing_px / 4 else max(4, math.ceil(math.pi / 4 * min(largest_px / spacing_px, 1e4) ** 2))


def points(count: int, diameter: float) -> np.ndarray:
    """Return (count, 2) float64 evenly distributed over the disc, in an order in which every section is also
    distributed.

    Vogel's spiral, sqrt(k + 1/2) at k golden angles, in the order of the bit-reversed numbers: instants are taken in
    the order of time, so the lens point must not depend on time."""
    bits = max(1, (count - 1).bit_length())
    # 0, 4, 2, 6, 1, … of eight: numbers that are not below ``count`` are left out.
    order = [int(f"{k:0{bits}b}"[::-1], 2) for k in range(1 << bits)]
    k = np.array([number for number in order if number < count], np.float64)
    # The square root gives every point the same area; pi (3 - sqrt(5)) is the golden angle.
    radius, angle = diameter / 2 * np.sqrt((k + 0.5) / count), k * math.pi * (3 - math.sqrt(5))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def through(camera: CameraModel, point: np.ndarray, focus: float) -> CameraModel:
    """Return the pinhole camera at ``point`` (2,) of the lens, whose picture is aligned at depth ``focus``."""
    assert isinstance(camera, PinHole)  # the renderer draws no other
    a, b = (float(v) for v in point)
    return camera.from_lens_point(a, b, focus)


def at_point(T_world_cam: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the pose of that camera, (4, 4)."""
    moved = T_world_cam.copy()
    # Columns 0 and 1 of the pose are the axes of the plane of the lens.
    moved[:3, 3] += T_world_cam[:3, :2] @ point
    return moved


def vignette(camera: CameraModel, strength: float) -> np.ndarray:
    """Return the fraction of the light that arrives, (H, W) float64: 1 - strength (1 - cos^4) of the angle between a
    pixel's ray and the optical axis."""
    y, x = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(np.stack([x, y], axis=-1))
    cosine = rays[..., 2] / np.linalg.norm(rays, axis=-1)
    return 1.0 - strength * (1.0 - np.maximum(cosine, 0.0) ** 4)
