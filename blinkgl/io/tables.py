"""Events as four columns of numbers, whatever holds them: NumPy's and MATLAB's files, HDF5, text.

People write the same table under many names (``t ts timestamps t_us``, ``x xs``, ``p pol polarity on``), with p as 0/1,
-1/1 or bool and t as any number of any unit. Names and units are known here, once; what has neither is proposed to the
user as the options to declare, and not read.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.columns import events_of, microseconds, proposed_polarity
from blinkgl.io.reading import EventReading, chosen
from blinkgl.io.records import shown_names
from blinkgl.io.times import NANOSECONDS, named_unit, overruled
from blinkgl.types.events import Events

_NAMES = {
    "t": "t ts time times timestamp timestamps stamp stamps",
    "x": "x xs col cols column",
    "y": "y ys row rows",
    "p": "p ps pol pols polarity polarities on",
}
_SLOT = {word: slot for slot, words in _NAMES.items() for word in words.split()}
_STATES = re.compile(
    r"(.*[_ ])?(size|resolution|shape|geometry|offset|start|t0|scale|units?|width|height|origin)([_ ].*)?|h|w", re.I
)
"""Names beside the columns that may say something about the events."""
_SAMPLE = 1 << 16
"""Rows that a proposal is made from."""
_NANOSECONDS_FROM = 1e17
"""Whole numbers from which on times are proposed as ns: in µs these are later than the year 5000."""


def slot_of(name: str) -> str:
    """Return which column a name means, "x", "y", "t" or "p"; "_": none of them. Units are no part of it: ``t_us``,
    ``timestamp [ns]``, ``x [px]``."""
    bare = re.sub(r"[\s_]*[\[(<{].*$", "", name.strip().lower()).removeprefix("events_").removeprefix("event_")
    return _SLOT.get(bare) or _SLOT.get(
        bare.rpartition("_")[0] if named_unit(bare) or bare.endswith("_px") else "", "_"
    )


def named_columns(names: Iterable[str], reading: EventReading, where: str) -> dict[str, str]:
    """Return column -> its name among ``names``: as declared, else the one that means it; of several the bare letter.
    Raises AssetError: several, and none is declared."""
    named: dict[str, list[str]] = {}
    names = list(names)
    for name in names:
        if (slot := slot_of(name)) != "_":
            named.setdefault(slot, []).append(name)
    whole = set("txyp") <= {*named, *reading.named}
    for slot, all_ in named.items():
        if whole and slot not in reading.named and len(all_) > 1 and slot not in all_:
            raise AssetError(
                f"{len(all_)} columns that may be {slot}, and none is chosen",
                where=where,
                accepted="one of " + ", ".join(f"--columns {slot}={name}" for name in all_),
            )
    columns = {slot: slot if slot in all_ else all_[0] for slot, all_ in named.items() if slot not in reading.named}
    return columns | {slot: name for slot, name in reading.named.items() if name in names}


def not_read(names: Iterable[str], known: Collection[str]) -> list[str]:
    """Return the line that says which of the ``names`` beside the columns seem to state something that no reader
    knows."""
    left = sorted({name for name in names if name not in known and _STATES.fullmatch(name)})
    return (
        [f"left out: {shown_names(left)}, whose meaning is not known (--size, --time-unit, --origin)"] if left else []
    )


def not_columns(names: Iterable[str]) -> list[str]:
    """Return the line that says which columns of the events' table, one value an event, are not read."""
    return [f"left out: columns that are none of t, x, y, p: {shown_names(left)}"] if (left := list(names)) else []


def proposal(rows: np.ndarray | None, times: np.ndarray | None = None) -> str:
    """Return the options to paste for (N, 4) rows without names, or for times without a unit, as far as a sample of the
    file shows them. The user declares; nothing is read by this."""
    options = []
    if rows is not None:
        if rows.ndim != 2 or rows.shape[1] != 4:
            return "--columns with x, y, t, p in the file's order, _ for others, and --time-unit"
        # t rises nearly everywhere and has the most values, p has the fewest; the others are x and y.
        share = [round(float(np.mean(np.diff(column) >= 0)), 1) if len(column) > 1 else 0.0 for column in rows.T]
        values = [len(np.unique(column)) for column in rows.T]
        t = max(range(4), key=lambda k: (share[k], values[k]))
        p = min((k for k in (3, 2, 1, 0) if k != t), key=lambda k: values[k])
        order = ["_"] * 4
        order[t], order[p] = "t", "p"
        for k, slot in zip([k for k in range(4) if order[k] == "_"], "xy", strict=True):
            order[k] = slot
        options.append(f"--columns {','.join(order)}")
        times = rows[:, t]
    if times is not None:
        size = float(np.abs(times).max()) if len(times) else 0.0
        whole = not len(times) or not (times % 1).any()
        options.append(f"--time-unit {('ns' if size > _NANOSECONDS_FROM else 'us') if whole else 's'}")
    return " ".join(options)


def undeclared(problem: str, where: str, rows: np.ndarray | None, times: np.ndarray | None = None) -> AssetError:
    """Return the refusal of a file that does not say what its columns or times are, with the options to paste."""
    return AssetError(
        problem,
        where=where,
        accepted=f"try {proposal(rows, times)} if that is right (blinkgl convert --look shows the file)",
    )


@dataclass
class Table:
    """Four columns in a file.   read : rows of a slice, "x", "y", "t", "p" and perhaps "cause" -> (N,) numbers.
    count : rows.   heading : the name of t.   unit : of t, where the file or its layout says it.   offset : added to
    t, in its unit.   size : (height, width), px, None: not in the file.   place : where it lies in the file.   layout :
    the name of the layout by which its unit is known; "": the file states it, or nothing does.   per_px : steps of x
    and y in a pixel.   notes : lines for the user.   named : whether its columns have names."""

    read: Callable[[slice], dict[str, np.ndarray]]
    count: int
    heading: str = "t"
    unit: str | None = None
    offset: int | float = 0
    size: tuple[int, int] | None = None
    place: str = ""
    layout: str = ""
    per_px: int = 1
    notes: Sequence[str] = ()
    named: bool = True


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

    others = not_columns(name for name in records.dtype.names if name not in named.values())
    made = Table(read, len(records), named["t"], **known)
    return replace(made, notes=[*made.notes, *others])


def table_of_rows(rows: Any, where: str, order: tuple[str, ...] | None, **known: Any) -> Table:
    """Return the table of an array (N, K) without names: K columns of the declared order. Raises AssetError, which
    proposes one: none is declared; of another length."""
    if not order or any("=" in entry for entry in order):
        sample = np.asarray(rows[:_SAMPLE])
        raise undeclared(f"array '{known.get('place', '')}' has no names of columns", where, sample)
    slots: tuple[str, ...] = order
    if len(slots) != rows.shape[1]:
        raise AssetError(
            f"--columns names {len(order)} columns", where=where, value=rows.shape, accepted="one for each"
        )

    def read(part: slice) -> dict[str, np.ndarray]:
        columns = np.ascontiguousarray(rows[part].T)  # contiguous, because each is read several times
        return {slot: column for slot, column in zip(slots, columns, strict=True) if slot != "_"}

    return Table(read, len(rows), **known, named=False)


Candidate = tuple[str, Callable[[], Table]]
"""The place of a table in a file, and what makes it, once it is chosen."""


def choose(candidates: list[Candidate], reading: EventReading, where: str, held: Iterable[str]) -> Table:
    """Return the table that the user means, or the only one.   held : what the file holds, for the message. Raises
    AssetError, which lists them, or says that there is none."""
    if not candidates:
        raise AssetError(
            "no columns of events",
            where=where,
            value=list(held)[:12],
            accepted="x, y, t, p in one place, an array (N, 4), or --columns x=NAME,y=NAME,t=NAME,p=NAME",
        )
    return candidates[chosen(reading.stream, [place for place, _ in candidates], where, "arrays of events")][1]()


class TableReader:
    """Events of a table. height, width : px, None where the file does not give them.   unit : of its times, read or
    declared.   notes : lines for the user.   unread : rows left out so far, with ``damaged="keep"``. Raises AssetError:
    no unit is stated or declared."""

    def __init__(self, path: Path, reading: EventReading, table: Table):
        self.path, self._keep, self._polarity, self.unread = path, reading.keep, reading.polarity, 0
        self._table, self.notes = table, [*table.notes]
        self.height, self.width = table.size or (None, None)
        first = table.read(slice(0, 1))
        self.count, self.causes = table.count, "cause" in first
        # NumPy's datetime64 and timedelta64 say their unit in the type.
        stated = np.datetime_data(first["t"].dtype) if first["t"].dtype.kind in "mM" else (None, 1)
        self._dated = stated[0] in NANOSECONDS and stated[1] == 1
        own = table.unit or (stated[0] if self._dated else named_unit(table.heading))
        unit = reading.time_unit or own
        self.notes += overruled(own, reading.time_unit)
        if table.named and reading.columns and not reading.named:
            self.notes.append("the columns have names; --columns is not used (x=NAME,y=NAME … for others)")
        if unit is None:
            times = table.read(slice(0, _SAMPLE))["t"]
            if len(times) and times.dtype.kind in "iuf":
                raise undeclared(f"no unit of the times '{table.heading}' is stated", str(path), None, times)
        elif table.layout and reading.time_unit is None:
            self.notes.append(f"read as {table.layout}")
        self.unit = unit or "us"  # of no times, or of no numbers, which reading refuses

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        """Yield all events in pieces of ``size``. Raises EventDataError, naming the event, for values that are none."""
        where, self.unread, unit = str(self.path), 0, NANOSECONDS[self.unit]
        offset = int(microseconds(np.array([self._table.offset]), where, 0, unit)[0])
        off: set[int] = set()
        for first in range(0, self.count, size):
            columns = self._table.read(slice(first, min(self.count, first + size)))
            if self._keep:
                columns = self._whole(columns)
            t = microseconds(self._numbers(columns["t"], where, first), where, first, unit)
            x, y = (columns[side] if self._table.per_px == 1 else columns[side] / self._table.per_px for side in "xy")
            p, cause = columns["p"], columns.get("cause")
            polarity = self._polarity
            # NaN and infinity are refused below, where the event is named.
            if polarity is None and p.dtype.kind in "if" and len(known := p[np.isfinite(p)]):
                # OFF is 0 or -1; the second of them in a file is another code.
                off |= {-1, 0} if known.min() < 0 and (known == 0).any() else {min(int(known.min()), 1)}
                if off >= {-1, 0}:
                    accepted = f"0 and 1, or -1 and 1{proposed_polarity(p)}"
                    raise EventDataError("polarities -1 and 0 in one file", where=where, accepted=accepted)
            yield events_of(x, y, t, p, where, first, cause=cause, offset=offset, signed=True, polarity=polarity)
        if self.count and self.unread == self.count:
            raise AssetError("no row is an event", where=where, accepted="x, y, t, p (--columns)")

    def _numbers(self, times: np.ndarray, where: str, first: int) -> np.ndarray:
        """Return times as numbers: those of NumPy's dates are int64. Raises EventDataError, as for NaN: no date."""
        if not self._dated:
            return times
        if (none := np.isnat(times)).any():
            microseconds(np.array([np.nan]), where, first + int(np.argmax(none)))
        return times.astype(np.int64)

    def _whole(self, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the rows that an event can be; count the others."""
        whole = np.ones(len(columns["t"]), bool)
        for slot, column in columns.items():
            if column.dtype.kind in "fmM":
                whole &= np.isfinite(column)
            if slot in "xy":
                whole &= (column >= 0) & (column < 65536)
        self.unread += int(np.count_nonzero(~whole))
        return {slot: column[whole] for slot, column in columns.items()}
