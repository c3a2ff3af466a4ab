"""Times settings and computes the errors of their events: the measurement of ``blinkgl trade``.

The events of a clip are simulated as by ``blinkgl generate``
(:func:`~blinkgl.sequence.simulate.simulate_sequence`; nothing is written), once per setting and round. Rounds are
interleaved, so that other load on the machine affects all settings equally.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.config.events import EmulatorConfig
from blinkgl.config.reader import apply_overrides
from blinkgl.config.run import RunTemplate
from blinkgl.config.sequence import RenderConfig, SequenceConfig
from blinkgl.errors import ConfigError
from blinkgl.events import emulator_of
from blinkgl.events.camera import EventCamera, EventFrame, emulate
from blinkgl.events.grids import masked
from blinkgl.events.response import Response
from blinkgl.gl import GLContext
from blinkgl.render.cutouts import Cutouts, lattice, mask_of
from blinkgl.render.frames import Rectangle
from blinkgl.render.motion import Look, Motion
from blinkgl.render.renderer import Renderer
from blinkgl.rng import Role, kernel_seed
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.types import Scene
from blinkgl.scene.waveforms import Waveform
from blinkgl.sequence import SensorSimulation, SequenceRequest, simulate_sequence
from blinkgl.timeline.sampling import Pace, bounded_times
from blinkgl.tools.trade.metrics import EventErrors, SpeedMaps, event_errors, flow_errors
from blinkgl.tools.trade.settings import SIZES, Setting
from blinkgl.types.events import Events

# ---------------------------------------------------------------------------------------------------------------------
# The reference of the settings: the same scene drawn so densely in space and time that a higher density changes
# nothing.
#
# Only some rectangles of the image are drawn (and compared): a whole image at 32 x 32 samples per pixel is too
# expensive, and a few thousand pixels in many places represent the errors of all. Each pixel is the mean of ``scale`` x
# ``scale`` samples on a regular grid, which converges to the box-filtered image of the full textures for any kind of
# sample. The rate of convergence depends on the samples: point samples of trilinear textures have an error of 1 / scale
# at silhouettes and are still blurred where a surface is seen at a grazing angle (RMS of the log at 64 x 64: 0.0055);
# the error of samples drawn as `edges` with sharper mip maps falls with its square (0.0003), to the same limit
# (``tests/tools/trade/test_suite.py``).

SAMPLES = RenderConfig(antialiasing="edges", mip_bias=-1.0)
"""Settings of each sample."""
FrameSource = Callable[[Iterable[int]], Iterator[np.ndarray]]
"""Times in ns -> luminance frames (H, W) float32, linear light; only the compared pixels count."""
MAX_STEP_NS = 20_000_000


class FineTiles(Cutouts):
    """Rectangles of a scene's image at ``scale`` x ``scale`` samples per pixel, and their frame times. A context
    manager; calling it is a FrameSource."""

    def __init__(
        self, gl: GLContext, scene: Scene, tiles: tuple[Rectangle, ...], scale: int, samples: RenderConfig = SAMPLES
    ):
        super().__init__(gl, scene, tiles, scale, samples)

    def times(self, max_px: float, t0_ns: int, t1_ns: int, response: Response) -> Iterator[int]:
        """Yield times between which nothing in the rectangles moves by more than ``max_px``, and no light changes by
        more than as many thresholds."""
        span, scene = (t0_ns, t1_ns), self._renderer.scene
        lights = tuple(scene.waveforms.values())
        jumps = {*self._renderer.motion.jumps(*span), *(t for light in lights for t in light.jumps(*span))}
        # The frame at a jump shows what was before it, that a nanosecond later what is after it.
        exact = {*jumps, *(t + 1 for t in jumps), *(t for light in lights for t in light.corners(*span))}
        pace = self.pace(max_px, lights, response.gain / response.threshold)
        stops = () if scene.dynamics is None else scene.dynamics.impacts_ns
        return bounded_times(pace, 1000, MAX_STEP_NS, *span, stops, sorted(exact))

    def pace(self, max_px: float, lights: Sequence[Waveform] = (), gain: float = 1.0) -> Pace:
        """Return the pace of steps in which nothing in the rectangles moves by more than ``max_px``, and ``gain`` times
        the logarithm of no light changes by more."""
        return _PaceOfTiles(self._renderer.motion, self._cameras, max_px * self._scale, lights, gain / max_px)


@dataclass(frozen=True)
class _PaceOfTiles:
    """The pace (:class:`blinkgl.timeline.sampling.Pace`) of several cameras at one place. max_px : of their px.
    per_light : steps for a change of a light by a factor e."""

    motion: Motion
    cameras: Sequence[CameraModel]
    max_px: float
    lights: Sequence[Waveform]
    per_light: float

    def at(self, t_ns: int) -> float:
        lit = max((light.steepness(t_ns) for light in self.lights), default=0.0) * self.per_light
        return max(lit, max(look.largest for look in self._looks(t_ns)) / self.max_px)

    def hides(self, ta_ns: int, tb_ns: int, steps: float) -> bool:
        looks = zip(self._looks(ta_ns), self._looks(tb_ns), strict=True)
        return any(self.motion.hides(a, b, steps * self.max_px) for a, b in looks)

    def bend(self, ta_ns: int, tb_ns: int) -> float:
        looks = zip(self._looks(ta_ns), self._looks(tb_ns), strict=True)
        return max(self.motion.bend(a, b) for a, b in looks) / self.max_px

    def misses(self, ta_ns: int, tb_ns: int) -> bool:
        """Nothing is said: its shortest step is a microsecond."""
        return True

    def _looks(self, t_ns: int) -> Iterator[Look]:
        for camera in self.cameras:
            self.motion.camera = camera
            yield self.motion.look(t_ns)


def reference_events(
    source: FrameSource,
    times: Iterable[int],
    config: EmulatorConfig,
    height: int,
    width: int,
    seed: int,
    mask: np.ndarray,
) -> tuple[Events, int]:
    """Return the events (of the masked pixels) of the frames of a source, linear in time between them, and the number
    of frames.

    Linear, because the times are dense enough, and because the reference must not use a scheme under test."""
    camera, times = EventCamera(config, None, height, width, seed), list(times)
    chunks = [masked(events, mask) for _, events in emulate(map(EventFrame, times, source(times)), camera)]
    return Events.concatenate(chunks), camera.frames


JUDGED = ("time_median_us", "time_p95_us", "wrong", "voxel")
"""The errors whose change decides whether the reference has converged."""
ENOUGH = 0.1
"""Largest allowed change of the reference, as a fraction of the smallest error."""


@dataclass(frozen=True)
class Density:
    """A rule that finds the density of the reference for each scene. First the frame distance is halved, at few samples
    per pixel, until that changes the events by less than ``share`` of the allowed change (:data:`ENOUGH`); then the
    samples are doubled at that step. The change of the last halving is added to that of the last doubling.

    scales : samples per pixel side, rising.   steps : px between frames, falling."""

    scales: tuple[int, ...] = (16, 32, 64, 128)
    steps: tuple[float, ...] = (0.25, 0.125, 0.0625, 0.03125)
    share: float = 0.4

    def next(self, levels: list[Level]) -> tuple[int, float] | None:
        """Return the samples and step of the level after these; None: there is none."""
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
    """Options of a measurement.

    clip_s : simulated seconds; 0: one label interval.   tiles : columns, rows, width, height of the compared
    rectangles.
    levels : (samples per pixel side, px between frames) of the reference, rising until it has converged or
    ``reference_s`` is spent; or a :class:`Density`, for each scene its own.
    reference_set : overrides of the scene, "scene.a.b=c", only for the reference: effects that settings leave out.
    rounds, rounds_s : largest number of rounds, and the time after which no new one starts, s."""

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
    """Whether the errors of flow labels are computed, too."""


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
    """One setting. wall_s, cpu_s : seconds (cpu: of all threads) per simulated second, one per round."""

    setting: Setting
    frames_per_s: float = 0.0
    triangles: float = 0.0
    """drawn per frame, after culling"""
    wall_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    flow: dict[str, float] = field(default_factory=dict)
    events: Events = field(init=False, repr=False)  # of the first round
    errors: EventErrors = field(init=False, repr=False)  # by Bench.judge
    moved: dict[str, float] = field(default_factory=dict)
    """Last change of the reference, as a fraction of this setting's errors."""

    @property
    def trusted(self) -> bool:
        """Return whether the reference has converged to a tenth of this setting's error."""
        return bool(self.moved) and max(self.moved.values()) <= ENOUGH

    @property
    def cost(self) -> float:
        """Return wall seconds per simulated second, median of the rounds."""
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
    """One level of the reference. movement : errors of the level before against this one; smallest : the smallest error
    of any setting against this one."""

    scale: int
    max_px: float
    frames: int
    seconds: float
    events: Events = field(repr=False)
    movement: dict[str, float] | None = None
    """Includes the change by the level's step where only its samples were changed."""
    smallest: dict[str, float] | None = None
    whole: bool = True
    """Whether samples and step have both been changed: one change alone shows nothing."""

    @property
    def ratio(self) -> dict[str, float]:
        movement, smallest = self.movement, self.smallest
        if not movement or smallest is None:
            return {}
        return {k: movement[k] / smallest[k] if smallest[k] else float("inf") for k in JUDGED}

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
    """One sequence at one image size: its scenes, its clip, its compared pixels."""

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
            raise ConfigError(
                "nothing is rendered from recorded frames, so there are no settings to compare", where="frames"
            )
        # Labels and previews are not measured; noise, and a bus that delays events, would hide the errors of interest.
        self.emulator = emulator_of(base.events).noiseless(base.events).beside(template.base)
        sized = [] if SIZES[size] == 1 else ["camera=" + json.dumps(base.camera.scaled(SIZES[size]))]
        tree = apply_overrides(template.tree, ["quality=null", *sized])  # the field of view stays
        self._template = RunTemplate({**tree, "events": self.emulator.model_dump()}, template.base)
        self._scenes: dict[str, Scene] = {}
        self.base = self.config(())
        self.scene = self.scene_of(self.base)
        for text in options.reference_set:
            if not text.startswith("scene."):
                raise ConfigError(
                    "the reference may differ only in the scene",
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
        """Return measurements of every setting, in interleaved rounds."""
        results = [Measured(s) for s in settings]
        configs = [self.config(m.setting.overrides) for m in results]
        groups: dict[str, list[int]] = {}  # settings with equal drawing share a renderer
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

        def clip(end_ns: int) -> SensorSimulation:
            window_ns = self.t0_ns, end_ns
            return simulate_sequence(
                SequenceRequest(config, self.options.sequence, labels=False, renderer=renderer, window_ns=window_ns)
            ).alone

        for _ in clip(self.t0_ns + (self.t1_ns - self.t0_ns) // 20):  # compile programs, targets and kernels first
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
        # n steps take n + 1 frames: this matters for a short clip, not for a sequence.
        steps = max(run.frames - 1, 1)
        result.wall_s.append(wall * steps / run.frames / self.duration_s)
        result.cpu_s.append(cpu * steps / run.frames / self.duration_s)
        if first:
            result.events = Events.concatenate(chunks)
            result.frames_per_s = steps / self.duration_s
            result.triangles = (renderer.stats.triangles - drawn) / run.frames

    # ---- judging -------------------------------------------------------------------------------------------------

    def speeds(self) -> SpeedMaps:
        """Return the analytic image speed over the clip, every 5 ms."""
        count = max(2, round(self.duration_s / 0.005) + 1)
        times = np.linspace(self.t0_ns, self.t1_ns, count).astype(np.int64)
        with Renderer(self.gl, self.scene, self.base.render) as renderer:
            maps = [np.hypot(*np.moveaxis(renderer.velocity(int(t)).read(), -1, 0)) for t in times]
        return SpeedMaps(times // 1000, np.stack(maps))

    def judge(self, results: list[Measured], speeds: SpeedMaps) -> list[Level]:
        """Refine the reference until it has converged (or time is up), fill in the results' errors, and return the
        levels."""
        levels: list[Level] = []
        begun = time.perf_counter()
        while (asked := self._next(levels)) is not None:
            scale, max_px = asked
            if levels and not self._affordable(levels, scale, max_px, time.perf_counter() - begun):
                self.say(f"reference: {scale}x{scale} at {max_px:g} px would take too long; stopped")
                break
            started = time.perf_counter()
            with FineTiles(self.gl, self.reference_scene, self.tiles, scale) as source:
                response = emulator_of(self.emulator).response(self.emulator)
                times = list(source.times(max_px, self.t0_ns, self.t1_ns, response))
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
            drift = f"; moved by {max(level.ratio.values()):.2g} of the smallest error" if level.ratio else ""
            self.say(f"reference {scale}x{scale} samples, {max_px:g} px, {frames} frames, {level.seconds:.0f} s{drift}")
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
        """Return the change by the step the last time that it alone was changed."""
        halved = [b.movement for a, b in pairwise(levels) if a.scale == b.scale and b.movement]
        return halved[-1] if halved else dict.fromkeys(JUDGED, 0.0)

    def errors(self, reference: Events, events: Events, speeds: SpeedMaps) -> EventErrors:
        return event_errors(
            reference, events, speeds, self.t0_ns // 1000, self.t1_ns // 1000, limit_us=self.options.limit_us
        )

    def _affordable(self, levels: list[Level], scale: int, max_px: float, spent: float) -> bool:
        last = levels[-1]
        return spent + last.seconds * (scale / last.scale) ** 2 * last.max_px / max_px <= self.options.reference_s
