"""Periodic motions: every joint's angles, and the root's position, are sums of a few sines of one phase.

    angle(t) = a_0 + sum_k a_k cos(k phi) + b_k sin(k phi),     phi(t) = 2 pi (t / period + phase)

A loop has no seam, and its rate is exact. A figure's motion (:mod:`~blinkgl.scene.shapes.gait`) is computed at some
phases and converted to this form once, by the fast Fourier transform.
"""

from __future__ import annotations

import numpy as np

from blinkgl.machine.kernels import kernel
from blinkgl.scene.shapes.skeleton import Locals

HARMONICS = 12
"""Highest harmonic k."""


class Cycle:
    """A motion of n joints, of :class:`~blinkgl.scene.shapes.skeleton.Skeleton`.

    offsets : (n, 3) of each joint in its parent's frame.   angles : (N, n, 3) rad at N equal steps of one round, about
    x, then the turned y, then the twice turned z.   root : (N, 3) displacement of the first joint, units.
    period : s of one round.   phase : rounds at time 0.   speed : units/s of the body along its x axis that fit the
    motion, 0: it stays in place.   N has to be more than twice ``HARMONICS``."""

    is_static = False
    locomotion = "upright"

    def __init__(
        self,
        offsets: np.ndarray,
        angles: np.ndarray,
        root: np.ndarray,
        period: float,
        phase: float = 0.0,
        speed: float = 0.0,
    ):
        self.period_ns = self.span_ns = max(round(period * 1e9), 1)
        # A sixteenth of the fourth harmonic's period; those above it are small.
        self.timescale_ns = max(self.period_ns // 64, 1)
        self.phase, self.speed = phase, speed
        count = len(angles)
        values = np.concatenate([root[:, None], angles], axis=1)  # the root's position is row 0
        # Higher harmonics are dropped: they hold only the corners of the keyed angles, which no body makes.
        spectrum = np.fft.rfft(values, axis=0)[: HARMONICS + 1] / count
        # Each wave of a real signal occurs twice in its spectrum, except the constant.
        spectrum[1:] *= 2
        self._cosines = np.ascontiguousarray(spectrum.real)
        # The transform has exp(-i k phi), so the sine's amplitude is minus the imaginary part.
        self._sines = np.ascontiguousarray(-spectrum.imag)
        self._offsets = np.ascontiguousarray(offsets, np.float64)

    def locals(self, t_ns: int) -> Locals:
        out = Locals.rest(len(self._offsets))
        rounds = (int(t_ns) % self.period_ns) / self.period_ns + self.phase
        # 2 pi over the period in seconds.
        rate = 2e9 * np.pi / self.period_ns
        _evaluate(2 * np.pi * rounds, rate, self._cosines, self._sines, self._offsets, out[0], out[1], out[3], out[4])
        return out


@kernel
def _evaluate(phi, rate, cosines, sines, offsets, T, R, dT, dR):
    """Write the joints' positions and rotations at a phase, and their rates, where phi grows by ``rate`` per second."""
    rows = cosines.shape[1]
    value, change = cosines[0].copy(), np.zeros((rows, 3))
    for k in range(1, len(cosines)):
        c, s = np.cos(k * phi), np.sin(k * phi)
        for i in range(rows):
            for j in range(3):
                a, b = cosines[k, i, j], sines[k, i, j]
                value[i, j] += a * c + b * s
                change[i, j] += rate * k * (b * c - a * s)
    for i in range(rows - 1):
        for j in range(3):
            T[i, j], dT[i, j] = offsets[i, j], 0.0
    for j in range(3):
        T[0, j] += value[0, j]
        dT[0, j] = change[0, j]
    q, d, turn, turning, p, e = np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(4)
    # Row 0 is the root's position; rows 1 on are the joints' angles.
    for i in range(1, rows):
        q[:], d[:] = 0.0, 0.0
        q[3] = 1.0
        # Quaternions x y z w. Each further axis belongs to the rotated body, so its rotation is multiplied
        # from the right.
        for axis in range(3):
            half, half_rate = 0.5 * value[i, axis], 0.5 * change[i, axis]
            turn[:], turning[:] = 0.0, 0.0
            turn[axis], turn[3] = np.sin(half), np.cos(half)
            turning[axis], turning[3] = half_rate * turn[3], -half_rate * turn[axis]
            # The product rule on q turn: dq turn + q dturn, before q itself changes.
            _product(q, turning, e)
            _product(d, turn, p)
            for k in range(4):
                d[k] = e[k] + p[k]
            _product(q, turn, p)
            q[:] = p
        R[i - 1], dR[i - 1] = q, d


@kernel
def _product(a, b, out):
    """Write the product of quaternions x, y, z, w."""
    out[0] = a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1]
    out[1] = a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0]
    out[2] = a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3]
    out[3] = a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2]
