"""Poses and motions of bodies and cameras in Python."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Literal, TypeVar, get_origin

import numpy as np
from numpy.typing import ArrayLike

from blinkgl.config.base import Config, placed
from blinkgl.config.poses import KeyedMotionConfig, PoseConfig, TrajectoryConfig, check_rigid, rigid_matrix
from blinkgl.config.problems import validate
from blinkgl.errors import ConfigError
from blinkgl.front import arguments as check
from blinkgl.types.trees import Tree

Vector = Sequence[float] | np.ndarray
P = TypeVar("P", bound="Piece")


class Piece:
    """A value that is checked at creation. ``tree``: itself as plain data, as in the YAML."""

    tree: Tree
    _called: ClassVar[Mapping[str, str]] = {}
    """Arguments of the model's keys that have other names; "": the keys' own names."""

    def __init_subclass__(cls) -> None:
        if "__init__" in vars(cls):
            cls.__init__ = check.public()(cls.__init__)

    def _checked(self, model: type[Config], tree: dict[str, object], **renamed: str) -> Tree:
        """Return ``tree`` unchanged if the model accepts it. renamed : further names, as of :attr:`_called`."""
        names = {**self._called, **renamed}

        def called(where: str) -> str:
            first, *rest = where.split(".")
            at = [step for step in (names.get(first, first), *rest) if step not in ("", "config")]
            return ".".join([type(self).__name__, *at])

        with placed(called):
            validate(model, tree)
        return tree

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{k}={v!r}' for k, v in self.tree.items())})"


def signed_by(model: type[Config], **called: str) -> Callable[[type[P]], type[P]]:
    """Give a class whose constructor takes ``**keys`` of a model a signature that shows them, for help() and editors.

    called : argument names of the model's keys."""

    def sign(kind: type[P]) -> type[P]:
        kind._called = called  # noqa: SLF001 - of the class that it decorates
        own = [p for p in inspect.signature(kind.__init__).parameters.values() if p.name not in ("self", "keys")]
        there = {parameter.name for parameter in own}
        more = [
            inspect.Parameter(
                called.get(key, key),
                inspect.Parameter.KEYWORD_ONLY,
                default=field.get_default(call_default_factory=True),
                annotation=Vector if get_origin(field.annotation) is tuple else field.annotation,
            )
            for key, field in model.model_fields.items()
            if called.get(key, key) not in there
        ]
        kind.__signature__ = inspect.Signature([*own, *more])  # ty: ignore
        return kind

    return sign


class Pose(Piece):
    """Position and orientation of a body or a camera; give at most one form of the orientation.

    position : (3,) m.   euler : (3,) degrees about the world's x, then y, then z.   quaternion : (4,) w, x, y, z.
    look_at : (3,) m, the point towards which a camera's z axis, or a body's x axis, is turned. A camera's axes are x
    right, y down, z forward; without orientation it looks along +x with z up.
    Raises ConfigError."""

    def __init__(
        self,
        position: Vector = (0.0, 0.0, 0.0),
        *,
        euler: Vector | None = None,
        quaternion: Vector | None = None,
        look_at: Vector | None = None,
    ):
        self.tree = self._checked(
            PoseConfig, check.given(position=position, euler=euler, quaternion=quaternion, look_at=look_at)
        )

    @classmethod
    def from_matrix(cls, T: ArrayLike, where: str = "Pose.from_matrix") -> Pose:
        """Return the pose of T_world_body or T_world_cam, (4, 4): from the body's axes to the world's, z up; a camera's
        are x right, y down, z forward. Raises ConfigError: not rigid."""
        matrix = check.array(T, where, (4, 4), "an array (4, 4)")
        if not np.isfinite(matrix).all():
            raise ConfigError("holds NaN or infinity", where=where, value=np.round(matrix, 6).tolist())
        with placed(where):
            check_rigid(check.plain(matrix), where)
        from scipy.spatial.transform import Rotation

        x, y, z, w = Rotation.from_matrix(rigid_matrix(matrix)[:3, :3]).as_quat()
        return cls(matrix[:3, 3], quaternion=(w, x, y, z))


@check.public()
def look_at(position: Vector, target: Vector) -> Pose:
    """Return a :class:`Pose` at ``position`` (3,) m, turned to the point ``target`` (3,) m; a camera's
    horizon is level. Raises ConfigError."""
    return Pose(position, look_at=target)


class Keyframes(Piece):
    """A motion through poses: ``Keyframes({0.0: Pose(…), 1.5: Pose(…)})``, constant before
    the first time and after the last.

    poses : time in s -> :class:`Pose`, two or more; from one to the next less than half a turn.
    interpolation : "spline" (twice continuously differentiable) or "linear" (straight lines and slerp). Raises
    ConfigError."""

    def __init__(self, poses: Mapping[float, Pose], interpolation: Literal["spline", "linear"] = "spline"):
        check.one_of(poses, "Keyframes.poses", Mapping, "a table of times and poses")
        for time, pose in poses.items():
            check.number(time, "Keyframes.poses")
            check.one_of(pose, f"Keyframes.poses[{time}]", Pose, "a Pose, as look_at makes one")
        frames = [{"time": check.plain(time), **poses[time].tree} for time in sorted(poses)]
        if not frames:
            raise ConfigError("too few entries", where="Keyframes.poses", value=poses, accepted="two or more poses")
        self.tree = self._checked(
            KeyedMotionConfig, {"keyframes": frames, "interpolation": check.plain(interpolation)}, keyframes="poses"
        )

    @classmethod
    def from_arrays(
        cls, times_s: ArrayLike, T: ArrayLike, *, interpolation: Literal["spline", "linear"] = "spline"
    ) -> Keyframes:
        """Return the motion through poses at times_s, (N,) s, increasing: T is (N, 4, 4), each as of
        :meth:`Pose.from_matrix`. Raises ConfigError."""
        times = check.array(times_s, "Keyframes.from_arrays.times_s", (None,), "an array (N,), s")
        poses = check.array(T, "Keyframes.from_arrays.T", (len(times), 4, 4), f"an array ({len(times)}, 4, 4)")
        # Compared, not subtracted: unsigned numbers would wrap.
        if not (times[1:] > times[:-1]).all():
            raise ConfigError(
                "times do not increase",
                where="Keyframes.from_arrays.times_s",
                value=times[:3].tolist(),
                accepted="s, in order",
            )
        made = (Pose.from_matrix(pose, f"Keyframes.from_arrays.T[{k}]") for k, pose in enumerate(poses))
        return cls(dict(zip(times.tolist(), made, strict=True)), interpolation=interpolation)


@signed_by(TrajectoryConfig)
class Trajectory(Piece):
    """A motion from a file by a spline: ``Camera(pose=Trajectory("flight.txt"))``.

    file : path.   form, columns, time_unit, maps_from, axes, rate : what the file does not say, as of
    :func:`blinkgl.read_trajectory`.   start : time on the file's clock, s,
    of 0 s on the scene's; None: the sequence begins at the first pose.   smooth : s, each pose becomes the mean of
    those within it.   speed_limit : units/s, turn_limit : degrees/s, beyond which poses are refused.
    T_body_sensor : pose of the camera or body of this motion on the body of the file's poses: (4, 4), or the path of
    EuRoC's sensor.yaml, whose T_BS it is; None: the same body.
    Raises ConfigError; a file that does not cover the sequence raises when the scene is built."""

    def __init__(
        self,
        file: str | os.PathLike,
        *,
        T_body_sensor: ArrayLike | str | os.PathLike | None = None,
        **keys: object,
    ):
        there = check.path(file, "Trajectory.file").expanduser().absolute()
        tree = check.given(file=there, **keys)
        if isinstance(T_body_sensor, (str, os.PathLike)):
            tree["T_body_sensor"] = os.fspath(
                check.path(T_body_sensor, "Trajectory.T_body_sensor").expanduser().absolute()
            )
        elif T_body_sensor is not None:
            place = check.array(T_body_sensor, "Trajectory.T_body_sensor", (4, 4), "a file, or an array (4, 4)")
            tree["T_body_sensor"] = check.plain(place)
        self.tree = self._checked(KeyedMotionConfig, {"trajectory": tree}, trajectory="")
        check.existing(there, "Trajectory.file")


def motion_tree(pose: Pose | Keyframes | Trajectory | Vector, where: str, others: str = "") -> Tree:
    """Return the table of a motion; a position alone is a pose. others : other accepted values, for the message."""
    if isinstance(pose, (Pose, Keyframes, Trajectory)):
        return pose.tree
    if np.shape(pose) == (4, 4):
        raise ConfigError("a matrix", where=where, value=pose, accepted="Pose.from_matrix(T)")
    check.one_of(
        pose, where, (list, tuple, np.ndarray), f"a Pose, Keyframes, Trajectory, {others}or a position of three numbers"
    )
    return Pose(pose).tree
