"""The passes: each is a value that defines what is drawn, by which program, from which other passes, into what.

In:    a :class:`~blinkgl.render.moment.Moment` and frames of other passes.
Out:   a :class:`~blinkgl.render.frames.Frame`, by ``Renderer.draw``.
Start: base.py, then luminance.py.
"""

from blinkgl.render.passes.base import Input, Output, Pass, ScenePass, ScreenPass, Shot
from blinkgl.render.passes.edged import Edged
from blinkgl.render.passes.gather import Gather
from blinkgl.render.passes.geometry import Geometry, Velocity
from blinkgl.render.passes.luminance import Brightness, Colour, Luminance, Mean
from blinkgl.render.passes.shadow import Shaded, ShadowMap, shadow_maps
from blinkgl.render.passes.specks import ColourPortraits, LuminancePortraits, Specks, filtered, one_value

PASSES: tuple[type[Pass], ...] = (
    Luminance,
    Brightness,
    Velocity,
    Colour,
    Geometry,
    Mean,
    Edged,
    LuminancePortraits,
    ColourPortraits,
    Specks,
    Gather,
    ShadowMap,
)
"""The passes that a renderer uses itself."""

__all__ = [
    "PASSES",
    "Brightness",
    "Colour",
    "ColourPortraits",
    "Edged",
    "Gather",
    "Geometry",
    "Input",
    "Luminance",
    "LuminancePortraits",
    "Mean",
    "Output",
    "Pass",
    "ScenePass",
    "ScreenPass",
    "Shaded",
    "ShadowMap",
    "Shot",
    "Specks",
    "Velocity",
    "filtered",
    "one_value",
    "shadow_maps",
]
