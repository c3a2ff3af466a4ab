"""The frames of a sequence: images of its frame camera where it has one, else those of ``labels.images``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from blinkgl.io.sequence_tables import EXPOSURES, picture_file, read_exposures
from blinkgl.labels import LABELS
from blinkgl.layouts.layout import need, write_bytes
from blinkgl.layouts.source import Source


@dataclass(frozen=True)
class Frames:
    """The frames of one sequence, in order of time.

    files : the images.   t_us : (n,) int64, their times, the middle of an exposure.
    sharp : images without blur at the same times; empty: there are none besides ``files``."""

    files: list[Path]
    t_us: np.ndarray
    sharp: list[Path]


two_frames = need(
    "two or more frames",
    "labels: {images: true}",
    lambda source: source.has(picture_file("images", 1)) or len(source.image_times) > 1,
)


def frames_of(source: Source) -> Frames:
    """Return the frames. Raises AssetError: their list is damaged."""
    if not source.has(EXPOSURES):
        files = [source.file("images", k) for k in range(len(source.image_times))]
        return Frames(files, np.array(source.image_times, np.int64), [])
    times = [line.middle_us for line in read_exposures(source.folder)]
    files, sharp = (
        [source.folder / picture_file(picture, k) for k in range(len(times)) if source.has(picture_file(picture, k))]
        for picture in ("images", "sharp")
    )
    return Frames(files, np.array(times, np.int64), sharp)


def picture(source: Source, file: Path) -> np.ndarray:
    """Return a frame as stored, (H, W, 3) RGB or (H, W) of one channel, uint8 or uint16. Raises AssetError: damaged, or
    of another size."""
    label = LABELS["images"]
    return label.read(file, label.forms[0], source.height, source.width)


def write_frames(source: Source, frames: Frames, folder: Path) -> None:
    """Write ``images/`` and ``sharp/``, numbered from 0. Raises AssetError as :func:`picture`; OutputError."""
    for name, files in (("images", frames.files), ("sharp", frames.sharp)):
        for k, file in enumerate(files):
            picture(source, file)
            write_bytes(folder / f"{name}/{k:06d}.png", file.read_bytes())
