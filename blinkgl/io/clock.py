"""Units of time of files: read from a heading, declared by the user, or guessed from all values together.

One list of times has one unit. A guess is never made value by value, and :attr:`TimeUnit.line` says it in one line.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from blinkgl.errors import ConfigError, EventDataError

NANOSECONDS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""ns in each unit, by the name that ``--time-unit`` takes."""
_SPELT = {
    "s": "s sec secs second seconds",
    "ms": "ms msec msecs millisecond milliseconds",
    "us": "us usec usecs microsecond microseconds µs μs",
    "ns": "ns nsec nsecs nanosecond nanoseconds",
}
_UNIT_OF = {word: unit for unit, words in _SPELT.items() for word in words.split()}
_TYPICAL_HZ = 100.0
"""Frame rate nearest to which, as a ratio, a guessed unit brings the frames."""
_EPOCH_S = (9.4e8, 4.1e9)
"""Seconds since 1970 of the years 2000 to 2099: times of a clock that counts from there betray their unit."""
_LEAP = 500.0
"""Ratio of neighbouring steps from which on a list of times is taken to be in two units."""


@dataclass(frozen=True)
class TimeUnit:
    """The unit of a file's times.   name : "s", "ms", "us" or "ns".   how : "read" from the file, "declared" by the
    user, or "guessed".   span : first and last time in that unit, for the line."""

    name: str
    how: str
    span: tuple[float, float] | None = None

    @property
    def nanoseconds(self) -> int:
        """Return the ns in one unit."""
        return NANOSECONDS[self.name]

    @property
    def line(self) -> str | None:
        """Return the sentence that says a guess and the option that overrules it; None: nothing was guessed."""
        if self.how != "guessed":
            return None
        shown = ""
        if self.span is not None:
            first, last = (value * self.nanoseconds / 1e9 for value in self.span)
            shown = f": {first:.9g} … {last:.9g} s" if self.span[0] < 1e6 else f": {last - first:.9g} s in all"
        others = ", ".join(unit for unit in NANOSECONDS if unit != self.name)
        return f"times taken as {self.name}{shown} (--time-unit {others} if that is wrong)"


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
    if found := re.search(r"[\[(<{]\s*([a-zµμ]+)\s*[\])>}]", text):
        return _UNIT_OF.get(found[1])
    if found := re.search(r"(?:_|\bin )([a-zµμ]+)$", text):
        return _UNIT_OF.get(found[1])
    return _UNIT_OF.get(text) if len(text) > 1 else None


def unit_of(declared: str | None, stated: str | None, guessed: Callable[[], TimeUnit]) -> TimeUnit:
    """Return the unit that the user declares, else the one that the file states, else a guess."""
    if declared is not None:
        return TimeUnit(declared, "declared")
    return guessed() if stated is None else TimeUnit(stated, "read")


def guessed_frame_unit(values: np.ndarray, where: str) -> TimeUnit:
    """Return the unit in which times of frames, (N,) numbers of an unknown unit, make sense together.

    Times within this century's seconds since 1970 in one unit are in that unit; else the unit is the one in which the
    median step is nearest to that of 100 Hz. Raises EventDataError: steps that only two units explain."""
    values = np.asarray(values, np.float64)
    steps = np.diff(values)
    if not len(steps):
        # A single time has no step: a fraction is of seconds, a whole number is in µs.
        return TimeUnit("s" if (values % 1).any() else "us", "guessed", (float(values[0]), float(values[-1])))
    size = np.abs(values)
    with np.errstate(divide="ignore", invalid="ignore"):
        leaps = np.flatnonzero(np.maximum(size[1:], size[:-1]) > _LEAP * np.minimum(size[1:], size[:-1]))
    for k in leaps[leaps > 0]:
        # A pause leaps, too, but the steps after it are as long as those before.
        before, after = (
            np.median(np.abs(steps[:k])),
            np.median(np.abs(steps[k + 1 :])) if k + 1 < len(steps) else np.inf,
        )
        if max(before, after) > _LEAP * min(before, after):
            raise EventDataError(
                "times in two units",
                where=f"{where}: frames {k} and {k + 1}",
                value=values[k : k + 2].tolist(),
                accepted="one unit for all, or --time-unit s, ms, us or ns where the leap is meant",
            )
    positive = steps[steps > 0]
    usual = float(np.median(positive)) if len(positive) else 1.0
    # Decades between the frame rate that a unit gives and the typical one; a time of this century counts for 2.5.
    likely = {
        unit: abs(np.log10(1e9 / (usual * ns * _TYPICAL_HZ)))
        - (2.5 if _EPOCH_S[0] <= values[0] * ns / 1e9 <= _EPOCH_S[1] else 0)
        for unit, ns in NANOSECONDS.items()
    }
    return TimeUnit(min(likely, key=likely.__getitem__), "guessed", (float(values[0]), float(values[-1])))


def nanoseconds(values: Sequence[str] | np.ndarray, unit: TimeUnit) -> list[int]:
    """Return times as whole ns, rounded to the nearest. Texts are converted exactly: a float64 of seconds since 1970
    holds steps of 240 ns only."""
    scale = unit.nanoseconds
    if isinstance(values, np.ndarray):
        if values.dtype.kind in "iu":
            return [int(value) * scale for value in values]
        return [round(Fraction(float(value)) * scale) for value in values]
    return [round(Fraction(value) * scale) for value in values]


_TYPICAL_DURATION_S, _TYPICAL_RATE_HZ = 3.0, 1e5
"""Of recordings: the middle, as ratios, of what people have."""


@np.errstate(invalid="ignore", divide="ignore")  # of numbers that are no times, which their readers refuse
def guessed_event_unit(values: np.ndarray, count: int, span: tuple[float, float] | None = None) -> TimeUnit:
    """Return the unit in which the times of a whole file of events make sense together.

    values : (N,) times, or a sample of them.   count : events of the file.   span : its first and last time (None:
    those of ``values``).

    A unit is likely where it makes the recording some seconds long and its rate some 100,000 events/s. Whole numbers
    are µs, or ns where all are whole µs; fractions are of seconds, or of ms where three places are used: cameras count
    µs. Times of this century's clock betray their unit.
    """
    values = np.asarray(values, np.float64)
    first, last = (float(v) for v in span or ((values.min(), values.max()) if len(values) else (0.0, 0.0)))
    whole, thousands = not (values % 1).any(), not (values % 1000).any()
    # Scores, the lowest is the likeliest: a preference for each unit, to which distances are added.
    if whole:
        likely = {"us": -3.0, "ns": -4.0 if thousands and values.any() else 0.0}
    else:
        likely = {"s": -9.0 if _places(values) == 6 else -6.0, "ms": -3.0 if _places(values) == 3 else 0.0, "us": 0.0}
    for unit in likely if last > first and count > 1 else ():
        seconds = (last - first) * NANOSECONDS[unit] / 1e9
        # Squared distances from the typical values, in spreads of 1.2 and 1.5 decades.
        likely[unit] += (np.log10(seconds / _TYPICAL_DURATION_S) / 1.2) ** 2
        likely[unit] += (np.log10(count / seconds / _TYPICAL_RATE_HZ) / 1.5) ** 2
        if _EPOCH_S[0] <= first * NANOSECONDS[unit] / 1e9 <= _EPOCH_S[1]:
            likely[unit] -= 40.0
    return TimeUnit(min(likely, key=likely.__getitem__), "guessed", (first, last))


def _places(values: np.ndarray) -> int | None:
    """Return the decimal places that the values use, up to six; None: more."""
    scaled = (values * 10.0**k for k in range(7))
    return next((k for k, v in enumerate(scaled) if (np.abs(v - np.rint(v)) < 1e-4).all()), None)
