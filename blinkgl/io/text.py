"""Events as text, the Event Camera Dataset's ``t[s] x y p`` and its relatives, parsed and
printed by numba at disk speed.

Read: separators space, tab, comma; comment lines (``#``, ``%``) anywhere; before the first event a line
``width height`` (as E2VID's files have) and a line that names the columns, also as faery writes it
(``t,x@640,y@480,on``); p as 0/1 or -1/1; t in seconds when it is written with a point or an exponent, in µs when it is
an integer, the same way in the whole file. Written: seconds with six decimals, or integer µs (exact both).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import check_events, check_size, refuse_causes
from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Events

_LONGEST_LINE = 1 << 16
_ACCEPTED = "t x y p"
_MICROSECONDS, _SECONDS = 0, 1
_COLUMN = re.compile(r"(?P<name>[a-z]+)[ _]?[\[(]?(?P<unit>s|us|µs|px)?[\])]?(@(?P<size>\d{1,9}))?")
_COLUMN_NAMES = ({"t", "ts", "time", "times", "timestamp", "timestamps"}, {"x"}, {"y"}, {"p", "pol", "polarity", "on"})


class TextReader:
    """Reads events from text. ``height`` and ``width`` are None when the file does not give them. Raises AssetError
    with the number of a line that is not an event."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        self.height = self.width = None
        self._start = self._lines = 0  # bytes and lines before the first event
        self._unit = -1  # unit of integer and of decimal times: not known yet
        named = False
        try:
            with open(path, "rb") as file:
                while line := file.readline(_LONGEST_LINE + 1):
                    if len(line) > _LONGEST_LINE:
                        raise AssetError(
                            f"line {self._lines + 1} is longer than {_LONGEST_LINE} bytes",
                            where=str(path),
                            value=line[:40],
                        )
                    text = line.decode("utf-8-sig", "replace").strip()
                    if text and text[0] not in "#%":
                        # Two integers before the first event are the sensor's size.
                        size = re.fullmatch(r"(\d{1,9})[ \t,]+(\d{1,9})", text)
                        if size and self.width is None:
                            self.width, self.height = int(size[1]), int(size[2])
                        elif not named and text[0].isalpha() and not re.match(r"(nan|inf)\b", text, re.I):
                            self._name_columns(text)
                            named = True
                        else:
                            break
                    self._start, self._lines = file.tell(), self._lines + 1
        except OSError as error:
            raise AssetError(f"cannot read: {error.strerror}", where=str(path)) from error
        check_size(self.height, self.width, str(path))

    def _name_columns(self, text: str) -> None:
        """Read sizes and the unit of time from a line with column names. Raises AssetError when it names others, or in
        another order."""
        names = re.split(r"[,\t]|\s+(?![\[(])", text.lower().replace('"', ""))
        found = [_COLUMN.fullmatch(name.strip()) for name in names if name.strip()]
        if len(found) != 4 or not all(m and m["name"] in known for m, known in zip(found, _COLUMN_NAMES)):
            raise AssetError(
                f"line {self._lines + 1} is not an event, and not a heading with column names",
                where=str(self.path),
                value=text,
                accepted=f"{_ACCEPTED}, in this order",
            )
        if found[0]["unit"]:
            self._unit = _SECONDS if found[0]["unit"] == "s" else _MICROSECONDS
        if found[1]["size"] and found[2]["size"]:
            self.width, self.height = int(found[1]["size"]), int(found[2]["size"])

    def chunks(self, size: int = 1 << 22) -> Iterator[Events]:
        """Yield all events, from about ``size`` bytes of text at a time."""
        unit = np.array([self._unit])
        with open(self.path, "rb") as file:
            file.seek(self._start)
            line, rest = self._lines, b""
            while True:
                data = file.read(size)
                # At the end of the file the last line may lack its newline.
                text = rest + data if data else rest + b"\n"
                cut = text.rfind(b"\n") + 1
                text, rest = text[:cut], text[cut:]
                if len(rest) > _LONGEST_LINE:
                    line += text.count(b"\n") + 1
                    raise AssetError(
                        f"line {line} is longer than {_LONGEST_LINE} bytes", where=str(self.path), value=rest[:40]
                    )
                buffer = np.frombuffer(text, np.uint8)
                capacity = text.count(b"\n")
                x, y, p = np.empty(capacity, np.uint16), np.empty(capacity, np.uint16), np.empty(capacity, np.uint8)
                t = np.empty(capacity, np.int64)
                # The kernel indexes lines from 0 within this piece of text.
                n, bad, mixed = _parse(buffer, x, y, t, p, unit)
                if bad >= 0:
                    content = text.split(b"\n", bad + 1)[bad].decode("latin-1")
                    if mixed:
                        raise AssetError(
                            f"line {line + bad + 1} has a time in another unit",
                            where=str(self.path),
                            value=content,
                            accepted="either integers (µs) or numbers with a point (s) in the whole file",
                        )
                    raise AssetError(
                        f"line {line + bad + 1} is not an event",
                        where=str(self.path),
                        value=content,
                        accepted=_ACCEPTED,
                    )
                line += capacity
                if n:
                    yield Events(x[:n], y[:n], t[:n], p[:n])
                if not data:
                    return


class TextWriter:
    """Writes ``t x y p``. ``separator`` "," makes a CSV that begins with a line of column names. time_unit : "s" writes
    seconds with six decimals, "us" integer µs; the CSV is then what faery writes and reads, with the sensor's size in
    its first line."""

    def __init__(self, path: str | os.PathLike, height: int, width: int, separator: str = " ", *, time_unit: str = "s"):
        if time_unit not in ("s", "us"):
            raise EventDataError("unit of time", where=str(path), value=time_unit, accepted="s or us")
        self.path, self._separator, self._micro = Path(path), ord(separator), time_unit == "us"
        self._size, self._count, self._last = (height, width), 0, None
        with output_errors(path):
            self._file = open(path, "wb")  # noqa: SIM115 - closed by close/abort
            if separator == ",":
                self._file.write(f"t,x@{width},y@{height},on\n".encode() if self._micro else b"t,x,y,p\n")

    def append(self, events: Events) -> None:
        refuse_causes(events, "text", str(self.path))
        if len(events) and events.t[0] < 0:
            raise EventDataError("negative time", where=str(self.path), value=int(events.t[0]), accepted=">= 0 µs")
        self._last = check_events(
            events, str(self.path), self._count, height=self._size[0], width=self._size[1], after=self._last
        )
        self._count += len(events)
        # 13 digits of seconds, point, 6, two coordinates of 5, polarity, separators, newline
        buffer = np.empty(len(events) * 40, np.uint8)
        n = _print(events.x, events.y, events.t, events.p, self._separator, self._micro, buffer)
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


@kernel
# Characters by their codes: 45 "-", 43 "+", 46 ".", 48 to 57 digits, 101 and 69 "e", "E".
def _number(buffer, i):
    """Return (mantissa, decimal exponent, integer?, next index); next index -1: not a number, or more digits than
    int64 holds."""
    mantissa, exponent, digits, integer = np.int64(0), 0, False, True
    negative = buffer[i] == 45
    if buffer[i] == 45 or buffer[i] == 43:
        i += 1
    while 48 <= buffer[i] <= 57 or (buffer[i] == 46 and integer):
        if buffer[i] == 46:
            integer = False
        elif mantissa < 10**16:  # digits beyond 17 are far below a µs once there is a point
            mantissa = mantissa * 10 + (buffer[i] - 48)
            digits = True
            exponent -= 0 if integer else 1
        elif integer:
            return mantissa, exponent, integer, -1
        i += 1
    if not digits:
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
            # 1000 is beyond anything that fits, and keeps the sum in range.
            power = min(power * 10 + (buffer[i] - 48), 1000)
            i += 1
        exponent += sign * power
    return (-mantissa if negative else mantissa), exponent, integer, i


@kernel
def _scaled(mantissa, exponent):
    """Return mantissa · 10^exponent rounded to the nearest integer, exactly (half away from zero); ok False when it
    overflows."""
    value = abs(mantissa)
    while exponent > 0 and value != 0:
        # value * 10 must stay below 2^63.
        if value > 10**17:
            return np.int64(0), False
        value *= 10
        exponent -= 1
    if exponent < 0:
        divisor = np.int64(1)
        for _ in range(min(-exponent, 18)):
            divisor *= 10
        # Half away from zero; beyond 18 places nothing is left.
        value = (value + divisor // 2) // divisor if exponent >= -18 else np.int64(0)
    return (value if mantissa >= 0 else -value), True


@kernel
def _parse(buffer, x, y, t, p, unit):
    """Parse the events in complete lines of text. Return (count, index of the first bad line or -1, bad for its unit of
    time?).

    unit[0] : of the times so far, -1 not known, 0 integers (µs), 1 decimals (s); kept up to date."""
    n, line, i = 0, 0, 0
    values = np.empty(4, np.int64)
    while i < len(buffer):
        field = 0
        while buffer[i] != 10:
            c = buffer[i]
            if c == 32 or c == 9 or c == 44 or c == 13:
                i += 1
                continue
            # The rest of a comment line is skipped.
            if (c == 35 or c == 37) and field == 0:
                while buffer[i] != 10:
                    i += 1
                break
            if field == 4:
                return n, line, False
            mantissa, exponent, integer, i = _number(buffer, i)
            if i < 0:
                return n, line, False
            c = buffer[i]
            if not (c == 32 or c == 9 or c == 44 or c == 13 or c == 10):
                return n, line, False
            # Decimal times are seconds: six more places make microseconds.
            values[field], ok = _scaled(mantissa, exponent + (6 if field == 0 and not integer else 0))
            if not ok or (field > 0 and exponent < 0 and values[field] * 10.0**-exponent != mantissa):
                # Coordinates between pixels are refused as well: rectified events are not raw events.
                return n, line, False
            # A plain 0 is the same time in both units.
            if field == 0 and (values[0] != 0 or not integer):
                kind = 0 if integer else 1
                if unit[0] >= 0 and unit[0] != kind:
                    return n, line, True
                unit[0] = kind
            field += 1
        i += 1
        if field == 4:
            # -1 and 0 are both OFF.
            if not (0 <= values[1] <= 65535 and 0 <= values[2] <= 65535 and -1 <= values[3] <= 1):
                return n, line, False
            t[n], x[n], y[n], p[n] = values[0], values[1], values[2], max(values[3], 0)
            n += 1
        elif field != 0:
            return n, line, False
        line += 1
    return n, -1, False


@kernel
def _put(value, digits, buffer, n):
    """Write the decimal digits of ``value``, at least ``digits`` of them, to ``buffer[n:]`` and return the new end."""
    # The number of digits first, then the digits from the last one on.
    length, rest = 1, value // 10
    while rest > 0:
        length, rest = length + 1, rest // 10
    length = max(length, digits)
    for k in range(length - 1, -1, -1):
        buffer[n + k] = 48 + value % 10
        value //= 10
    return n + length


@kernel
def _print(x, y, t, p, separator, micro, buffer):
    n = 0
    for i in range(len(t)):
        if micro:
            n = _put(t[i], 1, buffer, n)
        else:
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
