"""CUDA reads what OpenGL has written, on the same card: buffers registered with the driver, copied there.

**This has not run on a card.** None was there when it was written. So it proves itself where it runs: before the first
tensor of a context goes this way, a pattern that a compute shader wrote is read through CUDA and compared, twice
(:func:`proven`); whatever is missing or differs is said in a line, and :mod:`blinkgl.card.tensors` goes another way.

What holds, of the order of things (CUDA Driver API, Graphics Interoperability):

- what OpenGL was told before a map is done before what CUDA is told after it, on the stream of the map; what CUDA was
  told before an unmap is done before what OpenGL is told after it. Shaders' writes are fenced by the barrier that
  :meth:`~blinkgl.card.kernels.Kernels.run` ends with. Nobody waits on the processor;
- a buffer is mapped for the length of one copy, and OpenGL is told nothing in between;
- everything is on the stream that torch works on at the moment, so what torch does with the copy comes after it;
- a buffer is registered once, and unregistered before it is deleted, or the context is (``GLContext.ends_first``).

Calls are those of ``cuda.bindings.driver`` (package ``cuda-bindings``, which ``cuda-python`` installs), in torch's own
(the primary) context of the card that OpenGL draws on. cupy has none of them, so it alone does not do.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

if TYPE_CHECKING:
    import moderngl

    from blinkgl.gl import GLContext

CALLS = {
    "cuInit": ("Flags",),
    "cuGLGetDevices": ("cudaDeviceCount", "deviceList"),
    "cuDevicePrimaryCtxRetain": ("dev",),
    "cuCtxPushCurrent": ("ctx",),
    "cuCtxPopCurrent": (),
    "cuGetErrorName": ("error",),
    "cuGraphicsGLRegisterBuffer": ("buffer", "Flags"),
    "cuGraphicsMapResources": ("count", "resources", "hStream"),
    "cuGraphicsResourceGetMappedPointer": ("resource",),
    "cuGraphicsUnmapResources": ("count", "resources", "hStream"),
    "cuGraphicsUnregisterResource": ("resource",),
    "cuMemcpyDtoDAsync": ("dstDevice", "srcDevice", "ByteCount", "hStream"),
}
"""What is called of ``cuda.bindings.driver``, and the names of its parameters: the tests' stand-in has these, and is
compared with the package where that is installed."""
_MOST_CARDS = 16
_WORDS = 2**18
_LOCAL = 256
_PATTERN = """#version 430 core
layout(local_size_x = 256) in;
layout(std430, binding = 0) buffer Words { uint words[]; };
uniform uint salt;
void main() { words[gl_GlobalInvocationID.x] = (gl_GlobalInvocationID.x ^ salt) * 2654435761u; }
"""
_contexts: dict[int, Any] = {}
"""torch's contexts by card, kept until the process ends, as torch keeps them."""
_found: WeakKeyDictionary[GLContext, Cuda | str] = WeakKeyDictionary()


class NoInterop(Exception):
    """One line: why CUDA does not read this context's buffers."""


class Torch:
    """What is asked of torch. (The tests' stand-in has no card to ask.)"""

    def devices(self) -> int:
        """Cards that torch sees. Raises NoInterop: without torch, or of one that is built without CUDA."""
        try:
            import torch
        except ImportError as error:
            raise NoInterop(f"no torch ({error})") from None
        if not torch.cuda.is_available():
            raise NoInterop("torch sees no CUDA device")
        torch.cuda.init()
        return torch.cuda.device_count()

    def empty(self, words: int, card: int) -> Any:
        """(words,) int32 on a card, not set."""
        import torch

        return torch.empty(words, dtype=torch.int32, device=f"cuda:{card}")

    def stream(self, card: int) -> int:
        """Handle of the stream that torch works on."""
        import torch

        return torch.cuda.current_stream(card).cuda_stream


class Cuda:
    """The card that a context draws on, as CUDA sees it.   card : its number, torch's ``cuda:N``.

    driver : ``cuda.bindings.driver``; None: imported.   Raises NoInterop."""

    def __init__(self, gl: GLContext, driver: Any = None, torch: Torch | None = None):
        self._gl, self._torch = gl, torch or Torch()
        seen = self._torch.devices()
        self._driver = _bindings() if driver is None else driver
        self.call("cuInit", 0)
        gl.resume()
        every = self._driver.CUGLDeviceList.CU_GL_DEVICE_LIST_ALL
        count, cards = self.call("cuGLGetDevices", _MOST_CARDS, every)
        if not count:
            raise NoInterop("CUDA knows no card of this OpenGL context")
        self.card = int(cards[0])
        if self.card >= seen:
            raise NoInterop(f"OpenGL draws on CUDA's card {self.card}, and torch sees {seen}")
        if self.card not in _contexts:
            _contexts[self.card] = self.call("cuDevicePrimaryCtxRetain", cards[0])
        self._context = _contexts[self.card]

    def call(self, name: str, *arguments: Any) -> Any:
        """What the driver gives besides its status: nothing, a value, or several. Raises NoInterop: its error."""
        try:
            status, *values = getattr(self._driver, name)(*arguments)
        except Exception as error:  # noqa: BLE001 - a package without its driver, or of another version
            raise NoInterop(f"{name}: {type(error).__name__}: {' '.join(str(error).split())[:120]}") from None
        if int(status) != 0:
            raise NoInterop(f"{name}: {self._name_of(status)}")
        return values[0] if len(values) == 1 else tuple(values)

    def _name_of(self, status: Any) -> str:
        with suppress(Exception):  # the number will do
            failed, name = self._driver.cuGetErrorName(status)
            if int(failed) == 0:
                return name.decode()
        return f"error {int(status)}"

    @contextmanager
    def here(self) -> Iterator[None]:
        """OpenGL's context and CUDA's current in this thread; CUDA's of before afterwards."""
        self._gl.resume()
        self.call("cuCtxPushCurrent", self._context)
        try:
            yield
        finally:
            with suppress(NoInterop):
                self.call("cuCtxPopCurrent")

    def stream(self) -> Any:
        """torch's."""
        return self._driver.CUstream(self._torch.stream(self.card))

    def empty(self, words: int) -> Any:
        """(words,) int32 tensor on the card, not set."""
        return self._torch.empty(words, self.card)

    @property
    def read_only(self) -> int:
        return int(self._driver.CUgraphicsRegisterFlags.CU_GRAPHICS_REGISTER_FLAGS_READ_ONLY)


class Registered:
    """A buffer of OpenGL's that CUDA reads. Raises NoInterop: the driver does not register it."""

    def __init__(self, gl: GLContext, cuda: Cuda, buffer: moderngl.Buffer):
        self._gl, self._cuda, self._size = gl, cuda, buffer.size
        self._resource: Any = None
        with cuda.here():
            self._resource = cuda.call("cuGraphicsGLRegisterBuffer", buffer.glo, cuda.read_only)
        gl.ends_first(self)

    def read(self, size: int, offset: int = 0) -> Any:
        """(size / 4,) int32 tensor on the card, of its own: the buffer's bytes from ``offset`` on, as they are after
        everything that OpenGL was told before. Bytes are whole words. Raises NoInterop: the driver refuses; the buffer
        is then not mapped, as far as it lets go of it."""
        if self._resource is None:
            raise NoInterop("the buffer is not registered any more")
        cuda, resource = self._cuda, self._resource
        made = cuda.empty(size // 4)
        with cuda.here():
            stream = cuda.stream()
            cuda.call("cuGraphicsMapResources", 1, resource, stream)
            try:
                address, there = cuda.call("cuGraphicsResourceGetMappedPointer", resource)
                if offset + size > int(there):
                    raise NoInterop(f"CUDA sees {int(there)} of {self._size} bytes")
                cuda.call("cuMemcpyDtoDAsync", made.data_ptr(), int(address) + offset, size, stream)
            finally:
                cuda.call("cuGraphicsUnmapResources", 1, resource, stream)
        return made

    def release(self) -> None:
        """Before the buffer is deleted. Harmless when repeated."""
        resource, self._resource = self._resource, None
        if resource is not None:
            with suppress(NoInterop), self._gl.borrowed(), self._cuda.here():
                self._cuda.call("cuGraphicsUnregisterResource", resource)


def _bindings() -> Any:
    try:
        return importlib.import_module("cuda.bindings.driver")
    except Exception as error:  # noqa: BLE001 - whatever a broken installation throws
        raise NoInterop(f"no cuda-bindings ({type(error).__name__}: {' '.join(str(error).split())[:120]})") from None


def proven(gl: GLContext) -> Cuda | str:
    """CUDA beside this context, or the line that says why not. Tried at the first call, the answer is kept."""
    if gl not in _found:
        _found[gl] = _tried(gl)
    return _found[gl]


def _tried(gl: GLContext) -> Cuda | str:
    if gl.is_software:
        return f"the processor draws ({gl.renderer})"
    try:
        cuda = Cuda(gl)
        prove(gl, cuda)
    except NoInterop as why:
        return str(why)
    except Exception as error:  # noqa: BLE001 - torch's, OpenGL's, another package's: there is another way
        return f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
    return cuda


def prove(gl: GLContext, cuda: Cuda) -> None:
    """Two patterns of 1 MiB, one after the other in the same buffer, written by a compute shader and read through CUDA
    at once; the second is read from an offset. Raises NoInterop: one is not what was written."""
    gl.resume()
    shader = gl.ctx.compute_shader(_PATTERN)
    buffer = gl.ctx.buffer(reserve=4 * _WORDS)
    registered = None
    try:
        registered = Registered(gl, cuda, buffer)
        for salt, skipped in ((0x5EED1234, 0), (0x0DDB1A5E, 1024)):
            shader["salt"] = salt
            buffer.bind_to_storage_buffer(0)
            shader.run(_WORDS // _LOCAL)
            gl.ctx.memory_barrier()
            seen = registered.read(4 * (_WORDS - skipped), 4 * skipped).cpu().numpy().view(np.uint32)
            wanted = (np.arange(_WORDS, dtype=np.uint32) ^ np.uint32(salt)) * np.uint32(2654435761)
            if wrong := int((seen != wanted[skipped:]).sum()):
                raise NoInterop(f"CUDA reads other bytes than OpenGL wrote ({wrong} of {len(seen)} words)")
    finally:
        if registered is not None:
            registered.release()
        buffer.release()
        shader.release()
