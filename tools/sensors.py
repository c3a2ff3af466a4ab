"""What the shipped sensor files of DAVIS cameras say of each emulator: fitted jointly to recordings of the camera.

    python -m blinkgl.tools.sensors --recordings ../shared/data/events --evbench .../DATA/sequences --camera davis240c
    python -m blinkgl.tools.sensors --recordings ../shared/data/events --left-out          # the judge

One set of parameters for all recordings of a camera, by the same search as `blinkgl calibrate`; what of it goes into
the file (``emulators.…``) is printed as YAML. Noise of single pixels is the file's ``readout.pixels``, so that of the
emulators is off. ``--left-out`` fits without one recording at a time and judges by that one, whole: two cameras of one
name differ, and so does one with other bias settings, so this is what a user of the file may expect.

evbench (fbarranco/eventVision-evbench, ``DATA/sequences``) has a sequence that is not among the small recordings; its
rows are turned over, its polarity inverted, and its frames' times are known by correlation alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.config.events import EmulatorConfig
from blinkgl.config.reader import to_short_yaml
from blinkgl.config.readout import ReadoutConfig
from blinkgl.errors import BlinkGLError
from blinkgl.io.frames import read_any_image
from blinkgl.machine.terminal import plain_console, say
from blinkgl.recordings.bursts import inside_any
from blinkgl.recordings.calibration import judge_half
from blinkgl.recordings.clip import Clip, FrameReading, clip_of_frames, read_recording, timed_frames
from blinkgl.recordings.judge import judge
from blinkgl.recordings.search import Search
from blinkgl.recordings.simulation import emulator_config
from blinkgl.recordings.statistics import sums
from blinkgl.tools.real_recordings import read

FIT, WHOLE = 1_000_000, 10**10
"""Pixels times frames that are looked at of a recording: while fitting, and while judging."""
NOISE_ELSEWHERE: dict[str, dict[str, Any]] = {
    "v2e": {"leak_rate_hz": 0.0, "leak_jitter": 0.0, "leak_cov_decades": 0.0, "shot_noise_rate_hz": 0.0},
    "voltmeter": {"k4": 0.0, "k5": 0.0},
}
HOT = ("hot_pixel_fraction", "hot_pixel_rate_hz")
KICKS = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32)
MakeClip = Callable[[int], Clip]


def slider(root: Path) -> MakeClip:
    folder = root / "slider_depth"
    return _clip(folder / "events_chunk.txt", folder / "images", timestamps=folder / "images.txt")


def _clip(events: Path, frames: Path, **options: Any) -> MakeClip:
    stream, size = read_recording(events)
    timed, exposures = timed_frames(frames, **options)
    given, reading = list(timed), FrameReading(exposures=exposures, name=frames.name)
    return lambda most: clip_of_frames(stream, given, size, reading, most=most)


def evbench(events: Path, frames: Path, first_ms: float, gap_ms: float) -> MakeClip:
    """first_ms : middle of the first frame's exposure after the first event; of one frame after another ``gap_ms``."""
    stream, height, width = read(events)
    at = lambda k: int(stream.t[0]) * 1000 + round((first_ms + gap_ms * k) * 1e6)
    images = [read_any_image(file) for file in sorted(frames.glob("*.png"))]
    grey = [image if image.ndim == 2 else image[..., 1] for image in images]
    given = [(image[:height, :width], at(k), f"#{k}") for k, image in enumerate(grey)]
    reading = FrameReading(exposures=True, name=frames.name)
    return lambda most: clip_of_frames(stream, given, (height, width), reading, most=most)


def cameras(root: Path, more: Path | None) -> dict[str, dict[str, MakeClip]]:
    """Recordings by camera and name."""
    own = root / "evbench_davis240"
    davis240 = {
        "slider_depth": slider(root),
        "evbench 1": evbench(own / "seq_0001_e.mat", own / "frames", 44.0, 51.5),
    }
    if more is not None:
        davis240["evbench 3"] = evbench(more / "seq_0003_e.mat", more / "DAVIS_seq_0003", 12.0, 51.0)
    files = {"cuke": "cuke_davis346/demo-01.aedat4", "still": "aedat4/davis346_events_frames_imu.aedat4"}
    davis346 = {name: _clip(root / file, root / file) for name, file in files.items()}
    return {"davis240c": davis240, "davis346": davis346}


def resets(clip: Clip, kick: float) -> ReadoutConfig | None:
    """The jumps of a recording's camera, where and how often its own were; None: it had none."""
    if not len(clip.bursts):
        return None
    # Bursts of ON events begin with the jump; where it is over, OFF events may make one of their own.
    on = [
        clip.events.window(int(a), int(b) + 1).p.mean() if len(clip.events.window(int(a), int(b) + 1)) else 0.0
        for a, b in clip.bursts
    ]
    begins = clip.bursts[np.array(on) > 0.5, 0]
    gaps = np.diff(begins)
    every = float(np.median(gaps))
    number = np.round((begins - begins[0]) / every)
    every, first = np.polyfit(number, begins, 1)
    since_ms = (first / 1000 - clip.frames[0][0] / 1e6) % (every / 1000)
    return ReadoutConfig(frame_resets={"interval_ms": every / 1000, "kick": kick, "first_ms": since_ms})


def kick_of(clip: Clip, config: EmulatorConfig) -> float:
    """Height of the jump with which as many events more are in the recording's bursts as the camera has there."""
    inside = lambda events: float(inside_any(events.t, clip.bursts).sum())
    wanted, without = inside(clip.events), inside(clip.simulate(config, 1))
    found = [inside(clip.simulate(config, 1, readout=resets(clip, kick))) for kick in KICKS]
    return float(np.exp(np.interp(wanted, [without, *found], np.log([KICKS[0] / 4, *KICKS]))))


def fitted(clips: list[Clip], emulator: str, usual: EmulatorConfig | None = None) -> EmulatorConfig:
    """One set of parameters for all of the clips, whole. usual : of cameras of this kind, as far as the clips do not
    say otherwise."""
    off = NOISE_ELSEWHERE.get(emulator, {})
    base = usual if usual is not None else emulator_config({"emulator": emulator, **off})
    search = Search([(clip, clip.intervals) for clip in clips], base, 0)
    keys = search.responding([key for key in base.fitted if key not in off and key not in HOT])
    search.run(keys, search.roughly(keys, 1))
    return search.config()


def row(clip: Clip, config: EmulatorConfig, kick: float = 0.0) -> list[str]:
    """Rate against the recording, intervals, counts of pixels, and what the judge says."""
    readout = resets(clip, kick) if kick else None
    stream, recorded = clip.simulate(config, 1, readout=readout), sums(clip.events, clip, 0, clip.intervals)
    half = judge_half(recorded, sums(stream, clip, 0, clip.intervals, recorded))
    try:
        told = judge(clip.events, stream, clip.size, (int(clip.edges_us[0]), int(clip.edges_us[-1]))).auc
    except BlinkGLError:
        told = float("nan")
    rate = len(stream) / max(len(clip.events), 1)
    values = (rate, half.interval_distance, half.polarity_correlation, half.count_correlation, told)
    return [f"{value:.2f}" for value in values]


def said(config: EmulatorConfig) -> dict[str, Any]:
    """What a sensor file says of it."""
    table = config.model_dump(exclude_defaults=True)
    return {k: float(f"{v:.3g}") if isinstance(v, float) else v for k, v in table.items() if k != "emulator"}


def lines(found: dict[str, dict[str, MakeClip]], emulators: list[str], left_out: bool) -> Iterator[str]:
    heads = ["rate", "intervals, KS", "polarity", "counts", "judge"]
    yield "| camera, emulator | judged by | " + " | ".join(heads) + " | s |\n" + "|---" * (len(heads) + 3) + "|"
    for camera, recordings in found.items():
        for emulator in emulators:
            for left in list(recordings) if left_out else [None]:
                began = time.process_time()
                config = fitted([make(FIT) for name, make in recordings.items() if name != left], emulator)
                spent = f"{time.process_time() - began:.0f}"
                for name in [left] if left else list(recordings):
                    cells = [f"{camera}, {emulator}", name, *row(recordings[name](WHOLE), config), spent]
                    yield "| " + " | ".join(cells) + " |"
                if not left:
                    yield to_short_yaml({"emulators": {emulator: said(config)}})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument("--evbench", type=Path, help="folder of evbench's sequences, for its third")
    parser.add_argument("--camera", choices=("davis240c", "davis346"), action="append")
    parser.add_argument("--emulator", choices=tuple(EmulatorConfig.members.models), action="append")
    parser.add_argument("--left-out", action="store_true", help="fit without one recording, and judge by it")
    a = parser.parse_args()
    np.seterr(divide="ignore")
    found = cameras(a.recordings, a.evbench)
    found = {name: one for name, one in found.items() if not a.camera or name in a.camera}
    for line in lines(found, a.emulator or list(EmulatorConfig.members.models), a.left_out):
        say(plain_console(), line)


if __name__ == "__main__":
    main()
