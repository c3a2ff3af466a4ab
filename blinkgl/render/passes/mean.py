"""One value per pixel of a picture that was drawn finer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from blinkgl.render.antialiasing import Samples
from blinkgl.render.passes.base import Input, Output, Pass, ScreenPass

if TYPE_CHECKING:
    from blinkgl.render.draw_items import Kind


@dataclass(frozen=True)
class Mean(ScreenPass):
    """The mean of each pixel's samples of another pass, of one output; outputs as its."""

    of: Pass
    program: ClassVar[str] = "downsample.glsl"
    pointwise: ClassVar[bool] = True

    @property
    def inputs(self) -> tuple[Input, ...]:
        return (Input("fine", self.of),)

    @property
    def outputs(self) -> tuple[Output, ...]:
        return self.of.outputs

    @property
    def every(self) -> int:
        return self.of.every

    def defines(self, kind: Kind | None) -> dict[str, Any]:
        # Samples per pixel in x and in y.
        return {"FACTOR": self.of.samples.grid}

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        from blinkgl.render.passes.colour import Colour

        return (cls(Colour(Samples(grid=factor))) for factor in (2, 4))
