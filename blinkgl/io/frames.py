"""Frame sequences as input: a video, a folder of images, a stack or animation, or an array file; one frame in memory at
a time (.npz: all)."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from PIL import Image

from blinkgl.config.images import ImagesConfig
from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.images import NpzReader, check_npy, numpy_errors, over
from blinkgl.io.names import Series, series
from blinkgl.io.reading import NOTHING, Damage, Declared, EventReading, background_of, chosen
from blinkgl.io.records import inside, named, shown_names
from blinkgl.io.sequence_tables import camera_of
from blinkgl.io.stills import SUFFIXES as IMAGE, open_stills
from blinkgl.io.times import NANOSECONDS, Stamps, read_timestamps, stamps_of_array

VIDEO = frozenset(
    ".mp4 .avi .mkv .mov .webm .m4v .mpg .mpeg .ts .mts .m2ts .vob .wmv .3gp .flv .mxf .ogv .qt .y4m .h264".split()
)
STACK = {".tif", ".tiff", ".gif", ".webp", ".apng"}
RECORDING = {".aedat", ".aedat4"}
_STAMP_FILES = ("timestamps.txt", "timestamp.txt", "images.txt", "timestamps.csv", "data.csv")
_OURS = ("exposures.csv", "manifest.json")
"""Beside a folder of images of a sequence that BlinkGL wrote: its list of times is in µs."""
CALLED = ("frames", "images", "video", "luminance")
"""Names of arrays of frames."""
_LOOKED_AT = 16
"""Frames, spread over the clip, that are looked at for 16-bit codes which leave the upper two bits empty."""
_ENDINGS = tuple(f"_{unit}" for unit in NANOSECONDS)
_BITS = (8, 10, 12, 14)

Frames = Iterator[tuple[np.ndarray | None, int | None, str]]
"""Frame, own time and name; None: a damaged frame, which is left out."""


@dataclass(frozen=True)
class FrameSource:
    """Frames with their times.

    height, width : px. count : number of frames, None when unknown before the end. Iterating yields (frame, t_ns,
    name): frame (H, W) or (H, W, 3) RGB of uint8, uint16 or float32; t_ns int, strictly increasing; name for messages.

    own_times : whether the file itself has times. fps, times_ns : what is used in their place, or None. origin :
    "camera" (a camera's own frames beside its events, proportional to light), "video" or "images". transfer : curve
    that the file states: "linear", "pq", "hlg", an exponent; None: it states none. levels : codes of black and white
    that the file states, None: the ends of the type. exact : whether whoever wrote the frames says
    that they have no noise. notes : what was read that is unusual,
    or left out, a line each; more may be added while iterating.

    Raises (while iterating): AssetError for an undecodable frame, EventDataError for a changed size or times that do
    not increase, more or fewer times than frames, a single frame.
    """

    path: Path
    height: int
    width: int
    count: int | None
    _frames: Callable[[], Frames] = field(repr=False)
    own_times: bool = False
    origin: str = "images"
    transfer: str | float | None = None
    levels: tuple[float, float] | None = None
    notes: list[str] = field(default_factory=list)
    fps: float | None = None
    times_ns: list[int] | None = None
    zero_time: bool = False
    exact: bool = False

    def __iter__(self) -> Iterator[tuple[np.ndarray, int, str]]:
        last = first = None
        count = kept = 0
        for frame, own, name in self._frames():
            if frame is None:  # damaged, and left out: the others keep their times
                count += 1
                continue
            kept += 1
            if frame.shape[:2] != (self.height, self.width):
                raise EventDataError(
                    "frame size changed",
                    where=f"{self.path}: frame {count} ({name})",
                    value=frame.shape[:2],
                    accepted=f"{(self.height, self.width)} as frame 0",
                )
            t_ns = self._time(count, own)
            if last is not None and t_ns <= last:
                raise EventDataError(
                    "time stamps must increase",
                    where=f"{self.path}: frame {count} ({name})",
                    value=f"{t_ns / 1e9:.9g} s",
                    accepted=f"more than {last / 1e9:.9g} s, or --fps instead of the stamps",
                )
            if abs(t_ns) >= 2**62:
                raise EventDataError(
                    "time beyond 2^62 ns",
                    where=f"{self.path}: frame {count} ({name})",
                    value=t_ns,
                    accepted="another --time-unit",
                )
            last = t_ns
            first = t_ns if first is None else first
            yield frame, t_ns - first if self.zero_time else t_ns, name
            count += 1
        if kept < 2:
            raise EventDataError("events need at least two frames", where=str(self.path), value=f"{kept} frame(s)")
        self.check_count(count)

    def _time(self, number: int, own: int | None) -> int:
        if self.times_ns is not None:
            self.check_count(max(number + 1, len(self.times_ns)))
            return self.times_ns[number]
        if self.fps is not None:
            return round(number * 1e9 / self.fps)
        assert own is not None
        return own

    def check_count(self, count: int | None) -> None:
        """Raise EventDataError where ``count`` frames, if known, have another number of times."""
        if self.times_ns is not None and count is not None and count != len(self.times_ns):
            raise EventDataError(
                "one time stamp per frame",
                where=str(self.path),
                value=f"{len(self.times_ns)} stamps, {count} frames",
                accepted="as many, or --fps",
            )

    def timed(self, declared: Declared, stamps: Stamps | None = None) -> FrameSource:
        """Return the frames at the times that are declared, else at those of a list that lies beside them, else at
        their own. Raises EventDataError: none of these, or another number of them."""
        if declared.timestamps is not None:
            stamps = read_timestamps(Path(declared.timestamps), declared.time_unit, declared.fps)
        if stamps is None and declared.fps is None and not self.own_times:
            raise EventDataError("frames without times", where=str(self.path), accepted="--fps or --timestamps")
        if stamps is not None and stamps.note:
            self.notes.append(stamps.note)
        because = "--timestamps" if declared.timestamps else "--fps" if stamps is None and declared.fps else None
        if self.own_times and because:
            self.notes.append(f"the times in the file are not used, because of {because}")
        if stamps is None and self.times_ns is None and declared.time_unit is not None:
            self.notes.append("no list of times is read; --time-unit is not used")
        times = None if stamps is None else stamps.times_ns
        source = replace(self, fps=declared.fps, times_ns=times or self.times_ns, zero_time=declared.zero_time)
        source.check_count(self.count)
        if self.count == 1:
            raise EventDataError("events need at least two frames", where=str(self.path), value="1 frame")
        return source


def open_frames(path: str | os.PathLike, declared: Declared = NOTHING) -> FrameSource:
    """Open a video (by ending), a folder of images, a TIFF stack, an animated GIF, PNG or WebP, .npy/.npz with frames
    (N, H, W) or (N, H, W, 3), or the frames that a camera recorded beside its events (.aedat, .aedat4), at the middle
    of their exposures.

    A folder's own timestamps.txt, images.txt or data.csv, or one of these or FOLDER.txt beside it, is used
    automatically.

    Raises AssetError or EventDataError, one line naming file, frame and value; ConfigError for what cannot be declared.
    """
    path = Path(path)
    if not path.exists():
        raise AssetError("no such file or folder", where=str(path))
    suffix = path.suffix.lower()
    if path.is_dir():
        return _alone(_folder(path, declared), declared)
    if suffix in VIDEO:
        return _video(path, declared).timed(declared)
    if suffix in STACK or (suffix == ".png" and open_stills(path).pages > 1):
        return _alone(_stacks(path, Series([path]), declared).timed(declared), declared)
    if suffix in (".npy", ".npz"):
        return _array(path, declared).timed(declared)
    if suffix in RECORDING:
        return _recording(path, declared).timed(declared)
    raise AssetError(
        "unknown input",
        where=str(path),
        value=path.suffix,
        accepted=f"a video ({' '.join(sorted(VIDEO))}), a folder of images, a stack or animation "
        f"({' '.join(sorted(STACK))}), .npy, .npz, .aedat or .aedat4",
    )


_ONE_SERIES = "there is one series of frames; --stream is not used"


def _alone(source: FrameSource, declared: Declared) -> FrameSource:
    """Return the only series of a folder or file; one that is chosen of several is not there."""
    if declared.stream is not None:
        source.notes.append(_ONE_SERIES)
    return source


def read_any_image(path: Path, background: str | None = None) -> np.ndarray:
    """Return (H, W) or (H, W, 3) RGB, upright, without alpha; uint8, uint16 or float32 as in the file. Raises
    AssetError when undecodable."""
    return open_stills(Path(path)).read(background=background_of(background))


def _folder(folder: Path, declared: Declared) -> FrameSource:
    folder = named(folder)  # files beside it are looked for by its name
    pictures = series(folder, IMAGE)
    beside = [folder / name for name in _STAMP_FILES]
    beside += [folder.parent / name for name in ("images.txt", "data.csv", f"{folder.name}.txt")]
    # A declared file of times precedes the ones that data sets put beside their pictures.
    list_file = Path(declared.timestamps) if declared.timestamps else next((f for f in beside if f.is_file()), None)
    if list_file is not None and declared.timestamps is None and declared.fps is not None:
        if declared.time_unit != "frames":
            pictures.notes.append(f"{list_file.name} beside the images is not used, because of --fps")
            list_file = None
    # Times in a folder that BlinkGL wrote are microseconds; others have to say their unit.
    written = list_file is not None and any((list_file.parent.parent / name).is_file() for name in _OURS)
    usual = "us" if written else None
    stamps = None if list_file is None else read_timestamps(list_file, declared.time_unit, declared.fps, usual=usual)
    # The list may name pictures in another folder, as images.txt of ECD does.
    if not pictures.files and list_file is not None and stamps is not None and stamps.names:
        pictures = Series([p for name in stamps.names if (p := inside(list_file.parent, name)).is_file()])
    if not pictures.files:
        there = sorted({p.suffix.lower() for p in folder.iterdir() if p.is_file()} - {""})
        arrays = {".npz", ".npy"} & set(there)
        other = "" if not arrays else f"; of arrays, one file of all frames, or images ({len(there)} endings are there)"
        raise AssetError(
            "no images in the folder",
            where=str(folder),
            value=" ".join(there) or "no files",
            accepted=" ".join(sorted(IMAGE)) + other,
        )
    ours = camera_of(folder)
    source = _stacks(folder, pictures, declared, ours is not None)
    if ours is not None:
        source = _of_our_camera(source, ours, folder.name)
    if stamps is not None and stamps.names is not None and source.count == len(pictures.files):
        stamps = _by_name(stamps, pictures, str(list_file))
    return source.timed(replace(declared, timestamps=None), stamps)


def _stacks(where: Path, series_: Series, declared: Declared, ours: bool = False) -> FrameSource:
    """Return the pages of all files as frames.   ours : what the codes mean is known."""
    files, background, notes = series_.files, background_of(declared.background), series_.notes
    first = open_stills(files[0])
    # Only stacks and animations have pages, so that the others need not be opened before their turn.
    stacked = first.pages > 1 or {p.suffix.lower() for p in files} & STACK
    opened = [open_stills(p) for p in files] if stacked else [first]
    pages = sum(one.pages for one in opened) if stacked else len(files)
    delays = [delay for one in opened for delay in one.delays_ms or []]
    # A frame begins when the delays before it have passed.
    own = [round(1e6 * t) for t in np.cumsum([0.0, *delays])] if len(delays) == pages else None
    times = None
    if own is not None and declared.fps is None and declared.timestamps is None:
        shown = f"{min(delays):g}" if min(delays) == max(delays) else f"{min(delays):g} to {max(delays):g}"
        notes.append(f"each frame is shown for {shown} ms, as the file says (--fps for another rate)")
    elif declared.fps is not None and pages == len(files) and (places := series_.places()) is not None:
        notes += series_.missing()
        times = [round(int(place) * 1e9 / declared.fps) for place in places]

    mixed = not stacked and _mixed(files)
    if mixed:
        notes.append("grey and colour pictures in one folder: all are taken as colour")

    def frames() -> Frames:
        number = 0
        for path in files:
            one = open_stills(path)
            try:
                for image in one.iterate(background):
                    image = np.repeat(image[..., None], 3, axis=2) if mixed and image.ndim == 2 else image
                    time = own[number] if own else None
                    yield image, time, path.name if one.pages == 1 else f"{path.name} page {number}"
                    number += 1
            except Damage as error:
                if declared.damaged != "keep":
                    accepted = "a whole picture; or --damaged keep"
                    raise Damage(error.problem, where=error.where, accepted=accepted) from None
                note = f"left out: {path.name}: {error.problem}"
                notes.extend([note] if note not in notes else [])
                # Its time stays empty: that of the others does not move.
                yield None, None, path.name
                number += 1
            notes.extend(note for note in one.notes if note not in notes)

    image = next((image for image, _, _ in frames() if image is not None), None)
    if image is None:
        raise Damage("no picture of the folder can be decoded", where=str(where))
    declares = ours or declared.white_level is not None or declared.range is not None
    levels = stated_levels(files, ask=image.dtype == np.uint16 and not declares)
    (height, width), has = image.shape[:2], own is not None
    return FrameSource(
        where, height, width, pages, frames, has, transfer=first.transfer, levels=levels, notes=notes, times_ns=times
    )


def _of_our_camera(source: FrameSource, camera: ImagesConfig, pictures: str) -> FrameSource:
    """Return the frames with what the sequence's frame camera says of their codes and noise."""
    top = float(2**camera.bits - 1)
    transfer = {"linear": "linear", "gamma": camera.gamma}.get(camera.response)
    quiet = pictures == "clean" or not (camera.photon_noise or camera.read_noise)
    words = f"{camera.response}, {camera.bits} bits" + (f", {camera.bayer} filters" if camera.bayer else "")
    notes = [*source.notes]
    notes.append(f"the sequence's frame camera: {words}, {'no noise' if quiet else 'with its noise'}")
    # No light has the black level, on the scale of light.
    levels = (camera.black * top, top) if camera.response == "linear" else (0.0, top)
    return replace(source, transfer=transfer, levels=levels, notes=notes, exact=quiet)


def _mixed(files: list[Path]) -> bool:
    """Return whether some pictures are grey and some colour, by their headers."""
    kinds = set()
    for path in files:
        if path.suffix.lower() in _HEADERS:
            with contextlib.suppress(Exception), Image.open(path) as image:  # what cannot be opened is refused later
                kinds.add(image.mode in ("1", "L", "LA", "I;16", "I;16B", "I", "F"))
    return len(kinds) == 2


_HEADERS = {".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".pnm", ".pbm", ".tga", ".jp2", ".avif"}


def stated_levels(files: Sequence[Path], *, ask: bool) -> tuple[float, float] | None:
    """Return the codes of black and white that pictures state; None: the ends of their type.   ask : whether the codes
    have 16 bits, and nobody else says what is white. Raises AssetError as :func:`_ask_for_white`."""
    white = open_stills(files[0]).white
    levels = None if white is None else (0.0, float(white))
    if not ask:
        return levels
    top = max(_largest_code(files[int(k)]) for k in np.unique(np.linspace(0, len(files) - 1, _LOOKED_AT)))
    if levels is not None and top <= levels[1]:
        return levels
    # PNG's sBIT allows codes of the full scale, too.
    _ask_for_white(top, str(files[0].parent if len(files) > 1 else files[0]))
    return None


def _largest_code(path: Path) -> int:
    with contextlib.suppress(Damage):  # whoever reads the frames says it
        return max(int(image.max()) for image in open_stills(path).iterate())
    return 0


def _ask_for_white(top: int, where: str) -> None:
    """Raise AssetError, with the option to paste, for 16-bit codes up to ``top`` that leave the upper two bits empty:
    a camera's codes, or a dark film."""
    bits = next((bits for bits in _BITS if 0 < top < 2**bits), 16)
    if bits < 16:
        raise AssetError(
            "no code of white is stated for 16-bit frames",
            where=where,
            value=f"codes up to {top:,}",
            accepted=f"try --white-level {2**bits - 1} of {bits} bits, or 65535 if dark (white_level in a recipe)",
        )


def _by_name(stamps: Stamps, found: Series, where: str) -> Stamps:
    """Return the times of the files, by their names, with the folders that the list gives (those of several cameras).
    Raises EventDataError: a file without, or with several."""
    listed: dict[str, list[tuple[str, int]]] = {}
    for text, t in zip(stamps.names or (), stamps.times_ns):
        listed.setdefault(Path(text).name, []).append((Path(text).as_posix(), t))
    times = []
    for p in found.files:
        rows, whole = listed.get(p.name) or listed.get(p.stem) or [], Path(os.path.abspath(p))
        ends = (f"/{whole.as_posix()}", f"/{whole.with_suffix('').as_posix()}")
        own = {t for text, t in rows if any(end.endswith(f"/{text}") for end in ends)} or {t for _, t in rows}
        if len(own) != 1:
            problem = f"{len(own)} time stamps for image {p.name}" if own else f"no time stamp for image {p.name}"
            raise EventDataError(problem, where=where)
        times += own
    if left := len(stamps.times_ns) - len(found.files):
        found.notes.append(f"{Path(where).name}: {left} times of images that are not in the folder are left out")
    return replace(stamps, times_ns=times)


def _video(path: Path, declared: Declared) -> FrameSource:
    from blinkgl.io.video import VideoReader

    below = background_of(declared.background)
    keep = declared.damaged == "keep"
    reader = VideoReader(
        path,
        range=declared.range,
        background=below,
        zero_time=declared.zero_time,
        keep=keep,
        stream=declared.stream,
    )
    frames = lambda: ((frame, t_ns, f"#{i}") for i, (frame, t_ns) in enumerate(reader))
    timed = None not in reader.times_ns
    # Some packets hold no picture, so a list of times is compared at the end.
    count = reader.count if declared.timestamps is None else None
    return FrameSource(
        path,
        reader.height,
        reader.width,
        count,
        frames,
        timed,
        origin="video",
        transfer=reader.transfer,
        levels=reader.levels,
        notes=reader.notes,
    )


def _array(path: Path, declared: Declared) -> FrameSource:
    notes: list[str] = []
    own: list[int] | None = None
    with numpy_errors(path):
        # .npy is mapped, so that frames are read as they are asked for; an archive has to be unpacked.
        if path.suffix.lower() == ".npy":
            check_npy(path)
            frames = np.load(path, mmap_mode="r", allow_pickle=False)
            notes += [] if declared.stream is None else [_ONE_SERIES]
        else:
            with NpzReader(path) as data:
                held = [k for k in CALLED if k in data]
                if declared.stream is not None and declared.stream in data:
                    held = [declared.stream]
                if not held:
                    raise AssetError(
                        "no array 'frames'", where=str(path), value=data.names, accepted="--array NAME, or one 'frames'"
                    )
                name = held[chosen(declared.stream, held, str(path), "arrays of frames")]
                frames = data[name]
                called = [f"{k}{unit}" for k in ("timestamps", "times", "time", "ts", "t") for unit in ("", *_ENDINGS)]
                # Names of times, with and without their unit behind: "t", "t_us", "timestamps_ns" …
                stamp = next((k for k in called if k in data), None)
                if stamp is not None and declared.fps is None and declared.timestamps is None:
                    stamps = stamps_of_array(stamp, data[stamp], declared.time_unit, str(path))
                    own, notes = stamps.times_ns, [stamps.note] if stamps.note else []
                others = [k for k in data.names if k not in (name, stamp)]
                notes = [*notes, *([f"left out: {shown_names(others)}, beside the frames"] if others else [])]
                if stamp is not None and own is None:
                    notes.append(f"'{stamp}' in the file is not used, because of --fps or --timestamps")
    # (N, H, W) grey, or the last axis holds channels.
    if not (frames.ndim == 3 or (frames.ndim == 4 and frames.shape[3] in (1, 3, 4))) or not frames.shape[0]:
        raise AssetError("not frames", where=str(path), value=frames.shape, accepted="(N, H, W), (N, H, W, 3 or 4)")
    if frames.dtype == bool:
        frames = frames.view(np.uint8) * np.uint8(255)
    if frames.dtype not in (np.uint8, np.uint16) and frames.dtype.kind != "f":
        raise AssetError(
            "unsupported pixel type", where=str(path), value=str(frames.dtype), accepted="uint8, uint16 or float"
        )
    # 12 bits in 16 look as 16 do: the largest code of all frames is needed for the question.
    if frames.dtype == np.uint16 and declared.white_level is None and declared.range is None:
        _ask_for_white(max(int(frame.max()) for frame in frames), str(path))

    def read() -> Frames:
        for i, frame in enumerate(frames):
            frame = frame[..., 0] if frame.ndim == 3 and frame.shape[2] == 1 else frame
            if frame.ndim == 3 and frame.shape[2] == 4:
                frame, note = over(np.asarray(frame), background_of(declared.background))
                notes.extend([note] if note and note not in notes else [])
            yield np.asarray(frame, np.float32 if frame.dtype.kind == "f" else None), None, f"#{i}"

    (height, width), has = frames.shape[1:3], own is not None
    return FrameSource(path, height, width, len(frames), read, has, notes=notes, times_ns=own)


def _recording(path: Path, declared: Declared) -> FrameSource:
    """Frames that a camera recorded beside its events."""
    from blinkgl.io.formats import open_events

    file = open_events(path, EventReading.of(stream=declared.stream))
    first = next(file.frames(), None)
    if first is None:
        raise EventDataError("events need at least two frames", where=str(path), value="0 frames")
    frames = lambda: ((frame.image, frame.t_us * 1000, f"#{i}") for i, frame in enumerate(file.frames()))
    height, width = first.image.shape[:2]
    return FrameSource(path, height, width, None, frames, True, origin="camera", transfer="linear")
