"""Is a data set whole and right? Files against manifests, names and manifests against configurations, contents against
the formats, and a sample against itself made anew.

A sequence's problems are lines of text; none means none found. What could not be looked at is counted and said: nothing
is passed over in silence. Whatever stands in a record, looking at it ends, and ends with a line.
"""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from blinkgl.config.images import exposure_starts
from blinkgl.config.imu import imu_times
from blinkgl.config.sequence import RunTemplate, SequenceConfig, load_run
from blinkgl.config.tracks import track_times
from blinkgl.dataset.generate import generate_sequence
from blinkgl.dataset.plan import Plan, sequence_name
from blinkgl.dataset.run_folder import RunFolder
from blinkgl.dataset.verify_labels import problems_of_asked
from blinkgl.dataset.work import RUN_FOLDER
from blinkgl.errors import AssetError, BlinkGLError
from blinkgl.events.types import Cause
from blinkgl.gl import GLContext, create_context
from blinkgl.io.event_labels import EVENT_LABELS, EventLabelsReader, problem_of as problem_of_truth
from blinkgl.io.frame_camera import (
    FOLDER as FRAME_CAMERA,
    STAMPS as IMAGE_STAMPS,
    files_of,
    picture_file,
    problem_of,
    read_codes,
    read_exposures,
)
from blinkgl.io.hdf5 import dataset, open_hdf5
from blinkgl.io.imu import FILES as IMU_FILES, read_imu, read_imu_csv
from blinkgl.io.index import INDEX, entry, made_folders, read_index, sequence_folders
from blinkgl.io.lens_files import FILES as LENS_FILES, problems_of_lens
from blinkgl.io.records import open_regular, shown
from blinkgl.io.sequence_dir import MANIFEST, RIG, read_manifest, verify_sequence
from blinkgl.io.tracks import TRACKS, problem_of as problem_of_tracks, read_tracks
from blinkgl.labels import LABELS, Label, asked_for

_BLOCK = 1 << 20
_REQUIRED = {"duration_us": int, "seed": int, "sequence": int, "split": str, "labels": int}
_AT_TOP = {INDEX, "report.html"}
_MOST_MISSING = 1000
"""Missing sequences that get a line each; the others are counted."""
_SAME_ANYWHERE = (
    "split",
    "seed",
    "sequence",
    "emulator",
    "labels",
    "duration_us",
    "t_offset_us",
    "height",
    "width",
    "objects",
    "source",
)
"""Of a manifest: what no renderer and no library has a say in."""


_ENGINES = ("mujoco",)
"""Among the versions of a manifest: what computed the poses of falling bodies."""


@dataclass
class Verification:
    """``problems``: sequence (or "." for the data set) -> lines. ``notes``: what was not looked at, and why.

    ``deep``: sequences that were made again, the same bit by bit or not. ``in_part``: those of them that differ from
    what this machine makes and were made on another; there only what no machine has a say in was compared."""

    sequences: int = 0
    problems: dict[str, list[str]] = field(default_factory=dict)
    deep: list[str] = field(default_factory=list)
    in_part: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def clean(self) -> bool:
        return not self.problems

    def add(self, name: str, problems: list[str]) -> None:
        if problems:
            self.problems.setdefault(name, []).extend(problems)


@dataclass
class _Known:
    """A sequence without problems of its own."""

    folder: Path
    manifest: dict[str, Any]
    config: SequenceConfig


def verify_dataset(
    root: str | Path,
    *,
    deep: int = 0,
    seed: int = 0,
    base: str | Path | None = None,
    progress: Callable[[int, str], None] | None = None,
) -> Verification:
    """Every sequence below ``root``, and what lies between them.

    deep : so many sequences, drawn with ``seed``, are generated again and compared bit by bit.
    base : folder that the recipe's relative paths start from; default: as the run's record says.
    Raises AssetError when ``root`` holds no sequence at all."""
    root = Path(root)
    if not root.is_dir():
        raise AssetError("no such data set", where=str(root), accepted="a folder of sequences")
    result = Verification()
    folders = list(made_folders(root))
    if not folders and not (root / RUN_FOLDER).is_dir():
        raise AssetError("no sequence found", where=str(root), accepted="a folder that 'blinkgl generate' wrote")
    known: dict[str, _Known] = {}
    for number, folder in enumerate(folders):
        name = folder.relative_to(root).as_posix()
        if progress:
            progress(number, shown(name))
        problems, found = _look(folder, name)
        result.add(name, problems)
        if found is not None:
            known[name] = found
    result.sequences = len(folders)
    if not (root / MANIFEST).is_file():
        result.add(".", _guarded(lambda: _between(root, folders)))
        result.add(".", _guarded(lambda: _index(root, list(sequence_folders(root)))))
        for name, lines in _twins(known, result).items():
            result.add(name, lines)
        result.add(".", _guarded(lambda: _against_run(root, folders, known, result)))
    sound = [name for name in known if name not in result.problems]
    if deep and sound:
        chosen = sorted(np.random.default_rng(seed).permutation(len(sound))[:deep])
        _deep(root, {sound[i]: known[sound[i]] for i in chosen}, result, base, progress)
    return result


def _guarded(check: Callable[[], list[str]]) -> list[str]:
    """``check()``, or as its only line what stopped it: libraries meet damaged files with exceptions of every kind."""
    try:
        return check()
    except BlinkGLError as error:
        return [str(error)]
    except Exception as error:  # noqa: BLE001
        return [f"cannot be checked: {type(error).__name__}: {shown(' '.join(str(error).split()))}"]


def _look(folder: Path, name: str) -> tuple[list[str], _Known | None]:
    """``name``: path below the data set, "." where the sequence is looked at alone and may be called anything."""
    found: list[_Known] = []

    def check() -> list[str]:
        if name != "." and folder.is_symlink():
            return ["a symbolic link, not a folder"]
        if problems := verify_sequence(folder):
            return problems
        manifest = read_manifest(folder)
        if missing := [
            f"{MANIFEST}: '{key}' is missing or no {kind.__name__}"
            for key, kind in _REQUIRED.items()
            if manifest.get(key) is None
        ]:
            return missing
        if "config.yaml" not in manifest["files"]:
            return ["config.yaml: missing"]
        config = load_run(folder / "config.yaml").sequence(manifest["sequence"])
        if manifest["format"] == "blinkgl-rig":
            problems = look_at_rig(folder, name, manifest, config)
        elif config.sensors is not None:
            problems = look_at_sensor(folder, manifest, config)
        else:
            problems = _bound(name, manifest, config) or contents(folder, manifest, config)
        if not problems:
            found.append(_Known(folder, manifest, config))
        return problems

    return _guarded(check), found[0] if found else None


def look_at_rig(folder: Path, name: str, manifest: dict[str, Any], config: SequenceConfig) -> list[str]:
    """Problems of a rig's folder whose files are whole: of itself, and of each camera's in it."""
    if config.sensors is None:
        return ["config.yaml: a single camera's, but the manifest is a rig's"]
    said = [("sensors", [one.name for one in config.sensors]), *_said_of(config), *_times_of(config)]
    if problems := [*_unlike(manifest, said), *_misnamed(name, manifest, config)]:
        return problems
    if problems := _not_asked_for(set(_files_of_rig(config)), manifest):
        return problems
    for one in config.sensors:
        if one.sees:
            inside = _guarded(
                lambda one=one: look_at_sensor(folder / one.name, read_manifest(folder / one.name), config)
            )
            problems += [f"{one.name}/{line}" for line in inside]
        elif one.imu is not None:
            inside = _guarded(lambda one=one: _check_imu(folder / one.name, config.model_copy(update={"imu": one.imu})))
            problems += [f"{one.name}/{line}" for line in inside]
    total = sum(read_manifest(folder / one.name)["events"] for one in config.sensors if one.sees)
    return problems or _unlike(manifest, [("events", total)])


def look_at_sensor(folder: Path, manifest: dict[str, Any], config: SequenceConfig) -> list[str]:
    """Problems of the folder of one camera of a rig, whose configuration is the rig's."""
    number = {one.name: k for k, one in enumerate(config.sensors or ()) if one.sees}.get(str(manifest.get("sensor")))
    if number is None or config.sensors is None:
        return [f"{MANIFEST}: sensor is {shown(manifest.get('sensor'))}, of which config.yaml says nothing"]
    own, events = config.of_sensor(number), config.sensors[number].events is not None
    return _bound(".", manifest, own, events) or contents(folder, manifest, own)


def _files_of_rig(config: SequenceConfig) -> Iterator[str]:
    """Names of the files of a rig's sequence, its manifest left out."""
    yield from ("config.yaml", RIG)
    for k, one in enumerate(config.sensors or ()):
        if one.sees:
            yield f"{one.name}/{MANIFEST}"
            yield from (f"{one.name}/{file}" for file in _files_of(config.of_sensor(k), one.events is not None))
        elif one.imu is not None:
            yield from (f"{one.name}/{file}" for file in IMU_FILES)
    if config.preview.enabled and any(one.events is not None for one in config.sensors or ()):
        yield "preview.mp4"


def contents(folder: Path, manifest: dict[str, Any], config: SequenceConfig) -> list[str]:
    """Problems of what the files of one camera's sequence hold."""
    problems = (
        _guarded(lambda: check_events(folder / "events.h5", manifest)) if "events.h5" in manifest["files"] else []
    )
    problems = [line if line.startswith("events.h5") else f"events.h5: {line}" for line in problems]
    if EVENT_LABELS in manifest["files"]:
        problems += _guarded(lambda: _check_truth(folder, manifest))
    problems += _guarded(lambda: _check_labels(folder, manifest))
    problems += _guarded(lambda: problems_of_asked(folder, manifest, config))
    if config.imu is not None:
        problems += _guarded(lambda: _check_imu(folder, config))
    if config.tracks is not None:
        problems += _guarded(lambda: _check_tracks(folder, manifest, config))
    if _distorts(config):
        problems += _guarded(lambda: problems_of_lens(folder, config.camera.model))
    if config.images is not None:
        problems += _guarded(lambda: _check_images(folder, manifest, config))
    return problems


def _said_of(config: SequenceConfig) -> list[tuple[str, Any]]:
    return [("split", config.output.split), ("seed", config.seed), ("sequence", config.output.first_index)]


def _times_of(config: SequenceConfig) -> list[tuple[str, Any]]:
    t0, t1 = config.time.t0_ns // 1000, config.time.t1_ns // 1000
    return [("t_offset_us", t0), ("duration_us", t1 - t0)]


def _bound(name: str, manifest: dict[str, Any], config: SequenceConfig, events: bool = True) -> list[str]:
    """Do the folder's name, the manifest and the sequence's own configuration speak of the same
    sequence, and is there what it asks for?   events : whether there are some."""
    said = [*_said_of(config), ("emulator", config.events.emulator if events else None)]
    if config.frames is None:
        said += [
            ("height", config.camera.height),
            ("width", config.camera.width),
            *_times_of(config),
            ("labels", config.time.label_count),
        ]
    told = events and bool(getattr(config.events, "causes", False))
    if ("events_by_cause" in manifest) != told:
        said.append(("events_by_cause", "that there are some" if told else None))
    problems = [*_unlike(manifest, said), *_misnamed(name, manifest, config)]
    if config.frames is None and not problems:
        problems += _not_asked_for(set(_files_of(config, events)), manifest)
    return problems


def _unlike(manifest: dict[str, Any], said: list[tuple[str, Any]]) -> list[str]:
    return [
        f"{MANIFEST}: {key} is {shown(manifest.get(key))}, config.yaml says {value}"
        for key, value in said
        if manifest.get(key) != value
    ]


def _misnamed(name: str, manifest: dict[str, Any], config: SequenceConfig) -> list[str]:
    path = sequence_name(config.output, manifest["sequence"])
    wrong = name != "." and name != (path if "/" in name else path.split("/")[1])
    return [f"the folder is called {shown(name)}, but holds {path}"] if wrong else []


def _not_asked_for(wanted: set[str], manifest: dict[str, Any]) -> list[str]:
    there = set(manifest["files"])
    missing = [f"{file}: missing, config.yaml asks for it" for file in sorted(wanted - there)[:5]]
    return missing + [f"{shown(file)}: config.yaml does not ask for it" for file in sorted(there - wanted)[:5]]


def _files_of(config: SequenceConfig, events: bool = True) -> Iterator[str]:
    """Names of the files of a generated sequence, the manifest left out.   events : whether there are some."""
    yield from ("poses.npz", "config.yaml")
    if events:
        yield "events.h5"
        if config.labels.events:
            yield EVENT_LABELS
    for name in asked_for(config.labels):
        label = LABELS[name]
        if label.stamps is not None:
            yield label.stamps
        for form in label.written(config.labels):
            yield from form.files(config.time.label_count + label.at_last)
    if config.imu is not None:
        yield from IMU_FILES
    if config.tracks is not None:
        yield TRACKS
    if _distorts(config):
        yield from LENS_FILES
    if config.images is not None:
        yield from files_of(config.images, len(_exposures_of(config)))
    if config.preview.enabled:
        yield "preview.mp4"


def _distorts(config: SequenceConfig) -> bool:
    return config.frames is None and config.camera.lens != "pinhole"


def _exposures_of(config: SequenceConfig) -> list[int]:
    """When the frame camera's exposures begin, ns."""
    return exposure_starts(config.images, config.time.t0_ns, config.time.t1_ns, config.camera.height)


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


def _check_imu(folder: Path, config: SequenceConfig) -> list[str]:
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
    images, starts = config.images, _exposures_of(config)
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


# ---- between sequences -----------------------------------------------------------------------------------------------


def _between(root: Path, folders: list[Path]) -> list[str]:
    """What lies in the data set and belongs to no sequence."""
    problems = []
    known = set(folders)
    parents = {folder.parent for folder in folders} | {root}

    def look(folder: Path) -> Iterator[Path]:
        for path in sorted(folder.iterdir()):
            if path in known or (folder == root and path.name in (*_AT_TOP, RUN_FOLDER)):
                continue
            if path in parents and path.is_dir() and not path.is_symlink():
                yield from look(path)
            else:
                yield path

    for path in look(root):
        name = path.relative_to(root).as_posix()
        if path.is_dir() and not path.is_symlink() and not any(path.iterdir()):
            continue
        left = ".blinkgl-tmp-" in path.name
        problems.append(f"{shown(name)}: {'left by a run that was cut off' if left else 'belongs to no sequence'}")
    return problems


def _index(root: Path, folders: list[Path]) -> list[str]:
    """The index says what the manifests say."""
    try:
        (root / INDEX).lstat()
    except FileNotFoundError:
        return []
    listed = {line["path"]: line for line in read_index(root)}
    actual = {}
    for folder in folders:
        with suppress(BlinkGLError):
            line = entry(root, folder)
            actual[line["path"]] = line
    wrong = sorted(p for p in listed.keys() | actual.keys() if listed.get(p) != actual.get(p))
    return [f"{INDEX}: out of date for {shown(p)}" for p in wrong[:5]]


def _twins(known: dict[str, _Known], result: Verification) -> dict[str, list[str]]:
    """Sequences with the events or the poses of another one, although they are different draws. Where nothing is drawn
    at all (a scene of one's own or recorded frames, thresholds that are all alike) twins
    are what was asked for, and a note."""
    seen: dict[tuple[str, str], str] = {}
    problems: dict[str, list[str]] = {}
    for name, one in known.items():
        files, config = _files_of_first(one.manifest), one.config
        random_scene = config.frames is None and config.scene.kind == "random"
        looked = [
            f
            for f, tells in (("events.h5", one.manifest["events"] > 0), ("poses.npz", random_scene))
            if tells and f in files
        ]
        for file in looked:
            other = seen.setdefault((file, files[file]["sha256"]), name)
            if other == name:
                continue
            numbers = [(known[n].config.seed, known[n].manifest["sequence"]) for n in (name, other)]
            if numbers[0] != numbers[1] and (random_scene or _noisy(config)):
                problems.setdefault(name, []).append(
                    f"{file}: the same as in {shown(other)}, a sequence of another draw"
                )
            elif file == "events.h5":
                result.notes.append(
                    f"{shown(name)}: the same events as {shown(other)}, as their configurations have it"
                )
    return problems


def _files_of_first(manifest: dict[str, Any]) -> dict[str, Any]:
    """Files of a sequence, of a rig's first camera alone."""
    if not manifest.get("cameras"):
        return manifest["files"]
    own = manifest["cameras"][0] + "/"
    return {name.removeprefix(own): file for name, file in manifest["files"].items() if name.startswith(own)}


def _noisy(config: SequenceConfig) -> bool:
    """Whether two seeds give two pixel arrays."""
    if config.sensors is not None:
        return any(_noisy(config.of_sensor(k)) for k, one in enumerate(config.sensors) if one.events is not None)
    drawn = (
        "threshold_sigma",
        "threshold_jitter",
        "leak_rate_hz",
        "shot_noise_rate_hz",
        "hot_pixel_fraction",
        "k3",
        "k6",
    )
    readout = config.readout
    behind = readout is not None and (readout.pixels is not None or readout.latency is not None)
    return behind or any(getattr(config.events, key, 0) > 0 for key in drawn)


def _against_run(root: Path, folders: list[Path], known: dict[str, _Known], result: Verification) -> list[str]:
    """Sequences that the recipe asks for and are not there, or are and it draws others; what
    the run says of its OpenGL."""
    plan, record = plan_of(root), RunFolder(root).read("run.json") or {}
    if plan is None:
        result.notes.append("no record of the run here: sequences were not compared with a recipe")
        return []
    failed: dict[str, str] = {}
    problems = _guarded(lambda: failed.update(RunFolder(root).read("failed.json") or {}) or [])
    here = {folder.relative_to(root).as_posix() for folder in folders}
    missing = 0
    for task in plan.tasks:
        if task.name not in here:
            missing += 1
            if missing <= _MOST_MISSING:
                result.add(
                    task.name,
                    [
                        f"set aside: {shown(failed[task.name])}"
                        if task.name in failed
                        else "missing: the recipe asks for it"
                    ],
                )
    if missing > _MOST_MISSING:
        problems.append(f"and {missing - _MOST_MISSING} more sequences that the recipe asks for are missing")
    if record.get("mixed"):
        result.notes.append("the run went on with --mixed: configurations and OpenGL were not compared with its record")
        return problems
    groups = {
        f"{g.template.tree.get('output', {}).get('split', 'train')}/{_called(g.template)}": g for g in plan.groups
    }
    environment = record.get("environment", {})
    for name, one in known.items():
        group = groups.get(re.sub(r"_\d{6,}$", "", name))
        if group is None:
            result.add(name, ["no group of the recipe makes it"])
            continue
        drawn = group.template.sequence(one.manifest["sequence"])
        if where := _first_difference(_comparable(one.config), _comparable(drawn)):
            result.add(name, [f"config.yaml: the recipe draws another value for {where}"])
        result.add(
            name,
            [
                f"{MANIFEST}: made with {key} {shown(value)}, the run's record says {shown(environment[key])}"
                for key, value in _made_with(one.manifest).items()
                if environment.get(key, value) != value
            ],
        )
    return problems


def _made_with(manifest: dict[str, Any]) -> dict[str, str]:
    """Versions and OpenGL, under the names that the run's record has for them."""
    gl = manifest.get("opengl") or {}
    return {
        **(manifest.get("versions") or {}),
        **({"opengl": f"{gl.get('renderer')}, {gl.get('version')}"} if gl else {}),
    }


def _called(template: RunTemplate) -> str:
    return template.check().output.name


def _comparable(config: SequenceConfig) -> dict[str, Any]:
    """Plain data without what a sequence's own configuration says otherwise than the recipe:
    its number, and which of the folders."""
    tree = json.loads(config.model_dump_json())
    for key in ("sequences", "first_index"):
        tree["output"].pop(key)
    if tree["frames"] is not None:
        tree["frames"].pop("folders")
    return tree


def _first_difference(a: Any, b: Any, path: str = "") -> str:
    """Dotted path, "" when they agree. Numbers that a text form rounds are equal."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in sorted(a.keys() | b.keys()):
            if where := _first_difference(a.get(key), b.get(key), f"{path}.{key}" if path else key):
                return where
        return ""
    return "" if a == b else path


def plan_of(root: Path) -> Plan | None:
    """The plan of the run that made ``root``; None without a record of one. Raises BlinkGLError: a damaged record."""
    known = RunFolder(root).read("run.json")
    if known is None:
        return None
    recipe = root / RUN_FOLDER / "recipe.yaml"
    with suppress(FileNotFoundError):
        open(open_regular(recipe), "rb").close()
        template = load_run(recipe)
        return Plan.of(RunTemplate(template.tree, Path(known.get("base", "."))), known.get("num"))
    return None


# ---- made again ------------------------------------------------------------------------------------------------------


def _deep(root: Path, chosen: dict[str, _Known], result: Verification, base: str | Path | None, progress) -> None:
    gl: GLContext | None = None
    if base is None:
        base = "."
        with suppress(BlinkGLError):  # a damaged record has been reported
            base = (RunFolder(root).read("run.json") or {}).get("base", ".")
    with tempfile.TemporaryDirectory(prefix="blinkgl-verify-") as scratch:
        try:
            for name, one in chosen.items():
                if progress:
                    progress(result.sequences, "again: " + shown(name))

                def again(name: str = name, one: _Known = one) -> list[str]:
                    nonlocal gl
                    if one.config.frames is None and gl is None:
                        gl = create_context(one.config.gl.backend, one.config.gl.device)
                    made = generate_sequence(one.config, one.manifest["sequence"], scratch, gl, base=Path(base)).path
                    try:
                        result.deep.append(name)
                        return _compared(name, one, made, result)
                    finally:
                        shutil.rmtree(made)

                lines = _guarded(again)
                result.add(name, lines if name in result.deep else [f"cannot be made again: {line}" for line in lines])
        finally:
            if gl is not None:
                gl.release()


def _compared(name: str, one: _Known, made: Path, result: Verification) -> list[str]:
    """The sequence against itself made again: bit by bit, or as far as two machines can agree."""
    lines = differences(one.folder, made)
    if not lines:
        return []
    manifest = read_manifest(made)
    if not (apart := _apart(one.manifest, manifest)):
        return [f"made again, {line}" for line in lines]
    result.in_part.append(name)
    problems = [
        f"made again, {MANIFEST}: {key} differs" for key in _SAME_ANYWHERE if one.manifest.get(key) != manifest.get(key)
    ]
    problems += [f"made again, {line}" for line in lines if line.endswith("only in one of them")]
    depend = []
    for file in sorted(set(one.manifest["files"]) & set(manifest["files"])):
        if one.manifest["files"][file]["sha256"] != manifest["files"][file]["sha256"]:
            inside = next((camera for camera in manifest.get("cameras", ()) if file.startswith(camera + "/")), None)
            below, name_ = ("", file) if inside is None else (inside, file.removeprefix(inside + "/"))
            if (_moved_otherwise(one.manifest, manifest) and _follows_poses(name_)) or _agrees(
                name_, one.folder / below, made / below
            ):
                depend.append(file)
            else:
                problems.append(f"made again, {file}: differs by more than a renderer can")
    result.notes.append(
        f"{shown(name)}: {apart}; of {len(depend)} files that may depend on it the bytes were not compared: "
        + ", ".join(depend[:4])
        + (" …" if len(depend) > 4 else "")
    )
    return problems


def _apart(one: dict[str, Any], other: dict[str, Any]) -> str:
    """What may make the bytes of two machines differ; "" where nothing does."""
    mine, here = ({"BlinkGL": manifest.get("blinkgl"), **_made_with(manifest)} for manifest in (one, other))
    different = [k for k in mine.keys() | here.keys() if mine.get(k) != here.get(k)]
    return "; ".join(
        f"made with {k} {shown(mine.get(k))}, this machine has {shown(here.get(k))}" for k in sorted(different)
    )


def _moved_otherwise(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether another engine, or another version of it, computed the poses of one of the two."""
    return any(_made_with(one).get(name) != _made_with(other).get(name) for name in _ENGINES)


def _follows_poses(file: str) -> bool:
    """Whether what the file says hangs on where things are, not only on what was asked for."""
    return file != "config.yaml" and not file.endswith(".txt")


def _agrees(file: str, one: Path, other: Path) -> bool:
    """Whether two machines' files of one name say the same, as far as machines can agree. True for what a renderer, a
    codec or a library may change in every byte."""
    a, b = one / file, other / file
    if file == "config.yaml":
        configs = [load_run(path) for path in (a, b)]
        return not _first_difference(*(_comparable(c.sequence(c.check().output.first_index)) for c in configs))
    if any(form.holds(file) for label in LABELS.values() for form in label.forms[1:]):
        return True  # says again what the first form does
    if file.endswith(".txt"):
        return False
    if file == "poses.npz":
        with np.load(a, allow_pickle=False) as p, np.load(b, allow_pickle=False) as q:
            return set(p.files) == set(q.files) and all(
                p[k].shape == q[k].shape
                and (
                    np.allclose(p[k], q[k], rtol=1e-9, atol=1e-9)
                    if p[k].dtype.kind == "f"
                    else np.array_equal(p[k], q[k])
                )
                for k in p.files
            )
    for label in LABELS.values():
        if label.forms[0].holds(file):
            return label.agrees(label.forms[0].read(a), label.forms[0].read(b))
    return True


def differences(a: Path, b: Path) -> list[str]:
    """Files in which two folders differ, one line each."""
    names = [{p.relative_to(f).as_posix() for p in f.rglob("*") if p.is_file()} for f in (a, b)]
    lines = [f"{shown(name)}: only in one of them" for name in sorted(names[0] ^ names[1])]
    return lines + [
        f"{shown(name)}: differs"
        for name in sorted(names[0] & names[1])
        if (a / name).read_bytes() != (b / name).read_bytes()
    ]
