"""The parameters with which an emulator's events are like a camera's: found from one half of a recording in time,
judged by the other.

The method is that of simulated moments (McFadden, Econometrica 57, 1989): numbers of the recording
(:mod:`~blinkgl.recordings.statistics`) against the same of a simulation, each difference divided by what it may be by
chance, least squares with a robust loss from several starts. What the data say nothing about is not fitted but left at
its default, and named.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.stats import qmc

from blinkgl.config.events import EmulatorConfig
from blinkgl.errors import AssetError, ConfigError, EventDataError
from blinkgl.recordings.clip import (
    Clip,
    clip_of_frames,
    clip_of_still,
    clock_offset,
    read_recording,
    timed_frames,
)
from blinkgl.recordings.simulation import INTERPOLATIONS, emulator_config
from blinkgl.recordings.statistics import Sums, Target, interval_distance, sums, target
from blinkgl.types.events import Events

LEAST_EVENTS = 2000
TRIED = 64
"""Settings drawn over the whole room of the parameters, of which the best are started from."""
STEP = 0.05
"""Of a parameter's logarithm, for derivatives: far above the jumps of single events."""
UNTOLD = 0.5
"""Standard deviation of a parameter's logarithm from which on the data are taken not to tell it."""
VAGUE = 0.25
"""From which on other places are tried, too."""
LEAST_CHANCE = 0.05
"""Of a number's error, where chance is known at all."""
TOLERANCE = 0.5
"""How much worse the fit may become by putting a parameter that is not told back to its default."""
_MOST_STEPS = 20
_FEW_STEPS, _PLACES = 3, 6
_DAMPINGS = (1e-3, 0.1, 3.0)
_FARTHEST = 1.0
_WORTH = 0.2
"""How much worse than the best a place may be, with derivatives from elsewhere, to be worth a descent."""
_EACH = 3
"""Places for a start, from which a few steps are tried."""
_LITTLE = 0.03
"""Part of the cost below which a step with corrected derivatives asks for new ones."""


@dataclass(frozen=True)
class Judged:
    """A simulation against the recording in one half. Rates are of all pixels that count."""

    events: int
    recorded: int
    on_off: float
    recorded_on_off: float
    interval_distance: float
    """Kolmogorov and Smirnov's, of the intervals between the events of a pixel"""
    polarity_correlation: float
    """of polarity sums per interval, blurred by a pixel; NaN for a still scene"""
    still_hz: float
    """of the pixels that saw no change, events per second and pixel; NaN where there are too few of them"""
    recorded_still_hz: float

    @property
    def rate_ratio(self) -> float:
        return self.events / max(self.recorded, 1)


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of :func:`calibrate`.

    config : the emulator as fitted; before : as it was.   values, uncertainty : of the fitted keys (a standard
    deviation, in the key's unit).   untold : why the others were not fitted, by key.   halves : intervals of the half
    that was fitted, and of that which was not.   judged_before, judged : one of each half.   simulated_before,
    simulated : events of the whole clip.   warnings : what the recording lacks, though a fit was possible."""

    recording: str
    clip: Clip
    before: EmulatorConfig
    config: EmulatorConfig
    values: dict[str, float]
    uncertainty: dict[str, float]
    untold: dict[str, str]
    cost: float
    evaluations: int
    halves: tuple[tuple[int, int], tuple[int, int]]
    judged_before: tuple[Judged, Judged]
    judged: tuple[Judged, Judged]
    simulated_before: Events
    simulated: Events
    notes: list[str]
    warnings: list[str] = field(default_factory=list)

    def sensor(self) -> dict[str, Any]:
        """The table of a sensor file (:class:`~blinkgl.config.sensor.SensorConfig`)."""
        name, (height, width) = self.config.emulator, self.clip.sensor
        seconds = [(self.clip.edges_us[b] - self.clip.edges_us[a]) / 1e6 for a, b in self.halves]
        file = os.path.basename(self.recording)
        told = {k: v for k, v in self.config.model_dump(exclude_defaults=True).items() if k != "emulator"}
        return {
            "name": os.path.splitext(file)[0],
            "width": width,
            "height": height,
            "emulators": {name: {k: _short(v) for k, v in told.items()}},
            "sources": {
                f"emulators.{name}": f"blinkgl calibrate, fitted to the first {seconds[0]:.3g} s of {file}; in the "
                f"other {seconds[1]:.3g} s {self.judged[1].rate_ratio:.2f} of its events, intervals KS "
                f"{self.judged[1].interval_distance:.3f}",
                **{f"emulators.{name}.{key}": why for key, why in self.untold.items() if key in told},
            },
            "uncertainty": {f"emulators.{name}.{key}": _short(v, 2) for key, v in self.uncertainty.items()},
        }


def _short(value: Any, digits: int = 4) -> Any:
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value


def calibrate(
    recording: str | os.PathLike,
    frames: str | os.PathLike | None = None,
    *,
    emulator: str | EmulatorConfig | dict = EmulatorConfig.members.default,
    fixed: Iterable[str] = (),
    still: bool = False,
    fps: float | None = None,
    timestamps: str | os.PathLike | None = None,
    gamma: str | float = "linear",
    interpolate: str = "motion",
    max_px: float = 1.0,
    frame_delay_ms: float | None = None,
    starts: int = 3,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> Calibration:
    """Fits an emulator to a recording.

    frames : what the camera saw, of its size and at the middle of the exposures
    (:func:`~blinkgl.io.frames.open_frames`; default: the recording's own).   still : a scene that stands still in
    constant light, without frames: noise alone.
    emulator : a name, or where the fit begins; ``fixed``: keys that stay as they are there.
    gamma, interpolate, max_px : as of ``simulate``.   frame_delay_ms : added to the frames' times; None: found.
    starts : of the search.   progress : called with (what is being done, fraction).

    Raises EventDataError, one line: no frames, frames of another size, saturated, not of this recording's time or
    clock; too few events. ConfigError: an emulator that says nothing of what may be fitted, an unknown key,
    interpolation. AssetError: unreadable."""
    base = emulator_config(emulator)
    _keys(base, fixed)
    if still and frames is not None:
        raise ConfigError("a still scene needs no frames", where="--still", accepted="either of the two")
    if progress:
        progress("reading", 0.0)
    events, size = read_recording(recording, least=LEAST_EVENTS)
    options = dict(name=os.fspath(recording), emulator=base, fixed=fixed, starts=starts, seed=seed, progress=progress)
    if still:
        return calibrate_events(events, size, None, **options)
    frames = _own_frames(recording) if frames is None else frames
    given, exposures = timed_frames(frames, fps=fps, timestamps=timestamps)
    return calibrate_events(
        events,
        size,
        list(given),
        exposures=exposures,
        frames_name=os.fspath(frames),
        gamma=gamma,
        interpolate=interpolate,
        max_px=max_px,
        frame_delay_ms=frame_delay_ms,
        **options,
    )


def calibrate_events(
    events: Events,
    size: tuple[int, int],
    frames: Sequence[tuple[np.ndarray, int, str]] | None,
    *,
    name: str = "events",
    frames_name: str = "frames",
    exposures: bool = False,
    emulator: str | EmulatorConfig | dict = EmulatorConfig.members.default,
    fixed: Iterable[str] = (),
    gamma: str | float = "linear",
    interpolate: str = "motion",
    max_px: float = 1.0,
    frame_delay_ms: float | None = None,
    starts: int = 3,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> Calibration:
    """:func:`calibrate` of what was read already. size : (height, width) of the sensor.   frames : (array, t_ns, name);
    None: a still scene.   exposures : whether their times are known to be the
    middles of exposures."""
    base = emulator_config(emulator)
    keys = _keys(base, fixed)
    if interpolate not in INTERPOLATIONS:
        raise ConfigError(
            "unknown interpolation", where="interpolate", value=interpolate, accepted=", ".join(INTERPOLATIONS)
        )
    say = progress or (lambda *_: None)
    start, untold = None, {}
    warnings: list[str] = []
    if frames is None:
        clip = clip_of_still(events, size)
        notes = [
            "A still scene of middle brightness was assumed: what depends on light, or its change, is not in it.",
        ]
    else:
        look = lambda delay_us: clip_of_frames(
            events,
            frames,
            size,
            gamma=gamma,
            interpolate=interpolate,
            max_px=max_px,
            delay_us=delay_us,
            where=frames_name,
            seed=seed,
        )
        clip = look(None if frame_delay_ms is None else round(frame_delay_ms * 1000))
        if frame_delay_ms is None:
            # Levels are passed after the light has begun to change: an emulator's events lag behind the frames, too,
            # and by so much the clocks do not differ.
            first = _Search(clip, base, (clip.intervals + 1) // 2, seed, lambda done: say("clock", done))
            keys = first.responding(keys)
            start, untold = first.roughly(keys, starts), first.untold
            simulated = clip.simulate(first.config(keys, start), seed)
            lag_us, _ = clock_offset(simulated, clip.change, clip.clock_us, clip.size)
            found_us = round(clip.facts["found_delay_us"])
            clip = look(found_us - lag_us)
            clip.facts["lag_us"], clip.facts["found_delay_us"] = lag_us, found_us
        notes = _of_frames(clip, exposures, interpolate, frame_delay_ms)
        if not exposures and frame_delay_ms is None:
            warnings.append(
                f"{frames_name}: frames without exposure times: the offset of {clip.facts['delay_us'] / 1000:+.1f} ms "
                "found from the events has whatever lies between their time stamps and the middles of their exposures"
            )
    half = (clip.intervals + 1) // 2
    halves = ((0, half), (half, clip.intervals))
    found = _Search(clip, base, half, seed, lambda done: say("fitting", done))
    found.untold.update(untold)
    if start is None:
        keys = found.responding(keys)
        start = found.roughly(keys, starts) if keys else np.empty(0)
    found.run(keys, start)
    say("judging", 1.0)
    recorded = [sums(clip.events, clip, *part) for part in halves]
    streams = [clip.simulate(one, seed + 1) for one in (base, found.config())]
    judged = [
        [judge_half(own, sums(stream, clip, *part, own.polarity)) for own, part in zip(recorded, halves)]
        for stream in streams
    ]
    return Calibration(
        name,
        clip,
        base,
        found.config(),
        found.values(),
        found.uncertainty(),
        found.untold,
        found.cost,
        found.evaluations,
        halves,
        (judged[0][0], judged[0][1]),
        (judged[1][0], judged[1][1]),
        streams[0],
        streams[1],
        notes,
        warnings,
    )


def judge_half(recorded: Sums, simulated: Sums) -> Judged:
    """``simulated`` with its products taken against ``recorded``."""
    own, other = recorded.without(None), simulated.without(None)
    total = lambda parts: parts[0].sum(axis=0) + parts[4]  # OFF, ON of those that moved and of those that did not
    a, b = total(own), total(other)
    products, pixels = other[6], other[7]
    norm = np.sqrt(products[1] * products[2])
    hz = lambda parts: float(parts[4].sum() / (pixels[1] * recorded.seconds.sum())) if pixels[1] >= 400 else np.nan
    return Judged(
        int(b.sum()),
        int(a.sum()),
        float(b[1] / max(b[0], 1)),
        float(a[1] / max(a[0], 1)),
        interval_distance(recorded, simulated),
        float(products[0] / norm) if norm > 0 else float("nan"),
        hz(other),
        hz(own),
    )


def _keys(base: EmulatorConfig, fixed: Iterable[str]) -> list[str]:
    if not base.fitted:
        raise ConfigError("this emulator says nothing of what may be fitted", where="emulator", value=base.emulator)
    fixed = set(fixed)
    if "threshold_ratio" in fixed:
        raise ConfigError(
            "the two thresholds are fitted one by one, and not their ratio",
            where="--set",
            value="threshold_ratio",
            accepted="contrast_threshold or contrast_threshold_off",
        )
    keys = [key for key in base.fitted if key not in fixed]
    if not keys:
        raise ConfigError("nothing is left to be fitted", where="--set", value=sorted(fixed))
    return keys


def _own_frames(recording: str | os.PathLike) -> str | os.PathLike:
    from blinkgl.io.formats import open_events

    try:
        with open_events(recording) as file:
            if next(iter(file.frames()), None) is not None:
                return recording
    except AssetError as error:
        if "needs the package aedat" in error.problem or "damaged" in error.problem:
            raise
    raise EventDataError(
        "the recording has no frames, and without them nobody knows what the camera saw",
        where=os.fspath(recording),
        accepted="--frames, or --still for a scene that stands still",
    )


def _of_frames(clip: Clip, exposures: bool, interpolate: str, given: float | None) -> list[str]:
    facts, gap_ms = clip.facts, float(np.median(np.diff(clip.clock_us))) / 1000
    found = f"{facts['found_delay_us'] / 1000:+.1f} ms (correlation {facts['delay_correlation']:.2f})"
    notes = [
        f"Clock: the polarity sums follow the frames best when {found} is added to the frames' times; "
        + (
            f"the emulator's own events lag by {facts['lag_us'] / 1000:.1f} ms of it; {facts['delay_us'] / 1000:+.1f} "
            "ms taken."
            if given is None
            else f"{given:+g} ms was asked for and taken."
        )
        + (
            " The times were the middles of the exposures: what is left is the pixels' latency."
            if exposures
            else " Whether the times were of the beginning or the middle of the exposures is not known: that is in it."
        ),
        f"Between frames {gap_ms:.1f} ms apart the light is "
        + (
            f"guessed along dense flow, over up to {facts['displacement_px']:.0f} px: times in an interval, and the "
            "parameters that live on them (the low-pass, the dead time), are as good as that guess."
            if interpolate == "motion"
            else "taken to go in a straight line: what moved further than a pixel is wrong there."
        ),
    ]
    if "bursts" in facts:
        notes.append(
            f"{100 * facts['in_bursts']:.0f} % of the events come in {facts['bursts']:.0f} bursts of one polarity, all "
            "over the sensor, at the frames' interval: the camera's frames set them off, not light. Intervals that "
            "begin or end there are not compared."
        )
    if "other_exposure" in facts:
        notes.append(
            f"{facts['other_exposure']} intervals between frames were left out: there, or beyond, the picture as a "
            "whole becomes brighter or darker without events, so the exposure or gain of the frames was changed."
        )
    if facts["saturated"] > 0:
        notes.append(f"{100 * facts['saturated']:.1f} % of the pixels were saturated in a frame and are left out.")
    if clip.share < 1:
        notes.append(f"{100 * clip.share:.0f} % of the sensor's pixels were looked at, in tiles drawn at random.")
    return notes


class _Search:
    """Looks for the parameters; their logarithms are what it works with."""

    def __init__(self, clip: Clip, base: EmulatorConfig, stop: int, seed: int, progress: Callable[[float], None]):
        self._clip, self._base, self._stop, self._seed, self._progress = clip, base, stop, seed, progress
        recorded = sums(clip.events, clip, 0, stop)
        # What a model has no parameter for it would buy with those that are for something else.
        self.target: Target = target(recorded, together=base.one_threshold)
        if not len(self.target.values):
            raise EventDataError("too few pixels to tell an emulator's parameters", value=int(clip.used.sum()))
        self.evaluations = 0
        self.untold: dict[str, str] = {}
        self.cost = float("nan")
        self._set: dict[str, Any] = {}
        self._keys: list[str] = []
        self._at: np.ndarray = np.empty(0)
        self._jacobian: np.ndarray = np.empty((0, 0))
        self._residual: np.ndarray = np.empty(0)
        self._planned = 1

    def responding(self, keys: list[str]) -> list[str]:
        """Those that make any difference to the scene; the others are named and left alone. What is tried is the middle
        of all rooms with one key at either end."""
        middle = self._ends(keys).mean(axis=1)
        here, found = self._difference(keys, middle), []
        for i, ends in enumerate(self._ends(keys)):
            places = np.repeat(middle[None], 2, axis=0)
            places[:, i] = ends
            if any(np.abs(self._difference(keys, at) - here).max() > 0 for at in places):
                found.append(keys[i])
            else:
                self.untold[keys[i]] = "makes no difference to this scene, left as it was"
                self._set[keys[i]] = self._default(keys[i])
        return found

    def roughly(self, keys: list[str], starts: int) -> np.ndarray:
        """The logarithms of the parameters where the best of several descents ends: a few steps from more places, then
        all from those that led lowest."""
        ends = self._ends(keys)
        tried = qmc.scale(qmc.Sobol(len(keys), seed=self._seed).random(TRIED), *ends.T)
        tried = np.vstack([np.clip(self._defaults(keys), ends[:, 0], ends[:, 1]), tried])
        self._planned = len(tried) + starts * 20 * (len(keys) + 2)
        ordered = tried[np.argsort(self._costs(keys, tried))]
        self.target = self.target.beside(self._sums(keys, ordered[0]), floor="expected")
        first = [self._descend(keys, one, steps=_FEW_STEPS) for one in _apart(ordered, _EACH * starts)]
        first.sort(key=lambda found: found[0])
        return min((self._descend(keys, at) for _, at in first[:starts]), key=lambda found: found[0])[1]

    def run(self, keys: list[str], start: np.ndarray) -> None:
        """start : logarithms of the parameters, where :meth:`roughly` ended."""
        if not keys:
            self.cost = _loss(self._difference([], np.empty(0)))
            return
        self.target = self.target.beside(self._sums(keys, start), floor="expected")
        best = self._descend(keys, start)
        # As if the model were the camera, with nothing but chance between them; then with what it turns out to be off
        # by.
        for floor in ("lowest", "seen"):
            self.target = self.target.beside(self._sums(keys, best[1]), floor=floor)
            best = self._descend(keys, best[1])
            if floor == "lowest":
                best = self._scanned(keys, best)
        while True:
            self.cost, self._at, self._keys = best[0], best[1], keys
            self._residual = self._difference(keys, best[1])
            self._jacobian = self._derivatives(keys, best[1], self._residual)
            spread = self._spread()
            worst = int(np.argmax(spread))
            if spread[worst] <= UNTOLD:
                return
            key = keys[worst]
            keys = [k for k in keys if k != key]
            default = float(np.clip(np.exp(self._defaults([key])[0]), *self._base.fitted[key]))
            there = float(np.exp(best[1][worst]))
            others = np.delete(best[1], worst)
            within = f"the data tell it within a factor of {min(np.exp(spread[worst]), 1e6):.2g} at best"
            self._set[key] = self._default(key)
            again = (_loss(self._difference(keys, others)), others)  # often the others need not follow
            if again[0] > best[0] + TOLERANCE:
                again = self._descend(keys, others)
            if again[0] <= best[0] + TOLERANCE:
                self.untold[key] = f"not told by the recording, left at its default ({within})"
                best = again
            else:
                self._set[key] = there
                side = "less" if there < default else "more"
                self.untold[key] = f"told only to be {side} than its default ({within})"
                best = self._descend(keys, others)
            if not keys:
                self.cost, self._at = best
                self._keys = []
                return

    def config(self, keys: list[str] | None = None, at: np.ndarray | None = None) -> EmulatorConfig:
        keys, at = (self._keys, self._at) if keys is None or at is None else (keys, at)
        values = {key: float(np.exp(v)) for key, v in zip(keys, at)}
        base = self._base.model_dump()
        if base.get("threshold_ratio") is not None:  # of two thresholds that now go their own ways
            base["threshold_ratio"] = None
        return emulator_config({**base, **self._set, **values})

    def values(self) -> dict[str, float]:
        return {key: float(np.exp(v)) for key, v in zip(self._keys, self._at)}

    def uncertainty(self) -> dict[str, float]:
        """Of the recording's and the simulation's chance alone, more where the model does not fit: from what the fit
        would move by if a group of pixels were missing."""
        if not self._keys:
            return {}
        t = self.target
        weights = self._robust()
        j = self._jacobian * weights[:, None]
        pull = np.linalg.solve(j.T @ j + self._prior(), j.T * weights)
        moved = (t.jackknife - t.jackknife.mean(axis=0)) * (t.weight / t.error) @ pull.T
        count = len(t.jackknife)
        spread = np.sqrt((count - 1) / count * (moved**2).sum(axis=0))
        # Where the model is off by more than chance, by that much; a number that hardly any group of pixels moves says
        # nothing of chance.
        known = t.chance > LEAST_CHANCE * t.error
        off = self._residual[known] / t.weight[known] * t.error[known] / t.chance[known]
        misfit = max(1.0, float(np.sqrt(np.mean(off**2)))) if known.any() else 1.0
        return {key: float(np.exp(v) * s * misfit) for key, v, s in zip(self._keys, self._at, spread)}

    def _spread(self) -> np.ndarray:
        weights = self._robust()
        j = self._jacobian * weights[:, None]
        return np.sqrt(np.diag(np.linalg.inv(j.T @ j + self._prior())))

    def _robust(self) -> np.ndarray:
        """Square roots of the weights that the loss gives to the residuals."""
        return (1 + self._residual**2) ** -0.25

    def _prior(self) -> np.ndarray:
        """Nothing is known but the ends: a normal law as wide."""
        ends = self._ends(self._keys)
        return np.diag(12 / np.diff(ends, axis=1)[:, 0] ** 2)

    def _default(self, key: str) -> float | None:
        return getattr(self._base, key)

    def _defaults(self, keys: list[str]) -> np.ndarray:
        other = {"contrast_threshold_off": "contrast_threshold"}
        values = [self._default(key) or (self._default(other[key]) if key in other else 0) or 0 for key in keys]
        return np.log([max(v, self._base.fitted[key].low) for key, v in zip(keys, values)])

    def _ends(self, keys: list[str]) -> np.ndarray:
        return np.log([self._base.fitted[key] for key in keys]).reshape(-1, 2)

    def _sums(self, keys: list[str], at: np.ndarray) -> Sums:
        self.evaluations += 1
        self._progress(min(self.evaluations / self._planned, 0.99))
        events = self._clip.simulate(self.config(keys, at), self._seed, stop=self._stop)
        return sums(events, self._clip, 0, self._stop, self.target.sums.polarity)

    def _difference(self, keys: list[str], at: np.ndarray) -> np.ndarray:
        return self.target.residual(self._sums(keys, at))

    def _costs(self, keys: list[str], places: np.ndarray) -> np.ndarray:
        return np.array([_loss(self._difference(keys, at)) for at in places])

    def _derivatives(self, keys: list[str], at: np.ndarray, here: np.ndarray) -> np.ndarray:
        """By steps of ``STEP``; by wider ones where that does hardly anything."""
        columns = []
        for i, (low, high) in enumerate(self._ends(keys)):
            for width in (STEP, 8 * STEP):
                step = width if at[i] + width <= high else -width
                there = at.copy()
                there[i] = min(max(at[i] + step, low), high)
                moved = self._difference(keys, there) - here
                if moved @ moved > 1:
                    break
            columns.append(moved / step)
        return np.array(columns).T.reshape(len(here), len(keys))

    def _scanned(self, keys: list[str], best: tuple[float, np.ndarray]) -> tuple[float, np.ndarray]:
        """What a descent cannot see: far from where a parameter matters (a dead time shorter than any interval, an
        offset darker than any pixel) nothing says which way to go. So those that the data hardly tell here are each
        held at places over their whole room while the others follow, and the descent begins
        again where that is better."""
        self._keys, self._at, self._residual = keys, best[1], self._difference(keys, best[1])
        self._jacobian = self._derivatives(keys, best[1], self._residual)
        vague = [i for i, spread in enumerate(self._spread()) if spread > VAGUE]
        start, slopes = best, self._jacobian
        for i in vague:
            others, held = [key for key in keys if key != keys[i]], self._set
            (low, high), tried = self._ends([keys[i]])[0], []
            for place in np.linspace(low, high, _PLACES + 2)[1:-1]:
                self._set = {**held, keys[i]: float(np.exp(place))}
                # By the derivatives of where the scan began: near enough to see which places are worth a descent.
                cost, at = self._descend(others, np.delete(start[1], i), np.delete(slopes, i, axis=1), _FEW_STEPS)
                tried.append((cost, np.insert(at, i, place)))
            self._set = held
            tried.sort(key=lambda one: one[0])
            # A place may be better although the nearest that was tried is not: let go of it.
            worth = [at for cost, at in tried[:2] if cost < best[0] + max(_WORTH * best[0], 2.0)]
            best = min([best, *(self._descend(keys, at) for at in worth)], key=lambda one: one[0])
        return best

    def _descend(
        self, keys: list[str], start: np.ndarray, slopes: np.ndarray | None = None, steps: int = _MOST_STEPS
    ) -> tuple[float, np.ndarray]:
        """Levenberg and Marquardt's, on weights that follow the loss. Of each set of derivatives several dampings are
        tried: a simulation jumps event by event, and the best of them is surer than the boldest. Derivatives are what
        costs: after a step they are corrected by what it has shown (Broyden, Mathematics of Computation 19, 1965), and
        taken anew where that leads no further.

        slopes : derivatives to begin with, and to stop with where they lead no further; None: of the place."""
        ends = self._ends(keys)
        at = np.clip(start, ends[:, 0], ends[:, 1]) if keys else start
        residual = self._difference(keys, at)
        cost, j, borrowed = _loss(residual), slopes, slopes is not None
        fresh = False
        for _ in range(steps if keys else 0):
            if j is None:
                j, fresh = self._derivatives(keys, at, residual), True
            weighted = j.T / np.sqrt(1 + residual**2)
            square, pull = weighted @ j, weighted @ residual
            scale = np.diag(square) + 1e-3
            tried = []
            for damping in _DAMPINGS:
                step = -np.linalg.solve(square + damping * np.diag(scale), pull)
                there = np.clip(at + np.clip(step, -_FARTHEST, _FARTHEST), ends[:, 0], ends[:, 1])
                found = self._difference(keys, there)
                tried.append((_loss(found), there, found))
            best = min(tried, key=lambda one: one[0])
            gain = cost - best[0]
            moved, changed = best[1] - at, best[2] - residual
            if gain > 0:
                cost, at, residual = best
            if gain < max(0.003 * cost, 0.02):
                if fresh or borrowed:
                    break
                j = None
            elif gain < _LITTLE * cost and not (fresh or borrowed):
                j = None
            else:
                j = j + np.outer(changed - j @ moved, moved) / (moved @ moved)
                fresh = False
        return cost, at


def _loss(residual: np.ndarray) -> float:
    return float(np.sum(2 * (np.sqrt(1 + residual**2) - 1)))


def _apart(ordered: np.ndarray, count: int) -> list[np.ndarray]:
    """The best ones, no two of them within a factor of two in all parameters."""
    chosen: list[np.ndarray] = []
    for place in ordered:
        if all(np.abs(place - other).max() > np.log(2) for other in chosen):
            chosen.append(place)
        if len(chosen) == count:
            break
    return chosen
