"""Bodies smaller than a pixel: stars, particles, distant drones. A picture of samples shows them or not, as a pixel's
centre meets them or misses them; here each pixel gets their light by the area that they cover."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import moderngl
import numpy as np

from blinkgl.render.antialiasing import Samples
from blinkgl.render.frames import DEPTH_BUFFER
from blinkgl.render.passes.base import Input, Output, OverPass, Pass, ScenePass, Shot
from blinkgl.render.passes.edged import Edged
from blinkgl.render.passes.luminance import Colour, Luminance, LuminancePass, Mean, Picture
from blinkgl.render.passes.shadow import ShadowMap
from blinkgl.scene.types import Scene

if TYPE_CHECKING:
    from blinkgl.render.draw_items import DrawItem, Kind
    from blinkgl.render.painter import Painter

_TEXELS = 16
"""Texels of a portrait's side."""
_CELLS = 32
"""Portraits of a row."""
_ROOM = 1.02
"""Side of a portrait in diameters of the bounding sphere, whose picture is a little larger than its centre's scale."""


class Portraits(ScenePass):
    """Each speck of a picture of ``grid`` samples, alone and enlarged, in a cell of its own, the nearest ``most`` of
    them; -1 where it is not."""

    most: int
    grid: int

    def size(self, width: int, height: int) -> tuple[int, int]:
        return _CELLS * _TEXELS, -(-self.most // _CELLS) * _TEXELS

    def background(self, scene: Scene) -> tuple[float, ...]:
        return (-1.0,) * 3

    def paint(self, painter: Painter, shot: Shot, items: Iterable[DrawItem] | None = None) -> None:
        programs, moment = self.programs(painter), shot.moment
        bodies, places = moment.specks(self.grid, self.most)
        width, height = moment.view.camera.width * self.grid, moment.view.camera.height * self.grid
        ctx, ready = painter.gl.ctx, set()
        for k, (body, (x, y, diameter, _)) in enumerate(zip(bodies.tolist(), places.tolist())):
            ctx.viewport = _TEXELS * (k % _CELLS), _TEXELS * (k // _CELLS), _TEXELS, _TEXELS
            # x' = (x - u w) s in clip space, so that the sphere fills the viewport.
            enlarge = np.eye(4)
            for row, (place, length) in enumerate(((x, width), (y, height))):
                scale = length / (_ROOM * diameter)
                enlarge[row, row], enlarge[row, 3] = scale, -scale * (2 * place / length - 1)
            mvp = np.ascontiguousarray((enlarge @ moment.mvp[body]).T, np.float32)
            for item in moment.parts_of(body):
                uniforms = programs[item.kind]
                if item.kind not in ready:
                    ready.add(item.kind)
                    self.prepare(painter, shot, uniforms)
                self.dress_item(painter, shot, item, uniforms)
                uniforms["mvp"].write(mvp)
                if "fog_ray" in uniforms:  # that of the body, all over its portrait
                    P = moment.view.projection
                    slopes = (2 * x / width - 1 - P[0, 2]) / P[0, 0], (2 * y / height - 1 - P[1, 2]) / P[1, 1]
                    uniforms["fog_ray"].value = 0.0, 0.0, *slopes
                painter.draw(uniforms, item, moment.t_ns)


@dataclass(frozen=True)
class LuminancePortraits(Portraits, LuminancePass):
    """:class:`Portraits` of output "luminance"."""

    most: int = _CELLS
    grid: int = 1
    shadows: tuple[ShadowMap, ...] = ()
    outputs: ClassVar[tuple[Output, ...]] = Luminance.outputs


@dataclass(frozen=True)
class ColourPortraits(Portraits, Colour):
    """:class:`Portraits` of output "colour"."""

    most: int = _CELLS
    grid: int = 1


@dataclass(frozen=True)
class Specks(OverPass):
    """A picture of light, with filtered edges or without, and the specks that it leaves out, far ones first. Outputs
    and grid are those of the pass."""

    of: Edged | Picture
    program: ClassVar[str] = "specks.glsl"
    depth: ClassVar[bool | str] = False

    @property
    def inputs(self) -> tuple[Input, ...]:  # type: ignore[bad-override]
        base = self.drawn
        kind = ColourPortraits if isinstance(base, Colour) else LuminancePortraits
        portraits = kind(most=base.specks, grid=base.samples.grid, shadows=base.shadows)
        return Input("picture", self.of), Input("depths", base, DEPTH_BUFFER), Input("portraits", portraits)

    @property
    def drawn(self) -> Picture:
        """Return the pass that draws the larger bodies."""
        base = self.of.of if isinstance(self.of, Edged) else self.of
        assert isinstance(base, Picture)
        return base

    @property
    def samples(self) -> Samples:  # type: ignore[bad-override]
        return self.of.samples

    def defines(self, kind: Kind | None) -> dict[str, object]:
        return {"PORTRAIT": _TEXELS}

    def paint(self, painter: Painter, shot: Shot, items: Iterable[DrawItem] | None = None) -> None:
        shot.inputs["picture"].target.copy_into(shot.target)
        _, places = shot.moment.specks(self.samples.grid, self.drawn.specks)
        if not len(places):
            return
        cells = np.column_stack(np.divmod(np.arange(len(places)), _CELLS)[::-1])
        table = np.empty(len(places), [("body", "4f4"), ("cell", "2i4")])
        # A portrait shows a little more than the body, so its square in the picture is larger by as much.
        table["body"], table["cell"] = places * (1, 1, _ROOM, 1), cells
        ctx, program = painter.gl.ctx, painter.gl.program(self.program, self.defines(None))
        uniforms = painter.uniforms(program)
        for unit, one in enumerate(self.inputs[1:], 1):  # the picture itself is drawn over, not read
            shot.inputs[one.sampler].texture(one.output).use(unit)
            uniforms[one.sampler].value = unit
        uniforms["image_size"].value = shot.size
        # The nearest comes first among the portraits, and last into the picture.
        buffer = ctx.buffer(np.ascontiguousarray(table[::-1]))
        # "/i": a row of the table for each instance. Nine points, because a speck touches at most 3 x 3 pixels.
        array = ctx.vertex_array(program, [(buffer, "4f 2i /i", "in_body", "in_cell")])
        shot.target.use()
        # Alpha is the share of a pixel that a body covers; the rest of it shows what is behind.
        ctx.enable_only(moderngl.BLEND)
        ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        ctx.point_size = 1.0
        array.render(moderngl.POINTS, vertices=9, instances=len(places))
        ctx.disable(moderngl.BLEND)
        array.release()
        buffer.release()

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        yield cls(Edged(Luminance(Samples(taps=4, edges=True), specks=_CELLS)))


def one_value(pass_: Pass) -> Pass:
    """Return ``pass_`` with its edges filtered and its specks, but without the mean of a finer grid."""
    sharp = Edged(pass_) if pass_.samples.edges else pass_
    return Specks(sharp) if isinstance(pass_, Picture) and pass_.specks else sharp  # type: ignore[bad-argument-type]


def filtered(pass_: Pass) -> Pass:
    """Return a pass with one value per pixel: :func:`one_value`, the mean of its samples."""
    sharp = one_value(pass_)
    return sharp if pass_.samples.stored == 1 else Mean(sharp)
