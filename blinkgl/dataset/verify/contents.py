"""Do the files of a sequence hold what their formats and the manifest say?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from blinkgl.config.imu import imu_times
from blinkgl.config.sequence import SequenceConfig
from blinkgl.config.tracks import track_times
from blinkgl.dataset.verify.asked import distorts, exposures_of
from blinkgl.dataset.verify.found import guarded
from blinkgl.dataset.verify.labels import problems_of_asked
from blinkgl.io.event_labels import EVENT_LABELS, EventLabelsReader, problem_of as problem_of_truth
from blinkgl.io.frame_camera import (
    FOLDER as FRAME_CAMERA,
    STAMPS as IMAGE_STAMPS,
    picture_file,
    problem_of,
    read_codes,
    read_exposures,
)
from blinkgl.io.hdf5 import dataset, open_hdf5
from blinkgl.io.imu import FILES as IMU_FILES, read_imu, read_imu_csv
from blinkgl.io.records import shown
from blinkgl.io.tracks import TRACKS, problem_of as problem_of_tracks, read_tracks
from blinkgl.labels import LABELS, Label
from blinkgl.sequence_files.lens_files import problems_of_lens
from blinkgl.types.events import Cause

_BLOCK = 1 << 20


def contents(folder: Path, manifest: dict[str, Any], config: SequenceConfig) -> list[str]:
    """Problems of what the files of one camera's sequence hold."""
    problems = guarded(lambda: check_events(folder / "events.h5", manifest)) if "events.h5" in manifest["files"] else []
    problems = [line if line.startswith("events.h5") else f"events.h5: {line}" for line in problems]
    if EVENT_LABELS in manifest["files"]:
        problems += guarded(lambda: _check_truth(folder, manifest))
    problems += guarded(lambda: _check_labels(folder, manifest))
    problems += guarded(lambda: problems_of_asked(folder, manifest, config))
    if config.imu is not None:
        problems += guarded(lambda: check_imu(folder, config))
    if config.tracks is not None:
        problems += guarded(lambda: _check_tracks(folder, manifest, config))
    if distorts(config):
        problems += guarded(lambda: problems_of_lens(folder, config.camera.model))
    if config.images is not None:
        problems += guarded(lambda: _check_images(folder, manifest, config))
    return problems


def check_events(path: Path, manifest: dict[str, Any]) -> list[str]:
    """Sorted, inside the sensor and the sequence's time, counted as the manifest says, and
    ``ms_to_idx`` right at every millisecond."""
    problems = []
    with open_hdf5(path) as file:
        columns = {k: dataset(file, f"events/{k}", path, shape=(None,)) for k in "xytp"}
        offset = int(dataset(file, "t_offset", path, shape=())[()])
        counts = {k: len(c) for k, c in columns.items()}
        if set(counts.values()) != {manifest["events"]}:
            return [f"events.h5: columns of {sorted(set(counts.values()))} events, manifest says {manifest['events']}"]
        if offset != manifest["t_offset_us"]:
            problems.append(f"events.h5: t_offset is {offset}, manifest says {manifest['t_offset_us']}")
        last, end = 0, manifest["duration_us"]
        needed = -(-end // 1000) + 1
        table = dataset(file, "ms_to_idx", path, shape=(None,))
        if not needed <= len(table) <= needed + 1:
            return [*problems, f"events.h5: ms_to_idx has {len(table)} entries, {needed} are needed"]
        problems += _check_causes(file, path, manifest)
        ms_to_idx = table[()].astype(np.int64)
        expected = np.zeros(len(ms_to_idx), np.int64)
        marks = np.arange(len(ms_to_idx), dtype=np.int64) * 1000
        for begin in range(0, manifest["events"], _BLOCK):
            x, y, t, p = (columns[k][begin : begin + _BLOCK].astype(np.int64) for k in "xytp")
            if (np.diff(t) < 0).any() or t[0] < last:
                problems.append(
                    f"events.h5: times decrease after event {begin + int(np.argmax(np.diff(t, prepend=last) < 0))}"
                )
                break
            last = int(t[-1])
            if x.max() >= manifest["width"] or y.max() >= manifest["height"] or min(x.min(), y.min()) < 0:
                problems.append(f"events.h5: an event outside {manifest['width']}x{manifest['height']} px")
                break
            if p.max() > 1 or p.min() < 0:
                problems.append("events.h5: a polarity other than 0 and 1")
                break
            expected += np.searchsorted(t, marks)
        else:
            if manifest["events"] and last > end:
                problems.append(f"events.h5: last event at {last} µs, the sequence ends at {end} µs")
            if (wrong := np.flatnonzero(ms_to_idx != expected)).size:
                problems.append(
                    f"events.h5: ms_to_idx[{wrong[0]}] is {ms_to_idx[wrong[0]]}, expected {expected[wrong[0]]}"
                )
    return problems


def _check_causes(file: h5py.File, path: Path, manifest: dict[str, Any]) -> list[str]:
    """As many events of each cause as the manifest says."""
    there, wanted = "events/cause" in file, manifest.get("events_by_cause")
    if wanted is None or (not there and manifest["events"] == 0):
        return ["events.h5: 'events/cause', which the manifest does not know"] if there and wanted is None else []
    column = dataset(file, "events/cause", path, shape=(None,), kinds="iu")
    if len(column) != manifest["events"]:
        return [f"events.h5: causes of {len(column)} events, manifest says {manifest['events']}"]
    counts = np.zeros(256, np.int64)
    for begin in range(0, len(column), _BLOCK):
        counts += np.bincount(column[begin : begin + _BLOCK].astype(np.uint8), minlength=256)
    found = {cause.name.lower(): int(counts[cause]) for cause in Cause}
    if found == wanted and counts.sum() == sum(found.values()):
        return []
    return [f"events.h5: causes are {found}, manifest says {wanted}"]


def _check_truth(folder: Path, manifest: dict[str, Any]) -> list[str]:
    """A row per event, of what can be, and the causes that ``events.h5`` says."""
    count, instances = manifest["events"], {thing["id"] for thing in manifest.get("objects", ())}
    with EventLabelsReader(folder) as reader, open_hdf5(folder / "events.h5") as file:
        if reader.count != count:
            return [f"{EVENT_LABELS}: rows of {reader.count} events, manifest says {count}"]
        said = "events/cause" in file
        if said != reader.causes:
            return [f"{EVENT_LABELS}: causes " + ("are missing" if said else "that events.h5 does not have")]
        for begin in range(0, count, _BLOCK):
            truth, cause = reader.read(begin, begin + _BLOCK)
            if (problem := problem_of_truth(truth, instances)) is not None:
                return [f"{EVENT_LABELS}: {problem}"]
            if said and (cause != file["events/cause"][begin : begin + _BLOCK]).any():
                return [f"{EVENT_LABELS}: causes that are not those of events.h5"]
    return []


def _check_labels(folder: Path, manifest: dict[str, Any]) -> list[str]:
    """Of every label there is: as many files as time stamps as labels; times inside the sequence and in order; and in
    the first and the last file an array of the manifest's size that holds what its row says it can."""
    problems = []
    for label in LABELS.values():
        files = sorted(name for name in manifest["files"] if label.forms[0].holds(name))
        if files or label.stamps in manifest["files"]:
            problems += _check_times(folder, manifest, label, files)
            for name in dict.fromkeys(files[:1] + files[-1:]):
                problems += [f"{name}: {line}" for line in _check_value(folder / name, manifest, label)]
    return problems


def _check_times(folder: Path, manifest: dict[str, Any], label: Label, files: list[str]) -> list[str]:
    problems = []
    where, begin, end = (
        label.forms[0].folder,
        manifest["t_offset_us"],
        manifest["t_offset_us"] + manifest["duration_us"],
    )
    count = manifest["labels"]
    if label.stamps is None or label.stamps not in manifest["files"]:
        return (
            []
            if len(files) == count + label.at_last
            else [f"{where}: {len(files)} files, manifest says {count} labels"]
        )
    lines = [line for line in (folder / label.stamps).read_text().splitlines() if line and not line.startswith("#")]
    if label.towards is None:
        times = [int(line) for line in lines]
        if len(times) != len(files):
            problems.append(f"{where}: {len(files)} files, {len(times)} time stamps")
        if sorted(set(times)) != times or (times and not begin <= times[0] <= times[-1] <= end):
            problems.append(f"{label.stamps}: times are not in order inside {begin} … {end} µs")
    else:
        pairs = [tuple(int(v) for v in line.split(",")) for line in lines]
        if not len(files) == len(pairs) == count:
            problems.append(f"{where}: {len(files)} files, {len(pairs)} time stamps, manifest says {count} labels")
        if any(not begin <= t <= end for pair in pairs for t in pair) or any(
            (b > a) != (label.towards == "forward") for a, b in pairs
        ):
            problems.append(f"{label.stamps}: an interval leaves the sequence or runs the wrong way")
    return problems


def _check_value(path: Path, manifest: dict[str, Any], label: Label) -> list[str]:
    value = label.forms[0].read(path)
    problem = label.wrong(value, manifest["height"], manifest["width"]) or label.problem(value)
    return [] if problem is None else [problem]


def check_imu(folder: Path, config: SequenceConfig) -> list[str]:
    """As many measurements as the configuration asks for, at its times, finite, and the same in all files."""
    arrays, wanted = read_imu(folder), imu_times(config.imu.rate, config.time.t0_ns, config.time.t1_ns)
    if arrays["t_ns"].tolist() != wanted:
        return [f"{IMU_FILES[2]}: {len(arrays['t_ns'])} measurements, not the {len(wanted)} that config.yaml asks for"]
    if not all(np.isfinite(array).all() for array in arrays.values()):
        return [f"{IMU_FILES[2]}: a number that is not finite"]
    for name, columns in zip(IMU_FILES, (("rate", "acceleration"), ("ideal_rate", "ideal_acceleration"))):
        told = read_imu_csv(folder / name)
        if not all(np.array_equal(a, arrays[b]) for a, b in zip(told, ("t_ns", *columns))):
            return [f"{name}: not what imu.h5 says"]
    return []


def _check_tracks(folder: Path, manifest: dict[str, Any], config: SequenceConfig) -> list[str]:
    """At the times that the configuration asks for, of what the scene has, inside the image where seen."""
    arrays, time = read_tracks(folder), config.time
    wanted = track_times(config.tracks.rate, time.label_times_ns[0], time.t1_ns, time.interval_ns)
    if arrays["t_us"].tolist() != [t // 1000 for t in wanted]:
        return [f"{TRACKS}: at {len(arrays['t_us'])} times, not at the {len(wanted)} that config.yaml asks for"]
    instances = {thing["id"] for thing in manifest.get("objects", ())}
    problem = problem_of_tracks(arrays, manifest["height"], manifest["width"], instances)
    return [] if problem is None else [f"{TRACKS}: {problem}"]


def _check_images(folder: Path, manifest: dict[str, Any], config: SequenceConfig) -> list[str]:
    """Of the frame camera: as many images as the configuration has exposures, at its times and inside the sequence, and
    in the first and the last one codes that its settings can give."""
    images, starts = config.images, exposures_of(config)
    lines = read_exposures(folder)
    stamps = [int(line) for line in (folder / IMAGE_STAMPS).read_text().split()]
    said = manifest.get("frame_camera")
    problems = []
    if not isinstance(said, dict) or said.get("images") != len(lines) or len(lines) != len(starts):
        count = said.get("images") if isinstance(said, dict) else None
        return [
            f"{FRAME_CAMERA}: {len(lines)} exposures, manifest says {shown(count)}, config.yaml asks for {len(starts)}"
        ]
    if [round(line.start_us * 1000) for line in lines] != starts or [line.middle_us for line in lines] != stamps:
        problems.append(f"{FRAME_CAMERA}: exposures are not at the times that config.yaml and the time stamps say")
    end_us = manifest["t_offset_us"] + manifest["duration_us"] + 1
    if any(not (line.start_us < line.end_us <= end_us and line.exposure_us > 0) for line in lines):
        problems.append(f"{FRAME_CAMERA}: an exposure leaves the sequence")
    for picture in images.pictures:
        for k in sorted({0, len(lines) - 1}):
            name = picture_file(picture, k)
            wrong = problem_of(read_codes(folder / name), images, manifest["height"], manifest["width"])
            problems += [] if wrong is None else [f"{name}: {wrong}"]
    return problems
