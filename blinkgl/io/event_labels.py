"""The truth of each event of a sequence: ``event_labels.h5`` beside ``events.h5``, a row per event, in the same order.

instance  (N,)   u2   instance id of the surface, 0: nothing
depth     (N,)   f4   along the optical axis, world units; inf: nothing
velocity  (N, 2) f4   px/s, +x right, +y down
cause     (N,)   u1   blinkgl.types.events.Cause, where the emulator records it
light     (N,)   i4   number of the light among the names of lights.npz that made it, -1: none; where a light changes
"""

from __future__ import annotations

import contextlib
import os
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import whole
from blinkgl.io.hdf5 import Blocks, Data, dataset, growing_dataset, hdf5_errors, open_hdf5, write_rows
from blinkgl.machine.closing import Closing, Finishing
from blinkgl.types.events import TOLD, TRUTH, Cause, Events

EVENT_LABELS = "event_labels.h5"
BLOCK = 1 << 17
"""Rows per HDF5 chunk and per write, as in ``events.h5``."""
_COLUMNS = {name: TRUTH[name].subdtype or (TRUTH[name], ()) for name in (*TOLD, "light")}
_COLUMNS["cause"] = np.dtype(np.uint8), ()
"""Column -> type and shape of a row."""


class EventLabelsWriter(Finishing):
    """Writes the truth of the events in ``events.h5``. The same events give the same bytes for any chunks. Raises
    OutputError: the disk refuses; the file is then unusable.

    lights : whether a light of the scene changes over time, so that events say which."""

    def __init__(self, path: str | os.PathLike, *, codec: str = "zstd", lights: bool = False):
        self.path, self._codec = Path(path), codec
        self._rows, self._names = 0, (*TOLD, "light") if lights else TOLD
        with output_errors(self.path):
            self._file = h5py.File(self.path, "w", rdcc_nbytes=0)
            self._columns = {name: self._column(name) for name in self._names}
        self._blocks = Blocks(self._columns, BLOCK, self._store)

    def append(self, events: Events) -> None:
        """Append events. Raises TypeError where they have no truth."""
        if not len(events):
            return
        if events.truth is None:
            raise TypeError("event labels: events that do not say what made them")
        rows = {name: events.truth[name] for name in self._names}
        with output_errors(self.path):
            if not self._rows and events.cause is not None:
                self._columns["cause"] = self._column("cause")
            self._rows += len(events)
            self._blocks.add(rows if events.cause is None else {**rows, "cause": events.cause}, len(events))

    def _column(self, name: str) -> h5py.Dataset:
        kind, shape = _COLUMNS[name]
        return growing_dataset(self._file, name, (0, *shape), kind, (BLOCK, *shape), self._codec)

    def close(self) -> None:
        with output_errors(self.path):
            self._blocks.flush()
            self._file.close()

    def abort(self) -> None:
        """Stop without finishing; never raises."""
        with contextlib.suppress(Exception):  # a full disk refuses the flush; the file is deleted anyway
            self._file.close()

    def _store(self, block: dict[str, np.ndarray]) -> None:
        for name, column in self._columns.items():
            write_rows(column, len(column), block[name])


class EventLabelsReader(Closing):
    """The truth of a sequence's events, by their number in ``events.h5``: ``reader.read(i, j)``. Use as a context
    manager.

    path : the file, or the folder of its sequence.   count : rows.   causes, lights : whether it has them.
    Raises AssetError: missing, damaged, or no such file."""

    def __init__(self, path: str | os.PathLike):
        path = Path(path)
        self.path = path / EVENT_LABELS if path.is_dir() else path
        self._file = open_hdf5(self.path)
        with hdf5_errors(self.path, self._file):
            self._columns = {name: self._column(name) for name in _COLUMNS if name in TOLD or name in self._file}
            self.causes, self.lights = "cause" in self._columns, "light" in self._columns
            lengths = {len(column) for column in self._columns.values()}
            if len(lengths) != 1:
                raise AssetError("columns of events differ in length", where=str(self.path), value=sorted(lengths))
            self.count = lengths.pop()

    def close(self) -> None:
        self._file.close()

    def _column(self, name: str) -> Data:
        kind, shape = _COLUMNS[name]
        return dataset(self._file, name, self.path, shape=(None, *shape), kinds="f" if kind.kind == "f" else "iu")

    def read(self, start: int = 0, stop: int | None = None) -> tuple[np.ndarray, np.ndarray | None]:
        """Return, for events ``start`` to ``stop`` (None: the last), (N,) of :data:`~blinkgl.types.events.TRUTH`, and
        their causes (N,) uint8, None where the file has none. Raises AssetError: damaged; EventDataError, naming the
        event: a value that these types cannot hold."""
        rows = slice(*slice(start, stop).indices(self.count)[:2])
        read = {name: column[rows] for name, column in self._columns.items()}
        truth = np.empty(max(rows.stop - rows.start, 0), TRUTH)
        where = str(self.path)
        truth["instance"] = whole(read["instance"], "instance", np.uint16, 0, 65535, where, rows.start)
        most = np.iinfo(np.int32).max
        truth["light"] = whole(read["light"], "light", np.int32, -1, most, where, rows.start) if self.lights else -1
        for name in ("depth", "velocity"):
            with np.errstate(over="ignore"):
                truth[name] = read[name]
            # A depth may be infinite (nothing); what only float32 makes infinite may not.
            lost = np.isnan(truth[name]) | (np.isinf(truth[name]) & (np.isfinite(read[name]) | (name == "velocity")))
            if lost.any():
                i = int(np.argwhere(lost)[0][0])
                raise EventDataError(
                    f"{name} of event {rows.start + i}", where=where, value=read[name][i].tolist(), accepted="float32"
                )
        cause = whole(read["cause"], "cause", np.uint8, 0, max(Cause), where, rows.start) if self.causes else None
        return truth, cause


def with_truth(events: Events, first: int, path: str | os.PathLike) -> Events:
    """Return events of ``events.h5`` from number ``first`` on with their truth, from the ``event_labels.h5`` at
    ``path`` (the file, or the folder of its sequence). Raises AssetError: missing, damaged, or of another number of
    events."""
    with EventLabelsReader(path) as reader:
        truth, cause = reader.read(first, first + len(events))
        if len(truth) < len(events):
            raise AssetError(
                "rows of fewer events than there are",
                where=str(reader.path),
                value=reader.count,
                accepted=f"at least {first + len(events)}",
            )
    return replace(events, truth=truth, cause=events.cause if cause is None else cause)
