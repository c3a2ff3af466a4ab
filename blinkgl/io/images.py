"""Images, masks, ids, depth and normals of a sequence; NumPy files, whose headers are checked before use; transparent
pixels of given pictures: composited over one colour, and said."""

from __future__ import annotations

import io
import math
import os
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, BinaryIO, cast

import cv2
import numpy as np
from PIL import Image

from blinkgl.errors import AssetError, OutputError
from blinkgl.io.reading import Damage
from blinkgl.io.records import check_claim, decoding, input_errors, most_unpacked
from blinkgl.machine.closing import Closing
from blinkgl.srgb import to_srgb8

_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_MAX_PIXELS = 1 << 28


def encode_image(image: np.ndarray) -> bytes:
    """Return an sRGB PNG of (H, W) or (H, W, 3) RGB; float is linear light, uint8 and uint16 are stored unchanged."""
    image = np.asarray(image)
    if image.dtype.kind == "f":
        image = to_srgb8(image)
    return encode_png(image[..., ::-1] if image.ndim == 3 else image)


def read_image(path: str | os.PathLike) -> np.ndarray:
    """Return (H, W) or (H, W, 3) RGB as stored (uint8, uint16)."""
    image = read_png(path)
    return np.ascontiguousarray(image[..., 2::-1]) if image.ndim == 3 else image


def encode_mask(mask: np.ndarray) -> bytes:
    """Return an 8-bit PNG, 0 or 255, of a (H, W) bool."""
    return encode_png(np.asarray(mask, bool).astype(np.uint8) * np.uint8(255))


def read_mask(path: str | os.PathLike) -> np.ndarray:
    """Return a mask, (H, W) bool."""
    return _one_channel(path, "a mask") > 0


def encode_ids(ids: np.ndarray) -> bytes:
    """Return a 16-bit PNG of (H, W) instance ids. Raises ValueError when one does not fit."""
    ids = np.asarray(ids)
    if ids.size and (ids.min() < 0 or ids.max() > 65535):
        raise ValueError(f"instance ids must fit uint16, got {ids.min()}..{ids.max()}")
    return encode_png(ids.astype(np.uint16))


def read_ids(path: str | os.PathLike) -> np.ndarray:
    """Return (H, W) integers as stored. Raises AssetError."""
    return _one_channel(path, "a picture of ids")


def _one_channel(path: str | os.PathLike, what: str) -> np.ndarray:
    image = read_png(path)
    if image.ndim != 2:
        raise AssetError(f"not {what}", where=str(path), value=image.shape, accepted="one channel")
    return image


def encode_npy(array: np.ndarray) -> bytes:
    """Return .npy bytes; object arrays are refused (they would be pickled)."""
    return encoded(np.save, np.ascontiguousarray(array), allow_pickle=False)


def encoded(save: Callable[..., None], *given: object, **named: object) -> bytes:
    """Return the bytes that ``save(file, …)`` writes, one of NumPy's."""
    buffer = io.BytesIO()
    save(buffer, *given, **named)
    return buffer.getvalue()


def read_npy(path: str | os.PathLike) -> np.ndarray:
    """Return an array. Raises AssetError when missing, not a .npy, truncated, of objects, or when its length does not
    match its shape."""
    with numpy_errors(path):
        check_npy(path)
        return np.load(path, allow_pickle=False)


def check_npy(path: str | os.PathLike) -> None:
    """Check a .npy file. Raises the errors of :func:`npy_header`, and OSError."""
    with open(path, "rb") as file:
        npy_header(file, os.fstat(file.fileno()).st_size, str(path))


def npy_header(file: BinaryIO, size: int, where: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return (shape, Fortran order?, dtype) at the beginning of ``file``, ``size`` bytes long, and leave it where the
    data begin.

    Raises AssetError: objects (they would be unpickled), or a shape that does not match the bytes; and what NumPy
    raises."""
    shape, fortran, dtype = _header(file)
    if dtype.hasobject:
        raise AssetError(
            "array of Python objects, which can run any code when loaded; refused",
            where=where,
            accepted="an array of numbers",
        )
    expected = file.tell() + math.prod(shape) * dtype.itemsize
    if size != expected or min(shape, default=0) < 0:
        raise AssetError(
            "truncated or malformed array: its header does not match its length",
            where=where,
            value=f"{dtype} {shape} in {size} bytes",
            accepted=f"{expected} bytes",
        )
    return shape, fortran, dtype


def _header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    return read(file)


class NpzReader(Closing):
    """The arrays of an .npz by name; each is read when requested. Never unpickles. Use as a context manager.

    Raises (inside :func:`numpy_errors`) AssetError: an entry that is not a plain array of numbers; arrays that unpack
    to more than :func:`~blinkgl.io.records.check_claim` allows."""

    def __init__(self, path: str | os.PathLike):
        self.path, self._archive, self._unpacked = path, zipfile.ZipFile(path), 0
        self.names = [n.removesuffix(".npy") for n in self._archive.namelist()]

    def close(self) -> None:
        self._archive.close()

    def shapes(self) -> tuple[dict[str, tuple[tuple[int, ...], np.dtype]], list[str]]:
        """Return shape and type of each array, of which only the headers are read, and the names of the members that
        would have to be unpickled."""
        shapes, pickled = {}, []
        for name in self.names:
            member = f"{name}.npy"
            if member in self._archive.namelist():
                with self._archive.open(member) as file:
                    shape, _, dtype = _header(file)
                if dtype.hasobject:
                    pickled.append(name)
                else:
                    shapes[name] = shape, dtype
        return shapes, pickled

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def __getitem__(self, name: str) -> np.ndarray:
        where = f"{self.path}: '{name}'"
        if f"{name}.npy" not in self._archive.namelist():
            raise AssetError("no such array" if name not in self.names else "is no array", where=where)
        size = self._archive.getinfo(f"{name}.npy").file_size
        # All arrays count: a small archive may hold many that are as large as is allowed.
        self._unpacked += size
        check_claim(self._unpacked, where, os.path.getsize(self.path))
        with self._archive.open(f"{name}.npy") as member:
            npy_header(cast(BinaryIO, member), size, where)
        with self._archive.open(f"{name}.npy") as member:
            return np.lib.format.read_array(member, allow_pickle=False)

    def header(self, name: str) -> tuple[tuple[int, ...], np.dtype, int]:
        """Return shape and type of an array whose rows can be read, and where its data begin. Raises AssetError: it has
        no rows of numbers."""
        size = self._archive.getinfo(f"{name}.npy").file_size
        with self._archive.open(f"{name}.npy") as member:
            shape, fortran, dtype = npy_header(cast(BinaryIO, member), size, f"{self.path}: '{name}'")
            if fortran or not shape or dtype.kind not in "fiu":
                raise AssetError(
                    f"array '{name}' is not a C-ordered array of numbers",
                    where=str(self.path),
                    value=f"{dtype} {shape}",
                )
            return shape, dtype, member.tell()

    def row(self, name: str, k: int) -> np.ndarray:
        """Return row ``k`` of an array, without the others. Raises as :meth:`header`."""
        shape, dtype, start = self.header(name)
        size = math.prod(shape[1:]) * dtype.itemsize
        check_claim(size, str(self.path), os.path.getsize(self.path))
        with self._archive.open(f"{name}.npy") as member:
            member.seek(start + k * size)
            return np.frombuffer(member.read(size), dtype).reshape(shape[1:])


def checked_arrays(
    path: str | os.PathLike, shapes: dict[str, tuple[str, str]], optional: dict[str, tuple[str, str]] | None = None
) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz by name, each of its shape and number type.

    shapes : array -> its axes and NumPy's kinds of number. A digit is a length; a letter is one that all arrays share.
    optional : the same; arrays that are there, all of them, or none. Raises AssetError: missing, damaged, another shape
    or type, a number that is not finite."""
    sizes: dict[str, int] = {}
    with numpy_errors(path), NpzReader(path) as file:
        wanted = {**shapes, **(optional or {})} if any(name in file for name in optional or ()) else shapes
        stated, _ = file.shapes()
        for name, (axes, kinds) in wanted.items():
            shape, (length, dtype) = (), stated.get(name, ((), np.dtype("V")))
            # A letter has the length that the first array with this letter gives it.
            for axis, side in zip(axes, length):
                shape += (int(axis) if axis.isdigit() else sizes.setdefault(axis, side),)
            if name in stated and (len(length) != len(axes) or length != shape or dtype.kind not in kinds):
                raise AssetError(
                    f"'{name}' has the wrong shape or type",
                    where=str(path),
                    value=f"{dtype} {length}",
                    accepted=f"({', '.join(axes)})" + "".join(f", {k} = {n}" for k, n in sizes.items()),
                )
        # Headers alone were read so far.
        arrays = {name: file[name] for name in wanted}
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise AssetError(f"'{name}' holds NaN or infinity", where=str(path))
    return arrays


def numpy_errors(path: str | os.PathLike) -> AbstractContextManager[None]:
    """Convert any failure to load ``path`` with NumPy to an AssetError: on damaged bytes it raises exceptions of its
    header parser, zipfile and zlib (TokenError, BadZipFile, zlib.error, NotImplementedError, MemoryError …)."""
    return decoding(path, "cannot read")


def over(
    image: np.ndarray, background: tuple[int, int, int] | None, *, associated: bool | None = None
) -> tuple[np.ndarray, str | None]:
    """Return (H, W, 2) or (H, W, 4) without its alpha, (H, W) or (H, W, 3), composited over ``background`` (0 to 255 of
    full scale; None: black), and the line that says so; None where every pixel is opaque.

    Codes are mixed as viewers and browsers do, alpha being straight, and floats (OpenEXR) are premultiplied light,
    unless the file states whether alpha is ``associated``, multiplied already."""
    colour, alpha = image[..., :-1], image[..., -1:]
    top = 1.0 if image.dtype.kind == "f" else float(np.iinfo(image.dtype).max)
    grey = colour.shape[-1] == 1
    if (alpha >= 0.998 * top).all():  # FFmpeg widens 10 bits to 1023 * 64
        return (colour[..., 0] if grey else colour), None
    below = np.asarray(background or (0, 0, 0), np.float64) / 255 * top
    # A grey picture takes the luminance of the colour, by BT.709's weights.
    below = below @ [0.2126, 0.7152, 0.0722] if grey else below
    share = alpha / top
    multiplied = image.dtype.kind == "f" if associated is None else associated
    mixed = (colour if multiplied else colour * share) + below * (1 - share)
    mixed = mixed.astype(np.float32) if image.dtype.kind == "f" else np.rint(np.minimum(mixed, top)).astype(image.dtype)
    name = "black" if background is None else "#{:02x}{:02x}{:02x}".format(*background)
    return (mixed[..., 0] if grey else mixed), f"transparent pixels are shown over {name} (--background for another)"


# ---------------------------------------------------------------------------------------------------------------------
# Portable float map: "PF" (3 channels) or "Pf" (1), width height, scale (negative: little-endian), rows bottom-up.

_HEADER = re.compile(
    rb"^(PF|Pf)\s+(\d{1,9})\s+(\d{1,9})\s+([-+]?(?:\d{1,40}\.?\d{0,40}|\.\d{1,40})(?:[eE][-+]?\d{1,4})?)[ \t\r]?\n"
)


def read_pfm(path: str | os.PathLike) -> np.ndarray:
    """Return (H, W) or (H, W, 3) float32, row 0 = top. Raises AssetError: wrong header or length."""
    with input_errors(path):
        data = Path(path).read_bytes()
    header = _HEADER.match(data)
    if not header:
        raise AssetError("not a PFM file: wrong header", where=str(path))
    kind, width, height, scale = header.group(1), int(header.group(2)), int(header.group(3)), float(header.group(4))
    channels = 3 if kind == b"PF" else 1
    expected = header.end() + 4 * width * height * channels
    if len(data) != expected or width == 0 or height == 0 or not 0 < abs(scale) < float("inf"):
        raise AssetError(
            "truncated or malformed PFM file", where=str(path), value=f"{len(data)} bytes", accepted=f"{expected}"
        )
    # The sign of the scale tells the order of the bytes; its size is not applied.
    pixels = np.frombuffer(data, "<f4" if scale < 0 else ">f4", offset=header.end()).astype(np.float32)
    return np.ascontiguousarray(pixels.reshape((height, width, 3) if channels == 3 else (height, width))[::-1])


def encode_png(image: np.ndarray, strategy: int = cv2.IMWRITE_PNG_STRATEGY_RLE) -> bytes:
    """Return a fast PNG (level 1) of (H, W) or (H, W, 3) in BGR order, uint8 or uint16."""
    ok, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, strategy])
    if not ok:
        raise OutputError("PNG encoding failed", value=f"{image.dtype} {image.shape}")
    return data.tobytes()


def read_png(path: str | os.PathLike) -> np.ndarray:
    """Return pixels as stored, channels in OpenCV's BGR order, of a PNG or another image that OpenCV decodes. Raises
    AssetError when missing, truncated, undecodable, or of more than 2^28 px (checked before unpacking)."""
    with input_errors(path, "cannot read image"):
        return decode_image(Path(path).read_bytes(), path)


def decode_image(data: bytes, path: str | os.PathLike) -> np.ndarray:
    """Return :func:`read_png` of bytes already read."""
    if (problem := _image_problem(data)) is not None:
        raise Damage(problem, where=str(path))
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise Damage("cannot decode image (corrupt or truncated)", where=str(path))
    return image


def _image_problem(data: bytes) -> str | None:
    """Return a problem of an image file that OpenCV would ignore: it fills missing parts with grey."""
    if data[:8] == _PNG_MAGIC:
        return png_problem(data)
    if data[:2] == b"\xff\xd8":
        return "a JPEG, where pictures without loss are read"
    if data[:2] == b"#?":
        size_line = re.search(rb"\n[-+][XY] (\d{1,9}) [-+][XY] (\d{1,9})\n", data[:8192])
        # Radiance usually states rows first: -Y HEIGHT +X WIDTH.
        size = size_line and (int(size_line[2]), int(size_line[1]))
    else:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                with Image.open(io.BytesIO(data)) as opened:  # reads only the header
                    size = opened.size
        except Exception:  # noqa: BLE001 - unknown to Pillow, or damaged: its plug-ins raise anything; OpenCV decides
            return "cannot decode image (corrupt or truncated)" if not len(data) else None
    if not size:
        return "cannot decode image (no size in its header)"
    # OpenCV unpacks Radiance to three float32 a pixel; for other kinds four bytes are taken.
    return size_problem(*size, len(data), 12 if data[:2] == b"#?" else 4)


def png_problem(data: bytes) -> str | None:
    """Return a problem of the chunks (length, type, content, CRC) up to IEND. (PNG specification, section 5)"""
    # 33 bytes are the signature and the chunk IHDR.
    if data[12:16] != b"IHDR" or len(data) < 33:
        return "cannot decode image (corrupt or truncated)"
    at = 8
    for at, kind, body in png_chunks(data):
        if zlib.crc32(kind + body).to_bytes(4, "big") != data[at + 8 + len(body) : at + 12 + len(body)]:
            break
        if kind == b"IEND":
            # Bit depth and colour type follow width and height; a type counts its channels by its bits.
            width, height, bits, colour = struct.unpack_from(">IIBB", data, 16)
            return size_problem(width, height, len(data), -(-bits // 8) * {2: 3, 4: 2, 6: 4}.get(colour, 1))
        at += 12 + len(body)
    return f"cannot decode image (corrupt or truncated at byte {at})"


def chunks_before_pixels(path: Path) -> dict[bytes, bytes]:
    """Return the chunks of a PNG file before its pixels, by their types; of large ones (profiles) nothing."""
    chunks: dict[bytes, bytes] = {}
    with open(path, "rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8 and len(chunks) < _MOST_CHUNKS:
            length, kind = struct.unpack(">I4s", head)
            if kind in (b"IDAT", b"IEND"):
                break
            # Content and CRC; beyond the end nothing is left to read.
            chunks[kind] = file.read(length) if length < _LARGE_CHUNK else b""
            file.seek(4 if length < _LARGE_CHUNK else length + 4, os.SEEK_CUR)
    return chunks


_LARGE_CHUNK, _MOST_CHUNKS = 1 << 16, 1000


def png_chunks(data: bytes) -> Iterator[tuple[int, bytes, bytes]]:
    """Yield where each chunk begins, its type, and its content, of which the last one's may be cut."""
    # The signature has 8 bytes; a chunk's length, type and CRC have 4 each.
    at = 8
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        yield at, kind, data[at + 8 : at + 8 + length]
        at += 12 + length


def size_problem(width: int, height: int, packed: int, depth: int = 4) -> str | None:
    """Return why an image of this size, in so many bytes, is not read, or None.   depth : bytes of a pixel."""
    most = min(_MAX_PIXELS, most_unpacked(packed) // depth)
    if 0 < width * height <= most:
        return None
    return f"image of {width}x{height} px is too large (at most {most >> 20} Mpx" + (
        f" in {packed} bytes)" if most < _MAX_PIXELS else ")"
    )
