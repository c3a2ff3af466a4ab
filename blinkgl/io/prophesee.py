"""Prophesee's HDF5 event files: ``CD/events``, a table of x u2, y u2, p i2, t i8 µs in 16 bytes, ``CD/indexes`` of id
u8 and ts i8 every 2 ms, and the same of ``EXT_TRIGGER``.

Metavision's own writer packs the table with ECF, a codec that comes with its SDK and is in no package index; it can be
neither written nor read here. Written is the same layout packed by Blosc, which whoever has hdf5plugin reads; read is
any filter that hdf5plugin has.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from blinkgl.errors import AssetError
from blinkgl.events.types import Events
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import check_events, check_size, events_of, refuse_causes
from blinkgl.io.hdf5 import blosc_dataset, hdf5_errors, joined, open_hdf5, write_rows

DATASET = "CD/events"
EVENT = np.dtype({"names": ["x", "y", "p", "t"], "formats": ["<u2", "<u2", "<i2", "<i8"], "offsets": [0, 2, 4, 8]})
TRIGGER = np.dtype({"names": ["p", "t", "id"], "formats": ["<i2", "<i8", "<i2"], "offsets": [0, 8, 16], "itemsize": 24})
INDEX = np.dtype([("id", "<u8"), ("ts", "<i8")])
_PERIOD_US = 2000
_CHUNK = 16384
_ECF = 0x8ECF


class PropheseeWriter:
    """Streams events; the same events give the same bytes however they were chunked. Raises EventDataError."""

    def __init__(self, path: str | os.PathLike, height: int, width: int):
        self.path, self.height, self.width = Path(path), height, width
        self._last: int | None = None
        self._count, self._first, self._next_us = 0, 0, 0
        self._rows, self._indexes = np.empty(0, EVENT), [(0, -1)]  # as their tables begin
        with output_errors(path):
            self._file = h5py.File(self.path, "w")
            for key, value in (("version", "1.0"), ("geometry", f"{width}x{height}"), ("format", "BLOSC")):
                self._file.attrs[key] = np.bytes_(value)
            for group, dtype in (("CD", EVENT), ("EXT_TRIGGER", TRIGGER)):
                blosc_dataset(self._file, f"{group}/events", (0,), dtype, (_CHUNK,))
                blosc_dataset(self._file, f"{group}/indexes", (0,), INDEX, (_CHUNK,))

    def append(self, events: Events) -> None:
        refuse_causes(events, "Prophesee's HDF5", str(self.path))
        if not len(events):
            return
        self._last = check_events(
            events, str(self.path), self._count, height=self.height, width=self.width, after=self._last
        )
        if not self._count:  # an index counts from the first event's time
            self._first = self._next_us = int(events.t[0])
            self._file["CD/indexes"].attrs["offset"] = np.bytes_(str(-self._first))
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
            write_rows(self._file["CD/indexes"], 0, np.array(self._indexes, INDEX))
            self._file.close()

    def abort(self) -> None:
        try:
            self._file.close()
        except Exception:  # noqa: BLE001 - a full disk refuses the flush; the file is thrown away
            pass

    def _store(self, rows: np.ndarray) -> None:
        if len(rows):
            with output_errors(self.path):
                write_rows(self._file[DATASET], len(self._file[DATASET]), rows)


class PropheseeReader:
    """Events of ``CD/events``; height and width are None where ``geometry`` is missing.

    Raises AssetError: the table is missing, of another type, or packed with ECF."""

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
        for start in range(0, self.count, size):
            with open_hdf5(self.path) as file, hdf5_errors(self.path):
                rows = self._table(file)[start : start + size]
            yield events_of(rows["x"], rows["y"], rows["t"], rows["p"], str(self.path), start)

    def _table(self, file: h5py.File) -> h5py.Dataset:
        table = file.get(DATASET)
        named = isinstance(table, h5py.Dataset) and table.ndim == 1 and table.dtype.names
        if not named or not {"x", "y", "p", "t"} <= set(table.dtype.names):
            raise AssetError(f"no table '{DATASET}' of x, y, p, t", where=str(self.path))
        filters = table.id.get_create_plist()
        if any(filters.get_filter(k)[0] == _ECF for k in range(filters.get_nfilters())):
            raise AssetError(
                "packed with ECF, a codec of Metavision's SDK that no package has",
                where=str(self.path),
                accepted="the .raw, or this file as its `metavision_file_to_csv` writes it",
            )
        return table
