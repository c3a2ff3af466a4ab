"""Radial and tangential distortion (Brown 1966), as in OpenCV's ``projectPoints`` and Kalibr's ``radtan``.

A point at (x, y) = (X / Z, Y / Z), r^2 = x^2 + y^2, appears where a pin-hole camera shows (x', y') with

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y.

The model is valid where that is one-to-one: while the radial part grows with r and the derivative keeps its
orientation. The polynomial has values beyond, which OpenCV returns; here such a point is not visible (nan).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from blinkgl.camera.distorted import STEPS, DistortedModel, radial, radial_inverse, radius_limit


@dataclass(frozen=True)
class Radtan(DistortedModel):
    """Camera with this distortion. Coefficients without unit, in OpenCV's order: k1, k2, p1, p2, k3. Rays have Z =
    1."""

    kind: ClassVar[str] = "radtan"
    shader: ClassVar[str] = "RADTAN"
    coefficients: ClassVar[tuple[str, ...]] = ("k1", "k2", "p1", "p2", "k3")

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @cached_property
    def _limit(self) -> float:
        return radius_limit((self.k1, self.k2, self.k3))

    @property
    def plane_limit(self) -> float:
        return min(self._limit, 1e18)

    @property
    def reach(self) -> float:
        """g(limit) of the radial part."""
        return (
            self._limit * float(radial(np.float64(self._limit), (self.k1, self.k2, self.k3))[0])
            if math.isfinite(self._limit)
            else math.inf
        )

    def _distort(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (n, 2) distorted points and their (n, 2, 2) derivative, of (n, 2) points of the image plane; nan where
        it is not one-to-one."""
        x, y = u[:, 0], u[:, 1]
        r2 = x * x + y * y
        ratio = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        slope = self.k1 + r2 * (2 * self.k2 + 3 * r2 * self.k3)  # d ratio / d r²
        out = np.stack(
            [
                x * ratio + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
                y * ratio + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
            ],
            axis=-1,
        )
        # The derivative is symmetric: both parts of the distortion are gradients.
        cross = 2 * (x * y * slope + self.p1 * x + self.p2 * y)
        D = np.empty((len(u), 2, 2))
        D[:, 0, 0] = ratio + 2 * x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x
        D[:, 1, 1] = ratio + 2 * y * y * slope + 6 * self.p1 * y + 2 * self.p2 * x
        D[:, 0, 1] = D[:, 1, 0] = cross
        # The map is one-to-one while both leading minors of its symmetric derivative are positive.
        inside = (np.sqrt(r2) < self._limit) & (D[:, 0, 0] > 0) & (D[:, 0, 0] * D[:, 1, 1] > cross * cross)
        out[~inside], D[~inside] = np.nan, np.nan
        return out, D

    def _undistort(self, d: np.ndarray) -> np.ndarray:
        """Return the (n, 2) points of the image plane that are distorted to (n, 2) d; nan where there are none.

        Newton's method in the plane, from the inverse of the radial part alone. Each point's step is halved while it
        would leave the domain or not come nearer. It converges quadratically, to about 1e-15, wherever the radial part
        keeps growing; beyond, nan."""
        distance = np.linalg.norm(d, axis=1)
        r = radial_inverse(distance, (self.k1, self.k2, self.k3), self._limit)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = d * np.where(distance > 0, r / distance, 1.0)[:, None]
        # Without a tangential part the radial inverse is the whole inverse.
        if self.p1 == 0.0 and self.p2 == 0.0:
            return np.where((distance <= self.reach)[:, None] & (np.hypot(u[:, :1], u[:, 1:]) < self._limit), u, np.nan)
        at, D = self._distort(u)
        lost = np.isnan(at[:, 0])
        # A start outside the domain (the tangential part may bring it back): start in the middle, where the model is
        # the identity.
        u[lost] = 0.0
        at[lost], D[lost] = self._distort(u[lost])
        error, scale = at - d, np.ones(len(u))
        size = np.linalg.norm(error, axis=1)
        for _ in range(STEPS):
            # Points that are not solved to rounding and whose step has not been halved to nothing.
            active = (size > 1e-15 * (1 + distance)) & (scale > 1e-9)
            if not active.any():
                break
            k = np.flatnonzero(active)
            trial = u[k] - scale[k, None] * np.linalg.solve(D[k], error[k, :, None])[:, :, 0]
            at, slopes = self._distort(trial)
            nearer = np.linalg.norm(at - d[k], axis=1) < size[k]  # False for nan
            good = k[nearer]
            u[good], D[good], error[good] = trial[nearer], slopes[nearer], at[nearer] - d[good]
            size[good] = np.linalg.norm(error[good], axis=1)
            # After a step that came nearer the next one is twice as long, up to Newton's own; after another it is half.
            scale[k] = np.where(nearer, np.minimum(1.0, 2 * scale[k]), 0.5 * scale[k])
        return np.where((size <= 1e-12 * (1 + distance))[:, None], u, np.nan)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return (..., 2) px; nan for Z <= 0 and outside the domain."""
        points = np.asarray(points, np.float64)
        flat = points.reshape(-1, 3)
        u = flat[:, :2] / np.where(flat[:, 2:] > 0, flat[:, 2:], np.nan)
        return (self._distort(u)[0] * [self.fx, self.fy] + [self.cx, self.cy]).reshape(*points.shape[:-1], 2)

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return (..., 2, 3), by the chain rule."""
        points = np.asarray(points, np.float64)
        flat = points.reshape(-1, 3)
        z = np.where(flat[:, 2] > 0, flat[:, 2], np.nan)
        u = flat[:, :2] / z[:, None]
        # The derivative of (X / Z, Y / Z) by (X, Y, Z).
        flattening = np.zeros((len(flat), 2, 3))
        flattening[:, 0, 0] = flattening[:, 1, 1] = 1 / z
        flattening[:, :, 2] = -u / z[:, None]
        out = np.array([[self.fx], [self.fy]]) * (self._distort(u)[1] @ flattening)
        return out.reshape(*points.shape[:-1], 2, 3)

    def rays(self, xy: np.ndarray) -> np.ndarray:
        """Return (..., 3) with Z = 1; nan where there is no ray."""
        xy = np.asarray(xy, np.float64)
        u = self._undistort(((xy - [self.cx, self.cy]) / [self.fx, self.fy]).reshape(-1, 2))
        return np.concatenate([u, np.where(np.isnan(u[:, :1]), np.nan, 1.0)], axis=1).reshape(*xy.shape[:-1], 3)

    def ray_jacobian(self, xy: np.ndarray) -> np.ndarray:
        """Return (..., 3, 2), the inverse of the distortion's derivative."""
        xy = np.asarray(xy, np.float64)
        u = self.rays(xy).reshape(-1, 3)[:, :2]
        D = self._distort(u)[1]
        # Cramer's rule, through which the nan of a pixel without a ray passes.
        inverse = np.stack([D[:, 1, 1], -D[:, 0, 1], -D[:, 1, 0], D[:, 0, 0]], axis=-1).reshape(-1, 2, 2)
        inverse /= (D[:, 0, 0] * D[:, 1, 1] - D[:, 0, 1] * D[:, 1, 0])[:, None, None]
        # Z of a ray is always 1, so its row is 0, and nan where there is no ray.
        out = np.concatenate([inverse / [self.fx, self.fy], 0.0 * inverse[:, :1]], axis=1)
        return out.reshape(*xy.shape[:-1], 3, 2)
