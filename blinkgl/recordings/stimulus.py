"""Scenes that are known without frames, because a person has made them so: even light that flickers, or straight
borders of two tones that move. What is not known of them (frequency and phase; direction, speed, places and width) is
found from the events, and a clip is drawn of it for a calibration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np
from scipy.special import ndtr

from blinkgl.errors import EventDataError
from blinkgl.recordings.clip import MOST_PIXEL_STEPS, STILL, Clip, Tiles
from blinkgl.recordings.comparison import LOG_OFFSET
from blinkgl.types.events import Events

MIDDLE = 0.4
"""Luminance between the darkest and the brightest."""
LEAST_FLICKER = 0.2
"""Share of the polarity that goes with the light; of a square wave's events it is 0.64, of random ones 0."""
LEAST_HALF_PERIODS, MOST_HALF_PERIODS, MOST_PERIODS = 8, 48, 200
FLICKER_STEPS = 64
"""Frames per period."""
LEAST_EXPLAINED = 0.5
"""Share of the events that belong to a border."""
WIDEST_PX = 8.0
"""Of a border, one standard deviation: more is no border that goes straight on, but something else."""
EDGE_STEP_PX, MOST_EDGE_FRAMES = 0.25, 4000
_EDGE_INTERVALS = 16
_SOUGHT = 10_000
"""Events of which the motion is found."""
_COARSEST, _STEPS = 24, 17
_SETTLED = 3
_WARM = 1.5
"""Luminances that a pixel saw at first, as a logarithm to either side: so far apart that chance alone says where in a
threshold it stands."""


class Stimulus(Protocol):
    """What a calibration asks of such a scene."""

    option: ClassVar[str]
    """of the command line, which messages name"""

    def clip(self, events: Events, size: tuple[int, int], *, where: str = ..., seed: int = ...) -> Clip:
        """Drawn of what the events say of it. EventDataError: they do not say it."""

    def settled(
        self, events: Events, size: tuple[int, int], clip: Clip, simulate: Callable[[Clip], Events], *, seed: int = ...
    ) -> Clip:
        """The clip again, without what an emulator's own events do to what was found of the camera's.

        simulate : an emulator that is roughly the camera, events of a clip."""

    def said(self, clip: Clip) -> str:
        """What was assumed, and found."""


@dataclass(frozen=True)
class Flicker:
    """Light whose luminance goes as m (1 + contrast sin) everywhere in the picture, ``hz`` times a second. Frequency
    (within 2 %) and phase are found from the events; intervals are its half periods."""

    hz: float
    contrast: float
    option: ClassVar[str] = "--flicker"

    def clip(
        self,
        events: Events,
        size: tuple[int, int],
        *,
        lag_us: int = 0,
        luminance: float = MIDDLE,
        where: str = "--flicker",
        most: int = MOST_PIXEL_STEPS,
        seed: int = 0,
    ) -> Clip:
        """lag_us : by which events come after the light.   luminance : m.   Raises EventDataError: events that do not
        go with the light, fewer than four periods."""
        hz, begin_us, share = _flicker_of(events, self.hz)
        if share < LEAST_FLICKER:
            raise EventDataError(
                "the events do not go up and down with the light",
                where=where,
                value=f"{hz:.6g} Hz, {share:.2f} of the polarity",
                accepted=f"at least {LEAST_FLICKER}: an even scene, and the light's own frequency within 2 %",
            )
        half_us = 5e5 / hz
        # Half periods begin where the light is darkest, a quarter of a period before its rise is steepest, or where it
        # is brightest.
        origin = begin_us - lag_us - half_us / 2
        first = int(np.ceil((events.t[0] - origin) / half_us))
        stop = int(np.floor((events.t[-1] + 1 - origin) / half_us))
        if stop - first < LEAST_HALF_PERIODS:
            raise EventDataError(
                "the recording spans too few periods of the light",
                where=where,
                value=max(stop - first, 0) / 2,
                accepted=f"{LEAST_HALF_PERIODS // 2} or more whole ones",
            )
        stop = min(stop, first + MOST_HALF_PERIODS)
        edges = np.round(origin + half_us * np.arange(first, stop + 1)).astype(np.int64)
        count = len(edges) - 1
        step_us = 2 * half_us / FLICKER_STEPS
        warm = 2 * FLICKER_STEPS  # two periods, after which a pixel stands anywhere between its levels
        at = edges[0] + step_us * np.arange(-warm, count * FLICKER_STEPS // 2 + 1)
        light = luminance * (1 + self.contrast * np.sin(np.pi * ((at - origin) / half_us - 0.5)))
        tiles = Tiles(size, len(at), most, seed)
        used = tiles.cut(np.ones(size, bool))
        up = np.log((luminance * (1 + self.contrast) * 255 + LOG_OFFSET)
                    / (luminance * (1 - self.contrast) * 255 + LOG_OFFSET))  # fmt: skip
        sign = np.where((first + np.arange(count)) % 2 == 0, up, -up).astype(np.float32)
        return Clip(
            [(int(1000 * t), np.broadcast_to(np.float32(v), used.shape)) for v, t in zip(light, at)],
            edges,
            edges,
            tiles.events(events.window(int(edges[0]), int(edges[-1])), np.ones(size, bool)),
            used,
            np.zeros_like(used),
            np.zeros(used.shape, np.uint8),
            np.broadcast_to(sign[:, None, None], (count, *used.shape)),
            size,
            tiles.share,
            facts={"flicker_hz": hz, "flicker_share": share, "lag_us": lag_us},
        )

    def settled(
        self, events: Events, size: tuple[int, int], clip: Clip, simulate: Callable[[Clip], Events], *, seed: int = 0
    ) -> Clip:
        return self.clip(events, size, lag_us=flicker_lag(simulate(clip), clip), seed=seed)

    def said(self, clip: Clip) -> str:
        return (
            f"Light of {clip.facts['flicker_hz']:.6g} Hz (asked: {self.hz:g}) and contrast {self.contrast:g} was "
            f"assumed, everywhere and of middle brightness; {100 * clip.facts['flicker_share']:.0f} % of the polarity "
            f"goes with it, and the emulator's events come {clip.facts['lag_us'] / 1000:.2f} ms after it."
        )


def flicker_lag(simulated: Events, clip: Clip) -> int:
    """By how many µs an emulator's events of such a clip come after the light."""
    hz = clip.facts["flicker_hz"]
    # Steepest at the middle of the first half period of those that rise.
    turned = np.exp(-2j * np.pi * hz * 1e-6 * (simulated.t - clip.edges_us[0])) @ (2.0 * simulated.p - 1)
    rising = 0.25 if clip.change[0].flat[0] > 0 else 0.75
    late = (-np.angle(turned) / (2 * np.pi) - rising + 0.5) % 1.0 - 0.5
    return round(1e6 * late / hz)


def _flicker_of(events: Events, hz: float) -> tuple[float, float, float]:
    """(Hz, µs at which the polarity's wave is highest, its share of the polarity)."""
    part = events.window(int(events.t[0]), int(events.t[0] + 1e6 * MOST_PERIODS / hz) + 1)
    t, p = (part.t - part.t[0]) * 1e-6, 2.0 * part.p - 1
    seconds = max(float(t[-1]), 1e-6)
    wave, edges = np.histogram(t, bins=max(int(seconds * hz * 64), 64), range=(0, seconds), weights=p)
    middle = (edges[1:] + edges[:-1]) / 2
    tried = np.linspace(0.98 * hz, 1.02 * hz, max(int(0.4 * hz * seconds), 21))  # ten of them in a line of the spectrum
    found = np.array([np.abs(np.exp(-2j * np.pi * f * middle) @ wave) for f in tried])
    best = float(tried[int(np.argmax(found))])
    turned = np.exp(-2j * np.pi * best * t) @ p
    return best, float(events.t[0] - np.angle(turned) / (2 * np.pi * best) * 1e6), float(np.abs(turned) / len(p))


@dataclass(frozen=True, eq=False)
class Borders:
    """Straight parallel borders that move on at constant speed.

    slowness : (2,) µs per px in x and y: a border is at pixel (x, y) at its time plus slowness . (x, y).
    times_us : (N,) float64, when each is at pixel (0, 0); increasing.   rises : whether it brightens, in turns.
    width_us : (N,) standard deviation of the change, as a normal law's.   explained : share of the events."""

    slowness: np.ndarray
    times_us: np.ndarray
    rises: np.ndarray
    width_us: float
    explained: float

    @property
    def us_per_px(self) -> float:
        return float(np.hypot(*self.slowness))

    @property
    def width_px(self) -> float:
        return self.width_us / self.us_per_px

    def delay_us(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """By which pixel (x, y) sees what (0, 0) does."""
        return self.slowness[0] * x + self.slowness[1] * y

    def light(self, tau_us: np.ndarray, contrast: float, luminance: float = MIDDLE) -> np.ndarray:
        """Luminance at times less delays."""
        sign = np.where(self.rises, 1.0, -1.0)
        level = np.full(np.shape(tau_us), -sign[0])
        for t, s in zip(self.times_us, sign):
            level += 2 * s * ndtr((tau_us - t) / self.width_us)
        return luminance * (1 + contrast * level)


@dataclass(frozen=True)
class Edge:
    """Straight borders between a dark and a bright surface, drawn past the camera at constant speed: the edge of a
    sheet, a bar, a grating. Direction, speed, times and width are found from the events.

    contrast : (bright - dark)/(bright + dark).   width_px : of a border as the lens shows it, one standard deviation;
    None: found, so that an emulator's events are as far apart as the camera's."""

    contrast: float
    width_px: float | None = None
    option: ClassVar[str] = "--edge"

    def clip(
        self,
        events: Events,
        size: tuple[int, int],
        *,
        borders: Borders | None = None,
        where: str = "--edge",
        most: int = MOST_PIXEL_STEPS,
        seed: int = 0,
    ) -> Clip:
        """borders : as :func:`find_borders` gives them; None: found.   Raises EventDataError: see there."""
        if borders is None:
            borders = self._of_light(find_borders(events, where))
        yx = np.indices(size)
        delay = borders.delay_us(yx[1], yx[0])
        reach = 4 * borders.width_us
        begin = max(int(events.t[0]), int(borders.times_us[0] + delay.min() - reach))
        end = min(int(events.t[-1]) + 1, int(borders.times_us[-1] + delay.max() + reach))
        step_us = EDGE_STEP_PX * borders.us_per_px
        end = min(end, int(begin + step_us * MOST_EDGE_FRAMES))
        inside = events.window(begin, end)
        if len(inside) < _EDGE_INTERVALS:
            raise EventDataError("too few events at the borders", where=where, value=len(inside), accepted="thousands")
        # As many events in each, so that either half has some.
        edges = np.unique(np.r_[begin, inside.t[np.arange(1, _EDGE_INTERVALS) * len(inside) // _EDGE_INTERVALS], end])
        if len(edges) < 5:
            raise EventDataError("the recording is too short", where=where, value=f"{end - begin} µs")
        at = np.unique(np.r_[np.arange(begin, end, step_us), edges])
        tiles = Tiles(size, len(at) + 2, most, seed)
        delay, everywhere = tiles.cut(delay), np.ones(size, bool)
        shown = lambda t: borders.light(t - delay, self.contrast).astype(np.float32)
        logs = np.stack([np.log(255.0 * shown(t) + LOG_OFFSET) for t in edges])
        change = np.diff(logs, axis=0).astype(np.float32)
        # A border may come and go again within an interval, so that it is not the changes that say who saw one.
        passes = (borders.times_us + delay[..., None] > begin) & (borders.times_us + delay[..., None] < end)
        still = ~passes.any(axis=-1) & (np.abs(change).max(axis=0) < STILL)
        # Before it all anything, then such a border as comes next, gone by the other way.
        anything = np.exp(np.random.default_rng(seed).uniform(-_WARM, _WARM, delay.shape))
        other = np.full(delay.shape, MIDDLE * (1 + (self.contrast if borders.rises[0] else -self.contrast)))
        warm = round(1e5 * step_us)
        used = tiles.cut(everywhere)
        return Clip(
            [
                (1000 * begin - 2 * warm, (MIDDLE * anything).astype(np.float32)),
                (1000 * begin - warm, other.astype(np.float32)),
                *((round(1000 * t), shown(t)) for t in at),
            ],
            edges,
            edges,
            tiles.events(inside, everywhere),
            used,
            still & used,
            np.zeros(used.shape, np.uint8),
            change,
            size,
            tiles.share,
            facts={
                "borders": len(borders.times_us),
                "explained": borders.explained,
                "px_per_s": 1e6 / borders.us_per_px,
                "direction_deg": float(np.degrees(np.arctan2(borders.slowness[1], borders.slowness[0]))),
                "width_px": float(borders.width_px),
            },
        )

    def settled(
        self, events: Events, size: tuple[int, int], clip: Clip, simulate: Callable[[Clip], Events], *, seed: int = 0
    ) -> Clip:
        borders = self._of_light(find_borders(events))
        for _ in range(_SETTLED):
            clip = self.clip(events, size, borders=borders, seed=seed)
            yx = np.indices(size)
            delay = Tiles(size, len(clip.frames), seed=seed).cut(borders.delay_us(yx[1], yx[0]))
            own, others = (_around(one, delay, borders) for one in (clip.events, simulate(clip)))
            if own is None or others is None:
                break
            late, wider = np.mean(own[0] - others[0]), own[1] / others[1]
            width = borders.width_us if self.width_px else borders.width_us * float(np.clip(wider, 0.5, 2.0))
            borders = replace(borders, times_us=borders.times_us + late, width_us=width)
        return self.clip(events, size, borders=borders, seed=seed)

    def said(self, clip: Clip) -> str:
        facts = clip.facts
        found = "was given" if self.width_px else "was found from how far apart a pixel's events are"
        return (
            f"{facts['borders']:.0f} straight borders of contrast {self.contrast:g} and middle brightness were "
            f"assumed, and {100 * facts['explained']:.0f} % of the events belong to one. They move at "
            f"{facts['px_per_s']:.4g} px/s towards {facts['direction_deg']:+.1f}° (0 is to the right, 90 down). Their "
            f"width, {facts['width_px']:.2g} px, {found}: parameters that live on times, such as a low-pass or a dead "
            "time, are as good as that; thresholds do not need it."
        )

    def _of_light(self, events: Borders) -> Borders:
        """From where events lie to where light changes: levels are passed evenly in the logarithm, so earlier than the
        middle of the light where that rises, and later where it falls."""
        c = self.contrast
        u = np.linspace(-6, 6, 2401)
        passed = np.log1p(2 * c * ndtr(u) / (1 - c)) / np.log((1 + c) / (1 - c))
        low, middle, high = np.interp(_QUANTILES, passed, u)
        width = self.width_px * events.us_per_px if self.width_px else events.width_us / (0.5 * (high - low))
        return replace(
            events, times_us=events.times_us - np.where(events.rises, middle, -middle) * width, width_us=width
        )


_QUANTILES = (0.16, 0.5, 0.84)


def find_borders(events: Events, where: str = "--edge") -> Borders:
    """The borders that events show: ``times_us`` is the middle of a border's events, ``width_us`` half of what the
    middle 68 % of them take.

    The motion is that with which events, moved back along it, lie closest together (contrast maximisation, Gallego et
    al., CVPR 2018, of the times), then a line through those of each border. Raises EventDataError: what is no border
    that goes straight on, or borders that do not take turns."""
    begin = int(events.t[0])
    t, x, y = (events.t - begin).astype(np.float64), events.x.astype(np.float64), events.y.astype(np.float64)
    on = events.p.astype(bool)
    some = np.sort(np.random.default_rng(0).permutation(len(t))[:_SOUGHT])
    slowness = _motion(t[some], x[some], y[some], on[some])
    for _ in range(3):
        found = _peaks(t - slowness[0] * x - slowness[1] * y, on, float(np.hypot(*slowness)))
        if found:
            slowness = _through(t, x, y, [rows for _, rows in found])
    pace = float(np.hypot(*slowness))
    tau = t - slowness[0] * x - slowness[1] * y
    found = _peaks(tau, on, pace) if pace > 0 else []
    explained = sum(len(rows) for _, rows in found) / len(t)
    middle = np.array([np.median(tau[rows]) for _, rows in found])
    spread = [np.diff(np.quantile(tau[rows], _QUANTILES[::2]))[0] / 2 for _, rows in found]
    width = float(np.median(spread)) if found else 0.0
    if not found or explained < LEAST_EXPLAINED or width > WIDEST_PX * pace:
        told = "no border" if not found else f"{width / pace:.2g} px wide, {100 * explained:.0f} % of the events"
        raise EventDataError(
            "the events are not those of straight borders that move on at constant speed",
            where=where,
            value=told,
            accepted=f"at most {WIDEST_PX:g} px, at least {100 * LEAST_EXPLAINED:.0f} %",
        )
    rises = np.array([rises for rises, _ in found])
    if (rises[1:] == rises[:-1]).any():
        raise EventDataError(
            "two borders in a row both brighten, or both darken, which two tones cannot",
            where=where,
            value=" ".join("ON" if r else "OFF" for r in rises),
            accepted="ON and OFF in turns",
        )
    return Borders(np.asarray(slowness), middle + begin, rises, max(width, 1.0), explained)


def _through(t: np.ndarray, x: np.ndarray, y: np.ndarray, borders: list[np.ndarray]) -> np.ndarray:
    """(2,) slowness of t = T_j + slowness . (x, y) through the events of all borders, least squares."""
    rows = np.concatenate(borders)
    index = np.repeat(np.arange(len(borders)), [len(one) for one in borders])
    count = np.bincount(index)
    less_mean = lambda v: v[rows] - (np.bincount(index, v[rows]) / count)[index]
    found, *_ = np.linalg.lstsq(np.stack([less_mean(x), less_mean(y)], 1), less_mean(t), rcond=None)
    return found


def _motion(t: np.ndarray, x: np.ndarray, y: np.ndarray, on: np.ndarray) -> np.ndarray:
    """(2,) µs per px, roughly: by finer and finer bins of time."""
    span, reach = max(float(np.ptp(t)), 1.0), max(float(np.ptp(x)), float(np.ptp(y)), 8.0)

    def gathered(a: float, b: float, bin_us: float, step: int) -> float:
        tau = t[::step] - a * x[::step] - b * y[::step]
        place = ((tau - tau.min()) / bin_us).astype(np.int64)
        return float(sum((np.bincount(place[of]) ** 2).sum() for of in (on[::step], ~on[::step]) if of.any()))

    bin_us = span / _COARSEST
    step = max(len(t) // 1500, 1)
    # A border that crosses but a third of the picture is the slowest.
    grid = np.arange(-3 * span / reach, 3 * span / reach + 1e-9, 1.5 * bin_us / reach)
    best = sorted(((gathered(a, b, bin_us, step), a, b) for a in grid for b in grid), reverse=True)[:12]
    places = [(a, b) for _, a, b in best]
    for _ in range(_STEPS):
        spacing, bin_us = bin_us / reach, bin_us / 2
        around = {(a + i * spacing, b + j * spacing) for a, b in places for i in (-1, 0, 1) for j in (-1, 0, 1)}
        ranked = sorted(((gathered(a, b, bin_us, 1), a, b) for a, b in around), reverse=True)
        places = [(a, b) for _, a, b in ranked[: max(len(places) // 2, 2)]]
        if bin_us < max(float(np.hypot(*places[0])), span / 4000):  # a pixel: a line through the events does the rest
            break
    return np.array(places[0])


def _peaks(tau: np.ndarray, on: np.ndarray, us_per_px: float) -> list[tuple[bool, np.ndarray]]:
    """(whether it brightens, its events' numbers) of each border, in order of time."""
    if us_per_px <= 0:
        return []
    bin_us = max(us_per_px / 2, float(np.ptp(tau)) / 100_000, 1e-3)
    place = ((tau - tau.min()) / bin_us).astype(np.int64)
    length = int(place.max()) + 1
    found = []
    for rises in (False, True):
        count = np.bincount(place[on == rises], minlength=length).astype(float)
        smooth = np.convolve(count, np.hanning(7) / np.hanning(7).sum(), "same")
        background = float(np.median(smooth))
        high = smooth > background + 0.1 * (smooth.max() - background)
        ends = np.flatnonzero(np.diff(np.r_[False, high, False].astype(int)))
        for a, b in _joined(ends.reshape(-1, 2)):
            middle, half = (a + b) / 2, (b - a) / 2 + 2
            rows = np.flatnonzero((on == rises) & (np.abs(place - middle) <= 1.5 * half))
            if count[a:b].sum() >= 0.02 * len(tau):
                found.append((float(np.median(tau[rows])), rises, rows))
    return [(rises, rows) for _, rises, rows in sorted(found, key=lambda one: one[0])]


def _joined(spans: np.ndarray) -> Iterator[tuple[int, int]]:
    """Stretches with less than three bins between them as one."""
    last: list[int] = []
    for a, b in spans.tolist():
        if last and a - last[1] < 3:
            last[1] = b
            continue
        if last:
            yield last[0], last[1]
        last = [a, b]
    if last:
        yield last[0], last[1]


def _around(events: Events, delay: np.ndarray, borders: Borders) -> tuple[np.ndarray, float] | None:
    """((N,) middles of the events of each border, half of what the middle 68 % of them take), µs, less delays."""
    tau = events.t - delay[events.y, events.x]
    middles, spreads = [], []
    for t, rises in zip(borders.times_us, borders.rises):
        here = tau[(events.p == rises) & (np.abs(tau - t) < 6 * borders.width_us)]
        if len(here) < 50:
            continue
        low, middle, high = np.quantile(here, _QUANTILES)
        middles.append(middle - t)
        spreads.append((high - low) / 2)
    return (np.array(middles), float(np.mean(spreads))) if middles and np.mean(spreads) > 0 else None
