"""Random 6-DoF motion: waypoints in free space with random rotations, and a C2 spline through them.

    space = FreeSpace(low=(-4, -4, 0), high=(4, 4, 3), ground_z=0.0, centres=centres, radii=radii)
    rng = generator(seed, sequence, Role.TRAJECTORY)
    path = random_path(rng, t0_ns, t1_ns, ObjectMotion(speed=(0.5, 1)), space, 0.3, T_world_obj)
    sliding = random_path(rng, t0_ns, t1_ns, ObjectMotion(), space, 0.3, T_world_obj, on_ground=True)
    camera = random_camera_path(rng, t0_ns, t1_ns, CameraMotion(), space, 0.2, (0, 0, 0.5), T_world_cam)

How the configured speed is met: waypoints are a random walk whose legs have about the right length, so that they can be
rejected one by one. The spline through them is a fixed curve in space, and its *duration* is then scaled until the mean
speed over [t0, t1] is the drawn one, so waypoints stay in free space. The angular rate is met by scaling the turns
between key frames. ``path.t1_ns`` may be after t1: the walk's last leg is rarely used completely.

Waypoints and the straight legs between them avoid the given obstacles and the ground; the spline between them is
checked at samples and redrawn a few times. This makes collisions rare, not impossible:
:func:`blinkgl.scene.motion.collision.resolve_collisions` finds the rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import accumulate

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from blinkgl.config.trajectory import CameraMotion, MotionConfig, ObjectMotion
from blinkgl.scene.motion.paths import KeyframePath, PausedPath, StaticPath, rigid
from blinkgl.scene.motion.pose_path import PosePath

_REDRAWS = 6  # whole paths; the one that leaves free space least is used
_TRIES = 40  # directions per leg, after which the leg is halved
_MAX_TURN = 2.0  # rad between key frames: RotationSpline needs less than pi
_RAMP = 0.05  # fraction of the sequence in which a pausing body slows down, and speeds up again
_SAMPLES = 16  # per leg, for arc length, mean rate and the check of the curve


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """A box without the inside of obstacles' bounding spheres.

    low, high : (3,) corners, sequences, too; a body's *origin* must stay inside.
    ground_z  : bodies must stay above it by their radius (None: no ground).
    centres, radii : (M, 3), (M,) spheres.
    """

    low: np.ndarray
    high: np.ndarray
    ground_z: float | None = None
    centres: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    radii: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        for name, shape in (("low", (3,)), ("high", (3,)), ("centres", (-1, 3)), ("radii", (-1,))):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64).reshape(shape))
        if not (self.low <= self.high).all() or len(self.centres) != len(self.radii):
            raise ValueError("FreeSpace: low has to be below high, and each centre needs a radius")

    def depth(self, points: np.ndarray, radius: float, skip: np.ndarray | None = None) -> np.ndarray:
        """Return how far a body's sphere at (N, 3) ``points`` is outside free space, (N,); 0 inside. ``skip``: (M,)
        bool obstacles to ignore."""
        low = self.low.copy()
        if self.ground_z is not None:
            # A body that is too large for the box has its ceiling as the only free height.
            low[2] = min(max(low[2], self.ground_z + radius), self.high[2])
        out = np.maximum(np.maximum(low - points, points - self.high), 0.0).max(axis=1)
        if len(self.radii):
            # gap: between the body's sphere and each obstacle's, negative where they overlap.
            gap = np.linalg.norm(points[:, None] - self.centres, axis=2) - self.radii - radius
            if skip is not None:
                gap[:, skip] = 0.0
            out = np.maximum(out, -gap.min(axis=1))
        return out

    def leg_is_free(self, a: np.ndarray, b: np.ndarray, radius: float) -> bool:
        """Return whether a body's sphere may move straight from ``a`` to ``b``. Where it starts outside free space (a
        body placed close to another: bounding spheres overlap), it only must not go deeper."""
        if np.any(np.maximum(self.low - b, b - self.high) > np.maximum(np.maximum(self.low - a, a - self.high), 0.0)):
            return False
        if self.ground_z is not None and b[2] < self.ground_z + radius and b[2] < a[2]:
            return False
        if not len(self.radii):
            return True
        limit = self.radii + radius
        leg = b - a
        # along: the place on the leg, 0 to 1, that is nearest to each obstacle's centre.
        along = np.clip((self.centres - a) @ leg / max(leg @ leg, 1e-300), 0.0, 1.0)
        nearest = np.linalg.norm(a + along[:, None] * leg - self.centres, axis=1)
        at_a = np.linalg.norm(a - self.centres, axis=1)
        # Clear of the obstacle all along, or already in it at ``a`` and never nearer to its centre than there.
        return bool(np.all((nearest >= limit) | ((at_a < limit) & (nearest >= at_a * (1 - 1e-12)))))


def random_path(
    rng: np.random.Generator,
    t0_ns: int,
    t1_ns: int,
    config: ObjectMotion,
    space: FreeSpace,
    radius: float,
    start_pose: ArrayLike,
    on_ground: bool = False,
) -> PosePath:
    """Return the motion of one object over [t0, t1].

    radius     : of its bounding sphere, kept clear of ``space``'s obstacles, which must not include the object itself.
    start_pose : (4, 4) T_world_obj at t0.
    on_ground  : it rests on the ground: its height is constant and it turns only about the world's vertical. Returns a
    StaticPath for ``kind: static``, with probability ``static_share``, and for zero speed and rate.
    """
    start = rigid(start_pose)
    still = rng.random() < config.static_share
    speed, rate = rng.uniform(*config.speed), math.radians(rng.uniform(*config.rotation_rate))
    if config.kind == "static" or still or (speed == 0 and rate == 0):
        return StaticPath(start, t0_ns, t1_ns)
    times, positions = waypoints(rng, t0_ns, t1_ns, config, space, radius, start[:3, 3], speed, flat=on_ground)
    times, positions = _refined(times, positions, rate)
    # Row 2 of the rotation is the world's vertical in the body's axes.
    turns = _random_turns(rng, config, rate, times, start[:3, :3].T[:, 2] if on_ground else None)
    path = KeyframePath(times, positions, _rotations(start[:3, :3], turns, times, t0_ns, t1_ns, rate))
    return _pausing(rng, config, path, t0_ns, t1_ns)


def random_camera_path(
    rng: np.random.Generator,
    t0_ns: int,
    t1_ns: int,
    config: CameraMotion,
    space: FreeSpace,
    radius: float,
    target: ArrayLike,
    start_pose: ArrayLike,
) -> PosePath:
    """Return the motion of the camera over [t0, t1], OpenCV axes.

    radius     : of the sphere around the camera centre that stays clear of obstacles (at least the near distance).
    target     : point (3,) to look at. The viewing direction stays within ``view_cone`` of it and the horizon within
                 ``roll`` at the waypoints, as far as the drawn angular rate allows.
    start_pose : (4, 4) T_world_cam at t0.
    """
    start = rigid(start_pose)
    speed, rate = rng.uniform(*config.speed), math.radians(rng.uniform(*config.rotation_rate))
    if config.kind == "static" or (speed == 0 and rate == 0 and config.shake == 0):
        return StaticPath(start, t0_ns, t1_ns)
    ahead = _heading(rng, config, start)
    times, positions = waypoints(rng, t0_ns, t1_ns, config, space, radius, start[:3, 3], speed, flat=False, ahead=ahead)
    times, positions = _refined(times, positions, rate)
    aims = np.asarray(target, np.float64).reshape(3) - positions
    turns = _camera_turns(rng, config, rate, times, start[:3, :3], aims)
    rotations = _rotations(start[:3, :3], turns, times, t0_ns, t1_ns, rate)
    if config.shake > 0:
        times, positions, rotations = _shaken(rng, config, times, positions, rotations)
    return _pausing(rng, config, KeyframePath(times, positions, rotations), t0_ns, t1_ns)


def _heading(rng, config: CameraMotion, start: np.ndarray) -> np.ndarray | None:
    """Return the camera's initial direction, (3,) unit; None: any, and nothing is drawn."""
    if config.heading == "any":
        return None
    # Columns of a camera's pose: 0 and 1 span the image plane, 2 is the viewing direction.
    if config.heading == "view":
        return start[:3, 2] * rng.choice([-1.0, 1.0])
    angle = rng.uniform(0, 2 * math.pi)
    return start[:3, 0] * math.cos(angle) + start[:3, 1] * math.sin(angle)


def _pausing(rng, config: MotionConfig, path: KeyframePath, t0_ns: int, t1_ns: int) -> PosePath:
    """Return the path with a pause in some cases. Nothing is drawn where pauses are off."""
    if config.pauses == 0 or rng.random() >= config.pauses:
        return path
    stop, share = rng.uniform(0.1, 0.8), rng.uniform(0.1, 0.5)
    span = t1_ns - t0_ns
    return PausedPath(path, t0_ns + round(stop * span), round(share * span), max(round(_RAMP * span), 1))


def look_rotation(direction: ArrayLike) -> np.ndarray:
    """Return R_world_cam, (3, 3) (OpenCV axes), looking along ``direction`` with a level horizon (world z up); for
    straight up or down the image's right is the world's +x."""
    z = np.asarray(direction, dtype=np.float64)
    length = np.linalg.norm(z)
    z = z / length if length > 1e-12 else np.array([0.0, 1.0, 0.0])
    x = np.cross(z, [0.0, 0.0, 1.0])
    n = np.linalg.norm(x)
    x = x / n if n > 1e-9 else np.array([1.0, 0.0, 0.0]) - z[0] * z
    x /= np.linalg.norm(x)
    # Columns are the image's right, its down and the viewing direction, a right-handed frame.
    return np.column_stack([x, np.cross(z, x), z])


def _turned(rng, config: MotionConfig, last: np.ndarray | None, flat: bool) -> np.ndarray:
    """Return the next direction: the last one and a random one, mixed by smoothness."""
    v = rng.normal(size=3)
    v /= np.linalg.norm(v)
    if last is not None:
        v = (1.0 - config.smoothness) * v + config.smoothness * last
    if flat:
        v[2] = 0.0
    n = np.linalg.norm(v)
    return v / n if n > 1e-9 else np.array([1.0, 0.0, 0.0])


def waypoints(
    rng: np.random.Generator,
    t0_ns: int,
    t1_ns: int,
    config: MotionConfig,
    space: FreeSpace,
    radius: float,
    start: np.ndarray,
    speed: float,
    flat: bool,
    ahead: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return times (K,) int64 and positions (K, 3), K >= 2, of a walk whose mean speed over [t0, t1] is ``speed``.
    ahead : (3,) unit initial direction, kept as far as ``smoothness`` says; None: any."""
    duration = (t1_ns - t0_ns) * 1e-9
    if duration <= 0:
        raise ValueError("a path needs t0_ns < t1_ns")
    count = config.points(duration)
    if speed == 0.0:
        times = np.linspace(0, t1_ns - t0_ns, count).round().astype(np.int64) + t0_ns
        return times, np.tile(start, (count, 1))
    if flat:
        # The height of a body on the ground is fixed, so only obstacles and the horizontal extent count.
        space = FreeSpace(
            np.r_[space.low[:2], -np.inf], np.r_[space.high[:2], np.inf], None, space.centres, space.radii
        )
    # Spheres that overlap at the start are ignored for a while, because the body must leave them first.
    entangled = np.linalg.norm(space.centres - start, axis=1) < space.radii + radius
    best, least = None, math.inf
    for _ in range(_REDRAWS):
        points = _walk(rng, config, space, radius, start, speed * duration, flat, count, ahead)
        times = _timed(points, t0_ns, t1_ns, speed)
        used = int(np.searchsorted(times, t1_ns)) + 1
        # The spline leaves its straight legs, so it is checked, too.
        curve = CubicSpline((times - t0_ns) * 1e-9, points)(np.linspace(0, duration, _SAMPLES * used))
        outside = space.depth(curve, radius, skip=entangled).max()
        if outside < least:
            best, least = (times, points), outside
        if outside <= 0.0:
            break
    assert best is not None
    return best


def _walk(rng, config, space, radius, start, length, flat, count, ahead) -> np.ndarray:
    """Return (K, 3) waypoints from ``start``, legs of about length / (count - 1), until ``length`` is covered."""
    leg = length / (count - 1)
    points, covered, direction = [start], 0.0, ahead
    # In a narrow space legs are halved and never cover the length; the walk ends after 16 times as many.
    while covered < length and len(points) <= 16 * count:
        step = leg * rng.uniform(0.6, 1.4)
        for attempt in range(4 * _TRIES):
            # No free direction: shorter legs, in any direction.
            direction = _turned(rng, config, direction if attempt < _TRIES else None, flat)
            reach = step * 0.5 ** (attempt // _TRIES)
            goal = points[-1] + reach * direction
            if space.leg_is_free(points[-1], goal, radius):
                points.append(goal)
                covered += reach
                break
        else:
            points.append(points[-1].copy())
    return np.array(points)


def _timed(points, t0_ns, t1_ns, speed) -> np.ndarray:
    """Return (K,) int64 times such that the cubic spline through ``points`` has mean speed ``speed`` over [t0, t1].

    Affine changes of the parameter do not change the curve, so only the scale has to be found. Parameter steps are
    proportional to the square root of the leg (centripetal parametrisation): no loops and cusps where legs differ.
    """
    legs = np.linalg.norm(np.diff(points, axis=0), axis=1)
    # A minimum step, because two waypoints in one place would give the spline a parameter step of 0.
    steps = np.sqrt(np.maximum(legs, 0.05 * max(legs.max(), 1e-12)))
    parameter = np.r_[0.0, np.cumsum(steps)]
    # Arc length by the midpoint rule, and the parameter (``at``) at which each length is reached.
    middle = (parameter[:-1, None] + steps[:, None] * (np.arange(_SAMPLES) + 0.5) / _SAMPLES).ravel()
    rate = np.linalg.norm(CubicSpline(parameter, points)(middle, 1), axis=1)
    arc = np.r_[0.0, np.cumsum(rate * np.repeat(steps, _SAMPLES) / _SAMPLES)]
    at = np.r_[0.0, np.cumsum(np.repeat(steps, _SAMPLES) / _SAMPLES)]
    duration = (t1_ns - t0_ns) * 1e-9
    end = np.interp(speed * duration, arc, at)  # a body that found no free direction is slower than configured
    times = np.rint(parameter * ((t1_ns - t0_ns) / end)).astype(np.int64)
    # Rounded times of very short legs may coincide: each is at least a nanosecond after the previous one.
    # Subtracting 0, 1, 2, … turns "at least one more than the last" into a running maximum.
    order = np.arange(len(times))
    return np.maximum.accumulate(times - order) + order + t0_ns


def _split(times: np.ndarray, parts: int) -> np.ndarray:
    """Return (K,) int64 times with each interval divided into ``parts`` equal ones."""
    share = np.arange(parts) / parts
    inner = times[:-1, None] + np.rint(np.diff(times)[:, None] * share).astype(np.int64)
    return np.unique(np.r_[inner.ravel(), times[-1]])


def _seconds(times: np.ndarray) -> np.ndarray:
    return (times - times[0]) * 1e-9


def _resampled(times, positions, parts):
    """Return the same curve with more knots: a spline through samples at a superset of its knots is the spline
    itself."""
    finer = _split(times, parts)
    return finer, CubicSpline(_seconds(times), positions)((finer - times[0]) * 1e-9)


def _refined(times, positions, rate):
    # 1.4 is the largest factor on a drawn turn, see _random_turns and _camera_turns.
    parts = math.ceil(1.4 * rate * np.diff(times).max() * 1e-9 / _MAX_TURN)
    return _resampled(times, positions, parts) if parts > 1 else (times, positions)


def _random_turns(rng, config, rate, times, vertical) -> np.ndarray:
    """Return rotation vectors in the body frame from key frame to key frame, (K-1, 3), about ``vertical`` (body frame)
    if given."""
    angles = rate * np.diff(times) * 1e-9 * rng.uniform(0.6, 1.4, len(times) - 1)
    if vertical is not None:
        # One sign for all turns, so that they do not undo each other.
        return angles[:, None] * vertical * rng.choice([-1.0, 1.0])
    axes, axis = [], None
    for _ in angles:
        axis = _turned(rng, config, axis, False)
        axes.append(axis)
    return angles[:, None] * np.array(axes)


def _camera_turns(rng, config, rate, times, R, aims) -> np.ndarray:
    """Return turns as :func:`_random_turns`; each is the first of some random ones that keeps target and horizon in
    bounds, or else the best one (including turning straight to the target)."""
    cone, roll = math.radians(config.view_cone), math.radians(config.roll)
    turns, axis = [], None
    for k, dt in enumerate(np.diff(times) * 1e-9):
        angle = rate * dt * rng.uniform(0.6, 1.4)
        # All are drawn even if an early one fits: the number of draws must not depend on the geometry.
        tries = [angle * _turned(rng, config, axis, False) for _ in range(16)]
        home = Rotation.from_matrix(R.T @ look_rotation(aims[k + 1])).as_rotvec()
        tries.append(home * min(1.0, angle / max(float(np.linalg.norm(home)), 1e-12)))
        ends = R @ Rotation.from_rotvec(tries).as_matrix()
        towards = aims[k + 1] / max(float(np.linalg.norm(aims[k + 1])), 1e-12)
        # ends[:, :, 2] are viewing directions; ends[:, 2, 0] are the heights of the image's right, 0 for
        # a level horizon.
        off_target = np.arccos(np.clip(ends[:, :, 2] @ towards, -1.0, 1.0)) - cone
        off_level = np.arcsin(np.clip(np.abs(ends[:, 2, 0]), 0.0, 1.0)) - roll
        excess = np.maximum(off_target, 0.0) + np.maximum(off_level, 0.0)
        chosen = int(np.argmin(excess))  # the first zero, if there is one
        turns.append(tries[chosen])
        size = np.linalg.norm(tries[chosen])
        axis = tries[chosen] / size if size > 0 else None
        R = ends[chosen]
    return np.array(turns)


def _chained(R: np.ndarray, turns: np.ndarray) -> Rotation:
    steps = Rotation.from_rotvec(turns).as_matrix()
    return Rotation.from_matrix(np.array([*accumulate(steps, np.matmul, initial=R)]))


def _rotations(R, turns, times, t0_ns, t1_ns, rate) -> Rotation:
    """Return key rotations from ``R`` by ``turns``, all scaled so that the spline's mean angular rate over [t0, t1] is
    ``rate`` (to 0.1 %, unless turns would exceed 150 degrees)."""
    if rate == 0.0 or not turns.any():
        return _chained(R, 0.0 * turns)
    # 2.6 rad, 149 degrees: well below pi, where the way from one rotation to the next becomes ambiguous.
    most = 2.6 / np.linalg.norm(turns, axis=1).max()
    middle = (np.arange(_SAMPLES * len(times)) + 0.5) / (_SAMPLES * len(times)) * ((t1_ns - t0_ns) * 1e-9)
    factor = min(0.9, most)  # a spline turns more than its key frames
    # A fixed-point iteration: the mean rate is nearly proportional to the factor.
    for _ in range(5):
        rotations = _chained(R, factor * turns)
        mean = float(np.linalg.norm(RotationSpline(_seconds(times), rotations)(middle, 1), axis=1).mean())
        if abs(mean / rate - 1.0) < 1e-3 or mean == 0.0:
            break
        factor = min(factor * rate / mean, most)
    return rotations


def _shaken(rng, config, times, positions, rotations):
    # At least ``shake_rate`` key frames per second, each with a turn of its own.
    parts = math.ceil(np.diff(times).max() * 1e-9 * config.shake_rate)
    finer, moved = _resampled(times, positions, parts) if parts > 1 else (times, positions)
    smooth = RotationSpline(_seconds(times), rotations)((finer - times[0]) * 1e-9)
    noise = rng.normal(scale=math.radians(config.shake), size=(len(finer), 3))
    noise[0] = 0.0  # the pose at t0 is the caller's
    return finer, moved, smooth * Rotation.from_rotvec(noise)
