"""Event Stream (.es) by Marcireau, version 2, of a DVS: one byte of time and polarity, then x and y, 16 bits each.

The byte is (time since the event before, µs) << 1 | polarity; 0xff: 127 µs pass without an event, 0xfe: padding.
(neuromorphic-paris/event_stream, the format's page.) y counts from the bottom."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.reading import AS_FILE, Damage, EventReading
from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Events

# 12 bytes of magic, 3 of the version, 1 of the type of events, then width and height, 16 bits each.
_HEADER = 20
_DVS = 1


class EventStreamReader:
    """Size and events of an .es file. Raises AssetError: not version 2, not of a DVS, truncated."""

    origin = "bottom"

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        self.path = Path(path)
        with open(path, "rb") as file:
            header = file.read(_HEADER)
        if len(header) < _HEADER or not header.startswith(b"Event Stream"):
            raise AssetError("not an Event Stream file", where=str(path))
        if header[12] != 2 or header[15] != _DVS:
            raise AssetError(
                "unsupported Event Stream",
                where=str(path),
                value=f"version {header[12]}, type {header[15]}",
                accepted="version 2, type 1 (DVS)",
            )
        self.width, self.height = (int.from_bytes(header[i : i + 2], "little") for i in (16, 18))

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        """Yield all events, decoded from ``size`` bytes at a time."""
        # Time, bytes of the current event so far, its polarity, x and y.
        state = np.zeros(5, np.int64)
        with open(self.path, "rb") as file:
            file.seek(_HEADER)
            while data := file.read(size):
                # An event has five bytes, and the first one may have begun in the piece before.
                most = len(data) // 5 + 1
                made = Events(*(np.empty(most, dtype) for dtype in (np.uint16, np.uint16, np.int64, np.uint8)))
                n = _decode(np.frombuffer(data, np.uint8), state, made.x, made.y, made.t, made.p)
                yield made.part(slice(n)).copy()
        if state[1]:
            raise Damage("truncated: the last event is not whole", where=str(self.path))


@kernel
def _decode(data, state, x, y, t, p):
    """Decode bytes; return how many events are complete."""
    n = 0
    time, got, polarity, column, row = state
    for byte in data:
        value = np.int64(byte)
        if got == 0:
            # 255 is 127 µs without an event, 254 is padding.
            if value == 255:
                time += 127
            elif value != 254:
                time += value >> 1
                polarity, column, row, got = value & 1, 0, 0, 1
        else:
            # Bytes 1 and 2 of an event are x, 3 and 4 are y, each with the low byte first.
            if got <= 2:
                column |= value << (8 * (got - 1))
            else:
                row |= value << (8 * (got - 3))
            got += 1
            if got == 5:
                x[n], y[n], t[n], p[n] = column, row, time, polarity
                n, got = n + 1, 0
    state[0], state[1], state[2], state[3], state[4] = time, got, polarity, column, row
    return n
