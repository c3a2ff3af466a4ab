"""Headless OpenGL: EGL on a chosen device, OSMesa as the software fallback, one error when there is neither.

Every context made here has ``glClipControl(GL_LOWER_LEFT, GL_ZERO_TO_ONE)`` set, because reversed-Z keeps the precision
of a 32F depth buffer only when clip-space depth runs from 0 to 1 (with -1 to 1 the hardware's ``0.5 * z + 0.5`` rounds
it away).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import threading
import weakref
from collections.abc import Iterator, Mapping
from typing import Any

import moderngl

from blinkgl.errors import GLError
from blinkgl.gl.shader import ShaderLoader
from blinkgl.machine.closing import Releasing

# ---------------------------------------------------------------------------------------------------------------------
# OSMesa (Mesa's off-screen software renderer) as a context object for moderngl.
#
# moderngl has no OSMesa backend, but ``moderngl.create_context(context=obj)`` accepts any object with
# ``load_opengl_function``, ``__enter__``, ``__exit__`` and ``release``. Mesa dropped OSMesa in 25.1, so this is the
# fallback for machines without EGL, not the way forward.

# Numbers of OSMesa and OpenGL; the list of attributes is made of pairs and ends with a 0.
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
    name = _loadable(LIBRARIES)
    if name is None:
        raise OSMesaUnavailable("libOSMesa.so not found")
    lib = ctypes.CDLL(name)
    if not hasattr(lib, "OSMesaCreateContextAttribs"):
        raise OSMesaUnavailable("libOSMesa is too old (no OSMesaCreateContextAttribs, Mesa < 12)")
    # Declared, because ctypes takes every result for a C int by default and would cut off half of a pointer.
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


_thread = threading.local()
"""``current``: weak reference to the context last made current in the thread."""
_opened_by: int | None = None
"""The process that opened OpenGL first. A process forked from it has the drivers' locks but not their threads: it would
hang at its first triangle, even in its own context."""
REQUIRED_VERSION = 430
APT_PACKAGES = "libegl1 libgl1 libgl1-mesa-dri libosmesa6"
REMEDY = (
    f"run 'sudo apt-get install -y --no-install-recommends {APT_PACKAGES}', or install the GPU's driver with its EGL "
    "part"
)
DEVICE_VARIABLE = "GLCONTEXT_DEVICE_INDEX"

_LOWER_LEFT, _ZERO_TO_ONE, _CLIP_DEPTH_MODE = 0x8CA1, 0x935F, 0x935D
_SOFTWARE = re.compile(r"llvmpipe|softpipe|swrast|lavapipe|swiftshader|software", re.IGNORECASE)
_EGL_LIBRARIES = ("libEGL.so.1", "libEGL.so")
_GL_LIBRARIES = ("libGL.so.1", "libOpenGL.so.0", *_EGL_LIBRARIES)


class _EGLUnavailable(Exception):
    """``no_such_device``: the user named a device that does not exist, which no fallback should hide."""

    def __init__(self, message: str, no_such_device: bool = False):
        super().__init__(message)
        self.no_such_device = no_such_device


class GLContext(Releasing):
    """A current OpenGL >= 4.3 core context with its programs and targets. Use it in ``with``, or call :meth:`release`.

    ctx        : the ``moderngl.Context``.
    backend    : "egl" or "osmesa".   device: EGL device number (0 for OSMesa).
    vendor, renderer, version : GL's own strings; is_software : drawn by the CPU.
    notes      : earlier attempts that failed, one line each (empty when the first choice worked).
    shaders    : the :class:`~blinkgl.gl.shader.ShaderLoader` behind :meth:`program`.

    Not thread-safe, and not usable after ``fork()``: GLError in a process that was forked after the first context was
    made.
    """

    def __init__(self, raw: Any, backend: str, device: int, notes: tuple[str, ...] = ()):
        global _opened_by
        self._raw = raw
        _opened_by = _opened_by or os.getpid()
        try:
            self.ctx = moderngl.create_context(require=REQUIRED_VERSION, standalone=True, context=raw)
        except Exception as error:  # noqa: BLE001 - moderngl raises bare Exception, ValueError and its own Error here
            raw.release()
            raise _EGLUnavailable(_one_line(error)) from None
        self.backend, self.device, self.notes = backend, device, notes
        info = self.ctx.info
        self.vendor, self.renderer, self.version = info["GL_VENDOR"], info["GL_RENDERER"], info["GL_VERSION"]
        self.is_software = bool(_SOFTWARE.search(f"{self.vendor} {self.renderer}"))
        _thread.current = weakref.ref(self)
        self.shaders = ShaderLoader(self.ctx)
        self.idle = self.ctx.framebuffer(self.ctx.renderbuffer((1, 1)))  # bound when a target in use is released
        self.lost = False
        """Whether :meth:`check` has found that it no longer draws."""
        self._checks = 0
        self._set_clip_control()

    def _set_clip_control(self) -> None:
        if self.ctx.version_code < 450 and "GL_ARB_clip_control" not in self.ctx.extensions:
            self.release()
            raise _EGLUnavailable(
                f"{self.renderer}: neither OpenGL 4.5 nor GL_ARB_clip_control, needed for reversed-Z depth"
            )
        self.function("glClipControl", None, ctypes.c_uint, ctypes.c_uint)(_LOWER_LEFT, _ZERO_TO_ONE)
        mode = ctypes.c_int(0)
        self.function("glGetIntegerv", None, ctypes.c_uint, ctypes.c_void_p)(_CLIP_DEPTH_MODE, ctypes.byref(mode))
        if mode.value != _ZERO_TO_ONE:
            self.release()
            raise _EGLUnavailable(f"{self.renderer}: glClipControl has no effect")

    def function(self, name: str, restype: Any, *argtypes: Any) -> Any:
        """Return a ctypes function for the GL entry point ``name``; for calls that moderngl does not wrap."""
        address = self._raw.load_opengl_function(name)
        if not address:
            raise GLError(f"the driver has no {name}", where=self.renderer)
        return ctypes.CFUNCTYPE(restype, *argtypes)(address)

    def program(self, name: str, defines: Mapping[str, object] | None = None) -> moderngl.Program:
        """Return the program of ``shaders/<name>``; compiled once per (name, defines). See :class:`ShaderLoader`."""
        _refuse_after_fork()
        return self.shaders.program(name, defines)

    def make_current(self) -> None:
        """Make this context the current one again, after another context was used in the same thread.

        Raises GLError where it is current in another thread: drawing would then use and free objects of the context
        that is current here; and in a forked process."""
        _refuse_after_fork()
        egl = None
        if self.backend == "egl":
            # EGL is not aware of OSMesa: it assumes that a context it bound is still bound, and does nothing.
            egl = _unbind_egl()
        self._raw.__enter__()  # glcontext ignores the result of eglMakeCurrent
        if egl is not None and not egl.eglGetCurrentContext():
            raise GLError("another thread uses this context", where=self.renderer, accepted="a context per thread")
        _thread.current = weakref.ref(self)

    def check(self) -> None:
        """Draw one pixel and read it back. A driver that resets its GPU discards contexts, mostly without an error;
        reads then return invalid data. Raises GLError; the work must then be repeated in another context."""
        self.resume()
        # A different colour each time, so that an old answer is noticed.
        self._checks = self._checks % 250 + 1
        red, green = self._checks, 255 - self._checks
        asked = bytes([red, green, 85, 170])
        self.idle.clear(red / 255, green / 255, 85 / 255, 170 / 255)
        answer = self.idle.read(components=4)
        if answer != asked:
            self.lost = True
            raise GLError(
                "the GPU has lost its context; its last frame is lost",
                where=self.renderer,
                accepted="another try, in a new context",
            )

    def resume(self) -> None:
        """Call :meth:`make_current` where another context has been made current in this thread since."""
        if getattr(_thread, "current", lambda: None)() is not self:
            self.make_current()

    @contextlib.contextmanager
    def borrowed(self) -> Iterator[None]:
        """Make it current inside the block; afterwards the context that was current in this thread before is restored.
        Needed to release objects: OpenGL's names are per context, so freeing while another context is current frees
        that one's objects, and the garbage collector may finish an abandoned generator, and with it a renderer, at any
        moment."""
        before = getattr(_thread, "current", lambda: None)()
        try:
            self.make_current()
            yield
        finally:
            if before is not None and before is not self and not before.released:
                before.make_current()

    @property
    def released(self) -> bool:
        return self._raw is None

    def release(self) -> None:
        """Free the context and everything in it. May be called repeatedly."""
        if self._raw is not None and _forked():  # the parent process still uses it
            self._raw = None
        if self._raw is not None:
            with self.borrowed():
                self.shaders.clear()
                self.ctx.release()
                self._raw.release()
                self._raw = None

    def __repr__(self) -> str:
        return f"<GLContext {self.backend}:{self.device} {self.renderer}, OpenGL {self.version}>"


def create_context(backend: str = "auto", device: int = 0) -> GLContext:
    """Make a headless context and make it current.

    backend : "egl"; "osmesa"; or "auto": EGL's ``device``, then (only for device 0) EGL's other devices, then OSMesa.
    device  : index in the order of ``eglQueryDevicesEXT``; CUDA_VISIBLE_DEVICES does not affect it. The environment
              variable GLCONTEXT_DEVICE_INDEX overrides it (glcontext's own rule, kept because job schedulers set it).

    Raises GLError naming every attempt and the remedy, and in a process that was forked after another context was
    made.
    """
    _refuse_after_fork()
    if backend not in ("auto", "egl", "osmesa"):
        raise GLError("unknown backend", where="gl.backend", value=backend, accepted="'auto', 'egl' or 'osmesa'")
    device = _overridden(device)
    attempts: list[str] = []
    if backend in ("auto", "egl"):
        # Who names a device gets that one or an error; otherwise the first that works.
        others = range(1, len(egl_devices())) if backend == "auto" and device == 0 else ()
        for index in (device, *others):
            try:
                return GLContext(_egl(index), "egl", index, tuple(attempts))
            except _EGLUnavailable as error:
                attempts.append(f"EGL device {index}: {error}")
                # A number that is not there is a mistake of the user, which no other device mends.
                if error.no_such_device:
                    raise GLError(
                        "no such EGL device",
                        where="gl.device",
                        value=index,
                        accepted="one of those `blinkgl doctor` lists",
                    ) from None
    if backend in ("auto", "osmesa"):
        try:
            return GLContext(OSMesaContext(4, 3), "osmesa", 0, tuple(attempts))
        except (OSMesaUnavailable, _EGLUnavailable) as error:
            attempts.append(f"OSMesa: {error}")
    raise GLError(f"no usable OpenGL ({'; '.join(attempts)})", where=f"gl.backend {backend}", accepted=REMEDY)


def _forked() -> bool:
    return _opened_by not in (None, os.getpid())


def _refuse_after_fork() -> None:
    if _forked():
        raise GLError(
            "this process was forked from one that uses OpenGL, and would hang",
            where=f"process {os.getpid()}",
            accepted="use multiprocessing.get_context('spawn'), or fork before drawing",
        )


def _overridden(device: int) -> int:
    text = os.environ.get(DEVICE_VARIABLE)
    if not text:
        return device
    if not text.isdecimal():
        raise GLError(
            "not a device number",
            where=f"environment variable {DEVICE_VARIABLE}",
            value=text,
            accepted="an integer >= 0",
        )
    return int(text)


def _egl(device: int) -> object:
    """Return glcontext's EGL object, current in this thread."""
    from glcontext import egl  # type: ignore[missing-module-attribute]  # an extension module

    libegl = _egl_library()
    if libegl is None:
        raise _EGLUnavailable("libEGL.so.1 not found")
    # glcontext also opens libGL, although EGL provides every function: machines without X11 have no libGL.
    libgl = os.environ.get("GLCONTEXT_LINUX_LIBGL") or _loadable(_GL_LIBRARIES) or libegl
    try:
        return egl.create_context(
            mode="standalone", libegl=libegl, libgl=libgl, glversion=REQUIRED_VERSION, device_index=device
        )
    except Exception as error:  # noqa: BLE001 - glcontext raises bare Exception
        message = _one_line(error)
        if "but found 0 devices" in message:
            raise _EGLUnavailable("no driver (Mesa's is in libegl-mesa0 and libgl1-mesa-dri)") from None
        # 0x3001 is EGL_NOT_INITIALIZED.
        if "0x3001" in message:
            message += ", i.e. no working DRI driver"
        elif "eglCreateContext" in message:
            message += f", i.e. no OpenGL {REQUIRED_VERSION / 100:.1f} core"
        raise _EGLUnavailable(message, no_such_device="requested device index" in message) from None


def _unbind_egl() -> ctypes.CDLL:
    """Return libEGL, after unbinding the current context of this thread from EGL."""
    lib = ctypes.CDLL(_egl_library())
    lib.eglGetCurrentDisplay.restype = ctypes.c_void_p
    lib.eglGetCurrentContext.restype = ctypes.c_void_p
    lib.eglMakeCurrent.argtypes = [ctypes.c_void_p] * 4
    # No display: no EGL context was ever current in this thread.
    display = lib.eglGetCurrentDisplay()
    if display:
        lib.eglMakeCurrent(display, None, None, None)
    return lib


def _egl_library() -> str | None:
    """Return the name of libEGL, that of glcontext's variable if it is set; None: it cannot be loaded."""
    named = os.environ.get("GLCONTEXT_LINUX_LIBEGL")
    return _loadable((named,) if named else _EGL_LIBRARIES)


def _loadable(names: tuple[str, ...]) -> str | None:
    for name in names:
        try:
            ctypes.CDLL(name)
            return name
        except OSError:
            continue
    return None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def egl_devices() -> list[str]:
    """Return one description per EGL device, in ``gl.device`` order; empty without EGL or its device extension. Makes
    no context."""
    name = _egl_library()
    if name is None:
        return []
    lib = ctypes.CDLL(name)
    lib.eglGetProcAddress.restype = ctypes.c_void_p
    lib.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    query_devices = lib.eglGetProcAddress(b"eglQueryDevicesEXT")
    query_string = lib.eglGetProcAddress(b"eglQueryDeviceStringEXT")
    if not (query_devices and query_string):
        return []
    query_devices = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)(query_devices)
    query_string = ctypes.CFUNCTYPE(ctypes.c_char_p, ctypes.c_void_p, ctypes.c_int)(query_string)
    count, handles = ctypes.c_int(0), (ctypes.c_void_p * 32)()
    if not query_devices(32, handles, ctypes.byref(count)):
        return []
    return [_device_text(query_string, handles[i]) for i in range(count.value)]


def _device_text(query_string: Any, handle: int) -> str:
    # EGL_EXTENSIONS, EGL_RENDERER_EXT and EGL_DRM_DEVICE_FILE_EXT.
    _EXTENSIONS, _RENDERER_EXT, _DRM_FILE = 0x3055, 0x335F, 0x3233
    extensions = (query_string(handle, _EXTENSIONS) or b"").decode().split()
    if "EGL_MESA_device_software" in extensions:
        return "Mesa software rasteriser"
    asked = ("EGL_EXT_device_query_name", _RENDERER_EXT), ("EGL_EXT_device_drm", _DRM_FILE)
    words = [(query_string(handle, number) or b"").decode() for name, number in asked if name in extensions]
    if "EGL_NV_device_cuda" in extensions:
        words.append("NVIDIA")
    return " ".join(filter(None, words)) or "unnamed device"
