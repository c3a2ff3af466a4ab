"""Packed events: one int64 each, sorted by time, unpacked into columns.

Layout: ``(t_us - base_us) << 33 | y << 17 | x << 1 | p``. Kernels emit pixel by pixel in raster order, and the sort is
a stable radix sort by time only, so events of one microsecond are in raster order and those of one pixel in firing
order: the order does not depend on how the frame was divided among threads. Moving one 8-byte word per event is several
times cheaper than moving four columns.

Causes, if requested, use the two upper bits of y: a sensor then has at most 2^14 rows.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from blinkgl.events.threads import run, take_part
from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Cause, Events

# Bit 0: polarity; 1 to 16: x; 17 to 32: y; 33 and up: time. Causes: bits 31 and 32.
T_SHIFT = 33
CAUSE_SHIFT = 31
MAX_CAUSE_ROWS = 2**14
_SIGNAL, _LEAK, _SHOT = int(Cause.SIGNAL), int(Cause.LEAK), int(Cause.SHOT)
MAX_INTERVAL_NS = (2**30 - 1) * 1000
"""Longest interval between two frames: 30 bits of microseconds (the word stays positive), 17 minutes."""
# Times of up to 14 bits (16 ms) take one pass with 16384 counters.
_SINGLE_PASS_BITS, _DIGIT_BITS = 14, 11
_EVENTS_PER_THREAD, _PARTS_PER_THREAD = 2**15, 2
"""Smaller numbers of events are sorted in the time that another thread needs to wake up."""


@register_jitable
def cause_of(light: float, leak: float, noise: float) -> int:
    """Return the :class:`~blinkgl.types.events.Cause` of a crossing: that of the largest part."""
    # Parts are of the change in the event's own direction, so the largest one caused it.
    if light >= leak and light >= noise:
        return _SIGNAL
    return _LEAK if leak >= noise else _SHOT


# A radix sort from the lowest digit of the time up (Knuth, TAOCP 3, 5.2.5). Every pass keeps the order of equal digits,
# so what has been sorted by lower digits stays sorted, and the first pass keeps the raster order.


@kernel(error_model="numpy")
def _count_digits(packed, start, stop, shift, mask, histogram):
    for i in range(start, stop):
        histogram[(packed[i] >> shift) & mask] += 1


@kernel(error_model="numpy")
def _scatter(packed, start, stop, shift, mask, offsets, out):
    for i in range(start, stop):
        digit = (packed[i] >> shift) & mask
        # offsets: the next free place for this part's events with this digit.
        out[offsets[digit]] = packed[i]
        offsets[digit] += 1


@kernel(error_model="numpy")
def _histograms_to_offsets(histogram):
    """Replace counts by their exclusive prefix sum over (digit, band): where each band writes its events of each
    digit."""
    total = 0
    for digit in range(histogram.shape[1]):
        for band in range(histogram.shape[0]):
            count = histogram[band, digit]
            histogram[band, digit] = total
            total += count


@kernel(error_model="numpy")
def _unpack(packed, start, stop, base_us, x, y, t, p):
    # Slices that are indexed from 0: the loop then vectorises.
    word, xs, ys, ts, ps = packed[start:stop], x[start:stop], y[start:stop], t[start:stop], p[start:stop]
    for i in range(word.size):
        xs[i] = np.uint16((word[i] >> 1) & 0xFFFF)
        ys[i] = np.uint16((word[i] >> 17) & 0xFFFF)
        ts[i] = base_us + (word[i] >> T_SHIFT)
        ps[i] = np.uint8(word[i] & 1)


@kernel(error_model="numpy")
def _unpack_causes(packed, start, stop, y, cause):
    word, ys, causes = packed[start:stop], y[start:stop], cause[start:stop]
    for i in range(word.size):
        # With causes y has 14 bits.
        ys[i] = np.uint16((word[i] >> 17) & 0x3FFF)
        causes[i] = np.uint8((word[i] >> CAUSE_SHIFT) & 3)


# The three kernels below process parts of the events; each part is taken by the next free thread.


@kernel(error_model="numpy")
def _count_parts(taken, start, packed, starts, counts, first_row, shift, mask, histogram):
    # A part is a range of rows; its digits are counted in its own row of ``histogram``.
    part = take_part(taken, start)
    while part >= 0:
        histogram[part] = 0
        for row in range(first_row[part], first_row[part + 1]):
            _count_digits(packed, starts[row], starts[row] + counts[row], shift, mask, histogram[part])
        part = take_part(taken, start)


@kernel(error_model="numpy")
def _scatter_parts(taken, start, packed, starts, counts, first_row, shift, mask, offsets, out):
    # Every part has its own write positions, so threads never write to the same place.
    part = take_part(taken, start)
    while part >= 0:
        for row in range(first_row[part], first_row[part + 1]):
            _scatter(packed, starts[row], starts[row] + counts[row], shift, mask, offsets[part], out)
        part = take_part(taken, start)


@kernel(error_model="numpy")
# ``edges`` cut the sorted events into parts of about the same length.
def _unpack_parts(taken, start, packed, edges, base_us, x, y, t, p, cause):
    part = take_part(taken, start)
    while part >= 0:
        _unpack(packed, edges[part], edges[part + 1], base_us, x, y, t, p)
        if cause.size:
            _unpack_causes(packed, edges[part], edges[part + 1], y, cause)
        part = take_part(taken, start)


class PackedBuffer:
    """Scratch memory for one emulator's packed events; it grows to the largest step, not with the clip."""

    def __init__(self) -> None:
        self._rows = np.empty((0, 0), np.int64)
        self._sorted = np.empty((2, 0), np.int64)
        self._histogram = np.empty(0, np.int64)

    def rows(self, bands: int, capacity: int) -> np.ndarray:
        """Return (bands, >= capacity) int64, one row per band to emit into; its size is kept between steps."""
        if self._rows.shape[0] != bands or self._rows.shape[1] < capacity:
            self._rows = np.empty((bands, max(capacity, self._rows.size // bands, 1)), np.int64)
        return self._rows

    def grow(self, bands: int, capacity: int, filled: np.ndarray) -> None:
        """Enlarge the rows, keeping the first ``filled[b]`` events of each."""
        old, self._rows = self._rows, np.empty((bands, capacity), np.int64)
        for band in range(bands):
            self._rows[band, : filled[band]] = old[band, : filled[band]]

    def to_events(
        self, counts: np.ndarray, base_us: int, span_us: int, threads: int = 1, causes: bool = False
    ) -> Events:
        """Return the events of ``rows[b, : counts[b]]``, sorted.

        counts : (B,) int64, events per row, rows in raster order.
        base_us, span_us : time of offset 0, and the largest possible offset.
        threads : largest number; a few events are sorted by the calling one alone.
        causes : whether the words hold them.
        """
        total = int(counts.sum())
        if total == 0:
            return Events.empty()
        # Waking a thread takes longer than sorting a few thousand events.
        threads = max(1, min(threads, total // _EVENTS_PER_THREAD))
        parts = 1 if threads == 1 else min(_PARTS_PER_THREAD * threads, len(counts))
        # Short intervals take one pass; longer ones passes of 11 bits, whose 2048 counters and write positions stay in
        # the first-level cache.
        bits = max(1, int(span_us).bit_length())
        digit_bits = bits if bits <= _SINGLE_PASS_BITS else _DIGIT_BITS
        # A pass reads one buffer and writes the other. A quarter more, so that the next step fits.
        if self._sorted.shape[1] < total:
            self._sorted = np.empty((2 if bits > digit_bits else 1, total + total // 4), np.int64)
        if len(self._sorted) < 2 and bits > digit_bits:
            self._sorted = np.empty((2, self._sorted.shape[1]), np.int64)
        if self._histogram.size < parts << digit_bits:
            self._histogram = np.empty(parts << digit_bits, np.int64)
        histogram = self._histogram[: parts << digit_bits].reshape(parts, 1 << digit_bits)
        mask, edges = (1 << digit_bits) - 1, total * np.arange(parts + 1) // parts
        source, starts, first_row = (
            self._rows.reshape(-1),
            self._rows.shape[1] * np.arange(len(counts)),
            _even_split(counts, parts),
        )
        for k, low in enumerate(range(0, bits, digit_bits)):
            target, shift = self._sorted[k % 2], T_SHIFT + low
            run(_count_parts, parts, (source, starts, counts, first_row, shift, mask, histogram), threads)
            _histograms_to_offsets(histogram)
            run(_scatter_parts, parts, (source, starts, counts, first_row, shift, mask, histogram, target), threads)
            # Contiguous from now on.
            source, starts, counts, first_row = (target, edges[:-1], np.diff(edges), np.arange(parts + 1))
        return unpacked(source[:total], base_us, causes, edges, threads)


def unpacked(
    packed: np.ndarray, base_us: int, causes: bool = False, edges: np.ndarray | None = None, threads: int = 1
) -> Events:
    """Return the events of (N,) sorted int64 words.

    edges : (parts + 1,) int64, the part of each thread; None: one takes all.   causes : whether the words hold them."""
    total = len(packed)
    edges = np.array([0, total]) if edges is None else edges
    x, y = np.empty(total, np.uint16), np.empty(total, np.uint16)
    t, p = np.empty(total, np.int64), np.empty(total, np.uint8)
    cause = np.empty(total if causes else 0, np.uint8)
    run(_unpack_parts, len(edges) - 1, (packed, edges, base_us, x, y, t, p, cause), threads)
    return Events(x, y, t, p, cause if causes else None)


def _even_split(counts: np.ndarray, parts: int) -> np.ndarray:
    """Return the first row of each part and the end, (parts + 1,) int64, with about as many events in each part."""
    if parts == 1:
        return np.array([0, len(counts)])
    # Rows at which the running number of events reaches each part's share.
    inner = np.searchsorted(np.cumsum(counts), counts.sum() * np.arange(1, parts) / parts)
    return np.concatenate(([0], inner, [len(counts)]))


# ---------------------------------------------------------------------------------------------------------------------
# Branch-free loops over one block of pixels that several emulators share.
#
# They take slices and index them from 0: numba then vectorises them, which it does not with an offset in the index.


@kernel(error_model="numpy")
def copy_block(source: np.ndarray, target: np.ndarray) -> None:
    """Set ``target[:] = source``."""
    for i in range(source.size):
        target[i] = source[i]


@kernel(error_model="numpy")
def scale_block(frame: np.ndarray, scale: float, out: np.ndarray) -> None:
    """Set ``out[:] = frame * scale``."""
    for i in range(frame.size):
        out[i] = frame[i] * scale


@kernel(error_model="numpy")
def lookup_block(codes: np.ndarray, table: np.ndarray, out: np.ndarray) -> None:
    """Set ``out[:] = table[codes]``."""
    for i in range(codes.size):
        out[i] = table[codes[i]]


# The product of eight bytes of 0 or 1 with this constant has them as the bits of its top byte.
_BYTES_TO_BITS, _S56 = np.uint64(0x0102040810204080), np.uint64(56)
# Tables over all bytes: positions of the set bits, and their number.
_BIT_POSITIONS = np.zeros((256, 8), np.int32)
for _mask in range(256):
    _set = [_bit for _bit in range(8) if _mask >> _bit & 1]
    _BIT_POSITIONS[_mask, : len(_set)] = _set
_BIT_COUNTS = np.array([_mask.bit_count() for _mask in range(256)], np.int64)


@kernel(error_model="numpy")
def compact_flags(flags: np.ndarray, scratch: np.ndarray, first_pixel: int, out: np.ndarray) -> int:
    """Write the numbers ``first_pixel + i`` of the set flags to ``out``; return how many.

    flags : (n,) uint8 of 0 and 1, n a multiple of 8. scratch : (n / 8,) int64. out : int32 with room for 8 more than
    are set. Eight flags are one word, reduced to a byte by a multiplication and looked up: firing pixels are
    unpredictable, so a branch per pixel would cost several times more.
    """
    words = flags.view(np.uint64)
    used = 0
    # Numbers of the words with any flag, listed without a branch: always written, kept where the count
    # moves on.
    for k in range(words.size):
        scratch[used] = k
        used += np.int64(words[k] != np.uint64(0))
    count = 0
    for j in range(used):
        k = scratch[j]
        # Byte b of the (little-endian) word lands on bit b of the top byte.
        mask = np.int64((words[k] * _BYTES_TO_BITS) >> _S56)
        base = np.int32(first_pixel + 8 * k)
        # All eight places are written; only the set ones are counted, and the next word writes
        # over the rest.
        for b in range(8):
            out[count + b] = np.int32(base + _BIT_POSITIONS[mask, b])
        count += _BIT_COUNTS[mask]
    return count
