"""Paces by formula, for tests of frame times."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from blinkgl.timeline import bounded_times


class Formula:
    """The pace of a speed, px/s at a time in ns, where a step may have ``max_px``. What happens between two times is
    known from ``dense`` times between them; 0: nothing is."""

    def __init__(self, speed: Callable[[int], float], max_px: float, dense: int = 0):
        self.speed, self.max_px, self.dense = speed, max_px, dense

    def at(self, t_ns: int) -> float:
        return self.speed(t_ns) / self.max_px

    def hides(self, ta_ns: int, tb_ns: int, steps: float) -> bool:
        inside = np.linspace(ta_ns, tb_ns, self.dense + 2).astype(np.int64).tolist()
        return max(map(self.at, inside)) > max(self.at(ta_ns), self.at(tb_ns)) + steps

    def bend(self, ta_ns: int, tb_ns: int) -> float:
        return 0.0

    def misses(self, ta_ns: int, tb_ns: int) -> bool:
        return False


def displacement_times(
    max_px: float, low_ns: int, high_ns: int, t0_ns: int, t1_ns: int, speed: Callable[[int], float], dense: int = 0
) -> Iterator[int]:
    """Yield times between which what moves at ``speed`` moves ``max_px``."""
    return bounded_times(Formula(speed, max_px, dense), low_ns, high_ns, t0_ns, t1_ns)
