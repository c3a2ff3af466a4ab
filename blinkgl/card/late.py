"""Reading back one frame late: what a frame leaves on the card is copied into memory that the processor sees, behind a
fence, and taken when the next frame is there. Nobody waits for a card that is drawing."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import numpy as np

from blinkgl.errors import GLError

if TYPE_CHECKING:
    import moderngl

    from blinkgl.gl import GLContext

_COPY_READ, _COPY_WRITE = 0x8F36, 0x8F37
_MAP_READ, _MAP_PERSISTENT, _MAP_COHERENT, _CLIENT_STORAGE = 0x1, 0x40, 0x80, 0x200
_COMMANDS_COMPLETE, _FLUSH, _TIMED_OUT, _FAILED = 0x9117, 0x1, 0x911B, 0x911D
_WAIT_NS = 1_000_000_000
_PATIENCE = 60
"""Seconds. A card that has not done a frame's events by then is not coming back."""


def maps_persistently(gl: GLContext) -> bool:
    """Whether this OpenGL has memory that stays mapped (4.4)."""
    return gl.ctx.version_code >= 440 or "GL_ARB_buffer_storage" in gl.ctx.extensions


class Slot:
    """``size`` bytes that the card writes and the processor reads. Two of them, used in turns, are a double buffer."""

    def __init__(self, gl: GLContext, size: int):
        self.size = size
        u, p, n = ctypes.c_uint, ctypes.c_void_p, ctypes.c_ssize_t
        self._gl = gl
        self._bind = gl.function("glBindBuffer", None, u, u)
        self._copy = gl.function("glCopyBufferSubData", None, u, u, n, n, n)
        self._fence_here = gl.function("glFenceSync", p, u, u)
        self._wait_for = gl.function("glClientWaitSync", u, p, u, ctypes.c_uint64)
        self._forget_fence = gl.function("glDeleteSync", None, p)
        self._name, self._fence = u(0), None
        gl.function("glGenBuffers", None, ctypes.c_int, p)(1, ctypes.byref(self._name))
        self._bind(_COPY_WRITE, self._name)
        flags = _MAP_READ | _MAP_PERSISTENT | _MAP_COHERENT
        gl.function("glBufferStorage", None, u, n, p, u)(_COPY_WRITE, size, None, flags | _CLIENT_STORAGE)
        address = gl.function("glMapBufferRange", p, u, n, n, u)(_COPY_WRITE, 0, size, flags)
        if not address:
            self.release()
            raise GLError(
                "no memory that the card and the processor share",
                where="events.device",
                value=f"{size} bytes",
                accepted="events.device: cpu",
            )
        self._bytes = np.ctypeslib.as_array((ctypes.c_uint8 * size).from_address(address))

    def copy(self, source: moderngl.Buffer, size: int, at: int = 0) -> None:
        """The first ``size`` bytes of a buffer to offset ``at``, when the card gets there."""
        self._bind(_COPY_READ, source.glo)
        self._bind(_COPY_WRITE, self._name)
        self._copy(_COPY_READ, _COPY_WRITE, 0, at, size)

    def seal(self) -> None:
        """That was all; :meth:`wait` waits until it is there."""
        self._fence = self._fence_here(_COMMANDS_COMPLETE, 0)

    def wait(self) -> np.ndarray:
        """(size,) uint8: the memory itself, right until the slot is copied into again. Raises GLError where the card
        does not answer for a minute."""
        for _ in range(_PATIENCE):
            if self._fence is None:
                break
            answer = self._wait_for(self._fence, _FLUSH, _WAIT_NS)
            if answer == _FAILED:
                break
            if answer != _TIMED_OUT:
                self._forget_fence(self._fence)
                self._fence = None
        if self._fence is not None:
            raise GLError(
                "the card does not answer any more",
                where="events.device",
                value=self._gl.renderer,
                accepted="another try, or events.device: cpu",
            )
        return self._bytes

    def release(self) -> None:
        if self._fence is not None:
            self._forget_fence(self._fence)
            self._fence = None
        delete = self._gl.function("glDeleteBuffers", None, ctypes.c_int, ctypes.c_void_p)
        delete(1, ctypes.byref(self._name))
        self._bytes = np.empty(0, np.uint8)
