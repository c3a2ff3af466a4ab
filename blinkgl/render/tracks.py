"""Points on surfaces, followed over time in float64 by the functions of the reference renderer.

A point is a triangle of a part and three weights of its corners, so it follows its surface through any motion or
deformation. Its image position is a projection; its visibility is tested by a ray. Nothing is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from blinkgl.config.over_time import TracksConfig
from blinkgl.render import casting
from blinkgl.render.casting import Hits
from blinkgl.scene.types import Scene

_DRAWS = 8
"""Number of draws of new positions for points that hit nothing."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """N points at T times.

    t_us : (T,) int64.   query_points : (N, 3) float64, number of the time, y and x of where each point was chosen.
    target_points : (N, T, 2) float64 px, x and y, (0, 0) the centre of the top-left pixel; 0 behind the camera.
    occluded : (N, T) bool, not visible: hidden, seen from behind, outside the image or nearer than the near plane.
    points_world : (N, T, 3) float64.   depth : (N, T) float64 along the optical axis, <= 0 behind the camera.
    instance : (N,) uint16.   surface : (N, 2) int32 part (of the scene, as it is drawn) and triangle.
    weights : (N, 3) float64 of the triangle's corners."""

    t_us: np.ndarray
    query_points: np.ndarray
    target_points: np.ndarray
    occluded: np.ndarray
    points_world: np.ndarray
    depth: np.ndarray
    instance: np.ndarray
    surface: np.ndarray
    weights: np.ndarray


def track_points(scene: Scene, config: TracksConfig, times_ns: Sequence[int], rng: np.random.Generator) -> Tracks:
    """Return the points of ``config`` at (T,) times. rng : draws them, if they are random."""
    times = [int(t) for t in times_ns]
    if config.choose == "surface":
        return _of_surfaces(scene, config.points, times, rng)
    query, hits = _of_a_grid(scene, config.points, times)
    return _followed(scene, hits, times, query)


def _followed(scene: Scene, hits: Hits, times: list[int], query: np.ndarray) -> Tracks:
    shape = (len(hits.hit), len(times))
    xy, world = np.zeros((*shape, 2)), np.zeros((*shape, 3))
    depth, occluded = np.zeros(shape), np.ones(shape, bool)
    for k, t_ns in enumerate(times):
        xy[:, k], world[:, k], depth[:, k], seen = places(scene, hits, t_ns)
        occluded[:, k] = ~seen
    return Tracks(
        t_us=np.array([t // 1000 for t in times], np.int64),
        query_points=query,
        target_points=xy,
        occluded=occluded,
        points_world=world,
        depth=depth,
        instance=hits.instance.astype(np.uint16),
        surface=np.stack([hits.part, hits.triangle], axis=1).astype(np.int32),
        weights=hits.bary,
    )


def places(scene: Scene, hits: Hits, t_ns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return for the points of ``hits`` at a time: (N, 2) px, 0 behind the camera; (N, 3) world; (N,) depth; (N,) bool
    visible."""
    camera = scene.camera
    there = replace(hits, local=casting.local_at(scene, hits, t_ns))
    moved = casting.applied(scene, there, lambda obj: casting.relative_pose_at(scene, obj, t_ns))
    world = casting.applied(scene, there, lambda obj: obj.path.pose(t_ns))
    depth = moved[:, 2].copy()
    ahead = depth > 0
    xy = np.zeros((len(depth), 2))
    xy[ahead] = camera.project(moved[ahead])
    # The picture reaches half a px beyond the centres of the pixels at its edges.
    inside = ahead & ((xy >= -0.5) & (xy < [camera.width - 0.5, camera.height - 0.5])).all(axis=1)
    seen, _ = casting.is_seen(scene, there, t_ns, moved, inside & (depth >= camera.near))
    return xy, world, depth, seen


_ARRAYS = ("xy", "hit", "depth", "instance", "part", "triangle", "front", "bary", "local")


def _of_a_grid(scene: Scene, points: int, times: list[int]) -> tuple[np.ndarray, Hits]:
    """Return (N, 3) queries and the hits of a regular grid of whole pixels at the first time."""
    width, height = scene.camera.width, scene.camera.height
    # Columns and rows in the picture's proportions; the second division gives columns what rounding took from rows.
    columns = min(width, max(1, round(np.sqrt(points * width / height))))
    rows = min(height, max(1, points // columns))
    columns = min(width, max(1, points // rows))
    # Pixels at the middles of equal cells.
    x = np.floor((np.arange(columns) + 0.5) * width / columns)
    y = np.floor((np.arange(rows) + 0.5) * height / rows)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    hits = casting.cast(scene, times[0], xy)
    # A point of the grid at which nothing is hit has no surface to follow.
    hits = replace(hits, **{name: getattr(hits, name)[hits.hit] for name in _ARRAYS})
    # A query is (number of the time, y, x).
    return np.column_stack([np.zeros(len(hits.xy)), hits.xy[:, ::-1]]), hits


def _of_surfaces(scene: Scene, points: int, times: list[int], rng: np.random.Generator) -> Tracks:
    """Return points drawn uniformly on the objects (without objects, on all but the sky) at the first time; only those
    that are visible at some time, queried when they first are."""
    parts = casting.scene_parts(scene)
    own = [p for p, (obj, _) in enumerate(parts) if obj.category == "object"]
    own = own or [p for p, (obj, _) in enumerate(parts) if obj.category != "sky"]
    which, area = [np.zeros((0, 2), np.int32)], [np.zeros(0)]
    for p in own:
        mesh = parts[p][1].mesh
        a, b, c = np.moveaxis(casting.vertices_at(mesh, times[0])[mesh.faces], 1, 0)
        area.append(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))
        which.append(np.column_stack([np.full(len(a), p), np.arange(len(a))]).astype(np.int32))
    # ends: running sums of the triangles' areas, in which a uniform number finds its triangle.
    places_, ends = np.concatenate(which), np.cumsum(np.concatenate(area))
    kept: list[Tracks] = []
    left = points
    for _ in range(_DRAWS):
        if not len(ends) or ends[-1] <= 0:
            break
        # Half of the points on closed bodies face away.
        draws = 2 * left
        chosen = places_[np.minimum(np.searchsorted(ends, rng.random(draws) * ends[-1], side="right"), len(ends) - 1)]
        u, v = rng.random((2, draws))
        # The far half of the parallelogram is folded back: uniform over the triangle.
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        ids = np.array([obj.instance_id for obj, _ in parts], np.int32)[chosen[:, 0]]
        nothing = np.zeros(draws)
        hits = Hits(
            xy=np.zeros((draws, 2)),
            t_ns=times[0],
            hit=np.ones(draws, bool),
            depth=nothing,
            instance=ids,
            part=chosen[:, 0],
            triangle=chosen[:, 1],
            front=np.ones(draws, bool),
            bary=np.column_stack([1 - u - v, u, v]),
            local=np.zeros((draws, 3)),
        )
        tracks = _followed(scene, hits, times, np.zeros((draws, 3)))
        rows = np.flatnonzero(~tracks.occluded.all(axis=1))[:left]
        # argmin finds the first False: the first time at which the point is visible.
        first = np.argmin(tracks.occluded[rows], axis=1)
        at = tracks.target_points[rows, first]
        kept.append(_rows(tracks, rows, np.column_stack([first, at[:, 1], at[:, 0]])))
        left -= len(rows)
        if left <= 0:
            break
    if not kept:
        empty = casting.cast(scene, times[0], np.zeros((0, 2)))
        return _followed(scene, empty, times, np.zeros((0, 3)))
    return replace(kept[0], **{name: np.concatenate([getattr(one, name) for one in kept]) for name in _OF_POINTS})


_OF_POINTS = tuple(name for name in Tracks.__dataclass_fields__ if name != "t_us")


def _rows(tracks: Tracks, rows: np.ndarray, query: np.ndarray) -> Tracks:
    taken = {name: getattr(tracks, name)[rows] for name in _OF_POINTS if name != "query_points"}
    return replace(tracks, query_points=query.astype(np.float64), **taken)
