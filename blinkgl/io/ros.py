"""Events in ROS 1 and 2 bags and MCAP files, read by the package rosbags.

``dvs_msgs/EventArray`` and ``prophesee_event_msgs/EventArray`` hold rows x, y, time, polarity, which are read as arrays
and not event by event; ``event_camera_msgs/EventPacket`` holds a camera's own bytes, of which EVT2.1, EVT3 and ``mono``
are read. Times are the events' own: ROS time, or the camera's for EVT.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.columns import events_of, joined
from blinkgl.io.evt import HIGH, START, UNTIMED, decode, state_lines
from blinkgl.io.reading import AS_FILE, Damage, EventReading, chosen, listed
from blinkgl.io.records import bounded, decoding, unpacked
from blinkgl.machine.extras import install
from blinkgl.types.events import Events

_HEADER = "std_msgs/Header header\nuint32 height\nuint32 width\n"
FLOW = "esim_msgs/msg/OpticFlow"
_EVENT = "uint16 x\nuint16 y\ntime ts\nbool polarity\n"
DEFINITIONS = {
    "dvs_msgs/msg/Event": _EVENT,
    "dvs_msgs/msg/EventArray": f"{_HEADER}dvs_msgs/Event[] events\n",
    "prophesee_event_msgs/msg/Event": _EVENT,
    "prophesee_event_msgs/msg/EventArray": f"{_HEADER}prophesee_event_msgs/Event[] events\n",
    "event_camera_msgs/msg/EventPacket": f"{_HEADER}uint64 seq\nuint64 time_base\nstring encoding\nbool is_bigendian\n"
    "uint8[] events\n",
    FLOW: f"{_HEADER}float32[] flow_x\nfloat32[] flow_y\n",
}
"""Messages of event cameras, as their packages define them (for bags that do not say)."""
_EVENTS = frozenset(DEFINITIONS) - {FLOW}
_PACKET = "event_camera_msgs/msg/EventPacket"
_FIELDS = [("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")]
_PACKED = np.dtype(_FIELDS)
"""An event of a ROS 1 message; of ROS 2 the first one."""
_ALIGNED = np.dtype(
    {"names": [k for k, _ in _FIELDS], "formats": [f for _, f in _FIELDS], "offsets": [1, 3, 7, 11, 15]}
)
"""Every later event of a ROS 2 message: from the polarity before it, times on multiples of four bytes."""


def typestore(ros2: bool) -> Any:
    """Return rosbags' table of messages, with those of events. Raises AssetError: rosbags is not installed."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise AssetError("bags are read by the package rosbags", accepted=f"run {install('rosbags')}") from None
    store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
    types: dict[str, object] = {}
    for name, text in DEFINITIONS.items():
        types |= get_types_from_msg(text, name)
    store.register(types)
    return store


_UNSUSPECTED = 1 << 26
"""Bytes that a chunk, a message or a file of a bag may unpack to, however small it is: recorders write chunks of less
than a megabyte."""


@functools.cache
def _limited() -> None:
    """Give the unpackers of rosbags a limit: they unpack as much as a chunk holds, in 5 kB the events of a gigabyte."""
    import bz2

    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1.reader import decompressors
    from rosbags.rosbag2 import reader, storage_mcap

    limited = lambda make: lambda data, *_: unpacked(make, data, _UNSUSPECTED)
    decompressors.update(bz2=limited(bz2.BZ2Decompressor), lz4=limited(LZ4FrameDecompressor))
    # Versions without it use a library that takes the size that a chunk states.
    library = getattr(reader, "zstd", None)
    zstd = {} if library is None else {"zstd": limited(library.ZstdDecompressor)}
    storage_mcap.DECOMPRESSORS.update(lz4=limited(LZ4FrameDecompressor), **zstd)
    if library is None:
        return

    @contextlib.contextmanager
    def opened(file: BinaryIO, mode: str) -> Iterator[SimpleNamespace]:
        # Of bags that are packed as whole files, which the library unpacks into the temporary folder.
        with library.open(file, mode) as inner:
            packed = os.fstat(file.fileno()).st_size
            yield SimpleNamespace(read=bounded(inner.read, packed, _UNSUSPECTED))

    reader.zstd = SimpleNamespace(decompress=zstd["zstd"], open=opened)


class BagReader:
    """The events of the only topic, or of the one that ``stream`` names. height, width : px, of its first message.
    notes : after reading, a line for each kind of words that were left out. Raises AssetError: no topic of events, or
    several, which it lists; another encoding; Damage."""

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        self.path, self.notes, self._keep = Path(path), [], reading.keep
        self.height = self.width = None
        self.triggers = np.empty((0, 3), np.int64)
        with self._opened() as bag:
            self._topics = sorted({c.topic for c in bag.connections if c.msgtype in _EVENTS})
            if not self._topics:
                raise AssetError(
                    "no topic of events",
                    where=str(path),
                    value=sorted({c.msgtype for c in bag.connections})[:8],
                    accepted="dvs_msgs/EventArray, prophesee_event_msgs/EventArray or event_camera_msgs/EventPacket",
                )
            self._topic = self._topics[chosen(reading.stream, self._topics, str(path), "topics of events")]
            for _, _, (height, width) in self._messages(bag):
                self.height, self.width = (height, width) if height and width else (None, None)
                break

    @contextlib.contextmanager
    def _opened(self) -> Iterator[Any]:
        ros2 = self.path.suffix.lower() != ".bag"
        store = typestore(ros2)
        from rosbags.highlevel import AnyReader

        _limited()
        with decoding(self.path, "damaged bag", Damage), AnyReader([self.path], default_typestore=store) as bag:
            yield bag

    def _messages(self, bag: Any) -> Iterator[tuple[Any, Any, tuple[int, int]]]:
        """Yield, for each message of the topic, its connection, its content, and (height, width)."""
        for connection, _, data in bag.messages([c for c in bag.connections if c.topic == self._topic]):
            if connection.msgtype == _PACKET:
                message = bag.deserialize(data, connection.msgtype)
                yield connection, message, (message.height, message.width)
            else:
                rows, size = _rows(data, bag.is2)
                yield connection, rows, size

    def chunks(self, least: int = 1 << 20) -> Iterator[Events]:
        """Yield all events, joined to about ``least``."""
        yield from joined(self._events(), least)

    def _events(self) -> Iterator[Events]:
        state, first, lost, triggers = START.copy(), 0, 0, []
        try:
            with self._opened() as bag:
                for connection, content, _ in self._messages(bag):
                    if connection.msgtype == _PACKET:
                        events, bad = _unpacked(content, state, self.path, self._keep, triggers)
                        lost += bad
                    else:
                        events = _timed(content, str(self.path), first)
                    first += len(events)
                    yield events
        finally:
            self.triggers = np.concatenate(triggers) if triggers else np.empty((0, 3), np.int64)
            self.notes = [f"left out: words that the format does not have: {lost:,}"] if lost else []
            self.notes += state_lines(state)
        if state[HIGH] < 0 and state[UNTIMED]:
            raise Damage(f"{state[UNTIMED]} events and no TIME_HIGH word, so no times", where=str(self.path))


def _rows(data: memoryview | bytes, ros2: bool) -> tuple[np.ndarray, tuple[int, int]]:
    """Return the rows of an EventArray, and (height, width). The header is ROS 1's sequence number, time and name of a
    frame; in ROS 2 without the number, and with numbers on multiples of four bytes after a mark of four."""
    # ROS 1: sequence number and time; ROS 2: the mark and the time.
    at = 12
    # The frame's name: its length, then so many bytes.
    at += 4 + int.from_bytes(data[at : at + 4], "little")
    if ros2:
        if bytes(data[:2]) != b"\0\1":
            raise ValueError("not little-endian CDR")
        # Alignment counts from behind the mark, whose length is a multiple of four itself.
        at += -at % 4
    height, width, count = np.frombuffer(data, "<u4", 3, at).tolist()
    at += 12
    if not ros2 or not count:
        return np.frombuffer(data, _PACKED, count, at), (height, width)
    rows = np.empty(count, _PACKED)
    rows[0] = np.frombuffer(data, _PACKED, 1, at)[0]
    rows[1:] = np.frombuffer(data, _ALIGNED, count - 1, at + _PACKED.itemsize) if count > 1 else []
    return rows, (height, width)


def event_array(events: Events, height: int, width: int) -> tuple[str, bytes]:
    """Return the type and the bytes of a ROS 1 message, ``dvs_msgs/EventArray``, stamped by its last event."""
    rows = np.zeros(len(events), _PACKED)
    rows["x"], rows["y"], rows["p"] = events.x, events.y, events.p
    rows["s"], rows["ns"] = events.t // 10**6, events.t % 10**6 * 1000
    # Number in sequence, time, an empty name of a frame; height, width, count.
    header = np.array([0, rows["s"][-1], rows["ns"][-1], 0, height, width, len(events)], "<u4")
    return "dvs_msgs/msg/EventArray", header.tobytes() + rows.tobytes()


def _timed(rows: np.ndarray, where: str, first: int) -> Events:
    # Rounded to the nearest microsecond.
    t = rows["s"].astype(np.int64) * 1_000_000 + (rows["ns"].astype(np.int64) + 500) // 1000
    return events_of(rows["x"], rows["y"], t, rows["p"], where, first)


_ENCODINGS = {"evt3": "u2", "evt21": "u8", "mono": "u8"}
"""Encodings of a packet, and the type of their words; all but ``mono`` are read by :func:`~blinkgl.io.evt.decode`."""


def _unpacked(
    message: Any, state: np.ndarray, path: Path, keep: bool, triggers: list[np.ndarray]
) -> tuple[Events, int]:
    """Return the events of an EventPacket, and how many words were left out, which ``keep`` allows. state : of the
    decoder, which goes on from packet to packet."""
    data, order = np.ascontiguousarray(message.events), ">" if message.is_bigendian else "<"
    words = np.dtype(order + listed(_ENCODINGS, message.encoding, "unknown encoding of events", path))
    if len(data) % words.itemsize:
        raise Damage(
            f"packet {message.seq} is cut",
            where=str(path),
            value=f"{len(data)} bytes",
            accepted=f"a multiple of {words.itemsize}",
        )
    if message.encoding == "mono":  # p 1 bit, y 15, x 16, ns since time_base 32
        values = data.view(words)
        t = (np.int64(message.time_base) + (values & 0xFFFFFFFF).astype(np.int64) + 500) // 1000
        x, y = (values >> 32 & 0xFFFF).astype(np.uint16), (values >> 48 & 0x7FFF).astype(np.uint16)
        return Events(x, y, t, (values >> 63).astype(np.uint8)), 0
    # The decoder takes little-endian words, whatever the packet's order.
    rest, parts, lost = data.view(words).astype(words.newbyteorder("<"), copy=False), [], 0
    while True:
        events, bad = decode(message.encoding, rest, state, triggers=triggers)
        parts.append(events)
        if bad < 0:
            return Events.concatenate(parts), lost
        if not keep:
            raise Damage(
                f"packet {message.seq}: no valid {message.encoding.upper()} word",
                where=str(path),
                value=hex(int(rest[bad])),
            )
        rest, lost = rest[bad + 1 :], lost + 1
