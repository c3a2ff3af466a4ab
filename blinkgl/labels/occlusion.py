"""Which points of the flow are hidden at its other end."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from blinkgl.labels import files, grading
from blinkgl.labels.files import Form
from blinkgl.labels.label import Drawn, Key, Label, Towards, View

if TYPE_CHECKING:
    from blinkgl.config.labels import LabelsConfig

OCCLUSION_KEY = Key(
    bool, Field(True, description="masks of pixels that are not visible at the flow's other end"), "depth"
)


class OcclusionAt(Label):
    """(H, W) bool: a valid pixel's point is not visible where its flow ends, behind another
    surface or outside the image."""

    title, kind, off = "occlusion masks", "mask", "labels.occlusion: false, or no flow"
    dtype = bool

    def __init__(self, towards: Towards):
        self.towards, self.name, self.about = (
            towards,
            f"occlusion_{towards}",
            f"masks of pixels hidden at the end of {towards} flow",
        )
        self.needs, self.there = (f"flow_{towards}", "ids"), ("depth", "ids")
        self.shard = "occlusion.png" if towards == "forward" else None

    keys = property(lambda self: {"occlusion": OCCLUSION_KEY})
    said = property(lambda self: "occlusion")

    def asked(self, labels: LabelsConfig) -> bool:
        return labels.occlusion and self.towards in labels.flow

    def ask(self, tree: dict[str, Any]) -> None:
        tree["occlusion"] = True

    def finish(self, drawn: Drawn) -> np.ndarray:
        from blinkgl.render.occlusion import occlusion_mask

        flow = drawn.value(f"flow_{self.towards}")
        z_there = drawn.raw(f"flow_{self.towards}")[..., 2]
        return occlusion_mask(
            drawn.scene,
            drawn.end_ns,
            flow.flow,
            z_there,
            flow.valid,
            drawn.raw("ids"),
            drawn.there("depth"),
            drawn.there("ids"),
        )

    @property
    def forms(self) -> tuple[Form, ...]:
        return (files.mask_png(f"occlusion/{self.towards}"),)

    @property
    def views(self) -> tuple[View, ...]:
        way = self.towards
        return (
            View(
                f"occluded_{way}",
                f"occluded, {way}",
                "",
                "mask",
                lambda value: value,
                lambda scene, frame: getattr(frame, way).occluded,
                "fraction of pixels",
                1e-3,
                grading.different,
                "mean",
                same_triangle=False,
            ),
        )
