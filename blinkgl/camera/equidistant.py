"""The fisheye model of Kannala and Brandt (2006), as in OpenCV's ``fisheye`` and Kalibr's ``equidistant``.

A point whose direction makes the angle theta with the optical axis has the distance

    theta' = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

from the principal point (times fx in x, fy in y), in the direction of (X, Y). The angle is
atan2(hypot(X, Y), Z), up to 180 degrees, so a camera may show more than half of space (OpenCV uses atan of the tangent,
so it cannot). The model is valid while theta' grows with theta; points beyond are not visible (nan).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from blinkgl.camera.distorted import DistortedModel, radial, radial_inverse, radius_limit


@dataclass(frozen=True)
class Equidistant(DistortedModel):
    """Fisheye camera. Coefficients without unit: k1 … k4. Rays are unit vectors; beyond 90 degrees their Z is <= 0."""

    kind: ClassVar[str] = "equidistant"
    shader: ClassVar[str] = "EQUIDISTANT"
    coefficients: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "k4")

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @property
    def _k(self) -> tuple[float, ...]:
        return self.k1, self.k2, self.k3, self.k4

    @cached_property
    def _limit(self) -> float:
        """Return the largest angle, rad."""
        # No direction is farther from the axis than straight back.
        return min(math.pi, radius_limit(self._k))

    @property
    def plane_limit(self) -> float:
        # Directions at 90 degrees or more have no point on the plane Z = 1, so it sets no limit.
        return min(math.tan(self._limit), 1e18) if self._limit < math.pi / 2 else 1e18

    @property
    def reach(self) -> float:
        """theta' of the largest angle."""
        return self._limit * float(radial(np.float64(self._limit), self._k)[0])

    def _polar(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return rho, cos and sin of the direction of (X, Y) (1, 0 on the axis), and theta; nan where the model is not
        valid."""
        x, y, z = np.moveaxis(points, -1, 0)
        rho = np.hypot(x, y)
        theta = np.arctan2(rho, z)
        # The centre of the camera has no direction, so it is nan as well.
        theta = np.where((theta < self._limit) & (rho + np.abs(z) > 0), theta, np.nan)
        off = rho > 0
        return (
            rho,
            np.divide(x, rho, out=np.ones_like(rho), where=off),
            np.divide(y, rho, out=np.zeros_like(rho), where=off),
            theta,
        )

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return (..., 2) px; nan beyond the largest angle."""
        points = np.asarray(points, np.float64)
        _, c, s, theta = self._polar(points)
        distance = theta * radial(theta, self._k)[0]
        return np.stack([self.fx * distance * c + self.cx, self.fy * distance * s + self.cy], axis=-1)

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return (..., 2, 3): theta' changes along (X, Y) with d theta = (Z d rho - rho dZ) / R^2, and across it with 1
        / rho."""
        points = np.asarray(points, np.float64)
        rho, c, s, theta = self._polar(points)
        z = points[..., 2]
        squared = rho**2 + z**2
        ratio, slope = radial(theta, self._k)
        along = slope * z / squared
        with np.errstate(divide="ignore", invalid="ignore"):
            across = np.where(rho > 0, theta * ratio / rho, 1 / z)  # the limit on the axis
        out = np.empty((*z.shape, 2, 3))
        # With d = (c, s) the derivative is along d d^T + across (I - d d^T): along the radius and across it.
        out[..., 0, 0] = along * c * c + across * s * s
        out[..., 1, 1] = along * s * s + across * c * c
        out[..., 0, 1] = out[..., 1, 0] = (along - across) * c * s
        out[..., 0, 2], out[..., 1, 2] = -slope * rho / squared * c, -slope * rho / squared * s
        out[np.isnan(theta)] = np.nan
        return np.array([[self.fx], [self.fy]]) * out

    def _angles(self, xy: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the distance on the image plane, cos and sin of the direction, and theta; nan where the model has no
        ray."""
        u, v = np.moveaxis((xy - [self.cx, self.cy]) / [self.fx, self.fy], -1, 0)
        distance = np.hypot(u, v)
        off = distance > 0
        cos, sin = (
            np.divide(w, distance, out=np.full_like(distance, on_axis), where=off)
            for w, on_axis in ((u, 1.0), (v, 0.0))
        )
        return distance, cos, sin, radial_inverse(distance, self._k, self._limit)

    def rays(self, xy: np.ndarray) -> np.ndarray:
        """Return (..., 3) unit vectors; nan where there is no ray."""
        _, c, s, theta = self._angles(np.asarray(xy, np.float64))
        return np.stack([np.sin(theta) * c, np.sin(theta) * s, np.cos(theta)], axis=-1)

    def ray_jacobian(self, xy: np.ndarray) -> np.ndarray:
        """Return (..., 3, 2): along the direction d theta = d theta' / slope of theta', across it sin theta /
        theta'."""
        distance, c, s, theta = self._angles(np.asarray(xy, np.float64))
        slope = radial(theta, self._k)[1]
        across = np.divide(np.sin(theta), distance, out=np.ones_like(distance), where=distance > 0)
        # Split along the radius and across it, as in ``jacobian``.
        out = np.empty((*distance.shape, 3, 2))
        along = np.cos(theta) / slope
        out[..., 0, 0] = along * c * c + across * s * s
        out[..., 1, 1] = along * s * s + across * c * c
        out[..., 0, 1] = out[..., 1, 0] = (along - across) * c * s
        # Z = cos theta, so dZ = -sin theta d theta, along the radius only.
        out[..., 2, 0], out[..., 2, 1] = -np.sin(theta) / slope * c, -np.sin(theta) / slope * s
        out[np.isnan(theta)] = np.nan
        return out / [self.fx, self.fy]
