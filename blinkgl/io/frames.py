"""Frame sequences as input: a video, a folder of images, or an array file; one frame in memory at a time (.npz:
all)."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.images import NpzReader, check_npy, numpy_errors, read_image

VIDEO = {".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".gif", ".mpg", ".mpeg", ".ts", ".wmv"}
IMAGE = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm", ".exr", ".hdr", ".pfm"}
RECORDING = {".aedat", ".aedat4"}
_STAMP_FILES = ("timestamps.txt", "images.txt", "timestamps.csv")


@dataclass(frozen=True)
class FrameSource:
    """Frames with their times.

    height, width : px. count : number of frames, None when unknown before the end. linear : whether codes
    are known to be proportional to light (a camera's own frames beside its events). Iterating yields (frame, t_ns,
    name): frame (H, W) or (H, W, 3) RGB
    of uint8, uint16 or float32; t_ns int, strictly increasing; name for messages.

    Raises (while iterating): AssetError for an undecodable frame, EventDataError for a changed size or times that do
    not increase, a single frame.
    """

    path: Path
    height: int
    width: int
    count: int | None
    fps: float | None
    _frames: Callable[[], Iterator[tuple[np.ndarray, int | None, str]]] = field(repr=False)
    linear: bool = False

    def __iter__(self) -> Iterator[tuple[np.ndarray, int, str]]:
        last = None
        index = -1
        for index, (frame, t_ns, name) in enumerate(self._frames()):
            if frame.shape[:2] != (self.height, self.width):
                raise EventDataError(
                    "frame size changed",
                    where=f"{self.path}: frame {index} ({name})",
                    value=frame.shape[:2],
                    accepted=f"{(self.height, self.width)} as frame 0",
                )
            if t_ns is None:
                t_ns = round(index * 1e9 / self.fps)
            if last is not None and t_ns <= last:
                raise EventDataError(
                    "time stamps must increase",
                    where=f"{self.path}: frame {index} ({name})",
                    value=f"{t_ns / 1e9:.9g} s",
                    accepted=f"more than {last / 1e9:.9g} s",
                )
            last = t_ns
            yield frame, t_ns, name
        if index < 1:
            raise EventDataError("events need at least two frames", where=str(self.path), value=f"{index + 1} frame(s)")


def open_frames(
    path: str | os.PathLike, *, fps: float | None = None, timestamps: str | os.PathLike | None = None
) -> FrameSource:
    """Open a video (by ending), a folder of images, .npy/.npz with frames (N, H, W) or (N, H, W, 3), or the frames that
    a camera recorded beside its events (.aedat, .aedat4), at the middle of their exposures.

    fps : frame rate; overrides the video's own and any time stamps. timestamps : file with one time per frame, or "time
    name" lines as the Event Camera Dataset's images.txt (integers are µs, numbers with a point seconds). A folder's own
    timestamps.txt, or an images.txt in it or its parent, is used automatically.

    Raises AssetError or EventDataError, one line naming file, frame and value.
    """
    path = Path(path)
    if fps is not None and not (np.isfinite(fps) and fps > 0):
        raise EventDataError("frame rate", where="--fps", value=fps, accepted="a positive number")
    if not path.exists():
        raise AssetError("no such file or folder", where=str(path))
    if path.is_dir():
        source = _folder(path, fps, timestamps)
    elif path.suffix.lower() in VIDEO:
        source = _video(path, fps, timestamps)
    elif path.suffix.lower() in (".npy", ".npz"):
        source = _array(path, fps, timestamps)
    elif path.suffix.lower() in RECORDING:
        source = _recording(path, fps, timestamps)
    else:
        raise AssetError(
            "unknown input",
            where=str(path),
            value=path.suffix,
            accepted="a video (" + " ".join(sorted(VIDEO)) + "), a folder of images, .npy, .npz, .aedat or .aedat4",
        )
    if source.count == 1:
        raise EventDataError("events need at least two frames", where=str(path), value="1 frame")
    return source


def read_any_image(path: Path) -> np.ndarray:
    """Return (H, W) or (H, W, 3) RGB; uint8, uint16 or float32 as in the file. Raises AssetError when undecodable."""
    if path.suffix.lower() == ".pfm":
        from blinkgl.io.images import read_pfm

        return read_pfm(path)
    if path.suffix.lower() == ".exr":
        from blinkgl.io.video import read_exr

        return read_exr(path)
    image = read_image(path)
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise AssetError(
            "unsupported pixel type", where=str(path), value=str(image.dtype), accepted="8-bit, 16-bit or float32"
        )
    return image


def _folder(folder: Path, fps: float | None, timestamps) -> FrameSource:
    files = sorted((p for p in folder.iterdir() if p.suffix.lower() in IMAGE and p.is_file()), key=_natural)
    stamp_file = (
        Path(timestamps)
        if timestamps
        else next((f for f in [folder / n for n in _STAMP_FILES] + [folder.parent / "images.txt"] if f.is_file()), None)
    )
    times: list[int | None]
    stamps = read_timestamps(stamp_file) if stamp_file is not None and fps is None else None
    if stamps is not None and stamps[0][1] is not None:  # "time name" lines
        if not files:
            files = [p for _, name in stamps if (p := stamp_file.parent / name).is_file()]
        by_name = {Path(name).name: t for t, name in stamps}
        if missing := [p.name for p in files if p.name not in by_name]:
            raise EventDataError(f"no time stamp for image {missing[0]}", where=str(stamp_file))
        times = [by_name[p.name] for p in files]
    elif stamps is not None:
        if len(stamps) != len(files):
            raise EventDataError(
                "one time stamp per image", where=str(stamp_file), value=f"{len(stamps)} stamps, {len(files)} images"
            )
        times = [t for t, _ in stamps]
    else:
        times = [None] * len(files)
    if not files:
        raise AssetError("no images in the folder", where=str(folder), accepted=" ".join(sorted(IMAGE)))
    if times[0] is None and fps is None:
        raise EventDataError(
            "frames without times", where=str(folder), accepted="--fps, or a timestamps.txt beside the images"
        )
    first = read_any_image(files[0])
    return FrameSource(
        folder,
        *first.shape[:2],
        len(files),
        fps,
        lambda: ((read_any_image(p), t, p.name) for p, t in zip(files, times)),
    )


def _video(path: Path, fps: float | None, timestamps) -> FrameSource:
    from blinkgl.io.video import VideoReader

    reader = VideoReader(path)
    times = [t for t, _ in read_timestamps(Path(timestamps))] if timestamps and fps is None else None
    fps = fps or reader.fps
    if not fps and times is None:
        raise EventDataError("video without a frame rate", where=str(path), accepted="--fps")

    def frames():
        for i, frame in enumerate(reader):
            if times is not None and i >= len(times):
                raise EventDataError(
                    f"no time stamp for frame {i}", where=str(timestamps), value=f"{len(times)} stamps"
                )
            yield frame, times[i] if times is not None else None, f"#{i}"

    return FrameSource(path, reader.height, reader.width, reader.expected or None, fps, frames)


def _array(path: Path, fps: float | None, timestamps) -> FrameSource:
    times = None
    with numpy_errors(path):
        if path.suffix.lower() == ".npy":
            check_npy(path)
            frames = np.load(path, mmap_mode="r", allow_pickle=False)
        else:
            with NpzReader(path) as data:
                name = next((k for k in ("frames", "images", "video", "luminance") if k in data), None)
                if name is None:
                    raise AssetError("no array 'frames'", where=str(path), value=data.names)
                frames = data[name]
                stamp = next(
                    (k for k in ("timestamps", "t", "times", "timestamps_us", "timestamps_ns") if k in data), None
                )
                times = _stamps(stamp, data[stamp]) if stamp else None
    if not (frames.ndim == 3 or (frames.ndim == 4 and frames.shape[3] in (1, 3))) or not frames.shape[0]:
        raise AssetError("not frames", where=str(path), value=frames.shape, accepted="(N, H, W) or (N, H, W, 3)")
    if frames.dtype not in (np.uint8, np.uint16) and frames.dtype.kind != "f":
        raise AssetError(
            "unsupported pixel type", where=str(path), value=str(frames.dtype), accepted="uint8, uint16 or float"
        )
    if timestamps:
        times = [t for t, _ in read_timestamps(Path(timestamps))]
    if fps is not None:
        times = None
    elif times is None:
        raise EventDataError("frames without times", where=str(path), accepted="--fps or --timestamps")
    elif len(times) != len(frames):
        raise EventDataError(
            "one time stamp per frame", where=str(path), value=f"{len(times)} stamps, {len(frames)} frames"
        )

    def iterate():
        for i in range(len(frames)):
            frame = np.ascontiguousarray(frames[i])
            if frame.dtype.kind == "f":
                with np.errstate(over="ignore"):  # becomes inf, which a later check refuses by name
                    frame = frame.astype(np.float32)
            yield (
                frame[..., 0] if frame.ndim == 3 and frame.shape[2] == 1 else frame,
                times[i] if times else None,
                f"#{i}",
            )

    return FrameSource(path, *frames.shape[1:3], len(frames), fps, iterate)


def _recording(path: Path, fps: float | None, timestamps) -> FrameSource:
    from blinkgl.io.formats import open_events

    times = [t for t, _ in read_timestamps(Path(timestamps))] if timestamps and fps is None else None
    file = open_events(path)
    first = next(file.frames(), None)
    if first is None:
        raise EventDataError("events need at least two frames", where=str(path), value="0 frames")

    def frames() -> Iterator[tuple[np.ndarray, int | None, str]]:
        for i, frame in enumerate(file.frames()):
            if times is not None and i >= len(times):
                raise EventDataError(
                    f"no time stamp for frame {i}", where=str(timestamps), value=f"{len(times)} stamps"
                )
            yield frame.image, None if fps else times[i] if times is not None else frame.t_us * 1000, f"#{i}"

    return FrameSource(path, *first.image.shape[:2], None, fps, frames, linear=True)


def _stamps(name: str, values: np.ndarray) -> list[int]:
    """Return ns of an array of times: by its name's unit, else floats are seconds and integers µs."""
    unit = 1 if name.endswith("_ns") else 1000 if name.endswith("_us") or values.dtype.kind != "f" else 10**9
    return [round(float(t) * unit) if values.dtype.kind == "f" else int(t) * unit for t in values]


def read_timestamps(path: Path) -> list[tuple[int, str | None]]:
    """Return (t_ns, name or None) per line of "time" or "time name"; integers are µs, numbers with a point or exponent
    seconds; ``#`` comments and one header line are skipped. Raises EventDataError naming the line."""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise AssetError(f"cannot read: {error.strerror}", where=str(path)) from error
    stamps: list[tuple[int, str | None]] = []
    for number, line in enumerate(lines, 1):
        fields = line.split("#")[0].replace(",", " ").split()
        if not fields:
            continue
        try:
            t_ns = int(fields[0]) * 1000 if re.fullmatch(r"[-+]?\d+", fields[0]) else round(float(fields[0]) * 1e9)
        except (ValueError, OverflowError):
            if number == 1:
                continue
            raise EventDataError(
                f"line {number} is not a time stamp", where=str(path), value=line, accepted="'time' or 'time name'"
            ) from None
        stamps.append((t_ns, fields[1] if len(fields) > 1 else None))
    if not stamps:
        raise EventDataError("no time stamps", where=str(path))
    if len({name is None for _, name in stamps}) > 1:
        raise EventDataError(
            "times with a name and times without one", where=str(path), accepted="'time', or 'time name', in every line"
        )
    return stamps


def _natural(path: Path) -> list:
    """Return a sort key with frame2 before frame10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)]
