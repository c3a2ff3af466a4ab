"""What fits on a card: asked before buffers are made, where the driver says how much is free."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from blinkgl.errors import GLError

if TYPE_CHECKING:
    from blinkgl.gl import GLContext

_NVIDIA_FREE, _AMD_FREE = 0x9049, 0x87FC
_SURELY = 0.95  # buffers are of whole blocks of pixels
_OUT_OF_MEMORY = "GL_OUT_OF_MEMORY"


def free_bytes(gl: GLContext) -> int | None:
    """Memory of the card that is free now; None: the driver does not say, or the processor draws."""
    if "GL_NVX_gpu_memory_info" in gl.ctx.extensions:
        name = _NVIDIA_FREE
    elif "GL_ATI_meminfo" in gl.ctx.extensions:
        name = _AMD_FREE
    else:
        return None
    kib = (ctypes.c_int * 4)()  # AMD says four numbers, the first of which is meant
    gl.function("glGetIntegerv", None, ctypes.c_uint, ctypes.c_void_p)(name, kib)
    return 1024 * kib[0]


def refuse_too_large(gl: GLContext, sizes: Mapping[str, int], what: str, size: tuple[int, int] | None = None) -> None:
    """Raises GLError, one line, where buffers of these bytes are more than one may have, or more than is free.

    what : what they are for, plural.   size : width and height of the picture, to say which would fit."""
    limit, largest = gl.ctx.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"], max(sizes.values())
    if largest > limit:
        raise GLError(
            f"{what} are too many for this card's buffers",
            where="events.device",
            value=f"{largest / 2**20:.0f} MiB in one",
            accepted=f"at most {limit / 2**20:.0f} MiB, or events.device: cpu",
        )
    total, free = sum(sizes.values()), free_bytes(gl)
    if free is not None and total > free:
        share = math.sqrt(_SURELY * free / total)
        smaller = "" if size is None else f", or pictures of {int(size[0] * share)}x{int(size[1] * share)} px"
        raise GLError(
            f"{what} take more memory than this card has free",
            where="events.device",
            value=f"{total / 2**20:.0f} MiB",
            accepted=f"at most {free / 2**20:.0f} MiB{smaller}, or events.device: cpu",
        )


def refuse_if_out_of_memory(gl: GLContext, what: str) -> None:
    """Raises GLError where the driver had no room for the buffers that were made last."""
    if gl.ctx.error == _OUT_OF_MEMORY:
        raise GLError(
            f"no memory left on the card for {what}", where="events.device", accepted="less, or events.device: cpu"
        )
