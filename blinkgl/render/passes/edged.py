"""Silhouettes and creases filtered by the areas of their surfaces: the last step of anti-aliasing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from blinkgl.render.antialiasing import Samples
from blinkgl.render.draw_items import SKY
from blinkgl.render.frames import DEPTH_BUFFER, Rectangle, merged
from blinkgl.render.passes.base import Input, OverPass, Pass, ScenePass, Shot

if TYPE_CHECKING:
    from blinkgl.render.draw_items import DrawItem, Kind
    from blinkgl.render.painter import Painter

_CROSSINGS_UNIT = 8


_REACH = 13
"""px: distance within which a pixel's lines look for their surfaces (edges.glsl: ALONG and two)."""
_CHANNELS = {"R32F": 1, "RG32F": 2}


@dataclass(frozen=True)
class Edged(OverPass):
    """One output of another pass's picture, in which pixels on a silhouette or a crease have the mean of the surfaces
    on its two sides, weighted by their areas in the pixel's square. Outputs and grid are those of the pass: with a
    finer picture, pixels are those of its grid.

    The areas are exact, from the lines of ``contours.py``. The two values are those of pixels around, on the surfaces
    that the depth buffer shows there, so no surface is drawn again. Where no pixel around shows the line's own surface
    (it is narrower than a pixel, between all centres), nothing is changed."""

    of: Pass
    program: ClassVar[str] = "edges.glsl"
    depth: ClassVar[bool | str] = False
    pointwise: ClassVar[bool] = True

    @property
    def inputs(self) -> tuple[Input, ...]:
        return Input("picture", self.of), Input("depths", self.of, DEPTH_BUFFER)

    @property
    def samples(self) -> Samples:  # type: ignore[bad-override]
        return Samples(grid=self.of.samples.grid)

    def changed(self, painter: Painter, rectangles: list[Rectangle]) -> list[Rectangle]:
        seen = painter.scene.camera if painter.lens is None else painter.lens.flat
        # px of the fine grid to px of the picture, rounded up.
        reach = -(-_REACH // self.samples.grid)  # rectangles are in pixels of the picture
        return merged([r.grown(reach, seen.width, seen.height) for r in rectangles])

    def defines(self, kind: Kind | None) -> dict[str, object]:
        channels = _CHANNELS.get(self.outputs[0].format, 4)
        return {"LIGHT": "float" if channels == 1 else f"vec{channels}", "OF": "rgba"[:channels]}

    def paint(self, painter: Painter, shot: Shot, items: Iterable[DrawItem] | None = None) -> None:
        # Pixels without an edge keep their value.
        shot.inputs["picture"].target.copy_into(shot.target)
        moment, drawer = shot.moment, painter.line_drawer
        shown = self.of.items(moment) if isinstance(self.of, ScenePass) else moment.visible
        drawn = [item for item in (shown if items is None else items) if item.layer != SKY]
        drawer.upload(moment, drawn, *shot.size)
        program = drawer.program(self.program, self.defines(None))
        if program is None:  # the picture has no edges
            return
        uniforms, array = program
        self.bind(uniforms, shot)
        drawer.use(_CROSSINGS_UNIT)
        uniforms["crossings"].value = _CROSSINGS_UNIT
        uniforms["image_size"].value = shot.size
        # Width of a pixel on the plane at distance 1: 2 / (width |P00|).
        uniforms["pixel"].value = 2 / (shot.size[0] * abs(moment.view.projection[0, 0]))
        drawer.draw(array, shot.target)

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        from blinkgl.render.passes.luminance import Colour, Luminance

        edges = Samples(taps=4, edges=True)
        return (cls(of) for of in (Luminance(edges), Colour(edges)))
