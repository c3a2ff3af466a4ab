"""Portable float map: "PF" (3 channels) or "Pf" (1), width height, scale (negative: little-endian), rows bottom-up."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.atomic import output_errors

_HEADER = re.compile(
    rb"^(PF|Pf)\s+(\d{1,9})\s+(\d{1,9})\s+([-+]?(?:\d{1,40}\.?\d{0,40}|\.\d{1,40})(?:[eE][-+]?\d{1,4})?)[ \t\r]?\n"
)


def encode_pfm(image: np.ndarray) -> bytes:
    """(H, W) or (H, W, 3) float32, row 0 = top."""
    image = np.asarray(image)
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise ValueError(f"PFM holds (H, W) or (H, W, 3), got {image.shape}")
    kind = b"PF" if image.ndim == 3 else b"Pf"
    return kind + f"\n{image.shape[1]} {image.shape[0]}\n-1.0\n".encode() + image[::-1].astype("<f4").tobytes()


def write_pfm(path: str | os.PathLike, image: np.ndarray) -> None:
    """See :func:`encode_pfm`. Raises OutputError."""
    with output_errors(path):
        Path(path).write_bytes(encode_pfm(image))


def read_pfm(path: str | os.PathLike) -> np.ndarray:
    """(H, W) or (H, W, 3) float32, row 0 = top. AssetError: wrong header or length."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise AssetError(f"cannot read: {error.strerror}", where=str(path)) from error
    return decode_pfm(data, path)


def decode_pfm(data: bytes, path: str | os.PathLike) -> np.ndarray:
    """:func:`read_pfm` of bytes; ``path`` is for messages."""
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
    pixels = np.frombuffer(data, "<f4" if scale < 0 else ">f4", offset=header.end()).astype(np.float32)
    shape = (height, width, 3) if channels == 3 else (height, width)
    return np.ascontiguousarray(pixels.reshape(shape)[::-1])
