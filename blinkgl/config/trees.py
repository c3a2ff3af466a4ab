"""Plain trees of configurations, as YAML gives them: laid over one another, changed in several places at once."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

from blinkgl.config.draw import is_distribution
from blinkgl.config.reader import parse_yaml
from blinkgl.errors import ConfigError

Table = dict[str, Any]
_TAGS = ("kind", "emulator")
_WHOLE = ("sensor",)
"""Keys whose tables are not mixed: another camera is another camera."""


def merge(common: Any, own: Any) -> Any:
    """``own`` laid over ``common``: tables key by key; anything else, a distribution, or a table of another kind
    (``kind: explicit`` over ``kind: random``) replaces what was there."""
    both = (
        isinstance(common, dict) and isinstance(own, dict) and not is_distribution(common) and not is_distribution(own)
    )
    if not both or any(tag in own and own[tag] != common.get(tag) for tag in _TAGS):
        return copy.deepcopy(own)
    laid = {key: copy.deepcopy(value) if key in _WHOLE else merge(common.get(key), value) for key, value in own.items()}
    return {**copy.deepcopy(common), **laid}


def each_option(node: Any, change: Callable[[Any], Any]) -> Any:
    """``node`` changed, or each of the options that it is drawn from."""
    if not is_distribution(node):
        return change(node)
    kind, spec = next(iter(node.items()))
    if kind == "choice" and isinstance(spec, list):
        return {kind: [each_option(option, change) for option in spec]}
    if kind == "shares" and isinstance(spec, list) and all(isinstance(p, dict) and "value" in p for p in spec):
        return {kind: [{**part, "value": each_option(part["value"], change)} for part in spec]}
    return node


def with_groups(tree: Table, change: Callable[[Table], Table]) -> Table:
    """``tree`` changed, and each of the groups that it holds; what is no group is left to validation."""
    changed, groups = change(tree), tree.get("groups")
    if isinstance(groups, dict):
        changed["groups"] = {
            name: change(group) if isinstance(group, dict) and "groups" not in group else group
            for name, group in groups.items()
        }
    return changed


def with_sections(tree: Table, change: Callable[[Table], Table]) -> Table:
    """``tree`` with the table of every sensor that ``sensors:`` lists changed."""
    given = tree.get("sensors")
    if not isinstance(given, list):
        return tree
    return {**tree, "sensors": [change(one) if isinstance(one, dict) else one for one in given]}


def apply_overrides(tree: Table, overrides: Sequence[str]) -> Table:
    """Copy of ``tree`` with ``--set`` options applied; tables on the way are made when absent."""
    tree = copy.deepcopy(tree)
    for option in overrides:
        dotted, equals, text = option.partition("=")
        keys = dotted.strip().split(".")
        if not equals or not all(keys):
            raise ConfigError("not an override", where="--set", value=option, accepted="path.to.key=value")
        value = parse_yaml(text, f"--set {dotted}")
        node: Any = tree
        for depth, key in enumerate(keys):
            last = depth == len(keys) - 1
            if isinstance(node, list):
                if not key.isdigit() or int(key) >= len(node):
                    raise ConfigError(
                        "no such list entry",
                        where="--set " + ".".join(keys[: depth + 1]),
                        value=key,
                        accepted=f"0 … {len(node) - 1}",
                    )
                key = int(key)
            elif not isinstance(node, dict):
                raise ConfigError(
                    "is a plain value and has no keys", where="--set " + ".".join(keys[:depth]), value=node
                )
            if last:
                node[key] = value
            elif isinstance(node, dict):
                if node.get(key) is None:
                    node[key] = {}
                node = node[key]
            else:
                node = node[key]
    return tree
