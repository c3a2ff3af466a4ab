"""Occlusion of the flow's points at its other end."""

from __future__ import annotations

import numpy as np

from blinkgl.config.labels import LabelsConfig
from blinkgl.labels import files, grading
from blinkgl.labels.files import Form
from blinkgl.labels.label import Drawn, Label, Towards, View


class OcclusionAt(Label):
    """(H, W) bool: a valid pixel's point is not visible at its flow's end: behind another surface or outside the
    image."""

    title, kind, off = "occlusion masks", "mask", "labels.occlusion: false, or no flow"
    dtype = bool

    def __init__(self, towards: Towards):
        self.towards, self.name = towards, f"occlusion_{towards}"
        self.needs, self.there = (f"flow_{towards}", "ids"), ("depth", "ids")
        self.shard = "occlusion.png" if towards == "forward" else None

    said = property(lambda self: "occlusion")

    def asked(self, labels: LabelsConfig) -> bool:
        return labels.occlusion and self.towards in labels.flow

    def ask(self, tree: dict[str, object]) -> None:
        tree["occlusion"] = True

    def finish(self, drawn: Drawn) -> np.ndarray:
        return drawn.occlusion(f"flow_{self.towards}")

    @property
    def forms(self) -> tuple[Form, ...]:
        return (files.mask_png(f"occlusion/{self.towards}"),)

    @property
    def views(self) -> tuple[View, ...]:
        way = self.towards
        assert way is not None
        return (
            View(
                name=f"occluded_{way}",
                title=f"occluded, {way}",
                unit="",
                kind="mask",
                of=lambda value: value,
                reference=lambda scene, frame: getattr(frame, way).occluded,
                judged_in="fraction of pixels",
                tolerance=1e-3,
                error=grading.different,
                statistic="mean",
                same_triangle=False,
            ),
        )
