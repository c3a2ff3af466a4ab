"""Prophesee's HDF5 event files: ``CD/events``, a table of x u2, y u2, p i2, t i8 µs in 16 bytes, packed chunk by chunk
with ECF (:mod:`blinkgl.io.ecf`), ``CD/indexes`` of id u8 and ts i8 every 2 ms, and the same of ``EXT_TRIGGER``.

Metavision reads every table but ``CD/events`` as its chunks lie in the file, and attributes as strings of variable
length: so nothing else is packed here, and they are such strings. No plugin is needed: HDF5 hands over and takes packed
chunks. Read is, beside ECF, any filter that hdf5plugin has.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io import ecf
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import check_events, check_size, events_of, refuse_causes
from blinkgl.io.hdf5 import hdf5_errors, joined, open_hdf5
from blinkgl.types.events import Events

DATASET = "CD/events"
EVENT = np.dtype({"names": ["x", "y", "p", "t"], "formats": ["<u2", "<u2", "<i2", "<i8"], "offsets": [0, 2, 4, 8]})
TRIGGER = np.dtype({"names": ["p", "t", "id"], "formats": ["<i2", "<i8", "<i2"], "offsets": [0, 8, 16], "itemsize": 24})
INDEX = np.dtype([("id", "<u8"), ("ts", "<i8")])
_PERIOD_US = 2000
_CHUNK = 16384
_TEXT = h5py.string_dtype("ascii")


class PropheseeWriter:
    """Streams events; the same events give the same bytes however they were chunked.

    Raises EventDataError: events outside the sensor or out of order, a sensor beyond ECF's 11 bits."""

    def __init__(self, path: str | os.PathLike, height: int, width: int):
        if max(height, width) > ecf.MAX_SIDE:
            raise EventDataError(
                "Prophesee's HDF5 has 11-bit coordinates",
                where=str(path),
                value=(height, width),
                accepted=f"at most {ecf.MAX_SIDE} px a side",
            )
        self.path, self.height, self.width = Path(path), height, width
        self._last: int | None = None
        self._count, self._first, self._next_us = 0, 0, 0
        self._rows, self._indexes = np.empty(0, EVENT), [(0, -1)]  # as their tables begin
        with output_errors(path):
            self._file = h5py.File(self.path, "w")
            for key, value in (("version", "1.0"), ("geometry", f"{width}x{height}"), ("format", "ECF")):
                self._file.attrs.create(key, value, dtype=_TEXT)
            for group, dtype in (("CD", EVENT), ("EXT_TRIGGER", TRIGGER)):
                _new_table(self._file, f"{group}/events", dtype, packed=group == "CD")
                _new_table(self._file, f"{group}/indexes", INDEX)

    def append(self, events: Events) -> None:
        refuse_causes(events, "Prophesee's HDF5", str(self.path))
        if not len(events):
            return
        self._last = check_events(
            events, str(self.path), self._count, height=self.height, width=self.width, after=self._last
        )
        if not self._count:  # an index counts from the first event's time
            self._first = self._next_us = int(events.t[0])
            self._file["CD/indexes"].attrs.create("offset", str(-self._first), dtype=_TEXT)
        marks = np.arange(self._next_us, int(events.t[-1]) + 1, _PERIOD_US)
        at = np.searchsorted(events.t, marks, side="left")
        self._indexes += zip((self._count + at).tolist(), (events.t[at] - self._first).tolist())
        self._next_us += len(marks) * _PERIOD_US
        rows = np.zeros(len(events), EVENT)
        for name in "xypt":
            rows[name] = getattr(events, name)
        self._rows = joined([self._rows, rows])
        self._count += len(events)
        whole = len(self._rows) // _CHUNK * _CHUNK
        self._store(self._rows[:whole])
        self._rows = self._rows[whole:]

    def close(self, t_end_us: int | None = None) -> None:
        self._store(self._rows)
        with output_errors(self.path):
            indexes = self._file["CD/indexes"]
            indexes.resize(len(self._indexes), axis=0)
            indexes[:] = np.array(self._indexes, INDEX)
            self._file.close()

    def abort(self) -> None:
        try:
            self._file.close()
        except Exception:  # noqa: BLE001 - a full disk refuses the flush; the file is thrown away
            pass

    def _store(self, rows: np.ndarray) -> None:
        with output_errors(self.path):
            table = self._file[DATASET]
            for i in range(0, len(rows), _CHUNK):
                piece = rows[i : i + _CHUNK]
                start = len(table)
                table.resize(start + len(piece), axis=0)
                table.id.write_direct_chunk((start,), ecf.encode(piece["x"], piece["y"], piece["t"], piece["p"]))


class PropheseeReader:
    """Events of ``CD/events``; height and width are None where ``geometry`` is missing.

    Raises AssetError: the table is missing, of another type, packed with ECF and something else, or damaged."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        with open_hdf5(self.path) as file, hdf5_errors(self.path):
            table = self._table(file)
            self.count = len(table)
            geometry = file.attrs.get("geometry", b"")
            text = geometry.decode("latin-1") if isinstance(geometry, bytes) else str(geometry)
        found = re.fullmatch(r"(\d{1,9})x(\d{1,9})", text)
        self.height, self.width = (int(found[2]), int(found[1])) if found else (None, None)
        check_size(self.height, self.width, str(path))

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        start = 0
        while start < self.count:
            with open_hdf5(self.path) as file, hdf5_errors(self.path):
                table = self._table(file)
                if _filters(table) == [ecf.FILTER]:
                    x, y, t, p = self._unpacked(table, start, size)
                else:
                    rows = table[start : start + size]
                    x, y, t, p = (rows[name] for name in "xytp")
            yield events_of(x, y, t, p, str(self.path), start)
            start += len(t)

    def _unpacked(self, table: h5py.Dataset, start: int, size: int) -> tuple[np.ndarray, ...]:
        """Columns x, y, t, p of the chunks from ``start``, a chunk's begin, on: as many as hold ``size`` events."""
        step, where = table.chunks[0], str(self.path)
        pieces = []
        for at in range(start, min(start + max(size, step), self.count), step):
            skipped, data = table.id.read_direct_chunk((at,))
            if skipped:  # the filter is an optional one: a program that lacks it stores rows as they are
                rows = np.frombuffer(data, table.dtype, min(step, len(data) // table.dtype.itemsize))
                piece = tuple(rows[name] for name in "xytp")
            else:
                piece = ecf.decode(data, step, where)
            if len(piece[0]) < (rest := min(step, self.count - at)):
                raise AssetError(
                    f"damaged: the chunk of event {at} holds fewer events than its table has",
                    where=where,
                    value=len(piece[0]),
                    accepted=f"{rest}",
                )
            pieces.append([column[:rest] for column in piece])
        return tuple(np.concatenate(column) for column in zip(*pieces))

    def _table(self, file: h5py.File) -> h5py.Dataset:
        table = file.get(DATASET)
        named = isinstance(table, h5py.Dataset) and table.ndim == 1 and table.dtype.names
        if not named or not {"x", "y", "p", "t"} <= set(table.dtype.names):
            raise AssetError(f"no table '{DATASET}' of x, y, p, t", where=str(self.path))
        if ecf.FILTER in (filters := _filters(table)) and len(filters) > 1:
            raise AssetError(
                "packed with ECF and another filter", where=str(self.path), value=filters, accepted="ECF alone"
            )
        return table


def _filters(table: h5py.Dataset) -> list[int]:
    """Numbers of the filters that its chunks go through."""
    layout = table.id.get_create_plist()
    return [layout.get_filter(k)[0] for k in range(layout.get_nfilters())]


def _new_table(file: h5py.File, name: str, dtype: np.dtype, packed: bool = False) -> None:
    """A new table that grows; ``packed`` says that its chunks are ECF's, which h5py's own door refuses to say of a
    filter that is not installed."""
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_chunk((_CHUNK,))
    layout.set_obj_track_times(False)
    if packed:
        layout.set_filter(ecf.FILTER, h5py.h5z.FLAG_OPTIONAL, ())
    parents = h5py.h5p.create(h5py.h5p.LINK_CREATE)
    parents.set_create_intermediate_group(True)
    space = h5py.h5s.create_simple((0,), (h5py.h5s.UNLIMITED,))
    h5py.h5d.create(file.id, name.encode(), h5py.h5t.py_create(dtype, logical=True), space, layout, lcpl=parents)
