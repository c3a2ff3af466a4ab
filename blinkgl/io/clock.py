"""Units of time of files: read from a heading or a name, or declared by the user. One list of times has one unit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from blinkgl.errors import ConfigError
from blinkgl.types.numbers import exact

NANOSECONDS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""ns in each unit, by the name that ``--time-unit`` takes."""
_SPELT = {
    "s": "s sec secs second seconds",
    "ms": "ms msec msecs millisecond milliseconds",
    "us": "us usec usecs microsecond microseconds µs μs",
    "ns": "ns nsec nsecs nanosecond nanoseconds",
}
_UNIT_OF = {word: unit for unit, words in _SPELT.items() for word in words.split()}


def checked_unit(unit: str | None, where: str = "--time-unit") -> str | None:
    """Return a declared unit. Raises ConfigError: not one of s, ms, us, ns."""
    if unit is None or unit in NANOSECONDS:
        return unit
    raise ConfigError("unknown unit of time", where=where, value=unit, accepted=", ".join(NANOSECONDS))


def named_unit(heading: str) -> str | None:
    """Return the unit that a heading, a column's or an array's name, or a file's stem states: ``t_us``, ``t[us]``,
    ``timestamp [ns]``, ``time (ms)``, ``timestamps_ns``, ``Time in seconds``; None where it states none.

    A bare ``s`` counts in brackets and after an underscore only: it ends many words."""
    text = heading.strip().lower()
    if match := re.search(r"[\[(<{]\s*([a-zµμ]+)\s*[\])>}]", text):
        return _UNIT_OF.get(match[1])
    if match := re.search(r"(?:_|\bin )([a-zµμ]+)$", text):
        return _UNIT_OF.get(match[1])
    return _UNIT_OF.get(text) if len(text) > 1 else None


def nanoseconds(values: Sequence[str | Fraction] | np.ndarray, unit: str) -> list[int]:
    """Return times as whole ns, rounded to the nearest. Texts are converted exactly: a float64 of seconds since 1970
    holds steps of 240 ns only. Raises ValueError: a text that is no number."""
    scale = NANOSECONDS[unit]
    if isinstance(values, np.ndarray):
        if values.dtype.kind in "iu":
            return [int(value) * scale for value in values]
        return [round(Fraction(float(value)) * scale) for value in values]
    return [round((exact(value) if isinstance(value, str) else value) * scale) for value in values]


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
