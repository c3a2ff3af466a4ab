"""Small videos, written frame by frame with PyAV: any codec, pixel format, clock, tags, and sound beside them."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np


def put_video(
    path: Path,
    frames: Sequence[np.ndarray],
    *,
    ticks: Sequence[int] | None = None,
    tick: Fraction = Fraction(1, 100),
    rate: Fraction | int = 100,
    codec: str = "ffv1",
    pix_fmt: str | None = None,
    source: str | None = None,
    size: tuple[int, int] | None = None,
    options: dict[str, str] | None = None,
    range_: int | None = None,
    matrix: int | None = None,
    curve: int | None = None,
    container_options: dict[str, str] | None = None,
    sound_s: tuple[float, float] | None = None,
) -> Path:
    """Write frames, (H, W) or (H, W, 3) uint8, or planes of the format ``source`` and (H, W) ``size``, at ``ticks`` of
    ``tick`` s.

    range_, matrix, curve : tags (ITU-T H.273 numbers; 1 limited, 2 full).   sound_s : beginning and end of a track of
    silence."""
    first = frames[0]
    source = source or ("gray" if first.ndim == 2 else "rgb24")
    with av.open(str(path), "w", options=container_options or {}) as file:
        stream = file.add_stream(codec, rate=rate)
        stream.height, stream.width = size or first.shape[:2]
        stream.pix_fmt = pix_fmt or ("gray" if source == "gray" and codec == "ffv1" else "yuv444p")
        stream.options = options or {}
        stream.codec_context.time_base = stream.time_base = tick
        for name, value in (("color_range", range_), ("colorspace", matrix), ("color_trc", curve)):
            if value is not None:
                setattr(stream.codec_context, name, value)
        sound = file.add_stream("aac" if path.suffix != ".mkv" else "flac", rate=8000) if sound_s else None
        if sound is not None:
            sound.layout = "mono"
            begin, end = (round(8000 * at) for at in sound_s)
            for at in range(begin, end, 800):
                silence = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), "s16", "mono")
                silence.sample_rate, silence.pts, silence.time_base = 8000, at, Fraction(1, 8000)
                file.mux(sound.encode(silence))
            file.mux(sound.encode(None))
        for k, image in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), source)
            if frame.format.name == stream.pix_fmt:
                frame.color_range, frame.colorspace = range_ or 0, matrix or 2
            elif range_ is not None or matrix is not None:
                given = {"dst_color_range": range_ or 1, "dst_colorspace": matrix or 5}
                frame = frame.reformat(format=stream.pix_fmt, **given)
                frame.color_range, frame.colorspace = range_ or 1, matrix or 2
            elif frame.format.name != stream.pix_fmt:
                frame = frame.reformat(format=stream.pix_fmt)
            if curve is not None:
                frame.color_trc = curve
            frame.pts, frame.time_base = (k if ticks is None else ticks[k]), tick
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    return path


def put_exr(path: Path, image: np.ndarray) -> Path:
    """Write (H, W, 3) float32 linear light as OpenEXR."""
    encoder = av.CodecContext.create("exr", "w")
    encoder.height, encoder.width = image.shape[:2]
    encoder.pix_fmt, encoder.framerate, encoder.options = "gbrpf32le", 1, {"format": "float"}
    (packet,) = encoder.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image, np.float32), "gbrpf32le"))
    path.write_bytes(bytes(packet))
    return path
