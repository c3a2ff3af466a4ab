"""The strategies of ``timeline:``: frame times that adapt to the scene.

timeline = make_timeline(config.timeline, t0_ns, t1_ns, renderer,
                         emulator_of(config.events).response(config.events))
for t_ns in timeline:
    luminance = ...                              # the frame at t_ns
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from blinkgl.config.timeline import TimelineConfig
from blinkgl.events.response import Response
from blinkgl.timeline.sampling import bounded_times, uniform_times
from blinkgl.types.recent import Recent

# ---------------------------------------------------------------------------------------------------------------------
# What the brightness timeline needs of a small picture: a percentile and the maximum of what changes in it.

SLOWEST = np.float32(2.0**-40)
"""Values (px/s, or per second) below this, about 1e-12, count as still."""


class Drawn(Protocol):
    """A rendered picture, in any memory."""

    def read(self) -> np.ndarray: ...


class Ranked(NamedTuple):
    """Statistics of the moving values. count : their number.   percentile, largest : 0.0 where there are none."""

    count: int
    percentile: float
    largest: float


STILL = Ranked(0, 0.0, 0.0)


def speeds_of_edges(drawn: Drawn, luminance: np.ndarray, response: Response) -> float:
    """Return the largest length of (h, w, 2) float32 vectors where neighbouring pixels of the (h, w) luminance differ
    by a threshold or more; 0 where none do."""
    signal, edge = response.signal(luminance), np.zeros(luminance.shape, bool)
    for s, on in ((signal, edge), (signal.T, edge.T)):
        step = np.abs(np.diff(s, axis=0)) >= response.threshold
        # Both pixels beside a step are on its edge.
        on[1:] |= step
        on[:-1] |= step
    return ranked(np.linalg.norm(drawn.read(), axis=-1)[edge], 100).largest if edge.any() else 0.0


def ranked(values: np.ndarray, percent: float) -> Ranked:
    """Return the statistics of float32 values >= 0 of any shape, without still ones, which would lower a percentile,
    and without infinite ones (a surface in the camera plane)."""
    values = values.ravel()
    values = values[(values >= SLOWEST) & np.isfinite(values)]
    if not len(values):
        return STILL
    k, share = place(len(values), percent)
    above = min(k + 1, len(values) - 1)
    # The k-th smallest and the one above it, without sorting all.
    values = np.partition(values, (k, above, len(values) - 1))
    return Ranked(len(values), between(values[k], values[above], share), float(values[-1]))


def place(count: int, percent: float) -> tuple[int, float]:
    """Return the index of a percentile among ``count`` sorted values, and the fraction [0, 1) to the next, in double
    precision."""
    at = (count - 1) * (percent / 100)
    # percent = 100 would give an index beyond the last by rounding.
    k = min(math.floor(at), count - 1)
    return k, at - k


def between(below: np.float32, above: np.float32, share: float) -> float:
    """Return a value between two in single precision, rounded as NumPy's percentile (from the nearer neighbour)."""
    apart = above - below
    # NumPy interpolates from the nearer neighbour, which rounds otherwise than from below.
    if share < 0.5:
        return float(below + apart * np.float32(share))
    return float(above - apart * np.float32(1.0 - share))


class Look(Protocol):
    """The speeds of a scene's surfaces at one time. largest : px/s."""

    largest: float

    def percentile(self, percent: float) -> float: ...


class Moving(Protocol):
    """The speeds of a scene."""

    @property
    def unbounded(self) -> Sequence[str]:
        """Return the names of the bodies of which only single times are known."""

    def look(self, t_ns: int) -> Any: ...

    def jumps(self, t0_ns: int, t1_ns: int) -> list[int]:
        """Return the times in (t0, t1), ns, after which something stands elsewhere a nanosecond later."""

    def hides(self, a: Any, b: Any, tolerance: float) -> bool:
        """Return whether something may be faster between two looks, by more than ``tolerance`` px/s, than both show."""

    def bend(self, a: Any, b: Any) -> float:
        """Return how far, px, anything leaves a steady motion between two looks."""


class Changing(Protocol):
    """A light that changes over time (:class:`blinkgl.scene.waveforms.Waveform`)."""

    def jumps(self, t0_ns: int, t1_ns: int) -> list[int]: ...

    def corners(self, t0_ns: int, t1_ns: int) -> list[int]: ...

    def steepness(self, t_ns: int) -> float: ...


class Watched(Protocol):
    """What a timeline asks of a renderer."""

    @property
    def motion(self) -> Moving: ...

    def velocity_of_movers(self, t_ns: int, every: int) -> Drawn:
        """Return (h, w, 2) float32 image velocity, px/s of the whole image, of every n-th pixel in x and y."""

    def brightness(self, t_ns: int, every: int) -> Drawn:
        """Return (h, w, 2) float32 luminance and its rate of change per second, of every n-th pixel in x and y."""


class Timeline:
    """Iterator over frame times, int64 ns, from t0 to t1, both included, strictly increasing; each is decided when
    requested. ``stops_ns``: times of impacts, which adaptive kinds do not cross.   ``lights``: those that change
    over time: adaptive kinds have a frame at each of their jumps, as at those of what moves, and one a nanosecond
    later, do not cross their turning points, and in between take steps in which a light changes by a threshold at
    most, where the response is logarithmic."""

    def __init__(
        self,
        config: TimelineConfig,
        t0_ns: int,
        t1_ns: int,
        scene: Watched,
        response: Response,
        stops_ns: Sequence[int] = (),
        lights: Sequence[Changing] = (),
    ):
        self.lights = lights
        self.config, self.t0_ns, self.t1_ns, self.scene, self.response = config, t0_ns, t1_ns, scene, response
        self.stops_ns = stops_ns
        self.looks = 0
        """Number of times examined so far."""
        self.others: tuple[Timeline, ...] = ()
        """Timelines of other cameras whose pace also limits this one (:mod:`blinkgl.timeline.strategy`)."""
        self.too_long, self.longest = 0, 0.0
        """Number of steps so far that ``min_step_us`` kept too long, and the largest motion of any, in steps."""
        self.unseen: tuple[int, int] | None = None
        """The first two times, a shortest step apart, between which something may happen unseen."""
        self._known: Recent[int, float] = Recent(_KNOWN)

    def __iter__(self) -> Iterator[int]:
        c = self.config
        least, most = round(c.min_step_us * 1000), round(c.max_step_us * 1000)
        last, self.too_long, self.longest = self.t0_ns, 0, 0.0
        span = self.t0_ns, self.t1_ns
        jumps = {t for light in self.lights for t in light.jumps(*span)} | {*self.scene.motion.jumps(*span)}
        turns = {t for light in self.lights for t in light.corners(*span)}
        # The frame at a jump shows what was before it, that a nanosecond later what is after it.
        exact = sorted({*jumps, *(t + 1 for t in jumps), *turns})
        for t_ns in bounded_times(self, least, most, *span, self.stops_ns, exact):
            if last not in jumps and last - 1 not in jumps:  # what jumps is faster than any step
                steps = max(self.at(last), self.at(t_ns)) * (t_ns - last) * 1e-9
                self.too_long += steps > TOO_LONG
                self.longest = max(self.longest, steps)
            yield t_ns
            last = t_ns

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what limits the times so far, a line each."""
        notes = []
        if self.too_long:
            notes.append(
                f"{self.too_long} steps between event frames are {self.config.min_step_us:g} µs long and would have to "
                f"be up to {self.longest:.3g} times shorter for this motion; expected a smaller timeline.min_step_us"
            )
        if self.unseen and not self.scene.motion.unbounded:
            notes.append(
                f"something may pass, or move to and fro, unseen within {self.config.min_step_us:g} µs, first at "
                f"{self.unseen[0] * 1e-9:.9g} s; expected a smaller timeline.min_step_us"
            )
        return (*notes, *(line for other in self.others for line in other.notes))

    def misses(self, ta_ns: int, tb_ns: int) -> bool:
        self.unseen = self.unseen or (ta_ns, tb_ns)
        # Of a deformer without a time scale nothing is known at any time: a frame at each would be all of them.
        return not self.scene.motion.unbounded

    def at(self, t_ns: int) -> float:
        """Return the steps per second that the strictest camera needs at one time."""
        return self._known.of(t_ns, lambda: self._counted(t_ns))

    def hides(self, ta_ns: int, tb_ns: int, steps: float) -> bool:
        """Return whether a camera may need more steps per second between two times, by more than ``steps``, than at
        both of them."""
        motion = self.scene.motion
        hidden = motion.hides(motion.look(ta_ns), motion.look(tb_ns), steps * self.step_px)
        return hidden or any(other.hides(ta_ns, tb_ns, steps) for other in self.others)

    def bend(self, ta_ns: int, tb_ns: int) -> float:
        """Return how far anything leaves a steady motion between two times, in displacements of a step."""
        motion = self.scene.motion
        own = motion.bend(motion.look(ta_ns), motion.look(tb_ns)) / self.step_px
        return max([own, *(other.bend(ta_ns, tb_ns) for other in self.others)])

    @property
    def step_px(self) -> float:
        """Return the displacement, px, that a step may have."""
        raise NotImplementedError

    def pace(self, t_ns: int) -> float:
        """Return the steps per second that this camera needs at one time."""
        raise NotImplementedError

    def _counted(self, t_ns: int) -> float:
        self.looks += 1
        gain = self.response.gain / self.response.threshold
        lights = [light.steepness(t_ns) * gain for light in self.lights]
        return max([self.pace(t_ns), *lights, *(other.pace(t_ns) for other in self.others)])


TOO_LONG = 1.25
"""Motion of a step, in steps, from which on it is reported."""
_KNOWN = 64
"""Paces in memory: a step that is refused is examined again."""


class Uniform(Timeline):
    """``fps`` frames per second, independent of the scene."""

    def __iter__(self) -> Iterator[int]:
        return uniform_times(self.config.fps, self.t0_ns, self.t1_ns)


class Displacement(Timeline):
    """Steps in which surfaces move ``max_px``."""

    @property
    def step_px(self) -> float:
        return (
            self.config.max_px if self.config.max_px_peak is None else min(self.config.max_px, self.config.max_px_peak)
        )

    def pace(self, t_ns: int) -> float:
        c, look = self.config, self.scene.motion.look(t_ns)
        pace = look.percentile(c.percentile) / c.max_px
        return pace if c.max_px_peak is None else max(pace, look.largest / c.max_px_peak)

    @property
    def notes(self) -> tuple[str, ...]:
        bodies = ", ".join(f"'{name}'" for name in dict.fromkeys(self.scene.motion.unbounded))
        unknown = f"the deformer of {bodies} has no timescale_ns, so steps are examined every timeline.min_step_us"
        return (*super().notes, *([unknown] if bodies else ()))


class Brightness(Timeline):
    """Steps in which the emulator's signal changes by a fraction of its threshold, and edges move by that many pixels:
    the signal changes there by all of the contrast within a pixel, also where the surfaces themselves have one colour
    and no rate."""

    @property
    def step_px(self) -> float:
        return self.config.max_fraction_of_threshold

    def pace(self, t_ns: int) -> float:
        c = self.config
        picture = self.scene.brightness(t_ns, c.sample_every).read()
        luminance, rate = picture[..., 0], picture[..., 1]
        seen = ranked(np.abs(self.response.change(luminance, rate)), c.percentile)
        moving = self.scene.velocity_of_movers(t_ns, c.sample_every)
        fastest = speeds_of_edges(moving, luminance, self.response)
        return max(seen.percentile / self.response.threshold, fastest) / c.max_fraction_of_threshold


_KINDS = {"uniform": Uniform, "displacement": Displacement, "brightness": Brightness}


def make_timeline(
    config: TimelineConfig,
    t0_ns: int,
    t1_ns: int,
    scene: Watched,
    response: Response,
    stops_ns: Sequence[int] = (),
    lights: Sequence[Changing] = (),
) -> Timeline:
    """Return the timeline of any ``timeline:`` configuration.   stops_ns : increasing; times of impacts, which adaptive
    kinds do not cross.   lights : see :class:`Timeline`."""
    return _KINDS[config.kind](config, t0_ns, t1_ns, scene, response, stops_ns, lights)


# ---------------------------------------------------------------------------------------------------------------------
# One timeline of several cameras: the strictest one decides the times.


class Shared(Timeline):
    """One of several timelines that share their times."""

    def __init__(self, own: Timeline, times: Iterator[int]):
        self._own, self._times = own, times
        super().__init__(own.config, own.t0_ns, own.t1_ns, own.scene, own.response, own.stops_ns)

    def __iter__(self) -> Iterator[int]:
        return self._times

    @property
    def notes(self) -> tuple[str, ...]:
        # The steps of all are counted by the timeline of the first.
        return self._own.notes


def together(timelines: Sequence[Timeline]) -> list[Timeline]:
    """Return one timeline per timeline, all with the same times; no step is longer than any of ``timelines`` (of one
    configuration) allows. A time is decided when the first of them requests it, and stored for the others. A single one
    is returned unchanged."""
    if len(timelines) < 2:
        return list(timelines)
    lead = timelines[0]
    # tee holds a time until every camera has taken it, so cameras may lag behind each other.
    lead.others = tuple(timelines[1:])
    return [Shared(own, times) for own, times in zip(timelines, itertools.tee(lead, len(timelines)), strict=True)]
