"""Pictures in colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from blinkgl.render.antialiasing import Samples
from blinkgl.render.passes.base import Output, Shot
from blinkgl.render.passes.shadow import Shaded, ShadowMap

if TYPE_CHECKING:
    from blinkgl.render.draw_items import DrawItem
    from blinkgl.render.painter import Painter, Uniforms
    from blinkgl.scene.types import Scene


@dataclass(frozen=True)
class Colour(Shaded):
    """Output "colour", (H, W, 3) float32 linear radiance, at ``samples``."""

    samples: Samples = Samples()
    shadows: tuple[ShadowMap, ...] = ()
    program: ClassVar[str] = "colour.glsl"
    outputs: ClassVar[tuple[Output, ...]] = (Output("colour", "RGBA32F", components=3),)

    @property
    def depth(self) -> bool | str:
        return "texture" if self.samples.edges else True

    def background(self, scene: Scene) -> tuple[float, ...]:
        return (scene.backdrop,) * 3

    def set(self, painter: Painter, uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
        super().set(painter, uniforms, item, shot)
        uniforms["base_color"].value = tuple(item.material.base_color)
        if item.textured:
            painter.resources.colour_texture(item.material).use(0)
