"""Video in and out through the ffmpeg binary that imageio-ffmpeg brings; streaming, one frame in memory."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from blinkgl.errors import AssetError, OutputError
from blinkgl.io.images import decode_pfm


class VideoWriter:
    """H.264 (yuv420p, plays everywhere) from uint8 RGB frames; the container goes by the ending (.mp4, .mkv, .avi).

    width and height have to be even. One encoder thread: the bytes do not depend on the machine's core count. Use as a
    context manager. Raises OutputError, one line with ffmpeg's own reason, when the file cannot be written."""

    def __init__(
        self, path: str | os.PathLike, height: int, width: int, fps: float, *, preset: str = "veryfast", crf: int = 20
    ):
        if height % 2 or width % 2:
            raise ValueError(f"yuv420p needs even sizes, got {width}x{height}")
        self.path, self._shape = Path(path), (height, width, 3)
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the writer
        command = [
            _ffmpeg(OutputError, path),
            "-y",
            "-loglevel",
            "error",
            "-f",
            "rawvideo",
            "-pix_fmt",
            "rgb24",
            "-s",
            f"{width}x{height}",
            "-r",
            f"{fps:g}",
            "-i",
            "-",
            "-an",
            "-c:v",
            "libx264",
            "-preset",
            preset,
            "-crf",
            str(crf),
            "-pix_fmt",
            "yuv420p",
            "-threads",
            "1",
            "-fflags",
            "+bitexact",
            "-flags:v",
            "+bitexact",
            "-map_metadata",
            "-1",
            "-movflags",
            "+faststart",
            os.fspath(path),
        ]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self._log)

    def write(self, frame: np.ndarray) -> None:
        """Write (height, width, 3) uint8 RGB."""
        if frame.shape != self._shape or frame.dtype != np.uint8:
            raise ValueError(f"expected uint8 {self._shape}, got {frame.dtype} {frame.shape}")
        try:
            self._process.stdin.write(np.ascontiguousarray(frame).data)
        except OSError as error:
            self._fail(error)

    def close(self) -> None:
        if self._process is None:
            return
        try:
            self._process.stdin.close()
        except OSError as error:
            self._fail(error)
        if self._process.wait():
            self._fail(None)
        self._release()

    def abort(self) -> None:
        """Stop the encoder; never raises."""
        if self._process is not None:
            self._process.kill()
            with contextlib.suppress(OSError):
                self._process.stdin.close()
            self._process.wait()
            self._release()

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close() if kind is None else self.abort()

    def _fail(self, error: OSError | None) -> None:
        self._process.wait()
        reason = _last_line(self._log) or (
            str(error) if error else f"ffmpeg ended with status {self._process.returncode}"
        )
        self.abort()
        raise OutputError(f"cannot write video: {reason}", where=str(self.path)) from error

    def _release(self) -> None:
        self._log.close()
        self._process = None


_CONTAINERS = (
    "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,mpegvideo,flv,asf,ogg,gif,apng,webp_anim,ivf,nut,dv,mxf,"
    "yuv4mpegpipe,h264,hevc,vvc,av1,obu,m4v,mjpeg,rm,wtv,cine"
)
_ALONE = ["-protocol_whitelist", "file", "-format_whitelist", _CONTAINERS]
"""Only the file itself is read: play lists and manifests (DASH, HLS, concat), which make ffmpeg open other files and
the network for any file name, are not accepted."""


def _input(path: str | os.PathLike) -> str:
    """Return the file for ffmpeg, which would take a name with a colon as a protocol."""
    return f"file:{os.fspath(path)}"


class VideoReader:
    """Frames of any video ffmpeg can decode, as (H, W, 3) uint8 RGB, one at a time.

    fps is the container's average rate: frames are taken as equally spaced, also in variable-rate files.

    Raises
    ------
    AssetError : unreadable, no video stream; and, while iterating, truncated or corrupt (with the frame's number).
    """

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        if not self.path.is_file():
            raise AssetError("no such file", where=str(path))
        _ffmpeg(AssetError, path)
        try:
            probe = imageio_ffmpeg.read_frames(_input(path), input_params=_ALONE)
            meta = next(probe)
            probe.close()
        except Exception as error:  # IOError, RuntimeError, IndexError, StopIteration …
            if "not on whitelist" in str(error):
                accepted = "a video by itself (mp4, mov, mkv, webm, avi …), no list or manifest of others"
                raise AssetError("cannot read video: not a container", where=str(path), accepted=accepted) from error
            raise AssetError(f"cannot read video: {_gist(str(error))}", where=str(path)) from error
        # ffmpeg turns frames upright.
        self.width, self.height = meta["size"] if meta.get("rotate", 0) % 180 == 0 else meta["size"][::-1]
        self.fps = float(meta.get("fps") or 0)
        self.expected = round(float(meta.get("duration") or 0) * self.fps)

    def __iter__(self) -> Iterator[np.ndarray]:
        size = self.width * self.height * 3
        with tempfile.TemporaryFile() as log:
            command = [
                imageio_ffmpeg.get_ffmpeg_exe(),
                "-loglevel",
                "error",
                "-nostdin",
                *_ALONE,
                "-i",
                _input(self.path),
                "-map",
                "0:v:0",
                "-fps_mode",
                "passthrough",
                "-f",
                "rawvideo",
                "-pix_fmt",
                "rgb24",
                "-s",
                f"{self.width}x{self.height}",
                "-",
            ]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, bufsize=size)
            count = 0
            try:
                while len(data := process.stdout.read(size)) == size:
                    yield np.frombuffer(data, np.uint8).reshape(self.height, self.width, 3)
                    count += 1
                status, trouble = process.wait(), _last_line(log)
            finally:
                process.kill()
                process.stdout.close()
                process.wait()
        # Decoders also grumble about files that they decode whole: those words alone do not condemn a file.
        damaged = re.search(
            r"invalid data|error while decoding|partial file|concealing|corrupt|truncat|ended prematurely",
            trouble,
            re.I,
        )
        if status or data or count == 0 or damaged or count < 0.95 * self.expected - 2:
            raise AssetError(
                f"video truncated or corrupt after frame {count}" + (f": {trouble}" if trouble else ""),
                where=str(self.path),
            )


def read_exr(path: str | os.PathLike) -> np.ndarray:
    """Return (H, W, 3) or (H, W) float32 linear of an OpenEXR image. OpenCV's wheel has no OpenEXR; ffmpeg does. Raises
    AssetError: undecodable."""
    if not os.path.isfile(path):
        raise AssetError("no such file", where=str(path))
    return decode_exr(Path(path).read_bytes(), str(path))


def decode_exr(data: bytes, where: str) -> np.ndarray:
    """Return :func:`read_exr` of bytes already read."""
    # Through a pipe, and as OpenEXR whatever it looks like: a name such as f%d.exr would be a pattern of names. ffmpeg
    # finds no end of an image in a pipe by itself.
    whole = ["-f", "exr_pipe", "-c:v", "exr", "-frame_size", str(len(data))]
    command = [_ffmpeg(AssetError, where), "-loglevel", "error", *whole, "-i", "pipe:0"]
    command += ["-frames:v", "1", "-c:v", "pfm", "-f", "image2pipe", "-"]
    result = subprocess.run(command, input=data, capture_output=True)
    if result.returncode or not result.stdout:
        raise AssetError(f"cannot decode OpenEXR image: {_gist(result.stderr.decode(errors='replace'))}", where=where)
    return decode_pfm(result.stdout, where)


def _ffmpeg(error: type, where) -> str:
    try:
        return imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as problem:
        raise error(
            "no ffmpeg binary for video",
            where=str(where),
            accepted="use pip install imageio-ffmpeg, or set IMAGEIO_FFMPEG_EXE",
        ) from problem


def _last_line(log) -> str:
    log.seek(0)
    return _gist(log.read().decode(errors="replace"))


def _gist(text: str) -> str:
    """Return ffmpeg's most informative line, without addresses."""
    lines = [re.sub(r"^\[[^\]]*\]\s*", "", line).strip() for line in text.splitlines()]
    lines = [re.sub(r" @ 0x[0-9a-f]+", "", line) for line in lines if line]
    telling = [
        line
        for line in lines
        if re.search(
            r"invalid|error|not found|no space|denied|partial|truncat|corrupt|moov|no such|premature", line, re.I
        )
        and not line.startswith(("Conversion failed", "Error opening input file"))
    ]
    return (telling or lines or [""])[-1][:200]
