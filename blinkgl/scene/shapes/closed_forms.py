"""Deformers by formula: waves, turns, scales, each with an exact rate and an exact difference between two times.

    wave, flag    q = p + d e(p) sum_i A_i sin(k_i . p + phi_i(t))       e(p): 1, or 0 at the held end growing to 1
    twist, bend   q = c + R_b(a(t) u(p)) (p - c)                         u(p): 0 where it is held, 1 at one length's
                                                                         distance
    breathe       q = c + (1 + a sin phi(t)) * (p - c)

with phi(t) = 2 pi t / period + phase. Differences between times use
``sin x' - sin x = 2 cos((x + x') / 2) sin((x' - x) / 2)``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from blinkgl.config.deform import BendConfig, BreatheConfig, FlagConfig, TwistConfig, WaveConfig
from blinkgl.scene.types import Deformer, Mesh

_AXES = {"x": np.array([1.0, 0, 0]), "y": np.array([0, 1.0, 0]), "z": np.array([0, 0, 1.0])}


@dataclass(frozen=True)
class Beat:
    """phi(t) = 2 pi t / period + phase. period : s.   phase : rad."""

    period: float
    phase: float = 0.0

    @property
    def period_ns(self) -> int:
        return max(round(self.period * 1e9), 1)

    @property
    def timescale_ns(self) -> int:
        """Return a sixteenth of the period: from one to the next a sine's slope is within 2 % of its larger one."""
        return max(self.period_ns // 16, 1)

    @property
    def rate(self) -> float:
        """Return d(phi)/dt, rad/s."""
        return 2 * math.pi * 1e9 / self.period_ns

    def at(self, t_ns: int) -> float:
        """Return phi(t) minus whole turns."""
        return 2 * math.pi * (int(t_ns) % self.period_ns) / self.period_ns + self.phase

    def half_change(self, t_ns: int, there_ns: int) -> float:
        """Return (phi(t') - phi(t)) / 2 minus whole turns."""
        # Half of the phase repeats after two periods; fmod keeps the sign of the difference in time.
        return math.pi * math.fmod(int(there_ns) - int(t_ns), 2 * self.period_ns) / self.period_ns

    def sine_change(self, t_ns: int, there_ns: int) -> float:
        """Return sin phi(t') - sin phi(t)."""
        half = self.half_change(t_ns, there_ns)
        return 2 * math.cos(self.at(t_ns) + half) * math.sin(half)


def _dot(points: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.asarray(points, np.float64) @ vector


class Waves(Deformer):
    """Two plane waves along one direction. direction : (3,) displacement for an amplitude of 1.
    envelope : ((3,), float): e(p) = e . p + e0.   numbers : ((3,) rad per unit, phase rad) of both waves.
    amplitudes : units."""

    glsl = "waves"
    rows = 5  # type: ignore[assignment]

    def __init__(
        self,
        direction: np.ndarray,
        envelope: tuple[np.ndarray, float],
        waves: tuple[tuple[np.ndarray, float], tuple[np.ndarray, float]],
        amplitudes: tuple[float, float],
        beats: tuple[Beat, Beat],
    ):
        self.direction, self.envelope, self.waves, self.amplitudes, self.beats = (
            direction,
            envelope,
            waves,
            amplitudes,
            beats,
        )
        self.period_ns = self.span_ns = max(beat.period_ns for beat in beats)
        self.timescale_ns = min(beat.timescale_ns for beat in beats)

    @property
    def is_static(self) -> bool:
        return not any(self.amplitudes)

    def transformed(self, matrix: np.ndarray) -> Waves:
        linear, shift = matrix[:3, :3], matrix[:3, 3]
        # Phases and envelope are linear forms of the points, so they are transformed by the inverse map.
        inverse = np.linalg.inv(linear)

        def form(vector: np.ndarray, constant: float) -> tuple[np.ndarray, float]:
            """Return v . p + c in the points' new coordinates."""
            return vector @ inverse, constant - float(vector @ inverse @ shift)

        first, second = (form(*wave) for wave in self.waves)
        out = type(self)(linear @ self.direction, form(*self.envelope), (first, second), self.amplitudes, self.beats)
        out.locomotion, out.speed = self.locomotion, self.speed * float(np.linalg.norm(linear[:, 0]))
        return out

    def _terms(self, mesh: Mesh, t_ns: int):
        """Return (amplitude, wave vector, angles (V,), rate) of both waves."""
        # The waves travel along k: phi(t) is subtracted, so the angle's rate is negative.
        for amplitude, (k, phase), beat in zip(self.amplitudes, self.waves, self.beats):
            yield amplitude, k, _dot(mesh.vertices, k) + phase - beat.at(t_ns), -beat.rate

    def _envelope(self, mesh: Mesh) -> np.ndarray:
        return _dot(mesh.vertices, self.envelope[0]) + self.envelope[1]

    def positions(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        height = sum(A * np.sin(x) for A, _, x, _ in self._terms(mesh, t_ns))
        return mesh.vertices + np.outer(self._envelope(mesh) * height, self.direction)

    def velocity(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        rate = sum(A * rate * np.cos(x) for A, _, x, rate in self._terms(mesh, t_ns))
        return np.outer(self._envelope(mesh) * rate, self.direction)

    def normals(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        e, terms, n = self._envelope(mesh), list(self._terms(mesh, t_ns)), np.asarray(mesh.normals, np.float64)
        height = sum(A * np.sin(x) for A, _, x, _ in terms)
        # The map is p + h(p) d: its Jacobian is I + d grad h^T, whose cofactor matrix transforms
        # the normals (Sherman-Morrison).
        slope = np.outer(height, self.envelope[0]) + sum(np.outer(e * A * np.cos(x), k) for A, k, x, _ in terms)
        return n * (1 + slope @ self.direction)[:, None] - slope * (n @ self.direction)[:, None]

    def _rows(self, last: tuple[float, float, float, float], t_ns: int | None = None) -> np.ndarray:
        # The shader's five rows: direction; envelope; k and phase of either wave; amplitudes, or their
        # rates or changes.
        out = np.zeros((5, 4))
        if t_ns is not None:
            out[0, :3], out[1] = self.direction, [*self.envelope[0], self.envelope[1]]
            for row, (k, phase), beat in zip(out[2:4], self.waves, self.beats):
                row[:] = [*k, math.remainder(phase - beat.at(t_ns), 2 * math.pi)]
        out[4] = last
        return out

    def numbers(self, t_ns: int) -> np.ndarray:
        return self._rows((*self.amplitudes, 0.0, 0.0), t_ns)

    def rates(self, t_ns: int) -> np.ndarray:
        first, second = (-A * beat.rate for A, beat in zip(self.amplitudes, self.beats))
        return self._rows((first, second, 0.0, 0.0))

    def changes(self, t_ns: int, there_ns: int) -> np.ndarray:
        # A sin(x + 2 h) - A sin x = 2 A sin h cos(x + h): the rows hold the half changes h and the factors 2 A sin h.
        a, b = (-beat.half_change(t_ns, there_ns) for beat in self.beats)
        first, second = (2 * A * math.sin(half) for A, half in zip(self.amplitudes, (a, b)))
        return self._rows((a, b, first, second))


class Wave(Waves):
    """``deform: {kind: wave}``."""

    Config = WaveConfig

    @classmethod
    def of(cls, config: Any, low: np.ndarray, high: np.ndarray) -> Wave:
        along, middle = _AXES[config.along], (low + high) / 2
        length = _length(low, high, along)
        k = 2 * math.pi / (config.wavelength * length) * along
        # The phase is negative because Waves subtracts phi(t).
        beat, none = Beat(config.period, -math.radians(config.phase)), (np.zeros(3), 0.0)
        return cls(
            _AXES[config.towards],
            (np.zeros(3), 1.0),
            # The wave's own phase is 0 in the middle of the mesh.
            ((k, -float(k @ middle)), none),
            (config.amplitude * length, 0.0),
            (beat, beat),
        )


class Flag(Waves):
    """``deform: {kind: flag}``."""

    Config = FlagConfig

    @classmethod
    def of(cls, config: Any, low: np.ndarray, high: np.ndarray) -> Flag:
        along, towards = _AXES[config.along], _AXES[config.towards]
        across = np.abs(np.cross(along, towards))
        length = _length(low, high, along)
        pole = low
        if config.held == "high":
            # The envelope then grows from the high end downwards. The right-hand side still has the old direction.
            along, pole = -along, np.where(along > 0, high, low)
        # The second wave is oblique and twice as fast; otherwise the cloth would look like corrugated iron.
        k = 2 * math.pi / (config.wavelength * length)
        first, second = k * along, k * (1.6 * along + 0.9 * across)
        beat = Beat(config.period, -math.radians(config.phase))
        amplitude = config.amplitude * length
        return cls(
            towards,
            # 0 at the pole and 1 at the free end.
            (along / length, -float(along @ pole) / length),
            ((first, -float(first @ pole)), (second, -float(second @ pole))),
            (amplitude, 0.3 * amplitude),
            (beat, Beat(config.period / 2, 2 * beat.phase)),
        )


class Turn(Deformer):
    """A rotation about an axis by an angle that grows along the mesh and oscillates in time.
    axis : (3,) unit.   pivot : (3,).   share : ((3,), float): u(p) = s . p + s0.   angle : rad where u is 1."""

    glsl = "turn"
    rows = 4  # type: ignore[assignment]

    def __init__(self, axis: np.ndarray, pivot: np.ndarray, share: tuple[np.ndarray, float], angle: float, beat: Beat):
        self.axis, self.pivot, self.share, self.angle, self.beat = axis, pivot, share, angle, beat
        self.period_ns = self.span_ns = beat.period_ns
        self.timescale_ns = beat.timescale_ns

    @property
    def is_static(self) -> bool:
        return self.angle == 0

    def transformed(self, matrix: np.ndarray) -> Turn:
        scale, turn = _similarity(self, matrix)
        # For p' = k R p + t the share s . p + s0 has the vector R s / k and the constant s0 - (R s / k) . t.
        vector = turn @ self.share[0] / scale
        share = vector, self.share[1] - float(vector @ matrix[:3, 3])
        return type(self)(turn @ self.axis, matrix[:3, :3] @ self.pivot + matrix[:3, 3], share, self.angle, self.beat)

    def _share(self, mesh: Mesh) -> np.ndarray:
        return _dot(mesh.vertices, self.share[0]) + self.share[1]

    def _turned(self, vectors: np.ndarray, angles: np.ndarray) -> np.ndarray:
        # Rodrigues' formula, with an angle of its own for each vector.
        c, s, b = np.cos(angles)[:, None], np.sin(angles)[:, None], self.axis
        return vectors * c + np.cross(b, vectors) * s + np.outer(vectors @ b, b) * (1 - c)

    def _angle(self, t_ns: int) -> float:
        return self.angle * math.sin(self.beat.at(t_ns))

    def _rate(self, t_ns: int) -> float:
        return self.angle * self.beat.rate * math.cos(self.beat.at(t_ns))

    def positions(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        return self.pivot + self._turned(mesh.vertices - self.pivot, self._angle(t_ns) * self._share(mesh))

    def velocity(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        arm = self.positions(mesh, t_ns) - self.pivot
        return (self._rate(t_ns) * self._share(mesh))[:, None] * np.cross(self.axis, arm)

    def normals(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        angles = self._angle(t_ns) * self._share(mesh)
        arm = self._turned(mesh.vertices - self.pivot, angles)
        n = self._turned(np.asarray(mesh.normals, np.float64), angles)
        # dq/dp is the rotation plus, where the share grows, a shear along axis x arm; cofactors of a
        # rank-one update again.
        shear = np.cross(self.axis, arm)
        along = self._angle(t_ns) * self._turned(np.broadcast_to(self.share[0], arm.shape), angles)
        return n * (1 + (shear * along).sum(axis=1))[:, None] - along * (shear * n).sum(axis=1)[:, None]

    def _last_row(self, angle: float) -> np.ndarray:
        out = np.zeros((4, 4))
        out[3, 0] = angle
        return out

    def numbers(self, t_ns: int) -> np.ndarray:
        # The shader's four rows: axis, pivot, share, and the angle, its rate or its change.
        out = self._last_row(self._angle(t_ns))
        out[0, :3], out[1, :3], out[2] = self.axis, self.pivot, [*self.share[0], self.share[1]]
        return out

    def rates(self, t_ns: int) -> np.ndarray:
        return self._last_row(self._rate(t_ns))

    def changes(self, t_ns: int, there_ns: int) -> np.ndarray:
        return self._last_row(self.angle * self.beat.sine_change(t_ns, there_ns))


class Twist(Turn):
    """``deform: {kind: twist}``."""

    Config = TwistConfig

    @classmethod
    def of(cls, config: Any, low: np.ndarray, high: np.ndarray) -> Twist:
        along = _AXES[config.along]
        length, held = _length(low, high, along), low + config.held * (high - low)
        share = along / length, -float(along @ held) / length
        beat = Beat(config.period, math.radians(config.phase))
        return cls(along, (low + high) / 2, share, math.radians(config.angle), beat)


class Bend(Turn):
    """``deform: {kind: bend}``."""

    Config = BendConfig

    @classmethod
    def of(cls, config: Any, low: np.ndarray, high: np.ndarray) -> Bend:
        along, towards, middle = _AXES[config.along], _AXES[config.towards], (low + high) / 2
        length = _length(low, high, along)
        # at: the held plane's coordinate along the axis; reach: from there to the farther end, where u is 1 or -1.
        at = float(along @ low) + config.held * length
        reach = length * max(config.held, 1 - config.held)
        pivot = middle + along * (at - float(along @ middle))
        share = along / reach, -at / reach
        return cls(
            np.cross(along, towards),
            pivot,
            share,
            math.radians(config.angle),
            Beat(config.period, math.radians(config.phase)),
        )


class Breathe(Deformer):
    """``deform: {kind: breathe}``. centre : (3,).   amount : (3,) fractions of the size along each axis."""

    glsl = "scale"
    rows = 2  # type: ignore[assignment]
    Config = BreatheConfig

    def __init__(self, centre: np.ndarray, amount: np.ndarray, beat: Beat):
        self.centre, self.amount, self.beat = centre, amount, beat
        self.period_ns = self.span_ns = beat.period_ns
        self.timescale_ns = beat.timescale_ns

    @classmethod
    def of(cls, config: Any, low: np.ndarray, high: np.ndarray) -> Breathe:
        return cls((low + high) / 2, np.array(config.amount), Beat(config.period, math.radians(config.phase)))

    @property
    def is_static(self) -> bool:
        return not self.amount.any()

    def transformed(self, matrix: np.ndarray) -> Breathe:
        _, turn = _similarity(self, matrix)
        # The amounts belong to the coordinate axes, so the mesh may be scaled evenly and shifted only.
        if not np.allclose(turn, np.eye(3), atol=1e-12):
            raise TypeError("Breathe cannot be turned")
        return type(self)(matrix[:3, :3] @ self.centre + matrix[:3, 3], self.amount, self.beat)

    def _factor(self, t_ns: int) -> np.ndarray:
        return 1 + self.amount * math.sin(self.beat.at(t_ns))

    def _rate(self, t_ns: int) -> np.ndarray:
        return self.amount * (self.beat.rate * math.cos(self.beat.at(t_ns)))

    def positions(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        return self.centre + self._factor(t_ns) * (mesh.vertices - self.centre)

    def velocity(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        return self._rate(t_ns) * (mesh.vertices - self.centre)

    def normals(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        # The cofactors of a scale are the inverse, except for a common factor.
        return np.asarray(mesh.normals, np.float64) / self._factor(t_ns)

    def _rows(self, centre: np.ndarray, values: np.ndarray) -> np.ndarray:
        # The shader's two rows: centre, and one value for each axis.
        out = np.zeros((2, 4))
        out[0, :3], out[1, :3] = centre, values
        return out

    def numbers(self, t_ns: int) -> np.ndarray:
        return self._rows(self.centre, self._factor(t_ns))

    def rates(self, t_ns: int) -> np.ndarray:
        return self._rows(np.zeros(3), self._rate(t_ns))

    def changes(self, t_ns: int, there_ns: int) -> np.ndarray:
        return self._rows(np.zeros(3), self.amount * self.beat.sine_change(t_ns, there_ns))


def _similarity(deformer: Deformer, matrix: np.ndarray) -> tuple[float, np.ndarray]:
    """Return (scale, (3, 3) rotation) of an affine map that consists only of these and a shift. Raises TypeError."""
    linear = matrix[:3, :3]
    # The cube root keeps the sign: a reflection has a negative scale and is refused.
    scale = float(np.cbrt(np.linalg.det(linear)))
    if scale <= 0 or not np.allclose(linear @ linear.T, scale**2 * np.eye(3), rtol=0, atol=1e-9 * scale**2):
        raise TypeError(f"{type(deformer).__name__} can be turned and scaled evenly, and nothing else")
    return scale, linear / scale


def _length(low: np.ndarray, high: np.ndarray, along: np.ndarray) -> float:
    """Return the length of a box along an axis; if it is flat there, its largest side."""
    sides = high - low
    # A sheet has no length across, but wavelengths and amplitudes need some length.
    length = float(along @ sides)
    return length if length > 1e-6 * sides.max() else float(sides.max())
