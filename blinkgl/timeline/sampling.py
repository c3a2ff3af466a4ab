"""Time sampling: generators of frame times, int64 ns, from t0 to t1, both included, strictly increasing.

The generator decides the next time only when it is asked for it, so frames can be pulled one by one and nothing
grows with the length of a sequence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from fractions import Fraction

NS_PER_S = 1_000_000_000


def frame_times(config, t0_ns: int, t1_ns: int, speed: Callable[[int], float]) -> Iterator[int]:
    """Times of one sequence for any ``timeline:`` configuration.

    speed : t_ns -> largest image speed at that time, px/s; only called by strategies that adapt to it.
    """
    if config.kind == "uniform":
        return uniform_times(config.fps, t0_ns, t1_ns)
    return displacement_times(config.max_px, round(config.min_step_us * 1000), round(config.max_step_us * 1000),
                              t0_ns, t1_ns, speed)


def uniform_times(fps: float, t0_ns: int, t1_ns: int) -> Iterator[int]:
    """t0 + k / fps, each rounded to the nanosecond on its own (no error accumulates), then t1."""
    step = NS_PER_S / Fraction(fps).limit_denominator(1_000_000)
    yield t0_ns
    last, k = t0_ns, 1
    while (t := t0_ns + round(k * step)) < t1_ns:
        if t > last:  # above 1e9 fps neighbouring frames would round to the same nanosecond
            yield t
            last = t
        k += 1
    if t1_ns > last:
        yield t1_ns


def displacement_times(max_px: float, min_step_ns: int, max_step_ns: int, t0_ns: int, t1_ns: int,
                       speed: Callable[[int], float]) -> Iterator[int]:
    """Steps so short that ``speed * step <= max_px`` at both ends of each step, within [min_step, max_step].

    The step is proposed from the speed at its start (as in Rebecq et al. 2018, section 3.2) and then checked against
    the speed at its end, which the original does not do: something that accelerates inside the step would exceed the
    bound. A rejected step is shortened and tried again; the speed at an accepted end is the next step's start, so a
    speed is asked for once per frame as long as nothing is rejected. The last step ends at t1 exactly, and steps
    before it may be shorter than min_step only there.
    """
    yield t0_ns
    t, v = t0_ns, speed(t0_ns)
    while t < t1_ns:
        step = min(_step(max_px, v, min_step_ns, max_step_ns), t1_ns - t)
        while True:
            end = t + step
            v_end = speed(end)
            if max(v, v_end) * step <= max_px * NS_PER_S * (1 + 1e-9) or step <= min_step_ns:
                break
            # 0.9: a step cut to exactly what the end's speed asks for is often rejected again.
            step = max(min_step_ns, min(int(0.9 * step), _step(0.95 * max_px, max(v, v_end), min_step_ns, max_step_ns)))
        yield end
        t, v = end, v_end


def _step(max_px: float, speed: float, low: int, high: int) -> int:
    if speed * high <= max_px * NS_PER_S:
        return high
    return max(low, int(max_px / speed * NS_PER_S))
