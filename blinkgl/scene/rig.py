"""What looks at a scene: sensors, each at its place on one rig that moves."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.scene.motion.paths import OffsetPath
from blinkgl.scene.types import PosePath


@dataclass(frozen=True, eq=False)
class Sensor:
    """One camera of a rig.

    camera : its model.   T_rig_cam : (4, 4) float64 rigid, its place; camera axes as OpenCV has them, from camera to rig."""

    camera: CameraModel
    T_rig_cam: np.ndarray = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, eq=False)
class Rig:
    """path : T_world_rig over time.   sensors : one or more, all of which it carries."""

    path: PosePath
    sensors: tuple[Sensor, ...]

    @classmethod
    def alone(cls, camera: CameraModel, path: PosePath) -> Rig:
        """One camera, whose own motion ``path`` is."""
        return cls(path, (Sensor(camera),))

    def path_of(self, sensor: Sensor) -> PosePath:
        """T_world_cam over time. Raises ConfigError where the sensor's place is not rigid."""
        return self.path if np.array_equal(sensor.T_rig_cam, np.eye(4)) else OffsetPath(self.path, sensor.T_rig_cam)

    def with_camera(self, camera: CameraModel) -> Rig:
        """With another model in the first sensor."""
        return replace(self, sensors=(replace(self.sensors[0], camera=camera), *self.sensors[1:]))
