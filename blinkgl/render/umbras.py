"""Where in a picture a lamp's shadows can fall, by what bodies sweep: nothing else looks into its map, and nobody is
drawn into the map whose shadow is out of the picture.

A body that casts is taken for a polytope about it. Its points go along the light until they are through the box of what
is lit; what they pass there, seen by the camera, is bounded in eight directions, and covered by rectangles, few where
drawing once more costs more than looking into the map. A convex body casts nothing on itself.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit
from scipy.spatial import HalfspaceIntersection, QhullError

from blinkgl.render.rectangles import Rectangle

if TYPE_CHECKING:
    from collections.abc import Sequence

    from blinkgl.render.moment import Moment
    from blinkgl.render.resources import DrawItem
    from blinkgl.scene.types import Lamp, Mesh

_SIGNS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_SIDES = np.concatenate([np.eye(3), -np.eye(3), _SIGNS / math.sqrt(3.0)])  # of the polytopes
_MOST = 20_000_000  # corners times faces that are looked at, to know whether a mesh is convex
_FACES = 256  # at a time
_FLAT = 1e-5  # of a mesh's size: what is no farther in front of a face lies in it
_THIN = 0.02  # of its length: what is flatter is a box
_TEXELS = 2.0  # beside a shadow: its edge is smoothed over one
TRIANGLE, DRAW = 16, 8000
"""px whose look-ups into a map cost what a triangle costs, and a draw call with its uniforms, that comes once more."""
_CUT = 4  # of a triangle that is mostly outside of the rectangle


class Umbra(NamedTuple):
    """Of one lamp at one moment. throws : numbers of the items whose shadow can be seen.
    places : by number of the item that it falls on, rectangles of the picture, px, that may meet.
    boxes : by number of each item in light, where it is in the picture."""

    throws: frozenset[int]
    places: dict[int, list[Rectangle]]
    boxes: dict[int, Rectangle]


class Solids:
    """What shadows know of the items of a stage.

    centre, half : (m, 3) of their boxes, in their objects' axes.   casts, lit, simple : (m,) bool; ``simple``: casts
    nothing on itself.   points : (n, 3) of polytopes about them; those of item k begin at ``first[k]``.
    price : (m,) px, of drawing it once more."""

    def __init__(self, items: Sequence[DrawItem]):
        low, high = (np.array([getattr(i, name) for i in items], np.float64).reshape(-1, 3) for name in ("low", "high"))
        self.centre, self.half = (low + high) / 2, (high - low) / 2
        self.casts = np.array([i.casts for i in items], bool)
        self.lit = np.array([i.lit for i in items], bool)
        convex: dict[int, bool] = {}
        about: dict[int, np.ndarray] = {}
        points = []
        for item, centre, half in zip(items, self.centre, self.half):
            mesh = item.mesh
            if item.casts and id(mesh) not in convex:
                convex[id(mesh)], about[id(mesh)] = is_convex(mesh), polytope(mesh, centre, half)
            points.append(about[id(mesh)] if item.casts else np.zeros((0, 3)))
        self.simple = np.array([i.casts and convex[id(i.mesh)] and _one_sided(i) for i in items], bool)
        self.points = np.concatenate([np.zeros((0, 3)), *points])
        self.first = np.cumsum([0, *map(len, points)])
        self.price = np.array([DRAW + _CUT * len(i.mesh.faces) for i in items], np.int64)


def _one_sided(item: DrawItem) -> bool:
    """Whether light does not get at its inner side; of a sheet there is none."""
    size = item.high - item.low
    return not item.two_sided or bool(size.min() <= _FLAT * size.max())


def is_convex(mesh: Mesh) -> bool:
    """Whether no corner lies in front of any face, so that a face that looks at a lamp sees it. False for shapes that
    change, and where finding out would take long."""
    if mesh.deformer is not None or len(mesh.vertices) * len(mesh.faces) > _MOST:
        return False
    points = np.asarray(mesh.vertices, np.float64)
    least = _FLAT * float(np.ptp(points, axis=0).max())
    corners = points[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    kept = length > least**2
    normals, foot = normals[kept] / length[kept, None], corners[kept, 0]
    for k in range(0, len(normals), _FACES):
        n, at = normals[k : k + _FACES], foot[k : k + _FACES]
        if ((points @ n.T).max(axis=0) - (n * at).sum(axis=1) > least).any():
            return False
    return True


def polytope(mesh: Mesh, centre: np.ndarray, half: np.ndarray) -> np.ndarray:
    """(n, 3) corners of a convex body of at most fourteen sides that has a mesh in it: tighter than its box, which it
    is for what is thin or changes its shape."""
    box = centre + _SIGNS * half
    if mesh.deformer is not None or half.min() < _THIN * half.max():
        return box
    reach = (np.asarray(mesh.vertices, np.float64) @ _SIDES.T).max(axis=0) + 1e-4 * half.max()
    try:
        return HalfspaceIntersection(np.column_stack([_SIDES, -reach]), centre).intersections
    except QhullError:  # its box's middle is not in it
        return box


def umbra(moment: Moment, solids: Solids, lamp: Lamp, texel: tuple[float, float], soft: bool) -> Umbra:
    """Of the shadows that ``lamp`` throws into the picture of ``moment``.

    texel : width of one of its map, world units: everywhere, and more per unit of distance from it.
    soft : shadows have penumbras, as wide as the lamp is."""
    receivers = np.array([i.number for i in moment.visible if solids.lit[i.number]], np.int64)
    pose = lamp.path.pose(moment.t_ns)
    R = moment.T_world_cam[:3, :3].T
    sun = lamp.kind == "sun"
    origin = -R @ pose[:3, 2] if sun else R @ (pose[:3, 3] - moment.T_world_cam[:3, 3])
    stage, camera = moment.stage, moment.view.camera
    boxes, throws, found = _places(
        sun, origin, lamp.size if soft else 0.0, float(texel[0]), float(texel[1]),
        np.ascontiguousarray(moment.T_cam_obj[stage.item_object]), moment.centres, stage.item_radius,
        solids.centre, solids.half, solids.casts, solids.simple, solids.points, solids.first, solids.price,
        receivers, moment.view.projection, float(camera.near), camera.width, camera.height,
    )  # fmt: skip
    places: dict[int, list[Rectangle]] = {}
    for number, *place in found.tolist():
        places.setdefault(number, []).append(Rectangle(*place))
    seen = {number: Rectangle(*box) for number, box in zip(receivers.tolist(), boxes.tolist())}
    return Umbra(frozenset(np.flatnonzero(throws).tolist()), places, seen)


# ---- kernels: camera axes, float64

_AXES = 8
_ANGLES = np.arange(_AXES) * math.pi / _AXES
_COS, _SIN = np.cos(_ANGLES), np.sin(_ANGLES)
_COS[_AXES // 2] = 0.0  # straight down
_STRIPS = 16  # of a picture's height


@njit(cache=True, nogil=True, error_model="numpy")
def _add(bounds, x, y, room):
    """Widens (8, 2) bounds by a disc."""
    for k in range(_AXES):
        d = _COS[k] * x + _SIN[k] * y
        bounds[k, 0], bounds[k, 1] = min(bounds[k, 0], d - room), max(bounds[k, 1], d + room)


@njit(cache=True, nogil=True, error_model="numpy")
def _see(bounds, points, count, room, P, near, width, height):
    """Widens bounds by what is seen, px, of the hull of the first points and whatever is ``room`` away from it."""
    scale = 0.5 * max(abs(P[0, 0]) * width, abs(P[1, 1]) * height)
    for i in range(count):
        X, Y, Z = points[i]
        if near < Z:
            x, y = (P[0, 0] * X + P[0, 2] * Z) / Z, (P[1, 1] * Y + P[1, 2] * Z) / Z
            _add(bounds, 0.5 * width * (x + 1.0), 0.5 * height * (y + 1.0), room * scale / max(Z - room, near) + 1.0)
            continue
        for j in range(count):  # where its lines pass the near plane
            if points[j, 2] > near:
                share = (near - Z) / (points[j, 2] - Z)
                x = P[0, 0] * (X + share * (points[j, 0] - X)) / near + P[0, 2]
                y = P[1, 1] * (Y + share * (points[j, 1] - Y)) / near + P[1, 2]
                _add(bounds, 0.5 * width * (x + 1.0), 0.5 * height * (y + 1.0), room * scale / near + 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _near(sun, a, ra, b, rb, origin, size):
    """Whether a ball's shadow, with its penumbra, can reach another ball."""
    if sun:
        way = b - a
        along = (way * origin).sum()
        aside = math.sqrt(max((way * way).sum() - along * along, 0.0))
        return along > -(ra + rb) and aside <= ra + rb + 0.5 * size * max(along + ra + rb, 0.0)
    u, v = a - origin, b - origin
    far_u, far_v = math.sqrt((u * u).sum()), math.sqrt((v * v).sum())
    if far_u <= ra or far_v <= rb:
        return True
    if far_u - ra >= far_v + rb:
        return False
    between = math.acos(min(1.0, max(-1.0, (u * v).sum() / (far_u * far_v))))
    return between <= math.asin(ra / far_u) + math.asin(rb / far_v) + math.atan(size / (far_u - ra))


@njit(cache=True, nogil=True, error_model="numpy")
def _through(q, w, count, half, room):
    """(first, last) time at which any of ``count`` points at (n, 3) q, on their ways w per unit of time, is in a box;
    by what they span. ``room`` is added on all sides."""
    first, last = 0.0, np.inf
    for k in range(3):
        low, high, slow, fast = np.inf, -np.inf, np.inf, -np.inf
        for i in range(count):
            low, high = min(low, q[i, k]), max(high, q[i, k])
            slow, fast = min(slow, w[i, k]), max(fast, w[i, k])
        low, high, h = low - room, high + room, half[k]
        # A way that is still to go is gone first by the fastest, last by the slowest.
        if slow > 1e-12:
            first, last = max(first, (-h - high) / fast), min(last, (h - low) / slow)
        elif fast < -1e-12:
            first, last = max(first, (h - low) / slow), min(last, (-h - high) / fast)
        elif (low > h and slow >= 0.0) or (high < -h and fast <= 0.0):
            return 0.0, -1.0
    return first, last


@njit(cache=True, nogil=True, error_model="numpy")
def _sweep(p, v, q, w, count, half, first, last, out):
    """Writes the ends of the ways of all points through a box, twice ``count``. Where one pair of its sides has them
    all pass, each point's own ends; else from ``first`` to ``last``. The least cosine at which they meet it."""
    best, axis = np.inf, -1
    for k in range(3):
        least, same = np.inf, True
        for i in range(count):
            least = min(least, abs(w[i, k]))
            same = same and w[i, k] * w[0, k] > 0.0
        if same and least > 1e-9 and half[k] / least < best:
            best, axis = half[k] / least, k
    earliest = np.inf
    if axis >= 0:
        for i in range(count):
            earliest = min(earliest, (-half[axis] / abs(w[i, axis])) - q[i, axis] / w[i, axis])
    cosine = 1.0
    for i in range(count):
        begins, ends = first, last
        if axis >= 0:
            middle, width = -q[i, axis] / w[i, axis], half[axis] / abs(w[i, axis])
            begins, ends = 0.0 if earliest < 0.0 else middle - width, min(max(middle + width, 0.0), last)
            length = math.sqrt(w[i, 0] ** 2 + w[i, 1] ** 2 + w[i, 2] ** 2)
            cosine = min(cosine, abs(w[i, axis]) / max(length, 1e-30))
            begins = min(begins, ends)
        for c in range(3):
            out[2 * i, c], out[2 * i + 1, c] = p[i, c] + begins * v[i, c], p[i, c] + ends * v[i, c]
    return cosine


@njit(cache=True, nogil=True, error_model="numpy")
def _cover(bounds, box, price, number, found, count):
    """Appends rectangles of the box that hold what bounds are about: strips, together where that is cheaper."""
    top, bottom = max(box[1], math.floor(bounds[_AXES // 2, 0])), min(box[3], math.ceil(bounds[_AXES // 2, 1]))
    tall = max(8, (box[3] - box[1]) // _STRIPS)
    begun = count
    y = int(top)
    while y < bottom and count < len(found):
        end = min(y + tall, int(bottom))
        left, right = float(box[0]), float(box[2])
        for k in range(_AXES):
            if k != _AXES // 2:  # c x + s y in [low, high] for a y in the strip
                c, s = _COS[k], _SIN[k]
                one, other = s * y, s * end
                low, high = bounds[k, 0] - max(one, other), bounds[k, 1] - min(one, other)
                left, right = max(left, min(low / c, high / c)), min(right, max(low / c, high / c))
        if math.floor(left) < math.ceil(right):
            x0, x1 = max(box[0], math.floor(left)), min(box[2], math.ceil(right))
            joined = False
            if count > begun and found[count - 1, 4] == y:
                last = found[count - 1]
                a, b = min(last[1], x0), max(last[3], x1)
                area = (last[3] - last[1]) * (last[4] - last[2]) + (x1 - x0) * (end - y)
                if (b - a) * (end - last[2]) <= area + price:
                    last[1], last[3], last[4] = a, b, end
                    joined = True
            if not joined:
                found[count] = number, x0, y, x1, end
                count += 1
        y = end
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _join(found, begun, count, price):
    """Joins rectangles two by two where one is cheaper than both."""
    again = True
    while again:
        again = False
        i = begun
        while i < count:
            j = i + 1
            while j < count:
                a, b = found[i], found[j]
                x0, y0, x1, y1 = min(a[1], b[1]), min(a[2], b[2]), max(a[3], b[3]), max(a[4], b[4])
                area = (a[3] - a[1]) * (a[4] - a[2]) + (b[3] - b[1]) * (b[4] - b[2])
                if (x1 - x0) * (y1 - y0) <= area + price:
                    a[1], a[2], a[3], a[4] = x0, y0, x1, y1
                    found[j] = found[count - 1]
                    count -= 1
                    again = True
                else:
                    j += 1
            i += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _places(
    sun, origin, size, texel, texel_more, T, balls, radius, centre, half, casts, simple, points, first_point, price,
    receivers, P, near, width, height,
):  # fmt: skip
    """(boxes, throws, found): (receivers, 4) where each is in the picture; (m,) bool; (n, 5) number of the receiver and
    a rectangle."""
    items = len(casts)
    most = 0
    for c in range(items):
        most = max(most, first_point[c + 1] - first_point[c])
    p, v, q, w = np.zeros((most, 3)), np.zeros((most, 3)), np.zeros((most, 3)), np.zeros((most, 3))
    ends, corners, bounds = np.zeros((2 * most, 3)), np.zeros((8, 3)), np.zeros((_AXES, 2))
    boxes, throws = np.zeros((len(receivers), 4), np.int64), np.zeros(items, np.bool_)
    found = np.zeros((64 + 16 * items, 5), np.int64)
    done = 0
    for number in range(len(receivers)):
        r = receivers[number]
        for i in range(8):
            for k in range(3):
                corners[i, k] = T[r, k, 3]
                for c in range(3):
                    side = half[r, c] if (i >> c) & 1 else -half[r, c]
                    corners[i, k] += T[r, k, c] * (centre[r, c] + side)
        bounds[:, 0], bounds[:, 1] = np.inf, -np.inf
        _see(bounds, corners, 8, 0.0, P, near, width, height)
        box = boxes[number]
        across, down = bounds[0], bounds[_AXES // 2]
        if not (across[0] < width and across[1] > 0.0 and down[0] < height and down[1] > 0.0):
            continue
        box[0], box[2] = max(0.0, math.floor(across[0])), min(float(width), math.ceil(across[1]))
        box[1], box[3] = max(0.0, math.floor(down[0])), min(float(height), math.ceil(down[1]))
        begun = done
        whole = False
        for c in range(items):
            if not casts[c] or (c == r and simple[c]):
                continue
            if c == r:
                throws[c], whole = True, True
                continue
            if not _near(sun, balls[c], radius[c], balls[r], radius[r], origin, size):
                continue
            count = first_point[c + 1] - first_point[c]
            pace, fastest = np.inf, 0.0
            for i in range(count):
                at = points[first_point[c] + i]
                for k in range(3):
                    p[i, k] = T[c, k, 0] * at[0] + T[c, k, 1] * at[1] + T[c, k, 2] * at[2] + T[c, k, 3]
                for k in range(3):
                    v[i, k] = origin[k] if sun else p[i, k] - origin[k]
                length = math.sqrt(v[i, 0] ** 2 + v[i, 1] ** 2 + v[i, 2] ** 2)
                pace, fastest = min(pace, length), max(fastest, length)
                for k in range(3):
                    q[i, k], w[i, k] = -centre[r, k], 0.0
                    for a in range(3):
                        q[i, k] += T[r, a, k] * (p[i, a] - T[r, a, 3])
                        w[i, k] += T[r, a, k] * v[i, a]
            way = balls[r] - balls[c]
            farthest = (math.sqrt((way * way).sum()) + radius[c] + radius[r]) / max(pace, 1e-9)
            # What is beside the polytope's own way: a texel, and a penumbra, wider the longer the way.
            edge = _TEXELS * texel
            room, first, last = edge + _TEXELS * texel_more * fastest, 0.0, 0.0
            settled = False
            for _ in range(5):
                first, last = _through(q, w, count, half[r], room)
                last = min(last, farthest)
                reach = max(last, 0.0)
                grown = edge + _TEXELS * texel_more * fastest * (1.0 + reach) + 0.5 * size * reach
                if grown <= room * 1.0001:
                    settled = True
                    break
                room = 1.25 * grown
            if last < first:
                continue
            if not settled:  # it widens faster than it meets its ground
                throws[c], whole = True, True
                continue
            cosine = _sweep(p, v, q, w, count, half[r], first, last, ends)
            bounds[:, 0], bounds[:, 1] = np.inf, -np.inf
            _see(bounds, ends, 2 * count, room / max(cosine, 0.05), P, near, width, height)
            before = done
            done = _cover(bounds, box, price[r], r, found, done)
            if done > before:
                throws[c] = True
            if done == len(found):
                whole = True
                done = before
        if whole:
            found[begun] = r, box[0], box[1], box[2], box[3]
            done = begun + 1
        else:
            done = _join(found, begun, done, price[r])
    return boxes, throws, found[:done].copy()
