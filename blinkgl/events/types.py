"""The one event container of the project."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blinkgl.errors import EventDataError


@dataclass(frozen=True, eq=False)
class Events:
    """Events of one chunk, columnar, sorted by time.

    x, y : (N,) uint16 pixel column and row, (0, 0) the top-left pixel.
    t    : (N,) int64 microseconds, non-decreasing inside a chunk and across the chunks of one emulator.
    p    : (N,) uint8, 1 brighter (ON), 0 darker (OFF).

    Raises EventDataError: a column of another type or length.
    """

    x: np.ndarray
    y: np.ndarray
    t: np.ndarray
    p: np.ndarray

    def __post_init__(self) -> None:
        for name, dtype in (("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.uint8)):
            column = getattr(self, name)
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

    @staticmethod
    def concatenate(chunks: list[Events] | tuple[Events, ...]) -> Events:
        """Chunks joined in the given order (they must already be in time order)."""
        if not chunks:
            return Events.empty()
        return Events(*(np.concatenate([getattr(c, k) for c in chunks]) for k in "xytp"))

    def window(self, t0_us: int, t1_us: int) -> Events:
        """Events of the half-open window [t0_us, t1_us); views, no copy."""
        i, j = np.searchsorted(self.t, (t0_us, t1_us), side="left")
        return Events(self.x[i:j], self.y[i:j], self.t[i:j], self.p[i:j])

    def split(self, t_us: int) -> tuple[Events, Events]:
        """Those before t_us, and the rest; views, no copy."""
        cut = int(np.searchsorted(self.t, t_us, side="left"))
        return (
            Events(self.x[:cut], self.y[:cut], self.t[:cut], self.p[:cut]),
            Events(self.x[cut:], self.y[cut:], self.t[cut:], self.p[cut:]),
        )
