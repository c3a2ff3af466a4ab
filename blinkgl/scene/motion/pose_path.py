"""What every path of a body offers."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np


def no_jumps(t0_ns: int, t1_ns: int) -> list[int]:
    """Return the jumps of a motion without any: the times in (t0, t1), ns, after which it stands elsewhere."""
    return []


@runtime_checkable
class PosePath(Protocol):
    """A rigid motion over [t0_ns, t1_ns]; outside it the end poses are held (and the derivative is zero)."""

    t0_ns: int
    t1_ns: int

    @property
    def is_static(self) -> bool:
        """Return whether the pose is the same at all times (lets a renderer cache its picture)."""

    def pose(self, t_ns: int) -> np.ndarray:
        """Return T_world_body at t_ns, (4, 4) float64."""

    def derivative(self, t_ns: int) -> np.ndarray:
        """Return dT/dt in 1/s, analytic, (4, 4) float64; last row zero. With body rate w: dR/dt = R [w]x."""

    def poses(self, t_ns: np.ndarray) -> np.ndarray:
        """Return poses at (N,) int64 times, (N, 4, 4) float64; equals stacking :meth:`pose`."""

    def speed_bound(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        """Return upper bounds over [ta, tb] of (|velocity of the body's origin| in units/s, |angular rate| in
        rad/s)."""

    def unseen(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        """Return upper bounds over [ta, tb] of how far the velocity of the body's origin, units/s, and its angular
        velocity, rad/s, leave the straight line between their values at ta and tb. Both 0: what moves between these
        times is never faster than at one of them."""
