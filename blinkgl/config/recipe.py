"""A whole data set in one file: groups of sequences that share most of their parameters.

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

import copy
import hashlib
import json
from dataclasses import dataclass
from typing import Any

from blinkgl.config.draw import is_distribution
from blinkgl.config.problems import validate_field
from blinkgl.config.reader import merge
from blinkgl.config.run import RunTemplate
from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import ConfigError


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
        tree = copy.deepcopy(self.template.tree)
        if isinstance(tree.get("output"), dict):
            for key in ("sequences", "first_index"):
                tree["output"].pop(key, None)
        # Keys keep their type (1 is not "1"); their order does not matter.
        text = json.dumps(_plain(tree), sort_keys=True, ensure_ascii=False)
        return hashlib.sha256(text.encode()).hexdigest()


def all_groups(template: RunTemplate) -> tuple[Group, ...]:
    """Return the groups of a recipe, disabled ones included; a plain configuration is one group without a name. All
    that they can draw has been checked.

    Raises ConfigError for no groups, an invalid name, or two groups that write the same folders."""
    return template.groups


def split(template: RunTemplate) -> tuple[Group, ...]:
    """Return :func:`all_groups`, not cached."""
    if "groups" not in template.tree:
        return (_group("", template.tree, template, True),)
    groups = template.tree["groups"]
    if not isinstance(groups, dict) or not groups:
        raise ConfigError("not a table of groups", where="groups", value=groups, accepted="name: {keys of the group}")
    common = {key: value for key, value in template.tree.items() if key != "groups"}
    made = []
    for name, own in groups.items():
        where = f"groups.{name}"
        if not isinstance(name, str) or not isinstance(own, dict):
            raise ConfigError("not a group", where=where, value=own, accepted="a table of keys")
        if "groups" in own:
            raise ConfigError("a group cannot hold groups", where=f"{where}.groups")
        own = dict(own)
        enabled = own.pop("enabled", True)
        if not isinstance(enabled, bool):
            raise ConfigError("not true or false", where=f"{where}.enabled", value=enabled, accepted="true or false")
        tree = merge(common, own)
        if "seed" not in own:
            tree["seed"] = derived_seed(template.seed, name)
        elif not is_distribution(own["seed"]):
            tree["seed"] = validate_field(SequenceConfig, "seed", own["seed"])
        if isinstance(tree.setdefault("output", {}), dict):
            tree["output"].setdefault("name", name)
        try:
            made.append(_group(name, tree, template, enabled))
        except ConfigError as error:
            raise ConfigError(
                f"in group '{name}': {error.problem}", where=error.where, value=error.value, accepted=error.accepted
            ) from None
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


def _group(name: str, tree: dict[str, Any], template: RunTemplate, enabled: bool) -> Group:
    made = RunTemplate(tree, template.base)
    config: SequenceConfig = made.check()
    return Group(name, made, config.output.first_index, config.output.sequences, enabled)


def derived_seed(seed: int, name: str) -> int:
    """Return the 63-bit seed of the group ``name``."""
    return int.from_bytes(hashlib.sha256(f"{seed}/{name}".encode()).digest()[:8], "little") >> 1


def _plain(node: Any) -> Any:
    if isinstance(node, dict):
        return [
            ["table"],
            *sorted(([repr(key), _plain(value)] for key, value in node.items()), key=lambda pair: pair[0]),
        ]
    if isinstance(node, list):
        return [_plain(value) for value in node]
    return repr(node)
