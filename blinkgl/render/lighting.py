"""The light of a scene for the programs: their variants, and the numbers of each object.

A scene with only the plain white sun and sky, with or without shadows, needs none of this: its programs use
shaders/include/light.glsl without LIGHTS, and :meth:`Painter.place` sets their three uniforms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from blinkgl.gl.shader import Uniforms
from blinkgl.render.colour import LUMA
from blinkgl.scene.lights import is_coloured, lamps_of, quadric_of, quartic_of
from blinkgl.scene.types import Light
from blinkgl.types.recent import Kept

if TYPE_CHECKING:
    from blinkgl.render.draw_items import DrawItem, Kind
    from blinkgl.render.moment import Moment

EXAMPLES: tuple[dict[str, Any], ...] = (
    {"LIGHTS": 1, "AMBIENT": 3},
    {"LIGHTS": 1, "SUNS": 1, "AMBIENT": 3, "FACETED": 1},
    {"LIGHTS": 1, "SUNS": 2, "LAMPS": 2, "AMBIENT": 2},
    {"SHADOWS": 1, "SHADOW_SUNS": 1},
    {"LIGHTS": 1, "SUNS": 1, "AMBIENT": 1, "SHADOWS": 1, "SHADOW_SUNS": 1},
    {
        "LIGHTS": 1, "SUNS": 2, "LAMPS": 3, "SPOTS": 2, "AMBIENT": 1,
        "SHADOWS": 2, "SHADOW_SUNS": 1, "SHADOW_SPOTS": 1, "SOFT": 1,
    },
)  # fmt: skip
"""Variants in which the program of a lit pass must compile, besides the plain light's; each also with RGB."""
# By uniform, whether it has a value per channel: RGB's three, or one that represents them; for arrays, how many.
_FIXED = {"sun_strength": True, "lamp_strength": True, "lamp_fading": False, "spot_cone": False}
_PLACED = {
    **dict.fromkeys(("sun_towards", "lamp_place", "spot_axis"), 0),
    **dict.fromkeys(("around_even", "around_squares", "around_mixed"), 1),
    "around_fourth": 5,
}
_NAMES = frozenset((*_FIXED, *_PLACED, *(f"{name}_rate" for name in _PLACED)))


class Lighting:
    """The light of one scene. lamps : in the order of the shaders' arrays.   coloured : whether any is not white.
    plain : whether it is only a white sun and sky, apart from shadows."""

    def __init__(self, light: Light):
        self.plain, self.coloured, self.lamps = replace(light, shadows="off").plain, is_coloured(light), lamps_of(light)
        self._suns = sum(lamp.kind == "sun" for lamp in self.lamps)
        self._spots = sum(lamp.kind == "spot" for lamp in self.lamps)
        self._quadric, self._quartic = quadric_of(light), quartic_of(light)
        if self._quartic is not None:
            # n is a unit vector, so a quadratic form in it is also quartic, and the shader has one form.
            second, one = self._quadric[:, :3, :3].reshape(3, 9, 1), np.eye(3).reshape(1, 9)
            self._quartic = self._quartic + 0.5 * (second @ one + (second @ one).swapaxes(1, 2))
        near = self.lamps[self._suns :]
        strength = np.array([lamp.strength for lamp in self.lamps], np.float64).reshape(-1, 3)
        self._fixed = {
            "sun_strength": strength[: self._suns].T,  # channels first
            "lamp_strength": strength[self._suns :].T,
            "lamp_fading": np.array([lamp.reach**-4.0 for lamp in near]),  # 0 for an infinite reach
            "spot_cone": np.array([lamp.cone for lamp in near if lamp.kind == "spot"]),
        }
        self._weights: Kept[tuple[float, ...], np.ndarray] = Kept()
        self._bytes: dict[tuple, bytes] = {}  # constant values, by uniform and by the channel that one value represents
        self._last: tuple[Moment | None, bool, dict[str, np.ndarray]] = None, False, {}
        none = np.zeros((0, 3), np.float32)
        self._directed: tuple[Moment | None, tuple[np.ndarray, np.ndarray]] = None, (none, none)
        self._sun = np.asarray(light.sun_direction, np.float64)
        self._around = light.over_time
        self._varying = {
            name: lamps
            for name, lamps in (("sun_strength", self.lamps[: self._suns]), ("lamp_strength", near))
            if any(lamp.over_time is not None for lamp in lamps)
        }

    def defines(self, kind: Kind, one_channel: bool, maps: Sequence[object]) -> dict[str, Any]:
        """Return the defines of a lit pass's variant. RGB: light of three channels, where one is not enough: for
        colour pictures, and for the luminance of surfaces with several colours. maps : shadow maps of the pass."""
        rgb = {"RGB": 1} if kind.rgb and one_channel else {}
        if not kind.lit:
            return rgb
        shadows, lamps = self._shadows(maps), len(self.lamps) > self._suns
        if self.plain and not kind.whole:
            return shadows
        counts = {"SUNS": self._suns, "LAMPS": len(self.lamps) - self._suns, "SPOTS": self._spots}
        # Degree of the ambient light in the normal: 3 stands for a quartic form, 2 for a quadratic one, 1 for
        # a linear one.
        ambient = 3 if self._quartic is not None else 2 if self._quadric[:, :3, :3].any() else 1
        return (
            {"LIGHTS": 1}
            | {name: count for name, count in counts.items() if count}
            | ({"AMBIENT": ambient} if self._quadric.any() else {})
            | shadows
            | ({"VARYING": 1} if self._around is not None and "GLOSSY" in kind.more else {})
            | ({"FACETED": 1} if kind.faceted and not (shadows or lamps) else {})
            | (rgb or ({"RGB": 1} if not one_channel and (self.coloured or "GLOSSY" in kind.more) else {}))
        )

    def _shadows(self, maps: Sequence[Any]) -> dict[str, object]:
        suns = sum(one.lamp.kind == "sun" for one in maps)
        counts = {"SHADOWS": len(maps), "SHADOW_SUNS": suns, "SHADOW_SPOTS": len(maps) - suns}
        return {name: n for name, n in counts.items() if n} | ({"SOFT": 1} if any(one.soft for one in maps) else {})

    def place(self, uniforms: Uniforms, item: DrawItem, moment: Moment) -> None:
        """Set the uniforms of lights.glsl that the program has."""
        if _NAMES.isdisjoint(uniforms):
            return
        index, channel = item.object_index, item.material.base_color
        for name, per_channel in _FIXED.items():
            if (uniform := uniforms.get(name)) is not None:
                # A program of one channel gets one value, weighted by the colour of the surface.
                one = per_channel and uniform.dimension == 1
                key = (name, channel) if one else (name,)
                if key not in self._bytes or name in self._varying:
                    values = self._fixed[name]
                    if name in self._varying:
                        values = values * [moment.factor(lamp.over_time) for lamp in self._varying[name]]
                    values = self.channel(channel) @ values if one else values.T if per_channel else values
                    self._bytes[key] = np.ascontiguousarray(values, np.float32).tobytes()
                uniform.write(self._bytes[key])
        rates = any(f"{name}_rate" in uniforms for name in _PLACED)
        placed = self._placed(moment, rates)
        for name, per_channel in _PLACED.items():
            for one in (name, f"{name}_rate") if rates else (name,):
                if (uniform := uniforms.get(one)) is not None:
                    values = placed[one][index]
                    # The table's number is the length for one channel; arrays for three channels are three
                    # times as long.
                    if per_channel and uniform.array_length == per_channel:
                        values = (self.channel(channel) @ values).astype(np.float32)
                    uniform.write(values.tobytes())

    def directions(self, moment: Moment) -> tuple[np.ndarray, np.ndarray]:
        """Return the directions of the sun and of world z in the objects' axes, (n, 3) float32 each; those of the last
        moment are kept."""
        if self._directed[0] is not moment:
            R = moment.T_world_obj[:, :3, :3]
            # v @ R is R^T v, and R[2] is R^T z.
            sun = np.ascontiguousarray(self._sun @ R, np.float32)
            self._directed = moment, (sun, np.ascontiguousarray(R[:, 2], np.float32))
        return self._directed[1]

    def channel(self, base: tuple[float, ...]) -> np.ndarray:
        """Return (3,) the shares of r, g, b in the luminance of this base colour, which one channel represents."""
        return self._weights.of(base, lambda: _shares(LUMA * np.asarray(base, np.float64)))

    def _placed(self, moment: Moment, rates: bool) -> dict[str, np.ndarray]:
        """Return, by uniform, (objects, ...) float32 in the objects' axes; those of the last moment are kept."""
        if self._last[0] is moment and self._last[1] >= rates:
            return self._last[2]
        R, t = moment.T_world_obj[:, :3, :3], moment.T_world_obj[:, :3, 3]
        turn = np.zeros((len(R), 4, 4))
        turn[:, :3, :3], turn[:, 3, 3] = R, 1.0
        poses = np.array([lamp.path.pose(moment.t_ns) for lamp in self.lamps]).reshape(-1, 4, 4)
        # A lamp shines along its -z axis, so column 2 of its pose points from a surface towards a sun.
        axes, away = poses[:, :3, 2], poses[None, self._suns :, :3, 3] - t[:, None]
        # v @ R is R^T v: world directions in the axes of each object.
        own = axes @ R
        spots = slice(len(self.lamps) - self._spots, None)
        placed = {"sun_towards": own[:, : self._suns], "lamp_place": away @ R, "spot_axis": own[:, spots]}
        factor = moment.factor(self._around)
        placed |= _forms(_seen_turned(self._quadric, turn) * factor)
        if self._quartic is not None:
            placed["around_fourth"] = _fourth(_seen_turned(self._quartic, _kron(R, R))) * factor
        if rates:
            dR, dt = moment.rates.T_world_obj[:, :3, :3], moment.rates.T_world_obj[:, :3, 3]
            changes = np.array([lamp.path.derivative(moment.t_ns) for lamp in self.lamps]).reshape(-1, 4, 4)
            # The product rule: both the lamps and the objects may turn.
            own_rate = axes @ dR + changes[:, :3, 2] @ R
            turn_rate = np.zeros_like(turn)
            turn_rate[:, :3, :3] = dR
            placed |= {
                "sun_towards_rate": own_rate[:, : self._suns],
                "lamp_place_rate": away @ dR + (changes[None, self._suns :, :3, 3] - dt[:, None]) @ R,
                "spot_axis_rate": own_rate[:, spots],
            }
            changed = _forms(_seen_turned(self._quadric, turn, turn_rate) * factor)
            placed |= {f"{name}_rate": values for name, values in changed.items()}
            if self._quartic is not None:
                pairs_rate = _kron(dR, R) + _kron(R, dR)
                placed["around_fourth_rate"] = _fourth(_seen_turned(self._quartic, _kron(R, R), pairs_rate)) * factor
        placed = {name: np.ascontiguousarray(values, np.float32) for name, values in placed.items()}
        self._last = moment, rates, placed
        return placed


def _shares(weights: np.ndarray) -> np.ndarray:
    total = weights.sum()
    # Black has no shares; what it shows is black with any.
    return weights / total if total > 0 else LUMA


def _seen_turned(form: np.ndarray, turn: np.ndarray, rate: np.ndarray | None = None) -> np.ndarray:
    """Return (N, 3, n, n): symmetric forms (3, n, n) with their arguments transformed by (N, n, n); or their rate of
    change, where the transform changes by ``rate`` per second."""
    if rate is None:
        return turn[:, None].swapaxes(2, 3) @ form @ turn[:, None]
    # The product rule on M^T F M; its two terms are transposes of each other.
    half = turn[:, None].swapaxes(2, 3) @ form @ rate[:, None]
    return half + half.swapaxes(2, 3)


def _kron(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return (N, 9, 9), the Kronecker products of (N, 3, 3) each: they transform the nine products of two
    coordinates."""
    return np.einsum("nij,nkl->nikjl", a, b).reshape(-1, 9, 9)


# Monomials of lights.glsl: x^4 x²y² x³y xy³ x²yz, each followed by its cyclic permutations of x, y, z.
_MONOMIALS = tuple(
    tuple(sorted((axis + k) % 3 for axis in one))
    for one in ((0, 0, 0, 0), (0, 0, 1, 1), (0, 0, 0, 1), (0, 1, 1, 1), (0, 0, 1, 2))
    for k in range(3)
)
_MONOMIAL_OF = np.zeros((81, len(_MONOMIALS)))  # index of the monomial of each of a quartic's numbers
_MONOMIAL_OF[np.arange(81), [_MONOMIALS.index(tuple(sorted(one))) for one in np.ndindex(3, 3, 3, 3)]] = 1.0


def _fourth(quartic: np.ndarray) -> np.ndarray:
    """Return (..., 3, 9, 9) quartics in the shader's form, (..., 3, 15)."""
    return quartic.reshape(*quartic.shape[:-2], 81) @ _MONOMIAL_OF


def _forms(quadric: np.ndarray) -> dict[str, np.ndarray]:
    """Return (..., 3, 4, 4) quadrics in the shader's form, (..., 3, 4 or 3)."""
    # Of (n, 1) Q (n, 1): the linear terms and the constant.
    Q = quadric
    even = np.concatenate([2 * Q[..., :3, 3], Q[..., 3, 3:]], axis=-1)
    mixed = 2 * np.stack([Q[..., 0, 1], Q[..., 1, 2], Q[..., 2, 0]], axis=-1)  # of xy, yz, zx
    return {
        "around_even": even,
        "around_squares": np.diagonal(Q[..., :3, :3], axis1=-2, axis2=-1),
        "around_mixed": mixed,
    }
