"""Noise events of pixels whose rate depends on their light, by a camera's published curves.

A stage between the emulator and the bus, as :mod:`blinkgl.events.pixels`, described in :mod:`blinkgl.config.readout`.
Candidates are a Poisson process of the highest rate in continuous time, independent of the steps, each drawn only from
the seed and its number; one is kept with the probability of its pixel's rate at that moment (Lewis and Shedler 1979).
"""

from __future__ import annotations

import numpy as np
from scipy.special import gammaincinv

from blinkgl.config.readout import LightNoiseConfig
from blinkgl.events.philox import Stream, pixel_counters, uniform2
from blinkgl.events.pixels import among, waits_ns
from blinkgl.types.events import Cause, Events

_BATCH = 1024
_LEAST_HZ = 1e-12
"""Rate that stands for none where logarithms are interpolated: an event of a megapixel in eleven days."""
_STREAM = np.uint64(Stream.LIGHT_NOISE)
_FROZEN, _WHEN, _WHICH = np.uint64(0), np.uint64(1), np.uint64(2)


class LightNoise:
    """Adds noise events by the pixels' light to the events of an emulator.

    shares : (H*W,) float64, each pixel's rate by the mean of all.   most_hz : the highest rate of a mean pixel."""

    def __init__(self, config: LightNoiseConfig, height: int, width: int, seed: int, causes: bool = False):
        self._width, self._causes = width, causes
        self._seed = np.uint64(int(seed) & (2**64 - 1))
        self._lux, self._white = np.log(config.lux), config.white_lux
        self._on, self._off = (np.log(np.maximum(hz, _LEAST_HZ)) for hz in (config.on_hz, config.off_hz))
        self.shares = np.ones(height * width)
        if config.shape is not None:
            uniform, _ = uniform2(self._seed, pixel_counters(height, width), _STREAM, _FROZEN)
            self.shares = gammaincinv(config.shape, uniform) / config.shape
        self._sums = np.cumsum(self.shares)
        # Both logarithms are linear between the lights, so that their sum is largest at one of them.
        self.most_hz = float((np.exp(self._on) + np.exp(self._off)).max())
        self._batch, self._t_ns = 0, -1
        self._light: np.ndarray | None = None
        self._from_us = 0
        self._drawn = np.empty((0, 3))  # time, µs; pixel; uniform

    def rates(self, luminance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ON and OFF noise events per second of a mean pixel, for any shape of linear luminance."""
        lux = np.log(np.maximum(self._white * np.asarray(luminance, np.float64), 1e-30))
        on, off = (np.exp(np.interp(lux, self._lux, hz)) for hz in (self._on, self._off))
        return on, off

    def step(self, events: Events, until_us: int, luminance: np.ndarray) -> Events:
        """Return ``events`` with the noise up to ``until_us`` (that microsecond included), last within a microsecond.
        Noise begins with the first step. luminance : (H, W) at that time; between two steps light changes linearly."""
        # Candidates of a Poisson process at the largest rate, thinned by the rate at the light of their time (Lewis and
        # Shedler 1979).
        light = np.array(luminance, np.float32).reshape(-1)
        before, self._light = self._light, light
        if before is None:
            self._t_ns, self._from_us = 1000 * until_us, until_us
            return events
        drawn = [self._drawn]
        while self._t_ns // 1000 <= until_us:
            drawn.append(self._more())
        candidates = np.concatenate(drawn)
        count = int(np.searchsorted(candidates[:, 0], until_us, side="right"))
        (t_us, pixel, uniform), self._drawn = candidates[:count].T, candidates[count:]
        pixel = pixel.astype(np.int64)
        # The light at a candidate's time, on the line between the two frames.
        part = (t_us - self._from_us) / max(until_us - self._from_us, 1)
        self._from_us = until_us
        on, off = self.rates(before[pixel] + (light[pixel] - before[pixel]) * part)
        # One uniform number decides both whether it is kept and its polarity.
        threshold = uniform * self.most_hz
        kept = threshold < on + off
        if not kept.any():
            return events
        pixel = pixel[kept]
        own = Events(
            (pixel % self._width).astype(np.uint16),
            (pixel // self._width).astype(np.uint16),
            t_us[kept].astype(np.int64),
            (threshold < on)[kept].astype(np.uint8),
            np.full(len(pixel), Cause.SHOT, np.uint8) if self._causes else None,
        )
        return among(events, own)

    def _more(self) -> np.ndarray:
        """Draw the next batch of candidates of the whole sensor, (n, 3)."""
        index = np.uint64(self._batch * _BATCH) + np.arange(_BATCH, dtype=np.uint64)
        self._batch += 1
        wait, pick = uniform2(self._seed, index, _STREAM, _WHEN)
        keep, _ = uniform2(self._seed, index, _STREAM, _WHICH)
        # One process of all pixels together; below each candidate gets a pixel, in proportion to the shares.
        t_ns = self._t_ns + waits_ns(wait, self._sums[-1] * self.most_hz)
        self._t_ns = int(t_ns[-1])
        pixel = np.minimum(np.searchsorted(self._sums, pick * self._sums[-1], side="right"), len(self._sums) - 1)
        return np.column_stack([t_ns // 1000, pixel, keep])
