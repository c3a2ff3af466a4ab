"""Rigid motions over time: the :class:`~blinkgl.scene.motion.pose_path.PosePath` implementations.

All of them hold their end pose outside ``[t0_ns, t1_ns]`` and have a zero derivative there. Times are int64 nanoseconds
and are subtracted as integers before they become float seconds, so a path that starts at 10^6 s is as precise as (in
fact: bit-identical to) the same path started at 0.

    path = KeyframePath([0, 500_000_000, 1_000_000_000], positions, rotations)
    T_world_body = path.pose(250_000_000)

A piecewise path is, between key frames i and i + 1 and with u the seconds since key frame i,

    p(u) = sum_k cp[i, k] u^k,      R(u) = R_i exp([phi(u)]x),   phi(u) = sum_k cr[i, k] u^k,   k = 0..3,

which is what scipy's ``CubicSpline`` and ``RotationSpline`` evaluate; straight lines and slerp have the same form with
two terms. The coefficients come from scipy; evaluation is compiled (piecewise.py) because a renderer requests one time
at a time and scipy's call overhead is ten times the work.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from blinkgl.errors import ConfigError
from blinkgl.scene.motion import piecewise
from blinkgl.scene.motion.pose_path import PosePath, no_jumps
from blinkgl.types.poses import pose_of

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

    unseen = speed_bound


class KeyframePath:
    """Motion through given poses.

    times_ns      : (N,) int64, strictly increasing, N >= 1 (one key frame: a body that stays there).
    positions     : (N, 3) world coordinates of the body's origin.
    rotations     : scipy ``Rotation`` of length N, or (N, 4) quaternions (x, y, z, w).
    interpolation : "spline": C2 (cubic, not-a-knot ends; two key frames give the straight line); "linear": straight
                    lines and slerp, velocity jumps at the key frames (the derivative there is that of the following
                    piece).
    Raises ValueError on wrong shapes, non-finite values, zero quaternions or unordered times; callers check user input
    before.
    """

    def __init__(
        self,
        times_ns: ArrayLike,
        positions: ArrayLike,
        rotations: Rotation | ArrayLike,
        interpolation: Literal["spline", "linear"] = "spline",
    ):
        knots, positions, rotations = _checked_keys(times_ns, positions, rotations)
        self.t0_ns, self.t1_ns = int(knots[0]), int(knots[-1])
        if len(knots) == 1:
            # One nanosecond without motion, so that the evaluation below needs no special case. Both ends have the same
            # pose, so every coefficient but the first is 0.
            knots = np.array([knots[0], knots[0] + 1])
            positions, rotations = np.repeat(positions, 2, axis=0), Rotation.concatenate([rotations, rotations])
        seconds = (knots - knots[0]) * 1e-9
        if interpolation == "spline":
            cp = CubicSpline(seconds, positions).c
            cr = RotationSpline(seconds, rotations).interpolator.c
        else:
            # Straight lines and slerp: two coefficients each, highest power first as scipy has them.
            h = np.diff(seconds)[:, None]
            cp = np.stack([np.diff(positions, axis=0) / h, positions[:-1]])
            turn = (rotations[:-1].inv() * rotations[1:]).as_rotvec()
            cr = np.stack([turn / h, np.zeros_like(turn)])
        self._knots = knots
        self._cp, self._cr = _ascending(cp), _ascending(cr)
        # Rotation at the start of each piece, which the polynomial phi continues.
        self._rot = np.ascontiguousarray(rotations[:-1].as_matrix())
        self.key_times_ns = knots[:1] if self.t0_ns == self.t1_ns else knots
        # Static: no coefficient above the constant one.
        self.is_static = not (self._cp[:, 1:].any() or self._cr[:, 1:].any())

    def pose(self, t_ns: int) -> np.ndarray:
        T = np.empty((4, 4))
        piecewise.pose(int(t_ns), self._knots, self._cp, self._cr, self._rot, T)
        return T

    def derivative(self, t_ns: int) -> np.ndarray:
        D = np.zeros((4, 4))
        t_ns = int(t_ns)
        if self.t0_ns <= t_ns <= self.t1_ns:
            piecewise.derivative(t_ns, self._knots, self._cp, self._cr, self._rot, D)
        return D

    def poses(self, t_ns: np.ndarray) -> np.ndarray:
        t_ns = np.ascontiguousarray(t_ns, dtype=np.int64)
        T = np.empty((len(t_ns), 4, 4))
        piecewise.poses(t_ns, self._knots, self._cp, self._cr, self._rot, T)
        return T

    def speed_bound(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        """Return upper bounds, see :class:`PosePath`. Rigorous: a quadratic stays in the convex hull of its Bezier
        points on the interval, and |w| = |J_r(phi) phi'| <= |phi'| because the right Jacobian of SO(3) has singular
        values 1 and |sin(|phi|/2)| / (|phi|/2) <= 1."""
        v, w = piecewise.speed_bound(int(ta_ns), int(tb_ns), self._knots, self._cp, self._cr)
        return v * _BOUND_MARGIN, w * _BOUND_MARGIN

    def unseen(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        """Return bounds, see :class:`PosePath`, by the same Bezier points. The angular velocity is taken as phi',
        which it is for a steady rotation and for small phi."""
        return piecewise.unseen(int(ta_ns), int(tb_ns), self._knots, self._cp, self._cr)

    @property
    def coefficients(self) -> tuple[np.ndarray, ...]:
        """Return all coefficients: times (N,) int64 ns, polynomials of position and of rotation (N - 1, 4, 3),
        rotations (N - 1, 3, 3)."""
        return self._knots, self._cp, self._cr, self._rot

    def approach_bound(self, normal: np.ndarray, reach: float, ta_ns: int, tb_ns: int) -> float:
        """Return an upper bound over [ta, tb] of |n . velocity| in units/s of the body's points within ``reach`` of its
        origin, for the world direction ``normal`` (unit). Zero (to rounding) for a body that slides and turns on a
        plane, where :meth:`speed_bound` is not useful."""
        return _BOUND_MARGIN * piecewise.approach_bound(
            int(ta_ns), int(tb_ns), self._knots, self._cp, self._cr, self._rot, normal, reach
        )


class HermitePath(KeyframePath):
    """Motion through poses with known velocities: cubic between them, once continuously differentiable. It represents
    the steps of an engine; impacts are not smoothed, because no velocity is taken from neighbours.

    times_ns      : (N,) int64, strictly increasing, N >= 1.
    positions     : (N, 3) world coordinates of the body's origin.   velocities : (N, 3) theirs, units/s.
    quaternions   : (N, 4) unit, w x y z, body to world; less than half a turn from one to the next.
    rates         : (N, 3) angular velocity in the body's axes, rad/s.
    The poses outside [t0, t1] are held, so a body that still moves there stops.
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
            piecewise.hermite_piece(
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


class CutPath:
    """``path`` until ``t_cut_ns``, then the pose of that instant.

    The derivative is zero from the cut on (the right-sided derivative).
    """

    def __init__(self, path: PosePath, t_cut_ns: int):
        self.path, self.t_cut_ns = path, int(t_cut_ns)
        self.t0_ns = min(path.t0_ns, self.t_cut_ns)
        self.t1_ns = min(path.t1_ns, self.t_cut_ns)
        self.is_static = path.is_static or self.t_cut_ns <= path.t0_ns

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

    def unseen(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        if not ta_ns < self.t_cut_ns <= tb_ns:
            return self.path.unseen(ta_ns, tb_ns) if tb_ns < self.t_cut_ns else (0.0, 0.0)
        # At tb the body stands, which says nothing of its velocity before the cut.
        return self.path.speed_bound(ta_ns, self.t_cut_ns)


class PausedPath:
    """``path`` with a stop of ``hold_ns`` from ``stop_ns`` + ``ramp_ns`` on: it slows down and speeds up over
    ``ramp_ns`` each (> 0), with a velocity that is continuous and never higher than ``path``'s. Everything later is
    delayed by ``hold_ns`` + ``ramp_ns``."""

    is_static = False

    def __init__(self, path: KeyframePath, stop_ns: int, hold_ns: int, ramp_ns: int):
        self.path, self.t0_ns, self.t1_ns = path, path.t0_ns, path.t1_ns + int(hold_ns) + int(ramp_ns)
        self.stop_ns, self.hold_ns, self.ramp_ns = int(stop_ns), int(hold_ns), int(ramp_ns)

    def _clock(self, t_ns: int) -> tuple[int, float]:
        """Return the time on ``path``'s clock, ns, and the speed of that clock, in [0, 1]."""
        ramp, since = self.ramp_ns, t_ns - self.stop_ns
        # Before the stop, slowing down, standing, speeding up, after; ramp/2 is the integral of the whole ramp.
        if since <= 0:
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
        # Both ends lie in the stop: the path's clock stands over the whole interval.
        return (0.0, 0.0) if a == b and before == after == 0 else self.path.speed_bound(a, b)

    def unseen(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        (a, before), (b, after) = self._clock(int(ta_ns)), self._clock(int(tb_ns))
        v, w = self.path.unseen(a, b)
        inside = ta_ns < self.stop_ns + self.ramp_ns and tb_ns > self.stop_ns
        # Slowing down and speeding up within the interval: the body is slower there than at either end.
        return (v, w) if not inside or (before, after) != (1.0, 1.0) else self.path.speed_bound(a, b)

    def approach_bound(self, normal: np.ndarray, reach: float, ta_ns: int, tb_ns: int) -> float:
        """Return the bound of :meth:`KeyframePath.approach_bound`."""
        return self.path.approach_bound(normal, reach, self._clock(int(ta_ns))[0], self._clock(int(tb_ns))[0])


class AffinePath:
    """The rigid part of a motion that may also scale and shear, exact at every time: its position, and the rotation
    nearest to its linear part.

    motion : (M, dM/dt), ((4, 4), (4, 4) 1/s), at a time in ns.   local : (4, 4) rigid, from the body to M's axes.
    span_ns : time from 0, or any later time, on in which the motion takes all its later values; 0: unknown.
    timescale_ns : time in which its velocity changes little.
    jumps : the times in (t0, t1), ns, after which it jumps; None: it does not."""

    is_static = False

    def __init__(
        self,
        motion: Callable[[int], tuple[np.ndarray, np.ndarray]],
        t0_ns: int,
        t1_ns: int,
        local: ArrayLike,
        span_ns: int = 0,
        timescale_ns: int = 1,
        jumps: Callable[[int, int], list[int]] | None = None,
    ):
        self.t0_ns, self.t1_ns = int(t0_ns), int(t1_ns)
        self._motion, self._local, self._span_ns = motion, rigid(local), span_ns
        self._timescale_ns = max(int(timescale_ns), 1)
        self.jumps = jumps or no_jumps

    def pose(self, t_ns: int) -> np.ndarray:
        matrix, _ = self._motion(min(max(int(t_ns), self.t0_ns), self.t1_ns))
        return pose_of(matrix[:3, 3], nearest_rotation(matrix[:3, :3])) @ self._local

    def derivative(self, t_ns: int) -> np.ndarray:
        D = np.zeros((4, 4))
        if not self.t0_ns <= t_ns <= self.t1_ns:
            return D
        matrix, rate = self._motion(int(t_ns))
        R = nearest_rotation(matrix[:3, :3])
        # M = R P with P symmetric, and R' = R W: W P + P W = R^T M' - M'^T R, diagonal in the axes of P.
        sizes, axes = np.linalg.eigh(R.T @ matrix[:3, :3])
        twist = R.T @ rate[:3, :3]
        W = axes.T @ (twist - twist.T) @ axes
        # Entry ij is divided by s_i + s_j; where that is zero the nearest rotation is not unique, and its rate is
        # taken as 0.
        sums = sizes[:, None] + sizes
        D[:3, :3] = R @ axes @ np.divide(W, sums, out=np.zeros((3, 3)), where=np.abs(sums) > 1e-300) @ axes.T
        D[:3, 3] = rate[:3, 3]
        return D @ self._local

    def poses(self, t_ns: np.ndarray) -> np.ndarray:
        return np.array([self.pose(int(t)) for t in t_ns]).reshape(-1, 4, 4)

    def speed_bound(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        """Return bounds, see :class:`PosePath`, from samples; a quarter is added for what lies between them."""
        if self._span_ns:
            tb_ns = min(tb_ns, max(ta_ns, 0) + self._span_ns)
        # Four samples in each time scale, rounded up, and at least both ends.
        samples = min(max(2, 4 * -(-(tb_ns - ta_ns) // self._timescale_ns)), _SPEED_SAMPLES)
        rates = [self.derivative(int(t)) for t in np.linspace(ta_ns, tb_ns, samples)]
        speed = max(float(np.linalg.norm(D[:3, 3])) for D in rates)
        # The matrix of a rotation's rate has sqrt(2) times the norm of the angular velocity.
        return 1.25 * speed, 1.25 * max(float(np.linalg.norm(D[:3, :3])) for D in rates) / math.sqrt(2)

    def unseen(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        """Return the whole speeds where the ends are farther apart than the motion's own time scale, else 0."""
        return (0.0, 0.0) if tb_ns - ta_ns <= self._timescale_ns else self.speed_bound(ta_ns, tb_ns)


_SPEED_SAMPLES = 256


def nearest_rotation(linear: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to a (3, 3) matrix (polar decomposition)."""
    u, _, vt = np.linalg.svd(linear)
    # The sign on the smallest singular value makes the result a rotation, never a reflection.
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


class OffsetPath:
    """A body fixed to another: T_world_offset(t) = T_world_body(t) @ T_body_offset (a stereo camera, a part)."""

    def __init__(self, path: PosePath, T_body_offset: ArrayLike):
        self.path, self.T_body_offset = path, rigid(T_body_offset)
        self.t0_ns, self.t1_ns, self.is_static = path.t0_ns, path.t1_ns, path.is_static
        self.jumps = getattr(path, "jumps", no_jumps)
        self._arm = float(np.linalg.norm(self.T_body_offset[:3, 3]))

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

    def unseen(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        v, w = self.path.unseen(ta_ns, tb_ns)
        return v + (w + turned(self.path.speed_bound(ta_ns, tb_ns)[1], (tb_ns - ta_ns) * 1e-9)) * self._arm, w


class SharedOriginPath:
    """A body that stays at another's position without rotating with it: the sky around a camera."""

    def __init__(self, path: PosePath):
        self.path, self.t0_ns, self.t1_ns, self.is_static = path, path.t0_ns, path.t1_ns, path.is_static

    def pose(self, t_ns: int) -> np.ndarray:
        return self.poses(np.array([t_ns], np.int64))[0]

    def derivative(self, t_ns: int) -> np.ndarray:
        out = self.path.derivative(t_ns)
        out[:3, :3] = 0.0
        return out

    def poses(self, t_ns: np.ndarray) -> np.ndarray:
        out = np.tile(np.eye(4), (len(t_ns), 1, 1))
        # One by one: the renderer requests the camera's path for one pose, and both must be bitwise equal.
        out[:, :3, 3] = [self.path.pose(int(t))[:3, 3] for t in t_ns]
        return out

    def speed_bound(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        return self.path.speed_bound(ta_ns, tb_ns)[0], 0.0

    def unseen(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        return self.path.unseen(ta_ns, tb_ns)[0], 0.0


def turned(rate: float, seconds: float) -> float:
    """Return how far the velocity of a point at distance 1 leaves the straight line between its values at two times
    while it turns at up to ``rate``, rad/s: the height of an arc of that angle over its chord, as a speed."""
    return rate * min(2.0, (rate * seconds) ** 2 / 8)


def smoothed(
    t_ns: np.ndarray, positions: np.ndarray, rotations: Rotation, aside_ns: int
) -> tuple[np.ndarray, Rotation]:
    """Return (N, 3) positions and N rotations, each the mean of those within ``aside_ns`` before and after it, with
    triangular weights; towards the ends the window is narrower, so that it stays symmetric. 0: unchanged.

    t_ns : (N,) int64. Rotations are means of quaternions, accurate where they are close."""
    if not aside_ns:
        return positions, rotations
    q = rotations.as_quat()
    # q and -q are one rotation: signs are made consistent, or means would cancel.
    turned = np.cumprod(np.where(np.einsum("nk,nk->n", q[1:], q[:-1]) < 0, -1.0, 1.0))
    q[1:] *= turned[:, None]
    both, out = np.hstack([positions, q]), np.empty((len(q), 7))
    for i, t in enumerate(t_ns):
        # Equally wide on both sides, so that the mean is not shifted.
        wide = min(aside_ns, t - t_ns[0], t_ns[-1] - t)
        a, b = np.searchsorted(t_ns, (t - wide, t + wide), side="left")
        b = max(min(b + 1, len(t_ns)), i + 1)
        weight = np.maximum(1.0 - np.abs(t_ns[a:b] - t) / wide, 0.0) if wide else (t_ns[a:b] == t).astype(float)
        out[i] = weight @ both[a:b] / weight.sum()
    return out[:, :3], Rotation.from_quat(out[:, 3:])


def rigid(T: ArrayLike, where: str | None = None) -> np.ndarray:
    """Return a (4, 4) float64 copy of ``T``. Raises ConfigError unless it is finite and a rotation with a translation
    (to 1e-6)."""
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


def _checked_keys(
    times_ns: ArrayLike, positions: ArrayLike, rotations: Rotation | ArrayLike
) -> tuple[np.ndarray, np.ndarray, Rotation]:
    knots, positions = np.asarray(times_ns, np.int64), np.array(positions, np.float64)
    rotations = rotations if isinstance(rotations, Rotation) else Rotation.from_quat(rotations)
    fits = positions.shape == (len(knots), 3) and len(rotations) == len(knots) > 0
    if not fits or (np.diff(knots) <= 0).any() or not np.isfinite(positions).all():
        raise ValueError("key frames have increasing times, and a finite position and a rotation each")
    return knots, positions, rotations


def _ascending(c: np.ndarray) -> np.ndarray:
    """Return scipy's (k, pieces, 3) coefficients, highest power first, as contiguous (pieces, 4, 3), lowest first."""
    out = np.zeros((c.shape[1], 4, 3))
    out[:, : len(c)] = c[::-1].transpose(1, 0, 2)
    return out
