"""Times of a video's frames from the stamps of its clock, whose ticks may be as long as a frame (Matroska's: 1 ms)."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

_HALF = Fraction(51, 100)
"""Ticks by which a rounded stamp may differ from the time that was rounded."""


def frame_times(ticks: Sequence[int], tick: Fraction, start: Fraction, rates: Sequence[Fraction]) -> list[int]:
    """Return the times of frames, ns since ``start``.

    ticks : stamps, non-decreasing.   tick : s.   start : s, of the file.   rates : frame rates that the file states,
    Hz.

    Stamps are rounded times. Where a stated rate explains all of them the times are those of that rate. Else they are
    taken as they are.

    Raises nothing: stamps that cannot be times are for the caller to refuse."""
    if not ticks:
        return []
    offset = Fraction(ticks[0]) * tick - start
    steps = [k - ticks[0] for k in ticks]
    exact = lambda values: [round((offset + value) * 10**9) for value in values]
    if (rate := _constant(steps, tick, rates)) is not None:
        return exact(k / rate for k in range(len(steps)))
    return exact(step * tick for step in steps)


def _constant(steps: Sequence[int], tick: Fraction, rates: Sequence[Fraction]) -> Fraction | None:
    """Return the rate, Hz, of frames at equal intervals whose times were rounded to ``steps`` of a clock, or None."""
    if len(steps) < 3 or steps[-1] <= 0:
        return None
    for rate in rates:
        off = [step - k / (rate * tick) for k, step in enumerate(steps)]
        if max(off) - min(off) <= 2 * _HALF:  # the first stamp was rounded, too
            return rate
    return None
