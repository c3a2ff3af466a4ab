"""Frames with the events between them, as loaders of frame interpolation, deblurring and super-resolution read them.

    <split>/<sequence>/
      images/%06d.png, images/timestamp.txt   frames and their times, whole µs; sharp/%06d.png  of a frame camera
      events_aligned/%06d.npz                 HS-ERGB, TimeLens: x, y u2, t i8 µs, p u1
      events/%06d.npz                         BS-ERGB: x, y u4 in 1/32 px, timestamp f8 µs, polarity u1
    <split>/<sequence>.h5                     EvTexture: images/%06d (H, W, 3) u1 BGR; voxels_f/%06d, voxels_b/%06d
                                              (5, H, W) f4

The events of file k are those from frame k to k + 1: of [t_k, t_k+1).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from blinkgl.events.grids import voxel_grid
from blinkgl.io.columns import windows
from blinkgl.io.images import encoded
from blinkgl.io.sequence_tables import EXPOSURES
from blinkgl.layouts.frames import frames_of, picture, two_frames, write_frames
from blinkgl.layouts.layout import GZIP, Layout, keep, new_hdf5, sensor_pixels, write_bytes, write_lines
from blinkgl.layouts.source import Source
from blinkgl.types.events import Events

BINS = 5
"""Of EvTexture's voxel grids."""
_FULL = 0.98
"""Share of a grid's non-zero values that keep their ratios; larger ones become 1 (Rebecq et al., T-PAMI 2019, 3.1)."""
_BS_ERGB_UNIT = 32
_BS_ERGB_SIZE = 970, 625


class Intervals(Layout):
    """Frames, and the events of each interval between two."""

    name = "intervals"
    about = "TimeLens' HybridStorage, BS-ERGB's readers and EvTexture's hdf5 backend"
    # Images of a frame camera always have the sensor's pixels.
    needs = (two_frames, lambda source: None if source.has(EXPOSURES) else sensor_pixels(source))

    def write(self, source: Source, folder: Path) -> list[str]:
        frames, own = frames_of(source), folder / source.name
        write_lines(own / "images/timestamp.txt", frames.t_us.tolist())
        write_frames(source, frames, own)
        path = folder / f"{source.name}.h5"
        with new_hdf5(path) as grids:
            for k, file in enumerate(frames.files):
                keep(grids, f"images/{k:06d}", _bgr(source, file), **GZIP)
            for k, events in enumerate(windows(source.events(), frames.t_us)):
                columns = {"x": events.x, "y": events.y, "t": events.t, "p": events.p}
                write_bytes(own / f"events_aligned/{k:06d}.npz", encoded(np.savez_compressed, **columns))
                fine = {name: columns[name].astype(np.uint32) * _BS_ERGB_UNIT for name in "xy"}
                fine |= {"timestamp": events.t.astype(np.float64), "polarity": events.p}
                write_bytes(own / f"events/{k:06d}.npz", encoded(np.savez_compressed, **fine))
                grid = normalised(_voxels(events, source))
                # Backwards in time both the order and the polarities of events turn round.
                for name, voxels in (("voxels_f", grid), ("voxels_b", -grid[::-1])):
                    keep(grids, f"{name}/{k:06d}", voxels, **GZIP)
        width, height = _BS_ERGB_SIZE
        fits = source.width <= width and source.height <= height
        size = f"{source.width}x{source.height}"
        return [] if fits else [f"{source.name}: BS-ERGB's readers expect at most 970x625 px, and this is {size}"]

    def folder(self, source: Source) -> str:
        return source.split


def _voxels(events: Events, source: Source) -> np.ndarray:
    """Return E2VID's voxel grid, (BINS, H, W) float32: its first bin is at the first event, its last at the last."""
    if not len(events):
        return np.zeros((BINS, source.height, source.width), np.float32)
    start, end = int(events.t[0]), int(events.t[-1])
    return voxel_grid(events, start, max(end, start + 1), source.height, source.width, BINS)


def normalised(grid: np.ndarray) -> np.ndarray:
    """Return a grid in [-1, 1], float32: over the 98th percentile of its non-zero magnitudes."""
    sizes = np.sort(np.abs(grid[grid != 0]))
    return np.clip(grid / sizes[int(_FULL * len(sizes))], -1, 1) if len(sizes) else grid


def _bgr(source: Source, file: Path) -> np.ndarray:
    """Return a frame as (H, W, 3) uint8 in OpenCV's order of channels."""
    codes = picture(source, file)
    if codes.dtype != np.uint8:
        codes = (codes >> (source.manifest["frame_camera"]["bits"] - 8)).astype(np.uint8)
    return codes[..., ::-1] if codes.ndim == 3 else np.repeat(codes[..., None], 3, axis=2)
