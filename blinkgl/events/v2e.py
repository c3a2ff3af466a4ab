"""V2E: lin-log photoreceptor of finite bandwidth, threshold mismatch, leak, shot noise, refractory period.

Hu, Liu, Delbruck, "v2e: From Video Frames to Realistic DVS Events", CVPRW 2021, section 3, as a process in continuous
time, so that the frame rate affects only the accuracy of the interpolation:

* The photoreceptor follows the lin-log intensity x, linear in time between frames, through a first-order low-pass
  with k = 2 pi f_c dt (I + 20)/275 time constants per interval. With the lag D = y - x the exact solution over an
  interval is D' = D e^-k - dx (1 - e^-k)/k: stable for every k, second order in the frame spacing.
* The comparator sees z = y + leak (t - epoch) and fires where z, on its exact curve, meets the level (Newton's
  method), not at frame times.
* After any event the reference is z at the end of the dead time: without a refractory period the level just passed,
  with one the signal at that time, so that a change during the dead time causes no events later.
* Leak is a drift of the reference; with jitter each event draws the length of the pixel's next leak interval
  (keyed by the event's time). Hot pixels are pixels with a large leak.
* Shot noise is a Poisson process per block of 1024 pixels at its rate in the dark, thinned to each pixel's own rate
  (R/2)(1 - 0.75 (I + 20)/275) theta_nominal/theta per polarity at that instant.
* Photoreceptor noise (instead of shot noise) is the stationary noise of the same low-pass, added before the
  comparator; :mod:`blinkgl.events.noise` sets its size so that the rate holds at any frame spacing.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import numpy as np
from numba.extending import register_jitable

from blinkgl.config.events import EsimConfig, V2eConfig
from blinkgl.errors import EventDataError
from blinkgl.events.bands import BLOCK, driver
from blinkgl.events.emulator import NEVER_NS, Emulator, Source
from blinkgl.events.noise import noise_table
from blinkgl.events.packing import copy_block, lookup_block, scale_block
from blinkgl.events.response import Response
from blinkgl.events.table import register
from blinkgl.events.thresholds import pixel_thresholds
from blinkgl.events.v2e_blocks import (
    DRAWS,
    add_scaled_block,
    flag_block,
    lin_log_block,
    noise_block,
    relax_block,
    shot_block,
)
from blinkgl.events.v2e_events import End, emit
from blinkgl.events.v2e_model import (
    DARKEST,
    REBASE,
    corner_hz,
    draw_hot,
    draw_leaks,
    draw_start,
    draw_start_noise,
    lin_log,
    noise_threshold,
    shot_draw,
    shot_tables,
)
from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Events

_F = np.float32
# Typed: a float literal is float64 to numba and would widen the loops.
_ZERO = _F(0)
# Pixels in their dead time have infinite levels and lie infinitely far beyond them: the
# distance is cut here.
_FARTHEST = _F(1e6)


class Pixels(NamedTuple):
    """Per-pixel arrays, flat; size 0 when the feature is off. The photoreceptor's state is that of the previous
    frame."""

    intensity: np.ndarray  # float32 DN; [] unless the low-pass or shot noise needs it
    x: np.ndarray  # float32 lin-log
    lag: np.ndarray  # float32 y - x; [] without low-pass
    noise: np.ndarray  # float32 photoreceptor noise, ln units; []
    noise_sizes: np.ndarray  # see noise.noise_table, for this frame spacing; []
    upper: np.ndarray  # float32 levels; -inf and +inf in the dead time, so that the pixel is looked at
    lower: np.ndarray
    constants: np.ndarray  # (N, 4) float32: ON threshold, OFF threshold, mean leak per second, 0
    leak: np.ndarray  # (N,) float32, per second; changes with jitter
    release: np.ndarray  # int64 ns, end of the dead time or NEVER
    clock_ns: np.ndarray  # (blocks,) int64 time of the next shot-noise candidate; []
    clock_index: np.ndarray  # (blocks,) int64 its number
    shot_table: np.ndarray  # (blocks, 2048) float32, see shot_tables
    since_ns: np.ndarray  # int64: time of the reference; [] without causes
    noise_then: np.ndarray  # float32: the photoreceptor noise in the reference; []
    hot: np.ndarray  # uint8: whether the leak is a hot pixel's; []


class Interval(NamedTuple):
    """Values of a step that are the same for all pixels."""

    t0_ns: int
    dt_ns: int
    base_us: int
    since_epoch_0: float  # seconds from the leak epoch to both ends
    since_epoch_1: float
    kappa: float
    scale: np.float32
    seed: np.uint64
    step: int
    width: int
    refractory_ns: int
    leak_jitter: float
    shot_unit_per_ns: float  # rate of a dark pixel with nominal threshold, one polarity
    inverse_threshold: float
    bound_per_pixel: int


class Scratch(NamedTuple):
    """Memory of a thread for one block."""

    now: np.ndarray  # (5, BLOCK) float32: intensity, x, lag, noise and comparator's input at the interval's end
    normals: np.ndarray  # (BLOCK,) float32
    keys: np.ndarray  # (BLOCK,) int64, see shot_block
    draws: tuple[np.ndarray, np.ndarray, np.ndarray]


@register_jitable(inline="always")
def _sense(block, s, e, source, p, v, flags, scratch):
    """See :mod:`blinkgl.events.bands`."""
    n = e - s
    now, keys = scratch.now, scratch.keys
    # z is what the comparator sees. ``p`` is of the frame before.
    intensity, x, lag, noise, z = now[0, :n], now[1, :n], now[2, :n], now[3, :n], now[4, :n]
    # uint8 frames: luminance and lin-log of all 256 codes are in tables.
    if source.codes.size:
        lookup_block(source.codes[s:e], source.signals, x)
        lookup_block(source.codes[s:e], source.table, intensity)
    else:
        scale_block(source.frame[s:e], v.scale, intensity)
        lin_log_block(intensity, x)
    # The low-pass of the photoreceptor.
    if p.lag.size:
        relax_block(p.lag[s:e], p.x[s:e], x, p.intensity[s:e], intensity, _F(v.kappa), lag, z)
    else:
        copy_block(x, z)
    if p.leak.size:
        add_scaled_block(p.leak[s:e], _F(v.since_epoch_1), z)
    if p.noise.size:
        noise_block(
            p.noise[s:e], p.intensity[s:e], intensity, _F(v.kappa), p.noise_sizes, v.seed, v.step, s,
            scratch.normals, noise, z,
        )  # fmt: skip
    farthest = flag_block(z, p.upper[s:e], p.lower[s:e], flags)
    shots, clock_ns, clock_index = 0, np.int64(0), np.int64(0)
    if p.clock_ns.size:
        shots, clock_ns, clock_index = shot_block(block, n, p, v, intensity, keys, scratch.draws)
        # -1 event: no room. Draws are functions of their numbers, so the block is done again with twice the room.
        while shots < 0:
            keys = np.empty(2 * keys.size, np.int64)
            shots, clock_ns, clock_index = shot_block(block, n, p, v, intensity, keys, scratch.draws)
        # A pixel with shot noise is listed even where its signal reaches no level. Bits 42 and up: its number.
        for j in range(shots):
            flags[keys[j] >> 42] = 1
    end = End(
        intensity=intensity,
        x=x,
        lag=lag,
        noise=noise,
        keys=keys[:shots],
        clock_ns=clock_ns,
        clock_index=clock_index,
    )
    if farthest < _ZERO and not shots:
        return np.int64(0), end
    # As many events a pixel as levels fit between the first one and the farthest, rounded up, and its noise.
    levels = np.int64(max(min(farthest, _FARTHEST), _ZERO) * v.inverse_threshold) + 2
    return min(levels, v.bound_per_pixel) + shots, end


@register_jitable(inline="always")
def _keep(block, s, e, end, p):
    if p.intensity.size:
        copy_block(end.intensity, p.intensity[s:e])
    copy_block(end.x, p.x[s:e])
    if p.lag.size:
        copy_block(end.lag, p.lag[s:e])
    if p.noise.size:
        copy_block(end.noise, p.noise[s:e])
    if p.clock_ns.size:
        p.clock_ns[block], p.clock_index[block] = end.clock_ns, end.clock_index


_drive = driver(_sense, emit, _keep)


@kernel(error_model="numpy")
def _bands(taken, start, work, source, p, v):
    draws = (np.empty(DRAWS, np.int64), np.empty(DRAWS), np.empty(DRAWS))
    scratch = Scratch(np.empty((5, BLOCK), _F), np.empty(BLOCK, _F), np.empty(BLOCK, np.int64), draws)
    _drive(taken, start, work, source, p, v, scratch)


_TAIL = 4.0
"""Time constants of the low-pass after which a step of at most e^4 times the threshold is over."""
_PUSHES, _MOST_PUSH = 8, 3.0
"""Iterations for the light that makes a jump, and its largest ln: darker pixels follow more slowly."""


@register
class V2e(Emulator):
    """The V2E emulator, see the module and :class:`~blinkgl.events.emulator.Emulator`. Luminance 1.0 is
    ``config.full_scale`` DN.

    State: 12 bytes per pixel; 4 more each with the low-pass, leak, photoreceptor noise, and intensity (for low-pass or
    shot noise), 8 with the dead time, 12 with causes. Constants: 16 bytes per pixel, 8 more with shot noise."""

    Config = V2eConfig
    noisy = True
    _state: ClassVar[tuple[str, ...]] = (
        "_intensity",
        "_x",
        "_lag",
        "_noise",
        "_upper",
        "_lower",
        "_leak",
        "_release",
        "_clock_ns",
        "_clock_index",
        "_epoch_ns",
        "_since_ns",
        "_noise_then",
    )

    @classmethod
    def response(cls, config: V2eConfig) -> Response:
        """Return the lin-log response: linear up to 20 digital numbers."""
        # Below 20 DN the chord from the origin, whose slope is per DN: full_scale times as much per unit of luminance.
        return Response(
            min(config.thresholds), 1.0, 0.0, 20.0 / config.full_scale, np.log(20.0) / 20.0 * config.full_scale
        )

    @classmethod
    def noiseless(cls, config: V2eConfig) -> EsimConfig:
        return EsimConfig(
            contrast_threshold=config.contrast_threshold,
            contrast_threshold_off=config.contrast_threshold_off,
            threshold_sigma=config.threshold_sigma,
            threshold_map=config.threshold_map,
        )

    def __init__(self, height: int, width: int, config: V2eConfig | None = None, seed: int = 0):
        super().__init__(height, width, seed)
        self.config = config = config or V2eConfig()
        pixels = self.height * self.width
        # Arrays of features that are off have size 0, which the kernels test.
        frame = lambda wanted=True: np.zeros(pixels if wanted else 0, np.float32)
        on, off = config.thresholds
        self._on, self._off = (c.astype(np.float32) for c in pixel_thresholds(height, width, config, self.seed))
        self._x, self._upper, self._lower = (frame() for _ in range(3))
        self._intensity = frame(config.cutoff_hz > 0 or config.shot_noise_rate_hz > 0)
        noisy = config.photoreceptor_noise and config.shot_noise_rate_hz > 0
        self._lag, self._noise = frame(config.cutoff_hz > 0), frame(noisy)
        self._noise_sizes, self._sizes_dt_ns = np.empty(0, np.float32), -1

        self._leak = draw_leaks(height, width, config, self._on, self.seed)
        # Four floats per pixel in one cache line: everything that a firing pixel needs.
        self._constants = np.zeros((pixels, 4), np.float32)
        self._constants[:, 0], self._constants[:, 1] = self._on, self._off
        if self._leak.size:
            self._constants[:, 2] = self._leak
        self._leak_jitter = config.leak_jitter if self._leak.size else 0.0
        # Never, unless a pixel leaks.
        self._rebase_ns = 2**61
        if self._leak.size and self._leak.max() > 0:
            # The leak clock restarts when the median pixel has leaked REBASE.
            self._rebase_ns = int(REBASE / float(np.median(self._leak[self._leak > 0])) * 1e9)
        self._epoch_ns = np.zeros(1, np.int64)

        self._refractory_ns = round(config.refractory_us * 1000)
        self._release = np.full(pixels if self._refractory_ns else 0, NEVER_NS, np.int64)

        shot = config.shot_noise_rate_hz > 0 and not config.photoreceptor_noise
        blocks = -(-pixels // BLOCK) if shot else 0
        self._clock_ns, self._clock_index = np.zeros(blocks, np.int64), np.zeros(blocks, np.int64)
        # Half of the rate for each polarity, at its value in the dark, per ns.
        self._shot_unit = 0.5 * config.shot_noise_rate_hz * DARKEST * 1e-9
        self._shot_table = shot_tables(self._on, self._off, on, off) if shot else np.empty((0, 0), np.float32)
        self._shots_per_ns = self._shot_unit * float(self._shot_table[:, -1:].sum())  # if all pixels were dark
        self._inverse_threshold = 1.0 / float(min(self._on.min(), self._off.min()))
        self._scale = np.float32(config.full_scale)
        explained = pixels if config.causes else 0
        self._since_ns, self._noise_then = np.zeros(explained, np.int64), frame(config.causes)
        self._hot = draw_hot(height, width, config, self.seed) if explained else np.empty(0, np.uint8)
        self._tables_changed()

    def _tables_changed(self) -> None:
        self._table = self._decode * self._scale
        self._x_table = lin_log(self._table)

    def memory_s(self, luminance: np.ndarray) -> np.ndarray | None:
        if self.config.cutoff_hz == 0:
            return None
        level = luminance.astype(np.float64) * self.config.full_scale
        return _TAIL / (2 * np.pi * corner_hz(level, self.config))

    def push(self, luminance: np.ndarray, jump: float, rise_s: float) -> np.ndarray | None:
        memory = self.memory_s(luminance)
        if memory is None:
            return None
        # m (1 - e^{-k g}) = jump: the response of a low-pass to m in k of its time constants, which brighter light
        # shortens by the factor g. The geometric mean of two steps converges where the plain iteration diverges.
        k = rise_s * _TAIL / memory
        intensity, most = luminance.astype(np.float64) * self.config.full_scale, _MOST_PUSH
        m = np.minimum(jump / -np.expm1(-k), most)
        for _ in range(_PUSHES):
            g = (intensity * np.exp(m) + 20.0) / (intensity + 20.0)
            m = np.minimum(np.sqrt(m * jump / -np.expm1(-k * g)), most)
        return m.astype(np.float32)

    def _start(self, frame: np.ndarray, t_ns: int) -> Events:
        intensity = self._table[frame] if frame.dtype == np.uint8 else frame * self._scale
        self._x[...] = lin_log(intensity)
        if self._intensity.size:
            self._intensity[...] = intensity
        reference = self._x
        if self._noise.size:
            self._noise[...] = draw_start_noise(intensity, self.config, self.seed)
            reference = reference + self._noise
        start = draw_start(self.config, intensity, self._on, self._off, self._leak, self._noise, self.seed)
        reference = reference + start.offset
        self._upper[...], self._lower[...] = reference + self._on, reference - self._off
        self._leak[...] = start.leak
        dead = np.flatnonzero(start.dead_ns)
        # Levels that every signal has passed mark the dead time, so that the kernel processes the pixel.
        self._upper[dead], self._lower[dead] = -np.inf, np.inf
        self._release[dead] = t_ns + start.dead_ns[dead]
        if self.causes:
            self._since_ns[...] = t_ns - start.age_ns
            if self._noise.size:
                self._noise_then[...] = self._noise + start.by_noise
        for block in range(len(self._clock_ns)):
            # Number 2^62 is beyond all draws of the running clock.
            rate = self._shot_unit * float(self._shot_table[block, -1])
            gap, _ = shot_draw(self.seed, np.uint64(block), np.uint64(2**62), rate)
            self._clock_ns[block] = t_ns + gap
        self._epoch_ns[0] = t_ns
        return Events.empty()

    def _advance(self, frame: np.ndarray, t_ns: int) -> Events:
        dt_ns = t_ns - self.t_ns
        self._refuse_shots(dt_ns)
        self._make_noise_sizes(dt_ns)
        pixels = Pixels(
            intensity=self._intensity,
            x=self._x,
            lag=self._lag,
            noise=self._noise,
            noise_sizes=self._noise_sizes,
            upper=self._upper,
            lower=self._lower,
            constants=self._constants,
            leak=self._leak,
            release=self._release,
            clock_ns=self._clock_ns,
            clock_index=self._clock_index,
            shot_table=self._shot_table,
            since_ns=self._since_ns,
            noise_then=self._noise_then,
            hot=self._hot,
        )
        interval = self._interval(t_ns)
        base_us = interval.base_us
        source = Source.of(frame, self._table, self._x_table)
        events = self._run(_bands, (source, pixels, interval), base_us, t_ns // 1000 - base_us)
        if t_ns - int(self._epoch_ns[0]) >= self._rebase_ns:
            self._begin_leaks_anew(t_ns)
        return events

    def _refuse_shots(self, dt_ns: int) -> None:
        """Raise EventDataError for more shot noise in an interval than a step may emit."""
        if self._shots_per_ns * dt_ns > self.config.max_events_per_step:
            raise EventDataError(
                "more shot noise than max_events_per_step in one interval",
                where=f"frame {self.frames}",
                value=f"{dt_ns} ns",
                accepted="a shorter interval or a lower shot_noise_rate_hz",
            )

    def _make_noise_sizes(self, dt_ns: int) -> None:
        """Make the table of the photoreceptor's noise for this frame spacing."""
        if self._noise.size and dt_ns != self._sizes_dt_ns:
            config = self.config
            self._noise_sizes = noise_table(
                config.shot_noise_rate_hz, dt_ns * 1e-9, noise_threshold(config), config.refractory_us * 1e-6
            )
            self._sizes_dt_ns = dt_ns

    def _interval(self, t_ns: int) -> Interval:
        """Return the interval from the last frame to ``t_ns``."""
        config, (epoch,), (start_ns, dt_ns) = self.config, self._epoch_ns.tolist(), (self.t_ns, t_ns - self.t_ns)
        # 275 DN is 255 + 20, full scale in v2e's formula for the corner frequency.
        kappa = 2 * np.pi * config.cutoff_hz * dt_ns * 1e-9 / 275.0
        # In the order of the fields of Interval.
        return Interval(
            t0_ns=start_ns,
            dt_ns=dt_ns,
            base_us=start_ns // 1000,
            since_epoch_0=(start_ns - epoch) * 1e-9,
            since_epoch_1=(t_ns - epoch) * 1e-9,
            kappa=kappa,
            scale=self._scale,
            seed=self.seed,
            step=self.frames,
            width=self.width,
            refractory_ns=self._refractory_ns,
            leak_jitter=self._leak_jitter,
            shot_unit_per_ns=self._shot_unit,
            inverse_threshold=self._inverse_threshold,
            bound_per_pixel=dt_ns // self._refractory_ns + 2 if self._refractory_ns else 2**31,
        )

    def _begin_leaks_anew(self, t_ns: int) -> None:
        """Move what has leaked until ``t_ns`` into the levels, and restart the leak clock."""
        gone = self._leak * np.float32((t_ns - int(self._epoch_ns[0])) * 1e-9)
        self._upper -= gone
        self._lower -= gone
        self._epoch_ns[0] = t_ns
