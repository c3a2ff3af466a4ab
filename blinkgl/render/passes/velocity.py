"""Image velocity for the time sampling and the preview."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from blinkgl.render.matrices import rows_xyw_bytes
from blinkgl.render.passes.base import Output, Pass, ScenePass, Shot

if TYPE_CHECKING:
    from blinkgl.render.draw_items import DrawItem, Kind
    from blinkgl.render.moment import Moment
    from blinkgl.render.painter import Painter, Uniforms


@dataclass(frozen=True)
class Velocity(ScenePass):
    """Output "velocity", (h, w, 2) float32 px/s of the full-size image, 0 where nothing is
    hit, on every n-th pixel in x and y.
    moving_only : leaves out objects that stand still, also where they hide something.
    lens : macro of the camera model in whose pixels motion is, where a flat picture is drawn for it."""

    every: int = 1
    moving_only: bool = False
    lens: str = ""
    program: ClassVar[str] = "velocity.glsl"
    outputs: ClassVar[tuple[Output, ...]] = (Output("velocity", "RG32F"),)

    def items(self, moment: Moment) -> list[DrawItem]:
        return [item for item in moment.visible if item.moves] if self.moving_only else moment.visible

    def defines(self, kind: Kind | None) -> dict[str, Any]:
        return ({} if self.every == 1 else {"SMALL": 1}) | ({"LENS": 1, self.lens: 1} if self.lens else {})

    def set(self, painter: Painter, uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
        width, height = shot.size
        uniforms["rate"].write(rows_xyw_bytes(shot.moment.rates.mvp[item.object_index]))
        uniforms["image_size"].value = width, height
        if self.lens:
            assert painter.lens is not None
            # With a lens motion is in its own pixels at any size, so there is no scale.
            painter.lens.set(uniforms, shot, 0)
        elif self.every != 1:
            camera = shot.moment.view.camera
            uniforms["image_scale"].write(np.array([camera.width / width, camera.height / height], np.float32))

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        return (cls(every, lens=lens) for every in (1, 4) for lens in ("", "RADTAN", "EQUIDISTANT"))
