"""Defects of single pixels, independent of the emulator: dead pixels and noise events.

A stage between the emulator and the bus, described in :mod:`blinkgl.config.readout`. Noise is a process in continuous
time, independent of the steps: its events are numbered, and number n is drawn only from the seed and n.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from blinkgl.config.readout import PixelsConfig
from blinkgl.errors import EventDataError
from blinkgl.events.arith import exp_f64, log_f64
from blinkgl.events.philox import Stream, normal2, pixel_counters, uniform2
from blinkgl.machine.kernels import kernel
from blinkgl.types.events import OPTIONAL, Cause, Events

# Events drawn at once; the highest rate, one event per microsecond; the longest time
# before the recording.
_BATCH, _MOST_HZ, _LONGEST_BEFORE_S = 1024, 1e6, 5.0
_DEFECT, _OWN = np.uint64(Stream.DEFECT), np.uint64(Stream.OWN_NOISE)


@kernel(error_model="numpy")
def _awake(pixel, t_us, dead_us, last):
    """Return (n,) bool: which events come at least ``dead_us`` after the last accepted event of their pixel; updates
    ``last``."""
    out = np.empty(t_us.size, np.bool_)
    for i in range(t_us.size):
        out[i] = t_us[i] - last[pixel[i]] >= dead_us
        if out[i]:
            last[pixel[i]] = t_us[i]
    return out


def waits_ns(uniform: np.ndarray, per_second: float) -> np.ndarray:
    """Return the times of a Poisson process of this rate from the event before the first, int64 ns."""
    # Exponential waiting times, at most 13 days, so that the longest batch fits int64.
    return np.cumsum(np.minimum(-log_f64(uniform) * (1e9 / per_second), 2.0**50).astype(np.int64))


def among(events: Events, noise: Events) -> Events:
    """Return both in order of time."""
    if not len(events) or not len(noise):
        return noise if len(noise) else events
    # Stable: at the same microsecond the pixels' events stay before the noise.
    both = Events.concatenate([events, noise])
    return both.part(np.argsort(both.t, kind="stable"))


class PixelNoise:
    """Removes the events of dead pixels from an emulator's events and adds noise events.

    ``rates`` : (H*W,) float64, noise events per second of each pixel.   ``dead``, ``hot`` : (H*W,) bool. ``on_shares``
    : (H*W,) float64, of the events that do not follow another."""

    def __init__(self, config: PixelsConfig, height: int, width: int, seed: int, causes: bool = False):
        self.config, self._width, self._causes = config, width, causes
        self._seed = np.uint64(int(seed) & (2**64 - 1))
        pixels = pixel_counters(height, width)
        # Draws 0 and 1 of the stream: uniforms for the kind of pixel, normals for its values.
        which, other = uniform2(self._seed, pixels, _DEFECT, np.uint64(0))
        spread, prefers = normal2(self._seed, pixels, _DEFECT, np.uint64(1))
        self.hot = which < config.hot_fraction
        self.dead = other < config.dead_fraction
        # Log-normal rates: a median and a spread in decades.
        median = np.where(self.hot, config.hot_rate_hz, config.rate_hz)
        decades = np.where(self.hot, config.hot_spread_decades, config.spread_decades)
        rates = np.minimum(median * exp_f64(np.log(10.0) * decades * spread), _MOST_HZ)
        self.rates = np.where(self.dead, 0.0, rates)
        # Running sums, in which a uniform finds its pixel. Answers are added to the drawn events, which
        # are reduced accordingly.
        self._sums = np.cumsum(self.rates / (1.0 + np.where(self.hot, 0.0, config.answered)))
        # The odds of ON against OFF are log-normal over the hot pixels.
        off = (1.0 - config.hot_on_share) * exp_f64(-config.hot_on_spread * prefers)
        self.on_shares = np.where(self.hot, config.hot_on_share / (config.hot_on_share + off), config.on_share)
        self._decades = np.log(10.0) * config.answer_spread_decades
        # Answers of noise before the recording begins may fall into it.
        before_s = min(1e-3 * config.answer_ms * np.exp(3.0 * self._decades), _LONGEST_BEFORE_S)
        self._before_ns = round(1e9 * before_s) if config.answered else 0
        self._from_us = 0
        self._last = np.full(height * width, -(2**62), np.int64) if config.refractory_us else None
        self._batch = 0  # next to be drawn
        self._t_ns: int | None = None  # end of the last batch
        self._drawn = Events.empty()  # not returned yet

    def step(self, events: Events, until_us: int) -> Events:
        """Return ``events`` without those of dead pixels, with the noise up to ``until_us`` (that microsecond
        included); within a microsecond the noise comes last. Noise begins with the first step."""
        if self.dead.any() and len(events):
            events = events.part(~self.dead[events.pixel(self._width)])
        # No pixel has noise.
        if not (self._sums.size and self._sums[-1] > 0):
            return events
        if self._t_ns is None:
            # Noise begins early enough for its late answers to fall into the recording.
            self._t_ns, self._from_us = 1000 * until_us - self._before_ns, until_us
            return events
        while self._t_ns // 1000 <= until_us:
            drawn = Events.concatenate([self._drawn, self._more()])
            # Answers are late, so those of one batch may come after the next batch has begun.
            self._drawn = drawn.part(np.argsort(drawn.t, kind="stable")) if self._before_ns else drawn
        count = int(np.searchsorted(self._drawn.t, until_us, side="right"))
        own, self._drawn = self._drawn.part(slice(count)), self._drawn.part(slice(count, None))
        if self._last is not None:
            pixel = own.pixel(self._width)
            own = own.part(_awake(pixel, own.t, self.config.refractory_us, self._last))
        return among(events, own)

    def _more(self) -> Events:
        """Draw the next batch of a Poisson process of the whole sensor and the answers to its events. Pixels are
        drawn in proportion to their rates."""
        index = np.uint64(self._batch * _BATCH) + np.arange(_BATCH, dtype=np.uint64)
        self._batch += 1
        # Draw 0 of an event: the time to it and its pixel; draw 1: polarity and whether it is answered;
        # draw 2: how late.
        wait, pick = uniform2(self._seed, index, _OWN, np.uint64(0))
        polarity, answers = uniform2(self._seed, index, _OWN, np.uint64(1))
        total = self._sums[-1]
        t_ns = self._t_ns + waits_ns(wait, total)
        self._t_ns = int(t_ns[-1])
        pixel = np.minimum(np.searchsorted(self._sums, pick * total, side="right"), len(self._sums) - 1)
        cause = np.where(self.hot[pixel], np.uint8(Cause.HOT), np.uint8(Cause.SHOT)) if self._causes else None
        own = Events(
            (pixel % self._width).astype(np.uint16),
            (pixel // self._width).astype(np.uint16),
            t_ns // 1000,
            (polarity < self.on_shares[pixel]).astype(np.uint8),
            cause,
        )
        if not self._before_ns:
            return own
        late, _ = normal2(self._seed, index, _OWN, np.uint64(2))
        # Log-normal around ``answer_ms``. An answer has the other polarity.
        wait_ns = 1e6 * self.config.answer_ms * exp_f64(self._decades * late)
        chosen = (answers < self.config.answered) & ~self.hot[pixel]
        answer = own.part(chosen)
        at_us = (t_ns[chosen] + np.minimum(wait_ns[chosen], 2.0**55).astype(np.int64)) // 1000
        both = Events.concatenate([own, replace(answer, t=at_us, p=1 - answer.p)])
        # Events before the recording were drawn only for their answers.
        return both.part(both.t > self._from_us)

    def state_dict(self) -> dict[str, np.ndarray]:
        clock = [self._t_ns is not None, self._t_ns or 0, self._batch, self._from_us]
        last = {} if self._last is None else {"last": self._last.copy()}
        return {"clock": np.array(clock, np.int64), **last, **_columns("drawn", self._drawn)}

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        self._drawn = _events("drawn", state, {"clock"} if self._last is None else {"clock", "last"})
        if self._last is not None:
            self._last[...] = state["last"]
        started, t_ns, self._batch, self._from_us = (int(v) for v in state["clock"])
        self._t_ns = t_ns if started else None


def _columns(name: str, events: Events) -> dict[str, np.ndarray]:
    return {f"{name}_{k}": getattr(events, k).copy() for k in events.columns}


def _events(name: str, state: dict[str, np.ndarray], others: set[str]) -> Events:
    columns = ("x", "y", "t", "p", *(k for k in OPTIONAL if f"{name}_{k}" in state))
    if set(state) != {*others, *(f"{name}_{k}" for k in columns)}:
        raise EventDataError("saved state is of another camera", value=sorted(state))
    return Events(**{k: state[f"{name}_{k}"].copy() for k in columns})
