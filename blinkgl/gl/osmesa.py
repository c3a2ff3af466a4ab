"""OSMesa (Mesa's off-screen software renderer) as a context object for moderngl.

moderngl has no OSMesa backend, but ``moderngl.create_context(context=obj)`` accepts any object with
``load_opengl_function``, ``__enter__``, ``__exit__`` and ``release``. Mesa dropped OSMesa in 25.1, so this is the
fallback for machines without EGL, not the way forward.
"""

from __future__ import annotations

import ctypes

_FORMAT, _RGBA = 0x22, 0x1908
_DEPTH_BITS, _STENCIL_BITS, _PROFILE, _CORE_PROFILE = 0x30, 0x31, 0x33, 0x34
_MAJOR, _MINOR = 0x36, 0x37
_UNSIGNED_BYTE = 0x1401

LIBRARIES = ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")


class OSMesaUnavailable(Exception):
    """libOSMesa is missing, too old, or refused a context."""


class OSMesaContext:
    """A core-profile context on a 16x16 dummy surface (everything is drawn into framebuffer objects)."""

    standalone = True

    def __init__(self, major: int, minor: int):
        self._handle = None
        self._lib = _load_library()
        attributes = (ctypes.c_int * 13)(
            _FORMAT, _RGBA, _DEPTH_BITS, 0, _STENCIL_BITS, 0, _PROFILE, _CORE_PROFILE, _MAJOR, major, _MINOR, minor, 0
        )
        self._handle = self._lib.OSMesaCreateContextAttribs(attributes, None)
        if not self._handle:
            raise OSMesaUnavailable(f"libOSMesa offers no OpenGL {major}.{minor} core context")
        self._surface = ctypes.create_string_buffer(16 * 16 * 4)
        if not self._make_current():
            self.release()
            raise OSMesaUnavailable("OSMesaMakeCurrent failed")

    def _make_current(self) -> bool:
        return bool(self._lib.OSMesaMakeCurrent(self._handle, self._surface, _UNSIGNED_BYTE, 16, 16))

    def load_opengl_function(self, name: str) -> int:
        return self._lib.OSMesaGetProcAddress(name.encode()) or 0

    load = load_opengl_function

    def __enter__(self) -> OSMesaContext:
        self._make_current()
        return self

    def __exit__(self, *exc: object) -> None:
        self._lib.OSMesaMakeCurrent(None, None, _UNSIGNED_BYTE, 0, 0)

    def release(self) -> None:
        if self._handle:
            if self._lib.OSMesaGetCurrentContext() == self._handle:
                self._lib.OSMesaMakeCurrent(None, None, _UNSIGNED_BYTE, 0, 0)
            self._lib.OSMesaDestroyContext(self._handle)
            self._handle = None


def _load_library() -> ctypes.CDLL:
    for name in LIBRARIES:
        try:
            lib = ctypes.CDLL(name)
            break
        except OSError:
            continue
    else:
        raise OSMesaUnavailable("libOSMesa.so not found")
    if not hasattr(lib, "OSMesaCreateContextAttribs"):
        raise OSMesaUnavailable("libOSMesa is too old (no OSMesaCreateContextAttribs, Mesa < 12)")
    pointer = ctypes.c_void_p
    lib.OSMesaCreateContextAttribs.argtypes = [pointer, pointer]
    lib.OSMesaCreateContextAttribs.restype = pointer
    lib.OSMesaMakeCurrent.argtypes = [pointer, pointer, ctypes.c_uint, ctypes.c_int, ctypes.c_int]
    lib.OSMesaMakeCurrent.restype = ctypes.c_ubyte
    lib.OSMesaGetCurrentContext.restype = pointer
    lib.OSMesaDestroyContext.argtypes = [pointer]
    lib.OSMesaDestroyContext.restype = None
    lib.OSMesaGetProcAddress.argtypes = [ctypes.c_char_p]
    lib.OSMesaGetProcAddress.restype = pointer
    return lib
