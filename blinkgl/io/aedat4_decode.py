"""The process that runs dv-processing for :class:`blinkgl.io.aedat4.Aedat4Reader`: ``python aedat4_decode.py FILE``.

The library does not verify what it unpacks, so that damaged bytes can crash it or keep it busy for ever; here it may.
Written to stdout: a line of JSON, {"size": [height, width]} or {"problem": …}; then batches, each eight bytes of count
and as many rows of :data:`ROW`; last a count of -1 and a line of JSON, {} or {"problem": …}. Imports nothing of
BlinkGL, so as to start quickly.
"""

import json
import os
import resource
import signal
import sys
from pathlib import Path

import numpy as np

ROW = np.dtype([("t", "<i8"), ("x", "<i8"), ("y", "<i8"), ("p", "u1")])
_SECONDS, _BYTES_PER_SECOND = 3.0, 20e6
"""Processor time for a batch, or for opening: a file without its table is searched whole."""

_MEMORY = 1 << 28


def main(path: str) -> None:
    """Writes the file's events to standard output, as the reader beside it takes them."""
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
        if not recording.isEventStreamAvailable():
            raise RuntimeError("recording without an event stream")
        width, height = (int(v) for v in recording.getEventResolution())
        out.write(json.dumps({"size": [height, width]}).encode() + b"\n")
        begun = True
        while (batch := recording.getNextEventBatch()) is not None:
            signal.setitimer(signal.ITIMER_PROF, allowance)
            a = batch.numpy()
            rows = np.empty(len(a), ROW)
            for name, theirs in (("t", "timestamp"), ("x", "x"), ("y", "y"), ("p", "polarity")):
                rows[name] = a[theirs]
            out.write(np.int64(len(rows)).tobytes() + rows.tobytes())
        end = {}
    except (RuntimeError, MemoryError, ValueError, IndexError) as error:
        end = {"problem": f"{' '.join(str(error).split())[:160]}"}
    out.write((np.int64(-1).tobytes() if begun else b"") + json.dumps(end).encode() + b"\n")
    out.flush()


if __name__ == "__main__":
    main(sys.argv[1])
