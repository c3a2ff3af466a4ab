"""DVS-Voltmeter: the pixel voltage as Brownian motion with drift between two absorbing thresholds.

Lin, Ma, Guo, Wen, "DVS-Voltmeter: Stochastic Process-based Event Simulator for Dynamic Vision Sensors", ECCV 2022,
sections 3 and 4. In an interval with intensities L0 -> L1 (digital numbers) and mean L, times in us,

    mu    = k1 (L1 - L0)/dt / (L + k2) + k4 + k5 L        drift: signal, temperature, parasitic photocurrent
    sigma = k3 sqrt(L) / (L + k2) + k6                    photon shot noise, circuit

dV = mu dt + sigma dW from V in (-1, 1); at +1 an ON event, at -1 an OFF event, then V = 0.

The equation is solved exactly, so that noise is the same at any frame rate:

* A pixel far from both thresholds draws nothing. It keeps the mean of V and the *unspent variance*, the sum of
  sigma^2 dt since V was last known. Where the mean path comes within 6.5 standard deviations of a threshold, the
  pixel is processed: V is drawn at the interval's start, and the variance is spent. A path that crosses and returns
  before that is missed, with probability below 1.6e-10 per interval (4 Q(6.5), both sides).
* A processed pixel draws the time at which it meets the reachable threshold: inverse Gaussian with mean a/|mu| and
  shape a^2/sigma^2 for a distance a (the law against the drift, met with probability exp(-2 |mu| a/sigma^2), is the
  same; without drift it is Levy's). If that time is after the interval's end, V at the end is drawn under the
  condition that the threshold was not met: normal, accepted with the probability 1 - exp(-2 a b/sigma^2 dt) that a
  Brownian bridge to the distance b has not met it. Where both thresholds are reachable the interval is divided into
  parts so short that one of them is not (again to 1.6e-10).
* V starts at the stationary law of a still scene (:func:`start_voltage`), not at 0 everywhere, where all pixels of a
  flat image would have their first leak event at the same time.

V is stored in units of 2^-29, fine enough for a leak of one event an hour at any frame rate.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from blinkgl.config.events import EsimConfig, VoltmeterConfig
from blinkgl.events.bands import BLOCK, driver
from blinkgl.events.emulator import NEVER_NS, Emulator, Source
from blinkgl.events.packing import (
    CAUSE_SHIFT,
    T_SHIFT,
    cause_of,
    copy_block,
    lookup_block,
    scale_block,
)
from blinkgl.events.philox import Stream, normal2_and_uniform
from blinkgl.events.response import Response
from blinkgl.events.table import register
from blinkgl.events.voltmeter_model import (
    NEAREST,
    V_ONE,
    crosses,
    drift_and_noise,
    hitting_time,
    move,
    near_threshold,
    reach_of_part,
    reached,
    start_by_leak,
    start_voltage,
)
from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Events

_F = np.float32
# Typed constants: a float literal is float64 to numba and would widen the float32 loops.
_ZERO, _HALF, _I0 = _F(0.0), _F(0.5), np.int32(0)
_DIFFUSION = np.uint64(Stream.DIFFUSION)
# Draw numbers are step * 2^20 + draw within the step.
_U1000, _U20, _U1, _U2, _MAX_BOUND = np.uint64(1000), np.uint64(20), np.uint64(1), np.uint64(2), np.float32(1e7)
IN_DEAD_TIME = np.int32(2 * V_ONE - 1)
"""Voltage of a pixel in its dead time: always near a threshold, so that the pixel is processed."""
MAX_DRAWS = 2**19
TRIES = 500
"""Largest number of draws of an end value: the first one nearly always fits, unless the time before was a rounding
error."""
_MAX_DRAWS, _TRIES = np.uint64(MAX_DRAWS), np.uint64(TRIES)


class Pixels(NamedTuple):
    """Per-pixel arrays, flat."""

    intensity: np.ndarray  # float32 DN of the frame before
    v: np.ndarray  # int32 mean voltage, 2^-29 thresholds
    unspent: np.ndarray  # float32 variance of the voltage around it, thresholds^2; 0 where V is known
    release: np.ndarray  # int64 ns, end of the dead time or NEVER; [] without dead time
    by_light: np.ndarray  # float32: part of V caused by light and leak since it was 0; [] without causes
    by_leak: np.ndarray


class Ends(NamedTuple):
    """State of one block at the interval's end, as in :class:`Pixels`."""

    intensity: np.ndarray
    v: np.ndarray
    unspent: np.ndarray
    light: np.ndarray
    leak: np.ndarray


class Interval(NamedTuple):
    """Values of a step that are the same for all pixels; k1 to k6 are the model's parameters, times in µs."""

    t0_ns: int
    dt_ns: int
    base_us: int
    k1: float
    k2: float
    k3: float
    k4: float
    k5: float
    k6: float
    scale: np.float32
    seed: np.uint64
    width: int
    step: int
    refractory_ns: int
    bound_per_pixel: int


@kernel(error_model="numpy")
def _sense_block(before, now, v, unspent, interval, v_end, unspent_end, flags):
    """Write mean and variance of V at the end to ``v_end`` and ``unspent_end``, and flag the pixels to process. Return
    the largest mean number of events."""
    dt_us = interval.dt_ns * 1e-3
    # Once per block and in float32; dt_us multiplies what is a rate.
    k1, k2, k3, k6 = _F(interval.k1), _F(interval.k2), _F(interval.k3), _F(interval.k6)
    k4_dt, k5_dt, root_dt = _F(interval.k4 * dt_us), _F(interval.k5 * dt_us), _F(np.sqrt(dt_us))
    most = _I0
    for i in range(now.size):
        drift, noise = drift_and_noise(before[i], now[i], k1, k2, k3, k4_dt, k5_dt, k6, root_dt)
        end = move(v[i], drift)
        here = _F(noise * noise)
        variance = _F(unspent[i] + here)
        v_end[i] = end
        unspent_end[i] = variance
        flags[i] = np.uint8(near_threshold(v[i], end, variance, here))
        # Mean number of events between thresholds at +-1: |mu| dt of the drift alone, sigma^2 dt of
        # the diffusion alone.
        mean_events = _F(abs(drift) + here)
        # Floats >= 0 are ordered as their bits; this loop vectorises.
        most = max(most, mean_events.view(np.int32))
    return np.int32(most).view(np.float32)


@kernel(error_model="numpy")
def _share_block(before, now, by_light, by_leak, interval, light_end, leak_end):
    """Compute how far light and leak have moved V by the interval's end if nothing fires."""
    dt_us = interval.dt_ns * 1e-3
    k1, k2, k4_dt, k5_dt = _F(interval.k1), _F(interval.k2), _F(interval.k4 * dt_us), _F(interval.k5 * dt_us)
    # The drift of V at the interval's mean light.
    for i in range(now.size):
        mean = _HALF * (before[i] + now[i])
        light_end[i] = by_light[i] + k1 * (now[i] - before[i]) / (mean + k2)
        leak_end[i] = by_leak[i] + (k4_dt + k5_dt * mean)


@register_jitable
def rates(before: float, after: float, dt_us: float, v: Interval) -> tuple[float, float, float]:
    """Return (mu, its leak part, sigma) per us: :func:`drift_and_noise` in double precision, since a pixel may fire at
    any time."""
    mean = 0.5 * (before + after)
    leak = v.k4 + v.k5 * mean
    return v.k1 * (after - before) / dt_us / (mean + v.k2) + leak, leak, v.k3 * np.sqrt(mean) / (mean + v.k2) + v.k6


@register_jitable
def cause_at(side: int, since_us: float, light: float, leak: float, mu: float, leak_rate: float) -> int:
    """Return the cause of an event at the threshold ``side`` (1, -1), ``since_us`` after V's parts were ``light`` and
    ``leak``."""
    by_light, by_leak = light + (mu - leak_rate) * since_us, leak + leak_rate * since_us
    # Light, leak, and noise as the rest of the distance to the threshold.
    return cause_of(side * by_light, side * by_leak, 1.0 - side * (by_light + by_leak))


@register_jitable
def _passage(side, distance, toward, sigma, normal, uniform):
    """Return the time, us, at which V passes the threshold ``distance`` away; infinity: never. side : 0 where neither
    threshold is in reach.   toward : drift towards it, per us."""
    # One uniform decides whether the threshold is ever met and, divided by the chance, which root the time is.
    chance = reached(distance, toward, sigma) if side else 0.0
    if uniform >= chance:
        return np.inf
    return hitting_time(distance, toward, sigma, normal, uniform if chance == 1.0 else uniform / chance)


@register_jitable
def _end_of_part(side, distance, mean, noise, seed, pixel, draw):
    """Return (V at the end of a part in which no threshold is met, number of the last draw): V is drawn until it is
    accepted, with the probability by which a Brownian bridge does not meet the threshold."""
    stop = draw + _TRIES
    while True:
        draw += _U1
        normal, _, uniform = normal2_and_uniform(seed, pixel, _DIFFUSION, draw)
        end = mean + noise * normal
        if side == 0 or draw >= stop or uniform >= crosses(distance, 1.0 - side * end, noise):
            return max(min(end, NEAREST), -NEAREST), draw


class _State(NamedTuple):
    """A pixel at a time in the interval."""

    t_us: float  # from the interval's start
    voltage: float
    variance: float  # unspent, see the module
    since_us: float  # when V's parts were last known, and what they were
    light: float
    leak: float


@kernel(error_model="numpy")
def _emit_block(active, first, end, p, v, cap, packed, begin):
    """Write the events of the listed pixels of one block to ``packed[begin:]``, in raster order, and move their
    voltages.

    Returns (end of the events, events cut)."""
    out, cut = begin, 0
    dt_us = v.dt_ns * 1e-3
    # The listed pixels are in raster order: the row is counted along. ``row_end``: first pixel behind
    # row y.
    y = first // v.width
    row_end = (y + 1) * v.width
    v_end, unspent_end, light_end, leak_end = end.v, end.unspent, end.light, end.leak
    explained = p.by_light.size > 0
    for j in range(active.size):
        i = np.int64(active[j])
        while i >= row_end:
            y += 1
            row_end += v.width
        o = i - first
        # Dead until the interval's end: nothing fires, and V keeps the mark.
        waiting = p.release.size > 0 and p.release[i] != NEVER_NS
        if waiting and p.release[i] > v.t0_ns + v.dt_ns:
            v_end[o], unspent_end[o] = IN_DEAD_TIME, _ZERO
            if explained:
                light_end[o] = leak_end[o] = _ZERO
            continue
        light, leak = (np.float64(p.by_light[i]), np.float64(p.by_leak[i])) if explained else (0.0, 0.0)
        state = _State(0.0, p.v[i] / V_ONE, np.float64(p.unspent[i]), 0.0, light, leak)
        if waiting:
            # Released within the interval: V is known to be 0 at that time.
            t_us = max(p.release[i] - v.t0_ns, 0) * 1e-3
            state = _State(t_us, 0.0, 0.0, t_us, light, leak)
            p.release[i] = NEVER_NS
        moved = rates(np.float64(p.intensity[i]), np.float64(end.intensity[o]), dt_us, v)
        # The packed word (packing.py) without time and polarity.
        word = (y << 17) | ((i - row_end + v.width) << 1)
        state, release_ns, out, cut_here = _emit_pixel(i, word, state, moved, v, explained, cap, packed, out)
        cut += cut_here
        dead = release_ns != NEVER_NS
        if dead:
            p.release[i] = v.t0_ns + release_ns
        v_end[o] = IN_DEAD_TIME if dead else np.int32(state.voltage * V_ONE)
        if explained:
            mu, leak_rate, _ = moved
            rest_us = 0.0 if dead else dt_us - state.since_us
            light_end[o] = np.float32(0.0 if dead else state.light + (mu - leak_rate) * rest_us)
            leak_end[o] = np.float32(0.0 if dead else state.leak + leak_rate * rest_us)
        unspent_end[o] = _ZERO if dead else np.float32(state.variance)
    return out, cut


@register_jitable(inline="always")
def _emit_pixel(i, pixel_word, state, moved, v, explained, cap, packed, out):
    """Write the events of pixel ``i`` to ``packed[out:]``, at most ``cap``. moved : mu, its leak part and sigma, see
    :func:`rates`. Return (state at the end, end of its dead time beyond the interval, ns from the interval's start, or
    NEVER_NS, end of the events, events cut)."""
    mu, leak_rate, sigma = moved
    t_us, voltage, variance, since_us, light, leak = state
    dt_us, start_ns = v.dt_ns * 1e-3, v.t0_ns - 1000 * v.base_us
    emitted, cut, release_ns = 0, 0, np.int64(NEVER_NS)
    # The first block of random numbers: V at the interval's start, the time of the first event, which of its two roots.
    # One more for each event that follows, and for each end that is drawn. 20 bits count them within a step.
    draw = np.uint64(v.step) << _U20
    last = draw + _MAX_DRAWS
    past, normal, uniform = normal2_and_uniform(v.seed, np.uint64(i), _DIFFUSION, draw)
    unused = True
    if variance > 0.0:
        # Spends the variance: V at the interval's start is drawn around its mean.
        voltage, variance = max(min(voltage + np.sqrt(variance) * past, NEAREST), -NEAREST), 0.0
    # One turn per part of the interval, at most one event in each, until no threshold is in reach.
    while t_us < dt_us:
        left_us = dt_us - t_us
        part_us, side = reach_of_part(voltage, mu, sigma, left_us)
        # No threshold is reachable in the rest: nothing is drawn, the variance stays unspent.
        if side == 0 and part_us == left_us:
            voltage += mu * left_us
            variance = sigma * sigma * left_us
            break
        if not unused:
            draw += _U1
            _, normal, uniform = normal2_and_uniform(v.seed, np.uint64(i), _DIFFUSION, draw)
        unused = False
        distance = 1.0 - side * voltage
        after_us = _passage(side, distance, side * mu, sigma, normal, uniform)
        if not after_us <= part_us:
            # Not met in this part.
            mean, noise = voltage + mu * part_us, sigma * np.sqrt(part_us)
            voltage, draw = _end_of_part(side, distance, mean, noise, v.seed, np.uint64(i), draw)
            t_us += part_us
            if part_us == left_us or draw >= last:
                break
            continue
        # An event resets V to 0, and the rest of the interval continues from there.
        t_us += after_us
        event_ns, voltage = min(np.int64(t_us * 1e3), v.dt_ns), 0.0
        if emitted == cap or draw >= last:  # too many to draw them all: count the expected number
            cut, since_us, light, leak = 1 + np.int64((dt_us - t_us) * max(abs(mu), sigma * sigma)), dt_us, 0.0, 0.0
            break
        word = pixel_word | np.int64(side > 0)
        if explained:
            word |= cause_at(side, t_us - since_us, light, leak, mu, leak_rate) << CAUSE_SHIFT
        packed[out] = (np.int64(np.uint64(start_ns + event_ns) // _U1000) << T_SHIFT) | word
        out += 1
        emitted += 1
        if v.refractory_ns > 0:
            # Dead beyond the interval's end, or V restarts from 0 within it.
            if event_ns + v.refractory_ns > v.dt_ns:
                release_ns = event_ns + v.refractory_ns
                break
            t_us = (event_ns + v.refractory_ns) * 1e-3
        since_us, light, leak = t_us, 0.0, 0.0
    return _State(t_us, voltage, variance, since_us, light, leak), release_ns, out, cut


@register_jitable(inline="always")
def _sense(block, s, e, source, p, v, flags, scratch):
    """See :mod:`blinkgl.events.bands`."""
    now = scratch.intensity[: e - s]
    if source.codes.size:
        lookup_block(source.codes[s:e], source.table, now)
    else:
        scale_block(source.frame[s:e], v.scale, now)
    most = _sense_block(p.intensity[s:e], now, p.v[s:e], p.unspent[s:e], v, scratch.v, scratch.unspent, flags)
    if p.by_light.size:
        _share_block(p.intensity[s:e], now, p.by_light[s:e], p.by_leak[s:e], v, scratch.light, scratch.leak)
    most = np.float64(min(most, _MAX_BOUND))
    # The cap is far above the mean plus random fluctuations.
    return min(np.int64(2 * most + 8 * np.sqrt(most)) + 8, v.bound_per_pixel), scratch


@register_jitable(inline="always")
def _keep(block, s, e, end, p):
    n = e - s
    copy_block(end.intensity[:n], p.intensity[s:e])
    copy_block(end.v[:n], p.v[s:e])
    copy_block(end.unspent[:n], p.unspent[s:e])
    if p.by_light.size:
        copy_block(end.light[:n], p.by_light[s:e])
        copy_block(end.leak[:n], p.by_leak[s:e])


_drive = driver(_sense, _emit_block, _keep)


@kernel(error_model="numpy")
def _bands(taken, start, work, source, p, v):
    shares = BLOCK if p.by_light.size else 0
    scratch = Ends(
        np.empty(BLOCK, _F), np.empty(BLOCK, np.int32), np.empty(BLOCK, _F), np.empty(shares, _F), np.empty(shares, _F)
    )
    _drive(taken, start, work, source, p, v, scratch)


@register
class DvsVoltmeter(Emulator):
    """The DVS-Voltmeter emulator, see the module and :class:`~blinkgl.events.emulator.Emulator`. Luminance 1.0 is
    ``config.full_scale`` DN.

    State: 12 bytes per pixel, 8 more with a dead time, 8 more with causes. ``saturated`` counts the expected number of
    the events that were not drawn."""

    Config = VoltmeterConfig
    noisy = True
    _state = ("_intensity", "_v", "_unspent", "_release", "_by_light", "_by_leak")

    @classmethod
    def response(cls, config: VoltmeterConfig) -> Response:
        # Without noise and leak V is k1 ln(L + k2) but for a constant, and its threshold is 1.
        return Response(1.0, config.k1, config.k2 / config.full_scale)

    @classmethod
    def noiseless(cls, config: VoltmeterConfig) -> EsimConfig:
        # V's threshold of 1 is 1 / k1 in ln units, here limited to what ESIM accepts.
        return EsimConfig(contrast_threshold=min(max(1 / config.k1, 0.001), 10))

    def __init__(
        self,
        height: int,
        width: int,
        config: VoltmeterConfig | None = None,
        seed: int = 0,
    ):
        super().__init__(height, width, seed)
        self.config = config = config or VoltmeterConfig()
        pixels = self.height * self.width
        # Arrays of features that are off have size 0, which the kernels test.
        self._intensity, self._v = np.zeros(pixels, np.float32), np.zeros(pixels, np.int32)
        self._unspent = np.zeros(pixels, np.float32)
        self._by_light, self._by_leak = (np.zeros(pixels if config.causes else 0, np.float32) for _ in range(2))
        self._refractory_ns = round(config.refractory_us * 1000)
        self._release = np.full(pixels if self._refractory_ns else 0, NEVER_NS, np.int64)
        self._scale = np.float32(config.full_scale)
        self._tables_changed()

    def _tables_changed(self) -> None:
        self._table = self._decode * self._scale

    def _start(self, frame: np.ndarray, t_ns: int) -> Events:
        self._intensity[...] = self._table[frame] if frame.dtype == np.uint8 else frame * self._scale
        if self.config.start == "stationary":
            self._v[...], left_us = start_voltage(self._intensity, self.config, self.seed)
            dead = np.flatnonzero(left_us)
            self._v[dead] = IN_DEAD_TIME
            self._release[dead] = t_ns + (left_us[dead] * 1e3).astype(np.int64)
            if self.causes:
                self._by_leak[...] = start_by_leak(self._v, self._intensity, self.config)
        return Events.empty()

    def _advance(self, frame: np.ndarray, t_ns: int) -> Events:
        c, dt_ns, base_us = self.config, t_ns - self.t_ns, self.t_ns // 1000
        pixels = Pixels(self._intensity, self._v, self._unspent, self._release, self._by_light, self._by_leak)
        # In the order of the fields of Interval. The last bound: at most one event per dead time, and
        # one at either end.
        interval = Interval(
            t0_ns=self.t_ns,
            dt_ns=dt_ns,
            base_us=base_us,
            k1=c.k1,
            k2=c.k2,
            k3=c.k3,
            k4=c.k4,
            k5=c.k5,
            k6=c.k6,
            scale=self._scale,
            seed=self.seed,
            width=self.width,
            step=self.frames,
            refractory_ns=self._refractory_ns,
            bound_per_pixel=dt_ns // self._refractory_ns + 2 if self._refractory_ns else 2**31,
        )
        return self._run(_bands, (Source.of(frame, self._table), pixels, interval), base_us, t_ns // 1000 - base_us)
