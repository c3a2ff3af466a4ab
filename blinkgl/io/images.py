"""Images, masks, ids, depth and normals of a sequence; NumPy files, whose headers are checked
before they are believed."""

from __future__ import annotations

import contextlib
import io
import math
import os
import zipfile
from collections.abc import Iterator
from typing import BinaryIO

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


def read_ids(path: str | os.PathLike) -> np.ndarray:
    """(H, W) integers as stored. Raises AssetError."""
    image = read_png(path)
    if image.ndim != 2:
        raise AssetError("not a picture of ids", where=str(path), value=image.shape, accepted="one channel")
    return image


def encode_npy(array: np.ndarray) -> bytes:
    """.npy bytes; object arrays are refused (they would be pickled)."""
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return buffer.getvalue()


def read_npy(path: str | os.PathLike) -> np.ndarray:
    """An array; AssetError when missing, no .npy, truncated, of objects, or of a shape that the
    file is too short or too long for."""
    with numpy_errors(path):
        check_npy(path)
        return np.load(path, allow_pickle=False)


def check_npy(path: str | os.PathLike) -> None:
    """Raises what :func:`npy_header` does for the .npy file, and OSError."""
    with open(path, "rb") as file:
        npy_header(file, os.fstat(file.fileno()).st_size, str(path))


def npy_header(file: BinaryIO, size: int, where: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """(shape, Fortran order?, dtype) at the beginning of ``file``, ``size`` bytes long; it
    is left where the data begin.

    Raises AssetError: objects (they would be unpickled), or a shape that is not what the
    bytes hold; and what NumPy raises."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(file)
    if dtype.hasobject:
        raise AssetError(
            "array of Python objects, which could run any code when loaded; refused",
            where=where,
            accepted="an array of numbers",
        )
    expected = file.tell() + math.prod(shape) * dtype.itemsize
    if size != expected or min(shape, default=0) < 0:
        raise AssetError(
            "truncated or malformed array: its header does not agree with its length",
            where=where,
            value=f"{dtype} {shape} in {size} bytes",
            accepted=f"{expected} bytes",
        )
    return shape, fortran, dtype


class NpzReader:
    """The arrays of an .npz by name; one is read when it is asked for. Never unpickles. Use as a context manager.

    Raises (inside :func:`numpy_errors`) AssetError: an entry that is no plain array of numbers, or that would not fit
    into half of this machine's memory: a small archive can unpack to any size."""

    def __init__(self, path: str | os.PathLike):
        self.path, self._archive = path, zipfile.ZipFile(path)
        self.names = [n.removesuffix(".npy") for n in self._archive.namelist()]

    def __enter__(self) -> NpzReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._archive.close()

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def __getitem__(self, name: str) -> np.ndarray:
        where = f"{self.path}: '{name}'"
        if f"{name}.npy" not in self._archive.namelist():
            raise AssetError("no such array" if name not in self.names else "is no array", where=where)
        size = self._archive.getinfo(f"{name}.npy").file_size
        if size > memory_limit():
            raise AssetError(
                "array too large for this machine's memory",
                where=where,
                value=f"{size / 1e9:.1f} GB",
                accepted=f"at most {memory_limit() / 1e9:.1f} GB",
            )
        with self._archive.open(f"{name}.npy") as member:
            npy_header(member, size, where)
        with self._archive.open(f"{name}.npy") as member:
            return np.lib.format.read_array(member, allow_pickle=False)


def memory_limit() -> int:
    """Bytes that one file may make us hold: half of the machine's memory."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2


@contextlib.contextmanager
def numpy_errors(path: str | os.PathLike) -> Iterator[None]:
    """Any failure to load ``path`` with NumPy as an AssetError: on damaged bytes it raises what its header parser,
    zipfile and zlib happen to (TokenError, BadZipFile, zlib.error, NotImplementedError, MemoryError …)."""
    try:
        yield
    except AssetError:
        raise
    except Exception as error:
        raise AssetError(
            f"cannot read: {' '.join(str(error).split())[:160] or type(error).__name__}", where=str(path)
        ) from error
