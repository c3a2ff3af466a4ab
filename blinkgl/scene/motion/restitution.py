"""The damping of MuJoCo's soft contacts that gives back a share of a body's speed."""

from __future__ import annotations

import math
from functools import lru_cache

from numba import njit


@lru_cache(maxsize=4096)
def damping_ratio(restitution: float, steps: float) -> float:
    """Of the contact of so many steps that gives back this share of the speed (0 to 1), in the mean over the phases in
    which a step meets the surface. The strongest gives back 0.02: that is what 0 becomes."""
    # Bisection: a larger damping ratio gives back less.
    low, high = 0.0, 3.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _given_back(middle, steps) > restitution else (low, middle)
    return low


@njit(cache=True)
def _given_back(ratio: float, steps: float) -> float:
    """Return the mean share of its speed with which a body leaves the contact, by the engine's recurrence."""
    # w: angle of the spring per step. The contact only pushes, hence min(..., 0).
    w, total, phases = math.pi / steps, 0.0, 16
    for phase in range(phases):
        # The phase is where within a step the surface is met.
        depth, v = (phase + 0.5) / phases, 1.0
        while depth > 0.0:
            v += min(-(w * w * depth + 2.0 * ratio * w * v), 0.0)
            depth += v
        total -= v / phases
    return total
