"""All event formats, listed in :data:`FORMATS`: :func:`open_events`, :func:`event_writer`, :func:`write_events`,
:func:`convert`. docs/formats.md describes their content."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError, ConfigError, EventDataError, OutputError
from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.io.columns import (
    MAX_SIDE,
    BadEvent,
    CameraFrame,
    CheckedWriter,
    ImuSamples,
    check_events,
    check_size,
    on_or_off,
)
from blinkgl.io.reading import AS_FILE, Damage, EventReading
from blinkgl.machine.closing import Closing
from blinkgl.types.events import Events


@dataclass(frozen=True)
class EventFormat:
    """One event format; :func:`register` adds it.

    endings : of its files.   reader : class made from (path, :class:`~blinkgl.io.reading.EventReading`).
    writer : class made from (path, height, width) and ``fixed``; "": the format is only read. Either is the class, or
    its name in ``module`` of ``blinkgl.io``, which is imported when a file is opened or written.   magic : first bytes
    of its files, which decide where several formats share an ending.   takes : options of :func:`event_writer` that
    the writer has.   causes : it can store the causes of events.   sized : it cannot be written without the sensor's
    size."""

    name: str
    endings: tuple[str, ...]
    module: str = ""
    reader: str | type = ""
    writer: str | type = ""
    magic: bytes = b""
    fixed: Mapping[str, Any] = field(default_factory=dict)
    takes: tuple[str, ...] = ()
    causes: bool = False
    sized: bool = False

    def open(self, path: Path, reading: EventReading) -> Any:
        """Return a reader of the file. Raises AssetError: not what the ending says."""
        return self._class(self.reader)(path, reading)

    def create(self, path: Path, height: int | None, width: int | None, options: Mapping[str, object]) -> CheckedWriter:
        """Return a writer of the file. options : those that it takes are used."""
        taken = {name: options[name] for name in self.takes}
        return self._class(self.writer)(path, height, width, **self.fixed, **taken)

    def _class(self, named: str | type) -> Any:
        return getattr(import_module(f"blinkgl.io.{self.module}"), named) if isinstance(named, str) else named


HDF5 = (".h5", ".hdf5")
_TEXT = {"module": "text", "reader": "TextReader", "writer": "TextWriter", "takes": ("write_unit",)}
FORMATS: dict[str, EventFormat] = {}
"""Formats by name. Of formats that share an ending the first is written."""
ENDINGS: dict[str, str] = {}
"""Ending -> the format that is written for it."""


def register(one: EventFormat) -> EventFormat:
    """Add a format to the table that every command reads, and return it. Raises TypeError: its name is taken."""
    if one.name in FORMATS:
        raise TypeError(f"event format '{one.name}': there is one already")
    FORMATS[one.name] = one
    for ending in one.endings:
        ENDINGS.setdefault(ending, one.name)
    return one


for _one in (
    EventFormat("dsec", HDF5, "dsec", "DsecEventReader", "DsecEventWriter", takes=("t_offset_us",), causes=True),
    EventFormat("hdf5", HDF5, "hdf5_tables", "Hdf5TableReader"),
    EventFormat("evt3", (".raw",), "evt", "EvtReader", "EvtWriter"),
    EventFormat("aedat2", (".aedat",), "aedat2", "Aedat2Reader"),
    EventFormat("aedat4", (".aedat4", ".aedat"), "aedat4", "Aedat4Reader", "Aedat4Writer", b"#!AER-DAT4", sized=True),
    EventFormat("text", (".txt",), fixed={"separator": " "}, **_TEXT),
    EventFormat("csv", (".csv",), fixed={"separator": ","}, **_TEXT),
    EventFormat("gzip", (".txt.gz", ".csv.gz"), "text", "TextReader"),
    EventFormat("zip", (".zip",), "text", "TextReader"),
    EventFormat("es", (".es",), "event_stream", "EventStreamReader"),
    EventFormat("dat", (".dat",), "fixed_records", "DatReader"),
    EventFormat("nmnist", (".bin",), "fixed_records", "NMnistReader", "NMnistWriter"),
    EventFormat("mat", (".mat",), "arrays", "MatReader"),
    EventFormat("mat73", (".mat",), "hdf5_tables", "Hdf5TableReader", magic=b"MATLAB 7.3"),
    EventFormat("rosbag", (".bag", ".mcap", ".db3"), "ros", "BagReader"),
    EventFormat("npz", (".npz",), "arrays", "ArrayReader", "ArrayWriter", causes=True),
    EventFormat("npy", (".npy",), "arrays", "ArrayReader", "ArrayWriter", causes=True),
    EventFormat("evimo2", (), "arrays", "Evimo2Reader"),
    EventFormat("npz folder", (), "arrays", "NpzFolderReader", causes=True),
):
    register(_one)
_EVIMO2 = "dataset_events_*.npy"
SENSORS = ((180, 240), (240, 304), (260, 346), (320, 320), (480, 640), (720, 1280), (1080, 1920))
"""(height, width) of event cameras, smallest first: the guess for files without a size."""
_BESIDE = {".npz", ".txt", ".csv", ".json", ".yaml", ""}
"""Endings of the files of a folder of events: lists and notes beside the arrays."""
_FOUND = ("moved", "late", "cut", "outside")
"""Lines about what salvage found, which every pass over a file finds anew."""
_REMEDIED = (Damage, BadEvent)
"""What ``--damaged keep`` reads past: nothing else is damage."""
_OVERLAP_US = 10_000
"""With ``damaged="keep"``, events that come up to so much too late are put in their place."""


@dataclass(frozen=True)
class EventFile(Closing):
    """An event file opened for reading, in any format.

    height, width : px, None when neither the file nor the user gives them. t_offset_us : DSEC's, else 0 (already added
    to the times). reading : what is declared. guessed_size : whether the size is a guess of :meth:`sized`."""

    path: Path
    format: str
    height: int | None
    width: int | None
    t_offset_us: int = 0
    reading: EventReading = AS_FILE
    guessed_size: bool = False
    _reader: Any = field(default=None, repr=False)
    told: dict[str, str] = field(default_factory=dict, repr=False)

    @property
    def triggers(self) -> np.ndarray | None:
        """Return the triggers read so far, (N, 3) int64 µs, channel and edge; None: the format has none."""
        return getattr(self._reader, "triggers", None)

    @property
    def causes(self) -> bool:
        """Return whether its events have causes."""
        return getattr(self._reader, "causes", False)

    @property
    def fixed_unit(self) -> bool:
        """Return whether the format itself counts µs."""
        return not hasattr(self._reader, "unit")

    @property
    def notes(self) -> list[str]:
        """Return a line for each thing that was recognised by a layout's name, and, after reading, for each that was
        left out or moved."""
        lines = [*getattr(self._reader, "notes", ())]
        if "triggers" in self.told:
            lines = [line for line in lines if "--triggers" not in line]
        if self.guessed_size:
            known = (self.height, self.width) in SENSORS
            why = "the smallest sensor that holds all events" if known else "as far as events go, beyond known sensors"
            lines.append(f"size taken as {self.width}x{self.height}, {why} (--size if that is wrong)")
        if unread := getattr(self._reader, "unread", 0):
            lines.append(f"left out: rows that are no events: {unread:,}")
        return [line for line in (*lines, *self.told.values()) if line]

    def chunks(self) -> Iterator[Events]:
        """Yield all events from the beginning, in pieces, in constant memory (npz, npy, mat, and with ``sort``: all in
        memory).

        Raises, naming event and value, EventDataError: decreasing times, an event outside height and width where those
        are known, or that :class:`~blinkgl.types.events.Events` cannot hold; AssetError when the file is damaged. With
        ``damaged="keep"`` what is whole is yielded, and :attr:`notes` tells what is not."""
        last, count = None, 0
        flipped = (self.reading.origin or getattr(self._reader, "origin", "top")) == "bottom"
        if flipped and self.height is None:
            raise ConfigError("y counts from the bottom of an unknown height", where=str(self.path), accepted="--size")
        for events in self._salvaged() if self.reading.keep or self.reading.sort else self._declared():
            try:
                last = check_events(events, str(self.path), count, height=self.height, width=self.width, after=last)
            except EventDataError as error:
                raise self._with_remedy(error) from None
            count += len(events)
            if flipped and self.height is not None:
                events = replace(events, y=(self.height - 1 - events.y.astype(np.int32)).astype(np.uint16))
            if len(events):
                yield events

    def _declared(self) -> Iterator[Events]:
        """Yield the reader's events; a polarity that is declared of a format with one of its own counts."""
        pair = self.reading.polarity if self.fixed_unit else None
        try:
            for events in self._reader.chunks():
                yield replace(events, p=on_or_off(events.p, pair, str(self.path))) if pair else events
        except _REMEDIED as error:
            raise type(error)(
                error.problem,
                where=error.where,
                value=error.value,
                accepted=f"{error.accepted or 'a whole file'}; or --damaged keep",
            ) from error

    def _salvaged(self) -> Iterator[Events]:
        """Yield what is whole, in order of time; count the rest."""
        for kind in _FOUND:
            self.told.pop(kind, None)
        whole = self._inside(self._until_damage() if self.reading.keep else self._declared())
        if self.reading.sort:
            whole = iter([Events.concatenate(list(whole))])
        held, latest, moved, most, late = Events.empty(), -(1 << 62), 0, 0, 0
        for events in whole:
            t = events.t
            peak = np.maximum.accumulate(np.append(latest, t))[1:]  # the latest time so far, at each event
            latest, behind = (int(peak[-1]) if len(t) else latest), peak - t
            # With sort all events are here at once, so that none comes too late.
            lost = (behind > _OVERLAP_US) & (not self.reading.sort)
            late, moved = late + int(np.count_nonzero(lost)), moved + int(np.count_nonzero(behind[~lost]))
            most = max(most, int(behind[~lost].max(initial=0)))
            events = events.part(~lost) if lost.any() else events
            held = Events.concatenate([held, events])
            if (np.diff(held.t) < 0).any():
                held = held.part(np.argsort(held.t, kind="stable"))
            # What is still to come is not earlier than this.
            ready, held = held.split(latest - (0 if self.reading.sort else _OVERLAP_US))
            yield ready
        yield held
        if late:
            self.told["late"] = (
                f"left out: events more than {_OVERLAP_US // 1000} ms late: {late:,} (--sort keeps them)"
            )
        if moved:
            self.told["moved"] = f"put in order: events that came late: {moved:,}, by up to {most:,} µs"

    def _until_damage(self) -> Iterator[Events]:
        count = 0
        try:
            for events in self._declared():
                count += len(events)
                yield events
        except _REMEDIED as error:
            if not count:
                raise AssetError(f"no event is whole: {error.problem}", where=str(self.path)) from error
            self.told["cut"] = f"kept: events before the damage: {count:,} ({error.problem})"

    def _inside(self, whole: Iterable[Events]) -> Iterator[Events]:
        outside, inside, first = 0, 0, ""
        for events in whole:
            good = np.ones(len(events), bool)
            if self.reading.keep and self.height is not None and self.width is not None:
                good = (events.x < self.width) & (events.y < self.height)
            if not good.all():
                i = int(np.argmin(good))
                first = first or f"x {events.x[i]}, y {events.y[i]}"
                outside += int(np.count_nonzero(~good))
                events = events.part(good)
            inside += len(events)
            yield events
        if outside and not inside:
            raise AssetError(f"all events are outside {self.width}x{self.height}", where=str(self.path), value=first)
        if outside:
            self.told["outside"] = f"left out: events outside {self.width}x{self.height}: {outside:,} (first: {first})"

    def _with_remedy(self, error: EventDataError) -> EventDataError:
        """Return a refusal of :func:`check_events` that names the option which helps."""
        if "decrease" in error.problem:
            accepted = "times that do not; or --sort" + (", or --damaged keep" if self.fixed_unit else "")
        elif "outside" in error.problem:
            remedy = "a larger --size" if self.reading.size else "--damaged keep, or a larger --size"
            accepted = f"{error.accepted}; or {remedy}"
        else:
            return error
        return EventDataError(error.problem, where=error.where, value=error.value, accepted=accepted)

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
        check_size(height, width, str(self.path))
        return replace(self, height=height, width=width, guessed_size=True)


def ending_of(path: Path) -> str:
    """Return the ending that tells the format: ``.txt.gz`` of ``e.txt.gz``, ``.evt.json`` where a format has that."""
    two = "".join(path.suffixes[-2:]).lower()
    return two if two.endswith(".gz") or any(two in one.endings for one in FORMATS.values()) else path.suffix.lower()


def open_events(path: str | os.PathLike, reading: EventReading = AS_FILE) -> EventFile:
    """Open an event file; the content decides where the ending is ambiguous. reading : what the user declares.

    Raises AssetError: missing, unknown ending, or content that does not match the ending."""
    path = Path(path)
    kind = _kind(path, reading)
    reader = FORMATS[kind].open(path, reading)
    kind = getattr(reader, "version", kind)  # a .raw file says whether it is EVT2, EVT2.1 or EVT3
    height, width = reading.size or (reader.height, reader.width)
    check_size(height, width, str(path))
    file = EventFile(path, kind, height, width, getattr(reader, "t_offset_us", 0), reading, _reader=reader)
    if reading.size and reader.height and (reader.height, reader.width) != reading.size:
        file.told["size"] = f"the file says {reader.width}x{reader.height}; --size is used"
    for option, value in {"--time-unit": reading.time_unit, "--columns": reading.columns}.items():
        if file.fixed_unit and value and value != "us":
            file.told[option] = f"{kind} has its own columns, in µs; {option} is not used"
    return file


def kind_of_files(path: Path) -> str | None:
    """Return the format of a recording that lies in several files, of a folder or one of them; None: no such."""
    if path.match(_EVIMO2) or any(path.glob(_EVIMO2)):
        return "evimo2"
    if (path / "metadata.yaml").is_file():
        return "rosbag"
    endings = {file.suffix.lower() for file in path.iterdir()} if path.is_dir() else set()
    return "npz folder" if ".npz" in endings and endings <= _BESIDE else None


def _kind(path: Path, reading: EventReading) -> str:
    """Return the format of a file. Raises AssetError."""
    ending = ending_of(path)
    formats = [one for one in FORMATS.values() if ending in one.endings]
    if several := kind_of_files(path):
        return several
    if not formats:
        raise AssetError("unknown event file ending", where=str(path), value=path.suffix, accepted=", ".join(ENDINGS))
    if not path.is_file():
        raise AssetError("no such file", where=str(path))
    if ending in HDF5:
        from blinkgl.io.hdf5 import open_hdf5
        from blinkgl.io.hdf5_tables import is_dsec

        with open_hdf5(path) as file:
            return "dsec" if is_dsec(file, reading) else "hdf5"
    with open(path, "rb") as file:
        begin = file.read(16)
    marked = next((one for one in formats if one.magic and begin.startswith(one.magic)), None)
    return (marked or next((one for one in formats if not one.magic), formats[0])).name


def output_format(path: str | os.PathLike) -> str:
    """Return the format for writing ``path``. Raises OutputError: no written format has its ending."""
    kind = ENDINGS.get(ending_of(Path(path)))
    if kind is None or not FORMATS[kind].writer:
        raise OutputError(
            "unknown event file ending" if kind is None else f"{kind} files are read only",
            where=str(path),
            value=Path(path).suffix,
            accepted=", ".join(end for end, kind in ENDINGS.items() if FORMATS[kind].writer),
        )
    return kind


def _writer(
    path: Path, kind: str, height: int | None, width: int | None, t_offset_us: int, write_unit: str
) -> CheckedWriter:
    check_size(height, width, str(path), MAX_SIDE**2)
    if write_unit != "s" and "write_unit" not in FORMATS[kind].takes:
        raise OutputError(
            f"{kind} has a fixed unit of time",
            where=str(path),
            value=write_unit,
            accepted="--write-unit with .txt and .csv only; --time-unit is the unit of what is read",
        )
    if FORMATS[kind].sized and height is None:
        raise OutputError(
            f"{kind} stores the sensor's size, and the file does not give it", accepted="--size WIDTHxHEIGHT"
        )
    return FORMATS[kind].create(path, height, width, {"t_offset_us": t_offset_us, "write_unit": write_unit})


@contextlib.contextmanager
def event_writer(
    path: str | os.PathLike,
    height: int | None,
    width: int | None,
    *,
    t_offset_us: int = 0,
    write_unit: str = "s",
    overwrite: bool = True,
) -> Iterator[CheckedWriter]:
    """``with event_writer("out.h5", 480, 640) as out: out.append(events)``. The file appears under its name when the
    block ends without an exception, and not at all otherwise.

    height, width : px; None: not known, and not written. t_offset_us : DSEC only, the time of the recording's start.
    write_unit : text and CSV only, "s" or "us". Raises OutputError, EventDataError.
    """
    kind = output_format(path)
    with (
        atomic_file(path, overwrite=overwrite) as temporary,
        _writer(temporary, kind, height, width, t_offset_us, write_unit) as writer,
    ):
        yield writer


def write_events(
    path: str | os.PathLike, chunks: Events | Iterable[Events], height: int | None, width: int | None, **options: Any
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
    reading: EventReading = AS_FILE,
    *,
    zero_time: bool = False,
    write_unit: str = "s",
    overwrite: bool = True,
    triggers: str | os.PathLike | None = None,
) -> tuple[EventFile, int]:
    """Copy events from one format to another, streaming. A size that neither the source nor the user gives is not
    written.

    reading : what is declared of the source. write_unit : of text and CSV, "s" or "us". zero_time : shift times so that
    the first event is at 0, for EVT3, which counts from the start.   triggers : CSV of the source's triggers, t[us],
    channel, edge, on the times of the events that are written.
    Causes of events are left out where the format cannot store them.
    Returns the source, and the number of events written.
    """
    kind = output_format(target)
    with open_events(source, reading) as file:
        if file.fixed_unit and reading.time_unit not in (None, "us"):
            raise ConfigError(
                f"{file.format} files count µs",
                where="--time-unit",
                value=reading.time_unit,
                accepted="no --time-unit for them; --write-unit is the unit of text that is written",
            )
        if triggers is not None and file.triggers is None:
            raise ConfigError(f"{file.format} has no triggers", where="--triggers", accepted=".raw, .aedat4 or a bag")
        # Read beforehand: a writer is given DSEC's offset before the first event.
        first = next((int(e.t[0]) for e in file.chunks()), 0)
        shift = first if zero_time else 0
        # DSEC's t is u4 relative to t_offset: keep the source's own, else put it at the first event's second.
        whole = file.t_offset_us if file.t_offset_us or file.format == "dsec" else first // 1_000_000 * 1_000_000
        shifted = (replace(e, t=e.t - shift) for e in file.chunks()) if shift else file.chunks()
        if file.causes and not FORMATS[kind].causes:
            shifted = (replace(e, cause=None) for e in shifted)
        count = write_events(
            target,
            shifted,
            file.height,
            file.width,
            t_offset_us=0 if zero_time else whole,
            write_unit=write_unit,
            overwrite=overwrite,
        )
        if triggers is not None and file.triggers is not None:
            rows = file.triggers - [shift, 0, 0]
            lines = ["t[us],channel,edge", *(",".join(map(str, row)) for row in rows.tolist())]
            with atomic_file(triggers, overwrite=overwrite) as temporary, output_errors(triggers):
                temporary.write_text("\n".join(lines) + "\n")
            file.told["triggers"] = f"{len(rows):,} triggers written to {triggers}"
    return file, count
