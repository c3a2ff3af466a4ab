"""Events in HDF5 files of any layout, and in MATLAB's .mat of version 7.3, which is HDF5.

Found by names, in every group: ``events/{x,y,t,p}``, ``events/{xs,ys,ts,ps}``, ``x y t p`` at the root, an array (N, 4)
such as MVSEC's ``davis/left/events``, or an array of records. ``t_offset`` and ``height``, ``width`` beside them count.
"""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.hdf5 import Data, Group, Hdf5File, hdf5_errors, open_hdf5
from blinkgl.io.reading import AS_FILE, EventReading
from blinkgl.io.tables import (
    Candidate,
    Table,
    TableReader,
    choose,
    named_columns,
    not_columns,
    not_read,
    table_of_columns,
    table_of_records,
    table_of_rows,
)

MVSEC_EVENTS = ("davis/left/events", "davis/right/events")
"""Of both cameras of MVSEC's ``*_data.hdf5``: (N, 4) float64, x, y, t[s], ±1, of 346x260 px."""
_MILLISECONDS = ("ms_to_idx", "ms_map_idx")
"""Tables of milliseconds beside integer times, as DSEC, BlinkFlow, TUM-VIE and M3ED have them: these are µs."""
_EVENT_UTILS = {"xs": "iu", "ys": "iu", "ts": "f", "ps": "b"}
"""The group ``events`` of event_utils' and HQF's files, names and kinds of numbers: times are in seconds."""
_SIZES = ("sensor_resolution", "geometry", "resolution")
"""Attributes or data sets that hold a size; ``geometry`` of Metavision is WIDTHxHEIGHT, ``sensor_resolution`` of
event_utils (height, width), ``calib/resolution`` of M3ED (width, height)."""


class Hdf5TableReader(TableReader):
    """Events of the only table of a file, or of the one that ``stream`` names; its file stays open. Raises AssetError:
    several and none is chosen, which it lists."""

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        self.path = Path(path)
        self._file = open_hdf5(self.path)
        with hdf5_errors(self.path, self._file):
            tables = _candidates(self._file, self.path, reading)
            called = [one for one in tables[1] if one[0] in MVSEC_EVENTS or one[0].rpartition("/")[2] == "events"]
            every = [*tables[0], *tables[1]]
            # A name may mean any of them; a number counts those that the refusal lists.
            candidates = every if reading.stream in dict(every) else tables[0] or called or tables[1]
            table = choose(candidates, reading, str(path), self._file.names())
            super().__init__(self.path, reading, table)
        self.version = "mvsec" if table.place in MVSEC_EVENTS else "hdf5"

    def close(self) -> None:
        self._file.close()


def _candidates(file: Hdf5File, path: Path, reading: EventReading) -> tuple[list[Candidate], list[Candidate]]:
    """Return the tables of events, in the order of the groups' names, ``events`` and the root first: columns and fields
    with names, and arrays of four columns, which may be anything."""
    named, plain = [], []
    for name, group in sorted(file.groups().items(), key=lambda one: (one[0] != "events", one[0] != "", one[0])):
        held = group.data()
        columns = named_columns(held, reading, f"{path}: '{name}'")
        if set("txyp") <= set(columns):
            chosen_ = {slot: held[key] for slot, key in columns.items()}
            named.append((name, lambda g=group, c=chosen_, t=columns["t"]: _of_columns(file, g, c, t, path)))
            continue
        for key, data in held.items():
            place = f"{name}/{key}".lstrip("/")
            fields = named_columns(data.dtype.names or (), reading, f"{path}: '{place}'")
            if len(data.shape or ()) == 1 and set("txyp") <= set(fields):
                named.append((place, lambda d=data, f=fields, g=group: _of_records(file, g, d, f, path)))
            elif (
                data.dtype.kind in "iuf"
                and len(data.shape or ()) == 2
                and data.shape[1] in (4, len(reading.columns or ()))
            ):
                plain.append((place, lambda d=data, g=group: _of_rows(file, g, d, reading, path)))
    return named, plain


def _of_records(file: Hdf5File, group: object, data: Data, fields: dict[str, str], path: Path) -> Table:
    data.check()
    geometry = any(holder.attribute("geometry") is not None for holder in (data, file))
    known = data.name == "CD/events" or geometry
    layout = {"unit": "us", "layout": "Metavision's records of events: µs"} if known else {}
    return table_of_records(data, fields, place=data.name, size=_size(file, group, path), **layout)


def _of_rows(file: Hdf5File, group: object, data: Data, reading: EventReading, path: Path) -> Table:
    data.check()
    place = data.name
    if place in MVSEC_EVENTS:
        return table_of_rows(
            data, str(path), reading.columns or ("x", "y", "t", "p"), place=place, unit="s", size=(260, 346)
        )
    return table_of_rows(data, str(path), reading.columns, place=place, size=_size(file, group, path))


def _of_columns(file: Any, group: Any, columns: dict[str, Any], heading: str, path: Path) -> Table:
    if isinstance(cause := group.get("cause"), Data):
        columns["cause"] = cause
    for data in columns.values():
        if data.dtype.shape or data.dtype.kind not in "iufb":
            raise AssetError(
                f"dataset '{data.name}' holds no column of numbers", where=str(path), value=f"{data.dtype} {data.shape}"
            )
        data.check()
    units = _stated(columns["t"])
    place = columns["t"].name.rpartition("/")[0]
    layout: dict[str, object] = {}
    if any(key in holder for key in _MILLISECONDS for holder in (file, group)) and columns["t"].dtype.kind in "iu":
        layout = {"unit": "us"}
    elif place == "events" and all(
        isinstance(data := group.get(name), Data) and data.dtype.kind in kinds for name, kinds in _EVENT_UTILS.items()
    ):
        layout = {"unit": "s", "layout": "event_utils' group of events: seconds"}
    used, count = {data.name for data in columns.values()}, (columns["t"].shape or ())[:1]
    others = [name for name, one in group.data().items() if (one.shape or ())[:1] == count and one.name not in used]
    return table_of_columns(
        columns,
        str(path),
        heading=heading if units is None else f"t [{units}]",
        offset=next((n for holder in (group, file) if (n := _number(holder, "t_offset", path))), 0),
        notes=[*_notes(file, group, columns["t"]), *not_columns(others)],
        size=_size(file, group, path),
        place=place,
        **(layout if units is None else {}),
    )


def _stated(t: Data) -> str | None:
    """Return the unit that the times state; None: none."""
    units = next((u for key in ("unit", "units") if (u := t.attribute(key)) is not None), None)
    # C, C++ and MATLAB write text of a fixed length.
    units = units.decode("latin-1") if isinstance(units, bytes) else units
    return units if isinstance(units, str) else None


def _value(holder: Any, name: str) -> np.ndarray | None:
    """Return the few numbers or the text under a name, a data set or an attribute; None: there is none."""
    data = holder.get(name)
    if not isinstance(data, Data):
        return None if (value := holder.attribute(name)) is None else np.asarray(value)
    return np.asarray(data[()] if math.prod(data.shape or (0,)) <= _FEW else data.shape[:1])


_FEW = 16
_USED = {*_SIZES, "height", "width", "t_offset", "unit", "units"}


def _notes(file: Hdf5File, group: Group, t: Data) -> list[str]:
    names = {*group.data(), *file.data(), *(name for held in (file, group, t) for name in held.attributes())}
    return not_read(names, _USED)


def _number(holder: object, name: str, path: Path) -> Any:
    """Return the number under a name; None: there is none. Raises AssetError: it is none."""
    value = _value(holder, name)
    if value is not None and (value.size != 1 or value.dtype.kind not in "iuf"):
        raise AssetError(f"'{name}' is no number", where=str(path), value=str(value.shape if value.ndim else value))
    return None if value is None else value.ravel()[0].item()


def _size(file: Hdf5File, group: Any, path: Path) -> tuple[int, int] | None:
    """Return the (height, width) that a file states, in any of the known ways. Raises AssetError: it is none."""
    for holder in (group, file):
        sides = {side: n for side in ("height", "width") if (n := _number(holder, side, path)) is not None}
        if len(sides) == 2:
            return _whole(sides["height"], "height", path), _whole(sides["width"], "width", path)
    places = (holder for holder in (group, group.get("calib"), file) if isinstance(holder, Group))
    for holder, name in itertools.product(places, _SIZES):
        if (value := _value(holder, name)) is None:
            continue
        if value.dtype.kind in "SUO":
            text = value.item() if isinstance(value.item(), str) else value.item().decode("latin-1")
            value = np.array([int(side) for side in re.findall(r"\d{1,9}", text)])
        if value.size != 2 or value.dtype.kind not in "iuf":
            raise AssetError(f"'{name}' is no size", where=str(path), value=str(value), accepted="two numbers of px")
        first, second = (_whole(side, name, path) for side in value.ravel().tolist())
        return (first, second) if name == "sensor_resolution" else (second, first)
    return None


def _whole(number: float, name: str, path: Path) -> int:
    """Return a side in px; MATLAB writes all numbers as floats. Raises AssetError: not whole."""
    if not float(number).is_integer():
        raise AssetError(f"'{name}' is no size", where=str(path), value=number, accepted="whole numbers of px")
    return int(number)


def is_dsec(file: Hdf5File, reading: EventReading) -> bool:
    """Return whether a file has DSEC's or BlinkFlow's columns, which the slicing reader reads, and nothing is declared
    that only tables know."""
    columns: Mapping[str, Any] = {slot: file.get(f"events/{slot}") for slot in "xytp"}
    offset = file.get("t_offset")
    return (
        all(isinstance(data, Data) and data.dtype.kind in "iub" for data in columns.values())
        and columns["p"].dtype.kind in "ub"
        and "ms_to_idx" in file
        and _stated(columns["t"]) in (None, "us")
        and (offset is None or getattr(offset, "shape", None) == ())
        and not (reading.columns or reading.polarity or reading.stream or reading.keep)
        and reading.time_unit in (None, "us")
    )
