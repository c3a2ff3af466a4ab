"""What a user declares about an event file or a clip of frames. What is not declared is read from the file, and nothing
is guessed.

One value of :class:`EventReading`, or of :class:`Declared` for frames, passes from a command's options, or a Python
function's arguments, to every reader.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from blinkgl.errors import AssetError, ConfigError, EventDataError
from blinkgl.io.times import checked_unit
from blinkgl.types.numbers import is_number

_MOST_SIDE = 65536


def listed(table: Mapping[Any, Any], value: object, problem: str, where: str | os.PathLike, accepted: str = "") -> Any:
    """Return what a closed list has for a value of a file's field. Raises AssetError: the value is not in it."""
    if value not in table:
        accepted = accepted or ", ".join(map(str, table))
        raise AssetError(problem, where=os.fspath(where), value=value, accepted=accepted)
    return table[value]


class Damage(AssetError):
    """Bytes of a recording that are cut or no part of its format. Of all refusals, these alone are what
    ``--damaged keep`` reads past: a value that is whole, but unknown, is none."""


@dataclass(frozen=True)
class EventReading:
    """Declarations about an event file; None: as the file says.

    time_unit : "s", "ms", "us" or "ns".   size : (height, width), px.   origin : "top" or "bottom", the row with y 0.
    columns : order of the columns of a table, "_" for one to ignore, or "x=NAME" for the array that holds x.
    polarity : the numbers that mean OFF and ON.   stream : name or number of one of several streams, topics or arrays.
    damaged : "refuse", or "keep" what is whole.   sort : put events in order of time.
    """

    time_unit: str | None = None
    size: tuple[int, int] | None = None
    origin: str | None = None
    columns: tuple[str, ...] | None = None
    polarity: tuple[float, float] | None = None
    stream: str | None = None
    damaged: str = "refuse"
    sort: bool = False

    @property
    def keep(self) -> bool:
        """Return whether the whole parts of damaged files are kept."""
        return self.damaged == "keep"

    @property
    def named(self) -> dict[str, str]:
        """Return column -> name of its array, as declared."""
        return dict(entry.split("=", 1) for entry in self.columns or () if "=" in entry)

    @classmethod
    def of(
        cls,
        time_unit: str | None = None,
        size: str | Sequence[int] | None = None,
        origin: str | None = None,
        columns: str | Sequence[str] | None = None,
        polarity: str | Sequence[float] | None = None,
        stream: int | str | None = None,
        damaged: str = "refuse",
        sort: bool = False,
    ) -> EventReading:
        """Return the declarations of options: size as "WIDTHxHEIGHT" or (height, width), columns as "x,y,t,p", polarity
        as "OFF/ON" ("-1/1"), or sequences of such. Raises ConfigError, naming the option."""
        for option, value, known in (("origin", origin, (None, "top", "bottom")), ("damaged", damaged, _DAMAGED)):
            if value not in known:
                raise _refused(option, value, " or ".join(word for word in known if word))
        return cls(
            checked_unit(time_unit),
            parsed_size(size) if size is None or isinstance(size, str) else (int(size[0]), int(size[1])),
            origin,
            _columns(columns),
            _polarity(polarity),
            None if stream is None else str(stream),
            damaged,
            sort,
        )


_DAMAGED = ("refuse", "keep")
AS_FILE = EventReading()
"""Nothing is declared."""


def parsed_size(text: str | None) -> tuple[int, int] | None:
    """Return (height, width) of ``WIDTHxHEIGHT``. Raises ConfigError."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.lower())
    if not match or not all(0 < int(side) <= _MOST_SIDE for side in match.groups()):
        raise ConfigError("not a size", where="--size", value=text, accepted="WIDTHxHEIGHT, e.g. 640x480")
    return int(match[2]), int(match[1])


def _columns(columns: str | Sequence[str] | None) -> tuple[str, ...] | None:
    if columns is None:
        return None
    entries = tuple(part.strip() for part in (columns.split(",") if isinstance(columns, str) else columns))
    slots = [entry.split("=", 1)[0] for entry in entries if entry != "_"]
    whole = any("=" in entry for entry in entries) or len(slots) == 4
    if not whole or len(set(slots)) != len(slots) or not set(slots) <= set("xytp"):
        raise _refused("columns", columns, "x, y, t and p in the file's order, _ for others; or names, as t=stamp")
    return entries


def _polarity(polarity: str | Sequence[float] | None) -> tuple[float, float] | None:
    if polarity is None:
        return None
    codes = polarity.split("/") if isinstance(polarity, str) else [str(code) for code in polarity]
    off, on = map(float, codes) if len(codes) == 2 and all(map(is_number, codes)) else (0.0, 0.0)
    if off == on:
        raise _refused("polarity", polarity, "the numbers of OFF and ON: 0/1, -1/1, 1/0 …")
    return off, on


def _refused(option: str, value: object, accepted: str) -> ConfigError:
    return ConfigError(f"cannot read --{option}", where=f"--{option}", value=value, accepted=accepted)


def chosen(
    stream: str | None,
    names: Sequence[str],
    where: str,
    what: str,
    *,
    numbered: bool = True,
    labels: Sequence[str] = (),
) -> int:
    """Return which of ``names`` a user means by a name or, where they are ``numbered`` from 0, by a number; the only
    one where nothing is declared.   labels : shown behind the names. Raises AssetError, which lists them: several and
    none is declared, or none of these."""
    if stream in names:
        return names.index(stream)
    if numbered and stream is not None and is_number(stream) and stream.isdigit() and int(stream) < len(names):
        return int(stream)
    if stream is None and len(names) == 1:
        return 0
    shown = [str(k) for k in range(len(names))] if numbered else names
    behind = labels or (names if numbered else [""] * len(names))
    listed = (f"--stream {key} ({label})" if label else f"--stream {key}" for key, label in zip(shown, behind))
    problem = f"{len(names)} {what}, and none is chosen" if stream is None else f"no such one of the {what}"
    value: dict[str, object] = {} if stream is None else {"value": stream}
    raise AssetError(problem, where=where, accepted=("one of " if len(names) > 1 else "") + ", ".join(listed), **value)


_NAMED = {"black": (0, 0, 0), "grey": (128, 128, 128), "gray": (128, 128, 128), "white": (255, 255, 255)}


def background_of(text: str | None) -> tuple[int, int, int] | None:
    """Return (r, g, b), 0 to 255, of ``black``, ``grey``, ``white`` or ``#rrggbb``. Raises ConfigError."""
    if text is None or text in _NAMED:
        return None if text is None else _NAMED[text]
    if re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)
    raise ConfigError("unknown colour", where="--background", value=text, accepted="black, grey, white or #rrggbb")


RANGES = ("full", "limited")


@dataclass(frozen=True)
class Declared:
    """What a user declares of a clip of frames; None: what the file says.

    fps : Hz, of frames at equal intervals.   timestamps : file with one time per frame (:mod:`blinkgl.io.times`).
    time_unit : of these, "s", "ms", "us", "ns", or "frames" of ``fps``.   zero_time : count times from the first frame.
    white_level : code of white.   range : "full" or "limited" (16 to 235 of 8 bits).   background : colour below
    transparent pixels, "black", "grey", "white" or "#rrggbb".   stream : name or number of one of several arrays or
    streams of frames.   damaged : "refuse", or "keep" the frames that are whole.

    Raises ConfigError: values that are none of these, fps beside timestamps."""

    fps: float | None = None
    timestamps: str | os.PathLike | None = None
    time_unit: str | None = None
    zero_time: bool = False
    white_level: float | None = None
    range: str | None = None
    background: str | None = None
    stream: str | None = None
    damaged: str = "refuse"

    def __post_init__(self) -> None:
        if self.damaged not in ("refuse", "keep"):
            raise ConfigError("cannot read --damaged", where="--damaged", value=self.damaged, accepted="refuse or keep")
        if self.fps is not None and not 1e-6 <= self.fps <= 1e9:
            raise EventDataError("frame rate", where="--fps", value=self.fps, accepted="a positive number")
        if self.time_unit != "frames":
            checked_unit(self.time_unit)
            if self.fps is not None and self.timestamps is not None:
                raise ConfigError(
                    "a frame rate and a list of times contradict each other",
                    where="--fps, --timestamps",
                    value=f"{self.fps:g}, {self.timestamps}",
                    accepted="one of them, or --time-unit frames",
                )
        if self.range not in (None, *RANGES):
            raise ConfigError("unknown range", where="--range", value=self.range, accepted="full or limited")
        if self.white_level is not None and not (np.isfinite(self.white_level) and self.white_level > 0):
            raise ConfigError(
                "not a white level", where="--white-level", value=self.white_level, accepted="a positive number"
            )
        background_of(self.background)


NOTHING = Declared()


def refuse_without_frames(declared: Declared, gamma: object, delay: object) -> None:
    """Raise ConfigError where something is declared of frames, and there are none."""
    options = {
        "--fps": declared.fps,
        "--timestamps": declared.timestamps,
        "--frames-time-unit": declared.time_unit,
        "--white-level": declared.white_level,
        "--range": declared.range,
        "--background": declared.background,
        "--gamma": gamma,
        "--frame-delay-ms": delay,
    }
    if given := [name for name, value in options.items() if value is not None]:
        raise ConfigError("there are no frames", where=", ".join(given), accepted="--frames, or nothing of frames")
