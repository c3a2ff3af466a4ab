"""Times settings and judges their events: the measurement behind ``blinkgl trade``.

The events of a clip are simulated as ``blinkgl generate`` simulates them
(:func:`~blinkgl.sequence.simulate.simulate_sequence`; nothing is written), once per setting and round. Rounds are
interleaved, so that a busy moment of the machine falls on all settings alike.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from blinkgl.config.events import EmulatorConfig
from blinkgl.config.reader import apply_overrides
from blinkgl.config.run import RunTemplate
from blinkgl.config.sequence import RenderConfig, SequenceConfig
from blinkgl.errors import ConfigError
from blinkgl.events import emulator_of
from blinkgl.events.camera import EventCamera, EventFrame, emulate
from blinkgl.events.grids import masked
from blinkgl.gl import GLContext
from blinkgl.render.canvas import Rectangle
from blinkgl.render.cutouts import Cutouts, lattice, mask_of
from blinkgl.render.renderer import Renderer
from blinkgl.rng import Role, kernel_seed
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.types import Scene
from blinkgl.sequence import SequenceRequest, Simulation, simulate_sequence
from blinkgl.timeline.sampling import displacement_times, largest_speed
from blinkgl.trade.metrics import EventErrors, SpeedMaps, event_errors, flow_errors
from blinkgl.trade.settings import SIZES, Setting
from blinkgl.types.events import Events

# ---------------------------------------------------------------------------------------------------------------------
# The reference that settings are judged by: the same scene drawn so finely in space and time that it does not matter
# any more.
#
# Only some rectangles of the image are drawn (and judged): a whole image at 32 x 32 samples a pixel is out of reach,
# and a few thousand pixels in many places say as much about errors as all of them. Each pixel is the mean of
# ``scale`` x ``scale`` samples on a regular grid, which converges to the box-filtered image of the full textures
# however each sample is drawn. How fast it gets there is another matter: samples that are points of trilinear
# textures are off by 1 / scale at silhouettes and still blurred where a surface is seen at a grazing angle (RMS of
# the log at 64 x 64: 0.0055); samples drawn as `edges` with sharper mip maps fall with its square (0.0003), and end
# where the others do (``tests/trade/test_suite.py``).

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


JUDGED = ("time_median_us", "time_p95_us", "wrong", "voxel")
"""The errors whose movement decides whether the reference has converged."""
ENOUGH = 0.1
"""Of the smallest error judged: by how much the reference may move."""


@dataclass(frozen=True)
class Density:
    """How dense a reference has to be depends on the scene: first frames come closer, at few samples a pixel, until
    that moves the events by less than ``share`` of what is allowed (:data:`ENOUGH`); then samples are doubled at that
    step. What the last halving of the step moved is added to what the last doubling of the samples did.

    scales : samples per pixel side, rising.   steps : px between frames, falling."""

    scales: tuple[int, ...] = (16, 32, 64, 128)
    steps: tuple[float, ...] = (0.25, 0.125, 0.0625, 0.03125)
    share: float = 0.4

    def next(self, levels: list[Level]) -> tuple[int, float] | None:
        """Samples and step of the level after these; None: there is none."""
        if not levels:
            return self.scales[0], self.steps[0]
        last = levels[-1]
        k = self.steps.index(last.max_px)
        if last.scale == self.scales[0] and not self._still(last) and k + 1 < len(self.steps):
            return last.scale, self.steps[k + 1]
        finer = [s for s in self.scales if s > last.scale]
        return (finer[0], last.max_px) if finer else None

    def _still(self, level: Level) -> bool:
        return bool(level.ratio) and max(level.ratio.values()) <= self.share * ENOUGH


@dataclass(frozen=True)
class Options:
    """clip_s : simulated seconds; 0: one label interval.   tiles : columns, rows, width,
    height of the judged rectangles.
    levels : (samples per pixel side, px between frames) of the reference, rising until it has
    converged or ``reference_s`` is spent. A :class:`Density` instead: each scene's own.
    reference_set : overrides of the scene, "scene.a.b=c", that the reference alone has: effects that are left out.
    rounds, rounds_s : at most so many rounds, and no new one when so many seconds are gone."""

    clip_s: float = 0.0
    tiles: tuple[int, int, int, int] = (4, 3, 20, 15)
    levels: tuple[tuple[int, float], ...] | Density = ((8, 0.12), (16, 0.08), (32, 0.056), (64, 0.04), (128, 0.028))
    reference_s: float = 1200.0
    rounds: int = 3
    rounds_s: float = 1200.0
    limit_us: int = 10_000
    sequence: int = 0
    reference_set: tuple[str, ...] = ()
    labels: bool = True
    """Whether flow labels are judged, too."""


QUICK = Options(
    tiles=(3, 2, 24, 18),
    levels=((8, 0.12), (16, 0.08), (32, 0.056)),
    reference_s=60.0,
    rounds=3,
    rounds_s=60.0,
    clip_s=0.05,
)


@dataclass(eq=False)
class Measured:
    """One setting. wall_s, cpu_s : seconds (processor: of all threads) per simulated second, one per round."""

    setting: Setting
    frames_per_s: float = 0.0
    triangles: float = 0.0
    """drawn per frame, after culling"""
    wall_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    flow: dict[str, float] = field(default_factory=dict)
    events: Events | None = field(default=None, repr=False)
    errors: EventErrors | None = None
    moved: dict[str, float] = field(default_factory=dict)
    """What the reference moved last, in parts of this setting's own errors."""

    @property
    def trusted(self) -> bool:
        """Whether the reference stands still by a tenth of what it says of this setting."""
        return bool(self.moved) and max(self.moved.values()) <= ENOUGH

    @property
    def cost(self) -> float:
        """Wall seconds per simulated second, median of the rounds."""
        return float(np.median(self.wall_s))

    def to_dict(self) -> dict:
        s = self.setting
        return {
            "name": s.name,
            "sampling": s.sampling,
            "antialiasing": s.antialiasing,
            "other": s.other,
            "size": s.size,
            "overrides": list(s.overrides),
            "wall_s": self.cost,
            "cpu_s": float(np.median(self.cpu_s)),
            "wall_rounds": self.wall_s,
            "frames_per_s": self.frames_per_s,
            "triangles": self.triangles,
            **self.errors.to_dict(),
            **self.flow,
            "moved": self.moved,
            "trusted": self.trusted,
        }


@dataclass(eq=False)
class Level:
    """One reference of the ladder. movement : errors of the level before, judged by this one; smallest : the smallest
    error of any setting judged by this one."""

    scale: int
    max_px: float
    frames: int
    seconds: float
    events: Events = field(repr=False)
    movement: dict[str, float] | None = None
    """Includes what the level's step moved where only its samples were changed."""
    smallest: dict[str, float] | None = None
    whole: bool = True
    """Whether samples and step have both been changed: half a movement shows nothing."""

    @property
    def ratio(self) -> dict[str, float]:
        return (
            {k: self.movement[k] / self.smallest[k] if self.smallest[k] else float("inf") for k in JUDGED}
            if self.movement
            else {}
        )

    @property
    def converged(self) -> bool:
        return self.whole and bool(self.ratio) and max(self.ratio.values()) <= ENOUGH

    def to_dict(self) -> dict:
        return {
            "scale": self.scale,
            "max_px": self.max_px,
            "frames": self.frames,
            "seconds": self.seconds,
            "events": len(self.events),
            "movement": self.movement,
            "smallest": self.smallest,
            "ratio": self.ratio,
            "converged": self.converged,
        }


class Bench:
    """One sequence at one image size: its scenes, its clip, its judged pixels."""

    def __init__(
        self,
        gl: GLContext,
        template: RunTemplate,
        options: Options,
        size: str = "",
        say: Callable[[str], None] = lambda _: None,
    ):
        self.gl, self.options, self.say = gl, options, say
        base = template.sequence(options.sequence)
        if base.frames is not None:
            raise ConfigError("nothing is rendered from recorded frames, so there is nothing to trade", where="frames")
        # Labels and previews take no part in this; noise, and a bus that makes events late, would drown the errors that
        # are asked for.
        self.emulator = emulator_of(base.events).noiseless(base.events)
        tree = apply_overrides(template.tree, ["quality=null", *_sized(base, SIZES[size])])
        self._template = RunTemplate({**tree, "events": self.emulator.model_dump()}, template.base)
        self._scenes: dict[str, Scene] = {}
        self.base = self.config(())
        self.scene = self.scene_of(self.base)
        for text in options.reference_set:
            if not text.startswith("scene."):
                raise ConfigError(
                    "the reference differs in what it shows alone",
                    where="--reference-set",
                    value=text,
                    accepted="a key of the scene, such as scene.light.shadows=soft",
                )
        self.reference_scene = self.scene_of(self.config(options.reference_set))
        camera = self.scene.camera
        self.height, self.width = camera.height, camera.width
        self.tiles = lattice(self.width, self.height, *options.tiles)
        self.mask = mask_of(self.tiles, self.height, self.width)
        self.seed = kernel_seed(self.base.seed, options.sequence, Role.EVENTS)
        length = round(options.clip_s * 1e9) or self.base.time.interval_ns
        length = min(length, self.base.time.t1_ns - self.base.time.t0_ns)
        # From the middle, on a microsecond: event windows are in microseconds.
        self.t0_ns = (self.base.time.t0_ns + self.base.time.t1_ns - length) // 2000 * 1000
        self.t1_ns = self.t0_ns + length // 1000 * 1000

    def config(self, overrides: Iterable[str]) -> SequenceConfig:
        return RunTemplate(apply_overrides(self._template.tree, list(overrides)), self._template.base).sequence(
            self.options.sequence
        )

    def scene_of(self, config: SequenceConfig) -> Scene:
        key = json.dumps(config.scene.model_dump(), sort_keys=True)
        if key not in self._scenes:
            self._scenes[key] = sequence_scene(config, self.options.sequence, self._template.base)
        return self._scenes[key]

    @property
    def duration_s(self) -> float:
        return (self.t1_ns - self.t0_ns) * 1e-9

    # ---- settings ------------------------------------------------------------------------------------------------

    def measure(self, settings: Iterable[Setting]) -> list[Measured]:
        """Every setting, in interleaved rounds."""
        results = [Measured(s) for s in settings]
        configs = [self.config(m.setting.overrides) for m in results]
        groups: dict[str, list[int]] = {}  # settings that draw alike share a renderer
        for i, c in enumerate(configs):
            groups.setdefault(json.dumps([c.render.model_dump(), c.scene.model_dump()], sort_keys=True), []).append(i)
        started = time.perf_counter()
        for number in range(self.options.rounds):
            for members in groups.values():
                config = configs[members[0]]
                with Renderer(self.gl, self.scene_of(config), config.render) as renderer:
                    for i in members:
                        self._run(results[i], configs[i], renderer, first=number == 0)
                    if number == 0 and self.options.labels:
                        flow = flow_errors(self.scene, renderer, self.t0_ns, self.t0_ns + self.base.time.interval_ns)
                        for i in members:
                            results[i].flow = flow
            spent = time.perf_counter() - started
            self.say(f"round {number + 1} of {len(results)} settings, {spent:.0f} s")
            if spent + spent / (number + 1) > self.options.rounds_s:
                break
        return results

    def _run(self, result: Measured, config: SequenceConfig, renderer: Renderer, first: bool) -> None:
        config = config.model_copy(update={"events": self.emulator, "readout": None})

        def clip(end_ns: int) -> Simulation:
            window_ns = self.t0_ns, end_ns
            return simulate_sequence(
                SequenceRequest(config, self.options.sequence, labels=False, renderer=renderer, window_ns=window_ns)
            )

        for _ in clip(self.t0_ns + (self.t1_ns - self.t0_ns) // 20):  # programs, targets, kernels: made the first time
            pass
        run, drawn = clip(self.t1_ns), renderer.stats.triangles
        chunks: list[Events] = []
        wall, cpu = time.perf_counter(), time.process_time()
        for chunk in run.chunks():
            if first:
                paused = time.perf_counter(), time.process_time()
                chunks.append(masked(chunk.events, self.mask))
                wall += time.perf_counter() - paused[0]
                cpu += time.process_time() - paused[1]
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        # n steps take n + 1 frames: of a short clip that one would count for much, of a sequence it does not.
        steps = max(run.frames - 1, 1)
        result.wall_s.append(wall * steps / run.frames / self.duration_s)
        result.cpu_s.append(cpu * steps / run.frames / self.duration_s)
        if first:
            result.events = Events.concatenate(chunks)
            result.frames_per_s = steps / self.duration_s
            result.triangles = (renderer.stats.triangles - drawn) / run.frames

    # ---- judging -------------------------------------------------------------------------------------------------

    def speeds(self) -> SpeedMaps:
        """Analytic image speed all over the clip, every 5 ms."""
        count = max(2, round(self.duration_s / 0.005) + 1)
        times = np.linspace(self.t0_ns, self.t1_ns, count).astype(np.int64)
        with Renderer(self.gl, self.scene, self.base.render) as renderer:
            maps = [np.hypot(*np.moveaxis(renderer.velocity(int(t)).read(), -1, 0)) for t in times]
        return SpeedMaps(times // 1000, np.stack(maps))

    def judge(self, results: list[Measured], speeds: SpeedMaps) -> list[Level]:
        """Raises the reference until it has converged (or time is up) and fills in the results' errors."""
        levels: list[Level] = []
        begun = time.perf_counter()
        while (asked := self._next(levels)) is not None:
            scale, max_px = asked
            if levels and not self._affordable(levels, scale, max_px, time.perf_counter() - begun):
                self.say(f"reference: {scale}x{scale} at {max_px:g} px would take too long; stopped")
                break
            started = time.perf_counter()
            with FineTiles(self.gl, self.reference_scene, self.tiles, scale) as source:
                times = list(source.times(max_px, self.t0_ns, self.t1_ns))
                events, frames = reference_events(
                    source, times, self.emulator, self.height, self.width, self.seed, self.mask
                )
            level = Level(scale, max_px, frames, time.perf_counter() - started, events)
            for result in results:
                result.errors = self.errors(events, result.events, speeds)
            if levels and results:
                last, moved = levels[-1], self.errors(events, levels[-1].events, speeds).to_dict()
                carried = self._carried(levels) if max_px == last.max_px else dict.fromkeys(JUDGED, 0.0)
                level.whole = not isinstance(self.options.levels, Density) or scale != last.scale
                level.movement = {k: moved[k] + carried[k] for k in JUDGED}
                level.smallest = {k: float(np.nanmin([r.errors.to_dict()[k] for r in results])) for k in JUDGED}
            levels.append(level)
            said = f"; moved by {max(level.ratio.values()):.2g} of the smallest error" if level.ratio else ""
            self.say(f"reference {scale}x{scale} samples, {max_px:g} px, {frames} frames, {level.seconds:.0f} s{said}")
            if level.converged:
                break
        if levels[-1].whole and (moved := levels[-1].movement):
            for result in results:
                own = result.errors.to_dict()
                result.moved = {k: moved[k] / own[k] if own[k] else float("inf") for k in JUDGED}
        return levels

    def _next(self, levels: list[Level]) -> tuple[int, float] | None:
        plan = self.options.levels
        if isinstance(plan, Density):
            return plan.next(levels)
        return plan[len(levels)] if len(levels) < len(plan) else None

    @staticmethod
    def _carried(levels: list[Level]) -> dict[str, float]:
        """What the step moved the last time that it alone was changed."""
        halved = [b.movement for a, b in pairwise(levels) if a.scale == b.scale and b.movement]
        return halved[-1] if halved else dict.fromkeys(JUDGED, 0.0)

    def errors(self, reference: Events, events: Events, speeds: SpeedMaps) -> EventErrors:
        return event_errors(
            reference, events, speeds, self.t0_ns // 1000, self.t1_ns // 1000, limit_us=self.options.limit_us
        )

    def _affordable(self, levels: list[Level], scale: int, max_px: float, spent: float) -> bool:
        last = levels[-1]
        return spent + last.seconds * (scale / last.scale) ** 2 * last.max_px / max_px <= self.options.reference_s


def _sized(config: SequenceConfig, factor: float) -> list[str]:
    """Overrides that shrink the image, its field of view kept."""
    if factor == 1:
        return []
    return ["camera=" + json.dumps(config.camera.scaled(factor))]
