"""The float64 reference renderer: what every buffer of every pass should hold, by casting rays on the CPU.

It shares nothing with the rasteriser but :mod:`blinkgl.scene.types` and the camera models: no GLSL, no clip space, no
projection matrix. It sees through any camera model whose rays point forward (Z > 0).
Tests and the shader debugger compare the GPU with it. One ray goes through each pixel centre (or any other image
point); it hits the nearest triangle, and everything else follows from the object-local point of the hit. A mesh that
deforms is a mesh of its own at each time: its vertices are moved in float64, and rays are cast at them there.

Flow and its rounding
---------------------
With ``M(t) = inv(T_world_cam(t)) @ T_world_obj(t)``, the point p is at ``M p`` in camera coordinates, and
``X1 = X0 + (M1 - M0) p``. For a pin-hole camera ``X0 = Z0 (rx, ry, 1)`` with ``rx = (x - cx) / fx`` exact, so

    flow_x = fx (dX - rx dZ) / Z1,    (dX, dY, dZ) = (M1 - M0) p,    Z1 = Z0 + dZ,

without subtracting two projections (:meth:`blinkgl.camera.CameraModel.displacement`). ``M1 - M0`` is formed from the
differences of the poses, so a pose that does not change contributes exactly nothing. The point q of a
shape that changes moves by ``M1 (q1 - q0) + (M1 - M0) q0``. What is left is about 1e-15 of the
flow, plus the resolution of the poses themselves: a translation of size 1e6 units is stored
to 1e-10 units, i.e. fx * 1e-10 / Z px.

Back faces: a closed mesh whose material is not double-sided is not hit from behind; any other is, with the shading
normal turned round. Textures are sampled bilinearly at their full resolution, without mip maps: mip maps are the GPU's
way to anti-alias, not a property of the scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from scipy import ndimage

from blinkgl.camera import CameraModel
from blinkgl.render.raycast import Forest, Holes, build_tree, join_trees, nearest_exhaustive, nearest_tree
from blinkgl.scene.geometry.tangents import tangents
from blinkgl.scene.lights import ambient, beam, lamps_of, quadric_of, quartic_of, shadowing, surroundings_of
from blinkgl.scene.shapes.deformer import normals_at
from blinkgl.scene.surfaces import gloss
from blinkgl.scene.types import REPEAT, Lamp, Map, Material, Mesh, Part, Scene, SceneObject, Texture

LUMA = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709, of linear R, G, B
# A visibility ray ends this much (relative) before the point it aims at, so that the point does not hide itself:
# far above the rounding of a hit (1e-15), far below any separation of two surfaces that a picture could show.
VISIBILITY_SLACK = 1e-9

KEPT = 4
"""Times whose shapes are kept, of a scene that deforms."""
_trees: WeakKeyDictionary = WeakKeyDictionary()
_shapes: WeakKeyDictionary = WeakKeyDictionary()
_forests: WeakKeyDictionary = WeakKeyDictionary()


# ------------------------------------------------------------------------------------------------- rays and hits


@dataclass(frozen=True, eq=False)
class Hits:
    """The surface points seen at N image points at one time.

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
    """Where the points of some :class:`Hits` are at t_ns (t').

    flow : (..., 2) px, +x right, +y down, t -> t'; nan where not valid.
    valid : hit, and in front of the camera at t' (Z' > 0), where its model sees it.
    occluded : valid, but not visible at t': hidden by a surface, seen from its own culled side, outside the image or in
    front of the near plane.   outside : valid, and not inside the image at t'.
    depth : (...) Z' at t'.   hidden_by : (..., 2) int32 (part, triangle) of the nearest thing in the way, or -1.
    """

    t_ns: int
    flow: np.ndarray
    valid: np.ndarray
    occluded: np.ndarray
    outside: np.ndarray
    depth: np.ndarray
    hidden_by: np.ndarray


@dataclass(frozen=True, eq=False)
class Surface:
    """What the surface looks like at some :class:`Hits`.

    normal : (..., 3) unit shading normal in world coordinates, on the camera's side.   uv : (..., 2) before uv_scale.
    albedo, colour : (..., 3) linear light.   luminance : (...) Rec. 709 luma of colour.
    Where nothing is hit: normal and uv nan, albedo 0, colour and luminance the scene's background.
    """

    normal: np.ndarray
    uv: np.ndarray
    albedo: np.ndarray
    colour: np.ndarray
    luminance: np.ndarray


@dataclass(frozen=True, eq=False)
class ReferenceFrame:
    """All buffers of one image; (H, W, ...) float64 unless said otherwise. See :class:`Hits`, :class:`Surface`,
    :class:`Flow` for the fields. velocity : (H, W, 2) px/s at t, nan where nothing is hit.
    forward, backward : flow to the times that were asked for, else None."""

    t_ns: int
    hit: np.ndarray
    depth: np.ndarray
    instance: np.ndarray
    part: np.ndarray
    triangle: np.ndarray
    bary: np.ndarray
    local: np.ndarray
    normal: np.ndarray
    uv: np.ndarray
    albedo: np.ndarray
    colour: np.ndarray
    luminance: np.ndarray
    velocity: np.ndarray
    forward: Flow | None
    backward: Flow | None
    front: np.ndarray
    xy: np.ndarray

    def hits(self) -> Hits:
        """What was hit at the pixels' centres, row by row."""
        flat = {name: (a := getattr(self, name)).reshape(self.hit.size, *a.shape[2:]) for name in _HIT_IMAGES}
        return Hits(t_ns=self.t_ns, **flat)

    def scene_flow(self, scene: Scene) -> np.ndarray:
        """(H, W, 3) world units, as :func:`moved_in_space` to the forward flow's time; 0 where nothing is hit."""
        assert self.forward is not None
        moved = moved_in_space(scene, self.hits(), self.forward.t_ns).reshape(*self.hit.shape, 3)
        return np.where(self.hit[..., None], moved, 0.0)


def scene_parts(scene: Scene) -> list[tuple[SceneObject, Part]]:
    """Every part with its object, in the order that part indices count."""
    return [(thing, part) for thing in scene.objects for part in thing.parts]


def pixel_grid(camera: CameraModel) -> np.ndarray:
    """(H * W, 2) float64 pixel centres, row by row."""
    y, x = np.mgrid[0 : camera.height, 0 : camera.width]
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


def cast(scene: Scene, t_ns: int, xy: np.ndarray | None = None, *, exhaustive: bool = False) -> Hits:
    """The nearest hit behind each image point.

    xy : (N, 2) image points in px, not necessarily inside the image; every pixel centre when left out.
    exhaustive : test every triangle (the slow twin of the hierarchy; the same answer bit for bit).
    """
    xy = pixel_grid(scene.camera) if xy is None else np.atleast_2d(np.asarray(xy, np.float64))
    hit, bary, depth = _nearest(scene, t_ns, _rays(scene.camera, xy)[:, :2], exhaustive=exhaustive)
    parts = scene_parts(scene)
    # A part's number -1 (nothing hit) indexes the added 0 at the end.
    found = hit[:, 0] >= 0
    ids = np.array([thing.instance_id for thing, _ in parts] + [0], np.int32)
    local = np.full((len(xy), 3), np.nan)
    for p, rows in _by_part(hit[:, 0]):
        mesh = parts[p][1].mesh
        corners = vertices_at(mesh, t_ns)[mesh.faces[hit[rows, 1]]]
        local[rows] = np.einsum("nc,nck->nk", bary[rows], corners)
    return Hits(xy, int(t_ns), found, depth, ids[hit[:, 0]], hit[:, 0], hit[:, 1], hit[:, 2] == 1, bary, local)


def _rays(camera: CameraModel, xy: np.ndarray) -> np.ndarray:
    """Return (N, 3) rays of length 1 along the optical axis; nan for a pixel without a ray that points forward."""
    rays = camera.rays(xy)
    # nan marks a pixel that has no ray with Z > 0.
    return rays / np.where(rays[:, 2:] > 0, rays[:, 2:], np.nan)


def vertices_at(mesh: Mesh, t_ns: int) -> np.ndarray:
    """(V, 3) float64 object-local positions at a time; those of the last few are kept. Not to be written to."""
    if mesh.deformer is None:
        return np.asarray(mesh.vertices, np.float64)
    kept = _shapes.setdefault(mesh, {})
    if t_ns not in kept:
        kept[t_ns] = mesh.deformer.positions(mesh, t_ns)
        # The oldest shape goes; dictionaries keep the order of insertion.
        while len(kept) > KEPT:
            kept.pop(next(iter(kept)))
    return kept[t_ns]


def _forest(scene: Scene, t_ns: int) -> Forest:
    kept = _forests.setdefault(scene, {})
    # One forest for all times, unless some shape changes.
    key = t_ns if any(thing.deforms for thing in scene.objects) else None
    if key not in kept:
        parts = scene_parts(scene)
        trees = []
        for _, part in parts:
            if part.mesh.deformer is not None:
                trees.append(build_tree(vertices_at(part.mesh, t_ns), part.mesh.faces))
                continue
            if part.mesh not in _trees:
                _trees[part.mesh] = build_tree(part.mesh.vertices, part.mesh.faces)
            trees.append(_trees[part.mesh])
        kept[key] = join_trees(trees, [part.culled for _, part in parts], [_holes_of(part) for _, part in parts])
        while len(kept) > KEPT:
            kept.pop(next(iter(kept)))
    return kept[key]


def _holes_of(part: Part) -> Holes | None:
    """Return a part's holes as the ray caster takes them."""
    mask, mesh = part.material.mask, part.mesh
    if mask is None:
        return None
    # The same scale as in the shader's texture coordinates.
    uvs = mesh.uvs[mesh.faces].astype(np.float64) * np.asarray(part.material.uv_scale)
    return Holes(uvs, mask.alpha.astype(np.float32) / np.float32(255), mask.threshold, part.material.wrap)


def _nearest(scene, t_ns, rays, far=None, skip=None, exhaustive=False, eye=None, near=None, any_will_do=False):
    """Return (hit (N, 3) int32, bary (N, 3), depth (N,)) as described at :func:`raycast.nearest_tree`. eye, near :
    of other rays than the camera's: (4, 4) pose where they come from, Z at which they begin.   any_will_do : as
    there."""
    forest = _forest(scene, int(t_ns))
    camera_pose = scene.camera_path.pose(t_ns) if eye is None else eye
    # relative to the camera by differences of positions, so that a common offset from the origin cancels first
    relative = [_relative_pose(camera_pose, thing.path.pose(t_ns)) for thing, _ in scene_parts(scene)]
    axes = np.array([m[:3, :3].T for m in relative]).reshape(-1, 3, 3)
    origins = np.array([-m[:3, :3].T @ m[:3, 3] for m in relative]).reshape(-1, 3)
    n = len(rays)
    far = np.full(n, np.inf) if far is None else far
    skip = np.full((n, 2), -1, np.int32) if skip is None else skip
    hit, bary, depth = np.empty((n, 3), np.int32), np.zeros((n, 3)), np.empty(n)
    kernel = nearest_exhaustive if exhaustive else nearest_tree
    kernel(
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


def _by_part(part: np.ndarray):
    """Return (p, indices of the points on part p) for every part that was hit."""
    return [(int(p), np.flatnonzero(part == p)) for p in np.unique(part) if p >= 0]


# ------------------------------------------------------------------------------------------------- motion


def _relative_pose(camera: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Return the (4, 4) inv(camera) @ body of rigid poses."""
    m = np.eye(4)
    m[:3, :3] = camera[:3, :3].T @ body[:3, :3]
    m[:3, 3] = camera[:3, :3].T @ (body[:3, 3] - camera[:3, 3])
    return m


def _relative_change(scene: Scene, thing: SceneObject, t0_ns: int, t1_ns: int) -> np.ndarray:
    """Return (3, 4) M(t1) - M(t0) with M the pose in the camera's frame, from the differences of the poses."""
    c0, c1 = scene.camera_path.pose(t0_ns), scene.camera_path.pose(t1_ns)
    b0, b1 = thing.path.pose(t0_ns), thing.path.pose(t1_ns)
    # M1 - M0 = C1^T (B1 - B0) + (C1 - C0)^T B0, and likewise for the translation: differences only.
    turn = (c1[:3, :3] - c0[:3, :3]).T
    shift = (b1[:3, 3] - b0[:3, 3]) - (c1[:3, 3] - c0[:3, 3])
    change = np.empty((3, 4))
    change[:, :3] = c1[:3, :3].T @ (b1[:3, :3] - b0[:3, :3]) + turn @ b0[:3, :3]
    change[:, 3] = c1[:3, :3].T @ shift + turn @ (b0[:3, 3] - c0[:3, 3])
    return change


def _relative_rate(scene: Scene, thing: SceneObject, t_ns: int) -> np.ndarray:
    """Return (3, 4) dM/dt in 1/s: the analytic twist of the body as the moving camera sees it."""
    c, dc = scene.camera_path.pose(t_ns), scene.camera_path.derivative(t_ns)
    b, db = thing.path.pose(t_ns), thing.path.derivative(t_ns)
    rate = np.empty((3, 4))
    # The product rule on C^T B and on C^T (b - c).
    rate[:, :3] = dc[:3, :3].T @ b[:3, :3] + c[:3, :3].T @ db[:3, :3]
    rate[:, 3] = dc[:3, :3].T @ (b[:3, 3] - c[:3, 3]) + c[:3, :3].T @ (db[:3, 3] - dc[:3, 3])
    return rate


def applied(scene: Scene, hits: Hits, matrix_of: Callable[[SceneObject], np.ndarray]) -> np.ndarray:
    """(N, 3) matrix_of(object) (3, 4) applied to every object-local point; nan where nothing is hit."""
    parts, out = scene_parts(scene), np.full((len(hits.hit), 3), np.nan)
    for p, rows in _by_part(hits.part):
        m = matrix_of(parts[p][0])
        out[rows] = hits.local[rows] @ m[:3, :3].T + m[:3, 3]
    return out


def _add_of_shapes(scene: Scene, hits: Hits, out: np.ndarray, t_ns: int, vectors_of) -> None:
    """Adds to ``out`` (N, 3) what the shape itself does, on parts that deform: vectors_of(mesh) (V, 3) at the hit
    point, from the object's axes to the camera's at t_ns."""
    for p, rows in _by_part(hits.part):
        thing, part = scene_parts(scene)[p]
        if part.mesh.deformer is not None:
            corners = vectors_of(part.mesh)[part.mesh.faces[hits.triangle[rows]]]
            moved = np.einsum("nc,nck->nk", hits.bary[rows], corners)
            out[rows] += moved @ relative_pose_at(scene, thing, t_ns)[:3, :3].T


def local_at(scene: Scene, hits: Hits, t_ns: int) -> np.ndarray:
    """(N, 3) object-local positions of the hit points at another time."""
    out = hits.local
    for p, rows in _by_part(hits.part):
        mesh = scene_parts(scene)[p][1].mesh
        if mesh.deformer is not None:
            out = out.copy() if out is hits.local else out
            out[rows] = np.einsum(
                "nc,nck->nk", hits.bary[rows], vertices_at(mesh, t_ns)[mesh.faces[hits.triangle[rows]]]
            )
    return out


def flow_to(scene: Scene, hits: Hits, t_ns: int) -> Flow:
    """Displacement of every hit point from ``hits.t_ns`` to t_ns, and whether it is seen there."""
    camera = scene.camera
    change = applied(scene, hits, lambda thing: _relative_change(scene, thing, hits.t_ns, t_ns))
    _add_of_shapes(scene, hits, change, t_ns, lambda mesh: vertices_at(mesh, t_ns) - vertices_at(mesh, hits.t_ns))
    depth = hits.depth + change[:, 2]
    valid = hits.hit & (depth > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        # fx (dX - rx dZ) / Z1 and likewise in y, as the module's docstring derives it.
        flow = np.where(valid[:, None], camera.displacement(_rays(camera, hits.xy), hits.depth, change), np.nan)
        # A lens may not see the point at its new place.
        valid &= np.isfinite(flow).all(axis=1)
        there = hits.xy + flow
        inside = valid & ((there >= -0.5) & (there < [camera.width - 0.5, camera.height - 0.5])).all(axis=1)

    # the ray aims at the moved point itself: through there = xy + flow it would carry that sum's rounding
    there_hits = replace(hits, local=local_at(scene, hits, t_ns))
    moved = applied(scene, there_hits, lambda thing: relative_pose_at(scene, thing, t_ns))
    seen, hidden_by = is_seen(scene, hits, t_ns, moved, inside & (depth >= camera.near))
    occluded = valid & ~seen
    return Flow(int(t_ns), flow, valid, occluded, valid & ~inside, depth, hidden_by)


def moved_in_space(scene: Scene, hits: Hits, t_ns: int) -> np.ndarray:
    """(N, 3) how far every hit point moves in the world from ``hits.t_ns`` to t_ns, in the camera's axes at
    ``hits.t_ns``; nan where nothing is hit."""
    # The shape's own change, and the pose's.
    own = replace(hits, local=local_at(scene, hits, t_ns) - hits.local)
    carried = applied(scene, hits, lambda thing: (thing.path.pose(t_ns) - thing.path.pose(hits.t_ns))[:3])
    changed = applied(scene, own, lambda thing: np.c_[thing.path.pose(t_ns)[:3, :3], np.zeros(3)])
    return (carried + changed) @ scene.camera_path.pose(hits.t_ns)[:3, :3]


def is_seen(
    scene: Scene, hits: Hits, t_ns: int, moved: np.ndarray, candidate: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool: which of the points of ``hits`` are seen at t_ns, and (N, 2) int32 (part, triangle) of the nearest
    thing in the way, or -1.

    moved : (N, 3) where they are then, camera axes.   candidate : (N,) bool, those in the image and behind the near
    plane; the others are not seen."""
    candidate = candidate & _faces_camera(scene, hits, t_ns, candidate)
    hidden_by = np.full((len(hits.hit), 2), -1, np.int32)
    rows = np.flatnonzero(candidate)
    skip = np.ascontiguousarray(np.stack([hits.part[rows], hits.triangle[rows]], axis=1))
    # The ray stops a little before the point, so that its own surface does not hide it.
    far = moved[rows, 2] * (1.0 - VISIBILITY_SLACK)
    blocker, _, _ = _nearest(scene, t_ns, moved[rows, :2] / moved[rows, 2:], far=far, skip=skip)
    hidden_by[rows] = blocker[:, :2]
    return candidate & (hidden_by[:, 0] < 0), hidden_by


def is_hidden(scene: Scene, t_ns: int, xy: np.ndarray, depth: np.ndarray, slack: float) -> np.ndarray:
    """(N,) bool: something is in front of points that are at (N, 2) ``xy`` px and (N,) ``depth`` at t_ns.

    slack : what is nearer by less than this part of the depth counts as the point's own surface."""
    far = depth * (1.0 - slack)
    hit, _, _ = _nearest(scene, t_ns, _rays(scene.camera, xy)[:, :2], far=far, any_will_do=True)
    return hit[:, 0] >= 0


def velocity(scene: Scene, hits: Hits) -> np.ndarray:
    """(N, 2) px/s image velocity of every hit point at ``hits.t_ns``, from the analytic twists."""
    rate = applied(scene, hits, lambda thing: _relative_rate(scene, thing, hits.t_ns))
    _add_of_shapes(scene, hits, rate, hits.t_ns, lambda mesh: mesh.deformer.velocity(mesh, hits.t_ns))
    with np.errstate(invalid="ignore"):
        points = _rays(scene.camera, hits.xy) * hits.depth[:, None]
        return np.einsum("nij,nj->ni", scene.camera.jacobian(points), rate)


def relative_pose_at(scene: Scene, thing: SceneObject, t_ns: int) -> np.ndarray:
    """(4, 4) T_cam_obj at t_ns."""
    return _relative_pose(scene.camera_path.pose(t_ns), thing.path.pose(t_ns))


def _faces_camera(scene: Scene, hits: Hits, t_ns: int, rows: np.ndarray) -> np.ndarray:
    """Return (N,) bool: the triangle of each hit is drawn from where the camera is at t_ns (False only for culled
    ones)."""
    shown = np.ones(len(rows), bool)
    for p, (thing, part) in enumerate(scene_parts(scene)):
        on = np.flatnonzero(rows & (hits.part == p))
        if len(on) and part.culled:
            m = relative_pose_at(scene, thing, t_ns)
            eye = -m[:3, :3].T @ m[:3, 3]
            a, b, c = np.moveaxis(vertices_at(part.mesh, t_ns)[part.mesh.faces[hits.triangle[on]]], 1, 0)
            # The eye is on the outer side of the triangle's plane.
            shown[on] = (np.cross(b - a, c - a) * (eye - a)).sum(axis=1) > 0.0
    return shown


# ------------------------------------------------------------------------------------------------- appearance


def surface(scene: Scene, hits: Hits) -> Surface:
    """Normals, texture coordinates, albedo and radiance at every hit."""
    n = len(hits.hit)
    normal, uv = np.full((n, 3), np.nan), np.full((n, 2), np.nan)
    albedo, colour = np.zeros((n, 3)), np.full((n, 3), float(scene.backdrop))
    parts = scene_parts(scene)
    for p, rows in _by_part(hits.part):
        thing, part = parts[p]
        corners = part.mesh.faces[hits.triangle[rows]]
        bary = hits.bary[rows]
        # Interpolated over the triangle, as the rasteriser does, then made unit.
        blend = np.einsum("nc,nck->nk", bary, normals_at(part.mesh, hits.t_ns)[corners].astype(np.float64))
        # The maximum keeps a zero normal zero instead of NaN.
        length = np.maximum(np.linalg.norm(blend, axis=1, keepdims=True), 1e-15)
        # A surface seen from behind is lit from that side.
        sign = np.where(hits.front[rows], 1.0, -1.0)[:, None]
        normal[rows] = sign * (blend / length) @ thing.path.pose(hits.t_ns)[:3, :3].T
        uv[rows] = np.einsum("nc,nck->nk", bary, part.mesh.uvs[corners].astype(np.float64))
        albedo[rows] = sample_albedo(part.material, uv[rows])
        if part.mesh.colours is not None:
            albedo[rows] *= np.einsum("nc,nck->nk", bary, part.mesh.colours[corners].astype(np.float64))
        colour[rows] = albedo[rows]
        if not part.material.unlit:
            sent = radiated(scene, hits, rows, albedo[rows], normal[rows], uv[rows])
            colour[rows] = albedo[rows] * sent.matt + sent.added
    colour = seen_through_fog(scene, hits, colour)
    return Surface(normal, uv, albedo, colour, colour @ LUMA)


def seen_through_fog(scene: Scene, hits: Hits, colour: np.ndarray) -> np.ndarray:
    """(N, 3) radiance at the hits as it arrives at the camera; where nothing is hit as it is."""
    if scene.fog is None:
        return colour
    rays = _rays(scene.camera, hits.xy)
    # The distance is Z times the length of the ray (X, Y, Z) / Z.
    distance = hits.depth * np.linalg.norm(rays / rays[:, 2:], axis=1)
    arrives = np.exp(-scene.fog.density * distance)[:, None]
    return np.where(hits.hit[:, None], colour * arrives + scene.fog.radiance * (1 - arrives), colour)


@dataclass(frozen=True, eq=False)
class Radiated:
    """What N points of one part send to the camera, (N, 3) each: albedo * matt + mirrored + emission.

    light : what it receives.   matt : radiance that a white surface of this kind scatters of it.   mirrored : of the
    lamps and of all around."""

    light: Received
    matt: np.ndarray
    mirrored: np.ndarray
    emission: np.ndarray

    @property
    def added(self) -> np.ndarray:
        """What does not go through the albedo."""
        return self.mirrored + self.emission


def radiated(
    scene: Scene, hits: Hits, rows: np.ndarray, albedo: np.ndarray, normal: np.ndarray, uv: np.ndarray
) -> Radiated:
    """Of the hits ``rows``, all of one part, which is lit. albedo, normal : (N, 3), (N, 3) unit, world axes, without a
    normal map.   uv : (N, 2)."""
    thing, part = scene_parts(scene)[int(hits.part[rows[0]])]
    material, pose = part.material, thing.path.pose(hits.t_ns)
    # Maps are looked up at the base colour's coordinates.
    at = uv * np.asarray(material.uv_scale)
    emission = np.broadcast_to(np.asarray(material.emission, np.float64), albedo.shape)
    if material.emission_map is not None:
        emission = emission * sample_map(material.emission_map, at, colour=True)
    if material.bumps is not None:
        normal = bumped(hits, rows, part, pose, normal, at)
    points = hits.local[rows] @ pose[:3, :3].T + pose[:3, 3]
    own = np.column_stack([hits.part[rows], hits.triangle[rows]])
    light = received(scene, hits.t_ns, points, normal, own)
    if material.gloss is None:
        return Radiated(light, light.total, np.zeros_like(albedo), emission)
    metallic, roughness = np.full(len(at), material.gloss.metallic), np.full(len(at), material.gloss.roughness)
    if material.gloss.map is not None:
        given = sample_map(material.gloss.map, at)
        metallic, roughness = metallic * given[:, 2], roughness * given[:, 1]
    eye = scene.camera_path.pose(hits.t_ns)[:3, 3] - points
    eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    matt, mirrored = shone(scene, hits.t_ns, light, points, normal, eye, albedo, metallic, roughness)
    return Radiated(light, matt * light.total, mirrored, emission)


def bumped(
    hits: Hits, rows: np.ndarray, part: Part, pose: np.ndarray, normal: np.ndarray, at: np.ndarray
) -> np.ndarray:
    """(N, 3) unit normals, world axes, as the part's normal map has them. normal : without it, on the camera's side."""
    mesh, bumps = part.mesh, part.material.bumps
    assert bumps is not None
    corners, bary = mesh.faces[hits.triangle[rows]], hits.bary[rows]
    given = tangents(mesh).astype(np.float64)
    # The way along the texture turns as a normal does.
    if mesh.deformer is not None:
        turned = mesh.deformer.normals(replace(mesh, normals=given[:, :3].astype(np.float32)), hits.t_ns)
        given = np.column_stack([turned, given[:, 3]])
    side = np.where(hits.front[rows], 1.0, -1.0)[:, None]
    # Everything below is of the front; the result is turned back to the side that is seen.
    n = normal * side
    along = np.einsum("nc,nck->nk", bary, given[:, :3][corners]) @ pose[:3, :3].T
    # Gram and Schmidt: the tangent without its part along the normal.
    along = along - n * (along * n).sum(axis=1, keepdims=True)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-15)
    hand = np.sign(np.einsum("nc,nc->n", bary, given[:, 3][corners]))[:, None]
    # Stored 0 to 1, meant -1 to 1.
    bump = 2.0 * sample_map(bumps, at) - 1.0
    x, y, z = (bump[:, k : k + 1] for k in range(3))
    scale = part.material.bump_scale
    mapped = side * (along * x * scale + np.cross(n, along) * hand * y * scale + n * z)
    return mapped / np.maximum(np.linalg.norm(mapped, axis=1, keepdims=True), 1e-15)


def shone(
    scene: Scene,
    t_ns: int,
    light: Received,
    points: np.ndarray,
    normal: np.ndarray,
    eye: np.ndarray,
    albedo: np.ndarray,
    metallic: np.ndarray,
    roughness: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """((N, 1) share of the light that goes through the albedo, (N, 3) radiance that is mirrored) of a surface with a
    gloss (:mod:`blinkgl.scene.surfaces.gloss`). light : what a matt one receives there.   eye : (N, 3) unit vectors."""
    # The same limits as in surface.glsl; the lobe of a perfect mirror would divide by 0.
    roughness = np.maximum(roughness, gloss.SMOOTHEST)
    nv = np.clip((normal * eye).sum(axis=1), 1e-3, 1.0)
    part = gloss.energy_at(nv, roughness)
    # What single reflection loses of even light, which several reflections return.
    lost = (1.0 / part.sum(axis=1) - 1.0)[:, None]
    mix = metallic[:, None]
    clear = 1.0 + gloss.several(np.full((1, 1), gloss.DIELECTRIC), roughness) * lost
    metal = 1.0 + gloss.several(albedo, roughness) * lost
    even_clear = clear * (gloss.DIELECTRIC * part[:, :1] + part[:, 1:])
    even_metal = metal * (albedo * part[:, :1] + part[:, 1:])
    # The mirror direction 2 (n.v) n - v.
    away = 2.0 * (normal * eye).sum(axis=1, keepdims=True) * normal - eye
    if id(scene.light) not in _surroundings:
        _surroundings.clear()
        _surroundings[id(scene.light)] = scene.light, surroundings_of(scene.light)
    around = gloss.around(_surroundings[id(scene.light)][1], normal, away, nv, roughness)
    out = around * (even_clear * (1 - mix) + even_metal * mix)
    # Lamps: GGX lobe with Schlick's Fresnel term, half vector between lamp and eye.
    for k, lamp in enumerate(lamps_of(scene.light)):
        towards, _ = beam(lamp, lamp.path.pose(t_ns), points)
        nl = (towards * normal).sum(axis=1)
        half = towards + eye
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-15)
        lit = nl > 0
        edge = (1.0 - np.clip((half * eye).sum(axis=1, keepdims=True), 0, 1)) ** 5
        lobe = gloss.lobe(np.maximum(nl, 1e-12), nv, (half * normal).sum(axis=1), roughness)
        of_clear = clear * (gloss.DIELECTRIC + (1 - gloss.DIELECTRIC) * edge)
        of_metal = metal * (albedo + (1 - albedo) * edge)
        # ``direct`` has the cosine, the strength and the shadow in it
        out += np.where(lit, lobe, 0.0)[:, None] * light.direct[k] * (of_clear * (1 - mix) + of_metal * mix)
    return (1 - mix) * (1 - even_clear), out


_surroundings: dict[int, tuple] = {}


@dataclass(frozen=True, eq=False)
class Received:
    """The light that N points of a scene receive, as the radiance of a white Lambert surface there, (N, 3) each.

    direct : (lamps, N, 3) of each of :func:`blinkgl.scene.lights.lamps_of`, in the others' shadows.   open : the same
    without shadows.   around : from all around."""

    direct: np.ndarray
    open: np.ndarray
    around: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """All of it."""
        return self.direct.sum(axis=0) + self.around


def received(
    scene: Scene, t_ns: int, points: np.ndarray, normal: np.ndarray, own: np.ndarray | None = None
) -> Received:
    """What the scene's lights send at t_ns to (N, 3) points with (N, 3) unit normals, world axes.

    own : (N, 2) part and triangle that each point is on, which do not hide it from a lamp; None: no shadows."""
    lamps = lamps_of(scene.light)
    direct, open_ = np.zeros((2, len(lamps), *points.shape))
    casting = shadowing(scene.light)
    for k, lamp in enumerate(lamps):
        towards, strength = beam(lamp, lamp.path.pose(t_ns), points)
        facing = np.maximum(0.0, (towards * normal).sum(axis=1))
        direct[k] = open_[k] = facing[:, None] * strength
        if own is not None and k in casting:
            direct[k] *= seen_share(scene, t_ns, lamp, points, own)[:, None]
    return Received(direct, open_, ambient(quadric_of(scene.light), normal, quartic_of(scene.light)))


SOFT_SAMPLES = 64
"""Points of a lamp that are looked for, of a soft shadow."""
_FAR_AWAY = 1e5
"""From where a sun's rays come, times the scene's size: parallel to 1e-5."""


def seen_share(scene: Scene, t_ns: int, lamp: Lamp, points: np.ndarray, own: np.ndarray) -> np.ndarray:
    """(N,) how much of a lamp is seen from (N, 3) points, world axes, past what casts shadows: 0 or 1, of a soft shadow
    a mean over the lamp. own : as for :func:`received`."""
    casters, number = _casters(scene)
    if not casters.objects or not len(points):
        return np.ones(len(points))
    # Part numbers among the casters.
    skip = np.ascontiguousarray(np.column_stack([number[own[:, 0]], own[:, 1]]).astype(np.int32))
    # A lamp shines along -z, a camera looks along +z: y and z are turned round.
    pose = lamp.path.pose(t_ns) @ np.diag([1.0, -1.0, -1.0, 1.0])
    middle = points.mean(axis=0)
    size = 1.0 + float(np.linalg.norm(points - middle, axis=1).max())
    count = SOFT_SAMPLES if scene.light.shadows == "soft" and lamp.size > 0 else 1
    total = np.zeros(len(points))
    # Sunflower seeds over the lamp's disc: 2.39996323 rad is the golden angle.
    for i in range(count):
        radius, angle = math.sqrt((i + 0.5) / count), i * 2.39996323
        aside = (0.5 * lamp.size * radius if count > 1 else 0.0) * np.array([math.cos(angle), math.sin(angle)])
        eye = pose.copy()
        # A sun: the direction is turned by the angle, and the eye is far away along it.
        if lamp.kind == "sun":
            ahead = eye[:3, 2] + eye[:3, :2] @ np.tan(aside)
            eye[:3, 3] = middle - ahead * (_FAR_AWAY * size)
        else:
            eye[:3, 3] += eye[:3, :2] @ aside
        # Points in the lamp's axes: Z is the distance along it.
        there = (points - eye[:3, 3]) @ eye[:3, :3]
        before = there[:, 2] > 0
        # Ends a little before the point, so that it does not shade itself.
        far = np.where(before, there[:, 2] - 1e-7 * size, 0.0)
        rays = np.where(before[:, None], there[:, :2] / np.where(before, there[:, 2], 1.0)[:, None], 0.0)
        hit, _, _ = _nearest(casters, t_ns, np.ascontiguousarray(rays), far=far, skip=skip, eye=eye, near=1e-9)
        total += ~(before & (hit[:, 0] >= 0))
    return total / count


_shadowers: WeakKeyDictionary = WeakKeyDictionary()


def seen_by_lamp(
    scene: Scene, t_ns: int, eye: np.ndarray, rays: np.ndarray, near: float
) -> tuple[np.ndarray, np.ndarray]:
    """What a shadow map should hold: (N,) depth along the axis of a lamp that looks from the (4, 4) pose ``eye`` along
    (N, 3) rays of length 1 there, inf where nothing casts, and (N,) number of the part among all that cast, -1.

    Of closed meshes it is the nearest side that faces away from the lamp."""
    casters, _ = _casters(scene)
    if not casters.objects:
        return np.full(len(rays), np.inf), np.full(len(rays), -1, np.int32)
    if casters not in _inside_out:
        # Seen from inside, so that a face away from the lamp counts as front.
        _inside_out[casters] = replace(casters, objects=tuple(_turned_out(thing) for thing in casters.objects))
    turned = _inside_out[casters]
    hit, _, depth = _nearest(turned, t_ns, np.ascontiguousarray(rays[:, :2]), eye=eye, near=near)
    return depth, hit[:, 0]


_inside_out: WeakKeyDictionary = WeakKeyDictionary()


def _turned_out(thing: SceneObject) -> SceneObject:
    """Return the object with the faces of one-sided parts turned round."""
    parts = (
        replace(part, mesh=replace(part.mesh, faces=np.ascontiguousarray(part.mesh.faces[:, ::-1])))
        if part.culled
        else part
        for part in thing.parts
    )
    return replace(thing, parts=tuple(parts))


def casts(scene: Scene) -> bool:
    """Whether anything in it casts shadows."""
    return bool(_casters(scene)[0].objects)


def _casters(scene: Scene) -> tuple[Scene, np.ndarray]:
    """Return the scene with only the parts that cast shadows, and each part's number in it, -1 for none (and for no
    part)."""
    if scene not in _shadowers:
        kept, number, count = [], [], 0
        for thing in scene.objects:
            casting = [thing.category in ("object", "wall") and not part.material.unlit for part in thing.parts]
            # Numbers among the casting parts, in the scene's order.
            number += [count + sum(casting[:k]) if one else -1 for k, one in enumerate(casting)]
            count += sum(casting)
            if any(casting):
                kept.append(replace(thing, parts=tuple(p for p, one in zip(thing.parts, casting) if one)))
        _shadowers[scene] = replace(scene, objects=tuple(kept)), np.array([*number, -1])
    return _shadowers[scene]


def sample_albedo(material: Material, uv: np.ndarray) -> np.ndarray:
    """(N, 3) linear albedo at (N, 2) texture coordinates."""
    base = np.asarray(material.base_color, np.float64)
    if material.texture is None:
        return np.broadcast_to(base, (len(uv), 3)).copy()
    return sample_bilinear(material.texture, uv * np.asarray(material.uv_scale), material.wrap) * base


def sample_map(given: Map, at: np.ndarray, colour: bool = False) -> np.ndarray:
    """(N, 3) of a map at (N, 2) coordinates of the base colour: numbers as they are stored, 0 to 1, or linear light."""
    a, b, c, d, e, f = given.at
    # The map's own affine transform of the coordinates.
    there = at @ np.array([[a, b], [d, e]]).T + [c, f]
    texture = given.texture
    if not colour:
        if texture not in _as_numbers:
            _as_numbers[texture] = Texture(texture.image.astype(np.float32) / np.float32(255))
        texture = _as_numbers[texture]
    return sample_bilinear(texture, there, given.wrap)


_as_numbers: WeakKeyDictionary = WeakKeyDictionary()


def _wrapped(index: np.ndarray, size: int, wrap: str) -> np.ndarray:
    """Return (N,) texel numbers inside the picture, continued beyond its edges as ``wrap`` says."""
    if wrap == "clamp":
        return np.clip(index, 0, size - 1)
    if wrap == "mirror":
        # The texture mirrored and not, one period of 2 size.
        index = np.mod(index, 2 * size)
        return np.where(index < size, index, 2 * size - 1 - index)
    return np.mod(index, size)


def sample_bilinear(texture: Texture, uv: np.ndarray, wrap: tuple[str, str] = REPEAT) -> np.ndarray:
    """(N, 3) linear light, bilinear over the four nearest texels; texel centres at (i + 0.5) / size."""
    image = texture.image
    size = np.array([image.shape[1], image.shape[0]])
    at = uv * size - 0.5
    low = np.floor(at)
    # Column and row of the first of the four texels, and the fraction to the next.
    frac = at - low
    x0, x1 = (_wrapped(low[:, 0].astype(np.int64) + k, size[0], wrap[0]) for k in (0, 1))
    y0, y1 = (_wrapped(low[:, 1].astype(np.int64) + k, size[1], wrap[1]) for k in (0, 1))
    fx, fy = frac[:, :1], frac[:, 1:]

    def texel(y, x):
        values = image[y, x]
        return _SRGB_TO_LINEAR[values] if values.dtype == np.uint8 else values.astype(np.float64)

    top = texel(y0, x0) * (1.0 - fx) + texel(y0, x1) * fx
    bottom = texel(y1, x0) * (1.0 - fx) + texel(y1, x1) * fx
    return top * (1.0 - fy) + bottom * fy


def srgb_to_linear(v: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1 decoding of values in [0, 1]."""
    v = np.asarray(v, np.float64)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


_SRGB_TO_LINEAR = srgb_to_linear(np.arange(256) / 255.0)


# ------------------------------------------------------------------------------------------------- whole images


def render(
    scene: Scene,
    t_ns: int,
    *,
    forward_ns: int | None = None,
    backward_ns: int | None = None,
    exhaustive: bool = False,
) -> ReferenceFrame:
    """Every buffer at t_ns, with the flow to forward_ns and to backward_ns where given."""
    camera = scene.camera
    hits = cast(scene, t_ns, exhaustive=exhaustive)
    looks = surface(scene, hits)

    def image(values):
        return values.reshape(camera.height, camera.width, *values.shape[1:])

    def flow(to_ns):
        if to_ns is None:
            return None
        result = flow_to(scene, hits, to_ns)
        return Flow(result.t_ns, *(image(getattr(result, name)) for name in _FLOW_IMAGES))

    from_hits = {name: image(getattr(hits, name)) for name in _HIT_IMAGES}
    from_looks = {name: image(getattr(looks, name)) for name in ("normal", "uv", "albedo", "colour", "luminance")}
    return ReferenceFrame(
        t_ns=int(t_ns),
        **from_hits,
        **from_looks,
        velocity=image(velocity(scene, hits)),
        forward=flow(forward_ns),
        backward=flow(backward_ns),
    )


_HIT_IMAGES = ("xy", "hit", "depth", "instance", "part", "triangle", "front", "bary", "local")
_FLOW_IMAGES = ("flow", "valid", "occluded", "outside", "depth", "hidden_by")


def silhouette_band(ids: np.ndarray, depth: np.ndarray, width: int = 1, jump: float = 0.02) -> np.ndarray:
    """(H, W) bool: pixels within ``width`` px (8-neighbourhood) of an id change or a jump in depth.

    ids : (H, W) integers.   depth : (H, W), inf or nan where nothing is hit.   A jump is a second difference of 1 / Z
    along x or y above ``jump`` of its largest value there: 1 / Z is affine in the image of a plane, however steep the
    plane is seen, so that slanted ground is not taken for an edge.
    """
    # Second differences of 1/Z vanish on a plane; along x and along y in turn.
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.nan_to_num(1.0 / np.asarray(depth, np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    band = np.zeros(ids.shape, bool)
    for axis in (0, 1):
        i, z, b = np.swapaxes(ids, 0, axis), np.swapaxes(inverse, 0, axis), np.swapaxes(band, 0, axis)
        change = i[1:] != i[:-1]
        b[1:] |= change
        b[:-1] |= change
        bend = np.abs(z[2:] - 2.0 * z[1:-1] + z[:-2]) > jump * np.maximum(np.maximum(z[2:], z[1:-1]), z[:-2])
        b[1:-1] |= bend
    # Neighbours over a corner.
    diagonal = ids[1:, 1:] != ids[:-1, :-1]
    other = ids[1:, :-1] != ids[:-1, 1:]
    band[1:, 1:] |= diagonal
    band[:-1, :-1] |= diagonal
    band[1:, :-1] |= other
    band[:-1, 1:] |= other
    return ndimage.binary_dilation(band, np.ones((3, 3)), iterations=width - 1) if width > 1 else band
