"""Rigs in Python: the parts of ``sensors:``, checked by the same models.

    rig = Rig(
        RigSensor("left", camera=Camera(640, 480, fov=70), pair="right"),
        RigSensor("right", camera=Camera(640, 480, fov=70), pair="left", position=(0.1, 0, 0)),
        RigSensor("imu", imu="adis16448", position=(0.05, 0.02, 0)),
    )

The pose of the :class:`~blinkgl.front.scenes.Scene`'s camera is the rig's, and this camera also gives the keys that a
sensor's camera does not set.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

from numpy.typing import ArrayLike

from blinkgl.config.base import Config, placed
from blinkgl.config.camera import CameraConfig
from blinkgl.config.readout import ReadoutConfig
from blinkgl.config.rig import PlaceConfig, RigSensorConfig, spelled_out
from blinkgl.errors import ConfigError
from blinkgl.front import arguments as check
from blinkgl.front.poses import Piece, Vector
from blinkgl.front.scenes import Camera
from blinkgl.front.sections import Section, sections


class RigSensor(Piece):
    """One device on a rig: an event camera, a frame camera, an inertial unit, or several of them behind one lens.

    name : of its folder and of its part of a recording.
    position : (3,) m on the rig's axes, x right, y down, z forward.   euler : (3,) degrees about the rig's x, y, z
    axes; or quaternion : (4,) w, x, y, z; or matrix : (4, 4) T_rig_sensor, from the sensor's axes to the rig's, instead
    of all of them.
    pair : name of the other eye of a rectified stereo pair.
    camera : :class:`Camera` without a pose, or a table of ``camera:`` over the scene's; None: the scene's.
    events : whether it makes events; None: if it has neither images nor imu.
    emulator, sensor, labels, images, imu, tracks : as of :func:`record`; None: emulator, sensor and labels of the run,
    and none of the others.   readout : a table of ``readout:``.
    Raises ConfigError."""

    def __init__(
        self,
        name: str,
        *,
        position: Vector = (0.0, 0.0, 0.0),
        euler: Vector | None = None,
        quaternion: Vector | None = None,
        matrix: ArrayLike | None = None,
        pair: str | None = None,
        camera: Camera | Mapping[str, Any] | None = None,
        events: bool | None = None,
        emulator: Section | None = None,
        sensor: str | os.PathLike | None = None,
        readout: Mapping[str, Any] | Config | None = None,
        labels: Sequence[str | float] | None = None,
        images: Section | None = None,
        imu: Section | None = None,
        tracks: Section | None = None,
    ):
        if matrix is not None:
            matrix = check.array(matrix, "RigSensor.matrix", (4, 4), "an array (4, 4) of numbers, T_rig_sensor")
        place = check.given(position=position, euler=euler, quaternion=quaternion, matrix=matrix)
        arguments = dict(emulator=emulator, sensor=sensor, labels=labels, images=images, imu=imu, tracks=tracks)
        tree = {**check.given(name=name, pair=pair), **sections(arguments)}
        tree["place"] = self._checked(PlaceConfig, place)
        if camera is not None:
            tree["camera"] = _camera_tree(camera)
        if events is not None:
            check.one_of(events, "RigSensor.events", bool, "True, False or None")
            if emulator is not None and not events:
                raise ConfigError("the sensor has no events", where="RigSensor.emulator", value=emulator)
            tree.setdefault("events", {} if events else None)
        if readout is not None:
            table = readout.model_dump(exclude_unset=True) if isinstance(readout, Config) else readout
            check.one_of(table, "RigSensor.readout", Mapping, "a table of readout:")
            tree["readout"] = self._checked(ReadoutConfig, check.given(**table))
        complete = {key: value for key, value in tree.items() if key not in ("events", "sensor", "camera")}
        self._checked(RigSensorConfig, complete)  # these three are complete after merging with the run's
        self.tree = tree


def _camera_tree(camera: Camera | Mapping[str, object]) -> dict[str, object]:
    """Return all keys of a Camera, so that none of the run's camera is merged into it; only the given ones of a
    table."""
    if isinstance(camera, Mapping):
        return check.given(**camera)
    check.one_of(camera, "RigSensor.camera", Camera, "a Camera, or a table such as {'fov': 80}")
    if camera.motion != Camera(1, 1).motion:
        raise ConfigError(
            "a sensor moves with its rig and cannot have its own pose",
            where="RigSensor.camera",
            value=camera,
            accepted="position, euler, quaternion or matrix of the RigSensor",
        )
    return {**CameraConfig().model_dump(mode="json"), **camera.tree}


class Rig(Piece):
    """Sensors that move together: ``record(scene, Rig(RigSensor("left"), RigSensor("imu", imu="adis16448")))``.

    sensors : :class:`RigSensor`, with different names.   preset : "stereo", "davis", "dsec" or "mvsec": its sensors
    come first, changed by those of ``sensors`` with the same names (docs/rigs.md).
    Raises ConfigError; what depends on the scene's camera is checked when the rig is used."""

    def __init__(self, *sensors: RigSensor, preset: str | None = None):
        for k, one in enumerate(sensors):
            check.one_of(one, f"Rig.sensors[{k}]", RigSensor, "a RigSensor")
        self.sensors = sensors
        # both keys: a rig replaces the one of a configuration
        self.tree = {"rig": check.plain(preset), "sensors": [one.tree for one in sensors]}
        with placed(lambda where: "Rig.preset" if where == "rig" else f"Rig.{where}"):
            spelled_out(self.tree, ())

    def __repr__(self) -> str:
        return f"<Rig of {', '.join([*([self.tree['rig']] if self.tree['rig'] else []), *self.names])}>"

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of ``sensors``; a preset has further ones."""
        return tuple(one.tree["name"] for one in self.sensors)
