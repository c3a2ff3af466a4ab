"""Every emulator fitted to the recordings that have frames: the table of docs/results.md.

    python -m blinkgl.tools.fit_recordings FOLDER [--only TEXT] [--starts N] [--leave-one-out EMULATOR] [--judge]

FOLDER : of the recordings slider_depth, cuke_davis346 (needs dv-processing) and evbench_davis240, as docs/results.md
names them. Each is fitted on its first half in time and judged on its second.

--leave-one-out: each recording beside a sensor made of what was fitted to the others, a distribution over units: the
rate of its middle and of units drawn from it, and how well the judge of `compare --judge` tells default, that sensor's
middle and the recording's own fit from the recording. What is added to the light before the logarithm is not fitted
there: it is of the frames (their black level, exposure and gain) and not of the pixels, and thresholds that are fitted
beside it trade with it, so that those of two recordings would not be of the same thing.

--judge: nothing is fitted; each recording beside what every emulator makes of its frames as it is shipped and with the
shipped sensor of that camera, and beside ESIM without noise: rate, and how well the judge tells them apart.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.config.draw import draw, middle
from blinkgl.config.sensor import load_sensor
from blinkgl.io.frames import open_frames, read_any_image
from blinkgl.recordings.bursts import inside_any
from blinkgl.recordings.calibration import Calibration, calibrate_events
from blinkgl.recordings.clip import LOG_OFFSET, Clip, clip_of_frames, read_recording, timed_frames
from blinkgl.recordings.judge import judge, judge_halves
from blinkgl.recordings.simulation import emulator_config
from blinkgl.types.events import Events

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
    times, as far apart as the bursts that they make in the events (50.96 ms); two stuck pixels."""
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
        (np.ascontiguousarray(read_any_image(file)[:, :190]), 44_000_000 + 50_960_000 * k, file.name)
        for k, file in enumerate(files)
    ]
    return events, (180, 190), frames, False


RECORDINGS: dict[str, Callable[[Path], Recording]] = {
    read.__name__: read for read in (slider_depth, cuke_davis346, evbench_davis240)
}
EMULATORS = ("esim", "v2e", "voltmeter")
SENSORS = {"slider_depth": "davis240c", "cuke_davis346": "davis346", "evbench_davis240": "davis240c"}
NO_NOISE = {"emulator": "esim", "threshold_sigma": 0.0, "threshold_jitter": 0.0}


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


OFFSETS = {"esim": {"log_eps": LOG_OFFSET / 255}, "v2e": {"full_scale": 255.0}, "voltmeter": {"k2": LOG_OFFSET}}
"""Of an emulator: the keys that are of the frames."""


def units_of(configs: list[dict[str, Any]], keys: Iterable[str]) -> dict[str, Any]:
    """Keys of `events:` as a sensor file says them, of what was fitted to ``configs``: log-uniform where they differ.

    Of n values from a uniform law of width w the range is w (n - 1)/(n + 1) in the mean: so much wider than what was
    seen, on both sides, is the law that is taken."""
    configs = [with_ratio(config) for config in configs]
    found: dict[str, Any] = {}
    for key in ("threshold_ratio" if key == "contrast_threshold_off" else key for key in keys):
        logs = np.log([c[key] for c in configs if c[key]])
        if not logs.size:
            continue
        seen = float(np.ptp(logs))
        beyond = seen / max(logs.size - 1, 1)
        ends = np.exp([logs.min() - beyond, logs.max() + beyond])
        found[key] = float(ends[0]) if seen < 1e-6 else {"log_uniform": [float(end) for end in ends]}
    return found


def with_ratio(config: dict[str, Any]) -> dict[str, Any]:
    """The OFF threshold as its ratio to ON's: both are of one bias, and differ less between units than either does."""
    if "contrast_threshold_off" not in config:
        return config
    off = config["contrast_threshold_off"] or config["contrast_threshold"]
    return {**config, "contrast_threshold_off": None, "threshold_ratio": off / config["contrast_threshold"]}


def span_of(clip: Clip) -> tuple[int, int]:
    """µs, of all intervals that are compared."""
    return int(clip.edges_us[0]), int(clip.edges_us[-1])


def told_apart(clip: Clip, simulated: Events) -> float:
    """The judge's area, without the bursts of the camera's frames, which no emulator makes."""
    streams = (e.part(~inside_any(e.t, clip.bursts)) for e in (clip.events, simulated))
    return judge(*streams, clip.size, span_of(clip)).auc


def shipped(folder: Path, only: str = "") -> Iterator[str]:
    """Lines of a Markdown table: what is shipped, unfitted."""
    yield "| recording | events of | rate | judge |"
    yield "|---|---|---|---|"
    for name, read in RECORDINGS.items():
        if only not in name:
            continue
        events, size, frames, _ = read(folder)
        clip = clip_of_frames(events, frames, size)
        sensor = load_sensor(SENSORS[name])
        configs = {"ESIM without noise": emulator_config(NO_NOISE)}
        for emulator in EMULATORS:
            configs[f"{emulator}, default"] = emulator_config(emulator)
            configs[f"{emulator}, {sensor.name}"] = sensor.emulator(emulator)
        yield f"| {name} | its own halves | 1 | {judge_halves(clip.events, clip.size, span_of(clip)).auc:.3f} |"
        for what, config in configs.items():
            simulated = clip.simulate(config, 1)
            rate = len(simulated) / len(clip.events)
            yield f"| {name} | {what} | {rate:.2f} | {told_apart(clip, simulated):.3f} |"


def left_out(folder: Path, emulator: str, starts: int = 3, units: int = 20) -> Iterator[str]:
    """Lines of a Markdown table, one for each recording."""
    found: dict[str, Calibration] = {}
    for name, read in RECORDINGS.items():
        events, size, frames, exposures = read(folder)
        begin, fixed = {"emulator": emulator, **OFFSETS[emulator]}, OFFSETS[emulator]
        found[name] = calibrate_events(
            events, size, frames, name=name, exposures=exposures, emulator=begin, fixed=fixed, starts=starts
        )
    yield (
        "| recording | rate, middle | 90 % of units | judge: halves | default | others' sensor | own fit | "
        "others' sensor says |"
    )
    yield "|---|---|---|---|---|---|---|---|"
    for name, own in found.items():
        clip, base = own.clip, own.before
        law = units_of([o.config.model_dump() for n, o in found.items() if n != name], base.fitted)
        unset = with_ratio(base.model_dump())
        config = lambda keys, unset=unset: emulator_config({**unset, **keys})
        recorded = len(clip.events)
        ratio = lambda keys: len(clip.simulate(config(keys), 1)) / recorded
        rates = np.sort([ratio(draw(law, unit, 0)) for unit in range(units)])
        low, high = np.quantile(rates, (0.05, 0.95))
        area = lambda one, clip=clip: told_apart(clip, clip.simulate(one, 1))
        values = ", ".join(
            f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v['log_uniform'][0]:.3g}-{v['log_uniform'][1]:.3g}"
            for k, v in law.items()
        )
        yield (
            f"| {name} | {ratio(middle(law)):.3f} | {low:.2f}-{high:.2f} "
            f"| {judge_halves(clip.events, clip.size, span_of(clip)).auc:.3f} | {area(emulator_config(emulator)):.3f} "
            f"| {area(config(middle(law))):.3f} | {area(config(with_ratio(own.config.model_dump()))):.3f} | {values} |"
        )
        yield (
            f"<!-- {name}: own fit "
            + ", ".join(f"{k} {v:.4g} ± {own.uncertainty[k]:.2g}" for k, v in own.values.items())
            + f"; second half rate {own.judged[1].rate_ratio:.3f}, KS {own.judged[1].interval_distance:.3f} -->"
        )


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="part of 'RECORDING EMULATOR'")
    parser.add_argument("--starts", type=int, default=3)
    parser.add_argument("--leave-one-out", metavar="EMULATOR", choices=EMULATORS)
    parser.add_argument("--judge", action="store_true", help="what is shipped, without a fit")
    options = parser.parse_args()
    lines = rows(options.folder, options.only, options.starts)
    if options.judge:
        lines = shipped(options.folder, options.only)
    elif options.leave_one_out:
        lines = left_out(options.folder, options.leave_one_out, options.starts)
    for line in lines:
        print(line, flush=True)


if __name__ == "__main__":
    main()
