"""A YAML file as a template of sequences: overrides, sensor and scene files, draws, checks.

A whole data set in one file: groups of sequences that share most of their parameters.

    seed: 2023
    camera: {width: 640, height: 480}         # common to all groups
    groups:
      flying_train:                           # the name of the sequences, unless output.name is given
        output: {split: train, sequences: 3362}
        events: {shares: [{share: 0.8, value: {emulator: v2e}}, {share: 0.2, value: {emulator: voltmeter}}]}
      flying_test:
        output: {split: test, sequences: 200}
        events: {emulator: voltmeter}
      e_tartan:
        enabled: false                        # described, but not generated until it is enabled
        ...

A group is the common part with the group's keys laid over it. Each group has its own seed, derived from the recipe's
seed and the group's name, so that changing the size of one group, adding or removing one changes no sequence of
another.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from blinkgl.config.base import Refused, placed
from blinkgl.config.draw import Fill, corners, draw, is_distribution, sites
from blinkgl.config.expansion import expanded, with_scenes
from blinkgl.config.labels import fill_causes
from blinkgl.config.problems import validate, validate_field
from blinkgl.config.quality import fill_quality, with_default
from blinkgl.config.reader import apply_overrides, merge, read_table, run_file
from blinkgl.config.rig import (
    SECTIONS,
    check_pairs,
    spelled_out as with_whole_sensors,
    with_preset,
)
from blinkgl.config.sensor import fill_sensor
from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import ConfigError
from blinkgl.types.trees import Tree

FILLS = (
    Fill(("quality", "timeline.kind"), fill_quality),
    Fill(("sensor", "events.emulator"), fill_sensor),
    Fill(("labels.events", "events.emulator"), fill_causes),
    Fill(("images",), lambda images: {} if images is None else {"labels": {"images": False}}),
)


_OF_THE_RUN = ("seed", "output", "gl")


@dataclass(frozen=True)
class RunTemplate:
    """A run before its per-sequence parameters are drawn.

    tree : plain data as read, overrides applied.   base : folder that relative paths start from.
    """

    tree: Tree
    base: Path

    def sequence(self, index: int) -> SequenceConfig:
        """Return the validated configuration of sequence ``index`` (>= 0). Raises ConfigError, also where the file has
        several groups of sequences (:attr:`groups`)."""
        if "groups" in self.tree:
            raise ConfigError("the recipe has groups; only a group has numbered sequences", where="groups")
        tree = draw(self.tree, self.seed, index)
        if isinstance(tree, dict) and tree.get("rig") is not None:
            # A preset's sensors have names, too. Each sequence records the unit that it drew, as for a single camera.
            tree = draw(expanded(with_preset(tree), self.base), self.seed, index)
        return _validated(tree)

    @property
    def seed(self) -> int:
        """Return the run's seed, the same for every sequence. Raises ConfigError."""
        return validate_field(SequenceConfig, "seed", self.tree.get("seed", 0))

    def check(self) -> SequenceConfig:
        """Validate configurations that represent all that can be drawn, in every group; return the first. Raises
        ConfigError before any work starts."""
        return self._first

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """Return the groups, disabled ones included; a plain configuration is one group without a name. All that they
        can draw has been checked. Raises ConfigError for no groups, an invalid name, or two groups that write the same
        folders."""
        return _split(self)

    @cached_property
    def _first(self) -> SequenceConfig:  # cached: a large recipe has thousands of configurations to check
        if "groups" in self.tree:
            return self.groups[0].template.check()
        if is_distribution(self.tree):
            raise ConfigError(
                "the whole file cannot be drawn", where=next(iter(self.tree)), accepted="distributions of single keys"
            )
        for key in _OF_THE_RUN:
            if key in self.tree and sites(self.tree[key]):
                raise ConfigError(
                    "belongs to the whole run and cannot be drawn",
                    where=key,
                    value=self.tree[key],
                    accepted="plain values",
                )
        return self.corners[0]

    @cached_property
    def corners(self) -> tuple[SequenceConfig, ...]:
        """Return configurations that represent all that can be drawn (:mod:`blinkgl.config.draw`). Raises
        ConfigError."""
        return tuple(_validated(tree) for tree in corners(with_default(self.tree)))


@dataclass(frozen=True)
class Group:
    """Sequences ``first`` … ``first + count - 1`` of ``template``. ``name`` is "" for a run without groups."""

    name: str
    template: RunTemplate
    first: int
    count: int
    enabled: bool = True

    @property
    def identity(self) -> str:
        """Return the SHA-256 of everything that determines sequence n; the number of sequences is not part of it."""
        tree = without_places(self.template.tree)
        if isinstance(tree.get("output"), dict):
            for key in ("sequences", "first_index"):
                tree["output"].pop(key, None)
        # Keys keep their type (1 is not "1"); their order does not matter.
        text = json.dumps(_plain(tree), sort_keys=True, ensure_ascii=False)
        return hashlib.sha256(text.encode()).hexdigest()


def _split(template: RunTemplate) -> tuple[Group, ...]:
    if "groups" not in template.tree:
        return (_group("", template, True),)
    groups = template.tree["groups"]
    if not isinstance(groups, dict) or not groups:
        raise ConfigError("not a table of groups", where="groups", value=groups, accepted="name: {keys of the group}")
    # A group is the top level's tree with the group's own keys over it.
    common = {key: value for key, value in template.tree.items() if key != "groups"}
    made = []
    for name, own in groups.items():
        where = f"groups.{name}"
        if not isinstance(name, str) or not isinstance(own, dict):
            raise ConfigError("not a group", where=where, value=own, accepted="a table of keys")
        if "groups" in own:
            raise ConfigError("a group cannot hold groups", where=f"{where}.groups")
        # A copy: the run's tree keeps its ``enabled``.
        own = dict(own)
        enabled = own.pop("enabled", True)
        if not isinstance(enabled, bool):
            raise ConfigError("not true or false", where=f"{where}.enabled", value=enabled, accepted="true or false")
        tree = merge(common, own)
        if "seed" not in own:
            # By its name, not by its place: another group more changes no other's sequences.
            tree["seed"] = derived_seed(template.seed, name)
        elif not is_distribution(own["seed"]):
            tree["seed"] = validate_field(SequenceConfig, "seed", own["seed"])
        if isinstance(tree.setdefault("output", {}), dict):
            tree["output"].setdefault("name", name)
        with placed(str, before=f"in group '{name}': "):
            made.append(_group(name, RunTemplate(tree, template.base), enabled))
    # Two groups may have the same name in different splits.
    folders: dict[tuple[str, str], str] = {}
    for group in made:
        output = group.template.tree["output"]
        folder = (output.get("split", "train"), output["name"])
        if folder in folders:
            raise ConfigError(
                f"writes the same folders as group '{folders[folder]}'",
                where=f"groups.{group.name}.output",
                value="/".join(folder),
                accepted="another name or split",
            )
        folders[folder] = group.name
    return tuple(made)


def _group(name: str, template: RunTemplate, enabled: bool) -> Group:
    output = template.check().output
    return Group(name, template, output.first_index, output.sequences, enabled)


def derived_seed(seed: int, name: str) -> int:
    """Return the 63-bit seed of the group ``name``."""
    # A digest: Python's own hash of a text differs from process to process.
    return int.from_bytes(hashlib.sha256(f"{seed}/{name}".encode()).digest()[:8], "little") >> 1


def without_places(node: object) -> Any:
    """Return a copy of plain data with absolute paths by their last parts: another mount, node or container has the
    same files at another place, and contents are compared."""
    if isinstance(node, dict):
        return {key: without_places(value) for key, value in node.items()}
    if isinstance(node, (list, tuple)):
        return [without_places(value) for value in node]
    return Path(node).name if isinstance(node, str) and Path(node).is_absolute() else node


def _plain(node: object) -> Any:
    if isinstance(node, dict):
        return [
            ["table"],
            *sorted(([repr(key), _plain(value)] for key, value in node.items()), key=lambda pair: pair[0]),
        ]
    if isinstance(node, list):
        return [_plain(value) for value in node]
    return repr(node)


def _validated(tree: Mapping[str, object]) -> SequenceConfig:
    """Return the SequenceConfig of plain data; the values of a named quality and sensor fill in the keys that are not
    given. Each of several sensors keeps the rules of a single camera."""
    tree = with_whole_sensors(with_default(tree), FILLS)
    for fill in FILLS:
        tree = fill(tree)
    config = validate(SequenceConfig, tree)
    for k, one in enumerate(config.sensors or ()):
        try:
            config.of_sensor(k).check_rules()
        except Refused as refused:
            inside = refused.where.split(".")[0] in SECTIONS
            raise ConfigError(
                refused.problem if inside else f"{refused.problem} (of sensor '{one.name}')",
                where=f"sensors.{k}.{refused.where}" if inside else refused.where,
                value=refused.value,
                accepted=refused.accepted,
            ) from None
    check_pairs(config.sensors or ())
    if config.sensors is None and config.labels.disparity:  # type: ignore[missing-attribute]
        raise ConfigError(
            "a single camera has no disparity",
            where="labels.disparity",
            accepted="false, or rig: stereo, or sensors with a `pair` (docs/rigs.md)",
        )
    return config


def load_run(path: str | Path, overrides: Sequence[str] = (), *, seed: int | None = None) -> RunTemplate:
    """Read a YAML file and the files that its scenes refer to, apply ``a.b=c`` overrides (c is YAML) and an optional
    seed, and check all that can be drawn.

    path : a file, or the name of a shipped run such as "demo" (:func:`~blinkgl.config.reader.shipped_runs`). Raises
    ConfigError: missing or unreadable file, bad YAML (with line and column), unknown key, bad value."""
    path = run_file(path)
    base = path.parent
    tree = apply_overrides(with_scenes(read_table(path), base), overrides)
    tree = expanded(tree, base)
    if seed is not None:
        tree["seed"] = seed
    if "seed" in tree and not is_distribution(tree["seed"]):  # check() refuses a distribution here
        tree["seed"] = validate_field(SequenceConfig, "seed", tree["seed"])
    template = RunTemplate(tree, base)
    template.check()
    return template
