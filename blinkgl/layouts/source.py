"""A sequence directory as input of layouts, and one that a configuration makes, as far as their checks look at it."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from blinkgl.camera import CameraModel, PinHole
from blinkgl.config.camchain import read_camchain
from blinkgl.config.over_time import track_times
from blinkgl.config.reader import read_table
from blinkgl.config.sequence import SequenceConfig
from blinkgl.dataset.verify import files_of_sequence, times_of
from blinkgl.errors import AssetError
from blinkgl.io.dsec import DsecEventReader
from blinkgl.io.hdf5 import CODECS
from blinkgl.io.images import read_image
from blinkgl.io.imu import H5 as IMU
from blinkgl.io.intervals import intervals_in
from blinkgl.io.reading import listed
from blinkgl.io.records import inside, named
from blinkgl.io.sequence_tables import POSES, TRACKS, read_poses, read_tracks
from blinkgl.io.times import read_label_times
from blinkgl.labels import LABELS, Form
from blinkgl.labels.intervals import Flows
from blinkgl.sequence_files.index import made_folders
from blinkgl.sequence_files.rig_dir import CAM_TO_CAM, read_sensors
from blinkgl.sequence_files.sequence_dir import is_rig_folder, whole
from blinkgl.types.events import Events
from blinkgl.types.trees import Tree


@dataclass(frozen=True)
class Source:
    """One sequence. Times are µs on its own clock, also those of :meth:`events`.

    folder : its directory.   manifest : its content.   name : the directory's, or that of its rig.
    beside : the directory of the right camera, where this is the left one of a stereo pair.   unit : that of the
    inertial unit, its own or another of its rig; None: there is none."""

    folder: Path
    manifest: Tree
    name: str
    beside: Path | None = None
    unit: Path | None = None

    @classmethod
    def open(
        cls, folder: Path, name: str | None = None, beside: Path | None = None, unit: Path | None = None
    ) -> Source:
        """Open a sequence. Raises AssetError: no sequence, or files are missing or cut."""
        manifest = whole(folder)
        return cls(folder, manifest, name or named(folder).name, beside, folder if IMU in manifest["files"] else unit)

    @property
    def split(self) -> str:
        return str(self.manifest.get("split") or "train")

    @property
    def height(self) -> int:
        return self.manifest["height"]

    @property
    def width(self) -> int:
        return self.manifest["width"]

    @property
    def start_us(self) -> int:
        """Return the start of the recording: an interval before the first label."""
        return self.manifest["t_offset_us"]

    @property
    def end_us(self) -> int:
        """Return the end of the recording."""
        return self.start_us + int(self.manifest.get("duration_us") or 0)

    def has(self, name: str) -> bool:
        """Return whether the file ``name`` belongs to it."""
        return name in self.manifest["files"]

    def count(self, label: str) -> int:
        """Return the number of files of a label's first format."""
        return sum(map(LABELS[label].forms[0].holds, self.manifest["files"]))

    def flow_times(self, towards: str) -> list[tuple[int, int]]:
        """Return (from, to) of every flow label; empty: there is none."""
        return [(start, end) for start, end in self._times(f"flow_{towards}", 2)]

    @functools.cached_property
    def interval_times(self) -> list[int]:
        """Return the times of the labels that lead to several times (``flow_intervals``); empty: there are none."""
        return [time for (time,) in self._times("flow_intervals")]

    @functools.cached_property
    def image_times(self) -> list[int]:
        """Return the times of the sRGB images; empty: there are none."""
        return [time for (time,) in self._times("images")]

    @functools.cached_property
    def track_times(self) -> list[int]:
        """Return the times of the point tracks; empty: there are none. Raises AssetError."""
        return read_tracks(self.folder)["t_us"].tolist() if self.has(TRACKS) else []

    def interval_ns(self, k: int) -> np.ndarray:
        """Return the intervals over which label ``k`` leads, (n,) int64 ns. Raises AssetError."""
        return intervals_in(self.file("flow_intervals", k))

    def file(self, label: str, k: int) -> Path:
        """Return the ``k``-th file of a label, in its first format."""
        return self.folder / LABELS[label].forms[0].file(k)

    def copied(self, label: str, k: int) -> bytes:
        """Return the content of :meth:`file` once it was read as a value of this sequence. Raises AssetError."""
        self.image(k) if label == "images" else self.value(label, k)
        return self.file(label, k).read_bytes()

    def flow(self, towards: str, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (H, W, 2) float32 px and (H, W) bool, from the most exact format available. Raises AssetError."""
        forms = {form.ending: form for form in LABELS[f"flow_{towards}"].forms}
        for form in (forms["npy"], forms["flo"], forms["png"]):
            if self.has(form.file(k)):
                value = self._read(f"flow_{towards}", k, form)
                return value.flow, value.valid
        raise AssetError("no flow of this number", where=str(self.folder), value=k)

    def image(self, k: int) -> np.ndarray:
        """Return an image, (H, W, 3) uint8 sRGB."""
        path = self.file("images", k)
        image = read_image(path)
        if image.shape[:2] != (self.height, self.width) or image.dtype != np.uint8:
            raise AssetError(
                f"not {self.width}x{self.height} px of 8 bits: {image.shape} {image.dtype}", where=str(path)
            )
        return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)

    def grey(self, k: int) -> np.ndarray:
        """Return a grey image, (H, W) uint8."""
        return cv2.cvtColor(self.image(k), cv2.COLOR_RGB2GRAY)

    def value(self, label: str, k: int) -> Any:
        """Return the ``k``-th value of a label: most are one array, (H, W[, C]); depth is inf where nothing is hit.
        Raises AssetError."""
        return self._read(label, k)

    def flows(self, k: int) -> Flows:
        """Return the flow from label ``k`` to several times. Raises AssetError."""
        return self._read("flow_intervals", k)

    def events(self, chunk: int = 1 << 20) -> Iterator[Events]:
        """Yield all events, in order, in pieces."""
        with DsecEventReader(self.folder / "events.h5", size=(self.height, self.width)) as reader:
            yield from reader.chunks(chunk)

    @functools.cached_property
    def poses(self) -> dict[str, np.ndarray]:
        """Return the arrays of ``poses.npz``; none where a recording has no poses."""
        return read_poses(self.folder / POSES) if self.has(POSES) else {}

    @functools.cached_property
    def camera(self) -> CameraModel | None:
        """Return its camera model; None where a recording does not give it."""
        if self.has(CAM_TO_CAM):  # a lens with distortion
            return next(iter(read_camchain(self.folder / CAM_TO_CAM).values())).camera
        if "K" not in self.poses:
            return None
        (fx, _, cx), (_, fy, cy), _ = self.poses["K"].tolist()
        return PinHole(self.width, self.height, fx, fy, cx, cy)

    @functools.cached_property
    def right(self) -> Source | None:
        """Return the right camera's sequence, of a stereo pair. Raises as :meth:`open`."""
        return None if self.beside is None else Source.open(self.beside, self.name)

    @property
    def rectified(self) -> bool:
        """Return whether labels are in the pixels of the rectified image: of a lens with distortion, on request."""
        return isinstance(self.camera, PinHole) or self._configured("labels", "pixels") == "rectified"

    @property
    def codec(self) -> str:
        """Return the codec of its events."""
        codecs = {name: name for name in (*CODECS, "gzip")}
        return listed(codecs, self._configured("output", "compression") or "zstd", "unknown compression", self.folder)

    def _configured(self, section: str, key: str) -> Any:
        path = self.folder / "config.yaml"
        table = read_table(path).get(section) or {}
        if not isinstance(table, dict):
            raise AssetError("not a table of keys", where=f"{path}: {section}", value=table)
        return table.get(key)

    def _times(self, label: str, columns: int = 1) -> list[tuple[int, ...]]:
        stamps = LABELS[label].stamps
        assert stamps is not None, label
        return read_label_times(self.folder / stamps, columns, self.count(label)) if self.has(stamps) else []

    def _read(self, label: str, k: int, form: Form | None = None) -> Any:
        form = form or LABELS[label].forms[0]
        return LABELS[label].read(self.folder / form.file(k), form, self.height, self.width)


def sources_of(root: Path) -> list[Source]:
    """Return the sequences of a data set, or ``root`` itself; of a rig its first event camera's, of a pair the left
    one's. Raises as :meth:`Source.open`, and AssetError: a rig without an event camera."""
    return [_of_sensors(f) if is_rig_folder(f) else Source.open(f) for f in made_folders(root)]


def _of_sensors(folder: Path) -> Source:
    whole(folder)
    tables = read_sensors(folder)
    cameras = [name for name, one in tables.items() if "events" in one["records"]]
    if not cameras:
        raise AssetError("a rig without an event camera", where=str(folder))
    unit = next((inside(folder, name) for name, one in tables.items() if "imu" in one["records"]), None)
    one, other, name = cameras[0], tables[cameras[0]]["pair"], named(folder).name
    if other not in cameras:
        return Source.open(inside(folder, one), name, unit=unit)
    left, right = (one, other) if tables[one]["baseline"] > 0 else (other, one)
    return Source.open(inside(folder, left), name, inside(folder, right), unit)


@dataclass(frozen=True)
class Planned(Source):
    """A sequence of which nothing is generated.   config : of the camera that an export takes: of a rig its first with
    events."""

    config: SequenceConfig = field(default_factory=SequenceConfig)

    @classmethod
    def of(cls, config: SequenceConfig, where: Path) -> Planned:
        """Return the plan of a configuration; ``where`` is named in errors. Raises StopIteration: no events."""
        own = next(one.config for one in config.cameras() if one.gives_events)
        manifest = {
            "files": dict.fromkeys(files_of_sequence(own)),
            "height": own.camera.height,
            "width": own.camera.width,
            "split": own.output.split,
            **dict(times_of(own)),
        }
        return cls(where, manifest, own.output.name, config=own)

    @property
    def camera(self) -> CameraModel:
        return self.config.camera.model

    @property
    def track_times(self) -> list[int]:
        tracks, time = self.config.tracks, self.config.time
        if tracks is None:
            return []
        return [t // 1000 for t in track_times(tracks.rate, time.label_times_ns[0], time.t1_ns, time.interval_ns)]

    def interval_ns(self, k: int) -> np.ndarray:
        return np.array(LABELS["flow_intervals"].intervals(self.config.labels), np.int64)

    @property
    def _label_us(self) -> list[int]:
        return [t // 1000 for t in self.config.time.label_times_ns]

    def _times(self, label: str, columns: int = 1) -> list[tuple[int, ...]]:
        if not self.has(LABELS[label].stamps or ""):
            return []
        rows: list[tuple[int, ...]] = list(zip(*(self._label_us[k:] for k in range(columns))))
        return rows[: self.count(label)]

    def _configured(self, section: str, key: str) -> Any:
        return getattr(getattr(self.config, section), key)
