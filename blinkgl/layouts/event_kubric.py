"""EventKubric's samples (Hamann et al., ETAP, CVPR 2025), as ETAP's loader and its script for event stacks read them.

    <split>/<sequence>/
      annotations.npy            a table: target_points (N, 96, 2) f4 px from the corner, occluded (N, 96) bool
      data.hdf5                  rgba (96, H, W, 4) u1, subsample_indices; gzip
      events/%010d.npz           x, y i2, t i8 ns on the sample's clock, p i1 (-1, +1)

A sample has 96 times over 2 s, the first and the last included; its clock begins at the first.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from blinkgl.io.images import encoded
from blinkgl.io.over_time import TRACKS, read_tracks
from blinkgl.layouts.layout import Layout, Missing, append, growing, images, new_hdf5, write_bytes
from blinkgl.layouts.source import Source

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
    needs = (images, _times)

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
