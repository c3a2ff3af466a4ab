"""One instant of a scene as a camera sees it: poses, matrices, rates, visible items. Computed once, shared by all
passes.

    moments = Moments(scene, resources.items)
    moment = moments.at(t_ns)
    moment.mvp[item.object_index], moment.visible, moment.rates
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.camera.drawing import seen_through
from blinkgl.scene.motion import piecewise
from blinkgl.scene.motion.paths import KeyframePath
from blinkgl.scene.waveforms import factor_at
from blinkgl.types.recent import Kept, Recent

if TYPE_CHECKING:
    from blinkgl.render.draw_items import DrawItem
    from blinkgl.scene.motion.pose_path import PosePath
    from blinkgl.scene.types import Scene
    from blinkgl.scene.waveforms import Waveform


# ---------------------------------------------------------------------------------------------------------------------
# The only place where poses become clip-space matrices: float64, camera-relative, cast to float32 once.
#
# Clip space: x right, y DOWN, w = Z along the optical axis, reversed-Z with the far plane at infinity (depth = near / Z
# in [0, 1], 1 at the near plane). Because y points down in clip space, row 0 of every image is the top row and
# ``gl_FragCoord.xy - 0.5`` is the user's pixel: no image is ever flipped. The camera model gives the matrix from camera
# axes (:meth:`blinkgl.camera.CameraModel.clip_from_cam`).


def cam_from_obj(T_world_cam: np.ndarray, T_world_obj: np.ndarray) -> np.ndarray:
    """Return T_cam_obj, (..., 4, 4) float64. The translations are subtracted before they are rotated, so that a scene
    far from the origin loses only the rounding of its own coordinates."""
    R_t = np.swapaxes(T_world_cam[..., :3, :3], -1, -2)
    rotation = R_t @ T_world_obj[..., :3, :3]
    out = np.zeros((*rotation.shape[:-2], 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = (R_t @ (T_world_obj[..., :3, 3:] - T_world_cam[..., :3, 3:]))[..., 0]
    out[..., 3, 3] = 1.0
    return out


def cam_from_obj_rate(
    T_world_cam: np.ndarray, dT_world_cam: np.ndarray, T_world_obj: np.ndarray, dT_world_obj: np.ndarray
) -> np.ndarray:
    """Return d(T_cam_obj)/dt, (..., 4, 4) float64, 1/s, by the product rule on :func:`cam_from_obj`."""
    # T_cam_obj has the rotation R^T R_obj and the place R^T (p_obj - p), with R and p of the camera.
    R_t = np.swapaxes(T_world_cam[..., :3, :3], -1, -2)
    dR_t = np.swapaxes(dT_world_cam[..., :3, :3], -1, -2)
    offset = T_world_obj[..., :3, 3:] - T_world_cam[..., :3, 3:]
    d_offset = dT_world_obj[..., :3, 3:] - dT_world_cam[..., :3, 3:]
    out = np.zeros(np.broadcast_shapes(T_world_cam.shape, T_world_obj.shape))
    out[..., :3, :3] = dR_t @ T_world_obj[..., :3, :3] + R_t @ dT_world_obj[..., :3, :3]
    out[..., :3, 3] = (dR_t @ offset + R_t @ d_offset)[..., 0]
    return out


def rows_xyw_bytes(matrix: np.ndarray) -> bytes:
    """Return the GLSL mat4x3 (4 columns of 3) with the x, y, w rows of a (4, 4) clip-space matrix."""
    return np.ascontiguousarray(matrix[[0, 1, 3]].T, dtype=np.float32).tobytes()


def linear_xyw_bytes(matrix: np.ndarray) -> bytes:
    """Return the GLSL mat3 with the x, y, w rows of the linear part of a (4, 4) clip-space matrix, for differences of
    positions."""
    return np.ascontiguousarray(matrix[[0, 1, 3], :3].T, dtype=np.float32).tobytes()


DEPTH_ROOM = 2.0
"""Margin of depth: a fragment may lie a fraction of a pixel outside its triangle, so outside the part's depths by the
slope there."""


def inverse_depth_bits(centre_z: np.ndarray, radius: np.ndarray, near: float) -> np.ndarray:
    """Return (n, 2) uint32 for bounding spheres, ``inverse_depths`` of guard.glsl: the smallest 1/Z of a fragment as
    the bits of a float32, and the largest minus it. centre_z, radius : (n,) float64."""
    # A bounding sphere may reach behind the near plane, but no fragment does.
    farthest, nearest = np.maximum(centre_z + radius, near), np.maximum(centre_z - radius, near)
    inverse = np.empty((len(centre_z), 2), np.float32)
    inverse[:, 0], inverse[:, 1] = 1 / (DEPTH_ROOM * farthest), DEPTH_ROOM / nearest
    # Bits of floats above 0 are ordered as the floats: one unsigned comparison in the shader tests both limits.
    bits = inverse.view(np.uint32)
    bits[:, 1] -= bits[:, 0]
    return bits


# x and y from [-1, 1] to [0, 1]; the depth is in [0, 1] already.
_TEXTURE_FROM_CLIP = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 1, 0], [0, 0, 0, 1.0]])
KEPT = 4
"""Moments in memory: a label uses its own time and those of its neighbours, which use it, too."""


class View(NamedTuple):
    """The camera data that drawing needs. projection : (4, 4) float64 clip_from_cam.   frustum : (5, 3) inward unit
    normals, camera axes.   camera : a camera model, or an object with the methods used here (that of a shadow map)."""

    camera: Any
    projection: np.ndarray
    frustum: np.ndarray

    @classmethod
    def of(cls, camera: CameraModel) -> View:
        return cls(camera, camera.clip_from_cam(), camera.frustum_planes())


class Rates(NamedTuple):
    """Rates per object, (n, 4, 4) float64, 1/s: d(MVP)/dt and d(T_world_obj)/dt, from the analytic derivatives of the
    paths."""

    mvp: np.ndarray
    T_world_obj: np.ndarray


class Held(NamedTuple):
    """A light that shines by a factor of its own.   part : of the scene, that emits it; -1: a lamp or the
    surroundings."""

    wave: Waveform
    part: int = -1
    factor: float = 1.0


class Moment:
    """All objects of a scene at t_ns. Values are computed when they are first used, and only once.

    T_world_cam : (4, 4) float64.   T_world_obj, T_cam_obj : (n, 4, 4) float64, a row per object of the scene.
    view : :class:`View` of the camera.   Arrays per item have a row per drawn part, ``DrawItem.number``.
    exposed_ns : the span over which light that changes over time is averaged; None: it is that of the instant.
    held : a light that is not as it is at t_ns; None: all are."""

    exposed_ns: tuple[int, int] | None = None
    held: Held | None = None

    def __init__(self, t_ns: int, view: View, T_world_cam: np.ndarray, T_world_obj: np.ndarray, stage: Stage):
        self.t_ns, self.view, self._stage = t_ns, view, stage
        self.T_world_cam, self.T_world_obj = T_world_cam, T_world_obj

    def over(self, begin_ns: int, end_ns: int) -> Moment:
        """Return the same instant in the mean light of a span."""
        other = copy.copy(self)
        other.exposed_ns = begin_ns, max(end_ns, begin_ns + 1)  # a cell may be shorter than a nanosecond
        return other

    def holding(self, held: Held) -> Moment:
        """Return the same instant with one light at another factor."""
        other = copy.copy(self)
        other.held = held
        return other

    def factor(self, wave: Waveform | None, part: int = -1) -> float:
        """Return the factor of light that changes over time; None: 1. At a jump it is that before it, but at the
        sequence's start that after it.   part : of the scene, that emits it; -1: of a lamp or the surroundings."""
        if self.held is not None and wave is self.held.wave and part == self.held.part:
            return self.held.factor
        if wave is not None and self.exposed_ns is not None:
            return wave.mean(*self.exposed_ns)
        return factor_at(wave, self.t_ns, self._stage.t0_ns)

    def through(self, view: View) -> Moment:
        """Return the same instant through another camera at the same place."""
        other = Moment(self.t_ns, view, self.T_world_cam, self.T_world_obj, self._stage)
        other.exposed_ns, other.held = self.exposed_ns, self.held
        # Values that depend on the camera's place, not on its view, are the same.
        other.__dict__.update({name: self.__dict__[name] for name in _OF_THE_PLACE if name in self.__dict__})
        return other

    def from_place(self, view: View, T_world_cam: np.ndarray, dT_world_cam: np.ndarray | None = None) -> Moment:
        """Return the same instant through a camera elsewhere, such as a lamp that casts shadows; dT_world_cam : (4, 4)
        1/s, None: it stands still."""
        other = Moment(self.t_ns, view, T_world_cam, self.T_world_obj, self._stage)
        other.__dict__["dT_world_cam"] = np.zeros((4, 4)) if dT_world_cam is None else dT_world_cam
        other.exposed_ns, other.held = self.exposed_ns, self.held
        return other

    @cached_property
    def dT_world_cam(self) -> np.ndarray:
        """Return d(T_world_cam)/dt, (4, 4) float64, 1/s."""
        return self._stage.camera_path.derivative(self.t_ns)

    @cached_property
    def T_cam_obj(self) -> np.ndarray:
        return cam_from_obj(self.T_world_cam, self.T_world_obj)

    @cached_property
    def mvp(self) -> np.ndarray:
        """Return clip_from_obj, (n, 4, 4) float64."""
        return self.view.projection @ self.T_cam_obj

    @cached_property
    def mvp_columns(self) -> np.ndarray:
        """Return :attr:`mvp` as GLSL stores it, column by column, (n, 4, 4) float32."""
        return np.ascontiguousarray(self.mvp.swapaxes(1, 2), np.float32)

    @cached_property
    def texture_from_obj(self) -> np.ndarray:
        """Return (n, 4, 4) float32, row by row: from the object's axes to coordinates and depth, each in [0, 1] times
        w, of a texture that holds a picture of this moment."""
        return np.ascontiguousarray(_TEXTURE_FROM_CLIP @ self.mvp, np.float32)

    @cached_property
    def rates(self) -> Rates:
        dT_world_obj = self._stage.bodies.rates(self.t_ns)
        return Rates(self.view.projection @ self.dT_cam_obj, dT_world_obj)

    @cached_property
    def dT_cam_obj(self) -> np.ndarray:
        """Return d(T_cam_obj)/dt, (n, 4, 4) float64, 1/s."""
        dT_world_obj = self._stage.bodies.rates(self.t_ns)
        return cam_from_obj_rate(self.T_world_cam, self.dT_world_cam, self.T_world_obj, dT_world_obj)

    @cached_property
    def centres(self) -> np.ndarray:
        """Return the centres of the items' bounding spheres, camera axes, (m, 3) float64."""
        T = self.T_cam_obj[self._stage.item_object]
        return (T[:, :3, :3] @ self._stage.item_centre[..., None])[..., 0] + T[:, :3, 3]

    @cached_property
    def inverse_depths(self) -> np.ndarray:
        """Return ``inverse_depths`` of guard.glsl, (m, 2) uint32, a uvec2 per item."""
        if self.view.projection[3, 3]:  # parallel rays: w is 1 everywhere
            return np.tile(inverse_depth_bits(np.ones(1), np.zeros(1), 1.0), (len(self._stage.items), 1))
        return inverse_depth_bits(self.centres[:, 2], self._stage.item_radius, self.view.camera.near)

    @cached_property
    def visible(self) -> list[DrawItem]:
        """Return the items whose bounding sphere meets the view frustum: objects front to back, then ground, then
        sky."""
        stage = self._stage
        if not stage.items:
            return []
        # All planes of the frustum contain the camera's centre, so n . c is the signed distance of a sphere's centre.
        inside = np.all(self.centres @ self.view.frustum.T >= -stage.item_radius[:, None], axis=1)
        nearest = self.centres[:, 2] - stage.item_radius
        # lexsort sorts by its last key first: by layers, then by depth.
        order = np.lexsort((nearest, stage.item_layer))
        return [stage.items[i] for i in order[inside[order]]]

    def specks(self, grid: int, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the nearest ``most`` bodies whose bounding sphere is under :data:`SPECK` samples of a picture of
        ``grid`` samples per pixel in x and y, front to back: (k,) int64 and (k, 4) float64, the sphere's middle, from
        the picture's corner, and its diameter, in samples, and its depth (near / Z), the nearest point's."""
        return self._specks.of((grid, most), lambda: self._smallest(grid, most))

    @cached_property
    def _specks(self) -> Kept[tuple[int, int], tuple[np.ndarray, np.ndarray]]:
        return Kept()

    def _smallest(self, grid: int, most: int) -> tuple[np.ndarray, np.ndarray]:
        stage, camera, P = self._stage, self.view.camera, self.view.projection
        T, radius = self.T_cam_obj, stage.body_radius
        X, Y, Z = ((T[:, :3, :3] @ stage.body_centre[..., None])[..., 0] + T[:, :3, 3]).T
        near = np.maximum(Z - radius, camera.near)
        per_px = grid * camera.width * abs(P[0, 0])  # samples of a unit at distance 1, twice
        small = np.flatnonzero((camera.near < Z) & (radius * per_px < SPECK * near))
        small = small[np.argsort(near[small])]
        X, Y, Z, near, radius = X[small], Y[small], Z[small], near[small], radius[small]
        x, y = (P[k, k] * v / Z + P[k, 2] for k, v in enumerate((X, Y)))
        seen = np.flatnonzero((np.abs(x) <= 1) & (np.abs(y) <= 1))
        width, height = grid * camera.width, grid * camera.height
        places = np.column_stack([(x + 1) / 2 * width, (y + 1) / 2 * height, radius * per_px / Z, camera.near / near])
        return small[seen][:most], places[seen][:most]

    def parts_of(self, object_index: int) -> list[DrawItem]:
        """Return all items of one object, visible or not."""
        return self._stage.parts[object_index]


SPECK = 1.5
"""Samples; a larger body's own outline is right, its lines and the centres that it meets."""
_OF_THE_PLACE = ("T_cam_obj", "dT_world_cam", "centres")


class Stage:
    """The constant parts of a scene as arrays: paths of its objects, bounding spheres of its items."""

    def __init__(self, scene: Scene, items: Sequence[DrawItem], bodies: Bodies):
        self.items, self.bodies = items, bodies
        self.camera_path: PosePath = scene.camera_path
        self.t0_ns = scene.t0_ns
        self.item_object = np.array([i.object_index for i in items], np.intp)
        self.item_centre = np.array([i.centre for i in items]).reshape(-1, 3)
        self.item_radius = np.array([i.radius for i in items])
        self.item_layer = np.array([i.layer for i in items])
        self.parts: dict[int, list[DrawItem]] = {}
        for item in items:
            self.parts.setdefault(item.object_index, []).append(item)
        # Bounding spheres of whole bodies; those of sky, ground and walls have no end.
        self.body_centre, self.body_radius = np.zeros((len(scene.objects), 3)), np.full(len(scene.objects), np.inf)
        for body, parts in self.parts.items():
            if all(part.layer == 0 for part in parts):
                self.body_centre[body] = middle = np.mean([part.centre for part in parts], axis=0)
                self.body_radius[body] = max(np.linalg.norm(part.centre - middle) + part.radius for part in parts)


class Bodies:
    """Poses of a scene's objects, shared by all cameras; the last few times are kept."""

    def __init__(self, scene: Scene):
        paths = [o.path for o in scene.objects]
        moving = [i for i, path in enumerate(paths) if not path.is_static]
        # Piecewise cubic paths are evaluated together, others one by one.
        self.cubic = Cubics({i: path for i in moving if isinstance(path := paths[i], KeyframePath)})
        self.others: dict[int, PosePath] = {i: paths[i] for i in moving if not isinstance(paths[i], KeyframePath)}
        self._start = np.stack([p.pose(scene.t0_ns) for p in paths]) if paths else np.zeros((0, 4, 4))
        self._poses: Recent[int, np.ndarray] = Recent(KEPT)
        self._rates: Recent[int, np.ndarray] = Recent(KEPT)

    def poses(self, t_ns: int) -> np.ndarray:
        """Return T_world_obj, (n, 4, 4) float64."""
        return self._poses.of(t_ns, lambda: self._made(self._start.copy(), t_ns, self.cubic.poses, "pose"))

    def rates(self, t_ns: int) -> np.ndarray:
        """Return d(T_world_obj)/dt, (n, 4, 4) float64, 1/s."""
        start = np.zeros_like(self._start)
        return self._rates.of(t_ns, lambda: self._made(start, t_ns, self.cubic.derivatives, "derivative"))

    def bounds(self, ta_ns: int, tb_ns: int) -> np.ndarray:
        """Return (n, 4) float64 over [ta, tb]: ``speed_bound`` and ``unseen`` of each object's path."""
        out = np.zeros((len(self._start), 4))
        self.cubic.bounds(ta_ns, tb_ns, out)
        for i, path in self.others.items():
            out[i] = *path.speed_bound(ta_ns, tb_ns), *path.unseen(ta_ns, tb_ns)
        return out

    def _made(self, out: np.ndarray, t_ns: int, cubic: Callable[[int, np.ndarray], None], name: str) -> np.ndarray:
        # Rows of objects that do not move keep their values.
        cubic(t_ns, out)
        for i, path in self.others.items():
            out[i] = getattr(path, name)(t_ns)
        return out


class Cubics:
    """Piecewise cubic paths, by row, evaluated in one call."""

    def __init__(self, paths: Mapping[int, KeyframePath]):
        self.rows = np.array(list(paths), np.int64)
        coefficients = [path.coefficients for path in paths.values()]
        self.first = np.cumsum([0, *(len(knots) for knots, *_ in coefficients)]).astype(np.int64)
        # A path has one piece less than knots: an empty one is put behind each, so that both are numbered alike.
        pad = lambda array: np.concatenate([array, np.zeros_like(array[:1])])
        empty = np.zeros(0, np.int64), np.zeros((0, 4, 3)), np.zeros((0, 4, 3)), np.zeros((0, 3, 3))
        padded = [empty, *((knots, pad(cp), pad(cr), pad(rot)) for knots, cp, cr, rot in coefficients)]
        self.knots, self.cp, self.cr, self.rot = (np.concatenate(arrays) for arrays in zip(*padded, strict=True))

    def poses(self, t_ns: int, out: np.ndarray) -> None:
        piecewise.all_poses(int(t_ns), self.first, self.knots, self.cp, self.cr, self.rot, self.rows, out)

    def derivatives(self, t_ns: int, out: np.ndarray) -> None:
        piecewise.all_derivatives(int(t_ns), self.first, self.knots, self.cp, self.cr, self.rot, self.rows, out)

    def bounds(self, ta_ns: int, tb_ns: int, out: np.ndarray) -> None:
        piecewise.all_bounds(int(ta_ns), int(tb_ns), self.first, self.knots, self.cp, self.cr, self.rows, out)


class Moments:
    """Returns the moments of a scene and keeps the last few. ``stage``: :class:`Stage`. For a lens with distortion they
    are those of the pinhole camera that is drawn for it.

    bodies : of the same scene, shared with another camera; None: its own."""

    def __init__(self, scene: Scene, items: Sequence[DrawItem], bodies: Bodies | None = None):
        self.bodies = bodies or Bodies(scene)
        self.stage, self.view = Stage(scene, items, self.bodies), View.of(seen_through(scene.camera))
        self._kept: Recent[int, Moment] = Recent(KEPT)

    def at(self, t_ns: int) -> Moment:
        return self._kept.of(t_ns, lambda: self._moment(t_ns))

    def _moment(self, t_ns: int) -> Moment:
        stage = self.stage
        return Moment(t_ns, self.view, stage.camera_path.pose(t_ns), self.bodies.poses(t_ns), stage)

    def look_through(self, camera: CameraModel) -> None:
        """Use another camera on the same path from now on."""
        self.view = View.of(seen_through(camera))
        for t_ns, moment in self._kept.items():
            self._kept[t_ns] = moment.through(self.view)
