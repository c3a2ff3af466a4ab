"""What a configuration asks of a sequence's folder: its name, its manifest, its files."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from blinkgl.config.images import exposure_starts
from blinkgl.config.sequence import SequenceConfig
from blinkgl.dataset.plan import sequence_name
from blinkgl.io.event_labels import EVENT_LABELS
from blinkgl.io.frame_camera import files_of
from blinkgl.io.imu import FILES as IMU_FILES
from blinkgl.io.records import shown
from blinkgl.io.tracks import TRACKS
from blinkgl.labels import LABELS, asked_for
from blinkgl.sequence_files.rig_dir import FILES as LENS_FILES
from blinkgl.sequence_files.sequence_dir import MANIFEST, RIG


def said_of(config: SequenceConfig) -> list[tuple[str, Any]]:
    """(key, value) that the manifest of any folder has."""
    return [("split", config.output.split), ("seed", config.seed), ("sequence", config.output.first_index)]


def times_of(config: SequenceConfig) -> list[tuple[str, Any]]:
    """(key, value) of its time."""
    t0, t1 = config.time.t0_ns // 1000, config.time.t1_ns // 1000
    return [("t_offset_us", t0), ("duration_us", t1 - t0)]


def bound(name: str, manifest: dict[str, Any], config: SequenceConfig, events: bool = True) -> list[str]:
    """Do the folder's name, the manifest and the sequence's own configuration speak of the same
    sequence, and is there what it asks for?   events : whether there are some."""
    said = [*said_of(config), ("emulator", config.events.emulator if events else None)]
    if config.frames is None:
        said += [
            ("height", config.camera.height),
            ("width", config.camera.width),
            *times_of(config),
            ("labels", config.time.label_count),
        ]
    told = events and bool(getattr(config.events, "causes", False))
    if ("events_by_cause" in manifest) != told:
        said.append(("events_by_cause", "that there are some" if told else None))
    problems = [*unlike(manifest, said), *misnamed(name, manifest, config)]
    if config.frames is None and not problems:
        problems += not_asked_for(set(_files_of(config, events)), manifest)
    return problems


def unlike(manifest: dict[str, Any], said: list[tuple[str, Any]]) -> list[str]:
    """Where the manifest says another value than ``said``."""
    return [
        f"{MANIFEST}: {key} is {shown(manifest.get(key))}, config.yaml says {value}"
        for key, value in said
        if manifest.get(key) != value
    ]


def misnamed(name: str, manifest: dict[str, Any], config: SequenceConfig) -> list[str]:
    """Whether a folder is called otherwise than what it holds, with its split or without. "." may have any name."""
    path = sequence_name(config.output, manifest["sequence"])
    wrong = name != "." and name != (path if "/" in name else path.split("/")[1])
    return [f"the folder is called {shown(name)}, but holds {path}"] if wrong else []


def not_asked_for(wanted: set[str], manifest: dict[str, Any]) -> list[str]:
    """Files that are missing or too many, five each."""
    there = set(manifest["files"])
    missing = [f"{file}: missing, config.yaml asks for it" for file in sorted(wanted - there)[:5]]
    return missing + [f"{shown(file)}: config.yaml does not ask for it" for file in sorted(there - wanted)[:5]]


def files_of_rig(config: SequenceConfig) -> Iterator[str]:
    """Names of the files of a rig's sequence, its manifest left out."""
    yield from ("config.yaml", RIG)
    for _, name, own, gives_events in config.cameras():
        yield f"{name}/{MANIFEST}"
        yield from (f"{name}/{file}" for file in _files_of(own, gives_events))
    for one in config.sensors or ():
        if one.imu is not None and not one.sees:
            yield from (f"{one.name}/{file}" for file in IMU_FILES)
    if config.preview.enabled and any(one.events is not None for one in config.sensors or ()):
        yield "preview.mp4"


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
    if distorts(config):
        yield from LENS_FILES
    if config.images is not None:
        yield from files_of(config.images, len(exposures_of(config)))
    if config.preview.enabled:
        yield "preview.mp4"


def distorts(config: SequenceConfig) -> bool:
    """Whether a lens bends straight lines, so that its files are there."""
    return config.frames is None and config.camera.lens != "pinhole"


def exposures_of(config: SequenceConfig) -> list[int]:
    """When the frame camera's exposures begin, ns; of a configuration with ``images``."""
    assert config.images is not None
    return exposure_starts(config.images, config.time.t0_ns, config.time.t1_ns, config.camera.height)
