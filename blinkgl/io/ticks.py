"""Times of a video's frames from the stamps of its clock, whose ticks may be as long as a frame (Matroska's: 1 ms)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise

_HALF = Fraction(51, 100)
"""Ticks by which a rounded stamp may differ from the time that was rounded."""


def frame_times(
    ticks: Sequence[int], tick: Fraction, start: Fraction, rates: Sequence[Fraction]
) -> tuple[list[int], str | None]:
    """Return the times of frames, ns since ``start``, and a line on what was guessed, or None.

    ticks : stamps, non-decreasing.   tick : s.   start : s, of the file.   rates : frame rates that the file states,
    Hz.

    Stamps are rounded times. Where one constant rate explains all of them the times are those of that rate: a stated
    one, else the roundest that does. Else they are taken as they are; frames of one stamp share the time up to the next
    stamp evenly, and the line says so.

    Raises nothing: stamps that cannot be times are for the caller to refuse."""
    if not ticks:
        return [], None
    offset = Fraction(ticks[0]) * tick - start
    steps = [k - ticks[0] for k in ticks]
    exact = lambda values: [round((offset + value) * 10**9) for value in values]
    if (rate := _constant(steps, tick, rates)) is not None:
        return exact(k / rate for k in range(len(steps))), None
    if all(a != b for a, b in pairwise(steps)):
        return exact(step * tick for step in steps), None
    note = f"frames share stamps of {float(tick) * 1000:g} ms: spaced evenly in between (--fps for a constant rate)"
    return exact(tick * step for step in _spread(steps)), note


def _constant(steps: Sequence[int], tick: Fraction, rates: Sequence[Fraction]) -> Fraction | None:
    """Return the rate, Hz, of frames at equal intervals whose times were rounded to ``steps`` of a clock, or None."""
    if len(steps) < 3 or steps[-1] <= 0:
        return None
    for rate in rates:
        off = [step - k / (rate * tick) for k, step in enumerate(steps)]
        if max(off) - min(off) <= 2 * _HALF:  # the first stamp was rounded, too
            return rate
    # Each stamp bounds the time between frames; a constant rate lies within all of these bounds.
    low = max((step - _HALF) * tick / k for k, step in enumerate(steps) if k)
    high = min((step + _HALF) * tick / k for k, step in enumerate(steps) if k)
    return _roundest(1 / high, 1 / low) if 0 < low <= high else None


def _roundest(low: Fraction, high: Fraction) -> Fraction:
    """Return the number of the fewest decimal digits in [low, high], both positive."""
    middle = (low + high) / 2
    # One place above the first significant digit, from which the loop goes down place by place.
    digit = Fraction(10) ** (math.floor(math.log10(middle)) + 1)
    for _ in range(20):
        digit /= 10
        if low <= (value := round(middle / digit) * digit) <= high:
            return value
    return middle


def _spread(steps: Sequence[int]) -> list[Fraction]:
    """Return stamps with equal ones spaced evenly up to the next, the last ones as those before."""
    out: list[Fraction] = []
    at, share = 0, Fraction(1)
    while at < len(steps):
        end = at
        while end < len(steps) and steps[end] == steps[at]:
            end += 1
        if end < len(steps):
            share = Fraction(steps[end] - steps[at], end - at)
        out += [steps[at] + share * k for k in range(end - at)]
        at = end
    return out
