"""Silhouettes and creases by the areas of their surfaces: the last part of anti-aliasing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

from blinkgl.render.antialiasing import Samples
from blinkgl.render.canvas import DEPTH_BUFFER
from blinkgl.render.passes.base import Input, Output, Pass, Shot
from blinkgl.render.passes.mean import Mean
from blinkgl.render.rectangles import Rectangle, merged

if TYPE_CHECKING:
    from blinkgl.render.painter import Painter
    from blinkgl.render.resources import DrawItem, Kind

_SKY = 2


@dataclass(frozen=True)
class Changes(Pass):
    """What the lines of a scene's silhouettes and creases change of another pass's picture, of one output and one
    sample a pixel, and the sum of the shares that they change of each pixel, as its last component.

    The areas are exact, of the lines of ``contours.py``; the two values are those of the pixels beside the line, on the
    surfaces that the depth buffer shows there, so that no surface is drawn again. Where none of the pixels beside it
    shows the line's own surface (it is narrower than a pixel, and between all centres), nothing is changed.

    step : which of its programs."""

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
        return Output("changes", "RGBA32F"), Output("creases", "RGBA32F"), Output("lines", "R32F")

    @property
    def every(self) -> int:
        return self.of.every

    def changed(self, painter: Painter, rectangles: list[Rectangle]) -> list[Rectangle]:
        seen = painter.scene.camera if painter.lens is None else painter.lens.flat
        return merged([r.grown(1, seen.width, seen.height) for r in rectangles])  # it looks at the pixels beside it

    def defines(self, kind: Kind | None) -> dict[str, Any]:
        return {"STEP": self.step}

    def paint(self, painter: Painter, shot: Shot, items: Iterable[DrawItem] | None = None) -> None:
        moment = shot.moment
        drawn = [item for item in (moment.visible if items is None else items) if item.layer != _SKY]
        painter.strokes.upload(moment, drawn, *shot.size)
        for step, add in ((0, False), (1, True)):
            _draw(replace(self, step=step), painter, shot, add)

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        from blinkgl.render.passes.luminance import Luminance

        of = Luminance(False, Samples(taps=4, edges=True))
        return (cls(of, step) for step in (0, 1))


@dataclass(frozen=True)
class Edged(Pass):
    """Another pass's picture, of one output and one sample a pixel, in which the pixels that a silhouette or a crease
    goes through have the mean of the surfaces on its two sides, by the areas that they have in the pixel's square
    (:class:`Changes`). Outputs as its."""

    of: Pass
    program: ClassVar[str] = "edges.glsl"
    depth: ClassVar[bool | str] = False
    pointwise: ClassVar[bool] = True

    @property
    def inputs(self) -> tuple[Input, ...]:
        changes = Changes(self.of)
        return (
            Input("picture", self.of),
            Input("depths", self.of, DEPTH_BUFFER),
            Input("changes", changes),
            Input("creases", changes, "creases"),
            Input("lines", changes, "lines"),
        )

    @property
    def outputs(self) -> tuple[Output, ...]:
        return self.of.outputs

    @property
    def every(self) -> int:
        return self.of.every

    def defines(self, kind: Kind | None) -> dict[str, Any]:
        # Light is not negative; its rate may be anything.
        rates = [k for k, name in enumerate(self.outputs[0].planes) if name == "rate"]
        floor = ", ".join("-3.4e38" if k in rates else "0.0" for k in range(4))
        return {"STEP": 2, "FLOOR": f"vec4({floor})"}

    def paint(self, painter: Painter, shot: Shot, items: Iterable[DrawItem] | None = None) -> None:
        shot.inputs["picture"].target.resolve_into(shot.target)
        _draw(self, painter, shot, add=False)  # the lines that were uploaded for the changes

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        from blinkgl.render.passes.luminance import Luminance

        return (cls(Luminance(rate, Samples(taps=4, edges=True))) for rate in (False, True))


def _draw(pass_: Pass, painter: Painter, shot: Shot, add: bool) -> None:
    """The uploaded lines by a pass's program."""
    uniforms, array = painter.strokes.program(pass_.program, pass_.defines(None))
    if array is None:  # nothing in the picture has an edge
        return
    for unit, one in enumerate(pass_.inputs, 1):
        if one.sampler in uniforms:
            shot.inputs[one.sampler].texture(one.output).use(unit)
            uniforms[one.sampler].value = unit
    uniforms["image_size"].value = shot.size
    if "pixel" in uniforms:
        uniforms["pixel"].value = 2 / (shot.size[0] * abs(shot.moment.view.projection[0, 0]))
    painter.strokes.draw(array, shot.target, add)


def filtered(pass_: Pass) -> Pass:
    """A pass that gives one value per pixel: ``pass_`` itself, the mean of its samples, or with its edges filtered."""
    if pass_.samples.edges:
        return Edged(pass_)
    return pass_ if pass_.samples.stored == 1 else Mean(pass_)
