"""A first look at a sequence: may its frames be twice as far apart?

What a coarser step costs hangs on the scene, and no short cut foretells it (docs/trade.md, "auto"); so it is measured,
as :mod:`blinkgl.trade` measures, but little: a few pixels, a few steps at a few instants. Half a second of a processor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from blinkgl.config.events import EmulatorConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.config.timeline import DisplacementTimeline
from blinkgl.events import Events, emulator_of
from blinkgl.events.camera import EventCamera, EventFrame, emulate
from blinkgl.events.grids import masked, voxel_grid
from blinkgl.render.cutouts import Cutouts, lattice, mask_of
from blinkgl.render.renderer import Renderer
from blinkgl.scene.types import Scene

WORTH = 1.3
"""Frames that close together are worth their price where half as many make events so many times as wrong."""
INSTANTS, STEPS, TILES, FINER, BINS = 3, 4, (2, 2, 24, 18), 4, 8
"""Of the look: instants, spread over the sequence; steps at each of them; columns, rows, width, height of the
rectangles that are drawn; samples a pixel and side of what is true; slices of the voxel grid, half a step each."""
LEAST_EVENTS = 50
"""True ones; with fewer there is nothing to tell by."""
TRUE = RenderConfig(antialiasing="edges", mip_bias=-1.0)
_SEED = 0  # of an emulator without noise


@dataclass(frozen=True)
class Look:
    """What a first look saw. error, error_of_twice : of the events of frames one step apart and two steps apart:
    ||V - V_true|| / ||V_true|| of signed voxel grids, nan without events.   events : true ones."""

    error: float
    error_of_twice: float
    events: int

    @property
    def twice(self) -> bool:
        """Whether steps twice as long will do."""
        return self.events >= LEAST_EVENTS and self.error_of_twice <= WORTH * self.error

    def facts(self) -> dict[str, Any]:
        """Plain values for the manifest."""
        known = self.events > 0
        return {
            "events": self.events,
            "error": round(self.error, 4) if known else None,
            "error_of_twice": round(self.error_of_twice, 4) if known else None,
            "twice": self.twice,
        }


def first_look(
    renderer: Renderer,
    scene: Scene,
    timeline: DisplacementTimeline,
    emulator: EmulatorConfig,
    span_ns: tuple[int, int],
    pace: Callable[[int], float],
) -> Look:
    """Of a sequence that has begun with nothing yet. Deterministic: the same scene drawn by the same OpenGL gives the
    same look.

    renderer : of the sequence.   timeline : whose step is in question.   emulator : of the sensor; its noiseless
    twin judges.   span_ns : first and last time.   pace : steps per second that ``timeline`` asks for at a time, ns."""
    camera, noiseless = scene.camera, emulator_of(emulator).noiseless(emulator)
    height, width = camera.height, camera.width
    tiles = lattice(width, height, *TILES)
    mask = mask_of(tiles, height, width)

    def grid(times: list[int], frames: list[np.ndarray], every: int) -> tuple[np.ndarray, int]:
        sensor = EventCamera(noiseless, None, height, width, _SEED)
        chunks = emulate(map(EventFrame, times[::every], frames[::every]), sensor)
        events = masked(Events.concatenate([chunk for _, chunk in chunks]), mask)
        return voxel_grid(events, times[0] // 1000, times[-1] // 1000 + 1, height, width, BINS), len(events)

    off, off_of_twice, norm, count = 0.0, 0.0, 0.0, 0
    drawn = partial(Cutouts, renderer.gl, scene, tiles, beside=renderer)
    with drawn(scale=1, samples=renderer.config) as frames, drawn(scale=FINER, samples=TRUE) as fine:
        for times in _instants(timeline, span_ns, pace):
            true, events = grid(times, [frame.copy() for frame in fine(times)], 1)
            mine = [frame.copy() for frame in frames(times[::2])]
            off += _square(grid(times[::2], mine, 1)[0] - true)
            off_of_twice += _square(grid(times[::2], mine, 2)[0] - true)
            norm, count = norm + _square(true), count + events
    if not norm:
        return Look(float("nan"), float("nan"), count)
    return Look(float(np.sqrt(off / norm)), float(np.sqrt(off_of_twice / norm)), count)


def _instants(
    timeline: DisplacementTimeline, span_ns: tuple[int, int], pace: Callable[[int], float]
) -> Iterator[list[int]]:
    """Times half a step apart, ns; none of an instant where so many steps do not fit in or nothing would change."""
    (t0_ns, t1_ns), (least, most) = span_ns, (1e3 * timeline.min_step_us, 1e3 * timeline.max_step_us)
    for k in range(INSTANTS):
        middle = t0_ns + (t1_ns - t0_ns) * (2 * k + 1) // (2 * INSTANTS)
        asked = pace(middle)
        if not asked * most > 2e9:  # two steps are no longer than the longest that is allowed
            continue
        half = max(round(max(1e9 / asked, least) / 2), 1)
        begin = min(max(middle - STEPS * half, t0_ns), t1_ns - 2 * STEPS * half)
        if begin >= t0_ns:
            yield [begin + i * half for i in range(2 * STEPS + 1)]


def _square(grid: np.ndarray) -> float:
    return float(np.einsum("byx,byx->", grid, grid, dtype=np.float64))
