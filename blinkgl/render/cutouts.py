"""Rectangles of a scene's picture at any sampling density. A whole picture at 32 x 32 samples per pixel is too
expensive, and a few thousand pixels in many places represent its errors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import cv2
import numpy as np

from blinkgl.gl import GLContext
from blinkgl.machine.closing import Releasing
from blinkgl.render.frames import Rectangle
from blinkgl.render.renderer import Renderer
from blinkgl.scene.types import Scene

if TYPE_CHECKING:
    from blinkgl.config.sequence import RenderConfig


def lattice(
    width: int, height: int, columns: int, rows: int, tile_width: int, tile_height: int
) -> tuple[Rectangle, ...]:
    """Return ``columns`` x ``rows`` rectangles distributed evenly over an image; one of the whole image if they would
    touch."""
    if columns * tile_width >= width or rows * tile_height >= height:
        return (Rectangle(0, 0, width, height),)
    xs = [round((i + 0.5) * width / columns - tile_width / 2) for i in range(columns)]
    ys = [round((i + 0.5) * height / rows - tile_height / 2) for i in range(rows)]
    return tuple(Rectangle(x, y, x + tile_width, y + tile_height) for y in ys for x in xs)


def mask_of(tiles: tuple[Rectangle, ...], height: int, width: int) -> np.ndarray:
    """Return the pixels of the rectangles, (H, W) bool."""
    mask = np.zeros((height, width), bool)
    for r in tiles:
        mask[r.y0 : r.y1, r.x0 : r.x1] = True
    return mask


class Cutouts(Releasing):
    """Luminance of rectangles of a scene's picture; each pixel is the mean of ``scale`` x ``scale`` samples on a
    regular grid. A context manager; it is called with times.   samples : settings of each sample."""

    def __init__(self, gl: GLContext, scene: Scene, tiles: tuple[Rectangle, ...], scale: int, samples: RenderConfig):
        self._tiles, self._scale = tiles, scale
        self._shape = (scene.camera.height, scene.camera.width)
        self._cameras = [scene.camera.part(r.x0, r.y0, r.x1, r.y1, scale) for r in tiles]
        self._renderer = Renderer(gl, scene.with_camera(self._cameras[0]), samples)
        self._fine = np.empty((self._cameras[0].height, self._cameras[0].width), np.float32)

    def release(self) -> None:
        self._renderer.release()

    def __call__(self, times: Iterable[int]) -> Iterator[np.ndarray]:
        """Yield (H, W) float32 linear light at each time, ns, zero outside the rectangles; the same array each time."""
        frame = np.zeros(self._shape, np.float32)
        for t_ns in times:
            for r, camera in zip(self._tiles, self._cameras):
                self._renderer.look_through(camera)
                self._renderer.luminance(t_ns).read(out=self._fine)
                # INTER_AREA at a whole-numbered ratio is the mean.
                frame[r.y0 : r.y1, r.x0 : r.x1] = cv2.resize(
                    self._fine, (r.x1 - r.x0, r.y1 - r.y0), interpolation=cv2.INTER_AREA
                )
            yield frame
