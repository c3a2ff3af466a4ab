"""A part of a recording with its scene: the pixels and times of a calibration, the same for the camera's events and for
those that an emulator makes of the frames.

A clip may consist of some tiles of the sensor, stacked: pixels of emulators do not interact.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from scipy.ndimage import median_filter

from blinkgl.config.events import EmulatorConfig
from blinkgl.config.sensor import ReadoutConfig
from blinkgl.errors import EventDataError
from blinkgl.events.camera import EventCamera, EventFrame, emulate
from blinkgl.io.formats import open_events
from blinkgl.io.frames import FrameSource, open_frames
from blinkgl.io.reading import AS_FILE, NOTHING, Declared, EventReading
from blinkgl.recordings.bursts import frame_bursts, inside_any
from blinkgl.recordings.comparison import BLUR_PX, LOG_OFFSET, spanned
from blinkgl.recordings.decoding import UNKNOWN, Codes, OwnFrames, meaning
from blinkgl.recordings.frame_noise import DenoisedLight
from blinkgl.timeline.interpolate import Displacement, motion
from blinkgl.types.events import Events

TILE_PX = 32
SETTLING = 3
"""Intervals for which the first frame is shown before it counts, so that slow pixels reach a steady state."""
MOST_PIXEL_STEPS = 3_000_000
"""Largest number of pixels times frames of a clip, float32, for a fit in about a minute."""
STILL = 0.04
"""Largest change of ln(I + 10) between two frames, blurred by a pixel, of a pixel without a change."""
STUCK_TIMES, STUCK_LEAST = 4, 30
"""A stuck pixel has this many times the median of the 5x5 pixels around it, and this many events more."""
MOST_SATURATED = 0.3
LEAST_BRIGHT, LEAST_QUIET, ALIKE = 0.08, 0.05, 0.05
"""Luminance of pixels, and part of them, that can tell the gain of a frame, and how much their changes of ln I may
differ (median)."""
SAME_GAIN = 0.02
"""Change of ln below which there is no note."""
LEAP, LARGEST_THRESHOLD = 0.1, 2.0
"""Median change of ln I from one frame to the next from which on events have to say so, too, and the contrast that
they stand for at most."""
MOST_SHIFT_US = 100_000
LEAST_CORRELATION = 0.25
"""Of polarity sums with the frames' change: below, events and frames are of different scenes or clocks."""
DARK_BACKGROUND = 0.2
"""Luminance of the scene of a recording without frames: about the middle of the scale."""
_STILL_PARTS = 8


@dataclass(frozen=True, eq=False)
class Clip:
    """frames : what the emulator is shown, (t_ns, (h, w) float32 luminance), the warm-up first.   clock_us : (K + 1,)
    int64, the recorded frames' times.   edges_us : the same, but that the first interval begins with the first event
    and the last ends with the last.   events : the camera's of [edges_us[0], edges_us[-1]), on the clip's pixels.
    used : (h, w) bool, pixels that count.   still : (h, w) bool, those of them that saw no change.
    light : (h, w) uint8, eighth of the brightness, 0 the darkest.   change : (K, h, w) float32, of ln(I + 10).
    sensor : (height, width) of the camera.   share : of its pixels that are in the clip.
    bursts : (N, 2) int64 µs, of events that the camera's frames set off: what lies there counts, but not when.
    facts : what was found out on the way, by name.   gamma : curve of the frames' codes; None: there are no frames."""

    frames: list[tuple[int, np.ndarray]]
    clock_us: np.ndarray
    edges_us: np.ndarray
    events: Events
    used: np.ndarray
    still: np.ndarray
    light: np.ndarray
    change: np.ndarray
    sensor: tuple[int, int]
    share: float = 1.0
    bursts: np.ndarray = field(default_factory=lambda: np.empty((0, 2), np.int64))
    facts: dict[str, float] = field(default_factory=dict)
    gamma: str | float | None = None

    @property
    def size(self) -> tuple[int, int]:
        return self.used.shape

    @property
    def intervals(self) -> int:
        return len(self.edges_us) - 1

    def simulate(
        self, config: EmulatorConfig, seed: int = 0, *, stop: int | None = None, readout: ReadoutConfig | None = None
    ) -> Events:
        """Return an emulator's events in the first ``stop`` intervals (default: all), on the pixels that count."""
        stop = self.intervals if stop is None else stop
        end_ns = int(self.clock_us[stop]) * 1000
        shown = (EventFrame(t, luminance) for t, luminance in self.frames if t <= end_ns)
        camera = EventCamera(config, readout, *self.size, seed)
        chunks = [events for _, events in emulate(shown, camera)]
        events = Events.concatenate(chunks).window(int(self.edges_us[0]), int(self.edges_us[stop]))
        return events.part(self.used[events.y, events.x])

    def with_events(self, events: Events) -> Clip:
        """Return the same scene with other events."""
        return replace(self, events=events)


@dataclass(frozen=True)
class FrameReading:
    """How the frames beside a recording are interpreted.

    codes : what is known of their codes; grey ones of the sensor's size are its own, linear.   interpolate : between
    two frames, "motion" or "linear"; max_px : of motion, px per step.   delay_ms : of the frames' clock against the
    events'; None: estimated from both. exposures : whether their times are known to be the middles of exposures.   name
    : for messages."""

    codes: Codes = UNKNOWN
    interpolate: str = "motion"
    max_px: float = 1.0
    delay_ms: float | None = None
    exposures: bool = False
    name: str = "frames"


PLAIN = FrameReading()
"""A camera's own frames at times that are estimated."""


def clip_of_frames(
    events: Events,
    frames: Iterable[tuple[np.ndarray, int, str]],
    size: tuple[int, int],
    reading: FrameReading = PLAIN,
    *,
    most: int = MOST_PIXEL_STEPS,
    seed: int = 0,
) -> Clip:
    """Return the clip of a recording with frames.

    frames : (array, t_ns, name), at the middle of their exposures.   size : (height, width) of the events' sensor.
    Raises EventDataError: frames of another size, no common time, saturated frames, clocks that do not match."""
    grey, steady, clock, full, gamma = _greys(frames, size, reading)
    facts: dict[str, float] = {"saturated": float(full.mean())}
    full |= stuck_pixels(events, size)
    bursts = frame_bursts(events, float(np.median(np.diff(clock)))) if len(clock) > 1 else np.empty((0, 2), np.int64)
    if len(bursts):
        facts |= {"bursts": len(bursts), "in_bursts": float(inside_any(events.t, bursts).mean())}
    logs, change = _changes(grey)
    offset, correlation = clock_offset(events, change, clock, size)
    delay_us = _delay(offset, correlation, reading)
    facts |= {"delay_us": delay_us, "found_delay_us": offset, "delay_correlation": correlation}
    clock = clock + delay_us
    inside = _spanned(events, clock, reading.name)
    first, last = inside[0], inside[-1] + 1
    grey, clock = grey[first : last + 1], clock[first : last + 1]
    gains = _one_gain(grey, clock, ~full, events)
    kept = _without_leaps_at_the_ends(gains)
    if len(gains[kept]) < len(gains):
        facts["left_out"] = len(gains) - len(gains[kept])
    grey, clock, gains = grey[kept], clock[kept], gains[kept]
    if np.ptp(np.log(gains)) > SAME_GAIN:
        facts["gain"] = float(gains.max() / gains.min())
    grey = [(frame / np.float32(gain)) for frame, gain in zip(grey, gains)]
    logs, change = _changes(grey)
    grey = steady(grey)
    edges = clock.copy()
    edges[0], edges[-1] = max(clock[0], events.t[0]), min(clock[-1], events.t[-1] + 1)
    path = _path(grey, clock, reading, facts)
    still = np.abs(change).max(axis=0) < STILL
    mean = np.mean(logs, axis=0)
    # Seven quantiles divide the brightness into eighths.
    light = np.searchsorted(np.quantile(mean, np.arange(1, 8) / 8), mean).astype(np.uint8)
    tiles = Tiles(size, len(path), most, seed)
    return Clip(
        frames=[(t, tiles.cut(g)) for g, t in path],
        clock_us=clock,
        edges_us=edges,
        events=tiles.events(events.window(int(edges[0]), int(edges[-1])), ~full),
        used=tiles.cut(~full),
        still=tiles.cut(still & ~full),
        light=tiles.cut(light),
        change=tiles.cut(change),
        sensor=size,
        share=tiles.share,
        bursts=bursts,
        facts=facts,
        gamma=gamma,
    )


def _changes(grey: list[np.ndarray]) -> tuple[list[np.ndarray], np.ndarray]:
    """Return ln(I + 10) of the frames, blurred by a pixel, and (K, H, W) float32 from one to the next."""
    logs = [cv2.GaussianBlur(np.log(g.astype(np.float64) * 255 + LOG_OFFSET), (0, 0), BLUR_PX) for g in grey]
    return logs, np.diff(np.stack(logs), axis=0).astype(np.float32)


def _greys(
    frames: Iterable[tuple[np.ndarray, int, str]], size: tuple[int, int], reading: FrameReading
) -> tuple[list[np.ndarray], Callable[[list[np.ndarray]], list[np.ndarray]], np.ndarray, np.ndarray, str | float]:
    """Return the frames' luminance, the removal of their noise, their times in µs, (H, W) bool, pixels saturated in
    any frame, and the curve of their codes."""
    decode, steadied, white = None, None, None
    grey, times, full = [], [], np.zeros(size, bool)
    for frame, t_ns, name in frames:
        if frame.shape[:2] != size:
            raise EventDataError(
                "frames and recording have different sizes",
                where=reading.name,
                value=f"{frame.shape[1]}x{frame.shape[0]}",
                accepted=f"{size[1]}x{size[0]}, as its events",
            )
        if decode is None:
            codes = meaning(frame, replace(reading.codes, own=OwnFrames(size, "linear")))
            decode, white = codes.decode, codes.white
            if frame.dtype.kind == "u":
                # It takes luminance, of which no more than the distance of two codes is to be known.
                steadied = DenoisedLight(lambda light: light, decode.code_distance(frame.dtype))
        if frame.dtype.kind == "u":
            top = frame >= (white or np.iinfo(frame.dtype).max)
            full |= top.any(axis=2) if top.ndim == 3 else top
        grey.append(decode(frame, name))
        times.append(t_ns)
    if full.mean() > MOST_SATURATED:
        raise EventDataError(
            "too many pixels of the frames are saturated",
            where=reading.name,
            value=f"{100 * full.mean():.0f} %",
            accepted=f"at most {100 * MOST_SATURATED:.0f} % (a shorter exposure)",
        )

    def steady(lights: list[np.ndarray]) -> list[np.ndarray]:
        if steadied is None:
            return lights
        quiet = (steadied(light, light) for light in lights)
        return [light if values is None else values for light, values in zip(lights, quiet)]

    gamma = "linear" if decode is None else decode.gamma
    return grey, steady, np.array(times, np.int64) // 1000, full, gamma


def _delay(found_us: int, correlation: float, reading: FrameReading) -> int:
    """Return the offset of the frames' times, µs: the given one, or the estimated one where it is reliable."""
    if reading.delay_ms is not None:
        return round(reading.delay_ms * 1000)
    if not correlation >= LEAST_CORRELATION:
        raise EventDataError(
            "events and frames do not match: no clock offset within "
            f"{MOST_SHIFT_US // 1000} ms makes polarity sums follow the frames' change",
            where=reading.name,
            value=f"best correlation {correlation:.2f}",
            accepted=f"at least {LEAST_CORRELATION}, frames of the same scene, clock and orientation",
        )
    return found_us


def _spanned(events: Events, clock: np.ndarray, where: str) -> np.ndarray:
    """Return the indices of the intervals between frames that the events span."""
    inside = spanned(clock, int(events.t[0]), int(events.t[-1]) + 1)
    if len(inside) < 2:
        raise EventDataError(
            "the recording spans fewer than two intervals between frames",
            where=where,
            value=[tuple(round(int(t) / 1e6, 6) for t in (a[0], a[-1])) for a in (events.t, clock)],
            accepted="two or more, on one clock (seconds of events and of frames shown)",
        )
    return inside


def _path(
    grey: list[np.ndarray], clock: np.ndarray, reading: FrameReading, facts: dict[str, float]
) -> list[tuple[np.ndarray, int]]:
    """Return the emulator's input, (luminance, t_ns), the warm-up first; findings go to ``facts``."""
    path: list[tuple[np.ndarray, int]] = list(zip(grey, (clock * 1000).tolist()))
    if reading.interpolate == "motion":
        displacement = Displacement()
        path = [
            (g.astype(np.float32, copy=False), t) for g, t in motion(path, reading.max_px, displacement=displacement)
        ]
        facts |= {"displacement_px": displacement.p99, "inserted": displacement.inserted}
    # Before the first frame the pixels saw something else and have any state between their levels: another part of the
    # same picture, which changes into the first frame.
    height, width = grey[0].shape[:2]
    other = np.roll(grey[0], (height // 3, width // 3), (0, 1))
    begin, interval = int(clock[0]) * 1000, int(clock[1] - clock[0]) * 1000
    return [(other, begin - (SETTLING + 1) * interval), (path[0][0], begin - SETTLING * interval), *path]


def clip_of_still(events: Events, size: tuple[int, int]) -> Clip:
    """Return the clip of a recording of a static scene in constant light: only noise. Time is divided into
    eight parts."""
    begin, end = int(events.t[0]), int(events.t[-1]) + 1
    edges = begin + (end - begin) * np.arange(_STILL_PARTS + 1) // _STILL_PARTS
    frame = np.full(size, DARK_BACKGROUND, np.float32)
    path = [(frame, int(edges[0]) * 1000 - 1000), *((frame, int(t) * 1000) for t in edges)]
    everywhere = np.ones(size, bool)
    return Clip(
        frames=[(t, f) for f, t in path],
        clock_us=edges,
        edges_us=edges,
        events=events.window(begin, end),
        used=everywhere,
        still=everywhere,
        light=np.zeros(size, np.uint8),
        change=np.zeros((_STILL_PARTS, *size), np.float32),
        sensor=size,
    )


def _one_gain(grey: list[np.ndarray], clock_us: np.ndarray, used: np.ndarray, events: Events) -> np.ndarray:
    """Return divisors of the frames, (K + 1,), so that automatic changes of their camera's exposure or gain do not
    count as light: the brightness of pixels that fired in no interval stays constant.

    Where hardly any pixel was quiet all the time, those quiet from one frame to the next are used, for changes that the
    events contradict."""
    bright = used & (np.minimum.reduce(grey) > LEAST_BRIGHT)
    fired = [polarity_counts(events.window(int(a), int(b)), used.shape) for a, b in itertools.pairwise(clock_us)]
    quiet = bright & ~np.any([on + off > 0 for on, off in fired], axis=0)
    always = quiet.mean() >= LEAST_QUIET
    gains = [0.0]
    for k, (on, off) in enumerate(fired):
        here = quiet if always else bright & (on + off == 0)
        ratio = np.log(grey[k + 1][here] / grey[k][here]) if here.mean() >= LEAST_QUIET else np.zeros(1)
        middle = float(np.median(ratio))
        if float(np.median(np.abs(ratio - middle))) > max(ALIKE, 0.7 * abs(middle)):  # no common factor
            middle = 0.0
        # said: the contrast that the events stand for at most, in the direction of the change.
        change = np.sign(middle) * float((on - off)[used].mean()) * LARGEST_THRESHOLD
        changed = always or (abs(middle) > LEAP and change < abs(middle) / 2)
        gains.append(gains[-1] + (middle if changed else 0.0))
    return np.exp(gains)


def _without_leaps_at_the_ends(gains: np.ndarray) -> slice:
    """Return the frames between the first and the last interval without a leap: a camera's first exposures, before it
    has adapted, do not change dark and bright parts by one factor."""
    steady = np.flatnonzero(np.abs(np.diff(np.log(gains))) <= LEAP)
    # Intervals become frames, of which there is one more.
    return slice(int(steady[0]), int(steady[-1]) + 2) if len(steady) >= 2 else slice(None)


class Tiles:
    """The part of a sensor that fits into ``most`` pixels times frames: all of it, or random tiles, stacked. size :
    (height, width) of the sensor."""

    def __init__(self, size: tuple[int, int], frames: int, most: int = MOST_PIXEL_STEPS, seed: int = 0):
        self.size, self.share = size, 1.0
        self._corners: list[tuple[int, int]] = []
        # The number of each tile in the cut; -1: it is not there.
        self._place = np.zeros((size[0] // TILE_PX, size[1] // TILE_PX), np.int64)
        wanted = most // (frames * TILE_PX * TILE_PX)
        if frames * size[0] * size[1] <= most or wanted >= self._place.size:
            return
        chosen = np.sort(np.random.default_rng(seed).choice(self._place.size, max(wanted, 1), replace=False))
        self._place[...] = -1
        self._place.flat[chosen] = np.arange(len(chosen))
        columns = self._place.shape[1]
        self._corners = [(int(i) // columns * TILE_PX, int(i) % columns * TILE_PX) for i in chosen]
        self.share = len(chosen) * TILE_PX**2 / (size[0] * size[1])

    def cut(self, image: np.ndarray) -> np.ndarray:
        """Return the tiles that are judged, of (..., height, width), side by side; all of it where there are none."""
        if not self._corners:
            return image
        return np.concatenate([image[..., y : y + TILE_PX, x : x + TILE_PX] for y, x in self._corners], axis=-2)

    def events(self, events: Events, used: np.ndarray) -> Events:
        """Return the events on used pixels of ``used`` (height, width), with positions in the cut."""
        if not self._corners:
            return events.part(used[events.y, events.x])
        y, x = events.y.astype(np.int64), events.x.astype(np.int64)
        rows, columns = self._place.shape
        here = (y < rows * TILE_PX) & (x < columns * TILE_PX)
        here[here] = self._place[y[here] // TILE_PX, x[here] // TILE_PX] >= 0
        here &= used[events.y, events.x]
        # Tiles are stacked, so y counts on from tile to tile.
        tile = self._place[y[here] // TILE_PX, x[here] // TILE_PX]
        return Events(
            (x[here] % TILE_PX).astype(np.uint16), (tile * TILE_PX + y[here] % TILE_PX).astype(np.uint16),
            events.t[here], events.p[here],
        )  # fmt: skip


def clock_offset(events: Events, changes: np.ndarray, clock_us: np.ndarray, size: tuple[int, int]) -> tuple[int, float]:
    """Return the offset of the frames' times, µs, for which polarity sums best follow ``changes`` (K, H, W), of the
    frames' blurred logarithms, and the mean correlation over the intervals there; searched within ``MOST_SHIFT_US`` and
    three quarters of a frame interval."""
    pairs = list(range(len(clock_us) - 1))
    if not pairs:
        return 0, float("nan")
    reach = int(min(MOST_SHIFT_US, np.median(np.diff(clock_us)) * 0.75))
    at = lambda shifts: [_match(events, changes, clock_us + s, pairs, size) for s in shifts]
    coarse = np.linspace(-reach, reach, 25).astype(np.int64)
    values = np.array(at(coarse))
    if not np.isfinite(values).any():
        return 0, float("nan")
    best = int(coarse[np.nanargmax(values)])
    step = int(coarse[1] - coarse[0])
    fine = best + np.linspace(-step, step, 9).astype(np.int64)
    values = np.array(at(fine))
    k = int(np.nanargmax(values))
    if 0 < k < len(fine) - 1 and np.isfinite(values[k - 1 : k + 2]).all():
        # The top of the parabola through the best and its neighbours.
        a, b, c = values[k - 1 : k + 2]
        bend = a - 2 * b + c
        shift = 0.5 * (a - c) / bend if bend < 0 else 0.0
        return int(fine[k] + shift * (fine[1] - fine[0])), float(b)
    return int(fine[k]), float(values[k])


def _match(events: Events, changes: np.ndarray, clock_us: np.ndarray, pairs: list[int], size: tuple[int, int]) -> float:
    matches = []
    for k in pairs:
        if clock_us[k] < events.t[0] - 1000 or clock_us[k + 1] > events.t[-1] + 1000:
            continue
        part = events.window(int(clock_us[k]), int(clock_us[k + 1]))
        sums = polarity_sums(part, size)
        if sums.any() and np.ptp(changes[k]) > 0:  # frames without motion match nothing
            matches.append(np.corrcoef(cv2.GaussianBlur(sums, (0, 0), BLUR_PX).ravel(), changes[k].ravel())[0, 1])
    return float(np.mean(matches)) if matches else float("nan")


def stuck_pixels(events: Events, size: tuple[int, int]) -> np.ndarray:
    """Return pixels that fire many times as often as those around them, (H, W) bool. Their events do not depend on
    light (``readout.pixels`` models them), and two of them can dominate a correlation of counts."""
    where = events.pixel(size[1])
    count = np.bincount(where, minlength=size[0] * size[1]).reshape(size)
    return count > STUCK_TIMES * median_filter(count, 5, mode="nearest") + STUCK_LEAST


def polarity_sums(events: Events, size: tuple[int, int]) -> np.ndarray:
    """Return ON minus OFF events, (H, W) float64."""
    on, off = polarity_counts(events, size)
    return on - off


def polarity_counts(events: Events, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return ON and OFF events of the pixels, (H, W) float64 each."""
    where = events.pixel(size[1])
    count = lambda kind: np.bincount(where[events.p == kind], minlength=size[0] * size[1]).reshape(size).astype(float)
    return count(1), count(0)


def read_recording(
    path: str | os.PathLike, reading: EventReading = AS_FILE, *, least: int = 0
) -> tuple[Events, tuple[int, int], list[str]]:
    """Return all events of a file, the (height, width) of its sensor, and what was guessed or left out, a line each.
    Raises EventDataError: fewer than ``least``."""
    with open_events(path, reading) as file:
        file = file.sized()
        events = file.read()
    if len(events) < least:
        raise EventDataError(
            "too few events to estimate an emulator's parameters",
            where=str(path),
            value=len(events),
            accepted=f"{least:,} or more",
        )
    assert file.height is not None and file.width is not None
    return events, (file.height, file.width), file.notes


def timed_frames(path: str | os.PathLike, declared: Declared = NOTHING) -> tuple[FrameSource, bool]:
    """Return frames as :func:`~blinkgl.io.frames.open_frames` does, and whether their times are known to be the middles
    of exposures."""
    source = open_frames(path, declared)
    return source, source.origin == "camera" and declared.fps is None and declared.timestamps is None
