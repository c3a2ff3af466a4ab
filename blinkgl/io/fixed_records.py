"""Formats whose events are records of one length: Prophesee's ``.dat`` and the ``.bin`` of N-MNIST and N-Caltech101.

.dat (Prophesee, "DAT format" page): lines that begin with ``%``, of which ``% Height``, ``% Width`` and ``% Version``
matter; two bytes, type of event (0 and 12: x, y, polarity) and bytes a record (8); then t uint32 µs, which wraps after
71.6 minutes, and an address: x in bits 13..0, y 27..14, polarity 31..28.
.bin (Orchard et al. 2015): 40 bits, big-endian: x 8, y 8, polarity 1, t 23 bits µs. y = 240 marks no event but that
2^13 µs have passed.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError, OutputError
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import CheckedWriter
from blinkgl.io.reading import AS_FILE, Damage, EventReading, listed
from blinkgl.io.records import input_errors
from blinkgl.types.events import Events

_DAT = np.dtype([("t", "<u4"), ("address", "<u4")])
_NMNIST = np.dtype([("x", "u1"), ("y", "u1"), ("high", "u1"), ("low", ">u2")])
_LONGEST_HEADER = 1 << 16
_PASSES, _PASSED_US = 240, 1 << 13
_SHORT, _LONG = (0x1FF, 9, 0xFF, 17, 1), (0x3FFF, 14, 0x3FFF, 28, 0xF)
_VERSIONS = {"": _LONG, "1": _SHORT, "2": _LONG}
"""Version of a .dat, as its header states it -> masks and shifts of an address: x, then y, then polarity. Prophesee's
own tools read files without a version as version 2."""
_EVENT_TYPES = {0: "TD", 12: "CD"}
"""Types of .dat records that are contrast changes."""


def read_records(
    path: Path, start: int, dtype: np.dtype, count: int, last: Callable[[int], str] = lambda _: "the last event"
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the records behind the first ``start`` bytes of a file, ``count`` at a time, and the number of the first of
    them.   last : names the last record, by the number of them, for messages. Raises AssetError: unreadable; after all
    whole records: truncated."""
    first = 0
    with input_errors(path), open(path, "rb") as file:
        file.seek(start)
        while data := file.read(count * dtype.itemsize):
            whole, stray = divmod(len(data), dtype.itemsize)
            if whole:
                yield first, np.frombuffer(data, dtype, whole)
            first += whole
            if stray:
                raise Damage(f"truncated: {stray} stray bytes after {last(first)}", where=str(path))


class DatReader:
    """Size and events of a .dat file. Raises AssetError: a version, a type of events or a polarity that is not known,
    truncated."""

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        self.path = Path(path)
        with input_errors(path), open(path, "rb") as file:
            begin = file.read(_LONGEST_HEADER)
        heading = re.match(rb"(?:%[^\n]*\n)*", begin)
        # Two bytes follow the header's lines: the type of events and the size of a record.
        header, self._start = heading[0].decode("latin-1") if heading else "", heading.end() + 2 if heading else 2
        kind = begin[self._start - 2 : self._start]
        if len(kind) < 2 or kind[0] not in _EVENT_TYPES or kind[1] != _DAT.itemsize:
            raise AssetError(
                "not a .dat file of events",
                where=str(path),
                value=f"type {kind[0]}, {kind[1]} bytes an event" if len(kind) == 2 else "no type of events",
                accepted="type 0 or 12, 8 bytes an event",
            )
        # The last line of a name counts, as in Prophesee's tools.
        fields = dict(re.findall(r"^%\s*(\w+)[ \t:]+(\S.*?)\s*$", header, re.M))
        sides = [fields.get(name) for name in ("Height", "Width")]
        if not all(side is None or re.fullmatch(r"\d{1,5}", side) for side in sides):
            raise AssetError("a size in the header is no number", where=str(path), value=sides, accepted="px")
        self.height, self.width = (None if side is None else int(side) for side in sides)
        self._places = listed(_VERSIONS, fields.get("Version", ""), "unknown Version of .dat", path, "1, 2 or none")

    def chunks(self, count: int = 1 << 20) -> Iterator[Events]:
        """Yield all events."""
        x_mask, y_from, y_mask, p_from, p_mask = self._places
        wraps, last = 0, 0
        for first, rows in read_records(self.path, self._start, _DAT, count):
            t, address = rows["t"].astype(np.int64), rows["address"]
            # A step back by more than half of the counter's range is its wrap.
            turns = wraps + np.cumsum(np.diff(t, prepend=last) < -(1 << 31))
            wraps, last = int(turns[-1]), int(t[-1])
            x, y = address & x_mask, address >> y_from & y_mask
            p = address >> p_from & p_mask
            if (p > 1).any():
                i = int(np.argmax(p > 1))
                raise AssetError(
                    f"polarity of event {first + i}", where=str(self.path), value=int(p[i]), accepted="0 or 1"
                )
            yield Events(x.astype(np.uint16), y.astype(np.uint16), t + (turns << 32), p.astype(np.uint8))


class NMnistReader:
    """Events of a .bin file; it has no size. Raises AssetError: truncated."""

    height = width = None

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        self.path = Path(path)

    def chunks(self, count: int = 1 << 20) -> Iterator[Events]:
        """Yield all events."""
        passed = 0
        for _, rows in read_records(self.path, 0, _NMNIST, count):
            marks = rows["y"] == _PASSES
            # Every mark delays all records from its own place on.
            base = passed + np.cumsum(marks) * _PASSED_US
            passed = int(base[-1])
            # Of the third byte the upper bit is the polarity, and the other seven begin the time.
            t = ((rows["high"].astype(np.int64) & 0x7F) << 16) + rows["low"] + base
            x, y, p = rows["x"].astype(np.uint16), rows["y"].astype(np.uint16), rows["high"] >> 7
            yield Events(x, y, t, p).part(~marks)


class NMnistWriter(CheckedWriter):
    """Writes a .bin file. Raises OutputError: a sensor whose columns a byte cannot hold, or with the row that is a
    mark."""

    kind = "N-MNIST's .bin"
    limits = 0, 1 << 23, "a time that 23 bits of .bin cannot hold"

    def __init__(self, path: str | os.PathLike, height: int | None, width: int | None):
        super().__init__(path, height, width)
        if (width or 0) > 256 or (height or 0) > _PASSES:
            raise OutputError(
                "a sensor larger than .bin holds", where=str(path), value=f"{width}x{height}", accepted="256x240 px"
            )
        with output_errors(self.path):
            self._file = open(path, "wb")  # noqa: SIM115 - closed by close/abort

    def _write(self, events: Events) -> None:
        rows = np.empty(len(events), _NMNIST)
        if events.x.max() > 255 or events.y.max() >= _PASSES:  # of a sensor whose size is not known
            raise OutputError("an event outside what .bin holds", where=str(self.path), accepted="256x240 px")
        rows["x"], rows["y"], rows["low"] = events.x, events.y, events.t & 0xFFFF
        # Bit 7 is the polarity; the seven below it are the upper ones of the time.
        rows["high"] = events.p << 7 | (events.t >> 16).astype(np.uint8)
        self._file.write(rows.tobytes())
