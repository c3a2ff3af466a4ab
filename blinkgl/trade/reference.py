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

import numpy as np

from blinkgl.config.events import EmulatorConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.events.camera import EventCamera, EventFrame, emulate
from blinkgl.events.grids import masked
from blinkgl.gl import GLContext
from blinkgl.render.canvas import Rectangle
from blinkgl.render.cutouts import Cutouts
from blinkgl.scene.types import Scene
from blinkgl.timeline.sampling import displacement_times, largest_speed
from blinkgl.types.events import Events

SAMPLES = RenderConfig(antialiasing="edges", mip_bias=-1.0)
"""How the samples are drawn."""
FrameSource = Callable[[Iterable[int]], Iterator[np.ndarray]]
"""Times in ns -> luminance frames (H, W) float32, linear light; only the judged pixels count."""
MAX_STEP_NS = 20_000_000


class FineTiles(Cutouts):
    """Rectangles of a scene's image at ``scale`` x ``scale`` samples a pixel, and the times that they want. A context
    manager; calling it is a FrameSource."""

    def __init__(
        self, gl: GLContext, scene: Scene, tiles: tuple[Rectangle, ...], scale: int, samples: RenderConfig = SAMPLES
    ):
        super().__init__(gl, scene, tiles, scale, samples)

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
