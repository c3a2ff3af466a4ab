"""Off-screen render targets with float colour and a 32-bit float depth, and their read-back.

Row 0 of every array is GL's row 0. BlinkGL's projection inverts y, so this is the image's top row; nothing is flipped
here or anywhere else.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import moderngl
import numpy as np

from blinkgl.errors import GLError
from blinkgl.machine.closing import Releasing

if TYPE_CHECKING:
    from blinkgl.gl.context import GLContext

# OpenGL's own numbers, for the calls that moderngl does not wrap.
_READ_FRAMEBUFFER, _DRAW_FRAMEBUFFER, _COLOR_BIT, _DEPTH_BIT, _NEAREST = 0x8CA8, 0x8CA9, 0x4000, 0x0100, 0x2600
_COLOR_ATTACHMENT0 = 0x8CE0
_TEXTURE_2D, _RENDERBUFFER, _TEXTURE0 = 0x0DE1, 0x8D41, 0x84C0
_DEPTH_COMPONENT, _DEPTH_COMPONENT32F, _FLOAT = 0x1902, 0x8CAC, 0x1406
_TEXTURES = {"texture": _DEPTH_COMPONENT32F, "texture of 16 bits": 0x81A5}  # GL_DEPTH_COMPONENT16
_COLOR, _DEPTH = 0x1800, 0x1801


class PixelFormat(NamedTuple):
    """components per pixel, moderngl's dtype, and the dtype read back."""

    components: int
    gl: str
    numpy: np.dtype


FORMATS = {
    "R8": PixelFormat(1, "f1", np.dtype(np.uint8)),
    "RG8": PixelFormat(2, "f1", np.dtype(np.uint8)),
    "RGBA8": PixelFormat(4, "f1", np.dtype(np.uint8)),
    "R16F": PixelFormat(1, "f2", np.dtype(np.float16)),
    "RGBA16F": PixelFormat(4, "f2", np.dtype(np.float16)),
    "R32F": PixelFormat(1, "f4", np.dtype(np.float32)),
    "RG32F": PixelFormat(2, "f4", np.dtype(np.float32)),
    "RGBA32F": PixelFormat(4, "f4", np.dtype(np.float32)),
    "R32UI": PixelFormat(1, "u4", np.dtype(np.uint32)),
    "R32I": PixelFormat(1, "i4", np.dtype(np.int32)),
}


def checked_array(out: np.ndarray | None, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Return ``out``, or a new array where there is none. Raises ValueError when it is not C-contiguous or has another
    shape or dtype."""
    if out is None:
        return np.empty(shape, dtype)
    if out.shape != shape or out.dtype != dtype or not out.flags.c_contiguous:
        raise ValueError(f"out must be a C-contiguous {shape} {dtype} array, not {out.shape} {out.dtype}")
    return out


class Target(Releasing):
    """A framebuffer of ``width`` x ``height`` px with colour textures and depth.

    colour : one key of :data:`FORMATS` per attachment, ``layout(location = i)`` in the fragment shader.
    depth  : True: 32F renderbuffer; "texture": 32F texture that a later pass can sample
    (``.depth.use(unit)``, ``sampler2D``); "texture of 16 bits": that, in steps of 1/65535;
             False: none. Clear it to 0 and test with ``ctx.depth_func = ">"`` (reversed-Z).

    fbo    : moderngl.Framebuffer.   colour: its textures, filtered NEAREST.   depth:
           renderbuffer, texture or None.

    Raises GLError for unknown formats, sizes beyond the driver's limit.
    """

    def __init__(
        self, gl: GLContext, width: int, height: int, colour: Sequence[str] = ("RGBA8",), depth: bool | str = True
    ):
        limit = gl.ctx.info["GL_MAX_TEXTURE_SIZE"]
        if not (1 <= width <= limit and 1 <= height <= limit):
            raise GLError(
                "the render size exceeds this OpenGL's limit",
                value=f"{width}x{height}",
                accepted=f"1 to {limit} px a side",
            )
        if len(colour) > gl.ctx.info["GL_MAX_DRAW_BUFFERS"]:
            raise GLError(
                "too many colour attachments",
                value=len(colour),
                accepted=f"at most {gl.ctx.info['GL_MAX_DRAW_BUFFERS']}",
            )
        unknown = [name for name in colour if name not in FORMATS]
        if unknown:
            raise GLError("unknown pixel format", value=unknown[0], accepted="one of " + ", ".join(FORMATS))
        self.gl, self.width, self.height = gl, width, height
        self.formats = tuple(FORMATS[name] for name in colour)
        self.colour: tuple[moderngl.Texture, ...] = tuple(self._texture(f) for f in self.formats)
        self.depth = self._depth(depth)
        self.fbo = gl.ctx.framebuffer(list(self.colour), self.depth)
        # What moderngl does not offer: blits between targets, and clearing each attachment by its own type.
        self._bind = gl.function("glBindFramebuffer", None, ctypes.c_uint, ctypes.c_uint)
        self._blit = gl.function("glBlitFramebuffer", None, *[ctypes.c_int] * 8, ctypes.c_uint, ctypes.c_uint)
        self._read_buffer = gl.function("glReadBuffer", None, ctypes.c_uint)
        self._clear_float = gl.function("glClearBufferfv", None, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)
        self._clear_uint = gl.function("glClearBufferuiv", None, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)
        self._clear_int = gl.function("glClearBufferiv", None, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)
        self._cleared: tuple[tuple, list[Callable[[], object]]] = (), []  # clear values, and the calls that set them

    def _texture(self, pixel: PixelFormat) -> moderngl.Texture:
        texture = self.gl.ctx.texture((self.width, self.height), pixel.components, dtype=pixel.gl)
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        texture.repeat_x = texture.repeat_y = False
        return texture

    def _depth(self, kind: bool | str) -> moderngl.Texture | moderngl.Renderbuffer | None:
        """moderngl only makes 24-bit depth. Its object is kept and given 32F storage *before* it is attached, so that
        moderngl knows the framebuffer has depth: attached behind its back, depth_mask stays
        off and depth is never written."""
        gl, size = self.gl, (self.width, self.height)
        if kind is False:
            return None
        uint, integer = ctypes.c_uint, ctypes.c_int
        if kind in _TEXTURES:
            # Given 32F (or 16-bit) storage in place of moderngl's 24 bits, which reversed depth would waste.
            depth = gl.ctx.depth_texture(size)
            gl.function("glActiveTexture", None, uint)(_TEXTURE0 + gl.ctx.default_texture_unit)
            gl.function("glBindTexture", None, uint, uint)(_TEXTURE_2D, depth.glo)
            gl.function(
                "glTexImage2D", None, uint, integer, integer, integer, integer, integer, uint, uint, ctypes.c_void_p
            )(_TEXTURE_2D, 0, _TEXTURES[kind], *size, 0, _DEPTH_COMPONENT, _FLOAT, None)
            # Without a comparison a shader reads the depth itself.
            depth.compare_func = ""
            depth.filter = (moderngl.NEAREST, moderngl.NEAREST)
            depth.repeat_x = depth.repeat_y = False
            return depth
        if kind is True:
            depth = gl.ctx.depth_renderbuffer(size)
            gl.function("glBindRenderbuffer", None, uint, uint)(_RENDERBUFFER, depth.glo)
            gl.function("glRenderbufferStorage", None, uint, uint, integer, integer)(
                _RENDERBUFFER, _DEPTH_COMPONENT32F, *size
            )
            return depth
        raise GLError("unknown kind of depth", value=kind, accepted="True, False, 'texture' or 'texture of 16 bits'")

    def use(self) -> None:
        """Make all of this the target of drawing (sets the viewport, and the scissor of ``fbo.scissor``)."""
        self.fbo.use()
        # Binding restores the viewport of the last use, which may have been a part.
        self.gl.ctx.viewport = (0, 0, self.fbo.width, self.fbo.height)

    def clear(self, *colour: float | int | Sequence[float], depth: float = 0.0) -> None:
        """Make it current and clear every attachment: value i (scalar or per component) for
        attachment i, 0 where none is given.

        Unlike ``fbo.clear`` this is defined for integer formats and may differ between
        attachments. Honours the scissor.
        """
        self.fbo.use()
        values = (*(c if isinstance(c, (int, float)) else tuple(c) for c in colour), depth)
        if values != self._cleared[0]:  # usually equal to the previous frame's
            self._cleared = values, [*self._clear_calls(colour, depth)]
        for call in self._cleared[1]:
            call()

    def _clear_calls(
        self, colour: Sequence[float | int | Sequence[float]], depth: float
    ) -> Iterator[Callable[[], object]]:
        for i, pixel in enumerate(self.formats):
            # glClearBuffer reads four values of the format's type, however many components it has.
            value = np.zeros(4, {"u": np.uint32, "i": np.int32}.get(pixel.gl[0], np.float32))
            if i < len(colour):
                value[: np.size(colour[i])] = colour[i]
            clear = {"u": self._clear_uint, "i": self._clear_int}.get(pixel.gl[0], self._clear_float)
            yield partial(clear, _COLOR, i, value.ctypes)
        if self.depth is not None:
            yield partial(self._clear_float, _DEPTH, 0, ctypes.byref(ctypes.c_float(depth)))

    def copy_into(self, other: Target, edges: tuple[int, int, int, int] | None = None, *, depth: bool = False) -> None:
        """Copy the first attachment, if there is one, into that of ``other``, a target of the same size and formats;
        honours the scissor.   edges : x0, y0, x1, y1 px of the part; None: all.   depth : the depth, too."""
        self._bind(_READ_FRAMEBUFFER, self.fbo.glo)
        if self.formats:
            self._read_buffer(_COLOR_ATTACHMENT0)  # reading another attachment, such as the depth, has changed it
        self._bind(_DRAW_FRAMEBUFFER, other.fbo.glo)
        edges = edges or (0, 0, self.width, self.height)
        self._blit(*edges, *edges, _COLOR_BIT * bool(self.formats) | _DEPTH_BIT * depth, _NEAREST)
        # moderngl has not seen the calls above and believes that its own framebuffer is still bound.
        other.fbo.use()

    def read(
        self, i: int = 0, out: np.ndarray | None = None, region: tuple[int, int, int, int] | None = None
    ) -> np.ndarray:
        """Return attachment ``i``: (H, W) for one component, else (H, W, C); dtype of its format; row 0 is the top row.

        out    : written in place and returned when given (C-contiguous, that shape and dtype); the fast way, without
        allocation.
        region : (x, y, w, h) px; H, W are then h, w.
        """
        pixel = self.formats[i]
        x, y, w, h = region or (0, 0, self.width, self.height)
        shape = (h, w) if pixel.components == 1 else (h, w, pixel.components)
        out = checked_array(out, shape, pixel.numpy)
        self.fbo.read_into(out, (x, y, w, h), pixel.components, attachment=i, alignment=1, dtype=pixel.gl)
        return out

    def read_depth(self, out: np.ndarray | None = None) -> np.ndarray:
        """Return window-space depth, (H, W) float32: near/z_camera for BlinkGL's reversed-Z infinite projection, 0
        where cleared."""
        if self.depth is None:
            raise GLError("this target has no depth")
        out = checked_array(out, (self.height, self.width), np.dtype(np.float32))
        # For moderngl, attachment -1 is the depth.
        self.fbo.read_into(out, (0, 0, self.width, self.height), 1, attachment=-1, alignment=1, dtype="f4")
        return out

    def release(self) -> None:
        """Free the framebuffer and its textures. May be called repeatedly."""
        if self.gl.ctx.fbo is self.fbo:
            self.gl.idle.use()  # moderngl binds its current framebuffer again later, an error once that is deleted
        for resource in (self.fbo, *self.colour, self.depth):
            if resource is not None:
                resource.release()
