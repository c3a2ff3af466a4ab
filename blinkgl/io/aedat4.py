"""AEDAT4 recordings of iniVation's cameras, read by the package aedat."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.columns import CameraFrame, G, ImuSamples, check_size, events_of
from blinkgl.types.events import Events

_ABSENT = {"events": "no events", "frame": "no frames", "imus": "no samples of an inertial unit"}


class Aedat4Reader:
    """The streams of a recording; times are the file's own int64 µs (usually since 1970).

    height, width : px of the events' sensor. Raises AssetError: not AEDAT4, damaged, the requested stream is
    missing."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        with _damage(self.path):
            self._streams: dict[int, dict[str, Any]] = _decoder(self.path).id_to_stream()
        events = self._streams[self._first("events")]
        self.height, self.width = events["height"], events["width"]
        check_size(self.height, self.width, str(path))

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        """Yield all events, packet by packet, joined to about ``size``."""
        first, pending, count = 0, [], 0
        for a in self._packets("events"):
            pending.append(events_of(a["x"], a["y"], a["t"], a["on"], str(self.path), first + count))
            count += len(a)
            if count >= size:
                yield Events.concatenate(pending)
                first, pending, count = first + count, [], 0
        if pending:
            yield Events.concatenate(pending)

    def frames(self) -> Iterator[CameraFrame]:
        """Yield frames in their order, uint8, RGB where they have colours; one in memory at a time."""
        last = None
        for number, frame in enumerate(self._packets("frame")):
            begin, end = int(frame["exposure_begin_t"]), int(frame["exposure_end_t"])
            if not (last is None or begin > last) or end < begin:
                raise EventDataError(
                    f"times of frame {number} do not increase", where=str(self.path), value=(last, begin, end)
                )
            last = begin
            image = frame["pixels"]
            yield CameraFrame(image[..., :3] if image.ndim == 3 else image, begin, end)

    def imu(self) -> ImuSamples:
        """Return all samples of the inertial unit."""
        rows = np.concatenate(list(self._packets("imus")))
        t = rows["t"].astype(np.int64)
        if (back := np.diff(t) < 0).any():
            i = int(np.argmax(back))
            raise EventDataError(
                f"times decrease at sample {i + 1} of the inertial unit",
                where=str(self.path),
                value=(int(t[i]), int(t[i + 1])),
            )
        # The file's units are g and degrees per second.
        pull, rate = (
            np.stack([rows[f"{name}_{axis}"] for axis in "xyz"], axis=1).astype(np.float64)
            for name in ("accelerometer", "gyroscope")
        )
        return ImuSamples(t, pull * G, np.radians(rate), rows["temperature"].astype(np.float64))

    def _first(self, kind: str) -> int:
        """Return the number of the first stream of a kind."""
        found = [number for number, stream in self._streams.items() if stream["type"] == kind]
        if not found:
            raise AssetError(f"{_ABSENT[kind]} in the recording", where=str(self.path))
        return min(found)

    def _packets(self, kind: str) -> Iterator[Any]:
        number = self._first(kind)
        with _damage(self.path):
            for packet in _decoder(self.path):
                if packet["stream_id"] == number:
                    yield packet[kind]


def _decoder(path: Path) -> Any:
    # Imported here: few programs read such files.
    import aedat

    return aedat.Decoder(os.fspath(path))


@contextlib.contextmanager
def _damage(path: Path) -> Iterator[None]:
    """Convert what the decoder raises on damaged bytes, including a panic of its Rust code, to AssetError."""
    try:
        yield
    except (AssetError, ImportError):
        raise
    except OSError as error:
        raise AssetError(f"cannot read: {error.strerror}", where=str(path)) from error
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__module__ != "pyo3_runtime":
            raise
        text = " ".join(str(error).split())[:160]
        raise AssetError(f"damaged AEDAT4 file: {text}", where=str(path)) from error
