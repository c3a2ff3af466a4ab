"""What looks at a scene: sensors, each at its place on one rig that moves.

A :class:`Sensor` is a device on the rig; the data sheet of a camera that one can buy, which ``sensor:`` of a
configuration names, is :class:`blinkgl.config.sensor.SensorConfig`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.config.events import EmulatorConfig
from blinkgl.config.labels import LabelsConfig
from blinkgl.config.readout import ReadoutConfig
from blinkgl.errors import ConfigError
from blinkgl.scene.motion.paths import OffsetPath, SharedOriginPath
from blinkgl.scene.types import PosePath


@dataclass(frozen=True, eq=False)
class Sensor:
    """One camera of a rig and what is recorded through it.

    camera : its model.   T_rig_cam : (4, 4) float64 rigid, its place: from camera axes (OpenCV's) to the rig's.
    emulator, readout : how frames become events; emulator None: no events are recorded; readout None: no limit.
    labels : ground truth and pictures that are recorded with it; None: none.
    folder : of its files below the sequence's directory; "": that directory itself.
    baseline : world units along the camera's x axis to the other eye of a rectified pair; None: it has none.
    """

    camera: CameraModel
    T_rig_cam: np.ndarray = field(default_factory=lambda: np.eye(4))
    emulator: EmulatorConfig | None = None
    readout: ReadoutConfig | None = None
    labels: LabelsConfig | None = None
    folder: str = ""
    baseline: float | None = None


@dataclass(frozen=True, eq=False)
class Rig:
    """path : T_world_rig over time.   sensors : one or more, all of which it carries.

    Raises ConfigError for none, and for two that have one folder."""

    path: PosePath
    sensors: tuple[Sensor, ...]

    def __post_init__(self) -> None:
        folders = [sensor.folder for sensor in self.sensors]
        if not folders:
            raise ConfigError("a rig without a sensor", where="Rig.sensors", accepted="one or more")
        if twice := [folder for folder in folders if folders.count(folder) > 1]:
            raise ConfigError(
                "two sensors have one folder", where="Rig.sensors", value=twice[0], accepted="a folder each"
            )

    @classmethod
    def alone(cls, camera: CameraModel, path: PosePath) -> Rig:
        """One camera, whose own motion ``path`` is."""
        return cls(path, (Sensor(camera),))

    def path_of(self, sensor: Sensor) -> PosePath:
        """T_world_cam over time. Raises ConfigError where the sensor's place is not rigid."""
        if np.array_equal(sensor.T_rig_cam, np.eye(4)):
            return self.path
        return OffsetPath(self.path, sensor.T_rig_cam)

    def path_of_sky(self) -> PosePath:
        """T_world_sky over time, of the sky that the first sensor sees: at infinity all directions are the same
        wherever the camera is, as in a box that is always around it."""
        return SharedOriginPath(self.path_of(self.sensors[0]))

    def with_first(self, **changes: Any) -> Rig:
        """With other values in the first sensor."""
        return replace(self, sensors=(replace(self.sensors[0], **changes), *self.sensors[1:]))

    def seen_by(self, number: int) -> Rig:
        """The same with its sensor of this number alone. Raises ConfigError where there is none."""
        if not 0 <= number < len(self.sensors):
            raise ConfigError("no such sensor", where="seen_by", value=number, accepted=f"0 to {len(self.sensors) - 1}")
        return replace(self, sensors=(self.sensors[number],))
