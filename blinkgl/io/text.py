"""Events as text, the Event Camera Dataset's ``t[s] x y p`` and its relatives, parsed and printed by numba at disk
speed; also packed by gzip, or the one text in a zip.

Read: separators space, tab, comma, semicolon; comment lines (``#``, ``%``) anywhere; before the first event a line
``width height`` (as E2VID's files have) and a line, perhaps a comment, that names the columns, also as faery writes it
(``t,x@640,y@480,on``); p as 0/1, -1/1 or True/False; t in the unit of its name. Two layouts are known without such a
line: the Event Camera Dataset's, in which every row has to fit, and that of OpenEB, which ``%geometry:`` marks.
Written: seconds with six decimals, or integer µs (exact both).
"""

from __future__ import annotations

import codecs
import contextlib
import gzip
import os
import re
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
from numba.extending import register_jitable

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import CheckedWriter, proposed_polarity
from blinkgl.io.reading import AS_FILE, Damage, EventReading, chosen
from blinkgl.io.tables import not_columns, slot_of, undeclared
from blinkgl.io.times import named_unit, overruled
from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Events
from blinkgl.types.numbers import is_number

_LONGEST_LINE = 1 << 16
_PLACES = {"t": 0, "x": 1, "y": 2, "p": 3, "_": 4}
"""Numbers of columns for the parser; 4 is ignored."""
_SHIFT = {"s": 6, "ms": 3, "us": 0, "ns": -3}
"""Decimal places from each unit of time to µs."""


_ECD = ("t", "x", "y", "p")
_ECD_ROW = re.compile(rb"\d+\.(\d+)[ \t,;]+\d+[ \t,;]+\d+[ \t,;]+[01]")
_ECD_PLACES = 6
"""The Event Camera Dataset's rows: seconds with a point, of which some have six places or more, x, y, 0 or 1."""
_SAMPLE_BYTES = 1 << 15
_NOT_A_ROW, _POLARITY, _LAYOUT, _BETWEEN = 1, 2, 3, 4
"""What is wrong with a line: no numbers of an event; another polarity; not the layout of the others; between pixels."""


class TextReader:
    """Reads events from text. height, width : px, None when the file does not give them.   unit : of the times.   notes
    : lines for the user.   unread : lines left out so far, with ``damaged="keep"``. Raises AssetError with the number
    of a line that is not an event, or which proposes the columns and the unit to declare."""

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        self.path, self._reading, self.notes, self.unread = Path(path), reading, [], 0
        self.height: int | None = None
        self.width: int | None = None
        self._start = self._lines = 0  # bytes and lines before the first event
        self._order: tuple[str, ...] = ()
        self._unit: str | None = None
        with self._open() as file:
            while line := file.readline(_LONGEST_LINE + 1):
                if len(line) > _LONGEST_LINE:
                    raise AssetError(
                        f"line {self._lines + 1} is longer than {_LONGEST_LINE} bytes",
                        where=str(path),
                        value=line[:40],
                    )
                if self._begins_events(line):
                    self._start += 3 if line.startswith(codecs.BOM_UTF8) else 0
                    break
                self._start, self._lines = file.tell(), self._lines + 1
            file.seek(self._start)
            head = file.read(_SAMPLE_BYTES)
        # A last line without its newline may be cut; a single line counts.
        rows = head.split(b"\n")
        rows = rows[:-1] if len(rows) > 1 else rows
        rows = [row.strip() for row in rows if row.strip() and row.lstrip()[:1] not in (b"#", b"%")]
        if reading.columns and not reading.named:
            if self._order and self._order != tuple(reading.columns[: len(self._order)]):
                named = ",".join(self._order)
                self.notes.append(f"the heading names the columns {named}; --columns is used")
            self._order = reading.columns
        elif reading.named and not set("txyp") <= set(self._order):
            raise AssetError(
                "no heading with these names", where=str(path), value=reading.columns, accepted="a heading"
            )
        self._ecd = self._is_ecd(rows)
        numbers = [row for row in map(_row, rows) if row]
        wide = len(numbers[0]) if numbers else 4
        self._sample = np.array([row for row in numbers if len(row) == wide], np.float64).reshape(-1, wide)
        self.unit = reading.time_unit or self._unit or ("s" if self._ecd else "")
        self.notes += overruled(self._unit, reading.time_unit)
        if numbers and not (self._order and self.unit):
            if not self._order:
                raise undeclared("no heading names the columns", str(path), self._sample)
            t = self._sample[:, min(self._order.index("t"), wide - 1)]
            raise undeclared("no unit of the times is stated", str(path), None, t)
        self._order, self.unit = self._order or _ECD, self.unit or "us"  # of a text without events

    def _begins_events(self, line: bytes) -> bool:
        """Return whether a line is an event; take what one before the events states."""
        text = line.decode("utf-8-sig", "replace").strip()
        comment = text[:1] in ("#", "%")
        # Two integers before the first event are the sensor's size.
        size = re.fullmatch(r"(\d{1,9})[ \t,;]+(\d{1,9})", text)
        openeb = re.fullmatch(r"%\s*geometry:\s*(\d{1,9}),(\d{1,9})", text)
        if (size_line := size or openeb) and self.width is None:
            self.width, self.height = int(size_line[1]), int(size_line[2])
            if openeb and not self._reading.columns:
                self._order, self._unit = ("x", "y", "p", "t"), "us"
                self.notes.append("read as OpenEB's CSV: x y p t, µs")
            return False
        if not text or not (comment or re.match(r"[\s,;\"]*(?!(nan|inf|true|false)\b)[a-z]", text, re.I)):
            return bool(text)
        if "\r" in text:
            raise AssetError(
                "lines that end with carriage returns alone",
                where=str(self.path),
                accepted="lines that end with newlines",
            )
        names = _names(text.lstrip("#% "))
        declared = {name.lower(): slot for slot, name in self._reading.named.items()}
        bare = [name.partition("@")[0] for name in names]
        slots = [declared.get(name) or slot_of(name) for name in bare]
        order = tuple("_" if s in self._reading.named and n not in declared else s for s, n in zip(slots, bare))
        # A comment is a heading only if each of its words names a column: other comments may contain such words.
        named = all(order.count(slot) == 1 for slot in "txyp") and not (comment and "_" in order)
        if not self._order and named:
            self._order, self._unit = order, self._heading(dict(zip(order, names)))
            self.notes += not_columns(name for name, slot in zip(names, order) if slot == "_" and name)
        elif not comment and not self._reading.columns:
            raise AssetError(
                f"line {self._lines + 1} is not an event, and not a heading that names t, x, y and p",
                where=str(self.path),
                value=text,
                accepted="a heading such as t x y p, or --columns",
            )
        return False

    def _is_ecd(self, rows: list[bytes]) -> bool:
        """Return whether rows that nothing describes are of the Event Camera Dataset's layout: the first ones here, all
        others when they are parsed."""
        matches = [_ECD_ROW.fullmatch(row) for row in rows]
        declared = self._order not in ((), _ECD) or self._unit or self._reading.time_unit
        if declared or None in matches or max((len(m[1]) for m in matches if m), default=0) < _ECD_PLACES:
            return False
        self._order = _ECD
        self.notes.append("read as the Event Camera Dataset's text: t x y p, seconds")
        return True

    @contextlib.contextmanager
    def _open(self) -> Iterator[BinaryIO]:
        """Give the file, unpacked. Raises AssetError: unreadable, several texts in a zip; Damage."""
        suffix = self.path.suffix.lower()
        try:
            with contextlib.ExitStack() as stack:
                if suffix == ".zip":
                    archive = stack.enter_context(zipfile.ZipFile(self.path))
                    # macOS adds a folder of its own with a file of attributes beside every file.
                    names = [n for n in archive.namelist() if not n.startswith("__MACOSX/")]
                    names = [n for n in names if n.lower().endswith((".txt", ".csv"))]
                    if not names:
                        raise AssetError("no text in the zip", where=str(self.path), value=archive.namelist()[:8])
                    name = names[chosen(self._reading.stream, names, str(self.path), "texts in the zip")]
                    yield cast(BinaryIO, stack.enter_context(archive.open(name)))
                else:
                    zipped = suffix == ".gz"
                    opened = gzip.open(self.path) if zipped else open(self.path, "rb")  # noqa: SIM115 - on the stack
                    yield cast(BinaryIO, stack.enter_context(opened))
        except (OSError, EOFError, zlib.error, zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
            reason = getattr(error, "strerror", None)
            raise (AssetError if reason else Damage)(f"cannot read: {reason or error}", where=str(self.path)) from error

    def _heading(self, names: dict[str, str]) -> str | None:
        """Return the unit that the name of t states; take the sizes that faery adds to the names of x and y."""
        sizes = [names[side].partition("@")[2] for side in "xy"]
        if all(size.isdecimal() and len(size) < 10 for size in sizes):
            self.width, self.height = map(int, sizes)
            return "us"
        return named_unit(names["t"])

    def chunks(self, size: int = 1 << 22) -> Iterator[Events]:
        """Yield all events, from about ``size`` bytes of text at a time."""
        places = np.array([_PLACES[slot] for slot in self._order])
        off, on = (int(v) for v in self._reading.polarity or (0, 1))
        # Undeclared, -1 is OFF, too, but not in the layout that has 0 and 1 alone.
        pair = np.array([off, on, off if self._reading.polarity or self._ecd else -1])
        self.unread = kept = 0
        with self._open() as file:
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
                n, bad, lost, why = _parse(
                    buffer, x, y, t, p, places, _SHIFT[self.unit], pair, self._reading.keep, self._ecd
                )
                self.unread, kept = self.unread + lost, kept + n
                if why:
                    raise self._refused(line + bad + 1, text.split(b"\n", bad + 1)[bad].decode("latin-1"), why)
                line += capacity
                if n:
                    yield Events(x[:n], y[:n], t[:n], p[:n])
                if not data:
                    break
        if self.unread and not kept:
            raise AssetError(
                "no line is an event", where=str(self.path), accepted=" ".join(self._order) + " (--columns)"
            )

    def _refused(self, line: int, value: str, why: int) -> AssetError:
        p = self._order.index("p")
        codes = proposed_polarity(self._sample[:, p : p + 1])
        order = " ".join(self._order)
        problem, accepted = {
            _NOT_A_ROW: ("is not an event", f"{order} (--columns)"),
            _POLARITY: ("has a polarity that is not known", f"0/1, -1/1 or True/False as {order}{codes}"),
            _LAYOUT: (
                "is not as the lines before it, the Event Camera Dataset's: seconds with a point, x, y, 0 or 1",
                "try --columns and --time-unit",
            ),
            _BETWEEN: ("is between pixels", "whole numbers: rectified events are no raw events"),
        }[why]
        kind = Damage if why == _NOT_A_ROW else AssetError
        return kind(f"line {line} {problem}", where=str(self.path), value=value, accepted=accepted)


def _names(heading: str) -> list[str]:
    """Return the names of columns; a first one without a name, as pandas' index, is empty."""
    names = [name.strip() for name in re.split(r"[,;\t]|\s+(?![\[(])", heading.lower().replace('"', ""))]
    return [name for k, name in enumerate(names) if name or (k == 0 and heading[0] in ",;")]


def _row(line: bytes) -> list[float] | None:
    """Return the numbers of a line; None: it is not of numbers alone."""
    words = re.split(rb"[ \t,;\r]+", line.strip())
    known = {"true": 1.0, "false": 0.0}
    texts = [word.decode("latin-1").lower() for word in words]
    return (
        [known[text] if text in known else float(text) for text in texts]
        if all(text in known or is_number(text) for text in texts)
        else None
    )


class TextWriter(CheckedWriter):
    """Writes ``t x y p``. ``separator`` "," makes a CSV that begins with a line of column names. write_unit : "s"
    writes seconds with six decimals, "us" integer µs; the CSV is then what faery writes and reads, with the sensor's
    size in its first line."""

    kind, limits = "text", (0, 1 << 62, "negative time")

    def __init__(
        self,
        path: str | os.PathLike,
        height: int | None,
        width: int | None,
        separator: str = " ",
        *,
        write_unit: str = "s",
    ):
        if write_unit not in ("s", "us"):
            raise EventDataError("unit of time", where=str(path), value=write_unit, accepted="s or us")
        super().__init__(path, height, width)
        self._separator, self._micro = ord(separator), write_unit == "us"
        with output_errors(path):
            self._file = open(path, "wb")  # noqa: SIM115 - closed by close/abort
            if separator == ",":
                sized = "t[us],x,y,on\n" if height is None else f"t,x@{width},y@{height},on\n"
                self._file.write((sized if self._micro else "t,x,y,p\n").encode())

    def _write(self, events: Events) -> None:
        # 13 digits of seconds, point, 6, two coordinates of 5, polarity, separators, newline
        buffer = np.empty(len(events) * 40, np.uint8)
        n = _print(events.x, events.y, events.t, events.p, self._separator, self._micro, buffer)
        self._file.write(buffer[:n].data)


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
        elif mantissa < 8 * 10**17:  # 18 or 19 digits; more are far below a µs once there is a point
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
        if value > 9 * 10**17:
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
def _separates(c):
    # Space, tab, comma, semicolon, carriage return.
    return c == 32 or c == 44 or c == 9 or c == 59 or c == 13


@kernel
def _word(buffer, i, place, pair):
    """Return (value, next index) of a field that is no number: an ignored one, or True and False. Next index -1:
    neither."""
    # Bit 5 makes a letter small; 116 is t, 102 f.
    letter = buffer[i] | 32
    if place != 4 and not (place == 3 and (letter == 116 or letter == 102)):
        return np.int64(0), -1
    while not (_separates(buffer[i]) or buffer[i] == 10):
        i += 1
    return pair[1 if letter == 116 else 0], i


@register_jitable
def _fields(buffer, i, values, places, shift, pair, ecd):
    """Parse the fields of the line that begins at ``i`` into ``values``. Return (their number, what is wrong, see
    :func:`_parse`, and where the parsing ended: at the line's end, if nothing is)."""
    field, wrong = 0, 0
    while buffer[i] != 10:
        c = buffer[i]
        if _separates(c):
            i += 1
            continue
        # The rest of a comment line is skipped.
        if (c == 35 or c == 37) and field == 0:
            while buffer[i] != 10:
                i += 1
            break
        if field == len(places):
            wrong = 1
            break
        place = places[field]
        field += 1
        begin = i
        mantissa, exponent, _, i = _number(buffer, i)
        c = buffer[i]
        if i < 0 or not (_separates(c) or c == 10):
            values[place], i = _word(buffer, begin, place, pair)
            if i < 0:
                # A word in the place of the polarity is a code of it.
                wrong, i = 2 if place == 3 else 1, begin
                break
            continue
        # A time without a point: the line is not of the Event Camera Dataset's layout.
        if ecd and place == 0 and exponent >= 0:
            wrong = 3
        # Times are multiplied by 10^shift: that makes microseconds.
        values[place], ok = _scaled(mantissa, exponent + (shift if place == 0 else 0))
        if not ok:
            wrong = 1
            break
        if place > 0 and place < 4 and exponent < 0 and values[place] * 10.0**-exponent != mantissa:
            # Coordinates between pixels are refused as well: rectified events are not raw events.
            wrong = 2 if place == 3 else 4
            break
    return field, wrong, i


@kernel
def _parse(buffer, x, y, t, p, places, shift, pair, keep, ecd):
    """Parse the events in complete lines. Return (count, index of the line that stops the reading, lines left out, what
    is wrong with that line; 0: nothing).

    places : what each field is, 0 t, 1 x, 2 y, 3 p, 4 ignored.   shift : decimal places from the unit of time to µs.
    pair : numbers of OFF, of ON, and another of OFF.   keep : go on after no row of numbers.   ecd : with points."""
    n, line, i, lost, values = 0, 0, 0, 0, np.zeros(5, np.int64)
    while i < len(buffer):
        field, wrong, i = _fields(buffer, i, values, places, shift, pair, ecd)
        if field != 0 or wrong:
            on = values[3] == pair[1]
            fits = field == len(places) and 0 <= values[1] <= 65535 and 0 <= values[2] <= 65535
            if wrong == 0 and fits and (on or values[3] == pair[0] or values[3] == pair[2]):
                if not on:
                    # 0 or -1: the first OFF of a file decides which.
                    pair[0] = pair[2] = values[3]
                t[n], x[n], y[n], p[n] = values[0], values[1], values[2], on
                n += 1
                i, line = i + 1, line + 1
                continue
            # A line that does not fit is no event (1), also where its time lacks a point (3). One that fits has an
            # unknown polarity (2), or another layout (3) where the layout has 0 and 1 alone.
            wrong = wrong if wrong and (fits or wrong != 3) else 1 if not fits else 3 if ecd else 2
            if not keep or wrong != 1:
                return n, line, lost, wrong
            lost += 1
            while buffer[i] != 10:
                i += 1
        i += 1
        line += 1
    return n, -1, lost, 0


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
            # 46 is a full stop, 48 the digit 0, 10 the end of a line.
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
