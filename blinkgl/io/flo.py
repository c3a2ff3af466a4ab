"""Middlebury .flo: float32 202021.25, int32 width, height, then u, v interleaved, rows top-down, little-endian."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.atomic import output_errors

_TAG = 202021.25
_UNKNOWN = 1e9
_MAX_SIDE = 99999  # Middlebury's own reader refuses beyond


def encode_flo(flow: np.ndarray, valid: np.ndarray | None = None) -> bytes:
    """flow: (H, W, 2) px; where ``valid`` (H, W) is False, the format's "unknown" (1e10) is stored."""
    data = np.array(flow, "<f4", order="C")
    if valid is not None:
        data[~np.asarray(valid, bool)] = 1e10
    return struct.pack("<fii", _TAG, data.shape[1], data.shape[0]) + data.tobytes()


def write_flo(path: str | os.PathLike, flow: np.ndarray, valid: np.ndarray | None = None) -> None:
    """See :func:`encode_flo`. Raises OutputError."""
    with output_errors(path):
        Path(path).write_bytes(encode_flo(flow, valid))


def read_flo(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
    """flow (H, W, 2) float32 px (0 where unknown), valid (H, W) bool. AssetError: wrong tag, size or length."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise AssetError(f"cannot read: {error.strerror}", where=str(path)) from error
    if len(data) < 12 or struct.unpack_from("<f", data)[0] != _TAG:
        raise AssetError("not a .flo file: wrong tag", where=str(path), accepted=f"{_TAG}")
    width, height = struct.unpack_from("<ii", data, 4)
    if not (0 < width <= _MAX_SIDE and 0 < height <= _MAX_SIDE):
        raise AssetError("impossible .flo size", where=str(path), value=(width, height))
    if len(data) != 12 + 8 * width * height:
        raise AssetError(
            "truncated .flo file" if len(data) < 12 + 8 * width * height else "trailing bytes in .flo file",
            where=str(path),
            value=len(data),
            accepted=f"{12 + 8 * width * height} bytes",
        )
    flow = np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2).astype(np.float32)
    valid = np.all(np.abs(flow) <= _UNKNOWN, axis=-1)  # NaN compares False
    return np.where(valid[..., None], flow, np.float32(0)), valid
