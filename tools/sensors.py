"""What the shipped sensor files of DAVIS cameras say of each emulator, from recordings of such cameras.

    python -m blinkgl.tools.sensors --recordings ../shared/data/events --evbench .../DATA/sequences

One set of values is fitted to all recordings of a camera jointly, by the search of `blinkgl calibrate`, and stands for
the camera. Then each recording is fitted by itself: what its thresholds differ by is the spread over units, because two
cameras of one name differ, and so does one with other bias settings. Printed are the fits, a table, and the values as
YAML. The table has what a user of a file may expect: each recording is judged, whole, by a fit to the **other**
recordings of its camera.

A single recording does not tell the dark offset (ESIM's cost differs by 3 to 23 % between 0.003 and 0.1 of full scale,
not always to the same side, since the threshold makes up for it): there it is held (``HELD``). V2E's noise of single
pixels is off while fitting, and the Voltmeter's leak is what the sensor file records (0.004 and 0.005 Hz). The
Voltmeter's k3 and k6 are fitted, still pixels among the numbers; but some of slider_depth's and cuke's still pixels
see a little motion and fire at 0.1 to 0.5 Hz, so k6 is at most what the quiet recordings tell (``MOST_K6``): their OFF
events are half of k6^2 in us.

evbench (fbarranco/eventVision-evbench, ``DATA/sequences``) has a sequence that is not among the small recordings; its
rows are turned over, its polarity inverted, and its frames' times are known by correlation alone.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from blinkgl.config.events import EmulatorConfig
from blinkgl.config.reader import to_short_yaml
from blinkgl.config.readout import ReadoutConfig
from blinkgl.config.sensor import load_sensor
from blinkgl.errors import BlinkGLError
from blinkgl.io.frames import read_any_image
from blinkgl.io.reading import NOTHING, Declared
from blinkgl.machine.terminal import plain_console, say
from blinkgl.recordings.bursts import inside_any
from blinkgl.recordings.calibration import judge_half
from blinkgl.recordings.clip import Clip, FrameReading, clip_of_frames, read_recording, timed_frames
from blinkgl.recordings.search import Search
from blinkgl.recordings.simulation import emulator_config
from blinkgl.recordings.statistics import sums
from blinkgl.tools.judge import judge
from blinkgl.tools.real_recordings import read, table
from blinkgl.types.events import Events

FIT, WHOLE = 1_000_000, 10**10
"""Pixels times frames that are looked at of a recording: while fitting, and while judging."""
NOISE_ELSEWHERE = {"leak_rate_hz": 0.0, "leak_jitter": 0.0, "leak_cov_decades": 0.0, "shot_noise_rate_hz": 0.0}
MOST_K6 = {"davis240c": 3e-5, "davis346": 2e-5}
"""Of 0.0005 and 0.0002 OFF events a second in still pixels."""
HELD: dict[str, dict[str, float]] = {"esim": {"log_eps": 0.01}, "v2e": {"full_scale": 255.0}, "voltmeter": {"k2": 5.0}}
HOT = ("hot_pixel_fraction", "hot_pixel_rate_hz")
THRESHOLDS = {"contrast_threshold", "contrast_threshold_off", "k1"}
KICK = 0.35
"""Thresholds by which a reset lifts the signal, of the recordings that have any."""
KICKS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
MakeClip = Callable[[int], Clip]


def slider(root: Path) -> MakeClip:
    folder = root / "slider_depth"
    return _clip(folder / "events_chunk.txt", folder / "images", Declared(timestamps=folder / "images.txt"))


def _clip(events: Path, frames: Path, declared: Declared = NOTHING) -> MakeClip:
    stream, size, _ = read_recording(events)
    timed, exposures = timed_frames(frames, declared)
    stamped, reading = list(timed), FrameReading(exposures=exposures, name=frames.name)
    return lambda most: clip_of_frames(stream, stamped, size, reading, most=most)


def evbench(events: Path, frames: Path, first_ms: float, gap_ms: float) -> MakeClip:
    """first_ms : middle of the first frame's exposure after the first event; of one frame after another ``gap_ms``."""
    stream, height, width = read(events)
    at = lambda k: int(stream.t[0]) * 1000 + round((first_ms + gap_ms * k) * 1e6)
    images = [read_any_image(file) for file in sorted(frames.glob("*.png"))]
    grey = [image if image.ndim == 2 else image[..., 1] for image in images]
    stamped = [(image[:height, :width], at(k), f"#{k}") for k, image in enumerate(grey)]
    reading = FrameReading(exposures=True, name=frames.name)
    return lambda most: clip_of_frames(stream, stamped, (height, width), reading, most=most)


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
    inside = [clip.events.window(int(begin), int(end)).p for begin, end in clip.bursts]
    begins = clip.bursts[[len(p) > 0 and p.mean() > 0.5 for p in inside], 0]
    every = float(np.median(np.diff(begins)))
    number = np.round((begins - begins[0]) / every)
    every, first = np.polyfit(number, begins, 1)
    since_ms = (first / 1000 - clip.frames[0][0] / 1e6) % (every / 1000)
    return ReadoutConfig(frame_resets={"interval_ms": every / 1000, "kick": kick, "first_ms": since_ms})


def kick_of(clip: Clip, config: EmulatorConfig) -> float:
    """Height of the jump with which pixels that saw motion fire as often in the recording's bursts as the camera's."""

    def inside(events: Events) -> float:
        return float(inside_any(events.t[~clip.still[events.y, events.x]], clip.bursts).sum())

    wanted, without = inside(clip.events), inside(clip.simulate(config, 1))
    rates = [inside(clip.simulate(config, 1, readout=resets(clip, kick))) for kick in KICKS]
    return float(np.exp(np.interp(wanted, [without, *rates], np.log([KICKS[0] / 4, *KICKS]))))


def noise(camera: str, emulator: str) -> Mapping[str, object]:
    """The emulator's noise of single pixels, which is not fitted."""
    leak_hz = load_sensor(camera).leak_rate_hz
    assert leak_hz is not None
    leak = {"k4": leak_hz * 1e-6, "k5": 0.0}
    return {"v2e": NOISE_ELSEWHERE, "voltmeter": leak}.get(emulator, {})


def fitted(clips: list[Clip], camera: str, emulator: str, dark: dict[str, float]) -> dict[str, float]:
    """One set of values for all of the clips, whole: those that they tell, and where the search has left the others (a
    default of 0 as the smallest value that is tried, which is as good as none). dark : of the dark offset, held."""
    held = {**noise(camera, emulator), **dark}
    base = emulator_config({"emulator": emulator, **held})
    search = Search([(clip, clip.intervals) for clip in clips], base, 0)
    keys = search.responding([key for key in base.fitted if key not in held and key not in HOT])
    search.run(keys, search.roughly(keys, 1))
    left = {key: max(getattr(search.config(), key) or 0.0, base.fitted[key].low) for key in keys}
    if left.get("k6", 0.0) > MOST_K6[camera]:
        return fitted(clips, camera, emulator, {**dark, "k6": MOST_K6[camera]})
    return {key: float(f"{value:.3g}") for key, value in (left | dark).items()}


def of_camera(clips: list[Clip], camera: str, emulator: str) -> dict[str, float]:
    """The values that stand for the camera of these recordings."""
    return fitted(clips, camera, emulator, {} if len(clips) > 1 else HELD[emulator])


def of_units(middle: dict[str, float], each: list[dict[str, float]]) -> dict[str, object]:
    """The values with thresholds spread as widely as those of the recordings are round the middle."""
    spread: dict[str, object] = dict(middle)
    for key in THRESHOLDS & middle.keys():
        factor = max(max(one[key] / middle[key], middle[key] / one[key]) for one in each)
        spread[key] = {"log_uniform": [float(f"{end:.3g}") for end in (middle[key] / factor, middle[key] * factor)]}
    return spread


def row(clip: Clip, config: EmulatorConfig, kick: float = 0.0) -> list[str]:
    """Rate against the recording, intervals, counts of pixels, and what the judge says."""
    readout = resets(clip, kick) if kick else None
    stream, recorded = clip.simulate(config, 1, readout=readout), sums(clip.events, clip, 0, clip.intervals)
    half = judge_half(recorded, sums(stream, clip, 0, clip.intervals, recorded))
    try:
        auc = judge(clip.events, stream, clip.size, (int(clip.edges_us[0]), int(clip.edges_us[-1]))).auc
    except BlinkGLError:
        auc = float("nan")
    rate = len(stream) / max(len(clip.events), 1)
    values = (rate, half.interval_distance, half.polarity_correlation, half.count_correlation, auc)
    return [f"{value:.2f}" for value in values]


def lines(recorded: dict[str, dict[str, MakeClip]], emulators: list[str]) -> Iterator[str]:
    heads = ["judged by", "fitted to", "rate", "intervals, KS", "polarity", "counts", "judge"]
    rows: list[list[str]] = []
    for (camera, recordings), emulator in itertools.product(recorded.items(), emulators):
        small, whole = ({name: make(most) for name, make in recordings.items()} for most in (FIT, WHOLE))
        middle = of_camera(list(small.values()), camera, emulator)
        dark = {key: middle[key] for key in HELD[emulator]}
        each = [fitted([clip], camera, emulator, dark) for clip in small.values()]
        yield to_short_yaml({camera: {emulator: of_units(middle, each)}})
        for name, clip in whole.items():
            others = of_camera([one for other, one in small.items() if other != name], camera, emulator)
            for which, values in (("the others", others), ("all", middle)):
                config = emulator_config({"emulator": emulator, **noise(camera, emulator), **values})
                kick = kick_of(clip, config) if len(clip.bursts) and which == "all" else KICK
                rows.append([f"{camera}, {emulator}", name, which, *row(clip, config, kick)])
                if len(clip.bursts) and which == "all":
                    readout = resets(clip, kick)
                    assert readout is not None and readout.frame_resets is not None
                    every = readout.frame_resets.interval_ms
                    yield f"{camera}, {name}, {emulator}: resets every {every:.1f} ms by {kick:.2f} thresholds"
    yield table("camera, emulator", heads, rows)


def picture(recorded: dict[str, dict[str, MakeClip]], emulators: list[str], path: Path) -> None:
    """Events of one recording a camera beside those of its shipped file: ON blue, OFF red, 25 ms in the middle."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 1 + len(emulators), figsize=(12.5, 5.4), squeeze=False)
    for row_of, (camera, recordings) in zip(axes, recorded.items()):
        name, make = next(iter(recordings.items()))
        clip, sensor = make(WHOLE), load_sensor(camera)
        middle_us = int(clip.edges_us[0] + clip.edges_us[-1]) // 2
        streams = {f"{name}, recorded": clip.events}
        for emulator in emulators:
            kicked = sensor.readout.frame_resets if sensor.readout is not None else None
            readout = resets(clip, kicked.kick) if kicked else None
            streams[f"sensor: {camera}, {emulator}"] = clip.simulate(sensor.emulator(emulator), 1, readout=readout)
        for axis, (title, events) in zip(row_of, streams.items()):
            shown = events.window(middle_us - 12_500, middle_us + 12_500)
            image = np.ones((*clip.size, 3))
            image[shown.y, shown.x] = np.where(shown.p[:, None] > 0, (0.1, 0.3, 0.9), (0.9, 0.2, 0.1))
            axis.imshow(image)
            axis.set_title(f"{title}: {len(shown):,}", fontsize=9)
            axis.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument("--evbench", type=Path, help="folder of evbench's sequences, for its third")
    parser.add_argument("--camera", choices=("davis240c", "davis346"), action="append")
    parser.add_argument("--emulator", choices=tuple(EmulatorConfig.members), action="append")
    parser.add_argument("--picture", type=Path, help="no fits: draw events recorded and simulated, as PNG")
    a = parser.parse_args()
    np.seterr(divide="ignore")
    recorded = cameras(a.recordings, a.evbench)
    recorded = {name: one for name, one in recorded.items() if not a.camera or name in a.camera}
    if a.picture is not None:
        picture(recorded, a.emulator or list(EmulatorConfig.members), a.picture)
        return
    for line in lines(recorded, a.emulator or list(EmulatorConfig.members)):
        say(plain_console(), line)


if __name__ == "__main__":
    main()
