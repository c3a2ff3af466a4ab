"""Video in and out through PyAV (FFmpeg's libraries); streaming, one frame in memory.

What a file says is used: each frame's own time, the display matrix, the pixels' aspect, range, matrix and transfer
curve, alpha, bits per component. A video is whole where everything decodes: packets without a picture (hidden frames,
edit lists, null frames) are no damage. PyAV is imported when a video is opened.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import re
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from blinkgl.errors import AssetError, OutputError
from blinkgl.io.images import over
from blinkgl.io.reading import Damage, chosen
from blinkgl.io.records import most_unpacked
from blinkgl.io.times import frame_times
from blinkgl.io.yuv import cut_riff, floats_of, known, orientation_of, rgb_from_yuv, samples_of
from blinkgl.machine.closing import Finishing
from blinkgl.machine.extras import install
from blinkgl.machine.interrupts import uninterrupted

if TYPE_CHECKING:
    import av

_MAX_PIXELS, _MOST = 1 << 26, "at most 64 Mpx a frame"
_FORMATS = frozenset(
    "mov mp4 m4a 3gp 3g2 mj2 matroska webm avi mpegts mpeg mpegvideo flv asf ogg apng ivf nut dv mxf yuv4mpegpipe h264 "
    "hevc vvc av1 obu m4v mjpeg rm wtv cine live_flv".split()
)
_ALONE = {"protocol_whitelist": "file", "format_whitelist": ",".join(sorted(_FORMATS))}
"""Only the file itself is read: play lists and manifests (DASH, HLS, concat), which make FFmpeg open other files and
the network for any file name, are not accepted."""
_AS_SRGB = (1, 2, 6, 7, 11, 12, 13, 14, 15)
TRANSFERS: dict[int, str | float | None] = {
    16: "pq", 18: "hlg", 8: "linear", 4: 2.2, 5: 2.8, 9: "log100", 10: "log316", 17: "smpte428",
    **dict.fromkeys(_AS_SRGB),
}  # fmt: skip
"""Curves of ITU-T H.273, by their number, that codes are decoded with. None: as sRGB, which a display's curve for
BT.709 and BT.601 is closer to than their camera's. A name that no decoder has is refused by it."""
_RANGES = {0: None, 1: "limited", 2: "full"}
"""FFmpeg's numbers of pixel ranges; 0 is not specified."""
_UNSPECIFIED = 2
_MATRICES = {
    0: "RGB", 3: "reserved", 8: "YCgCo", 11: "SMPTE 2085", 12: "chroma-derived", 13: "chroma-derived, constant",
    14: "ICtCp", 15: "IPT-C2", 16: "YCgCo-Re", 17: "YCgCo-Ro",
}  # fmt: skip
"""YUV matrices of H.273 that are not read: FFmpeg's own conversion refuses them."""
_ALPHA = {"vp8": "libvpx", "vp9": "libvpx-vp9"}
"""Decoders that read the alpha which WebM keeps beside a picture (alpha_mode=1); FFmpeg's own drop it."""
_RAW = {"h264", "hevc", "vvc", "mpegvideo", "m4v"}
"""Streams without a container: FFmpeg makes up 25 Hz where the stream itself states no rate."""
_PACKED = {
    "nv12": "yuv420p", "nv21": "yuv420p", "nv16": "yuv422p", "yuyv422": "yuv422p", "uyvy422": "yuv422p",
    "yvyu422": "yuv422p", "p010le": "yuv420p10le", "p210le": "yuv422p10le", "y210le": "yuv422p10le",
    "v210": "yuv422p10le", "yuv411p": "yuv444p", "yuvj411p": "yuvj444p", "yuv410p": "yuv444p", "uyyvyy411": "yuv444p",
}  # fmt: skip
"""Formats with interleaved samples, or chroma of every fourth column, by the planar one that holds them."""


class VideoWriter(Finishing):
    """H.264 (yuv420p, plays everywhere) from uint8 RGB frames; the container goes by the ending (.mp4, .mkv, .avi).

    width and height have to be even. One encoder thread: the bytes do not depend on the machine's core count. Use as a
    context manager. Raises OutputError, one line with FFmpeg's own reason, when the file cannot be written."""

    def __init__(
        self, path: str | os.PathLike, height: int, width: int, fps: float, *, preset: str = "veryfast", crf: int = 20
    ):
        if height % 2 or width % 2:
            raise ValueError(f"yuv420p needs even sizes, got {width}x{height}")
        av = _av(OutputError, path)
        self.path, self._shape, self._frame = Path(path), (height, width, 3), av.VideoFrame
        with self._errors():
            # Without a date and a version of the encoder, so that the same frames give the same bytes.
            self._file = av.open(_url(path), "w", options={"fflags": "+bitexact", "movflags": "+faststart"})
            self._stream = self._file.add_stream("libx264", rate=Fraction(fps).limit_denominator(1_000_000))
            self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
            self._stream.options = {"preset": preset, "crf": str(crf), "threads": "1", "flags": "+bitexact"}

    def write(self, frame: np.ndarray) -> None:
        """Write (height, width, 3) uint8 RGB."""
        if frame.shape != self._shape or frame.dtype != np.uint8:
            raise ValueError(f"expected uint8 {self._shape}, got {frame.dtype} {frame.shape}")
        with self._errors():
            self._file.mux(self._stream.encode(self._frame.from_ndarray(np.ascontiguousarray(frame), "rgb24")))

    def close(self) -> None:
        if self._file is not None:
            with self._errors():
                self._file.mux(self._stream.encode(None))
                self._file.close()
            self._file = None

    def abort(self) -> None:
        """Close the file as it is; never raises."""
        if self._file is not None:
            with contextlib.suppress(Exception):
                self._file.close()
            self._file = None

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError) as error:  # PyAV's errors are OSErrors, or ValueErrors of a bad argument
            self.abort()
            raise OutputError(f"cannot write video: {_gist(error)}", where=str(self.path)) from error

    _file: Any = None


@dataclass(frozen=True)
class _Scan:
    """The packets of a file's video. times_ns : of the frames in the order of display, from the file's start; None
    where packets have no stamps.   pts : their stamps, ticks.   damage : why the file is not whole, or None."""

    times_ns: list[int | None]
    pts: list[int]
    damage: str | None


class VideoReader:
    """Frames of any video that FFmpeg decodes, upright, one at a time, each at its own time.

    height, width : px, as displayed.   count : number of frames.   times_ns : theirs, None where packets have no
    stamps.   transfer : curve that the file states, as of ``--gamma``, None where it states none that matters (sRGB).
    levels : codes of black and white; None: the ends of the type.   notes : what was guessed or is lost, a line each.
    Iterating yields (frame, t_ns): (H, W) or (H, W, 3) RGB, uint8, uint16 or float32, and int ns since the file's
    start, None where the file has none.

    range : "full" or "limited", overrules the file's.   zero_time : whether the start does not matter.   background :
    (r, g, b), 0 to 255, below transparent pixels.   keep : frames that are whole, of a damaged file, too.   stream :
    number of one of several videos in the file.

    Raises
    ------
    AssetError : unreadable, encrypted, no video stream, several and none is chosen, a colour matrix that is not read.
    Damage : while iterating, truncated or corrupt, with the frame's number.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        *,
        range: str | None = None,
        background: tuple[int, int, int] | None = None,
        zero_time: bool = False,
        keep: bool = False,
        stream: str | None = None,
    ):
        self.path, self._keep, self._wanted = Path(path), keep, stream
        if not self.path.is_file():
            raise AssetError("no such file", where=str(path))
        self._av = _av(AssetError, path)
        self._range, self._background, self._zero_time = range, background, zero_time
        self.notes: list[str] = []
        with self._opened() as (file, stream):
            self._scan = self._scanned(file, stream)
            rate = self._rate(file, stream)
        self.fps = float(rate) if rate else 0.0
        self.times_ns = self._scan.times_ns
        self.count = len(self.times_ns)
        first = next(self._decoded(), None)
        if first is None:
            raise AssetError(
                f"cannot read video: no frame can be decoded{_because(self._scan.damage)}", where=str(path)
            )
        self._look_at(first)

    def _look_at(self, frame: av.VideoFrame) -> None:
        """Take from the first frame what holds for all."""
        parts, notes = frame.format.components, self.notes
        self._upright = orientation_of(frame)
        self.width, self.height = self._square(frame.width, frame.height)
        if self._upright[0]:
            self.width, self.height = self.height, self.width
        self._bits = max(part.bits for part in parts)
        self._alpha = any(part.is_alpha for part in parts)
        self._grey = len(parts) == 1 + self._alpha and frame.format.name != "pal8"
        curve = int(frame.color_trc)
        self.transfer = TRANSFERS.get(curve, f"H.273 curve {curve}")
        if int(frame.color_range) not in _RANGES:
            raise AssetError("unknown range", where=str(self.path), value=int(frame.color_range), accepted="--range")
        stated = _RANGES[int(frame.color_range)]
        # Codes of grey and RGB stay as they are; YUV is converted with its range.
        self._by_levels = self._grey or frame.format.is_rgb or frame.format.name == "pal8"
        self.levels: tuple[float, float] | None = None
        if self._by_levels and (self._range or (stated if self._grey else None)) == "limited":
            # Black and white of 8 bits, 16 and 235, shifted to the frame's number of bits.
            self.levels = 16 << self._bits - 8, 235 << self._bits - 8
        elif self._by_levels and 8 < self._bits < 16 and not self._alpha:
            self.levels = 0, 2**self._bits - 1
        matrix = int(frame.colorspace)
        if not self._by_levels and matrix != _UNSPECIFIED and not known(matrix):
            named = _MATRICES.get(matrix, "unknown")
            raise AssetError(
                f"the YUV matrix {named} is not read",
                where=str(self.path),
                value=matrix,
                accepted="BT.601, 709 or 2020",
            )
        unstated = [] if self._by_levels or stated or self._range else ["range (limited; --range full for another)"]
        if not self._by_levels and int(frame.colorspace) == _UNSPECIFIED:
            unstated.append("YUV matrix (BT.601)")
        before = 0 if frame.pts is None else sum(pts < frame.pts for pts in self._scan.pts)
        if before:
            notes.append(f"left out: {before} pictures before the first that decodes: the file begins within a group")
        if unstated:
            notes.append(f"not stated by the video, so taken as usual: {' and '.join(unstated)}")
        if self.transfer is not None:
            notes.append(f"the video states the curve {self.transfer} (--gamma for another)")
        if frame.interlaced_frame:
            notes.append("interlaced video: both fields, which are of different times, are taken as one frame")
        begin_ns = self._scan.times_ns[before] if before < len(self._scan.times_ns) else 0
        if begin_ns and not self._zero_time:
            notes.append(f"the first frame is at {begin_ns / 1e9:.6g} s of the file (--zero-time: at 0)")

    def __iter__(self) -> Iterator[tuple[np.ndarray, int | None]]:
        pts, at, count = self._scan.pts, 0, 0
        damage, self._lost = self._scan.damage, 0
        try:
            for frame in self._decoded():
                if frame.is_corrupt:
                    if not self._keep:
                        damage = damage or "a frame is corrupt"
                        break
                    self._lost += 1
                    continue
                time = None if pts or count >= self.count else self.times_ns[count]
                if pts and frame.pts is not None:
                    # Packets that gave no frame are passed over, so that the others keep their times.
                    while at < len(pts) and pts[at] < frame.pts:
                        at += 1
                    if at < len(pts) and pts[at] == frame.pts:
                        time, at = self._scan.times_ns[at], at + 1
                    else:  # it runs back, which whoever reads the frames refuses
                        time = round((frame.pts * self._tick - self._start) * 10**9)
                yield self._pixels(frame), time
                count += 1
        except Damage as error:
            damage = error.problem
        if damage and not self._keep:
            raise Damage(
                f"video truncated or corrupt after frame {count}{_because(damage)}",
                where=str(self.path),
                accepted="a whole file; or --damaged keep",
            )
        if damage or self._lost:
            lost = f", {self._lost} damaged ones left out" if self._lost else ""
            line = f"kept: {count} frames that are whole{lost}{_because(damage)}"
            self.notes += [] if line in self.notes else [line]  # once, however often it is read

    def _square(self, width: int, height: int) -> tuple[int, int]:
        """Return the (width, height) of a picture whose pixels are as wide as high. Raises AssetError: an aspect that
        makes it too large."""
        aspect = self._aspect
        if not aspect or aspect == 1:
            return width, height
        shown = (round(width * aspect), height) if aspect > 1 else (width, round(height / aspect))
        if not shown[0] * shown[1] <= _MAX_PIXELS:
            raise AssetError(
                "pixels of this aspect are not read", where=str(self.path), value=str(aspect), accepted="1:1"
            )
        note = f"its pixels are {aspect.numerator}:{aspect.denominator} wide: {width}x{height} is shown as "
        note += f"{shown[0]}x{shown[1]}"
        self.notes += [] if note in self.notes else [note]
        return shown

    def _pixels(self, frame: av.VideoFrame) -> np.ndarray:
        """Return a frame's pixels, upright."""
        image = self._codes(frame)
        if self._alpha:
            image, note = over(image, self._background)
            if note and note not in self.notes:
                self.notes.append(note)
        if self._aspect and self._aspect != 1:
            image = cv2.resize(image, self._square(frame.width, frame.height), interpolation=cv2.INTER_LINEAR)
        transposed, left, up = self._upright
        if transposed:
            image = image.swapaxes(0, 1)
        return np.ascontiguousarray(image[:: -1 if up else 1, :: -1 if left else 1])

    def _codes(self, frame: av.VideoFrame) -> np.ndarray:
        """Return (H, W), (H, W, 3) or, with alpha, (H, W, 4) codes."""
        name, bits = frame.format.name, self._bits
        planar = name.startswith(("yuv", "yuvj", "gbr", "gray")) and name.endswith(("p", "le", "gray")) and bits <= 16
        if bits == 32 or (bits == 16 and "f16" in name):
            return floats_of(frame)
        if name in _PACKED and known(int(frame.colorspace)):
            return self._codes(frame.reformat(format=_PACKED[name]))
        if planar and (self._by_levels or known(int(frame.colorspace))):
            planes = [samples_of(plane, bits) for plane in frame.planes]
            if self._grey:
                return planes[0]
            if self._by_levels:  # the planes are G, B, R, A
                rgb = np.stack([planes[k] for k in (2, 0, 1, 3)[: len(planes)]], axis=-1)
                return np.rint(rgb * (65535.0 / (2**bits - 1))).astype(np.uint16) if self._alpha and bits > 8 else rgb
            limited = (self._range or _RANGES.get(int(frame.color_range)) or "limited") == "limited"
            # The yuvj formats are of full range by definition.
            limited = limited and not (name.startswith("yuvj") and self._range is None)
            rgb = rgb_from_yuv((planes[0], planes[1], planes[2]), bits, int(frame.colorspace), limited)
            if not self._alpha:
                return rgb
            alpha = planes[3] if bits == 8 else np.rint(planes[3] * (65535.0 / (2**bits - 1))).astype(np.uint16)
            return np.dstack([rgb, alpha])
        wanted = ("rgba" if self._alpha else "rgb24") if bits <= 8 else "rgba64le" if self._alpha else "rgb48le"
        if self._grey and bits <= 8:
            wanted = "rgba" if self._alpha else "gray"
        return frame.to_ndarray() if name == wanted else frame.reformat(format=wanted).to_ndarray()

    def _scanned(self, file: av.container.InputContainer, stream: av.VideoStream) -> _Scan:
        """Read the packets, without decoding them: the times of all frames, and whether the file is whole."""
        stamps, without, seen = [], 0, 0
        problem = cut_riff(self.path) if file.format.name == "avi" else None
        with _logged(self._av) as log:
            try:
                for packet in file.demux():
                    if not packet.size:
                        continue
                    if packet.stream is not stream:
                        continue
                    seen += 1
                    if packet.is_discard:
                        continue
                    if packet.has_sidedata("encryption_info"):
                        raise AssetError("encrypted video", where=str(self.path), accepted="a file without protection")
                    if packet.pts is None:
                        without += 1
                    else:
                        stamps.append(packet.pts)
            except self._av.FFmpegError as error:
                problem = _gist(error)
        decoded = len(stamps) + without
        # The index of a file holds the packets that are to be read, edit lists included; its other counts do not.
        wanted = len(getattr(stream, "index_entries", ())) if "mp4" in file.format.name else 0
        cut = [line for line in log if re.search(r"ended prematurely|partial file|truncat", line, re.I)]
        if problem is None and seen < wanted:
            problem = f"{seen} of {wanted} packets"
        elif problem is None and cut:
            problem = cut[0]
        self._start, self._tick = Fraction(file.start_time or 0, 1_000_000), stream.time_base
        # FFmpeg rounds the file's start to a µs; the streams have it exactly.
        starts = [s.start_time * s.time_base for s in file.streams if s.start_time is not None and s.time_base]
        if starts and abs(min(starts) - self._start) < Fraction(1, 500_000):
            self._start = min(starts)
        if file.format.name == "avi" and stamps:  # its stamps count decoding, which begins earlier
            self._start = min(stamps) * self._tick
        if without:  # some AVI and raw streams: nothing says when, so the frame rate does
            rate = self._rate(file, stream)
            times = [round(k * 10**9 / rate) if rate else None for k in range(decoded)]
            return _Scan(times, [], problem)
        ticks = sorted(stamps)
        rates = [rate for rate in (stream.average_rate, stream.base_rate, stream.guessed_rate) if rate]
        return _Scan(list(frame_times(ticks, self._tick, self._start, rates)), ticks, problem)

    def _rate(self, file: av.container.InputContainer, stream: av.VideoStream) -> Fraction | None:
        """Return the frame rate that a file states, Hz."""
        if file.format.name in _RAW:
            return stream.codec_context.framerate or None
        return stream.average_rate or stream.guessed_rate

    def _decoded(self) -> Iterator[av.VideoFrame]:
        """Yield the frames. What does not decode is passed over up to the next key frame, if such files are kept.
        Raises Damage."""
        with self._opened() as (file, stream):
            stream.thread_type = "AUTO"
            decoder, broken = self._decoder(stream), False
            for packet in file.demux(stream):
                try:
                    frames = decoder.decode(packet) if decoder else packet.decode()
                except self._av.FFmpegError as error:
                    if not self._keep:
                        raise Damage(_gist(error), where=str(self.path)) from error
                    self._lost, broken = self._lost + 1, True
                    continue
                for frame in frames:
                    broken = broken and not frame.key_frame
                    if not broken:
                        yield frame

    _lost = 0

    def _decoder(self, stream: av.VideoStream) -> Any:
        """Return a decoder that reads a WebM's alpha; None: the stream's own does. Says where alpha is lost."""
        mode, name = stream.metadata.get("alpha_mode", "0"), _ALPHA.get(stream.codec_context.name)
        if mode == "0" or name is None:
            return None
        if mode == "1":
            with contextlib.suppress(ValueError):
                return self._av.CodecContext.create(name, "r")
        note = f"left out: alpha (alpha_mode {mode}), which no decoder here reads"
        self.notes += [] if note in self.notes else [note]
        return None

    @contextlib.contextmanager
    def _opened(self) -> Iterator[tuple[av.container.InputContainer, av.VideoStream]]:
        accepted = "a video by itself (mp4, mov, mkv, webm, avi …), no list or manifest of others"
        with contextlib.ExitStack() as stack:
            try:
                file = stack.enter_context(self._av.open(_url(self.path), options=_ALONE))
            except (self._av.FFmpegError, OSError, ValueError) as error:
                # A format that is not on the list is an invalid argument for FFmpeg.
                reason = "not a video" if getattr(error, "errno", 0) == errno.EINVAL else _gist(error)
                raise AssetError(f"cannot read video: {reason}", where=str(self.path), accepted=accepted) from error
            if not set(file.format.name.split(",")) & _FORMATS:
                raise AssetError("cannot read video: not a container", where=str(self.path), accepted=accepted)
            # A cover of an audio file counts as a video stream, too.
            streams = [s for s in file.streams.video if not s.disposition & self._av.stream.Disposition.attached_pic]
            if not streams:
                raise AssetError("no pictures in the file: it has no video stream", where=str(self.path))
            main = [s for s in streams if s.disposition & self._av.stream.Disposition.default]
            sizes = [f"{s.codec_context.width}x{s.codec_context.height}" if s.codec_context else "" for s in streams]
            chosen_ = self._wanted is not None or len(main) != 1
            stream = streams[chosen(self._wanted, sizes, str(self.path), "videos in the file")] if chosen_ else main[0]
            self._aspect = stream.sample_aspect_ratio
            if stream.codec_context is None:
                raise AssetError("cannot read video: unknown codec", where=str(self.path))
            if stream.codec_context.width * stream.codec_context.height > _MAX_PIXELS:
                size = f"{stream.codec_context.width}x{stream.codec_context.height}"
                raise AssetError("video too large", where=str(self.path), value=size, accepted=_MOST)
            # A frame may have another size than the container states.
            stream.codec_context.options = {"max_pixels": str(_MAX_PIXELS)}
            yield file, stream


def decode_exr(data: bytes, where: str) -> np.ndarray:
    """Return (H, W, 3), (H, W, 4) or (H, W) float32 linear of an OpenEXR image. OpenCV's wheel has no OpenEXR; FFmpeg
    has. Raises AssetError: undecodable."""
    av = _av(AssetError, where)
    # Up to four channels of float32.
    most = most_unpacked(len(data)) // 16
    try:
        decoder = av.CodecContext.create("exr", "r")
        decoder.options = {"max_pixels": str(most)}
        frames = decoder.decode(av.Packet(data))
    except (av.FFmpegError, OSError, ValueError, NotImplementedError) as error:
        accepted = f"at most {most} px in {len(data)} bytes"
        raise AssetError(f"cannot decode OpenEXR image: {_gist(error)}", where=where, accepted=accepted) from error
    if not frames or "f" not in frames[0].format.name:
        raise AssetError("cannot decode OpenEXR image: no picture of floats", where=where)
    return floats_of(frames[0])


@functools.cache
def _imported() -> Any:
    with uninterrupted(signal.SIGINT, signal.SIGTERM):
        import av
    return av


def _av(error: type, where: str | os.PathLike) -> Any:
    """Return PyAV. Raises ``error`` where it is not installed."""
    try:
        return _imported()
    except ImportError as problem:
        raise error("no FFmpeg for video", where=str(where), accepted=f"run {install('av')}") from problem


@contextlib.contextmanager
def _logged(av: object) -> Iterator[list[str]]:
    """Return the lines that FFmpeg reports from this thread, filled at the end."""
    lines: list[str] = []
    level = av.logging.get_level()
    av.logging.set_level(av.logging.ERROR)
    try:
        with av.logging.Capture() as logs:
            yield lines
        lines += [f"{name}: {text}".strip() for _, name, text in logs]
    finally:
        av.logging.set_level(level)


def _url(path: str | os.PathLike) -> str:
    """Return the file for FFmpeg, which would take a name with a colon as a protocol."""
    return f"file:{os.fspath(path)}"


def _because(reason: str | None) -> str:
    return f": {reason}" if reason else ""


def _gist(error: BaseException) -> str:
    """Return FFmpeg's own reason, without errno, file and addresses."""
    log = getattr(error, "log", None)
    # PyAV's log is (level, name, text).
    text = log[2] if log else getattr(error, "strerror", None) or str(error)
    return " ".join(re.sub(r" @ 0x[0-9a-f]+", "", text).split())[:200]
