"""The reference that settings are judged by: the same scene drawn so finely in space and
time that it does not matter any more.

Only some rectangles of the image are drawn (and judged): a whole image at 32 x 32 samples a pixel is out of reach, and
a few thousand pixels in many places say as much about errors as all of them. Each pixel is the mean of ``scale`` x
``scale`` samples on a regular grid, which converges to the box-filtered image of the full textures however each sample
is drawn. How fast it gets there is another matter: samples that are points of trilinear textures are off by 1 / scale
at silhouettes and still blurred where a surface is seen at a grazing angle (RMS of the log at 64 x 64: 0.0055); samples
drawn as `edges` with sharper mip maps fall with its square (0.0003), and end where the others do
(``tests/trade/test_suite.py``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import cv2
import numpy as np

from blinkgl.config.events import EmulatorConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.events.camera import EventCamera, EventFrame, emulate
from blinkgl.events.types import Events
from blinkgl.gl import GLContext
from blinkgl.render.rectangles import Rectangle
from blinkgl.render.renderer import Renderer
from blinkgl.scene.types import Scene
from blinkgl.timeline.sampling import displacement_times
from blinkgl.timeline.speed import largest_speed
from blinkgl.trade.metrics import masked

SAMPLES = RenderConfig(antialiasing="edges", mip_bias=-1.0)
"""How the samples are drawn."""
FrameSource = Callable[[Iterable[int]], Iterator[np.ndarray]]
"""Times in ns -> luminance frames (H, W) float32, linear light; only the judged pixels count. What else renders the
scene (a path tracer) takes the rasteriser's place by being one of these."""
MAX_STEP_NS = 20_000_000


def lattice(
    width: int, height: int, columns: int, rows: int, tile_width: int, tile_height: int
) -> tuple[Rectangle, ...]:
    """``columns`` x ``rows`` rectangles spread evenly over an image; one of the whole image when they would touch."""
    if columns * tile_width >= width or rows * tile_height >= height:
        return (Rectangle(0, 0, width, height),)
    xs = [round((i + 0.5) * width / columns - tile_width / 2) for i in range(columns)]
    ys = [round((i + 0.5) * height / rows - tile_height / 2) for i in range(rows)]
    return tuple(Rectangle(x, y, x + tile_width, y + tile_height) for y in ys for x in xs)


def mask_of(tiles: tuple[Rectangle, ...], height: int, width: int) -> np.ndarray:
    """(H, W) bool."""
    mask = np.zeros((height, width), bool)
    for r in tiles:
        mask[r.y0 : r.y1, r.x0 : r.x1] = True
    return mask


class FineTiles:
    """Rectangles of a scene's image at ``scale`` x ``scale`` samples a pixel. A context
    manager; calling it is a FrameSource."""

    cost = None

    def __init__(
        self, gl: GLContext, scene: Scene, tiles: tuple[Rectangle, ...], scale: int, samples: RenderConfig = SAMPLES
    ):
        self._tiles, self._scale = tiles, scale
        self._shape = (scene.camera.height, scene.camera.width)
        self._cameras = [scene.camera.part(r.x0, r.y0, r.x1, r.y1, scale) for r in tiles]
        self._renderer = Renderer(gl, scene.with_camera(self._cameras[0]), samples)
        self._fine = np.empty((self._cameras[0].height, self._cameras[0].width), np.float32)

    def __enter__(self) -> FineTiles:
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.release()

    def __call__(self, times: Iterable[int]) -> Iterator[np.ndarray]:
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

    def speed(self, t_ns: int) -> float:
        """Largest image speed in the rectangles, px/s."""
        largest = 0.0
        for camera in self._cameras:
            self._renderer.look_through(camera)
            largest = max(
                largest, largest_speed(self._renderer.velocity_of_movers(t_ns, self._scale).read()) / self._scale
            )
        return largest

    def times(self, max_px: float, t0_ns: int, t1_ns: int) -> Iterator[int]:
        """Times between which nothing in the rectangles moves by more than ``max_px``."""
        return displacement_times(max_px, 1000, MAX_STEP_NS, t0_ns, t1_ns, self.speed)


def reference_events(
    source: FrameSource,
    times: Iterable[int],
    config: EmulatorConfig,
    height: int,
    width: int,
    seed: int,
    mask: np.ndarray,
) -> tuple[Events, int]:
    """Events (of the masked pixels) of the frames of a source, linear in time between them; and the number of frames.

    Linear, because the times are so dense that it does not matter, and no scheme that is judged should judge."""
    camera, times = EventCamera(config, None, height, width, seed), list(times)
    chunks = [masked(events, mask) for _, events in emulate(map(EventFrame, times, source(times)), camera)]
    return Events.concatenate(chunks), camera.frames
