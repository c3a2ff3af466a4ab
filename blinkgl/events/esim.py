"""ESIM: events where log intensity, linear in time between frames, passes levels one contrast threshold apart.

Rebecq, Gehrig, Scaramuzza, "ESIM: an Open Event Camera Simulator", CoRL 2018, section 3. With L = ln(I + eps) and
the last level passed L_ref, a pixel fires ON at every L_ref + j C+ and OFF at every L_ref - j C- that L reaches in
the interval (t_prev, t], at the time where the straight line from L_prev to L meets the level, floored to the
microsecond. A level passed in the refractory period is lost (L_ref moves all the same).

C+ and C- belong to the pixel and are drawn once; with jitter each *event* draws the next ones, once. (Thresholds
redrawn at every frame lose events, the more the higher the frame rate.) Everything is integer arithmetic: logs in
2^-25 steps, times in ns, so references neither drift nor stick, however slow the ramp, and a brightness that
returns exactly passes exactly the same levels.

How it is fast: the logarithm and the comparison with both levels are branch-free loops over blocks that stay in
the first-level cache; the pixels that fire are then picked out of the block's flags, eight at a time, without branches on the data.
:mod:`blinkgl.events.reference` is the slow twin.
"""

from __future__ import annotations

import numba
import numpy as np
from numba.extending import register_jitable

from blinkgl.config.events import EsimConfig
from blinkgl.events.arith import Q_ONE, log_q25
from blinkgl.events.emulator import BLOCK, NEVER_NS, NO_CAP, Emulator
from blinkgl.events.packing import JIT, JIT_PARALLEL, T_SHIFT, compact_flags
from blinkgl.events.philox import Stream, normal2, pixel_counters
from blinkgl.events.types import Events

_ZERO, _I0, _FAR_BELOW = np.float32(0.0), np.int32(0), np.int32(-(2**31))
_U1000 = np.uint64(1000)
_JITTER = np.uint64(Stream.JITTER)
_LONG_NS = 2**31
MIN_THRESHOLD = 0.01


@numba.njit(**JIT)
def log_block(intensity, eps, out):
    """ln(intensity + eps) into ``out`` (int32, 2^-25); returns the largest bit pattern seen (see INTENSITY_LIMIT_BITS)."""
    worst = np.uint32(0)
    for i in range(intensity.size):
        value = np.float32(intensity[i] + _ZERO)  # -0.0 becomes +0.0
        worst = max(worst, value.view(np.uint32))
        out[i] = log_q25(np.float32(value + eps))
    return worst


@numba.njit(**JIT)
def lookup_block(codes, table, out):
    for i in range(codes.size):
        out[i] = table[codes[i]]


@numba.njit(**JIT)
def _flag_block(level, upper, lower, flags):
    """Flags (uint8) of the pixels at or beyond a level; returns how far the farthest is beyond (negative: none is)."""
    farthest = _FAR_BELOW
    for i in range(level.size):
        beyond = max(np.int32(level[i] - upper[i]), np.int32(lower[i] - level[i]))
        flags[i] = np.uint8(beyond >= _I0)
        farthest = max(farthest, beyond)
    return farthest


@numba.njit(**JIT)
def _sense_band(frame, codes, table, eps, start, stop, now, upper, lower, inverse_threshold, refractory_bound, active):
    """Log of the band's pixels, and the numbers of those that fire into ``active[start:]``.

    Returns (firing pixels, upper bound of their events, largest bit pattern of the intensities)."""
    count, bound, worst = 0, 0, np.uint32(0)
    flags, words_set = np.zeros(BLOCK, np.uint8), np.empty(BLOCK // 8, np.int64)
    for s in range(start, stop, BLOCK):
        e = min(s + BLOCK, stop)
        if e - s < BLOCK:
            flags[:] = 0
        if codes.size:
            lookup_block(codes[s:e], table, now[s:e])
        else:
            worst = max(worst, log_block(frame[s:e], eps, now[s:e]))
        farthest = _flag_block(now[s:e], upper[s:e], lower[s:e], flags)
        if farthest >= 0:
            found = compact_flags(flags, words_set, s, active[start + count:])
            count += found
            bound += found * min(np.int64(farthest * inverse_threshold) + 2, refractory_bound)
    return count, bound, worst


@numba.njit(**JIT)
def _fine_bound(active, start, count, now, upper, lower, inverse_threshold, refractory_bound):
    """The bound of :func:`_sense_band`, pixel by pixel."""
    bound = 0
    for j in range(start, start + count):
        i = active[j]
        beyond = max(np.int64(now[i]) - upper[i], np.int64(lower[i]) - now[i])
        bound += min(np.int64(beyond * inverse_threshold) + 2, refractory_bound)
    return bound


@register_jitable
def crossing_ns(part, whole, dt_ns):
    """floor(part / whole * dt_ns) for 0 <= part <= whole < 2^31, exactly, for any dt_ns < 2^52."""
    if dt_ns < _LONG_NS:
        return np.int64(np.uint64(part * dt_ns) // np.uint64(whole))
    high, low = dt_ns >> 20, dt_ns & 0xFFFFF  # schoolbook division, two digits
    quotient, rest = part * high // whole, part * high % whole
    return (quotient << 20) + ((rest << 20) + part * low) // whole


@numba.njit(**JIT)
def _emit_band(active, first, count, before, now, upper, lower, on, off, on_all, off_all, jitter, floor_on, floor_off, fired,
               last_ns, refractory_ns, seed, width, t0_ns, dt_ns, base_us, cap, packed, begin):
    """Events of the listed pixels into ``packed[begin:]``, in raster order; moves levels and pixel state.

    Returns (events emitted, events cut by ``cap``)."""
    out, cut = begin, 0
    y, row_end = np.int64(0), np.int64(0)
    start_ns = t0_ns - 1000 * base_us  # start of the interval after the microsecond base, 0 to 999
    for j in range(first, first + count):
        i = np.int64(active[j])
        if i >= row_end:
            y = i // width
            row_end = (y + 1) * width
        level, above, below = np.int64(now[i]), np.int64(upper[i]), np.int64(lower[i])
        whole = abs(level - before[i])
        polarity = np.int64(level >= above)
        gap = max(level - above, below - level)  # how far the signal ends beyond the level being passed
        pixel = (y << 17) | ((i - row_end + width) << 1) | polarity
        step_on, step_off = on_all, off_all
        if on.size:
            step_on, step_off = np.int64(on[i]), np.int64(off[i])
        up, down = step_on, step_off
        step = down + polarity * (up - down)
        emitted = 0
        while gap >= 0:
            after_ns = start_ns + crossing_ns(whole - gap, whole, dt_ns)
            alive = True
            if last_ns.size:
                alive = base_us * 1000 + after_ns - last_ns[i] >= refractory_ns
                if alive:
                    last_ns[i] = base_us * 1000 + after_ns
            if alive:
                if emitted < cap:
                    packed[out] = (np.int64(np.uint64(after_ns) // _U1000) << T_SHIFT) | pixel
                    out += 1
                    emitted += 1
                else:
                    cut += 1
            if fired.size:
                fired[i] += 1
                a, b = normal2(seed, np.uint64(i), _JITTER, np.uint64(fired[i]))
                up = max(floor_on, step_on + np.int64(np.floor(jitter * a + 0.5)))
                down = max(floor_off, step_off + np.int64(np.floor(jitter * b + 0.5)))
                step = down + polarity * (up - down)
            gap -= step
        passed = level - (2 * polarity - 1) * (gap + step)  # the last level passed: the new reference
        upper[i] = np.int32(passed + up)
        lower[i] = np.int32(passed - down)
    return out - begin, cut


@numba.njit(**JIT_PARALLEL)
def _sense_parallel(edges, frame, codes, table, eps, now, upper, lower, inverse_threshold, refractory_bound, active, report):
    for b in numba.prange(edges.size - 1):
        count, bound, worst = _sense_band(frame, codes, table, eps, edges[b], edges[b + 1], now, upper, lower,
                                          inverse_threshold, refractory_bound, active)
        report[b, 0], report[b, 1], report[b, 2] = count, bound, worst


@numba.njit(**JIT_PARALLEL)
def _emit_parallel(edges, counts, begins, active, before, now, upper, lower, on, off, on_all, off_all, jitter, floor_on,
                   floor_off, fired, last_ns, refractory_ns, seed, width, t0_ns, dt_ns, base_us, cap, packed, report):
    for b in numba.prange(edges.size - 1):
        emitted, cut = _emit_band(active, edges[b], counts[b], before, now, upper, lower, on, off, on_all, off_all, jitter,
                                  floor_on, floor_off, fired, last_ns, refractory_ns, seed, width, t0_ns, dt_ns, base_us,
                                  cap, packed, begins[b])
        report[b, 0], report[b, 1] = emitted, cut


def to_q25(value: float | np.ndarray) -> np.ndarray:
    """Log intensity in ln units as fixed point (int64)."""
    return np.floor(np.asarray(value, np.float64) * Q_ONE + 0.5).astype(np.int64)


def draw_thresholds(height: int, width: int, on: float, off: float, sigma: float, seed: np.uint64) -> tuple[np.ndarray, np.ndarray]:
    """Per-pixel (C+, C-), float64 (H*W,): normal around the nominal values, kept >= 0.01 and <= 10.

    For nominal thresholds under 0.02 the floor is half the nominal one.
    """
    a, b = normal2(seed, pixel_counters(height, width), np.uint64(Stream.THRESHOLD), np.uint64(0))
    clip = lambda c, n: np.clip(c + sigma * n, min(MIN_THRESHOLD, c / 2), 10.0)
    return clip(on, a), clip(off, b)


class Esim(Emulator):
    """See the module and :class:`~blinkgl.events.emulator.Emulator`. State: 12 bytes per pixel, 8 more each for
    spread thresholds (constant), the refractory period, and 4 for jitter, when these are on."""

    _state = ("_before", "_upper", "_lower", "_fired", "_last_ns")

    def __init__(self, height: int, width: int, config: EsimConfig | None = None, seed: int = 0):
        super().__init__(height, width, seed)
        self.config = config = config or EsimConfig()
        pixels = self.height * self.width
        on, off = config.contrast_threshold, config.contrast_threshold_off or config.contrast_threshold
        self._on_all, self._off_all = int(to_q25(on)), int(to_q25(off))
        self._on = self._off = np.empty(0, np.int32)
        if config.threshold_sigma:
            self._on, self._off = (to_q25(c).astype(np.int32) for c in
                                   draw_thresholds(height, width, on, off, config.threshold_sigma, self.seed))
        self._jitter = config.threshold_jitter * Q_ONE
        self._floor_on, self._floor_off = (int(to_q25(min(MIN_THRESHOLD, c / 2))) for c in (on, off))
        self._fired = np.zeros(pixels if config.threshold_jitter else 0, np.int32)
        self._refractory_ns = int(round(config.refractory_us * 1000))
        self._last_ns = np.full(pixels if self._refractory_ns else 0, NEVER_NS, np.int64)
        self._before, self._now, self._upper, self._lower = (np.zeros(pixels, np.int32) for _ in range(4))
        smallest = min(self._on_all, self._off_all)
        if config.threshold_sigma:
            smallest = int(min(self._on.min(), self._off.min()))
        if config.threshold_jitter:
            smallest = min(self._floor_on, self._floor_off)
        self._inverse_threshold = 1.0 / smallest
        self._eps = np.float32(config.log_eps)
        self._tables_changed()

    def _tables_changed(self) -> None:
        self._table = log_q25(self._decode + self._eps)

    def _start(self, frame: np.ndarray, t_ns: int) -> Events:
        if frame.dtype == np.uint8:
            lookup_block(frame, self._table, self._now)
        else:
            self._refuse_bad_intensity(frame, log_block(frame, self._eps, self._now))
        self._before, self._now = self._now, self._before
        up, down = (self._on, self._off) if self._on.size else (self._on_all, self._off_all)
        if self._fired.size:
            a, b = normal2(self.seed, pixel_counters(self.height, self.width), _JITTER, np.uint64(0))
            up = np.maximum(self._floor_on, up + np.floor(self._jitter * a + 0.5).astype(np.int64))
            down = np.maximum(self._floor_off, down + np.floor(self._jitter * b + 0.5).astype(np.int64))
        self._upper[...] = self._before + up
        self._lower[...] = self._before - down
        return Events.empty()

    def _advance(self, frame: np.ndarray, t_ns: int) -> Events:
        edges = self._band_edges()
        bands = len(edges) - 1
        codes, floats = (frame, _NO_FRAME) if frame.dtype == np.uint8 else (_NO_CODES, frame)
        dt_ns = t_ns - self.t_ns
        refractory_bound = dt_ns // self._refractory_ns + 2 if self._refractory_ns else 2**31
        report = np.zeros((bands, 3), np.int64)
        sense = (floats, codes, self._table, self._eps)
        levels = (self._now, self._upper, self._lower, self._inverse_threshold, refractory_bound, self._active)
        if bands == 1:
            report[0] = _sense_band(*sense, 0, len(frame), *levels)
        else:
            _sense_parallel(edges, *sense, *levels, report)
        counts, bounds = report[:, 0].copy(), report[:, 1].copy()
        if frame.dtype != np.uint8:
            self._refuse_bad_intensity(frame, int(report[:, 2].max()))

        active, bound = int(counts.sum()), int(bounds.sum())
        limit, cap = self.config.max_events_per_step, NO_CAP
        if bound > limit:  # the blocks' bound is generous: look again, pixel by pixel, before cutting anything
            bounds = np.array([_fine_bound(self._active, edge, count, *levels[:-1]) for edge, count in zip(edges, counts)])
            if bounds.sum() > limit:
                cap = max(1, limit // active)
                bounds = counts * cap
        begins = np.cumsum(bounds) - bounds
        packed = self._buffer.reserve(int(bounds.sum()))
        base_us = self.t_ns // 1000
        emit = (self._active, self._before, self._now, self._upper, self._lower, self._on, self._off, self._on_all, self._off_all,
                self._jitter, self._floor_on, self._floor_off, self._fired, self._last_ns, self._refractory_ns, self.seed,
                self.width, self.t_ns, dt_ns, base_us, cap, packed)
        if bands == 1:
            report[0, :2] = _emit_band(emit[0], 0, counts[0], *emit[1:], 0)
        else:
            _emit_parallel(edges, counts, begins, *emit, report)
        self.saturated += int(report[:, 1].sum())
        self._before, self._now = self._now, self._before
        return self._buffer.to_events(begins, report[:, 0].copy(), base_us, t_ns // 1000 - base_us)


_NO_CODES, _NO_FRAME = np.empty(0, np.uint8), np.empty(0, np.float32)
