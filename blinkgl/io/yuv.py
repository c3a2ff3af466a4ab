"""Planes and orientation of FFmpeg's frames, and RGB of planar YUV, rounded once: FFmpeg's fast conversion is up to a
code too dark, its exact one takes longer than everything else that a frame goes through."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.machine.kernels import kernel

# Red and blue weights of luma, by the matrix' number in ITU-T H.273; an unstated one (2) is BT.601's.
_WEIGHTS = {
    1: (0.2126, 0.0722), 2: (0.299, 0.114), 4: (0.30, 0.11), 5: (0.299, 0.114), 6: (0.299, 0.114), 7: (0.212, 0.087),
    9: (0.2627, 0.0593), 10: (0.2627, 0.0593),
}  # fmt: skip


def known(matrix: int) -> bool:
    """Return whether :func:`rgb_from_yuv` has this matrix, a number of ITU-T H.273."""
    return matrix in _WEIGHTS


def rgb_from_yuv(
    planes: tuple[np.ndarray, np.ndarray, np.ndarray], bits: int, matrix: int, limited: bool
) -> np.ndarray:
    """Return (H, W, 3) RGB of planes Y (H, W), U and V, which may have half as many rows or columns: uint8 of 8 bits,
    else uint16 of full scale. Chroma is that of the nearest sample.

    bits : of a sample.   matrix : number of ITU-T H.273.   limited : whether Y is 16 to 235 of 8 bits and chroma 16 to
    240, by equation 20 to 28 there."""
    red, blue = _WEIGHTS[matrix]
    green, step = 1 - red - blue, 2.0 ** (bits - 8)
    low, span, chroma = (16 * step, 219 * step, 224 * step) if limited else (0.0, 2.0**bits - 1, 2.0**bits - 1)
    top = 255 if bits == 8 else 65535
    y, u, v = planes
    out = np.empty((*y.shape, 3), np.uint8 if bits == 8 else np.uint16)
    # Factors: luma, Cr in red, Cb in green, Cr in green, Cb in blue; then black, the middle of chroma, and white.
    factors = np.array(
        [
            top / span,
            2 * (1 - red) * top / chroma,
            2 * (1 - blue) * blue / green * top / chroma,
            2 * (1 - red) * red / green * top / chroma,
            2 * (1 - blue) * top / chroma,
            low,
            2.0 ** (bits - 1),
            top,
        ],
        np.float32,
    )
    _convert(y, u, v, y.shape[0] > u.shape[0], y.shape[1] > u.shape[1], factors, out)
    return out


@kernel
def _convert(y, u, v, halved_rows, halved_columns, factors, out):
    luma, r_v, g_u, g_v, b_u = factors[0], factors[1], factors[2], factors[3], factors[4]
    low, middle, top, half = factors[5], factors[6], factors[7], np.float32(0.5)
    for row in range(y.shape[0]):
        below = row // 2 if halved_rows else row
        for column in range(y.shape[1]):
            right = column // 2 if halved_columns else column
            # Whole numbers are cut off below, so half a code rounds to the nearest.
            light = (np.float32(y[row, column]) - low) * luma + half
            cb, cr = np.float32(u[below, right]) - middle, np.float32(v[below, right]) - middle
            out[row, column, 0] = min(max(light + r_v * cr, np.float32(0)), top)
            out[row, column, 1] = min(max(light - g_u * cb - g_v * cr, np.float32(0)), top)
            out[row, column, 2] = min(max(light + b_u * cb, np.float32(0)), top)


def cut_riff(path: Path) -> str | None:
    """Return the damage of an AVI file whose chunks are longer than it; None: they are not."""
    at, total = 0, path.stat().st_size
    with open(path, "rb") as file:
        while at + 8 <= total:
            file.seek(at)
            kind, size = file.read(4), int.from_bytes(file.read(4), "little")
            if kind != b"RIFF" or size in (0, 0xFFFFFFFF):  # a file that was never finished states no size
                return None
            at += 8 + size + size % 2
    return f"{total} of {at} bytes" if at > total + 1 else None


def orientation_of(frame: Any) -> tuple[bool, bool, bool]:
    """Return (transposed, mirrored left to right, upside down), in the order of application, by which a frame becomes
    upright: x' = a x + c y, y' = b x + d y of its display matrix (ISO 14496-12, 8.3.2)."""
    try:
        # By its key: what iterating yields differs between versions of PyAV.
        data = frame.side_data.get("DISPLAYMATRIX")
    except ValueError:
        # Beside it lies what PyAV has no name for.
        if frame.rotation:
            raise AssetError("a turned picture with unknown side data", value=frame.rotation, accepted="0") from None
        data = None
    if data is None:
        return False, False, False
    # The matrix has nine 32-bit numbers, row by row: a b u, c d v, x y w.
    a, b, _, c, d = np.frombuffer(bytes(data), np.int32)[:5].tolist()
    return (True, c < 0, b < 0) if abs(b) > abs(a) else (False, a < 0, d < 0)


def samples_of(plane: Any, bits: int) -> np.ndarray:
    """Return a plane's samples, (H, W) uint8 or uint16."""
    dtype = np.dtype(np.uint8) if bits <= 8 else np.dtype("<u2")
    # Rows are padded to line_size bytes.
    return np.frombuffer(plane, dtype).reshape(-1, plane.line_size // dtype.itemsize)[: plane.height, : plane.width]


def floats_of(frame: Any) -> np.ndarray:
    """Return (H, W), (H, W, 3) or (H, W, 4) float32 of a frame of 16- or 32-bit floats, planes G, B, R, A."""
    dtype = np.dtype("<f2") if "f16" in frame.format.name else np.dtype("<f4")
    planes = [
        np.frombuffer(plane, dtype).reshape(frame.height, -1)[:, : frame.width].astype(np.float32)
        for plane in frame.planes
    ]
    return planes[0] if len(planes) == 1 else np.stack([planes[k] for k in (2, 0, 1, 3)[: len(planes)]], axis=-1)
