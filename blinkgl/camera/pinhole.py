"""The pin-hole camera: ``x = fx X / Z + cx``, ``y = fy Y / Z + cy``."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from blinkgl.camera.model import CameraModel, planes_of


def focal_length(size: float, angle: float) -> float:
    """Return the focal length, px, of a pin-hole camera whose view is ``angle`` rad across ``size`` px, centred on the
    optical axis."""
    return 0.5 * size / math.tan(angle / 2)


@dataclass(frozen=True)
class PinHole(CameraModel):
    """Pin-hole camera: a point (X, Y, Z), Z > 0, is visible at (fx X / Z + cx, fy Y / Z + cy). Rays have Z = 1."""

    kind: ClassVar[str] = "pinhole"

    @classmethod
    def centred(cls, width: int, height: int, fx: float, fy: float | None = None, near: float = 0.05) -> PinHole:
        """Return a camera with the principal point in the middle of the image; ``fy``: default fx."""
        # Pixel centres are at whole numbers, so the middle of the image is at (size - 1) / 2.
        return cls(width, height, fx, fx if fy is None else fy, (width - 1) / 2, (height - 1) / 2, near)

    def from_lens_point(self, a: float, b: float, focus: float) -> PinHole:
        """Return the camera of a point (a, b) of a lens in front of this camera, focused at depth ``focus``: its centre
        is (a, b, 0), and its picture is shifted."""
        # The picture is shifted by the parallax at ``focus``, so that points in focus keep their pixels.
        return replace(self, cx=self.cx + self.fx * a / focus, cy=self.cy + self.fy * b / focus)

    @property
    def px_per_slope(self) -> float:
        """Largest distance, px, by which a point's image moves when X / Z or Y / Z changes by 1."""
        return max(self.fx, self.fy)

    def project(self, points: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
        z = np.where(z > 0, z, np.nan)
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=-1)

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
        z = np.where(z > 0, z, np.nan)
        out = np.zeros((*z.shape, 2, 3))
        out[..., 0, 0], out[..., 0, 2] = self.fx / z, -self.fx * x / z**2
        out[..., 1, 1], out[..., 1, 2] = self.fy / z, -self.fy * y / z**2
        # There are no cross terms, but they are nan where the point is not visible.
        out[..., 0, 1] = out[..., 1, 0] = np.where(z > 0, 0.0, np.nan)
        return out

    def rays(self, xy: np.ndarray) -> np.ndarray:
        xy = np.asarray(xy, np.float64)
        out = np.ones((*xy.shape[:-1], 3))
        out[..., :2] = (xy - [self.cx, self.cy]) / [self.fx, self.fy]
        return out

    def ray_jacobian(self, xy: np.ndarray) -> np.ndarray:
        return np.broadcast_to([[1 / self.fx, 0.0], [0.0, 1 / self.fy], [0.0, 0.0]], (*np.shape(xy)[:-1], 3, 2)).copy()

    def displacement(self, rays: np.ndarray, depth: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Computed without a difference of two projections: rays (r, 1) give ``f (d - r dZ) / (Z + dZ)``."""
        after = depth + change[:, 2]
        after = np.where((depth > 0) & (after > 0), after, np.nan)
        return np.array([self.fx, self.fy]) * (change[:, :2] - rays[:, :2] * change[:, 2:]) / after[:, None]

    def _edge(self) -> tuple[float, float]:
        """Return |X / Z| and |Y / Z| of the picture's farthest corner from the optical axis."""
        return max(self.cx + 0.5, self.width - 0.5 - self.cx) / self.fx, max(
            self.cy + 0.5, self.height - 0.5 - self.cy
        ) / self.fy

    @property
    def half_angle(self) -> float:
        return float(np.arctan(np.hypot(*self._edge())))

    @property
    def magnification(self) -> float:
        # Z times the Jacobian is f (1, 0, -u; 0, 1, -v), with the largest singular value f sqrt(1 + u^2 + v^2).
        return float(max(self.fx, self.fy) * np.sqrt(1 + np.hypot(*self._edge()) ** 2))

    @property
    def near_corner(self) -> float:
        x, y = self._edge()
        # The ray (x, y, 1) meets the near plane at near times its own length.
        return self.near * math.sqrt(1 + x * x + y * y)

    def frustum_planes(self) -> np.ndarray:
        """(5, 3): left, right, top, bottom and the plane through the centre."""
        left, right = (-0.5 - self.cx) / self.fx, (self.width - 0.5 - self.cx) / self.fx
        top, bottom = (-0.5 - self.cy) / self.fy, (self.height - 0.5 - self.cy) / self.fy
        return planes_of(left, right, top, bottom)

    def bounds(self, points: np.ndarray) -> tuple[int, int, int, int] | None:
        """Return (x0, y0, x1, y1): the convex hull of (n, 3) points can touch only pixels x0 <= x < x1, y0 <= y < y1,
        with a margin of a pixel on every side. The whole image if the hull meets the near plane; None if it is outside
        the picture."""
        # Of a convex body in front of the camera the corners are the extreme points of the image.
        z = points[:, 2]
        if z.min() <= self.near:
            return (0, 0, self.width, self.height) if z.max() > self.near else None
        # Not by `project`, to save time: this runs for every moving body in every frame, and no point here is behind
        # the camera.
        x, y = self.fx * points[:, 0] / z + self.cx, self.fy * points[:, 1] / z + self.cy
        # A pixel of margin on each side; x1 and y1 are exclusive.
        x0, x1 = max(0, math.floor(x.min()) - 1), min(self.width, math.ceil(x.max()) + 2)
        y0, y1 = max(0, math.floor(y.min()) - 1), min(self.height, math.ceil(y.max()) + 2)
        return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None

    def clip_from_cam(self) -> np.ndarray:
        """Return (4, 4) float64: x right, y down, w = Z, depth = near / Z (reversed, the far plane at infinity).

        A point at pixel x = fx X / Z + cx has the window coordinate x + 0.5, thus ndc 2 (x + 0.5) / width - 1."""
        w, h = self.width, self.height
        return np.array(
            [
                [2 * self.fx / w, 0.0, 2 * (self.cx + 0.5) / w - 1, 0.0],
                [0.0, 2 * self.fy / h, 2 * (self.cy + 0.5) / h - 1, 0.0],
                [0.0, 0.0, 0.0, self.near],
                [0.0, 0.0, 1.0, 0.0],
            ]
        )


# ---------------------------------------------------------------------------------------------------------------------
# Rectification of a distorted camera's pictures: the pin-hole camera, and the map between the two cameras' pixels.


def rectified(camera: CameraModel) -> PinHole:
    """Return the pin-hole camera of the same size and intrinsics at the same place. Parts of the distorted picture may
    lie outside its picture (the corners, for barrel distortion)."""
    return PinHole(camera.width, camera.height, *camera.intrinsics, camera.near)


def rectify_map(camera: CameraModel, to: PinHole | None = None) -> np.ndarray:
    """Return the (H, W, 2) float32 map, DSEC's convention: ``map[y, x] = (x_rect, y_rect)``, the position, px, in the
    rectified picture of what the camera's pixel (x, y) shows; also outside of it. nan where a ray does not point
    forward.

    to : the rectified camera; default :func:`rectified`'s."""
    to = rectified(camera) if to is None else to
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return to.project(camera.rays(np.stack([x, y], axis=-1))).astype(np.float32)
