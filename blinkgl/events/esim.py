"""ESIM: events where log intensity passes levels one contrast threshold apart.

Rebecq, Gehrig, Scaramuzza, "ESIM: an Open Event Camera Simulator", CoRL 2018, section 3. With L = ln(I + eps) and the
last level passed L_ref, a pixel fires ON at every L_ref + j C+ and OFF at every L_ref - j C- that L reaches in the
interval (t_prev, t], at the time where the straight line from L_prev to L meets the level, floored to the microsecond.
A level passed in the refractory period is lost (L_ref moves all the same).

C+ and C- belong to the pixel and are drawn once; with jitter each *event* draws the next ones, once. (Thresholds
redrawn at every frame would lose events, more of them at a higher frame rate.) Everything is integer arithmetic: logs
in units of 2^-25, times in ns. So references neither drift nor stick, however slow the ramp, and a brightness that
returns exactly passes exactly the same levels.

For speed, the logarithm and the comparison with both levels are branch-free loops over blocks that fit the first-level
cache; the pixels that fire are then extracted from the block's flags, eight at a time, without branches on the data.
``blinkgl.tensors`` makes the same events by another implementation.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import numpy as np
from numba.extending import register_jitable

from blinkgl.config.events import EsimConfig
from blinkgl.events.arith import Q_ONE, log_q25
from blinkgl.events.bands import BLOCK, driver
from blinkgl.events.emulator import NEVER_NS, Emulator, Source
from blinkgl.events.packing import T_SHIFT, copy_block, lookup_block
from blinkgl.events.philox import Stream, in_blocks, normal2, pixel_counters
from blinkgl.events.response import Response
from blinkgl.events.table import register
from blinkgl.events.thresholds import MIN_THRESHOLD, pixel_thresholds
from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Events

# Typed constants: an int literal is int64 to numba and would widen the int32 loops. _FAR_BELOW is the
# least int32, the start of a maximum.
_I0, _FAR_BELOW = np.int32(0), np.int32(-(2**31))
_U1000 = np.uint64(1000)
_JITTER = np.uint64(Stream.JITTER)
# Intervals of this length or more take the long division of crossing_ns.
_LONG_NS = 2**31


class Levels(NamedTuple):
    """Per-pixel arrays, flat; size 0 when the feature is off."""

    log: np.ndarray  # int32, 2^-25 ln units: log intensity of the frame before
    upper: np.ndarray  # int32: the next ON level
    lower: np.ndarray  # int32: the next OFF level
    on: np.ndarray  # int32 thresholds, constant; [] when all are equal
    off: np.ndarray
    fired: np.ndarray  # int32 number of levels passed, for the jitter's draws
    last_ns: np.ndarray  # int64 time of the last event, for the refractory period


class Interval(NamedTuple):
    """Values of a step that are the same for all pixels; thresholds in 2^-25 ln units."""

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


@kernel(error_model="numpy")
def log_block(intensity: np.ndarray, eps: float, out: np.ndarray) -> None:
    """Write ln(intensity + eps) to ``out``, int32, 2^-25."""
    # No branch and no call of libm in the loop, so that LLVM vectorises it.
    for i in range(intensity.size):
        out[i] = log_q25(np.float32(intensity[i] + eps))


@kernel(error_model="numpy")
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
    """Return floor(part / whole * dt_ns) for 0 <= part <= whole < 2^31, exactly, for any dt_ns < 2^52."""
    # Both factors are below 2^31, so the product fits int64.
    if dt_ns < _LONG_NS:
        return np.int64(np.uint64(part * dt_ns) // np.uint64(whole))
    # Schoolbook division of part * dt by whole, dt as two digits of base 2^20: no product reaches 2^63.
    high, low = dt_ns >> 20, dt_ns & 0xFFFFF
    quotient, rest = part * high // whole, part * high % whole
    return (quotient << 20) + ((rest << 20) + part * low) // whole


@register_jitable
def _jittered(pixel, passed, on, off, v):
    """Return the thresholds after the level number ``passed``: they are drawn once per level and do not depend on the
    frame times."""
    a, b = normal2(v.seed, np.uint64(pixel), _JITTER, np.uint64(passed))
    up = max(v.floor_on, on + np.int64(np.floor(v.jitter * a + 0.5)))
    return up, max(v.floor_off, off + np.int64(np.floor(v.jitter * b + 0.5)))


@kernel(error_model="numpy")
def _emit_block(active, first, now, p, v, cap, packed, begin):
    """Write the events of the listed pixels of one block to ``packed[begin:]``, in raster order, and move their
    levels. Return (end of the events, events cut by ``cap``)."""
    out, cut = begin, 0
    # The listed pixels are in raster order, so the row is counted along instead of divided out.
    # ``row_end`` is the number of the first pixel behind row y.
    y = first // v.width
    row_end = (y + 1) * v.width
    # The interval's start after the microsecond base, 0 to 999.
    start_ns = v.t0_ns - 1000 * v.base_us
    for j in range(active.size):
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
        # One turn per level passed. All are of one polarity, since a line does not turn back.
        while gap >= 0:
            after_ns = start_ns + crossing_ns(whole - gap, whole, v.dt_ns)
            # In the refractory period the event is lost, but the reference moves all the same.
            alive = True
            if p.last_ns.size:
                alive = v.base_us * 1000 + after_ns - p.last_ns[i] >= v.refractory_ns
                if alive:
                    p.last_ns[i] = v.base_us * 1000 + after_ns
            if alive:
                # ``packed`` has room for ``cap`` events of each listed pixel; further ones
                # are counted only.
                if emitted < cap:
                    packed[out] = (np.int64(np.uint64(after_ns) // _U1000) << T_SHIFT) | pixel
                    out += 1
                    emitted += 1
                else:
                    cut += 1
            if p.fired.size:
                p.fired[i] += 1
                up, down = _jittered(i, p.fired[i], step_on, step_off, v)
                step = down + polarity * (up - down)
            gap -= step
        # The last level passed is the new reference.
        passed = level - (2 * polarity - 1) * (gap + step)
        p.upper[i] = np.int32(passed + up)
        p.lower[i] = np.int32(passed - down)
    return out, cut


@register_jitable(inline="always")
def _sense(block, s, e, source, p, v, flags, now):
    """See :mod:`blinkgl.events.bands`; the state at the end is the logarithms."""
    end = now[: e - s]
    # A uint8 frame needs 256 logarithms, which are in the table.
    if source.codes.size:
        lookup_block(source.codes[s:e], source.table, end)
    else:
        log_block(source.frame[s:e], v.eps, end)
    farthest = _flag_block(end, p.upper[s:e], p.lower[s:e], flags)
    if farthest < 0:
        return np.int64(0), end
    # As many events a pixel as levels fit between the first one and the farthest, rounded up; never more than the
    # block's share.
    return min(np.int64(farthest * v.inverse_threshold) + 2, v.bound_per_pixel), end


@register_jitable(inline="always")
def _keep(block, s, e, end, p):
    copy_block(end, p.log[s:e])


_drive = driver(_sense, _emit_block, _keep)


@kernel(error_model="numpy")
def _bands(taken, start, work, source, p, v):
    _drive(taken, start, work, source, p, v, np.empty(BLOCK, np.int32))


def to_q25(value: float | np.ndarray) -> np.ndarray:
    """Return log intensity in ln units as fixed point (int64)."""
    return np.floor(np.asarray(value, np.float64) * Q_ONE + 0.5).astype(np.int64)


@register
class Esim(Emulator):
    """The ESIM emulator, see the module and :class:`~blinkgl.events.emulator.Emulator`. State: 12 bytes per pixel;
    spread thresholds (constant) and the refractory period add 8 each, jitter 4."""

    Config = EsimConfig
    _still_pixels_sleep = True
    # Thresholds of the pixels are drawn again from the seed, so a saved state does not hold them.
    _state: ClassVar[tuple[str, ...]] = ("_upper", "_lower", "_fired", "_last_ns", "_log")

    @classmethod
    def response(cls, config: EsimConfig) -> Response:
        return Response(min(config.thresholds), 1.0, config.log_eps)

    @classmethod
    def noiseless(cls, config: EsimConfig) -> EsimConfig:
        return EsimConfig(
            contrast_threshold=config.contrast_threshold,
            contrast_threshold_off=config.contrast_threshold_off,
            threshold_sigma=config.threshold_sigma,
            threshold_map=config.threshold_map,
        )

    def __init__(self, height: int, width: int, config: EsimConfig | None = None, seed: int = 0):
        super().__init__(height, width, seed)
        self.config = config = config or EsimConfig()
        pixels = self.height * self.width
        on, off = config.thresholds
        # Thresholds become fixed point here. Without spread one pair of integers serves all pixels.
        self._on_all, self._off_all = int(to_q25(on)), int(to_q25(off))
        self._on = self._off = np.empty(0, np.int32)
        smallest = min(self._on_all, self._off_all)
        if config.threshold_sigma or config.threshold_map is not None:
            self._on, self._off = (
                to_q25(c).astype(np.int32) for c in pixel_thresholds(height, width, config, self.seed)
            )
            smallest = int(min(self._on.min(), self._off.min()))
        self._floor_on, self._floor_off = (int(to_q25(min(MIN_THRESHOLD, c / 2))) for c in (on, off))
        # With jitter every event may draw the smallest threshold, which gives the largest number of events.
        if config.threshold_jitter:
            smallest = min(self._floor_on, self._floor_off)
        self._inverse_threshold = 1.0 / smallest
        self._fired = np.zeros(pixels if config.threshold_jitter else 0, np.int32)
        self._refractory_ns = round(config.refractory_us * 1000)
        self._last_ns = np.full(pixels if self._refractory_ns else 0, NEVER_NS, np.int64)
        self._upper, self._lower = (np.zeros(pixels, np.int32) for _ in range(2))
        self._log = np.zeros(pixels, np.int32)
        self._tables_changed()

    def _tables_changed(self) -> None:
        # A uint8 frame has 256 values, so their logarithms are taken once and looked up.
        self._table = log_q25(self._decode + np.float32(self.config.log_eps))

    def _start(self, frame: np.ndarray, t_ns: int) -> Events:
        log = self._log
        if frame.dtype == np.uint8:
            lookup_block(frame, self._table, log)
        else:
            log_block(frame, np.float32(self.config.log_eps), log)
        up, down = (self._on, self._off) if self._on.size else (self._on_all, self._off_all)
        if self._fired.size:
            jitter = self.config.threshold_jitter * Q_ONE
            # Draw 0 is the pair of thresholds at the first frame. _emit_block counts from 1.
            spread = lambda pixels: normal2(self.seed, pixels, _JITTER, np.uint64(0))
            a, b = in_blocks(spread, pixel_counters(self.height, self.width))
            up = np.maximum(self._floor_on, up + np.floor(jitter * a + 0.5).astype(np.int64))
            down = np.maximum(self._floor_off, down + np.floor(jitter * b + 0.5).astype(np.int64))
        self._upper[...] = log + up
        self._lower[...] = log - down
        return Events.empty()

    def _advance(self, frame: np.ndarray, t_ns: int) -> Events:
        levels, interval = self._levels(self._log), self._interval(self.t_ns, t_ns)
        base_us = self.t_ns // 1000
        return self._run(_bands, (Source.of(frame, self._table), levels, interval), base_us, t_ns // 1000 - base_us)

    def _levels(self, log: np.ndarray) -> Levels:
        return Levels(
            log=log,
            upper=self._upper,
            lower=self._lower,
            on=self._on,
            off=self._off,
            fired=self._fired,
            last_ns=self._last_ns,
        )

    def _interval(self, t0_ns: int, t1_ns: int) -> Interval:
        dt_ns = t1_ns - t0_ns
        # In the order of the fields of Interval. The last bound: at most one event per refractory
        # period, and one at either end.
        return Interval(
            t0_ns=t0_ns,
            dt_ns=dt_ns,
            base_us=t0_ns // 1000,
            eps=np.float32(self.config.log_eps),
            on_all=self._on_all,
            off_all=self._off_all,
            jitter=self.config.threshold_jitter * Q_ONE,
            floor_on=self._floor_on,
            floor_off=self._floor_off,
            refractory_ns=self._refractory_ns,
            inverse_threshold=self._inverse_threshold,
            bound_per_pixel=dt_ns // self._refractory_ns + 2 if self._refractory_ns else 2**31,
            seed=self.seed,
            width=self.width,
        )
