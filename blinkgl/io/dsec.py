"""DSEC's event file: streaming writer, slicing reader (Gehrig et al., "DSEC", RA-L 2021; data format page).

Layout: ``events/{x,y}`` u2, ``events/p`` u1, ``events/t`` u4 µs relative to the scalar ``t_offset`` (i8 µs on the
image clock), ``ms_to_idx`` u8 with ``ms_to_idx[ms]`` = smallest index whose t >= 1000·ms. Blosc-zstd with bit
shuffle, as the published files. ``events/cause`` u1 besides, of :class:`~blinkgl.types.events.Cause`, where events have
causes; readers of DSEC's files do not look at it.
"""

from __future__ import annotations

import contextlib
import os
import queue
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import h5py
import numpy as np

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import MAX_SIDE, CheckedWriter, check_events, check_size, events_of
from blinkgl.io.hdf5 import (
    SHUFFLE,
    Blocks,
    Group,
    dataset,
    growing_dataset,
    hdf5_errors,
    open_hdf5,
    packing,
    write_rows,
)
from blinkgl.io.reading import AS_FILE, EventReading
from blinkgl.io.tables import not_columns
from blinkgl.machine.closing import Closing
from blinkgl.types.events import Events

BLOCK = 1 << 17
"""Events per HDF5 chunk and per write."""

_COLUMNS = {"x": np.uint16, "y": np.uint16, "t": np.uint32, "p": np.uint8}
# Entries of ms_to_idx that are written at once.
_MS_PIECE = 1 << 20
_MAX_RELATIVE_US = np.iinfo(np.uint32).max


class DsecEventWriter(CheckedWriter):
    """Writes events of one sensor, chunk by chunk, in memory that does not grow with the sequence.

    Compression runs in a background thread (Blosc releases the GIL) behind a queue of a few blocks; an error
    there is raised by the next :meth:`append` or by :meth:`close`. The same events give the same bytes however they
    were chunked. Use as a context manager: it closes on success and aborts on an exception (the file is then not
    usable; the caller owns the name, see :mod:`blinkgl.io.atomic`).

    Parameters
    ----------
    path : file to create (overwritten).
    height, width : sensor size in px, None: not known; events outside are refused. Also stored as root attributes,
        which DSEC's own readers ignore.
    t_offset_us : image-clock time of relative time 0. Events before it, or 2^32 µs (71.6 minutes) or more after it, are
        refused: the format's u4 cannot hold them.
    codec : "zstd", as the published files, "lz4" or "gzip".
    """

    def __init__(
        self,
        path: str | os.PathLike,
        height: int | None,
        width: int | None,
        t_offset_us: int = 0,
        *,
        codec: str = "zstd",
    ):
        if not all(side is None or 0 < side <= MAX_SIDE for side in (height, width)):
            raise EventDataError(
                "sensor size does not fit uint16 coordinates",
                where=str(path),
                value=(height, width),
                accepted=f"1 to {MAX_SIDE} px a side",
            )
        super().__init__(path, height, width)
        self.t_offset_us, self._codec = int(t_offset_us), codec
        # Entries of ms_to_idx written so far; events written so far.
        self._next_ms = self._written = 0
        self._error: BaseException | None = None
        self._closed = False
        with output_errors(path):
            # Whole chunks only: no cache, a full disk shows at once.
            self._file = h5py.File(self.path, "w", rdcc_nbytes=0)
            self._columns = {
                k: growing_dataset(self._file, f"events/{k}", (0,), dtype, (BLOCK,), codec)
                for k, dtype in _COLUMNS.items()
            }
            self._ms_to_idx = growing_dataset(self._file, "ms_to_idx", (0,), np.uint64, (1 << 13,), codec)
            self._file.create_dataset("t_offset", data=np.int64(self.t_offset_us), track_times=False)
            if height is not None and width is not None:
                self._file.attrs["height"], self._file.attrs["width"] = int(height), int(width)
        # Compression runs beside the simulation; a full queue makes append wait.
        self._queue: queue.Queue = queue.Queue(maxsize=4)
        self._blocks = Blocks(self._columns, BLOCK, self._queue.put)
        self._thread = threading.Thread(target=self._run, name="dsec-writer", daemon=True)
        self._thread.start()

    def append(self, events: Events) -> None:
        """Adds events (copied: the caller may reuse its arrays).

        Raises
        ------
        EventDataError : times not in order or outside the file's range, coordinates outside the sensor, polarity
            not 0 or 1. OutputError : the disk refused an earlier block.
        """
        if self._closed:
            raise ValueError("append after close")
        where, t = str(self.path), events.t
        if len(t) and t[0] < self.t_offset_us:
            raise EventDataError(
                "event before the recording's start", where=where, value=int(t[0]), accepted=f">= {self.t_offset_us} µs"
            )
        if len(t) and t[-1] - self.t_offset_us > _MAX_RELATIVE_US:
            raise EventDataError(
                "event time beyond what DSEC's 32-bit µs can hold",
                where=where,
                value=int(t[-1]),
                accepted=f"at most {self.t_offset_us + _MAX_RELATIVE_US} µs (71.6 minutes per file)",
            )
        super().append(events)
        self._raise_pending()

    def _write(self, events: Events) -> None:
        # All events have causes, or none: the first ones decide.
        if self.count == 0 and events.cause is not None:
            self._columns["cause"] = growing_dataset(self._file, "events/cause", (0,), np.uint8, (BLOCK,), self._codec)
        if (events.cause is not None) != ("cause" in self._columns):
            raise EventDataError("some events have causes and some do not", where=str(self.path))
        rows = {name: getattr(events, name) for name in self._columns}
        self._blocks.add({**rows, "t": events.t - self.t_offset_us}, len(events))

    def close(self, t_end_us: int | None = None) -> None:
        """Finish the file. ``t_end_us`` (image clock, exclusive) is the recording's end where it is later than the last
        event's, so that ``ms_to_idx`` covers windows up to it."""
        if self._closed:
            return
        # The table covers the whole recording, events or not.
        t_end_us = self.t_end_us if t_end_us is None else t_end_us
        end = max(
            self.t_offset_us if self._last is None else self._last + 1,
            self.t_offset_us if t_end_us is None else int(t_end_us),
        )
        try:
            self._blocks.flush()
            self._queue.put(None)
            self._thread.join()
            self._raise_pending()
            with output_errors(self.path):
                # One entry past the last millisecond: a slicer asks for ceil(end).
                last_ms = -(-(end - self.t_offset_us) // 1000)
                # Entries are written in pieces: an eventless day would be 700 MB at once. Pieces end
                # where chunks do.
                while self._next_ms <= last_ms:
                    stop = min((self._next_ms // _MS_PIECE + 1) * _MS_PIECE, last_ms + 1)
                    self._store_ms(np.full(stop - self._next_ms, self._written, np.uint64))
                self._file.close()
            self._closed = True
        except BaseException:
            self.abort()
            raise

    def abort(self) -> None:
        """Stop without finishing; never raises."""
        if self._closed:
            return
        self._closed = True
        if self._thread.is_alive():
            # An error that is already known stays the one that is raised.
            self._error = self._error or RuntimeError("aborted")  # the thread drops what is queued
            self._queue.put(None)
            self._thread.join()
        with contextlib.suppress(Exception):
            self._file.close()

    def _run(self) -> None:
        while (block := self._queue.get()) is not None:
            if self._error is not None:
                # Keep draining, so that a blocked producer wakes up and sees the error.
                continue
            try:
                with output_errors(self.path):
                    self._store(block)
            except BaseException as error:  # noqa: BLE001 - handed to the caller's thread
                self._error = error

    def _raise_pending(self) -> None:
        if self._error is not None:
            error = self._error
            self.abort()
            raise error

    def _store(self, block: dict[str, np.ndarray]) -> None:
        start, stop = self._written, self._written + len(block["t"])
        for name, column in self._columns.items():
            write_rows(column, start, block[name])
        # Entries up to the last event's own millisecond are settled now; later ones wait for their event.
        last_ms = int(block["t"][-1]) // 1000
        bounds = np.arange(self._next_ms, last_ms + 1, dtype=np.int64) * 1000
        self._store_ms(start + np.searchsorted(block["t"], bounds, side="left"))
        self._written = stop

    def _store_ms(self, entries: np.ndarray) -> None:
        if len(entries):
            write_rows(self._ms_to_idx, self._next_ms, entries)
            self._next_ms += len(entries)


class DsecEventReader(Closing):
    """Reads events of a DSEC file by time; times are returned as int64 µs on the image clock (t + t_offset).

    Also reads BlinkFlow's files, which lack ``t_offset`` (taken as 0), store t as u8, and whose ``ms_to_idx`` ends
    before the last millisecond.

    Raises
    ------
    AssetError : not a readable HDF5 file (truncated, wrong type) or without the DSEC datasets.
    """

    def __init__(
        self, path: str | os.PathLike, reading: EventReading = AS_FILE, *, size: tuple[int, int] | None = None
    ):
        """size : (height, width) of the sensor as known from elsewhere, by which events are checked; None: only what
        the file says counts."""
        self.path, self._checked = Path(path), size is not None
        self._file = open_hdf5(self.path)
        with hdf5_errors(self.path, self._file):
            self._columns = {
                k: dataset(self._file, f"events/{k}", self.path, shape=(None,), kinds="iub") for k in "xytp"
            }
            self.causes = "events/cause" in self._file
            if self.causes:
                self._columns["cause"] = dataset(self._file, "events/cause", self.path, shape=(None,), kinds="iu")
            held = self._file.get("events")
            names = held.data() if isinstance(held, Group) else ()
            self.notes = not_columns(name for name in names if name not in self._columns)
            # Columns of a damaged or made-up file may differ.
            lengths = {len(c) for c in self._columns.values()}
            if len(lengths) != 1:
                raise AssetError("event columns differ in length", where=str(path), value=sorted(lengths))
            self.count = lengths.pop()
            self.t_offset_us, self._ms_to_idx = 0, None
            # DSEC counts times from t_offset; a file without it counts from 0.
            if "t_offset" in self._file:
                self.t_offset_us = int(dataset(self._file, "t_offset", self.path, shape=())[()])
            if "ms_to_idx" in self._file:
                self._ms_to_idx = dataset(self._file, "ms_to_idx", self.path, shape=(None,))
            self.height, self.width = (self._declared(name) for name in ("height", "width"))
            if size is not None:
                # What the file itself states must agree with the sequence.
                if (self.height or size[0], self.width or size[1]) != size:
                    raise AssetError(
                        "another size than the sequence's",
                        where=str(path),
                        value=f"{self.width}x{self.height}",
                        accepted=f"{size[1]}x{size[0]}",
                    )
                self.height, self.width = size
            check_size(self.height, self.width, str(path))

    def _declared(self, name: str) -> int | None:
        """Return a root attribute with the sensor's size; None without."""
        value = self._file.attribute(name)
        if value is not None and (np.ndim(value) or np.asarray(value).dtype.kind not in "iu"):
            raise AssetError(f"attribute '{name}' is no integer", where=str(self.path), value=value)
        return None if value is None else int(value)

    def slice(self, t0_us: int, t1_us: int) -> Events:
        """Return events of [t0_us, t1_us), image clock, by DSEC's rule: ``ms_to_idx`` gives the conservative range
        floor(t0)…ceil(t1) in ms, inside which the exact bounds are searched.

        Raises EventDataError as :func:`~blinkgl.io.columns.check_events`; AssetError: damaged, or a table that leaves
        events out."""
        # Times on the file's own clock; the table is asked for whole milliseconds around them.
        r0, r1 = int(t0_us) - self.t_offset_us, int(t1_us) - self.t_offset_us
        start, stop = self._index(r0 // 1000, 0), self._index(-(-r1 // 1000), self.count)
        if not 0 <= start <= stop <= self.count:
            self._wrong_table(t0_us, t1_us, (start, stop))
        # One more on either side shows whether the table was right.
        low, high = max(start - 1, 0), min(stop + 1, self.count)
        events = self._read(low, high)
        check_events(events, str(self.path), low, height=self.height, width=self.width)
        if (low < start and events.t[0] >= t0_us) or (high > stop and events.t[-1] < t1_us):
            self._wrong_table(t0_us, t1_us, (start, stop))
        return events.window(t0_us, t1_us)

    def number(self, t_us: int) -> int:
        """Return how many events are before t_us, image clock: the number of the first that is not. Raises as
        :meth:`slice`."""
        # The event lies within one millisecond, between two entries of the table.
        ms = (int(t_us) - self.t_offset_us) // 1000
        start, stop = self._index(ms, 0), self._index(ms + 1, self.count)
        if not 0 <= start <= stop <= self.count:
            self._wrong_table(t_us, t_us, (start, stop))
        return start + int(np.searchsorted(self._read(start, stop).t, t_us, side="left"))

    def _wrong_table(self, t0_us: int, t1_us: int, found: tuple[int, int]) -> NoReturn:
        raise AssetError(
            f"'ms_to_idx' does not lead to the events of [{t0_us}, {t1_us}) µs",
            where=str(self.path),
            value=found,
            accepted=f"the smallest index whose t >= 1000·ms, at most {self.count}",
        )

    def _index(self, ms: int, otherwise: int) -> int:
        table = self._ms_to_idx
        if table is None:
            return otherwise
        if ms < 0:
            return 0
        if ms < len(table):
            return int(table[ms])
        # Past the table: the end for an upper bound; for a lower one the last entry is still a safe start.
        return self.count if otherwise else (int(table[-1]) if len(table) else 0)

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        """Yield all events in pieces of ``size``. Raises EventDataError as :meth:`slice` does, if the sensor's size was
        given when the file was opened; without a size the caller has to check the events."""
        last = None
        for start in range(0, self.count, size):
            events = self._read(start, min(self.count, start + size))
            if self._checked:
                last = check_events(events, str(self.path), start, height=self.height, width=self.width, after=last)
            yield events

    def _read(self, start: int, stop: int) -> Events:
        columns = {k: column[start:stop] for k, column in self._columns.items()}
        x, y, t, p = (columns[name] for name in "xytp")
        cause, where = columns.get("cause"), str(self.path)
        return events_of(x, y, t, p, where=where, first=start, cause=cause, offset=self.t_offset_us)

    def close(self) -> None:
        self._file.close()


def write_rectify_map(path: str | os.PathLike, rectify_map: np.ndarray, codec: str = "zstd") -> None:
    """Write ``rectify_map``: (H, W, 2) float32, ``map[y, x] = (x_rect, y_rect)``. A pinhole camera's is the identity;
    loaders such as E-RAFT's require the file. codec : "gzip", which h5py alone reads, or another, which is Blosc's
    zstd."""
    # Without a cache: HDF5 that meets a full disk as it closes ends the process.
    with output_errors(path), h5py.File(path, "w", rdcc_nbytes=0) as file:
        packed = packing("gzip" if codec == "gzip" else "zstd", SHUFFLE)
        file.create_dataset("rectify_map", data=np.asarray(rectify_map, np.float32), track_times=False, **packed)


def identity_rectify_map(height: int, width: int) -> np.ndarray:
    """Return the identity, (H, W, 2) float32, for :func:`write_rectify_map`."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return np.stack([x, y], axis=-1)
