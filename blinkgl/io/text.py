"""Events as text, the Event Camera Dataset's ``t[s] x y p`` and its relatives, parsed and printed by numba at disk speed.

Read: separators space, tab, comma; comment and header lines; p as 0/1 or -1/1; t in seconds when it is written with a point or an
exponent, in µs when it is an integer; an optional first line ``width height`` (as E2VID's files have). Written: seconds with six
decimals (exact µs).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np

from blinkgl.errors import AssetError, EventDataError
from blinkgl.events.types import Events
from blinkgl.io.atomic import output_errors


class TextReader:
    """Raises AssetError with the line number for anything that is not an event."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        self.height = self.width = None
        self._skip = 0
        try:
            with open(path, "rb") as file:
                for _ in range(1000):
                    line = file.readline(4096)
                    fields = line.replace(b",", b" ").split()
                    if not line:
                        break
                    if len(fields) == 2 and all(f.isdigit() for f in fields):
                        self.width, self.height = int(fields[0]), int(fields[1])
                    elif fields and _is_number(fields[0]):
                        break
                    self._skip += 1
        except OSError as error:
            raise AssetError(f"cannot read: {error.strerror}", where=str(path)) from error

    def chunks(self, size: int = 1 << 22) -> Iterator[Events]:
        """All events, from about ``size`` bytes of text at a time."""
        with open(self.path, "rb") as file:
            for _ in range(self._skip):
                file.readline()
            line, rest = self._skip, b""
            while True:
                data = file.read(size)
                text = rest + data if data else rest + b"\n"
                cut = text.rfind(b"\n") + 1
                text, rest = text[:cut], text[cut:]
                if len(rest) > 1 << 16:
                    raise AssetError(f"line {line + 1} is not an event", where=str(self.path), value=rest[:40])
                buffer = np.frombuffer(text, np.uint8)
                capacity = text.count(b"\n")
                x, y, p = np.empty(capacity, np.uint16), np.empty(capacity, np.uint16), np.empty(capacity, np.uint8)
                t = np.empty(capacity, np.int64)
                n, bad = _parse(buffer, x, y, t, p)
                if bad >= 0:
                    content = text.split(b"\n", bad + 1)[bad].decode("latin-1")
                    raise AssetError(f"line {line + bad + 1} is not an event", where=str(self.path), value=content,
                                     accepted="t x y p")
                line += capacity
                if n:
                    yield Events(x[:n], y[:n], t[:n], p[:n])
                if not data:
                    return


class TextWriter:
    """``t x y p`` with t in seconds, six decimals. ``separator`` "," also writes a header line (CSV)."""

    def __init__(self, path: str | os.PathLike, separator: str = " "):
        self.path, self._separator = Path(path), ord(separator)
        with output_errors(path):
            self._file = open(path, "wb")  # noqa: SIM115 - closed by close/abort
            if separator == ",":
                self._file.write(b"t,x,y,p\n")

    def append(self, events: Events) -> None:
        if len(events) and events.t[0] < 0:
            raise EventDataError("negative time", where=str(self.path), value=int(events.t[0]), accepted=">= 0 µs")
        # 13 digits of seconds, point, 6, two coordinates of 5, polarity, separators, newline
        buffer = np.empty(len(events) * 40, np.uint8)
        n = _print(events.x, events.y, events.t, events.p, self._separator, buffer)
        with output_errors(self.path):
            self._file.write(buffer[:n].data)

    def close(self, t_end_us: int | None = None) -> None:
        with output_errors(self.path):
            self._file.close()

    def abort(self) -> None:
        try:
            self._file.close()
        except OSError:
            pass


def _is_number(field: bytes) -> bool:
    try:
        return np.isfinite(float(field))
    except ValueError:
        return False


@numba.njit(cache=True, nogil=True)
def _number(buffer, i):
    """(mantissa, decimal exponent, integer?, next index); next index -1: not a number, or more digits than int64 holds."""
    mantissa, exponent, digits, integer = np.int64(0), 0, 0, True
    negative = buffer[i] == 45
    if buffer[i] == 45 or buffer[i] == 43:
        i += 1
    while 48 <= buffer[i] <= 57 or (buffer[i] == 46 and integer):
        if buffer[i] == 46:
            integer = False
        elif mantissa < 10**16:  # digits beyond 17 are far below a µs once there is a point
            mantissa = mantissa * 10 + (buffer[i] - 48)
            digits += 1
            exponent -= 0 if integer else 1
        elif integer:
            return mantissa, exponent, integer, -1
        else:
            digits += 1
        i += 1
    if digits == 0:
        return mantissa, exponent, integer, -1
    if buffer[i] == 101 or buffer[i] == 69:
        integer = False
        i += 1
        sign = 1
        if buffer[i] == 45 or buffer[i] == 43:
            sign = -1 if buffer[i] == 45 else 1
            i += 1
        if not 48 <= buffer[i] <= 57:
            return mantissa, exponent, integer, -1
        power = 0
        while 48 <= buffer[i] <= 57:
            power = min(power * 10 + (buffer[i] - 48), 1000)
            i += 1
        exponent += sign * power
    return (-mantissa if negative else mantissa), exponent, integer, i


@numba.njit(cache=True, nogil=True)
def _scaled(mantissa, exponent):
    """mantissa · 10^exponent rounded to the nearest integer, exactly (half away from zero); ok False when it overflows."""
    value = abs(mantissa)
    while exponent > 0 and value != 0:
        if value > 10**17:
            return np.int64(0), False
        value *= 10
        exponent -= 1
    if exponent < 0:
        divisor = np.int64(1)
        for _ in range(min(-exponent, 18)):
            divisor *= 10
        value = (value + divisor // 2) // divisor if exponent >= -18 else np.int64(0)
    return (value if mantissa >= 0 else -value), True


@numba.njit(cache=True, nogil=True)
def _parse(buffer, x, y, t, p):
    """Events in whole lines of text. Returns (count, index of the first bad line or -1)."""
    n, line, i = 0, 0, 0
    values = np.empty(4, np.int64)
    while i < len(buffer):
        field = 0
        while buffer[i] != 10:
            c = buffer[i]
            if c == 32 or c == 9 or c == 44 or c == 13:
                i += 1
                continue
            if c == 35 and field == 0:  # comment
                while buffer[i] != 10:
                    i += 1
                break
            if field == 4:
                return n, line
            mantissa, exponent, integer, i = _number(buffer, i)
            if i < 0:
                return n, line
            c = buffer[i]
            if not (c == 32 or c == 9 or c == 44 or c == 13 or c == 10):
                return n, line
            values[field], ok = _scaled(mantissa, exponent + (6 if field == 0 and not integer else 0))
            if not ok or (field > 0 and exponent < 0 and values[field] * 10.0 ** -exponent != mantissa):
                return n, line  # also coordinates between pixels: rectified events are not raw events
            field += 1
        i += 1
        if field == 4:
            if not (0 <= values[1] <= 65535 and 0 <= values[2] <= 65535 and -1 <= values[3] <= 1):
                return n, line
            t[n], x[n], y[n], p[n] = values[0], values[1], values[2], max(values[3], 0)
            n += 1
        elif field != 0:
            return n, line
        line += 1
    return n, -1


@numba.njit(cache=True, nogil=True)
def _put(value, digits, buffer, n):
    """Decimal digits of ``value`` at ``buffer[n:]``, at least ``digits`` of them; returns the new end."""
    length, rest = 1, value // 10
    while rest > 0:
        length, rest = length + 1, rest // 10
    length = max(length, digits)
    for k in range(length - 1, -1, -1):
        buffer[n + k] = 48 + value % 10
        value //= 10
    return n + length


@numba.njit(cache=True, nogil=True)
def _print(x, y, t, p, separator, buffer):
    n = 0
    for i in range(len(t)):
        n = _put(t[i] // 1000000, 1, buffer, n)
        buffer[n] = 46
        n = _put(t[i] % 1000000, 6, buffer, n + 1)
        buffer[n] = separator
        n = _put(np.int64(x[i]), 1, buffer, n + 1)
        buffer[n] = separator
        n = _put(np.int64(y[i]), 1, buffer, n + 1)
        buffer[n] = separator
        buffer[n + 1] = 48 + p[i]
        buffer[n + 2] = 10
        n += 3
    return n
