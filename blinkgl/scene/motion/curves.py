"""The key `way`: a body follows a curve through points at constant speed, its x axis forward.

    path = path_along_curve([(0, 0, 0), (3, 0, 0), (4, 2, 0)], speed=1.3, t0_ns=0, t1_ns=2_000_000_000)

The curve is a C2 spline through the points, parametrised by its length, so that a figure's steps or a fish's strokes
fit the speed everywhere. Beyond its end the body continues straight.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from blinkgl.config.trajectory import ObjectMotion
from blinkgl.errors import ConfigError
from blinkgl.scene.motion.paths import KeyframePath, StaticPath
from blinkgl.scene.motion.pose_path import PosePath
from blinkgl.scene.motion.trajectories import FreeSpace, look_rotation, waypoints

_LEGS = 4  # waypoints of a random way, besides its start
_SMOOTHNESS = 0.8
_SAMPLES = 64  # per leg, of the curve's length
_KNOTS = 8  # per leg, of the path
_MAX_KNOTS = 20_000
_STEP = 0.05  # largest time between knots, s


class ArcLengthCurve:
    """A curve parametrised by its length. points : (K, 3), distinct neighbours, K >= 2, or 3 if closed."""

    def __init__(self, points: ArrayLike, closed: bool = False):
        points = np.asarray(points, np.float64)
        self.closed = closed
        if closed:
            points = np.vstack([points, points[:1]])
        legs = np.linalg.norm(np.diff(points, axis=0), axis=1)
        parameter = np.r_[0.0, np.cumsum(np.sqrt(legs))]  # centripetal: no loops where legs differ
        self._curve = CubicSpline(parameter, points, bc_type="periodic" if closed else "not-a-knot")
        share = np.arange(_SAMPLES) / _SAMPLES
        within = parameter[:-1, None] + np.diff(parameter)[:, None] * share
        self._at = np.r_[within.ravel(), parameter[-1]]
        # Simpson's rule between samples.
        ends, middles = self._at, (self._at[1:] + self._at[:-1]) / 2
        at_ends, at_middles = (np.linalg.norm(self._curve(u, 1), axis=1) for u in (ends, middles))
        pieces = (at_ends[:-1] + 4 * at_middles + at_ends[1:]) * np.diff(ends) / 6
        # Length as a function of the parameter. As a spline it has the derivative that Newton's method needs.
        self._length = CubicSpline(ends, np.r_[0.0, np.cumsum(pieces)])
        self._lengths = np.r_[0.0, np.cumsum(pieces)]
        self.length = float(self._lengths[-1])

    def at(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ((N, 3) positions, (N, 3) unit directions) after (N,) units along the curve."""
        s = np.asarray(s, np.float64)
        within = s % self.length if self.closed else np.clip(s, 0, self.length)
        # The table gives a start; two Newton steps on the length's spline make it exact to rounding.
        u = np.interp(within, self._lengths, self._at)
        for _ in range(2):
            u = np.clip(u - (self._length(u) - within) / np.maximum(self._length(u, 1), 1e-12), 0, self._at[-1])
        directions = self._curve(u, 1)
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-300)
        # Beyond the ends of an open curve the body continues along the tangent.
        return self._curve(u) + (0 if self.closed else (s - within)[:, None] * directions), directions


def path_along_curve(
    points: ArrayLike,
    speed: float,
    t0_ns: int,
    t1_ns: int,
    *,
    closed: bool = False,
    level: bool = True,
    start: float = 0.0,
    where: str = "way",
) -> KeyframePath:
    """Return the motion along a way over [t0, t1]. Raises ConfigError for points that coincide with the next.

    points : as of :class:`ArcLengthCurve`.   speed : units/s, > 0.   level : the body's z axis stays up; otherwise its
    x axis follows the slope, its y axis staying level.   start : fraction of the way covered at time 0."""
    control = np.asarray(points, np.float64)
    after = np.roll(control, -1, axis=0) if closed else control[1:]
    for k in np.flatnonzero(np.abs(after - control[: len(after)]).max(axis=1) < 1e-6):
        raise ConfigError("must differ from the next point", where=f"{where}.points.{k}", value=control[k].tolist())
    curve = ArcLengthCurve(points, closed)
    span = (t1_ns - t0_ns) * 1e-9
    legs = len(np.asarray(points)) - (not closed)
    step = min(curve.length / (legs * _KNOTS) / speed, _STEP)
    count = min(max(math.ceil(span / step), 4), _MAX_KNOTS)
    # One step more at both ends: labels use times slightly beyond.
    times = np.linspace(t0_ns - span / count * 1e9, t1_ns + span / count * 1e9, count + 3).round().astype(np.int64)
    places, ahead = curve.at(start * curve.length + speed * times * 1e-9)
    # Unwrapped, because a body would turn fully where atan2 jumps from pi to -pi.
    if level:
        heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
        turns = Rotation.from_rotvec(heading[:, None] * [0.0, 0.0, 1.0])
    else:
        cameras = np.stack([look_rotation(direction) for direction in ahead])
        # Camera axes are right, down, ahead; the body's are ahead, left, up.
        turns = Rotation.from_matrix(np.stack([cameras[:, :, 2], -cameras[:, :, 0], -cameras[:, :, 1]], axis=2))
    return KeyframePath(times, places, turns)


def random_path_along_curve(
    rng: np.random.Generator,
    t0_ns: int,
    t1_ns: int,
    space: FreeSpace,
    radius: float,
    start_pose: np.ndarray,
    speed: float,
    flat: bool,
) -> PosePath:
    """Return a way through free space from a pose's position, at ``speed`` from t0 on. flat : at constant height;
    otherwise the body's x axis follows the slope. It is static where there is no free space."""
    config = ObjectMotion(waypoints=_LEGS + 1, smoothness=_SMOOTHNESS)
    points = waypoints(rng, t0_ns, t1_ns, config, space, radius, start_pose[:3, 3], speed, flat)[1]
    # A waypoint without a free direction repeats the one before, but neighbours on a curve must differ.
    apart = np.r_[True, np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-3 * radius]
    if apart.sum() < 2:
        return StaticPath(start_pose, t0_ns, t1_ns)
    curve = ArcLengthCurve(points[apart])
    behind = -speed * t0_ns * 1e-9 / curve.length  # fraction at time 0, so that it begins at t0
    return path_along_curve(points[apart], speed, t0_ns, t1_ns, level=flat, start=behind)
