"""What a run has to make: the list of sequences, and what identifies the run so that another day's workers can go on with it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from blinkgl.config.base import validate
from blinkgl.config.reader import to_yaml
from blinkgl.config.recipe import Group, all_groups
from blinkgl.config.scene import ExplicitSceneConfig, FileSceneConfig, RandomSceneConfig
from blinkgl.config.sequence import OutputConfig, RunTemplate, SequenceConfig
from blinkgl.dataset.frames import matching_folders, used_images
from blinkgl.errors import AssetError, ConfigError, OutputError
from blinkgl.scene.build import check_assets
from blinkgl.scene.images import IMAGE_SUFFIXES, content_hash
from blinkgl.scene.mesh_files import dependencies
from blinkgl.scene.pool import files_below, resolve
from blinkgl.scene.world import pools


@dataclass(frozen=True)
class Task:
    """One sequence: ``index`` of ``group``; ``name`` is its folder below the data set, "train/flying_000017"."""

    group: str
    index: int
    name: str


def sequence_name(output: OutputConfig, index: int) -> str:
    """<split>/<name>_<index>"""
    return f"{output.split}/{output.name}_{index:06d}"


@dataclass(frozen=True)
class Plan:
    """The sequences of a run, in order. ``groups`` also holds those that are switched off: they identify the recipe."""

    template: RunTemplate
    groups: tuple[Group, ...]
    tasks: tuple[Task, ...]

    @classmethod
    def of(cls, template: RunTemplate, num: int | None = None) -> "Plan":
        """``num``: at most so many of each group (a configuration without groups: exactly so many).

        Raises ConfigError: any bad value of the recipe, or every group switched off."""
        groups = all_groups(template)
        tasks = []
        for group in groups:
            count = group.count if num is None else num if group.name == "" else min(num, group.count)
            output = validate(OutputConfig, group.template.tree.get("output") or {}, where="output")
            if group.enabled:
                tasks += [Task(group.name, i, sequence_name(output, i)) for i in range(group.first, group.first + count)]
        if not tasks:
            raise ConfigError("every group is switched off", where="groups", accepted="enabled: true in at least one")
        return cls(template, groups, tuple(tasks))

    @cached_property
    def by_name(self) -> dict[str, Group]:
        return {group.name: group for group in self.groups}

    def config(self, task: Task) -> SequenceConfig:
        """The sequence's configuration, every value drawn. Raises ConfigError."""
        return self.by_name[task.group].template.sequence(task.index)

    @cached_property
    def used(self) -> tuple[Group, ...]:
        """The groups that have tasks."""
        names = {task.group for task in self.tasks}
        return tuple(group for group in self.groups if group.name in names)

    @property
    def identity(self) -> dict[str, str]:
        """Group -> hash of its recipe, without the numbers of sequences: a run may be made longer."""
        return {group.name: group.identity for group in self.groups}

    def check_assets(self) -> dict[str, str]:
        """Content hash of every file that the run's scenes may use, by name; frame folders by name and size.

        Raises ConfigError and AssetError: missing folders, empty pools, pools too small for the split, too few frame folders."""
        hashes: dict[str, str] = {}
        for group in self.used:
            try:
                _check_group(group, self.tasks, hashes)
            except ConfigError as error:
                if group.name:
                    raise ConfigError(f"in group '{group.name}': {error.problem}", where=error.where, value=error.value,
                                      accepted=error.accepted) from None
                raise
        return hashes

    def recipe_text(self) -> str:
        """The recipe with all overrides, as YAML that ``load_run`` takes."""
        return to_yaml(self.template.tree)


def _check_group(group: Group, tasks: Iterable[Task], hashes: dict[str, str]) -> None:
    base = group.template.base
    # What check_assets looks at, and which folders there are.
    for config in group.template.corners_of("frames", "scene.kind", "scene.pool", "scene.textures", "scene.sky", "scene.objects.count",
                                            "scene.meshes", "scene.materials", "scene.path"):
        if config.frames is not None:
            folders = matching_folders(config.frames, base)
            needed = [task.index for task in tasks if task.group == group.name]
            if len(folders) > 1 and max(needed) >= len(folders):
                raise ConfigError(f"{len(folders)} folders are too few for sequence {max(needed)}", where="frames.folders",
                                  value=list(config.frames.folders), accepted=f"at least {max(needed) + 1} folders, or fewer output.sequences")
            for folder in folders:
                with suppress(AssetError):  # one bad folder is set aside alone; frames too far apart are the recipe's fault
                    used_images(config.frames, folder)
                for path in sorted(folder.rglob("*")):
                    if path.is_file():
                        hashes[f"frames/{folder.name}/{path.relative_to(folder).as_posix()}"] = f"{path.stat().st_size} bytes"
            continue
        check_assets(config.scene, base, config.output.split)
        _hash_scene_files(config.scene, base, hashes)


def _hash_scene_files(scene, base: Path, hashes: dict[str, str]) -> None:
    def file(path: Path, name: str) -> None:
        data = path.read_bytes()
        hashes[name] = content_hash(data, *dependencies(path, data))

    if isinstance(scene, RandomSceneConfig):
        for pool in pools(scene, base):
            hashes.update({f"{entry.source}/{entry.name}": entry.source_hash for entry in pool.entries if entry.file is not None})
        for name in scene.sky.panoramas if scene.sky else ():
            path = resolve(name, base)
            for found in files_below(path, "scene.sky.panoramas", name, IMAGE_SUFFIXES, "images") if path.is_dir() else [path]:
                hashes[f"{name}/{found.name}"] = content_hash(found.read_bytes())
    elif isinstance(scene, ExplicitSceneConfig):
        for used in [*(m.file for m in scene.meshes.values()), *(m.texture for m in scene.materials.values())]:
            if used is not None:
                file(resolve(used, base), used)
    elif isinstance(scene, FileSceneConfig):
        file(resolve(scene.path, base), scene.path)


def digest(hashes: dict[str, str]) -> str:
    """One hash of :meth:`Plan.check_assets`, to compare machines by."""
    return hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()


def check_output(out: str | Path) -> None:
    """OutputError when ``out`` cannot become a folder of sequences."""
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise OutputError("is a file", where=str(out), accepted="a folder")
