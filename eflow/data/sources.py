"""Data sets on disk as lists of samples: BlinkGL's sequence directories, DSEC and BlinkFlow. (For MVSEC see
:mod:`eflow.data.mvsec`, for single rendered windows :mod:`eflow.data.pool`.)

All three have an event file and one flow file per label, so they share one reader; only the places of the files differ.

| layout | events | flow | times |
|---|---|---|---|
| blinkgl | events.h5 | flow/{forward,backward}/*.png | flow/*_timestamps.txt |
| dsec | events/left/events.h5, rectify_map.h5 | flow/forward/*.png | flow/forward_timestamps.txt, or the test CSV |
| video | events.h5 of blinkgl simulate | flow/forward/*.flo, png, npy, pfm or flo5 | flow/forward_timestamps.txt |
| blinkflow | events_left/events.h5 | forward_flow/*.npy, backward_flow/*.npy | index / fps (config.yaml) |
"""

from __future__ import annotations

import csv
import os
import re
from collections import Counter
from collections.abc import Sequence as SequenceOf, Sized
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Protocol

import numpy as np

from blinkgl.config.reader import read_table
from blinkgl.errors import AssetError, ConfigError, EventDataError
from blinkgl.io import flow as flow_files
from blinkgl.io.dsec import DsecEventReader
from blinkgl.io.flow import read_flow_npy
from blinkgl.io.hdf5 import dataset, open_hdf5
from blinkgl.io.records import inside, named
from blinkgl.io.times import read_label_times
from blinkgl.labels import LABELS
from blinkgl.sequence_files.index import INDEX, read_index
from blinkgl.types.recent import Recent
from eflow.data.folders import below
from eflow.data.mvsec import MvsecSource
from eflow.data.pool import ABOUT, PoolSource
from eflow.data.window import RawSample, Window
from eflow.types import Flow, Mask, Numbers

# ---------------------------------------------------------------------------------------------------------------------
# Layouts of data sets.


_OPEN_FILES = 16


class Source(Protocol):
    """A finite list of samples. ``has_backward``: samples have backward flow, so time reversal is possible."""

    has_backward: bool

    def __len__(self) -> int:
        """Return the number of samples."""

    def __getitem__(self, index: int) -> RawSample:
        """Return a sample. Raises AssetError."""


@dataclass(frozen=True)
class Entry:
    """One label: flow from ``from_us`` to ``to_us`` (clock of the images). ``index``: number of the file, needed for
    submissions."""

    index: int
    from_us: int
    to_us: int
    forward: Path | None = None
    backward: Path | None = None


@dataclass(frozen=True)
class Sequence:
    """One recording. ``scene``: the group over which metrics are averaged first."""

    name: str
    scene: str
    events: Path
    entries: tuple[Entry, ...]
    rectify_map: Path | None = None


class FolderSource:
    """The samples of :class:`Sequence` objects, in order. Files are opened on first use in each process, since HDF5
    handles survive neither a fork nor pickling; the last 16 stay open."""

    def __init__(self, sequences: list[Sequence]):
        self.sequences = sequences
        self._index = [(s, e) for s in sequences for e in s.entries]
        self.has_backward = bool(self._index) and all(e.backward is not None for _, e in self._index)
        self._readers: Recent[tuple[int, Path], DsecEventReader] = Recent(_OPEN_FILES)
        self._maps: Recent[Path, Numbers] = Recent(len(sequences))

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, index: int) -> RawSample:
        sequence, entry = self._index[index]
        flow = valid = backward = backward_valid = None
        if entry.forward is not None:
            flow, valid = read_flow(entry.forward)
        if entry.backward is not None:
            backward, backward_valid = read_flow(entry.backward)
        reader = self._readers.of((os.getpid(), sequence.events), lambda: DsecEventReader(sequence.events))
        rectify = (
            None if (path := sequence.rectify_map) is None else self._maps.of(path, lambda: read_rectify_map(path))
        )
        height, width = self._size(sequence, reader, flow, rectify)
        span = entry.to_us - entry.from_us
        return RawSample(
            # The older window has the length of the newer, although a label says nothing about it.
            old=self._window(reader, entry.from_us - span, entry.from_us, rectify),
            new=self._window(reader, entry.from_us, entry.to_us, rectify),
            height=height,
            width=width,
            name=f"{sequence.name}/{entry.index:06d}",
            scene=sequence.scene,
            flow=flow,
            valid=valid,
            backward=backward,
            backward_valid=backward_valid,
        )

    def sequence_names(self) -> list[str]:
        """Return the name of each sample's sequence."""
        return [sequence.name for sequence, _ in self._index]

    def entry(self, index: int) -> tuple[Sequence, Entry]:
        """Return the sequence and the label of sample ``index``."""
        return self._index[index]

    @staticmethod
    def _window(reader: DsecEventReader, t0: int, t1: int, rectify: Numbers | None) -> Window:
        e = reader.slice(t0, t1)
        if rectify is None:
            return Window(e.x, e.y, e.t, e.p, t0, t1)
        if len(e) and (e.y.max() >= rectify.shape[0] or e.x.max() >= rectify.shape[1]):
            raise EventDataError(
                "event outside the rectification map",
                where=str(reader.path),
                value=(int(e.x.max()), int(e.y.max())),
                accepted=f"x < {rectify.shape[1]}, y < {rectify.shape[0]}",
            )
        # The map holds (x, y) for each raw pixel, float32: rectified events lie between pixels.
        xy = rectify[e.y, e.x]
        return Window(np.ascontiguousarray(xy[:, 0]), np.ascontiguousarray(xy[:, 1]), e.t, e.p, t0, t1)

    @staticmethod
    def _size(
        sequence: Sequence, reader: DsecEventReader, flow: Flow | None, rectify: Numbers | None
    ) -> tuple[int, int]:
        sizes = {
            (int(s[0]), int(s[1]))
            for s in (
                (reader.height, reader.width) if reader.height and reader.width else None,
                flow.shape[:2] if flow is not None else None,
                rectify.shape[:2] if rectify is not None else None,
            )
            if s is not None
        }
        if len(sizes) > 1:
            raise AssetError(
                "event file, flow and rectification map differ in size", where=str(sequence.events), value=sorted(sizes)
            )
        return sizes.pop() if sizes else (480, 640)  # the sensor of DSEC and BlinkFlow, whose files do not store it


def read_rectify_map(path: Path) -> Numbers:
    """Return the rectified (x, y) of each pixel, (H, W, 2) float32 px. Raises AssetError."""
    with open_hdf5(path) as file:
        table = dataset(file, "rectify_map", path, shape=(None, None, 2), kinds="f")[()].astype(np.float32)
    if not np.isfinite(table).all():
        raise AssetError("rectification map with NaN or infinity", where=str(path))
    return table


def read_flow(path: Path) -> tuple[Flow, Mask]:
    """Return flow (H, W, 2) float32 px and valid (H, W) bool of a DSEC PNG, a BlinkFlow .npy (u, v, validity), or a
    .flo, .pfm or .flo5.

    Raises AssetError: missing, corrupt, wrong shape, or NaN / infinity in a valid pixel."""
    if path.suffix != ".npy":
        return flow_files.read_flow(path)
    flow, valid = read_flow_npy(path)
    bad = valid & ~np.isfinite(flow).all(-1)
    if bad.any():
        y, x = np.argwhere(bad)[0]
        raise AssetError(f"flow is NaN or infinite at pixel ({x}, {y}) and marked valid", where=str(path))
    return np.where(valid[..., None], flow, np.float32(0)), valid


class Part:
    """The samples ``indices`` of a source, or of a list in memory, in order."""

    def __init__(self, source: Source | list[RawSample], indices: SequenceOf[int], has_backward: bool):
        self.source, self.indices, self.has_backward = source, indices, has_backward

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> RawSample:
        return self.source[self.indices[index]]


def parts_of(source: Source, share: float, where: str) -> tuple[Part, Part]:
    """Return the samples to train on, and those of the sequences held out: about a ``share`` of all, by digests of
    their names, so that a sequence stays where it is when others are added.

    Raises ConfigError: single windows, which are of no sequence, or one of the parts would be empty."""
    if isinstance(source, PoolSource):
        raise ConfigError("single windows are of no sequence", where=where, accepted="a folder of sequences")
    assert isinstance(source, FolderSource | MvsecSource)
    names = source.sequence_names()
    # The first 48 bits of a digest, as a number in [0, 1): exact in a float64.
    draws = {name: int(sha256(name.encode()).hexdigest()[:12], 16) / 16**12 for name in names}
    least, most = min(draws.values()), max(draws.values())
    if not least < share <= most:
        raise ConfigError(
            "too few sequences for a share",
            where=where,
            value=f"{share}, {len(draws)} sequences",
            accepted=f"a share from {least + 0.001:.3f} to {most:.3f}" if len(draws) > 1 else "a set to validate on",
        )
    kept = [k for k, name in enumerate(names) if draws[name] < share]
    rest = [k for k, name in enumerate(names) if draws[name] >= share]
    return Part(source, rest, source.has_backward), Part(source, kept, source.has_backward)


# ---- where files lie -------------------------------------------------------------------------------------------------


def find_blinkgl(root: Path) -> list[Sequence]:
    """Return the sequence directories of ``index.jsonl`` in ``root``, or else all at or below ``root``.

    Sequences without forward flow are skipped. Flow is read from the 16-bit PNG (quantum 1/128 px)."""
    sequences = []
    indexed = (root / INDEX).is_file()
    folders = (
        [root if line["path"] == "." else inside(root, line["path"]) for line in read_index(root)]
        if indexed
        else [m.parent for m in sorted(below(root, "manifest.json"))]
    )
    for folder in folders:
        if any(part.startswith(".") for part in folder.relative_to(root).parts):
            continue
        name = folder.relative_to(root).as_posix()
        if (sequence := blinkgl_sequence(folder, folder.name if name == "." else name)) is not None:
            sequences.append(sequence)
    return sequences


def blinkgl_sequence(folder: Path, name: str) -> Sequence | None:
    """Return a sequence directory, or None if it has no events or no forward flow. Raises AssetError: missing files."""
    if not (folder / "events.h5").is_file():
        return None
    there, back = LABELS["flow_forward"], LABELS["flow_backward"]
    stamps = inside(folder, str(there.stamps))
    forward, backward = (numbered(inside(folder, label.forms[0].folder), "png") for label in (there, back))
    # Generated without flow: nothing to learn from, but not an error.
    if not forward and not stamps.exists():
        return None
    times = read_times(stamps)
    _same_count(folder / there.forms[0].folder, forward, times)
    if backward:
        _same_count(folder / back.forms[0].folder, backward, times)
    entries = tuple(
        Entry(k, t0, t1, f, backward.get(k)) for (k, f), (t0, t1) in zip(forward.items(), times, strict=True)
    )
    return Sequence(name, name, inside(folder, "events.h5"), entries)


def find_dsec(root: Path) -> list[Sequence]:
    """Return the DSEC sequences at or below ``root``, and those of events made of video.

    Events and flow are in one tree, or in the folders of the archives, ``train_events`` and ``train_optical_flow``.
    The times of a test sequence are in ``test_forward_flow_timestamps.csv`` or ``<sequence>.csv``. Events of video lie
    in the folder of the sequence and need no rectification map."""
    sequences = []
    for events in sorted(below(root, "events.h5")):
        place = events.parent
        # Folders of the event camera are called events/left or events_left; another place is one of our own sets.
        video = place.name not in ("left", "events_left")
        if "forward_flow" in {p.name for p in place.parent.iterdir()} or (video and not (place / "flow").is_dir()):
            continue
        folder = place if video else place.parent.parent if place.name == "left" else place.parent
        # Truth lies beside the events, or in an archive of its own with the same sequence names.
        flow_folder = next(
            (f for f in (folder / "flow", root / "train_optical_flow" / folder.name / "flow") if f.is_dir()), None
        )
        rectify = None if video else place / "rectify_map.h5"
        test = next(
            (
                c
                for c in (
                    folder / "test_forward_flow_timestamps.csv",
                    folder / f"{folder.name}.csv",
                    root / "test_forward_optical_flow_timestamps" / f"{folder.name}.csv",
                )
                if c.is_file()
            ),
            None,
        )
        if flow_folder is not None:
            times, files = (
                read_times(flow_folder / "forward_timestamps.txt"),
                numbered(flow_folder / "forward", "*" if video else "png"),
            )
            _same_count(flow_folder / "forward", files, times)
            entries = tuple(Entry(k, t0, t1, f) for (k, f), (t0, t1) in zip(files.items(), times, strict=True))
        elif test is not None:
            entries = tuple(Entry(i, t0, t1) for t0, t1, i in read_submission_times(test))
        else:
            continue
        if rectify is not None and not rectify.is_file():
            raise AssetError("no rectification map beside the events", where=str(rectify))
        sequences.append((folder, Sequence(folder.name, folder.name, events, entries, rectify)))
    return _distinct(sequences, root)


def _distinct(sequences: list[tuple[Path, Sequence]], root: Path) -> list[Sequence]:
    """Return the sequences of folders below ``root``; those of the same name are called by their paths there, as a
    scene of that name is."""
    count = Counter(s.name for _, s in sequences)
    called = lambda s, path: replace(s, name=path, scene=path if s.scene == s.name else s.scene)
    return [called(s, os.path.relpath(folder, root)) if count[s.name] > 1 else s for folder, s in sequences]


def find_blinkflow(root: Path) -> list[Sequence]:
    """Return the sequences in the published layout of BlinkFlow,
    ``[<split>/]<scene>/<seq>/{events_left/events.h5, forward_flow, config.yaml}``.

    Label 0 is skipped, since it has no events before it."""
    sequences = []
    for folder in sorted(p.parent for p in below(root, "forward_flow") if p.is_dir()):
        fps = _fps(folder / "config.yaml")
        files, backward = (numbered(folder / name, "npy") for name in ("forward_flow", "backward_flow"))
        at = lambda i, fps=fps: round(i * 1e6 / fps)
        # backward_flow/k belongs to frames k+1 -> k in the published sets, so the one that starts at label i is file i
        # - 1.
        entries = tuple(Entry(i, at(i), at(i + 1), f, backward.get(i - 1)) for i, f in files.items() if i > 0)
        parts = folder.relative_to(root).parts or (folder.parent.name, folder.name)
        name = "/".join(parts[-2:])
        scene = parts[-2] if len(parts) > 1 else name
        sequences.append((folder, Sequence(name, scene, folder / "events_left/events.h5", entries)))
    return _distinct(sequences, root)


def numbered(folder: Path, ending: str) -> dict[int, Path]:
    """Return the files of a folder by their numbers, in order; none without the folder. Hidden files, such as those
    that some systems write beside each file (``._000001.png``), are no labels. Raises AssetError: a name without a
    number, or a number twice."""
    files: dict[int, Path] = {}
    for path in sorted(folder.glob(f"[!.]*.{ending}")):
        if not re.fullmatch("[0-9]{1,9}", path.stem) or int(path.stem) in files:
            raise AssetError(
                "not the number of a label", where=str(path), value=path.stem, accepted=f"000000.{ending}, each once"
            )
        files[int(path.stem)] = path
    return dict(sorted(files.items()))


def _fps(path: Path) -> float:
    if not path.is_file():
        return 10.0
    try:
        fps = float(read_table(path).get("fps", 10.0))
    except (ConfigError, TypeError, ValueError):
        raise AssetError("no readable 'fps'", where=str(path), accepted="duration and fps as YAML") from None
    if not 0 < fps < 1e6:
        raise AssetError("impossible fps", where=str(path), value=fps)
    return fps


def read_times(path: Path) -> list[tuple[int, int]]:
    """Return the lines ``from_us, to_us`` of a file, without ``#`` headers. Raises AssetError: not a list of
    intervals."""
    times = [(start, end) for start, end in read_label_times(path, 2)]
    for line in times:
        if line[0] >= line[1]:
            raise AssetError("not an interval", where=str(path), value=line, accepted="from_us, to_us with from < to")
    return times


def read_submission_times(path: Path) -> list[tuple[int, int, int]]:
    """Return the rows (from_us, to_us, file_index) of a test CSV of DSEC. Raises AssetError."""
    try:
        with open(path, newline="", encoding="utf-8") as file:
            rows = [
                [int(v) for v in row[:3]]
                for row in csv.reader(file)
                if row and not row[0].lstrip().startswith(("#", "from"))
            ]
    except (OSError, ValueError):
        raise AssetError(
            "not DSEC's test CSV", where=str(path), accepted="from_timestamp_us, to_timestamp_us, file_index"
        ) from None
    if not rows or any(len(r) != 3 or not 0 <= r[0] < r[1] < 10**16 or not 0 <= r[2] < 10**9 for r in rows):
        raise AssetError(
            "not DSEC's test CSV", where=str(path), accepted="from_timestamp_us, to_timestamp_us, file_index"
        )
    return [(start, end, number) for start, end, number in rows]


def _same_count(folder: Path, files: Sized, times: Sized) -> None:
    if len(files) != len(times):
        raise AssetError(
            "flow files and time stamps differ in number", where=str(folder), value=(len(files), len(times))
        )


_KNOWN_BY = {"blinkgl": "manifest.json", "blinkflow": "forward_flow", "mvsec": "*_data.hdf5", "dsec": "events.h5"}
"""Layout -> a file or folder that only it and those after it have."""


def detect_format(root: Path) -> str:
    """Return the name of the layout at ``root``. Raises AssetError: no known layout."""
    if root.is_file() and root.name.endswith("_data.hdf5"):
        return "mvsec"
    if not root.is_dir():
        raise AssetError("no such data set", where=str(root), accepted="a folder")
    if (root / ABOUT).is_file():
        return "windows"
    if (root / INDEX).is_file():
        return "blinkgl"
    for layout, pattern in _KNOWN_BY.items():
        if next(below(root, pattern), None):
            return layout
    raise AssetError(
        "no data set found",
        where=str(root),
        accepted="a folder of BlinkGL, DSEC, MVSEC or BlinkFlow sequences, or of windows of eflow render",
    )


def open_source(
    path: str | os.PathLike,
    format: str = "auto",
    *,
    dt: int = 1,
    protocol: str = "all",
    frames: tuple[tuple[int, int], ...] = (),
    dense: bool = False,
) -> Source:
    """Open the data set at ``path``.

    dt, protocol, frames, dense : for MVSEC, see :class:`~eflow.data.mvsec.MvsecSource`.
    Raises ConfigError: one of them for another data set. AssetError: no data set, or a damaged index. Files of single
    samples are opened when they are read."""
    root = named(Path(path))
    kind = detect_format(root) if format == "auto" else format
    if kind == "mvsec":
        return MvsecSource(root, dt, protocol, frames, dense)
    refuse_of_mvsec(dt=dt, protocol=protocol, frames=frames, dense=dense)
    if not root.is_dir():
        raise AssetError("no such data set", where=str(root), accepted="a folder")
    if kind == "windows":
        return PoolSource(root)
    find = {"blinkgl": find_blinkgl, "dsec": find_dsec, "blinkflow": find_blinkflow}[kind]
    source = FolderSource(find(Path(os.path.abspath(root))))  # folders name the sequences, and `.` has no name
    if not len(source):
        raise AssetError(f"no {kind} sequence with flow labels", where=str(root))
    return source


def refuse_of_mvsec(*, dt: int, protocol: str, frames: tuple[tuple[int, int], ...], dense: bool) -> None:
    """Raise ConfigError if one of these options of MVSEC is asked of another data set."""
    options = {"dt": (dt, 1), "protocol": (protocol, "all"), "frames": (frames, ()), "dense": (dense, False)}
    for name, (value, default) in options.items():
        if value != default:
            typed = ", ".join(f"{first}-{end - 1}" for first, end in frames) if name == "frames" else value
            raise ConfigError("only for MVSEC", where=name, value=typed, accepted="a data set in the layout of MVSEC")
