"""AEDAT4 (iniVation) through dv-processing, an optional package of its own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError, BlinkGLError, EventDataError, OutputError
from blinkgl.events.types import Events
from blinkgl.extras import install
from blinkgl.io.atomic import output_errors

MAGIC = b"#!AER-DAT4"


def _dv(error: type[BlinkGLError], path):
    try:
        import dv_processing
    except ImportError as problem:
        raise error("AEDAT4 needs dv-processing, which is not installed", where=str(path),
                    accepted=f"run {install('dv-processing')}") from problem
    return dv_processing


class Aedat4Reader:
    """The event stream of a recording; times are the file's own int64 µs (usually since 1970)."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        try:
            with open(path, "rb") as file:
                magic = file.read(len(MAGIC))
        except OSError as error:
            raise AssetError(f"cannot read: {error.strerror}", where=str(path)) from error
        if magic != MAGIC:
            raise AssetError("not an AEDAT4 file: wrong magic", where=str(path))
        recording = self._open()
        if not recording.isEventStreamAvailable():
            raise AssetError("recording without an event stream", where=str(path))
        self.width, self.height = (int(v) for v in recording.getEventResolution())

    def _open(self):
        try:
            return _dv(AssetError, self.path).io.MonoCameraRecording(os.fspath(self.path))
        except RuntimeError as error:
            raise self._broken(error) from error

    def _broken(self, error: Exception) -> AssetError:
        return AssetError(f"damaged AEDAT4 file: {' '.join(str(error).split())[:160]}", where=str(self.path))

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        """All events, packet by packet, joined to about ``size``."""
        recording = self._open()
        pending, count = [], 0
        while True:
            try:
                batch = recording.getNextEventBatch()
            except RuntimeError as error:
                raise self._broken(error) from error
            if batch is not None and batch.size():
                a = batch.numpy()
                pending.append(Events(a["x"].astype(np.uint16), a["y"].astype(np.uint16), a["timestamp"].astype(np.int64),
                                      a["polarity"].astype(np.uint8)))
                count += len(a)
            if pending and (batch is None or count >= size):
                yield Events.concatenate(pending)
                pending, count = [], 0
            if batch is None:
                return


class Aedat4Writer:
    """Events only, LZ4 packets. dv-processing takes events one by one from Python: about 1 M events/s."""

    def __init__(self, path: str | os.PathLike, height: int, width: int):
        if height > 32767 or width > 32767:
            raise EventDataError("AEDAT4 has 15-bit coordinates", where=str(path), value=(height, width))
        dv = _dv(OutputError, path)
        self.path, self._store = Path(path), dv.EventStore
        with output_errors(path):
            open(path, "wb").close()  # dv's own message for an unwritable path does not say why
            try:
                self._writer = dv.io.MonoCameraWriter(os.fspath(path), dv.io.MonoCameraWriter.EventOnlyConfig("BlinkGL", (width, height)))
            except RuntimeError as error:
                raise OutputError(f"cannot write: {' '.join(str(error).split())}", where=str(path)) from error

    def append(self, events: Events) -> None:
        if not len(events):
            return
        store = self._store()
        push = store.push_back
        for t, x, y, p in zip(events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.astype(bool).tolist()):
            push(t, x, y, p)
        try:
            self._writer.writeEvents(store)
        except RuntimeError as error:
            raise OutputError(f"cannot write: {' '.join(str(error).split())}", where=str(self.path)) from error

    def close(self, t_end_us: int | None = None) -> None:
        self._writer = None  # its destructor writes the last packets and the index

    def abort(self) -> None:
        self._writer = None
