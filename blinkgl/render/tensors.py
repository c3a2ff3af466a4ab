"""An OpenGL frame as a torch tensor, by the fastest available way.

``interop``: CUDA copies the texture on the GPU, without using the bus. ``pinned``: OpenGL reads into memory that the
GPU accesses directly. ``plain``: the array of ``Frame.read``. All three give the same numbers.

``interop`` and ``pinned`` have not been tested on a GPU. So ``interop`` compares its first tensor of every texture with
what OpenGL reads, and whenever something is missing, refused or different, the reader takes the next way and gives the
reason.

Order (CUDA Driver API, Graphics Interoperability): OpenGL commands before a map are complete before CUDA commands after
it on the map's stream, and the unmap orders the other direction; so the host never waits.
"""

from __future__ import annotations

import importlib
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from blinkgl.errors import GLError
from blinkgl.machine.extras import install

if TYPE_CHECKING:
    from blinkgl.gl import GLContext, Target

# GL_TEXTURE_2D.
_TEXTURE_2D = 0x0DE1
_CONTEXTS: dict[int, Any] = {}  # torch's (primary) contexts by GPU, kept for the life of the process


class NoInteropError(Exception):
    """The reason why CUDA does not read this texture, one line."""


def torch_device(name: object) -> Any:
    """Return torch and the device of this name, with its number. Raises GLError: no torch, or no such device."""
    try:
        torch = importlib.import_module("torch")
    except ImportError:
        raise GLError("tensors need torch", where="device", accepted=f"run {install('torch')}, or use read()") from None
    try:
        return torch, torch.empty(0, device=name).device
    except Exception as error:  # noqa: BLE001 - torch raises what it likes for a device that is not there
        words = str(error).splitlines()[0][:120]
        raise GLError(f"no such device for torch ({words})", where="device", value=str(name), accepted="cpu") from None


class TextureReader:
    """Reads attachment ``i`` of a target into tensors on one device.

    way : "interop", "pinned" or "plain".   why : one line, why no faster way is used; "" for the fastest."""

    def __init__(self, gl: GLContext, target: Target, i: int, device: object, driver: object = None):
        self._gl, self._target, self._i = gl, target, i
        self._torch, self.device = torch_device(device)
        self._resource: Any = None
        self._pinned: Any = None
        self._sent: Any = None  # event: the GPU has read the pinned memory
        self.way, self.why = "plain", "tensors of the processor are asked for"
        if self.device.type == "cuda":
            self.way, self.why = "pinned", ""
        if self.device.type == "cuda" or driver is not None:
            try:
                self._register(driver)
                self.way, self.why = "interop", ""
            except NoInteropError as error:
                self.why = str(error)

    def read(self) -> Any:
        """Return a new (H, W) or (H, W, C) tensor, with the dtype of the attachment's format."""
        self._gl.resume()
        if self.way == "interop":
            try:
                return self._copied()
            except NoInteropError as error:
                self.release()
                self.way, self.why = ("pinned" if self.device.type == "cuda" else "plain"), str(error)
        if self.way == "plain":
            return self._torch.from_numpy(self._target.read(self._i)).to(self.device)
        if self._sent is not None:
            self._sent.synchronize()  # the previous frame may still be in transfer from this memory
        # Pinned memory is slow to allocate, so one block serves all frames.
        if self._pinned is None:
            like = self._torch.from_numpy(self._target.read(self._i))
            self._pinned = self._torch.empty(like.shape, dtype=like.dtype, pin_memory=True)
        self._target.read(self._i, out=self._pinned.numpy())
        with self._torch.cuda.device(self.device):
            made = self._pinned.to(self.device, non_blocking=True)
            self._sent = self._torch.cuda.Event()
            # Signalled once the copy on this stream is done with the pinned memory.
            self._sent.record()
        return made

    # -- CUDA beside OpenGL --------------------------------------------------------------------------------------
    def _call(self, name: str, *arguments: object) -> Any:
        """Return the results of a driver call without its status. Raises NoInteropError."""
        try:
            status, *values = getattr(self._driver, name)(*arguments)
        except Exception as error:  # noqa: BLE001 - a package without its driver, or of another version
            raise NoInteropError(f"{name}: {type(error).__name__}: {' '.join(str(error).split())[:120]}") from None
        if int(status) != 0:
            raise NoInteropError(f"{name}: error {int(status)}")
        return values[0] if len(values) == 1 else tuple(values)

    def _register(self, driver: Any) -> None:
        """Register the texture with CUDA and compare the first copy. Raises NoInteropError."""
        if driver is None and self._gl.is_software:
            raise NoInteropError(f"the processor draws ({self._gl.renderer})")
        try:
            self._driver = driver or importlib.import_module("cuda.bindings.driver")
        except Exception as error:  # noqa: BLE001 - whatever a broken installation throws
            raise NoInteropError(f"no cuda-bindings ({type(error).__name__})") from None
        self._call("cuInit", 0)
        self._gl.resume()
        # CUDA shares textures only with the card on which OpenGL draws.
        every = self._driver.CUGLDeviceList.CU_GL_DEVICE_LIST_ALL
        count, cards = self._call("cuGLGetDevices", 16, every)
        if not count or int(cards[0]) != (self.device.index or 0):
            raise NoInteropError(f"OpenGL draws on another card than {self.device}")
        card = int(cards[0])
        if card not in _CONTEXTS:
            _CONTEXTS[card] = self._call("cuDevicePrimaryCtxRetain", cards[0])
        self._context = _CONTEXTS[card]
        texture: Any = self._target.colour[self._i]
        flags = self._driver.CUgraphicsRegisterFlags.CU_GRAPHICS_REGISTER_FLAGS_READ_ONLY
        self._resource = self._here("cuGraphicsGLRegisterImage", texture.glo, _TEXTURE_2D, flags)
        seen, wanted = self._copied().cpu(), self._torch.from_numpy(self._target.read(self._i))
        # As bytes, because NaN differs from itself.
        if not self._torch.equal(seen.view(self._torch.uint8), wanted.view(self._torch.uint8)):
            self.release()
            raise NoInteropError("CUDA reads other numbers than OpenGL")

    def _here(self, name: str, *arguments: object) -> Any:
        """Call the driver with torch's context current."""
        self._call("cuCtxPushCurrent", self._context)
        try:
            return self._call(name, *arguments)
        finally:
            with suppress(NoInteropError):
                self._call("cuCtxPopCurrent")

    def _copied(self) -> Any:
        """Return the texture's numbers, copied on the GPU. Raises NoInteropError: the driver refuses."""
        target, pixel, torch = self._target, self._target.formats[self._i], self._torch
        shape = (target.height, target.width) + ((pixel.components,) if pixel.components > 1 else ())
        dtype = torch.from_numpy(np.empty(0, pixel.numpy)).dtype
        made = torch.empty(shape, dtype=dtype, device=self.device)
        stream = torch.cuda.current_stream(self.device).cuda_stream if self.device.type == "cuda" else 0
        copy = self._driver.CUDA_MEMCPY2D()
        # A mapped texture is a CUDA array, whose layout is the driver's own; the tensor is plain memory.
        copy.srcMemoryType = self._driver.CUmemorytype.CU_MEMORYTYPE_ARRAY
        copy.dstMemoryType = self._driver.CUmemorytype.CU_MEMORYTYPE_DEVICE
        copy.dstDevice = made.data_ptr()
        # Rows follow each other without gaps: the pitch is the length of a row.
        copy.WidthInBytes = copy.dstPitch = target.width * pixel.components * pixel.numpy.itemsize
        copy.Height = target.height
        stream = self._driver.CUstream(stream)
        self._here("cuGraphicsMapResources", 1, self._resource, stream)
        try:
            copy.srcArray = self._here("cuGraphicsSubResourceGetMappedArray", self._resource, 0, 0)
            self._here("cuMemcpy2DAsync", copy, stream)
        finally:
            self._here("cuGraphicsUnmapResources", 1, self._resource, stream)
        return made

    def release(self) -> None:
        """Release the registration, before the texture is released. May be called repeatedly."""
        resource, self._resource, self._pinned = self._resource, None, None
        if resource is not None:
            with suppress(NoInteropError):
                self._here("cuGraphicsUnregisterResource", resource)
