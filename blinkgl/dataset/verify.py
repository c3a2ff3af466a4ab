"""Verification of a data set: files against manifests, names and manifests against configurations, and a sample of
sequences generated again, bit by bit.

A sequence's problems are lines of text; no lines mean no problem. What could not be checked is counted and reported.
Any content of a record, valid or not, leads to a line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.config.images import exposure_starts
from blinkgl.config.run import load_run
from blinkgl.config.scene import lights_change
from blinkgl.config.sequence import SequenceConfig
from blinkgl.dataset.cross_checks import (
    Known,
    Verification,
    against_run,
    guarded,
    index,
    strangers,
    twins,
)
from blinkgl.dataset.messages import RUN_FOLDER
from blinkgl.dataset.plan import sequence_name
from blinkgl.dataset.run_folder import RunFolder
from blinkgl.errors import AssetError
from blinkgl.io.dsec import DsecEventReader
from blinkgl.io.event_labels import EVENT_LABELS
from blinkgl.io.imu import FILES as IMU_FILES
from blinkgl.io.records import shown
from blinkgl.io.sequence_tables import LIGHTS, TRACKS, files_of
from blinkgl.labels import LABELS, asked_for
from blinkgl.machine.heartbeat import heartbeat
from blinkgl.machine.plugins import missing_plugins
from blinkgl.sequence_files.index import data_set, made_folders, sequence_folders
from blinkgl.sequence_files.rig_dir import FILES as LENS_FILES
from blinkgl.sequence_files.sequence_dir import MANIFEST, RIG, manifest_problems, read_manifest, verify_sequence
from blinkgl.types.trees import Tree

# ---------------------------------------------------------------------------------------------------------------------
# What a configuration requires of a sequence's folder: its name, its manifest, its files.


def said_of(config: SequenceConfig) -> list[tuple[str, Any]]:
    """Return (key, value) pairs of every folder's manifest."""
    output = config.output
    return [("split", output.split), ("class", output.label), ("seed", config.seed), ("sequence", output.first_index)]


def times_of(config: SequenceConfig) -> list[tuple[str, Any]]:
    """Return (key, value) pairs of its time."""
    t0, t1 = config.time.t0_ns // 1000, config.time.t1_ns // 1000
    return [("t_offset_us", t0), ("duration_us", t1 - t0)]


def bound(name: str, manifest: dict[str, object], config: SequenceConfig, events: bool = True) -> list[str]:
    """Return where the folder's name, the manifest and the sequence's own configuration disagree, and missing or extra
    files.
    events : whether there are some."""
    fields = [*said_of(config), ("emulator", config.events.emulator if events else None)]
    if config.frames is None:
        fields += [
            ("height", config.camera.height),
            ("width", config.camera.width),
            *times_of(config),
            ("labels", config.time.label_count),
        ]
    causes = events and bool(getattr(config.events, "causes", False))
    if ("events_by_cause" in manifest) != causes:
        # A value that the manifest does not have: unlike() makes a line of it.
        fields.append(("events_by_cause", "that there are some" if causes else None))
    problems = [*unlike(manifest, fields), *misnamed(name, manifest, config)]
    if config.frames is None and not problems:
        problems += not_asked_for(set(files_of_sequence(config, events)), manifest)
    return problems


def unlike(manifest: Mapping[str, object], said: list[tuple[str, object]]) -> list[str]:
    """Return where the manifest differs from ``said``."""
    return [
        f"{MANIFEST}: {key} is {shown(manifest.get(key))}, config.yaml says {value}"
        for key, value in said
        if manifest.get(key) != value
    ]


def misnamed(name: str, manifest: Tree, config: SequenceConfig) -> list[str]:
    """Return whether a folder's name differs from its content, with its split or without. "." may have any name."""
    path = sequence_name(config.output, manifest["sequence"])
    wrong = name != "." and name != (path if "/" in name else path.split("/")[1])
    return [f"the folder is called {shown(name)}, but holds {path}"] if wrong else []


def not_asked_for(wanted: set[str], manifest: Tree) -> list[str]:
    """Return missing and extra files, at most five each."""
    there = set(manifest["files"])
    missing = [f"{file}: missing, config.yaml asks for it" for file in sorted(wanted - there)[:5]]
    return missing + [f"{shown(file)}: config.yaml does not ask for it" for file in sorted(there - wanted)[:5]]


def files_of_sensors(config: SequenceConfig) -> Iterator[str]:
    """Yield the names of the files of a sequence of several sensors, without its manifest."""
    yield from ("config.yaml", RIG)
    for camera in config.cameras():
        yield f"{camera.name}/{MANIFEST}"
        yield from (f"{camera.name}/{file}" for file in files_of_sequence(camera.config, camera.gives_events))
    for one in config.sensors or ():
        if one.imu is not None and not one.sees:
            yield from (f"{one.name}/{file}" for file in IMU_FILES)
    if config.preview.enabled and any(one.events is not None for one in config.sensors or ()):
        yield "preview.mp4"


def files_of_sequence(config: SequenceConfig, events: bool = True) -> Iterator[str]:
    """Yield the names of the files of a generated sequence, without the manifest.   events : whether there are some."""
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
    if config.frames is None and lights_change(config.scene):
        yield LIGHTS
    if config.frames is None and config.camera.lens != "pinhole":  # a lens with distortion
        yield from LENS_FILES
    if config.images is not None:
        starts = exposure_starts(config.images, config.time.t0_ns, config.time.t1_ns, config.camera.height)
        yield from files_of(config.images, len(starts))
    if config.preview.enabled:
        yield "preview.mp4"


# ---------------------------------------------------------------------------------------------------------------------
# Checks of one sequence's folder, or one rig's.

_REQUIRED = {"duration_us": int, "seed": int, "sequence": int, "split": str, "labels": int}


def look(folder: Path, name: str) -> tuple[list[str], Known | None]:
    """Return the problems of a folder. ``name``: path below the data set, "." where the sequence is checked alone and
    may have any name."""
    known: list[Known] = []

    def check() -> list[str]:
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
        if missing := missing_plugins(manifest.get("versions") or {}):
            return missing
        config = load_run(folder / "config.yaml").sequence(manifest["sequence"])
        if manifest["format"] == "blinkgl-rig":
            problems = look_at_sensors(folder, name, manifest, config)
        else:
            problems = look_at_camera(folder, name, manifest, config)
        # Last: other findings say more than that something was edited.
        problems = problems or manifest_problems(folder)
        if not problems:
            known.append(Known(folder, manifest, config))
        return problems

    return guarded(check), known[0] if known else None


def look_at_sensors(folder: Path, name: str, manifest: dict[str, object], config: SequenceConfig) -> list[str]:
    """Return the problems of a rig's folder whose files are complete: its own, and those of each camera's folder."""
    if config.sensors is None:
        return ["config.yaml: a single camera's, but the manifest is a rig's"]
    fields = [("sensors", [one.name for one in config.sensors]), *said_of(config), *times_of(config)]
    problems = [*unlike(manifest, fields), *misnamed(name, manifest, config)]
    if problems := problems or not_asked_for(set(files_of_sensors(config)), manifest):
        return problems
    names = [camera.name for camera in config.cameras()]
    for name in names:
        inside = guarded(lambda name=name: look_at_camera(folder / name, name, read_manifest(folder / name), config))
        problems += [f"{name}/{line}" for line in inside]
    return problems or unlike(manifest, [("events", sum(read_manifest(folder / name)["events"] for name in names))])


def look_at_camera(folder: Path, name: str, manifest: dict[str, object], config: SequenceConfig) -> list[str]:
    """Return the problems of the folder of a camera, of a rig's if the configuration has several sensors."""
    for camera in config.cameras():
        if camera.name == (manifest.get("sensor") or ""):
            problems = bound("." if camera.name else name, manifest, camera.config, camera.gives_events)
            return problems or (events_problems(folder, manifest) if camera.gives_events else [])
    return [f"{MANIFEST}: sensor is {shown(manifest.get('sensor'))}, of which config.yaml says nothing"]


def events_problems(folder: Path, manifest: Tree) -> list[str]:
    """Return the problems of the events, all of which are read: storage, order, place, time, number. Raises AssetError,
    EventDataError: the first of them that a reader refuses."""
    start, duration = manifest["t_offset_us"], manifest.get("duration_us") or 0
    with DsecEventReader(folder / "events.h5", size=(manifest["height"], manifest["width"])) as reader:
        if reader.count != manifest["events"]:
            return [f"events.h5: holds {reader.count} events, {MANIFEST} says {manifest['events']}"]
        for events in reader.chunks():
            if len(events) and not start <= events.t[0] <= events.t[-1] <= start + duration:
                return [
                    f"events.h5: events from {events.t[0]} to {events.t[-1]} µs; the sequence: {start} to "
                    + str(start + duration)
                ]
    return []


__all__ = ["Verification", "verify_dataset"]


def verify_dataset(
    root: str | Path,
    *,
    deep: int = 0,
    seed: int = 0,
    base: str | Path | None = None,
    progress: Callable[[int, str], None] | None = None,
) -> Verification:
    """Check every sequence below ``root``, and the relations between them.

    deep : this many sequences, drawn with ``seed``, are generated again and compared bit by bit.
    base : folder that the recipe's relative paths start from; default: as recorded by the run.
    Raises AssetError when ``root`` holds no sequence."""
    root = data_set(root)
    result = Verification()
    folders = list(made_folders(root))
    if not folders and not (root / RUN_FOLDER).is_dir():
        raise AssetError("no sequence found", where=str(root), accepted="a folder that 'blinkgl generate' wrote")
    known: dict[str, Known] = {}
    for number, folder in enumerate(folders):
        name = folder.relative_to(root).as_posix()
        heartbeat.at(f"sequence {number + 1:,} of {len(folders):,}")
        if progress:
            progress(number, shown(name))
        problems, sequences = look(folder, name)
        result.add(name, problems)
        if sequences is not None:
            known[name] = sequences
    result.sequences = len(folders)
    if not (root / MANIFEST).is_file():
        result.add(".", guarded(lambda: strangers(root, folders)))
        result.add(".", guarded(lambda: index(root, list(sequence_folders(root)))))
        for name, lines in twins(known, result).items():
            result.add(name, lines)
        result.add(".", guarded(lambda: against_run(root, folders, known, result)))
        result.add(".", guarded(RunFolder(root).altered))
    sound = [name for name in known if name not in result.problems]
    if deep and sound:
        chosen = sorted(np.random.default_rng(seed).permutation(len(sound))[:deep])
        from blinkgl.dataset.deep import made_again  # draws; the rest of verification runs where OpenGL is missing

        made_again(root, {sound[i]: known[sound[i]] for i in chosen}, result, base, progress)
    return result
