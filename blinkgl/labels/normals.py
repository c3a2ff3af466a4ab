"""Which way the surface faces."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from blinkgl.labels.label import Label

if TYPE_CHECKING:
    from blinkgl.render.passes import Shot
    from blinkgl.render.reference import ReferenceFrame
    from blinkgl.scene.types import Scene


class Normals(Label):
    """(H, W, 3) float32 unit, camera axes (OpenCV), facing the camera; 0 where nothing is hit."""

    name = "normals"
    unit, kind = "camera axes", "unit"
    shard = "normals.npy"
    buffer, varyings, channels = "RGBA32F", ("normal",), 3
    judged_in, tolerance = "of a unit vector", 1e-3

    def uniforms(self, shot: Shot) -> dict[str, np.ndarray]:
        return {"camera_from_local": shot.moment.T_cam_obj[:, :3, :3]}

    def reference(self, scene: Scene, frame: ReferenceFrame) -> np.ndarray:
        rotation = scene.camera_path.pose(frame.t_ns)[:3, :3]
        return np.where(frame.hit[..., None], frame.normal @ rotation, 0.0)
