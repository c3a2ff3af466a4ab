"""Files of events and flow, conversion of frames to events, comparison of two recordings.

Each function imports what it needs when it is called, so that reading an event file loads no emulator."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

import numpy as np

from blinkgl.errors import ConfigError, EventDataError
from blinkgl.front import arguments as check
from blinkgl.front.event_files import EventOptions, checked_size, event_reading
from blinkgl.types.events import Events

if TYPE_CHECKING:
    from blinkgl.front.sections import Section
    from blinkgl.io.reading import Declared
    from blinkgl.recordings.calibration import Calibration
    from blinkgl.recordings.comparison import Comparison
    from blinkgl.recordings.simulation import FrameUse, SimulationReport

_SIDE = 65535


@check.public()
def read_flow(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
    """Return flow (H, W, 2) float32 px, +x right, +y down (0 where invalid), and valid (H, W) bool,
    of a .png (DSEC), .flo or .npy file.

    Raises AssetError: missing, damaged, or not flow."""
    from blinkgl.io import flow as flow_files

    return flow_files.read_flow(check.path(path, "path"))


@check.public()
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


@check.public()
def read_trajectory(
    path: str | os.PathLike,
    *,
    form: str | None = None,
    columns: str | None = None,
    time_unit: str | None = None,
    maps_from: str | None = None,
    axes: str | None = None,
    rate: float | None = None,
    times: str | os.PathLike | None = None,
    notes: list[str] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) int64 ns and poses T_world_body (N, 4, 4) float64, with OpenCV's axes, of a table with or
    without a heading, KITTI's poses, COLMAP's images.txt or NeRF's transforms.json.

    form : "tum", "euroc", "orbslam", "kitti", "tartanair", "colmap", "nerf"; None: by heading and content.
    columns : names, such as "t x y z qw qx qy qz".   time_unit : "s", "ms", "us", "ns".   maps_from : "camera" or
    "world".   axes : of the camera, "opencv", "opengl", "ned".   rate : poses per second, or times : a file of times,
    for a file without them.   notes : gets what was recognised, a line each.
    Raises AssetError with the line: invalid pose, times that do not increase, a gap; ConfigError."""
    from blinkgl.io import trajectories

    words = {"form": form, "columns": columns, "time_unit": time_unit, "maps_from": maps_from, "axes": axes}
    for where, word in words.items():
        check.one_of(word, where, (str, type(None)), "text, or None")
    per_second = None if rate is None else check.number(rate, "rate", above=0, most=1e9)
    stamps = None if times is None else check.path(times, "times")
    declared = trajectories.PoseFile(
        form=form, columns=columns, time_unit=time_unit, maps_from=maps_from, axes=axes, rate=per_second, times=stamps
    )
    return trajectories.read_trajectory(check.path(path, "path"), declared, notes)


@check.public()
def write_trajectory(path: str | os.PathLike, t_ns: np.ndarray, poses: np.ndarray) -> None:
    """Write poses (N, 4, 4) at t_ns (N,) whole ns as TUM's text, t x y z qx qy qz qw. A sequence's
    ``poses.npz`` has them as ``t_ns`` and ``T_world_cam``. Raises OutputError, ConfigError."""
    from blinkgl.config.poses import are_rigid
    from blinkgl.front.poses import Pose
    from blinkgl.io import trajectories

    times = check.array(t_ns, "t_ns", (None,), "an array (N,) of whole ns")
    placed = check.array(poses, "poses", (len(times), 4, 4), f"an array ({len(times)}, 4, 4)")
    if times.dtype.kind not in "iu" or (times[1:] <= times[:-1]).any():
        raise ConfigError(
            "times do not increase", where="t_ns", value=times[:3].tolist(), accepted="whole ns, in order"
        )
    for k in np.flatnonzero(~are_rigid(placed)):
        Pose.from_matrix(placed[k], f"poses[{k}]")  # names what is wrong with it
    trajectories.write_trajectory(check.path(path, "path"), times, placed.astype(np.float64))


class DeclaredBoth(EventOptions, total=False):
    """What event files do not say (:func:`blinkgl.open_events`), nor frames beside them."""

    fps: float | None
    timestamps: str | os.PathLike | None
    frames_time_unit: str | None
    white_level: float | None
    range: str | None
    background: str | None


@check.public(DeclaredBoth)
def compare(
    a: str | os.PathLike,
    b: str | os.PathLike | None = None,
    *,
    frames: str | os.PathLike | None = None,
    interval_ms: float = 20.0,
    zero_time: bool = False,
    gamma: str | float | None = None,
    frame_delay_ms: float = 0.0,
    **declared: Unpack[DeclaredBoth],
) -> Comparison:
    """Compare two event files over their common time: ``rows()`` is a table, ``to_dict()`` numbers.

    b : event file; None: only ``a`` is described.
    frames : video or folder of images that both are compared with.   gamma : of their codes; None: what the file
    states, linear for grey images, srgb for video and colour.   frame_delay_ms : added to their times, ms.   declared :
    what the file does not say of them, as of :func:`simulate_file` (``frames_time_unit`` is its ``time_unit``).
    interval_ms : ms, of rates and correlations.   zero_time : count both from their first event, and frames from the
    first.
    time_unit, size … : of both event files, as of :func:`open_events`.
    Raises AssetError, EventDataError, ConfigError."""
    from blinkgl.recordings import comparison

    return comparison.compare(
        check.path(a, "a"),
        None if b is None else check.path(b, "b"),
        frames=None if frames is None else check.path(frames, "frames"),
        declared=_declared(declared, "frames_time_unit"),
        gamma=gamma,
        frame_delay_ms=check.number(frame_delay_ms, "frame_delay_ms", least=-1e6, most=1e6),
        interval_ms=check.number(interval_ms, "interval_ms", above=0, most=1e7),
        zero_time=bool(zero_time),
        reading=event_reading(declared),
    )


class ReadingOptions(DeclaredBoth, total=False):
    """Options of frames beside a recording; :func:`blinkgl.calibrate` describes them."""

    zero_time: bool
    gamma: str | float | None
    interpolate: str
    max_px: float
    frame_delay_ms: float | None


@check.public(ReadingOptions)
def calibrate(
    recording: str | os.PathLike,
    frames: str | os.PathLike | None = None,
    *,
    emulator: Section = "esim",
    fixed: Iterable[str] = (),
    still: bool = False,
    starts: int = 3,
    seed: int = 0,
    **reading: Unpack[ReadingOptions],
) -> Calibration:
    """Fit an emulator to a camera's own recording. Of the result, ``config`` is the fitted emulator, ``values`` and
    ``uncertainty`` belong to its fitted keys, ``undetermined`` gives the reasons why others were not fitted,
    ``judged`` is the difference from the recording in the fitted half and in the other, ``sensor()`` is the table of a
    sensor file.

    recording : event file.   frames : what the camera saw, of its size (default: the recording's own).   emulator : a
    name, or a mapping of initial values.   fixed : keys that keep their initial values.   still : a static scene in
    constant light, without frames: only noise is fitted.   fps, timestamps, frames_time_unit, white_level, range,
    background : of the frames, as of :func:`simulate_file`.   zero_time : count events from the first, and frames from
    the first.   gamma : of their codes; None: what the file states, linear for grey images, srgb for video and colour.
    interpolate : between them, "motion" or "linear".   max_px : of "motion", px.   frame_delay_ms : added to their
    times, ms; None: estimated.   starts : of the search.   time_unit, size … : of the recording, as of
    :func:`open_events`.   Raises AssetError, EventDataError, ConfigError."""
    from blinkgl.front.sections import section_tree
    from blinkgl.recordings import calibration
    from blinkgl.recordings.clip import FrameReading
    from blinkgl.recordings.decoding import Codes

    listed = isinstance(fixed, Iterable) and not isinstance(fixed, str)
    items = tuple(fixed) if listed else (None,)
    keys = tuple(key for key in items if isinstance(key, str))
    if len(keys) != len(items):
        raise ConfigError("not names of keys", where="fixed", value=fixed, accepted="a list of texts")
    delay = reading.get("frame_delay_ms")
    understood = FrameReading(
        Codes(reading.get("gamma")),
        reading.get("interpolate", FrameReading.interpolate),
        check.number(reading.get("max_px", FrameReading.max_px), "max_px", above=0, most=1000),
        None if delay is None else check.number(delay, "frame_delay_ms", least=-1e6, most=1e6),
    )
    return calibration.calibrate(
        check.path(recording, "recording"),
        None if frames is None else check.path(frames, "frames"),
        understood,
        emulator=section_tree("emulator", emulator),
        fixed=keys,
        still=bool(still),
        declared=_declared(reading, "frames_time_unit"),
        starts=check.whole(starts, "starts", 1, 20),
        seed=check.seed(seed),
        events=event_reading(reading),
    )


class FrameOptions(TypedDict, total=False):
    """Options of frames that are converted to events; :func:`blinkgl.simulate` describes them."""

    fps: float | None
    zero_time: bool
    white_level: float | None
    range: str | None
    emulator: Section
    gamma: str | float | None
    interpolate: str
    max_px: float
    keep_noise: bool
    seed: int
    sensor: str | None


@check.public(FrameOptions)
def simulate(
    frames: Iterable, *, unit: str = "ns", report: SimulationReport | None = None, **frame_options: Unpack[FrameOptions]
) -> Iterator[Events]:
    """Yield the :class:`Events` of any stream of frames, t in µs: one chunk per frame, an empty one too, as soon as
    that frame has come. Nothing of an array is used after the next is asked for, so that one buffer may serve all.

    frames : iterable, a generator included, of (H, W) or (H, W, 3) RGB arrays with ``fps``, Hz, or of pairs (array,
    time). uint8, uint16, or float.   unit : of the times: "ns", whole numbers, or "s", "ms", "us", floats too.
    zero_time : count times from the first frame.   white_level : code of white (default: the type's largest, 1.0 of
    floats).   range : "limited" for codes from 16 to 235 of 8 bits.
    emulator : as of :func:`record`, default "esim".   seed : of its noise, default 0.
    sensor : camera whose read-out limit is used and, with an emulator's name, its values; frames keep their size.
    gamma : "srgb", "linear", "pq", "hlg" or an exponent; default: linear for floats, srgb for integers, except grey
    ones of the size of ``sensor``, which count as its own (``report.assumed_gamma``, ``report.notes``).   keep_noise :
    also make events from the noise of integer frames, which otherwise causes none (``report.noise``). interpolate :
    "linear", the default; "motion": dense flow, at most ``max_px`` (1) px a step, necessary for frames between which
    motion exceeds 2 px (``report.guessed_over_px``). report : a SimulationReport to be filled. Raises ConfigError at
    once; EventDataError during iteration, naming the frame."""
    from blinkgl.recordings import simulation

    if not isinstance(frames, Iterable) or isinstance(frames, (str, os.PathLike)):
        raise ConfigError(
            "not frames", where="frames", value=frames, accepted="an iterable of arrays; of a file, simulate_file"
        )
    use, options, _ = _options(**frame_options)
    if unit not in ("ns", "us", "ms", "s"):
        raise ConfigError("unknown unit of time", where="unit", value=unit, accepted="s, ms, us or ns")
    return simulation.frames_to_events(_frames(frames), use, unit=unit, report=report, **options)


@check.public(FrameOptions)
def simulate_file(
    source: str | os.PathLike,
    target: str | os.PathLike,
    *,
    timestamps: str | os.PathLike | None = None,
    time_unit: str | None = None,
    background: str | None = None,
    stream: int | str | None = None,
    damaged: str = "refuse",
    size: tuple[int, int] | None = None,
    preview: str | os.PathLike | None = None,
    overwrite: bool = True,
    **frames: Unpack[FrameOptions],
) -> SimulationReport:
    """Convert a video, a folder of images, a stack or .npy frames (N, H, W[, 3]) to an event file, as
    ``blinkgl simulate``; files appear complete or not at all.

    timestamps : file of times, one a frame.   time_unit : of these, "s", "ms", "us", "ns" or "frames" of fps; None: as
    the file says.   background : below transparent pixels, "black", "grey", "white" or "#rrggbb".   stream : of several
    arrays, videos or cameras, by name or number.   damaged : "refuse", or "keep" the frames that are whole.   size :
    (height, width), px, to which frames are cropped and scaled; None: that of ``sensor``, or else the frames' own.
    preview : a video of frames and events to write. frames : fps, zero_time, white_level, range, emulator, gamma,
    interpolate, max_px, keep_noise, seed, sensor as of :func:`simulate`. Returns a report: frames, steps, events, lost,
    notes on what was left out … Raises AssetError, OutputError, EventDataError, ConfigError."""
    from blinkgl.recordings import simulation

    use, options, sensor_size = _options(**frames)
    declared: dict[str, object] = {**frames, "timestamps": timestamps, "time_unit": time_unit, "background": background}
    declared |= {"stream": stream, "damaged": damaged}
    options = {key: options[key] for key in ("emulator", "seed", "readout")}
    return simulation.file_to_events(
        check.path(source, "source"),
        check.path(target, "target"),
        declared=_declared(declared),
        size=sensor_size if size is None else checked_size(size),
        preview=None if preview is None else check.path(preview, "preview"),
        overwrite=overwrite,
        use=use,
        **options,
    )


def _options(
    *,
    fps: float | None = None,
    zero_time: bool = False,
    white_level: float | None = None,
    range: str | None = None,
    emulator: Section = "esim",
    gamma: str | float | None = None,
    interpolate: str = "linear",
    max_px: float = 1.0,
    keep_noise: bool = False,
    seed: int = 0,
    sensor: str | None = None,
) -> tuple[FrameUse, dict[str, Any], tuple[int, int] | None]:
    """Return the conversion of frames to light, the other arguments of :func:`frames_to_events`, and the sensor's
    height and width, px."""
    from blinkgl.front.sections import section_tree
    from blinkgl.recordings import simulation
    from blinkgl.recordings.decoding import Codes

    chosen, camera = simulation.with_sensor(section_tree("emulator", emulator), sensor)
    declared = _declared({"white_level": white_level, "range": range, "fps": fps})
    use = simulation.FrameUse(
        Codes(gamma, declared.white_level, declared.range, simulation.own_frames(camera)),
        interpolate,
        check.number(max_px, "max_px", above=0, most=1e4),
        bool(keep_noise),
    )
    options = dict(
        fps=declared.fps,
        zero_time=bool(zero_time),
        emulator=chosen,
        seed=check.seed(seed),
        readout=None if camera is None else camera.readout,
    )
    return use, options, None if camera is None else (camera.height, camera.width)


def _declared(options: Mapping[str, Any], unit: str = "time_unit") -> Declared:
    """Return what is declared of frames; ``unit`` is the key of the unit of their times. Raises ConfigError."""
    from blinkgl.io.reading import Declared

    fps, white, stamps = options.get("fps"), options.get("white_level"), options.get("timestamps")
    return Declared(
        fps=None if fps is None else check.number(fps, "fps", above=0, most=1e9),
        timestamps=None if stamps is None else check.path(stamps, "timestamps"),
        time_unit=options.get(unit),
        zero_time=bool(options.get("zero_time", False)),
        white_level=None if white is None else check.number(white, "white_level", above=0, most=1e9),
        range=options.get("range"),
        background=options.get("background"),
        # The events' stream is no frames' stream: which frames belong to it is found where both are opened.
        stream=None if unit != "time_unit" or options.get("stream") is None else str(options["stream"]),
        damaged=options.get("damaged", "refuse"),
    )


def _frames(frames: Iterable) -> Iterator:
    """Yield the items; an error names an invalid frame by its number."""
    for k, item in enumerate(frames):
        try:
            array, *rest = item if isinstance(item, tuple) else (item,)
            array = np.asarray(array)
            if not 0 <= len(rest) <= 2 or (rest and not isinstance(rest[0], (int, float, np.integer, np.floating))):
                raise ValueError
        except (TypeError, ValueError, OverflowError):
            raise EventDataError(
                "not a frame", where=f"frames[{k}]", value=item, accepted="an array, or (array, time)"
            ) from None
        yield (array, *rest) if rest else array
