"""Prophesee's EVT2, EVT2.1 (32- and 64-bit words, read only) and EVT3 (16-bit words), by numba kernels.

EVT2: type in bits 31..28 (0 OFF, 1 ON, 8 TIME_HIGH = t >> 6); t low 27..22, x 21..11, y 10..0.
EVT2.1: upper half as a word of EVT2, lower half a mask: bit k is an event at x + k. Sensors whose header says
"endianness=legacy" (IMX636) send the upper half first, each half little-endian.
EVT3: type in bits 15..12: 0 ADDR_Y, 1 ADDR_Y of events that are no contrast changes (left out until the next ADDR_Y), 2
ADDR_X (polarity bit 11), 3 VECT_BASE_X, 4 VECT_12, 5 VECT_8, 6 TIME_LOW (t & 0xfff), 8 TIME_HIGH (t >> 12 & 0xfff): 24
bits of µs, wrapping every 16.8 s.
(Prophesee, "EVT 2.0 / 2.1 / 3.0 format" pages.)

Like other encoders of a ready event list we write EVT3's single events only, no vectors; the reader knows both.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import CheckedWriter
from blinkgl.io.fixed_records import read_records
from blinkgl.io.reading import AS_FILE, EventReading
from blinkgl.io.records import input_errors
from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Events

_WORD = {"evt2": np.dtype("<u4"), "evt21": np.dtype("<u8"), "evt3": np.dtype("<u2")}
_MAX_SIDE = 2048
_LONGEST_LINE = 4096
_MAX_TIME = 1 << 34
"""µs, 4.8 hours: the longest time that is filled with TIME_HIGH words."""


class EvtWriter(CheckedWriter):
    """Streams events into an EVT3 file with a header that names format and geometry.

    Raises EventDataError for times outside [0, 2^34) µs or out of order, and coordinates
    outside the sensor or the format's 11 bits.
    """

    kind, limits = "EVT3", (0, _MAX_TIME, "EVT3 times count from the recording's start; --zero-time shifts them")

    def __init__(self, path: str | os.PathLike, height: int | None, width: int | None):
        if max(height or 0, width or 0) > _MAX_SIDE:
            raise EventDataError(
                "EVT3 has 11-bit coordinates",
                where=str(path),
                value=(height, width),
                accepted="at most 2048 px a side",
            )
        super().__init__(path, height, width)
        # time written so far, and the row; -1: none yet
        self._state = np.array([0, -1], np.int64)
        known = height is not None and width is not None
        size, geometry = (f";height={height};width={width}", f"% geometry {width}x{height}\n") if known else ("", "")
        header = f"% evt 3.0\n% format EVT3{size}\n{geometry}% integrator_name BlinkGL\n% end\n"
        with output_errors(path):
            self._file = open(path, "wb")  # noqa: SIM115 - closed by close/abort
            self._file.write(header.encode())

    def _write(self, events: Events) -> None:
        # An event takes at most TIME_LOW, ADDR_Y and ADDR_X, and a TIME_HIGH for every 4096 us passed.
        t = events.t
        words = np.empty(4 * len(t) + 2 + int((t[-1] >> 12) - (self._state[0] >> 12)), np.uint16)
        n = _encode_evt3(events.x, events.y, t, events.p, self._state, not self.count, words)
        self._file.write(words[:n].astype(_WORD["evt3"], copy=False).data)


class EvtReader:
    """Header and events of an EVT2/EVT2.1/EVT3 file. ``height`` and ``width`` are None when the header does not give
    them.

    Events before the first TIME_HIGH have no time: they are left out, and ``notes`` counts them. Triggers and vendors'
    words are skipped. With ``damaged="keep"`` words that the format does not have are skipped, too, and counted.
    Raises AssetError: no ``% evt`` header, another version, an impossible size, stray bytes at the end (truncated), a
    word that the format does not have (with its byte), events but no TIME_HIGH."""

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        self.path, self._keep, self.notes = Path(path), reading.keep, []
        self._mend = reading.keep or reading.sort
        header, self._start = _read_header(self.path)
        # Either line of the header names the version.
        version = re.search(r"^% evt (\d+\.?\d*)", header, re.M) or re.search(r"^% format EVT(\d+)", header, re.M)
        if not version:
            raise AssetError("not an EVT file: header without '% evt'", where=str(path))
        self.version = "evt" + version.group(1).removesuffix(".0").replace(".", "")
        if self.version not in _WORD:
            raise AssetError("unsupported EVT version", where=str(path), value=version.group(1), accepted="2, 2.1 or 3")
        self._upper_first = "endianness=legacy" in header
        geometry = re.search(r"^% geometry (\d{1,9})x(\d{1,9})\b", header, re.M)
        sizes = {k: re.search(rf"{k}=(\d{{1,9}})\b", header) for k in ("height", "width")}
        self.height = int(geometry.group(2)) if geometry else int(sizes["height"].group(1)) if sizes["height"] else None
        self.width = int(geometry.group(1)) if geometry else int(sizes["width"].group(1)) if sizes["width"] else None

    def chunks(self, words: int = 1 << 17) -> Iterator[Events]:
        """Yield all events, decoded from ``words`` words at a time."""
        dtype, state = _WORD[self.version], START[self.version].copy()
        name, lost = self.version.upper(), 0
        buffers = room(self.version, words)  # one for all pieces: fresh memory costs as much as decoding
        try:
            for first, raw in read_records(self.path, self._start, dtype, words, lambda _: f"the last {name} word"):
                events, bad = self._decode(raw, state, buffers)
                while bad >= 0 and self._keep:
                    # The bad word is skipped, and the words after it are decoded with the state as it is.
                    first, raw, lost = first + bad + 1, raw[bad + 1 :], lost + 1
                    more, bad = self._decode(raw, state, buffers)
                    events = Events.concatenate([events, more])
                if bad >= 0:
                    raise AssetError(
                        f"damaged at byte {self._start + (first + bad) * dtype.itemsize}: no valid {name} word",
                        where=str(self.path),
                        value=f"0x{int(raw[bad]):0{2 * dtype.itemsize}x}",
                    )
                if len(events):
                    yield events
        finally:
            # The state's last entries, see START: TIME_HIGH words that were missing (EVT3 only), and events
            # without a time.
            missing = state[-2] if self.version == "evt3" else 0
            said = (
                (lost, f"left out: words that {name} does not have: {lost:,}"),
                (missing, f"4096 µs counted for each of {missing:,} TIME_HIGH words that are missing"),
                (state[-1], f"left out: events before the first TIME_HIGH, which have no time: {state[-1]:,}"),
            )
            self.notes = [line for count, line in said if count]
        if state[0] < 0 and state[-1]:
            raise AssetError(f"{state[-1]} events and no TIME_HIGH word, so no times", where=str(self.path))

    def _decode(self, words: np.ndarray, state: np.ndarray, buffers: list[np.ndarray]) -> tuple[Events, int]:
        upper_first, mend = self._upper_first, self._mend
        return decode(self.version, words, state, upper_first=upper_first, mend=mend, buffers=buffers)


START = {
    "evt2": np.array([-1, 0, 0], np.int64),
    "evt21": np.array([-1, 0, 0], np.int64),
    "evt3": np.array([-1, 0, 0, 0, 0, 0, 0, 0], np.int64),
}
"""State of :func:`decode` before the first word. EVT2: time high (-1: none yet), wraps, events without a time. EVT3:
time high, y, low, vector base x, polarity, wraps, TIME_HIGH words that were missing, events without a time."""
_MOST = {"evt2": 1, "evt21": 32, "evt3": 12}
"""Events of a word: a vector of EVT3 holds twelve."""


def room(version: str, words: int) -> list[np.ndarray]:
    """Return arrays for x, y, t and p of all events that so many words may hold."""
    return [np.empty(_MOST[version] * words, kind) for kind in (np.uint16, np.uint16, np.int64, np.uint8)]


@functools.lru_cache(maxsize=2)
def _single(words: int) -> np.ndarray:
    """Return masks of one event a word."""
    return np.ones(words, np.uint32)


def decode(
    version: str,
    words: np.ndarray,
    state: np.ndarray,
    *,
    upper_first: bool = False,
    mend: bool = False,
    buffers: list[np.ndarray] | None = None,
) -> tuple[Events, int]:
    """Return the events of words, and the index of the first word that the format does not have (-1: none). state : of
    :data:`START`, kept up to date.   upper_first : order of the halves of EVT2.1.   mend : count a missing TIME_HIGH
    where EVT3's low bits begin again.   buffers : of :func:`room`, for as many words or more."""
    columns = buffers or room(version, len(words))
    if version == "evt3":
        n, bad = _decode_evt3(words, state, *columns, mend)
    elif version == "evt2":
        n, bad = _decode_evt2(words, _single(len(words)), state, *columns)
    else:
        # As 32-bit words in file order: the lower half comes first, unless the header says otherwise.
        upper, lower = (words.view("<u4")[half::2].copy() for half in ((0, 1) if upper_first else (1, 0)))
        n, bad = _decode_evt2(upper, lower, state, *columns)
    return Events(*(column[:n].copy() for column in columns)), bad


def _read_header(path: Path) -> tuple[str, int]:
    lines, start = [], 0
    with input_errors(path), open(path, "rb") as file:
        # A word of the data may begin with '%', too, but hardly goes on as a line.
        while (line := file.readline(_LONGEST_LINE)).startswith(b"% ") and lines[-1:] != ["% end"]:
            if len(line) == _LONGEST_LINE:
                raise AssetError(f"header line {len(lines) + 1} is longer than {_LONGEST_LINE} bytes", where=str(path))
            if not line.endswith(b"\n"):
                break
            lines.append(line.decode("latin-1").rstrip())
            start = file.tell()
    return "\n".join(lines), start


@kernel
def _decode_evt2(words, masks, state, x, y, t, p):
    """Decode words; return (events, index of the first word of an unknown type, or whose mask exceeds the 11 bits of x;
    -1: none).

    masks : bit k is an event at the word's x + k; of EVT2 that is 1."""
    n, bad = 0, -1
    high, wraps, untimed = state
    for i in range(len(words)):
        word = np.int64(words[i])
        kind = word >> 28
        if kind == 8:
            new = word & 0xFFFFFFF
            # The 28-bit counter fell by more than half of its range: it has wrapped.
            if high - new > 1 << 27:
                wraps += 1
            high = new
        elif kind <= 1:
            # Before the first TIME_HIGH the time is unknown.
            if high < 0:
                untimed += 1
                continue
            mask, column = np.int64(masks[i]), (word >> 11) & 0x7FF
            while mask:
                if mask & 1:
                    if column > 0x7FF:
                        bad = i
                        break
                    x[n], y[n], p[n] = column, word & 0x7FF, kind
                    # From the top: wraps, 28 bits of TIME_HIGH, 6 bits of the word itself.
                    t[n] = (((wraps << 28) | high) << 6) | ((word >> 22) & 63)
                    n += 1
                mask >>= 1
                column += 1
            if bad >= 0:
                break
        elif kind != 10 and kind < 14:  # 10 external trigger, 14 others, 15 continued
            bad = i
            break
    state[0], state[1], state[2] = high, wraps, untimed
    return n, bad


@kernel
def _encode_evt3(x, y, t, p, state, first, words):
    # Types in the upper four bits: 0x8000 TIME_HIGH, 0x6000 TIME_LOW, 0x2000 ADDR_X; ADDR_Y is 0, so its word
    # is the row.
    n = 0
    time, row = state
    # TIME_HIGH 0.
    if first:
        words[0] = 0x8000
        # -1 differs from every time, so that an event at time 0 gets its TIME_LOW.
        n, time = 1, -1
    for i in range(len(t)):
        if t[i] != time:
            # Every 4096 µs step is written: a reader counts the 24-bit counter's wraps by seeing it fall.
            # EVT3's time field counts on by itself in the reader; it must not miss a wrap.
            high = max(time, 0) >> 12
            while high < t[i] >> 12:
                high += 1
                words[n] = 0x8000 | (high & 0xFFF)
                n += 1
            words[n] = 0x6000 | (t[i] & 0xFFF)
            n += 1
            time = t[i]
        # ADDR_Y holds for all events until the next.
        if y[i] != row:
            row = y[i]
            words[n] = row
            n += 1
        words[n] = 0x2000 | (np.int64(p[i]) << 11) | np.int64(x[i])
        n += 1
    state[0], state[1] = time, row
    return n


@kernel
def _decode_evt3(words, state, x, y, t, p, mend):
    """Decode words; return (events, index of the first word of an unknown type, or whose vector exceeds the 11 bits of
    x; -1: none).

    mend : count a missing TIME_HIGH where the low bits begin again."""
    n, bad = 0, -1
    high, row, low, base, polarity, wraps, mended, untimed = state
    for i in range(len(words)):
        word = np.int64(words[i])
        kind = word >> 12
        if kind <= 1:
            # Type 1: the events that follow are no contrast changes; row -1 leaves them out.
            row = word & 0x7FF if kind == 0 else -1
        elif kind == 2:
            if row < 0:
                continue
            # Before the first TIME_HIGH the time is unknown.
            if high < 0:
                untimed += 1
                continue
            # The time, from the top: wraps, 12 bits of TIME_HIGH, 12 bits of TIME_LOW.
            x[n], y[n], p[n] = word & 0x7FF, row, (word >> 11) & 1
            t[n] = (((wraps << 12) | high) << 12) | low
            n += 1
        elif kind == 3:
            base, polarity = word & 0x7FF, (word >> 11) & 1
        elif kind == 4 or kind == 5:
            width = 12 if kind == 4 else 8
            # Bit k of a vector is the pixel base + k; the base then moves on by the vector's width.
            for k in range(width):
                if (word >> k) & 1 and row >= 0:
                    if base + k > 0x7FF:
                        bad = i
                        break
                    if high < 0:
                        untimed += 1
                        continue
                    x[n], y[n], p[n] = base + k, row, polarity
                    t[n] = (((wraps << 12) | high) << 12) | low
                    n += 1
            base += width
            if bad >= 0:
                break
        elif kind == 6:
            # The low bits began again without a new TIME_HIGH, which some writers and lost words leave out.
            if mend and low - (word & 0xFFF) > 1 << 11:
                wraps, high, mended = wraps + (high == 0xFFF), (high + 1) & 0xFFF, mended + 1
            low = word & 0xFFF
        elif kind == 8:
            new = word & 0xFFF
            # The 12-bit counter fell by half of its range or more: it has wrapped.
            if high - new >= 1 << 11:
                wraps += 1
            # A new TIME_HIGH begins its 4096 µs: the low bits of before belong to the block that has ended, and
            # TIME_LOW follows only with the next event that needs one. A repeated word changes nothing. (OpenEB)
            if new != max(high, 0):
                low = 0
            high = new
        elif kind != 7 and kind != 10 and kind < 14:  # 7, 15 continued, 10 external trigger, 14 others
            bad = i
            break
    state[0], state[1], state[2], state[3] = high, row, low, base
    state[4], state[5], state[6], state[7] = polarity, wraps, mended, untimed
    return n, bad
