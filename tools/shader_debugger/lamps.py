"""Shadow maps in float64, the pixels where a map may be wrong because of its texels; the reference of soft shadows."""

from __future__ import annotations

import math

import numpy as np

from blinkgl.render import casting
from blinkgl.render.passes.shadow import ShadowMap
from blinkgl.render.shadows import Parallel, scale_of, view_of
from blinkgl.scene.types import Scene
from blinkgl.tools.shader_debugger import appearance, reference

FAR_AWAY = 1e5
"""Distance of the origin of a sun's rays, in depths of its map: they are parallel to 1e-5."""
SMOOTHED = 1.5
"""Texels from the edge of a hard shadow within which map and rays may differ: the width over which it is smoothed."""
WAYS = 8
GRAZING = 0.1
"""Cosine at a surface below which light is so grazing that its depth offset is up to sixteen texels."""


def map_of(scene: Scene, t_ns: int, map_: ShadowMap) -> tuple[np.ndarray, np.ndarray]:
    """Return ((texels, texels) float64 depth that the map should contain, 0 where nothing casts; int32 number of the
    visible triangle, among all that cast, -1: nothing)."""
    view, pose = view_of(map_.lamp, map_.box, map_.texels, map_.lamp.path.pose(t_ns))
    camera, size = view.camera, map_.texels
    y, x = np.mgrid[0:size, 0:size].reshape(2, -1)
    if not isinstance(camera, Parallel):
        # Texels are pixels of the lamp's camera.
        rays = camera.rays(np.stack([x, y], axis=1).astype(np.float64))
        depth, part = appearance.seen_by_lamp(scene, t_ns, pose, rays / rays[:, 2:], camera.near)
        value = camera.near / depth
    else:
        # The ray caster's rays start at one point: from far enough away they are parallel.
        away = FAR_AWAY * camera.depth
        pose = pose.copy()
        pose[:3, 3] -= away * pose[:3, 2]
        there = np.stack(
            [(2 * (x + 0.5) / size - 1) * camera.half_x, (2 * (y + 0.5) / size - 1) * camera.half_y], axis=1
        )
        rays = np.column_stack([there / (away + 0.5 * camera.depth), np.ones(len(there))])
        depth, part = appearance.seen_by_lamp(scene, t_ns, pose, rays, 0.5 * away)
        # Depth is reversed, 1 at the lamp's side.
        value = 1.0 - (depth - away) / camera.depth
    return np.where(part >= 0, value, 0.0).reshape(size, size), part.reshape(size, size)


def place_in(map_: ShadowMap, t_ns: int, point: np.ndarray) -> np.ndarray:
    """Return (3,): texels from the left and from the top, and depth, of a (3,) point, world axes, in a map."""
    view, pose = view_of(map_.lamp, map_.box, map_.texels, map_.lamp.path.pose(t_ns))
    clip = view.projection @ [*((point - pose[:3, 3]) @ pose[:3, :3]), 1.0]
    x, y, depth = clip[:3] / clip[3]
    return np.array([(x + 1) * map_.texels / 2, (y + 1) * map_.texels / 2, depth])


def near_an_edge(scene: Scene, frame: reference.ReferenceFrame, maps: tuple[ShadowMap, ...]) -> np.ndarray:
    """Return (H, W) bool: pixels whose point is so near to a hard shadow's edge, or lit so grazingly, that map and rays
    may differ."""
    out = np.zeros(frame.hit.shape, bool)
    rows, points, own = lit_points(scene, frame)
    normals = _flat(scene, frame, rows)
    for one in maps:
        pose = one.lamp.path.pose(frame.t_ns)
        wide, wider, _, _ = scale_of(one.lamp, one.box, one.texels)
        if one.lamp.kind == "sun":
            towards, texel = np.broadcast_to(pose[:3, 2], points.shape), np.full(len(points), wide)
        else:
            towards = pose[:3, 3] - points
            texel = wider * np.abs(towards @ pose[:3, 2])
            towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        facing = (towards * normals).sum(axis=1)
        edge = np.abs(facing) < GRAZING
        # A shadow's edge is where a neighbouring point, at the map's smoothing distance, sees another fraction.
        share = appearance.seen_share(scene, frame.t_ns, one.lamp, points, own)
        edge |= (share > 0) & (share < 1)
        for k in range(WAYS):
            angle = 2 * math.pi * k / WAYS
            aside = math.cos(angle) * pose[:3, 0] + math.sin(angle) * pose[:3, 1]
            aside = aside * (texel * SMOOTHED)[:, None]
            # in the plane of the surface, where it is as far aside as the lamp sees it
            slide = (aside * normals).sum(axis=1) / np.where(np.abs(facing) < GRAZING, 1.0, facing)
            # Moved along the light back to the surface's own plane.
            there = points + aside - slide[:, None] * towards
            edge |= appearance.seen_share(scene, frame.t_ns, one.lamp, there, own) != share
        out.ravel()[rows] |= edge
    return out


def lit_points(scene: Scene, frame: reference.ReferenceFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the (n,) numbers of the pixels with a lit surface, their (n, 3) points, world axes, and (n, 2) part and
    triangle."""
    hits = frame.hits()
    points = casting.applied(scene, hits, lambda thing: thing.path.pose(frame.t_ns))
    unlit = [p for p, (_, part) in enumerate(casting.scene_parts(scene)) if part.material.unlit]
    rows = np.flatnonzero(hits.hit & ~np.isin(hits.part, unlit))
    return rows, points[rows], np.column_stack([hits.part[rows], hits.triangle[rows]])


def _flat(scene: Scene, frame: reference.ReferenceFrame, rows: np.ndarray) -> np.ndarray:
    """Return the (n, 3) unit normals of the triangles themselves, world axes."""
    part, triangle = frame.part.ravel()[rows], frame.triangle.ravel()[rows]
    out = np.zeros((len(rows), 3))
    for p, (body, own) in enumerate(casting.scene_parts(scene)):
        on = part == p
        if on.any():
            a, b, c = np.moveaxis(casting.vertices_at(own.mesh, frame.t_ns)[own.mesh.faces[triangle[on]]], 1, 0)
            normal = np.cross(b - a, c - a)
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
            out[on] = normal @ body.path.pose(frame.t_ns)[:3, :3].T
    return out


# ---------------------------------------------------------------------------------------------------------------------
# Slow float64 reference of the soft shadows of shaders/include/shadows.glsl, which explains the method.
#
# It reads the GPU's own shadow map, which is graded separately.

SPARE, FARTHEST, WIDEST, TAPS, LEAST_SLOPE = 0.25, 16.0, 24.0, 16, 1e-4
TURN = math.pi * (3 - math.sqrt(5))
"""The golden angle between one tap and the next."""
SEEDS = np.array(
    [math.sqrt((i + 0.5) / TAPS) * np.array([math.cos(i * TURN), math.sin(i * TURN)]) for i in range(TAPS)]
)
ROUNDED = 2.0**-21
"""Relative rounding error of a position in the map, 0 to 1, and of a depth there: float32 matrix product."""


def share_range(
    scene: Scene, frame: reference.ReferenceFrame, one: ShadowMap, depths: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return ((H, W), (H, W)): smallest and largest possible visible fraction of a lamp by its map, 1 where nothing is
    lit. They differ where rounding decides which texel a tap hits, or whether it is a blocker.

    depths : (texels, texels) float32, the map as the GPU made it."""
    rows, points, _ = lit_points(scene, frame)
    view, pose = view_of(one.lamp, one.box, one.texels, one.lamp.path.pose(frame.t_ns))
    # Row vectors times R are R^T times columns: into the lamp's camera axes.
    there = (points - pose[:3, 3]) @ pose[:3, :3]
    normals = frame.normal.reshape(-1, 3)[rows] @ pose[:3, :3]
    at = _Place(one, view.projection, there, normals)
    out = np.ones((2, frame.hit.size))
    # The exact position, and corners of the box within which rounding may have moved it.
    moved = [(0, 0, 0), (1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1)]
    shares = [at.share(depths.astype(np.float64), ROUNDED * np.array(way)) for way in moved]
    out[:, rows] = np.min(shares, axis=0), np.max(shares, axis=0)
    low, high = out.reshape(2, *frame.hit.shape)
    return low, high


class _Place:
    """Positions of N points in a map, and the orientation of their surfaces there."""

    def __init__(self, one: ShadowMap, projection: np.ndarray, there: np.ndarray, normals: np.ndarray):
        clip = np.column_stack([there, np.ones(len(there))]) @ projection.T
        # As the shader divides: 1 of a sun, the depth of a spot light.
        w = np.maximum(clip[:, 3], 1e-6)
        self.size, self.sun = one.texels, one.lamp.kind == "sun"
        self.xy, self.depth = (clip[:, :2] / w[:, None] + 1) / 2, clip[:, 2] / w
        wide, wider, self.per_unit, self.width = scale_of(one.lamp, one.box, one.texels)
        self.texel = wide + wider * w
        # Depth is affine in the map on a plane: 1 - Z / depth of a sun's, near / Z of a spot light's.
        unit = self.per_unit if self.sun else self.depth / w
        through = normals[:, 2] if self.sun else (normals * there).sum(axis=1) / w**2
        through = np.where(np.abs(through) > LEAST_SLOPE, through, LEAST_SLOPE)
        # What a unit of the map, 0 to 1, is on the plane at distance 1, or of a sun in world units.
        across = 2 / np.array([projection[0, 0], projection[1, 1]])
        self.slope = normals[:, :2] * across * (unit / through)[:, None]
        # Largest offset towards the lamp that avoids self-shadowing; ``least`` is the smallest.
        self.most = FARTHEST * self.texel * unit
        self.least = np.abs(self.slope).sum(axis=1) / self.size + SPARE * self.texel * unit

    def _limit(self, depth: np.ndarray, aside: np.ndarray) -> np.ndarray:
        """Return the depth above which a texel blocks the light of the surface at a tap."""
        room = np.clip(self.least + (self.slope * aside).sum(axis=1), -self.most, self.most)
        return np.maximum(depth + room, 0.0)

    def share(self, depths: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Return the (N,) visible fraction of the lamp. moved : (3,) of all positions, and of all depths in parts."""
        xy, depth = self.xy + moved[:2], self.depth + moved[2] * (1.0 if self.sun else self.depth)
        # Largest distance of a blocker to the side: the sun's cone up to the map's near side, or the lamp's disc.
        reach = self.width * (1 - depth) / self.per_unit if self.sun else self.width
        search = np.clip(0.5 * reach / self.texel, 1.0, WIDEST) / self.size
        blockers, count = np.zeros(len(xy)), np.zeros(len(xy))
        # Every second tap is enough to find blockers.
        for seed in SEEDS[::2]:
            aside = seed * search[:, None]
            # ivec2() truncates towards zero.
            nearest = _fetched(depths, np.trunc((xy + aside) * self.size).astype(np.intp), empty=True)
            hides = nearest > self._limit(depth, aside)
            blockers, count = blockers + np.where(hides, nearest, 0.0), count + hides
        # The penumbra's width, by similar triangles from the mean blocker.
        blocker = blockers / np.maximum(count, 1)
        if self.sun:
            width = self.width * (blocker - depth) / self.per_unit
        else:
            width = self.width * np.maximum(blocker / depth - 1, 0.0)
        radius = np.clip(0.5 * width / self.texel, 0.5, WIDEST) / self.size
        lit = np.zeros(len(xy))
        for seed in SEEDS:
            aside = seed * radius[:, None]
            lit += _bilinear(depths, (xy + aside) * self.size - 0.5, self._limit(depth, aside))
        return np.where(count > 0, lit / TAPS, 1.0)


def _fetched(depths: np.ndarray, texel: np.ndarray, empty: bool) -> np.ndarray:
    """Return (N,) texels of a map; beyond its edge nothing, or the edge's own."""
    size = len(depths)
    inside = ((texel >= 0) & (texel < size)).all(axis=1)
    x, y = np.clip(texel, 0, size - 1).T
    return np.where(inside | (not empty), depths[y, x], 0.0)


def _bilinear(depths: np.ndarray, at: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Return the (N,) fraction of the four texels around (N, 2) positions that are not nearer than the limit,
    bilinearly weighted."""
    low = np.floor(at)
    part, total = at - low, np.zeros(len(at))
    for x in (0, 1):
        for y in (0, 1):
            weight = np.abs(1 - x - part[:, 0]) * np.abs(1 - y - part[:, 1])
            total += weight * (limit >= _fetched(depths, (low + [x, y]).astype(np.intp), empty=False))
    return total
