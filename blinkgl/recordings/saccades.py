"""Still pictures to event clips: a sensor moves over a picture, as N-MNIST's did, and nothing is drawn.

The light of a pixel is the mean of the picture's linear light over the pixel's square, at any place exactly, by a
summed-area table (Crow, SIGGRAPH 1984). Beyond its edges the picture's border goes on. Between two frames the sensor
moves at most :data:`STEP_PX`; the emulator's light is linear between them, as that of every source.
"""

from __future__ import annotations

import csv
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from blinkgl.config.events import EmulatorConfig
from blinkgl.config.readout import ReadoutConfig
from blinkgl.errors import AssetError, ConfigError, OutputError
from blinkgl.events.camera import EventCamera, EventFrame, emulate
from blinkgl.io.formats import FORMATS, output_format
from blinkgl.io.frames import IMAGE, read_any_image
from blinkgl.io.records import input_errors
from blinkgl.rng import Role, kernel_seed
from blinkgl.srgb import LUMA, linear_from_srgb
from blinkgl.tensors.choice import make_on_device
from blinkgl.types.numbers import exact

STEP_PX = 0.1
"""Largest motion between two frames, px of the sensor."""
SACCADES = np.array([[0.0, 3.5, 3.5], [0.105, 0.0, -3.5], [0.21, -3.5, 3.5], [0.315, 3.5, 3.5]])
"""t [s], x, y [px]: N-MNIST's three saccades (Orchard et al., Frontiers in Neuroscience 9:437, 2015) at constant speed.
In 105 ms each the picture moves by (3.5, 7), (3.5, -7) and (-7, 0) px, as its authors' program ``stabilize.m`` takes
it, which undoes the motion; the sensor moves the other way."""
ENDINGS = {"bin": ".bin", "npz": ".npz", "npy": ".npy"}


def read_path(path: str | Path) -> np.ndarray:
    """Return the points of a CSV with the heading ``t,x,y``, (n, 3) float64: s, px, px. Raises AssetError: unreadable;
    ConfigError: another heading, no number, one point, times that do not increase."""
    with input_errors(path), open(path, encoding="utf-8-sig", newline="") as file:
        rows = [[field.strip() for field in row] for row in csv.reader(file) if row]
    try:
        points = np.array([[float(exact(field)) for field in row] for row in rows[1:]])
    except ValueError as error:
        raise ConfigError(f"{error}", where=f"--path {path}", accepted="numbers: t [s], x, y [px]") from None
    if rows[:1] != [["t", "x", "y"]] or points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
        value = f"{','.join(rows[0]) if rows else 'an empty file'}, {max(len(rows) - 1, 0)} points"
        raise ConfigError(
            "not a path", where=f"--path {path}", value=value, accepted="a line 't,x,y', then two or more points"
        )
    if (np.diff(points[:, 0]) <= 0).any() or points[0, 0] < 0:
        raise ConfigError("times do not increase from 0 on", where=f"--path {path}", value=points[:, 0].tolist())
    return points


@dataclass(frozen=True)
class Clips:
    """What all clips have in common.

    emulator, readout : of the sensor.   size : (height, width), px.   path : (n, 3) points of :data:`SACCADES`' form.
    seed : of the run; a clip's own depends on it and the clip's number.   ending : of the event files."""

    emulator: EmulatorConfig
    readout: ReadoutConfig | None
    size: tuple[int, int]
    path: np.ndarray
    seed: int
    ending: str

    def __post_init__(self) -> None:
        across = np.ptp(self.path[:, 1:], axis=0)
        if (across >= self.size[::-1]).any():
            raise ConfigError(
                "the path is wider than the sensor",
                where="--path",
                value="{:g}x{:g} px".format(*across),
                accepted=f"less than {self.size[1]}x{self.size[0]}",
            )

    def frames(self, light: np.ndarray) -> Iterator[EventFrame]:
        """Yield the frames of a picture, linear light (h, w)."""
        (h, w), (height, width) = light.shape, self.size
        table = np.zeros((h + 1, w + 1))
        # table[i, j] is the sum over the rows before i and the columns before j.
        table[1:, 1:] = light.cumsum(axis=0, dtype=np.float64).cumsum(axis=1)
        low, high = self.path[:, 1:].min(axis=0), self.path[:, 1:].max(axis=0)
        # scale : px of the picture over one of the sensor; the picture stays in view all along the path, but for half
        # a pixel of its border: N-MNIST's 28x28 px move by 7 in 34x34.
        room = np.array([width, height]) - (high - low) + 1
        scale = max(w / room[0], h / room[1])
        # Edges of the sensor's pixels, px of the sensor from its middle.
        columns, rows = (np.arange(side + 1) - side / 2 for side in (width, height))
        for t_s, x, y in positions(self.path):
            dx, dy = np.array([x, y]) - (low + high) / 2
            # The table at all edges, first along y, then along x; its differences are the sums over the pixels.
            sums = _at(_at(table, h / 2 + scale * (rows + dy)).T, w / 2 + scale * (columns + dx)).T
            means = np.diff(np.diff(sums, axis=0), axis=1) / scale**2
            # Rounding may leave black a little below 0.
            yield EventFrame(round(t_s * 1e9), np.maximum(means, 0).astype(np.float32))

    def write(self, number: int, picture: Path, target: Path) -> tuple[int, tuple[int, int]]:
        """Write the clip of a picture; return the number of its events and the picture's (height, width). Raises
        AssetError: the picture cannot be read; OutputError, EventDataError: the format cannot hold it."""
        light, (height, width) = linear_light(picture), self.size
        seed = kernel_seed(self.seed, number, Role.EVENTS)
        camera = EventCamera(self.emulator, self.readout, height, width, seed, make=make_on_device)
        options = {"t_offset_us": 0, "write_unit": "s"}
        with FORMATS[output_format(target)].create(target, height, width, options) as writer:
            for _, events in emulate(self.frames(light), camera):
                writer.append(events)
        return writer.count, light.shape


def positions(path: np.ndarray) -> Iterator[tuple[float, float, float]]:
    """Yield t, x, y along a path, every point of it included, at most STEP_PX apart."""
    yield tuple(path[0].tolist())
    for begin, end in itertools.pairwise(path):
        steps = max(1, int(np.ceil(np.hypot(*(end - begin)[1:]) / STEP_PX - 1e-9)))
        for k in range(1, steps + 1):
            t, x, y = (begin + (end - begin) * (k / steps)).tolist()
            yield t, x, y


def _at(table: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return a summed-area table at places along its first axis. Between two rows it is a straight line, because the
    picture is constant over each of its pixels; beyond the ends the line goes on, and so does the border."""
    row = np.clip(np.floor(places).astype(np.int64), 0, len(table) - 2)
    share = (places - row)[:, None]
    return table[row] * (1 - share) + table[row + 1] * share


def linear_light(path: Path) -> np.ndarray:
    """Return the linear luminance of a picture, (h, w): sRGB codes of 8 or 16 bits over the largest code, floats as
    they are. Raises AssetError."""
    image = read_any_image(path)
    light = linear_from_srgb(image / np.float64(np.iinfo(image.dtype).max)) if image.dtype.kind == "u" else image
    return light @ LUMA.astype(np.float64) if light.ndim == 3 else light


@dataclass(frozen=True)
class Still:
    """A picture of a run: its file, its class ("": none) and the number of the class (-1: none)."""

    file: Path
    label: str
    number: int

    def target(self, ending: str) -> str:
        """Return the name of its clip below the output."""
        return f"{self.label}/{self.file.stem}{ending}".removeprefix("/")


def _shown(folder: Path) -> list[Path]:
    """Return what a folder holds, sorted, without the hidden entries that programs leave (``._a.png``)."""
    return sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))


def stills_of(folder: Path, classes: bool) -> list[Still]:
    """Return the pictures of a folder, sorted; with ``classes`` those of its folders, each of which is a class. Raises
    AssetError: there are none; OutputError: two whose clips would have one name."""
    accepted = "a folder of one folder of pictures per class" if classes else "pictures, or --classes-from folders"
    if not folder.is_dir():
        raise AssetError("no such folder", where=str(folder), accepted=accepted)
    places = [place for place in _shown(folder) if place.is_dir()] if classes else [folder]
    with input_errors(folder):
        stills = [
            Still(file, place.name if classes else "", number if classes else -1)
            for number, place in enumerate(places)
            for file in _shown(place)
            if file.suffix.lower() in IMAGE
        ]
    if not stills:
        raise AssetError("no pictures", where=str(folder), accepted=accepted)
    names = [still.target("") for still in stills]
    if len(set(names)) < len(names):
        twice = next(still.file for still, name in zip(stills, names) if names.count(name) > 1)
        raise OutputError("two pictures would give clips of one name", where=str(twice), accepted="other names")
    return stills
