"""Signed voxel grids of events, and events of selected pixels, to compare streams of one sensor."""

from __future__ import annotations

import numpy as np

from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Events


def voxel_grid(events: Events, t0_us: int, t1_us: int, height: int, width: int, bins: int) -> np.ndarray:
    """Return (bins, H, W) float32: polarities (+1, -1), each divided between the two bins next to
    (bins - 1) (t - t0) / (t1 - t0); events outside [t0, t1] are ignored."""
    grid = np.zeros((bins, height, width), np.float32)
    _vote(events.x, events.y, events.t, events.p, np.int64(t0_us), np.int64(t1_us), grid)
    return grid


@kernel(error_model="numpy")
def _vote(x, y, t, p, t0, t1, grid):
    last = grid.shape[0] - 1
    scale = last / np.float64(t1 - t0)
    # The weights of the two bins beside the event's place add up to 1.
    for i in range(len(t)):
        place = (t[i] - t0) * scale
        if not 0 <= place <= last:  # outside the window, or a window without length
            continue
        b = min(max(np.int64(place), 0), last)
        weight = np.float32(place - b)
        sign = np.float32(1) if p[i] else np.float32(-1)
        grid[b, y[i], x[i]] += sign * (np.float32(1) - weight)
        if b < last:
            grid[b + 1, y[i], x[i]] += sign * weight


def masked(events: Events, mask: np.ndarray) -> Events:
    """Return the events of the pixels where ``mask`` (H, W) is True."""
    keep = mask[events.y, events.x]
    return events.part(keep)
