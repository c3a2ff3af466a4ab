"""Lines in a picture as OpenGL has them: a rectangle for each, which a program fills."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np

from blinkgl.render.contours import FLOATS, Lines

if TYPE_CHECKING:
    from blinkgl.gl import GLContext, Target
    from blinkgl.render.moment import Moment
    from blinkgl.render.resources import DrawItem

_LAYOUT = (("in_place", 2), ("in_start", 3), ("in_end", 3), ("in_kind", 1))


class Strokes:
    """Of one renderer. lines : the contours that it draws."""

    def __init__(self, gl: GLContext):
        self.gl, self.lines = gl, Lines()
        self._room, self._count = 0, 0
        self._vertices: moderngl.Buffer | None = None
        self._indices: moderngl.Buffer | None = None
        self._programs: dict[tuple, tuple[dict[str, Any], moderngl.VertexArray]] = {}

    def upload(self, moment: Moment, items: Iterable[DrawItem], width: int, height: int) -> None:
        """The lines of these items in a picture of width x height px, to be drawn next."""
        quads = self.lines.of(moment, items, width, height)
        self._count = len(quads)
        if self._count > self._room:
            self.release()
            self._room = 1 << max(self._count - 1, 255).bit_length()
            corners = np.arange(self._room, dtype=np.uint32)[:, None] * 4 + np.array([0, 1, 2, 2, 1, 3], np.uint32)
            self._indices = self.gl.ctx.buffer(corners.tobytes())
            self._vertices = self.gl.ctx.buffer(reserve=self._room * 4 * FLOATS * 4, dynamic=True)
        if self._count and self._vertices is not None:
            self._vertices.write(quads)

    def program(self, name: str, defines: dict[str, Any]) -> tuple[dict[str, Any], moderngl.VertexArray | None]:
        """Uniforms of a program, and the array that it draws; None where there is no line."""
        if not self._count:
            return {}, None
        key = name, *sorted(defines.items())
        if key not in self._programs:
            program = self.gl.program(name, defines)
            formats = " ".join(f"{n}f" if field in program else f"{4 * n}x" for field, n in _LAYOUT)
            used = [field for field, _ in _LAYOUT if field in program]
            array = self.gl.ctx.vertex_array(program, [(self._vertices, formats, *used)], self._indices, 4)
            uniforms = {one: program[one] for one in program if isinstance(program[one], moderngl.Uniform)}
            self._programs[key] = uniforms, array
        return self._programs[key]

    def draw(self, array: moderngl.VertexArray, target: Target, add: bool) -> None:
        """Over what ``target`` holds, or added to it."""
        ctx = self.gl.ctx
        target.fbo.use()
        ctx.viewport = (0, 0, target.fbo.width, target.fbo.height)
        ctx.enable_only(moderngl.BLEND if add else moderngl.NOTHING)
        ctx.blend_func = moderngl.ONE, moderngl.ONE
        ctx.blend_equation = moderngl.FUNC_ADD, moderngl.FUNC_ADD
        array.render(moderngl.TRIANGLES, vertices=6 * self._count)
        ctx.disable(moderngl.BLEND)

    def forget(self) -> None:
        """Asks for every program again."""
        for _, array in self._programs.values():
            array.release()
        self._programs = {}

    def release(self) -> None:
        self.forget()
        for buffer in (self._vertices, self._indices):
            if buffer is not None:
                buffer.release()
        self._vertices = self._indices = None
        self._room = 0
