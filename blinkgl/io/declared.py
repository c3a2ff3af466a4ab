"""What a user declares of frames that their file does not say."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from blinkgl.errors import ConfigError, EventDataError
from blinkgl.io.alpha import background_of
from blinkgl.io.clock import checked_unit

RANGES = ("full", "limited")


@dataclass(frozen=True)
class Declared:
    """What a user declares of a clip of frames; None: what the file says.

    fps : Hz, of frames at equal intervals.   timestamps : file with one time per frame (:mod:`blinkgl.io.stamps`).
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
