"""Passes of light: luminance of event frames, its rate of change in small pictures, colour, and means of samples."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from blinkgl.render.antialiasing import Samples
from blinkgl.render.colour import LUMA
from blinkgl.render.moment import rows_xyw_bytes
from blinkgl.render.passes.base import Input, Output, OverPass, Pass, ScreenPass, Shot
from blinkgl.render.passes.shadow import Shaded, ShadowMap
from blinkgl.scene.types import Scene

if TYPE_CHECKING:
    from blinkgl.gl.shader import Uniforms
    from blinkgl.render.draw_items import DrawItem, Kind
    from blinkgl.render.moment import Moment
    from blinkgl.render.painter import Painter


class LuminancePass(Shaded):
    """A pass that draws the scene's luminance."""

    program: ClassVar[str] = "luminance.glsl"
    one_channel: ClassVar[bool] = True

    def background(self, scene: Scene) -> tuple[float, ...]:
        return scene.backdrop, 0.0

    def set(self, painter: Painter, uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
        super().set(painter, uniforms, item, shot)
        if item.textured:
            resources = painter.resources
            (resources.shares_texture if item.kind.rgb else resources.luminance_texture)(item.material).use(0)
        elif item.kind.rgb:
            uniforms["albedo"].value = tuple(LUMA * np.asarray(item.material.base_color, np.float64))
        else:
            uniforms["albedo"].value = painter.resources.albedo_luminance(item.material)
        # A surface without texture and light is constant; its program has no rates.
        if "rate" in uniforms:
            uniforms["rate"].write(rows_xyw_bytes(shot.moment.rates.mvp[item.object_index]))
            uniforms["image_size"].value = shot.size
        if "sun_rate" in uniforms:
            # Rates of directions in the object's axes, in the same form as painter.place.
            dR = shot.moment.rates.T_world_obj[item.object_index, :3, :3]
            uniforms["sun_rate"].value = tuple(shot.scene.light.sun_direction @ dR)
            uniforms["up_rate"].value = tuple(dR[2])


class Picture(Shaded):
    """A picture of light at ``samples``.   specks : as many bodies under a pixel are left out, for
    :class:`~blinkgl.render.passes.specks.Specks`."""

    specks: int

    @property
    def depth(self) -> bool | str:
        return "texture" if self.specks else super().depth

    def items(self, moment: Moment) -> list[DrawItem]:
        if not self.specks:
            return moment.visible
        apart = set(moment.specks(self.samples.grid, self.specks)[0].tolist())
        return [item for item in moment.visible if item.object_index not in apart]


@dataclass(frozen=True)
class Luminance(Picture, LuminancePass):
    """Output "luminance", (H, W) float32."""

    samples: Samples = Samples()
    shadows: tuple[ShadowMap, ...] = ()
    specks: int = 0
    still: ClassVar[bool] = True

    outputs: ClassVar[tuple[Output, ...]] = (Output("luminance", "R32F"),)

    def defines(self, kind: Kind | None) -> dict[str, Any]:
        # Taps are for textures; a uniform colour needs none.
        taps = {"TAPS4": 1} if self.samples.taps == 4 and kind is not None and kind.textured else {}
        stretched = {"STRETCHED": 1} if taps and self.samples.edges else {}
        return taps | stretched | ({"NEAREST_LEVEL": 1} if stretched and self.samples.grid == 1 else {})

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        return (cls(one) for one in (Samples(), Samples(taps=4), Samples(taps=4, edges=True)))


@dataclass(frozen=True)
class Brightness(LuminancePass):
    """Output "brightness", (h, w, 2) float32: luminance and its rate per second on every n-th pixel in x and y,
    textures filtered as for the whole image."""

    every: int = 1
    shadows: tuple[ShadowMap, ...] = ()
    outputs: ClassVar[tuple[Output, ...]] = (Output("brightness", "RG32F"),)

    def defines(self, kind: Kind | None) -> dict[str, object]:
        return {"RATE": 1} if self.every == 1 else {"RATE": 1, "EVERY": self.every}

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        return (cls(every) for every in (1, 4))


# ---------------------------------------------------------------------------------------------------------------------
# Pictures in colour.


@dataclass(frozen=True)
class Colour(Picture):
    """Output "colour", (H, W, 3) float32 linear radiance."""

    samples: Samples = Samples()
    shadows: tuple[ShadowMap, ...] = ()
    specks: int = 0
    program: ClassVar[str] = "colour.glsl"
    outputs: ClassVar[tuple[Output, ...]] = (Output("colour", "RGBA32F", components=3),)

    def background(self, scene: Scene) -> tuple[float, ...]:
        return (scene.backdrop,) * 3

    def set(self, painter: Painter, uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
        super().set(painter, uniforms, item, shot)
        uniforms["base_color"].value = tuple(item.material.base_color)
        if item.textured:
            painter.resources.colour_texture(item.material).use(0)


# ---------------------------------------------------------------------------------------------------------------------
# One value per pixel from a picture of higher resolution.


@dataclass(frozen=True)
class Mean(OverPass, ScreenPass):
    """The mean of each pixel's samples of one output of another pass."""

    of: Pass
    program: ClassVar[str] = "downsample.glsl"
    pointwise: ClassVar[bool] = True

    @property
    def inputs(self) -> tuple[Input, ...]:
        return (Input("fine", self.of),)

    def defines(self, kind: Kind | None) -> dict[str, object]:
        # Samples per pixel in x and in y.
        return {"FACTOR": self.of.samples.grid}

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        return (cls(Colour(Samples(grid=factor))) for factor in (2, 4, 8))
