"""Speeds of triangles in a picture, compiled: what :mod:`~blinkgl.render.motion` computes them with.

Triangles are moved to camera axes, cut at the edges of the view, and summed by the speed of their fastest corner; the
velocity of a rigid triangle's points is between those of its corners but for perspective. Rows are copied value by
value: an assignment of arrays makes numba compile the words of its own errors, seconds of a first run.
"""

from __future__ import annotations

import math

import numpy as np

from blinkgl.machine.kernels import kernel

SLOWEST = 2.0**-40
"""px/s below which a surface counts as still."""
OCTAVE = 16
"""Bins of speed per factor of two: they are 4 % wide, and each keeps its mean."""
BINS = 104 * OCTAVE
"""From 2^-40 to 2^64 px/s."""
POINTS = 8
"""Points of a part whose velocities are compared between looks."""
# Columns of an item's row of a look.
SEEN, NEAREST, AWAY, ASIDE = range(4)


@kernel(error_model="numpy")
def _velocity(x, y, z, dx, dy, dz, lens):
    """Return (px/s of a point in x and in y, px² per unit² around it); nan where the lens shows nothing. lens : corner,
    size and Jacobians of :class:`~blinkgl.render.motion.View`."""
    corner, size, jacobians = lens
    # The quotient rule on the point's place at distance 1, then the lens's Jacobian in the cell of that place.
    u, v = x / z, y / z
    du, dv = (dx - u * dz) / z, (dy - v * dz) / z
    i = min(max(int((v - corner[1]) / size[1]), 0), jacobians.shape[0] - 1)
    j = min(max(int((u - corner[0]) / size[0]), 0), jacobians.shape[1] - 1)
    J = jacobians[i, j]
    a, b = J[0, 0] * du + J[0, 1] * dv, J[1, 0] * du + J[1, 1] * dv
    return a, b, abs(J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0])


@kernel(error_model="numpy")
def _pattern(x, y, z, light, lens):
    """Return the largest px/s of the light's patterns at a point."""
    (twists, cones), most = light, 0.0
    for k in range(len(twists)):
        # Columns of a lamp: 0 to 2 position, 3 to 5 direction, 6 cosine of its half angle, 7 reach.
        lamp, M = cones[k], twists[k]
        a, b, c = x - lamp[0], y - lamp[1], z - lamp[2]
        distance = math.sqrt(a * a + b * b + c * c)
        # Beyond its reach or outside its cone, where it lights nothing.
        if distance > lamp[7] or a * lamp[3] + b * lamp[4] + c * lamp[5] < lamp[6] * distance:
            continue
        dx = M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3]
        dy = M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3]
        dz = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3]
        a, b, _ = _velocity(x, y, z, dx, dy, dz, lens)
        most = max(most, math.sqrt(a * a + b * b))
    return most


@kernel(error_model="numpy")
def _patterns(polygon, count, area, light, lens):
    """Return the largest px/s of the light's patterns on a polygon of this area, px²: on a grid of about 4 px. light :
    maps and cones of :meth:`~blinkgl.render.motion.Motion.light`."""
    n, most = min(max(int(math.sqrt(area) / 4.0), 1), 64), 0.0
    for k in range(1, count - 1):
        # The polygon as a fan of triangles around its first corner; s and t go along two sides of each.
        a, b, c = polygon[0], polygon[k], polygon[k + 1]
        for i in range(n + 1):
            for j in range(n + 1 - i):
                s, t = i / n, j / n
                x = a[0] + s * (b[0] - a[0]) + t * (c[0] - a[0])
                y = a[1] + s * (b[1] - a[1]) + t * (c[1] - a[1])
                z = a[2] + s * (b[2] - a[2]) + t * (c[2] - a[2])
                most = max(most, _pattern(x, y, z, light, lens))
    return most


@kernel(error_model="numpy")
def _cut(polygon, count, out, nx, ny, nz, d):
    """Write the part of a polygon of ``count`` corners (position, velocity) in which n . x >= d to ``out``; return its
    number of corners."""
    m = 0
    for k in range(count):
        # Sutherland and Hodgman (1974): a corner inside is kept, and a side that crosses the plane gives a corner
        # there, with the velocity at that place.
        p, q = polygon[k], polygon[(k + 1) % count]
        a = nx * p[0] + ny * p[1] + nz * p[2] - d
        b = nx * q[0] + ny * q[1] + nz * q[2] - d
        if a >= 0.0:
            for r in range(6):
                out[m, r] = p[r]
            m += 1
        if (a >= 0.0) != (b >= 0.0):
            s = a / (a - b)
            for r in range(6):
                out[m, r] = p[r] + s * (q[r] - p[r])
            m += 1
    return m


@kernel(error_model="numpy")
def _gap(corners, count, n, d):
    """Return (how far a polygon is outside the plane n . x = d, the same as the sine of an angle), at most."""
    gap, farthest = np.inf, 0.0
    for k in range(count):
        p = corners[k]
        gap = min(gap, d - n[0] * p[0] - n[1] * p[1] - n[2] * p[2])
        farthest = max(farthest, p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
    return max(gap, 0.0), max(gap, 0.0) / math.sqrt(farthest)


@kernel(error_model="numpy")
def _in_view(polygon, other, planes, near, common, row):
    """Cut the triangle in ``polygon`` at the edges of the view; return (the array that holds the rest, its number of
    corners). Where nothing is left, its distance from the view goes to ``row``, of a look's items. common : bits of the
    planes that the whole triangle is outside of, the last for the near plane."""
    count, last = 3, len(planes)
    gap, aside = 0.0, 0.0
    for k in range(last + 1):
        if common & (1 << k):
            n, d = (_AHEAD, near) if k == last else (planes[k], 0.0)
            g, s = _gap(polygon, 3, n, d)
            gap, aside = max(gap, g), max(aside, s)
    # Wholly outside of a plane: nothing is left, and the triangle is at least as far away as each such plane.
    if common:
        count = 0
    else:
        # Each cut writes to the other array, so two arrays serve for any number of planes.
        count = _cut(polygon, count, other, 0.0, 0.0, 1.0, near)
        polygon, other = other, polygon
    for k in range(last):
        if count > 0:
            left = _cut(polygon, count, other, planes[k, 0], planes[k, 1], planes[k, 2], 0.0)
            if left == 0:
                # Past a corner of the view: about so far from it.
                gap, aside = _gap(polygon, count, planes[k], 0.0)
                gap, aside = 0.5 * gap, 0.5 * aside
            count = left
            polygon, other = other, polygon
    if count == 0:
        row[AWAY], row[ASIDE] = min(row[AWAY], gap), min(row[ASIDE], aside)
    return polygon, count


_AHEAD = np.array([0.0, 0.0, 1.0])


@kernel(error_model="numpy")
def _move(R, dR, points, rates, planes, near, lens, moved, outside):
    """Write positions, velocities, image velocities and densities of points in camera axes to ``moved``, (n, 9), and
    the bits of the planes they are outside of; what is not in view gets no image velocity."""
    for v in range(len(points)):
        p, dp, row, code = points[v], rates[v], moved[v], 0
        for r in range(3):
            row[r] = R[r, 0] * p[0] + R[r, 1] * p[1] + R[r, 2] * p[2] + R[r, 3]
            row[3 + r] = dR[r, 0] * p[0] + dR[r, 1] * p[1] + dR[r, 2] * p[2] + dR[r, 3]
            # The shape's own motion, in the body's axes, besides that of the body.
            row[3 + r] += R[r, 0] * dp[0] + R[r, 1] * dp[1] + R[r, 2] * dp[2]
        for k in range(len(planes)):
            if planes[k, 0] * row[0] + planes[k, 1] * row[1] + planes[k, 2] * row[2] < 0.0:
                code |= 1 << k
        if row[2] < near:
            code |= 1 << len(planes)
        outside[v] = code
        if code == 0:
            row[6], row[7], row[8] = _velocity(row[0], row[1], row[2], row[3], row[4], row[5], lens)


# Columns of the sums over a polygon's corners.
_FASTEST, _DENSITY, _SUM_X, _SUM_Y = range(4)
# Columns of the sums over an item's surface.
_WHOLE, _MEAN_X, _MEAN_Y, _SPREAD, _OUTWARDS, _AROUND = range(6)


@kernel(error_model="numpy")
def _add(q, corners, total, row):
    """Add a corner to the sums over its polygon and its item."""
    x, y = q[6], q[7]
    speed = math.sqrt(x * x + y * y)
    row[NEAREST] = min(row[NEAREST], q[2])
    if speed < np.inf:  # also false for nan
        u, v = q[0] / q[2], q[1] / q[2]
        corners[_FASTEST], corners[_DENSITY] = max(corners[_FASTEST], speed), max(corners[_DENSITY], q[8])
        corners[_SUM_X], corners[_SUM_Y] = corners[_SUM_X] + x, corners[_SUM_Y] + y
        # Parts of the velocity away from the middle of the view and around it, times the distance from there.
        total[_SPREAD] += math.sqrt(u * u + v * v)
        total[_OUTWARDS], total[_AROUND] = total[_OUTWARDS] + x * u + y * v, total[_AROUND] + y * u - x * v


@kernel(error_model="numpy")
def _twice_area(p, q):
    """Return the cross product of two corners on the plane at distance 1."""
    return (p[0] * q[1] - q[0] * p[1]) / (p[2] * q[2])


@kernel(error_model="numpy")
def _clipped(corners3, codes, polygon, other, view, row, corners, total):
    """Cut a triangle at the edges of the view and add its corners to the sums over its polygon and its item; return
    (the array that holds the rest, its number of corners, twice its area at distance 1)."""
    planes, near, lens = view
    for r in range(9):
        polygon[0, r], polygon[1, r], polygon[2, r] = corners3[0][r], corners3[1][r], corners3[2][r]
    rest, count, area = polygon, 3, 0.0
    if codes[0] | codes[1] | codes[2]:
        rest, count = _in_view(polygon, other, planes, near, codes[0] & codes[1] & codes[2], row)
    for k in range(count):
        q = rest[k]
        q[6], q[7], q[8] = _velocity(q[0], q[1], q[2], q[3], q[4], q[5], lens)
        _add(q, corners, total, row)
        area += _twice_area(q, rest[(k + 1) % count])
    return rest, count, area


@kernel(error_model="numpy")
def _count(area, fastest, corners, count, total, histogram):
    """Add a polygon of this area, px², and these corners to the sums over its item and to the histogram of speeds."""
    areas, sums = histogram
    total[_WHOLE] += area
    total[_MEAN_X] += area * corners[_SUM_X] / count
    total[_MEAN_Y] += area * corners[_SUM_Y] / count
    if fastest >= SLOWEST:
        # SLOWEST, 2^-40, is the lower end of bin 0.
        k = min(max(int((math.log2(fastest) + 40.0) * OCTAVE), 0), BINS - 1)
        areas[k] += area
        sums[k] += area * fastest


@kernel(error_model="numpy")
def look(
    bodies: tuple[np.ndarray, ...],
    shapes: tuple[np.ndarray, ...],
    view: tuple,
    light: tuple[np.ndarray, ...],
    histogram: tuple[np.ndarray, ...],
    rows: np.ndarray,
    velocities: np.ndarray,
) -> float:
    """Fill the arrays of a :class:`~blinkgl.render.motion.Look` and return the largest speed.

    bodies : poses and their rates in camera axes; of each item its body, ranges and side.   shapes : points, their
    rates, faces.   view : planes, near, lens.   light : of :func:`_patterns`.   histogram : areas and sums."""
    (T, D, body, ranges, sides), (points, rates, faces), (planes, near, lens) = bodies, shapes, view
    room, largest, lit = 0, 0.0, len(light[0]) > 0
    for i in range(len(body)):
        room = max(room, int(ranges[i, 1] - ranges[i, 0]))
    # Memory for the body with the most points, used for all, and for clipped polygons.
    moved, outside = np.empty((room, 9)), np.empty(room, np.int64)
    polygon, other, corners = np.empty((16, 9)), np.empty((16, 9)), np.empty(4)
    for i in range(len(body)):
        first, last = int(ranges[i, 0]), int(ranges[i, 1])
        # All points once, since triangles share their corners.
        _move(T[body[i]], D[body[i]], points[first:last], rates[first:last], planes, near, lens, moved, outside)
        total, row = np.zeros(6), rows[i]
        row[SEEN], row[NEAREST], row[AWAY], row[ASIDE] = 0.0, np.inf, np.inf, np.inf
        for f in range(int(ranges[i, 2]), int(ranges[i, 3])):
            ka, kb, kc = faces[f, 0] - first, faces[f, 1] - first, faces[f, 2] - first
            a, b, c = moved[ka], moved[kb], moved[kc]
            # Faces whose back is turned to the camera are not drawn.
            if sides[i] * _behind(a, b, c) > 0.0:
                continue
            for r in range(4):
                corners[r] = 0.0
            rest, codes = polygon, (outside[ka], outside[kb], outside[kc])
            # All three corners are in the frustum: most triangles need no clipping.
            if not codes[0] | codes[1] | codes[2] and not lit:
                area, count = _twice_area(a, b) + _twice_area(b, c) + _twice_area(c, a), 3
                _add(a, corners, total, row)
                _add(b, corners, total, row)
                _add(c, corners, total, row)
            else:
                rest, count, area = _clipped((a, b, c), codes, polygon, other, view, row, corners, total)
                if count == 0:
                    continue
            row[SEEN] = 1.0
            # In px: the area at distance 1, times the densest corner's pixels per unit of it.
            area, fastest = 0.5 * abs(area) * corners[_DENSITY], corners[_FASTEST]
            if lit:
                fastest = max(fastest, _patterns(rest, count, area, light, lens))
            largest = max(largest, fastest)
            _count(area * ranges[i, 4], fastest, corners, count, total, histogram)
        _represent(moved, outside, last - first, total, velocities[i])
    return largest


@kernel(error_model="numpy")
def _behind(a, b, c):
    """Return a number above 0 where a triangle is seen from behind: the camera, the origin, is there."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return (uy * vz - uz * vy) * a[0] + (uz * vx - ux * vz) * a[1] + (ux * vy - uy * vx) * a[2]


@kernel(error_model="numpy")
def _represent(moved, outside, count, total, out):
    """Write the velocities of an item's row of a look."""
    for k in range(POINTS):
        # Vertices evenly spread over the part's numbers, its first and its last among them.
        v = k * (count - 1) // (POINTS - 1)
        if count > 0 and outside[v] == 0:
            out[k, 0], out[k, 1] = moved[v, 6], moved[v, 7]
    if total[_WHOLE] > 0.0:
        out[POINTS, 0], out[POINTS, 1] = total[_MEAN_X] / total[_WHOLE], total[_MEAN_Y] / total[_WHOLE]
    if total[_SPREAD] > 0.0:
        out[POINTS + 1, 0], out[POINTS + 1, 1] = total[_OUTWARDS] / total[_SPREAD], total[_AROUND] / total[_SPREAD]


@kernel(error_model="numpy")
def hides(
    limits: np.ndarray,
    camera: np.ndarray,
    body: np.ndarray,
    arm: np.ndarray,
    timescale: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    seconds: float,
    near: float,
    focal: float,
    tolerance: float,
) -> bool:
    """Return the value of :meth:`~blinkgl.render.motion.Motion.hides`. limits : (n, 4) of the bodies and (4,) of the
    camera: largest speed and angular rate, and the parts of them that the ends do not show."""
    v_cam, w_cam, off_cam, woff_cam = camera[0], camera[1], camera[2], camera[3]
    for i in range(len(body)):
        bound = limits[body[i]]
        # arm: distance of the part's farthest point from the origin that its body turns about.
        moves, turns = bound[0] + v_cam, bound[1] * arm[i]
        deforms = timescale[i] < np.inf
        if not deforms and moves + turns + w_cam == 0.0:
            continue
        if a[i, SEEN] == 0.0 and b[i, SEEN] == 0.0:
            # From outside into the view and out again: the way is at least the sum of both distances.
            if deforms and seconds * 1e9 > timescale[i]:
                return True
            reach = (moves + turns) * seconds
            turned = w_cam * seconds
            far, wide = a[i, AWAY] + b[i, AWAY], a[i, ASIDE] + b[i, ASIDE]
            # It enters by moving, by the camera's turning, or by a part of the way each.
            if (reach > 0.0 and reach >= far) or (turned > 0.0 and turned >= wide) or reach / far + turned / wide > 1.0:
                return True
            continue
        if deforms and seconds * 1e9 > timescale[i]:
            return True
        z = np.inf
        if a[i, SEEN] > 0.0:
            z = min(z, a[i, NEAREST])
        if b[i, SEEN] > 0.0:
            z = min(z, b[i, NEAREST])
        # It may be nearer in between, and must be back at the end.
        nearer = max(near, z - 0.5 * (moves + turns + 1.5 * w_cam * z) * seconds)
        hidden = bound[2] + off_cam + bound[3] * arm[i] + turns * _bow(bound[1] * seconds)
        hidden = (
            hidden / nearer
            + (moves + turns) * (1.0 / nearer - 1.0 / z)
            + 1.5 * (woff_cam + w_cam * _bow(w_cam * seconds))
        )
        if focal * hidden > tolerance:
            return True
    return False


@kernel(error_model="numpy")
def _bow(angle):
    """Return the height of an arc over its chord, by its radius."""
    # 1 - cos(angle / 2) is at most angle^2 / 8, and never above the diameter, 2.
    return min(2.0, angle * angle / 8.0)
