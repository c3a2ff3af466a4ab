"""Every emulator fitted to the recordings that have frames: the table of docs/results.md.

    python -m blinkgl.tools.fit_recordings FOLDER [--only TEXT] [--starts N]

FOLDER : of the recordings slider_depth, cuke_davis346 (needs dv-processing) and evbench_davis240, as docs/results.md
names them. Each is fitted on its first half in time and judged on its second.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from blinkgl.events.types import Events
from blinkgl.io.frames import open_frames, read_any_image
from blinkgl.recordings.calibration import calibrate_events
from blinkgl.recordings.clip import read_recording, timed_frames

Recording = tuple[Events, tuple[int, int], list[tuple[np.ndarray, int, str]], bool]
"""Events, (height, width), frames, and whether their times are the middles of exposures."""


def slider_depth(folder: Path) -> Recording:
    """DAVIS240C on a slider."""
    events, size = read_recording(folder / "slider_depth" / "events_chunk.txt")
    frames = open_frames(folder / "slider_depth" / "images", timestamps=folder / "slider_depth" / "images.txt")
    return events, size, list(frames), False


def cuke_davis346(folder: Path) -> Recording:
    """DAVIS346, a still camera before a Newton's cradle."""
    path = folder / "cuke_davis346" / "demo-01.aedat4"
    frames, exposures = timed_frames(path)
    return *read_recording(path), list(frames), exposures


def evbench_davis240(folder: Path) -> Recording:
    """DAVIS240b that turns in an office. Rows from below and polarity the other way round in the file; frames without
    times, 51.5 ms apart; two stuck pixels."""
    from scipy.io import loadmat

    stored = loadmat(folder / "evbench_davis240" / "seq_0001_e.mat")
    t, x, y, off = (stored[key].ravel().astype(np.int64) for key in ("ts", "x", "y", "pol"))
    fine = ~((np.abs(x - 27) < 2) & (np.abs(179 - y - 109) < 2))
    events = Events(
        x[fine].astype(np.uint16),
        (179 - y[fine]).astype(np.uint16),
        t[fine] - t[0],
        (1 - off[fine]).astype(np.uint8),
    )
    files = sorted((folder / "evbench_davis240" / "frames").glob("*.png"))
    frames = [
        (np.ascontiguousarray(read_any_image(file)[:, :190]), 44_000_000 + 51_500_000 * k, file.name)
        for k, file in enumerate(files)
    ]
    return events, (180, 190), frames, False


RECORDINGS: dict[str, Callable[[Path], Recording]] = {
    read.__name__: read for read in (slider_depth, cuke_davis346, evbench_davis240)
}
EMULATORS = ("esim", "v2e", "voltmeter")


def rows(folder: Path, only: str = "", starts: int = 3) -> Iterator[str]:
    """Lines of a Markdown table, two for each recording and emulator."""
    yield "| recording | emulator | events / recorded | ON / OFF (recorded) | intervals, KS | polarity sums | s |"
    yield "|---|---|---|---|---|---|---|"
    for name, read in RECORDINGS.items():
        for emulator in EMULATORS:
            if only not in f"{name} {emulator}":
                continue
            events, size, frames, exposures = read(folder)
            begun = time.process_time()
            found = calibrate_events(
                events, size, frames, name=name, exposures=exposures, emulator=emulator, starts=starts
            )
            seconds = time.process_time() - begun
            for what, judged in (("default", found.judged_before[1]), ("fitted", found.judged[1])):
                yield (
                    f"| {name} | {emulator}, {what} | {judged.rate_ratio:.3f} | {judged.on_off:.3f} "
                    f"({judged.recorded_on_off:.3f}) | {judged.interval_distance:.3f} "
                    f"| {judged.polarity_correlation:.3f} | {f'{seconds:.0f}' if what == 'fitted' else ''} |"
                )
            told = ", ".join(f"{k} {v:.4g} ± {found.uncertainty[k]:.2g}" for k, v in found.values.items())
            yield f"<!-- {told}; not told: {', '.join(found.untold) or 'none'}; {found.notes[0]} -->"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="part of 'RECORDING EMULATOR'")
    parser.add_argument("--starts", type=int, default=3)
    options = parser.parse_args()
    for line in rows(options.folder, options.only, options.starts):
        print(line, flush=True)


if __name__ == "__main__":
    main()
