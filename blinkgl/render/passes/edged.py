"""Silhouettes and creases by the areas of their surfaces: the last part of anti-aliasing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import moderngl

from blinkgl.render.antialiasing import Samples
from blinkgl.render.canvas import DEPTH_BUFFER
from blinkgl.render.passes.base import Input, Output, Pass, Shot
from blinkgl.render.passes.mean import Mean
from blinkgl.render.rectangles import Rectangle, merged

if TYPE_CHECKING:
    from blinkgl.render.painter import Painter
    from blinkgl.render.resources import DrawItem, Kind

_SKY = 2
_STEPS = ((0, moderngl.FUNC_ADD), (1, moderngl.MAX))
"""STEP of edges.glsl, and how what it writes meets what is there."""


@dataclass(frozen=True)
class Edged(Pass):
    """Another pass's picture, of one output and one sample a pixel, in which the pixels that a silhouette or a crease
    goes through have the mean of the surfaces on its two sides, by the areas that they have in the pixel's square.
    Outputs as its.

    The areas are exact, of the lines of ``contours.py``; the two values are those of the pixels beside the line, on the
    surfaces that the depth buffer shows there, so that no surface is drawn again. Where none of the pixels beside it
    shows the line's own surface (it is narrower than a pixel, and between all centres), nothing is changed.

    step : which of its programs; 0 stands for all."""

    of: Pass
    step: int = 0
    program: ClassVar[str] = "edges.glsl"
    depth: ClassVar[bool | str] = False
    pointwise: ClassVar[bool] = True

    @property
    def inputs(self) -> tuple[Input, ...]:
        return Input("picture", self.of), Input("depths", self.of, DEPTH_BUFFER)

    @property
    def outputs(self) -> tuple[Output, ...]:
        return self.of.outputs

    @property
    def every(self) -> int:
        return self.of.every

    def changed(self, painter: Painter, rectangles: list[Rectangle]) -> list[Rectangle]:
        seen = painter.scene.camera if painter.lens is None else painter.lens.flat
        return merged([r.grown(1, seen.width, seen.height) for r in rectangles])  # it looks at the pixels beside it

    def defines(self, kind: Kind | None) -> dict[str, Any]:
        # Light is not negative; its rate may be anything.
        rates = [k for k, name in enumerate(self.outputs[0].planes) if name == "rate"]
        return {"STEP": self.step, "FLOOR": f"vec4({', '.join('-3.4e38' if k in rates else '0.0' for k in range(4))})"}

    def paint(self, painter: Painter, shot: Shot, items: Iterable[DrawItem] | None = None) -> None:
        moment = shot.moment
        drawn = [item for item in (moment.visible if items is None else items) if item.layer != _SKY]
        shot.inputs["picture"].target.resolve_into(shot.target)
        strokes = painter.strokes
        strokes.upload(moment, drawn, *shot.size)
        for step, equation in _STEPS:
            uniforms, array = strokes.program(self.program, replace(self, step=step).defines(None))
            if array is None:  # nothing in the picture has an edge
                break
            self.bind(uniforms, shot)
            uniforms["image_size"].value = shot.size
            strokes.draw(array, shot.target, equation)

    def bind(self, uniforms: dict[str, Any], shot: Shot) -> None:
        for unit, one in enumerate(self.inputs, 1):
            if one.sampler in uniforms:
                shot.inputs[one.sampler].texture(one.output).use(unit)
                uniforms[one.sampler].value = unit

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        from blinkgl.render.passes.luminance import Luminance

        return (cls(Luminance(rate, Samples(taps=4, edges=True)), step) for rate in (False, True) for step, _ in _STEPS)


def filtered(pass_: Pass) -> Pass:
    """A pass that gives one value per pixel: ``pass_`` itself, the mean of its samples, or with its edges filtered."""
    if pass_.samples.edges:
        return Edged(pass_)
    return pass_ if pass_.samples.stored == 1 else Mean(pass_)
