"""What lamps see, and what they leave in the dark: shadow maps in float64, and where a map may be off by its texels."""

from __future__ import annotations

import math

import numpy as np

from blinkgl.render import appearance, casting, reference
from blinkgl.render.passes.shadow import ShadowMap
from blinkgl.render.shadows import Parallel, scale_of, view_of
from blinkgl.scene.types import Scene

FAR_AWAY = 1e5
"""From where a sun's rays come, times the depth of its map: parallel to 1e-5."""
SMOOTHED = 1.5
"""Texels from the edge of a hard shadow in which a map's own differs from the rays': what an edge is smoothed over."""
WAYS = 8
GRAZING = 0.1
"""Cosine at a surface that light passes so flatly that it is given up to sixteen texels of room."""


def map_of(scene: Scene, t_ns: int, map_: ShadowMap) -> tuple[np.ndarray, np.ndarray]:
    """((texels, texels) float64 depth as the map should hold it, 0 where nothing casts; int32 number of what is seen
    there, among all that cast, -1: nothing)."""
    view, pose = view_of(map_.lamp, map_.box, map_.texels, map_.lamp.path.pose(t_ns))
    camera, size = view.camera, map_.texels
    y, x = np.mgrid[0:size, 0:size].reshape(2, -1)
    if not isinstance(camera, Parallel):
        # Texels are pixels of the lamp's camera.
        rays = camera.rays(np.stack([x, y], axis=1).astype(np.float64))
        depth, part = appearance.seen_by_lamp(scene, t_ns, pose, rays / rays[:, 2:], camera.near)
        value = camera.near / depth
    else:
        # The ray caster has rays from one point: from far enough away they are parallel.
        away = FAR_AWAY * camera.depth
        pose = pose.copy()
        pose[:3, 3] -= away * pose[:3, 2]
        there = np.stack(
            [(2 * (x + 0.5) / size - 1) * camera.half_x, (2 * (y + 0.5) / size - 1) * camera.half_y], axis=1
        )
        rays = np.column_stack([there / (away + 0.5 * camera.depth), np.ones(len(there))])
        depth, part = appearance.seen_by_lamp(scene, t_ns, pose, rays, 0.5 * away)
        # Depth is reversed, 1 at the side of the lamp.
        value = 1.0 - (depth - away) / camera.depth
    return np.where(part >= 0, value, 0.0).reshape(size, size), part.reshape(size, size)


def place_in(map_: ShadowMap, t_ns: int, point: np.ndarray) -> np.ndarray:
    """(3,) texels from the left and from the top, and depth, of a (3,) point, world axes, in a map."""
    view, pose = view_of(map_.lamp, map_.box, map_.texels, map_.lamp.path.pose(t_ns))
    clip = view.projection @ [*((point - pose[:3, 3]) @ pose[:3, :3]), 1.0]
    x, y, depth = clip[:3] / clip[3]
    return np.array([(x + 1) * map_.texels / 2, (y + 1) * map_.texels / 2, depth])


def near_an_edge(scene: Scene, frame: reference.ReferenceFrame, maps: tuple[ShadowMap, ...]) -> np.ndarray:
    """(H, W) bool: pixels whose point is so near to the edge of a hard shadow, or so flat to the light, that a map need
    not agree with rays."""
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
        # A shadow's edge is where a neighbour, as far aside as the map smooths, sees another share.
        share = appearance.seen_share(scene, frame.t_ns, one.lamp, points, own)
        edge |= (share > 0) & (share < 1)
        for k in range(WAYS):
            angle = 2 * math.pi * k / WAYS
            aside = math.cos(angle) * pose[:3, 0] + math.sin(angle) * pose[:3, 1]
            aside = aside * (texel * SMOOTHED)[:, None]
            # in the plane of the surface, where it is as far aside as the lamp sees it
            slide = (aside * normals).sum(axis=1) / np.where(np.abs(facing) < GRAZING, 1.0, facing)
            # Moved along the light until it is on the surface's own plane again.
            there = points + aside - slide[:, None] * towards
            edge |= appearance.seen_share(scene, frame.t_ns, one.lamp, there, own) != share
        out.ravel()[rows] |= edge
    return out


def lit_points(scene: Scene, frame: reference.ReferenceFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n,) numbers of the pixels that show something that is lit, their (n, 3) points, world axes, and (n, 2) part and
    triangle."""
    hits = frame.hits()
    points = np.full((len(hits.hit), 3), np.nan)
    for p, (thing, part) in enumerate(casting.scene_parts(scene)):
        rows = hits.part == p
        if rows.any() and not part.material.unlit:
            pose = thing.path.pose(frame.t_ns)
            points[rows] = hits.local[rows] @ pose[:3, :3].T + pose[:3, 3]
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    return rows, points[rows], np.column_stack([hits.part[rows], hits.triangle[rows]])


def _flat(scene: Scene, frame: reference.ReferenceFrame, rows: np.ndarray) -> np.ndarray:
    """(n, 3) unit normals of the triangles themselves, world axes."""
    part, triangle = frame.part.ravel()[rows], frame.triangle.ravel()[rows]
    out = np.zeros((len(rows), 3))
    for p, (thing, own) in enumerate(casting.scene_parts(scene)):
        on = part == p
        if on.any():
            a, b, c = np.moveaxis(casting.vertices_at(own.mesh, frame.t_ns)[own.mesh.faces[triangle[on]]], 1, 0)
            normal = np.cross(b - a, c - a)
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
            out[on] = normal @ thing.path.pose(frame.t_ns)[:3, :3].T
    return out
