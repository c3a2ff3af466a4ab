"""The process that runs dv-processing for :class:`blinkgl.io.aedat4.Aedat4Reader`:
``python aedat4_decode.py FILE events|frames|imu``.

The library does not verify what it unpacks, so that damaged bytes can crash it or keep it busy for ever; here it may.
Written to stdout: a line of JSON, {"size": [height, width]}, {"absent": …} or {"problem": …}; then
batches, each eight bytes of count and as many rows of the stream's :data:`ROWS`; last a count of -1 and a line of JSON,
{} or {"problem": …}. A batch of frames is one row, which the picture's bytes follow. Imports nothing of BlinkGL, so as
to start quickly.
"""

import json
import os
import resource
import signal
import sys
from pathlib import Path

import numpy as np

ROW = np.dtype([("t", "<i8"), ("x", "<i8"), ("y", "<i8"), ("p", "u1")])
FRAME = np.dtype([(name, "<i8") for name in ("begin", "end", "height", "width", "channels", "bytes")])
"""Exposure, µs; the picture's size, and bytes per number."""
IMU = np.dtype([("t", "<i8"), ("acceleration", "<f8", 3), ("rate", "<f8", 3), ("temperature", "<f8")])
"""µs, m/s², rad/s, °C."""
ROWS = {"events": ROW, "frames": FRAME, "imu": IMU}
_SECONDS, _BYTES_PER_SECOND = 3.0, 20e6
"""Processor time for a batch, or for opening: a file without its table is searched whole."""

_MEMORY = 1 << 28


def main(path: str, stream: str) -> None:
    """Writes a stream of the file to standard output, as the reader beside it takes it."""
    import dv_processing

    # The library allocates what a packet's header claims before it looks whether the file is that long.
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY + 64 * os.path.getsize(path),) * 2)
    out = sys.stdout.buffer
    allowance = _SECONDS + os.path.getsize(path) / _BYTES_PER_SECOND
    begun = False
    try:
        signal.setitimer(signal.ITIMER_PROF, allowance)  # ends the process
        recording = dv_processing.io.MonoCameraRecording(path)
        if not getattr(recording, f"is{_NAMES[stream]}StreamAvailable")():
            out.write(json.dumps({"absent": _SAID[stream]}).encode() + b"\n")
            return
        size = recording.getFrameResolution() if stream == "frames" else recording.getEventResolution()
        out.write(json.dumps({"size": None if size is None else [int(size[1]), int(size[0])]}).encode() + b"\n")
        out.flush()  # what came before a crash is not lost with it
        begun = True
        for rows, payload in _BATCHES[stream](recording):
            signal.setitimer(signal.ITIMER_PROF, allowance)
            out.write(np.int64(len(rows)).tobytes() + rows.tobytes() + payload)
            out.flush()
        end = {}
    except (RuntimeError, MemoryError, ValueError, IndexError) as error:
        end = {"problem": f"{' '.join(str(error).split())[:160]}"}
    out.write((np.int64(-1).tobytes() if begun else b"") + json.dumps(end).encode() + b"\n")
    out.flush()


def _events(recording):
    while (batch := recording.getNextEventBatch()) is not None:
        a = batch.numpy()
        rows = np.empty(len(a), ROW)
        for name, theirs in (("t", "timestamp"), ("x", "x"), ("y", "y"), ("p", "polarity")):
            rows[name] = a[theirs]
        yield rows, b""


def _frames(recording):
    while (frame := recording.getNextFrame()) is not None:
        image = np.ascontiguousarray(frame.image)
        channels = image.shape[2] if image.ndim == 3 else 1
        exposure = round(frame.exposure.total_seconds() * 1e6)
        row = (frame.timestamp, frame.timestamp + exposure, *image.shape[:2], channels, image.itemsize)
        yield np.array([row], FRAME), image.tobytes()


def _imu(recording):
    while (batch := recording.getNextImuBatch()) is not None:
        rows = [(i.timestamp, i.getAccelerations(), i.getAngularVelocities(), i.temperature) for i in batch]
        yield np.array(rows, IMU), b""


_BATCHES = {"events": _events, "frames": _frames, "imu": _imu}
_NAMES = {"events": "Event", "frames": "Frame", "imu": "Imu"}
_SAID = {"events": "no events", "frames": "no frames", "imu": "no samples of an inertial unit"}

if __name__ == "__main__":
    main(*sys.argv[1:])
