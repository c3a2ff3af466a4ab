"""Any video to events: frames in, events out.

    for events in frames_to_events(frames, fps=1000, emulator="v2e"):
        ...

``frames`` is any iterable, a generator included; nothing but the current frames is kept. :func:`file_to_events` is the
same from file to file (``blinkgl simulate``). :func:`blinkgl.simulate` and
:func:`blinkgl.simulate_file` are these behind the front door.
"""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numba
import numpy as np
from numpy.typing import DTypeLike

from blinkgl.config.events import EmulatorConfig
from blinkgl.config.problems import validate
from blinkgl.config.readout import ReadoutConfig
from blinkgl.errors import ConfigError, EventDataError, OutputError
from blinkgl.events.camera import EventCamera, EventFrame, emulate
from blinkgl.io.frames import VIDEO, open_frames
from blinkgl.recordings.fitting import Fitting
from blinkgl.srgb import linear_from_srgb
from blinkgl.tensors.choice import make_on_device
from blinkgl.timeline import interpolate as between
from blinkgl.types.events import Events, count_causes, named_causes

if TYPE_CHECKING:
    from blinkgl.sequence_files.preview import PreviewWriter

INTERPOLATIONS = ("linear", "motion")
_LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""ITU-R BT.709, on linear light."""


@dataclass
class SimulationReport:
    """What a simulation did; complete when the generator is exhausted."""

    frames: int = 0
    """given"""
    steps: int = 0
    """frames that the emulator saw, interpolated ones included"""
    first_ns: int = 0
    last_ns: int = 0
    events: int = 0
    on: int = 0
    saturated: int = 0
    """events cut by the emulator's max_events_per_step"""
    lost: int = 0
    """events that found the queue of the sensor's read-out full"""
    late: int = 0
    """events that were still on the read-out's bus when the last frame came"""
    causes: dict[str, int] = field(default_factory=dict)
    """events by what caused them, "signal", "leak", "shot" and "hot"; empty unless ``causes`` of the emulator is set"""
    displacement: between.Displacement | None = None
    """for interpolate="motion" """
    moved_px: list[float] = field(default_factory=list)
    """for interpolate="linear": 99th percentile of the dense flow between a few pairs of given frames"""
    assumed_srgb: bool = False
    """whether the codes of images were taken as sRGB because nobody said what they are"""
    fitting: Fitting | None = None
    """how frames became the sensor's size; None: they had it, or nobody asked"""

    @property
    def duration_s(self) -> float:
        return (self.last_ns - self.first_ns) * 1e-9

    def add(self, t_ns: int, events: Events, camera: EventCamera) -> None:
        """Count what the emulator made of a frame at t_ns."""
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
        """How far things move between given frames, px, where interpolation is linear: 0 where nobody looked."""
        # The median: dense flow fails at a cut, and where nothing has contrast.
        return float(np.median(self.moved_px)) if self.moved_px else 0.0


def frames_to_events(
    frames: Iterable,
    *,
    fps: float | None = None,
    emulator: str | EmulatorConfig = EmulatorConfig.members.default,
    gamma: str | float | None = None,
    interpolate: str = "linear",
    max_px: float = 1.0,
    seed: int = 0,
    readout: ReadoutConfig | None = None,
    report: SimulationReport | None = None,
) -> Iterator[Events]:
    """Events of a stream of frames, one chunk per step, sorted, int64 µs on the frames' clock.

    Parameters
    ----------
    frames : iterable of (H, W) or (H, W, 3) RGB arrays with ``fps``, of (array, t_ns) pairs or (array, t_ns, name)
        triples (a :class:`~blinkgl.io.frames.FrameSource` is that). uint8, uint16 (full scale
        1.0) or float (1.0 is white, more is fine).
    emulator : name of one ("esim", "v2e", "voltmeter"), or a config of one.
    gamma : "srgb", "linear", or an exponent N (luminance = code^N). Default: srgb for integers, linear for floats.
    interpolate : "linear": the given frames, between which the emulators are linear themselves; "motion":
        dense-flow warp with at most ``max_px`` per step (see :mod:`blinkgl.timeline.interpolate`).
    seed : of the emulator. readout : what is behind the pixels (``load_sensor(name).readout``); None:
    nothing. report : filled as it goes.

    Raises
    ------
    EventDataError : NaN, infinite or negative intensities, non-increasing times, a changed
    size, fewer than two frames; names the frame.
    ConfigError : unknown emulator, gamma or interpolation.
    """
    report = report if report is not None else SimulationReport()
    steps = simulated_steps(
        frames,
        fps=fps,
        emulator=emulator,
        gamma=gamma,
        interpolate=interpolate,
        max_px=max_px,
        seed=seed,
        readout=readout,
        report=report,
    )
    return (step.events for step in steps if len(step.events))


class Step(NamedTuple):
    """One step of an emulator. events : before t_ns, not given before.   frame : (H, W) float32
    linear luminance or uint8 codes, at t_ns."""

    t_ns: int
    events: Events
    frame: np.ndarray


def simulated_steps(
    frames: Iterable,
    *,
    report: SimulationReport,
    fps: float | None = None,
    emulator: str | EmulatorConfig = EmulatorConfig.members.default,
    gamma: str | float | None = None,
    interpolate: str = "linear",
    max_px: float = 1.0,
    seed: int = 0,
    readout: ReadoutConfig | None = None,
) -> Iterator[Step]:
    """As :func:`frames_to_events`, every step of it."""
    config = emulator_config(emulator)
    if interpolate not in INTERPOLATIONS:
        raise ConfigError(
            "unknown interpolation", where="interpolate", value=interpolate, accepted=", ".join(INTERPOLATIONS)
        )
    return _run(timed(frames, fps), config, _checked_gamma(gamma), interpolate, max_px, seed, readout, report)


def _run(frames, config, gamma, interpolate, max_px, seed, readout, report) -> Iterator[Step]:
    first = next(frames, None)
    if first is None:
        raise EventDataError("events need at least two frames", value="0 frames")
    camera = EventCamera(config, readout, *first[0].shape[:2], seed, make=make_on_device)
    yield from stepped(
        itertools.chain([first], frames),
        camera,
        gamma=gamma,
        interpolate=interpolate,
        max_px=max_px,
        report=report,
    )


def stepped(
    frames: Iterator[tuple[np.ndarray, int, str]],
    camera: EventCamera,
    *,
    gamma: str | float | None,
    interpolate: str,
    max_px: float,
    report: SimulationReport | None = None,
) -> Iterator[Step]:
    """Frames (array, t_ns, name), those in between included, through an event camera. Raises
    EventDataError as :func:`frames_to_events`."""
    report = report if report is not None else SimulationReport()
    first = next(frames)
    decode = Decoder(gamma)
    table = interpolate == "linear" and first[0].dtype == np.uint8 and first[0].ndim == 2
    if table:
        camera.emulator.set_decode(decode.table(np.uint8))

    def luminances() -> Iterator[tuple[np.ndarray, int]]:
        shape = first[0].shape
        last = None
        for frame, t_ns, name in itertools.chain([first], frames):
            if frame.shape != shape:
                raise EventDataError(
                    "frame size changed", where=name, value=frame.shape, accepted=f"{shape} as the first frame"
                )
            if last is not None and t_ns <= last:
                raise EventDataError(
                    "time stamps must increase", where=name, value=f"{t_ns} ns", accepted=f"more than {last} ns"
                )
            last = t_ns
            report.frames += 1
            yield (frame if table and frame.dtype == np.uint8 else decode(frame, name)), t_ns
        if report.frames < 2:
            raise EventDataError("events need at least two frames", where=name, value="1 frame")

    stream = luminances()
    if interpolate == "motion":
        report.displacement = between.Displacement()
        stream = between.motion(stream, max_px, displacement=report.displacement)
    else:
        stream = between.watched(stream, report.moved_px)
    seen: list[np.ndarray] = [first[0]]

    def shown() -> Iterator[EventFrame]:
        for luminance, t_ns in stream:
            seen[0] = luminance
            yield EventFrame(t_ns, luminance)

    for t_ns, events in emulate(shown(), camera):
        report.add(t_ns, events, camera)
        yield Step(t_ns, events, seen[0])


def file_to_events(
    source: str | os.PathLike,
    target: str | os.PathLike,
    *,
    fps: float | None = None,
    timestamps: str | os.PathLike | None = None,
    size: tuple[int, int] | None = None,
    preview: str | os.PathLike | None = None,
    overwrite: bool = True,
    progress: Callable[[SimulationReport, float | None], None] | None = None,
    **options: Any,
) -> SimulationReport:
    """Frames of ``source`` (see :func:`~blinkgl.io.frames.open_frames`) to an event file whose ending names the format
    (.h5 .raw .txt .csv .npz .npy); options as :func:`frames_to_events`. The files appear whole or not at all.

    size : (height, width) of the sensor; frames of another size are cropped and scaled; None: as the frames are.
    preview : video of frames and events. progress : called with (report so far, fraction done or None) per given frame.
    """
    from blinkgl.io.formats import event_writer

    _check_target(target, options.get("emulator", EmulatorConfig.members.default))
    if preview is not None and Path(preview).resolve() == Path(target).resolve():
        raise OutputError("preview and events in the same file", where=str(preview))
    frames = open_frames(source, fps=fps, timestamps=timestamps)
    height, width = (frames.height, frames.width) if size is None else size
    report = SimulationReport()
    if options.get("gamma") is None and frames.linear:
        options = {**options, "gamma": "linear"}
    said = options.get("gamma") is not None
    decode = Decoder(_checked_gamma(options["gamma"]) if said else "srgb")
    if (height, width) != (frames.height, frames.width):
        report.fitting = Fitting((frames.height, frames.width), (height, width))
        options = {**options, "gamma": "linear"}  # scaled in linear light
    iterator = iter(frames)
    first = next(iterator)
    second = next(iterator, None)
    # A video is made to be looked at; images and arrays may be a camera's raw codes.
    is_video = frames.path.suffix.lower() in VIDEO
    report.assumed_srgb = not said and first[0].dtype.kind == "u" and not is_video
    start_us = first[1] // 1000
    gap_ns = (second[1] - first[1]) if second else 10**9

    def given() -> Iterator:
        for i, (frame, t_ns, name) in enumerate(itertools.chain([first], [second] if second else [], iterator)):
            where = f"{source}: frame {i} ({name})"
            yield (frame if report.fitting is None else report.fitting(decode(frame, where))), t_ns, where

    with contextlib.ExitStack() as stack:
        out = stack.enter_context(event_writer(target, height, width, t_offset_us=start_us, overwrite=overwrite))
        video = None
        if preview is not None:
            shown = _preview(preview, height, width, start_us, gap_ns, overwrite)
            video = stack.enter_context(shown)
        done = 0
        for step in simulated_steps(given(), report=report, **options):
            if video is not None:
                video.add_events(step.events)
                if video.due(step.t_ns // 1000):
                    video.frame(
                        step.t_ns // 1000, decode(step.frame, "") if step.frame.dtype == np.uint8 else step.frame
                    )
            out.append(step.events)
            if progress is not None and report.frames > done:
                done = report.frames
                progress(report, min(done / frames.count, 1.0) if frames.count else None)
        out.t_end_us = report.last_ns // 1000
    return report


def _check_target(target: str | os.PathLike, emulator: str | EmulatorConfig | dict) -> None:
    """Raises OutputError: no event file's ending, or of a format that cannot hold what the emulator says."""
    from blinkgl.io.formats import WITH_CAUSES, output_format

    kind = output_format(target)
    if getattr(emulator_config(emulator), "causes", False) and kind not in WITH_CAUSES:
        raise OutputError(
            f"{kind} cannot hold the causes of events",
            where=str(target),
            accepted=".h5, .npz or .npy, or an emulator without causes",
        )


@contextlib.contextmanager
def _preview(
    path: str | os.PathLike, height: int, width: int, start_us: int, gap_ns: int, overwrite: bool
) -> Iterator[PreviewWriter]:
    """A video of frames and events, at the frames' rate up to 100 Hz, that appears whole or not at all."""
    from blinkgl.io.atomic import atomic_file
    from blinkgl.sequence_files.preview import PreviewWriter

    rate = min(1e9 / gap_ns, 100.0)
    with (
        atomic_file(path, overwrite=overwrite) as temporary,
        PreviewWriter(
            temporary, height, width, t0_us=start_us, flow=False, rate_hz=rate, fps=min(rate, 25.0)
        ) as writer,
    ):
        yield writer


class Decoder:
    """Frames as stored to linear luminance (H, W) float32. gamma as :func:`frames_to_events`."""

    def __init__(self, gamma: str | float | None):
        self._gamma = gamma
        self._tables: dict[np.dtype, np.ndarray] = {}

    def table(self, dtype: DTypeLike) -> np.ndarray:
        """Luminance of each code of an unsigned integer type, float32."""
        dtype = np.dtype(dtype)
        if dtype not in self._tables:
            most = np.iinfo(dtype).max
            self._tables[dtype] = self._curve(np.arange(most + 1, dtype=np.float64) / most, "srgb").astype(np.float32)
        return self._tables[dtype]

    def __call__(self, frame: np.ndarray, name: str) -> np.ndarray:
        """Raises EventDataError with ``name``, pixel and value for NaN, infinite or negative intensities."""
        if frame.dtype in (np.uint8, np.uint16):
            table = self.table(frame.dtype)
            if frame.ndim == 2:
                return table[frame]
            out = np.empty(frame.shape[:2], np.float32)
            _luma_by_table(np.ascontiguousarray(frame), table, _LUMA, out)
            return out
        if frame.dtype.kind != "f":
            raise EventDataError(
                "unsupported pixel type", where=name, value=str(frame.dtype), accepted="uint8, uint16 or float"
            )
        frame = np.asarray(frame, np.float32)
        low, high = frame.min(), frame.max()
        if not (low >= 0 and high < np.inf):  # NaN fails both
            where = np.argwhere(~((frame >= 0) & (frame < np.inf)))[0]
            raise EventDataError(
                f"intensity at pixel x={where[1]}, y={where[0]} cannot be used",
                where=name,
                value=float(frame[tuple(where)]),
                accepted="a finite value >= 0",
            )
        linear = self._curve(frame, "linear")
        return np.ascontiguousarray(linear if linear.ndim == 2 else linear @ _LUMA, np.float32)

    def _curve(self, code: np.ndarray, default: str) -> np.ndarray:
        gamma = default if self._gamma is None else self._gamma
        if gamma == "linear":
            return code
        return linear_from_srgb(code) if gamma == "srgb" else code ** code.dtype.type(gamma)


@numba.njit(cache=True, nogil=True)
def _luma_by_table(frame, table, weights, out):
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[y, x] = (
                weights[0] * table[frame[y, x, 0]]
                + weights[1] * table[frame[y, x, 1]]
                + weights[2] * table[frame[y, x, 2]]
            )


def emulator_config(emulator: str | EmulatorConfig | dict) -> EmulatorConfig:
    """A validated emulator config from a name, a plain mapping with ``emulator``, or a config."""
    if isinstance(emulator, EmulatorConfig):
        return emulator
    data = {"emulator": emulator} if isinstance(emulator, str) else dict(emulator)
    members = EmulatorConfig.members
    kind = data.get("emulator", members.default)
    if not isinstance(kind, str) or kind not in members.models:
        raise ConfigError("unknown emulator", where="emulator", value=kind, accepted=", ".join(members.models))
    return validate(members.models[kind], data, where=kind)


def _checked_gamma(gamma: str | float | None) -> str | float | None:
    if gamma in (None, "srgb", "linear"):
        return gamma
    try:
        value = float(gamma)
        if 0 < value <= 10:
            return value
    except (TypeError, ValueError):
        pass
    raise ConfigError(
        "unknown transfer curve", where="gamma", value=gamma, accepted="srgb, linear or an exponent up to 10"
    )


def timed(frames: Iterable, fps: float | None = None) -> Iterator[tuple[np.ndarray, int, str]]:
    """(frame, t_ns, name) from the three kinds of iterables :func:`frames_to_events` takes."""
    for i, item in enumerate(frames):
        if isinstance(item, tuple):
            frame, t_ns = np.asarray(item[0]), int(item[1])
            name = item[2] if len(item) > 2 else f"frame {i}"
        elif fps:
            frame, t_ns, name = np.asarray(item), round(i * 1e9 / fps), f"frame {i}"
        else:
            raise EventDataError("frames without times", where=f"frame {i}", accepted="fps, or (frame, t_ns) pairs")
        if frame.ndim == 3 and frame.shape[2] == 1:
            frame = frame[..., 0]
        if frame.ndim not in (2, 3) or (frame.ndim == 3 and frame.shape[2] != 3):
            raise EventDataError("not a frame", where=name, value=frame.shape, accepted="(H, W) or (H, W, 3)")
        yield frame, t_ns, name
