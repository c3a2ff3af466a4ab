"""How fast the surface moves in the image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from blinkgl.labels import grading
from blinkgl.labels.label import Label

if TYPE_CHECKING:
    from blinkgl.render.passes import Shot
    from blinkgl.render.reference import ReferenceFrame
    from blinkgl.scene.types import Scene


class Velocity(Label):
    """(H, W, 2) float32 px/s at the label's time; 0 where nothing is hit."""

    name = "velocity"
    title, unit, kind = "velocity label", "px/s", "motion"
    shard = "velocity.npy"
    buffer, varyings, channels = "RG32F", ("local", "rate"), 2
    judged_in, tolerance, error = "px per label interval", 1e-2, staticmethod(grading.motion_per_interval)

    def uniforms(self, shot: Shot) -> dict[str, np.ndarray]:
        return {"rate": shot.moment.rates.mvp[:, [0, 1, 3]]}

    def reference(self, scene: Scene, frame: ReferenceFrame) -> np.ndarray:
        return np.where(frame.hit[..., None], frame.velocity, 0.0)
