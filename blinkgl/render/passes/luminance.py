"""Event frames: linear luminance; and small pictures of it with its rate of change."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from blinkgl.render.antialiasing import Samples
from blinkgl.render.colour import LUMA
from blinkgl.render.matrices import rows_xyw_bytes
from blinkgl.render.passes.base import Output, Pass, Shot
from blinkgl.render.passes.shadow import Shaded, ShadowMap

if TYPE_CHECKING:
    from blinkgl.render.draw_items import DrawItem, Kind
    from blinkgl.render.painter import Painter, Uniforms
    from blinkgl.scene.types import Scene


class _Luminance(Shaded):
    program: ClassVar[str] = "luminance.glsl"
    one_channel: ClassVar[bool] = True

    def background(self, scene: Scene) -> tuple[float, ...]:
        return scene.backdrop, 0.0

    def set(self, painter: Painter, uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
        super().set(painter, uniforms, item, shot)
        if item.textured:
            resources = painter.resources
            (resources.shares_texture if item.kind.hued else resources.luminance_texture)(item.material).use(0)
        elif item.kind.hued:
            uniforms["albedo"].value = tuple(LUMA * np.asarray(item.material.base_color, np.float64))
        else:
            uniforms["albedo"].value = painter.resources.albedo_luminance(item.material)
        # What is neither textured nor lit does not change; its program has none of these.
        if "rate" in uniforms:
            uniforms["rate"].write(rows_xyw_bytes(shot.moment.rates.mvp[item.object_index]))
            uniforms["image_size"].value = shot.size
        if "sun_rate" in uniforms:
            # Rates of directions in the object's axes, as painter.place sets the directions.
            dR = shot.moment.rates.T_world_obj[item.object_index, :3, :3]
            uniforms["sun_rate"].value = tuple(shot.scene.light.sun_direction @ dR)
            uniforms["up_rate"].value = tuple(dR[2])


@dataclass(frozen=True)
class Luminance(_Luminance):
    """Output "luminance", (H, W) float32, at ``samples``."""

    samples: Samples = Samples()
    shadows: tuple[ShadowMap, ...] = ()
    still: ClassVar[bool] = True

    @property
    def depth(self) -> bool | str:
        return "texture" if self.samples.edges else True

    outputs: ClassVar[tuple[Output, ...]] = (Output("luminance", "R32F"),)

    def defines(self, kind: Kind | None) -> dict[str, Any]:
        # Taps are for textures; an even colour needs none.
        taps = {"TAPS4": 1} if self.samples.taps == 4 and kind.textured else {}
        return taps | ({"STRETCHED": 1} if taps and self.samples.edges else {})

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        return (cls(one) for one in (Samples(), Samples(taps=4), Samples(taps=4, edges=True)))


@dataclass(frozen=True)
class Brightness(_Luminance):
    """Output "brightness", (h, w, 2) float32: luminance and its rate per second on every n-th pixel in x and y,
    textures filtered as for the whole image."""

    every: int = 1
    shadows: tuple[ShadowMap, ...] = ()
    outputs: ClassVar[tuple[Output, ...]] = (Output("brightness", "RG32F"),)

    def defines(self, kind: Kind | None) -> dict[str, Any]:
        return {"RATE": 1} if self.every == 1 else {"RATE": 1, "EVERY": self.every}

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        return (cls(every) for every in (1, 4))
