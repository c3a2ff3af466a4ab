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

RISE_NS = 300_000
"""Time of the jump: the ON events of a reset lie within half a millisecond."""


class _Seen(NamedTuple):
    t_ns: int
    luminance: np.ndarray


class FrameResets:
    """The light that pixels see between and at the frames that an emulator is given, with the jumps in it.

    ln I is higher by ``kick`` thresholds ``RISE_NS`` after a reset, and by nothing ``length_ms`` after that, in
    straight lines. Resets follow one another at ``interval_ms``; the first comes ``first_ms`` after the first frame.

    threshold : the emulator's, ln units: in three recordings whose thresholds differ by a factor of four the jump is
    0.31 to 0.39 of it."""

    def __init__(self, config: FrameResetsConfig, threshold: float):
        self._kick = config.kick * threshold
        self._every, self._first = (round(1e6 * ms) for ms in (config.interval_ms, config.first_ms))
        self._corners = (0, RISE_NS, RISE_NS + round(1e6 * config.length_ms))
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
                between = last.luminance + (luminance - last.luminance) * part
                yield knot, between * np.float32(np.exp(self._at(knot))), True
                kicked = True
        here = self._at(t_ns)
        yield t_ns, luminance * np.float32(np.exp(here)) if here else luminance, kicked or here > 0
        self._last = _Seen(t_ns, np.array(luminance, np.float32))

    def _at(self, t_ns: int) -> float:
        """The jump, of ln I."""
        assert self._began is not None
        since = (t_ns - self._began - self._first) % self._every if t_ns >= self._began + self._first else -1
        return float(np.interp(since, self._corners, (0.0, self._kick, 0.0), left=0.0, right=0.0))

    def _knots(self, after_ns: int, before_ns: int) -> Iterator[int]:
        """Times strictly between two frames at which the jump begins, is highest and is over."""
        assert self._began is not None
        first = max((after_ns - self._began - self._first - self._corners[-1]) // self._every, 0)
        for number in itertools.count(first):
            reset = self._began + self._first + number * self._every
            if reset >= before_ns:
                return
            yield from (t for t in (reset + corner for corner in self._corners) if after_ns < t < before_ns)
