"""Time sampling: generators of frame times, int64 ns, from t0 to t1, both included, strictly increasing.

A generator decides each time only when it is requested, so frames are pulled one by one and memory does not grow with
the length of a sequence.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Protocol

NS_PER_S = 1_000_000_000
_PROPOSED = 0.98
"""Proposed fraction of the longest step that the expected pace allows. Over nine shipped scenes 2 % of these steps are
refused, with 1,497 paces for 1,465 frames; of steps as long as the pace at their start allows, a third is refused, with
2,257 paces for 1,503 frames."""


def uniform_times(fps: float, t0_ns: int, t1_ns: int) -> Iterator[int]:
    """Yield t0 + k / fps, each rounded to the nanosecond (errors do not accumulate), then t1."""
    # An exact fraction: only the rounding of each time to the nanosecond is left.
    step = NS_PER_S / Fraction(fps).limit_denominator(1_000_000)
    yield t0_ns
    last, k = t0_ns, 1
    while (t := t0_ns + round(k * step)) < t1_ns:
        # Above 1e9 fps neighbouring frames would round to the same nanosecond.
        if t > last:
            yield t
            last = t
        k += 1
    if t1_ns > last:
        yield t1_ns


SHOWN = 0.1
"""Largest displacement, in steps' limits, that the speeds at both ends of a step may leave out."""


class Pace(Protocol):
    """What limits the steps of a scene."""

    def at(self, t_ns: int) -> float:
        """Return the steps per second that the scene needs at a time."""

    def hides(self, ta_ns: int, tb_ns: int, steps: float) -> bool:
        """Return whether between two times it may need more steps per second, by more than ``steps``, than at both."""

    def bend(self, ta_ns: int, tb_ns: int) -> float:
        """Return how far the scene leaves a steady motion from one time to the other in between, in steps."""

    def misses(self, ta_ns: int, tb_ns: int) -> bool:
        """Take note that more than a step may happen unseen between two times that are a shortest step apart. Return
        whether both get a frame, which holds a jump between these two."""


BEND = 0.05
"""Largest value of :meth:`Pace.bend` of a step. Emulators take what is between two frames as a straight line, which
cuts off the turning points of a motion to and fro."""


def bounded_times(
    pace: Pace,
    min_step_ns: int,
    max_step_ns: int,
    t0_ns: int,
    t1_ns: int,
    stops_ns: Sequence[int] = (),
    exact_ns: Sequence[int] = (),
) -> Iterator[int]:
    """Yield times with ``pace * step <= 1`` everywhere in each step, steps within [min_step, max_step].

    stops_ns : increasing times that no step may cross, such as impacts. One that comes less than min_step after
        another, or before t1, is left out.
    exact_ns : increasing times that are yielded however near they are to each other, such as jumps of light.
    The step is proposed from the pace at its start (as in Rebecq et al. 2018, section 3.2), or from the expected pace
    at its end if the pace rises as over the last step. It is then checked against the pace at its end, and inside it
    wherever the pace may be higher than at the times known so far (:func:`_holds_until`), which the original does not
    do: a motion that accelerates, or goes to and fro, or passes through the picture inside the step would exceed the
    bound. A rejected step is shortened and tried again. The pace at an accepted end is the next step's start, so there
    is one pace per frame if nothing is rejected. The last step ends at t1 exactly; steps are shorter than min_step only
    there, before a stop, and between exact times.
    """
    yield t0_ns
    t = t0_ns
    v = v_before = pace.at(t)
    ends = deque(sorted({*_apart(stops_ns, min_step_ns, t0_ns, t1_ns), *(t for t in exact_ns if t0_ns < t < t1_ns)}))
    while t < t1_ns:
        while ends and ends[0] <= t:
            ends.popleft()
        # No step crosses a stop or the end.
        # 2 v - v_before: the pace at the step's end if it rises by as much as over the last step.
        expected = max(v, 2 * v - v_before)
        step = min(_step(_PROPOSED, expected, min_step_ns, max_step_ns), (ends[0] if ends else t1_ns) - t)
        while True:
            v_end = pace.at(t + step)
            if step <= min_step_ns:
                break
            if max(v, v_end) * step > _LIMIT:
                # 0.9: a step cut to exactly the limit of the end's pace is often rejected again.
                step = max(min_step_ns, min(int(0.9 * step), _step(0.95, max(v, v_end), min_step_ns, max_step_ns)))
                continue
            holds = _holds_until(pace, t, t + step, min_step_ns)
            if holds < t + step:
                step = max(min_step_ns, holds - t)
                continue
            bend = pace.bend(t, t + step)
            if bend <= BEND:
                break
            # It grows with the square of the step.
            step = max(min_step_ns, int(step * max(0.5, 0.95 * math.sqrt(BEND / bend))))
        yield t + step
        t, v_before, v = t + step, v, v_end


_LIMIT = NS_PER_S * (1 + 1e-9)


def _holds_until(pace: Pace, t: int, end: int, min_step_ns: int) -> int:
    """Return the end of the longest part of the step from t to ``end``, which holds at both, that holds everywhere.

    Intervals are halved, the earliest first, until both ends of each show its pace, or it is min_step long."""
    fastest, intervals = pace.at(t), [(t, end)]
    while intervals:
        a, b = intervals.pop()
        if b - a > min_step_ns and pace.hides(a, b, SHOWN * NS_PER_S / (end - t)):
            middle = (a + b) // 2
            intervals += [(middle, b), (a, middle)]
            continue
        # In the shortest step that is allowed more than a whole step's motion may still be hidden.
        if b - a <= min_step_ns and pace.hides(a, b, NS_PER_S / (b - a)) and pace.misses(a, b):
            # The step ends where this interval begins, which is then a step of its own: both of its ends get frames.
            return a if a > t else b
        most = max(fastest, pace.at(b))
        if most * (b - t) > _LIMIT:
            # Up to a it holds, and until b nothing is faster than ``most``.
            return min(b, max(a, t + int(0.95 / most * NS_PER_S)))
        fastest = most
    return end


def _apart(stops_ns: Sequence[int], least_ns: int, t0_ns: int, t1_ns: int) -> Iterator[int]:
    last = t0_ns
    for stop in stops_ns:
        if last + least_ns <= stop <= t1_ns - least_ns:
            yield stop
            last = stop


def _step(steps: float, pace: float, low: int, high: int) -> int:
    # A pace of 0 is limited only by the largest step.
    if pace * high <= steps * NS_PER_S:
        return high
    return max(low, int(steps / pace * NS_PER_S))


class Ticks:
    """Finds the first times at or after each multiple of 1 / rate_hz since t0_us, when a picture of a video is due.

    In float µs, each period added to the last."""

    def __init__(self, t0_us: int, rate_hz: float):
        self._period_us, self._next_us = 1e6 / rate_hz, float(t0_us)

    def due(self, t_us: int) -> bool:
        """Return whether a multiple has come since the last one passed."""
        return t_us >= self._next_us

    def passed(self, t_us: int) -> int:
        """Return how many multiples have come up to and including t_us, and mark them as passed."""
        count = 0
        while self.due(t_us):
            self._next_us += self._period_us
            count += 1
        return count
