"""ECF, the codec of Prophesee's HDF5 event tables (HDF5 filter 36559, 0x8ECF): one chunk of events to bytes and back.

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

Which form is taken is the encoder's choice: here, of each chunk, the shortest. (Prophesee, hdf5_ecf, whose plugin reads
these bytes and writes what is read here: tests/io/test_ecf.py.)
"""

from __future__ import annotations

import numba
import numpy as np

from blinkgl.errors import AssetError

FILTER = 0x8ECF
MAX_SIDE = 2048
"""px: coordinates have 11 bits."""
MAX_EVENTS = 65535
"""of one chunk: the longest run that can be written."""
_HEADER = 12
_FORMS = 3
# y: 11 bits and 5 of count in a u2; p: 1 bit and 7 of count in a byte.
_ROWS, _SIGNS = (5, 2), (7, 1)
"""Of runs: bits of the count, and bytes of count and value together."""


def encode(x: np.ndarray, y: np.ndarray, t: np.ndarray, p: np.ndarray) -> bytes:
    """One chunk of at least one and at most :data:`MAX_EVENTS` events. x, y : below :data:`MAX_SIDE`. t : µs, int64,
    not decreasing. p : 0 or 1. The caller has checked them."""
    x, y, p = (np.ascontiguousarray(c, np.int64) for c in (x, y, p))
    t = np.ascontiguousarray(t, np.int64)
    # The longest entry is 16 bytes of a number, a count byte and the u2 that follows it.
    times = np.empty(20 * len(t), np.uint8)
    head = t[:1].astype("<i8").tobytes()
    # evlib 0.13.2 takes a small first time for the chunk's header, unless the fourth byte after it has bit 7.
    # Four times none of a number's bits mean nothing to a decoder, and have it.
    head += b"\xf0" * 4 if int(t[0]) % (1 << 32) < 1 << 18 else b""
    head += times[: _encode_times(t.view(np.uint64), times)].tobytes()
    # All three forms are made and the shortest is taken.
    wide = _four_in_three(y << 12 | x << 1 | p, 8, "<u4")
    words, runs = np.empty(len(t), np.uint16), np.empty(4 * len(t), np.uint8)
    rows = runs[: _encode_runs(y, *_ROWS, runs)].tobytes()
    narrow = rows + _four_in_three(x << 1 | p, 4, "<u2")
    masks = words[: _encode_columns(x, words)].astype("<u2").tobytes()
    masked = rows + masks + runs[: _encode_runs(p, *_SIGNS, runs)].tobytes()
    form, body = min(enumerate((masked, narrow, wide)), key=lambda one: len(one[1]))
    return np.array(len(t) << 2 | form, "<u4").tobytes() + head + body


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


def _four_in_three(values: np.ndarray, s: int, word: str) -> bytes:
    # Padded with zeros to a multiple of four.
    v = np.zeros((-(-len(values) // 4), 4), np.int64)
    v.reshape(-1)[: len(values)] = values
    # Each word has the high part of one value and the low part of the next.
    words = [(v[:, k] >> k * s) << (k + 1) * s | v[:, k + 1] & (1 << (k + 1) * s) - 1 for k in range(3)]
    return np.stack(words, 1).astype(word).tobytes()


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
def _encode_times(t, out):
    """t : (N,) uint64, so that differences of any two int64 fit. Returns bytes written."""
    n, i, now = 0, 0, t[0]
    while i < len(t):
        # Events of the same us are one byte.
        end = i + 1
        while end < len(t) and t[end] == t[i]:
            end += 1
        later, count = t[i] - now, end - i
        now = t[i]
        # Larger steps in groups of four bits, the lowest first, each with 15 in the high half.
        if later >= np.uint64(15):
            while later > np.uint64(0):
                out[n] = np.uint64(0xF0) | (later & np.uint64(15))
                later >>= np.uint64(4)
                n += 1
        out[n] = np.int64(later) << 4 | min(count, 15)
        n += 1
        if count >= 15:
            n = _put(out, n, count, 2)
        i = end
    return n


@numba.njit(cache=True, nogil=True)
def _put(out, n, number, size):
    for k in range(size):
        out[n + k] = number >> 8 * k & 0xFF
    return n + size


# Little endian.
@numba.njit(cache=True, nogil=True)
def _encode_runs(values, bits, size, out):
    """``value << bits | count`` in ``size`` bytes; a count that has no room is all ones there, and follows as u2."""
    most, n, i = (1 << bits) - 1, 0, 0
    while i < len(values):
        end = i + 1
        while end < len(values) and values[end] == values[i]:
            end += 1
        count = end - i
        n = _put(out, n, values[i] << bits | min(count, most), size)
        if count >= most:
            n = _put(out, n, count, 2)
        i = end
    return n


@numba.njit(cache=True, nogil=True)
def _encode_columns(x, out):
    n, i = 0, 0
    # Up to five neighbours to the right go into the mask.
    while i < len(x):
        base, mask = x[i], 0
        i += 1
        # Neighbours in order alone: a mask cannot say that x + 2 came before x + 1.
        for k in range(1, 6):
            if i < len(x) and x[i] == base + k:
                mask |= 1 << (5 - k)
                i += 1
        out[n] = base << 5 | mask
        n += 1
    return n


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
    """Fill ``values`` from what :func:`_encode_runs` wrote. Return the byte after them, -1 where they do not fit."""
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
