"""AEDAT4 recordings of iniVation's cameras, read by the package aedat; events are written here, packet by packet.

dv-processing 2.0 reads the same events but refuses a file that was cut, and one without a table of its packets; aedat
reads what is there. (iniVation, "AEDAT 4.0": after the magic a header, packets, and a table of the packets, each a
FlatBuffer behind its length. A packet's own header is a stream's number and a length, four bytes each.)
"""

from __future__ import annotations

import contextlib
import os
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import CameraFrame, CheckedWriter, G, ImuSamples, events_of, joined
from blinkgl.io.reading import AS_FILE, Damage, EventReading, chosen
from blinkgl.types.events import Events

_ABSENT = {"events": "no events", "frame": "no frames", "imus": "no samples of an inertial unit"}
_CALLED = {"events": "events", "frame": "frames", "imus": "an inertial unit"}


_STREAM = re.compile(
    r'<node name="(\d{1,9})" path="/outInfo/\d+/">(.*?)(?=<node name="\d+" path="/outInfo/\d+/">|</dv>|$)', re.S
)
_ATTRIBUTE = re.compile(r'<attr key="(\w+)" type="string">([^<]*)</attr>')


class Aedat4Reader:
    """The streams of a recording; times are the file's own int64 µs (usually since 1970).

    height, width : px of the events' sensor; None: there are no events.   notes : a line where streams are left out.
    triggers : (N, 3) int64 of those read so far, µs, channel (0) and kind as iniVation numbers them. Frames and samples
    are those of the events' camera. Raises AssetError: not AEDAT4, several streams of events and none is declared, the
    requested stream is missing; Damage."""

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        self.path, self.notes = Path(path), []
        self.triggers = np.empty((0, 3), np.int64)
        with _damage(self.path):
            self._streams: dict[int, dict[str, Any]] = _decoder(self.path).id_to_stream()
        self._about = _descriptions(self.path)
        events, frames = self._of("events"), self._of("frame")
        # The number of a stream of frames means the events of the same camera.
        self._frame = next((number for number in frames if str(number) == reading.stream), None)
        if self._frame is not None:
            events = [n for n in events if self._source(n) == self._source(self._frame)] or events
        asked = None if self._frame is not None else reading.stream
        self._number = self._chosen(asked, events, "streams of events") if events or asked else None
        sized = self._streams[self._number] if self._number is not None else {"height": None, "width": None}
        self.height, self.width = sized["height"], sized["width"]

    def _of(self, kind: str) -> list[int]:
        return sorted(number for number, stream in self._streams.items() if stream["type"] == kind)

    def _source(self, number: int) -> str | None:
        return self._about.get(number, {}).get("source")

    def _chosen(self, stream: str | None, numbers: list[int], what: str) -> int:
        about = [self._about.get(n, {}) for n in numbers]
        labels = [
            ", ".join(
                filter(
                    None,
                    (
                        a.get("source"),
                        a.get("originalModuleName"),
                        f"{s['width']}x{s['height']}" if "width" in s else "",
                    ),
                )
            )
            for a, s in zip(about, (self._streams[n] for n in numbers))
        ]
        return numbers[chosen(stream, [str(n) for n in numbers], str(self.path), what, numbered=False, labels=labels)]

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
            lost = ["left out: the alpha of the frames"] if image.ndim == 3 and image.shape[2] == 4 else []
            if frame.get("offset_x") or frame.get("offset_y"):
                lost.append("left out: the place on the sensor of frames of a part of it")
            self.notes += [note for note in lost if note not in self.notes]
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

    def _stream(self, kind: str) -> int:
        """Return the number of the stream of a kind that belongs to the events that are read. Raises AssetError: there
        is none; several, which it lists."""
        if kind == "events" and self._number is not None:
            return self._number
        if kind == "frame" and self._frame is not None:
            return self._frame
        numbers = self._of(kind)
        if not numbers:
            raise AssetError(f"{_ABSENT[kind]} in the recording", where=str(self.path))
        if self._number is not None and self._source(self._number) is not None:
            own = [n for n in numbers if self._source(n) == self._source(self._number)]
            numbers = own or numbers
        return self._chosen(None, numbers, f"streams of {_CALLED[kind]}")

    def _packets(self, kind: str) -> Iterator[Any]:
        number, triggers = self._stream(kind), []
        try:
            with _damage(self.path):
                packets, sound = iter(_decoder(self.path)), _check_claims(self.path)
                while True:
                    # Check what this packet claims before the decoder sets memory aside for it.
                    next(sound, None)
                    packet = next(packets, None)
                    if packet is None:
                        break
                    if packet["stream_id"] == number:
                        yield packet[kind]
                    elif kind == "events" and "triggers" in packet and self._together(packet["stream_id"], number):
                        rows = packet["triggers"]
                        t = rows["t"].astype(np.int64)
                        triggers.append(np.stack([t, np.zeros_like(t), rows["source"].astype(np.int64)], axis=1))
        finally:
            if triggers:  # also those before damage
                self.triggers = np.concatenate(triggers)
                self.notes = [line for line in self.notes if " triggers are no events: " not in line] + [
                    f"{len(self.triggers):,} triggers are no events: blinkgl convert --triggers FILE.csv writes them"
                ]

    def _together(self, a: int, b: int | None) -> bool:
        """Return whether two streams may be of one camera."""
        sources = {self._source(a), None if b is None else self._source(b)}
        return len(sources - {None}) < 2


def _descriptions(path: Path) -> dict[int, dict[str, str]]:
    """Return the texts that the header says of each stream: source, module …"""
    with open(path, "rb") as file:
        begin = file.read(_HEADER)
        header = file.read(min(int.from_bytes(begin[-4:], "little"), _LONGEST_INFO)).decode("utf-8", "replace")
    return {int(number): dict(_ATTRIBUTE.findall(body)) for number, body in _STREAM.findall(header)}


_LONGEST_INFO = 1 << 20
_MAGIC = b"#!AER-DAT4.0\r\n"
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
        if len(begin) < _HEADER or not begin.startswith(_MAGIC):
            raise AssetError("not an AEDAT4 file", where=str(path), value=begin[:14], accepted="#!AER-DAT4.0")
        if length > total - _HEADER:
            raise Damage(f"a header of {length} bytes", where=str(path), accepted=f"at most {total - _HEADER}")
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
                raise Damage(
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
        raise Damage(f"damaged AEDAT4 file: {text}", where=str(path)) from error


# ---------------------------------------------------------------------------------------------------------------------
# Writing. A FlatBuffer begins with its length, the place of its root and four letters; a table points back to the list
# of its fields' places, its vtable. Nothing is packed: events are written as fast as the disk takes them.

_EVENT = np.dtype(
    {"names": list("txyp"), "formats": ["<i8", "<i2", "<i2", "u1"], "offsets": [0, 8, 10, 12], "itemsize": 16}
)
_PACKET_EVENTS = 1 << 16
_MOST_SIDE = 1 << 15
_TABLE_AT = 54
"""Byte of a file at which its header says where the table of packets lies."""
_INFO = """<dv version="2.0">
    <node name="outInfo" path="/outInfo/">
        <node name="0" path="/outInfo/0/">
            <attr key="compression" type="string">NONE</attr>
            <attr key="originalModuleName" type="string">BlinkGL</attr>
            <attr key="originalOutputName" type="string">events</attr>
            <attr key="typeDescription" type="string">Array of events (polarity ON/OFF).</attr>
            <attr key="typeIdentifier" type="string">EVTS</attr>
            <node name="info" path="/outInfo/0/info/">
                <attr key="sizeX" type="int">{width}</attr>
                <attr key="sizeY" type="int">{height}</attr>
                <attr key="source" type="string">BlinkGL</attr>
            </node>
        </node>
    </node>
</dv>
"""


class Aedat4Writer(CheckedWriter):
    """Writes one stream of events, in packets that are not compressed. Raises EventDataError: negative times, a side
    beyond 32768 px."""

    kind, limits = "AEDAT4", (0, 1 << 62, "AEDAT4 has no negative times; --zero-time shifts them")

    def __init__(self, path: str | os.PathLike, height: int, width: int):
        if max(height, width) > _MOST_SIDE:
            raise EventDataError(
                "AEDAT4 has 16-bit signed coordinates", where=str(path), value=(height, width), accepted="at most 32768"
            )
        super().__init__(path, height, width)
        self._packets: list[tuple[int, int, int, int, int]] = []
        info = _INFO.format(height=height, width=width).encode()
        # The vtable: its size, the size of the table, and where the table has its fields: compression, place of the
        # table of packets, text. The table: distance back to the vtable, compression 0 (none), offset of the text, no
        # place yet (-1).
        vtable = struct.pack("<5H", 10, 20, 4, 12, 8)
        table = struct.pack("<iiIq", 10, 0, 12, -1)
        # The table begins at byte 24. Its field of 64 bits, 12 bytes on, then lies at a multiple of eight from the
        # length on, and at _TABLE_AT of the file.
        body = struct.pack("<I4s6x", 24, b"IOHE") + vtable + table + struct.pack("<I", len(info)) + info + b"\0"
        with output_errors(path):
            self._file = open(path, "wb")  # noqa: SIM115 - closed by close/abort
            self._file.write(_MAGIC + struct.pack("<I", len(body)) + body)

    def _write(self, events: Events) -> None:
        for first in range(0, len(events), _PACKET_EVENTS):
            part = events.part(slice(first, first + _PACKET_EVENTS))
            rows = np.zeros(len(part), _EVENT)
            for name in "txyp":
                rows[name] = getattr(part, name)
            # Root at byte 16, the four letters, padding; a vtable of 6 bytes for a table of 8 with one field, at 4,
            # which leads to the list; then the number of events.
            head = struct.pack("<I4sHHHHiII", 16, b"EVTS", 0, 6, 8, 4, 6, 4, len(part))
            size = 4 + len(head) + rows.nbytes
            # The packet's own header, stream 0 and its size, then the FlatBuffer's length.
            self._file.write(struct.pack("<III", 0, size, size - 4) + head)
            # A packet's place is that of its FlatBuffer's length, behind the packet's header.
            self._packets.append((self._file.tell() - 4 - len(head), size, len(part), int(part.t[0]), int(part.t[-1])))
            self._file.write(rows.data)

    def close(self, t_end_us: int | None = None) -> None:
        """Write the table of packets, and finish the file."""
        with output_errors(self.path):
            at = self._file.tell()
            self._file.write(_table_of_packets(self._packets))
            self._file.seek(_TABLE_AT)
            self._file.write(struct.pack("<q", at))
            self._file.close()


def _table_of_packets(packets: list[tuple[int, int, int, int, int]]) -> bytes:
    """Return the table of packets: place, size, number of events, first and last time of each."""
    head = struct.pack("<I4sHHHHiII", 16, b"FTAB", 0, 6, 8, 4, 6, 4, len(packets))
    # Places are counted from the length; the 64-bit fields, 12 bytes into each entry, lie at multiples of eight.
    list_at, step = 4 + len(head), 48
    vtable_at = list_at + 4 * len(packets)
    first = vtable_at + 14 + (4 - (vtable_at + 14)) % 8
    offsets = [first + step * k - (list_at + 4 * k) for k in range(len(packets))]
    # The vtable: its size, the size of an entry, and where an entry has its place, stream and size, number of events,
    # first and last time.
    body = head + struct.pack(f"<{len(packets)}I", *offsets) + struct.pack("<7H", 14, 44, 12, 4, 20, 28, 36)
    body += b"\0" * (first - 4 - len(body))
    for k, (place, size, count, begin, end) in enumerate(packets):
        body += struct.pack("<iiiqqqq4x", first + step * k - vtable_at, 0, size, place, count, begin, end)
    return struct.pack("<I", len(body)) + body
