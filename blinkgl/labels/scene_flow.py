"""How far the surface moves in space."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from blinkgl.labels import grading
from blinkgl.labels.label import Drawn, Label

if TYPE_CHECKING:
    from blinkgl.render.passes import Shot
    from blinkgl.render.reference import ReferenceFrame
    from blinkgl.scene.types import Scene

_SHARE = 0.95
"""Of the pixels, that two renderers agree on: silhouettes may fall on either side."""


class SceneFlow(Label):
    """(H, W, 3) float32 world units: how far the point that a pixel shows moves in the world until the next label's
    time, in the camera's axes at its own time; 0 where nothing is hit. What stands still has 0, however the camera
    moves: of a point at X in the camera's axes it leads to X + s, which at the other time is at
    T_cam'_cam (X + s) in that camera's axes."""

    name, title = "scene_flow", "scene flow"
    unit, kind = "world units", "scalar"
    towards = "forward"
    stamps, shard = "scene_flow/timestamps.txt", "scene_flow.npy"
    buffer, varyings, channels = "RGBA32F", ("local", "forward"), 3
    of_shapes = ("space_from_clip",)
    judged_in, tolerance, error = "world units", 1e-4, staticmethod(grading.absolute)

    def uniforms(self, shot: Shot) -> dict[str, np.ndarray]:
        now, then = shot.moment, shot.ends["forward"]
        to_camera = now.T_world_cam[:3, :3].T
        # Differences of poses, so that what stands still has exactly nothing.
        change = to_camera @ (then.T_world_obj - now.T_world_obj)[:, :3]
        # A sky at infinity stands still: its box is only drawn where the camera is.
        change[[thing.at_infinity for thing in shot.scene.objects]] = 0.0
        of_clip = to_camera @ then.T_world_cam[:3, :3] @ np.linalg.inv(then.view.projection[[0, 1, 3], :3])
        return {"change_in_space": change, "space_from_clip": np.tile(of_clip, (len(change), 1, 1))}

    def finish(self, drawn: Drawn) -> np.ndarray:
        raw = drawn.raw(self.name)
        return np.where(raw[..., 3:] > 0, raw[..., :3], np.float32(0))

    def reference(self, scene: Scene, frame: ReferenceFrame) -> np.ndarray:
        return frame.scene_flow(scene)
