"""Conversion of any video to events.

    for events in frames_to_events(frames, fps=1000, emulator="v2e"): ...

``frames`` is any iterable; only the current ones are stored. Public: :func:`blinkgl.simulate`, `simulate_file`.
"""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from blinkgl.config.events import EmulatorConfig
from blinkgl.config.problems import validate
from blinkgl.config.readout import ReadoutConfig
from blinkgl.config.sensor import SensorConfig, load_sensor
from blinkgl.errors import ConfigError, EventDataError, OutputError
from blinkgl.events.camera import EventCamera, EventFrame, emulate
from blinkgl.io.formats import FORMATS, event_writer, output_format
from blinkgl.io.frames import open_frames
from blinkgl.io.reading import NOTHING, Declared
from blinkgl.io.times import NANOSECONDS, checked_unit
from blinkgl.recordings.decoding import UNKNOWN, Codes, Decoder, OwnFrames, checked_gamma, meaning
from blinkgl.recordings.fitting import Fitting
from blinkgl.recordings.frame_checks import FrameChecks
from blinkgl.recordings.frame_noise import DenoisedLight, FrameNoise, is_mosaic
from blinkgl.sequence_files.preview import Panels, PreviewWriter
from blinkgl.tensors.choice import make_on_device
from blinkgl.timeline import interpolate as between
from blinkgl.types.events import Events, count_causes, named_causes

INTERPOLATIONS = ("linear", "motion")


def own_frames(sensor: SensorConfig | None) -> OwnFrames | None:
    """Return the known properties of a sensor's own frames."""
    if sensor is None or sensor.frame_gamma is None:
        return None
    return OwnFrames((sensor.height, sensor.width), sensor.frame_gamma)


@dataclass(frozen=True)
class FrameUse:
    """How given frames are converted to light; see :func:`frames_to_events`."""

    codes: Codes = UNKNOWN
    interpolate: str = "linear"
    max_px: float = 1.0
    keep_noise: bool = False


@dataclass
class SimulationReport:
    """Record of a simulation; complete when the generator is exhausted.

    frames : given.   steps : frames that the emulator saw, interpolated ones included.   saturated : events cut by the
    emulator's max_events_per_step.   lost : events that found the queue of the sensor's read-out full.   late : events
    that were still on the read-out's bus at the last frame.   causes : events by cause, "signal", "leak", "shot" and
    "hot"; empty unless ``causes`` of the emulator is set.   displacement : for interpolate="motion".   moved_px : for
    interpolate="linear", 99th percentile of the dense flow between a few pairs of frames.   assumed_gamma : curve of
    codes that state none: of the sensor's own frames its own, of integers srgb, of floats linear.
    fitting : conversion of frames to the sensor's size; None: not needed.   noise : of the frames, from which no events
    were made; None: exact frames, or it was kept.   notes : what was unusual or left out, a line each, with the option
    that overrules it.   caveats : problems of the frames, a line each: few codes, clipped, repeated, flicker."""

    frames: int = 0
    steps: int = 0
    first_ns: int = 0
    last_ns: int = 0
    events: int = 0
    on: int = 0
    saturated: int = 0
    lost: int = 0
    late: int = 0
    causes: dict[str, int] = field(default_factory=dict)
    displacement: between.Displacement | None = None
    moved_px: list[float] = field(default_factory=list)
    assumed_gamma: str | float | None = None
    fitting: Fitting | None = None
    noise: FrameNoise | None = None
    notes: list[str] = field(default_factory=list)
    caveats: list[str] = field(default_factory=list)

    @property
    def duration_s(self) -> float:
        return (self.last_ns - self.first_ns) * 1e-9

    def add(self, t_ns: int, events: Events, camera: EventCamera) -> None:
        """Count the emulator's events of a frame at t_ns."""
        self.first_ns = t_ns if self.steps == 0 else self.first_ns
        self.steps += 1
        self.last_ns = t_ns
        self.events += len(events)
        self.on += int(np.count_nonzero(events.p))
        self.saturated, self.lost, self.late = camera.saturated, camera.dropped, camera.late
        if camera.emulator.causes:
            new = named_causes(count_causes(events))
            self.causes = {cause: self.causes.get(cause, 0) + count for cause, count in new.items()}

    @property
    def guessed_over_px(self) -> float:
        """Return the motion between given frames, px, where interpolation is linear; 0 where it was not measured."""
        # The median: dense flow fails at a cut, and where nothing has contrast.
        return float(np.median(self.moved_px)) if self.moved_px else 0.0


def frames_to_events(
    frames: Iterable,
    use: FrameUse = FrameUse(),
    *,
    fps: float | None = None,
    unit: str = "ns",
    zero_time: bool = False,
    emulator: str | EmulatorConfig = EmulatorConfig.default_member,
    seed: int = 0,
    readout: ReadoutConfig | None = None,
    report: SimulationReport | None = None,
    **given: Any,
) -> Iterator[Events]:
    """Yield the events of a stream of frames, one chunk per given frame as soon as it has come, an empty one too,
    sorted, int64 µs on the frames' clock. Arrays are used before the next is asked for, so that one buffer may serve
    all.

    Parameters
    ----------
    frames : iterable of (H, W) or (H, W, 3) RGB arrays with ``fps``, of (array, time) pairs or (array, time, name)
        triples (such as a :class:`~blinkgl.io.frames.FrameSource`). uint8, uint16 or float.
    unit : of the times: "ns", which are whole numbers, or "s", "ms", "us", which may be floats.   zero_time : count
        them from the first frame.
    emulator : name of one ("esim", "v2e", "voltmeter"), or a config of one.
    use : how frames are converted to light. ``codes`` says what codes mean (:func:`~blinkgl.recordings.decoding
        .meaning`). ``interpolate`` "linear": the given frames, between which the emulators interpolate linearly;
        "motion": dense-flow warp with at most ``max_px`` per step (see :mod:`blinkgl.timeline.interpolate`).
        ``keep_noise``: make events of the noise of integer frames, too; else it is estimated all along, and changes
        that it explains cause no events (:mod:`blinkgl.recordings.frame_noise`). Floats, and frames without noise, are
        used unchanged.
    given : the fields of ``use`` and of its codes by themselves: gamma, white_level, range, own, interpolate, max_px,
        keep_noise.
    seed : of the emulator. readout : read-out of the sensor (``load_sensor(name).readout``); None: none. report :
        filled during the simulation.

    Raises
    ------
    EventDataError : NaN, infinite or negative intensities, non-increasing times, float times in ns, a changed size,
        fewer than two frames; names the frame.
    ConfigError : unknown emulator, gamma, unit or interpolation.
    """
    report = report if report is not None else SimulationReport()
    of_codes = {key: given.pop(key) for key in ("gamma", "white_level", "range", "own") if key in given}
    use = replace(use, codes=replace(use.codes, **of_codes), **given)
    checked_unit(unit, "unit")
    steps = simulated_steps(
        frames,
        use,
        fps=fps,
        unit=unit,
        zero_time=zero_time,
        emulator=emulator,
        seed=seed,
        readout=readout,
        report=report,
    )
    return _by_frame(steps)


def _by_frame(steps: Iterator[Step]) -> Iterator[Events]:
    """Yield the events of all steps up to each given frame."""
    chunks: list[Events] = []
    for step in steps:
        chunks.append(step.events)
        if step.given:
            yield chunks[0] if len(chunks) == 1 else Events.concatenate(chunks)
            chunks = []


class Step(NamedTuple):
    """One step of an emulator. events : new events before t_ns.   frame : (H, W) float32 linear luminance or uint8
    codes, at t_ns.   given : whether it is a given frame's, not an interpolated one's."""

    t_ns: int
    events: Events
    frame: np.ndarray
    decode: Decoder
    given: bool

    def luminance(self) -> np.ndarray:
        """Return linear luminance, (H, W) float32."""
        return self.decode(self.frame, "") if self.frame.dtype == np.uint8 else self.frame


def simulated_steps(
    frames: Iterable,
    use: FrameUse,
    *,
    report: SimulationReport,
    fps: float | None = None,
    unit: str = "ns",
    zero_time: bool = False,
    emulator: str | EmulatorConfig = EmulatorConfig.default_member,
    seed: int = 0,
    readout: ReadoutConfig | None = None,
    fitting: Fitting | None = None,
) -> Iterator[Step]:
    """Yield every step of :func:`frames_to_events`. fitting : conversion of frames to the sensor's size; None: they
    have that size."""
    config = emulator_config(emulator)
    if use.interpolate not in INTERPOLATIONS:
        raise ConfigError(
            "unknown interpolation", where="interpolate", value=use.interpolate, accepted=", ".join(INTERPOLATIONS)
        )
    checked_gamma(use.codes.gamma)
    return _run(timed(frames, fps, unit, zero_time), use, config, seed, readout, report, fitting)


def _run(frames, use, config, seed, readout, report, fitting) -> Iterator[Step]:
    first = next(frames, None)
    if first is None:
        raise EventDataError("events need at least two frames", value="0 frames")
    height, width = first[0].shape[:2] if fitting is None else fitting.wanted
    camera = EventCamera(config, readout, height, width, seed, make=make_on_device)
    yield from stepped(itertools.chain([first], frames), camera, use, report=report, fitting=fitting)


def stepped(
    frames: Iterator[tuple[np.ndarray, int, str]],
    camera: EventCamera,
    use: FrameUse,
    *,
    report: SimulationReport | None = None,
    fitting: Fitting | None = None,
) -> Iterator[Step]:
    """Yield steps of frames (array, t_ns, name), interpolated ones included, through an event camera. Raises
    EventDataError as :func:`frames_to_events`."""
    report = report if report is not None else SimulationReport()
    report.notes.extend(camera.notes)
    source = _Given(frames, use, report, fitting, camera)
    stream = iter(source)
    if use.interpolate == "motion":
        report.displacement = between.Displacement()
        stream = between.motion(stream, use.max_px, displacement=report.displacement)
    else:
        stream = _watched(stream, report.moved_px)
    seen: list[np.ndarray] = []

    def shown() -> Iterator[EventFrame]:
        for luminance, t_ns in stream:
            # Holds the frame that the emulator has taken last, for its step.
            seen[:] = [luminance]
            yield EventFrame(t_ns, luminance)

    for t_ns, events in emulate(shown(), camera):
        report.add(t_ns, events, camera)
        # An interpolated frame lies before the given frame that has been read last.
        yield Step(t_ns, events, seen[0], source.decode, t_ns == source.t_ns)


def _watched(stream: Iterator[tuple[np.ndarray, int]], moved_px: list[float]) -> Iterator[tuple[np.ndarray, int]]:
    """Yield the frames of :func:`~blinkgl.timeline.interpolate.watched`. Of a mosaic of colour filters the pixels of
    one filter are watched, which are two pixels apart: neighbours of other filters follow no motion."""
    first = next(stream, None)
    apart = 2 if first is not None and is_mosaic(first[0]) else 1
    whole: list[np.ndarray] = []

    def planes() -> Iterator[tuple[np.ndarray, int]]:
        for frame, t in itertools.chain([] if first is None else [first], stream):
            whole[:] = [frame]
            yield np.ascontiguousarray(frame[::apart, apart - 1 :: apart]), t

    for _, t in between.watched(planes(), moved_px):
        yield whole[0], t
    moved_px[:] = [apart * moved for moved in moved_px]


class _Given:
    """Light of the given frames, (luminance, t_ns) in order: decoded, of the sensor's size, without their noise. Grey
    bytes stay codes where nothing has to be done to them: the emulator has a table. t_ns : of the last frame."""

    decode: Decoder
    t_ns: int | None = None

    def __init__(
        self,
        frames: Iterator[tuple[np.ndarray, int, str]],
        use: FrameUse,
        report: SimulationReport,
        fitting: Fitting | None,
        camera: EventCamera,
    ):
        self._frames, self._use, self._report = frames, use, report
        self._fitting, self._camera = fitting, camera

    def __iter__(self) -> Iterator[tuple[np.ndarray, int]]:
        shape, name, checks = None, "", FrameChecks()
        white, steadied, by_codes, report = None, None, False, self._report
        for frame, t_ns, name in self._frames:
            if shape is None:
                shape = frame.shape
                white, steadied, by_codes = self._begin(frame)
            if frame.shape != shape:
                raise EventDataError(
                    "frame size changed", where=name, value=frame.shape, accepted=f"{shape} as the first frame"
                )
            if self.t_ns is not None and t_ns <= self.t_ns:
                raise EventDataError(
                    "time stamps must increase", where=name, value=f"{t_ns} ns", accepted=f"more than {self.t_ns} ns"
                )
            self.t_ns = t_ns
            report.frames += 1
            checks.see(frame)
            luminance = None if by_codes and frame.dtype == np.uint8 else self._luminance(frame, name)
            quiet = None if steadied is None else steadied(frame, luminance)
            yield quiet if quiet is not None else frame if luminance is None else luminance, t_ns
        if report.frames < 2:
            raise EventDataError("events need at least two frames", where=name, value="1 frame")
        report.caveats.extend(checks.lines(white))
        if steadied is not None:
            report.noise = steadied.noise
            report.caveats.extend([steadied.doubt] if steadied.doubt else [])

    def _begin(self, first: np.ndarray) -> tuple[float | None, DenoisedLight | None, bool]:
        """Decide by the first frame's type what codes mean. Return the code of white, what removes noise, and whether
        frames may stay codes."""
        codes = meaning(first, self._use.codes)
        self.decode, self._report.assumed_gamma = codes.decode, codes.assumed
        self._report.notes.extend(codes.notes)
        by_codes = self._use.interpolate == "linear" and first.dtype == np.uint8 and first.ndim == 2
        by_codes = by_codes and self._fitting is None
        if by_codes:
            self._camera.emulator.set_decode(self.decode.table(np.uint8))
        if self._use.keep_noise or first.dtype.kind != "u":
            return codes.white, None, by_codes
        light = lambda frame: self._luminance(frame, "")
        return codes.white, DenoisedLight(light, self.decode.code_distance(first.dtype)), by_codes

    def _luminance(self, frame: np.ndarray, name: str) -> np.ndarray:
        luminance = self.decode(frame, name)
        if self._fitting is not None:
            return self._fitting(luminance)
        # Floats may come back as they are, in a buffer that the caller fills again before interpolation is done.
        return luminance.copy() if np.may_share_memory(luminance, frame) else luminance


def file_to_events(
    source: str | os.PathLike,
    target: str | os.PathLike,
    *,
    declared: Declared = NOTHING,
    size: tuple[int, int] | None = None,
    preview: str | os.PathLike | None = None,
    overwrite: bool = True,
    use: FrameUse = FrameUse(),
    emulator: str | EmulatorConfig = EmulatorConfig.default_member,
    seed: int = 0,
    readout: ReadoutConfig | None = None,
    progress: Callable[[SimulationReport, float | None], None] | None = None,
) -> SimulationReport:
    """Convert the frames of ``source`` (see :func:`~blinkgl.io.frames.open_frames`) to an event file whose ending
    selects the format (.h5 .raw .txt .csv .npz .npy); emulator, seed, readout and ``use`` as in
    :func:`frames_to_events`. The files appear completely or not at all.

    declared : what the user says of the frames.   size : (height, width) of the sensor; frames of another size are
    cropped and scaled; None: that of the frames. preview : video of frames and events. progress : called with (report
    so far, fraction done or None) per given frame.
    """
    _check_target(target, emulator)
    if preview is not None and Path(preview).resolve() == Path(target).resolve():
        raise OutputError("preview and events in the same file", where=str(preview))
    frames = open_frames(source, declared)
    height, width = (frames.height, frames.width) if size is None else size
    report = SimulationReport(notes=frames.notes)
    white, limits = declared.white_level, declared.range
    codes = replace(use.codes, white_level=white or use.codes.white_level, range=limits or use.codes.range)
    use = replace(use, codes=codes.of(frames), keep_noise=use.keep_noise or frames.exact)
    if (height, width) != (frames.height, frames.width):
        report.fitting = Fitting((frames.height, frames.width), (height, width))
    iterator = iter(frames)
    # The files need the first time, and the preview the interval, before the first step is made.
    first = list(itertools.islice(iterator, 2))
    start_us, gap_ns = first[0][1] // 1000, first[-1][1] - first[0][1]
    numbered = enumerate(itertools.chain(first, iterator))
    steps = simulated_steps(
        ((frame, t_ns, f"{source}: frame {i} ({name})") for i, (frame, t_ns, name) in numbered),
        use,
        emulator=emulator,
        seed=seed,
        readout=readout,
        report=report,
        fitting=report.fitting,
    )
    with contextlib.ExitStack() as stack:
        out = stack.enter_context(event_writer(target, height, width, t_offset_us=start_us, overwrite=overwrite))
        shown = None if preview is None else _preview(preview, height, width, start_us, gap_ns, overwrite)
        video, done = None if shown is None else stack.enter_context(shown), 0
        for step in steps:
            if video is not None:
                _show(video, step)
            out.append(step.events)
            if progress is not None and report.frames > done:
                done = report.frames
                progress(report, min(done / frames.count, 1.0) if frames.count else None)
        out.t_end_us = report.last_ns // 1000
    return report


def _show(video: PreviewWriter, step: Step) -> None:
    video.panels[0].add_events(step.events)
    if video.panels[0].due(step.t_ns // 1000):
        video.frame(step.t_ns // 1000, step.luminance())


def _check_target(target: str | os.PathLike, emulator: str | EmulatorConfig | dict) -> None:
    """Raise OutputError for an ending that is not an event file's, or a format that cannot store the emulator's
    causes."""
    kind = output_format(target)
    if getattr(emulator_config(emulator), "causes", False) and not FORMATS[kind].causes:
        raise OutputError(
            f"{kind} cannot hold the causes of events",
            where=str(target),
            accepted=".h5, .npz or .npy, or an emulator without causes",
        )


@contextlib.contextmanager
def _preview(
    path: str | os.PathLike, height: int, width: int, start_us: int, gap_ns: int, overwrite: bool
) -> Iterator[PreviewWriter]:
    """Return a video of frames and events, at the frames' rate up to 100 Hz, which appears completely or not at all."""
    from blinkgl.io.atomic import atomic_file

    rate = min(1e9 / gap_ns, 100.0)
    fps = min(rate, 25.0)
    panels = Panels(height, width, t0_us=start_us, flow=False, rate_hz=rate, fps=fps)
    with atomic_file(path, overwrite=overwrite) as temporary, PreviewWriter(temporary, [panels], fps) as writer:
        yield writer


def emulator_config(emulator: str | EmulatorConfig | dict) -> EmulatorConfig:
    """Return a validated emulator config from a name, a plain mapping with ``emulator``, or a config."""
    if isinstance(emulator, EmulatorConfig):
        return emulator
    data = {"emulator": emulator} if isinstance(emulator, str) else dict(emulator)
    kind, members = data.get("emulator", EmulatorConfig.default_member), EmulatorConfig.members
    if not isinstance(kind, str) or kind not in members:
        raise ConfigError("unknown emulator", where="emulator", value=kind, accepted=", ".join(members))
    return validate(members[kind], data, where=kind)


def with_sensor(emulator: dict[str, object], sensor: str | None) -> tuple[EmulatorConfig, SensorConfig | None]:
    """Return the emulator of a plain table, with the values of a sensor where the table gives none, and that sensor, a
    shipped one's name or a sensor file; None: the emulator's defaults. Raises ConfigError."""
    if sensor is None:
        return emulator_config(emulator), None
    camera = load_sensor(sensor)
    values = camera.values(emulator.get("emulator", EmulatorConfig.default_member))
    return emulator_config({**values, **emulator}), camera


def timed(
    frames: Iterable, fps: float | None = None, unit: str = "ns", zero_time: bool = False
) -> Iterator[tuple[np.ndarray, int, str]]:
    """Yield (frame, t_ns, name) from the three kinds of iterables of :func:`frames_to_events`."""
    start = None
    for i, item in enumerate(frames):
        name = item[2] if isinstance(item, tuple) and len(item) > 2 else f"frame {i}"
        if isinstance(item, tuple):
            frame, t_ns = np.asarray(item[0]), _nanoseconds(item[1], unit, name)
        elif fps:
            frame, t_ns = np.asarray(item), round(i * 1e9 / fps)
        else:
            raise EventDataError("frames without times", where=f"frame {i}", accepted="fps, or (frame, t_ns) pairs")
        if frame.ndim == 3 and frame.shape[2] == 1:
            frame = frame[..., 0]
        if frame.ndim not in (2, 3) or (frame.ndim == 3 and frame.shape[2] != 3):
            raise EventDataError("not a frame", where=name, value=frame.shape, accepted="(H, W) or (H, W, 3)")
        start = t_ns if start is None else start
        yield frame, t_ns - start if zero_time else t_ns, name


def _nanoseconds(time: object, unit: str, name: str) -> int:
    """Return a time as whole ns. Raises EventDataError: not a number, not finite, or a float of ns."""
    if isinstance(time, (int, np.integer)) and not isinstance(time, bool):
        return int(time) * NANOSECONDS[unit]
    if isinstance(time, (float, np.floating)) and np.isfinite(time) and unit != "ns":
        return round(float(time) * NANOSECONDS[unit])
    raise EventDataError(
        "not a time", where=name, value=time, accepted='whole ns, or a number with unit="s", "ms" or "us"'
    )
