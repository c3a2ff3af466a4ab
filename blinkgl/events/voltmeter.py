"""DVS-Voltmeter: the pixel voltage as Brownian motion with drift between two absorbing thresholds.

Lin, Ma, Guo, Wen, "DVS-Voltmeter: Stochastic Process-based Event Simulator for Dynamic Vision Sensors", ECCV 2022,
sections 3 and 4. In an interval with intensities L0 -> L1 (digital numbers) and mean L, times in us,

    mu    = k1 (L1 - L0)/dt / (L + k2) + k4 + k5 L        drift: signal, temperature, parasitic photocurrent
    sigma = k3 sqrt(L) / (L + k2) + k6                    photon shot noise, circuit

dV = mu dt + sigma dW from V in (-1, 1); at +1 an ON event, at -1 an OFF event, V back to 0. Which threshold comes
first has the closed form :func:`on_first`; the time to it is inverse Gaussian with mean a/|mu| and shape
a^2/sigma^2 (the law against the drift, given that it is reached, is the same; without drift it is Levy's). A time
beyond the frame's end is discarded, and V carries its drift into the next interval.

Far from both thresholds (more than 6.5 sigma sqrt(dt) at both ends of the drift; probability 1e-10) nothing is
drawn. V is kept in 2^-29, fine enough for a leak of one event an hour at any frame rate.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numba.extending import register_jitable

from blinkgl.config.events import EsimConfig, VoltmeterConfig
from blinkgl.events.arith import exp_f64, select
from blinkgl.events.blocks import compact_flags, copy_block, lookup_block, scale_block
from blinkgl.events.emulator import BLOCK, NEVER_NS, NO_CODES, NO_FRAME, Emulator
from blinkgl.events.packing import JIT, T_SHIFT
from blinkgl.events.philox import Stream, normal_and_uniform, uniform2
from blinkgl.events.response import Response
from blinkgl.events.threads import take_part
from blinkgl.events.types import Events

_F = np.float32
_HALF, _ONE, _I0 = _F(0.5), _F(1.0), np.int32(0)
V_ONE = 2**29
_V_SCALE, _V_UNIT, _DRIFT_LIMIT = _F(V_ONE), _F(1.0 / V_ONE), _F(2.25)
_DIFFUSION = np.uint64(Stream.DIFFUSION)
_U1000, _U20, _U1, _MAX_BOUND = np.uint64(1000), np.uint64(20), np.uint64(1), np.float32(1e7)
_FAR_64 = 6.5
FAR = np.float32(6.5)
NEAREST = 1.0 - 1e-6
"""|V| carried over never exceeds this: a threshold that the drift has passed is then reached at once."""
IN_DEAD_TIME = np.int32(2 * V_ONE - 1)
"""Voltage of a pixel in its dead time: never far from a threshold, so that the pixel is looked at."""
MAX_DRAWS = 2**19


@register_jitable
def drift_and_noise(
    before: float, now: float, k1: float, k2: float, k3: float, k4_dt: float, k5_dt: float, k6: float, root_dt: float
) -> tuple[float, float]:
    """(mu dt, sigma sqrt(dt)) of an interval, elementwise; k4_dt = k4 dt, root_dt = sqrt(dt), dt in us."""
    mean = _HALF * (before + now)
    room = mean + k2  # (L + k2): the gain of the logarithm
    return k1 * (now - before) / room + k4_dt + k5_dt * mean, (k3 * np.sqrt(mean) / room + k6) * root_dt


@register_jitable
def move(v: float, drift: float) -> float:
    """V (int32, 2^-29) at the interval's end if nothing fires; a drift beyond 2.25 thresholds is cut to that."""
    cut = select(drift > _DRIFT_LIMIT, _DRIFT_LIMIT, select(drift < -_DRIFT_LIMIT, -_DRIFT_LIMIT, drift))
    return np.int32(v + np.int32(cut * _V_SCALE))


@register_jitable
def near_threshold(v: float, v_end: float, noise: float) -> bool:
    """Whether a threshold may be reached: 6.5 sigma sqrt(dt) around the path's extremes."""
    high, low = select(v > v_end, v, v_end), select(v > v_end, v_end, v)
    reach = FAR * noise
    return (_F(high) * _V_UNIT + reach >= _ONE) | (_F(low) * _V_UNIT - reach <= -_ONE)


@register_jitable
def in_reach(v: float, drift: float, noise: float) -> bool:
    """:func:`near_threshold` for the rest of an interval, float64, V in thresholds."""
    reach = _FAR_64 * noise
    return max(v, v + drift) + reach >= 1.0 or min(v, v + drift) - reach <= -1.0


@register_jitable
def one_minus_exp(x: float) -> float:
    """1 - e^-x for x >= 0, to 1e-11 relative."""
    return x * (1.0 - x * (0.5 - x * (1.0 / 6.0))) if x < 1e-4 else 1.0 - exp_f64(-x)


@register_jitable
def on_first(to_on: float, to_off: float, mu: float, sigma: float) -> float:
    """P(+threshold before -threshold) for drift mu and diffusion sigma, at distances to_on and to_off > 0.

    (e^{2 mu b/s^2} - 1)/(e^{2 mu b/s^2} - e^{-2 mu a/s^2}) (Lin et al. 2022, eq. 9), arranged so that nothing
    overflows and small drifts do not cancel; b/(a + b) without drift.
    """
    variance = sigma * sigma
    if variance == 0.0:
        return 1.0 if mu > 0 else 0.0
    rate = 2.0 * abs(mu) / variance
    span = rate * (to_on + to_off)
    if span < 1e-12:
        return to_off / (to_on + to_off)
    if rate * to_off > 40.0 and (mu > 0 or rate * to_on > 60.0):
        return 1.0 if mu > 0 else 0.0  # to within 1e-17
    if mu > 0:
        return one_minus_exp(rate * to_off) / one_minus_exp(span)
    return one_minus_exp(rate * to_off) * exp_f64(-rate * to_on) / one_minus_exp(span)


@register_jitable
def hitting_time(distance: float, mu: float, sigma: float, normal: float, uniform: float) -> float:
    """Time to a threshold at ``distance`` > 0 that is reached: inverse Gaussian, mean distance/|mu|, shape
    distance^2/sigma^2; Levy's law without drift.

    Michael, Schucany, Haas (1976): the smaller root of a quadratic in the squared normal, or its conjugate. The
    root is written with a sum in the denominator, so that it keeps its digits for small drifts and tends to
    distance^2/(sigma normal)^2, which is Levy's law.
    """
    speed = abs(mu)
    g = normal * normal * sigma * sigma / (2.0 * distance)
    denominator = speed + g + np.sqrt(g * (g + 2.0 * speed))
    if denominator == 0.0:
        return np.inf
    root = distance / denominator
    ratio = root * speed / distance  # root / mean
    if uniform * (1.0 + ratio) <= 1.0:
        return root
    return distance / (speed * ratio)


class Pixels(NamedTuple):
    """Per-pixel arrays, flat."""

    intensity: np.ndarray  # float32 DN of the frame before
    v: np.ndarray  # int32 voltage, 2^-29 thresholds
    release: np.ndarray  # int64 ns, end of the dead time or NEVER; [] without dead time


class Interval(NamedTuple):
    """What is the same for all pixels of a step; k1 to k6 are the model's parameters, times in µs."""

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


@numba.njit(**JIT)
def _sense_block(before, now, v, interval, v_end, flags):
    """V at the end into ``v_end``, flags of pixels that may fire; returns the largest mean number of events."""
    dt_us = interval.dt_ns * 1e-3
    k1, k2, k3, k6 = _F(interval.k1), _F(interval.k2), _F(interval.k3), _F(interval.k6)
    k4_dt, k5_dt, root_dt = _F(interval.k4 * dt_us), _F(interval.k5 * dt_us), _F(np.sqrt(dt_us))
    most = _I0
    for i in range(now.size):
        drift, noise = drift_and_noise(before[i], now[i], k1, k2, k3, k4_dt, k5_dt, k6, root_dt)
        end = move(v[i], drift)
        v_end[i] = end
        flags[i] = np.uint8(near_threshold(v[i], end, noise))
        # Mean number of events between thresholds at +-1: |mu| dt of the drift alone, sigma^2 dt of the diffusion
        # alone.
        mean_events = _F(abs(drift) + noise * noise)
        most = max(most, mean_events.view(np.int32))  # floats >= 0 are ordered as their bits; this loop vectorises
    return np.int32(most).view(np.float32)


@numba.njit(**JIT)
def _emit_block(active, count, first, now, v_end, p, v, cap, packed, begin):
    """Events of the listed pixels of one block into ``packed[begin:]``, in raster order; moves their voltages.

    Returns (end of the events, events cut)."""
    out, cut = begin, 0
    dt_us = v.dt_ns * 1e-3
    start_ns = v.t0_ns - 1000 * v.base_us
    y = first // v.width
    row_end = (y + 1) * v.width
    for j in range(count):
        i = np.int64(active[j])
        while i >= row_end:
            y += 1
            row_end += v.width
        pixel = (y << 17) | ((i - row_end + v.width) << 1)
        before, after = np.float64(p.intensity[i]), np.float64(now[i - first])
        mean = 0.5 * (before + after)
        # drift_and_noise, once more in double precision and per us: a pixel may fire at any time of the interval.
        mu = v.k1 * (after - before) / dt_us / (mean + v.k2) + v.k4 + v.k5 * mean
        sigma = v.k3 * np.sqrt(mean) / (mean + v.k2) + v.k6
        voltage = p.v[i] / V_ONE
        t_us = 0.0
        if p.release.size and p.release[i] != NEVER_NS:
            if p.release[i] > v.t0_ns + v.dt_ns:
                v_end[i - first] = IN_DEAD_TIME
                continue
            t_us, voltage = max(p.release[i] - v.t0_ns, 0) * 1e-3, 0.0
            p.release[i] = NEVER_NS
        emitted, draw, dead = 0, 0, False
        # One turn per event, after which V is 0 again, until no threshold is reached before the frame's end.
        while True:
            left_us = dt_us - t_us
            if not in_reach(voltage, mu * left_us, sigma * np.sqrt(left_us)):
                voltage += mu * left_us
                break
            # Two blocks a draw: (normal, uniform), then the side.
            index = (np.uint64(v.step) << _U20) | np.uint64(2 * draw)
            normal, which = normal_and_uniform(v.seed, np.uint64(i), _DIFFUSION, index)
            chance = on_first(1.0 - voltage, 1.0 + voltage, mu, sigma)
            polarity = np.int64(chance)  # where it is certain, no number is drawn
            if 0.0 < chance < 1.0:
                side, _ = uniform2(v.seed, np.uint64(i), _DIFFUSION, index + _U1)
                polarity = np.int64(side < chance)
            distance = 1.0 - voltage if polarity else 1.0 + voltage
            hit_us = t_us + hitting_time(distance, mu, sigma, normal, which)
            # Too late, or never (inf): no event, and V takes its drift along, as in the paper's algorithm.
            if not hit_us <= dt_us:
                voltage = max(min(voltage + mu * left_us, NEAREST), -NEAREST)
                break
            draw += 1
            voltage, t_us = 0.0, hit_us
            event_ns = min(np.int64(hit_us * 1e3), v.dt_ns)
            if emitted == cap or draw == MAX_DRAWS:  # too many to draw them all: count what is to be expected
                cut += 1 + np.int64((dt_us - t_us) * max(abs(mu), sigma * sigma))
                break
            packed[out] = (np.int64(np.uint64(start_ns + event_ns) // _U1000) << T_SHIFT) | pixel | polarity
            out += 1
            emitted += 1
            if p.release.size:
                release_ns = event_ns + v.refractory_ns
                if release_ns > v.dt_ns:
                    p.release[i] = v.t0_ns + release_ns
                    dead = True
                    break
                t_us = release_ns * 1e-3
        v_end[i - first] = IN_DEAD_TIME if dead else np.int32(voltage * V_ONE)
    return out, cut


@numba.njit(**JIT)
def _band(first_block, stop_block, share, packed, filled, frame, codes, table, p, v):
    """Band kernel, see :meth:`Emulator._run`."""
    cut, pixels = 0, p.v.size
    flags, scratch, active = np.zeros(BLOCK, np.uint8), np.empty(BLOCK // 8, np.int64), np.empty(BLOCK + 8, np.int32)
    now, v_end = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.int32)
    for block in range(first_block, stop_block):
        s = block * BLOCK
        e = min(s + BLOCK, pixels)
        n = e - s
        if n < BLOCK:
            flags[:] = 0
        if codes.size:
            lookup_block(codes[s:e], table, now[:n])
        else:
            scale_block(frame[s:e], v.scale, now[:n])
        most = _sense_block(p.intensity[s:e], now[:n], p.v[s:e], v, v_end, flags)
        most = np.float64(min(most, _MAX_BOUND))
        count = compact_flags(flags, scratch, s, active)
        if count:
            # Far beyond what chance adds to the mean.
            cap = min(np.int64(2 * most + 8 * np.sqrt(most)) + 8, v.bound_per_pixel)
            if count * cap > share:
                cap = max(1, share // count)
            if filled + count * cap > packed.size:
                return block, filled, cut
            filled, cut_here = _emit_block(active, count, s, now, v_end, p, v, cap, packed, filled)
            cut += cut_here
        copy_block(now[:n], p.intensity[s:e])
        copy_block(v_end[:n], p.v[s:e])
    return stop_block, filled, cut


@numba.njit(**JIT)
def _bands(taken, start, edges, progress, share, packed, frame, codes, table, p, v):
    b = take_part(taken, start)
    while b >= 0:
        block, filled, cut = _band(
            progress[b, 0], edges[b + 1], share, packed[b], progress[b, 1], frame, codes, table, p, v
        )
        progress[b, 0], progress[b, 1] = block, filled
        progress[b, 2] += cut
        b = take_part(taken, start)


class DvsVoltmeter(Emulator):
    """See the module and :class:`~blinkgl.events.emulator.Emulator`. Luminance 1.0 is ``config.full_scale`` DN.

    State: 8 bytes per pixel, 8 more with a dead time. V starts at 0. ``saturated`` counts the expected number of
    the events that were not drawn."""

    Config = VoltmeterConfig
    _state = ("_intensity", "_v", "_release")

    @classmethod
    def response(cls, config: VoltmeterConfig) -> Response:
        return Response(1.0, config.k1, config.k2 / config.full_scale)

    @classmethod
    def noiseless(cls, config: VoltmeterConfig) -> EsimConfig:
        return EsimConfig(contrast_threshold=min(max(1 / config.k1, 0.001), 10))

    def __init__(
        self,
        height: int,
        width: int,
        config: VoltmeterConfig | None = None,
        seed: int = 0,
        reconstruction: str = "linear",
    ):
        super().__init__(height, width, seed, reconstruction)
        self.config = config = config or VoltmeterConfig()
        pixels = self.height * self.width
        self._intensity, self._v = np.zeros(pixels, np.float32), np.zeros(pixels, np.int32)
        self._refractory_ns = round(config.refractory_us * 1000)
        self._release = np.full(pixels if self._refractory_ns else 0, NEVER_NS, np.int64)
        self._scale = np.float32(config.full_scale)
        self._tables_changed()

    def _tables_changed(self) -> None:
        self._table = self._decode * self._scale

    def _start(self, frame: np.ndarray, t_ns: int, rate: np.ndarray | None) -> Events:
        self._intensity[...] = self._table[frame] if frame.dtype == np.uint8 else frame * self._scale
        return Events.empty()

    def _advance(self, frame: np.ndarray, t_ns: int, rate: np.ndarray | None) -> Events:
        c, dt_ns, base_us = self.config, t_ns - self.t_ns, self.t_ns // 1000
        pixels = Pixels(self._intensity, self._v, self._release)
        interval = Interval(
            self.t_ns,
            dt_ns,
            base_us,
            c.k1,
            c.k2,
            c.k3,
            c.k4,
            c.k5,
            c.k6,
            self._scale,
            self.seed,
            self.width,
            self.frames,
            self._refractory_ns,
            dt_ns // self._refractory_ns + 2 if self._refractory_ns else 2**31,
        )
        source = (NO_FRAME, frame) if frame.dtype == np.uint8 else (frame, NO_CODES)
        return self._run(_bands, (*source, self._table, pixels, interval), base_us, t_ns // 1000 - base_us)
