"""The event container of the project, and the causes of events."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from blinkgl.errors import EventDataError


class Cause(IntEnum):
    """The origin of an event: what moved the pixel to its threshold.

    The cause is the largest part of the signal's change since the pixel's last event (or the end of the dead time after
    it), in the direction of the crossing; light where two are equal. An event that an emulator draws directly, V2E's
    shot noise, has its own cause.

    So every event has one cause, the parts add up to the threshold, and an event is noise where light alone moved the
    pixel less than noise did. The numbers are part of the file format."""

    SIGNAL = 0  # the light changed
    LEAK = 1  # V2E: leak; DVS-Voltmeter: k4 and k5
    SHOT = 2  # V2E: shot or photoreceptor noise; DVS-Voltmeter: diffusion
    HOT = 3  # V2E: leak of a hot pixel


TRUTH = np.dtype([("instance", "u2"), ("depth", "f4"), ("velocity", "f4", (2,)), ("light", "i4")])
"""The surface that made an event: its instance id, 0: nothing; depth along the optical axis, world units, inf: nothing;
image velocity, px/s, +x right, +y down. The light that made it by changing over time: its number among the names of
``lights.npz``, -1: none, or a file that does not say."""
TOLD = ("instance", "depth", "velocity")
"""Fields of :data:`TRUTH` of every scene."""
OPTIONAL = ("cause", "truth")
"""Columns that may be absent."""
_TYPES = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.uint8, "cause": np.uint8, "truth": TRUTH}


@dataclass(frozen=True, eq=False)
class Events:
    """Events of one chunk, columnar, sorted by time.

    x, y : (N,) uint16 pixel column and row, (0, 0) the top-left pixel.
    t    : (N,) int64 microseconds, non-decreasing inside a chunk and across the chunks of one emulator.
    p    : (N,) uint8, 1 brighter (ON), 0 darker (OFF).
    cause : (N,) uint8 of :class:`Cause`, or None where it was not requested (``events.causes``) or is unknown.
    truth : (N,) of :data:`TRUTH`, the surface that made each (:mod:`blinkgl.events.truth`), or None likewise
        (``labels.events``): ``truth["instance"]`` (N,), ``truth["depth"]`` (N,), ``truth["velocity"]`` (N, 2),
        ``truth["light"]`` (N,).

    Raises EventDataError: a column of another type or length.
    """

    x: np.ndarray
    y: np.ndarray
    t: np.ndarray
    p: np.ndarray
    cause: np.ndarray | None = None
    truth: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name, dtype in _TYPES.items():
            column = getattr(self, name)
            if name in OPTIONAL and column is None:
                continue
            if (
                not isinstance(column, np.ndarray)
                or column.dtype != dtype
                or column.ndim != 1
                or len(column) != len(self.t)
            ):
                got = f"{column.dtype} {column.shape}" if isinstance(column, np.ndarray) else column
                many = f" of {len(self.t)}" if isinstance(self.t, np.ndarray) and self.t.ndim == 1 else ""
                raise EventDataError(
                    "not a column of events",
                    where=f"Events.{name}",
                    value=got,
                    accepted=f"a one-dimensional {np.dtype(dtype)} array{many}",
                )

    def __len__(self) -> int:
        return len(self.t)

    @staticmethod
    def empty() -> Events:
        return Events(np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.int64), np.empty(0, np.uint8))

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the names of the columns that are present: "x", "y", "t", "p" and perhaps "cause" and "truth"."""
        return ("x", "y", "t", "p", *(name for name in OPTIONAL if getattr(self, name) is not None))

    def part(self, which: slice | np.ndarray) -> Events:
        """Return the events of a slice (views), an index array or a mask (copies); the order of time must stay."""
        return Events(**{k: getattr(self, k)[which] for k in self.columns})

    def pixel(self, width: int) -> np.ndarray:
        """Return the number of each event's pixel, row by row in a sensor of this width, (N,) int64."""
        return self.y.astype(np.int64) * width + self.x

    def copy(self) -> Events:
        """Return a copy with its own memory."""
        return Events(**{k: getattr(self, k).copy() for k in self.columns})

    @staticmethod
    def concatenate(chunks: list[Events] | tuple[Events, ...]) -> Events:
        """Join chunks in the given order (they must already be in time order); with causes and truth where all
        that are not empty have them."""
        full = [c for c in chunks if len(c)] or list(chunks[:1])
        if not full:
            return Events.empty()
        known = [k for k in full[0].columns if all(getattr(c, k) is not None for c in full)]
        return Events(**{k: np.concatenate([getattr(c, k) for c in full]) for k in known})

    def window(self, t0_us: int, t1_us: int) -> Events:
        """Return the events of the half-open window [t0_us, t1_us); views, no copy."""
        i, j = np.searchsorted(self.t, (t0_us, t1_us), side="left")
        return self.part(slice(i, j))

    def split(self, t_us: int) -> tuple[Events, Events]:
        """Return the events before t_us, and the rest; views, no copy."""
        cut = int(np.searchsorted(self.t, t_us, side="left"))
        return self.part(slice(cut)), self.part(slice(cut, None))


def named_causes(counts: np.ndarray) -> dict[str, int]:
    """Return the counts of :func:`count_causes` by name: {"signal": n, "leak": n, "shot": n, "hot": n}."""
    return {cause.name.lower(): int(counts[cause]) for cause in Cause}


def count_causes(events: Events) -> np.ndarray:
    """Return (4,) int64, events by :class:`Cause`; zeros without causes."""
    counts = np.zeros(len(Cause), np.int64)
    return counts if events.cause is None else counts + np.bincount(events.cause, minlength=len(Cause))[: len(Cause)]
