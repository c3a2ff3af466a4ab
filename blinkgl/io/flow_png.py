"""Flow as 16-bit PNG: DSEC's (quantum 1/128 px, ±256 px) and KITTI's (1/64 px, ±512 px).

On disk the channels are R = x, G = y, B = valid. OpenCV is the codec because imageio's default and Pillow silently
return 8 bits for 16-bit RGB; it speaks BGR, so the order is turned here and nowhere else.
"""

from __future__ import annotations

import io
import os
import re
import struct
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from blinkgl.errors import AssetError, OutputError
from blinkgl.io.atomic import output_errors

DSEC_SCALE = 128.0
_ZERO = 1 << 15
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_MAX_PIXELS = 1 << 28


def encode_flow_png(flow: np.ndarray, valid: np.ndarray, *, scale: float = DSEC_SCALE) -> tuple[bytes, int]:
    """PNG bytes of a flow field.

    flow : (H, W, 2) float px, +x right, +y down. valid : (H, W) bool.
    Returns (png, lost): ``lost`` counts valid pixels that the format cannot hold (beyond -256 … 255.99 px for DSEC, or
    not finite). They are stored as invalid instead of being clipped to a wrong flow. Invalid pixels hold zero flow.
    """
    valid = np.asarray(valid, bool)
    with np.errstate(invalid="ignore", over="ignore"):
        code = np.asarray(flow, np.float32) * np.float32(scale)
        np.rint(code, out=code)
        code += np.float32(_ZERO)
        if code.size and code.min() >= 0 and code.max() <= 65535:  # as nearly always; NaN is neither
            holds = np.ones(valid.shape, bool)
        else:
            holds = ((code >= 0) & (code <= 65535)).all(axis=-1)
    stored = valid & holds
    code[~stored] = _ZERO
    bgr = np.empty((*valid.shape, 3), np.uint16)
    bgr[..., 0], bgr[..., 1:] = stored, code[..., ::-1]
    # Level 1: half as large as level 0 and as fast; level 6 saves another half for three times the time.
    return encode_png(bgr, cv2.IMWRITE_PNG_STRATEGY_DEFAULT), int(np.count_nonzero(valid & ~holds))


def write_flow_png(path: str | os.PathLike, flow: np.ndarray, valid: np.ndarray, *, scale: float = DSEC_SCALE) -> int:
    """Writes :func:`encode_flow_png`; returns the count of valid pixels the format could not hold."""
    png, lost = encode_flow_png(flow, valid, scale=scale)
    with output_errors(path):
        Path(path).write_bytes(png)
    return lost


def read_flow_png(path: str | os.PathLike, *, scale: float = DSEC_SCALE) -> tuple[np.ndarray, np.ndarray]:
    """flow (H, W, 2) float32 px (0 where invalid), valid (H, W) bool.

    Raises AssetError when the file is not a 16-bit RGB PNG."""
    raw = read_png(path)
    if raw.dtype != np.uint16 or raw.ndim != 3 or raw.shape[2] != 3:
        raise AssetError("not a flow PNG", where=str(path), value=f"{raw.dtype} {raw.shape}", accepted="16-bit RGB")
    valid = raw[..., 0] > 0
    flow = (raw[..., 2:0:-1].astype(np.float32) - np.float32(_ZERO)) / np.float32(scale)
    return np.where(valid[..., None], flow, np.float32(0)), valid


def encode_png(image: np.ndarray, strategy: int = cv2.IMWRITE_PNG_STRATEGY_RLE) -> bytes:
    """PNG at the fast end (level 1). (H, W) or (H, W, 3) in BGR order, uint8 or uint16."""
    ok, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, strategy])
    if not ok:
        raise OutputError("PNG encoding failed", value=f"{image.dtype} {image.shape}")
    return data.tobytes()


def read_png(path: str | os.PathLike) -> np.ndarray:
    """Pixels as stored, channels in OpenCV's BGR order, of a PNG or another image that OpenCV decodes; AssetError when
    missing, truncated, undecodable, or of more than 2^28 px (what it would unpack to is known before that happens)."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise AssetError(f"cannot read image: {error.strerror}", where=str(path)) from error
    if (problem := _image_problem(data)) is not None:
        raise AssetError(problem, where=str(path))
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise AssetError("cannot decode image (corrupt or truncated)", where=str(path))
    return image


def _image_problem(data: bytes) -> str | None:
    """What is wrong with an image file that OpenCV would pass over: it fills up what is missing with grey."""
    if data[:8] == _PNG_MAGIC:
        return _png_problem(data)
    if data[:2] == b"\xff\xd8" and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
        return "cannot decode image (truncated)"
    if data[:2] == b"#?":
        found = re.search(rb"\n[-+][XY] (\d{1,9}) [-+][XY] (\d{1,9})\n", data[:8192])
        size = found and (int(found[2]), int(found[1]))
    else:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                with Image.open(io.BytesIO(data)) as opened:  # reads the header only
                    size = opened.size
        except Exception:  # noqa: BLE001 - unknown to Pillow, or damaged: its plug-ins raise anything; OpenCV decides
            return "cannot decode image (corrupt or truncated)" if not len(data) else None
    return _size_problem(*size) if size else "cannot decode image (no size in its header)"


def _png_problem(data: bytes) -> str | None:
    """Chunks (length, type, content, CRC) up to IEND, all there and undamaged? (PNG specification, section 5)"""
    if data[12:16] != b"IHDR" or len(data) < 33:
        return "cannot decode image (corrupt or truncated)"
    at = 8
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        if end > len(data) or zlib.crc32(data[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            break
        if kind == b"IEND":
            return _size_problem(*struct.unpack_from(">II", data, 16))
        at = end
    return f"cannot decode image (corrupt or truncated at byte {at})"


def _size_problem(width: int, height: int) -> str | None:
    return (
        None
        if 0 < width * height <= _MAX_PIXELS
        else f"image of {width}x{height} px is too large (at most {_MAX_PIXELS >> 20} Mpx)"
    )
