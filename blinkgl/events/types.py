"""The one event container of the project."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Events:
    """Events of one chunk, columnar, sorted by time.

    x, y : (N,) uint16 pixel column and row, (0, 0) the top-left pixel.
    t    : (N,) int64 microseconds, non-decreasing inside a chunk and across the chunks of one emulator.
    p    : (N,) uint8, 1 brighter (ON), 0 darker (OFF).
    """

    x: np.ndarray
    y: np.ndarray
    t: np.ndarray
    p: np.ndarray

    def __post_init__(self) -> None:
        for name, dtype in (("x", np.uint16), ("y", np.uint16), ("t", np.int64), ("p", np.uint8)):
            column = getattr(self, name)
            if column.dtype != dtype or column.ndim != 1 or len(column) != len(self.t):
                raise TypeError(f"Events.{name}: expected 1-D {np.dtype(dtype)} of length {len(self.t)}, "
                                f"got {column.dtype} {column.shape}")

    def __len__(self) -> int:
        return len(self.t)

    @staticmethod
    def empty() -> "Events":
        return Events(np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.int64), np.empty(0, np.uint8))

    @staticmethod
    def concatenate(chunks: "list[Events] | tuple[Events, ...]") -> "Events":
        """Chunks joined in the given order (they must already be in time order)."""
        if not chunks:
            return Events.empty()
        return Events(*(np.concatenate([getattr(c, k) for c in chunks]) for k in "xytp"))

    def window(self, t0_us: int, t1_us: int) -> "Events":
        """Events of the half-open window [t0_us, t1_us); views, no copy."""
        i, j = np.searchsorted(self.t, (t0_us, t1_us), side="left")
        return Events(self.x[i:j], self.y[i:j], self.t[i:j], self.p[i:j])
