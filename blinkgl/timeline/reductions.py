"""What a timeline needs of a small picture: a percentile and the largest of what moves in it, two numbers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

if TYPE_CHECKING:
    from blinkgl.events.response import Response

SLOWEST = np.float32(2.0**-40)
"""What moves (px/s) or changes (per second) by less than these 1e-12 stands still."""


class Drawn(Protocol):
    """What has been drawn, wherever it is."""

    def read(self) -> np.ndarray: ...


class Ranked(NamedTuple):
    """Of the values that move. count : how many.   percentile, largest : 0.0 where there are none."""

    count: int
    percentile: float
    largest: float


STILL = Ranked(0, 0.0, 0.0)


def speeds(drawn: Drawn, percent: float) -> Ranked:
    """Of the lengths of (h, w, 2) float32 vectors."""
    return ranked(np.linalg.norm(drawn.read(), axis=-1), percent)


def changes(drawn: Drawn, response: Response, percent: float) -> Ranked:
    """Of |d(signal)/dt|, per second, of (h, w, 2) float32 luminances and their rates."""
    picture = drawn.read()
    return ranked(np.abs(response.change(picture[..., 0], picture[..., 1])), percent)


def ranked(values: np.ndarray, percent: float) -> Ranked:
    """Of float32 values of any shape >= 0: those that neither stand still nor are beyond all bounds (a surface in the
    camera plane); a still background has no say in a percentile."""
    values = values.ravel()
    values = values[(values >= SLOWEST) & np.isfinite(values)]
    if not len(values):
        # The k-th smallest and the one above it, without sorting all.
        return STILL
    k, share = place(len(values), percent)
    above = min(k + 1, len(values) - 1)
    values = np.partition(values, (k, above, len(values) - 1))
    return Ranked(len(values), between(values[k], values[above], share), float(values[-1]))


def place(count: int, percent: float) -> tuple[int, float]:
    """Which of ``count`` values in order, and how far on to the next one [0, 1), in double precision."""
    at = (count - 1) * (percent / 100)
    # percent = 100 would give the place behind the last by rounding.
    k = min(math.floor(at), count - 1)
    return k, at - k


def between(below: np.float32, above: np.float32, share: float) -> float:
    # NumPy interpolates from the nearer neighbour, which rounds otherwise than from below.
    """From one value towards the next in single precision, as NumPy's percentile rounds (from the nearer of them)."""
    apart = above - below
    if share < 0.5:
        return float(below + apart * np.float32(share))
    return float(above - apart * np.float32(1.0 - share))
