"""Slow twins of the emulators: the papers, one pixel and one event at a time.

They share the elementary functions and the random numbers of the kernels (:mod:`~blinkgl.events.arith`,
:mod:`~blinkgl.events.philox`, here on NumPy arrays) and nothing else: no blocks, no packing, no threads, no compiled
code. The tests ask for equality event for event. For small frames only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.events import v2e_model as v2e, voltmeter
from blinkgl.events.arith import Q_ONE, log_q25
from blinkgl.events.noise import noise_table
from blinkgl.events.philox import (
    Stream,
    normal2,
    normal2_and_uniform,
    pixel_counters,
    rough_normal,
    uniform2,
)
from blinkgl.types.events import Events


def sorted_events(rows: list[tuple[int, int, int, int, int]], causes: bool) -> Events:
    """Events from (t_us, y, x, p, cause) rows given pixel by pixel in raster order: sorted by time, ties in that
    order."""
    rows = sorted(rows, key=lambda r: r[0])
    t, y, x, p, cause = np.array(rows, np.int64).reshape(-1, 5).T
    return Events(
        x.astype(np.uint16),
        y.astype(np.uint16),
        np.ascontiguousarray(t),
        p.astype(np.uint8),
        cause.astype(np.uint8) if causes else None,
    )


def as_luminance(frame: np.ndarray) -> np.ndarray:
    """float32 luminance; uint8 by the default decoding k / 255."""
    return frame / np.float32(255) if frame.dtype == np.uint8 else np.asarray(frame, np.float32)


class ReferenceEsim:
    """Rebecq et al. 2018, section 3, in exact integer arithmetic (log intensity in 2^-25, time in ns)."""

    def __init__(self, height: int, width: int, config: EsimConfig, seed: int = 0):
        self.shape, self.config, self.seed = (height, width), config, np.uint64(seed)
        self.levels, self.times = [], []
        q = lambda c: math.floor(c * Q_ONE + 0.5)
        nominal = [config.contrast_threshold, config.contrast_threshold_off or config.contrast_threshold]
        floor = [min(0.01, c / 2) for c in nominal]
        pixels = pixel_counters(height, width)
        spread = normal2(self.seed, pixels, np.uint64(Stream.THRESHOLD), np.uint64(0))
        self.threshold = [
            [q(min(max(c + config.threshold_sigma * n, f), 10.0)) for n in normals]
            for c, f, normals in zip(nominal, floor, spread)
        ]
        if config.threshold_sigma == 0:
            self.threshold = [[q(c)] * (height * width) for c in nominal]
        self.floor = [q(f) for f in floor]
        self.events_so_far = [0] * (height * width)
        self.last_ns: list[int | None] = [None] * (height * width)

    def next_thresholds(self, i: int) -> tuple[int, int]:
        """(C-, C+) of pixel i for its next event."""
        on, off = self.threshold[0][i], self.threshold[1][i]
        if self.config.threshold_jitter:
            draws = normal2(
                self.seed,
                np.array([i], np.uint64),
                np.uint64(Stream.JITTER),
                np.array([self.events_so_far[i]], np.uint64),
            )
            scale = self.config.threshold_jitter * Q_ONE
            on, off = (max(f, c + math.floor(scale * n[0] + 0.5)) for f, c, n in zip(self.floor, (on, off), draws))
        return off, on

    def step(self, luminance: np.ndarray, t_ns: int) -> Events:
        intensity = as_luminance(luminance) + np.float32(self.config.log_eps)
        self.levels.append([int(v) for v in log_q25(intensity).ravel()])
        self.times.append(t_ns)
        if len(self.times) == 1:
            self.reference = list(self.levels[0])
            self.next = [self.next_thresholds(i) for i in range(len(self.reference))]
        rows = []
        for i in range(len(self.reference) if len(self.times) > 1 else 0):
            before, now = (levels[i] for levels in self.levels[-2:])
            rows += self.pixel(i, before, now, *self.times[-2:])
        return sorted_events(rows, self.config.causes)

    def pixel(self, i: int, before: int, now: int, t0: int, t1: int) -> list[tuple[int, int, int, int]]:
        y, x = divmod(i, self.shape[1])
        rows = []
        while True:
            off, on = self.next[i]
            if now >= self.reference[i] + on:
                self.reference[i] += on
                p = 1
            elif now <= self.reference[i] - off:
                self.reference[i] -= off
                p = 0
            else:
                return rows
            t = t0 + (self.reference[i] - before) * (t1 - t0) // (now - before)
            self.events_so_far[i] += 1
            self.next[i] = self.next_thresholds(i)
            if self.last_ns[i] is None or t - self.last_ns[i] >= round(self.config.refractory_us * 1000):
                self.last_ns[i] = t
                rows.append((t // 1000, y, x, p, 0))


class ReferenceV2e:
    """Hu et al. 2021 in continuous time, as the docstring of :mod:`blinkgl.events.v2e` says it."""

    def __init__(self, height: int, width: int, config: V2eConfig, seed: int = 0):
        self.height, self.width, self.config, self.seed = height, width, config, np.uint64(seed)
        self.pixels = height * width
        nominal = config.contrast_threshold, config.contrast_threshold_off or config.contrast_threshold
        a, b = normal2(self.seed, pixel_counters(height, width), np.uint64(Stream.THRESHOLD), np.uint64(0))
        normals = a, b
        self.on, self.off = (
            np.clip(c + config.threshold_sigma * n, min(0.01, c / 2), 10.0).astype(np.float32)
            for c, n in zip(nominal, normals)
        )
        self.leak = v2e.draw_leaks(height, width, config, self.on, self.seed)
        if not self.leak.size:
            self.leak = np.zeros(self.pixels, np.float32)
        self.mean_leak = self.leak.copy()
        self.leaks = bool(config.leak_rate_hz or config.hot_pixel_fraction)
        self.rebase_ns = int(v2e.REBASE / float(np.median(self.leak[self.leak > 0])) * 1e9) if self.leaks else 2**61
        self.hums = bool(config.photoreceptor_noise and config.shot_noise_rate_hz)
        self.shot_table = v2e.shot_tables(self.on, self.off, *nominal)
        self.refractory = round(config.refractory_us * 1000)
        self.release: list[int | None] = [None] * self.pixels
        self.t_ns: int | None = None

    def shot_times(self, block: int) -> Iterator[tuple[int, int, int, int]]:
        """All candidate events of one block of pixels: (ns, pixel in block, polarity, index), endlessly."""
        whole = np.float64(self.shot_table[block, -1])
        rate = 0.5 * self.config.shot_noise_rate_hz * v2e.DARKEST * 1e-9 * whole
        b = np.uint64(block)
        t = self.t_ns + v2e.shot_draw(self.seed, b, np.uint64(2**62), rate)[0]
        index = 0
        while True:
            gap, pick = v2e.shot_draw(self.seed, b, np.uint64(index), rate)
            place = min(int(np.sum(self.shot_table[block] <= np.float32(pick * whole))), 2 * v2e.BLOCK - 1)
            yield int(t), place % v2e.BLOCK, int(place < v2e.BLOCK), index
            t, index = t + gap, index + 1

    def step(self, luminance: np.ndarray, t_ns: int) -> Events:
        intensity = (as_luminance(luminance) * np.float32(self.config.full_scale)).ravel()
        x = v2e.lin_log(intensity)
        rows = []
        if self.t_ns is None:
            self.t_ns = self.epoch = t_ns
            self.hum = np.zeros(0, np.float32)
            if self.hums:
                self.hum = v2e.draw_start_noise(intensity, self.config, self.seed)
            leak = self.leak if self.leaks else self.leak[:0]
            start = v2e.draw_start(self.config, intensity, self.on, self.off, leak, self.hum, self.seed)
            if self.leaks:
                self.leak = start.leak
            reference = (x + self.hum if self.hums else x) + start.offset
            lag = np.zeros(self.pixels, np.float32)
            self.upper, self.lower = reference + self.on, reference - self.off
            self.release = [t_ns + int(left) if left else None for left in start.dead_ns] or self.release
            self.since, self.noise_then = (
                t_ns - start.age_ns,
                start.by_noise + (self.hum if self.hums else np.float32(0)),
            )
            self.hot = v2e.draw_hot(self.height, self.width, self.config, self.seed)
            if self.config.shot_noise_rate_hz and not self.hums:
                self.clocks = [self.shot_times(b) for b in range(-(-self.pixels // v2e.BLOCK))]
                self.pending = [next(clock) for clock in self.clocks]
        else:
            kappa = 2 * np.pi * self.config.cutoff_hz * (t_ns - self.t_ns) * 1e-9 / 275.0
            lag = self.lag
            if self.config.cutoff_hz:
                lag = v2e.relax(self.lag, self.x, x, self.intensity, intensity, np.float32(kappa))
            noise, hum = self.noise(intensity, t_ns), np.zeros(self.pixels, np.float32)
            if self.hums:
                hum = self.photoreceptor_noise(intensity, np.float32(kappa), (t_ns - self.t_ns) * 1e-9)
            for i in range(self.pixels):
                rows += self.pixel(i, x, lag, intensity, kappa, t_ns, noise[i], hum[i])
            self.hum = hum
        self.frame = getattr(self, "frame", 0) + 1
        self.x, self.intensity, self.lag, self.t_ns = x, intensity, lag, t_ns
        if t_ns - self.epoch >= self.rebase_ns:
            gone = self.leak * np.float32((t_ns - self.epoch) * 1e-9)
            self.upper, self.lower, self.epoch = self.upper - gone, self.lower - gone, t_ns
        return sorted_events(rows, self.config.causes)

    def noise(self, intensity: np.ndarray, t_ns: int) -> list[list[tuple[int, int]]]:
        """Accepted shot noise of the interval, per pixel: (ns from its start, polarity) in time order."""
        accepted = [[] for _ in range(self.pixels)]
        for block, clock in enumerate(getattr(self, "clocks", [])):
            while self.pending[block][0] <= t_ns:
                t, offset, p, index = self.pending[block]
                self.pending[block] = next(clock)
                i = block * v2e.BLOCK + offset
                if i >= self.pixels:
                    continue
                after = max(t - self.t_ns, 0)
                here = self.intensity[i] + (intensity[i] - self.intensity[i]) * (after / (t_ns - self.t_ns))
                u, _ = uniform2(self.seed, np.uint64(block), np.uint64(Stream.SHOT), np.uint64(2 * index + 1))
                if u * v2e.DARKEST < v2e.shot_factor(here):
                    accepted[i].append((after, p))
        return [sorted(events) for events in accepted]

    def photoreceptor_noise(self, intensity: np.ndarray, kappa: np.float32, dt_s: float) -> np.ndarray:
        """The noise at the interval's end, ln units."""
        f, c = np.float32, self.config
        pairs = normal2(
            self.seed,
            np.arange((self.pixels + 1) // 2, dtype=np.uint64),
            np.uint64(Stream.NOISE),
            np.uint64(self.frame),
        )
        normals = np.stack(pairs, axis=1).ravel()[: self.pixels].astype(f)
        k = kappa * (f(0.5) * (self.intensity + intensity) + f(20))
        sizes = noise_table(c.shot_noise_rate_hz, dt_s, v2e.noise_threshold(c), c.refractory_us * 1e-6)
        below, part = v2e.noise_place(k)
        return v2e.next_noise(self.hum, k, sizes[below] + part * (sizes[below + 1] - sizes[below]), normals)

    def hum_at(self, i: int, s: float, change: float) -> float:
        """Photoreceptor noise at the fraction s of the interval."""
        return np.float64(self.hum[i]) + change * s if self.hums else np.float64(0)

    def pixel(
        self, i: int, x: int, lag: float, intensity: float, kappa: float, t_ns: int, noise: float, hum: float
    ) -> list[tuple[int, int, int, int]]:
        f = np.float64
        dt_ns, (y, column) = t_ns - self.t_ns, divmod(i, self.width)
        since = (self.t_ns - self.epoch) * 1e-9, (t_ns - self.epoch) * 1e-9
        z_now = x[i] + lag[i] if self.config.cutoff_hz else x[i]
        z_now = z_now + self.leak[i] * np.float32(since[1]) if self.leaks else z_now
        z_now = z_now + hum if self.hums else z_now
        waiting = self.release[i] is not None
        if not (waiting or noise or z_now >= self.upper[i] or z_now <= self.lower[i]):
            return []
        x0, dx = f(self.x[i]), f(x[i]) - f(self.x[i])
        curve_lag, k = f(0), f(-1)
        if self.config.cutoff_hz:
            curve_lag, k = f(self.lag[i]), kappa * (0.5 * (f(self.intensity[i]) + f(intensity[i])) + 20.0)
        leak = f(self.leak[i])
        change_of_hum = 0.0
        if self.hums:
            x0, change_of_hum = x0 + f(self.hum[i]), f(hum) - f(self.hum[i])
        base, drift = x0 + leak * since[0], change_of_hum + leak * (dt_ns * 1e-9)
        c, rise, fall = v2e.curve_of(base, drift, dx, curve_lag, k)
        z = lambda s: v2e.signal_at(s, c, rise, fall, k)
        end = base + drift + dx
        if self.config.cutoff_hz:
            end = end + f(lag[i])
        on, off, up, down = f(self.on[i]), f(self.off[i]), f(self.upper[i]), f(self.lower[i])
        s, after, rows, then = f(0), 0, [], f(self.noise_then[i])
        if waiting:
            if self.release[i] > t_ns:
                return []
            after = max(self.release[i] - self.t_ns, 0)
            s, self.release[i] = f(after / dt_ns), None
            up, down = z(s) + on, z(s) - off
            self.since[i], then = self.t_ns + after, self.hum_at(i, s, change_of_hum)
        while True:
            noise = [n for n in noise if n[0] >= after]
            p = 1 if end >= up else 0 if end <= down else None
            event = None
            if p is not None:
                level = up if p else down
                event_s = v2e.crossing_fraction(s, level, p, c, rise, fall, k, end)
                event = int(event_s * dt_ns), p, event_s, level
            if noise and (event is None or noise[0][0] <= event[0]):
                after, p = noise.pop(0)
                event = after, p, f(after / dt_ns), None
            if event is None:
                break
            after, p, s, reference = event
            sign, size = (1.0, on) if p else (-1.0, off)
            by_leak = sign * leak * ((self.t_ns + after - self.since[i]) * 1e-9)
            by_noise = sign * (self.hum_at(i, s, change_of_hum) - then)
            cause = 2 if reference is None else int(np.argmax([size - by_leak - by_noise, by_leak, by_noise]))
            rows.append(((self.t_ns + after) // 1000, y, column, p, 3 if cause == 1 and self.hot[i] else cause))
            if self.leaks and self.config.leak_jitter:
                n = rough_normal(self.seed, np.uint64(i), np.uint64(Stream.LEAK_JITTER), np.uint64(self.t_ns + after))
                self.leak[i] = np.float32(self.mean_leak[i] / max(0.1, 1.0 + self.config.leak_jitter * n))
                change = f(self.leak[i]) - leak
                leak += change
                c, rise, end = c + change * since[0], rise + change * (dt_ns * 1e-9), end + change * since[1]
                if reference is not None:
                    reference += change * (since[0] + s * (dt_ns * 1e-9))
            if self.refractory:
                after += self.refractory
                if after > dt_ns:
                    self.release[i] = self.t_ns + after
                    break
                s, reference = f(after / dt_ns), None
            if reference is None:
                reference = z(s)
            up, down = reference + on, reference - off
            self.since[i], then = self.t_ns + after, self.hum_at(i, s, change_of_hum)
        self.noise_then[i] = then
        self.upper[i], self.lower[i] = np.float32(up), np.float32(down)
        return rows


class ReferenceVoltmeter:
    """Lin et al. 2022, sections 3 and 4, as the docstring of :mod:`blinkgl.events.voltmeter` says it."""

    def __init__(self, height: int, width: int, config: VoltmeterConfig, seed: int = 0):
        self.width, self.config, self.seed = width, config, np.uint64(seed)
        self.v, self.unspent = np.zeros(height * width, np.int32), np.zeros(height * width, np.float32)
        self.release: list[int | None] = [None] * (height * width)
        self.parts = np.zeros((height * width, 2), np.float32)
        """What light and leak have moved V by since it was 0."""
        self.t_ns: int | None = None
        self.frame = 0

    def step(self, luminance: np.ndarray, t_ns: int) -> Events:
        c, f = self.config, np.float32
        intensity = (as_luminance(luminance) * f(c.full_scale)).ravel()
        rows = []
        if self.t_ns is None and c.start == "stationary":
            self.v, left_us = voltmeter.start_voltage(intensity, c, self.seed)
            self.release = [t_ns + int(us * 1e3) if us else None for us in left_us]
            v = np.where([r is None for r in self.release], self.v, voltmeter.IN_DEAD_TIME)
            self.parts[:, 1] = voltmeter.start_by_leak(v, intensity, c)
        if self.t_ns is not None:
            dt = (t_ns - self.t_ns) * 1e-3
            drift, noise = voltmeter.drift_and_noise(
                self.intensity,
                intensity,
                f(c.k1),
                f(c.k2),
                f(c.k3),
                f(c.k4 * dt),
                f(c.k5 * dt),
                f(c.k6),
                f(np.sqrt(dt)),
            )
            v_end, unspent = voltmeter.move(self.v, drift), self.unspent + noise * noise
            near = voltmeter.near_threshold(self.v, v_end, unspent, noise * noise)
            mean = f(0.5) * (self.intensity + intensity)
            by_light = self.parts[:, 0] + f(c.k1) * (intensity - self.intensity) / (mean + f(c.k2))
            after = np.stack([by_light, self.parts[:, 1] + (f(c.k4 * dt) + f(c.k5 * dt) * mean)], axis=1)
            for i in range(len(self.v)):
                if near[i] or self.release[i] is not None:
                    v_end[i], unspent[i] = self.pixel(i, np.float64(intensity[i]), dt, t_ns, rows)
                else:
                    continue
                after[i] = self.moved if v_end[i] != voltmeter.IN_DEAD_TIME else 0
            self.v, self.unspent, self.parts = v_end, unspent, after
        self.intensity, self.t_ns, self.frame = intensity, t_ns, self.frame + 1
        return sorted_events(rows, self.config.causes)

    def rates(self, i: int, after: np.float64, dt: float, t: float) -> tuple[float, float]:
        """(mu, sigma) of one pixel, per us, that goes on at t."""
        c, before = self.config, np.float64(self.intensity[i])
        mean = 0.5 * (before + after)
        leak = c.k4 + c.k5 * mean
        mu = c.k1 * (after - before) / dt / (mean + c.k2) + leak
        self.since, self.part, self.part_rates = t, self.parts[i].astype(np.float64), np.array([mu - leak, leak])
        self.moved = self.part + self.part_rates * (dt - t)
        return mu, c.k3 * np.sqrt(mean) / (mean + c.k2) + c.k6

    def fire(self, i: int, up: bool, t: float, t_ns: int, rows: list) -> float | None:
        """Notes an event; returns when the pixel goes on (us from the interval's start), None after its end."""
        light, leak = (1 if up else -1) * (self.part + self.part_rates * (t - self.since))
        cause = int(np.argmax([light, leak, 1 - light - leak]))
        after_us = self._fire(i, up, t, t_ns, rows, cause)
        if after_us is not None:
            self.since, self.part = after_us, np.zeros(2)
            self.moved = self.part_rates * ((t_ns - self.t_ns) * 1e-3 - after_us)
        return after_us

    def _fire(self, i: int, up: bool, t: float, t_ns: int, rows: list, cause: int) -> float | None:
        refractory, dt_ns = round(self.config.refractory_us * 1000), t_ns - self.t_ns
        after_ns = min(int(t * 1e3), dt_ns)
        y, x = divmod(i, self.width)
        rows.append(((self.t_ns + after_ns) // 1000, y, x, int(up), cause))
        if not refractory:
            return t
        if after_ns + refractory > dt_ns:
            self.release[i] = self.t_ns + after_ns + refractory
            return None
        return (after_ns + refractory) * 1e-3

    def pixel(self, i: int, after: np.float64, dt: float, t_ns: int, rows: list) -> tuple[int, float]:
        """Draw the interval of one pixel; returns its voltage at the end and the variance that is unspent."""
        v, variance, t = np.float64(self.v[i] / voltmeter.V_ONE), np.float64(self.unspent[i]), 0.0
        if self.release[i] is not None:
            if self.release[i] > t_ns:
                return voltmeter.IN_DEAD_TIME, 0.0
            v, variance, t, self.release[i] = np.float64(0), 0.0, max(self.release[i] - self.t_ns, 0) * 1e-3, None
        mu, sigma = self.rates(i, after, dt, t)
        held = lambda voltage: np.clip(voltage, -voltmeter.NEAREST, voltmeter.NEAREST)
        draws = (
            normal2_and_uniform(self.seed, np.uint64(i), np.uint64(Stream.DIFFUSION), np.uint64((self.frame << 20) + k))
            for k in range(voltmeter.MAX_DRAWS)
        )
        first, normal, uniform = next(draws)
        drawn = True
        if variance > 0:
            v, variance = held(v + np.sqrt(variance) * first), 0.0
        while t < dt:
            part, side = voltmeter.reach_of_part(v, mu, sigma, dt - t)
            if side == 0 and part == dt - t:
                v, variance = v + mu * part, sigma * sigma * part
                break
            if not drawn:
                _, normal, uniform = next(draws)
            drawn, distance, hit = False, 1.0 - side * v, np.inf
            chance = voltmeter.reached(distance, side * mu, sigma) if side else 0.0
            if uniform < chance:
                hit = voltmeter.hitting_time(distance, side * mu, sigma, normal, uniform / chance)
            if hit <= part:
                resumed = self.fire(i, side > 0, t + hit, t_ns, rows)
                if resumed is None:
                    return voltmeter.IN_DEAD_TIME, 0.0
                v, t = np.float64(0), resumed
                continue
            noise = sigma * np.sqrt(part)
            for _ in range(voltmeter.TRIES):
                normal, _, uniform = next(draws)
                end = v + mu * part + noise * normal
                if not side or uniform >= voltmeter.crosses(distance, 1.0 - side * end, noise):
                    break
            v, whole, t = held(end), part == dt - t, t + part
            if whole:
                break
        return int(v * voltmeter.V_ONE), np.float32(variance)
