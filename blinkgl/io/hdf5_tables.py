"""Events in HDF5 files of any layout, and in MATLAB's .mat of version 7.3, which is HDF5.

Found by names, in every group: ``events/{x,y,t,p}``, ``events/{xs,ys,ts,ps}``, ``x y t p`` at the root, an array (N, 4)
such as MVSEC's ``davis/left/events``, or an array of records. ``t_offset`` and ``height``, ``width`` beside them count.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.hdf5 import attribute, check_storage, hdf5_errors, open_hdf5
from blinkgl.io.mvsec import EVENTS
from blinkgl.io.reading import AS_FILE, EventReading
from blinkgl.io.tables import Table, TableReader, named_columns, table_of_columns, table_of_records, table_of_rows
from blinkgl.types.events import Events


class Hdf5TableReader(TableReader):
    """Events of the first table of a file, or of another by ``stream``; its file stays open."""

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        self.path = Path(path)
        self._file = open_hdf5(self.path)
        with hdf5_errors(self.path, self._file):
            tables = [table for named in (True, False) for table in _tables(self._file, self.path, reading, named)]
            if not tables:
                raise AssetError(
                    "no columns of events",
                    where=str(path),
                    value=list(self._file)[:12],
                    accepted="x, y, t, p in one group, an (N, 4) array, or --columns x=NAME,y=NAME,t=NAME,p=NAME",
                )
            super().__init__(self.path, reading, tables)
        self.version = "mvsec" if tables[reading.stream or 0].place in EVENTS else "hdf5"

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        """Yield all events in pieces of ``size``."""
        with hdf5_errors(self.path):
            yield from super().chunks(size)

    def close(self) -> None:
        self._file.close()


def _tables(file: h5py.File, path: Path, reading: EventReading, named: bool) -> Iterator[Table]:
    """Yield the tables of events, in the order of the groups' names, ``events`` and the root first: columns and fields
    with names, or (not ``named``) arrays of four columns, which may be anything."""
    groups = [""]
    file.visititems(lambda name, found: groups.append(name) if isinstance(found, h5py.Group) else None)
    for name in sorted(groups, key=lambda name: (name != "events", name != "", name)):
        group = file[name] if name else file
        held = {key: group[key] for key in group if isinstance(group[key], h5py.Dataset)}
        columns = named_columns(held, reading)
        if set("txyp") <= set(columns):
            if named:
                yield _of_columns(file, group, {slot: held[key] for slot, key in columns.items()}, columns["t"], path)
            continue
        for key, data in held.items():
            place, size = f"{name}/{key}".lstrip("/"), _size(file, group, path)
            fields = named_columns(data.dtype.names or (), reading)
            if named and len(data.shape or ()) == 1 and set("txyp") <= set(fields):
                check_storage(data, place, path)
                yield table_of_records(data, fields, place=place, size=size)
            rows = data.dtype.kind in "iuf" and len(data.shape or ()) == 2
            if not named and rows and data.shape[1] in (4, len(reading.columns or ())):
                check_storage(data, place, path)
                if place in EVENTS:
                    # MVSEC's columns, in seconds, of its sensor of 346x260 px.
                    asked = reading if reading.columns else EventReading(columns=("x", "y", "t", "p"))
                    yield table_of_rows(data, str(path), asked, place=place, unit="s", size=(260, 346))
                else:
                    yield table_of_rows(data, str(path), reading, place=place, size=size)


def _of_columns(file: Any, group: Any, columns: dict[str, Any], heading: str, path: Path) -> Table:
    if isinstance(group.get("cause"), h5py.Dataset):
        columns["cause"] = group["cause"]
    for data in columns.values():
        if data.dtype.shape or data.dtype.kind not in "iufb":
            raise AssetError(
                f"dataset '{data.name}' holds no column of numbers", where=str(path), value=f"{data.dtype} {data.shape}"
            )
        check_storage(data, data.name, path)
    units = next((attribute(columns["t"], key, path) for key in ("unit", "units") if key in columns["t"].attrs), None)
    return table_of_columns(
        columns,
        str(path),
        heading=f"t [{units}]" if isinstance(units, str) else heading,
        # A table of milliseconds, as DSEC and BlinkFlow have, counts µs.
        unit="us" if ("ms_to_idx" in file or "ms_to_idx" in group) and columns["t"].dtype.kind in "iu" else None,
        offset=_number(file, "t_offset", path) or 0,
        size=_size(file, group, path),
        place=columns["t"].parent.name.strip("/"),
    )


def _number(holder: Any, name: str, path: Path) -> Any:
    """Return the number under a name, a data set of one value or an attribute; None: there is none. Raises AssetError:
    it is none."""
    data = holder.get(name)
    if data is None:
        data = attribute(holder, name, path)
        value = np.asarray(0 if data is None else data)
    elif isinstance(data, h5py.Dataset) and data.size == 1:
        check_storage(data, name, path)
        value = np.asarray(data[()])
    else:
        value = np.asarray(None)
    if value.size != 1 or value.dtype.kind not in "iuf":
        raise AssetError(f"'{name}' is no number", where=str(path), value=str(getattr(data, "shape", data)))
    return None if data is None else value.ravel()[0].item()


def _size(file: h5py.File, group: Any, path: Path) -> tuple[int, int] | None:
    for holder in (group, file):
        height, width = (_number(holder, side, path) for side in ("height", "width"))
        if isinstance(height, int) and isinstance(width, int):
            return height, width
    return None


def is_dsec(file: h5py.File, reading: EventReading) -> bool:
    """Return whether a file has DSEC's or BlinkFlow's columns, which the slicing reader reads, and nothing is declared
    that only tables know."""
    columns: Mapping[str, Any] = {slot: file.get(f"events/{slot}") for slot in "xytp"}
    offset = file.get("t_offset")
    return (
        all(isinstance(data, h5py.Dataset) and data.dtype.kind in "iub" for data in columns.values())
        and columns["p"].dtype.kind in "ub"
        and "ms_to_idx" in file
        and (offset is None or getattr(offset, "shape", None) == ())
        and not (reading.columns or reading.polarity or reading.stream or reading.keep)
        and reading.time_unit in (None, "us")
    )
