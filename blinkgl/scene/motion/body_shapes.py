"""Collision shapes of a body: its parts as convex solids that MuJoCo supports, chosen from the mesh."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from blinkgl.config.physics import BodyConfig
from blinkgl.machine.kernels import kernel
from blinkgl.scene.shapes.sweep import filled
from blinkgl.scene.types import SceneObject

_MOST_PARTS = 24  # an object with more parts gets one common hull


@dataclass(frozen=True)
class Barrier:
    """An infinite invisible plane that nothing passes: points x with ``normal . x >= offset`` are inside."""

    normal: tuple[float, float, float]
    offset: float


@dataclass(frozen=True, eq=False)
class Shape:
    """A convex solid in a body's axes. kind : MuJoCo's, BOX, SPHERE, PLANE or MESH.   size : in MuJoCo's form: half
    edges, radius.   vertices : (V, 3) of a MESH's hull."""

    kind: str
    size: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)
    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    vertices: np.ndarray | None = None

    @property
    def quaternion(self) -> np.ndarray:
        return quaternions(self.rotation[None])[0]

    def moved(self, T: np.ndarray) -> Shape:
        return replace(self, position=T[:3, :3] @ self.position + T[:3, 3], rotation=T[:3, :3] @ self.rotation)


def shapes_of(obj: SceneObject, config: BodyConfig) -> list[Shape]:
    """Return an object's collision shapes in its axes: one per part; of a deforming one the hull of all its shapes."""
    parts = [filled(part.mesh)[0] for part in obj.parts if len(part.mesh.faces)]
    if len(parts) > _MOST_PARTS:
        parts = [np.concatenate(parts)]
    # A flat ground is an infinite plane, so that nothing falls off.
    if obj.category == "ground" and config.kind == "fixed" and len(parts) == 1:
        mesh = next(part.mesh for part in obj.parts if len(part.mesh.faces))
        centre, axes, extent = _framed(parts[0])
        if extent[2] < 1e-6 * extent[0]:
            up = axes[:, 2] * (1.0 if float(mesh.normals.mean(axis=0) @ axes[:, 2]) >= 0 else -1.0)
            return [plane_of(Barrier(tuple(up), float(up @ centre)))]
    return [_solid(points) for points in parts]


def _solid(points: np.ndarray) -> Shape:
    """Return a box or a ball where the points form one, to rounding; else their convex hull."""
    low, high = points.min(axis=0), points.max(axis=0)
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    radii = np.linalg.norm(points - centre, axis=1)
    # Flat in its smallest principal direction: a thin box.
    middle, axes, extent = _framed(points)
    if extent[2] < 0.005 * extent[0]:
        return Shape("BOX", np.maximum(extent, 0.01 * extent.max()), middle, axes)
    hull, volume = hull_of(points)
    ball = 4 / 3 * math.pi * radii.max() ** 3
    # The hull's corners lie on a sphere, which it nearly fills.
    if np.ptp(np.linalg.norm(hull - centre, axis=1)) < 1e-4 * radii.max() and volume > 0.9 * ball:
        return Shape("SPHERE", (float(radii.max()), 0, 0), centre)
    # The hull's corners are those of its bounding box.
    if (np.abs(np.abs(hull - centre) - half) < 1e-6 * half.max()).all():
        return Shape("BOX", half, centre)
    return Shape("MESH", vertices=hull)


def hull_of(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the convex hull's vertices (V, 3) and its volume."""
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):  # flat or too few: all of them
        return np.unique(points, axis=0), 0.0
    return points[hull.vertices], float(hull.volume)


def _framed(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (centre (3,), axes (3, 3) as columns, a right-handed frame, half extents (3,) along them) of a box around
    the points, along their principal axes, longest first."""
    mean = points.mean(axis=0)
    # Principal axes: eigenvectors of the covariance, smallest first.
    _, axes = np.linalg.eigh(np.cov(points.T, bias=True))
    # All three are reversed where they make a left-handed frame.
    axes = axes[:, ::-1] * np.sign(np.linalg.det(axes[:, ::-1]))
    along = (points - mean) @ axes
    low, high = along.min(axis=0), along.max(axis=0)
    return mean + axes @ (0.5 * (low + high)), axes, 0.5 * (high - low)


def plane_of(side: Barrier) -> Shape:
    """Return an infinite plane whose z axis is the normal."""
    normal = np.asarray(side.normal, dtype=np.float64)
    rotation, _ = Rotation.align_vectors([normal], [[0.0, 0.0, 1.0]])
    return Shape("PLANE", (1.0, 1.0, 1.0), normal * side.offset, rotation.as_matrix())


def quaternions(R: np.ndarray) -> np.ndarray:
    """Return the (n, 4) quaternions, w x y z, of (n, 3, 3) rotations."""
    return Rotation.from_matrix(R).as_quat()[:, [3, 0, 1, 2]]


# ---------------------------------------------------------------------------------------------------------------------
# The damping of MuJoCo's soft contacts for a given restitution.


@lru_cache(maxsize=4096)
def damping_ratio(restitution: float, steps: float) -> float:
    """Return the damping ratio of a contact of ``steps`` steps that gives this restitution (0 to 1), averaged over the
    phases in which a step meets the surface. The strongest damping gives 0.02, which is used for 0."""
    # Bisection: a larger damping ratio gives a smaller restitution.
    low, high = 0.0, 3.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _given_back(middle, steps) > restitution else (low, middle)
    return low


@kernel
def _given_back(ratio: float, steps: float) -> float:
    """Return the mean share of its speed with which a body leaves the contact, by the engine's recurrence."""
    # w: angle of the spring per step. The contact only pushes, hence min(..., 0).
    w, total, phases = math.pi / steps, 0.0, 16
    for phase in range(phases):
        # The phase is the position within a step at which the surface is met.
        # In units of a step's time and of the speed of arrival: one step moves the body by v.
        depth, v = (phase + 0.5) / phases, 1.0
        while depth > 0.0:
            v += min(-(w * w * depth + 2.0 * ratio * w * v), 0.0)
            depth += v
        total -= v / phases
    return total
