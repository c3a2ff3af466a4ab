"""One sequence's folder, or one rig's, by itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from blinkgl.config.run import load_run
from blinkgl.config.sequence import SequenceConfig
from blinkgl.dataset.verify.config_checks import bound, files_of_rig, misnamed, not_asked_for, said_of, times_of, unlike
from blinkgl.dataset.verify.problems import Known, guarded
from blinkgl.io.records import shown
from blinkgl.sequence_files.sequence_dir import MANIFEST, manifest_problems, read_manifest, verify_sequence

_REQUIRED = {"duration_us": int, "seed": int, "sequence": int, "split": str, "labels": int}


def look(folder: Path, name: str) -> tuple[list[str], Known | None]:
    """``name``: path below the data set, "." where the sequence is looked at alone and may be called anything."""
    found: list[Known] = []

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
            problems = look_at_sensor(manifest, config)
        else:
            problems = bound(name, manifest, config)
        # Last: what else is found says more than that something was edited.
        problems = problems or manifest_problems(folder)
        if not problems:
            found.append(Known(folder, manifest, config))
        return problems

    return guarded(check), found[0] if found else None


def look_at_rig(folder: Path, name: str, manifest: dict[str, Any], config: SequenceConfig) -> list[str]:
    """Problems of a rig's folder whose files are whole: of itself, and of each camera's in it."""
    if config.sensors is None:
        return ["config.yaml: a single camera's, but the manifest is a rig's"]
    said = [("sensors", [one.name for one in config.sensors]), *said_of(config), *times_of(config)]
    if problems := [*unlike(manifest, said), *misnamed(name, manifest, config)]:
        return problems
    if problems := not_asked_for(set(files_of_rig(config)), manifest):
        return problems
    names = [name for _, name, _, _ in config.cameras()]
    for name in names:
        inside = guarded(lambda name=name: look_at_sensor(read_manifest(folder / name), config))
        problems += [f"{name}/{line}" for line in inside]
    total = sum(read_manifest(folder / name)["events"] for name in names)
    return problems or unlike(manifest, [("events", total)])


def look_at_sensor(manifest: dict[str, Any], config: SequenceConfig) -> list[str]:
    """Problems of the folder of one camera of a rig, whose configuration is the rig's."""
    for _, name, own, gives_events in config.cameras():
        if name == manifest.get("sensor"):
            return bound(".", manifest, own, gives_events)
    return [f"{MANIFEST}: sensor is {shown(manifest.get('sensor'))}, of which config.yaml says nothing"]
