"""Which object is seen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from blinkgl.labels import files, grading
from blinkgl.labels.files import Form
from blinkgl.labels.label import Label, View

if TYPE_CHECKING:
    from blinkgl.render.passes import Shot
    from blinkgl.render.reference import ReferenceFrame
    from blinkgl.scene.types import Scene


class Ids(Label):
    """(H, W) uint32 instance ids; 0: nothing hit."""

    name = "ids"
    title, unit, kind = "instance ids", "0: nothing hit", "ids"
    shard = "ids.png"
    buffer, dtype = "R32UI", np.uint32

    def uniforms(self, shot: Shot) -> dict[str, np.ndarray]:
        return {"instance_id": np.array([thing.instance_id for thing in shot.scene.objects], np.uint32)}

    @property
    def forms(self) -> tuple[Form, ...]:
        return (files.ids_png("ids"),)

    def reference(self, scene: Scene, frame: ReferenceFrame) -> np.ndarray:
        return frame.instance

    @property
    def views(self) -> tuple[View, ...]:
        return (
            View(
                "id",
                "instance id",
                self.unit,
                self.kind,
                lambda value: value,
                self.reference,
                "mismatch",
                0.0,
                grading.different,
                same_triangle=False,
            ),
        )
