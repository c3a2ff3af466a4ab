"""AEDAT 2.0 recordings as jAER writes them, made from events, frames and IMU values whose every number is known."""

from __future__ import annotations

import numpy as np

from blinkgl.types.events import Events

CHIP = "eu.seebetter.ini.chips.davis.DAVIS240C"
SIZES = {"DAVIS240C": (180, 240), "Davis346B": (260, 346)}


def header(chip: str | None = CHIP, *lines: str, end: bool = False) -> bytes:
    said = ["#!AER-DAT2.0", "# This is a raw AE data file - do not edit", "# Timestamps tick is 1 us"]
    said += [f"# AEChip: {chip}"] if chip else []
    said += [*lines, *(["# End Of ASCII Header"] if end else [])]
    return "".join(f"{line}\r\n" for line in said).encode()


def records(address, t) -> bytes:
    address, t = np.broadcast_arrays(np.asarray(address, np.int64), np.asarray(t, np.int64))
    return np.stack([address & 0xFFFFFFFF, t & 0xFFFFFFFF], 1).astype(">u4").tobytes()


def event_addresses(events: Events, height: int = 180, width: int = 240) -> np.ndarray:
    x, y, p = (getattr(events, k).astype(np.int64) for k in "xyp")
    return (height - 1 - y) << 22 | (width - 1 - x) << 12 | p << 11


def frame_addresses(read: np.ndarray, signal: bool) -> np.ndarray:
    """Samples (H, W), row 0 at the top, in the order of a read-out from the lower right corner, column by column."""
    height, width = read.shape
    x, y = (a.ravel() for a in np.meshgrid(np.arange(width)[::-1], np.arange(height), indexing="ij"))
    return 1 << 31 | y << 22 | x << 12 | int(signal) << 10 | read[height - 1 - y, x].astype(np.int64)


def imu_addresses(values: np.ndarray) -> np.ndarray:
    """(N, 7) int16 -> (7 N,)."""
    which = np.tile(np.arange(7), len(values))
    return 1 << 31 | which << 28 | (values.ravel().astype(np.int64) & 0xFFFF) << 12 | 3 << 10
