"""The interface to all event formats: :func:`open_events`, :func:`event_writer`, :func:`write_events`, :func:`convert`.

:data:`FORMATS` lists the formats; docs/formats.md describes their content.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from blinkgl.errors import AssetError, OutputError
from blinkgl.io.atomic import atomic_file
from blinkgl.io.columns import CameraFrame, ImuSamples, check_events, check_size
from blinkgl.types.events import Events


@dataclass(frozen=True)
class EventFormat:
    """One event format.

    endings : of its files.   module : of ``blinkgl.io``, imported when a file of it is opened or written.
    reader : class made from a path.   writer : class made from (path, height, width) and ``fixed``; "": the format is
    only read.   dataset : of an HDF5 file, which distinguishes files with one ending; "": the format of files without
    the others'.
    takes : options of :func:`event_writer` that the writer has.   causes : it can store the causes of events."""

    name: str
    endings: tuple[str, ...]
    module: str
    reader: str
    writer: str = ""
    dataset: str = ""
    fixed: Mapping[str, Any] = field(default_factory=dict)
    takes: tuple[str, ...] = ()
    causes: bool = False

    def open(self, path: Path) -> Any:
        """Return a reader of the file. Raises AssetError: not what the ending says."""
        return getattr(import_module(f"blinkgl.io.{self.module}"), self.reader)(path)

    def create(self, path: Path, height: int, width: int, options: Mapping[str, Any]) -> EventWriter:
        """Return a writer of the file. options : those that it takes are used."""
        given = {name: options[name] for name in self.takes}
        return getattr(import_module(f"blinkgl.io.{self.module}"), self.writer)(
            path, height, width, **self.fixed, **given
        )


HDF5 = (".h5", ".hdf5")
FORMATS = {
    one.name: one
    for one in (
        EventFormat("dsec", HDF5, "dsec", "DsecEventReader", "DsecEventWriter", takes=("t_offset_us",), causes=True),
        EventFormat("mvsec", HDF5, "mvsec", "MvsecReader", dataset="davis/left/events"),
        EventFormat("evt3", (".raw",), "evt", "EvtReader", "EvtWriter"),
        EventFormat("aedat4", (".aedat4",), "aedat4", "Aedat4Reader"),
        EventFormat("aedat2", (".aedat",), "aedat2", "Aedat2Reader"),
        EventFormat(
            "text", (".txt",), "text", "TextReader", "TextWriter", fixed={"separator": " "}, takes=("time_unit",)
        ),
        EventFormat(
            "csv", (".csv",), "text", "TextReader", "TextWriter", fixed={"separator": ","}, takes=("time_unit",)
        ),
        EventFormat("es", (".es",), "event_stream", "EventStreamReader"),
        EventFormat("mat", (".mat",), "arrays", "MatReader"),
        EventFormat("npz", (".npz",), "arrays", "ArrayReader", "ArrayWriter", causes=True),
        EventFormat("npy", (".npy",), "arrays", "ArrayReader", "ArrayWriter", causes=True),
    )
}
"""Formats by name. Of formats that share an ending the first is written."""
ENDINGS: dict[str, str] = {}
"""Ending -> the format that is written for it."""
for _one in FORMATS.values():
    for _ending in _one.endings:
        ENDINGS.setdefault(_ending, _one.name)
WITH_CAUSES = tuple(name for name, one in FORMATS.items() if one.causes)
"""Formats that can store the causes of events; the others refuse events with causes."""
SENSORS = ((180, 240), (240, 304), (260, 346), (320, 320), (480, 640), (720, 1280), (1080, 1920))
"""(height, width) of event cameras, smallest first: the guess for files without a size."""


class EventWriter(Protocol):
    """Interface of every format's writer; ``abort`` never raises. ``t_end_us`` may be set before the end: the
    recording's, where it is later than the last event's (used by DSEC's table)."""

    t_end_us: int | None

    def append(self, events: Events) -> None: ...
    def close(self, t_end_us: int | None = None) -> None: ...
    def abort(self) -> None: ...


@dataclass(frozen=True)
class EventFile:
    """An event file opened for reading, in any format.

    height, width : px, None when the file does not give them. t_offset_us : DSEC's, else 0 (already added to the
    times)."""

    path: Path
    format: str
    height: int | None
    width: int | None
    t_offset_us: int = 0
    _reader: Any = field(default=None, repr=False)

    @property
    def causes(self) -> bool:
        """Return whether its events have causes."""
        return getattr(self._reader, "causes", False)

    def chunks(self) -> Iterator[Events]:
        """Yield all events from the beginning, in pieces, in constant memory (npz, npy: all in memory).

        Raises, naming event and value, EventDataError: decreasing times, an event outside height and width where those
        are known, or that :class:`~blinkgl.types.events.Events` cannot hold; AssetError when the file is damaged."""
        last, count = None, 0
        for events in self._reader.chunks():
            last = check_events(events, str(self.path), count, height=self.height, width=self.width, after=last)
            count += len(events)
            if len(events):
                yield events

    def frames(self) -> Iterator[CameraFrame]:
        """Yield the camera's own frames, one in memory at a time. Raises AssetError: the format, or the recording, has
        none; damaged.
        EventDataError: times that do not increase."""
        return self._stream("frames")()

    def imu(self) -> ImuSamples:
        """Return the samples of the camera's inertial unit. Raises as :meth:`frames`."""
        return self._stream("imu")()

    def _stream(self, name: str) -> Callable[[], Any]:
        stream = getattr(self._reader, name, None)
        if stream is None:
            raise AssetError(
                f"{self.format} files hold events alone",
                where=str(self.path),
                accepted="an .aedat4 or .aedat recording",
            )
        return stream

    def close(self) -> None:
        """Close the file (only HDF5 files stay open between reads)."""
        getattr(self._reader, "close", lambda: None)()

    def __enter__(self) -> EventFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self) -> Events:
        """Return all events at once."""
        return Events.concatenate(list(self.chunks()))

    def sized(self) -> EventFile:
        """Return self with height and width known: where the file has none, the smallest known sensor that contains all
        its events (one pass over the file)."""
        if self.height is not None and self.width is not None:
            return self
        largest = np.zeros(2, int)
        for events in self.chunks():
            largest = np.maximum(largest, (int(events.y.max()), int(events.x.max())))
        fits = (s for s in SENSORS if s[0] > largest[0] and s[1] > largest[1])
        height, width = next(fits, tuple(int(v) + 1 for v in largest))
        return replace(self, height=height, width=width)


def open_events(path: str | os.PathLike) -> EventFile:
    """Open an event file; the content decides where the ending is ambiguous.

    Raises AssetError: missing, unknown ending, or content that does not match the ending."""
    path = Path(path)
    kind = ENDINGS.get(path.suffix.lower())
    if kind is None:
        raise AssetError("unknown event file ending", where=str(path), value=path.suffix, accepted=", ".join(ENDINGS))
    if not path.is_file():
        raise AssetError("no such file", where=str(path))
    if path.suffix.lower() in HDF5:
        kind = _held(path)
    reader = FORMATS[kind].open(path)
    kind = getattr(reader, "version", kind)  # a .raw file says whether it is EVT2, EVT2.1 or EVT3
    return EventFile(path, kind, reader.height, reader.width, getattr(reader, "t_offset_us", 0), reader)


def output_format(path: str | os.PathLike) -> str:
    """Return the format for writing ``path``. Raises OutputError: no written format has its ending."""
    kind = ENDINGS.get(Path(path).suffix.lower())
    if kind is None or not FORMATS[kind].writer:
        raise OutputError(
            "unknown event file ending" if kind is None else f"{kind} files are read only",
            where=str(path),
            value=Path(path).suffix,
            accepted=", ".join(end for end, kind in ENDINGS.items() if FORMATS[kind].writer),
        )
    return kind


def _held(path: Path) -> str:
    """Return the name of the format that an HDF5 file holds, by its datasets."""
    from blinkgl.io.hdf5 import hdf5_errors, open_hdf5

    with open_hdf5(path) as file, hdf5_errors(path):
        return next((name for name, one in FORMATS.items() if one.dataset and one.dataset in file), "dsec")


def _writer(path: Path, kind: str, height: int, width: int, t_offset_us: int, time_unit: str) -> EventWriter:
    check_size(height, width, str(path))
    if time_unit != "s" and "time_unit" not in FORMATS[kind].takes:
        raise OutputError(
            f"{kind} has a fixed unit of time",
            where=str(path),
            value=time_unit,
            accepted="a unit with .txt and .csv only",
        )
    return FORMATS[kind].create(path, height, width, {"t_offset_us": t_offset_us, "time_unit": time_unit})


@contextlib.contextmanager
def event_writer(
    path: str | os.PathLike,
    height: int,
    width: int,
    *,
    t_offset_us: int = 0,
    time_unit: str = "s",
    overwrite: bool = True,
) -> Iterator[EventWriter]:
    """``with event_writer("out.h5", 480, 640) as out: out.append(events)``. The file appears under its name when the
    block ends without an exception, and not at all otherwise.

    t_offset_us : DSEC only, the time of the recording's start. time_unit : text and CSV only, "s" or "us". Raises
    OutputError, EventDataError.
    """
    kind = output_format(path)
    with atomic_file(path, overwrite=overwrite) as temporary:
        writer = _writer(temporary, kind, height, width, t_offset_us, time_unit)
        try:
            yield writer
            writer.close()
        except BaseException:
            writer.abort()
            raise


def write_events(
    path: str | os.PathLike, chunks: Events | Iterable[Events], height: int, width: int, **options: Any
) -> int:
    """Write events or an iterable of chunks; options as :func:`event_writer`. Return the number of events."""
    count = 0
    with event_writer(path, height, width, **options) as writer:
        for events in [chunks] if isinstance(chunks, Events) else chunks:
            if events.truth is not None:
                raise OutputError(
                    "event files cannot store what caused the events",
                    where=str(path),
                    accepted="dataclasses.replace(events, truth=None), or `generate`, which writes event_labels.h5",
                )
            writer.append(events)
            count += len(events)
    return count


def convert(
    source: str | os.PathLike,
    target: str | os.PathLike,
    *,
    size: tuple[int, int] | None = None,
    zero_time: bool = False,
    time_unit: str = "s",
    overwrite: bool = True,
) -> tuple[EventFile, int]:
    """Copy events from one format to another, streaming.

    size : (height, width) for sources without a size (default: guessed, see :meth:`EventFile.sized`).
    time_unit : of text and CSV, "s" or "us". zero_time : shift times so that the first event is at 0, for EVT3, which
    counts from the start.
    Causes of events are left out where the format cannot store them.
    Returns the source with its size, and the number of events written.
    """
    kind = output_format(target)
    with open_events(source) as file:
        if size is not None:
            file = replace(file, height=size[0], width=size[1])
        file = file.sized()
        first = next((int(e.t[0]) for e in file.chunks()), 0)
        shift = first if zero_time else 0
        # DSEC's t is u4 relative to t_offset: keep the source's own, else put it at the first event's second.
        offset = 0 if zero_time else file.t_offset_us or first // 1_000_000 * 1_000_000
        shifted = (replace(e, t=e.t - shift) for e in file.chunks()) if shift else file.chunks()
        if file.causes and kind not in WITH_CAUSES:
            shifted = (replace(e, cause=None) for e in shifted)
        count = write_events(
            target,
            shifted,
            file.height,
            file.width,
            t_offset_us=offset,
            time_unit=time_unit,
            overwrite=overwrite,
        )
    return file, count
