"""TAP-Vid's pickles (Doersch et al., NeurIPS 2022), in the form of its DAVIS file: a table of one video.

    <split>/<sequence>.pkl   {sequence: {"video": (T, H, W, 3) u1, "points": (N, T, 2) f4, "occluded": (N, T) bool}}

Points are x, y as shares of width and height, counted from the image's corner. A time is there when it has an image.
"""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np

from blinkgl.io.over_time import TRACKS, read_tracks
from blinkgl.layouts.layout import Layout, images, need, write_bytes
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
