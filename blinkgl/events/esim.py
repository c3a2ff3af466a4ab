"""ESIM: events where log intensity passes levels one contrast threshold apart.

Rebecq, Gehrig, Scaramuzza, "ESIM: an Open Event Camera Simulator", CoRL 2018, section 3. With L = ln(I + eps) and
the last level passed L_ref, a pixel fires ON at every L_ref + j C+ and OFF at every L_ref - j C- that L reaches in
the interval (t_prev, t], at the time where the straight line from L_prev to L meets the level, floored to the
microsecond. A level passed in the refractory period is lost (L_ref moves all the same). Instead of the straight line
it may be a monotone cubic (:mod:`~blinkgl.events.curve`): the same levels at better times.
Only the pixels that fire solve it.

C+ and C- belong to the pixel and are drawn once; with jitter each *event* draws the next ones, once. (Thresholds
redrawn at every frame lose events, the more the higher the frame rate.) Everything is integer arithmetic: logs in
2^-25 steps, times in ns, so references neither drift nor stick, however slow the ramp, and a brightness that
returns exactly passes exactly the same levels.

How it is fast: the logarithm and the comparison with both levels are branch-free loops over blocks that stay in
the first-level cache; the pixels that fire are then picked out of the block's flags, eight at a time, without branches
on the data. ``tests/events/reference.py`` is the slow twin.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numba.extending import register_jitable

from blinkgl.config.events import EsimConfig
from blinkgl.events.arith import Q_ONE, log_q25
from blinkgl.events.blocks import compact_flags, copy_block, lookup_block
from blinkgl.events.curve import Curve, curve_time, end_slopes, limited, slope_block
from blinkgl.events.emulator import BLOCK, NEVER_NS, NO_CODES, NO_FRAME, NO_LOG, Emulator
from blinkgl.events.packing import JIT, T_SHIFT
from blinkgl.events.philox import Stream, normal2, pixel_counters
from blinkgl.events.response import Response, smallest_threshold
from blinkgl.events.table import register
from blinkgl.events.threads import take_part
from blinkgl.types.events import Events

# Typed constants: an int literal is int64 to numba and would widen the int32 loops. _FAR_BELOW is the
# least int32, the start of a maximum.
_I0, _FAR_BELOW = np.int32(0), np.int32(-(2**31))
_U1000 = np.uint64(1000)
_JITTER = np.uint64(Stream.JITTER)
# Intervals of this length or more take the long division of crossing_ns.
_LONG_NS = 2**31
# Smallest threshold in ln units that spread and jitter may draw.
MIN_THRESHOLD = 0.01


class Levels(NamedTuple):
    """Per-pixel arrays, flat; size 0 when the feature is off."""

    log: np.ndarray  # int32, 2^-25 ln units: log intensity of the frame before
    upper: np.ndarray  # int32: the next ON level
    lower: np.ndarray  # int32: the next OFF level
    on: np.ndarray  # int32 thresholds, constant; [] when all are alike
    off: np.ndarray
    fired: np.ndarray  # int32 number of levels passed, for the jitter's draws
    last_ns: np.ndarray  # int64 time of the last event, for the refractory period
    slope: np.ndarray  # float32, 2^-25 per ns: that of the log intensity at the frame before; hermite alone


class Interval(NamedTuple):
    """What is the same for all pixels of a step; thresholds in 2^-25 ln units."""

    t0_ns: int
    dt_ns: int
    base_us: int
    eps: np.float32
    on_all: int
    off_all: int
    jitter: float
    floor_on: int
    floor_off: int
    refractory_ns: int
    inverse_threshold: float
    bound_per_pixel: int
    seed: np.uint64
    width: int


@numba.njit(**JIT)
def log_block(intensity: np.ndarray, eps: float, out: np.ndarray) -> None:
    """ln(intensity + eps) into ``out``, int32, 2^-25."""
    # No branch and no call of libm in the loop, so that LLVM vectorises it.
    for i in range(intensity.size):
        out[i] = log_q25(np.float32(intensity[i] + eps))


@numba.njit(**JIT)
def _flag_block(level, upper, lower, flags):
    """Flag (uint8) the pixels at or beyond a level, and return how far the farthest is beyond (negative: none is)."""
    farthest = _FAR_BELOW
    for i in range(level.size):
        # The reference lies between the two levels, so at most one of them has been reached.
        beyond = max(np.int32(level[i] - upper[i]), np.int32(lower[i] - level[i]))
        flags[i] = np.uint8(beyond >= _I0)
        farthest = max(farthest, beyond)
    return farthest


@register_jitable
def crossing_ns(part: float, whole: float, dt_ns: int) -> int:
    """floor(part / whole * dt_ns) for 0 <= part <= whole < 2^31, exactly, for any dt_ns < 2^52."""
    # Both factors are below 2^31, so the product fits int64.
    if dt_ns < _LONG_NS:
        return np.int64(np.uint64(part * dt_ns) // np.uint64(whole))
    # Schoolbook division of part * dt by whole, dt as two digits of base 2^20: no product reaches 2^63.
    high, low = dt_ns >> 20, dt_ns & 0xFFFFF
    quotient, rest = part * high // whole, part * high % whole
    return (quotient << 20) + ((rest << 20) + part * low) // whole


@numba.njit(**JIT)
def _emit_block(active, count, first, now, p, v, cap, packed, begin, curve, slope):
    """Write the events of the listed pixels of one block to ``packed[begin:]``, in raster order, and move their
    levels.

    curve : None for the straight line (the branches on it are then not compiled).   slope : of the block, at the
    interval's end; [] where the curve takes its slopes from other frames.
    Returns (end of the events, events cut by ``cap``)."""
    out, cut = begin, 0
    # The listed pixels are in raster order, so the row is counted along instead of divided out.
    # ``row_end`` is the number of the first pixel behind row y.
    y = first // v.width
    row_end = (y + 1) * v.width
    # The interval's start after the microsecond base, 0 to 999.
    start_ns = v.t0_ns - 1000 * v.base_us
    for j in range(count):
        i = np.int64(active[j])
        while i >= row_end:
            y += 1
            row_end += v.width
        # Rebecq et al. 2018, section 3: the path goes from p.log[i] to ``level``, ``whole`` units. What of it lies
        # beyond the level that is being passed is ``gap``, so that level is met at the fraction (whole - gap) / whole
        # of a straight line.
        level, above, below = np.int64(now[i - first]), np.int64(p.upper[i]), np.int64(p.lower[i])
        whole = abs(level - p.log[i])
        polarity = np.int64(level >= above)
        # How far the signal ends beyond the level being passed.
        gap = max(level - above, below - level)
        # The packed word (packing.py) without its time.
        pixel = (y << 17) | ((i - row_end + v.width) << 1) | polarity
        # The pixel's own thresholds; ``up`` and ``down`` are those now in force, with jitter.
        step_on, step_off = (v.on_all, v.off_all)
        if p.on.size:
            step_on, step_off = np.int64(p.on[i]), np.int64(p.off[i])
        up, down = step_on, step_off
        step = down + polarity * (up - down)
        emitted = 0
        if curve is not None:
            # Slopes in units of the secant: a falling path becomes a rising one, and both are solved alike.
            before, s = np.int64(p.log[i]), 0.0
            if slope.size:
                secant = (level - before) / v.dt_ns
                alpha, beta = limited(p.slope[i] / secant), limited(slope[i - first] / secant)
            else:
                older = np.int64(curve.older[i]) if curve.older_ns > 0.0 else before
                newer = np.int64(curve.newer[i]) if curve.newer_ns > 0.0 else level
                alpha, beta = end_slopes(
                    older, before, level, newer, np.float64(v.dt_ns), curve.older_ns, curve.newer_ns
                )
        # One turn per level passed. All are of one polarity, since neither a line nor a monotone cubic turns back.
        while gap >= 0:
            if curve is None:
                after_ns = start_ns + crossing_ns(whole - gap, whole, v.dt_ns)
            else:
                s = curve_time((whole - gap) / whole, alpha, beta, s)
                after_ns = start_ns + np.int64(s * v.dt_ns)
            # In the refractory period the event is lost, but the reference moves all the same.
            alive = True
            if p.last_ns.size:
                alive = v.base_us * 1000 + after_ns - p.last_ns[i] >= v.refractory_ns
                if alive:
                    p.last_ns[i] = v.base_us * 1000 + after_ns
            if alive:
                # ``packed`` has room for ``cap`` events of each listed pixel; further ones are counted
                # only.
                if emitted < cap:
                    packed[out] = (np.int64(np.uint64(after_ns) // _U1000) << T_SHIFT) | pixel
                    out += 1
                    emitted += 1
                else:
                    cut += 1
            if p.fired.size:
                # The next thresholds, drawn once per level and numbered by the levels passed: how the path was cut into
                # frames has no part in it.
                p.fired[i] += 1
                a, b = normal2(v.seed, np.uint64(i), _JITTER, np.uint64(p.fired[i]))
                up = max(v.floor_on, step_on + np.int64(np.floor(v.jitter * a + 0.5)))
                down = max(v.floor_off, step_off + np.int64(np.floor(v.jitter * b + 0.5)))
                step = down + polarity * (up - down)
            gap -= step
        # The last level passed is the new reference.
        passed = level - (2 * polarity - 1) * (gap + step)
        p.upper[i] = np.int32(passed + up)
        p.lower[i] = np.int32(passed - down)
    return out, cut


@numba.njit(**JIT)
def _band(first_block, stop_block, share, packed, filled, frame, codes, table, p, v):
    """Process the blocks of a band, see :meth:`Emulator._run`."""
    # Scratch memory of one block. compact_flags writes eight numbers at a time, so ``active`` has eight
    # more.
    cut, pixels = 0, p.log.size
    flags, scratch = np.zeros(BLOCK, np.uint8), np.empty(BLOCK // 8, np.int64)
    active, now = np.empty(BLOCK + 8, np.int32), np.empty(BLOCK, np.int32)
    for block in range(first_block, stop_block):
        s = block * BLOCK
        e = min(s + BLOCK, pixels)
        n = e - s
        if n < BLOCK:
            # The last block is shorter, and compact_flags looks at whole words.
            flags[:] = 0
        # A uint8 frame needs 256 logarithms, which are in the table.
        if codes.size:
            lookup_block(codes[s:e], table, now[:n])
        else:
            log_block(frame[s:e], v.eps, now[:n])
        farthest = _flag_block(now[:n], p.upper[s:e], p.lower[s:e], flags)
        if farthest >= 0:
            count = compact_flags(flags, scratch, s, active)
            # As many events a pixel as levels fit between the first one and the farthest, rounded up; never more than
            # the block's share.
            cap = min(np.int64(farthest * v.inverse_threshold) + 2, v.bound_per_pixel)
            if count * cap > share:
                cap = max(1, share // count)
            # No room for the worst case; nothing of this block has been touched: the caller makes room and comes
            # back to it.
            if filled + count * cap > packed.size:
                return block, filled, cut
            filled, cut_here = _emit_block(active, count, s, now, p, v, cap, packed, filled, None, None)
            cut += cut_here
        # The copy comes last, because p.log is the previous frame until here.
        copy_block(now[:n], p.log[s:e])
    return stop_block, filled, cut


@numba.njit(**JIT)
def _bands(taken, start, edges, progress, share, packed, frame, codes, table, p, v):
    # A row of ``progress`` is a band: next block, events written, events cut. A thread takes bands
    # until none is left.
    b = take_part(taken, start)
    while b >= 0:
        block, filled, cut = _band(
            progress[b, 0], edges[b + 1], share, packed[b], progress[b, 1], frame, codes, table, p, v
        )
        progress[b, 0], progress[b, 1] = block, filled
        progress[b, 2] += cut
        b = take_part(taken, start)


@numba.njit(**JIT)
def _band_curve(
    first_block, stop_block, share, packed, filled, frame, codes, table, rate, decode, log_now, curve, p, v
):
    """Process a band with cubics instead of straight lines. With slopes (``rate`` given, per second): the interval
    up to ``frame``. Without: the interval up to ``log_now``; the frame that lies after it only goes into
    ``curve.newer``."""
    cut, pixels = 0, p.log.size
    flags, scratch = np.zeros(BLOCK, np.uint8), np.empty(BLOCK // 8, np.int64)
    active, fresh = np.empty(BLOCK + 8, np.int32), np.empty(BLOCK, np.int32)
    intensity, slopes = np.empty(BLOCK, np.float32), np.empty(BLOCK if rate.size else 0, np.float32)
    for block in range(first_block, stop_block):
        s = block * BLOCK
        e = min(s + BLOCK, pixels)
        n = e - s
        if n < BLOCK:
            # As in _band: compact_flags reads whole words of eight flags.
            flags[:] = 0
        if codes.size:
            lookup_block(codes[s:e], table, fresh[:n])
        elif frame.size:
            log_block(frame[s:e], v.eps, fresh[:n])
        now = fresh
        # hermite: the slope of the log intensity at the interval's end, from the rendered rate of
        # change.
        if rate.size:
            if codes.size:
                lookup_block(codes[s:e], decode, intensity[:n])
                slope_block(rate[s:e], intensity[:n], v.eps, slopes[:n])
            else:
                slope_block(rate[s:e], frame[s:e], v.eps, slopes[:n])
        else:
            # pchip: the frame just read lies one interval ahead and only gives a slope. The interval
            # ends at the logarithm that was taken one step before.
            if curve.newer_ns > 0.0:
                copy_block(fresh[:n], curve.newer[s:e])
            now = log_now[s:e]
        farthest = _flag_block(now[:n], p.upper[s:e], p.lower[s:e], flags)
        if farthest >= 0:
            count = compact_flags(flags, scratch, s, active)
            # The same room as in _band.
            cap = min(np.int64(farthest * v.inverse_threshold) + 2, v.bound_per_pixel)
            if count * cap > share:
                cap = max(1, share // count)
            if filled + count * cap > packed.size:
                return block, filled, cut
            filled, cut_here = _emit_block(active, count, s, now, p, v, cap, packed, filled, curve, slopes)
            cut += cut_here
        # With hermite the end of this interval is the start of the next one. With pchip the ring of
        # frames already holds it.
        if rate.size:
            copy_block(now[:n], p.log[s:e])
            copy_block(slopes[:n], p.slope[s:e])
    return stop_block, filled, cut


@numba.njit(**JIT)
def _bands_curve(taken, start, edges, progress, share, packed, frame, codes, table, rate, decode, log_now, curve, p, v):
    b = take_part(taken, start)
    while b >= 0:
        block, filled, cut = _band_curve(
            progress[b, 0],
            edges[b + 1],
            share,
            packed[b],
            progress[b, 1],
            frame,
            codes,
            table,
            rate,
            decode,
            log_now,
            curve,
            p,
            v,
        )
        progress[b, 0], progress[b, 1] = block, filled
        progress[b, 2] += cut
        b = take_part(taken, start)


def to_q25(value: float | np.ndarray) -> np.ndarray:
    """Log intensity in ln units as fixed point (int64)."""
    return np.floor(np.asarray(value, np.float64) * Q_ONE + 0.5).astype(np.int64)


def correlated(a: np.ndarray, b: np.ndarray, correlation: float) -> np.ndarray:
    """Of independent standard normals a and b a normal that has this correlation with a; b itself for 0."""
    return correlation * a + np.sqrt(1.0 - correlation * correlation) * b if correlation else b


def draw_thresholds(
    height: int, width: int, on: float, off: float, sigma: float, seed: np.uint64, correlation: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Per-pixel (C+, C-), float64 (H*W,): normal around the nominal values, kept >= 0.01 and <= 10.

    For nominal thresholds under 0.02 the floor is half the nominal one.   correlation : of C+ with C-.
    """
    # Draw 0 of the stream, one pair of normals per pixel: thresholds are fixed for the life of the
    # sensor.
    a, b = normal2(seed, pixel_counters(height, width), np.uint64(Stream.THRESHOLD), np.uint64(0))
    b = correlated(a, b, correlation)
    clip = lambda c, n: np.clip(c + sigma * n, min(MIN_THRESHOLD, c / 2), 10.0)
    return clip(on, a), clip(off, b)


@register
class Esim(Emulator):
    """See the module and :class:`~blinkgl.events.emulator.Emulator`. State: 12 bytes per pixel; spread thresholds
    (constant) and the refractory period add 8 each, jitter and the slopes of ``hermite``
    4, the neighbours of ``pchip`` 12."""

    Config = EsimConfig
    _still_pixels_sleep = True

    @property
    def _looks_around(self) -> bool:
        """Return whether slopes come from the neighbouring frames, so that the last frames are kept."""
        return self.reconstruction == "pchip"

    @classmethod
    def response(cls, config: EsimConfig) -> Response:
        return Response(smallest_threshold(config), 1.0, config.log_eps)

    @classmethod
    def noiseless(cls, config: EsimConfig) -> EsimConfig:
        return EsimConfig(
            contrast_threshold=config.contrast_threshold,
            contrast_threshold_off=config.contrast_threshold_off,
            threshold_sigma=config.threshold_sigma,
            threshold_correlation=config.threshold_correlation,
        )

    def __init__(
        self, height: int, width: int, config: EsimConfig | None = None, seed: int = 0, reconstruction: str = "linear"
    ):
        super().__init__(height, width, seed, reconstruction)
        self._state = (
            "_upper",
            "_lower",
            "_fired",
            "_last_ns",
            *(("_ring", "_ring_ns", "_ring_rows", "_passed") if self._looks_around else ("_log",)),
            *(("_slope",) if self.needs_rate else ()),
        )
        self.config = config = config or EsimConfig()
        pixels = self.height * self.width
        on, off = config.contrast_threshold, config.contrast_threshold_off or config.contrast_threshold
        # Thresholds become fixed point here. One pair of integers serves all pixels unless they are
        # spread.
        self._on_all, self._off_all = int(to_q25(on)), int(to_q25(off))
        self._on = self._off = np.empty(0, np.int32)
        smallest = min(self._on_all, self._off_all)
        if config.threshold_sigma:
            self._on, self._off = (
                to_q25(c).astype(np.int32)
                for c in draw_thresholds(
                    height, width, on, off, config.threshold_sigma, self.seed, config.threshold_correlation
                )
            )
            smallest = int(min(self._on.min(), self._off.min()))
        self._floor_on, self._floor_off = (int(to_q25(min(MIN_THRESHOLD, c / 2))) for c in (on, off))
        # With jitter every event may draw the floor, so the worst case of events per unit of change is
        # that of the floor.
        if config.threshold_jitter:
            smallest = min(self._floor_on, self._floor_off)
        self._inverse_threshold = 1.0 / smallest
        self._fired = np.zeros(pixels if config.threshold_jitter else 0, np.int32)
        self._refractory_ns = round(config.refractory_us * 1000)
        self._last_ns = np.full(pixels if self._refractory_ns else 0, NEVER_NS, np.int64)
        self._upper, self._lower = (np.zeros(pixels, np.int32) for _ in range(2))
        if self._looks_around:
            # The last four frames, frame k in row k mod 4: their logs, times, and the pixels [first, stop) in which
            # each differs from the one before it.
            self._ring, self._ring_ns, self._ring_rows = (
                np.zeros((4, pixels), np.int32),
                np.zeros(4, np.int64),
                np.zeros((4, 2), np.int64),
            )
            self._passed = np.zeros(1, np.int64)  # number of the frame up to which events have been returned
        else:
            self._log = np.zeros(pixels, np.int32)
        self._slope = np.zeros(pixels if self.needs_rate else 0, np.float32)
        self._tables_changed()

    def _tables_changed(self) -> None:
        self._table = log_q25(self._decode + np.float32(self.config.log_eps))

    def _start(self, frame: np.ndarray, t_ns: int, rate: np.ndarray | None) -> Events:
        log, eps = self._ring[0] if self._looks_around else self._log, np.float32(self.config.log_eps)
        if frame.dtype == np.uint8:
            lookup_block(frame, self._table, log)
        else:
            log_block(frame, eps, log)
        if self._looks_around:
            self._ring_ns[0], self._ring_rows[0], self._passed[0] = t_ns, (0, log.size), 0
        if self.needs_rate:
            slope_block(rate, self._decode[frame] if frame.dtype == np.uint8 else frame, eps, self._slope)
        up, down = (self._on, self._off) if self._on.size else (self._on_all, self._off_all)
        if self._fired.size:
            jitter = self.config.threshold_jitter * Q_ONE
            # Draw 0 is the pair of thresholds in force at the first frame. _emit_block counts on from
            # 1.
            a, b = normal2(self.seed, pixel_counters(self.height, self.width), _JITTER, np.uint64(0))
            up = np.maximum(self._floor_on, up + np.floor(jitter * a + 0.5).astype(np.int64))
            down = np.maximum(self._floor_off, down + np.floor(jitter * b + 0.5).astype(np.int64))
        self._upper[...] = log + up
        self._lower[...] = log - down
        return Events.empty()

    def _advance(self, frame: np.ndarray, t_ns: int, rate: np.ndarray | None) -> Events:
        source = (NO_FRAME, frame, self._table) if frame.dtype == np.uint8 else (frame, NO_CODES, self._table)
        if self._looks_around:
            return self._advance_late(source, t_ns)
        levels, interval = self._levels(self._log), self._interval(self.t_ns, t_ns)
        base_us = self.t_ns // 1000
        if self.needs_rate:
            curve = Curve(NO_LOG, NO_LOG, 0.0, 0.0)
            return self._run(
                _bands_curve,
                (*source, rate, self._decode, NO_LOG, curve, levels, interval),
                base_us,
                t_ns // 1000 - base_us,
            )
        return self._run(_bands, (*source, levels, interval), base_us, t_ns // 1000 - base_us)

    def _advance_late(self, source: tuple, t_ns: int) -> Events:
        """Take the logarithm of frame k = ``frames`` and return the events between the two frames before it."""
        k = self.frames
        # The usual case: frame k gives the slope at the end of the interval from k - 2 to k - 1, which
        # is emitted now.
        if self._passed[0] < k - 1:
            self._ring_ns[k % 4] = t_ns
            return self._pass_interval(k - 1, source)
        # The interval before is done: only the first frame, and after flush.
        log, first, stop = (self._ring[k % 4], *self._stale(k))
        frame, codes, table = (a[first:stop] if j < 2 else a for j, a in enumerate(source))
        if first < stop:
            lookup_block(codes, table, log[first:stop]) if codes.size else log_block(
                frame, np.float32(self.config.log_eps), log[first:stop]
            )
        self._ring_ns[k % 4] = t_ns
        return Events.empty()

    def _stale(self, k: int) -> tuple[int, int]:
        """Return the pixels in which row k mod 4 differs from frame k: those that changed since frame k - 4 was
        written there."""
        self._ring_rows[k % 4] = self._changed
        rows = self._ring_rows[[j % 4 for j in range(max(0, k - 3), k + 1)]]
        rows = rows[rows[:, 0] < rows[:, 1]]
        return (int(rows[:, 0].min()), int(rows[:, 1].max())) if len(rows) else (0, 0)

    def _pass_interval(self, k: int, source: tuple | None) -> Events:
        """Return the events between frames k - 1 and k. ``source`` is frame k + 1, None when there is none yet."""
        # Row and time of frame j in the ring of four.
        ring, ns = (lambda j: self._ring[j % 4]), (lambda j: int(self._ring_ns[j % 4]))
        curve = Curve(
            ring(k - 2) if k >= 2 else NO_LOG,
            ring(k + 1) if source else NO_LOG,
            float(ns(k - 1) - ns(k - 2)) if k >= 2 else 0.0,
            float(ns(k + 1) - ns(k)) if source else 0.0,
        )
        if source:
            self._changed = self._stale(k + 1)
        else:
            # Without a next frame nothing is read, and only pixels that changed in frame k can have passed
            # a level.
            self._changed = tuple(self._ring_rows[k % 4].tolist())
        self._passed[0] = k
        base_us = ns(k - 1) // 1000
        arguments = (
            *(source or (NO_FRAME, NO_CODES, self._table)),
            NO_FRAME,
            self._decode,
            ring(k),
            curve,
            self._levels(ring(k - 1)),
            self._interval(ns(k - 1), ns(k)),
        )
        return self._run(_bands_curve, arguments, base_us, ns(k) // 1000 - base_us)

    @property
    def done_ns(self) -> int | None:
        return int(self._ring_ns[self._passed[0] % 4]) if self._looks_around and self.t_ns is not None else self.t_ns

    def flush(self) -> Events:
        if not self._looks_around or self.t_ns is None or self._passed[0] >= self.frames - 1:
            return Events.empty()
        return self._pass_interval(self.frames - 1, None)

    def _levels(self, log: np.ndarray) -> Levels:
        return Levels(log, self._upper, self._lower, self._on, self._off, self._fired, self._last_ns, self._slope)

    def _interval(self, t0_ns: int, t1_ns: int) -> Interval:
        dt_ns = t1_ns - t0_ns
        # In the order of the fields of Interval. The last bound: at most one event per refractory
        # period, and one at either end.
        return Interval(
            t0_ns,
            dt_ns,
            t0_ns // 1000,
            np.float32(self.config.log_eps),
            self._on_all,
            self._off_all,
            self.config.threshold_jitter * Q_ONE,
            self._floor_on,
            self._floor_off,
            self._refractory_ns,
            self._inverse_threshold,
            dt_ns // self._refractory_ns + 2 if self._refractory_ns else 2**31,
            self.seed,
            self.width,
        )
