"""Light that changes over time: the factor by which a lamp or a material shines, as a function of time.

    flicker = Sine(frequency=120, depth=0.5)
    flicker.factor(t_ns), flicker.jumps(t0_ns, t1_ns), flicker.corners(t0_ns, t1_ns), flicker.steepness(t_ns)

Times are ns on the sequence's clock. A jump at t means: before t the old value, from t on the new one. A frame at t
shows the old one and a frame at t + 1 the new one, so that events of a jump have its microsecond.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Protocol

NS_PER_S = 1_000_000_000
_FLOOR = 0.05
"""Share of a waveform's largest factor below which its relative change counts as that of this share: other light is
seen there, or nothing is."""


class Waveform(Protocol):
    """A factor >= 0 over time."""

    def factor(self, t_ns: int) -> float:
        """Return the factor at a time."""

    def jumps(self, t0_ns: int, t1_ns: int) -> list[int]:
        """Return the times in (t0, t1) at which the factor jumps, ns, increasing."""

    def corners(self, t0_ns: int, t1_ns: int) -> list[int]:
        """Return the times in (t0, t1) at which it turns or bends, ns, increasing; in between it is monotone."""

    def steepness(self, t_ns: int) -> float:
        """Return a bound of its relative change between the corners around t, 1/s."""

    def per_second(self) -> float:
        """Return the average number of jumps and corners in a second."""

    def mean(self, t0_ns: int, t1_ns: int) -> float:
        """Return the mean factor from t0 to t1."""


def factor_at(wave: Waveform | None, t_ns: int, t0_ns: int) -> float:
    """Return the factor that a frame at a time shows, of a sequence that begins at t0; 1 without a waveform."""
    # A nanosecond earlier: from a jump on the factor is the new one, and the frame at the jump shows the old one.
    return 1.0 if wave is None else wave.factor(max(t_ns - 1, t0_ns))


def _times(first: float, period: float, t0_ns: int, t1_ns: int) -> list[int]:
    """Return the whole ns of first + k period (s) in (t0, t1)."""
    # One period early: the quotient may be rounded up.
    begin = math.floor((t0_ns * 1e-9 - first) / period) - 1
    times = (round((first + k * period) * NS_PER_S) for k in itertools.count(begin))
    return [t for t in itertools.takewhile(lambda t: t < t1_ns, times) if t > t0_ns]


@dataclass(frozen=True)
class Sine:
    """1 + depth sin(2 pi (frequency t + phase)).   frequency : Hz.   depth : 0 to 1.   phase : fraction of a period."""

    frequency: float
    depth: float = 1.0
    phase: float = 0.0

    def factor(self, t_ns: int) -> float:
        return 1.0 + self.depth * math.sin(2 * math.pi * (self.frequency * t_ns * 1e-9 + self.phase))

    def jumps(self, t0_ns: int, t1_ns: int) -> list[int]:
        return []

    def corners(self, t0_ns: int, t1_ns: int) -> list[int]:
        # Its crests and troughs, at a quarter and three quarters of a period.
        return _times((0.25 - self.phase) / self.frequency, 0.5 / self.frequency, t0_ns, t1_ns)

    def steepness(self, t_ns: int) -> float:
        # The largest of 2 pi f depth cos / (1 + depth sin), which is at sin = -depth.
        floor = max(math.sqrt(1.0 - self.depth**2), math.sqrt(_FLOOR / (1.0 - _FLOOR)))
        return 2 * math.pi * self.frequency * self.depth / floor

    def per_second(self) -> float:
        return 2 * self.frequency

    def mean(self, t0_ns: int, t1_ns: int) -> float:
        angle = lambda t: 2 * math.pi * (self.frequency * t * 1e-9 + self.phase)
        # The integral of a sine is minus the cosine, divided by the angular frequency.
        swing = math.cos(angle(t0_ns)) - math.cos(angle(t1_ns))
        return 1.0 + self.depth * swing / (2 * math.pi * self.frequency * (t1_ns - t0_ns) * 1e-9)


class _Steps(Waveform):
    """What a waveform of constant pieces has in common."""

    def corners(self, t0_ns: int, t1_ns: int) -> list[int]:
        return []

    def steepness(self, t_ns: int) -> float:
        return 0.0

    def mean(self, t0_ns: int, t1_ns: int) -> float:
        edges = [t0_ns, *self.jumps(t0_ns, t1_ns), t1_ns]
        return sum((b - a) * self.factor(a) for a, b in itertools.pairwise(edges)) / (t1_ns - t0_ns)


@dataclass(frozen=True)
class Pwm(_Steps):
    """1 for a share ``duty`` of each period from its start on, else ``low``.   frequency : Hz.   phase : fraction of a
    period that has passed at 0 s."""

    frequency: float
    duty: float = 0.5
    phase: float = 0.0
    low: float = 0.0

    def _edges(self, k: int) -> tuple[int, int]:
        """Return when period ``k`` begins and when its light goes out, ns."""
        begin = k - self.phase
        return round(begin / self.frequency * NS_PER_S), round((begin + self.duty) / self.frequency * NS_PER_S)

    def factor(self, t_ns: int) -> float:
        k = math.floor(self.frequency * t_ns * 1e-9 + self.phase)
        # Rounded to the nanosecond, so that the neighbours decide at an edge.
        on = any(begin <= t_ns < end for begin, end in map(self._edges, (k - 1, k, k + 1)))
        return 1.0 if on else self.low

    def jumps(self, t0_ns: int, t1_ns: int) -> list[int]:
        if not 0 < self.duty < 1 or self.low == 1:
            return []
        period = 1 / self.frequency
        rises = _times(-self.phase * period, period, t0_ns, t1_ns)
        return sorted({*rises, *_times((self.duty - self.phase) * period, period, t0_ns, t1_ns)})

    def per_second(self) -> float:
        return 2 * self.frequency if 0 < self.duty < 1 and self.low != 1 else 0.0


@dataclass(frozen=True)
class Code(_Steps):
    """Bits one after the other, 1 for "1" and ``low`` for "0", from 0 s on.   rate : bits per second.   repeat : from
    the beginning after the end; else ``low`` after it."""

    bits: str
    rate: float
    low: float = 0.0
    repeat: bool = True

    def _bit(self, k: int) -> str:
        return self.bits[k % len(self.bits)] if self.repeat or 0 <= k < len(self.bits) else "0"

    def factor(self, t_ns: int) -> float:
        k = math.floor(self.rate * t_ns * 1e-9)
        # The bit whose rounded beginning has come.
        k = max(j for j in (k - 1, k, k + 1) if round(j / self.rate * NS_PER_S) <= t_ns)
        return 1.0 if self._bit(k) == "1" else self.low

    def jumps(self, t0_ns: int, t1_ns: int) -> list[int]:
        first, last = math.floor(self.rate * t0_ns * 1e-9) - 1, math.ceil(self.rate * t1_ns * 1e-9) + 1
        times = [round(k / self.rate * NS_PER_S) for k in range(first, last) if self._bit(k) != self._bit(k - 1)]
        return [t for t in times if t0_ns < t < t1_ns] if self.low != 1 else []

    def per_second(self) -> float:
        changes = sum(a != b for a, b in zip(self.bits, self.bits[1:] + self.bits[:1]))
        # Once, it has no more changes than bits.
        return self.rate * changes / len(self.bits) if self.low != 1 and self.repeat else 0.0


@dataclass(frozen=True)
class Keys:
    """Factors at times, straight lines in between, or each held until the next (``hold``); the first before all, the
    last after them.   times_ns : increasing."""

    times_ns: tuple[int, ...]
    factors: tuple[float, ...]
    hold: bool = False

    def _piece(self, t_ns: int) -> int:
        """Return the number of the last key that has come, -1: none."""
        return bisect_right(self.times_ns, t_ns) - 1

    def factor(self, t_ns: int) -> float:
        k = self._piece(t_ns)
        # Before the first key its factor, after the last one that one's.
        if k < 0 or k == len(self.times_ns) - 1 or self.hold:
            return self.factors[max(k, 0)]
        part = (t_ns - self.times_ns[k]) / (self.times_ns[k + 1] - self.times_ns[k])
        return self.factors[k] + part * (self.factors[k + 1] - self.factors[k])

    def jumps(self, t0_ns: int, t1_ns: int) -> list[int]:
        if not self.hold:
            return []
        pairs = zip(self.times_ns[1:], self.factors, self.factors[1:])
        return [t for t, a, b in pairs if a != b and t0_ns < t < t1_ns]

    def corners(self, t0_ns: int, t1_ns: int) -> list[int]:
        return [] if self.hold else [t for t in self.times_ns if t0_ns < t < t1_ns]

    def steepness(self, t_ns: int) -> float:
        if self.hold:
            return 0.0
        # At a key both of its pieces count.
        k, floor = self._piece(t_ns), _FLOOR * max(self.factors)
        pieces = {k, k - 1} if k >= 0 and self.times_ns[k] == t_ns else {k}
        steepest = 0.0
        for j in pieces:
            if 0 <= j < len(self.times_ns) - 1:
                a, b = self.factors[j : j + 2]
                if a == b:  # also where all are 0, of which no part is a change
                    continue
                seconds = (self.times_ns[j + 1] - self.times_ns[j]) * 1e-9
                steepest = max(steepest, abs(b - a) / seconds / max(min(a, b), floor))
        return steepest

    def per_second(self) -> float:
        return 0.0  # as many as there are keys

    def mean(self, t0_ns: int, t1_ns: int) -> float:
        edges = [t0_ns, *self.corners(t0_ns, t1_ns), *self.jumps(t0_ns, t1_ns), t1_ns]
        last = lambda b: self.factor(b - 1) if self.hold else self.factor(b)
        parts = ((b - a) * 0.5 * (self.factor(a) + last(b)) for a, b in itertools.pairwise(edges))
        return sum(parts) / (t1_ns - t0_ns)
