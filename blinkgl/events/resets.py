"""What a camera that takes frames does to its own event pixels: where the frame's pixels are reset, the signal of every
event pixel jumps and comes back.

Seen in recordings of DAVIS240 cameras: once a frame, 3 to 9 % of the pixels on which something moves, and hardly any
other, fire ON within half a millisecond; for the next millisecond there are hardly any ON events and more OFF events
than usual. So a jump carries over their threshold those pixels that stand near it. No noise that is added to events can
do that; the jump is made before the emulator, in the light that it is shown.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from blinkgl.config.readout import FrameResetsConfig
from blinkgl.events.emulator import Emulator

RISE_NS = 300_000
"""Time of the jump: the ON events of a reset lie within half a millisecond."""


class _Seen(NamedTuple):
    t_ns: int
    luminance: np.ndarray


class FrameResets:
    """The light that pixels see between and at the frames that an emulator is given, with the jumps in it.

    The signal is higher by ``kick`` thresholds ``RISE_NS`` after a reset. Of an emulator that follows light at once it
    goes there and, in ``length_ms``, back in straight lines; one with a low-pass is pushed there by brighter light
    and comes back as slowly as its pixels do. Resets follow one another at ``interval_ms``; the first comes
    ``first_ms`` after the first frame.

    emulator : of which the pixels are.   threshold : its smallest nominal one, ln units: in three recordings whose
    thresholds differ by a factor of four the jump is 0.31 to 0.39 of it."""

    def __init__(self, config: FrameResetsConfig, emulator: Emulator, threshold: float):
        self._jump, self._emulator = config.kick * threshold, emulator
        self._every, self._first = (round(1e6 * ms) for ms in (config.interval_ms, config.first_ms))
        if emulator.push(np.ones((1, 1), np.float32), self._jump, 1e-9 * RISE_NS) is None:
            self._corners, self._share = (0, RISE_NS, RISE_NS + round(1e6 * config.length_ms)), (0.0, 1.0, 0.0)
        else:
            self._corners, self._share = (0, 1000, RISE_NS, RISE_NS + 1000), (0.0, 1.0, 1.0, 0.0)
        self._began: int | None = None
        self._last: _Seen | None = None

    def shown(self, t_ns: int, luminance: np.ndarray) -> Iterator[tuple[int, np.ndarray, bool]]:
        """(t_ns, luminance, changed) of what an emulator is shown up to a frame, that frame last; changed: the jump is
        in it, or was in the one before.

        luminance : (H, W) float32, linear; it stays as it is, and a copy of it is kept."""
        last, kicked = self._last, False
        if last is None:
            self._began = t_ns
        else:
            kicked = self._at(last.t_ns) > 0
            for knot in self._knots(last.t_ns, t_ns):
                part = np.float32((knot - last.t_ns) / (t_ns - last.t_ns))
                yield knot, self._lit(last.luminance + (luminance - last.luminance) * part, self._at(knot)), True
                kicked = True
        here = self._at(t_ns)
        yield t_ns, self._lit(luminance, here), kicked or here > 0
        self._last = _Seen(t_ns, np.array(luminance, np.float32))

    def _lit(self, luminance: np.ndarray, share: float) -> np.ndarray:
        """The light with a share of the jump in it."""
        if share == 0:
            return luminance
        push = self._emulator.push(luminance, self._jump, 1e-9 * RISE_NS)
        return luminance * np.exp(np.float32(share) * (np.float32(self._jump) if push is None else push))

    def _at(self, t_ns: int) -> float:
        """The share of the jump at a time."""
        assert self._began is not None
        since = (t_ns - self._began - self._first) % self._every if t_ns >= self._began + self._first else -1
        return float(np.interp(since, self._corners, self._share, left=0.0, right=0.0))

    def _knots(self, after_ns: int, before_ns: int) -> Iterator[int]:
        """Times strictly between two frames at which the jump begins, is highest and is over."""
        assert self._began is not None
        first = max((after_ns - self._began - self._first - self._corners[-1]) // self._every, 0)
        for number in itertools.count(first):
            reset = self._began + self._first + number * self._every
            if reset >= before_ns:
                return
            yield from (t for t in (reset + corner for corner in self._corners) if after_ns < t < before_ns)
