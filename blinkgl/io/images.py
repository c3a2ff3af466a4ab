"""Images, masks, ids, depth and normals of a sequence."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.flow_png import encode_png, read_png
from blinkgl.srgb import to_srgb8


def encode_image(image: np.ndarray) -> bytes:
    """sRGB PNG. (H, W) or (H, W, 3) RGB; float is linear light, uint8 and uint16 are stored as they are."""
    image = np.asarray(image)
    if image.dtype.kind == "f":
        image = to_srgb8(image)
    return encode_png(image[..., ::-1] if image.ndim == 3 else image)


def read_image(path: str | os.PathLike) -> np.ndarray:
    """(H, W) or (H, W, 3) RGB as stored (uint8, uint16)."""
    image = read_png(path)
    return np.ascontiguousarray(image[..., 2::-1]) if image.ndim == 3 else image


def encode_mask(mask: np.ndarray) -> bytes:
    """8-bit PNG, 0 or 255, of a (H, W) bool."""
    return encode_png(np.asarray(mask, bool).astype(np.uint8) * np.uint8(255))


def read_mask(path: str | os.PathLike) -> np.ndarray:
    """(H, W) bool."""
    image = read_png(path)
    if image.ndim != 2:
        raise AssetError("not a mask", where=str(path), value=image.shape, accepted="one channel")
    return image > 0


def encode_ids(ids: np.ndarray) -> bytes:
    """16-bit PNG of (H, W) instance ids; ValueError when one does not fit."""
    ids = np.asarray(ids)
    if ids.size and (ids.min() < 0 or ids.max() > 65535):
        raise ValueError(f"instance ids must fit uint16, got {ids.min()}..{ids.max()}")
    return encode_png(ids.astype(np.uint16))


def encode_npy(array: np.ndarray) -> bytes:
    """.npy bytes; object arrays are refused (they would be pickled)."""
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return buffer.getvalue()


def read_npy(path: str | os.PathLike) -> np.ndarray:
    """An array; AssetError when missing, truncated or pickled."""
    with numpy_errors(path):
        return np.load(path, allow_pickle=False)


@contextlib.contextmanager
def numpy_errors(path: str | os.PathLike) -> Iterator[None]:
    """Any failure to load ``path`` with NumPy as an AssetError: on damaged bytes it raises what its header parser, zipfile
    and zlib happen to (TokenError, BadZipFile, zlib.error, NotImplementedError, MemoryError …)."""
    try:
        yield
    except AssetError:
        raise
    except Exception as error:  # noqa: BLE001
        raise AssetError(f"cannot read: {' '.join(str(error).split())[:160] or type(error).__name__}", where=str(path)) from error
