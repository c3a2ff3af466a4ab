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
from blinkgl.machine.kernels import kernel
from blinkgl.render.moment import cam_from_obj, cam_from_obj_rate
from blinkgl.types.recent import Recent

if TYPE_CHECKING:
    from blinkgl.render.draw_items import DrawItem
    from blinkgl.render.moment import Moments
    from blinkgl.scene.types import Mesh, Scene

SLOWEST = 2.0**-40
"""px/s below which a surface counts as still."""
FEW = 1024
"""Number of triangles that represent a part that is wholly in view, or deforms."""
MOST = 1 << 17
"""Number of triangles that represent any part."""
KEPT = 64
"""Looks in memory: a step that is refused is examined again."""
OCTAVE = 16
"""Bins of speed per factor of two: they are 4 % wide, and each keeps its mean."""
BINS = 104 * OCTAVE
"""From 2^-40 to 2^64 px/s."""
POINTS = 8
"""Points of a part whose velocities are compared between looks."""
CELLS = 33
"""Cells of a lens's picture, in x and y, in which its Jacobian is taken as constant."""
# Columns of an item's row of a look.
SEEN, NEAREST, AWAY, ASIDE = range(4)


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
        self._moments, self._path = moments, scene.camera_path
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

    @cached_property
    def _surfaces(self) -> _Surfaces:
        return _Surfaces(self._items)

    @property
    def still(self) -> bool:
        """Return whether nothing ever moves."""
        return not self._items

    def look(self, t_ns: int) -> Look:
        """Return the speeds at a time."""
        return self._looks.of((self.camera, t_ns), lambda: self._look(t_ns))

    def _look(self, t_ns: int) -> Look:
        bodies = self._moments.bodies
        T_world_cam, dT_world_cam = self._path.pose(t_ns), self._path.derivative(t_ns)
        T_world_obj, dT_world_obj = bodies.poses(t_ns), bodies.rates(t_ns)
        T = cam_from_obj(T_world_cam, T_world_obj)
        D = cam_from_obj_rate(T_world_cam, dT_world_cam, T_world_obj, dT_world_obj)
        view, surfaces = _View.of(self.camera), self._surfaces
        points, rates = surfaces.at(t_ns)
        centres = (T[self._body, :3, :3] @ self._centre[..., None])[..., 0] + T[self._body, :3, 3]
        inside = np.all(centres @ view.planes.T >= self._radius[:, None], axis=1)
        # Wholly in view, and not much nearer on one side than on the other.
        few = inside & (centres[:, 2] > max(view.near, 1e-300) + 2 * self._radius)
        sides = np.array([item.side(t_ns) for item in self._items], np.int64)
        twists, cones = self._light(t_ns, T_world_cam, dT_world_cam, centres)
        areas, sums, rows = np.zeros(BINS), np.zeros(BINS), np.zeros((len(self._items), 4))
        velocities = np.full((len(self._items), POINTS + 2, 2), np.nan)
        largest = _look(
            T, D, self._body, surfaces.ranges[few.astype(np.intp), np.arange(len(few))], sides, points, rates,
            surfaces.faces, view.planes, view.near, view.corner, view.size, view.jacobians, twists, cones, areas, sums,
            rows, velocities,
        )  # fmt: skip
        return Look(t_ns, areas, sums, float(largest), rows, velocities)

    def fastest(self, ta_ns: int, tb_ns: int, max_px: float) -> float:
        """Return the largest speed, px/s, at any time from ta to tb, to a tenth of that of ``max_px`` in this time."""
        tolerance = 0.1 * max_px / max((tb_ns - ta_ns) * 1e-9, 1e-9)
        largest, intervals = self.look(ta_ns).largest, [(ta_ns, tb_ns)]
        while intervals:
            a, b = intervals.pop()
            largest = max(largest, self.look(b).largest)
            if 256 * (b - a) > tb_ns - ta_ns and b - a > 1 and self.hides(self.look(a), self.look(b), tolerance):
                intervals += [((a + b) // 2, b), (a, (a + b) // 2)]
        return largest

    def _light(
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
            v, w = lamp.path.unseen(ta, tb)
            # Of light only its own time scale is known: what it moves over may be anywhere.
            if v or w:
                moved = (lamp.path.speed_bound(ta, tb)[0], lamp.path.speed_bound(ta, tb)[1])
                if v > 0.1 * moved[0] or w > 0.1 * moved[1]:
                    return True
        return bool(
            _hides(
                limits, camera, self._body, self._radius, self._arm, self._timescale, a.items, b.items,
                (tb - ta) * 1e-9, self.camera.near, self.camera.px_per_slope, tolerance,
            )
        )  # fmt: skip

    def bend(self, a: Look, b: Look) -> float:
        """Return how far, px, anything leaves the straight line of its positions at two looks in between, where its
        velocity changes steadily: an eighth of this change times the time."""
        apart = b.velocities - a.velocities
        squares = np.einsum("ipk,ipk->ip", apart, apart)
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
class _View:
    """planes : (n, 3) inward normals, camera axes.   jacobians : (h, w, 2, 2) px per unit of (X / Z, Y / Z), in cells
    of ``size`` (2,) from ``corner`` (2,) on; nan where nothing is visible."""

    planes: np.ndarray
    near: float
    corner: np.ndarray
    size: np.ndarray
    jacobians: np.ndarray

    @classmethod
    def of(cls, camera: CameraModel) -> _View:
        if camera not in _views:
            _views.of(camera, lambda: cls._made(camera))
        return _views[camera]

    @classmethod
    def _made(cls, camera: CameraModel) -> _View:
        # The plane through the centre would be the last; depths are compared instead.
        planes = np.ascontiguousarray(camera.frustum_planes()[:4])
        if isinstance(camera, PinHole):
            diagonal = np.diag([camera.fx, camera.fy])[None, None]
            return cls(planes, camera.near, np.zeros(2), np.ones(2), np.ascontiguousarray(diagonal))
        x, y = np.linspace(-0.5, camera.width - 0.5, 65), np.linspace(-0.5, camera.height - 0.5, 65)
        rays = camera.rays(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
        seen = rays[rays[:, 2] > 0]
        low, high = (f(seen[:, :2] / seen[:, 2:], axis=0) for f in (np.nanmin, np.nanmax))
        size = (high - low) / CELLS
        middles = low + size * (np.stack(np.meshgrid(*[np.arange(CELLS)] * 2), axis=-1) + 0.5)
        ahead = np.concatenate([middles, np.ones((CELLS, CELLS, 1))], axis=-1)
        return cls(planes, camera.near, low, size, np.ascontiguousarray(camera.jacobian(ahead)[..., :2]))


_views: Recent[CameraModel, _View] = Recent(8)


@kernel
def _velocity(x, y, z, dx, dy, dz, corner, size, jacobians):
    """Return (px/s of a point in x and in y, px² per unit² around it); nan where the lens shows nothing."""
    u, v = x / z, y / z
    du, dv = (dx - u * dz) / z, (dy - v * dz) / z
    i = min(max(int((v - corner[1]) / size[1]), 0), jacobians.shape[0] - 1)
    j = min(max(int((u - corner[0]) / size[0]), 0), jacobians.shape[1] - 1)
    J = jacobians[i, j]
    a, b = J[0, 0] * du + J[0, 1] * dv, J[1, 0] * du + J[1, 1] * dv
    return a, b, abs(J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0])


@kernel
def _pattern(x, y, z, twists, cones, corner, size, jacobians):
    """Return the largest px/s of the light's patterns at a point."""
    most = 0.0
    for k in range(len(twists)):
        lamp, M = cones[k], twists[k]
        a, b, c = x - lamp[0], y - lamp[1], z - lamp[2]
        distance = math.sqrt(a * a + b * b + c * c)
        if distance > lamp[7] or a * lamp[3] + b * lamp[4] + c * lamp[5] < lamp[6] * distance:
            continue
        dx = M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3]
        dy = M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3]
        dz = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3]
        a, b, _ = _velocity(x, y, z, dx, dy, dz, corner, size, jacobians)
        most = max(most, math.sqrt(a * a + b * b))
    return most


@kernel
def _patterns(polygon, count, area, twists, cones, corner, size, jacobians):
    """Return the largest px/s of the light's patterns on a polygon of this area, px²: on a grid of about 4 px."""
    n, most = min(max(int(math.sqrt(area) / 4.0), 1), 64), 0.0
    for k in range(1, count - 1):
        a, b, c = polygon[0], polygon[k], polygon[k + 1]
        for i in range(n + 1):
            for j in range(n + 1 - i):
                s, t = i / n, j / n
                x, y, z = a[:3] + s * (b[:3] - a[:3]) + t * (c[:3] - a[:3])
                most = max(most, _pattern(x, y, z, twists, cones, corner, size, jacobians))
    return most


@kernel
def _cut(polygon, count, out, nx, ny, nz, d):
    """Write the part of a polygon of ``count`` corners (position, velocity) in which n . x >= d to ``out``; return its
    number of corners."""
    m = 0
    for k in range(count):
        p, q = polygon[k], polygon[(k + 1) % count]
        a = nx * p[0] + ny * p[1] + nz * p[2] - d
        b = nx * q[0] + ny * q[1] + nz * q[2] - d
        if a >= 0.0:
            out[m] = p
            m += 1
        if (a >= 0.0) != (b >= 0.0):
            s = a / (a - b)
            for r in range(6):
                out[m, r] = p[r] + s * (q[r] - p[r])
            m += 1
    return m


@kernel(error_model="numpy")
def _look(
    T, D, body, ranges, sides, points, rates, faces, planes, near, corner, size, jacobians, twists, cones, areas, sums,
    rows, velocities,
):  # fmt: skip
    """Fill the arrays of a :class:`Look` and return the largest speed."""
    room = 0
    for i in range(len(body)):
        room = max(room, int(ranges[i, 1] - ranges[i, 0]))
    moved, outside = np.empty((room, 6)), np.empty(room, np.int64)
    polygon, other = np.empty((16, 6)), np.empty((16, 6))
    largest, lit = 0.0, len(twists) > 0
    for i in range(len(body)):
        R, dR = T[body[i]], D[body[i]]
        first = int(ranges[i, 0])
        seen, nearest, away, aside = 0.0, np.inf, np.inf, np.inf
        for v in range(first, int(ranges[i, 1])):
            p, dp, row, code = points[v], rates[v], moved[v - first], 0
            for r in range(3):
                row[r] = R[r, 0] * p[0] + R[r, 1] * p[1] + R[r, 2] * p[2] + R[r, 3]
                row[3 + r] = dR[r, 0] * p[0] + dR[r, 1] * p[1] + dR[r, 2] * p[2] + dR[r, 3]
                row[3 + r] += R[r, 0] * dp[0] + R[r, 1] * dp[1] + R[r, 2] * dp[2]
            for k in range(len(planes)):
                if planes[k, 0] * row[0] + planes[k, 1] * row[1] + planes[k, 2] * row[2] < 0.0:
                    code |= 1 << k
            if row[2] < near:
                code |= 1 << len(planes)
            outside[v - first] = code
        count = int(ranges[i, 1]) - first
        for k in range(POINTS):
            v = k * (count - 1) // (POINTS - 1)
            if count > 0 and outside[v] == 0:
                q = moved[v]
                a, b, _ = _velocity(q[0], q[1], q[2], q[3], q[4], q[5], corner, size, jacobians)
                velocities[i, k, 0], velocities[i, k, 1] = a, b
        whole, mean_x, mean_y, spread, outwards, around = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for f in range(int(ranges[i, 2]), int(ranges[i, 3])):
            ka, kb, kc = faces[f, 0] - first, faces[f, 1] - first, faces[f, 2] - first
            a, b, c = moved[ka], moved[kb], moved[kc]
            # Seen from behind: the camera, the origin, is on the other side of the face's plane.
            ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
            vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
            facing = (uy * vz - uz * vy) * a[0] + (uz * vx - ux * vz) * a[1] + (ux * vy - uy * vx) * a[2]
            if sides[i] * facing > 0.0:
                continue
            common = outside[ka] & outside[kb] & outside[kc]
            if common != 0:
                gap = 0.0
                for k in range(len(planes)):
                    if common & (1 << k):
                        n = planes[k]
                        highest = max(
                            n[0] * a[0] + n[1] * a[1] + n[2] * a[2],
                            n[0] * b[0] + n[1] * b[1] + n[2] * b[2],
                            n[0] * c[0] + n[1] * c[1] + n[2] * c[2],
                        )
                        gap = max(gap, -highest)
                if common & (1 << len(planes)):
                    gap = max(gap, near - max(a[2], b[2], c[2]))
                farthest = 0.0
                for q in (a, b, c):
                    farthest = max(farthest, q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
                away, aside = min(away, gap), min(aside, gap / math.sqrt(farthest))
                continue
            polygon[0], polygon[1], polygon[2] = a, b, c
            count = 3
            if outside[ka] | outside[kb] | outside[kc]:
                count = _cut(polygon, count, other, 0.0, 0.0, 1.0, near)
                polygon, other = other, polygon
                for k in range(len(planes)):
                    if count > 0:
                        left = _cut(polygon, count, other, planes[k, 0], planes[k, 1], planes[k, 2], 0.0)
                        if left == 0:
                            # Past a corner of the view: about so far from it.
                            gap, farthest = np.inf, 0.0
                            for q in range(count):
                                p = polygon[q]
                                gap = min(gap, -(planes[k, 0] * p[0] + planes[k, 1] * p[1] + planes[k, 2] * p[2]))
                                farthest = max(farthest, p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
                            away, aside = min(away, 0.5 * gap), min(aside, 0.5 * gap / math.sqrt(farthest))
                        count = left
                        polygon, other = other, polygon
                if count == 0:
                    continue
            fastest, area, density, sum_x, sum_y = 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(count):
                q, r = polygon[k], polygon[(k + 1) % count]
                x, y, dense = _velocity(q[0], q[1], q[2], q[3], q[4], q[5], corner, size, jacobians)
                speed = math.sqrt(x * x + y * y)
                if speed < np.inf:  # also false for nan
                    sum_x, sum_y = sum_x + x, sum_y + y
                    u, v = q[0] / q[2], q[1] / q[2]
                    spread += math.sqrt(u * u + v * v)
                    outwards, around = outwards + x * u + y * v, around + y * u - x * v
                    fastest, density = max(fastest, speed), max(density, dense)
                nearest = min(nearest, q[2])
                area += (q[0] * r[1] - r[0] * q[1]) / (q[2] * r[2])
            seen = 1.0
            area = 0.5 * abs(area) * density
            if lit:
                fastest = max(fastest, _patterns(polygon, count, area, twists, cones, corner, size, jacobians))
            largest = max(largest, fastest)
            area *= ranges[i, 4]
            whole += area
            mean_x, mean_y = mean_x + area * sum_x / count, mean_y + area * sum_y / count
            if fastest >= SLOWEST:
                k = min(max(int((math.log2(fastest) + 40.0) * OCTAVE), 0), BINS - 1)
                areas[k] += area
                sums[k] += area * fastest
        if whole > 0.0:
            velocities[i, POINTS, 0], velocities[i, POINTS, 1] = mean_x / whole, mean_y / whole
        if spread > 0.0:
            velocities[i, POINTS + 1, 0], velocities[i, POINTS + 1, 1] = outwards / spread, around / spread
        rows[i, SEEN], rows[i, NEAREST], rows[i, AWAY], rows[i, ASIDE] = seen, nearest, away, aside
    return largest


@kernel(error_model="numpy")
def _hides(limits, camera, body, radius, arm, timescale, a, b, seconds, near, focal, tolerance):
    """Return the value of :meth:`Motion.hides`. limits : (n, 4) of the bodies and (4,) of the camera: largest speed and
    angular rate, and the parts of them that the ends do not show."""
    v_cam, w_cam, off_cam, woff_cam = camera[0], camera[1], camera[2], camera[3]
    for i in range(len(body)):
        bound = limits[body[i]]
        moves, turns = bound[0] + v_cam, bound[1] * arm[i]
        deforms = timescale[i] < np.inf
        if not deforms and moves + turns + w_cam == 0.0:
            continue
        if a[i, SEEN] == 0.0 and b[i, SEEN] == 0.0:
            # From outside into the view and out again: the way is at least the sum of both distances.
            if deforms and seconds * 1e9 > timescale[i]:
                return True
            reach = (moves + turns) * seconds
            turned = w_cam * seconds
            far, wide = a[i, AWAY] + b[i, AWAY], a[i, ASIDE] + b[i, ASIDE]
            if (reach > 0.0 and reach >= far) or (turned > 0.0 and turned >= wide) or reach / far + turned / wide > 1.0:
                return True
            continue
        if deforms and seconds * 1e9 > timescale[i]:
            return True
        z = np.inf
        if a[i, SEEN] > 0.0:
            z = min(z, a[i, NEAREST])
        if b[i, SEEN] > 0.0:
            z = min(z, b[i, NEAREST])
        # It may be nearer in between, and must be back at the end.
        nearer = max(near, z - 0.5 * (moves + turns + 1.5 * w_cam * z) * seconds)
        hidden = bound[2] + off_cam + bound[3] * arm[i] + turns * _bow(bound[1] * seconds)
        hidden = (
            hidden / nearer
            + (moves + turns) * (1.0 / nearer - 1.0 / z)
            + 1.5 * (woff_cam + w_cam * _bow(w_cam * seconds))
        )
        if focal * hidden > tolerance:
            return True
    return False


@kernel
def _bow(angle):
    """Return the height of an arc over its chord, by its radius."""
    return min(2.0, angle * angle / 8.0)
