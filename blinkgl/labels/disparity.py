"""Disparity of a rectified stereo pair."""

from __future__ import annotations

import numpy as np

from blinkgl.labels import grading
from blinkgl.labels.label import Drawn, Label, ReferenceFrame
from blinkgl.scene.types import Scene


class Disparity(Label):
    """(H, W) float32 px, f b / Z >= 0: x in the left image minus x in the right, for both images; 0 where nothing is
    hit, and everywhere for a sensor without a pair. Hidden points are included."""

    name = "disparity"
    unit, kind = "px", "scalar"
    needs = ("depth",)
    shard = "disparity.npy"
    judged_in, tolerance, error = "relative", 1e-5, staticmethod(grading.relative)

    def can_be_of(self, scene: Scene) -> bool:
        return scene.sensors[0].baseline is not None

    def finish(self, drawn: Drawn) -> np.ndarray:
        return _of(drawn.scene, drawn.raw("depth")).astype(np.float32)

    def reference(self, scene: Scene, frame: ReferenceFrame) -> np.ndarray:
        return _of(scene, np.where(np.isfinite(frame.depth), frame.depth, 0.0))


def _of(scene: Scene, depth: np.ndarray) -> np.ndarray:
    """Return the disparity, (H, W) float64; depth is 0 where nothing is hit."""
    baseline = scene.sensors[0].baseline or 0.0
    there = depth > 0
    return np.where(there, scene.camera.disparity(np.where(there, depth, 1.0), abs(baseline)), 0.0)
