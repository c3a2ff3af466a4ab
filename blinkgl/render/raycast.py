"""Nearest triangle along a ray, in float64: a bounding-volume hierarchy and its slow reference.

Rays are given in camera coordinates as ``s * (rx, ry, 1)``, so that the ray parameter ``s`` *is* the depth Z along the
optical axis. Each part (one mesh of one object) is traversed in its own local frame; the camera is transformed to the
mesh, never the mesh to the world, so nothing is lost when both are a million units from the origin.

The triangle test is the watertight one of Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection", JCGT 2(1),
2013, sections 3.1-3.3: an edge shared by two triangles is never missed by both. Equal depths are decided by the lower
(part, triangle), so that the answer does not depend on the order of traversal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from blinkgl.machine.kernels import kernel

LEAF_TRIANGLES = 4
_STACK = 64  # the tree is balanced: 64 levels suffice for any mesh in memory
# Relative slack of the box tests, far above the rounding of the triangle test (a few 1e-16), and too small to visit
# noticeably more boxes. With it, the tree finds what the exhaustive loop finds.
_BALL_SLACK = 1e-9
_BOX_SLACK = 1e-14
_DEPTH_SLACK = 1e-9


@dataclass(frozen=True, eq=False)
class Tree:
    """A balanced hierarchy over one mesh, in the mesh's own coordinates.

    triangles : (F, 3, 3) float64 corner positions, in leaf order.   face : (F,) int32 index into ``mesh.faces``.
    lower, upper : (N, 3) float64 boxes.   child : (N,) int32 first child (the second follows it), or first triangle.
    count : (N,) int32 triangles of a leaf, 0 for an inner node.
    """

    triangles: np.ndarray
    face: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    child: np.ndarray
    count: np.ndarray


class Forest(NamedTuple):
    """The trees of all parts, one after the other, in the kernels' form.

    root, first, size : (P,) int32 root node, first triangle and number of triangles of each part.
    side : (P,) int8: a part is hit from both sides (0), from the front (1), from behind (-1).
    extent : (P,) largest local coordinate.
    mask : (P,) int32 row of ``masks`` with a part's holes, -1: none.   uvs : (M, 3, 2) float64 texture coordinates of
    the corners of all faces of parts with holes.
    masks : (K, 6) int64 of each: first face in ``uvs``; first texel in ``texels``, height, width; wrap modes along u
    and v, of :data:`WRAPS`.   cutoffs : (K,) opacity below which there is a hole.   texels : (T,) float32 opacity.
    """

    triangles: np.ndarray
    face: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    child: np.ndarray
    count: np.ndarray
    root: np.ndarray
    first: np.ndarray
    size: np.ndarray
    side: np.ndarray
    extent: np.ndarray
    mask: np.ndarray
    uvs: np.ndarray
    masks: np.ndarray
    cutoffs: np.ndarray
    texels: np.ndarray


# _texel_index takes their indices as ``wrap``.
WRAPS = ("repeat", "mirror", "clamp")


class Holes(NamedTuple):
    """The holes of one part. uvs : (F, 3, 2) float64 of its faces' corners.   opacity : (h, w) float32, 0 to 1.
    cutoff : a lower opacity is a hole.   wrap : along u and v, of :data:`WRAPS`."""

    uvs: np.ndarray
    opacity: np.ndarray
    cutoff: float
    wrap: tuple[str, str]


# Slice assignment and argsort would take longer to compile than everything else here: numba compiles a string library
# for their error message.
@kernel
def _sort_stably(order, a, b, centre, axis, spare):
    """Sort order[a:b] by the centroids along an axis; equal ones keep their order. spare : room for b - a."""
    # A merge sort from below: sorted runs of 1, 2, 4, … entries are merged in pairs.
    width = 1
    while width < b - a:
        for low in range(a, b, 2 * width):
            middle, high = min(low + width, b), min(low + 2 * width, b)
            i, j = low, middle
            for k in range(low, high):
                if i < middle and (j >= high or centre[order[i], axis] <= centre[order[j], axis]):
                    spare[k - a] = order[i]
                    i += 1
                else:
                    spare[k - a] = order[j]
                    j += 1
        for k in range(a, b):
            order[k] = spare[k - a]
        width *= 2


@kernel(error_model="numpy")
def _build(triangles, lower, upper, child, count):
    """Build the tree by median splits along the longest side of the centroids' box. Return (order, number of nodes)."""
    n = triangles.shape[0]
    order, spare, centre = np.empty(n, np.int64), np.empty(n, np.int64), np.empty((n, 3))
    for i in range(n):
        order[i] = i
        for k in range(3):
            centre[i, k] = (triangles[i, 0, k] + triangles[i, 1, k] + triangles[i, 2, k]) / 3.0
    stack = np.empty((_STACK, 3), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, 0, n
    depth, nodes = 1, 1
    while depth > 0:
        depth -= 1
        node, a, b = stack[depth, 0], stack[depth, 1], stack[depth, 2]
        # The box of the range's triangles, and the axis along which their centroids spread most.
        axis, widest = np.int64(0), -1.0  # a literal 0 would compile the sort for a second type
        for k in range(3):
            lo, hi, clo, chi = np.inf, -np.inf, np.inf, -np.inf
            for j in range(a, b):
                i = order[j]
                for c in range(3):
                    lo, hi = min(lo, triangles[i, c, k]), max(hi, triangles[i, c, k])
                clo, chi = min(clo, centre[i, k]), max(chi, centre[i, k])
            lower[node, k], upper[node, k] = lo, hi
            if chi - clo > widest:
                axis, widest = k, chi - clo
        if b - a <= LEAF_TRIANGLES:
            child[node], count[node] = a, b - a
            continue
        # Stable, so that the tree does not depend on the sort's implementation.
        _sort_stably(order, a, b, centre, axis, spare)
        # Children are adjacent in memory: one number finds both.
        middle = (a + b) // 2
        child[node], count[node] = nodes, 0
        stack[depth, 0], stack[depth, 1], stack[depth, 2] = nodes, a, middle
        stack[depth + 1, 0], stack[depth + 1, 1], stack[depth + 1, 2] = nodes + 1, middle, b
        depth += 2
        nodes += 2
    return order, nodes


def build_tree(vertices: np.ndarray, faces: np.ndarray) -> Tree:
    """Return a hierarchy over (F, 3) faces of (V, 3) float64 vertices; F >= 1."""
    corners = np.ascontiguousarray(np.asarray(vertices, np.float64)[np.asarray(faces)])
    n = len(corners)
    lower, upper = np.empty((2 * n, 3)), np.empty((2 * n, 3))
    # Leaves hold 2 to 4 triangles: < 2 n nodes.
    child, count = np.empty(2 * n, np.int32), np.empty(2 * n, np.int32)
    order, nodes = _build(corners, lower, upper, child, count)
    return Tree(corners[order], order.astype(np.int32), lower[:nodes], upper[:nodes], child[:nodes], count[:nodes])


def join_trees(trees: list[Tree], side: Sequence[int], holes: list[Holes | None] | None = None) -> Forest:
    """Return one forest; its part p is ``trees[p]``, with the holes ``holes[p]``."""
    mask, uvs, masks, cutoffs, texels = _holes(len(trees), holes or [])

    def starts(sizes):
        return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)

    def joined(name, empty):
        return np.concatenate([getattr(tree, name) for tree in trees]) if trees else np.empty(empty)

    size = np.array([len(tree.face) for tree in trees], np.int32)
    first = starts(size)
    root = starts([len(tree.child) for tree in trees])
    # Child numbers are continued over the trees: of leaves over the triangles, of inner nodes over the nodes.
    child = [tree.child + np.where(tree.count > 0, first[p], root[p]) for p, tree in enumerate(trees)]
    return Forest(
        triangles=joined("triangles", (0, 3, 3)),
        face=joined("face", 0).astype(np.int32),
        lower=joined("lower", (0, 3)),
        upper=joined("upper", (0, 3)),
        child=(np.concatenate(child) if trees else np.empty(0)).astype(np.int32),
        count=joined("count", 0).astype(np.int32),
        root=root[:-1],
        first=first[:-1],
        size=size,
        side=np.array(side, np.int8),
        extent=np.array([np.abs(tree.triangles).max() for tree in trees], np.float64),
        mask=mask,
        uvs=uvs,
        masks=masks,
        cutoffs=cutoffs,
        texels=texels,
    )


def _holes(parts: int, holes: list[Holes | None]) -> tuple[np.ndarray, ...]:
    """Return the last five fields of a :class:`Forest`."""
    mask, rows, uvs, texels = np.full(parts, -1, np.int32), [], [np.empty((0, 3, 2))], [np.empty(0, np.float32)]
    for p, one in enumerate(holes):
        if one is not None:
            mask[p] = len(rows)
            wraps = [WRAPS.index(w) for w in one.wrap]
            rows.append([sum(map(len, uvs)), sum(map(len, texels)), *one.opacity.shape, *wraps])
            uvs.append(np.asarray(one.uvs, np.float64))
            texels.append(np.asarray(one.opacity, np.float32).ravel())
    cutoffs = np.array([one.cutoff for one in holes if one is not None], np.float64)
    return mask, np.concatenate(uvs), np.array(rows, np.int64).reshape(-1, 6), cutoffs, np.concatenate(texels)


@kernel(error_model="numpy")
def _texel_index(i, size, wrap):
    if wrap == 2:
        return min(max(i, 0), size - 1)
    if wrap == 1:
        i %= 2 * size
        # The texture mirrored and not, one period of 2 size.
        return i if i < size else 2 * size - 1 - i
    return i % size


@kernel(error_model="numpy")
def _is_hole(mask, uvs, cutoff, texels, face, a, b, c):
    """Return whether the point of a face with these barycentrics is cut out, bilinear in ``texels``. mask : a row of
    ``Forest.masks``."""
    first, start, height, width = mask[0] + face, mask[1], mask[2], mask[3]
    # Texture coordinates are affine in the barycentrics; texel centres lie at half-integers.
    u = a * uvs[first, 0, 0] + b * uvs[first, 1, 0] + c * uvs[first, 2, 0]
    v = a * uvs[first, 0, 1] + b * uvs[first, 1, 1] + c * uvs[first, 2, 1]
    x, y = u * width - 0.5, v * height - 0.5
    i, j = np.int64(np.floor(x)), np.int64(np.floor(y))
    fx, fy = x - i, y - j
    # mask[4] and mask[5]: how the texture goes on beyond its sides in u and in v.
    x0, x1 = _texel_index(i, width, mask[4]), _texel_index(i + 1, width, mask[4])
    y0, y1 = start + _texel_index(j, height, mask[5]) * width, start + _texel_index(j + 1, height, mask[5]) * width
    top = texels[y0 + x0] * (1.0 - fx) + texels[y0 + x1] * fx
    bottom = texels[y1 + x0] * (1.0 - fx) + texels[y1 + x1] * fx
    return top * (1.0 - fy) + bottom * fy < cutoff


@kernel(error_model="numpy")
def _shear(d):
    """Return the axes and the shear that turn direction d into +z (Woop et al., section 3.1): kx, ky, kz, sx, sy,
    sz."""
    # The longest axis of d becomes z, so that the division below is well conditioned.
    kz = 0
    if abs(d[1]) > abs(d[kz]):
        kz = 1
    if abs(d[2]) > abs(d[kz]):
        kz = 2
    kx = (kz + 1) % 3
    ky = (kx + 1) % 3
    # Keep the handedness, and so the sign that distinguishes front and back.
    if d[kz] < 0.0:
        kx, ky = ky, kx
    return kx, ky, kz, d[kx] / d[kz], d[ky] / d[kz], 1.0 / d[kz]


@kernel(error_model="numpy")
def _triangle(tri, o, kx, ky, kz, sx, sy, sz):
    """Return (s, u, v, w, front): ray parameter and barycentrics of corners 0, 1, 2; s = inf for a miss."""
    # Corners relative to the ray's origin, sheared so that the ray runs along z (Woop et
    # al., section 3.2).
    az, bz, cz = tri[0, kz] - o[kz], tri[1, kz] - o[kz], tri[2, kz] - o[kz]
    ax, ay = tri[0, kx] - o[kx] - sx * az, tri[0, ky] - o[ky] - sy * az
    bx, by = tri[1, kx] - o[kx] - sx * bz, tri[1, ky] - o[ky] - sy * bz
    cx, cy = tri[2, kx] - o[kx] - sx * cz, tri[2, ky] - o[ky] - sy * cz
    # Scaled barycentrics: the edges' signed areas. Both triangles at an edge compute the same products.
    u = cx * by - cy * bx
    v = ax * cy - ay * cx
    w = bx * ay - by * ax
    det = u + v + w
    # Areas of both signs: the ray passes outside an edge. Zero belongs to both signs, so no ray slips between two
    # triangles that share an edge.
    if det == 0.0 or ((u < 0.0 or v < 0.0 or w < 0.0) and (u > 0.0 or v > 0.0 or w > 0.0)):
        return np.inf, 0.0, 0.0, 0.0, False
    u, v, w = u / det, v / det, w / det
    # The interpolated z of the sheared corners; sz = 1 / d[kz] makes it the ray's parameter.
    return sz * (u * az + v * bz + w * cz), u, v, w, det > 0.0


@kernel(error_model="numpy")
# The ray (rx, ry, 1) in the part's axes: the parameter stays the depth.
def _local_ray(axes, rx, ry, d):
    for k in range(3):
        d[k] = axes[k, 0] * rx + axes[k, 1] * ry + axes[k, 2]


@kernel(error_model="numpy")
def _balls(forest, origins, axes):
    """Return balls around the parts, slightly too large, in camera axes: (P, 3) middles, (P,) radii, and (P,) the
    squared length of the tangents from the camera's centre, slightly too short; <= 0: it is inside. Most rays miss most
    parts, and a ball finds that before a ray is transformed into a part's axes."""
    count = forest.root.shape[0]
    centre, radius, outside = np.empty((count, 3)), np.empty(count), np.empty(count)
    for p in range(count):
        node, half, square, scale = forest.root[p], 0.0, 0.0, forest.extent[p]
        away = np.empty(3)
        # Half the diagonal of the root's box, and its middle as seen from the camera; an empty part is
        # a point.
        for k in range(3):
            scale = max(scale, abs(origins[p, k]))
            side = 0.5 * (forest.upper[node, k] - forest.lower[node, k]) if forest.size[p] else 0.0
            half += side * side
            away[k] = (forest.lower[node, k] + side if forest.size[p] else 0.0) - origins[p, k]
        # Into the camera's axes; radius and tangent allow for the rounding of all this.
        for k in range(3):
            centre[p, k] = axes[p, 0, k] * away[0] + axes[p, 1, k] * away[1] + axes[p, 2, k] * away[2]
            square += centre[p, k] * centre[p, k]
        radius[p] = np.sqrt(half) * (1.0 + _BALL_SLACK) + _BALL_SLACK * scale
        outside[p] = (square - radius[p] * radius[p]) * (1.0 - _BALL_SLACK)
    return centre, radius, outside


@register_jitable
def _box_entry(low, high, box, o_lo, o_hi, inverse):
    """Return the depths at which a ray enters and leaves a box, widened by the rounding; enter > leave: it misses it.

    low, high : (N, 3), and the number of the box in them.   o_lo, o_hi : (3,) the origin moved apart by the slack of
    the test.   inverse : (3,) 1 / direction."""
    # Slabs: the ray is inside the box between the largest entry and the smallest exit.
    enter, leave = 0.0, np.inf
    for k in range(3):
        # a ray in the plane of a side gives 0 * inf = nan, which no comparison takes: visited
        a = (low[box, k] - o_lo[k]) * inverse[k]
        b = (high[box, k] - o_hi[k]) * inverse[k]
        if inverse[k] < 0.0:
            a, b = b, a
        if a > enter:
            enter = a
        if b < leave:
            leave = b
    return enter * (1.0 - _DEPTH_SLACK), leave * (1.0 + _DEPTH_SLACK)


@register_jitable
def _may_meet(balls, part, rx, ry, best):
    """Return whether the ray (rx, ry, 1) may meet the ball of a part (:func:`_balls`) nearer than ``best``."""
    centre, radius, outside = balls
    # The ball begins behind the best hit so far.
    if centre[part, 2] - radius[part] > best:
        return False
    # The angle to the middle is wider than the tangent's, or the ball is behind the camera.
    along = centre[part, 0] * rx + centre[part, 1] * ry + centre[part, 2]
    length = rx * rx + ry * ry + 1.0
    return not (outside[part] > 0.0 and (along < 0.0 or along * along < outside[part] * length))


@kernel(error_model="numpy")
def nearest_tree(
    forest: Forest,
    origins: np.ndarray,
    axes: np.ndarray,
    rays: np.ndarray,
    near: float,
    far: np.ndarray,
    skip: np.ndarray,
    hit: np.ndarray,
    bary: np.ndarray,
    depth: np.ndarray,
    any_will_do: bool = False,
) -> None:
    """Find the nearest hit of each ray through the hierarchy.

    origins : (P, 3) camera centre and axes : (P, 3, 3) camera axes (columns) in each part's frame.
    rays : (N, 2) (rx, ry).   near : depth below which nothing is hit.   far : (N,) depth from which nothing is hit.
    skip : (N, 2) int32 (part, face) each ray passes through, or (-1, -1).
    any_will_do : return the first hit found instead of the nearest, to test whether there is one.
    Output: hit (N, 3) int32 (part, face, 1 when seen from the front) or -1; bary (N, 3); depth (N,), inf when nothing
    is hit.
    """
    triangles, face, lower, upper, child, count, root, _, size, side, extent, mask, uvs, masks, cutoffs, texels = forest
    o, d, inverse, o_lo, o_hi = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    stack, entry = np.empty(_STACK, np.int64), np.empty(_STACK)
    balls = _balls(forest, origins, axes)
    for i in range(rays.shape[0]):
        best = far[i]
        depth[i] = np.inf
        hit[i] = -1
        for p in range(root.shape[0]):
            if any_will_do and hit[i, 0] >= 0:
                break
            if size[p] == 0 or not _may_meet(balls, p, rays[i, 0], rays[i, 1], best):
                continue
            scale = extent[p]
            for k in range(3):
                o[k] = origins[p, k]
                scale = max(scale, abs(o[k]))
            _local_ray(axes[p], rays[i, 0], rays[i, 1], d)
            kx, ky, kz, sx, sy, sz = _shear(d)
            # inf for an axis along which the ray does not move; origins are moved apart by the slack of the box test.
            for k in range(3):
                inverse[k] = 1.0 / d[k] if d[k] != 0.0 else np.inf
                o_lo[k], o_hi[k] = o[k] + _BOX_SLACK * scale, o[k] - _BOX_SLACK * scale
            stack[0], entry[0] = root[p], 0.0
            n = 1
            while n > 0 and not (any_will_do and hit[i, 0] >= 0):
                n -= 1
                # Entered beyond the best hit: so is its whole subtree.
                if entry[n] > best:
                    continue
                node = stack[n]
                if count[node] > 0:
                    for j in range(child[node], child[node] + count[node]):
                        if skip[i, 0] == p and skip[i, 1] == face[j]:
                            continue
                        s, u, v, w, front = _triangle(triangles[j], o, kx, ky, kz, sx, sy, sz)
                        if not (near <= s <= best and s < far[i]) or (side[p] != 0 and (side[p] > 0) != front):
                            continue
                        # Equal depths are decided by the lower (part, triangle), independent of the order.
                        if s == best and (hit[i, 0] < p or hit[i, 1] < face[j]):
                            continue
                        k = mask[p]
                        if k >= 0 and _is_hole(masks[k], uvs, cutoffs[k], texels, face[j], u, v, w):
                            continue
                        best, depth[i] = s, s
                        hit[i, 0], hit[i, 1], hit[i, 2] = p, face[j], front
                        bary[i, 0], bary[i, 1], bary[i, 2] = u, v, w
                    continue
                for c in range(child[node], child[node] + 2):
                    enter, leave = _box_entry(lower, upper, c, o_lo, o_hi, inverse)
                    if enter <= leave and enter <= best:
                        stack[n], entry[n] = c, enter
                        n += 1
                if n >= 2 and entry[n - 1] > entry[n - 2] and count[node] == 0:
                    # nearer child on top; harmless when the two are not siblings
                    stack[n - 1], stack[n - 2] = stack[n - 2], stack[n - 1]
                    entry[n - 1], entry[n - 2] = entry[n - 2], entry[n - 1]
