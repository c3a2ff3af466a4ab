"""AEDAT4 recordings of iniVation's cameras, read by the package aedat and written by dv-processing.

dv-processing 2.0 reads the same events but refuses a file that was cut, and one without a table of its packets; aedat
reads what is there."""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError, EventDataError, OutputError
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import CameraFrame, CheckedWriter, G, ImuSamples, events_of, joined
from blinkgl.io.reading import AS_FILE, EventReading
from blinkgl.machine.extras import install
from blinkgl.types.events import Events

_ABSENT = {"events": "no events", "frame": "no frames", "imus": "no samples of an inertial unit"}


class Aedat4Reader:
    """The streams of a recording; times are the file's own int64 µs (usually since 1970).

    height, width : px of the events' sensor.   notes : a line where there are several streams of events. Raises
    AssetError: not AEDAT4, damaged, the requested stream is missing."""

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        self.path = Path(path)
        with _damage(self.path):
            self._streams: dict[int, dict[str, Any]] = _decoder(self.path).id_to_stream()
        found = sorted(number for number, stream in self._streams.items() if stream["type"] == "events")
        self._number = self._first("events") if reading.stream is None else reading.stream
        shown = ", ".join(f"{n} ({self._streams[n]['width']}x{self._streams[n]['height']})" for n in found)
        if self._number not in found:
            raise AssetError(
                "no such stream of events", where=str(path), value=self._number, accepted=f"--stream {shown}"
            )
        self.notes = []
        if len(found) > 1:
            self.notes.append(f"{len(found)} streams of events: {shown}; {self._number} is read (--stream for another)")
        events = self._streams[self._number]
        self.height, self.width = events["height"], events["width"]

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        """Yield all events, packet by packet, joined to about ``size``."""
        yield from joined(self._events(), size)

    def _events(self) -> Iterator[Events]:
        first = 0
        for a in self._packets("events"):
            yield events_of(a["x"], a["y"], a["t"], a["on"], str(self.path), first)
            first += len(a)

    def frames(self) -> Iterator[CameraFrame]:
        """Yield frames in their order, uint8, RGB where they have colours; one in memory at a time."""
        last = None
        for number, frame in enumerate(self._packets("frame")):
            begin, end = int(frame["exposure_begin_t"]), int(frame["exposure_end_t"])
            if not (last is None or begin > last) or end < begin:
                raise EventDataError(
                    f"times of frame {number} do not increase", where=str(self.path), value=(last, begin, end)
                )
            last = begin
            image = frame["pixels"]
            yield CameraFrame(image[..., :3] if image.ndim == 3 else image, begin, end)

    def imu(self) -> ImuSamples:
        """Return all samples of the inertial unit."""
        packets = list(self._packets("imus"))
        if not packets:
            raise AssetError(f"{_ABSENT['imus']} in the recording", where=str(self.path))
        rows = np.concatenate(packets)
        t = rows["t"].astype(np.int64)
        if (back := np.diff(t) < 0).any():
            i = int(np.argmax(back))
            raise EventDataError(
                f"times decrease at sample {i + 1} of the inertial unit",
                where=str(self.path),
                value=(int(t[i]), int(t[i + 1])),
            )
        # The file's units are g and degrees per second.
        pull, rate = (
            np.stack([rows[f"{name}_{axis}"] for axis in "xyz"], axis=1).astype(np.float64)
            for name in ("accelerometer", "gyroscope")
        )
        return ImuSamples(t, pull * G, np.radians(rate), rows["temperature"].astype(np.float64))

    def _first(self, kind: str) -> int:
        """Return the number of the first stream of a kind."""
        found = [number for number, stream in self._streams.items() if stream["type"] == kind]
        if not found:
            raise AssetError(f"{_ABSENT[kind]} in the recording", where=str(self.path))
        return min(found)

    def _packets(self, kind: str) -> Iterator[Any]:
        number = self._number if kind == "events" else self._first(kind)
        with _damage(self.path):
            packets, sound = iter(_decoder(self.path)), _check_claims(self.path)
            while True:
                # Check what this packet claims before the decoder sets memory aside for it.
                next(sound, None)
                packet = next(packets, None)
                if packet is None:
                    return
                if packet["stream_id"] == number:
                    yield packet[kind]


_HEADER = 18
"""Bytes of the magic and of the header's length, which follows it."""


def _check_claims(path: Path) -> Iterator[None]:
    """Yield before each packet of a file, once it is known to lie in the file. The decoder sets aside as much memory as
    a packet claims. (iniVation, "AEDAT 4.0": packets of a stream's number, a length and so many bytes; the header is a
    FlatBuffer, whose second field says where the table behind the packets lies.)

    Raises AssetError: the header or a packet is longer than the rest of the file."""
    total = path.stat().st_size
    with open(path, "rb") as file:
        begin = file.read(_HEADER)
        length = int.from_bytes(begin[-4:], "little") if len(begin) == _HEADER else 0
        if length > total - _HEADER:
            raise AssetError(f"a header of {length} bytes", where=str(path), accepted=f"at most {total - _HEADER}")
        header, end = file.read(length), total
        with contextlib.suppress(struct.error):
            # A FlatBuffer begins with the offset of its root table, and the table with the signed distance back
            # to its vtable.
            table = struct.unpack_from("<I", header)[0]
            # In the vtable two sizes and the offset of field 0, two bytes each, come before that of field 1; 0:
            # no such field.
            place = struct.unpack_from("<H", header, table - struct.unpack_from("<i", header, table)[0] + 6)[0]
            end = struct.unpack_from("<q", header, table + place)[0] if place else end
        while len(packet := file.read(8)) == 8 and file.tell() - 8 != end:
            # The first four bytes are the stream's number, the others the packet's length.
            size = int.from_bytes(packet[4:], "little")
            if size > total - file.tell():
                at = file.tell() - 8
                raise AssetError(
                    f"a packet at byte {at} of {size} bytes", where=str(path), accepted=f"at most {total - at}"
                )
            yield
            file.seek(size, os.SEEK_CUR)


def _decoder(path: Path) -> Any:
    next(_check_claims(path), None)
    # Imported here: few programs read such files.
    import aedat

    return aedat.Decoder(os.fspath(path))


@contextlib.contextmanager
def _damage(path: Path) -> Iterator[None]:
    """Convert what the decoder raises on damaged bytes, including a panic of its Rust code, to AssetError."""
    try:
        yield
    except (AssetError, ImportError):
        raise
    except OSError as error:
        raise AssetError(f"cannot read: {error.strerror}", where=str(path)) from error
    except BaseException as error:
        # A panic of Rust code derives from BaseException; anything else of that kind, such as an interrupt, passes.
        if not isinstance(error, Exception) and type(error).__module__ != "pyo3_runtime":
            raise
        text = " ".join(str(error).split())[:160]
        raise AssetError(f"damaged AEDAT4 file: {text}", where=str(path)) from error


class Aedat4Writer(CheckedWriter):
    """Writes one stream of events by dv-processing. Raises OutputError: it is not installed."""

    kind = "AEDAT4"

    def __init__(self, path: str | os.PathLike, height: int, width: int):
        super().__init__(path, height, width)
        try:
            import dv_processing as dv
        except ImportError:
            raise OutputError(
                "AEDAT4 is written by the package dv-processing", accepted=f"run {install('dv-processing')}"
            ) from None
        settings = dv.io.MonoCameraWriter.EventOnlyConfig("BlinkGL", (width, height))
        self._store = dv.EventStore
        with output_errors(path):
            self._file = dv.io.MonoCameraWriter(os.fspath(path), settings)

    def _write(self, events: Events) -> None:
        store = self._store()
        for x, y, t, p in zip(*(getattr(events, k).tolist() for k in "xytp"), strict=True):
            store.push_back(t, x, y, bool(p))
        self._file.writeEvents(store)

    def close(self, t_end_us: int | None = None) -> None:
        """Finish the file, which the library does when its writer goes."""
        with output_errors(self.path):
            self._file = None
