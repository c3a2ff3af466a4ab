"""Common parts of the models with distortion: inverses by Newton's method, and bounds found along the picture's
border."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from blinkgl.camera.model import CameraModel, planes_of
from blinkgl.errors import ConfigError

STEPS = 100
"""Largest number of a solver's steps; five or six are usual, halving brackets takes about sixty where the derivative
vanishes."""
_LARGEST = 1e6  # of a coefficient, as in YAML: powers of it are finite
_GRID = 33  # grid points along each side of the picture at which the magnification is computed


def radius_limit(coefficients: tuple[float, ...]) -> float:
    """Return the smallest r > 0 with g'(r) = 0, where ``g(r) = r (1 + k1 r^2 + k2 r^4 + …)`` stops growing; inf if it
    always grows."""
    # g'(r) = 1 + 3 k1 r^2 + 5 k2 r^4 + …, a polynomial in r^2.
    slopes = [(2 * i + 3) * k for i, k in enumerate(coefficients)]
    roots = np.roots([*reversed(slopes), 1.0])
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    # The roots are squares of radii.
    return float(np.sqrt(real.min())) if len(real) else math.inf


def radial(r: np.ndarray | float, coefficients: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return ``g(r) / r = 1 + k1 r^2 + k2 r^4 + …`` and g'(r)."""
    squared = np.square(r)
    ratio, slope = np.zeros_like(squared), np.zeros_like(squared)
    for i in range(len(coefficients) - 1, -1, -1):  # Horner, from the highest power
        ratio = (ratio + coefficients[i]) * squared
        slope = (slope + (2 * i + 3) * coefficients[i]) * squared
    return 1.0 + ratio, 1.0 + slope


def radial_inverse(y: np.ndarray, coefficients: tuple[float, ...], limit: float) -> np.ndarray:
    """Return (...) r in [0, limit] with g(r) = y for (...) y >= 0; nan above g(limit).

    Newton's method inside a bracket that every step tightens. A step that would leave the bracket halves it instead;
    after many steps every other one does, because a high power slows Newton's method down. g grows up to the limit, so
    this converges from any start, quadratically except at the limit itself, where g' = 0; to the last place or two, in
    :data:`STEPS` steps at most."""
    y = np.asarray(y, np.float64)
    low, high = np.zeros_like(y), np.full_like(y, min(1.0, limit))
    # The upper end is doubled until g reaches y there, or until it is at the limit.
    for _ in range(STEPS):
        short = (high < limit) & (high * radial(high, coefficients)[0] < y)
        if not short.any():
            break
        high = np.where(short, np.minimum(2 * high, limit), high)
    end = limit * radial(np.float64(limit), coefficients)[0] if math.isfinite(limit) else math.inf
    r = np.minimum(y, high)
    for step in range(STEPS):
        ratio, slope = radial(r, coefficients)
        excess = r * ratio - y
        low, high = np.where(excess < 0, r, low), np.where(excess > 0, r, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            new = r - excess / slope
        halve = (new < low) | (new > high) | np.isnan(new) | (step > STEPS // 4 and step % 2 == 1)
        new = np.where(excess == 0, r, np.where(halve, 0.5 * (low + high), new))
        still = np.abs(new - r) > 4e-16 * r
        r = new
        if not still.any():
            break
    return np.where(y <= end, r, np.nan)


@dataclass(frozen=True)
class DistortedModel(CameraModel):
    """Base class of models that are smooth and one-to-one in the whole picture: its extreme rays are then on its
    border.

    Raises ConfigError for a picture with pixels without a ray, because the distortion folds back before its corners."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.coefficients:
            if not abs(getattr(self, name)) <= _LARGEST:
                self._refuse(name, "not a coefficient", f"a finite number, at most {_LARGEST:g}")
        sides = self._border
        blind = ~np.isfinite(self.rays(sides)).all(axis=-1)
        if blind.any():
            away = np.linalg.norm(sides - [self.cx, self.cy], axis=-1)
            raise ConfigError(
                "the distortion folds inside the image",
                where=type(self).__name__,
                value=f"{min(self.reach * min(self.fx, self.fy), away[blind].min()):.1f} px from the principal point",
                accepted=f"coefficients that are monotonic up to the image corners,  {away.max():.1f} px",
            )

    @property
    @abstractmethod
    def reach(self) -> float:
        """Radius on the image plane up to which the radial distortion grows; inf if it always grows."""

    @property
    def plane_limit(self) -> float:
        """Largest hypot(X, Y) / Z that is visible; a very large number where there is no limit."""
        return 1e18

    # ---- the border of the picture -----------------------------------------------------------------------------

    @cached_property
    def _border(self) -> np.ndarray:
        """Return (4, n, 2) px along the picture's sides (top, bottom, left, right), a pixel apart or less."""
        n = max(self.width, self.height) + 1
        x, y = np.linspace(-0.5, self.width - 0.5, n), np.linspace(-0.5, self.height - 0.5, n)
        # The edges' coordinates: left and top; bottom; right.
        ends = [np.full(n, v) for v in (-0.5, self.height - 0.5, self.width - 0.5)]
        return np.stack([np.stack(s, axis=-1) for s in ((x, ends[0]), (x, ends[1]), (ends[0], y), (ends[2], y))])

    @cached_property
    def plane_edges(self) -> tuple[float, float, float, float] | None:
        """Smallest and largest X / Z, smallest and largest Y / Z in the picture; None if it shows half of space."""
        rays = self.rays(self._border)
        if not (rays[..., 2] > 0).all():
            return None
        (left, top), (right, bottom) = _extremes(rays[..., :2] / rays[..., 2:])
        return left, right, top, bottom

    @cached_property
    def half_angle(self) -> float:
        """Largest angle between the optical axis and a visible point, rad, or slightly more."""
        rays = self.rays(self._border)
        angles = np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])
        # The border is sampled: between two samples the angle may exceed them by as much as they differ.
        return float(angles.max() + np.abs(np.diff(angles, axis=-1)).max())

    @cached_property
    def magnification(self) -> float:
        """A displacement d at depth Z > 0 moves the image by at most ``magnification * d / Z`` px."""
        # Sampled on a grid: between grid points it changes by no more than from one to the next.
        x, y = np.linspace(-0.5, self.width - 0.5, _GRID), np.linspace(-0.5, self.height - 0.5, _GRID)
        rays = self.rays(np.stack(np.meshgrid(x, y), axis=-1))
        with np.errstate(divide="ignore", invalid="ignore"):
            points = np.where(rays[..., 2:] > 0, rays / rays[..., 2:], np.nan)
        most = np.full(points.shape[:2], np.nan)
        ahead = np.isfinite(points).all(axis=-1)
        most[ahead] = largest_stretch(self.jacobian(points[ahead]))
        between = max(np.nanmax(np.abs(np.diff(most, axis=axis)), initial=0.0) for axis in (0, 1))
        return float(np.nanmax(most) + between)

    @cached_property
    def near_corner(self) -> float:
        """Distance from the camera's centre to the farthest visible point of the near plane."""
        return math.inf if self.half_angle >= math.pi / 2 else self.near / math.cos(self.half_angle)

    def frustum_planes(self) -> np.ndarray:
        """(5, 3): of the smallest pin-hole picture that contains this one; (0, 3) if this one shows half of space."""
        if self.plane_edges is None:
            return np.zeros((0, 3))
        return planes_of(*self.plane_edges)


def largest_stretch(J: np.ndarray) -> np.ndarray:
    """Return the (n,) largest singular values of (n, 2, 3) Jacobians: the largest factor on a step's length."""
    # J J^T is [[a, b], [b, c]], and the root of its larger eigenvalue is the largest singular value of J.
    a, b, c = (J[:, 0] ** 2).sum(axis=1), (J[:, 0] * J[:, 1]).sum(axis=1), (J[:, 1] ** 2).sum(axis=1)
    return np.sqrt(0.5 * (a + c) + np.hypot(0.5 * (a - c), b))


def _extremes(sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest coordinates, (2,) each, of curves through (4, n, 2) points. A curve differs
    from the chord between neighbours by an eighth of its second difference; a quarter is added."""
    bow = 0.25 * np.abs(np.diff(sides, n=2, axis=1)).max(axis=(0, 1)) if sides.shape[1] > 2 else 0.0
    return sides.min(axis=(0, 1)) - bow, sides.max(axis=(0, 1)) + bow
