"""Regions that deforming shapes fill over time: boxes, hulls, and their margins."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection

from blinkgl.machine.kernels import kernel

if TYPE_CHECKING:
    from blinkgl.scene.types import Deformer, Mesh, Part

_SAMPLES = 32
"""Smallest number of times at which a shape is sampled to find its bounds."""
_MAX_SAMPLES = 256
_STEP_NS = 50_000_000
_MARGIN = 1.25


@dataclass(frozen=True, eq=False)
class Sweep:
    """The region that a shape fills over some time. low, high : (3,) box, the margin included.
    margin : largest distance of the shape from the sampled positions, units."""

    deformer: Deformer
    mesh: Mesh
    times: tuple[int, ...]
    low: np.ndarray
    high: np.ndarray
    margin: float

    @classmethod
    def of(cls, deformer: Deformer, mesh: Mesh, t0_ns: int, t1_ns: int) -> Sweep:
        """Return the region from positions at sampled times. Between two, a vertex leaves the straight line by at most
        h/4 times the change of its velocity (h/8 if that is steady, h/4 if it jumps); the margin is a quarter more."""
        count = (
            1 if deformer.is_static or t1_ns <= t0_ns else min(max(_SAMPLES, (t1_ns - t0_ns) // _STEP_NS), _MAX_SAMPLES)
        )
        # One time more than there are steps; a single one for what is at rest.
        times = tuple(int(t) for t in np.linspace(t0_ns, t1_ns, count + (count > 1)).round())
        low, high, margin, before = np.full(3, np.inf), np.full(3, -np.inf), 0.0, None
        for i, t in enumerate(times):
            at, velocity = deformer.positions(mesh, t), deformer.velocity(mesh, t)
            _widen(at, low, high)
            if before is not None:
                jump = float(_largest_difference(velocity, before))
                margin = max(margin, _MARGIN * jump * (t - times[i - 1]) * 1e-9 / 4)
            before = velocity
        return cls(deformer, mesh, times, low - margin, high + margin, margin)

    @cached_property
    def hull(self) -> tuple[np.ndarray, np.ndarray]:
        """Return ((K, 3) float64, (F, 3) int32, facing out): a convex body around all sampled positions, without the
        margin, bounded by a plane in each of 162 directions. For a ball it is 1.5 % larger."""
        directions, halves, order = _directions()
        reach, inside = np.full(len(directions), -np.inf), np.zeros(3)
        for t in self.times:
            points = np.ascontiguousarray(self.deformer.positions(self.mesh, t))
            inside += _reach(points, halves, order, reach) / len(self.times)
        # Slightly enlarged, so that flat shapes, and those that an animation shrinks to a point, have an inside.
        reach += 1e-6 * (float(np.linalg.norm(self.high - self.low)) or 1.0)
        # scipy's form of the half-spaces n . x - reach <= 0: normals and offsets in one row.
        corners = HalfspaceIntersection(np.column_stack([directions, -reach]), inside).intersections
        hull = ConvexHull(corners)
        vertices = corners[hull.vertices]
        faces = np.searchsorted(hull.vertices, hull.simplices)  # they are sorted in three dimensions
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        # Qhull's equations have outward normals, but the order of a face's corners is arbitrary.
        inwards = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0
        faces[inwards] = faces[inwards, ::-1]
        return vertices, faces.astype(np.int32)


@kernel
def _reach(points, halves, order, reach):
    """Raise ``reach``, (162,), the largest extent of (V, 3) points in each direction, to their mean. halves, order : of
    :func:`_directions`. Point by point and one sign after the other, so that the loop vectorises over directions."""
    x, y, z = halves[0], halves[1], halves[2]
    count = len(x)
    ahead, behind = np.full(count, -np.inf), np.full(count, -np.inf)
    foremost, hindmost = np.zeros(count), np.zeros(count)  # numbers of points, as float like the extents
    for i in range(len(points)):
        a, b, c, number = points[i, 0], points[i, 1], points[i, 2], float(i)
        for d in range(count):
            height = a * x[d] + b * y[d] + c * z[d]
            foremost[d] = number if height > ahead[d] else foremost[d]
            ahead[d] = max(ahead[d], height)
        for d in range(count):
            height = -(a * x[d] + b * y[d] + c * z[d])
            hindmost[d] = number if height > behind[d] else hindmost[d]
            behind[d] = max(behind[d], height)
    heights, furthest = np.concatenate((ahead, behind)), np.concatenate((foremost, hindmost))
    mean = np.zeros(3)
    for d in range(len(order)):
        reach[d] = max(reach[d], heights[order[d]])
        mean += points[int(furthest[order[d]])] / len(order)
    return mean


@kernel
def _widen(points, low, high):
    """Enlarge the box low to high, (3,) both, to contain (V, 3) points."""
    for i in range(len(points)):
        for j in range(3):
            low[j], high[j] = min(low[j], points[i, j]), max(high[j], points[i, j])


@kernel
def _largest_difference(a, b):
    """Return the largest distance between the rows of (V, 3) a and b."""
    most = 0.0
    for i in range(len(a)):
        x, y, z = a[i, 0] - b[i, 0], a[i, 1] - b[i, 1], a[i, 2] - b[i, 2]
        most = max(most, x * x + y * y + z * z)
    return np.sqrt(most)


@cache
def _directions() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ((162, 3) evenly distributed unit vectors, each with its opposite; (3, 81) one of each pair; (162,) index
    of each vector among those 81 followed by their opposites)."""
    import trimesh  # imported here: it is slow to import, and few scenes have deforming shapes

    every = np.array(trimesh.creation.icosphere(subdivisions=2, radius=1.0).vertices)
    opposite = (every[:, None] == -every).all(axis=2).argmax(axis=1)
    chosen = np.flatnonzero(np.arange(len(every)) < opposite)
    order = np.empty(len(every), np.int64)
    order[chosen], order[opposite[chosen]] = np.arange(len(chosen)), np.arange(len(chosen)) + len(chosen)
    return every, np.ascontiguousarray(every[chosen].T), order


_sweeps: WeakKeyDictionary[Mesh, dict[tuple[int, int], Sweep]] = WeakKeyDictionary()


def sweep(mesh: Mesh, t0_ns: int, t1_ns: int) -> Sweep:
    """Return the region that a deforming mesh fills over [t0, t1]. It is kept as long as the mesh."""
    deformer = mesh.deformer
    assert deformer is not None
    if deformer.period_ns is not None and t1_ns - t0_ns >= deformer.period_ns:
        # A whole period fills the same region wherever it begins, so all longer spans share one entry.
        t0_ns, t1_ns = 0, deformer.period_ns
    kept = _sweeps.setdefault(mesh, {})
    if (t0_ns, t1_ns) not in kept:
        kept[t0_ns, t1_ns] = Sweep.of(deformer, mesh, t0_ns, t1_ns)
    return kept[t0_ns, t1_ns]


def filled(mesh: Mesh) -> tuple[np.ndarray, float]:
    """Return ((K, 3) points, largest distance of the mesh from their hull): its vertices, or for a deforming mesh the
    corners of its region's hull."""
    if mesh.deformer is None:
        return mesh.vertices[np.unique(mesh.faces)], 0.0
    swept = sweep(mesh, 0, mesh.deformer.span_ns)
    return swept.hull[0], swept.margin


def normals_at(mesh: Mesh, t_ns: int) -> np.ndarray:
    """Return normals at t, (V, 3), object frame; not normalised for a deforming mesh."""
    return mesh.normals if mesh.deformer is None else mesh.deformer.normals(mesh, t_ns)


def gait(parts: Iterable[Part]) -> tuple[str, float]:
    """Return (orientation, units/s) of the motion of one object's parts: of the first that has any."""
    for deformer in (part.mesh.deformer for part in parts):
        if deformer is not None and deformer.locomotion != "free":
            return deformer.locomotion, deformer.speed
    return "free", 0.0
