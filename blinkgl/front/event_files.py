"""Event files: opened, read, written, converted."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypedDict, Unpack

from blinkgl.errors import ConfigError
from blinkgl.front import arguments as check
from blinkgl.io import formats
from blinkgl.io.formats import EventFile
from blinkgl.io.reading import EventReading
from blinkgl.types.events import Events

_SIDE = 65535


class EventOptions(TypedDict, total=False):
    """Declarations about an event file; :func:`blinkgl.open_events` describes them."""

    time_unit: str | None
    size: tuple[int, int] | None
    origin: str | None
    columns: str | Iterable[str] | None
    polarity: str | Iterable[float] | None
    stream: int | str | None
    damaged: str
    sort: bool


def event_reading(declared: Mapping[str, Any]) -> EventReading:
    """Return what is declared of event files, among other arguments. Raises ConfigError."""
    options = {key: value for key, value in declared.items() if key in EventOptions.__annotations__}
    if options.get("size") is not None:
        options["size"] = checked_size(options["size"])
    return EventReading.of(**options)


@check.public(EventOptions)
def open_events(path: str | os.PathLike, **declared: Unpack[EventOptions]) -> EventFile:
    """Open an event file for reading in pieces: ``with open_events(path) as file: for events in file.chunks(): …``;
    ``height``, ``width`` in px, None if the file does not contain them (``file.sized()`` computes them), times in µs.
    Formats and endings: docs/formats.md. For .aedat4 and .aedat also ``file.frames()``, the camera's own frames, and
    ``file.imu()``, its inertial unit. ``file.notes`` lists what was recognised, and after reading what was left out.

    time_unit : "s", "ms", "us" or "ns".   size : (height, width), px.   origin : "top" or "bottom", the row of y = 0.
    columns : order of a table's columns, "x,y,t,p".   polarity : numbers of OFF and ON, (-1, 1).   stream : of several,
    by name or number.   damaged : "refuse", or "keep" what is whole.   sort : put events in order of time. Default: as
    the file says; what it does not say and nobody declares is refused, with the options that declare it.
    Raises AssetError: missing file, unknown ending, or content of another format; ConfigError."""
    return formats.open_events(check.path(path, "path"), event_reading(declared))


@check.public(EventOptions)
def read_events(path: str | os.PathLike, *, truth: bool = False, **declared: Unpack[EventOptions]) -> Events:
    """Return all :class:`Events` of a file, t in µs, in memory. What is left out is a warning.

    truth : also read their causes (``Events.truth``), from ``event_labels.h5`` beside a sequence's ``events.h5``.
    declared : as of :func:`open_events`. Raises AssetError and EventDataError (decreasing times …)."""
    with formats.open_events(check.path(path, "path"), event_reading(declared)) as file:
        events = file.read()
    _warn(file)
    if not check.one_of(truth, "truth", bool, "True or False"):
        return events
    from blinkgl.io.event_labels import with_truth

    return with_truth(events, 0, check.path(path, "path").parent)


def _warn(file: EventFile) -> None:
    for line in file.notes:
        warnings.warn(f"{file.path}: {line}", stacklevel=4)


@check.public()
def write_events(
    path: str | os.PathLike,
    events: Events | Iterable[Events],
    height: int,
    width: int,
    *,
    t_offset_us: int = 0,
    write_unit: str = "s",
    overwrite: bool = True,
) -> int:
    """Write events, or chunks in order, of a sensor of height x width px, and return their number. The file appears
    complete or not at all.

    path : its ending names the format (docs/formats.md).   t_offset_us : DSEC's, µs.
    write_unit : of text and CSV, "s" or "us". Raises OutputError, EventDataError, ConfigError."""
    path, height, width = (
        check.path(path, "path"),
        check.whole(height, "height", 1, _SIDE),
        check.whole(width, "width", 1, _SIDE),
    )
    offset = check.whole(t_offset_us, "t_offset_us", 0, 2**62)
    return formats.write_events(
        path,
        _chunks(events),
        height,
        width,
        t_offset_us=offset,
        write_unit=write_unit,
        overwrite=overwrite,
    )


def _chunks(events: object) -> Iterator[Events]:
    if isinstance(events, Events):
        events = (events,)
    if not isinstance(events, Iterable):
        raise ConfigError("not events", where="events", value=events, accepted="Events, or chunks of them")

    def checked() -> Iterator[Events]:
        for chunk in events:
            yield check.one_of(chunk, "events", Events, "Events, or chunks of them")

    return checked()


@check.public(EventOptions)
def convert(
    source: str | os.PathLike,
    target: str | os.PathLike,
    *,
    zero_time: bool = False,
    write_unit: str = "s",
    overwrite: bool = True,
    **declared: Unpack[EventOptions],
) -> int:
    """Copy events from one file format to another, in pieces. Returns the number of events. A guess, or something left
    out, is a warning.

    write_unit : as of :func:`write_events`.   zero_time : count times from the first event.   declared : of ``source``,
    as of :func:`open_events`. Raises AssetError, OutputError, EventDataError, ConfigError."""
    file, count = formats.convert(
        check.path(source, "source"),
        check.path(target, "target"),
        event_reading(declared),
        zero_time=bool(zero_time),
        write_unit=write_unit,
        overwrite=overwrite,
    )
    _warn(file)
    return count


def checked_size(size: object) -> tuple[int, int]:
    """Return (height, width), px. Raises ConfigError."""
    pair = check.one_of(size, "size", (list, tuple), "(height, width)")
    if len(pair) != 2:
        raise ConfigError("not two numbers", where="size", value=size, accepted="(height, width)")
    return check.whole(pair[0], "size", 1, _SIDE), check.whole(pair[1], "size", 1, _SIDE)
