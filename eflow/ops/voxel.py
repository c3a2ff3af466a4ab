"""Conversion of events to dense tensors in one pass (numba). Kernels are serial; loader workers run in parallel."""

from __future__ import annotations

import numpy as np

from blinkgl.errors import EventDataError
from blinkgl.machine.kernels import kernel


def voxel_grid(
    x: np.ndarray,
    y: np.ndarray,
    t: np.ndarray,
    p: np.ndarray,
    t0: int,
    t1: int,
    bins: int,
    height: int,
    width: int,
    *,
    normalise: str = "nonzero",
) -> np.ndarray:
    """Return the signed voxel grid (bins, height, width) float32 of events, with a linear kernel in time (Zhu et al.,
    CVPR 2019, eq. 1) and the bin coordinate (B-1)(t-t0)/(t1-t0).

    x, y : uint16 px, or float32 rectified px, which are splatted bilinearly (without corners outside the sensor).
    t : int64 µs, t0 <= t <= t1. p : uint8 {0, 1}, counted as -1 and +1.
    normalise : "nonzero" (zero mean, unit standard deviation over cells that are not 0), "all", "none".
    Raises EventDataError: an integer pixel or a time is outside the grid.
    """
    grid = np.zeros((bins, height, width), np.float32)
    if len(t):
        # A window of length 0: all events are in the first bin.
        scale = (bins - 1) / (int(t1) - int(t0)) if t1 > t0 else 0.0
        kernel = _splat_t if x.dtype.kind == "u" else _splat_xyt
        _all_inside(kernel(x, y, t, p, np.int64(t0), np.int64(t1), scale, grid), t0, t1, grid)
    if normalise != "none":
        _normalise(grid.reshape(-1), normalise == "all")
    return grid


def _all_inside(outside: int, t0: int, t1: int, grid: np.ndarray) -> None:
    """Raise EventDataError if some events are outside the window or the sensor. grid : (…, H, W)."""
    if outside:
        height, width = grid.shape[-2:]
        raise EventDataError(
            f"{outside} events outside the window or the {width}x{height} sensor", where=f"window [{t0}, {t1}) µs"
        )


@kernel
def _splat_t(x, y, t, p, t0, t1, scale, grid):
    bins, height, width = grid.shape
    outside = 0
    for i in range(len(t)):
        if x[i] >= width or y[i] >= height or t[i] < t0 or t[i] > t1:
            outside += 1
            continue
        # Times are subtracted as integers, which is exact.
        c = np.float64(t[i] - t0) * scale
        # t == t1 is in the last bin.
        b = min(int(c), max(bins - 2, 0))
        w = np.float32(c - b)
        s = np.float32(1) if p[i] else np.float32(-1)
        grid[b, y[i], x[i]] += s * (np.float32(1) - w)
        if bins > 1:
            grid[b + 1, y[i], x[i]] += s * w
    return outside


@kernel
def _splat_xyt(x, y, t, p, t0, t1, scale, grid):
    bins, height, width = grid.shape
    outside = 0
    for i in range(len(t)):
        if t[i] < t0 or t[i] > t1:
            outside += 1
            continue
        c = np.float64(t[i] - t0) * scale
        b = min(int(c), max(bins - 2, 0))
        wt = np.float32(c - b)
        s = np.float32(1) if p[i] else np.float32(-1)
        # Rectified coordinates are between pixels; each event is distributed to four pixels.
        fx, fy = np.floor(x[i]), np.floor(y[i])
        # NaN fails these comparisons and is dropped.
        if not (fx >= -1 and fx < width and fy >= -1 and fy < height):
            continue
        ix, iy = int(fx), int(fy)
        wx, wy = np.float32(x[i] - fx), np.float32(y[i] - fy)
        for dy in range(2):
            for dx in range(2):
                xx, yy = ix + dx, iy + dy
                if xx < 0 or xx >= width or yy < 0 or yy >= height:
                    continue
                v = s * (wx if dx else np.float32(1) - wx) * (wy if dy else np.float32(1) - wy)
                grid[b, yy, xx] += v * (np.float32(1) - wt)
                if bins > 1:
                    grid[b + 1, yy, xx] += v * wt
    return outside


@kernel
def _normalise(cells, everything):
    # Two passes in float64, mean and squared deviations: one pass would suffer from cancellation.
    n, total = 0, 0.0
    for v in cells:
        if everything or v != 0:
            n += 1
            total += v
    if n == 0:
        return
    mean = total / n
    square = 0.0
    for v in cells:
        if everything or v != 0:
            square += (v - mean) ** 2
    # The unbiased estimate, as torch.std.
    std = np.sqrt(square / (n - 1)) if n > 1 else 0.0
    scale = 1.0 / std if std > 0 else 1.0
    for i in range(len(cells)):
        if everything or cells[i] != 0:
            cells[i] = np.float32((cells[i] - mean) * scale)


def count_slices(
    x: np.ndarray, y: np.ndarray, t: np.ndarray, p: np.ndarray, t0: int, t1: int, slices: int, height: int, width: int
) -> np.ndarray:
    """Return event counts per slice of equal duration and polarity, (slices, 2, height, width) float32; 0 OFF, 1 ON.

    x, y : uint16 px. t in [t0, t1]; t == t1 is in the last slice. Raises EventDataError as :func:`voxel_grid`."""
    counts = np.zeros((slices, 2, height, width), np.float32)
    _all_inside(_count(x, y, t, p, np.int64(t0), np.int64(max(t1 - t0, 1)), counts), t0, t1, counts)
    return counts


@kernel
def _count(x, y, t, p, t0, span, counts):
    slices, _, height, width = counts.shape
    outside = 0
    for i in range(len(t)):
        d = t[i] - t0
        if x[i] >= width or y[i] >= height or d < 0 or d > span:
            outside += 1
            continue
        # t == t1 would be slice number ``slices``.
        counts[min(d * slices // span, slices - 1), p[i], y[i], x[i]] += np.float32(1)
    return outside


def counts_and_times(
    x: np.ndarray, y: np.ndarray, t: np.ndarray, p: np.ndarray, t0: int, t1: int, height: int, width: int
) -> np.ndarray:
    """Return the input of EV-FlowNet (Zhu et al., RSS 2018), (4, height, width) float32: OFF count, ON count, latest
    OFF time, latest ON time. Times are fractions of the window, 0 without an event. Raises EventDataError as
    :func:`voxel_grid`."""
    out = np.zeros((4, height, width), np.float32)
    _all_inside(_latest(x, y, t, p, np.int64(t0), np.int64(max(t1 - t0, 1)), out), t0, t1, out)
    return out


@kernel
def _latest(x, y, t, p, t0, span, out):
    _, height, width = out.shape
    outside = 0
    for i in range(len(t)):
        d = t[i] - t0
        if x[i] >= width or y[i] >= height or d < 0 or d > span:
            outside += 1
            continue
        # Events are sorted by time, so the last one written is the latest.
        out[p[i], y[i], x[i]] += np.float32(1)
        out[2 + p[i], y[i], x[i]] = np.float32(d / span)
    return outside
