"""Prophesee's HDF5 event files: ``CD/events``, a table of x u2, y u2, p i2, t i8 µs in 16 bytes, packed chunk by chunk
with ECF (:mod:`blinkgl.io.ecf`). Read only.

No plugin is needed: HDF5 hands over packed chunks. Read is, beside ECF, any filter that hdf5plugin has.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io import ecf
from blinkgl.io.columns import check_size, events_of
from blinkgl.io.hdf5 import attribute, hdf5_errors, open_hdf5
from blinkgl.types.events import Events

DATASET = "CD/events"


class PropheseeReader:
    """Events of ``CD/events``; height and width are None where ``geometry`` is missing.

    Raises AssetError: the table is missing, of another type, packed with ECF and something else, or damaged."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        with open_hdf5(self.path) as file, hdf5_errors(self.path):
            table = self._table(file)
            self.count = len(table)
            geometry = attribute(file, "geometry", self.path)
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
        whole = named and all(name in named and table.dtype[name].kind in "iu" for name in "xypt")
        if not whole:
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
