"""Checks of a file's events: no overflow, no event outside the sensor, no decreasing times.

Every reader passes its columns to :func:`events_of`; :class:`blinkgl.io.formats.EventFile`, the slicing readers and
every writer call :func:`check_events` for the rest. Positions in messages are indices of events, counted from the
file's first.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from blinkgl.errors import AssetError, EventDataError, OutputError
from blinkgl.io.atomic import output_errors
from blinkgl.machine.closing import Finishing
from blinkgl.types.events import Cause, Events

MAX_SIDE, MAX_PIXELS = 65536, 1 << 25


class BadEvent(EventDataError):
    """A value that no event has: NaN, a place or a time out of all bounds. ``--damaged keep`` leaves it out."""


_MAX_TIME = 1 << 62
"""µs; sums and differences of two such times still fit int64."""


def events_of(
    x: np.ndarray,
    y: np.ndarray,
    t: np.ndarray,
    p: np.ndarray,
    where: str,
    first: int = 0,
    *,
    cause: np.ndarray | None = None,
    offset: int = 0,
    signed: bool = False,
    polarity: tuple[float, float] | None = None,
) -> Events:
    """Return columns of any integer, boolean or float type as :class:`Events`; ``offset`` (µs) is added to the times.

    t : µs. p : 0 or 1, with ``signed`` also -1, which becomes 0; or the two numbers of ``polarity``, OFF and ON.
    cause : 0 to 3, see :class:`~blinkgl.types.events.Cause`, where the file has them. first : index of the first of
    these events in the file.
    Raises EventDataError, naming event and value, for what Events cannot hold: coordinates outside uint16 or between
    pixels, NaN, times beyond int64, another polarity. AssetError: a column that is not a 1-D array of numbers, or
    columns of different lengths."""
    columns = {"x": np.asarray(x), "y": np.asarray(y), "t": np.asarray(t), "p": np.asarray(p)}
    if polarity is not None:
        columns["p"], signed = on_or_off(columns["p"], polarity, where, first), False
    if cause is not None:
        columns["cause"] = np.asarray(cause)
    if any(c.ndim != 1 for c in columns.values()) or len({len(c) for c in columns.values()}) != 1:
        raise AssetError("event columns differ in length", where=where, value={k: c.shape for k, c in columns.items()})
    x = whole(columns["x"], "x", np.uint16, 0, MAX_SIDE - 1, where, first)
    y = whole(columns["y"], "y", np.uint16, 0, MAX_SIDE - 1, where, first)
    # Times have to be in the range after the offset, too.
    t = whole(columns["t"], "t", np.int64, -_MAX_TIME - min(offset, 0), _MAX_TIME - max(offset, 0), where, first)
    accepted = _SIGNED if signed else None
    p = whole(columns["p"], "p", np.int8, -1 if signed else 0, 1, where, first, accepted)
    if cause is not None:
        cause = whole(columns["cause"], "cause", np.uint8, 0, max(Cause), where, first)
    return Events(x, y, t + offset if offset else t, (p > 0).view(np.uint8) if signed else p.view(np.uint8), cause)


def microseconds(times: np.ndarray, where: str, first: int = 0, unit_ns: int = 10**9) -> np.ndarray:
    """Return int64 µs, rounded, of times in units of ``unit_ns`` (1e9: s, 1000: µs). Raises EventDataError, naming the
    event, for NaN, infinity and what int64 cannot hold; AssetError: no numbers."""
    times = np.asarray(times)
    if times.dtype.kind not in "iufb":
        accepted = "integers, floats, or dates in s, ms, us or ns"
        raise AssetError("event column 't' holds no numbers", where=where, value=str(times.dtype), accepted=accepted)
    if times.dtype.kind in "iu" and unit_ns == 1000 and len(times) and abs(int(times.max())) < _MAX_TIME:
        return times.astype(np.int64, copy=False)
    scale = unit_ns / 1000
    rounded = np.rint(times.astype(np.float64, copy=False) * scale)
    if len(times) and not (good := np.abs(rounded) < _MAX_TIME).all():  # NaN compares False
        i = int(np.argmin(good))
        raise BadEvent(
            f"time of event {first + i}", where=where, value=times[i].item(), accepted="times that fit int64 µs"
        )
    if times.dtype.kind == "f":
        return rounded.astype(np.int64)
    whole = times.astype(np.int64)  # exact: a float64 holds 53 bits only
    return whole * int(scale) if scale >= 1 else (whole + 500) // 1000


def on_or_off(p: np.ndarray, pair: tuple[float, float], where: str, first: int = 0) -> np.ndarray:
    """Return uint8 1 where ``p`` is the second of the pair (ON), 0 where it is the first. Raises EventDataError, naming
    event and value."""
    on = p == pair[1]
    if not (good := on | (p == pair[0])).all():
        _refuse(p, good, "polarity", f"{pair[0]:g} or {pair[1]:g} (--polarity)", where, first)
    return on.view(np.uint8)


def check_events(
    events: Events,
    where: str,
    first: int = 0,
    *,
    height: int | None = None,
    width: int | None = None,
    after: int | None = None,
) -> int | None:
    """Refuse, naming event and value, events outside a sensor of that size (None: not known), a polarity other than 0
    and 1, and decreasing times, also against ``after``, the last time before these events. Return the last time
    (``after`` when there are no events). Raises EventDataError."""
    t = events.t
    if not len(t):
        return after
    # Chunks are checked one by one, so the last time of the chunk before is kept.
    if after is not None and t[0] < after:
        raise EventDataError(f"event times decrease at event {first}", where=where, value=(after, int(t[0])))
    if (back := t[1:] < t[:-1]).any():
        i = int(np.argmax(back))
        raise EventDataError(
            f"event times decrease at event {first + i + 1}", where=where, value=(int(t[i]), int(t[i + 1]))
        )
    # A maximum is one pass; which event it was is looked up only for the message.
    for name, side in (("x", width), ("y", height)):
        column = getattr(events, name)
        if side is not None and column.max() >= side:
            i = int(np.argmax(column >= side))
            raise EventDataError(
                f"event {first + i} is outside the sensor",
                where=where,
                value=(int(events.x[i]), int(events.y[i])),
                accepted=", ".join(f"{k} < {n}" for k, n in (("x", width), ("y", height)) if n is not None),
            )
    if events.cause is not None and events.cause.max() > max(Cause):
        i = int(np.argmax(events.cause > max(Cause)))
        raise EventDataError(
            f"cause of event {first + i}", where=where, value=int(events.cause[i]), accepted=f"0 to {int(max(Cause))}"
        )
    if events.p.max() > 1:
        i = int(np.argmax(events.p > 1))
        raise EventDataError(f"polarity of event {first + i}", where=where, value=int(events.p[i]), accepted="0 or 1")
    return int(t[-1])


def joined(pieces: Iterable[Events], least: int) -> Iterator[Events]:
    """Yield events in pieces of ``least`` or more. What precedes an error is yielded before it is raised."""
    pending, count = [], 0
    try:
        for events in pieces:
            pending.append(events)
            count += len(events)
            if count >= least:
                yield Events.concatenate(pending)
                pending, count = [], 0
    except (AssetError, EventDataError):
        if pending:
            yield Events.concatenate(pending)
        raise
    if pending:
        yield Events.concatenate(pending)


def windows(pieces: Iterable[Events], edges: np.ndarray) -> Iterator[Events]:
    """Yield the events of each [edges[k], edges[k+1]), µs, also of empty ones; no piece is empty."""
    parts: list[Events] = []
    k, last = 0, len(edges) - 1
    for events in pieces:
        while k < last:
            parts.append(events.window(int(edges[k]), int(edges[k + 1])))
            if events.t[-1] < edges[k + 1]:
                break  # the interval may go on in the next piece
            yield Events.concatenate(parts)
            parts, k = [], k + 1
        if k == last:
            return
    while k < last:
        yield Events.concatenate(parts)
        parts, k = [], k + 1


class CheckedWriter(Finishing):
    """Base of writers of event files: checks what it is given, counts, and closes ``_file``. A subclass has
    :meth:`_write`.

    height, width : px, None: not known.   limits : times that the format holds, [least, most) µs, and what they are.
    kind : name of a format that cannot store the causes of events; "": it can."""

    kind = ""
    limits: tuple[int, int, str] | None = None

    def __init__(self, path: str | os.PathLike, height: int | None, width: int | None):
        self.path, self._size, self.count = Path(path), (height, width), 0
        self._last: int | None = None
        self._file: Any = None
        self.t_end_us: int | None = None

    def append(self, events: Events) -> None:
        """Add events. Raises OutputError: causes, which the format cannot store, or the disk refuses; EventDataError as
        :func:`check_events`, and times that the format cannot hold."""
        where, (height, width) = str(self.path), self._size
        if self.kind and events.cause is not None:
            raise OutputError(
                f"{self.kind} cannot hold the causes of events",
                where=where,
                accepted=".h5, .npz or .npy, or events without causes",
            )
        if not len(events):
            return
        if self.limits is not None:
            least, most, problem = self.limits
            if events.t[0] < least or events.t[-1] >= most:
                raise EventDataError(
                    problem,
                    where=where,
                    value=int(events.t[0] if events.t[0] < least else events.t[-1]),
                    accepted=f"{least} to less than {most} µs",
                )
        self._last = check_events(events, where, self.count, height=height, width=width, after=self._last)
        with output_errors(self.path):
            self._write(events)
        self.count += len(events)

    def _write(self, events: Events) -> None:
        raise NotImplementedError

    def close(self, t_end_us: int | None = None) -> None:
        """Finish the file."""
        with output_errors(self.path):
            self._file.close()

    def abort(self) -> None:
        """Stop without finishing; never raises."""
        with contextlib.suppress(Exception):
            self._file.close()


def check_size(height: int | None, width: int | None, where: str, most: int = MAX_PIXELS) -> None:
    """Raise AssetError when a sensor's declared size (None: not declared) is impossible, before anything of that size
    is made."""
    sides = [side for side in (height, width) if side is not None]
    if not all(0 < side <= MAX_SIDE for side in sides) or (len(sides) == 2 and sides[0] * sides[1] > most):
        raise AssetError(
            "impossible sensor size",
            where=where,
            value=f"{width}x{height}",
            accepted=f"1 to {MAX_SIDE} px a side and at most {most} px: --size WIDTHxHEIGHT",
        )


def whole(
    column: np.ndarray,
    name: str,
    dtype: DTypeLike,
    low: int,
    high: int,
    where: str,
    first: int,
    accepted: str | None = None,
) -> np.ndarray:
    """Return numbers of events as ``dtype``, every value unchanged. Raises EventDataError, naming event and value:
    outside ``low`` … ``high``, NaN, or between two integers; AssetError: no numbers."""
    if column.dtype.kind not in "iufb":
        raise AssetError(
            f"event column '{name}' holds no numbers",
            where=where,
            value=str(column.dtype),
            accepted="integers or floats",
        )
    # A type that can only hold accepted values needs no pass over the column.
    limits = None if column.dtype.kind in "fb" else np.iinfo(column.dtype)
    fits = column.dtype.kind == "b" or (limits is not None and limits.min >= low and limits.max <= high)
    if not fits and len(column) and not (column.min() >= low and column.max() <= high):  # NaN compares False
        good = (column >= low) & (column <= high)
        _refuse(column, good, name, accepted or f"{low} to {high}", where, first)
    out = column.astype(dtype, copy=False)
    if column.dtype.kind == "f":
        whole = out == column
        if not whole.all():
            _refuse(column, whole, name, "whole numbers", where, first)
    return out


_SIGNED = "0 or 1, -1 or 1"


def proposed_polarity(p: np.ndarray) -> str:
    """Return the option to paste for the numbers of OFF and ON, as the end of a message; "": there are no numbers."""
    values = np.unique(p[np.isfinite(p)]) if p.dtype.kind in "iuf" else p[:0]
    if len(values) == 2:
        return f"; or --polarity {values[0]:.17g}/{values[1]:.17g}"
    return "; or --polarity, the numbers of OFF and ON" if len(values) else ""


def _refuse(column: np.ndarray, good: np.ndarray, name: str, accepted: str, where: str, first: int) -> None:
    i = int(np.argmin(good))
    value = column[i].item()
    if accepted == _SIGNED:
        accepted += proposed_polarity(column)
    # Codes of polarity, and places between pixels, are sound values that the reader does not know: no damage.
    sound = value == value and (name in ("p", "polarity") or accepted == "whole numbers")
    kind = EventDataError if sound else BadEvent
    raise kind(f"{name} of event {first + i}", where=where, value=value, accepted=accepted)


# ---------------------------------------------------------------------------------------------------------------------
# Recordings of a camera beside its events: its frames and the samples of an inertial measurement unit.

G = 9.80665
"""m/s²; the unit of recordings."""


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """image : (H, W) or (H, W, 3) RGB, uint8 or uint16, row 0 at the top. begin_us, end_us : int, of the exposure, on
    the events' clock; the same where the file does not tell them apart."""

    image: np.ndarray
    begin_us: int
    end_us: int

    @property
    def t_us(self) -> int:
        """Return the middle of the exposure."""
        return (self.begin_us + self.end_us) // 2


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """t : (N,) int64 µs, on the events' clock, non-decreasing. acceleration : (N, 3) float64 m/s². rate : (N, 3)
    float64 rad/s. temperature : (N,) float64 °C. Axes are those of the unit, as the file has them."""

    t: np.ndarray
    acceleration: np.ndarray
    rate: np.ndarray
    temperature: np.ndarray

    def __len__(self) -> int:
        return len(self.t)
