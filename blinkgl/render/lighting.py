"""The light of a scene as the programs have it: which variants they are compiled in, and the numbers of each object.

A scene whose light is the plain white sun and sky needs none of this: its programs are those of
shaders/include/light.glsl without LIGHTS, and :meth:`Painter.place` sets their three uniforms.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from blinkgl.render.colour import LUMA
from blinkgl.scene.lights import is_coloured, lamps_of, quadric_of

if TYPE_CHECKING:
    from blinkgl.render.moment import Moment
    from blinkgl.render.painter import Uniforms
    from blinkgl.render.passes.base import Pass
    from blinkgl.render.resources import DrawItem, Kind
    from blinkgl.scene.types import Light

EXAMPLES: tuple[dict[str, Any], ...] = (
    {"LIGHTS": 1, "AMBIENT": 1},
    {"LIGHTS": 1, "SUNS": 2, "LAMPS": 2},
    {"LIGHTS": 1, "SUNS": 2, "LAMPS": 3, "SPOTS": 1, "AMBIENT": 1},
)
"""Variants for which a program of a pass that is lit has to compile, besides the plain light's; HUED comes on top."""
_STRENGTHS = ("sun_strength", "lamp_strength")
_AROUND = ("around", "around_rate")


class Lighting:
    """Of one scene. lamps : in the order of the shaders' arrays.   coloured : whether any of it is not white."""

    def __init__(self, light: Light):
        self.plain, self.coloured, self.lamps = light.plain, is_coloured(light), lamps_of(light)
        self._suns = sum(lamp.kind == "sun" for lamp in self.lamps)
        self._spots = sum(lamp.kind == "spot" for lamp in self.lamps)
        self._quadric = quadric_of(light)
        near = self.lamps[self._suns :]
        strength = np.array([lamp.strength for lamp in self.lamps], np.float64).reshape(-1, 3)
        self._fixed = {
            "sun_strength": strength[: self._suns],
            "lamp_strength": strength[self._suns :],
            "lamp_fading": np.array([lamp.reach**-4.0 for lamp in near]),  # of inf: 0
            "spot_cone": np.array([lamp.cone for lamp in near if lamp.kind == "spot"]),
        }
        self._weights: dict[tuple[float, ...], np.ndarray] = {}
        self._last: tuple[Moment | None, bool, dict[str, np.ndarray]] = None, False, {}

    def defines(self, pass_: Pass, kind: Kind) -> dict[str, Any]:
        """Of the variant that a pass is drawn in. HUED: light of three channels, where one does not do: for pictures in
        colour, and for the luminance of what is of several colours itself."""
        if self.plain or not (kind.lit and pass_.lit):
            return {}
        counts = {"SUNS": self._suns, "LAMPS": len(self.lamps) - self._suns, "SPOTS": self._spots}
        return (
            {"LIGHTS": 1}
            | {name: count for name, count in counts.items() if count}
            | ({"AMBIENT": 1} if self._quadric.any() else {})
            | ({"HUED": 1} if self.coloured and (kind.hued or not pass_.one_channel) else {})
        )

    def place(self, uniforms: Uniforms, item: DrawItem, moment: Moment) -> None:
        """Sets what lights.glsl asks for, of whichever variant the program is."""
        if self.plain:
            return
        rates = any(name.endswith("_rate") for name in ("sun_towards_rate", "lamp_place_rate") if name in uniforms)
        rates = rates or "around_rate" in uniforms
        placed = self._placed(moment, rates)
        for name, values in (*self._fixed.items(), *placed.items()):
            if name not in uniforms:
                continue
            if name in placed:
                values = values[item.object_index]
            if name in _STRENGTHS and uniforms[name].dimension == 1:
                values = values @ self._channel(item)
            elif name in _AROUND and uniforms[name].array_length == 1:
                values = np.tensordot(self._channel(item), values, axes=1)
            uniforms[name].write(np.ascontiguousarray(values, np.float32).tobytes())

    def _channel(self, item: DrawItem) -> np.ndarray:
        """(3,) what one channel stands for: the shares of r, g, b in the luminance of what the item is made of."""
        base = item.material.base_color
        if base not in self._weights:
            shares = LUMA * np.asarray(base, np.float64)
            total = shares.sum()
            self._weights[base] = shares / total if total > 0 else LUMA
        return self._weights[base]

    def _placed(self, moment: Moment, rates: bool) -> dict[str, np.ndarray]:
        """By uniform, (objects, ...) float64 in the objects' axes; those of the last moment are kept."""
        if self._last[0] is moment and self._last[1] >= rates:
            return self._last[2]
        R, t = moment.T_world_obj[:, :3, :3], moment.T_world_obj[:, :3, 3]
        turn = np.zeros((len(R), 4, 4))
        turn[:, :3, :3], turn[:, 3, 3] = R, 1.0
        poses = np.array([lamp.path.pose(moment.t_ns) for lamp in self.lamps]).reshape(-1, 4, 4)
        axes, away = poses[:, :3, 2], poses[None, self._suns :, :3, 3] - t[:, None]
        own = axes @ R
        spots = slice(len(self.lamps) - self._spots, None)
        placed = {
            "sun_towards": own[:, : self._suns],
            "lamp_place": away @ R,
            "spot_axis": own[:, spots],
            "around": turn[:, None].swapaxes(2, 3) @ self._quadric @ turn[:, None],
        }
        if rates:
            dR, dt = moment.rates.T_world_obj[:, :3, :3], moment.rates.T_world_obj[:, :3, 3]
            changes = np.array([lamp.path.derivative(moment.t_ns) for lamp in self.lamps]).reshape(-1, 4, 4)
            own_rate = axes @ dR + changes[:, :3, 2] @ R
            turn_rate = np.zeros_like(turn)
            turn_rate[:, :3, :3] = dR
            half = turn[:, None].swapaxes(2, 3) @ self._quadric @ turn_rate[:, None]
            placed |= {
                "sun_towards_rate": own_rate[:, : self._suns],
                "lamp_place_rate": away @ dR + (changes[None, self._suns :, :3, 3] - dt[:, None]) @ R,
                "spot_axis_rate": own_rate[:, spots],
                "around_rate": half + half.swapaxes(2, 3),
            }
        self._last = moment, rates, placed
        return placed
