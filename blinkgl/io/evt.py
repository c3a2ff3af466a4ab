"""Prophesee's EVT2, EVT2.1 (32- and 64-bit words, read only) and EVT3 (16-bit words), by numba kernels.

EVT2: type in bits 31..28 (0 OFF, 1 ON, 8 TIME_HIGH = t >> 6); t low 27..22, x 21..11, y 10..0.
EVT2.1: upper half as a word of EVT2, lower half a mask: bit k is an event at x + k. Sensors whose header says
"endianness=legacy" (IMX636) send the upper half first, each half little-endian.
EVT3: type in bits 15..12: 0 ADDR_Y, 2 ADDR_X (polarity bit 11), 3 VECT_BASE_X, 4 VECT_12, 5 VECT_8, 6 TIME_LOW (t &
0xfff), 8 TIME_HIGH (t >> 12 & 0xfff): 24 bits of µs, wrapping every 16.8 s.
(Prophesee, "EVT 2.0 / 2.1 / 3.0 format" pages.)

Like other encoders of a ready event list we write EVT3's single events only, no vectors; the reader knows both.
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

_WORD = {"evt2": np.dtype("<u4"), "evt21": np.dtype("<u8"), "evt3": np.dtype("<u2")}
_MAX_SIDE = 2048
_LONGEST_LINE = 4096
_MAX_TIME = 1 << 34
"""µs, 4.8 hours: the longest time that is filled with TIME_HIGH words."""


class EvtWriter:
    """Streams events into an EVT3 file with a header that names format and geometry.

    Raises EventDataError for times outside [0, 2^34) µs or out of order, and coordinates
    outside the sensor or the format's 11 bits.
    """

    def __init__(self, path: str | os.PathLike, height: int, width: int):
        if height > _MAX_SIDE or width > _MAX_SIDE:
            raise EventDataError(
                "EVT3 has 11-bit coordinates",
                where=str(path),
                value=(height, width),
                accepted="at most 2048 px a side",
            )
        self.path, self.height, self.width = Path(path), height, width
        # time written so far, and the row; -1: none yet
        self._state = np.array([0, -1], np.int64)
        self._count = 0
        header = (
            f"% evt 3.0\n% format EVT3;height={height};width={width}\n"
            f"% geometry {width}x{height}\n% integrator_name BlinkGL\n% end\n"
        )
        with output_errors(path):
            self._file = open(path, "wb")  # noqa: SIM115 - closed by close/abort
            self._file.write(header.encode())

    def append(self, events: Events) -> None:
        refuse_causes(events, "EVT3", str(self.path))
        if not len(events):
            return
        t = events.t
        if t[0] < 0 or t[-1] >= _MAX_TIME:
            raise EventDataError(
                "EVT3 times count from the recording's start",
                where=str(self.path),
                value=int(t[0] if t[0] < 0 else t[-1]),
                accepted="0 to less than 2^34 µs; use --zero-time to shift",
            )
        check_events(
            events, str(self.path), self._count, height=self.height, width=self.width, after=int(self._state[0])
        )
        # An event takes at most TIME_LOW, ADDR_Y and ADDR_X, and a TIME_HIGH for every 4096 us passed.
        words = np.empty(4 * len(t) + 2 + int((t[-1] >> 12) - (self._state[0] >> 12)), np.uint16)
        n = _encode_evt3(events.x, events.y, t, events.p, self._state, not self._count, words)
        self._count += len(t)
        with output_errors(self.path):
            self._file.write(words[:n].astype(_WORD["evt3"], copy=False).data)

    def close(self, t_end_us: int | None = None) -> None:
        with output_errors(self.path):
            self._file.close()

    def abort(self) -> None:
        try:
            self._file.close()
        except OSError:
            pass


class EvtReader:
    """Header and events of an EVT2/EVT2.1/EVT3 file. ``height`` and ``width`` are None when the header does not give
    them.

    As the format requires, events before the first TIME_HIGH have no time and are left out, and triggers and vendors'
    words are skipped.
    Raises AssetError: no ``% evt`` header, another version, an impossible size, stray bytes at the end (truncated), a
    word that the format does not have (with its byte), events but no TIME_HIGH."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
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
        check_size(self.height, self.width, str(path))

    def chunks(self, words: int = 1 << 17) -> Iterator[Events]:
        """Yield all events, decoded from ``words`` words at a time."""
        dtype = _WORD[self.version]
        # EVT2: time high, wraps.  EVT3: time high, y, low, vector base x, polarity, wraps.  -1: no time yet.  Last:
        # events without a time.
        state = np.array([-1, 0, 0, 0, 0, 0, 0] if self.version == "evt3" else [-1, 0, 0], np.int64)
        position = self._start
        # Words decode to at most so many events: a vector of EVT3 holds twelve.
        most = {"evt2": 1, "evt21": 32, "evt3": 12}[self.version]
        with open(self.path, "rb") as file:
            file.seek(self._start)
            # A file that ends within a word is truncated, which is said after its whole words.
            while data := file.read(words * dtype.itemsize):
                whole = len(data) // dtype.itemsize * dtype.itemsize
                raw = np.frombuffer(data[:whole], dtype)
                x, y, p = (
                    np.empty(most * len(raw), np.uint16),
                    np.empty(most * len(raw), np.uint16),
                    np.empty(most * len(raw), np.uint8),
                )
                t = np.empty(most * len(raw), np.int64)
                n, bad = self._decode(raw, state, x, y, t, p)
                if bad >= 0:
                    raise AssetError(
                        f"damaged at byte {position + bad * dtype.itemsize}: no valid {self.version.upper()} word",
                        where=str(self.path),
                        value=f"0x{int(raw[bad]):0{2 * dtype.itemsize}x}",
                    )
                position += whole
                if n:
                    yield Events(x[:n].copy(), y[:n].copy(), t[:n].copy(), p[:n].copy())
                if whole < len(data):
                    raise AssetError(
                        f"truncated: {len(data) - whole} stray bytes after the last {self.version.upper()} word",
                        where=str(self.path),
                    )
        if state[0] < 0 and state[-1]:
            raise AssetError(f"{state[-1]} events and no TIME_HIGH word, so no times", where=str(self.path))

    def _decode(self, raw, state, x, y, t, p) -> tuple[int, int]:
        if self.version == "evt3":
            return _decode_evt3(raw, state, x, y, t, p)
        if self.version == "evt2":
            return _decode_evt2(raw, np.ones(len(raw), np.uint32), state, x, y, t, p)
        upper, lower = (raw.view("<u4")[half::2].copy() for half in ((0, 1) if self._upper_first else (1, 0)))
        return _decode_evt2(upper, lower, state, x, y, t, p)


def _read_header(path: Path) -> tuple[str, int]:
    lines = []
    try:
        with open(path, "rb") as file:
            while True:
                start = file.tell()
                if file.read(1) != b"%":
                    break
                line = file.readline(_LONGEST_LINE)
                if line.startswith(b" ") and len(line) == _LONGEST_LINE:
                    raise AssetError(
                        f"header line {len(lines) + 1} is longer than {_LONGEST_LINE} bytes", where=str(path)
                    )
                if not line.startswith(b" ") or not line.endswith(b"\n"):
                    # The data begins here: this is a word whose first byte happens to be '%'.
                    break
                lines.append("%" + line.decode("latin-1").rstrip())
                if lines[-1] == "% end":
                    start = file.tell()
                    break
    except OSError as error:
        raise AssetError(f"cannot read: {error.strerror}", where=str(path)) from error
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
    n = 0
    time, row = state
    # TIME_HIGH 0.
    if first:
        words[0] = 0x8000
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
def _decode_evt3(words, state, x, y, t, p):
    """Decode words; return (events, index of the first word of an unknown type, or whose vector exceeds the 11 bits of
    x; -1: none)."""
    n, bad = 0, -1
    high, row, low, base, polarity, wraps, untimed = state
    for i in range(len(words)):
        word = np.int64(words[i])
        kind = word >> 12
        if kind == 0:
            row = word & 0x7FF
        elif kind == 2:
            # Before the first TIME_HIGH the time is unknown.
            if high < 0:
                untimed += 1
                continue
            x[n], y[n], p[n] = word & 0x7FF, row, (word >> 11) & 1
            t[n] = (((wraps << 12) | high) << 12) | low
            n += 1
        elif kind == 3:
            base, polarity = word & 0x7FF, (word >> 11) & 1
        elif kind == 4 or kind == 5:
            width = 12 if kind == 4 else 8
            # Bit k of a vector is the pixel base + k; the base then moves on by the vector's width.
            for k in range(width):
                if (word >> k) & 1:
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
            low = word & 0xFFF
        elif kind == 8:
            new = word & 0xFFF
            # The 12-bit counter fell by more than half of its range: it has wrapped.
            if high - new > 1 << 11:
                wraps += 1
            high = new
        elif kind != 7 and kind != 10 and kind < 14:  # 7, 15 continued, 10 external trigger, 14 others
            bad = i
            break
    state[0], state[1], state[2], state[3], state[4], state[5], state[6] = (
        high,
        row,
        low,
        base,
        polarity,
        wraps,
        untimed,
    )
    return n, bad
