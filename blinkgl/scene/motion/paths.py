"""Rigid motions over time: the :class:`~blinkgl.scene.types.PosePath` implementations.

All of them hold their end pose outside ``[t0_ns, t1_ns]`` and have a zero derivative there. Times are int64
nanoseconds and are subtracted as integers before they become float seconds, so a path that starts at 10^6 s
is as precise as (in fact: bit-identical to) the same path started at 0.

    path = SplinePath([0, 500_000_000, 1_000_000_000], positions, rotations)
    T_world_body = path.pose(250_000_000)

A piecewise path is, between key frames i and i + 1 and with u the seconds since key frame i,

    p(u) = sum_k cp[i, k] u^k,      R(u) = R_i exp([phi(u)]x),   phi(u) = sum_k cr[i, k] u^k,   k = 0..3,

which is what scipy's ``CubicSpline`` and ``RotationSpline`` evaluate; straight lines and slerp are the same form
with two terms. The coefficients come from scipy; evaluation is compiled here because a renderer asks for one time
at a time and scipy's call overhead is ten times the work.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from blinkgl.errors import ConfigError
from blinkgl.scene.types import PosePath

# Rounding in the bounds' own arithmetic is of order 1e-15; this margin keeps them upper bounds.
_BOUND_MARGIN = 1.0 + 1e-9


class StaticPath:
    """A body that does not move.

    T : (4, 4) rigid T_world_body, or None for the identity. Raises ConfigError when it is not rigid and finite.
    """

    def __init__(self, T: ArrayLike | None = None, t0_ns: int = 0, t1_ns: int = 0):
        self._T = np.eye(4) if T is None else rigid(T)
        self.t0_ns, self.t1_ns = int(t0_ns), int(t1_ns)

    is_static = True

    def pose(self, t_ns: int) -> np.ndarray:
        return self._T.copy()

    def derivative(self, t_ns: int) -> np.ndarray:
        return np.zeros((4, 4))

    def poses(self, t_ns: np.ndarray) -> np.ndarray:
        return np.tile(self._T, (len(t_ns), 1, 1))

    def speed_bound(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        return 0.0, 0.0


class KeyframePath:
    """Motion through given poses.

    times_ns      : (N,) int64, strictly increasing, N >= 1 (one key frame: a body that stays there).
    positions     : (N, 3) world coordinates of the body's origin.
    rotations     : scipy ``Rotation`` of length N, or (N, 4) quaternions (x, y, z, w).
    interpolation : "spline": C2 (cubic, not-a-knot ends; two key frames give the straight line);
                    "linear": straight lines and slerp, velocity jumps at the key frames (the derivative there is that
                    of the following piece).
    Raises ConfigError (prefixed by ``where``) on wrong shapes, non-finite values, zero quaternions or unordered times.
    """

    def __init__(
        self,
        times_ns: ArrayLike,
        positions: ArrayLike,
        rotations: Rotation | ArrayLike,
        interpolation: Literal["spline", "linear"] = "spline",
        where: str | None = None,
    ):
        knots, positions, rotations = _checked_keys(times_ns, positions, rotations, where)
        self.t0_ns, self.t1_ns = int(knots[0]), int(knots[-1])
        if len(knots) == 1:
            # One nanosecond of standing still, so that the evaluation below needs no special case.
            # Both ends have the same pose, so every coefficient but the first is 0.
            knots = np.array([knots[0], knots[0] + 1])
            positions, rotations = np.repeat(positions, 2, axis=0), Rotation.concatenate([rotations, rotations])
        seconds = (knots - knots[0]) * 1e-9
        if interpolation == "spline":
            cp = CubicSpline(seconds, positions).c
            cr = RotationSpline(seconds, rotations).interpolator.c
        elif interpolation == "linear":
            # Straight lines and slerp: two coefficients each, highest power first as scipy has them.
            h = np.diff(seconds)[:, None]
            cp = np.stack([np.diff(positions, axis=0) / h, positions[:-1]])
            turn = (rotations[:-1].inv() * rotations[1:]).as_rotvec()
            cr = np.stack([turn / h, np.zeros_like(turn)])
        else:
            raise ConfigError("unknown interpolation", where=where, value=interpolation, accepted="spline or linear")
        self._knots = knots
        self._cp, self._cr = _ascending(cp), _ascending(cr)
        # Rotation at the start of each piece; the polynomial phi turns on from there.
        self._rot = np.ascontiguousarray(rotations[:-1].as_matrix())
        self.key_times_ns = knots[:1] if self.t0_ns == self.t1_ns else knots
        # Static: no coefficient above the constant one.
        self.is_static = not (self._cp[:, 1:].any() or self._cr[:, 1:].any())

    def pose(self, t_ns: int) -> np.ndarray:
        T = np.empty((4, 4))
        _pose(int(t_ns), self._knots, self._cp, self._cr, self._rot, T)
        return T

    def derivative(self, t_ns: int) -> np.ndarray:
        D = np.zeros((4, 4))
        t_ns = int(t_ns)
        if self.t0_ns <= t_ns <= self.t1_ns:
            _derivative(t_ns, self._knots, self._cp, self._cr, self._rot, D)
        return D

    def poses(self, t_ns: np.ndarray) -> np.ndarray:
        t_ns = np.ascontiguousarray(t_ns, dtype=np.int64)
        T = np.empty((len(t_ns), 4, 4))
        _poses(t_ns, self._knots, self._cp, self._cr, self._rot, T)
        return T

    def speed_bound(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        """See :class:`PosePath`. Rigorous: a quadratic stays in the convex hull of its Bezier points on the interval,
        and |w| = |J_r(phi) phi'| <= |phi'| because the right Jacobian of SO(3) has singular values 1 and
        |sin(|phi|/2)| / (|phi|/2) <= 1."""
        v, w = _speed_bound(int(ta_ns), int(tb_ns), self._knots, self._cp, self._cr)
        return v * _BOUND_MARGIN, w * _BOUND_MARGIN

    def approach_bound(self, normal: np.ndarray, reach: float, ta_ns: int, tb_ns: int) -> float:
        """Upper bound over [ta, tb] of |n . velocity| in units/s of the body's points within ``reach`` of its origin,
        for the world direction ``normal`` (unit). Zero (to rounding) for a body that slides and turns on a plane,
        where :meth:`speed_bound` says nothing useful."""
        return _BOUND_MARGIN * _approach_bound(
            int(ta_ns), int(tb_ns), self._knots, self._cp, self._cr, self._rot, normal, reach
        )


class SplinePath(KeyframePath):
    """C2 spline through way-points; arguments as in :class:`KeyframePath`."""

    def __init__(
        self, times_ns: ArrayLike, positions: ArrayLike, rotations: Rotation | ArrayLike, where: str | None = None
    ):
        super().__init__(times_ns, positions, rotations, "spline", where)


class HermitePath(KeyframePath):
    """Motion through poses whose velocities are known, too: cubic between them, once continuously differentiable. What
    an engine computed step by step; nothing is drawn over an impact, because no velocity is taken from neighbours.

    times_ns      : (N,) int64, strictly increasing, N >= 1.
    positions     : (N, 3) world coordinates of the body's origin.   velocities : (N, 3) theirs, units/s.
    quaternions   : (N, 4) unit, w x y z, body to world; less than half a turn from one to the next.
    rates         : (N, 3) angular velocity in the body's axes, rad/s.
    The poses outside [t0, t1] are held, so that a body that still moves there stops.
    """

    def __init__(
        self,
        times_ns: np.ndarray,
        positions: np.ndarray,
        velocities: np.ndarray,
        quaternions: np.ndarray,
        rates: np.ndarray,
    ):
        knots = np.ascontiguousarray(times_ns, dtype=np.int64)
        self.t0_ns, self.t1_ns, self.key_times_ns = int(knots[0]), int(knots[-1]), knots
        if len(knots) == 1:
            knots, still = np.array([knots[0], knots[0] + 1]), np.zeros((2, 3))
            # A single pose stands still.
            positions, quaternions = (np.repeat(a, 2, axis=0) for a in (positions, quaternions))
            velocities = rates = still
        self._knots = knots
        self._cp, self._cr = np.empty((len(knots) - 1, 4, 3)), np.empty((len(knots) - 1, 4, 3))
        for i in range(len(knots) - 1):
            j, h = i + 1, (knots[i + 1] - knots[i]) * 1e-9
            _hermite_piece(
                h,
                positions[i],
                positions[j],
                velocities[i],
                velocities[j],
                quaternions[i],
                quaternions[j],
                rates[i],
                rates[j],
                self._cp[i],
                self._cr[i],
            )
        # scipy wants x y z w.
        x, y, z = quaternions[:-1, 1:].T
        self._rot = np.ascontiguousarray(Rotation.from_quat(np.stack([x, y, z, quaternions[:-1, 0]], 1)).as_matrix())
        self.is_static = not (self._cp[:, 1:].any() or self._cr[:, 1:].any())

    @property
    def coefficients(self) -> tuple[np.ndarray, ...]:
        """All that the path is: times (N,) int64 ns, polynomials of position and of rotation (N - 1, 4, 3), rotations
        (N - 1, 3, 3)."""
        return self._knots, self._cp, self._cr, self._rot


class CutPath:
    """``path`` until ``t_cut_ns``, then standing still at the pose of that instant.

    The derivative is zero from the cut on (the derivative to the right: what happens next).
    """

    def __init__(self, path: PosePath, t_cut_ns: int):
        self.path, self.t_cut_ns = path, int(t_cut_ns)
        self.t0_ns = min(path.t0_ns, self.t_cut_ns)
        self.t1_ns = min(path.t1_ns, self.t_cut_ns)

    @property
    def is_static(self) -> bool:
        return self.path.is_static or self.t_cut_ns <= self.path.t0_ns

    def pose(self, t_ns: int) -> np.ndarray:
        return self.path.pose(min(int(t_ns), self.t_cut_ns))

    def derivative(self, t_ns: int) -> np.ndarray:
        return self.path.derivative(t_ns) if t_ns < self.t_cut_ns else np.zeros((4, 4))

    def poses(self, t_ns: np.ndarray) -> np.ndarray:
        return self.path.poses(np.minimum(np.asarray(t_ns, dtype=np.int64), self.t_cut_ns))

    def speed_bound(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        if ta_ns >= self.t_cut_ns:
            return 0.0, 0.0
        return self.path.speed_bound(ta_ns, min(tb_ns, self.t_cut_ns))


class PausedPath:
    """``path``, standing still for ``hold_ns`` from ``stop_ns`` + ``ramp_ns`` on: it slows down and sets out again over
    ``ramp_ns`` each (> 0), with a velocity that is continuous and never higher than ``path``'s. All that comes after is
    later by ``hold_ns`` + ``ramp_ns``."""

    is_static = False

    def __init__(self, path: KeyframePath, stop_ns: int, hold_ns: int, ramp_ns: int):
        self.path, self.t0_ns, self.t1_ns = path, path.t0_ns, path.t1_ns + int(hold_ns) + int(ramp_ns)
        self.stop_ns, self.hold_ns, self.ramp_ns = int(stop_ns), int(hold_ns), int(ramp_ns)

    def _clock(self, t_ns: int) -> tuple[int, float]:
        """Return the time on ``path``'s clock, ns, and how fast that runs, in [0, 1]."""
        ramp, since = self.ramp_ns, t_ns - self.stop_ns
        if since <= 0:
            # Before the stop, slowing down, standing, setting out, after; ramp/2 is the integral of the
            # whole ramp.
            return t_ns, 1.0
        # The rate is 1 - smoothstep, of which this is the integral.
        if since < ramp:
            u = since / ramp
            return self.stop_ns + round(ramp * (u - u**3 + u**4 / 2)), 1 - u * u * (3 - 2 * u)
        if since <= ramp + self.hold_ns:
            return self.stop_ns + round(ramp / 2), 0.0
        u = (since - ramp - self.hold_ns) / ramp
        if u < 1:
            return self.stop_ns + round(ramp * (0.5 + u**3 - u**4 / 2)), u * u * (3 - 2 * u)
        return t_ns - self.hold_ns - ramp, 1.0

    def pose(self, t_ns: int) -> np.ndarray:
        return self.path.pose(self._clock(int(t_ns))[0])

    def derivative(self, t_ns: int) -> np.ndarray:
        at, rate = self._clock(int(t_ns))
        return self.path.derivative(at) * rate

    def poses(self, t_ns: np.ndarray) -> np.ndarray:
        return self.path.poses(np.array([self._clock(int(t))[0] for t in np.asarray(t_ns)], np.int64))

    def speed_bound(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        (a, before), (b, after) = self._clock(int(ta_ns)), self._clock(int(tb_ns))
        return (0.0, 0.0) if a == b and before == after == 0 else self.path.speed_bound(a, b)

    def approach_bound(self, normal: np.ndarray, reach: float, ta_ns: int, tb_ns: int) -> float:
        """As :meth:`KeyframePath.approach_bound`."""
        return self.path.approach_bound(normal, reach, self._clock(int(ta_ns))[0], self._clock(int(tb_ns))[0])


class OffsetPath:
    """A body fixed to another: T_world_offset(t) = T_world_body(t) @ T_body_offset (a stereo camera, a part)."""

    def __init__(self, path: PosePath, T_body_offset: ArrayLike):
        self.path, self.T_body_offset = path, rigid(T_body_offset)
        self.t0_ns, self.t1_ns = path.t0_ns, path.t1_ns
        self._arm = float(np.linalg.norm(self.T_body_offset[:3, 3]))

    @property
    def is_static(self) -> bool:
        return self.path.is_static

    def pose(self, t_ns: int) -> np.ndarray:
        return self.path.pose(t_ns) @ self.T_body_offset

    def derivative(self, t_ns: int) -> np.ndarray:
        return self.path.derivative(t_ns) @ self.T_body_offset

    def poses(self, t_ns: np.ndarray) -> np.ndarray:
        return self.path.poses(t_ns) @ self.T_body_offset

    def speed_bound(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        v, w = self.path.speed_bound(ta_ns, tb_ns)
        # |v + w x r| <= |v| + |w| |r|.
        return (v + w * self._arm) * _BOUND_MARGIN, w


def smoothed(
    t_ns: np.ndarray, positions: np.ndarray, rotations: Rotation, aside_ns: int
) -> tuple[np.ndarray, Rotation]:
    """(N, 3) positions and N rotations, each the mean of those within ``aside_ns`` before and after it, weighed by a
    triangle; towards the ends the window is narrower, so that it stays even. 0: as they are.

    t_ns : (N,) int64. Rotations are means of quaternions, good where they lie near each other."""
    if not aside_ns:
        return positions, rotations
    q = rotations.as_quat()
    # q and -q are one rotation: signs are made to agree, or means would cancel.
    turned = np.cumprod(np.where(np.einsum("nk,nk->n", q[1:], q[:-1]) < 0, -1.0, 1.0))
    q[1:] *= turned[:, None]
    both, out = np.hstack([positions, q]), np.empty((len(q), 7))
    for i, t in enumerate(t_ns):
        # As wide on both sides, so that the mean is not shifted.
        wide = min(aside_ns, t - t_ns[0], t_ns[-1] - t)
        a, b = np.searchsorted(t_ns, (t - wide, t + wide), side="left")
        b = max(min(b + 1, len(t_ns)), i + 1)
        weight = np.maximum(1.0 - np.abs(t_ns[a:b] - t) / wide, 0.0) if wide else (t_ns[a:b] == t).astype(float)
        out[i] = weight @ both[a:b] / weight.sum()
    return out[:, :3], Rotation.from_quat(out[:, 3:])


def rigid(T: ArrayLike, where: str | None = None) -> np.ndarray:
    """(4, 4) float64 copy of ``T``; ConfigError unless it is finite and a rotation with a translation (to 1e-6)."""
    T = np.array(T, dtype=np.float64)
    ok = T.shape == (4, 4) and bool(np.isfinite(T).all())
    if ok:
        R = T[:3, :3]
        ok = np.abs(R @ R.T - np.eye(3)).max() < 1e-6 and np.linalg.det(R) > 0 and np.array_equal(T[3], [0, 0, 0, 1])
    if not ok:
        raise ConfigError(
            "pose is not rigid",
            where=where,
            value=T.tolist(),
            accepted="a 4x4 matrix of a rotation (determinant +1) and a finite translation",
        )
    return T


def _checked_keys(times_ns, positions, rotations, where):
    try:
        times = np.asarray(times_ns)
        knots = times.astype(np.int64)
        positions = np.array(positions, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ConfigError("key frames are not numbers", where=where) from None
    if knots.ndim != 1 or len(knots) == 0 or not np.array_equal(knots, times):
        raise ConfigError("key-frame times have to be a list of whole nanoseconds, at least one", where=where)
    if (np.diff(knots) <= 0).any():
        at = int(np.argmax(np.diff(knots) <= 0)) + 1
        raise ConfigError(
            f"key-frame times have to increase (key frame {at})",
            where=where,
            value=int(knots[at]),
            accepted=f"more than {int(knots[at - 1])} ns",
        )
    if positions.shape != (len(knots), 3) or not np.isfinite(positions).all():
        raise ConfigError(
            "key-frame positions have to be finite and three per time",
            where=where,
            value=f"shape {positions.shape}",
            accepted=f"shape ({len(knots)}, 3)",
        )
    if not isinstance(rotations, Rotation):
        try:
            quaternions = np.array(rotations, dtype=np.float64)
        except (TypeError, ValueError):
            raise ConfigError("key-frame rotations are not numbers", where=where) from None
        if (
            quaternions.shape != (len(knots), 4)
            or not np.isfinite(quaternions).all()
            or not (np.linalg.norm(quaternions, axis=1) > 1e-12).all()
        ):
            raise ConfigError(
                "key-frame rotations have to be non-zero quaternions (x, y, z, w), one per time",
                where=where,
                value=f"shape {quaternions.shape}",
                accepted=f"shape ({len(knots)}, 4)",
            )
        rotations = Rotation.from_quat(quaternions)
    elif rotations.single or len(rotations) != len(knots):
        raise ConfigError(
            "key-frame rotations have to be one per time",
            where=where,
            value=1 if rotations.single else len(rotations),
            accepted=str(len(knots)),
        )
    return knots, positions, rotations


def _ascending(c: np.ndarray) -> np.ndarray:
    """Return scipy's (k, pieces, 3) coefficients, highest power first, as contiguous (pieces, 4, 3), lowest first."""
    out = np.zeros((c.shape[1], 4, 3))
    out[:, : len(c)] = c[::-1].transpose(1, 0, 2)
    return out


@njit(cache=True)
def _hermite_piece(h, p0, p1, v0, v1, q0, q1, w0, w1, cp, cr):
    """Fill ``cp`` and ``cr`` (4, 3), the cubics of one piece of ``h`` seconds (see the module's docstring), from
    positions p, velocities v, quaternions q (w x y z) and body rates w at its ends. Returns the angle from the
    first rotation to the last, rad.

    phi = log(R0^T R1); the rate of phi at the end is J_r^-1(phi) w1, with J_r^-1 = I + [phi]x / 2 + k [phi]x^2,
    k = 1 / a^2 - cot(a / 2) / (2 a), a = |phi|."""
    # conj(q0) q1
    w = q0[0] * q1[0] + q0[1] * q1[1] + q0[2] * q1[2] + q0[3] * q1[3]
    x = q0[0] * q1[1] - q0[1] * q1[0] - q0[2] * q1[3] + q0[3] * q1[2]
    y = q0[0] * q1[2] - q0[2] * q1[0] - q0[3] * q1[1] + q0[1] * q1[3]
    z = q0[0] * q1[3] - q0[3] * q1[0] - q0[1] * q1[2] + q0[2] * q1[1]
    s = math.sqrt(x * x + y * y + z * z)
    # The short way round: atan2 with |w|, and the sign of w.
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
    """(N,) bool: which of N poses, ``step`` seconds apart, a :class:`HermitePath` needs to pass all of them within
    ``tolerance`` (units) and ``angle`` (rad); both ends are. Arrays as there. From each pose that is kept the next is
    looked for by halving."""
    # As large a step as passes all poses between, halved until it does.
    keep = np.empty(len(positions), dtype=bool)
    p, v, q, w = (np.ascontiguousarray(a, dtype=np.float64) for a in (positions, velocities, quaternions, rates))
    _thin(step, p, v, q, w, tolerance, angle, keep)
    return keep


@njit(cache=True)
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
            turned = _hermite_piece(
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


@njit(cache=True)
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


@njit(cache=True)
# The piece that holds t; the first and last go on beyond their ends.
def _piece(t, knots):
    i = np.searchsorted(knots, t, side="right") - 1
    return min(max(i, 0), len(knots) - 2)


@njit(cache=True)
def _pose(t, knots, cp, cr, rot, T):
    t = min(max(t, knots[0]), knots[-1])
    i = _piece(t, knots)
    # Integer difference first, so that times far from 0 lose nothing.
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


@njit(cache=True)
def _poses(times, knots, cp, cr, rot, T):
    for k in range(len(times)):
        _pose(times[k], knots, cp, cr, rot, T[k])


@njit(cache=True)
def _derivative(t, knots, cp, cr, rot, D):
    """Write D = dT/dt. Body rate w = J_r(phi) phi' with the right Jacobian of SO(3), J_r = I - (1 - cos a)/a^2
    [phi]x + (a - sin a)/a^3 [phi]x^2, a = |phi|."""
    T = np.empty((4, 4))
    _pose(t, knots, cp, cr, rot, T)
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


@njit(cache=True)
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


@njit(cache=True)
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


@njit(cache=True)
def _approach_bound(ta, tb, knots, cp, cr, rot, normal, reach):
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
            local[r] = rot[i, 0, r] * normal[0] + rot[i, 1, r] * normal[1] + rot[i, 2, r] * normal[2]
        # Coefficients along the normal and across it.
        for k in range(4):
            along[k, 0] = cp[i, k, 0] * normal[0] + cp[i, k, 1] * normal[1] + cp[i, k, 2] * normal[2]
            dot = cr[i, k, 0] * local[0] + cr[i, k, 1] * local[1] + cr[i, k, 2] * local[2]
            for r in range(3):
                across[k, r] = cr[i, k, r] - dot * local[r]
        phi, rate = _cubic_bound(cr[i], ua, ub), _quadratic_bound(cr[i], ua, ub)
        rate_n = _quadratic_bound(across, ua, ub)
        x = phi * rate_n + _cubic_bound(across, ua, ub) * rate
        tilt = min(rate_n + 0.5 * x + phi * x / 6.0, rate)
        best = max(best, _quadratic_bound(along, ua, ub) + reach * tilt)
    return best


@njit(cache=True)
def _speed_bound(ta, tb, knots, cp, cr):
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
