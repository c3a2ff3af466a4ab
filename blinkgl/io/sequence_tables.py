"""Small files of a sequence beside its events and labels: ``poses.npz`` (camera and objects), ``tracks.npz`` (points on
surfaces; :class:`blinkgl.render.tracks.Tracks` names the arrays), ``lights.npz`` (light that changes), and those of a
frame camera, in a folder of its own:

frame_camera/
  images/%06d.png   as the camera gives them: RGB, or one channel of colour filters; 8 bits, or 16-bit PNG of codes
  sharp/%06d.png, clean/%06d.png   side by side with them, on request
  images/timestamps.txt   middle of each exposure, one µs per line
  exposures.csv           a line per image, times of the first row's start and the last row's end (µs)
  poses.npz               the camera's pose at the start, middle and end of each exposure
"""

from __future__ import annotations

import contextlib
import csv
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from blinkgl.config.images import ImagesConfig
from blinkgl.config.reader import read_yaml
from blinkgl.errors import AssetError, BlinkGLError
from blinkgl.io.images import checked_arrays
from blinkgl.types.numbers import exact

POSES, TRACKS, LIGHTS = "poses.npz", "tracks.npz", "lights.npz"
_POSES: dict[str, tuple[str, str]] = {
    "t_ns": ("T", "i"),
    "T_world_cam": ("T44", "f"),
    "K": ("33", "f"),
    "near": ("", "fi"),
}
_OF_OBJECTS: dict[str, tuple[str, str]] = {
    "object_ids": ("N", "i"),
    "object_names": ("N", "U"),
    "object_categories": ("N", "U"),
    "T_world_obj": ("NT44", "f"),
}
_TRACKS: dict[str, tuple[str, str]] = {
    "t_us": ("T", "i"),
    "query_points": ("N3", "f"),
    "target_points": ("NT2", "f"),
    "occluded": ("NT", "b"),
    "points_world": ("NT3", "f"),
    "depth": ("NT", "f"),
    "instance": ("N", "u"),
    "surface": ("N2", "i"),
    "weights": ("N3", "f"),
}
_LIGHTS: dict[str, tuple[str, str]] = {
    "t_ns": ("T", "i"),
    "names": ("N", "U"),
    "factors": ("NT", "f"),
    "jump_t_ns": ("J", "i"),
    "jump_light": ("J", "i"),
    "jump_factor": ("J", "f"),
}
"""Array -> its axes, T times and N objects, points or lights, J jumps, and NumPy's kinds of number."""


def read_poses(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Return the arrays of ``poses.npz`` by name: t_ns (T,) int64, of the start and every label, T_world_cam (T, 4, 4),
    K (3, 3), near; of objects object_ids (N,), object_names, object_categories and T_world_obj (N, T, 4, 4), all of
    them or none. path : the file, or the folder of its sequence.

    Raises AssetError: missing, damaged, another shape or number type, NaN, no time, times that decrease."""
    path = _file(path, POSES)
    poses = checked_arrays(path, _POSES, _OF_OBJECTS)
    if not len(poses["t_ns"]) or (np.diff(poses["t_ns"]) < 0).any():
        raise AssetError("'t_ns' is empty or decreases", where=str(path), accepted="times in order")
    return poses


def read_tracks(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Return the arrays of ``tracks.npz``, by name. path : the file, or the folder of its sequence.

    Raises AssetError: missing, damaged, another shape or number type."""
    return checked_arrays(_file(path, TRACKS), _TRACKS)


def read_lights(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Return the arrays of ``lights.npz``, by name: t_ns (T,) of the poses, the start and every label's time;
    names (N,) of the lights; factors (N, T) float64 by which they shine; jump_t_ns (J,) at which one jumps, increasing,
    jump_light (J,) its number among the names, jump_factor (J,) what it jumps to. An event of a jump has its
    microsecond, jump_t_ns // 1000, from an emulator without a low-pass.
    path : the file, or the folder of its sequence.

    Raises AssetError: missing, damaged, another shape or number type."""
    return checked_arrays(_file(path, LIGHTS), _LIGHTS)


def _file(path: str | os.PathLike, name: str) -> Path:
    return Path(path) / name if Path(path).is_dir() else Path(path)


CAMERA_FOLDER = "frame_camera"
CAMERA_STAMPS = f"{CAMERA_FOLDER}/images/timestamps.txt"
EXPOSURES = f"{CAMERA_FOLDER}/exposures.csv"
EXPOSURE_POSES = f"{CAMERA_FOLDER}/poses.npz"


@dataclass(frozen=True)
class ExposureLine:
    """A line of ``exposures.csv``.

    start_us : of the first row.   end_us : of the last row's exposure.   exposure_us : of each row.
    row_us : between two rows' starts.   gain_db.   instants : of which the image is the mean."""

    start_us: float
    end_us: float
    exposure_us: float
    row_us: float
    gain_db: float
    instants: int

    @property
    def middle_us(self) -> int:
        """Return the middle of the exposure, of the middle row where they differ."""
        return round((self.start_us + self.end_us) / 2)


def picture_file(picture: str, k: int) -> str:
    """Return the name of the k-th "images", "sharp" or "clean" below the sequence."""
    return f"{CAMERA_FOLDER}/{picture}/{k:06d}.png"


def files_of(images: ImagesConfig, count: int) -> Iterator[str]:
    """Yield the names of all files of ``count`` images."""
    yield from (CAMERA_STAMPS, EXPOSURES, EXPOSURE_POSES)
    for picture in images.pictures:
        yield from (picture_file(picture, k) for k in range(count))


def exposures_csv(lines: Iterable[ExposureLine]) -> str:
    """Return the text of ``exposures.csv``: a heading, then a line per image. Times to the nanosecond."""
    rows = [",".join(f.name for f in fields(ExposureLine))]
    rows += [
        f"{e.start_us:.3f},{e.end_us:.3f},{e.exposure_us:.3f},{e.row_us:.6g},{e.gain_db:.6g},{e.instants}"
        for e in lines
    ]
    return "\n".join(rows) + "\n"


def stamps_txt(lines: Iterable[ExposureLine]) -> str:
    """Return the text of ``images/timestamps.txt``."""
    return "".join(f"{e.middle_us}\n" for e in lines)


def camera_of(folder: Path) -> ImagesConfig | None:
    """Return the frame camera whose pictures are in a folder, as the sequence's ``config.yaml`` says; None: the folder
    is none of a sequence's, or the sequence does not say it."""
    sequence = folder.absolute().parent.parent
    if folder.absolute().parent.name != CAMERA_FOLDER or not (sequence / EXPOSURES).is_file():
        return None
    for place in (sequence, sequence.parent):  # a camera of a rig has its configuration in the rig's folder
        with contextlib.suppress(BlinkGLError, ValidationError, OSError, TypeError, KeyError):
            return ImagesConfig(**read_yaml(place / "config.yaml")["images"])
    return None


def read_exposures(sequence: str | os.PathLike) -> list[ExposureLine]:
    """Return the exposures of a sequence's frame camera. Raises AssetError: there is none, or its list is damaged."""
    path = Path(sequence) / EXPOSURES
    heading = [f.name for f in fields(ExposureLine)]
    try:
        with open(path, encoding="utf-8", newline="") as file:
            first, *rows = csv.reader(file)
        if first != heading or any(len(row) != len(heading) for row in rows):
            raise ValueError("not the columns " + ", ".join(heading))
        numbers = [[float(exact(field)) for field in row] for row in rows]
        return [ExposureLine(a, b, each, row_us, gain, int(row[-1]))
                for row, (a, b, each, row_us, gain, _) in zip(rows, numbers)]  # fmt: skip
    except FileNotFoundError:
        raise AssetError(
            "the sequence has no frame camera", where=str(path), accepted="a sequence made with images:"
        ) from None
    except (OSError, ValueError, csv.Error) as error:
        raise AssetError(f"damaged list of exposures: {' '.join(str(error).split())[:120]}", where=str(path)) from None


def read_exposure_poses(sequence: str | os.PathLike) -> dict[str, np.ndarray]:
    """Return the poses of a sequence's frame camera: t_ns (N, 3) int64, the start, middle and end of each exposure, and
    T_world_cam (N, 3, 4, 4) float64 at those times. Raises AssetError: missing, damaged, another shape or type."""
    return checked_arrays(Path(sequence) / EXPOSURE_POSES, {"t_ns": ("N3", "i"), "T_world_cam": ("N344", "f")})
