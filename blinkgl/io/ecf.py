"""ECF, the codec of Prophesee's HDF5 event tables (HDF5 filter 36559, 0x8ECF): the events of one chunk, decoded.

All numbers are little endian. A chunk is u4 ``events << 2 | form``, the times, then by form

| form | x, y and polarity |
|---|---|
| 2 | y (11 bits), x (11), p of four events in three u4 |
| 1 | y in runs; x (11 bits), p of four events in three u2 |
| 0 | y in runs; x with masks; p in runs |

Times: the first as u8, then bytes ``later << 4 | count``: so many µs later (0 to 14) come so many events. Count 15: a
u2 with the number follows. Later 15: no events, the low half is four bits of a number of µs, the lowest bits first; the
byte that ends the number adds its own.
Runs of y: u2 ``y << 5 | count``, count 31: a u2 with the number follows. Of p: bytes ``p << 7 | count``, count 127: a
u2 with the number follows.
x with masks: u2 ``x << 5 | mask``: events at x, and for each bit from bit 4 down at x + 1 to x + 5.
Four values a, b, c, d of 3 s bits in three words of 4 s: ``a << s | b % 2^s``, ``b >> s << 2 s | c % 2^2s`` and
``c >> 2 s << 3 s | d``.

(Prophesee, hdf5_ecf, whose plugin writes what is read here: tests/io/test_ecf.py.)
"""

from __future__ import annotations

import numba
import numpy as np

from blinkgl.errors import AssetError

FILTER = 0x8ECF
MAX_EVENTS = 65535
"""of one chunk: the longest run that can be written."""
_HEADER = 12
_FORMS = 3
# y: 11 bits and 5 of count in a u2; p: 1 bit and 7 of count in a byte.
_ROWS, _SIGNS = (5, 2), (7, 1)
"""Of runs: bits of the count, and bytes of count and value together."""


def decode(data: bytes, most: int, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """x, y (uint16), t (int64 µs), p (uint8) of a chunk of at most ``most`` events.

    Raises AssetError: truncated, bytes left over, more events than that, a form that ECF does not have, runs that do
    not end with the events."""
    # events << 2 | form.
    count, form = divmod(int.from_bytes(data[:4], "little"), 4)
    if form >= _FORMS:
        raise AssetError("damaged: an ECF chunk of an unknown form", where=where, value=form, accepted="0 to 2")
    if count > min(most, MAX_EVENTS):
        raise AssetError(
            "damaged: an ECF chunk of too many events", where=where, value=count, accepted=f"at most {most}"
        )
    raw = np.frombuffer(data, np.uint8)
    x, y, p = np.empty(count, np.uint16), np.empty(count, np.uint16), np.empty(count, np.uint8)
    t = np.empty(count, np.uint64)
    at = -1
    if len(raw) >= _HEADER:
        # The first time is a u8 right behind the header's u4.
        start = np.frombuffer(data, "<u8", 1, 4).astype(np.uint64)[0]
        at = _decode_times(raw, _HEADER, start, t)
    if form == 2:
        v, at = _three_to_four(raw, at, 8, "<u4", count)
        x[:], y[:], p[:] = v >> 1 & 0x7FF, v >> 12 & 0x7FF, v & 1
    else:
        at = _decode_runs(raw, at, *_ROWS, y)
        if form == 1:
            v, at = _three_to_four(raw, at, 4, "<u2", count)
            x[:], p[:] = v >> 1, v & 1
        else:
            at = _decode_columns(raw, at, x)
            at = _decode_runs(raw, at, *_SIGNS, p)
    if at != len(raw):
        raise AssetError(
            "damaged: an ECF chunk that is truncated, or whose runs do not add up to its events"
            if at < 0
            else f"damaged: an ECF chunk with {len(raw) - at} bytes after its last event",
            where=where,
            value=f"{len(raw)} bytes for {count} events",
        )
    return x, y, t.view(np.int64), p


def _three_to_four(raw: np.ndarray, at: int, s: int, word: str, count: int) -> tuple[np.ndarray, int]:
    """Return ``count`` values and where they end; -1 where they do not fit or ``at`` is -1 already."""
    groups = -(-count // 4)
    end = at + groups * 3 * np.dtype(word).itemsize
    if at < 0 or end > len(raw):
        return np.zeros(count, np.int64), -1
    w = raw[at:end].tobytes()
    w = np.frombuffer(w, word).astype(np.int64).reshape(groups, 3)
    low = [w[:, k] & (1 << (k + 1) * s) - 1 for k in range(3)]
    high = [w[:, k] >> (k + 1) * s for k in range(3)]
    v = np.stack([high[0], low[0] | high[1] << s, low[1] | high[2] << 2 * s, low[2]], 1)
    return v.reshape(-1)[:count], end


@numba.njit(cache=True, nogil=True)
def _decode_times(raw, at, start, t):
    """Fill t and return the byte after the times, -1 where they do not fit."""
    i, now, step, shift = 0, start, np.uint64(0), np.uint64(0)
    while i < len(t):
        if at >= len(raw):
            return -1
        later, count = raw[at] >> 4, np.int64(raw[at] & 15)
        at += 1
        # Four more bits of the step; more than 64 are damage.
        if later == 15:
            if shift > np.uint64(60):
                return -1
            step |= np.uint64(count) << shift
            shift += np.uint64(4)
            continue
        if count == 15:
            count = _number(raw, at, 2)
            at += 2
        # Runs must end with the events.
        if count < 0 or count > len(t) - i:
            return -1
        now += step + np.uint64(later)
        step, shift = np.uint64(0), np.uint64(0)
        for _ in range(count):
            t[i] = now
            i += 1
    return at


@numba.njit(cache=True, nogil=True)
def _number(raw, at, size):
    """Return the number in ``size`` bytes, -1 where there are fewer."""
    if at < 0 or at + size > len(raw):
        return -1
    number = 0
    for k in range(size):
        number |= np.int64(raw[at + k]) << 8 * k
    return number


@numba.njit(cache=True, nogil=True)
def _decode_runs(raw, at, bits, size, values):
    """Fill ``values`` from runs, ``value << bits | count`` in ``size`` bytes each. Return the byte after them, -1 where
    they do not fit."""
    most, i = (1 << bits) - 1, 0
    while i < len(values):
        head = _number(raw, at, size)
        if head < 0:
            return -1
        at += size
        count = head & most
        if count == most:
            count = _number(raw, at, 2)
            at += 2
        if count < 0 or count > len(values) - i:
            return -1
        for _ in range(count):
            values[i] = head >> bits
            i += 1
    return at


@numba.njit(cache=True, nogil=True)
def _decode_columns(raw, at, x):
    i = 0
    while i < len(x):
        word = _number(raw, at, 2)
        if word < 0:
            return -1
        at += 2
        x[i] = word >> 5
        i += 1
        # Prophesee's encoder looks past the last event: the last mask may have more bits than there are events.
        for k in range(1, 6):
            if i < len(x) and word >> (5 - k) & 1:
                x[i] = (word >> 5) + k
                i += 1
    return at
