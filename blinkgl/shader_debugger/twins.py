"""Pictures that a program makes of another picture, and their float64 twins of that very picture: silhouettes by area
(``edges.glsl``, :mod:`edges_twin`), and what a lens sees (``gather.glsl``)."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from blinkgl.camera import CameraModel
from blinkgl.camera.drawing import seen_through
from blinkgl.config.sequence import SequenceConfig
from blinkgl.render import lens
from blinkgl.render.antialiasing import Samples, samples_of
from blinkgl.render.casting import pixel_grid
from blinkgl.render.contours import Lines
from blinkgl.render.passes import Colour, Edged, Gather, Luminance, Pass
from blinkgl.render.passes.edged import SKY
from blinkgl.scene.types import Scene
from blinkgl.shader_debugger.edges_twin import filtered

if TYPE_CHECKING:
    from blinkgl.shader_debugger.session import DebugRenderer

EDGED = ("luminance_edges", "colour_edges")
LENSED = ("luminance_lens", "colour_lens")
TWINNED = EDGED + LENSED


def twinned_of(config: SequenceConfig, scene: Scene) -> tuple[str, ...]:
    """Those of :data:`TWINNED` that a generation run draws: with ``edges2`` on a finer grid, of which the image's own
    pixels are looked at here."""
    # A lens's flat picture is filtered before the lens looks at it, as without one.
    drawn = (config.render.antialiasing, config.render.image_antialiasing)
    edged = tuple(name for name, kind in zip(EDGED, drawn, strict=True) if samples_of(kind).edges)
    return edged + (() if places_of(scene.camera) is None else LENSED)


@lru_cache(maxsize=8)
def places_of(camera: CameraModel) -> np.ndarray | None:
    """(H, W, 2) column and row of the pixel of the flat picture that each pixel of a lens looks at; None where the
    camera's own picture is drawn."""
    flat = seen_through(camera)
    if flat is camera:
        return None
    # Of float32 places, as gather.glsl has them: which side of a pixel's border a ray is on hangs on the last bit.
    return np.floor(lens.places_of(camera, flat, camera.width, camera.height).places).astype(np.intp)


def pass_of(renderer: DebugRenderer, what: str, samples: Samples = Samples()) -> Pass:
    """The pass that draws "luminance" or "colour"."""
    return {"luminance": Luminance, "colour": Colour}[what](samples, renderer.maps)


def _parts(renderer: DebugRenderer, name: str) -> tuple[str, Pass, Pass]:
    """(what the picture is of, the pass that draws it before, the pass that makes ``name`` of that)"""
    what = name.partition("_")[0]
    if name in LENSED:
        of = pass_of(renderer, what)
        return what, of, Gather(of, renderer.scene.camera, True)
    of = pass_of(renderer, what, samples_of("edges"))
    return what, of, Edged(of)


def drawn(renderer: DebugRenderer, name: str, t_ns: int) -> np.ndarray:
    """What the program writes, (H, W) or (H, W, 3) float32; behind a lens ``edges`` makes a flat picture. name : of
    :data:`TWINNED`, here and below."""
    what, _, pass_ = _parts(renderer, name)
    return renderer.draw(pass_, t_ns).read(what)


def twin_of(renderer: DebugRenderer, name: str, t_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """(the picture that the program reads, float32; what it should make of it, float64)"""
    written = drawn(renderer, name, t_ns)
    what, of, _ = _parts(renderer, name)
    frame = renderer.draw(of, t_ns)
    plain = frame.read(what)
    if name in LENSED:
        return renderer.at_pixels(plain), _gathered(plain, renderer.scene.camera)
    depths, moment = frame.target.read_depth(), frame.moment
    # The sky has no silhouette of its own: others stand before it.
    items = [item for item in moment.visible if item.layer != SKY]
    pixels, crossings = Lines().in_pixels(moment, items, frame.width, frame.height)
    pixel = 2 / (frame.width * abs(moment.view.projection[0, 0]))
    return plain, filtered(plain, depths, pixels, crossings, pixel, written)


def _gathered(picture: np.ndarray, camera: CameraModel) -> np.ndarray:
    """(H, W) or (H, W, C) float64: the mean of a flat picture over each pixel of a lens, at as many places between four
    pixels as gather.glsl looks at."""
    flat, grid = seen_through(camera), pixel_grid(camera)
    rays = camera.rays(grid)
    # To first order, as the shader has it: the place of the pixel's centre and its two derivatives.
    place, slopes = flat.project(rays), flat.jacobian(rays) @ camera.ray_jacobian(grid)
    columns, rows = lens.steps_of(camera, 1)
    # map_coordinates takes one channel at a time.
    channels = np.moveaxis(np.atleast_3d(picture).astype(np.float64), 2, 0)
    total = np.zeros((len(channels), len(grid)))
    for across in (np.arange(columns) + 0.5) / columns - 0.5:
        for down in (np.arange(rows) + 0.5) / rows - 0.5:
            # Rows before columns, whole numbers at the pixels' centres.
            there = (place + slopes @ [across, down])[:, ::-1].T
            total += [ndimage.map_coordinates(channel, there, order=1, mode="nearest") for channel in channels]
    mean = total.T.reshape(camera.height, camera.width, -1) / (columns * rows)
    return mean if picture.ndim == 3 else mean[..., 0]
