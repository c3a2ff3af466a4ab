"""Casting rays into a scene in float64: the surface points that they hit, and the motion of those points.

One ray goes through each pixel centre (or any other image point) and hits the nearest triangle; everything else is
computed from the object-local point of the hit. A deforming mesh is a separate mesh at each time: its vertices are
moved in float64, and rays are cast at them there.

Flow and its rounding
---------------------
With ``M(t) = inv(T_world_cam(t)) @ T_world_obj(t)``, the point p is at ``M p`` in camera coordinates, and ``X1 = X0 +
(M1 - M0) p``. For a pinhole camera ``X0 = Z0 (rx, ry, 1)`` with ``rx = (x - cx) / fx`` exact, so

    flow_x = fx (dX - rx dZ) / Z1,    (dX, dY, dZ) = (M1 - M0) p,    Z1 = Z0 + dZ,

without subtracting two projections (:meth:`blinkgl.camera.CameraModel.displacement`). ``M1 - M0`` is computed from the
differences of the poses, so a constant pose contributes exactly nothing. The point q of a deforming shape moves by ``M1
(q1 - q0) + (M1 - M0) q0``. The remaining error is about 1e-15 of the flow, plus the resolution of the poses themselves:
a translation of 1e6 units is stored to 1e-10 units, i.e. fx * 1e-10 / Z px.

Back faces: a closed mesh whose material is not double-sided is not hit from behind; any other is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.render.moment import cam_from_obj, cam_from_obj_rate
from blinkgl.render.raycast import Forest, Holes, Tree, build_tree, join_trees, nearest_tree
from blinkgl.scene.types import Mesh, Part, Scene, SceneObject
from blinkgl.types.recent import Recent

# A visibility ray ends this much (relative) before its target point, so that the point does not hide itself: far above
# the rounding of a hit (1e-15), far below any visible separation of two surfaces.
VISIBILITY_SLACK = 1e-9

KEPT = 4
"""Number of times whose shapes are kept, for a deforming scene."""
_trees: WeakKeyDictionary = WeakKeyDictionary()
_shapes: WeakKeyDictionary = WeakKeyDictionary()
_forests: WeakKeyDictionary = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class Hits:
    """The visible surface points at N image points at one time.

    xy : (N, 2) px.   t_ns : the time.   hit : (N,) bool.
    depth : (N,) Z along the optical axis in world units, inf where nothing is hit.
    instance : (N,) int32 ``instance_id``, 0 where nothing is hit.
    part : (N,) int32 index into :func:`scene_parts`, -1 where nothing is hit.   triangle : (N,) int32 index into
    ``mesh.faces``.   front : (N,) bool seen from the front.   bary : (N, 3) weights of the triangle's corners.
    local : (N, 3) object-local position at ``t_ns`` (float64, nan where nothing is hit).
    """

    xy: np.ndarray
    t_ns: int
    hit: np.ndarray
    depth: np.ndarray
    instance: np.ndarray
    part: np.ndarray
    triangle: np.ndarray
    front: np.ndarray
    bary: np.ndarray
    local: np.ndarray


@dataclass(frozen=True, eq=False)
class Flow:
    """Positions of the points of some :class:`Hits` at another time t_ns (t').

    flow : (..., 2) px, +x right, +y down, t -> t'; nan where not valid.
    valid : hit, and in front of the camera at t' (Z' > 0), where its model sees it.
    occluded : valid, but not visible at t': hidden by a surface, seen from its own culled side, outside the image or in
    front of the near plane.   outside : valid, and not inside the image at t'.
    depth : (...) Z' at t'.   hidden_by : (..., 2) int32 (part, triangle) of the nearest occluder, or -1.
    """

    t_ns: int
    flow: np.ndarray
    valid: np.ndarray
    occluded: np.ndarray
    outside: np.ndarray
    depth: np.ndarray
    hidden_by: np.ndarray


def scene_parts(scene: Scene) -> list[tuple[SceneObject, Part]]:
    """Return every part with its object, in the order of part indices."""
    return [(obj, part) for obj in scene.objects for part in obj.parts]


def pixel_grid(camera: CameraModel) -> np.ndarray:
    """Return pixel centres row by row, (H * W, 2) float64."""
    y, x = np.mgrid[0 : camera.height, 0 : camera.width]
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


def cast(scene: Scene, t_ns: int, xy: np.ndarray | None = None) -> Hits:
    """Return the nearest hit of each image point's ray.

    xy : (N, 2) image points in px, not necessarily inside the image; None: every pixel centre."""
    xy = pixel_grid(scene.camera) if xy is None else np.atleast_2d(np.asarray(xy, np.float64))
    hit, bary, depth = nearest(scene, t_ns, rays_of(scene.camera, xy)[:, :2])
    parts = scene_parts(scene)
    # A part's number -1 (nothing hit) indexes the added 0 at the end.
    is_hit = hit[:, 0] >= 0
    ids = np.array([obj.instance_id for obj, _ in parts] + [0], np.int32)
    local = np.full((len(xy), 3), np.nan)
    hits = Hits(
        xy=xy,
        t_ns=int(t_ns),
        hit=is_hit,
        depth=depth,
        instance=ids[hit[:, 0]],
        part=hit[:, 0],
        triangle=hit[:, 1],
        front=hit[:, 2] == 1,
        bary=bary,
        local=local,
    )
    return replace(hits, local=local_at(scene, hits, t_ns))


def rays_of(camera: CameraModel, xy: np.ndarray) -> np.ndarray:
    """Return (N, 3) rays of length 1 along the optical axis; nan for a pixel without a ray that points forward."""
    rays = camera.rays(xy)
    # nan marks a pixel that has no ray with Z > 0.
    return rays / np.where(rays[:, 2:] > 0, rays[:, 2:], np.nan)


def vertices_at(mesh: Mesh, t_ns: int) -> np.ndarray:
    """Return object-local positions at a time, (V, 3) float64; the last few are kept. Read only."""
    if mesh.deformer is None:
        return np.asarray(mesh.vertices, np.float64)
    return _shapes.setdefault(mesh, Recent(KEPT)).of(t_ns, lambda: mesh.deformer.positions(mesh, t_ns))


def _forest(scene: Scene, t_ns: int) -> Forest:
    # One forest for all times, unless a shape deforms.
    key = t_ns if any(obj.deforms for obj in scene.objects) else None
    return _forests.setdefault(scene, Recent(KEPT)).of(key, lambda: _planted(scene, t_ns))


def _planted(scene: Scene, t_ns: int) -> Forest:
    parts = [part for _, part in scene_parts(scene)]
    trees = [_tree(part.mesh, t_ns) for part in parts]
    return join_trees(trees, [part.side(t_ns) for part in parts], [_holes_of(part) for part in parts])


def _tree(mesh: Mesh, t_ns: int) -> Tree:
    if mesh.deformer is not None:
        return build_tree(vertices_at(mesh, t_ns), mesh.faces)
    # Weak keys: objects of several scenes share meshes, and their trees live as long as they do.
    if mesh not in _trees:
        _trees[mesh] = build_tree(mesh.vertices, mesh.faces)
    return _trees[mesh]


def _holes_of(part: Part) -> Holes | None:
    """Return a part's holes in the ray caster's form."""
    mask, mesh = part.material.mask, part.mesh
    if mask is None:
        return None
    # The same scale as in the shader's texture coordinates.
    uvs = mesh.uvs[mesh.faces].astype(np.float64) * np.asarray(part.material.uv_scale)
    return Holes(uvs, mask.alpha.astype(np.float32) / np.float32(255), mask.threshold, part.material.wrap)


def nearest(
    scene: Scene,
    t_ns: int,
    rays: np.ndarray,
    far: np.ndarray | None = None,
    skip: np.ndarray | None = None,
    eye: np.ndarray | None = None,
    near: float | None = None,
    any_will_do: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (hit (N, 3) int32, bary (N, 3), depth (N,)) as described at :func:`raycast.nearest_tree`. eye, near : for
    rays from elsewhere: their (4, 4) pose, and the Z at which they begin.   any_will_do : as there."""
    forest = _forest(scene, int(t_ns))
    camera_pose = scene.camera_path.pose(t_ns) if eye is None else eye
    # relative to the camera by differences of positions, so that a common offset from the origin cancels first
    relative = [cam_from_obj(camera_pose, obj.path.pose(t_ns)) for obj, _ in scene_parts(scene)]
    # R^T, whose columns are the camera's axes in the object's frame.
    axes = np.array([m[:3, :3].T for m in relative]).reshape(-1, 3, 3)
    # The camera's centre in each object's axes, -R^T t.
    origins = np.array([-m[:3, :3].T @ m[:3, 3] for m in relative]).reshape(-1, 3)
    n = len(rays)
    far = np.full(n, np.inf) if far is None else far
    skip = np.full((n, 2), -1, np.int32) if skip is None else skip
    hit, bary, depth = np.empty((n, 3), np.int32), np.zeros((n, 3)), np.empty(n)
    nearest_tree(
        forest,
        origins,
        np.ascontiguousarray(axes),
        np.ascontiguousarray(rays),
        float(scene.camera.near if near is None else near),
        far,
        skip,
        hit,
        bary,
        depth,
        any_will_do,
    )
    return hit, bary, depth


def by_part(part: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Return (p, indices of the points on part p) for every part that was hit."""
    return [(int(p), np.flatnonzero(part == p)) for p in np.unique(part) if p >= 0]


def _relative_change(scene: Scene, obj: SceneObject, t0_ns: int, t1_ns: int) -> np.ndarray:
    """Return (3, 4) M(t1) - M(t0) with M the pose in the camera's frame, from the differences of the poses."""
    c0, c1 = scene.camera_path.pose(t0_ns), scene.camera_path.pose(t1_ns)
    b0, b1 = obj.path.pose(t0_ns), obj.path.pose(t1_ns)
    # M1 - M0 = C1^T (B1 - B0) + (C1 - C0)^T B0, and likewise for the translation: differences only.
    turn = (c1[:3, :3] - c0[:3, :3]).T
    shift = (b1[:3, 3] - b0[:3, 3]) - (c1[:3, 3] - c0[:3, 3])
    change = np.empty((3, 4))
    change[:, :3] = c1[:3, :3].T @ (b1[:3, :3] - b0[:3, :3]) + turn @ b0[:3, :3]
    change[:, 3] = c1[:3, :3].T @ shift + turn @ (b0[:3, 3] - c0[:3, 3])
    return change


def _relative_rate(scene: Scene, obj: SceneObject, t_ns: int) -> np.ndarray:
    """Return (3, 4) dM/dt in 1/s: the analytic twist of the body relative to the moving camera."""
    camera, body = ((path.pose(t_ns), path.derivative(t_ns)) for path in (scene.camera_path, obj.path))
    return cam_from_obj_rate(*camera, *body)[:3]


def applied(scene: Scene, hits: Hits, matrix_of: Callable[[SceneObject], np.ndarray]) -> np.ndarray:
    """Return matrix_of(object) (3, 4) applied to every object-local point, (N, 3); nan where nothing is hit."""
    parts, out = scene_parts(scene), np.full((len(hits.hit), 3), np.nan)
    for p, rows in by_part(hits.part):
        m = matrix_of(parts[p][0])
        out[rows] = hits.local[rows] @ m[:3, :3].T + m[:3, 3]
    return out


def _add_of_shapes(scene: Scene, hits: Hits, out: np.ndarray, t_ns: int, vectors_of) -> None:
    """Add the motion of deforming shapes to ``out`` (N, 3): vectors_of(mesh) (V, 3) at the hit point, from the object's
    axes to the camera's at t_ns."""
    for p, rows in by_part(hits.part):
        obj, part = scene_parts(scene)[p]
        if part.mesh.deformer is not None:
            corners = vectors_of(part.mesh)[part.mesh.faces[hits.triangle[rows]]]
            # The mean of the corners' vectors, with barycentric weights.
            moved = np.einsum("nc,nck->nk", hits.bary[rows], corners)
            out[rows] += moved @ relative_pose_at(scene, obj, t_ns)[:3, :3].T


def local_at(scene: Scene, hits: Hits, t_ns: int) -> np.ndarray:
    """Return object-local positions of the hit points at another time, (N, 3); nan where nothing is hit."""
    parts, out = scene_parts(scene), np.full((len(hits.hit), 3), np.nan)
    for p, rows in by_part(hits.part):
        mesh = parts[p][1].mesh
        corners = vertices_at(mesh, t_ns)[mesh.faces[hits.triangle[rows]]]
        out[rows] = np.einsum("nc,nck->nk", hits.bary[rows], corners)
    return out


def flow_to(scene: Scene, hits: Hits, t_ns: int) -> Flow:
    """Return the displacement of every hit point from ``hits.t_ns`` to t_ns, and its visibility there."""
    camera = scene.camera
    change = applied(scene, hits, lambda obj: _relative_change(scene, obj, hits.t_ns, t_ns))
    _add_of_shapes(scene, hits, change, t_ns, lambda mesh: vertices_at(mesh, t_ns) - vertices_at(mesh, hits.t_ns))
    depth = hits.depth + change[:, 2]
    valid = hits.hit & (depth > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        # fx (dX - rx dZ) / Z1 and likewise in y, as the module's docstring derives it.
        flow = np.where(valid[:, None], camera.displacement(rays_of(camera, hits.xy), hits.depth, change), np.nan)
        # A lens may not see the point at its new place.
        valid &= np.isfinite(flow).all(axis=1)
        there = hits.xy + flow
        # Pixel centres are at whole numbers, so the image reaches half a pixel beyond the outer ones.
        inside = valid & ((there >= -0.5) & (there < [camera.width - 0.5, camera.height - 0.5])).all(axis=1)

    # the ray aims at the moved point itself: through xy + flow it would have that sum's rounding
    there_hits = replace(hits, local=local_at(scene, hits, t_ns))
    moved = applied(scene, there_hits, lambda obj: relative_pose_at(scene, obj, t_ns))
    seen, hidden_by = is_seen(scene, hits, t_ns, moved, inside & (depth >= camera.near))
    occluded = valid & ~seen
    return Flow(
        t_ns=int(t_ns),
        flow=flow,
        valid=valid,
        occluded=occluded,
        outside=valid & ~inside,
        depth=depth,
        hidden_by=hidden_by,
    )


def moved_in_space(scene: Scene, hits: Hits, t_ns: int) -> np.ndarray:
    """Return how far every hit point moves in the world from ``hits.t_ns`` to t_ns, (N, 3), in the camera's axes at
    ``hits.t_ns``; nan where nothing is hit."""
    # The motion of the shape plus that of the pose.
    own = replace(hits, local=local_at(scene, hits, t_ns) - hits.local)
    carried = applied(scene, hits, lambda obj: _pose_change(obj, hits.t_ns, t_ns))
    # A difference of positions is a vector: the pose rotates it and does not shift it.
    changed = applied(scene, own, lambda obj: np.c_[obj.path.pose(t_ns)[:3, :3], np.zeros(3)])
    return (carried + changed) @ scene.camera_path.pose(hits.t_ns)[:3, :3]


def _pose_change(obj: SceneObject, t0_ns: int, t1_ns: int) -> np.ndarray:
    """Return the difference of two poses, (3, 4); zero for a sky at infinity, whose box only follows the camera."""
    if obj.at_infinity:
        return np.zeros((3, 4))
    return (obj.path.pose(t1_ns) - obj.path.pose(t0_ns))[:3]


def is_seen(
    scene: Scene, hits: Hits, t_ns: int, moved: np.ndarray, candidate: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (N,) bool: which points of ``hits`` are visible at t_ns, and (N, 2) int32 (part, triangle) of the nearest
    occluder, or -1.

    moved : (N, 3) their positions then, camera axes.   candidate : (N,) bool, those in the image and behind the near
    plane; the others are not visible."""
    candidate = candidate & _faces_camera(scene, hits, t_ns, candidate)
    hidden_by = np.full((len(hits.hit), 2), -1, np.int32)
    rows = np.flatnonzero(candidate)
    skip = np.ascontiguousarray(np.stack([hits.part[rows], hits.triangle[rows]], axis=1))
    # The ray stops a little before the point, so that its own surface does not hide it.
    far = moved[rows, 2] * (1.0 - VISIBILITY_SLACK)
    # Rays are (X, Y) / Z, so that the ray's parameter is the depth.
    blocker, _, _ = nearest(scene, t_ns, moved[rows, :2] / moved[rows, 2:], far=far, skip=skip)
    hidden_by[rows] = blocker[:, :2]
    return candidate & (hidden_by[:, 0] < 0), hidden_by


def is_hidden(scene: Scene, t_ns: int, xy: np.ndarray, depth: np.ndarray, slack: float) -> np.ndarray:
    """Return (N,) bool: whether something is in front of points at (N, 2) ``xy`` px and (N,) ``depth`` at t_ns.

    slack : a surface nearer by less than this fraction of the depth counts as the point's own."""
    far = depth * (1.0 - slack)
    hit, _, _ = nearest(scene, t_ns, rays_of(scene.camera, xy)[:, :2], far=far, any_will_do=True)
    return hit[:, 0] >= 0


def velocity(scene: Scene, hits: Hits) -> np.ndarray:
    """Return the image velocity of every hit point at ``hits.t_ns``, (N, 2) px/s, from the analytic twists."""
    rate = applied(scene, hits, lambda obj: _relative_rate(scene, obj, hits.t_ns))
    _add_of_shapes(scene, hits, rate, hits.t_ns, lambda mesh: mesh.deformer.velocity(mesh, hits.t_ns))
    with np.errstate(invalid="ignore"):
        points = rays_of(scene.camera, hits.xy) * hits.depth[:, None]
        # The chain rule: the projection's derivative at the point, (2, 3), times its rate in the camera's axes.
        return np.einsum("nij,nj->ni", scene.camera.jacobian(points), rate)


def relative_pose_at(scene: Scene, obj: SceneObject, t_ns: int) -> np.ndarray:
    """Return T_cam_obj at t_ns, (4, 4)."""
    return cam_from_obj(scene.camera_path.pose(t_ns), obj.path.pose(t_ns))


def _faces_camera(scene: Scene, hits: Hits, t_ns: int, rows: np.ndarray) -> np.ndarray:
    """Return (N,) bool: the triangle of each hit is drawn from the camera's position at t_ns (False only for culled
    ones)."""
    shown = np.ones(len(rows), bool)
    for p, (obj, part) in enumerate(scene_parts(scene)):
        on = np.flatnonzero(rows & (hits.part == p))
        if len(on) and (side := part.side(t_ns)):
            m = relative_pose_at(scene, obj, t_ns)
            # The camera's centre in the object's axes, -R^T t.
            eye = -m[:3, :3].T @ m[:3, 3]
            a, b, c = np.moveaxis(vertices_at(part.mesh, t_ns)[part.mesh.faces[hits.triangle[on]]], 1, 0)
            # The eye is on the drawn side of the triangle's plane.
            shown[on] = side * (np.cross(b - a, c - a) * (eye - a)).sum(axis=1) > 0.0
    return shown
