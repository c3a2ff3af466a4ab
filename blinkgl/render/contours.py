"""Lines of a picture where one surface ends in front of another: the mesh edges that are visible as steps.

    lines = Lines()
    pixels, crossings = lines.in_pixels(moment, items, width, height)      # what passes/edged.py draws

A mesh edge is visible when the surface turns away from the camera there (a silhouette), when it ends there (a border),
when two of its faces meet at an angle (a crease), or when they show different parts of their texture (a seam). This is
decided in float64, in the mesh's own axes: the camera is transformed to the mesh, as in raycast.py.

Where triangles are small an outline zigzags. A silhouette's edge at which the surface is hollow lies behind the surface
itself, and its line runs back along visible ones: these lines cancel each other (edges.glsl).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba.extending import register_jitable

from blinkgl.machine.kernels import kernel
from blinkgl.render.mesh_edges import Contour, write_planes

if TYPE_CHECKING:
    from blinkgl.render.draw_items import DrawItem
    from blinkgl.render.moment import Moment

LINE = 7
"""Numbers of a line (:meth:`Lines.of`): both of its ends, px and depth (near / Z); its kind. The surface lies to the
left of the direction from the first to the second end, x to the right and y down."""
CROSSING = 8
"""Numbers of a line's part in one pixel (:meth:`Lines.in_pixels`): where it begins and ends, px along the line from the
place nearest to the pixel's centre; px from the line to the centre, to the left; depth in the middle of the part; the
direction to the left, a unit vector; the line's kind; the change of depth along it per px of the longer axis."""
SILHOUETTE, BACK_AGAIN = 0, -1
"""Kinds of lines besides creases and seams (mesh_edges.py): silhouettes and borders; silhouettes where a closed surface
is hollow."""


_BUSIEST = 12
"""Pixels with at least this many crossings are not sorted further (:func:`_by_pixel`)."""


class _Pool(NamedTuple):
    """Contours one after the other, for kernels: places, faces, planes, edges, sharp, culled as in each, with continued
    numbers.

    starts : (N + 1, 3) int64: where each one's places, faces and edges begin, and the last one's end."""

    starts: np.ndarray
    places: np.ndarray
    faces: np.ndarray
    planes: np.ndarray
    edges: np.ndarray
    sharp: np.ndarray
    culled: np.ndarray


def _pool_of(contours: list[Contour]) -> _Pool:
    sizes = [(len(c.rest), len(c.faces), len(c.edges)) for c in contours]
    # Running sums, so that numbers count on from contour to contour.
    starts = np.concatenate([np.zeros((1, 3), np.int64), np.cumsum(np.reshape(sizes, (-1, 3)), axis=0)])
    starts = starts.astype(np.int64)
    # An empty part first, so that a pool without contours has arrays of the right shapes, too.
    empty = [(np.empty((0, 3)), np.empty((0, 3), np.int32), np.empty((0, 4)), np.empty((0, 4), np.int32))]
    # An edge holds two places and two faces, which are renumbered; -1 stays for a face that it does not have.
    parts = empty + [
        (
            c.rest,
            c.faces + place,
            c.planes,
            np.where(c.edges >= 0, c.edges + (place, place, face, face), -1),
        )
        for c, (place, face, _) in zip(contours, starts[:-1].tolist(), strict=True)
    ]
    places, faces, planes, edges = (np.concatenate(kind) for kind in zip(*parts, strict=True))
    return _Pool(
        starts=starts,
        places=places,
        faces=faces.astype(np.int32),
        planes=planes,
        edges=edges.astype(np.int32),
        sharp=np.concatenate([np.empty(0, np.int8), *(c.sharp for c in contours)]),
        culled=np.concatenate([np.empty(0, np.bool_), *(c.culled for c in contours)]),
    )


class Lines:
    """The contours of a scene's objects; each is made when it is first drawn, and kept. Objects of the same meshes
    share one."""

    def __init__(self) -> None:
        self._contours: list[Contour] = []
        self._numbers: dict[
            tuple[tuple[int, bool], ...], int
        ] = {}  # numbers of contours, by their meshes' ids and sides
        self._of_object: dict[int, int] = {}
        self._pool = _pool_of([])
        self._lines = np.empty((1024, LINE))
        self._crossings = np.empty((4096, CROSSING), np.float32)
        self._sorted = np.empty_like(self._crossings)
        self._places = np.empty(4096, np.int32)
        self._pixels = np.empty((4096, 4), np.int32)
        self._counts = np.zeros(0, np.int32)

    def of(self, moment: Moment, items: Iterable[DrawItem], width: int, height: int) -> np.ndarray:
        """Return (lines, LINE) float64: the lines of these items' objects in a picture of ``width`` x ``height`` px,
        hidden ones included; valid until the next call."""
        bodies = np.array(list(dict.fromkeys(item.object_index for item in items)), np.int64)
        numbers = np.array([self._number(moment, body) for body in bodies.tolist()], np.int64)
        # A pool's starts have one row more than it has contours; fewer mean that contours have been made since.
        if len(self._pool.starts) <= len(self._contours):
            self._pool = _pool_of(self._contours)
        pool = self._pool
        for number in dict.fromkeys(numbers.tolist()):
            contour, (place, face, _) = self._contours[number], pool.starts[number]
            # A deforming shape needs the places and planes of this moment.
            if contour.deforms:
                there = slice(face, face + len(contour.faces))
                pool.places[place : place + len(contour.corners)] = contour.positions(moment.t_ns)
                write_planes(pool.places, pool.faces[there], pool.planes[there])
        # Every edge of every object may be a line.
        room = int((pool.starts[numbers + 1, 2] - pool.starts[numbers, 2]).sum())
        if room > len(self._lines):
            self._lines = np.empty((2 * room, LINE))
        poses = moment.T_cam_obj, moment.mvp
        count = _emit(numbers, bodies, *poses, pool, float(width), float(height), self._lines)
        return self._lines[:count]

    def _number(self, moment: Moment, body: int) -> int:
        """Return the number of an object's contour, which is made where there is none."""
        if body not in self._of_object:
            parts = [(item.mesh, item.two_sided) for item in moment.parts_of(body)]
            key = tuple((id(mesh), both) for mesh, both in parts)
            if key not in self._numbers:
                self._numbers[key] = len(self._contours)
                self._contours.append(Contour(parts))
            self._of_object[body] = self._numbers[key]
        return self._of_object[body]

    def in_pixels(
        self, moment: Moment, items: Iterable[DrawItem], width: int, height: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the parts of those lines in each pixel that they cross. (pixels, 4) int32: x, y, the first of the
        pixel's crossings, the one after its last; no pixel occurs twice.  (crossings, CROSSING) float32, those of a
        pixel in the order of :meth:`of`. Valid until the next call."""
        lines = self.of(moment, items, width, height)
        if len(self._counts) != width * height:
            self._counts = np.zeros(width * height, np.int32)
        room = _most(lines)
        if room > len(self._crossings):
            self._crossings = np.empty((2 * room, CROSSING), np.float32)
            self._sorted = np.empty_like(self._crossings)
            self._places, self._pixels = np.empty(2 * room, np.int32), np.empty((2 * room, 4), np.int32)
        count = _cross(lines, width, height, self._crossings, self._places)
        pixels = _by_pixel(self._crossings[:count], self._places, width, self._counts, self._pixels, self._sorted)
        return self._pixels[:pixels], self._sorted[:count]

    def tangled(self, moment: Moment, items: Iterable[DrawItem], width: int, height: int) -> float:
        """Return the share of the picture's pixels in which three silhouettes cross, or two at depths that differ by
        more than :data:`_APART`, hidden ones included: which surfaces they divide is a guess (edges.glsl)."""
        pixels, crossings = self.in_pixels(moment, items, width, height)
        # reduceat needs increasing starts, and the pixels are in the order of their numbers of crossings.
        first = np.sort(pixels[:, 2])
        if not len(first):
            return 0.0
        # Column 6 is the kind, 0 or -1 for outlines; column 3 is the depth, near / Z.
        outline, depth = crossings[:, 6] < 0.5, crossings[:, 3].astype(np.float64)
        count = np.add.reduceat(outline.astype(np.int64), first)
        nearest = np.maximum.reduceat(np.where(outline, depth, 0.0), first)
        farthest = np.minimum.reduceat(np.where(outline, depth, np.inf), first)
        return float(np.count_nonzero((count > 2) | ((count == 2) & (nearest > _APART * farthest)))) / (width * height)


_APART = 1.05
"""Ratio of depths, near / Z, of two surfaces that are not one."""


@kernel
def _emit(numbers, bodies, T_cam_obj, mvps, pool, width, height, out):
    """Write the lines of all objects and return their number. numbers, bodies : of each object, its contour's index in
    the pool and its own in the scene."""
    starts, planes = pool.starts, pool.planes
    front = np.empty(len(planes), np.bool_)
    # np.int64(0), because a literal 0 would compile _emit_one for a second type.
    count = np.int64(0)
    for n in range(len(numbers)):
        number, T = numbers[n], T_cam_obj[bodies[n]]
        # (x, y, z): the camera's centre in the mesh's axes, -R^T t.
        x = -(T[0, 3] * T[0, 0] + T[1, 3] * T[1, 0] + T[2, 3] * T[2, 0])
        y = -(T[0, 3] * T[0, 1] + T[1, 3] * T[1, 1] + T[2, 3] * T[2, 1])
        z = -(T[0, 3] * T[0, 2] + T[1, 3] * T[1, 2] + T[2, 3] * T[2, 2])
        for f in range(starts[number, 1], starts[number + 1, 1]):
            # The camera lies on the outer side of the face's plane.
            front[f] = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z > planes[f, 3]
        mine = starts[number, 2], starts[number + 1, 2]
        count = _emit_one(mvps[bodies[n]], pool, mine, front, width, height, out, count)
    return count


@register_jitable
def _part_in_picture(ax, ay, dx, dy, width, height):
    """Return the part [low, high] of the line from (ax, ay) to (ax + dx, ay + dy) that is in the picture or at most a
    pixel outside, where float32 is accurate; high <= low: none (Liang-Barsky)."""
    low, high = 0.0, 1.0
    for k in range(4):
        # k: left, right, upper and lower side; d: the line's way towards it; room: distance of its first end.
        d = -dx if k == 0 else dx if k == 1 else -dy if k == 2 else dy
        room = ax + 1 if k == 0 else width + 1 - ax if k == 1 else ay + 1 if k == 2 else height + 1 - ay
        if d > 0:
            high = min(high, room / d)
        elif d < 0:
            low = max(low, room / d)
        elif room < 0:
            # Parallel to this side, and beyond it.
            high = -1.0
    return low, high


@register_jitable
def _cut_at_near_plane(ends):
    """Move an end behind the near plane, z <= w, to where the edge meets it. ends : (2, 4) clip coordinates. Return
    whether anything is in front of it."""
    # w - z is linear along the edge: above 0 in front of the near plane, 0 on it.
    r0, r1 = ends[0, 3] - ends[0, 2], ends[1, 3] - ends[1, 2]
    if r0 <= 0 and r1 <= 0:
        return False
    if r0 <= 0 or r1 <= 0:
        t = r0 / (r0 - r1)
        k = 0 if r0 <= 0 else 1
        for r in range(4):
            ends[k, r] = ends[0, r] + t * (ends[1, r] - ends[0, r])
    return ends[0, 3] > 0 and ends[1, 3] > 0


@kernel
def _emit_one(mvp, pool, mine, front, width, height, out, count):
    """Append the lines of one object, whose edges are ``mine`` of the pool's, to the first ``count``, and return the
    new number."""
    places, faces, planes = pool.places, pool.faces, pool.planes
    edges, sharp = pool.edges[mine[0] : mine[1]], pool.sharp[mine[0] : mine[1]]
    ends = np.empty((2, 4))
    for e in range(len(edges)):
        # Kinds, and directions from which faces are visible.
        v0, v1, towards, kind = edges[e, 0], edges[e, 1], front[edges[e, 2]], SILHOUETTE
        culled = pool.culled[edges[e, 2]] and (edges[e, 3] < 0 or pool.culled[edges[e, 3]])
        if edges[e, 3] >= 0:
            other = front[edges[e, 3]]
            if towards == other:
                # Both faces are visible or neither is: no silhouette, so the edge is drawn only if it is sharp.
                if sharp[e] == 0 or (culled and not towards):
                    continue
                kind = sharp[e]
            elif culled:
                # The edge follows the order of the visible face.
                if not towards:
                    v0, v1, towards = v1, v0, True
                # Hollow: one face's third corner is in front of the other.
                for k in range(3):
                    p = places[faces[edges[e, 3], k]]
                    if faces[edges[e, 3], k] != v0 and faces[edges[e, 3], k] != v1:
                        plane = planes[edges[e, 2]]
                        if plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2] > plane[3]:
                            kind = BACK_AGAIN
        elif culled and not towards:
            # A border of a surface that is seen from behind and culled.
            continue
        # The surface lies to the left of its line, x to the right and y down.
        if towards:
            v0, v1 = v1, v0
        for k in range(2):
            p = places[v0] if k == 0 else places[v1]
            for r in range(4):
                ends[k, r] = mvp[r, 0] * p[0] + mvp[r, 1] * p[1] + mvp[r, 2] * p[2] + mvp[r, 3]
        if not _cut_at_near_plane(ends):
            continue
        # NDC to px: both axes from -1 to 1, y down already in the projection.
        ax = (ends[0, 0] / ends[0, 3] + 1) * 0.5 * width
        ay = (ends[0, 1] / ends[0, 3] + 1) * 0.5 * height
        bx = (ends[1, 0] / ends[1, 3] + 1) * 0.5 * width
        by = (ends[1, 1] / ends[1, 3] + 1) * 0.5 * height
        ad, bd = ends[0, 2] / ends[0, 3], ends[1, 2] / ends[1, 3]
        dx, dy = bx - ax, by - ay
        low, high = _part_in_picture(ax, ay, dx, dy, width, height)
        if not low < high:
            continue
        if not np.sqrt(dx * dx + dy * dy) * (high - low) > 1e-9:
            continue
        cx, cy, cd = ax, ay, ad
        ax, ay, ad = cx + low * dx, cy + low * dy, cd + low * (bd - cd)
        bx, by, bd = cx + high * dx, cy + high * dy, cd + high * (bd - cd)
        out[count, 0], out[count, 1], out[count, 2] = ax, ay, ad
        out[count, 3], out[count, 4], out[count, 5] = bx, by, bd
        out[count, 6] = kind
        count += 1
    return count


@kernel
def _most(lines):
    """Return an upper bound of the number of pixels crossed."""
    count = 0
    for n in range(len(lines)):
        # A line enters a new pixel at most once for each column and row that it crosses.
        count += 4 + int(abs(lines[n, 3] - lines[n, 0]) + abs(lines[n, 4] - lines[n, 1]))
    return count


@kernel
def _cross(lines, width, height, out, places):
    """Write the crossings of each line, in order along it, and each one's pixel, y * width + x. Return their number.

    A line is cut where it passes from pixel to pixel."""
    count = 0
    for n in range(len(lines)):
        ax, ay, dx, dy = lines[n, 0], lines[n, 1], lines[n, 3] - lines[n, 0], lines[n, 4] - lines[n, 1]
        length, longer = np.sqrt(dx * dx + dy * dy), max(abs(dx), abs(dy))
        # Unit vector to the left of the way; what depth gains over the whole line.
        lx, ly, gain = -dy / length, dx / length, lines[n, 5] - lines[n, 2]
        # The pixel that it begins in, and where along it (0 to 1) the next column and the next row begin.
        x, y = int(np.floor(ax)), int(np.floor(ay))
        # A line that begins on the border of two pixels begins in the one that it runs into.
        if ax == x and dx < 0:
            x -= 1
        if ay == y and dy < 0:
            y -= 1
        step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        # by_x, by_y: the fraction of the line from one column to the next, and from one row to the next.
        by_x, by_y = (1 / abs(dx) if dx != 0 else np.inf), (1 / abs(dy) if dy != 0 else np.inf)
        # Amanatides and Woo: walk from pixel to pixel across the nearer border.
        next_x = ((x + 1 - ax) if dx > 0 else (ax - x)) * by_x if dx != 0 else np.inf
        next_y = ((y + 1 - ay) if dy > 0 else (ay - y)) * by_y if dy != 0 else np.inf
        low = 0.0
        while low < 1.0:
            high = min(1.0, next_x, next_y)
            if high > low and 0 <= x < width and 0 <= y < height:
                # From the pixel's centre to the line's first end; the centre's place along the line.
                fx, fy = ax - (x + 0.5), ay - (y + 0.5)
                room, along = -(lx * fx + ly * fy), fx * ly - fy * lx
                out[count, 0], out[count, 1] = along + low * length, along + high * length
                out[count, 2], out[count, 3] = room, lines[n, 2] + 0.5 * (low + high) * gain
                out[count, 4], out[count, 5] = lx, ly
                out[count, 6], out[count, 7] = lines[n, 6], gain / longer
                places[count] = y * width + x
                count += 1
            low = high
            if next_x <= next_y:
                x += step_x
                next_x += by_x
            else:
                y += step_y
                next_y += by_y
    return count


@kernel
def _by_pixel(crossings, places, width, counts, pixels, out):
    """Write the crossings to ``out``, grouped by pixel, and return the number of pixels. counts : zeros, left so."""
    # A counting sort. ``counts`` first holds numbers, then write positions, and is zero again at the end.
    filled = 0
    for n in range(len(crossings)):
        place = places[n]
        if counts[place] == 0:
            pixels[filled, 2] = place
            filled += 1
        counts[place] += 1
    # Another one, of the pixels by their numbers of crossings: processors shade several at once, as long as the one
    # with the most takes.
    begins = np.zeros(_BUSIEST + 1, np.int64)
    for k in range(filled):
        begins[min(counts[pixels[k, 2]], _BUSIEST)] += 1
    before = 0
    for at in range(len(begins)):
        begins[at], before = before, before + begins[at]
    for k in range(filled):
        place = pixels[k, 2]
        at = min(counts[place], _BUSIEST)
        pixels[begins[at], 3] = place
        begins[at] += 1
    # Until here pixels[:, 3] holds the sorted places. Now the columns become x, y, first crossing and the one after the
    # last, and ``counts`` the write positions.
    first = 0
    for k in range(filled):
        place = pixels[k, 3]
        pixels[k, 0], pixels[k, 1], pixels[k, 2] = place % width, place // width, first
        first += counts[place]
        pixels[k, 3] = first
        counts[place] = pixels[k, 2]
    for n in range(len(crossings)):
        at = counts[places[n]]
        counts[places[n]] = at + 1
        for i in range(CROSSING):
            out[at, i] = crossings[n, i]
    for k in range(filled):
        counts[pixels[k, 1] * width + pixels[k, 0]] = 0
    return filled
