"""The lens's picture from the pinhole picture that was drawn (:mod:`blinkgl.render.lens`)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from moderngl import LINEAR

from blinkgl.camera import CameraModel, Radtan
from blinkgl.gl import FORMATS
from blinkgl.labels import LABELS
from blinkgl.render.frames import Rectangle
from blinkgl.render.lens import steps_of
from blinkgl.render.passes.base import Input, OverPass, Pass, ScreenPass, Shot
from blinkgl.render.passes.geometry import Geometry, Velocity
from blinkgl.render.passes.luminance import Colour

if TYPE_CHECKING:
    from blinkgl.render.draw_items import DrawItem, Kind
    from blinkgl.render.painter import Painter

_FREE_UNIT = 8


@dataclass(frozen=True)
class Gather(OverPass, ScreenPass):
    """The value of another pass at each pixel of a lens's picture: all outputs of its nearest pixel or, with
    ``smooth``, the mean of one output over its own area. It has every n-th pixel where the other has."""

    of: Pass
    camera: CameraModel
    smooth: bool = False
    program: ClassVar[str] = "gather.glsl"
    pointwise: ClassVar[bool] = True

    @property
    def inputs(self) -> tuple[Input, ...]:  # type: ignore[bad-override]
        return tuple(Input(f"picked_{k}", self.of, output.name) for k, output in enumerate(self.of.outputs))

    def size(self, width: int, height: int) -> tuple[int, int]:
        every = self.of.every
        return max(1, self.camera.width // every), max(1, self.camera.height // every)

    def changed(self, painter: Painter, rectangles: list[Rectangle]) -> list[Rectangle]:
        """Return the whole picture, where anything of the pinhole picture has changed."""
        width, height = self.size(self.camera.width, self.camera.height)
        return [Rectangle(0, 0, width, height)] if rectangles else []

    def defines(self, kind: Kind | None) -> dict[str, object]:
        defines: dict[str, object] = {}
        if self.smooth:
            columns, rows = steps_of(self.camera, self.of.samples.grid)
            defines = {"SMOOTH": 1, "COLUMNS": columns, "ROWS": rows}
        # Integer formats need integer samplers and outputs, of unsigned numbers here.
        prefixes = ("u" if FORMATS[output.format].numpy.kind == "u" else "" for output in self.outputs)
        outputs = (f"OUTPUT({k}, {prefix}sampler2D, {prefix}vec4)" for k, prefix in enumerate(prefixes))
        return defines | {"OUTPUTS": " ".join(outputs)}

    def paint(self, painter: Painter, shot: Shot, items: Iterable[DrawItem] | None = None) -> None:
        lens, (uniforms, array) = painter.lens, painter.cover(self.program, self.defines(None))
        assert lens is not None
        self.bind(uniforms, shot)
        if self.smooth:
            texture = shot.inputs["picked_0"].texture(self.inputs[0].output)
            # The mean reads between texels; beyond the edge the outermost one is repeated.
            texture.filter, texture.repeat_x, texture.repeat_y = (LINEAR, LINEAR), False, False
            lens.slopes(*shot.size).use(_FREE_UNIT + 3)
            uniforms["slopes"].value = _FREE_UNIT + 3
        # Units below hold what is gathered, one for each output.
        lens.places(*shot.size).use(_FREE_UNIT + 2)
        uniforms["places"].value = _FREE_UNIT + 2
        uniforms["flat_size"].value = lens.flat.width, lens.flat.height
        painter.fill(array, shot.target)

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        lens = Radtan(4, 3, 4.0, 4.0, 1.5, 1.0)
        # As many labels as there are outputs, see geometry.MOST_BUFFERS.
        yield cls(Colour(), lens, True)
        drawn = tuple(name for name, label in LABELS.items() if label.buffer)[:8]
        yield cls(Geometry(drawn, lens.shader), lens)
        yield cls(Velocity(4, lens=lens.shader), lens)
