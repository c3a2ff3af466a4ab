"""Prophesee's EVT2, EVT2.1, EVT4 (32- and 64-bit words, read only) and EVT3 (16-bit words), by numba kernels.

EVT2: type in bits 31..28 (0 OFF, 1 ON, 8 TIME_HIGH = t >> 6, 10 trigger); t low 27..22, x 21..11, y 10..0; of a trigger
channel 12..8, edge 0.
EVT2.1: upper half as a word of EVT2, lower half a mask: bit k is an event at x + k. Sensors of "endianness legacy"
(IMX636) send the upper half first, each half little-endian.
EVT4: as EVT2 with types 10 OFF, 11 ON, 12 and 13 vectors of these, whose mask is the next word, 14 TIME_HIGH, 9
trigger, 15 padding.
EVT3: type in bits 15..12: 0 ADDR_Y, 1 ADDR_Y of events that are no contrast changes (left out until the next ADDR_Y), 2
ADDR_X (polarity bit 11), 3 VECT_BASE_X, 4 VECT_12, 5 VECT_8, 6 TIME_LOW (t & 0xfff), 8 TIME_HIGH (t >> 12 & 0xfff), 10
trigger (channel 11..8, edge 0): 24 bits of µs, wrapping every 16.8 s. 0x9999 is the padding of Lucid's cameras.
(Prophesee, "EVT 2.0 / 2.1 / 3.0 format" pages; OpenEB's decoders and its reader of headers.)

Like other encoders of a ready event list we write EVT3's single events only, no vectors; the reader knows both.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numba.extending import register_jitable

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import CheckedWriter
from blinkgl.io.fixed_records import read_records
from blinkgl.io.reading import AS_FILE, Damage, EventReading, listed
from blinkgl.io.records import input_errors
from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Events

_WORD = {"evt2": np.dtype("<u4"), "evt21": np.dtype("<u8"), "evt3": np.dtype("<u2"), "evt4": np.dtype("<u4")}
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


_VGA, _HD = (480, 640), (720, 1280)
_SYSTEMS: dict[int, tuple[str, tuple[int, int]]] = {
    **dict.fromkeys((0x15, 0x1C, 0x17, 0x97, 0x19, 0x99, 0x1D, 0x23, 0x21, 0xA1, 0x22, 0xA2, 0x29), ("EVT2", _VGA)),
    **dict.fromkeys((0x1A, 0x1F, 0x27), ("EVT2", _HD)),
    **dict.fromkeys((0x1E, 0x2E, 0x30, 0x31, 0x32), ("EVT3", _HD)),
    0x28: ("EVT3", _VGA),
}
"""system_ID of Prophesee's cameras -> format and (height, width), for headers that state no more (OpenEB)."""
_NEWER_SYSTEM = 0x37
"""Prophesee's cameras before this system_ID send EVT2.1 with the upper half first."""
_VERSIONS = {
    "EVT2": "evt2", "EVT21": "evt21", "EVT3": "evt3", "EVT4": "evt4", "2.0": "evt2", "2.1": "evt21", "3.0": "evt3",
    "2": "evt2", "3": "evt3", "4.0": "evt4", "4": "evt4",
}  # fmt: skip
"""Values of the header's ``format`` and ``evt``."""
_UPPER_FIRST = {"legacy": True, "little": False}
"""Values of the header's ``endianness``."""


class EvtReader:
    """Header and events of an EVT2, EVT2.1, EVT3 or EVT4 file. ``height`` and ``width`` are None when the header does
    not give them.

    Events before the first TIME_HIGH have no time: they are left out, and ``notes`` counts them. ``triggers`` : (N, 3)
    int64 of those read so far, µs, channel and edge. Vendors' words are skipped. With ``damaged="keep"`` words that the
    format does not have are skipped, too, and counted.
    Raises AssetError: a header without a format, another format or order of bytes, sizes that contradict each other;
    Damage: stray bytes at the end (truncated), a word that the format does not have (with its byte), events but no
    TIME_HIGH."""

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        self.path, self._keep, self.notes = Path(path), reading.keep, []
        self._mend = reading.keep or reading.sort
        self.triggers = np.empty((0, 3), np.int64)
        header, self._start = _read_header(self.path)
        fields = dict(re.findall(r"^% (\w+)[ \t]+(\S.*?)[ \t]*$", header, re.M))
        name, *rest = fields.get("format", "").split(";")
        options = dict(part.split("=", 1) for part in rest if "=" in part)
        system = fields.get("system_ID", "")
        # A system_ID tells something only where no other integrator is named.
        prophesee = {fields.get(k, "Prophesee") for k in _INTEGRATORS} == {"Prophesee"}
        usual = _SYSTEMS.get(int(system)) if prophesee and system.isdecimal() and len(system) < 10 else None
        stated = name or fields.get("evt", "") or (usual[0] if usual else "")
        if not stated:
            raise AssetError(
                "not an EVT file: its header has neither '% evt' nor '% format', and no system_ID that says them",
                where=str(path),
                value=system or header[:40],
            )
        self.version = listed(_VERSIONS, stated, "unknown format of events", path, "EVT2, EVT21, EVT3, EVT4")
        order = options.get("endianness") or fields.get("endianness")
        old = prophesee and system.isdecimal() and 0 < int(system[:9]) < _NEWER_SYSTEM
        self._upper_first = old if order is None else listed(_UPPER_FIRST, order, "unknown endianness", path)
        self.height, self.width = self._size(fields, options) or (usual[1] if usual else (None, None))

    def _size(self, fields: dict[str, str], options: dict[str, str]) -> tuple[int, int] | None:
        """Return the (height, width) that ``geometry`` or ``format`` state."""
        stated = {"geometry": fields["geometry"]} if "geometry" in fields else {}
        if {"height", "width"} <= options.keys():
            stated["size in format"] = f"{options['width']}x{options['height']}"
        for what, size in stated.items():
            if not re.fullmatch(r"\d{1,9}x\d{1,9}", size):
                raise AssetError(f"unknown {what}", where=str(self.path), value=size, accepted="WIDTHxHEIGHT")
        if len(sizes := set(stated.values())) > 1:
            raise AssetError(
                "geometry and format state different sizes",
                where=str(self.path),
                value=sorted(sizes),
                accepted="one size",
            )
        width, _, height = sizes.pop().partition("x") if sizes else ("", "", "")
        return (int(height), int(width)) if height else None

    def chunks(self, words: int = 1 << 17) -> Iterator[Events]:
        """Yield all events, decoded from ``words`` words at a time."""
        dtype, state = _WORD[self.version], START.copy()
        name, lost, triggers = self.version.upper(), 0, []
        # One room for all pieces: fresh memory costs as much as decoding.
        options: dict[str, Any] = {"upper_first": self._upper_first, "mend": self._mend}
        options |= {"buffers": room(self.version, words), "triggers": triggers}
        try:
            for first, raw in read_records(self.path, self._start, dtype, words, lambda _: f"the last {name} word"):
                events, bad = decode(self.version, raw, state, **options)
                while bad >= 0 and self._keep:
                    # The bad word is skipped, and the words after it are decoded with the state as it is.
                    first, raw, lost = first + bad + 1, raw[bad + 1 :], lost + 1
                    more, bad = decode(self.version, raw, state, **options)
                    events = Events.concatenate([events, more])
                if bad >= 0:
                    raise Damage(
                        f"damaged at byte {self._start + (first + bad) * dtype.itemsize}: no valid {name} word",
                        where=str(self.path),
                        value=f"0x{int(raw[bad]):0{2 * dtype.itemsize}x}",
                    )
                if len(events):
                    yield events
        finally:
            self.triggers = np.concatenate(triggers) if triggers else self.triggers[:0]
            lines = [f"left out: words that {name} does not have: {lost:,}"] if lost else []
            self.notes = lines + state_lines(state)
        if state[HIGH] < 0 and state[UNTIMED]:
            raise Damage(f"{state[UNTIMED]} events and no TIME_HIGH word, so no times", where=str(self.path))


_INTEGRATORS = ("integrator_name", "plugin_integrator_name", "camera_integrator_name")

HIGH, WRAPS, UNTIMED, TRIGGERS, OTHERS, MISSING, ROW, LOW, BASE, POLARITY, VECTOR = range(11)
"""Entries of a decoder's state: the last TIME_HIGH (-1: none yet), its wraps, events before it, triggers, events that
are no contrast changes, TIME_HIGH words that were missing; of EVT3 y, low bits of time, x and polarity of a vector; of
EVT4 the word of a vector whose mask is still to come (0: none)."""
START = np.array([-1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], np.int64)
"""State of :func:`decode` before the first word."""
_MOST = {"evt2": 1, "evt21": 32, "evt3": 12, "evt4": 32}
"""Events of a word: a vector of EVT3 holds twelve."""
_EVENT, _VECTOR, _TIME, _TRIGGER, _SKIPPED, _UNKNOWN = 0, 2, 4, 5, 6, 7
_EVT2_TYPES = {0: _EVENT, 1: _EVENT + 1, 8: _TIME, 10: _TRIGGER, 14: _SKIPPED, 15: _SKIPPED}
_EVT4_TYPES = {
    6: _SKIPPED, 7: _SKIPPED, 9: _TRIGGER, 10: _EVENT, 11: _EVENT + 1, 12: _VECTOR, 13: _VECTOR + 1, 14: _TIME,
    15: _SKIPPED,
}  # fmt: skip
"""Types of words: an event or a vector of OFF (ON is one more), TIME_HIGH, trigger; others, continued and padding."""
_KINDS = {
    version: np.array([types.get(kind, _UNKNOWN) for kind in range(16)])
    for version, types in (("evt2", _EVT2_TYPES), ("evt21", _EVT2_TYPES), ("evt4", _EVT4_TYPES))
}


def state_lines(state: np.ndarray) -> list[str]:
    """Return a line for each kind of words that a decoder left out or mended."""
    lines = (
        (state[MISSING], "4096 µs counted for each of {:,} TIME_HIGH words that are missing"),
        (state[UNTIMED], "left out: events before the first TIME_HIGH, which have no time: {:,}"),
        (state[OTHERS], "left out: events that are no contrast changes (ADDR_Y of type 1): {:,}"),
        (state[TRIGGERS], "{:,} triggers are no events: blinkgl convert --triggers FILE.csv writes them"),
    )
    return [line.format(count) for count, line in lines if count]


def room(version: str, words: int) -> list[np.ndarray]:
    """Return arrays for x, y, t and p of all events that so many words may hold, and (words, 3) for triggers."""
    columns = [np.empty(_MOST[version] * words, kind) for kind in (np.uint16, np.uint16, np.int64, np.uint8)]
    return [*columns, np.empty((words, 3), np.int64)]


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
    triggers: list[np.ndarray] | None = None,
) -> tuple[Events, int]:
    """Return the events of words, and the index of the first word that the format does not have (-1: none). state : of
    :data:`START`, kept up to date.   upper_first : order of the halves of EVT2.1.   mend : count a missing TIME_HIGH
    where EVT3's low bits begin again.   buffers : of :func:`room`, for as many words or more.
    triggers : to which those among the words are appended, (N, 3)."""
    columns, before = buffers or room(version, len(words)), state[TRIGGERS]
    if version == "evt3":
        n, bad = _decode_evt3(words, state, *columns, mend)
    else:
        upper, masks = words, _single(len(words))
        if version == "evt21":
            # As 32-bit words in file order: the lower half comes first, unless the header says otherwise.
            upper, masks = (words.view("<u4")[half::2].copy() for half in ((0, 1) if upper_first else (1, 0)))
        n, bad = _decode_evt2(upper, masks, state, *columns, _KINDS[version])
    if triggers is not None and state[TRIGGERS] > before:
        triggers.append(columns[4][: state[TRIGGERS] - before].copy())
    return Events(*(column[:n].copy() for column in columns[:4])), bad


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
def _decode_evt2(words, masks, state, x, y, t, p, triggers, kinds):
    """Decode words; return (events, index of the first word of an unknown type, or whose mask exceeds the 11 bits of x;
    -1: none).

    masks : bit k is an event at the word's x + k; of EVT2 that is 1.   kinds : what each type is, of _KINDS."""
    # Kinds: 0 and 1 an event, 2 and 3 a vector, 4 TIME_HIGH, 5 a trigger, 6 skipped, 7 unknown (_EVENT to _UNKNOWN).
    n, bad, seen = 0, -1, 0
    high, wraps, untimed, vector = state[0], state[1], state[2], state[10]
    for i in range(len(words)):
        word = np.int64(words[i])
        kind = kinds[word >> 28]
        if kind <= 1 or vector:
            mask = np.int64(masks[i])
            if vector:
                # EVT4: this word is the mask of the vector before it.
                mask, word, vector = word, vector, 0
                # Vectors of OFF and ON are two kinds above single events of OFF and ON.
                kind = kinds[word >> 28] - 2
            # Before the first TIME_HIGH the time is unknown.
            if high < 0:
                untimed += 1
                continue
            # Of the time, from the top: wraps, 28 bits of TIME_HIGH, 6 bits of the word itself.
            column, now = (word >> 11) & 0x7FF, (((wraps << 28) | high) << 6) | ((word >> 22) & 63)
            # A word of one event, as all of EVT2 are: no loop over the bits.
            if mask == 1:
                x[n], y[n], t[n], p[n] = column, word & 0x7FF, now, kind
                n += 1
                continue
            while mask:
                if mask & 1:
                    if column > 0x7FF:
                        bad = i
                        break
                    x[n], y[n], t[n], p[n] = column, word & 0x7FF, now, kind
                    n += 1
                mask >>= 1
                column += 1
            if bad >= 0:
                break
        elif kind == 4:
            new = word & 0xFFFFFFF
            # The 28-bit counter fell by more than half of its range: it has wrapped.
            if high - new > 1 << 27:
                wraps += 1
            high = new
        elif kind <= 3:
            # EVT4: the next word is the mask of this one.
            vector = word
        elif kind == 5:
            if high >= 0:
                # Bits 12..8 are the channel, bit 0 the edge.
                triggers[seen] = (((wraps << 28) | high) << 6) | ((word >> 22) & 63), (word >> 8) & 31, word & 1
                seen += 1
        elif kind == 7:
            bad = i
            break
    state[0], state[1], state[2], state[3], state[10] = high, wraps, untimed, state[3] + seen, vector
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


@register_jitable
def _time_high(new, high, low, wraps):
    """Return (TIME_HIGH, TIME_LOW, wraps) after a word TIME_HIGH of EVT 3."""
    # The 12-bit counter fell by half of its range or more: it has wrapped.
    if high - new >= 1 << 11:
        wraps += 1
    # A new TIME_HIGH begins its 4096 µs: the low bits of before belong to the block that has ended, and TIME_LOW
    # follows only with the next event that needs one. A repeated word changes nothing. (OpenEB)
    return new, low if new == max(high, 0) else 0, wraps


@kernel
def _decode_evt3(words, state, x, y, t, p, triggers, mend):
    """Decode words; return (events, index of the first word of an unknown type, or whose vector exceeds the 11 bits of
    x; -1: none).

    mend : count a missing TIME_HIGH where the low bits begin again."""
    n, bad = 0, -1
    high, wraps, untimed, before, others, mended, row, low, base, polarity, _ = state
    seen = before
    for i in range(len(words)):
        word = np.int64(words[i])
        kind = word >> 12
        if kind <= 1:
            # Type 1: the events that follow are no contrast changes; row -1 leaves them out.
            row = word & 0x7FF if kind == 0 else -1
        elif kind == 2:
            if row < 0:
                others += 1
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
                if not (word >> k) & 1:
                    continue
                if row < 0:
                    others += 1
                    continue
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
            if mend and high >= 0 and low - (word & 0xFFF) > 1 << 11:
                wraps, high, mended = wraps + (high == 0xFFF), (high + 1) & 0xFFF, mended + 1
            low = word & 0xFFF
        elif kind == 8:
            high, low, wraps = _time_high(word & 0xFFF, high, low, wraps)
        elif kind == 10:
            # Bits 11..8 are the channel, bit 0 the edge.
            if high >= 0:
                triggers[seen - before] = (((wraps << 12) | high) << 12) | low, (word >> 8) & 15, word & 1
                seen += 1
        elif kind != 7 and kind < 14 and word != 0x9999:  # 7, 15 continued, 14 others, 0x9999 Lucid's padding
            bad = i
            break
    state[0], state[1], state[2], state[3], state[4] = high, wraps, untimed, seen, others
    state[5], state[6], state[7], state[8], state[9] = mended, row, low, base, polarity
    return n, bad
