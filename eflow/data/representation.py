"""Representations: the tensors that networks read, computed from events. A representation is a frozen value that is
called as ``representation(window, height, width)``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from blinkgl.errors import EventDataError
from eflow.data.window import RawSample, StreamWindow, Window
from eflow.ops import voxel
from eflow.types import Grid


class Representation(Protocol):
    """Converts the events of a window to a tensor."""

    @property
    def channels(self) -> int:
        """Return the number of channels of the tensor."""

    def __call__(self, window: Window, height: int, width: int) -> Grid:
        """Return (channels, height, width) float32. Raises EventDataError: events outside the window or the sensor."""


def grids_of(
    representation: Representation, pair: StreamWindow | RawSample, reads: Iterable[str], size: tuple[int, int]
) -> dict[str, Grid]:
    """Return the tensors of the windows of a pair that are in ``reads``, by name.

    size : (height, width) of the sensor, px. Raises EventDataError: events outside the window or the sensor."""
    try:
        return {name: representation(getattr(pair, name), *size) for name in reads}
    except EventDataError as error:
        where = f"{pair.name}: {error.where}" if pair.name else error.where
        raise EventDataError(error.problem, where=where) from None


@dataclass(frozen=True)
class VoxelGrid:
    """A voxel grid, see :func:`eflow.ops.voxel.voxel_grid`.

    bounds : "window": bins span [t0, t1]; "events": from the first to the last event (E-RAFT)."""

    bins: int = 15
    normalise: str = "nonzero"
    bounds: str = "window"

    @property
    def channels(self) -> int:
        return self.bins

    def __call__(self, window: Window, height: int, width: int) -> Grid:
        t0, t1 = window.t0, window.t1
        if self.bounds == "events" and len(window):
            t0, t1 = int(window.t[0]), int(window.t[-1])
        w = window
        return voxel.voxel_grid(w.x, w.y, w.t, w.p, t0, t1, self.bins, height, width, normalise=self.normalise)


@dataclass(frozen=True)
class CountSlices:
    """Counts per polarity in slices of equal duration: channel 2 s + p has slice s and polarity p (0 OFF, 1 ON)."""

    slices: int

    @property
    def channels(self) -> int:
        return 2 * self.slices

    def __call__(self, window: Window, height: int, width: int) -> Grid:
        w = _on_pixels(window, height, width)
        counts = voxel.count_slices(w.x, w.y, w.t, w.p, w.t0, w.t1, self.slices, height, width)
        return counts.reshape(-1, height, width)


@dataclass(frozen=True)
class CountsAndTimes:
    """The four channels of EV-FlowNet: counts and latest times of both polarities."""

    channels: int = 4

    def __call__(self, window: Window, height: int, width: int) -> Grid:
        w = _on_pixels(window, height, width)
        return voxel.counts_and_times(w.x, w.y, w.t, w.p, w.t0, w.t1, height, width)


def _on_pixels(window: Window, height: int, width: int) -> Window:
    """Return a window with rectified coordinates rounded to the nearest pixel, without events outside the sensor."""
    if window.x.dtype.kind == "u":
        return window
    x, y = np.rint(window.x), np.rint(window.y)
    keep = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    return Window(
        x[keep].astype(np.uint16), y[keep].astype(np.uint16), window.t[keep], window.p[keep], window.t0, window.t1
    )
