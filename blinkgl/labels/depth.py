"""Z along the optical axis."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from blinkgl.labels import grading
from blinkgl.labels.label import Drawn, Label
from blinkgl.scene.types import FARTHEST

if TYPE_CHECKING:
    from blinkgl.render.reference import ReferenceFrame
    from blinkgl.scene.types import Scene

_SHARE = 0.95
"""Of the pixels, that two renderers agree on: silhouettes may fall on either side."""


class Depth(Label):
    """(H, W) float32 world units along the optical axis; inf: nothing hit, or a panorama's sky."""

    name = "depth"
    unit, kind = "world units", "depth"
    shard = "depth.npy"
    buffer = "R32F"
    judged_in, tolerance, error = "relative", 1e-5, staticmethod(grading.relative)

    def finish(self, drawn: Drawn) -> np.ndarray:
        raw = drawn.raw("depth")
        return np.where((raw > 0) & (raw < FARTHEST), raw, np.float32(np.inf))

    def reference(self, scene: Scene, frame: ReferenceFrame) -> np.ndarray:
        return np.where(frame.depth < FARTHEST, frame.depth, np.inf)
