"""The pictures of ``antialiasing: edges``: what ``edges.glsl`` puts together, and what its slow twin makes of the same
picture, depths and lines (``edges_twin.py``)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from blinkgl.config.sequence import SequenceConfig
from blinkgl.render.antialiasing import samples_of
from blinkgl.render.contours import Lines
from blinkgl.render.passes import Colour, Edged, Luminance, Pass
from blinkgl.render.passes.edged import SKY
from blinkgl.shader_debugger.edges_twin import filtered

if TYPE_CHECKING:
    from blinkgl.shader_debugger.session import DebugRenderer

EDGED = ("luminance_edges", "colour_edges")
_SAMPLES = samples_of("edges")


def edged_of(config: SequenceConfig) -> tuple[str, ...]:
    """Those of :data:`EDGED` that a generation run of this configuration draws: with ``edges2`` on a finer grid, of
    which the image's own pixels are looked at here."""
    drawn = (config.render.antialiasing, config.render.image_antialiasing)
    return tuple(name for name, kind in zip(EDGED, drawn, strict=True) if samples_of(kind).edges)


def _filtered(renderer: DebugRenderer, name: str) -> tuple[str, Pass]:
    """(what is filtered, the pass that draws it unfiltered)"""
    what = name.partition("_")[0]
    maps = renderer.maps
    return what, Colour(_SAMPLES, maps) if what == "colour" else Luminance(_SAMPLES, maps)


def edged(renderer: DebugRenderer, name: str, t_ns: int) -> np.ndarray:
    """What the program writes, (H, W) or (H, W, 3) float32. name : of :data:`EDGED`, here and below."""
    what, of = _filtered(renderer, name)
    return renderer.draw(Edged(of), t_ns).read(what)


def twin_of(renderer: DebugRenderer, name: str, t_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """(the picture that the program filters, float32; what it should make of it, float64)"""
    what, of = _filtered(renderer, name)
    frame = renderer.draw(of, t_ns)
    plain, depths, moment = frame.read(what), frame.target.read_depth(), frame.moment
    items = [item for item in moment.visible if item.layer != SKY]
    pixels, crossings = Lines().in_pixels(moment, items, frame.width, frame.height)
    pixel = 2 / (frame.width * abs(moment.view.projection[0, 0]))
    return plain, filtered(plain, depths, pixels, crossings, pixel)
