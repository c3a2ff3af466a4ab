"""Effect of a frame camera's resets on its event pixels: at each reset of the frame's pixels the signal of every event
pixel jumps and returns.

Observed in recordings of DAVIS240 cameras: once per frame, 3 to 9 % of the pixels with motion, and hardly any other,
fire ON within half a millisecond; during the next millisecond there are hardly any ON events and more OFF events than
usual. So the jump carries pixels near their threshold over it. Noise added to the events cannot reproduce this; the
jump is added to the light before the emulator.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from blinkgl.config.readout import FrameResetsConfig
from blinkgl.events.arith import LOG_MAX_INPUT
from blinkgl.events.emulator import Emulator

RISE_NS = 300_000
"""Duration of the jump: the ON events of a reset lie within half a millisecond."""


BEFORE = 8
"""Resets before the first frame, in its light. Afterwards few pixels are so near to their threshold that the next one
carries them over, but for those that leak and noise bring there: a still scene is still from the first frame on, within
.02 Hz a pixel for a DAVIS240C's Voltmeter, whose diffusion brings most."""


class _Seen(NamedTuple):
    t_ns: int
    luminance: np.ndarray


class FrameResets:
    """The light that pixels see at and between the frames of an emulator, with the jumps added.

    The signal is higher by ``kick`` thresholds ``RISE_NS`` after a reset. In an emulator that follows light at once it
    rises and, in ``length_ms``, returns linearly; an emulator with a low-pass gets brighter light, and its pixels
    return at their own speed. Resets have the interval ``interval_ms``; one comes ``first_ms`` after the first frame.

    emulator : that of the pixels.   threshold : its smallest nominal one, ln units: in three recordings whose
    thresholds differ by a factor of four the jump is 0.31 to 0.39 of it."""

    def __init__(self, config: FrameResetsConfig, emulator: Emulator, threshold: float):
        self._jump, self._emulator = config.kick * threshold, emulator
        self._every, self._first = (round(1e6 * ms) for ms in (config.interval_ms, config.first_ms))
        if emulator.push(np.ones((1, 1), np.float32), self._jump, 1e-9 * RISE_NS) is None:
            # Times after a reset, ns, and the share of the jump at each: here the light rises and returns along lines.
            self._corners, self._share = (0, RISE_NS, RISE_NS + round(1e6 * config.length_ms)), (0.0, 1.0, 0.0)
        else:
            # Here the light steps up within a microsecond, stays while the signal rises, and steps back.
            self._corners, self._share = (0, 1000, RISE_NS, RISE_NS + 1000), (0.0, 1.0, 1.0, 0.0)
        self._began: int | None = None
        self._last: _Seen | None = None

    def shown(self, t_ns: int, luminance: np.ndarray) -> Iterator[tuple[int, np.ndarray, bool]]:
        """Yield (t_ns, luminance, changed) for an emulator up to a frame, that frame last; changed: the jump is in it,
        or was in the one before. Up to the first frame: the resets before it (:data:`BEFORE`).

        luminance : (H, W) float32, linear; it is not changed, and a copy of it is kept."""
        last = self._last
        if last is None:
            self._began = t_ns - BEFORE * self._every
            last = _Seen(self._began, luminance)
            yield self._began, luminance, True
        kicked = self._at(last.t_ns) > 0
        for knot in self._knots(last.t_ns, t_ns):
            part = np.float32((knot - last.t_ns) / (t_ns - last.t_ns))
            yield knot, self._lit(last.luminance + (luminance - last.luminance) * part, self._at(knot)), True
            kicked = True
        here = self._at(t_ns)
        yield t_ns, self._lit(luminance, here), kicked or here > 0
        self._last = _Seen(t_ns, np.array(luminance, np.float32))

    def _lit(self, luminance: np.ndarray, share: float) -> np.ndarray:
        """Return the light with this share of the jump, at most the brightest that emulators take."""
        if share == 0:
            return luminance
        push = self._emulator.push(luminance, self._jump, 1e-9 * RISE_NS)
        factor = np.exp(np.float32(share) * (np.float32(self._jump) if push is None else push))
        # The frame itself is checked later, so light that is too bright without the jump stays so.
        return np.minimum(luminance * factor, np.maximum(luminance, np.float32(LOG_MAX_INPUT)))

    def _at(self, t_ns: int) -> float:
        """Return the share of the jump at a time."""
        assert self._began is not None
        # -1: before the first reset, where the share is 0.
        since = (t_ns - self._began - self._first) % self._every if t_ns >= self._began + self._first else -1
        return float(np.interp(since, self._corners, self._share, left=0.0, right=0.0))

    def _knots(self, after_ns: int, before_ns: int) -> Iterator[int]:
        """Yield the times strictly between two frames at which the jump begins, is highest and ends."""
        assert self._began is not None
        # Resets of smaller numbers have returned by ``after_ns``.
        first = max((after_ns - self._began - self._first - self._corners[-1]) // self._every, 0)
        for number in itertools.count(first):
            reset = self._began + self._first + number * self._every
            if reset >= before_ns:
                return
            yield from (t for t in (reset + corner for corner in self._corners) if after_ns < t < before_ns)
