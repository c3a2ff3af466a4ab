"""Calibration: finds the parameters for which an emulator's events resemble a camera's, from one half of a recording in
time, and tests them on the other.

The method is that of simulated moments (McFadden, Econometrica 57, 1989): numbers of the recording
(:mod:`~blinkgl.recordings.statistics`) against those of a simulation, each difference divided by its standard deviation
by chance, least squares with a robust loss from several starts. Parameters that the data do not determine are not
fitted but left at their defaults, and named.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from blinkgl.config.events import EmulatorConfig
from blinkgl.errors import AssetError, ConfigError, EventDataError
from blinkgl.io.reading import AS_FILE, NOTHING, Damage, Declared, EventReading, refuse_without_frames
from blinkgl.recordings.clip import (
    PLAIN,
    Clip,
    FrameReading,
    clip_of_frames,
    clip_of_still,
    clock_offset,
    read_recording,
    timed_frames,
)
from blinkgl.recordings.search import Search
from blinkgl.recordings.simulation import INTERPOLATIONS, emulator_config
from blinkgl.recordings.statistics import GroupSums, correlation, interval_distance, sums
from blinkgl.types.events import Events
from blinkgl.types.trees import Tree

LEAST_EVENTS = 2000
_STILL = "A still scene of middle brightness was assumed: what depends on light, or its change, is not in it."


@dataclass(frozen=True)
class Judged:
    """A simulation against the recording in one half. Rates are over all pixels that count.

    interval_distance : Kolmogorov-Smirnov distance of the intervals between the events of a pixel.
    polarity_correlation : of polarity sums per interval, blurred by a pixel; NaN for a still scene.
    count_correlation : of the events of single pixels.   still_hz : rate of the pixels that saw no change, events per
    second and pixel; NaN where there are too few of them."""

    events: int
    recorded: int
    on_off: float
    recorded_on_off: float
    interval_distance: float
    polarity_correlation: float
    count_correlation: float
    still_hz: float
    recorded_still_hz: float

    @property
    def rate_ratio(self) -> float:
        return self.events / max(self.recorded, 1)


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of :func:`calibrate`.

    config : the fitted emulator; before : before the fit.   values, uncertainty : of the fitted keys (a standard
    deviation, in the key's unit).   undetermined : reason for each key that was not fitted.   halves : intervals of the
    fitted half, and of the other.
    judged_before, judged : one of each half.   simulated_before, simulated : events of the whole clip.   gamma : of the
    frames' codes; None: there were none.   warnings : weaknesses of the recording, though a fit was possible."""

    recording: str
    clip: Clip
    before: EmulatorConfig
    config: EmulatorConfig
    values: dict[str, float]
    uncertainty: dict[str, float]
    undetermined: dict[str, str]
    cost: float
    evaluations: int
    halves: tuple[tuple[int, int], tuple[int, int]]
    judged_before: tuple[Judged, Judged]
    judged: tuple[Judged, Judged]
    simulated_before: Events
    simulated: Events
    notes: list[str]
    gamma: str | float | None = None
    warnings: list[str] = field(default_factory=list)

    def sensor(self) -> Tree:
        """Return the table of a sensor file (:class:`~blinkgl.config.sensor.SensorConfig`)."""
        name, (height, width) = self.config.emulator, self.clip.sensor
        seconds = [(self.clip.edges_us[b] - self.clip.edges_us[a]) / 1e6 for a, b in self.halves]
        file = os.path.basename(self.recording)
        values = {k: v for k, v in self.config.model_dump(exclude_defaults=True).items() if k != "emulator"}
        return {
            "name": os.path.splitext(file)[0],
            "width": width,
            "height": height,
            **({} if self.gamma is None else {"frame_gamma": self.gamma}),
            "emulators": {name: {k: _short(v) for k, v in values.items()}},
            "sources": {
                f"emulators.{name}": f"blinkgl calibrate, fitted to the first {seconds[0]:.3g} s of {file}; in the "
                f"other {seconds[1]:.3g} s {self.judged[1].rate_ratio:.2f} of its events, intervals KS "
                f"{self.judged[1].interval_distance:.3f}",
                **{f"emulators.{name}.{key}": why for key, why in self.undetermined.items() if key in values},
            },
            "uncertainty": {f"emulators.{name}.{key}": _short(v, 2) for key, v in self.uncertainty.items()},
        }


def _short(value: object, digits: int = 4) -> object:
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value


def calibrate(
    recording: str | os.PathLike,
    frames: str | os.PathLike | None = None,
    reading: FrameReading = PLAIN,
    *,
    emulator: str | EmulatorConfig | dict = EmulatorConfig.default_member,
    fixed: Iterable[str] = (),
    still: bool = False,
    declared: Declared = NOTHING,
    starts: int = 3,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
    events: EventReading = AS_FILE,
) -> Calibration:
    """Fit an emulator to a recording.

    frames : of the scene, of the camera's size and at the middle of the exposures
    (:func:`~blinkgl.io.frames.open_frames`; default: the recording's own).   declared : what the user says of them;
    zero_time also counts events from the first.   reading : how they are interpreted.
    still : a static scene in constant light, without frames: only noise.
    emulator : a name, or the initial configuration; ``fixed``: keys that keep their values.
    starts : of the search.   progress : called with (current activity, fraction).   events : what is declared of the
    recording.

    Raises EventDataError, one line: no frames, frames of another size, saturated, not of this recording's time or
    clock; too few events. ConfigError: an emulator without parameters to fit, an unknown key, interpolation.
    AssetError: unreadable."""
    base = emulator_config(emulator)
    _keys(base, fixed)
    if still and frames is not None:
        raise ConfigError("a still scene needs no frames", where="--still", accepted="either of the two")
    if still:
        refuse_without_frames(declared, reading.codes.gamma, reading.delay_ms)
    if progress:
        progress("reading", 0.0)
    stream, size, notes = read_recording(recording, events, least=LEAST_EVENTS)
    pictures = None
    if not still:
        if frames is None:
            # The frames of the camera whose events are read.
            frames, declared = _own_frames(recording, events), replace(declared, stream=events.stream)
        source, exposures = timed_frames(frames, declared)
        pictures, notes = list(source), [*notes, *source.notes]
        codes = replace(reading.codes, white_level=declared.white_level, range=declared.range).of(source)
        reading = replace(reading, codes=codes, exposures=exposures, name=os.fspath(frames))
    if declared.zero_time:
        stream = replace(stream, t=stream.t - stream.t[0])
    search = dict(emulator=base, fixed=fixed, starts=starts, seed=seed, progress=progress)
    result = calibrate_events(stream, size, pictures, reading, name=os.fspath(recording), **search)
    return replace(result, notes=[*result.notes, *notes])


def calibrate_events(
    events: Events,
    size: tuple[int, int],
    frames: Sequence[tuple[np.ndarray, int, str]] | None,
    reading: FrameReading = PLAIN,
    *,
    name: str = "events",
    emulator: str | EmulatorConfig | dict = EmulatorConfig.default_member,
    fixed: Iterable[str] = (),
    starts: int = 3,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> Calibration:
    """Fit :func:`calibrate` to data already read. size : (height, width) of the sensor.   frames : (array, t_ns, name);
    None: a static scene."""
    base = emulator_config(emulator)
    keys = _keys(base, fixed)
    if reading.interpolate not in INTERPOLATIONS:
        raise ConfigError(
            "unknown interpolation", where="interpolate", value=reading.interpolate, accepted=", ".join(INTERPOLATIONS)
        )
    say = progress or (lambda *_: None)
    before: Search | None = None
    if frames is None:
        clip, notes, warnings = clip_of_still(events, size), [_STILL], []
    else:
        clip, before = _of_scene(events, frames, size, reading, base, keys, starts, seed, say)
        notes, warnings = _of_frames(clip, reading)
    # The first half is fitted, the second only judged: a fit must not see what it is judged by.
    half = (clip.intervals + 1) // 2
    halves = ((0, half), (half, clip.intervals))
    search = Search([(clip, half)], base, seed, lambda done: say("fitting", done))
    _fit(search, before, keys, starts)
    say("judging", 1.0)
    # Another seed than the search's, so that it is not judged by the noise that it has fitted.
    streams = [clip.simulate(one, seed + 1) for one in (base, search.config())]
    judged = [_judged(clip, stream, halves) for stream in streams]
    return Calibration(
        recording=name,
        clip=clip,
        before=base,
        config=search.config(),
        values=search.values(),
        uncertainty=search.uncertainty(),
        undetermined=search.undetermined,
        cost=search.cost,
        evaluations=search.evaluations,
        halves=halves,
        judged_before=judged[0],
        judged=judged[1],
        simulated_before=streams[0],
        simulated=streams[1],
        notes=notes,
        gamma=clip.gamma,
        warnings=warnings,
    )


def _fit(search: Search, before: Search | None, keys: list[str], starts: int) -> None:
    """Fit the keys, from where the search ``before`` ended; None: from the best of ``starts``."""
    if before is not None:
        search.undetermined.update(before.undetermined)
        keys, start = before.keys, before.place
    else:
        keys = search.responding(keys)
        start = search.roughly(keys, starts) if keys else np.empty(0)
    search.run(keys, start)


def _judged(clip: Clip, stream: Events, halves: tuple[tuple[int, int], tuple[int, int]]) -> tuple[Judged, Judged]:
    """Return the comparison of a simulation with the clip's own events, in each half."""

    def of(part: tuple[int, int]) -> Judged:
        own = sums(clip.events, clip, *part)
        return judge_half(own, sums(stream, clip, *part, own))

    return of(halves[0]), of(halves[1])


def _of_scene(
    events: Events,
    frames: Sequence[tuple[np.ndarray, int, str]],
    size: tuple[int, int],
    reading: FrameReading,
    base: EmulatorConfig,
    keys: list[str],
    starts: int,
    seed: int,
    say: Callable[[str, float], None],
) -> tuple[Clip, Search | None]:
    """Return the clip of the frames, and the search that found its clock; None where the clock is known."""
    clip = clip_of_frames(events, frames, size, reading, seed=seed)
    if reading.delay_ms is not None:
        return clip, None
    # The clock is found from the fitted half alone, like the parameters.
    search = Search([(clip, (clip.intervals + 1) // 2)], base, seed, lambda done: say("clock", done))
    search.roughly(search.responding(keys), starts)
    return _without_lag(clip, search, events, frames, size, reading, seed), search


def _without_lag(
    clip: Clip,
    search: Search,
    events: Events,
    frames: Sequence[tuple[np.ndarray, int, str]],
    size: tuple[int, int],
    reading: FrameReading,
    seed: int,
) -> Clip:
    """Return the clip on a clock without the emulator's own delay: levels are passed after the light begins to change,
    so an emulator's events are also later than the frames, and the clocks do not differ by that."""
    simulated = clip.simulate(search.config(), seed)
    lag_us, _ = clock_offset(simulated, clip.change, clip.clock_us, clip.size)
    found_us = round(clip.facts["found_delay_us"])
    again = clip_of_frames(events, frames, size, replace(reading, delay_ms=(found_us - lag_us) / 1000), seed=seed)
    again.facts["lag_us"], again.facts["found_delay_us"] = lag_us, found_us
    return again


def judge_half(recorded: GroupSums, simulated: GroupSums) -> Judged:
    """Return the comparison of ``simulated`` with ``recorded``; its products must be with ``recorded``."""
    # Of these lists 0 is the rates of moving pixels, 4 the events of still ones, 6 to 8 products, pixels and alike.
    own, other = recorded.without(None), simulated.without(None)
    total = lambda parts: parts[0].sum(axis=0) + parts[4]  # OFF, ON of those that moved and of those that did not
    a, b = total(own), total(other)
    products, pixels, alike = other[6:9]
    norm = np.sqrt(products[1] * products[2])
    # Fewer pixels than 400 say little about a rate of a fraction of a hertz.
    hz = lambda parts: float(parts[4].sum() / (pixels[1] * recorded.seconds.sum())) if pixels[1] >= 400 else np.nan
    return Judged(
        events=int(b.sum()),
        recorded=int(a.sum()),
        on_off=float(b[1] / max(b[0], 1)),
        recorded_on_off=float(a[1] / max(a[0], 1)),
        interval_distance=interval_distance(recorded, simulated),
        polarity_correlation=float(products[0] / norm) if norm > 0 else float("nan"),
        count_correlation=correlation(alike),
        still_hz=hz(other),
        recorded_still_hz=hz(own),
    )


def _keys(base: EmulatorConfig, fixed: Iterable[str]) -> list[str]:
    if not base.fitted:
        raise ConfigError("this emulator has no parameters to fit", where="emulator", value=base.emulator)
    fixed = set(fixed)
    if unknown := sorted(fixed - set(type(base).model_fields)):
        raise ConfigError("no such parameter", where="--set", value=unknown[0], accepted=", ".join(base.fitted))
    if "threshold_ratio" in fixed:
        raise ConfigError(
            "the two thresholds are fitted separately, not by their ratio",
            where="--set",
            value="threshold_ratio",
            accepted="contrast_threshold or contrast_threshold_off",
        )
    keys = [key for key in base.fitted if key not in fixed]
    if not keys:
        raise ConfigError("no parameter is left to fit", where="--set", value=sorted(fixed))
    return keys


def _own_frames(recording: str | os.PathLike, events: EventReading) -> str | os.PathLike:
    from blinkgl.io.formats import open_events

    try:
        with open_events(recording, events) as file:
            if next(iter(file.frames()), None) is not None:
                return recording
    except AssetError as error:
        # A format without frames is no error here: the message below says what to give.
        if isinstance(error, Damage) or "none is chosen" in error.problem or "needs the package" in error.problem:
            raise
    raise EventDataError(
        "the recording has no frames, and the scene cannot be estimated without them",
        where=os.fspath(recording),
        accepted="--frames, or --still for a static scene",
    )


def _of_frames(clip: Clip, reading: FrameReading) -> tuple[list[str], list[str]]:
    """Return notes and warnings about the frames."""
    facts, gap_ms = clip.facts, float(np.median(np.diff(clip.clock_us))) / 1000
    delay = f"{facts['found_delay_us'] / 1000:+.1f} ms (correlation {facts['delay_correlation']:.2f})"
    notes = [
        f"Clock: the polarity sums follow the frames best when {delay} is added to the frames' times; "
        + (
            f"the emulator's own events lag by {facts['lag_us'] / 1000:.1f} ms of it; {facts['delay_us'] / 1000:+.1f} "
            "ms taken."
            if reading.delay_ms is None
            else f"{reading.delay_ms:+g} ms was asked for and taken."
        )
        + (
            " The times were the middles of the exposures: what is left is the pixels' latency."
            if reading.exposures
            else " Whether the times were of the beginning or the middle of the exposures is not known: that is in it."
        ),
        f"Between frames {gap_ms:.1f} ms apart the light is "
        + (
            f"guessed along dense flow, over up to {facts['displacement_px']:.0f} px: times in an interval, and the "
            "parameters that live on them (the low-pass, the dead time), are as good as that guess."
            if reading.interpolate == "motion"
            else "taken to go in a straight line: what moved further than a pixel is wrong there."
        ),
    ]
    notes.append(
        f"The frames' codes were taken as `--gamma {clip.gamma}`; the sensor file tells `simulate`, which takes "
        "grey images of the sensor's size for the camera's own."
    )
    if "bursts" in facts:
        notes.append(
            f"{100 * facts['in_bursts']:.0f} % of the events come in {facts['bursts']:.0f} bursts of one polarity, all "
            "over the sensor, at the frames' interval: the camera's frames set them off, not light. What lies "
            "there is not compared."
        )
    if "left_out" in facts:
        notes.append(
            f"{facts['left_out']} frames at the ends were left out: the picture as a whole leaps there, and no event "
            "says so, so the exposure of the frames was changed."
        )
    if "gain" in facts:
        notes.append(
            f"The frames as a whole become brighter or darker by a factor of {facts['gain']:.3g} where no event says "
            "so: that is their exposure or gain, and was taken out."
        )
    if facts["saturated"] > 0:
        notes.append(f"{100 * facts['saturated']:.1f} % of the pixels were saturated in a frame and are left out.")
    if clip.share < 1:
        notes.append(f"{100 * clip.share:.0f} % of the sensor's pixels were looked at, in tiles drawn at random.")
    if reading.exposures or reading.delay_ms is not None:
        return notes, []
    warning = (
        f"{reading.name}: frames without exposure times: the offset of {facts['delay_us'] / 1000:+.1f} ms found from "
        "the events has whatever lies between their time stamps and the middles of their exposures"
    )
    return notes, [warning]
