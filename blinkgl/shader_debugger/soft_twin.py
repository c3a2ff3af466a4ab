"""Slow twin of the soft shadows of shaders/include/shadows.glsl in float64; see there for what is done and why.

It looks into the GPU's own shadow map, which is graded by itself."""

from __future__ import annotations

import math

import numpy as np

from blinkgl.render import reference
from blinkgl.render.passes.shadow import ShadowMap
from blinkgl.render.shadows import scale_of, view_of
from blinkgl.scene.types import Scene
from blinkgl.shader_debugger.lamps import lit_points

SPARE, FARTHEST, WIDEST, TAPS, LEAST_SLOPE = 0.25, 16.0, 24.0, 16, 1e-4
TURN = math.pi * (3 - math.sqrt(5))
"""The golden angle between one tap and the next."""
SEEDS = np.array(
    [math.sqrt((i + 0.5) / TAPS) * np.array([math.cos(i * TURN), math.sin(i * TURN)]) for i in range(TAPS)]
)
ROUNDED = 2.0**-21
"""Of a place in the map, 0 to 1, and of a depth there: what float32 makes of a product of a matrix."""


def share_range(
    scene: Scene, frame: reference.ReferenceFrame, one: ShadowMap, depths: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """((H, W), (H, W)) least and greatest share of a lamp that may be seen past its map, 1 where nothing is lit. They
    differ where rounding decides which texel a tap hits, or whether that is in the way.

    depths : (texels, texels) float32, the map as the GPU made it."""
    rows, points, _ = lit_points(scene, frame)
    view, pose = view_of(one.lamp, one.box, one.texels, one.lamp.path.pose(frame.t_ns))
    # Row vectors times R are R^T times columns: into the lamp's camera axes.
    there = (points - pose[:3, 3]) @ pose[:3, :3]
    normals = frame.normal.reshape(-1, 3)[rows] @ pose[:3, :3]
    at = _Place(one, view.projection, there, normals)
    out = np.ones((2, frame.hit.size))
    # The exact place, and corners of the box in which rounding may have moved it.
    moved = [(0, 0, 0), (1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1)]
    shares = [at.share(depths.astype(np.float64), ROUNDED * np.array(way)) for way in moved]
    out[:, rows] = np.min(shares, axis=0), np.max(shares, axis=0)
    low, high = out.reshape(2, *frame.hit.shape)
    return low, high


class _Place:
    """Where N points are in a map, and how their surfaces lie there."""

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
        # Towards the lamp a surface is spared its own shadow by this much at most, and by ``least`` at least.
        self.most = FARTHEST * self.texel * unit
        self.least = np.abs(self.slope).sum(axis=1) / self.size + SPARE * self.texel * unit

    def _limit(self, depth: np.ndarray, aside: np.ndarray) -> np.ndarray:
        """Depth above which something is in the way of the surface at a tap."""
        room = np.clip(self.least + (self.slope * aside).sum(axis=1), -self.most, self.most)
        return np.maximum(depth + room, 0.0)

    def share(self, depths: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """(N,) share of the lamp that is seen. moved : (3,) of all places, and of all depths in parts."""
        xy, depth = self.xy + moved[:2], self.depth + moved[2] * (1.0 if self.sun else self.depth)
        # How far aside a blocker may stand: the sun's cone up to the map's near side, or the lamp's disc.
        reach = self.width * (1 - depth) / self.per_unit if self.sun else self.width
        search = np.clip(0.5 * reach / self.texel, 1.0, WIDEST) / self.size
        blockers, count = np.zeros(len(xy)), np.zeros(len(xy))
        # Every second tap is enough to find what is in the way.
        for seed in SEEDS[::2]:
            aside = seed * search[:, None]
            # ivec2() cuts off towards zero.
            found = _fetched(depths, np.trunc((xy + aside) * self.size).astype(np.intp), empty=True)
            hides = found > self._limit(depth, aside)
            blockers, count = blockers + np.where(hides, found, 0.0), count + hides
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
    """(N,) texels of a map; beyond its edge nothing, or the edge's own."""
    size = len(depths)
    inside = ((texel >= 0) & (texel < size)).all(axis=1)
    x, y = np.clip(texel, 0, size - 1).T
    return np.where(inside | (not empty), depths[y, x], 0.0)


def _bilinear(depths: np.ndarray, at: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """(N,) share of the four texels around (N, 2) places that are not nearer than the limit, bilinearly weighted."""
    low = np.floor(at)
    part, total = at - low, np.zeros(len(at))
    for x in (0, 1):
        for y in (0, 1):
            weight = np.abs(1 - x - part[:, 0]) * np.abs(1 - y - part[:, 1])
            total += weight * (limit >= _fetched(depths, (low + [x, y]).astype(np.intp), empty=False))
    return total
