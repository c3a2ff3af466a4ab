"""Events as four columns of numbers, whatever holds them: NumPy's and MATLAB's files, HDF5, text.

People write the same table under many names (``t ts timestamps t_us``, ``x xs``, ``p pol polarity on``), with p as 0/1,
-1/1 or bool and t as any number of any unit. Names and units are known here, once.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.clock import TimeUnit, guessed_event_unit, named_unit, unit_of
from blinkgl.io.columns import events_of, microseconds
from blinkgl.io.reading import EventReading
from blinkgl.types.events import Events

_NAMES = {
    "t": "t ts time times timestamp timestamps stamp stamps",
    "x": "x xs col cols column",
    "y": "y ys row rows",
    "p": "p ps pol pols polarity polarities on",
}
_SLOT = {word: slot for slot, words in _NAMES.items() for word in words.split()}
_FEW = 16
"""Rows below which columns rise by accident."""
_SAMPLE = 1 << 16
"""Rows at each end of a table that a guess is made from."""


def slot_of(name: str) -> str:
    """Return which column a name means, "x", "y", "t" or "p"; "_": none of them. Units are no part of it: ``t_us``,
    ``timestamp [ns]``, ``x [px]``."""
    bare = re.sub(r"[\s_]*[\[(<{].*$", "", name.strip().lower()).removeprefix("events_").removeprefix("event_")
    return _SLOT.get(bare) or _SLOT.get(
        bare.rpartition("_")[0] if named_unit(bare) or bare.endswith("_px") else "", "_"
    )


def named_columns(names: Iterable[str], reading: EventReading) -> dict[str, str]:
    """Return column -> its name among ``names``: as declared, else the first that means it."""
    found = dict(reading.named)
    for name in names:
        slot = slot_of(name)
        if slot != "_":
            found.setdefault(slot, name)
    return {slot: name for slot, name in found.items() if name in names}


def guessed_order(rows: np.ndarray) -> tuple[str, ...]:
    """Return the order of the columns of (N, 4) numbers without names: t x y p, unless p, the last column of -1, 0 and
    1 alone, or the rising one say another."""
    # From the last: of a still x or y, which may be 0 or 1 alone, p is the one behind it.
    signs = [k for k in (3, 2, 1, 0) if np.isin(rows[:, k], (-1, 0, 1)).all()]
    p = signs[0] if signs else 3
    rising = [k for k in range(4) if k != p and (np.diff(rows[:, k]) >= 0).all()]
    t = 0 if len(rows) < _FEW or not rising else rising[0]
    p = 3 if len(rows) < _FEW else p
    order = ["_"] * 4
    order[p], order[t] = "p", "t"
    for k, slot in zip([k for k in range(4) if order[k] == "_"], "xy", strict=True):
        order[k] = slot
    return tuple(order)


def order_line(order: Iterable[str]) -> str:
    """Return the sentence that says a guessed order, and the option that overrules it."""
    return f"columns taken as {' '.join(order)} (--columns x,y,t,p, or as they are, if that is wrong)"


@dataclass
class Table:
    """Four columns in a file.   read : rows of a slice, "x", "y", "t", "p" and perhaps "cause" -> (N,) numbers.
    count : rows.   heading : the name of t.   unit : of t, where the file or its layout says it.   offset : added to
    t, in its unit.   size : (height, width), px, None: not in the file.   place : where it lies in the file.   notes :
    lines for the user, of guesses."""

    read: Callable[[slice], dict[str, np.ndarray]]
    count: int
    heading: str = "t"
    unit: str | None = None
    offset: int | float = 0
    size: tuple[int, int] | None = None
    place: str = ""
    notes: tuple[str, ...] = ()


def table_of_columns(columns: Mapping[str, Any], where: str, **known: Any) -> Table:
    """Return the table of columns that can be sliced: (N,), or vectors of two axes, as MATLAB has them. Raises
    AssetError: columns of different lengths, or no numbers."""
    lengths = {slot: max(column.shape, default=0) for slot, column in columns.items() if _is_vector(column)}
    if len(lengths) != len(columns) or len(set(lengths.values())) != 1:
        raise AssetError(
            "event columns differ in length",
            where=where,
            value={slot: getattr(column, "shape", None) for slot, column in columns.items()},
        )

    def read(part: slice) -> dict[str, np.ndarray]:
        flat = {slot: column for slot, column in columns.items() if len(column.shape) == 1}
        wide = {slot: column for slot, column in columns.items() if slot not in flat}
        ranks = {slot: column[0, part] if column.shape[0] == 1 else column[part, 0] for slot, column in wide.items()}
        return {slot: column[part] for slot, column in flat.items()} | ranks

    return Table(read, lengths["t"], **known)


def _is_vector(column: Any) -> bool:
    shape = column.shape
    return shape is not None and (len(shape) == 1 or (len(shape) == 2 and 1 in shape))


def table_of_records(records: Any, named: Mapping[str, str], **known: Any) -> Table:
    """Return the table of an array (N,) of records, whose fields ``named`` gives."""

    def read(part: slice) -> dict[str, np.ndarray]:
        rows = records[part]
        return {slot: rows[name] for slot, name in named.items()}

    return Table(read, len(records), named["t"], **known)


def table_of_rows(rows: Any, where: str, reading: EventReading, **known: Any) -> Table:
    """Return the table of an array (N, K) without names: K columns as declared, or four by :func:`guessed_order`."""
    order, notes = reading.columns or (), ()
    if not order or reading.named:
        if rows.shape[1] != 4:
            raise AssetError("columns without names", where=where, value=rows.shape, accepted="--columns x,y,t,p")
        order = guessed_order(np.concatenate([rows[:_SAMPLE], rows[max(_SAMPLE, len(rows) - _SAMPLE) :]]))
        notes = (order_line(order),)
    if len(order) != rows.shape[1]:
        raise AssetError(
            f"--columns names {len(order)} columns", where=where, value=rows.shape, accepted="one for each"
        )

    def read(part: slice) -> dict[str, np.ndarray]:
        columns = np.ascontiguousarray(rows[part].T)  # contiguous, because each is read several times
        return {slot: column for slot, column in zip(order, columns, strict=True) if slot != "_"}

    return Table(read, len(rows), notes=notes, **known)


class TableReader:
    """Events of a table. height, width : px, None where the file does not give them.   unit : of its times, read,
    declared or guessed.   notes : lines for the user.   unread : rows left out so far, with ``damaged="keep"``."""

    def __init__(self, path: Path, reading: EventReading, tables: list[Table]):
        self.path, self._keep, self._polarity, self.unread = path, reading.keep, reading.polarity, 0
        number = reading.stream or 0
        if not 0 <= number < len(tables):
            raise AssetError(
                "no such stream", where=str(path), value=number, accepted=f"--stream 0 to {len(tables) - 1}"
            )
        self._table = table = tables[number]
        self.notes = [*table.notes]
        if len(tables) > 1:
            more = f"{len(tables)} streams of events: {number} ({table.place}) is read (--stream for another)"
            self.notes.append(more)
        self.height, self.width = table.size or (None, None)
        first = table.read(slice(0, 1))
        self.count, self.causes = table.count, "cause" in first
        self._numbers = first["t"].dtype.kind in "iufb"
        self.unit = unit_of(reading.time_unit, table.unit or named_unit(table.heading), self._guessed)

    def _guessed(self) -> TimeUnit:
        if not self._numbers:
            return TimeUnit("us", "read")
        ends = (slice(0, _SAMPLE), slice(max(self.count - _SAMPLE, _SAMPLE), self.count))
        t = np.concatenate([self._table.read(part)["t"] for part in ends]).astype(np.float64) + self._table.offset
        t = t[np.isfinite(t)]
        return guessed_event_unit(t, self.count) if len(t) else TimeUnit("us", "read")

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        """Yield all events in pieces of ``size``. Raises EventDataError, naming the event, for values that are none."""
        where, self.unread, unit = str(self.path), 0, self.unit.nanoseconds
        offset = int(microseconds(np.array([self._table.offset]), where, 0, unit)[0])
        for first in range(0, self.count, size):
            columns = self._table.read(slice(first, min(self.count, first + size)))
            if self._keep:
                columns = self._whole(columns)
            t = microseconds(columns["t"], where, first, unit)
            x, y, p, cause = columns["x"], columns["y"], columns["p"], columns.get("cause")
            polarity = self._polarity
            yield events_of(x, y, t, p, where, first, cause=cause, offset=offset, signed=True, polarity=polarity)

    def _whole(self, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the rows that an event can be; count the others."""
        whole = np.ones(len(columns["t"]), bool)
        for slot, column in columns.items():
            if column.dtype.kind == "f":
                whole &= np.isfinite(column) & ((column % 1 == 0) | (slot == "t"))
            if slot in "xy":
                whole &= (column >= 0) & (column < 65536)
        self.unread += int(np.count_nonzero(~whole))
        return {slot: column[whole] for slot, column in columns.items()}
