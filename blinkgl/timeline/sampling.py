"""Time sampling: generators of frame times, int64 ns, from t0 to t1, both included, strictly increasing.

A generator decides each time only when it is requested, so frames are pulled one by one and memory does not grow with
the length of a sequence.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction

import numpy as np

from blinkgl.machine.kernels import kernel

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


def displacement_times(
    max_px: float, min_step_ns: int, max_step_ns: int, t0_ns: int, t1_ns: int, speed: Callable[[int], float]
) -> Iterator[int]:
    """Yield times with ``speed * step <= max_px`` at both ends of each step, steps within [min_step, max_step].

    speed : t_ns -> largest image speed at that time, px/s."""
    return bounded_times(lambda t_ns: speed(t_ns) / max_px, min_step_ns, max_step_ns, t0_ns, t1_ns)


def bounded_times(
    pace: Callable[[int], float],
    min_step_ns: int,
    max_step_ns: int,
    t0_ns: int,
    t1_ns: int,
    stops_ns: Sequence[int] = (),
) -> Iterator[int]:
    """Yield times with ``pace * step <= 1`` at both ends of each step, steps within [min_step, max_step].

    pace : t_ns -> steps per second that the scene needs at that time.
    stops_ns : increasing times that no step may cross, such as impacts: a motion that reverses inside a step is
        invisible at its ends. One that comes less than min_step after another, or before t1, is left out.
    The step is proposed from the pace at its start (as in Rebecq et al. 2018, section 3.2), or from the expected pace
    at its end if the pace rises as over the last step. It is then checked against the pace at its end, which the
    original does not do: a motion that accelerates inside the step would exceed the bound. A rejected step is shortened
    and tried again. The pace at an accepted end is the next step's start, so there is one pace per frame if nothing is
    rejected. The last step ends at t1 exactly; steps are shorter than min_step only there and before a stop.
    """
    yield t0_ns
    t = t0_ns
    v = v_before = pace(t)
    ends = deque(_apart(stops_ns, min_step_ns, t0_ns, t1_ns))
    while t < t1_ns:
        while ends and ends[0] <= t:
            ends.popleft()
        # No step crosses a stop or the end.
        # 2 v - v_before: the pace at the step's end if it rises by as much as over the last step.
        expected = max(v, 2 * v - v_before)
        step = min(_step(_PROPOSED, expected, min_step_ns, max_step_ns), (ends[0] if ends else t1_ns) - t)
        while True:
            end = t + step
            v_end = pace(end)
            if max(v, v_end) * step <= NS_PER_S * (1 + 1e-9) or step <= min_step_ns:
                break
            # 0.9: a step cut to exactly the limit of the end's pace is often rejected again.
            step = max(min_step_ns, min(int(0.9 * step), _step(0.95, max(v, v_end), min_step_ns, max_step_ns)))
        yield end
        t, v_before, v = end, v, v_end


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


# ---------------------------------------------------------------------------------------------------------------------
# Speed of the fastest pixel.


@kernel
def _largest_squared(velocity):
    largest = np.float32(0.0)
    for y in range(velocity.shape[0]):
        for x in range(velocity.shape[1]):
            # Compares squares and takes one root at the end; inf and NaN fail the comparison.
            squared = velocity[y, x, 0] * velocity[y, x, 0] + velocity[y, x, 1] * velocity[y, x, 1]
            if squared > largest and squared < np.float32(np.inf):
                largest = squared
    return largest


def largest_speed(velocity: np.ndarray) -> float:
    """Return the largest speed, px/s, of (H, W, 2) float32 px/s. Pixels without a finite velocity (a surface in the
    camera plane) are left out."""
    return float(np.sqrt(_largest_squared(velocity)))
