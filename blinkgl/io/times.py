"""Times in files. Their unit is read from a heading or a name, or declared by the user; one list has one unit. Times of
a video's frames from the stamps of its clock, whose ticks may be as long as a frame (Matroska's: 1 ms). Lists of frame
times: one a line, with or without the names of the frames (the Event Camera Dataset's images.txt, TUM's rgb.txt,
EuRoC's data.csv, DSEC's timestamps, mkvextract's timestamps_v2)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError, ConfigError, EventDataError
from blinkgl.io.records import input_errors, read_text
from blinkgl.types.numbers import exact, is_number

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


@dataclass(frozen=True)
class Stamps:
    """times_ns : int ns, in the file's order.   names : of the frames, None where the list has none.   note : the line
    that says a layout that was recognised, or a unit that was overruled; or None."""

    times_ns: list[int]
    names: list[str] | None = None
    note: str | None = None


def overruled(stated: str | None, declared: str | None, option: str = "--time-unit") -> list[str]:
    """Return the line that says that another unit of time was declared than the file states."""
    other = stated is not None and declared is not None and stated != declared
    return [f"the file says {stated}; {option} {declared} is used"] if other else []


class Undeclared(EventDataError):
    """A list of times whose unit is neither stated nor declared."""


_SECONDS = re.compile(r"[-+]?\d+\.(\d+)([eE][-+]?\d+)?")
PLACES = 6
"""The Event Camera Dataset's and TUM's lists: seconds with a point, of which some have six places or more, or names."""


def read_timestamps(
    path: Path, unit: str | None = None, fps: float | None = None, *, usual: str | None = None
) -> Stamps:
    """Return the times of a list.

    Columns are separated by blanks, tabs, commas or semicolons; ``#`` begins a comment, and the first line may be a
    heading. The time is the column that a heading calls so, else the first of numbers that is no plain count beside
    another; a start and an end of an exposure give their middle. The unit is ``unit`` ("s", "ms", "us", "ns"; "frames"
    of ``fps`` Hz), else what the heading or the file's name states, else ``usual``, that of a known writer; else
    seconds, where every time has a point, and some have six places or all have names.

    Raises AssetError: unreadable. EventDataError: not a time, with its line; no times; Undeclared: no unit.
    ConfigError: "frames" without fps."""
    with input_errors(path):
        heading, numbered = read_rows(path.read_text(encoding="utf-8-sig", errors="replace"))
    rows = [fields for _, fields in numbered]
    if not rows:
        raise EventDataError("no time stamps", where=str(path))
    titles = titles_of(heading)
    columns = _time_columns(rows, titles)
    texts: list[str] = []
    times: list[Fraction] = []
    for number, row in numbered:
        chosen = [row[k] for k in columns if k < len(row)]
        if len(chosen) < len(columns) or not all(map(is_number, chosen)):
            raise EventDataError(
                f"line {number} is not a time stamp",
                where=str(path),
                value=" ".join(row),
                accepted="'time' or 'time name', a finite number",
            )
        texts.append(chosen[0])
        times.append(sum(map(exact, chosen), Fraction(0)) / len(chosen))
    names = _names(rows, columns, path)
    own = _stated(titles, columns, heading, path)
    note = next((f"{path.name}: {line}" for line in overruled(own, unit)), None)
    if unit == "frames":
        if fps is None:
            raise ConfigError(
                "times in frames need a frame rate", where="--time-unit", value=unit, accepted="--fps, too"
            )
        return Stamps([round(time * 10**9 / Fraction(fps)) for time in times], names, note)
    stated = unit or own or usual
    if stated is not None:
        return Stamps(nanoseconds(times, stated), names, note)
    places = places_of(texts)
    if places and (names is not None or places >= PLACES) and len(columns) == 1:
        note = f"{path.name}: read as the Event Camera Dataset's and TUM's lists: seconds with a point"
        return Stamps(nanoseconds(times, "s"), names, note)
    raise _undeclared(str(path), any("." in text for text in texts))


def places_of(times: Sequence[str]) -> int:
    """Return the most places that seconds with a point have; 0: some time has no point, or is no number."""
    points = [_SECONDS.fullmatch(text) for text in times]
    return max((len(point[1]) for point in points if point), default=0) if None not in points else 0


_MICROSECONDS = re.compile(r"[-+]?\d{1,16}")


def read_label_times(path: Path, columns: int, count: int | None = None) -> list[tuple[int, ...]]:
    """Return the rows of a list of times, µs, separated by commas, without ``#`` comments: one column for labels of one
    time, two for the start and the end of flow.   count : the number of files that they belong to; None: not compared.

    Raises AssetError: missing, not such a row (with its line), another number of rows."""
    try:
        lines = read_text(path).splitlines()
    except FileNotFoundError:
        raise AssetError("no such file", where=str(path)) from None
    rows = []
    for number, line in enumerate(lines, 1):
        fields = [part.strip() for part in line.split(",")]
        if not line.strip() or line.startswith("#"):
            continue
        if len(fields) != columns or not all(map(_MICROSECONDS.fullmatch, fields)):
            raise AssetError(
                f"line {number} is no time",
                where=str(path),
                value=line,
                accepted="from_us, to_us" if columns == 2 else "a time in µs",
            )
        rows.append(tuple(map(int, fields)))
        if columns == 2 and rows[-1][0] == rows[-1][1]:
            raise AssetError(f"line {number} is not an interval", where=str(path), value=line, accepted="two times")
    if count is not None and len(rows) != count:
        raise AssetError("files and time stamps differ in number", where=str(path), value=(count, len(rows)))
    return rows


def stamps_of_array(name: str, values: np.ndarray, unit: str | None, where: str) -> Stamps:
    """Return the times of an array (N,) named ``name``; the unit as of :func:`read_timestamps`. Raises EventDataError:
    not numbers, not finite."""
    values, own = np.asarray(values).reshape(-1), named_unit(name)
    # NumPy's datetime64 and timedelta64 say their unit in the type.
    if values.dtype.kind in "mM" and not np.isnat(values).any():
        dated, step = np.datetime_data(values.dtype)
        own, values = dated if step == 1 and dated in NANOSECONDS else own, values.astype(np.int64)
    if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        bad = int(np.argmax(~np.isfinite(values))) if values.dtype.kind == "f" else 0
        raise EventDataError(
            "not a time",
            where=f"{where}: '{name}'[{bad}]",
            value=values[bad : bad + 1].tolist(),
            accepted="a finite number",
        )
    stated = unit or own
    if stated is None:
        raise _undeclared(f"{where}: '{name}'", values.dtype.kind == "f" and bool((values % 1).any()))
    return Stamps(nanoseconds(values, stated), note=next(iter(overruled(own, unit)), None))


def _undeclared(where: str, points: bool) -> Undeclared:
    proposed = "s" if points else "us"
    accepted = f"try --time-unit {proposed} if that is right (--frames-time-unit in compare and calibrate), or --fps"
    return Undeclared("no unit of the times is stated", where=where, accepted=accepted)


def _time_columns(rows: Sequence[Sequence[str]], titles: Sequence[str]) -> list[int]:
    """Return the column of the times, or the two whose middle is the time."""
    width = min(len(row) for row in rows)
    if width == len(titles):
        between = [k for k, title in enumerate(titles) if re.search(r"start|begin|end|stop", title, re.I)]
        if len(between) == 2:
            return between
        words = r"(time(_?stamps?)?|t|ts|stamps?)(?![a-z])"
        # A title of these words comes before one that ends with them, such as exposure_time.
        for before in ("#?", r".*[_ ]"):
            if called := [k for k, title in enumerate(titles) if re.match(before + words, title, re.I)]:
                return called[:1]
    numeric = [k for k in range(width) if all(is_number(row[k]) for row in rows)]
    if len(numeric) < 2:
        # One odd line among numbers is named by its line, so the first column stays the time.
        return numeric[:1] if numeric and not is_number(rows[0][0]) else [0]
    first = [exact(row[numeric[0]]) for row in rows]
    # Numbers that count 0, 1, 2, … beside another column of numbers are no times.
    counts = len(first) > 2 and first[0] in (0, 1) and all(b - a == 1 for a, b in pairwise(first))
    return [numeric[1] if counts else numeric[0]]


def _names(rows: Sequence[Sequence[str]], columns: Sequence[int], path: Path) -> list[str] | None:
    others = [[" ".join(part for k, part in enumerate(row) if k not in columns)] for row in rows]
    names = [other[0] or None for other in others]
    if all(name is None or is_number(name) for name in names):
        return None
    if None in names:
        raise EventDataError(
            "times with a name and times without one", where=str(path), accepted="'time', or 'time name', in every line"
        )
    # A row of other columns and one name: the name has a letter.
    return [next((part for part in reversed(str(name).split(" ")) if not is_number(part)), str(name))
            if len(rows[k]) > 2 and any(is_number(part) for part in str(name).split(" ")) else str(name)
            for k, name in enumerate(names)]  # fmt: skip


def _stated(titles: Sequence[str], columns: Sequence[int], heading: str, path: Path) -> str | None:
    """Return the unit that a title, the heading or the file's name states."""
    stated = named_unit(titles[columns[0]]) if columns[0] < len(titles) else None
    if stated is None and re.search(r"time(code|stamp)s? format v2", heading, re.I):
        stated = "ms"  # mkvextract
    return stated or (named_unit(heading) if not titles[1:] else None) or named_unit(path.stem)


_TITLE = re.compile(r"[^\s,;]+(?:\s*[\[(][^\])]*[\])])?")


def read_rows(text: str, most: int = 5_000_000) -> tuple[str, list[tuple[int, list[str]]]]:
    """Return the heading, the last comment or line without a number before the data, and (line, fields) of each line
    of data; fields are separated by blanks, tabs, commas or semicolons, and ``#`` begins a comment."""
    heading, rows = "", []
    for number, line in enumerate(text.splitlines()[:most], 1):
        body, _, comment = line.partition("#")
        fields = [part for part in re.split(r"[\s,;]+", body.strip()) if part]
        titled = comment.strip() if not fields else body.strip()
        if not fields or (not rows and not any(map(is_number, fields)) and (len(fields) > 1 or not heading)):
            heading = titled if titled and not rows else heading
        else:
            rows.append((number, fields))
    return heading, rows


def titles_of(heading: str) -> list[str]:
    """Return the titles of a heading's columns, units in brackets included."""
    return _TITLE.findall(heading)
