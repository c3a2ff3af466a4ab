"""Emulators as published training sets had them: ``events: {recipe: NAME}``.

A recipe is a shipped YAML file: ``about`` it, its ``events`` (keys of one emulator, mostly distributions), where each
value comes from (``sources``) and in what it ``differs`` from the program that it is of. When a run is read, ``recipe:
NAME`` becomes what the file says, with the keys beside it laid over that; so a run and its sequences say all by
themselves.
"""

from __future__ import annotations

import copy
from functools import lru_cache
from importlib import resources
from typing import Any

from pydantic import Field

from blinkgl.config.base import Config
from blinkgl.config.draw import is_distribution
from blinkgl.config.problems import validate
from blinkgl.config.reader import parse_yaml
from blinkgl.config.rig import with_sections
from blinkgl.errors import ConfigError


class Recipe(Config):
    """A shipped recipe as its file says it."""

    about: str = Field(description="Which data set or program, and its paper.")
    events: dict[str, Any] = Field(description="Keys of `events:`; distributions are drawn once a sequence.")
    sources: dict[str, str] = Field(description="Where each value comes from, by key.")
    differs: str = Field("", description="In what this is not what they did.")


@lru_cache
def recipe_names() -> tuple[str, ...]:
    """Names of the shipped recipes."""
    files = (resources.files("blinkgl.configs") / "emulators").iterdir()
    return tuple(sorted(f.name.removesuffix(".yaml") for f in files if f.name.endswith(".yaml")))


def load_recipe(name: str) -> Recipe:
    """A shipped recipe. Raises ConfigError naming the known ones."""
    if not isinstance(name, str) or name not in recipe_names():
        raise ConfigError(
            "unknown recipe", where="events.recipe", value=name, accepted=f"one of {', '.join(recipe_names())}"
        )
    return _shipped(name)


@lru_cache
def _shipped(name: str) -> Recipe:
    text = (resources.files("blinkgl.configs") / "emulators" / f"{name}.yaml").read_text(encoding="utf-8")
    return validate(Recipe, parse_yaml(text, f"emulators/{name}.yaml"), where=f"emulators/{name}.yaml")


def with_recipes(tree: dict[str, Any]) -> dict[str, Any]:
    """A run's ``tree`` with every ``events: {recipe: …}``, at the top and in groups, replaced by what it says.
    Raises ConfigError."""
    tree, groups = dict(tree), tree.get("groups")
    if isinstance(groups, dict):
        tree["groups"] = {
            name: with_recipes(group) if isinstance(group, dict) and "groups" not in group else group
            for name, group in groups.items()
        }
    if "events" in tree:
        tree["events"] = _spelled_out(tree["events"])
    return with_sections(tree, lambda one: {**one, "events": _spelled_out(one["events"])} if "events" in one else one)


def _spelled_out(events: Any) -> Any:
    if is_distribution(events):
        return _each(events, _spelled_out)
    if not isinstance(events, dict) or "recipe" not in events:
        return events
    own = {key: value for key, value in events.items() if key != "recipe"}
    return _over(copy.deepcopy(load_recipe(events["recipe"]).events), own)


def _over(events: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """``own`` keys over those of a recipe, in each of its choices where it has some."""
    if is_distribution(events):
        return _each(events, lambda option: _over(option, own))
    if own.get("emulator", events.get("emulator")) != events.get("emulator"):
        raise ConfigError(
            "the recipe is of another emulator",
            where="events.emulator",
            value=own["emulator"],
            accepted=f"{events.get('emulator')}, or no recipe",
        )
    return {**events, **own}


def _each(distribution: dict[str, Any], change) -> dict[str, Any]:
    kind, spec = next(iter(distribution.items()))
    if kind == "choice" and isinstance(spec, list):
        return {kind: [change(option) for option in spec]}
    if kind == "shares" and isinstance(spec, list) and all(isinstance(p, dict) and "value" in p for p in spec):
        return {kind: [{**part, "value": change(part["value"])} for part in spec]}
    return distribution
