"""How fast a scene moves through a camera's picture, from its surfaces and paths: nothing is drawn.

    motion = Motion(scene, items, moments)
    look = motion.look(t_ns)                       # speeds at one time
    look.largest, look.percentile(99.9)            # px/s
    motion.hides(look, other, tolerance)           # may something between two looks be faster than both show?

Triangles are cut at the edges of the view, and hidden surfaces count: a body that comes from behind another one is
known before it is seen. Of bodies that deform, and of bodies that are wholly in view, some triangles represent all.

Between two looks, paths bound the velocities (:meth:`~blinkgl.scene.motion.pose_path.PosePath.unseen`), and so how soon
anything outside the view can enter it; deforming shapes say their time scale. Light that moves (a lamp on a path) moves
its beam and its shadows as if they were painted on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from blinkgl.camera import CameraModel, PinHole
from blinkgl.render import speeds
from blinkgl.render.moment import cam_from_obj, cam_from_obj_rate
from blinkgl.render.speeds import BINS, POINTS
from blinkgl.types.recent import Recent

if TYPE_CHECKING:
    from blinkgl.render.draw_items import DrawItem
    from blinkgl.render.moment import Moments
    from blinkgl.scene.types import Mesh, Scene

FEW = 1024
"""Number of triangles that represent a part that is wholly in view, or deforms."""
MOST = 1 << 17
"""Number of triangles that represent any part."""
KEPT = 64
"""Looks in memory: a step that is refused is examined again."""
CELLS = 33
"""Cells of a lens's picture, in x and y, in which its Jacobian is taken as constant."""


@dataclass(frozen=True, eq=False)
class Look:
    """What moves at one time. areas, sums : (BINS,) px² of the surfaces of each speed, and their sums of area times
    speed.
    largest : px/s.   items : (m, 4) of each item: 1 if a part of it is in view; the smallest depth of that part; how
    far the rest is from the view, world units, and as the sine of an angle.
    velocities : (m, POINTS + 2, 2) px/s of a few of each item's points; of its surface in view the mean; and the mean
    away from the middle of the view, and around it. nan for what is not in view."""

    t_ns: int
    areas: np.ndarray
    sums: np.ndarray
    largest: float
    items: np.ndarray
    velocities: np.ndarray

    def percentile(self, percent: float) -> float:
        """Return the speed, px/s, below which ``percent`` of the area of moving surfaces lie; 0.0: nothing moves."""
        if percent >= 100:
            return self.largest
        total = np.cumsum(self.areas)
        if not total[-1]:
            return 0.0
        k = int(np.searchsorted(total, total[-1] * percent / 100))
        return min(float(self.sums[k] / self.areas[k]), self.largest) if self.areas[k] else self.largest


class Motion:
    """The motion of a scene's drawn parts in the picture of ``camera``, which may be replaced.

    unbounded : names of the bodies whose deformer has no time scale."""

    def __init__(self, scene: Scene, items: Sequence[DrawItem], moments: Moments):
        self.camera: CameraModel = scene.camera
        self._moments, self._path, self._objects = moments, scene.camera_path, scene.objects
        self._lamps = [lamp for lamp in scene.light.lamps if not lamp.path.is_static]
        # Before a camera that stands still, and in light that does, only what moves itself.
        every = not scene.camera_path.is_static or bool(self._lamps)
        self._items = [item for item in items if every or item.moves]
        self._body = np.array([item.object_index for item in self._items], np.int64)
        self._centre = np.array([item.centre for item in self._items]).reshape(-1, 3)
        self._radius = np.array([item.radius for item in self._items])
        # The farthest point of a part from the origin of its body's path.
        self._arm = np.linalg.norm(self._centre, axis=1) + self._radius
        self._timescale = np.array([_timescale(item) for item in self._items])
        self.unbounded = [scene.objects[self._body[k]].name for k in np.flatnonzero(self._timescale == 0)]
        self._looks: Recent[tuple[CameraModel, int], Look] = Recent(KEPT)
        self._casters = np.array([i.casts for i in self._items], bool)

    def jumps(self, t0_ns: int, t1_ns: int) -> list[int]:
        """Return the times in (t0, t1), ns, increasing, after which a body, the camera or a lamp stands elsewhere a
        nanosecond later."""
        paths = [self._path, *(lamp.path for lamp in self._lamps), *(self._objects[k].path for k in set(self._body))]
        moving = [*paths, *(item.deformer for item in self._items if item.deformer is not None)]
        # Paths need not say it.
        return sorted({t for one in moving if hasattr(one, "jumps") for t in one.jumps(t0_ns, t1_ns)})

    @cached_property
    def _surfaces(self) -> _Surfaces:
        return _Surfaces(self._items)

    def look(self, t_ns: int) -> Look:
        """Return the speeds at a time."""
        return self._looks.of((self.camera, t_ns), lambda: self._look(t_ns))

    def _look(self, t_ns: int) -> Look:
        bodies = self._moments.bodies
        T_world_cam, dT_world_cam = self._path.pose(t_ns), self._path.derivative(t_ns)
        T_world_obj, dT_world_obj = bodies.poses(t_ns), bodies.rates(t_ns)
        T = cam_from_obj(T_world_cam, T_world_obj)
        D = cam_from_obj_rate(T_world_cam, dT_world_cam, T_world_obj, dT_world_obj)
        view, surfaces = View.of(self.camera), self._surfaces
        points, rates = surfaces.at(t_ns)
        centres = (T[self._body, :3, :3] @ self._centre[..., None])[..., 0] + T[self._body, :3, 3]
        inside = np.all(centres @ view.planes.T >= self._radius[:, None], axis=1)
        # Wholly in view, and not much nearer on one side than on the other.
        few = inside & (centres[:, 2] > max(view.near, 1e-300) + 2 * self._radius)
        sides = np.array([item.side(t_ns) for item in self._items], np.int64)
        light = self.light(t_ns, T_world_cam, dT_world_cam, centres)
        areas, sums, rows = np.zeros(BINS), np.zeros(BINS), np.zeros((len(self._items), 4))
        velocities = np.full((len(self._items), POINTS + 2, 2), np.nan)
        ranges = surfaces.ranges[few.astype(np.intp), np.arange(len(few))]
        drawn, shapes = (T, D, self._body, ranges, sides), (points, rates, surfaces.faces)
        seen = view.planes, view.near, (view.corner, view.size, view.jacobians)
        largest = speeds.look(drawn, shapes, seen, light, (areas, sums), rows, velocities)
        return Look(t_ns, areas, sums, float(largest), rows, velocities)

    def fastest(self, ta_ns: int, tb_ns: int, max_px: float) -> tuple[float, bool]:
        """Return (the largest speed, px/s, at any time from ta to tb, to a tenth of that of ``max_px`` in this time;
        whether something jumps then, or moves by more than ``max_px`` within a 256th of this time)."""
        tolerance = 0.1 * max_px / max((tb_ns - ta_ns) * 1e-9, 1e-9)
        largest, intervals, jumps = self.look(ta_ns).largest, [(ta_ns, tb_ns)], bool(self.jumps(ta_ns, tb_ns))
        while intervals:
            a, b = intervals.pop()
            largest = max(largest, self.look(b).largest)
            if 256 * (b - a) > tb_ns - ta_ns and b - a > 1:
                if self.hides(self.look(a), self.look(b), tolerance):
                    # The earlier half is taken first, so that the look at its end is kept for the start of the other.
                    intervals += [((a + b) // 2, b), (a, (a + b) // 2)]
            elif not self.unbounded and b > a:
                jumps = jumps or self.hides(self.look(a), self.look(b), max_px / (b - a) * 1e9)
        return largest, jumps

    def light(
        self, t_ns: int, T_world_cam: np.ndarray, dT_world_cam: np.ndarray, centres: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (l, 3, 4) maps from a lit point to the velocity of the light's pattern there, camera axes, and (l, 8)
        positions, directions, cosines of the half angle and reaches; a cosine of -2: in all directions."""
        twists, cones = np.zeros((len(self._lamps), 3, 4)), np.zeros((len(self._lamps), 8))
        for k, lamp in enumerate(self._lamps):
            pose, rate = lamp.path.pose(t_ns), lamp.path.derivative(t_ns)
            T = cam_from_obj(T_world_cam, pose)
            dT = cam_from_obj_rate(T_world_cam, dT_world_cam, pose, rate)
            if lamp.kind == "point":  # its rotation changes nothing
                still = rate.copy()
                still[:3, :3] = 0.0
                dT = cam_from_obj_rate(T_world_cam, dT_world_cam, pose, still)
            if lamp.kind == "sun" and self._casters.any():
                # Only its direction counts: shadows turn about what casts them.
                T[:3, 3], dT[:3, 3] = centres[self._casters].mean(axis=0), 0.0
            # d(point)/dt of a pattern that is fixed to the lamp: its place in the lamp's axes, T^-1 p, does not change.
            twists[k] = (dT @ np.linalg.inv(T))[:3]
            cosine = math.cos(lamp.outer) if lamp.kind == "spot" else -2.0
            cones[k] = *T[:3, 3], *-T[:3, 2], cosine, lamp.reach if lamp.kind != "sun" else math.inf
        return twists, cones

    def hides(self, a: Look, b: Look, tolerance: float) -> bool:
        """Return whether something may be faster between two looks, by more than ``tolerance`` px/s, than both of
        them show: because a velocity changes to and fro, or because it is out of view at both times."""
        ta, tb, bodies = a.t_ns, b.t_ns, self._moments.bodies
        limits = bodies.bounds(ta, tb)
        camera = np.array([*self._path.speed_bound(ta, tb), *self._path.unseen(ta, tb)])
        for lamp in self._lamps:
            # Relative to its own speed: what it moves over may be anywhere.
            (v, w), (speed, rate) = lamp.path.unseen(ta, tb), lamp.path.speed_bound(ta, tb)
            if v > 0.1 * speed or w > 0.1 * rate:
                return True
        return bool(
            speeds.hides(
                limits, camera, self._body, self._arm, self._timescale, a.items, b.items,
                (tb - ta) * 1e-9, self.camera.near, self.camera.px_per_slope, tolerance,
            )
        )  # fmt: skip

    def bend(self, a: Look, b: Look) -> float:
        """Return how far, px, anything leaves the straight line of its positions at two looks in between, where its
        velocity changes steadily: an eighth of this change times the time."""
        apart = b.velocities - a.velocities
        squares = np.einsum("ipk,ipk->ip", apart, apart)
        # fmax passes over nan: points that are out of view at one of the two times.
        return math.sqrt(float(np.fmax.reduce(squares, axis=None, initial=0.0))) * (b.t_ns - a.t_ns) * 1e-9 / 8


class _Surfaces:
    """Triangles that represent items. faces : (F, 3) int64 indices of points.   ranges : (2, m, 5) float64 of each
    item: where its points begin and end, and its faces, and how many faces each of them stands for; row 1: fewer."""

    def __init__(self, items: Sequence[DrawItem]):
        points, faces = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)]
        self._deforming: list[tuple[slice, Mesh]] = []
        self._counts = [0, 0]
        self.ranges = np.zeros((2, len(items), 5))
        for k, item in enumerate(items):
            deforms = item.deformer is not None and not item.deformer.is_static
            # Two resolutions of each body: many triangles, for those that are seen large, and few.
            for row, most in enumerate((FEW if deforms else MOST, FEW)):
                if row and (deforms or len(item.mesh.faces) <= FEW):
                    self.ranges[1, k] = self.ranges[0, k]
                    continue
                mesh, chosen, share = _represented(item.mesh, most)
                begin, side = self._counts
                self._counts = [begin + len(mesh.vertices), side + len(chosen)]
                if deforms:
                    self._deforming.append((slice(begin, self._counts[0]), mesh))
                points.append(mesh.vertices)
                faces.append(chosen.astype(np.int64) + begin)
                self.ranges[row, k] = begin, self._counts[0], side, self._counts[1], share
        self.faces = np.concatenate(faces)
        self._points = np.concatenate(points, dtype=np.float64)
        self._rates = np.zeros_like(self._points)

    def at(self, t_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return ((n, 3), (n, 3)) float64, object axes: all points and their rates; valid until the next call."""
        for there, mesh in self._deforming:
            assert mesh.deformer is not None
            self._points[there] = mesh.deformer.positions(mesh, t_ns)
            self._rates[there] = mesh.deformer.velocity(mesh, t_ns)
        return self._points, self._rates


def _represented(mesh: Mesh, most: int) -> tuple[Mesh, np.ndarray, float]:
    """Return (a mesh of the vertices of some of the faces, these faces, faces for each of them)."""
    step = -(-len(mesh.faces) // most)
    if step <= 1:
        return mesh, mesh.faces, 1.0
    used, faces = np.unique(mesh.faces[::step], return_inverse=True)
    deformer = None if mesh.deformer is None else mesh.deformer.of_vertices(used)
    # A deformer that cannot be reduced moves all vertices, also those of faces that are left out.
    if mesh.deformer is not None and deformer is None:
        return mesh, mesh.faces[::step], float(step)
    fewer = replace(
        mesh, vertices=mesh.vertices[used], normals=mesh.normals[used], uvs=mesh.uvs[used], colours=None,
        deformer=deformer,
    )  # fmt: skip
    return fewer, faces.reshape(-1, 3), float(step)


def _timescale(item: DrawItem) -> float:
    """Return the time scale of an item's deformer, ns; 0.0: unknown; inf: it does not deform."""
    if item.deformer is None or item.deformer.is_static:
        return math.inf
    return float(item.deformer.timescale_ns or 0)


@dataclass(frozen=True, eq=False)
class View:
    """planes : (n, 3) inward normals, camera axes.   jacobians : (h, w, 2, 2) px per unit of (X / Z, Y / Z), in cells
    of ``size`` (2,) from ``corner`` (2,) on; nan where nothing is visible."""

    planes: np.ndarray
    near: float
    corner: np.ndarray
    size: np.ndarray
    jacobians: np.ndarray

    @classmethod
    def of(cls, camera: CameraModel) -> View:
        return _views.of(camera, lambda: cls._made(camera))

    @classmethod
    def _made(cls, camera: CameraModel) -> View:
        # The plane through the centre would be the last; depths are compared instead.
        planes = np.ascontiguousarray(camera.frustum_planes()[:4])
        if isinstance(camera, PinHole):
            diagonal = np.diag([camera.fx, camera.fy])[None, None]
            return cls(planes, camera.near, np.zeros(2), np.ones(2), np.ascontiguousarray(diagonal))
        x, y = np.linspace(-0.5, camera.width - 0.5, 65), np.linspace(-0.5, camera.height - 0.5, 65)
        rays = camera.rays(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
        # The cells cover all (X / Z, Y / Z) of the picture; rays at 90 degrees and more have none.
        seen = rays[rays[:, 2] > 0]
        low, high = (f(seen[:, :2] / seen[:, 2:], axis=0) for f in (np.nanmin, np.nanmax))
        size = (high - low) / CELLS
        middles = low + size * (np.stack(np.meshgrid(*[np.arange(CELLS)] * 2), axis=-1) + 0.5)
        ahead = np.concatenate([middles, np.ones((CELLS, CELLS, 1))], axis=-1)
        return cls(planes, camera.near, low, size, np.ascontiguousarray(camera.jacobian(ahead)[..., :2]))


_views: Recent[CameraModel, View] = Recent(8)
