"""AEDAT4 (iniVation) through dv-processing, an optional package of its own."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import signal
import subprocess
import sys
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import numpy as np

from blinkgl.errors import AssetError, BlinkGLError, EventDataError, OutputError
from blinkgl.io import aedat4_decode
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import check_events, check_size, events_of, refuse_causes
from blinkgl.io.davis import CameraFrame, ImuSamples
from blinkgl.machine.extras import install
from blinkgl.types.events import Events

MAGIC = b"#!AER-DAT4"


def _missing(error: type[BlinkGLError], path) -> BlinkGLError:
    return error(
        "AEDAT4 needs dv-processing, which is not installed",
        where=str(path),
        accepted=f"run {install('dv-processing')}",
    )


class Aedat4Reader:
    """The streams of a recording; times are the file's own int64 µs (usually since 1970).

    height, width : px of the events' sensor. Raises AssetError: no AEDAT4, damaged, no stream of what is asked for."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        try:
            with open(path, "rb") as file:
                magic = file.read(len(MAGIC))
        except OSError as error:
            raise AssetError(f"cannot read: {error.strerror}", where=str(path)) from error
        if magic != MAGIC:
            raise AssetError("not an AEDAT4 file: wrong magic", where=str(path))
        self._decoder: _Decoder | None = _Decoder(self.path)
        self.height, self.width = self._decoder.size
        check_size(self.height, self.width, str(path))

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        """All events, packet by packet, joined to about ``size``."""
        decoder, self._decoder = self._decoder or _Decoder(self.path), None
        first, pending, count = 0, [], 0
        with contextlib.closing(decoder):
            for a in decoder:
                pending.append(events_of(a["x"], a["y"], a["t"], a["p"], str(self.path), first + count))
                count += len(a)
                if count >= size:
                    yield Events.concatenate(pending)
                    first, pending, count = first + count, [], 0
        if pending:
            yield Events.concatenate(pending)

    def frames(self) -> Iterator[CameraFrame]:
        """Frames in their order, uint8, RGB where they have colours; one in memory at a time."""
        last = None
        with contextlib.closing(_Decoder(self.path, "frames")) as decoder:
            for number, (row, image) in enumerate(decoder.pictures()):
                begin, end = int(row["begin"]), int(row["end"])
                if not (last is None or begin > last) or end < begin:
                    raise EventDataError(
                        f"times of frame {number} do not increase", where=str(self.path), value=(last, begin, end)
                    )
                last = begin
                yield CameraFrame(image, begin, end)

    def imu(self) -> ImuSamples:
        """All samples of the inertial unit."""
        with contextlib.closing(_Decoder(self.path, "imu")) as decoder:
            rows = np.concatenate([np.empty(0, aedat4_decode.IMU), *decoder])
        if (back := np.diff(rows["t"]) < 0).any():
            i = int(np.argmax(back))
            raise EventDataError(
                f"times run backwards at sample {i + 1} of the inertial unit",
                where=str(self.path),
                value=(int(rows["t"][i]), int(rows["t"][i + 1])),
            )
        return ImuSamples(*(np.ascontiguousarray(rows[name]) for name in ("t", "acceleration", "rate", "temperature")))

    def close(self) -> None:
        if self._decoder is not None:
            self._decoder.close()
            self._decoder = None


class _Decoder:
    """dv-processing in a process of its own, :mod:`blinkgl.io.aedat4_decode`: damaged bytes crash it or keep it busy
    for ever. Iterating yields its arrays. Raises AssetError."""

    def __init__(self, path: Path, stream: str = "events"):
        self.path, self._row = path, aedat4_decode.ROWS[stream]
        if importlib.util.find_spec("dv_processing") is None:
            raise _missing(AssetError, path)
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        self._process = subprocess.Popen(
            [sys.executable, aedat4_decode.__file__, os.fspath(path), stream],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            stdin=subprocess.DEVNULL,
            env=environment,
        )
        self._finalizer = weakref.finalize(self, _end, self._process)
        size = self._line()["size"]
        self.size: tuple[int, int] = (0, 0) if size is None else tuple(size)

    def __iter__(self) -> Iterator[np.ndarray]:
        while (count := int(np.frombuffer(self._read(8), np.int64)[0])) >= 0:
            if count:
                yield np.frombuffer(self._read(count * self._row.itemsize), self._row)
        self._line()

    def pictures(self) -> Iterator[tuple[np.void, np.ndarray]]:
        """Rows of frames, and their pictures."""
        for rows in self:
            row = rows[0]
            height, width, channels = (int(row[name]) for name in ("height", "width", "channels"))
            if channels not in (1, 3) or row["bytes"] != 1:
                raise AssetError(
                    "frames of another kind",
                    where=str(self.path),
                    value=f"{channels} channels of {int(row['bytes'])} bytes",
                    accepted="1 or 3 channels of 8 bits",
                )
            flat = np.frombuffer(self._read(height * width * channels), np.uint8)
            image = flat.reshape((height, width) if channels == 1 else (height, width, channels))
            yield row, image.copy() if channels == 1 else np.ascontiguousarray(image[..., ::-1])  # OpenCV's BGR

    def close(self) -> None:
        self._finalizer()

    def _line(self) -> dict:
        line = self._process.stdout.readline()
        if not line.endswith(b"\n"):
            self._died()
        said = json.loads(line)
        if "absent" in said:
            self.close()
            raise AssetError(f"{said['absent']} in the recording", where=str(self.path))
        if "problem" in said:
            self.close()
            raise AssetError(f"damaged AEDAT4 file: {said['problem']}", where=str(self.path))
        return said

    def _read(self, size: int) -> bytes:
        data = self._process.stdout.read(size)
        if len(data) < size:
            self._died()
        return data

    def _died(self) -> NoReturn:
        status = self._process.wait()
        self.close()
        raise AssetError(
            "damaged AEDAT4 file: dv-processing "
            + ("does not come to an end with it" if status == -signal.SIGPROF else "crashed on it"),
            where=str(self.path),
        )


def _end(process: subprocess.Popen) -> None:
    process.kill()
    process.stdout.close()
    process.wait()


class Aedat4Writer:
    """Events only, LZ4 packets. dv-processing takes events one by one from Python: about 1 M events/s."""

    def __init__(self, path: str | os.PathLike, height: int, width: int):
        if height > 32767 or width > 32767:
            raise EventDataError("AEDAT4 has 15-bit coordinates", where=str(path), value=(height, width))
        try:
            import dv_processing as dv
        except ImportError as error:
            raise _missing(OutputError, path) from error
        self.path, self._store, self._size = Path(path), dv.EventStore, (height, width)
        self._count, self._last = 0, None
        with output_errors(path):
            open(path, "wb").close()  # dv's own message for an unwritable path does not say why
            try:
                self._writer = dv.io.MonoCameraWriter(
                    os.fspath(path), dv.io.MonoCameraWriter.EventOnlyConfig("BlinkGL", (width, height))
                )
            except RuntimeError as error:
                raise OutputError(f"cannot write: {' '.join(str(error).split())}", where=str(path)) from error

    def append(self, events: Events) -> None:
        refuse_causes(events, "AEDAT4", str(self.path))
        if not len(events):
            return
        self._last = check_events(
            events, str(self.path), self._count, height=self._size[0], width=self._size[1], after=self._last
        )
        self._count += len(events)
        store = self._store()
        push = store.push_back
        for t, x, y, p in zip(events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.astype(bool).tolist()):
            push(t, x, y, p)
        try:
            self._writer.writeEvents(store)
        except RuntimeError as error:
            raise OutputError(f"cannot write: {' '.join(str(error).split())}", where=str(self.path)) from error

    def close(self, t_end_us: int | None = None) -> None:
        self._writer = None  # its destructor writes the last packets and the index

    def abort(self) -> None:
        self._writer = None
