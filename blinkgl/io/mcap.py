"""Events in MCAP, as ROS 2 records them: messages ``event_camera_msgs/msg/EventPacket``, written and read without ROS.

A message is CDR (little-endian): std_msgs/Header, height, width, seq u4/u8, time_base u8 ns, encoding, is_bigendian,
events. Written is the encoding "mono", 64 bits an event: polarity in bit 63, y in 62..48, x in 47..32, ns since
time_base in 31..0. Read are "mono" and "evt3" (Prophesee's words, as :mod:`blinkgl.io.evt` has them).

Needs the package mcap (extra [exchange]), which takes care of the container alone.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError, EventDataError, OutputError
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import check_events, check_size, events_of, refuse_causes
from blinkgl.types.events import Events

TOPIC = "/event_camera/events"
SCHEMA = "event_camera_msgs/msg/EventPacket"
_PACKET_US = 10_000
"""A message holds the events of so long: short enough for players, long enough to compress."""
_MAX_SIDE = 32768
_CDR = b"\x00\x01\x00\x00"
_DEFINITION = """std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def _package(where: str, kind: type[AssetError] | type[OutputError]) -> Any:
    try:
        import mcap.reader
        import mcap.writer
    except ImportError:
        from blinkgl.machine.extras import install

        raise kind("needs the Python package mcap", where=where, accepted=f"run {install('mcap')}") from None
    return mcap


class McapWriter:
    """Streams events of one camera; the same events give the same bytes however they were chunked.

    Raises OutputError: the package mcap is not installed. EventDataError: times outside [0, 2^63) ns, sides over
    32768 px, causes."""

    def __init__(self, path: str | os.PathLike, height: int, width: int):
        package = _package(str(path), OutputError)
        if height > _MAX_SIDE or width > 2 * _MAX_SIDE:
            raise EventDataError("EventPacket has y in 15 bits", where=str(path), value=(height, width))
        self.path, self.height, self.width = Path(path), height, width
        self._waiting: list[Events] = []
        self._last: int | None = None
        self._begin_us, self._count, self._seq = 0, 0, 0
        with output_errors(path):
            self._file = open(path, "wb")  # noqa: SIM115 - closed by close/abort
            self._mcap = package.writer.Writer(self._file)
            self._mcap.start(profile="ros2", library="BlinkGL")
            schema = self._mcap.register_schema(SCHEMA, "ros2msg", _DEFINITION.encode())
            self._channel = self._mcap.register_channel(TOPIC, "cdr", schema)

    def append(self, events: Events) -> None:
        refuse_causes(events, "MCAP", str(self.path))
        if not len(events):
            return
        where, t = str(self.path), events.t
        if t[0] < 0 or t[-1] >= 2**63 // 1000:
            raise EventDataError(
                "MCAP counts ns since 1970",
                where=where,
                value=int(t[0] if t[0] < 0 else t[-1]),
                accepted="times from 0 on; use --zero-time to shift",
            )
        self._last = check_events(events, where, self._count, height=self.height, width=self.width, after=self._last)
        for begin in np.unique(t // _PACKET_US):
            low, high = np.searchsorted(t, [begin * _PACKET_US, (begin + 1) * _PACKET_US])
            if self._waiting and self._begin_us != begin * _PACKET_US:
                self._flush()
            self._begin_us = int(begin) * _PACKET_US
            self._waiting.append(events.part(slice(low, high)).copy())
        self._count += len(events)

    def close(self, t_end_us: int | None = None) -> None:
        if self._waiting or not self._seq:  # a message without events says how large the sensor is
            self._flush()
        with output_errors(self.path):
            self._mcap.finish()
            self._file.close()

    def abort(self) -> None:
        try:
            self._file.close()
        except OSError:
            pass

    def _flush(self) -> None:
        events, base_ns = Events.concatenate([Events.empty(), *self._waiting]), self._begin_us * 1000
        words = (
            (events.p.astype(np.uint64) << np.uint64(63))
            | (events.y.astype(np.uint64) << np.uint64(48))
            | (events.x.astype(np.uint64) << np.uint64(32))
            | (events.t * 1000 - base_ns).astype(np.uint64)
        )
        data = _message(self.height, self.width, self._seq, base_ns, "mono", words.astype("<u8").tobytes())
        with output_errors(self.path):
            self._mcap.add_message(self._channel, base_ns, data, base_ns, self._seq)
        self._waiting, self._seq = [], self._seq + 1


class McapReader:
    """Events of the first topic of EventPackets; times are µs, what is finer is cut off. height, width : of its first
    message.

    Raises AssetError: the package is missing, the file is damaged or cut, holds no such messages, or other encodings
    than "mono" and "evt3"."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        first = next(self._packets(), None)
        if first is None:
            raise AssetError(f"no messages of {SCHEMA}", where=str(path))
        self.height, self.width = first[0], first[1]
        check_size(self.height, self.width, str(path))

    def chunks(self) -> Iterator[Events]:
        """The events of each message."""
        count, state = 0, np.array([-1, 0, 0, 0, 0, 0, 0], np.int64)
        for _, _, base_ns, encoding, data in self._packets():
            if encoding == "mono":
                events = self._mono(base_ns, data, count)
            elif encoding == "evt3":
                from blinkgl.io.evt import decode_evt3

                events = decode_evt3(data, state, str(self.path))  # its words carry whole times: no base
            else:
                raise AssetError(
                    "unknown encoding of events", where=str(self.path), value=encoding, accepted="mono or evt3"
                )
            count += len(events)
            yield events

    def _mono(self, base_ns: int, data: bytes, first: int) -> Events:
        if len(data) % 8:
            raise AssetError("damaged: a message that ends within an event", where=str(self.path), value=len(data))
        words = np.frombuffer(data, "<u8")
        t = (base_ns + (words & np.uint64(0xFFFFFFFF)).astype(np.int64)) // 1000
        x, y = (words >> np.uint64(32)) & np.uint64(0xFFFF), (words >> np.uint64(48)) & np.uint64(0x7FFF)
        return events_of(x, y, t, words >> np.uint64(63), str(self.path), first)

    def _packets(self) -> Iterator[tuple[int, int, int, str, bytes]]:
        """(height, width, time_base, encoding, events) of every message, in the order of the log."""
        package, topic = _package(str(self.path), AssetError), None
        try:
            with open(self.path, "rb") as file:
                for schema, channel, message in package.reader.make_reader(file, validate_crcs=True).iter_messages():
                    if schema is None or schema.name != SCHEMA or channel.topic != (topic or channel.topic):
                        continue
                    topic = channel.topic
                    yield _parsed(message.data)
        except OSError as error:
            raise AssetError(f"cannot read: {error.strerror}", where=str(self.path)) from error
        except AssetError:
            raise
        except Exception as error:
            text = " ".join(str(error).split())[:120] or type(error).__name__
            raise AssetError(f"damaged MCAP file: {text}", where=str(self.path)) from error


def _message(height: int, width: int, seq: int, base_ns: int, encoding: str, events: bytes) -> bytes:
    """CDR: every number stands at a multiple of its size, counted from the end of the four bytes at the front."""
    body = bytearray(struct.pack("<iI", base_ns // 10**9, base_ns % 10**9))
    _string(body, "event_camera")
    _align(body, 4)
    body += struct.pack("<II", height, width)
    _align(body, 8)
    body += struct.pack("<QQ", seq, base_ns)
    _string(body, encoding)
    body += b"\x00"  # is_bigendian
    _align(body, 4)
    body += struct.pack("<I", len(events))
    return _CDR + bytes(body) + events


def _string(body: bytearray, text: str) -> None:
    raw = text.encode() + b"\x00"
    body += struct.pack("<I", len(raw)) + raw


def _align(body: bytearray, size: int) -> None:
    body += bytes(-len(body) % size)


def _parsed(data: bytes) -> tuple[int, int, int, str, bytes]:
    """What :func:`_message` was given, but for seq. Raises struct.error, ValueError."""
    if data[:4] != _CDR:
        raise ValueError("a message that is no little-endian CDR")
    body = memoryview(data)[4:]
    at = _after_string(body, 8)[1]
    at += -at % 4
    height, width = struct.unpack_from("<II", body, at)
    at += 8
    at += -at % 8
    (base_ns,) = struct.unpack_from("<Q", body, at + 8)
    encoding, at = _after_string(body, at + 16)
    bigendian = body[at]
    at += 1
    at += -at % 4
    (size,) = struct.unpack_from("<I", body, at)
    events = bytes(body[at + 4 : at + 4 + size])
    if len(events) != size or bigendian:
        raise ValueError("a message that is cut" if len(events) != size else "a message of a big-endian machine")
    return height, width, base_ns, encoding, events


def _after_string(body: memoryview, at: int) -> tuple[str, int]:
    (size,) = struct.unpack_from("<I", body, at)
    return bytes(body[at + 4 : at + 4 + size]).rstrip(b"\x00").decode(), at + 4 + size
