"""Positions and orientations of bodies and cameras: poses, key frames, trajectory files, ways."""

from __future__ import annotations

import itertools
from typing import Literal

import numpy as np
from pydantic import Field

from blinkgl.config.base import Config, Refused, at_most_one, rule
from blinkgl.config.values import (
    Fraction,
    Position,
    Vector3,
)

# ---------------------------------------------------------------------------------------------------------------------
# A rigid transform as four rows of four numbers.

_Row = tuple[float, float, float, float]
Matrix = tuple[_Row, _Row, _Row, _Row]
_RIGID = 1e-4


def check_rigid(matrix: object, where: str) -> None:
    """Raise Refused for (4, 4) numbers that are not a rotation and a translation, apart from rounding."""
    T = np.array(matrix, np.float64)
    R = T[:3, :3]
    if not np.abs(T[3] - [0, 0, 0, 1]).max() < 1e-9:
        raise Refused("the last row of a pose is not 0, 0, 0, 1", where=where, value=T[3].tolist())
    orthogonal = np.abs(R @ R.T - np.eye(3)).max() < _RIGID
    if not (orthogonal and np.linalg.det(R) > 0):
        raise Refused(
            "the matrix contains a reflection" if orthogonal else "the matrix is no rotation",
            where=where,
            value=np.round(R, 6).tolist(),
            accepted=f"R Rᵀ = 1 to {_RIGID:g} and determinant +1",
        )


def are_rigid(matrices: np.ndarray) -> np.ndarray:
    """Return (N,) bool: which of (N, 4, 4) numbers :func:`check_rigid` accepts, and are finite."""
    T = np.asarray(matrices, np.float64)
    R, last = T[:, :3, :3], np.abs(T[:, 3] - [0, 0, 0, 1]).max(axis=1, initial=0)
    off = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2), initial=0)
    return np.isfinite(T).all(axis=(1, 2)) & (last < 1e-9) & (off < _RIGID) & (np.linalg.det(R) > 0)


def rigid_matrix(matrix: object) -> np.ndarray:
    """Return a valid matrix (:func:`check_rigid`) as (4, 4) float64 with its rounded rotation made exact."""
    T = np.array(matrix, np.float64)
    u, _, v = np.linalg.svd(T[:3, :3])
    nearest = u @ v
    if np.abs(nearest - T[:3, :3]).max() > 1e-12:
        T[:3, :3] = nearest
    T[3] = [0, 0, 0, 1]
    return T


@rule("quaternion")
def some_rotation(quaternion: tuple[float, ...] | None) -> None:
    """A rule of the key ``quaternion``."""
    if quaternion is not None and sum(q * q for q in quaternion) < 1e-12:
        raise Refused("a quaternion must not be zero", where="quaternion", value=list(quaternion))


class PoseConfig(Config):
    """A position, and at most one kind of orientation: of a body's own axes, or of a camera's as OpenCV has them (x
    right, y down, z forward). Without one a body is not turned, and a camera looks along +x with z up."""

    position: Position = Field((0.0, 0.0, 0.0), description="m")
    quaternion: tuple[float, float, float, float] | None = Field(
        None, description="[w, x, y, z], normalised automatically"
    )
    euler: Vector3 | None = Field(None, description="degrees about the fixed x, y, z axes, applied in this order")
    look_at: Position | None = Field(
        None, description="point at which the camera's z axis, or an object's x axis, points"
    )

    _one_orientation = at_most_one("quaternion", "euler", "look_at")
    _some_rotation = some_rotation

    @rule("look_at", "position")
    def _some_direction(look_at, position):
        # Nearer than that, rounding would decide the direction.
        if look_at is not None and max(abs(a - b) for a, b in zip(look_at, position)) < 1e-9:
            raise Refused("must differ from the position", where="look_at", value=list(look_at))


class KeyframeConfig(PoseConfig):
    """A pose at a time."""

    time: float = Field(
        ge=-1e7, le=1e7, description="s on the sequence's clock (first label: time.start + 1 / label_rate)"
    )


class TrajectoryConfig(Config):
    """Poses from a file, connected by a C2 spline: T_world_body, of a camera with OpenCV's axes. The file must cover
    the sequence (docs/labels.md)."""

    file: str = Field(description="a table of poses (TUM, EuRoC, ESIM …), KITTI's, COLMAP's images.txt, NeRF's JSON")
    form: Literal["auto", "tum", "euroc", "orbslam", "kitti", "tartanair", "colmap", "nerf"] = Field(
        "auto", description="auto: by the heading, else by a known layout, with a note"
    )
    columns: str | None = Field(None, description="names of the columns, such as `t x y z qw qx qy qz`; `-`: left out")
    time_unit: Literal["s", "ms", "us", "ns"] | None = Field(
        None,
        description="of the file's times; null: the heading's, else the form's",
    )
    maps_from: Literal["camera", "world"] | None = Field(
        None, description="world: poses map the world to the camera; null: the form's (colmap: world)"
    )
    axes: Literal["opencv", "opengl", "ned"] | None = Field(
        None, description="of the camera in the file; null: the form's (nerf: opengl, tartanair: ned)"
    )
    rate: float | None = Field(None, gt=0, le=1e6, description="poses per second of a file without times")
    start: float | None = Field(
        None,
        ge=-1e10,
        le=1e10,
        description="time on the file's clock, s, that is 0 s of the sequence; null: the first pose is at time.start",
    )
    smooth: float = Field(
        0.0,
        ge=0,
        le=60,
        description="averages the poses within this time around each, s, with triangular weights",
    )
    speed_limit: float = Field(
        100.0,
        gt=0,
        le=1e9,
        description="largest speed between poses, world units/s; a higher one is refused",
    )
    turn_limit: float = Field(
        7200.0,
        gt=0,
        le=1e9,
        description="largest turning rate between poses, degrees/s; a higher one is refused",
    )
    T_body_sensor: str | Matrix | None = Field(
        None,
        description="if the file describes another body: the transform from this body's axes to that one's, or "
        "EuRoC's sensor.yaml (T_BS)",
    )

    @rule("T_body_sensor")
    def _a_place(place):
        if place is not None and not isinstance(place, str):
            check_rigid(place, "T_body_sensor")


class KeyedMotionConfig(PoseConfig):
    """A fixed pose, key frames, or a trajectory from a file. The first pose holds before its time, the last after it.
    Between key frames a body turns the shortest way (for ``spline``: near it), by less than 180 degrees."""

    keyframes: tuple[KeyframeConfig, ...] = Field((), description="two or more poses with increasing times")
    interpolation: Literal["spline", "linear"] = Field(
        "spline", description="between key frames: C2 spline, or straight lines and slerp"
    )

    trajectory: TrajectoryConfig | None = Field(None, description="poses from a file, instead of a pose or key frames")

    @rule("?trajectory", "#keyframes", "position", "quaternion", "euler", "look_at")
    def _one_source(trajectory, keyframes, position, *orientation):
        if trajectory and (keyframes or any(position) or any(o is not None for o in orientation)):
            raise Refused("give a trajectory, a fixed pose or keyframes, not several of them", where="trajectory")

    @rule("keyframes.*.time")
    def _in_order(times: tuple[float, ...]):
        if len(times) == 1:
            raise Refused("one key frame is not enough; give two or more, or a fixed pose", where="keyframes")
        for k, (before, after) in enumerate(itertools.pairwise(times)):
            # In whole nanoseconds: 4e-6 - 3e-6 is a little less than 1e-6.
            if round(1e9 * after) - round(1e9 * before) < 1000:
                raise Refused(
                    "the key frames' times must increase by at least 1e-6 s",
                    where=f"keyframes.{k + 1}.time",
                    value=after,
                )

    @rule("#keyframes", "position", "quaternion", "euler", "look_at")
    def _pose_or_keyframes(keyframes, position, *orientation):
        if keyframes and (any(position) or any(o is not None for o in orientation)):
            raise Refused("give a fixed pose or keyframes, not both")

    @rule("keyframes.*.euler", "keyframes.*.quaternion", "keyframes.*.look_at")
    def _shortest_turns(eulers: tuple, quaternions: tuple, look_ats: tuple):
        # Between poses the body turns the shortest way: half a turn has none, and more would turn back.
        otherwise = [q is not None or at is not None for q, at in zip(quaternions, look_ats)]
        for k in range(len(eulers) - 1):
            if otherwise[k] or otherwise[k + 1]:
                continue
            steps = [abs(v - u) for u, v in zip(eulers[k] or (0, 0, 0), eulers[k + 1] or (0, 0, 0))]
            if max(steps) >= 180:
                raise Refused(
                    f"euler changes by {max(steps):g} degrees about {'xyz'[steps.index(max(steps))]} from key frame "
                    f"{k} to {k + 1}; it must be less than 180 (add key frames in between)"
                )


class WayConfig(Config):
    """A curve that a body follows at constant speed, its x axis forward; beyond an open end it goes straight on."""

    points: tuple[Position, ...] = Field(description="two or more, m; a smooth curve passes through all")
    speed: float | None = Field(
        None,
        gt=0,
        le=1e4,
        description="m/s; null: 1, of a figure or fish that of its motion",
    )
    closed: bool = Field(False, description="back to the first point, repeatedly")
    level: bool = Field(True, description="true: its z axis stays up; false: its x axis follows the slope")
    start: Fraction = Field(0.0, description="fraction of the way that it has covered at time 0")

    @rule("#points", "closed")
    def _a_way(points, closed):
        least, count = (3 if closed else 2), len([*points])
        if count < least:
            raise Refused(f"a way needs at least {least} points", where="points", value=count)
