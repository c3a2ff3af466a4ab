"""A path tracer in the reference's place (``blinkgl trade --reference cycles``): errors then contain what rasterising
leaves out, shadows and inter-reflection, and what it filters differently. Needs the extra [cycles]; see
``cycles.py``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from blinkgl.gl import GLContext
from blinkgl.render.rectangles import Rectangle
from blinkgl.scene.types import Scene
from blinkgl.trade import cycles
from blinkgl.trade.reference import FineTiles


class TracedFrames:
    """The scene by Blender's Cycles at ``scale`` * ``scale`` paths a pixel, with shadows and four diffuse bounces. Used
    like FineTiles, but draws whole images, at seconds each: for small ones and short clips.

    cost : seconds per frame, filled as frames are drawn. Raises BlinkGLError when Blender is not there or stops."""

    def __init__(self, gl: GLContext, scene: Scene, tiles: tuple[Rectangle, ...], scale: int):
        self._motion = FineTiles(gl, scene, tiles, 1)
        self.cost = cycles.Cost()
        self._frames = cycles.source(scene, cycles.CyclesSettings(samples=scale * scale), self.cost)

    def __enter__(self) -> TracedFrames:
        return self

    def __exit__(self, *_: object) -> None:
        self._motion.__exit__()

    def __call__(self, times: Iterable[int]) -> Iterator[np.ndarray]:
        return self._frames(times)

    def times(self, max_px: float, t0_ns: int, t1_ns: int) -> Iterator[int]:
        """Times between which nothing in the rectangles moves by more than ``max_px``."""
        return self._motion.times(max_px, t0_ns, t1_ns)
