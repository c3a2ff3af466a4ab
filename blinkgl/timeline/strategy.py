"""The strategies of ``timeline:``: frame times that adapt to what is drawn.

timeline = make_timeline(config.timeline, t0_ns, t1_ns, renderer,
emulator_of(config.events).response(config.events)) for t_ns in timeline:
    luminance = ...                              # the frame at t_ns
timeline.info()                                  # what was achieved, for the manifest
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol

from blinkgl.config.timeline import TimelineConfig
from blinkgl.events.response import Response
from blinkgl.timeline.reductions import Drawn, changes, speeds
from blinkgl.timeline.sampling import bounded_times, uniform_times


class SmallPictures(Protocol):
    """What a timeline asks of a renderer: every n-th pixel in x and y."""

    def velocity_of_movers(self, t_ns: int, every: int) -> Drawn:
        """(h, w, 2) float32 image velocity, px/s of the whole image."""

    def brightness(self, t_ns: int, every: int) -> Drawn:
        """(h, w, 2) float32 luminance and its rate of change per second."""


class Timeline:
    """Iterates over frame times, int64 ns, from t0 to t1, both included, strictly increasing;
    each is decided when asked for. ``stops_ns``: times of impacts, that adaptive kinds do not step over."""

    def __init__(
        self,
        config: TimelineConfig,
        t0_ns: int,
        t1_ns: int,
        pictures: SmallPictures,
        response: Response,
        stops_ns: Sequence[int] = (),
    ):
        self.config, self.t0_ns, self.t1_ns, self.pictures, self.response = config, t0_ns, t1_ns, pictures, response
        self.stops_ns = stops_ns
        self.looks = 0
        """Small pictures asked for so far."""
        self.seen: dict[str, Any] = {}
        """What a first look at the sequence saw and made of it, for the manifest."""
        self.others: tuple[Timeline, ...] = ()
        """Of other cameras, whose pace is kept, too (:mod:`blinkgl.timeline.together`)."""

    def __iter__(self) -> Iterator[int]:
        c = self.config
        least, most = round(c.min_step_us * 1000), round(c.max_step_us * 1000)
        return bounded_times(self._counted, least, most, self.t0_ns, self.t1_ns, self.stops_ns)

    def pace(self, t_ns: int) -> float:
        """Steps per second that the scene asks for at one time."""
        raise NotImplementedError

    # The strictest camera decides.
    def _counted(self, t_ns: int) -> float:
        self.looks += 1
        return max([self.pace(t_ns), *(other.pace(t_ns) for other in self.others)])

    def info(self) -> dict[str, Any]:
        """What was achieved: plain values for the manifest."""
        return dict(self.seen)


class Uniform(Timeline):
    """``fps`` frames a second, whatever happens."""

    def __iter__(self) -> Iterator[int]:
        return uniform_times(self.config.fps, self.t0_ns, self.t1_ns)


class Displacement(Timeline):
    """Steps in which pixels move ``max_px``, by the image velocity of those that move."""

    def pace(self, t_ns: int) -> float:
        c = self.config
        seen = speeds(self.pictures.velocity_of_movers(t_ns, c.sample_every), c.percentile)
        pace = seen.percentile / c.max_px
        return pace if c.max_px_peak is None else max(pace, seen.largest / c.max_px_peak)


class Brightness(Timeline):
    """Steps in which the emulator's signal changes by a fraction of its threshold."""

    def pace(self, t_ns: int) -> float:
        c = self.config
        seen = changes(self.pictures.brightness(t_ns, c.sample_every), self.response, c.percentile)
        return seen.percentile / (c.max_fraction_of_threshold * self.response.threshold)


_KINDS = {"uniform": Uniform, "displacement": Displacement, "brightness": Brightness}


def make_timeline(
    config: TimelineConfig,
    t0_ns: int,
    t1_ns: int,
    pictures: SmallPictures,
    response: Response,
    stops_ns: Sequence[int] = (),
) -> Timeline:
    """Of any ``timeline:`` configuration.   stops_ns : increasing; times of impacts, that
    adaptive kinds do not step over."""
    return _KINDS[config.kind](config, t0_ns, t1_ns, pictures, response, stops_ns)
