"""Collisions along trajectories, found continuously; bodies that collide stop.

    result = resolve_collisions(objects, camera_path, camera_radius, t0_ns, t1_ns)
    if result.at_start: ...                         # a placement to be drawn again
    scene = Scene(result.objects, Rig.alone(camera, result.camera_path), t0_ns, t1_ns, log=result.log)

Method: conservative advancement (Mirtich 1996; Tang, Kim & Manocha, "C2A", ICRA 2009). At a time t two bodies are a
distance d apart and over [t, t + dt] no point of theirs is faster than S = sum(|v| + |w| r), with bounds from the
trajectories' polynomials (:meth:`PosePath.speed_bound`), not from samples; so nothing can touch before t + d / S, which
is the next time tested. Therefore a body that is thinner than its motion per frame cannot be jumped over. The pair with
the earliest next time is advanced first, so each step sees all earlier cuts.

Distances: bounding spheres and separating faces of convex static bodies while these suffice, otherwise exact
triangle-triangle distances (fcl). Two bodies collide when they come within ``tol = tolerance * (the smaller's
radius)``; the cut is at a separation in (0, tol].

Rest: a body that touches the ground (or a wall) at t0 rests on it. Where that is flat (or convex: a slab), the body may
slide on it, lift off and land; only sinking more than ``rest_margin`` of its radius into it counts as a collision.
Touching other bodies, or ground that is not convex, at t0 is a collision at t0.

A deforming body is the convex hull of all its shapes in [t0, t1], enlarged by the possible motion between the sampled
times (:class:`~blinkgl.scene.shapes.sweep.Sweep`): a body clear of that is clear of each shape. Its path is cut like
any other's; its shape continues to change.

Surfaces collide, not solids: a body that starts completely inside another's hollow touches nothing there.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace
from functools import cached_property

import fcl
import numpy as np

from blinkgl.scene.motion.body_shapes import hull_of
from blinkgl.scene.motion.paths import CutPath
from blinkgl.scene.motion.pose_path import PosePath
from blinkgl.scene.shapes.sweep import sweep
from blinkgl.scene.types import SceneObject

CAMERA = "camera"
_SUPPORTS = ("ground", "wall")
_MAX_PLANES = 24  # convex static bodies with more faces use fcl
_REQUEST = fcl.DistanceRequest()


@dataclass(frozen=True)
class Collision:
    """``first`` and ``second`` (names; the camera's is "camera") came within ``separation`` of each other at t_ns.

    cut  : names of those that were moving and have been stopped.
    """

    t_ns: int
    first: str
    second: str
    separation: float
    cut: tuple[str, ...]

    def __str__(self) -> str:
        stopped = f"; stopped: {', '.join(self.cut)}" if self.cut else ""
        return f"t={self.t_ns * 1e-9:.6f} s: {self.first} touches {self.second}{stopped}"


@dataclass(frozen=True, eq=False)
class CollisionResult:
    """The result of a search. objects, camera_path : as given, with :class:`CutPath` where something was stopped.
    events   : in order of time.
    at_start : those of ``events`` at t0: invalid placements.
    distance_queries : number of exact distances computed.
    """

    objects: tuple[SceneObject, ...]
    camera_path: PosePath
    events: tuple[Collision, ...]
    at_start: tuple[Collision, ...]
    distance_queries: int

    @property
    def log(self) -> tuple[str, ...]:
        return tuple(str(event) for event in self.events)


def resolve_collisions(
    objects: tuple[SceneObject, ...] | list[SceneObject],
    camera_path: PosePath,
    camera_radius: float,
    t0_ns: int,
    t1_ns: int,
    tolerance: float = 1e-3,
    rest_margin: float = 0.01,
) -> CollisionResult:
    """Cut every moving body's path at its first collision in [t0, t1].

    objects       : moving and static ones, ground, walls and sky included.
    camera_radius : the camera is a sphere of this radius (at least the near distance, or the image cuts into surfaces)
                    around its centre, > 0.
    tolerance     : relative to the smaller body's radius, see the module's docstring; in (0, 0.1].
    rest_margin   : how deep, relative to its radius, a body may sink into what it rests on at t0; in (0, 0.1].
    """
    if not (0 < tolerance <= 0.1 and 0 < rest_margin <= 0.1 and camera_radius > 0 and t0_ns <= t1_ns):
        raise ValueError("resolve_collisions: tolerance and rest_margin in (0, 0.1], camera_radius > 0, t0_ns <= t1_ns")
    bodies = [_Body.of_object(o, int(t0_ns), int(t1_ns)) for o in objects if any(len(p.mesh.faces) for p in o.parts)]
    bodies.append(_Body.of_camera(camera_path, camera_radius))
    search = _Search(bodies, int(t0_ns), int(t1_ns), tolerance, rest_margin)
    events = tuple(search.run())
    cut = {body.source: body.path for body in bodies if body.cut}
    return CollisionResult(
        tuple(replace(o, path=cut[id(o)]) if id(o) in cut else o for o in objects),
        cut.get(CAMERA, camera_path),
        events,
        tuple(e for e in events if e.t_ns == t0_ns),
        search.distance_queries,
    )


@dataclass(eq=False)
class _Body:
    """Data of a body for the search. vertices (V, 3), faces (F, 3): all parts, local; pad: thickness added all around.
    Derived: centre, radius: bounding ball, local; arm: |centre|; reach: largest distance of a vertex from the local
    origin, which is what rotation moves; hull: (H, 3) vertices of the convex hull, local; planes: (P, 4) world (n, o)
    with n.x <= o inside, of a convex static body, else None."""

    name: str
    category: str
    source: int | str
    path: PosePath
    vertices: np.ndarray
    faces: np.ndarray
    pad: float = 0.0
    cut: bool = False

    @staticmethod
    def of_object(obj: SceneObject, t0: int, t1: int) -> _Body:
        meshes = [part.mesh for part in obj.parts if len(part.mesh.faces)]
        regions = [None if mesh.deformer is None else sweep(mesh, t0, t1) for mesh in meshes]
        solids = [
            (mesh.vertices, mesh.faces) if region is None else region.hull for mesh, region in zip(meshes, regions)
        ]
        # Vertex numbers are continued from part to part.
        first = np.cumsum([0] + [len(vertices) for vertices, _ in solids])
        return _Body(
            obj.name,
            obj.category,
            id(obj),
            obj.path,
            np.concatenate([vertices for vertices, _ in solids]),
            np.concatenate([faces + k for (_, faces), k in zip(solids, first)]),
            pad=max((region.margin for region in regions if region is not None), default=0.0),
        )

    @staticmethod
    def of_camera(path: PosePath, radius: float) -> _Body:
        # A point is a triangle of three equal corners, so that the same exact distance routine can be used.
        return _Body(CAMERA, CAMERA, CAMERA, path, np.zeros((3, 3)), np.array([[0, 1, 2]]), pad=radius)

    def __post_init__(self):
        self.vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        # The ball is around the middle of the box of vertices that faces use.
        used = self.vertices[np.unique(self.faces)]
        self.low, self.high = used.min(axis=0), used.max(axis=0)
        self.centre = 0.5 * (self.low + self.high)
        self.radius = float(np.linalg.norm(used - self.centre, axis=1).max()) + self.pad
        self.arm = float(np.linalg.norm(self.centre))
        self.reach = float(np.linalg.norm(used, axis=1).max())
        self.hull, _ = hull_of(used)
        self.is_static = self.path.is_static
        self.planes = None
        # A static body's faces are transformed to world coordinates once.
        if self.is_static and self.category != CAMERA:
            T = self.path.pose(self.path.t0_ns)
            self.planes = _face_planes(
                used @ T[:3, :3].T + T[:3, 3], self.vertices @ T[:3, :3].T + T[:3, 3], self.faces
            )
            if self.planes is not None:
                self.planes[:, 3] += self.pad

    @cached_property
    def _shape(self) -> fcl.CollisionObject:
        # Made when it is first needed: most pairs never come so near.
        model = fcl.BVHModel()
        model.beginModel(len(self.vertices), len(self.faces))
        model.addSubModel(self.vertices, self.faces)
        model.endModel()
        return fcl.CollisionObject(model)

    def shape(self, T: np.ndarray) -> fcl.CollisionObject:
        """Return its triangles at a pose, (4, 4)."""
        self._shape.setTransform(fcl.Transform(T[:3, :3], T[:3, 3]))
        return self._shape


class _Search:
    """Conservative advancement of all pairs, the earliest next time first."""

    def __init__(self, bodies: list[_Body], t0: int, t1: int, tolerance: float, rest_margin: float):
        self.bodies, self.t0, self.t1, self.tolerance, self.rest_margin = bodies, t0, t1, tolerance, rest_margin
        self.distance_queries = 0
        self.resting: dict[tuple[int, int], tuple[np.ndarray, float]] = {}

    def run(self):
        yield from self.at_start()
        # All times are equal and the pairs are ordered, so the list is a heap already.
        queue = [(self.t0, i, j) for i, j in self._pairs()]
        while queue:
            t, i, j = heapq.heappop(queue)
            a, b = self.bodies[i], self.bodies[j]
            if a.is_static and b.is_static:
                continue
            # Either a collision now, or the next time to test.
            later, hit = self._advance(i, j, t)
            if hit is not None:
                yield Collision(t, a.name, b.name, hit, self._stop(t, a, b))
            elif later < self.t1:
                heapq.heappush(queue, (later, i, j))

    def at_start(self) -> list[Collision]:
        """Return contacts at t0; record which bodies rest on which, and stop moving ones."""
        meeting = []
        for i, j in self._pairs():
            a, b = self.bodies[i], self.bodies[j]
            Ta, Tb = a.path.pose(self.t0), b.path.pose(self.t0)
            # Balls this far apart cannot touch.
            if self._ball_gap(a, b, Ta, Tb) > self._tol(a, b):
                continue
            if not self._rests(i, j, Ta, Tb):
                separation = self._distance(a, b, Ta, Tb)
                if separation <= self._tol(a, b):
                    meeting.append((a, b, max(separation, 0.0)))
        # Stopped only now, so that every pair is tested in the same scene.
        return [
            Collision(self.t0, a.name, b.name, separation, self._stop(self.t0, a, b)) for a, b, separation in meeting
        ]

    def _pairs(self):
        for i, a in enumerate(self.bodies):
            for j in range(i + 1, len(self.bodies)):
                b = self.bodies[j]
                # Ground, walls and sky may touch each other.
                surroundings = a.category in ("sky", *_SUPPORTS) and b.category in ("sky", *_SUPPORTS)
                if not surroundings and (CAMERA in (a.category, b.category) or not (a.is_static and b.is_static)):
                    yield i, j

    def _tol(self, a: _Body, b: _Body) -> float:
        # Floor: float64 distances of bodies this far from the origin are no better.
        return max(self.tolerance * min(a.radius, b.radius), 1e-12 * max(a.reach, b.reach))

    def _stop(self, t: int, *bodies: _Body) -> tuple[str, ...]:
        moving = [body for body in bodies if not body.is_static]
        for body in moving:
            # Its path ends here, and it counts as static from now on.
            body.path, body.is_static, body.cut = CutPath(body.path, t), True, True
        return tuple(body.name for body in moving)

    def _rests(self, i: int, j: int, Ta, Tb) -> bool:
        a, b = self.bodies[i], self.bodies[j]
        if a.category in _SUPPORTS:
            a, b, Ta, Tb = b, a, Tb, Ta
        if b.category not in _SUPPORTS or b.planes is None or a.category == CAMERA:
            return False
        # The plane that the body is farthest outside is the one it lies on.
        heights = _heights(b.planes, a, Ta)
        k = int(np.argmax(heights))
        # A body padded for its deformation was placed without its padding.
        if not -self.rest_margin * a.radius - a.pad <= heights[k] <= self._tol(a, b):
            return False
        self.resting[i, j] = b.planes[k : k + 1], min(float(heights[k]), 0.0)
        return True

    def _advance(self, i: int, j: int, t: int) -> tuple[int, float | None]:
        """Return (next time up to which the pair is known to be apart, None), or (t, separation) for a collision at
        t."""
        a, b = self.bodies[i], self.bodies[j]
        Ta, Tb = a.path.pose(t), b.path.pose(t)
        room, nearer = self._room(i, j, a, b, Ta, Tb)
        separation = room
        if room <= 0.0:
            tol = self._tol(a, b)
            # Closer than the cheap bounds can tell: the exact distance.
            separation = self._distance(a, b, Ta, Tb)
            if separation <= tol:
                return t, max(separation, 0.0)
            # Half of the tolerance is kept back, so that the next test still finds the bodies apart.
            room, nearer = separation - 0.5 * tol, _body_speed
        later = self._later(a, b, t, room, nearer)
        # A body that crosses the remaining distance within a nanosecond has no later time to test.
        return (later, None) if later > t else (t, separation)

    def _room(self, i: int, j: int, a: _Body, b: _Body, Ta, Tb):
        """Return how much the two may approach before they have to be tested again, without an exact distance, and the
        bound on a body's share in the approach. Room 0 when only the exact distance can decide."""
        # A resting body may sink by the margin; 0.975 of it is left before a closer test.
        if (i, j) in self.resting:
            plane, lowest = self.resting[i, j]
            body, T = (b, Tb) if a.category in _SUPPORTS else (a, Ta)
            margin = self.rest_margin * body.radius
            room = float(_heights(plane, body, T)[0]) - lowest + 0.975 * margin
            return (room if room > 0.025 * margin else 0.0), _speed_along(plane[0, :3])
        tol = self._tol(a, b)
        gap = self._ball_gap(a, b, Ta, Tb)
        # Far apart, balls are as good as triangles; nearby, an exact distance allows much larger steps.
        if gap > max(tol, 0.3 * min(a.radius, b.radius)):
            return gap - 0.5 * tol, _centre_speed
        # The lowest point over a face of a static convex body is a separating plane.
        for solid, body, T in ((a, b, Tb), (b, a, Ta)):
            if solid.planes is not None:
                heights = _heights(solid.planes, body, T)
                k = int(np.argmax(heights))
                if heights[k] > tol:
                    return float(heights[k]) - 0.5 * tol, _speed_along(solid.planes[k, :3])
        return 0.0, None

    def _later(self, a: _Body, b: _Body, t: int, room: float, speed_bound) -> int:
        """Return the latest time for which ``speed_bound`` allows no more than ``room`` of approach since t."""
        window = self.t1 - t
        for _ in range(4):
            speed = sum(speed_bound(body, t, t + window) for body in (a, b) if not body.is_static)
            # The whole rest of the time, if the bound allows it.
            if speed * window * 1e-9 <= room:
                return t + window
            step = int(room / speed * 1e9)
            # The bound over a shorter interval is smaller; below half the time a closer test does not pay.
            if 2 * step >= window:
                break
            window = min(2 * step + 1, window)
        return t + step

    def _ball_gap(self, a, b, Ta, Tb) -> float:
        """Return a lower bound of the distance: between bounding balls, or of a ball and a static body's faces."""
        ca, cb = Ta[:3, :3] @ a.centre + Ta[:3, 3], Tb[:3, :3] @ b.centre + Tb[:3, 3]
        # The balls' distance; a static convex body's faces often say more.
        gap = float(np.linalg.norm(ca - cb)) - a.radius - b.radius
        for planes, centre, radius in ((b.planes, ca, a.radius), (a.planes, cb, b.radius)):
            if planes is not None:
                gap = max(gap, float((planes[:, :3] @ centre - planes[:, 3]).max()) - radius)
        return gap

    def _distance(self, a, b, Ta, Tb) -> float:
        self.distance_queries += 1
        apart = fcl.distance(a.shape(Ta), b.shape(Tb), _REQUEST, fcl.DistanceResult())
        # fcl gives a negative number for bodies that overlap.
        return max(apart, 0.0) - a.pad - b.pad


def _body_speed(body: _Body, ta: int, tb: int) -> float:
    """Return an upper bound over [ta, tb] of the speed of any of the body's points. (A pad is round: rotation does not
    move it.)"""
    v, w = body.path.speed_bound(ta, tb)
    return v + w * body.reach


def _centre_speed(body: _Body, ta: int, tb: int) -> float:
    # Rotation moves the centre of the bounding ball by its arm, and a ball does not notice its own rotation.
    v, w = body.path.speed_bound(ta, tb)
    return v + w * body.arm


def _speed_along(normal: np.ndarray):
    """Return a bound like :func:`_body_speed` along one direction, for paths that have one."""
    normal = np.ascontiguousarray(normal)

    def speed(body: _Body, ta: int, tb: int) -> float:
        bound = getattr(body.path, "approach_bound", None)
        return _body_speed(body, ta, tb) if bound is None else bound(normal, body.reach, ta, tb)

    return speed


def _heights(planes: np.ndarray, body: _Body, T: np.ndarray) -> np.ndarray:
    """Return the (P,) heights of the body's lowest point over each plane."""
    # The planes' normals in the body's axes, so that the hull needs no transformation.
    local = planes[:, :3] @ T[:3, :3]
    return (local @ body.hull.T).min(axis=1) + planes[:, :3] @ T[:3, 3] - planes[:, 3] - body.pad


def _face_planes(used: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray | None:
    """Return the (P, 4) face planes of a convex mesh, both sides of a flat one; None when it is neither."""
    corners = vertices[faces]
    # Faces without area have no plane.
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    keep = length > 0
    if not keep.any():
        return None
    normals = normals[keep] / length[keep, None]
    # n . x = d for the plane's points, with d from one corner.
    planes = np.column_stack([normals, np.einsum("ij,ij->i", normals, corners[keep, 0])])
    extent = float(np.linalg.norm(used.max(axis=0) - used.min(axis=0)))
    # Coplanar triangles have one plane: compared to 1e-6, offsets relative to the extent.
    _, first = np.unique(np.round(planes / [1, 1, 1, max(extent, 1e-300)], 6), axis=0, return_index=True)
    planes = planes[np.sort(first)]
    if len(planes) > _MAX_PLANES:
        return None
    # Outermost vertices on both sides: faces that face inwards (a sky box) fail the first test.
    offset = used @ planes[:, :3].T - planes[:, 3]
    # Rounding errors grow with the coordinates, which may be far from the origin.
    slack = 1e-9 * max(extent, float(np.abs(used).max()))
    if offset.max() > slack:
        return None
    # Planes are moved out to the outermost vertex, so that rounding leaves none outside.
    planes[:, 3] += np.maximum(offset.max(axis=0), 0.0)
    if offset.min() >= -slack:
        # No vertex lies below any plane either: the mesh is flat and has a second side.
        opposite = -planes
        opposite[:, 3] -= offset.min(axis=0)
        planes = np.vstack([planes, opposite])
    return planes
