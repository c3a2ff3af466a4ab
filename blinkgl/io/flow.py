"""A flow field by its file's ending: .png (DSEC's 16 bit), .flo (Middlebury), .npy (u, v[, valid], as BlinkFlow's)."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError, OutputError
from blinkgl.io.atomic import atomic_file
from blinkgl.io.flo import encode_flo, read_flo
from blinkgl.io.flow_png import encode_flow_png, read_flow_png
from blinkgl.io.images import encode_npy, read_npy

ENDINGS = (".png", ".flo", ".npy")


def read_flow(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
    """flow (H, W, 2) float32 px, +x right, +y down (0 where invalid), and valid (H, W) bool.

    Raises AssetError: missing, damaged, or no flow."""
    path = Path(path)
    if path.suffix == ".flo":
        return read_flo(path)
    if path.suffix == ".png":
        return read_flow_png(path)
    if path.suffix != ".npy":
        raise AssetError("unknown flow file ending", where=str(path), value=path.suffix, accepted=", ".join(ENDINGS))
    flow, stated = read_flow_npy(path)
    valid = stated & np.isfinite(flow).all(-1)
    return np.where(valid[..., None], flow, np.float32(0)), valid


def read_flow_npy(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
    """flow (H, W, 2) float32 px as it stands in a .npy of (H, W, 2) or, with the validity, (H, W, 3), NaN included; and
    (H, W) bool what the file says is valid, all of it where it says nothing.

    Raises AssetError: missing, damaged, or no flow."""
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
    """(H, W, 3) float32 of u, v (0 where invalid) and 1 or 0."""
    return encode_npy(np.dstack([np.where(valid[..., None], flow, 0), valid]).astype(np.float32))


def write_flow(path: str | os.PathLike, flow: np.ndarray, valid: np.ndarray) -> int:
    """Writes flow (H, W, 2) px and valid (H, W) bool; the file appears whole or not at all. Returns how many valid
    pixels the format could not hold (.png: beyond -256 ... 255.99 px), which are stored as invalid.

    Raises OutputError: unknown ending, or it cannot be written."""
    ending, lost = Path(path).suffix, 0
    if ending not in ENDINGS:
        raise OutputError("unknown flow file ending", where=str(path), value=ending, accepted=", ".join(ENDINGS))
    if ending == ".png":
        encoded, lost = encode_flow_png(flow, valid)
    else:
        encoded = encode_flo(flow, valid) if ending == ".flo" else encode_flow_npy(flow, valid)
    with atomic_file(path, overwrite=True) as temporary:
        temporary.write_bytes(encoded)
    return lost
