"""Files of events and flow, conversion of frames to events, comparison of two recordings.

Each function imports what it needs when it is called, so that reading an event file loads no emulator."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, TypedDict, cast

import numpy as np

from blinkgl.errors import ConfigError, EventDataError
from blinkgl.front import arguments as check
from blinkgl.io import formats
from blinkgl.io.formats import EventFile
from blinkgl.io.reading import EventReading
from blinkgl.types.events import Events

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from blinkgl.front.sections import EmulatorSettings
    from blinkgl.recordings.calibration import Calibration
    from blinkgl.recordings.comparison import Comparison
    from blinkgl.recordings.simulation import FrameUse, SimulationReport

_SIDE = 65535


class EventOptions(TypedDict, total=False):
    """Declarations about an event file; :func:`blinkgl.open_events` describes them."""

    time_unit: str | None
    size: tuple[int, int] | None
    origin: str | None
    columns: str | Iterable[str] | None
    polarity: str | Iterable[float] | None
    stream: int | None
    damaged: str
    sort: bool


def _reading(declared: EventOptions) -> EventReading:
    given: dict[str, Any] = dict(declared)
    if given.get("size") is not None:
        given["size"] = _size(given["size"])
    return EventReading.of(**given)


@check.public
def open_events(path: str | os.PathLike, **declared: Unpack[EventOptions]) -> EventFile:
    """Open an event file for reading in pieces: ``with open_events(path) as file: for events in file.chunks(): …``;
    ``height``, ``width`` in px, None if the file does not contain them (``file.sized()`` computes them), times in µs.
    Formats and endings: docs/formats.md. For .aedat4 and .aedat also ``file.frames()``, the camera's own frames, and
    ``file.imu()``, its inertial unit. ``file.said`` lists what was guessed, and after reading what was left out.

    time_unit : "s", "ms", "us" or "ns".   size : (height, width), px.   origin : "top" or "bottom", the row of y = 0.
    columns : order of a table's columns, "x,y,t,p".   polarity : numbers of OFF and ON, (-1, 1).   stream : of several.
    damaged : "refuse", or "keep" what is whole.   sort : put events in order of time. Default: as the file says; what
    it does not say is guessed.
    Raises AssetError: missing file, unknown ending, or content of another format; ConfigError."""
    return formats.open_events(check.path(path, "path"), _reading(declared))


@check.public
def read_events(path: str | os.PathLike, *, truth: bool = False, **declared: Unpack[EventOptions]) -> Events:
    """Return all :class:`Events` of a file, t in µs, in memory. A guess, or something left out, is a warning.

    truth : also read their causes (``Events.truth``), from ``event_labels.h5`` beside a sequence's ``events.h5``.
    declared : as of :func:`open_events`. Raises AssetError and EventDataError (decreasing times …)."""
    with formats.open_events(check.path(path, "path"), _reading(declared)) as file:
        events = file.read()
    _warn(file)
    if not check.one_of(truth, "truth", bool, "True or False"):
        return events
    from blinkgl.io.event_labels import with_truth

    return with_truth(events, 0, check.path(path, "path").parent)


def _warn(file: EventFile) -> None:
    for line in file.said:
        warnings.warn(f"{file.path}: {line}", stacklevel=4)


@check.public
def write_events(
    path: str | os.PathLike,
    events: Events | Iterable[Events],
    height: int,
    width: int,
    *,
    t_offset_us: int = 0,
    write_unit: str = "s",
    overwrite: bool = True,
) -> int:
    """Write events, or chunks in order, of a sensor of height x width px, and return their number. The file appears
    complete or not at all.

    path : its ending names the format (docs/formats.md).   t_offset_us : DSEC's, µs.
    write_unit : of text and CSV, "s" or "us". Raises OutputError, EventDataError, ConfigError."""
    path, height, width = (
        check.path(path, "path"),
        check.whole(height, "height", 1, _SIDE),
        check.whole(width, "width", 1, _SIDE),
    )
    offset = check.whole(t_offset_us, "t_offset_us", 0, 2**62)
    return formats.write_events(
        path,
        _chunks(events),
        height,
        width,
        t_offset_us=offset,
        write_unit=write_unit,
        overwrite=overwrite,
    )


def _chunks(events: Any) -> Iterator[Events]:
    if isinstance(events, Events):
        events = (events,)
    if not isinstance(events, Iterable):
        raise ConfigError("not events", where="events", value=events, accepted="Events, or chunks of them")

    def checked() -> Iterator[Events]:
        for chunk in events:
            yield check.one_of(chunk, "events", Events, "Events, or chunks of them")

    return checked()


@check.public
def convert(
    source: str | os.PathLike,
    target: str | os.PathLike,
    *,
    zero_time: bool = False,
    write_unit: str = "s",
    overwrite: bool = True,
    **declared: Unpack[EventOptions],
) -> int:
    """Copy events from one file format to another, in pieces. Returns the number of events. A guess, or something left
    out, is a warning.

    write_unit : as of :func:`write_events`.   zero_time : count times from the first event.   declared : of ``source``,
    as of :func:`open_events`. Raises AssetError, OutputError, EventDataError, ConfigError."""
    file, count = formats.convert(
        check.path(source, "source"),
        check.path(target, "target"),
        _reading(declared),
        zero_time=bool(zero_time),
        write_unit=write_unit,
        overwrite=overwrite,
    )
    _warn(file)
    return count


def _size(size: Any) -> tuple[int, int]:
    """Return (height, width), px. Raises ConfigError."""
    pair = check.one_of(size, "size", (list, tuple), "(height, width)")
    if len(pair) != 2:
        raise ConfigError("not two numbers", where="size", value=size, accepted="(height, width)")
    return check.whole(pair[0], "size", 1, _SIDE), check.whole(pair[1], "size", 1, _SIDE)


def _sensor_size(sensor: str | None) -> tuple[int, int] | None:
    from blinkgl.config.sensor import load_sensor

    if sensor is None:
        return None
    camera = load_sensor(sensor)
    return camera.height, camera.width


@check.public
def read_flow(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
    """Return flow (H, W, 2) float32 px, +x right, +y down (0 where invalid), and valid (H, W) bool,
    of a .png (DSEC), .flo or .npy file.

    Raises AssetError: missing, damaged, or not flow."""
    from blinkgl.io import flow as flow_files

    return flow_files.read_flow(check.path(path, "path"))


@check.public
def write_flow(path: str | os.PathLike, flow: np.ndarray, valid: np.ndarray | None = None) -> int:
    """Write flow (H, W, 2) px and valid (H, W) bool (default: all) as .png (DSEC's 16
    bit), .flo or .npy, by the ending.

    Returns the number of valid pixels whose flow exceeds the format's range; they are stored as invalid. Raises
    OutputError, ConfigError."""
    from blinkgl.io import flow as flow_files

    field = check.array(flow, "flow", (None, None, 2), "an array (H, W, 2), px")
    mask = (
        np.ones(field.shape[:2], bool)
        if valid is None
        else check.array(valid, "valid", field.shape[:2], f"an array {field.shape[:2]} of bool")
    )
    if not field.size:
        raise ConfigError("no pixels", where="flow", value=field.shape, accepted="an array (H, W, 2), px")
    return flow_files.write_flow(check.path(path, "path"), field.astype(np.float32), mask.astype(bool))


@check.public
def read_trajectory(path: str | os.PathLike, *, form: str | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) int64 ns and poses T_world_body (N, 4, 4) float64 of TUM's text or EuRoC's CSV.

    form : "tum" or "euroc"; None: EuRoC if lines contain commas.
    Raises AssetError with the line: invalid pose, times that do not increase, a gap."""
    from blinkgl.io import trajectories

    if form not in (None, *trajectories.FORMATS):
        raise ConfigError("unknown form", where="form", value=form, accepted="tum, euroc or None")
    return trajectories.read_trajectory(check.path(path, "path"), form)


@check.public
def write_trajectory(path: str | os.PathLike, t_ns: np.ndarray, poses: np.ndarray) -> None:
    """Write poses (N, 4, 4) at t_ns (N,) whole ns as TUM's text, t x y z qx qy qz qw. A sequence's
    ``poses.npz`` has them as ``t_ns`` and ``T_world_cam``. Raises OutputError, ConfigError."""
    from blinkgl.io import trajectories

    times = check.array(t_ns, "t_ns", (None,), "an array (N,) of whole ns")
    placed = check.array(poses, "poses", (len(times), 4, 4), f"an array ({len(times)}, 4, 4)")
    if times.dtype.kind not in "iu" or (np.diff(times) <= 0).any():
        raise ConfigError(
            "times do not increase", where="t_ns", value=times[:3].tolist(), accepted="whole ns, in order"
        )
    trajectories.write_trajectory(check.path(path, "path"), times, placed.astype(np.float64))


@check.public
def compare(
    a: str | os.PathLike,
    b: str | os.PathLike | None = None,
    *,
    frames: str | os.PathLike | None = None,
    fps: float | None = None,
    interval_ms: float = 20.0,
    zero_time: bool = False,
    judge: bool = False,
    **declared: Unpack[EventOptions],
) -> Comparison:
    """Compare two event files over their common time: ``rows()`` is a table, ``to_dict()`` numbers.

    b : event file; None: only ``a`` is described.
    frames : video or folder of images that both are compared with.   fps : of the frames, Hz.
    interval_ms : ms, of rates and correlations.   zero_time : count both from their first event.
    judge : also compute how well a classifier separates b from a, and the halves of each: ``told_apart``, ``halves``.
    declared : of both files, as of :func:`open_events`. Raises AssetError, EventDataError, ConfigError."""
    from blinkgl.recordings import comparison

    return comparison.compare(
        check.path(a, "a"),
        None if b is None else check.path(b, "b"),
        frames=None if frames is None else check.path(frames, "frames"),
        fps=_fps(fps),
        interval_ms=check.number(interval_ms, "interval_ms", above=0, most=1e7),
        zero_time=bool(zero_time),
        judge=bool(judge),
        reading=_reading(declared),
    )


class ReadingOptions(EventOptions, total=False):
    """Options of frames beside a recording; :func:`blinkgl.calibrate` describes them."""

    gamma: str | float
    interpolate: str
    max_px: float
    frame_delay_ms: float | None


@check.public
def calibrate(
    recording: str | os.PathLike,
    frames: str | os.PathLike | None = None,
    *,
    emulator: EmulatorSettings = "esim",
    fixed: Iterable[str] = (),
    still: bool = False,
    fps: float | None = None,
    timestamps: str | os.PathLike | None = None,
    starts: int = 3,
    seed: int = 0,
    **reading: Unpack[ReadingOptions],
) -> Calibration:
    """Fit an emulator to a camera's own recording. Of the result, ``config`` is the fitted emulator, ``values`` and
    ``uncertainty`` belong to its fitted keys, ``untold`` gives the reasons why others were not fitted, ``judged`` is
    the difference from the recording in the fitted half and in the other, ``sensor()`` is the table of a sensor file.

    recording : event file.   frames : what the camera saw, of its size (default: the recording's own).   emulator : a
    name, or a mapping of initial values.   fixed : keys that keep their initial values.   still : a static scene in
    constant light, without frames: only noise is fitted.   fps : of the frames, Hz.   timestamps : file of the frames'
    times.   gamma : of their codes, "linear", "srgb" or an exponent.   interpolate : between them, "motion" or
    "linear".   max_px : of "motion", px.   frame_delay_ms : added to their times, ms; None: estimated.
    starts : of the search.   time_unit, size … : of the recording, as of :func:`open_events`.   Raises AssetError,
    EventDataError, ConfigError."""
    from blinkgl.front.sections import events_tree
    from blinkgl.recordings import calibration
    from blinkgl.recordings.clip import FrameReading

    listed = isinstance(fixed, Iterable) and not isinstance(fixed, str)
    given = tuple(fixed) if listed else (None,)
    keys = tuple(key for key in given if isinstance(key, str))
    if len(keys) != len(given):
        raise ConfigError("not names of keys", where="fixed", value=fixed, accepted="a list of texts")
    delay = reading.get("frame_delay_ms")
    understood = FrameReading(
        reading.get("gamma", FrameReading.gamma),
        reading.get("interpolate", FrameReading.interpolate),
        check.number(reading.get("max_px", FrameReading.max_px), "max_px", above=0, most=1000),
        None if delay is None else check.number(delay, "frame_delay_ms", least=-1e6, most=1e6),
    )
    return calibration.calibrate(
        check.path(recording, "recording"),
        None if frames is None else check.path(frames, "frames"),
        understood,
        emulator=events_tree(emulator),
        fixed=keys,
        still=bool(still),
        fps=_fps(fps),
        timestamps=None if timestamps is None else check.path(timestamps, "timestamps"),
        starts=check.whole(starts, "starts", 1, 20),
        seed=check.seed(seed),
        events=_reading(cast(EventOptions, {k: v for k, v in reading.items() if k in EventOptions.__annotations__})),
    )


class FrameOptions(TypedDict, total=False):
    """Options of frames that are converted to events; :func:`blinkgl.simulate` describes them."""

    fps: float | None
    emulator: EmulatorSettings
    gamma: str | float | None
    interpolate: str
    max_px: float
    keep_noise: bool
    seed: int
    sensor: str | None


@check.public
def simulate(
    frames: Iterable, *, report: SimulationReport | None = None, **frame_options: Unpack[FrameOptions]
) -> Iterator[Events]:
    """Yield the :class:`Events` of any stream of frames, a chunk per step, t in µs; only the current frames are stored.

    frames : iterable, a generator included, of (H, W) or (H, W, 3) RGB arrays with ``fps``, Hz, or of pairs (array,
    t_ns). uint8, uint16, or float (1.0 is white).
    emulator : as of :func:`record`, default "esim".   seed : of its noise, default 0.
    sensor : camera whose read-out limit is used and, with an emulator's name, its values; frames keep their size.
    gamma : "srgb", "linear" or an exponent; default: linear for floats, srgb for integers, except grey ones of the size
    of ``sensor``, which count as its own (``report.assumed_gamma``).   keep_noise : also make events from the noise of
    integer frames, which otherwise causes none (``report.noise``).
    interpolate : "linear", the default; "motion": dense flow, at most ``max_px`` (1) px a step, necessary for frames
    between which motion exceeds 2 px (``report.guessed_over_px``).
    report : a SimulationReport to be filled.
    Raises ConfigError at once; EventDataError during iteration, naming the frame."""
    from blinkgl.recordings import simulation

    if not isinstance(frames, Iterable) or isinstance(frames, (str, os.PathLike)):
        raise ConfigError(
            "not frames", where="frames", value=frames, accepted="an iterable of arrays; of a file, simulate_file"
        )
    use, options = _options(**frame_options)
    return simulation.frames_to_events(_frames(frames), report=report, **vars(use), **options)


@check.public
def simulate_file(
    source: str | os.PathLike,
    target: str | os.PathLike,
    *,
    timestamps: str | os.PathLike | None = None,
    size: tuple[int, int] | None = None,
    preview: str | os.PathLike | None = None,
    overwrite: bool = True,
    **frames: Unpack[FrameOptions],
) -> SimulationReport:
    """Convert a video, a folder of images or .npy frames (N, H, W[, 3]) to an event file, as
    ``blinkgl simulate``; files appear complete or not at all.

    timestamps : file of times, one a frame.   size : (height, width), px, to which frames are cropped and scaled; None:
    that of ``sensor``, or else the frames' own.   preview : a video of frames and events to write.
    frames : fps, emulator, gamma, interpolate, max_px, keep_noise, seed, sensor as of :func:`simulate`. Returns a
    report: frames, steps, events, lost … Raises AssetError, OutputError, EventDataError, ConfigError."""
    from blinkgl.recordings import simulation

    use, options = _options(**frames)
    return simulation.file_to_events(
        check.path(source, "source"),
        check.path(target, "target"),
        timestamps=None if timestamps is None else check.path(timestamps, "timestamps"),
        size=_sensor_size(frames.get("sensor")) if size is None else _size(size),
        preview=None if preview is None else check.path(preview, "preview"),
        overwrite=overwrite,
        use=use,
        **options,
    )


def _options(
    *,
    fps: float | None = None,
    emulator: EmulatorSettings = "esim",
    gamma: str | float | None = None,
    interpolate: str = "linear",
    max_px: float = 1.0,
    keep_noise: bool = False,
    seed: int = 0,
    sensor: str | None = None,
) -> tuple[FrameUse, dict[str, Any]]:
    """Return the conversion of frames to light, and the other arguments of :func:`frames_to_events`."""
    from blinkgl.config.sensor import load_sensor
    from blinkgl.front.sections import events_tree
    from blinkgl.recordings import simulation

    tree = events_tree(emulator)
    camera = None if sensor is None else load_sensor(sensor)
    if camera is not None:
        tree = {**camera.values(tree.get("emulator", "esim")), **tree}
    use = simulation.FrameUse(
        gamma,
        interpolate,
        check.number(max_px, "max_px", above=0, most=1e4),
        bool(keep_noise),
        simulation.own_frames(camera),
    )
    return use, dict(
        fps=_fps(fps),
        emulator=simulation.emulator_config(tree),
        seed=check.seed(seed),
        readout=None if camera is None else camera.readout,
    )


def _fps(fps: float | None) -> float | None:
    return None if fps is None else check.number(fps, "fps", above=0, most=1e9)


def _frames(frames: Iterable) -> Iterator:
    """Yield the items; an error names an invalid frame by its number."""
    for k, item in enumerate(frames):
        try:
            array, *rest = item if isinstance(item, tuple) else (item,)
            array = np.asarray(array)
            if not 0 <= len(rest) <= 2 or (rest and int(rest[0]) != rest[0]):
                raise ValueError
        except (TypeError, ValueError, OverflowError):
            raise EventDataError(
                "not a frame", where=f"frames[{k}]", value=item, accepted="an array, or (array, whole ns)"
            ) from None
        yield (array, *rest) if rest else array
