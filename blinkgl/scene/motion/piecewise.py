"""Piecewise cubic motions, compiled: poses, rates, and upper bounds of both; :mod:`blinkgl.scene.motion.paths` gives
the form.

knots : (N,) int64 ns.   cp, cr : (N - 1, 4, 3) polynomials of position and of rotation.   rot : (N - 1, 3, 3).
"""

from __future__ import annotations

import math

import numpy as np

from blinkgl.machine.kernels import kernel


@kernel
def hermite_piece(
    h: float,
    p0: np.ndarray,
    p1: np.ndarray,
    v0: np.ndarray,
    v1: np.ndarray,
    q0: np.ndarray,
    q1: np.ndarray,
    w0: np.ndarray,
    w1: np.ndarray,
    cp: np.ndarray,
    cr: np.ndarray,
) -> float:
    """Fill ``cp`` and ``cr`` (4, 3), the cubics of one piece of ``h`` seconds (see the module's docstring), from
    positions p, velocities v, quaternions q (w x y z) and body rates w at its ends. Return the angle from the first
    rotation to the last, rad.

    phi = log(R0^T R1); the rate of phi at the end is J_r^-1(phi) w1, with J_r^-1 = I + [phi]x / 2 + k [phi]x^2, k = 1 /
    a^2 - cot(a / 2) / (2 a), a = |phi|."""
    # conj(q0) q1
    w = q0[0] * q1[0] + q0[1] * q1[1] + q0[2] * q1[2] + q0[3] * q1[3]
    x = q0[0] * q1[1] - q0[1] * q1[0] - q0[2] * q1[3] + q0[3] * q1[2]
    y = q0[0] * q1[2] - q0[2] * q1[0] - q0[3] * q1[1] + q0[1] * q1[3]
    z = q0[0] * q1[3] - q0[3] * q1[0] - q0[1] * q1[2] + q0[2] * q1[1]
    s = math.sqrt(x * x + y * y + z * z)
    # The shorter way round: atan2 with |w|, and the sign of w.
    a = 2.0 * math.atan2(s, abs(w))
    f = (a / s if s > 1e-12 else 2.0) * (1.0 if w >= 0.0 else -1.0)
    phi = np.array([f * x, f * y, f * z])
    # k of the inverse right Jacobian; its series below 0.01 rad, where both terms cancel.
    k = 1.0 / (a * a) - 0.5 / (a * math.tan(0.5 * a)) if a > 1e-2 else 1.0 / 12.0 + a * a / 720.0
    c = np.cross(phi, w1)
    end = w1 + 0.5 * c + k * np.cross(phi, c)
    # The cubic with these ends and slopes (Hermite).
    for r in range(3):
        cp[0, r], cp[1, r] = p0[r], v0[r]
        d = p1[r] - p0[r]
        cp[2, r] = (3.0 * d / h - 2.0 * v0[r] - v1[r]) / h
        cp[3, r] = (v0[r] + v1[r] - 2.0 * d / h) / (h * h)
        cr[0, r], cr[1, r] = 0.0, w0[r]
        cr[2, r] = (3.0 * phi[r] / h - 2.0 * w0[r] - end[r]) / h
        cr[3, r] = (w0[r] + end[r] - 2.0 * phi[r] / h) / (h * h)
    return a


def thin(
    step: float,
    positions: np.ndarray,
    velocities: np.ndarray,
    quaternions: np.ndarray,
    rates: np.ndarray,
    tolerance: float,
    angle: float,
) -> np.ndarray:
    """Return (N,) bool: which of N poses, ``step`` seconds apart, a ``HermitePath`` needs to pass all of them within
    ``tolerance`` (units) and ``angle`` (rad); both ends are included. Arrays as there. From each kept pose the next is
    found by halving."""
    keep = np.empty(len(positions), dtype=bool)
    p, v, q, w = (np.ascontiguousarray(a, dtype=np.float64) for a in (positions, velocities, quaternions, rates))
    _thin(step, p, v, q, w, tolerance, angle, keep)
    return keep


@kernel
def _thin(step, positions, velocities, quaternions, rates, tolerance, angle, keep):
    cp, cr = np.empty((4, 3)), np.empty((4, 3))
    last = len(positions) - 1
    keep[:] = False
    keep[0] = keep[last] = True
    a = 0
    while a < last:
        b = last
        while b > a + 1:
            # From pose a to pose b over what lies between them.
            turned = hermite_piece(
                (b - a) * step,
                positions[a],
                positions[b],
                velocities[a],
                velocities[b],
                quaternions[a],
                quaternions[b],
                rates[a],
                rates[b],
                cp,
                cr,
            )
            if turned < 2.0 and _passes(
                a, b, step, positions, quaternions, cp, cr, tolerance * tolerance, math.sin(0.5 * angle)
            ):
                break
            b = a + (b - a) // 2
        keep[b] = True
        a = b


@kernel
def _passes(a, b, step, positions, quaternions, cp, cr, square, half):
    for i in range(a + 1, b):
        # Position by Horner's scheme, then rotation.
        u = (i - a) * step
        q = 0.0
        for r in range(3):
            d = ((cp[3, r] * u + cp[2, r]) * u + cp[1, r]) * u + cp[0, r] - positions[i, r]
            q += d * d
        if q > square:
            return False
        # exp(phi / 2) as a quaternion.
        x = ((cr[3, 0] * u + cr[2, 0]) * u + cr[1, 0]) * u
        y = ((cr[3, 1] * u + cr[2, 1]) * u + cr[1, 1]) * u
        z = ((cr[3, 2] * u + cr[2, 2]) * u + cr[1, 2]) * u
        n = math.sqrt(x * x + y * y + z * z)
        f = math.sin(0.5 * n) / n if n > 1e-12 else 0.5
        w, x, y, z = math.cos(0.5 * n), f * x, f * y, f * z
        # The vector part of conj(q_i) q_a exp(phi / 2): half the angle between them.
        o, s = quaternions[a], quaternions[i]
        pw = o[0] * w - o[1] * x - o[2] * y - o[3] * z
        px = o[0] * x + o[1] * w + o[2] * z - o[3] * y
        py = o[0] * y - o[1] * z + o[2] * w + o[3] * x
        pz = o[0] * z + o[1] * y - o[2] * x + o[3] * w
        ex = s[0] * px - s[1] * pw - s[2] * pz + s[3] * py
        ey = s[0] * py - s[2] * pw - s[3] * px + s[1] * pz
        ez = s[0] * pz - s[3] * pw - s[1] * py + s[2] * px
        if ex * ex + ey * ey + ez * ez > half * half:
            return False
    return True


# The piece that contains t; the first and last extend beyond their ends.
@kernel
def _piece(t, knots):
    return min(max(np.searchsorted(knots, t, side="right") - 1, 0), len(knots) - 2)


@kernel
def pose(t: int, knots: np.ndarray, cp: np.ndarray, cr: np.ndarray, rot: np.ndarray, T: np.ndarray) -> None:
    """Write the pose at a time, held beyond both ends."""
    t = min(max(t, knots[0]), knots[-1])
    i = _piece(t, knots)
    # Integer difference first, so that times far from 0 lose no precision.
    u = (t - knots[i]) * 1e-9
    x = ((cr[i, 3, 0] * u + cr[i, 2, 0]) * u + cr[i, 1, 0]) * u + cr[i, 0, 0]
    y = ((cr[i, 3, 1] * u + cr[i, 2, 1]) * u + cr[i, 1, 1]) * u + cr[i, 0, 1]
    z = ((cr[i, 3, 2] * u + cr[i, 2, 2]) * u + cr[i, 1, 2]) * u + cr[i, 0, 2]
    q = x * x + y * y + z * z
    # exp = c I + a [phi]x + b phi phi^T. sin(angle / 2) has no cancellation in 1 - cos at small angles.
    if q > 1e-300:
        angle = math.sqrt(q)
        half = math.sin(0.5 * angle)
        a = math.sin(angle) / angle
        b = 2.0 * half * half / q
        c = math.cos(angle)
    else:
        a, b, c = 1.0, 0.5, 1.0
    # E = exp([phi]x), row by row.
    E00, E01, E02 = c + b * x * x, b * x * y - a * z, b * x * z + a * y
    E10, E11, E12 = b * x * y + a * z, c + b * y * y, b * y * z - a * x
    E20, E21, E22 = b * x * z - a * y, b * y * z + a * x, c + b * z * z
    for r in range(3):
        r0, r1, r2 = rot[i, r, 0], rot[i, r, 1], rot[i, r, 2]
        T[r, 0] = r0 * E00 + r1 * E10 + r2 * E20
        T[r, 1] = r0 * E01 + r1 * E11 + r2 * E21
        T[r, 2] = r0 * E02 + r1 * E12 + r2 * E22
        T[r, 3] = ((cp[i, 3, r] * u + cp[i, 2, r]) * u + cp[i, 1, r]) * u + cp[i, 0, r]
        T[3, r] = 0.0
    T[3, 3] = 1.0


@kernel
def poses(times: np.ndarray, knots: np.ndarray, cp: np.ndarray, cr: np.ndarray, rot: np.ndarray, T: np.ndarray) -> None:
    """Write the poses at (n,) times."""
    for k in range(len(times)):
        pose(times[k], knots, cp, cr, rot, T[k])


@kernel
def derivative(t: int, knots: np.ndarray, cp: np.ndarray, cr: np.ndarray, rot: np.ndarray, D: np.ndarray) -> None:
    """Write D = dT/dt. Body rate w = J_r(phi) phi' with the right Jacobian of SO(3), J_r = I - (1 - cos a)/a^2
    [phi]x + (a - sin a)/a^3 [phi]x^2, a = |phi|."""
    T = np.empty((4, 4))
    pose(t, knots, cp, cr, rot, T)
    i = _piece(t, knots)
    u = (t - knots[i]) * 1e-9
    p, d = np.empty(3), np.empty(3)
    for k in range(3):
        p[k] = ((cr[i, 3, k] * u + cr[i, 2, k]) * u + cr[i, 1, k]) * u + cr[i, 0, k]
        d[k] = (3.0 * cr[i, 3, k] * u + 2.0 * cr[i, 2, k]) * u + cr[i, 1, k]
        D[k, 3] = (3.0 * cp[i, 3, k] * u + 2.0 * cp[i, 2, k]) * u + cp[i, 1, k]
    q = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
    if q > 1e-4:
        a = math.sqrt(q)
        k1, k2 = (1.0 - math.cos(a)) / q, (a - math.sin(a)) / (q * a)
    else:
        # Both differences cancel at small angles; next terms are q^3/40320 and q^3/362880, below 1e-16.
        k1 = 0.5 - q * (1.0 / 24.0 - q / 720.0)
        k2 = 1.0 / 6.0 - q * (1.0 / 120.0 - q / 5040.0)
    # phi x phi', and from it J_r phi'.
    c0, c1, c2 = p[1] * d[2] - p[2] * d[1], p[2] * d[0] - p[0] * d[2], p[0] * d[1] - p[1] * d[0]
    w0 = d[0] - k1 * c0 + k2 * (p[1] * c2 - p[2] * c1)
    w1 = d[1] - k1 * c1 + k2 * (p[2] * c0 - p[0] * c2)
    w2 = d[2] - k1 * c2 + k2 * (p[0] * c1 - p[1] * c0)
    # R' = R [w]x, column by column.
    for r in range(3):
        D[r, 0] = T[r, 1] * w2 - T[r, 2] * w1
        D[r, 1] = T[r, 2] * w0 - T[r, 0] * w2
        D[r, 2] = T[r, 0] * w1 - T[r, 1] * w0


@kernel
def _quadratic_bound(c, ua, ub):
    """Return an upper bound of |p'(u)| over [ua, ub] for the cubic p: the largest norm of the three Bezier points of
    p'."""
    best = 0.0
    # The bound is that of the convex hull of the control points.
    for corner in range(3):
        # Blossom of a quadratic: products u u -> v w, u -> (v + w) / 2.
        v = ub if corner == 2 else ua
        w = ua if corner == 0 else ub
        q = 0.0
        for k in range(3):
            x = 3.0 * c[3, k] * v * w + c[2, k] * (v + w) + c[1, k]
            q += x * x
        best = max(best, q)
    return math.sqrt(best)


@kernel
def _cubic_bound(c, ua, ub):
    """Return an upper bound of |p(u)| over [ua, ub]: the largest norm of the four Bezier points of p."""
    # The blossom of a cubic at (v, w, x): a control point each.
    best = 0.0
    for corner in range(4):
        v = ub if corner > 0 else ua
        w = ub if corner > 1 else ua
        x = ub if corner > 2 else ua
        q = 0.0
        for k in range(3):
            y = c[3, k] * v * w * x + (c[2, k] * (v * w + v * x + w * x) + c[1, k] * (v + w + x)) / 3.0 + c[0, k]
            q += y * y
        best = max(best, q)
    return math.sqrt(best)


@kernel
def approach_bound(
    ta: int,
    tb: int,
    knots: np.ndarray,
    cp: np.ndarray,
    cr: np.ndarray,
    rot: np.ndarray,
    normal: np.ndarray,
    reach: float,
) -> float:
    """n . (velocity of the point x) = n . p' + x . (n x w), all in key frame i's axes, where w = J_l(phi) phi' with
    J_l = I + a [phi]x + b [phi]x^2, 0 <= a <= 1/2, 0 <= b <= 1/6. With the parts across n, phi_n and phi'_n:
    |n x w| <= |phi'_n| + X / 2 + |phi| X / 6,  X = |phi x phi'| <= |phi| |phi'_n| + |phi_n| |phi'|;  also <= |phi'|."""
    if tb < knots[0] or ta > knots[-1] or tb < ta:
        return 0.0
    ta, tb = max(ta, knots[0]), min(tb, knots[-1])
    best = 0.0
    along, across, local = np.zeros((4, 3)), np.empty((4, 3)), np.empty(3)
    for i in range(_piece(ta, knots), _piece(tb, knots) + 1):
        # The part of [ta, tb] that lies in piece i, in its own seconds.
        ua = (max(ta, knots[i]) - knots[i]) * 1e-9
        ub = (min(tb, knots[i + 1]) - knots[i]) * 1e-9
        for r in range(3):
            # The normal in key frame i's axes, which are those of the rotation vector.
            local[r] = rot[i, 0, r] * normal[0] + rot[i, 1, r] * normal[1] + rot[i, 2, r] * normal[2]
        # Coefficients along the normal and across it.
        for k in range(4):
            along[k, 0] = cp[i, k, 0] * normal[0] + cp[i, k, 1] * normal[1] + cp[i, k, 2] * normal[2]
            dot = cr[i, k, 0] * local[0] + cr[i, k, 1] * local[1] + cr[i, k, 2] * local[2]
            for r in range(3):
                across[k, r] = cr[i, k, r] - dot * local[r]
        phi, rate = _cubic_bound(cr[i], ua, ub), _quadratic_bound(cr[i], ua, ub)
        rate_n = _quadratic_bound(across, ua, ub)
        # X of the docstring, and the bound of |n x w|.
        x = phi * rate_n + _cubic_bound(across, ua, ub) * rate
        tilt = min(rate_n + 0.5 * x + phi * x / 6.0, rate)
        best = max(best, _quadratic_bound(along, ua, ub) + reach * tilt)
    return best


@kernel
def _off(c, a, b):
    """Return the distance of the point ``c`` from the segment a to b, (3,) each."""
    along, length = 0.0, 0.0
    for k in range(3):
        along += (c[k] - a[k]) * (b[k] - a[k])
        length += (b[k] - a[k]) ** 2
    s = min(max(along / length, 0.0), 1.0) if length > 0.0 else 0.0
    q = 0.0
    for k in range(3):
        q += (c[k] - a[k] - s * (b[k] - a[k])) ** 2
    return math.sqrt(q)


@kernel
def _slope(c, u, out):
    """Write p'(u) of the cubic p to ``out``, (3,)."""
    for k in range(3):
        out[k] = (3.0 * c[3, k] * u + 2.0 * c[2, k]) * u + c[1, k]


@kernel
def _quadratic_off(c, ua, ub, a, b):
    """Return an upper bound over [ua, ub] of the distance of p'(u) from the segment a to b: the largest of the three
    Bezier points of p'."""
    most, point = 0.0, np.empty(3)
    for corner in range(3):
        v = ub if corner == 2 else ua
        w = ua if corner == 0 else ub
        for k in range(3):
            point[k] = 3.0 * c[3, k] * v * w + c[2, k] * (v + w) + c[1, k]
        most = max(most, _off(point, a, b))
    return most


@kernel
def unseen(ta: int, tb: int, knots: np.ndarray, cp: np.ndarray, cr: np.ndarray) -> tuple[float, float]:
    """Return upper bounds over [ta, tb] of the distance of the origin's velocity, and of the rotation vector's rate,
    from the segments between their values at both ends: what the ends do not show. Beyond the knots both are 0."""
    a, b, da, db = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    if tb < knots[0] or ta > knots[-1] or tb < ta:
        return 0.0, 0.0
    i, j = _piece(ta, knots), _piece(tb, knots)
    # Before the first knot and after the last one the body stands still, and the velocities stay 0.
    if ta >= knots[0]:
        _slope(cp[i], (ta - knots[i]) * 1e-9, a)
        _slope(cr[i], (ta - knots[i]) * 1e-9, da)
    if tb <= knots[-1]:
        _slope(cp[j], (tb - knots[j]) * 1e-9, b)
        _slope(cr[j], (tb - knots[j]) * 1e-9, db)
    ta, tb = max(ta, knots[0]), min(tb, knots[-1])
    speed, rate = 0.0, 0.0
    for n in range(i, j + 1):
        ua = (max(ta, knots[n]) - knots[n]) * 1e-9
        ub = (min(tb, knots[n + 1]) - knots[n]) * 1e-9
        speed = max(speed, _quadratic_off(cp[n], ua, ub, a, b))
        rate = max(rate, _quadratic_off(cr[n], ua, ub, da, db))
    return speed, rate


@kernel
def speed_bound(ta: int, tb: int, knots: np.ndarray, cp: np.ndarray, cr: np.ndarray) -> tuple[float, float]:
    """Return upper bounds over [ta, tb] of the speed of the origin and of the angular rate."""
    if tb < knots[0] or ta > knots[-1] or tb < ta:
        return 0.0, 0.0
    ta, tb = max(ta, knots[0]), min(tb, knots[-1])
    speed, rate = 0.0, 0.0
    for i in range(_piece(ta, knots), _piece(tb, knots) + 1):
        ua = (max(ta, knots[i]) - knots[i]) * 1e-9
        ub = (min(tb, knots[i + 1]) - knots[i]) * 1e-9
        speed = max(speed, _quadratic_bound(cp[i], ua, ub))
        rate = max(rate, _quadratic_bound(cr[i], ua, ub))
    return speed, rate


# ---------------------------------------------------------------------------------------------------------------------
# Many paths at once, one after the other in the same arrays. first : (n + 1,) where each one's knots begin; its pieces
# have the numbers of their first knots.


@kernel
def all_poses(
    t: int,
    first: np.ndarray,
    knots: np.ndarray,
    cp: np.ndarray,
    cr: np.ndarray,
    rot: np.ndarray,
    rows: np.ndarray,
    T: np.ndarray,
) -> None:
    """Write the pose of path k to row rows[k] of T, (m, 4, 4)."""
    for k in range(len(rows)):
        a, b = first[k], first[k + 1]
        pose(t, knots[a:b], cp[a : b - 1], cr[a : b - 1], rot[a : b - 1], T[rows[k]])


@kernel
def all_derivatives(
    t: int,
    first: np.ndarray,
    knots: np.ndarray,
    cp: np.ndarray,
    cr: np.ndarray,
    rot: np.ndarray,
    rows: np.ndarray,
    D: np.ndarray,
) -> None:
    """Write dT/dt of path k to row rows[k] of D, (m, 4, 4): 0 beyond its knots."""
    for k in range(len(rows)):
        a, b = first[k], first[k + 1]
        D[rows[k]] = 0.0
        if knots[a] <= t <= knots[b - 1]:
            derivative(t, knots[a:b], cp[a : b - 1], cr[a : b - 1], rot[a : b - 1], D[rows[k]])


@kernel
def all_bounds(
    ta: int,
    tb: int,
    first: np.ndarray,
    knots: np.ndarray,
    cp: np.ndarray,
    cr: np.ndarray,
    rows: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write both numbers of :func:`speed_bound` and both of :func:`unseen` of path k to row rows[k] of ``out``, (m,
    4)."""
    for k in range(len(rows)):
        a, b = first[k], first[k + 1]
        row = out[rows[k]]
        row[0], row[1] = speed_bound(ta, tb, knots[a:b], cp[a : b - 1], cr[a : b - 1])
        row[2], row[3] = unseen(ta, tb, knots[a:b], cp[a : b - 1], cr[a : b - 1])
