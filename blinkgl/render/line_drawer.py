"""Lines of a picture as OpenGL draws them: one point per crossed pixel; the vertex stage reads all lines of its
pixel."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING

import moderngl
import numpy as np

from blinkgl.gl import GLContext, Target
from blinkgl.gl.shader import Uniforms, unused
from blinkgl.render.contours import CROSSING, Lines
from blinkgl.types.recent import Kept

if TYPE_CHECKING:
    from blinkgl.render.draw_items import DrawItem
    from blinkgl.render.moment import Moment

ROW = 512
"""Crossings per row of their texture, two texels each; the same as in edges.glsl."""


class LineDrawer:
    """The lines of one renderer. lines : the contours that it draws.   uniforms : returns a program's table."""

    def __init__(self, gl: GLContext, uniforms: Callable[[moderngl.Program], Uniforms]):
        self.gl, self.lines, self._uniforms = gl, Lines(), uniforms
        self._count = 0
        self._pixels: moderngl.Buffer | None = None
        self._crossings: moderngl.Texture | None = None
        self._rows = np.empty((0, ROW, CROSSING), np.float32)
        self._programs: Kept[tuple, tuple[Uniforms, moderngl.VertexArray]] = Kept()

    def upload(self, moment: Moment, items: Iterable[DrawItem], width: int, height: int) -> None:
        """Upload the lines of these items in a picture of width x height px, for the next drawing."""
        pixels, crossings = self.lines.in_pixels(moment, items, width, height)
        self._count = len(pixels)
        if not self._count:
            return
        if self._pixels is None or pixels.nbytes > self._pixels.size:
            # The programs' vertex arrays hold the old buffer.
            self.forget()
            if self._pixels is not None:
                self._pixels.release()
            # Twice the present size, so that a growing number of lines rarely needs a new buffer.
            self._pixels = self.gl.ctx.buffer(reserve=2 * pixels.nbytes, dynamic=True)
        self._pixels.write(pixels)
        rows = -(-len(crossings) // ROW)
        if self._crossings is None or rows > len(self._rows):
            if self._crossings is not None:
                self._crossings.release()
            self._rows = np.zeros((2 * rows, ROW, CROSSING), np.float32)
            # A crossing is eight floats: two texels of four.
            self._crossings = self.gl.ctx.texture((2 * ROW, 2 * rows), 4, dtype="f4")
            self._crossings.filter = moderngl.NEAREST, moderngl.NEAREST
        self._rows.reshape(-1, CROSSING)[: len(crossings)] = crossings
        self._crossings.write(self._rows[:rows], viewport=(0, 0, 2 * ROW, rows))

    def program(self, name: str, defines: Mapping[str, object]) -> tuple[Uniforms, moderngl.VertexArray] | None:
        """Return the uniforms of a program and the array to draw; None where no pixel has a line."""
        if not self._count:
            return None
        return self._programs.of(
            (name, *sorted(defines.items())), lambda: self._drawing(self.gl.program(name, defines))
        )

    def _drawing(self, program: moderngl.Program) -> tuple[Uniforms, moderngl.VertexArray]:
        if "in_pixel" not in program:
            raise unused(program, "in_pixel")
        array = self.gl.ctx.vertex_array(program, [(self._pixels, "4i", "in_pixel")])
        return self._uniforms(program), array

    def use(self, unit: int) -> None:
        """Bind the crossings' texture to a unit."""
        if self._crossings is not None:
            self._crossings.use(unit)

    def draw(self, array: moderngl.VertexArray, target: Target) -> None:
        """Draw each of the pixels over the content of ``target``."""
        ctx = self.gl.ctx
        target.use()
        ctx.enable_only(moderngl.NOTHING)
        ctx.point_size = 1.0
        array.render(moderngl.POINTS, vertices=self._count)

    def forget(self) -> None:
        """Drop all programs, so that they are requested again."""
        for _, array in self._programs.values():
            array.release()
        self._programs.clear()

    def release(self) -> None:
        self.forget()
        for held in (self._pixels, self._crossings):
            if held is not None:
                held.release()
        self._pixels = self._crossings = None
