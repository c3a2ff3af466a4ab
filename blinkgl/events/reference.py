"""Slow twins of the emulators: the papers, one pixel and one event at a time.

They share the arithmetic and the random numbers of the kernels (:mod:`~blinkgl.events.arith`,
:mod:`~blinkgl.events.philox`, here on NumPy arrays) and nothing else: no blocks, no packing, no threads, no compiled
code. The tests ask for equality event for event. For small frames only.
"""

from __future__ import annotations

import math

import numpy as np

from blinkgl.config.events import EsimConfig
from blinkgl.events.arith import Q_ONE, log_q25
from blinkgl.events.philox import Stream, normal2, pixel_counters
from blinkgl.events.types import Events


def sorted_events(rows: list[tuple[int, int, int, int]]) -> Events:
    """Events from (t_us, y, x, p) rows given pixel by pixel in raster order: sorted by time, ties in that order."""
    rows = sorted(rows, key=lambda r: r[0])
    t, y, x, p = np.array(rows, np.int64).reshape(-1, 4).T
    return Events(x.astype(np.uint16), y.astype(np.uint16), np.ascontiguousarray(t), p.astype(np.uint8))


def as_luminance(frame: np.ndarray) -> np.ndarray:
    """float32 luminance; uint8 by the default decoding k / 255."""
    return frame / np.float32(255) if frame.dtype == np.uint8 else np.asarray(frame, np.float32)


class ReferenceEsim:
    """Rebecq et al. 2018, section 3, in exact integer arithmetic (log intensity in 2^-25, time in ns)."""

    def __init__(self, height: int, width: int, config: EsimConfig, seed: int = 0):
        self.shape, self.config, self.seed = (height, width), config, np.uint64(seed)
        q = lambda c: math.floor(c * Q_ONE + 0.5)
        nominal = [config.contrast_threshold, config.contrast_threshold_off or config.contrast_threshold]
        floor = [min(0.01, c / 2) for c in nominal]
        pixels = pixel_counters(height, width)
        spread = normal2(self.seed, pixels, np.uint64(Stream.THRESHOLD), np.uint64(0))
        self.threshold = [[q(min(max(c + config.threshold_sigma * n, f), 10.0)) for n in normals]
                          for c, f, normals in zip(nominal, floor, spread)]
        if config.threshold_sigma == 0:
            self.threshold = [[q(c)] * (height * width) for c in nominal]
        self.floor = [q(f) for f in floor]
        self.events_so_far = [0] * (height * width)
        self.last_ns: list[int | None] = [None] * (height * width)
        self.t_ns: int | None = None

    def next_thresholds(self, i: int) -> tuple[int, int]:
        """(C-, C+) of pixel i for its next event."""
        on, off = self.threshold[0][i], self.threshold[1][i]
        if self.config.threshold_jitter:
            draws = normal2(self.seed, np.array([i], np.uint64), np.uint64(Stream.JITTER),
                            np.array([self.events_so_far[i]], np.uint64))
            scale = self.config.threshold_jitter * Q_ONE
            on, off = (max(f, c + math.floor(scale * n[0] + 0.5)) for f, c, n in zip(self.floor, (on, off), draws))
        return off, on

    def step(self, luminance: np.ndarray, t_ns: int) -> Events:
        level = [int(v) for v in log_q25(as_luminance(luminance) + np.float32(self.config.log_eps)).ravel()]
        rows = []
        if self.t_ns is None:
            self.reference = list(level)
            self.next = [self.next_thresholds(i) for i in range(len(level))]
        else:
            for i, (before, now) in enumerate(zip(self.level, level)):
                rows += self.pixel(i, before, now, self.t_ns, t_ns)
        self.level, self.t_ns = level, t_ns
        return sorted_events(rows)

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
                rows.append((t // 1000, y, x, p))
