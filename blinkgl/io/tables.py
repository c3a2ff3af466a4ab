"""Events as four columns of numbers, whatever holds them: NumPy's and MATLAB's files, HDF5, text.

People write the same table under many names (``t ts timestamps t_us``, ``x xs``, ``p pol polarity on``), with p as 0/1,
-1/1 or bool and t as any number of any unit. Names and units are known here, once.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.clock import TimeUnit, guessed_event_unit, named_unit
from blinkgl.io.columns import check_size, events_of, microseconds
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
    bare = re.sub(r"[\s_]*[\[(<{].*$|_(s|ms|us|µs|ns|px)$", "", name.strip().lower())
    return _SLOT.get(bare, "_")


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
    """Four columns in a file.   columns : "x", "y", "t", "p" and perhaps "cause" -> (N,) numbers that can be sliced.
    heading : the name of t.   unit : of t, where the file or its layout says it.   offset : added to t, in its unit.
    size : (height, width), px, None: not in the file.   place : where it lies in the file.   said : lines for the user,
    of guesses."""

    columns: Mapping[str, Any]
    heading: str = "t"
    unit: str | None = None
    offset: int | float = 0
    size: tuple[int, int] | None = None
    place: str = ""
    said: tuple[str, ...] = ()


def table_of_rows(rows: Any, where: str, reading: EventReading, **known: Any) -> Table:
    """Return the table of an array (N, K) without names: K columns as declared, or four by :func:`guessed_order`."""
    order, said = reading.columns, ()
    if not order or reading.named:
        if rows.shape[1] != 4:
            raise AssetError("columns without names", where=where, value=rows.shape, accepted="--columns x,y,t,p")
        order = guessed_order(np.concatenate([rows[:_SAMPLE], rows[max(_SAMPLE, len(rows) - _SAMPLE) :]]))
        said = (order_line(order),)
    if len(order) != rows.shape[1]:
        raise AssetError(
            f"--columns names {len(order)} columns", where=where, value=rows.shape, accepted="one for each"
        )
    return Table({slot: RowColumn(rows, k) for k, slot in enumerate(order) if slot != "_"}, said=said, **known)


class RowColumn:
    """Column ``k`` of rows that may lie in a file."""

    def __init__(self, rows: Any, k: int):
        self._rows, self._k, self.shape, self.dtype = rows, k, rows.shape[:1], rows.dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, part: Any) -> np.ndarray:
        return np.ascontiguousarray(self._rows[part, self._k])


class TableReader:
    """Events of a table. height, width : px, None where the file does not give them.   unit : of its times, read,
    declared or guessed.   said : lines for the user."""

    def __init__(self, path: Path, reading: EventReading, tables: list[Table]):
        self.path, self._keep, self._polarity = path, reading.keep, reading.polarity
        number = reading.stream or 0
        if not 0 <= number < len(tables):
            raise AssetError(
                "no such stream", where=str(path), value=number, accepted=f"--stream 0 to {len(tables) - 1}"
            )
        self._table = table = tables[number]
        self.said = [*table.said]
        if len(tables) > 1:
            self.said.append(
                f"{len(tables)} streams of events: {number} ({table.place}) is read (--stream for another)"
            )
        self.height, self.width = table.size or (None, None)
        check_size(self.height, self.width, str(path))
        shapes = {slot: tuple(column.shape) for slot, column in table.columns.items()}
        if any(len(shape) != 1 for shape in shapes.values()) or len(set(shapes.values())) != 1:
            raise AssetError("event columns differ in length", where=str(path), value=shapes)
        self.count, self.causes = next(iter(shapes.values()))[0], "cause" in table.columns
        self.unit = self._unit(table, reading.time_unit)

    def _unit(self, table: Table, declared: str | None) -> TimeUnit:
        if declared:
            return TimeUnit(declared, "declared")
        if said := table.unit or named_unit(table.heading):
            return TimeUnit(said, "read")
        t = table.columns["t"]
        if t.dtype.kind not in "iufb" or not self.count:
            return TimeUnit("us", "read")  # no numbers: refused by the first event
        sample = (
            np.concatenate([t[:_SAMPLE], t[max(self.count - _SAMPLE, _SAMPLE) :]]).astype(np.float64) + table.offset
        )
        good = sample[np.isfinite(sample)]
        return guessed_event_unit(good, self.count) if len(good) else TimeUnit("us", "read")

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        """Yield all events in pieces of ``size``. Raises EventDataError, naming the event, for values that are none."""
        where, self.unread = str(self.path), 0
        for first in range(0, self.count, size):
            columns = {slot: np.asarray(column[first : first + size]) for slot, column in self._table.columns.items()}
            yield from self._events(columns, where, first)

    def _events(self, columns: dict[str, np.ndarray], where: str, first: int) -> Iterator[Events]:
        offset, unit = self._table.offset, self.unit.nanoseconds
        whole = np.ones(len(columns["t"]), bool)
        if self._keep:  # what no event can be is left out, and counted
            for slot, column in columns.items():
                if column.dtype.kind == "f":
                    whole &= np.isfinite(column) & ((column % 1 == 0) | (slot == "t"))
                if slot in "xy":
                    whole &= (column >= 0) & (column < 65536)
            columns = {slot: column[whole] for slot, column in columns.items()}
            self.unread += int(len(whole) - np.count_nonzero(whole))
        shift = int(microseconds(np.array([offset]), where, 0, unit)[0]) if offset else 0
        t = microseconds(columns.pop("t"), where, first, unit)
        yield events_of(**columns, t=t, where=where, first=first, offset=shift, signed=True, polarity=self._polarity)
