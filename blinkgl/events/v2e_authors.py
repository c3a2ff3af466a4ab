"""V2E as its authors' program has it: ``events: {emulator: v2e, compat: authors}``.

Hu, Liu, Delbruck, "v2e: From Video Frames to Realistic DVS Events", CVPRW 2021, as their ``emulator.py`` computes it
(version of 2023 and later, shot noise once a frame), for who has to make numbers again that were made with it. What
:mod:`blinkgl.events.v2e` does in continuous time happens here at the frames, so that noise, event times and dead time
depend on how far they are apart:

* Low-pass: y += min(1, 2 pi f_c dt (I + 20)/275) (x - y), once a frame. Without one, y is x and state is float32, else
  float64, as theirs.
* Leak: the reference falls by rate theta_on dt (1 - jitter N(0, 1)), a normal for every pixel and frame.
* A pixel has floor(|y - reference| / theta) events, all of one polarity. The largest such number N of the *whole*
  frame sets its times: event i of any pixel is at t_0 + i dt / N. The reference moves by theta per event.
* A dead time longer than dt / N drops the events that come too early; a reference does not move for those, which come
  later therefore. A shorter one does nothing, nor is it remembered when a pixel fired.
* Shot noise: one uniform for every pixel and frame is ON above 1 - p theta/theta_on and OFF below p theta/theta_off,
  p = rate/2 dt (1 - 0.75 (I + 20)/275), at the frame's time; the reference is then y.
* Photoreceptor noise: Gaussian, low-passed by f_c alone, of a size from a fit of theirs (``vn``) for the smaller of two
  drawn thresholds, scaled up by what the low-pass takes away.
* At first the reference is the frame.

What differs: draws are Philox's (the law is theirs, the numbers are not: their generator's cannot be had here); times
are whole nanoseconds where theirs are float32 seconds; the size of the photoreceptor noise is worked out for every
frame spacing where theirs is estimated once from 300 thresholds and a simulation, and kept while spacings change by
less than a tenth; where frames are two time constants of the low-pass apart and more, their photoreceptor noise grows
without end, and here it is white. Ties: an event at the very end of a dead time, which their rounding decides, is
dropped. ``tools/peer_v2e.py`` of 348eebef ran their program beside this one,
with the same draws: the same events.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numba.extending import register_jitable
from scipy.special import ndtr

from blinkgl.config.events import V2eConfig
from blinkgl.events.emulator import BLOCK, NEVER_NS, NO_CODES, NO_FRAME, SHARE_BLOCKS
from blinkgl.events.packing import CAUSE_SHIFT, JIT, T_SHIFT, cause_of
from blinkgl.events.philox import Stream, normal2, uniform2
from blinkgl.events.threads import run, take_part, thread_count
from blinkgl.events.types import Cause, Events
from blinkgl.events.v2e import V2e
from blinkgl.events.v2e_model import draw_hot

_NOISE, _SHOT = np.uint64(Stream.NOISE), np.uint64(Stream.SHOT)
_CHORD, _ROUND = math.log(20.0) / 20.0, 1e8
_LEAK, _SHOT_CAUSE, _HOT = int(Cause.LEAK), int(Cause.SHOT), int(Cause.HOT)
_MOST, _SWINGS_UP = 2**30, 1.999


class Pixels(NamedTuple):
    """Per-pixel arrays, flat; size 0 when the feature is off. T is float64 with a low-pass, else float32."""

    signal: np.ndarray  # T: lin-log intensity behind the low-pass
    reference: np.ndarray  # T
    noise: np.ndarray  # float64 photoreceptor noise, ln units; []
    on: np.ndarray  # float32 thresholds
    off: np.ndarray
    leak: np.ndarray  # float32 mean leak, ln units per second; []
    last_ns: np.ndarray  # int64: time of the last event that the dead time knows of; []
    leaked: np.ndarray  # float32: by how much leak has moved the pixel since its last event; [] unless causes are asked
    noise_then: np.ndarray  # float64: the photoreceptor noise in the last event; []
    hot: np.ndarray  # uint8; []


class Interval(NamedTuple):
    """What is the same for all pixels of a step."""

    t0_ns: int
    dt_ns: int
    base_us: int
    step: np.uint64
    seed: np.uint64
    width: int
    scale: np.float32
    constants: float  # 2 pi f_c dt; 0: no low-pass
    leak_jitter: float
    noise_share: float  # see noise_share
    noise_size: float  # of the white noise before its low-pass
    shot: float  # p of a pixel in the dark
    theta_on: float  # nominal
    theta_off: float
    refractory_ns: int
    most: int  # events of the busiest pixel of the frame, at least 1


@register_jitable
def lin_log(intensity: float) -> float:
    """ln(I) above 20 DN, the chord below; to eight places. float64 in and out."""
    x = intensity * _CHORD if intensity <= 20.0 else np.log(intensity)
    return np.rint(x * _ROUND) / _ROUND


@numba.njit(**JIT)
def _lin_logs(intensity, x):
    for i in range(x.size):
        x[i] = np.float32(lin_log(np.float64(intensity[i])))


def noise_share(cutoff_hz: float, dt_s: float) -> float:
    """What a frame's noise adds to the low-passed one. Above 1 it swings, as theirs does; theirs grows without end from
    2 on, where this is 1."""
    share = 2 * math.pi * cutoff_hz * dt_s
    return share if share < _SWINGS_UP else 1.0


def noise_size(rate_hz: float, cutoff_hz: float, dt_s: float, on: float, off: float, sigma: float) -> float:
    """Standard deviation, ln units, of the white noise before its low-pass (``compute_photoreceptor_noise_voltage``).

    rate_hz : noise events per second asked for, ON and OFF.   dt_s : between frames, s.
    on, off, sigma : nominal thresholds and their spread, ln units."""
    x = math.log10(max(0.5 * rate_hz / cutoff_hz, 1e-300))
    threshold_per_noise = 10 ** (((-0.0026 * x - 0.036) * x - 0.1949) * x + 0.321)
    spread = math.sqrt(2.0) * sigma
    least = min(on, off)
    if spread > 0:  # mean of the smaller of two normals
        a = (on - off) / spread
        density = math.exp(-0.5 * a * a) / math.sqrt(2 * math.pi)
        least = on * ndtr(-a) + off * ndtr(a) - spread * density
    share = noise_share(cutoff_hz, dt_s)
    # What y += share (n - y) leaves of white noise's variance: share / (2 - share).
    return max(least, 0.0) / threshold_per_noise * math.sqrt((2.0 - share) / share)


@numba.njit(**JIT)
def _compare(taken, start, edges, most, counts, frame, codes, table, x_table, p, v):
    """Photoreceptor, leak and comparator of every pixel: how many events, negative for OFF; the largest of a part."""
    part = take_part(taken, start)
    dt_s = v.dt_ns * 1e-9
    while part >= 0:
        largest = 0
        for i in range(edges[part], edges[part + 1]):
            intensity = np.float64(table[codes[i]] if codes.size else frame[i] * v.scale)
            x = x_table[codes[i]] if codes.size else np.float32(lin_log(intensity))
            if v.constants > 0:
                share = min(v.constants * ((intensity + 20.0) / 275.0), 1.0)
                p.signal[i] = (1.0 - share) * p.signal[i] + share * x
            else:
                p.signal[i] = x
            if p.leak.size or p.noise.size:
                hum, turn = normal2(v.seed, np.uint64(i), _NOISE, v.step)
            noise = 0.0
            if p.noise.size:
                noise = (1.0 - v.noise_share) * p.noise[i] + v.noise_share * v.noise_size * hum
                p.noise[i] = noise
            if p.leak.size:
                fallen = np.float32(dt_s * np.float64(p.leak[i]) * (1.0 - v.leak_jitter * turn))
                p.reference[i] -= fallen
                if p.leaked.size:
                    p.leaked[i] += fallen
            difference = p.signal[i] + noise - p.reference[i]
            n = np.int64(0)
            if difference >= p.on[i]:
                n = np.int64(min(difference // p.on[i], _MOST))
            elif -difference >= p.off[i]:
                n = -np.int64(min(-difference // p.off[i], _MOST))
            counts[i] = n
            largest = max(largest, abs(n))
        most[part] = largest
        part = take_part(taken, start)


@numba.njit(**JIT)
def _band(first_block, stop_block, share, packed, filled, counts, frame, codes, table, p, v):
    """Band kernel, see :meth:`Emulator._run`."""
    cut, start_ns = 0, v.t0_ns - 1000 * v.base_us
    waits = p.last_ns.size and v.refractory_ns > v.dt_ns / v.most
    for block in range(first_block, stop_block):
        s, e = block * BLOCK, min(block * BLOCK + BLOCK, p.on.size)
        room, busy = 0, 0
        for i in range(s, e):
            room += abs(counts[i])
            busy += counts[i] != 0
        cap = _MOST if room <= share else max(1, share // max(busy, 1))
        room = min(room, cap * busy) + (2 * (e - s) if v.shot > 0 else 0)
        if filled + room > packed.size:
            return block, filled, cut
        for i in range(s, e):
            n = abs(counts[i])
            on = off = False
            if v.shot > 0:
                intensity = np.float64(table[codes[i]] if codes.size else frame[i] * v.scale)
                each = v.shot * (1.0 - 0.75 * ((intensity + 20.0) / 275.0))
                u, _ = uniform2(v.seed, np.uint64(i), _SHOT, v.step)
                on, off = u > 1.0 - each * (v.theta_on / p.on[i]), u < each * (v.theta_off / p.off[i])
            if n == 0 and not (on or off):
                continue
            polarity = np.int64(counts[i] > 0)
            sign, theta = (1.0, p.on[i]) if polarity else (-1.0, p.off[i])
            pixel = ((i // v.width) << 17) | ((i % v.width) << 1)
            noise = p.noise[i] if p.noise.size else 0.0
            mark = 0
            if p.leaked.size:
                leak, hum = sign * p.leaked[i], sign * (noise - p.noise_then[i])
                mark = cause_of(n * theta - leak - hum, leak, hum)
                if mark == _LEAK and p.hot[i]:
                    mark = _HOT
            emitted, moved = 0, 0
            for k in range(1, n + 1):
                after = v.dt_ns if k == v.most else np.int64(v.dt_ns * (k / v.most))
                if waits:
                    if v.t0_ns + after - p.last_ns[i] <= v.refractory_ns:
                        continue
                    p.last_ns[i] = v.t0_ns + after
                moved += 1
                if emitted < cap:
                    packed[filled] = ((start_ns + after) // 1000 << T_SHIFT) | mark << CAUSE_SHIFT | pixel | polarity
                    filled += 1
                    emitted += 1
                else:
                    cut += 1
            p.reference[i] += sign * moved * theta
            for which in range(2):
                if (off, on)[which]:
                    packed[filled] = ((start_ns + v.dt_ns) // 1000 << T_SHIFT) | pixel | which
                    if p.leaked.size:
                        packed[filled] |= _SHOT_CAUSE << CAUSE_SHIFT
                    filled += 1
            if on or off:
                p.reference[i] = p.signal[i]
            if p.leaked.size and (moved or on or off):
                p.leaked[i], p.noise_then[i] = np.float32(0), noise
    return stop_block, filled, cut


@numba.njit(**JIT)
def _bands(taken, start, edges, progress, share, packed, counts, frame, codes, table, p, v):
    b = take_part(taken, start)
    while b >= 0:
        block, filled, cut = _band(
            progress[b, 0], edges[b + 1], share, packed[b], progress[b, 1], counts, frame, codes, table, p, v
        )
        progress[b, 0], progress[b, 1] = block, filled
        progress[b, 2] += cut
        b = take_part(taken, start)


class V2eAuthors(V2e):
    """See the module and :class:`~blinkgl.events.emulator.Emulator`. Luminance 1.0 is ``config.full_scale`` DN.

    State: 8 bytes per pixel, 16 with a low-pass; 8 more each with photoreceptor noise and dead time, 12 with causes."""

    compat = "authors"
    _state = ("_signal", "_reference", "_noise", "_last_ns", "_leaked", "_noise_then")

    def __init__(
        self, height: int, width: int, config: V2eConfig | None = None, seed: int = 0, reconstruction: str = "linear"
    ):
        config = config or V2eConfig(compat="authors")
        super().__init__(height, width, config, seed, reconstruction)
        pixels = self.height * self.width
        kind = np.float64 if config.cutoff_hz > 0 else np.float32
        self._signal, self._reference = np.zeros(pixels, kind), np.zeros(pixels, kind)
        hums = config.photoreceptor_noise and config.shot_noise_rate_hz > 0
        self._noise = np.zeros(pixels if hums else 0)
        self._last_ns = np.full(pixels if self._refractory_ns else 0, NEVER_NS, np.int64)
        told = pixels if config.causes else 0
        self._leaked, self._noise_then = np.zeros(told, np.float32), np.zeros(told)
        self._hot = draw_hot(self.height, self.width, config, self.seed) if told else np.empty(0, np.uint8)
        self._counts = np.zeros(pixels, np.int32)
        for name in ("_x", "_upper", "_lower", "_lag", "_intensity", "_release", "_since_ns", "_clock_ns"):
            setattr(self, name, np.empty(0))  # the other program's

    def _tables_changed(self) -> None:
        self._table = self._decode * self._scale
        self._x_table = np.empty(256, np.float32)
        _lin_logs(self._table, self._x_table)

    def _start(self, frame: np.ndarray, t_ns: int, rate: np.ndarray | None) -> Events:
        intensity = self._table[frame] if frame.dtype == np.uint8 else frame * self._scale
        _lin_logs(intensity, self._signal)
        self._reference[...] = self._signal
        return Events.empty()

    def _advance(self, frame: np.ndarray, t_ns: int, rate: np.ndarray | None) -> Events:
        config, dt_ns = self.config, t_ns - self.t_ns
        on, off = config.contrast_threshold, config.contrast_threshold_off or config.contrast_threshold
        size, share = 0.0, noise_share(config.cutoff_hz, dt_ns * 1e-9)
        if self._noise.size:
            size = noise_size(
                config.shot_noise_rate_hz, config.cutoff_hz, dt_ns * 1e-9, on, off, config.threshold_sigma
            )
        pixels = Pixels(
            self._signal,
            self._reference,
            self._noise,
            self._on,
            self._off,
            self._leak,
            self._last_ns,
            self._leaked,
            self._noise_then,
            self._hot,
        )
        interval = Interval(
            self.t_ns,
            dt_ns,
            self.t_ns // 1000,
            np.uint64(self.frames),
            self.seed,
            self.width,
            self._scale,
            2 * np.pi * config.cutoff_hz * dt_ns * 1e-9,
            config.leak_jitter,
            share,
            size,
            0.0 if config.photoreceptor_noise else 0.5 * config.shot_noise_rate_hz * dt_ns * 1e-9,
            on,
            off,
            self._refractory_ns,
            1,
        )
        source = (NO_FRAME, frame) if frame.dtype == np.uint8 else (frame, NO_CODES)
        parts = max(1, min(4 * thread_count(), self._blocks // SHARE_BLOCKS))
        edges, most = len(self._counts) * np.arange(parts + 1, dtype=np.int64) // parts, np.zeros(parts, np.int64)
        run(
            _compare,
            parts,
            (edges, most, self._counts, *source, self._table, self._x_table, pixels, interval),
            min(parts, thread_count()),
        )
        interval = interval._replace(most=max(int(most.max()), 1))
        base_us = interval.base_us
        return self._run(
            _bands, (self._counts, *source, self._table, pixels, interval), base_us, t_ns // 1000 - base_us
        )
