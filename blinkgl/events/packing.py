"""Packed events: one int64 each, sorted by time, unpacked into columns.

Layout: ``(t_us - base_us) << 33 | y << 17 | x << 1 | p``. Kernels emit pixel by pixel in raster order, and the
sort is a stable radix sort on the time alone, so events of one microsecond come out in raster order, those of one
pixel in the order they fired: no tie depends on how the frame was cut into bands for the threads. Moving one
8-byte word per event is several times cheaper than moving four columns.
"""

from __future__ import annotations

import numba
import numpy as np

from blinkgl.events.types import Events

T_SHIFT = 33
MAX_INTERVAL_NS = (2**30 - 1) * 1000
"""Longest interval between two frames: 30 bits of microseconds (the word stays positive), 17 minutes."""
_SINGLE_PASS_BITS, _DIGIT_BITS = 14, 11

JIT = dict(nogil=True, cache=True, error_model="numpy", boundscheck=False)
JIT_PARALLEL = dict(parallel=True, **JIT)


@numba.njit(**JIT)
def _count_digits(packed, start, stop, shift, mask, histogram):
    histogram[:] = 0
    for i in range(start, stop):
        histogram[(packed[i] >> shift) & mask] += 1


@numba.njit(**JIT)
def _scatter(packed, start, stop, shift, mask, offsets, out):
    for i in range(start, stop):
        digit = (packed[i] >> shift) & mask
        out[offsets[digit]] = packed[i]
        offsets[digit] += 1


@numba.njit(**JIT)
def _histograms_to_offsets(histogram):
    """Exclusive prefix sum over (digit, band), in place: where each band writes its events of each digit."""
    total = 0
    for digit in range(histogram.shape[1]):
        for band in range(histogram.shape[0]):
            count = histogram[band, digit]
            histogram[band, digit] = total
            total += count


@numba.njit(**JIT)
def _unpack(packed, start, stop, base_us, x, y, t, p):
    word, xs, ys, ts, ps = packed[start:stop], x[start:stop], y[start:stop], t[start:stop], p[start:stop]
    for i in range(word.size):
        xs[i] = np.uint16((word[i] >> 1) & 0xFFFF)
        ys[i] = np.uint16((word[i] >> 17) & 0xFFFF)
        ts[i] = base_us + (word[i] >> T_SHIFT)
        ps[i] = np.uint8(word[i] & 1)


@numba.njit(**JIT)
def _sort_pass_serial(packed, starts, counts, shift, mask, histogram, out):
    for b in range(starts.size):
        _count_digits(packed, starts[b], starts[b] + counts[b], shift, mask, histogram[b])
    _histograms_to_offsets(histogram)
    for b in range(starts.size):
        _scatter(packed, starts[b], starts[b] + counts[b], shift, mask, histogram[b], out)


@numba.njit(**JIT_PARALLEL)
def _sort_pass_parallel(packed, starts, counts, shift, mask, histogram, out):
    for b in numba.prange(starts.size):
        _count_digits(packed, starts[b], starts[b] + counts[b], shift, mask, histogram[b])
    _histograms_to_offsets(histogram)
    for b in numba.prange(starts.size):
        _scatter(packed, starts[b], starts[b] + counts[b], shift, mask, histogram[b], out)


@numba.njit(**JIT_PARALLEL)
def _unpack_parallel(packed, total, base_us, bands, x, y, t, p):
    for b in numba.prange(bands):
        _unpack(packed, total * b // bands, total * (b + 1) // bands, base_us, x, y, t, p)


class PackedBuffer:
    """Scratch memory for one emulator's packed events; grows to the largest step seen, never with the clip."""

    def __init__(self) -> None:
        self._rows = np.empty((0, 0), np.int64)
        self._sorted = np.empty((2, 0), np.int64)
        self._histogram = np.empty(0, np.int64)

    def rows(self, bands: int, capacity: int) -> np.ndarray:
        """(bands, >= capacity) int64, one row per thread to emit into; keeps its size between steps."""
        if self._rows.shape[0] != bands or self._rows.shape[1] < capacity:
            self._rows = np.empty((bands, max(capacity, self._rows.size // bands, 1)), np.int64)
        return self._rows

    def grow(self, bands: int, capacity: int, filled: np.ndarray) -> None:
        """More room per row, keeping the first ``filled[b]`` events of each."""
        old, self._rows = self._rows, np.empty((bands, capacity), np.int64)
        for band in range(bands):
            self._rows[band, : filled[band]] = old[band, : filled[band]]

    def to_events(self, counts: np.ndarray, base_us: int, span_us: int) -> Events:
        """The events of ``rows[b, : counts[b]]``, sorted.

        counts : (B,) int64, events per row, rows in raster order.
        base_us, span_us : time of offset 0, and the largest offset that can occur.
        """
        total, bands = int(counts.sum()), len(counts)
        if total == 0:
            return Events.empty()
        bits = max(1, int(span_us).bit_length())
        digit_bits = bits if bits <= _SINGLE_PASS_BITS else _DIGIT_BITS
        if self._sorted.shape[1] < total:
            self._sorted = np.empty((2 if bits > digit_bits else 1, total + total // 4), np.int64)
        if len(self._sorted) < 2 and bits > digit_bits:
            self._sorted = np.empty((2, self._sorted.shape[1]), np.int64)
        if self._histogram.size < bands << digit_bits:
            self._histogram = np.empty(bands << digit_bits, np.int64)
        histogram = self._histogram[: bands << digit_bits].reshape(bands, 1 << digit_bits)
        sort_pass = _sort_pass_parallel if bands > 1 else _sort_pass_serial
        source, starts, counts = self._rows.reshape(-1), self._rows.shape[1] * np.arange(bands), counts
        for k, low in enumerate(range(0, bits, digit_bits)):
            target = self._sorted[k % 2]
            sort_pass(source, starts, counts, T_SHIFT + low, (1 << digit_bits) - 1, histogram, target)
            source, edges = target, total * np.arange(bands + 1) // bands  # contiguous from now on
            starts, counts = edges[:-1], np.diff(edges)
        x, y = np.empty(total, np.uint16), np.empty(total, np.uint16)
        t, p = np.empty(total, np.int64), np.empty(total, np.uint8)
        if bands > 1:
            _unpack_parallel(source, total, base_us, bands, x, y, t, p)
        else:
            _unpack(source, 0, total, base_us, x, y, t, p)
        return Events(x, y, t, p)
