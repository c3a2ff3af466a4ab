"""Skeletons: a tree of joints, and their motion.

    skeleton = Skeleton(parents, motion)
    world, rate = skeleton.at(t_ns)                     # (n, 4, 4) each, the second per second

A :class:`Motion` gives translation, rotation and scale of every joint relative to its parent, and their rates: a clip
of a file (:mod:`~blinkgl.scene.shapes.clips`), or a formula.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from blinkgl.machine.kernels import kernel
from blinkgl.types.recent import Recent

_KEPT = 4
NEVER = 1 << 62
"""ns: the time scale of what does not move."""


class Locals(NamedTuple):
    """Transforms of n joints relative to their parents. translation, scale : (n, 3).   rotation : (n, 4) unit
    quaternions x, y, z, w. The others: their rates, per second."""

    translation: np.ndarray
    rotation: np.ndarray
    scale: np.ndarray
    d_translation: np.ndarray
    d_rotation: np.ndarray
    d_scale: np.ndarray

    @classmethod
    def rest(cls, count: int) -> Locals:
        """Return identity transforms."""
        rotation = np.zeros((count, 4))
        rotation[:, 3] = 1.0
        zeros = np.zeros((count, 3))
        return cls(zeros, rotation, np.ones((count, 3)), zeros.copy(), np.zeros((count, 4)), zeros.copy())

    def copy(self) -> Locals:
        return Locals(*(array.copy() for array in self))


class Motion(Protocol):
    """The motion of a skeleton's joints. jumps : the times in (t0, t1), ns, after which a transform jumps; a motion of
    somebody's own need not have it."""

    @property
    def period_ns(self) -> int | None:
        """Return its period; None: not periodic."""

    @property
    def span_ns(self) -> int:
        """Return the time from 0 after which nothing changes."""

    @property
    def timescale_ns(self) -> int:
        """Return the time in which no velocity changes much."""

    @property
    def is_static(self) -> bool:
        """Return whether nothing ever changes."""

    def locals(self, t_ns: int) -> Locals:
        """Return the transforms at a time. The arrays may be reused; do not write to them."""


class Still:
    """Joints that do not move."""

    period_ns = None
    span_ns = 0
    timescale_ns = NEVER
    is_static = True

    def __init__(self, locals_: Locals):
        self._locals = locals_

    def locals(self, t_ns: int) -> Locals:
        return self._locals


class Skeleton:
    """A tree of joints. parents : (n,) index of each joint's parent, -1: none; parents before their children.
    motion : of the n joints.   fixed : (n, 4, 4) constant transform before each joint's own, such as the position of a
    root;
    None: none. Raises ValueError for a parent that does not come before."""

    def __init__(self, parents: ArrayLike, motion: Motion, fixed: ArrayLike | None = None):
        self.parents = np.asarray(parents, np.int64).reshape(-1)
        count = len(self.parents)
        if not ((self.parents >= -1) & (self.parents < np.arange(count))).all():
            raise ValueError("a skeleton's parents come before their children")
        self.motion = motion
        self.fixed = np.tile(np.eye(4), (count, 1, 1)) if fixed is None else np.array(fixed, np.float64)
        # Positions, rates and the vertex stage use the same few times in a row.
        self._kept: Recent[int, tuple[np.ndarray, np.ndarray]] = Recent(_KEPT)

    @property
    def is_static(self) -> bool:
        return self.motion.is_static

    def at(self, t_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return ((n, 4, 4), (n, 4, 4)) float64: each joint's transform to the object's frame, and its rate, 1/s. The
        last few are kept; do not write to them."""
        return self._kept.of(t_ns, lambda: self._at(t_ns))

    def _at(self, t_ns: int) -> tuple[np.ndarray, np.ndarray]:
        world, rate = np.empty((2, len(self.parents), 4, 4))
        _world(self.parents, self.fixed, *self.motion.locals(t_ns), world, rate)
        return world, rate


@kernel(error_model="numpy")
def _world(parents, fixed, T, R, S, dT, dR, dS, world, rate):
    """Compute transforms of all joints, parents first, and their rates by the product rule."""
    # L and D: a joint's own transform and its rate; F and G: the same with the fixed transform before them.
    L, D, F, G = np.zeros((4, 4)), np.zeros((4, 4)), np.empty((4, 4)), np.empty((4, 4))
    L[3, 3] = 1.0
    for i in range(len(parents)):
        x, y, z, w = R[i]
        dx, dy, dz, dw = dR[i]
        _turn(x, y, z, w, L)
        # The matrix is quadratic in the quaternion: its rate is linear in the quaternion's.
        D[0, 0] = -4 * (y * dy + z * dz)
        D[1, 1] = -4 * (x * dx + z * dz)
        D[2, 2] = -4 * (x * dx + y * dy)
        # a and b are the rates of xy and zw, of whose sum and difference the two entries are made; likewise below.
        a, b = dx * y + x * dy, dz * w + z * dw
        D[0, 1], D[1, 0] = 2 * (a - b), 2 * (a + b)
        a, b = dx * z + x * dz, dy * w + y * dw
        D[0, 2], D[2, 0] = 2 * (a + b), 2 * (a - b)
        a, b = dy * z + y * dz, dx * w + x * dw
        D[1, 2], D[2, 1] = 2 * (a - b), 2 * (a + b)
        for r in range(3):
            for c in range(3):
                # The product rule on rotation times scale, before L itself is scaled.
                D[r, c] = D[r, c] * S[i, c] + L[r, c] * dS[i, c]
                L[r, c] *= S[i, c]
            L[r, 3], D[r, 3] = T[i, r], dT[i, r]
        # fixed comes before the joint's own transform and is constant: it multiplies transform and rate.
        _times(fixed[i], L, F)
        _times(fixed[i], D, G)
        parent = parents[i]
        if parent < 0:
            world[i], rate[i] = F, G
        else:
            _times(world[parent], F, world[i])
            # (W F)' = W' F + W F': the second term is added below.
            _times(rate[parent], F, rate[i])
            for r in range(4):
                for c in range(4):
                    for k in range(4):
                        rate[i, r, c] += world[parent, r, k] * G[k, c]


@kernel
def _turn(x, y, z, w, out):
    out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)


@kernel
def _times(a, b, out):
    for r in range(4):
        for c in range(4):
            total = 0.0
            for k in range(4):
                total += a[r, k] * b[k, c]
            out[r, c] = total
