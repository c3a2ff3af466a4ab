"""Contrast thresholds of the pixels: drawn around the nominal ones, or measured ones from a file."""

from __future__ import annotations

import numpy as np

from blinkgl.config.events import EsimConfig, V2eConfig
from blinkgl.errors import EventDataError
from blinkgl.events.philox import Stream, in_blocks, normal2, pixel_counters

MIN_THRESHOLD = 0.01
"""Smallest threshold, ln units, that spread and jitter may draw."""
_MEASURED = 0.001, 10.0


def pixel_thresholds(
    height: int, width: int, config: EsimConfig | V2eConfig, seed: np.uint64
) -> tuple[np.ndarray, np.ndarray]:
    """Return (C+, C-) of the pixels, ln units, float64 (H*W,): those of ``config.threshold_map``, else drawn, normal
    around the nominal values, kept >= 0.01 and <= 10.

    For nominal thresholds under 0.02 the floor is half the nominal one. Raises AssetError and EventDataError as
    :func:`measured_thresholds`."""
    if config.threshold_map is not None:
        return measured_thresholds(config.threshold_map, height, width)
    # Draw 0 of the stream, one pair of normals per pixel: thresholds never change.
    spread = lambda pixels: normal2(seed, pixels, np.uint64(Stream.THRESHOLD), np.uint64(0))
    a, b = in_blocks(spread, pixel_counters(height, width))
    clip = lambda c, n: np.clip(c + config.threshold_sigma * n, min(MIN_THRESHOLD, c / 2), 10.0)
    on, off = config.thresholds
    return clip(on, a), clip(off, b)


def measured_thresholds(file: str, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (C+, C-) of a file, ln units, float64 (H*W,): of a .npy of floats, (H, W) or (2, H, W).

    Raises AssetError: the file cannot be read. EventDataError: not floats, of another size, or out of range."""
    from blinkgl.io.images import read_npy

    values, where = read_npy(file), f"events.threshold_map: {file}"
    if values.dtype.kind != "f" or values.shape not in ((height, width), (2, height, width)):
        raise EventDataError(
            "not thresholds of this camera's pixels",
            where=where,
            value=f"{values.dtype} {values.shape}",
            accepted=f"floats of shape ({height}, {width}), or (2, {height}, {width}) with C+ and C-",
        )
    low, high = _MEASURED
    outside = ~((values >= low) & (values <= high))
    if outside.any():
        # The last two indices are y and x, whether or not C+ and C- have an axis of their own.
        y, x = np.argwhere(outside)[0, -2:]
        raise EventDataError(
            f"{np.count_nonzero(outside)} thresholds out of range, the first at pixel ({x}, {y})",
            where=where,
            value=float(values[outside][0]),
            accepted=f"{low:g} to {high:g}, ln units",
        )
    on, off = np.broadcast_to(values, (2, height, width)).astype(np.float64).reshape(2, -1)
    return on, off
