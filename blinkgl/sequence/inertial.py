"""Measurements of an inertial unit on the camera: body rate and specific force from the path, with noise and biases.

    rate = w + b_g + n_g          acceleration = R^T (a - g) + b_a + n_a

at the unit's own position, so that its distance from the camera (lever arm) is included in a. w comes from the path's
analytic derivative; a is the central difference of the analytic velocity over 40 µs, which is exact where the velocity
is quadratic, as a spline's is between its knots.

White noise of density s is sampled with standard deviation s sqrt(rate); a bias of random walk density s changes by s /
sqrt(rate) from one measurement to the next (Kalibr's model; Woodman 2007; Crassidis 2006).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.config.over_time import ImuConfig, imu_times
from blinkgl.errors import ConfigError
from blinkgl.scene.motion.paths import OffsetPath
from blinkgl.scene.motion.pose_path import PosePath
from blinkgl.types.poses import pose_of

# Half of the time over which velocities are differenced.
_HALF_NS = 20_000
# Spacing of the times at which the velocity is searched for jumps, and the largest number of them.
_LOOK_NS = 1_000_000
_MOST_LOOKS = 200_000


@dataclass(frozen=True, eq=False)
class Inertial:
    """Measurements of an inertial unit, in its own axes.

    t_ns : (N,) int64.   rate : (N, 3) float64 rad/s.   acceleration : (N, 3) float64 m/s², at rest that of free fall,
    upwards.   ideal_rate, ideal_acceleration : the same without noise and bias.   rate_bias, acceleration_bias : (N, 3)
    included biases.   T_cam_imu : (4, 4) float64, from the unit's axes to the camera's."""

    t_ns: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray
    ideal_rate: np.ndarray
    ideal_acceleration: np.ndarray
    rate_bias: np.ndarray
    acceleration_bias: np.ndarray
    T_cam_imu: np.ndarray


def place_of(config: ImuConfig) -> np.ndarray:
    """Return T_cam_imu, (4, 4)."""
    return pose_of(config.position, Rotation.from_euler("xyz", config.rotation, degrees=True).as_matrix())


def measured(path: PosePath, config: ImuConfig, t0_ns: int, t1_ns: int, rng: np.random.Generator) -> Inertial:
    """Return the unit's measurements over [t0, t1] on a camera that moves by ``path``, T_world_cam.

    Raises ConfigError where the camera's velocity jumps, which gives infinite acceleration."""
    T_cam_imu = place_of(config)
    body = OffsetPath(path, T_cam_imu)
    times = imu_times(config.rate, t0_ns, t1_ns)
    rate, force = _ideal(body, times, np.asarray(config.gravity))
    if not path.is_static:
        _refuse_jumps(body, t0_ns, t1_ns)
    n, dt = len(times), 1 / config.rate
    white, walk = rng.normal(size=(2, n, 3)), rng.normal(size=(2, n, 3))
    # No time has passed before the first measurement, so its bias has not walked.
    walk[:, 0] = 0
    # + 0.0: without a walk there are no negative zeros, which are other bytes.
    bias_w = config.gyroscope_random_walk * np.sqrt(dt) * np.cumsum(walk[0], 0) + 0.0
    bias_a = config.accelerometer_random_walk * np.sqrt(dt) * np.cumsum(walk[1], 0) + 0.0
    return Inertial(
        t_ns=np.array(times, np.int64),
        rate=rate + bias_w + config.gyroscope_noise_density / np.sqrt(dt) * white[0],
        acceleration=force + bias_a + config.accelerometer_noise_density / np.sqrt(dt) * white[1],
        ideal_rate=rate,
        ideal_acceleration=force,
        rate_bias=bias_w,
        acceleration_bias=bias_a,
        T_cam_imu=T_cam_imu,
    )


def _ideal(body: PosePath, times: list[int], gravity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return body rates, (N, 3), and specific forces, (N, 3), of a body, its own axes."""
    R_body_world = body.poses(np.array(times, np.int64))[:, :3, :3].swapaxes(1, 2)
    if body.is_static:
        return np.zeros((len(times), 3)), R_body_world @ -gravity
    turning = R_body_world @ np.array([body.derivative(t)[:3, :3] for t in times])
    # R^T R' is the skew matrix of the body rate, but for rounding; its entries 21, 02 and 10 are x, y and z.
    twist = 0.5 * (turning - turning.swapaxes(1, 2))
    second = np.array([_second(body, t)[:3, 3] for t in times])
    rate = np.stack([twist[:, 2, 1], twist[:, 0, 2], twist[:, 1, 0]], axis=1)
    # An accelerometer at rest measures the force that holds it, minus gravity.
    return rate, np.einsum("nij,nj->ni", R_body_world, second - gravity)


def _second(path: PosePath, t_ns: int) -> np.ndarray:
    """Return the second derivative, (4, 4), 1/s², one-sided at the ends of the path."""
    h, seconds = _HALF_NS, _HALF_NS * 1e-9
    # Beyond its ends a path stands still; within so short a one there is no room for the difference.
    if not path.t0_ns <= t_ns <= path.t1_ns or path.t1_ns - path.t0_ns < 2 * h:
        return np.zeros((4, 4))
    if t_ns - h < path.t0_ns or t_ns + h > path.t1_ns:
        sign = 1 if t_ns - h < path.t0_ns else -1
        # The one-sided difference of second order.
        a, b, c = (path.derivative(t_ns + sign * k * h) for k in (0, 1, 2))
        return sign * (-3 * a + 4 * b - c) / (2 * seconds)
    return (path.derivative(t_ns + h) - path.derivative(t_ns - h)) / (2 * seconds)


def _refuse_jumps(path: PosePath, t0_ns: int, t1_ns: int) -> None:
    """Raise ConfigError where the velocity changes by more than its rate of change explains."""
    begin, end = max(t0_ns, path.t0_ns), min(t1_ns, path.t1_ns)
    step = max(_LOOK_NS, (end - begin) // _MOST_LOOKS)
    times = range(begin, end + 1, step)
    first = np.array([path.derivative(t)[:3] for t in times])
    second = np.array([_second(path, t)[:3] for t in times])
    if len(first) < 2:
        return
    # The change of velocity that the accelerations at both ends explain, by the trapezoidal rule.
    change = 0.5e-9 * step * (second[1:] + second[:-1])
    left = np.abs(first[1:] - first[:-1] - change).max(axis=(1, 2))
    # a smooth curve leaves a third-order remainder; a jump does not
    allowed = 2e-3 * np.abs(first).max() + 0.25 * np.abs(change).max(axis=(1, 2))
    if (left > allowed).any():
        at = int(np.argmax(left - allowed))
        raise ConfigError(
            "the camera's velocity jumps, so its acceleration is infinite",
            where="imu",
            value=f"at {times[at] * 1e-9:.6g} s",
            accepted="a camera path with `interpolation: spline`, or imu: null",
        )
