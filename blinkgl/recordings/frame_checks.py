"""Weaknesses of given frames that affect their events, found as the frames go by."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

_FEW_CODES, _CLIPPED, _FLICKER, _REPEATED = 32, 0.1, 0.02, (0.1, 0.9)
"""From which on frames are warned of: different codes, part of the pixels at an end, how much the whole picture's
brightness jumps to and fro from one frame to the next (median), and which part of the frames equals the one before."""
_SPARSE_PX = 128
"""Side of the grid of pixels that is looked at."""


class FrameChecks:
    """Looks at every frame of a clip, of which nothing but copies is kept; ``lines`` yields the warnings."""

    def __init__(self) -> None:
        self._brightness: list[float] = []
        self._codes: np.ndarray | None = None
        """How often each code was seen; None: no integers."""
        self._repeated = 0.0
        self._top = 0.0
        self._last: np.ndarray | None = None

    def see(self, frame: np.ndarray) -> None:
        """Look at a frame as stored."""
        step = tuple(slice(None, None, max(1, side // _SPARSE_PX)) for side in frame.shape[:2])
        sparse = frame[step].copy()
        # As a part of white: files of 8 and of 16 bits may show one light.
        white = np.iinfo(sparse.dtype).max if sparse.dtype.kind == "u" else 1
        self._brightness.append(float(sparse.mean()) / white)
        self._top = max(self._top, float(sparse.max()))
        if sparse.dtype.kind == "u":
            before = np.zeros(0, np.int64) if self._codes is None else self._codes
            self._codes = np.bincount(sparse.ravel(), minlength=max(white + 1, len(before)))
            self._codes[: len(before)] += before
        self._repeated += self._last is not None and np.array_equal(sparse, self._last)
        self._last = sparse

    def lines(self, white: float | None) -> Iterator[str]:
        """Yield the warnings about the frames seen.   white : the level that was declared, read or guessed; None: the
        type's largest."""
        count = len(self._brightness)
        if self._codes is None and self._top > (white or 1.0):
            yield (f"floats up to {self._top:.4g}, where {white or 1:g} is white: --white-level 255, if they are codes")
        if self._codes is not None:
            if len(self._codes) > 256 and white is None and 0 < self._top < 2**14:
                bits = int(self._top).bit_length()
                where = f"16-bit codes up to {self._top:,.0f}, where 65,535 is white"
                yield f"{where}: --white-level {2**bits - 1} for {bits} bits"
            top = len(self._codes) - 1 if white is None else min(math.ceil(white), len(self._codes) - 1)
            clipped = (self._codes[0] + self._codes[top:].sum()) / self._codes.sum()
            if clipped > _CLIPPED:
                yield f"{100 * clipped:.0f} % of the codes are at an end: what moves there makes no events"
            if 1 < (different := int(np.count_nonzero(self._codes))) <= _FEW_CODES:
                yield f"frames of {different} different codes: each step from one to the next makes events at once"
        if count > 4 and _REPEATED[0] < self._repeated / (count - 1) < _REPEATED[1]:
            yield (
                f"{self._repeated:.0f} of {count} frames repeat the one before, as in a film at a higher rate: their "
                "changes make events at once"
            )
        # The second difference of a steady change is 0; of brightness that goes up and down by one factor it is twice
        # the logarithm of that factor.
        jumps = np.diff(np.log(np.maximum(self._brightness, 1e-6)), 2)
        to_and_fro = len(jumps) >= 3 and abs(np.sign(jumps).mean()) < 0.5  # a fade has one sign
        if to_and_fro and np.median(np.abs(jumps)) > _FLICKER:
            yield (
                "the whole picture flickers, by a factor of "
                f"{min(np.exp(np.median(np.abs(jumps)) / 2), 1e6):.3g} from frame to frame, and that makes events as "
                "motion does"
            )
