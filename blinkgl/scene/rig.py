"""Sensors of a scene, each at a fixed pose on one moving rig.

A :class:`Sensor` is a device on the rig; the data sheet of a commercial camera, which ``sensor:`` of a configuration
names, is :class:`blinkgl.config.sensor.SensorConfig`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.scene.motion.paths import OffsetPath, SharedOriginPath
from blinkgl.scene.motion.pose_path import PosePath


@dataclass(frozen=True, eq=False)
class Sensor:
    """One camera of a rig. What is recorded with it, the configuration says.

    camera : its model.   T_rig_cam : (4, 4) float64 rigid, from camera axes (OpenCV's) to the rig's.
    baseline : world units along the camera's x axis to the other camera of a rectified pair; None: no pair.
    """

    camera: CameraModel
    T_rig_cam: np.ndarray = field(default_factory=lambda: np.eye(4))
    baseline: float | None = None


@dataclass(frozen=True, eq=False)
class Rig:
    """A rig. path : T_world_rig over time.   sensors : one or more, all carried by it."""

    path: PosePath
    sensors: tuple[Sensor, ...]

    @classmethod
    def alone(cls, camera: CameraModel, path: PosePath) -> Rig:
        """Return a rig of one camera that moves along ``path``."""
        return cls(path, (Sensor(camera),))

    def path_of(self, sensor: Sensor) -> PosePath:
        """Return T_world_cam over time. Raises ConfigError where the sensor's pose is not rigid."""
        if np.array_equal(sensor.T_rig_cam, np.eye(4)):
            return self.path
        return OffsetPath(self.path, sensor.T_rig_cam)

    def path_of_sky(self) -> PosePath:
        """Return T_world_sky over time, of the first sensor's sky: at infinity directions do not depend on the camera's
        position, as in a box that is always around it."""
        return SharedOriginPath(self.path_of(self.sensors[0]))
