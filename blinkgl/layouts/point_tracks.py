"""Layouts of point tracks. TAP-Vid's pickles (Doersch et al., NeurIPS 2022), in the form of its DAVIS file: a table of
one video.

    <split>/<sequence>.pkl   {sequence: {"video": (T, H, W, 3) u1, "points": (N, T, 2) f4, "occluded": (N, T) bool}}

Points are x, y as shares of width and height, counted from the image's corner. A time is there when it has an image.

EventKubric's samples (Hamann et al., ETAP, CVPR 2025), as ETAP's loader and its script for event stacks read them.

    <split>/<sequence>/
      annotations.npy            a table: target_points (N, 96, 2) f4 px from the corner, occluded (N, 96) bool
      data.hdf5                  rgba (96, H, W, 4) u1, subsample_indices; gzip
      events/%010d.npz           x, y i2, t i8 ns on the sample's clock, p i1 (-1, +1)

A sample has 96 times over 2 s, the first and the last included; its clock begins at the first.
"""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np

from blinkgl.io.images import encoded
from blinkgl.io.sequence_tables import TRACKS, read_tracks
from blinkgl.layouts.layout import Layout, Missing, append, growing, images, need, new_hdf5, sensor_pixels, write_bytes
from blinkgl.layouts.source import Source

_tracks = need("point tracks", "tracks: {points: 256}", lambda source: source.has(TRACKS))
_at_images = need(
    "tracks at the images' times",
    "tracks: {points: 256}, without a rate",
    lambda source: (
        _tracks(source) or not source.image_times or len(_common(source, np.array(source.track_times))[0]) > 1
    ),
)


class TapVid(Layout):
    """Videos with point tracks."""

    name = "tapvid"
    about = "TAP-Vid's DAVIS reader (TAPIR, CoTracker, BootsTAP: a pickle of NumPy arrays)"
    needs = (_tracks, images, _at_images)

    def folder(self, source: Source) -> str:
        return source.split

    def write(self, source: Source, folder: Path) -> list[str]:
        tracks = read_tracks(source.folder)
        at, shown = _common(source, tracks["t_us"])
        hidden = tracks["occluded"][:, at]
        ever = ~hidden.all(axis=1)  # points that no frame shows cannot be queried
        # Pixel centres are at whole numbers here, so the corner of the image is at -0.5.
        share = (tracks["target_points"][:, at] + 0.5) / [source.width, source.height]
        table = {
            "video": np.stack([source.image(k) for k in shown]),
            "points": share[ever].astype(np.float32),
            "occluded": hidden[ever],
        }
        write_bytes(folder / f"{source.name}.pkl", pickle.dumps({source.name: table}, protocol=4))
        left = len(tracks["t_us"]) - len(at)
        return [f"{source.name}: {left} of {len(tracks['t_us'])} times of the tracks have no image"] if left else []


def _common(source: Source, t_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the tracks' times at which there is an image, and of those images."""
    _, at, shown = np.intersect1d(t_us, source.image_times, return_indices=True)
    return at, shown


TIMES, SECONDS = 96, 2.0
_TIME = "time: {duration: 2, label_rate: 47.5}"


def _times(source: Source) -> Missing | None:
    """Require 96 images and tracks at their times, 2 s from the first to the last."""
    times = source.image_times
    if not times:
        return None
    if len(times) < TIMES or abs(times[TIMES - 1] - times[0] - SECONDS * 1e6) > 1000:
        return Missing(f"{TIMES} images over {SECONDS:g} s", _TIME)
    if not source.has(TRACKS) or source.track_times[:TIMES] != times[:TIMES]:
        return Missing("point tracks at the images' times", "tracks: {points: 2048}, without a rate")
    return None


class EventKubric(Layout):
    """Events, images and tracks of points, of samples of 2 s."""

    name = "eventkubric"
    about = "ETAP's EventKubric loader (after its prepare_event_representations.py)"
    size = (512, 512)
    needs = (images, _times, sensor_pixels)

    def write(self, source: Source, folder: Path) -> list[str]:
        start_us = source.image_times[0]
        self._write_annotations(source, folder)
        with new_hdf5(folder / "data.hdf5") as file:
            rgba = growing(file, "rgba", np.uint8, (source.height, source.width, 4), rows=1)
            for k in range(TIMES):
                image = source.image(k)
                append(rgba, np.dstack([image, np.full(image.shape[:2], 255, np.uint8)])[None])
            file["subsample_indices"] = np.arange(TIMES)
        for number, events in enumerate(source.events()):
            part = events.window(start_us, start_us + round(SECONDS * 1e6))
            if len(part):
                arrays = dict(x=part.x.astype(np.int16), y=part.y.astype(np.int16), t=(part.t - start_us) * 1000)
                arrays["time_unit"] = np.array("ns")  # for readers other than ETAP's
                packed = encoded(np.savez_compressed, p=2 * part.p.astype(np.int8) - 1, **arrays)
                write_bytes(folder / f"events/{number:010d}.npz", packed)
        return []

    @staticmethod
    def _write_annotations(source: Source, folder: Path) -> None:
        tracks = read_tracks(source.folder)
        table = {
            "target_points": (tracks["target_points"][:, :TIMES] + 0.5).astype(np.float32),
            "occluded": tracks["occluded"][:, :TIMES],
        }
        # The loader reads a pickled table.
        pickled = encoded(np.save, np.array(table, dtype=object), allow_pickle=True)
        write_bytes(folder / "annotations.npy", pickled)
