"""Flow fields by file ending: .png (DSEC's 16 bit), .flo (Middlebury), .npy (u, v[, valid], as BlinkFlow's)."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import cv2
import numpy as np

from blinkgl.config.frames import FLOW_FORMATS
from blinkgl.errors import AssetError, OutputError
from blinkgl.io.atomic import output_errors, write_whole
from blinkgl.io.images import encode_npy, encode_png, read_npy, read_pfm, read_png
from blinkgl.io.records import input_errors

# ---------------------------------------------------------------------------------------------------------------------
# Flow as 16-bit PNG: DSEC's (quantum 1/128 px, ±256 px) and KITTI's (1/64 px, ±512 px).
#
# On disk the channels are R = x, G = y, B = valid. OpenCV is the codec, since Pillow silently returns
# 8 bits for 16-bit RGB; OpenCV's order is BGR, so the order is turned here and nowhere else.

DSEC_SCALE, KITTI_SCALE = 128.0, 64.0
_ZERO = 1 << 15


def encode_flow_png(flow: np.ndarray, valid: np.ndarray, *, scale: float = DSEC_SCALE) -> tuple[bytes, int]:
    """Return the PNG bytes of a flow field.

    flow : (H, W, 2) float px, +x right, +y down. valid : (H, W) bool.
    Returns (png, lost): ``lost`` counts valid pixels that the format cannot hold (beyond -256 … 255.99 px for DSEC, or
    not finite). They are stored as invalid instead of being clipped to a wrong flow. Invalid pixels hold zero flow.
    """
    valid = np.asarray(valid, bool)
    with np.errstate(invalid="ignore", over="ignore"):
        # The code is 2^15 + scale * flow, rounded; float32 holds whole numbers of this size exactly.
        code = np.asarray(flow, np.float32) * np.float32(scale)
        np.rint(code, out=code)
        code += np.float32(_ZERO)
        if code.size and code.min() >= 0 and code.max() <= 65535:  # the usual case; NaN is neither
            holds = np.ones(valid.shape, bool)
        else:
            holds = ((code >= 0) & (code <= 65535)).all(axis=-1)
    stored = valid & holds
    code[~stored] = _ZERO
    bgr = np.empty((*valid.shape, 3), np.uint16)
    # In OpenCV's order: blue is validity, green is y and red is x.
    bgr[..., 0], bgr[..., 1:] = stored, code[..., ::-1]
    # Level 1: half as large as level 0 and as fast; level 6 saves another half for three times the time.
    return encode_png(bgr, cv2.IMWRITE_PNG_STRATEGY_DEFAULT), int(np.count_nonzero(valid & ~holds))


def write_flow_png(path: str | os.PathLike, flow: np.ndarray, valid: np.ndarray) -> int:
    """Write :func:`encode_flow_png`; return the number of valid pixels that the format could not hold."""
    png, lost = encode_flow_png(flow, valid)
    with output_errors(path):
        Path(path).write_bytes(png)
    return lost


def read_flow_png(path: str | os.PathLike, *, scale: float = DSEC_SCALE) -> tuple[np.ndarray, np.ndarray]:
    """Return flow (H, W, 2) float32 px (0 where invalid), valid (H, W) bool.

    Raises AssetError when the file is not a 16-bit RGB PNG."""
    raw = _sixteen_bits(Path(path))
    valid = raw[..., 0] > 0
    # Channel 2, red, is x and channel 1, green, is y.
    flow = (raw[..., 2:0:-1].astype(np.float32) - np.float32(_ZERO)) / np.float32(scale)
    return np.where(valid[..., None], flow, np.float32(0)), valid


# ---------------------------------------------------------------------------------------------------------------------
# Middlebury .flo: float32 202021.25, int32 width, height, then u, v interleaved, rows top-down, little-endian.

_TAG = 202021.25
_UNKNOWN = 1e9
_MAX_SIDE = 99999  # limit of Middlebury's own reader


def encode_flo(flow: np.ndarray, valid: np.ndarray | None = None) -> bytes:
    """Return the bytes of flow, (H, W, 2) px; where ``valid`` (H, W) is False, the format's "unknown" (1e10) is
    stored."""
    data = np.array(flow, "<f4", order="C")
    if valid is not None:
        data[~np.asarray(valid, bool)] = 1e10
    return struct.pack("<fii", _TAG, data.shape[1], data.shape[0]) + data.tobytes()


def read_flo(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
    """Return flow (H, W, 2) float32 px (0 where unknown), valid (H, W) bool. Raises AssetError: wrong tag, size or
    length."""
    with input_errors(path):
        data = Path(path).read_bytes()
    if len(data) < 12 or struct.unpack_from("<f", data)[0] != _TAG:
        raise AssetError("not a .flo file: wrong tag", where=str(path), accepted=f"{_TAG}")
    # Width and height follow the tag, then u and v of each pixel, 8 bytes.
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


# ---------------------------------------------------------------------------------------------------------------------
# Other data sets' flow: KITTI's and TartanAir v2's PNGs with 1/64 px, Virtual KITTI 2's in shares of the image's size,
# FlyingThings3D's PFM, Spring's HDF5 of twice the images' size.

ENDINGS = (".png", ".flo", ".npy")
"""Endings of the files that are written."""
READ_ENDINGS = (".png", ".flo", ".npy", ".pfm", ".flo5")


def flow_form(path: str | os.PathLike) -> tuple[str, str | None]:
    """Return the form of a flow file, one of ``FLOW_FORMATS``, and the line that says a guess, or None: 16-bit PNGs do
    not say whose they are. Raises AssetError: unreadable."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix != ".png":
        return suffix[1:], None
    raw = _sixteen_bits(path)
    third, first = raw[..., 0], raw[..., 2]  # on disk blue and red
    # A mask has small numbers, while flow near 0 is stored near 2^15.
    if first.max() <= 255 and (third.max() > 255 or raw[..., 1].max() > 255):
        form = "tartanair2"  # its mask comes first
    # Every eighth row and column is enough to see that the channel is a mask.
    elif set(np.unique(third[::8, ::8]).tolist()) <= {0, 65535} and third.max() == 65535:
        form = "vkitti2"
    else:
        form = "kitti" if any(part in ("flow_occ", "flow_noc") for part in path.parts) else "dsec"
    return form, f"{path.name}: 16-bit flow taken as {form}'s (flow_format: {', '.join(FLOW_FORMATS[:4])})"


def _sixteen_bits(path: Path) -> np.ndarray:
    raw = read_png(path)
    if raw.dtype != np.uint16 or raw.ndim != 3 or raw.shape[2] != 3:
        raise AssetError("not a flow PNG", where=str(path), value=f"{raw.dtype} {raw.shape}", accepted="16-bit RGB")
    return raw


def read_flow(path: str | os.PathLike, form: str | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return flow (H, W, 2) float32 px, +x right, +y down (0 where invalid), and valid (H, W) bool.

    form : one of ``FLOW_FORMATS``; None: by the ending, DSEC's for .png.   Raises AssetError: missing, damaged, not
    flow."""
    path = Path(path)
    if path.suffix.lower() not in READ_ENDINGS:
        raise AssetError(
            "unknown flow file ending", where=str(path), value=path.suffix, accepted=", ".join(READ_ENDINGS)
        )
    form = form or {".png": "dsec"}.get(path.suffix.lower(), path.suffix.lower()[1:])
    if form == "flo":
        return read_flo(path)
    if form in ("dsec", "kitti"):
        return read_flow_png(path, scale=DSEC_SCALE if form == "dsec" else KITTI_SCALE)
    if form == "tartanair2":
        # u is the third channel, and 0 in the first means that the point is seen in both images.
        raw = _sixteen_bits(path)
        return (raw[..., :2].astype(np.float32) - np.float32(_ZERO)) / np.float32(KITTI_SCALE), raw[..., 2] == 0
    stated: np.ndarray | bool = True
    if form == "vkitti2":
        # Shares of the width and height less one, from -1 to 1.
        raw = _sixteen_bits(path)
        size = np.array([raw.shape[1] - 1, raw.shape[0] - 1], np.float32)
        flow, stated = (raw[..., 2:0:-1].astype(np.float32) * np.float32(2 / 65535) - 1) * size, raw[..., 0] > 0
    elif form == "pfm":
        data = read_pfm(path)
        if data.ndim != 3:
            raise AssetError("not a flow field", where=str(path), value=data.shape, accepted="PFM of three channels")
        flow = data[..., :2]
    elif form == "flo5":
        flow = read_flo5(path)
    else:
        flow, stated = read_flow_npy(path)
    valid: np.ndarray = np.logical_and(stated, np.isfinite(flow).all(-1))
    return np.where(valid[..., None], flow, np.float32(0)), valid


def read_flo5(path: str | os.PathLike) -> np.ndarray:
    """Return flow (H, W, 2) float32 of Spring's .flo5, every second row and column: it is of twice the images' size, in
    their px. Raises AssetError."""
    from blinkgl.io.hdf5 import dataset, open_hdf5

    with open_hdf5(Path(path)) as file:
        data = dataset(file, "flow", Path(path), shape=(None, None, 2), kinds="f")
        return np.ascontiguousarray(data[::2, ::2], np.float32)


def read_flow_npy(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
    """Return flow (H, W, 2) float32 px as in a .npy of (H, W, 2) or, with validity, (H, W, 3), NaN included; and the
    file's validity, (H, W) bool, all True where it has none.

    Raises AssetError: missing, damaged, or not flow."""
    data = read_npy(path)
    if data.ndim != 3 or data.shape[2] not in (2, 3) or data.dtype.kind != "f":
        raise AssetError(
            "not a flow field",
            where=str(path),
            value=f"{data.dtype} {data.shape}",
            accepted="float (H, W, 2) or (H, W, 3)",
        )
    stated = data[..., 2] > 0 if data.shape[2] == 3 else np.ones(data.shape[:2], bool)
    return data[..., :2].astype(np.float32), stated


def encode_flow_npy(flow: np.ndarray, valid: np.ndarray) -> bytes:
    """Return (H, W, 3) float32 of u, v (0 where invalid) and 1 or 0."""
    return encode_npy(np.dstack([np.where(valid[..., None], flow, 0), valid]).astype(np.float32))


def write_flow(path: str | os.PathLike, flow: np.ndarray, valid: np.ndarray) -> int:
    """Write flow (H, W, 2) px and valid (H, W) bool; the file appears completely or not at all. Return the number of
    valid pixels that the format could not hold (.png: beyond -256 ... 255.99 px), which are stored as invalid.

    Raises OutputError: unknown ending, or it cannot be written."""
    ending, lost = Path(path).suffix.lower(), 0
    if ending not in ENDINGS:
        raise OutputError("unknown flow file ending", where=str(path), value=ending, accepted=", ".join(ENDINGS))
    if ending == ".png":
        encoded, lost = encode_flow_png(flow, valid)
    else:
        encoded = encode_flo(flow, valid) if ending == ".flo" else encode_flow_npy(flow, valid)
    write_whole(path, encoded)
    return lost
