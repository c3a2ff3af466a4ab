"""Replace the names in a run's configuration by what they refer to, once, when it is read. A run and its sequences are
then complete without other files.

    scene: {from: FILE, …}        the scene of another YAML file, with the other keys laid over it
    camera: {calibration: FILE}   the intrinsics of a calibration (blinkgl.config.camera)
    sensor: FILE                  the table of a sensor file, or of a shipped sensor whose values are distributions
    events: {recipe: NAME, …}     the emulator of a published training set, with the other keys laid over it

These may be at the top level, in groups and, except scenes, at the sensors of a rig; also as options of a distribution.
(``quality:`` and ``rig:`` are filled in when a sequence has been drawn: blinkgl.config.run.)
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from pydantic import Field

from blinkgl.config.base import Config
from blinkgl.config.camera import calibrated, placed_by_calibration
from blinkgl.config.problems import validate
from blinkgl.config.reader import (
    each_option,
    merge,
    read_table,
    shipped,
    with_groups,
    with_sections,
)
from blinkgl.config.rig import check_one_lens
from blinkgl.config.sensor import sensor_file_or_name
from blinkgl.errors import ConfigError
from blinkgl.types.trees import Tree


class Recipe(Config):
    """A shipped recipe file."""

    about: str = Field(description="The data set or program, and its paper.")
    events: Tree = Field(description="Keys of `events:`; distributions are drawn once per sequence.")
    sources: dict[str, str] = Field(description="Source of each value, by key.")
    differs: str = Field("", description="Differences from the original.")


def load_recipe(name: str) -> Recipe:
    """Return a shipped recipe. Raises ConfigError listing the known ones."""
    keys = shipped("emulators", name, "recipe", "events.recipe")
    return validate(Recipe, keys, where=f"emulators/{name}.yaml")


def expanded(tree: Tree, base: Path) -> Tree:
    """Return ``tree`` with its calibrations, sensor files (paths relative to ``base``) and recipes replaced by their
    content. Raises ConfigError."""
    meanings = {
        "camera": partial(calibrated, base=base),
        "sensor": partial(sensor_file_or_name, base=base),
        "events": _recipe,
    }

    def spelled_out(table: Tree) -> Tree:
        meant = {key: each_option(table[key], meaning) for key, meaning in meanings.items() if key in table}
        return {**table, **meant}

    def placed(table: Tree) -> Tree:
        return {**spelled_out(table), **placed_by_calibration(table, base)}

    def whole(table: Tree) -> Tree:
        # Before the names are replaced: a calibration's keys look like those of the camera itself.
        check_one_lens(table)
        # Only a sensor of a rig has a place, which its calibration may state.
        return with_sections(spelled_out(table), placed)

    return with_groups(tree, whole)


def _recipe(events: object) -> object:
    if not isinstance(events, dict) or "recipe" not in events:
        return events
    own = {key: value for key, value in events.items() if key != "recipe"}
    return each_option(load_recipe(events["recipe"]).events, partial(_over, own=own))


def _over(events: Tree, own: Tree) -> Tree:
    """Return a recipe's keys with ``own`` laid over them."""
    if own.get("emulator", events.get("emulator")) != events.get("emulator"):
        raise ConfigError(
            "the recipe uses another emulator",
            where="events.emulator",
            value=own["emulator"],
            accepted=f"{events.get('emulator')}, or no recipe",
        )
    return {**events, **own}


def with_scenes(tree: Tree, base: Path) -> Tree:
    """Return ``tree`` with every ``scene: {from: FILE, …}`` replaced by that file's scene. Raises ConfigError."""
    groups = tree.get("groups")
    named = [(f"groups.{name}.", group) for name, group in groups.items()] if isinstance(groups, dict) else []
    for prefix, table in (("", tree), *named):
        own = table.get("scene") if isinstance(table, dict) else None
        if isinstance(own, dict) and "from" in own:
            table["scene"] = _scene_from(dict(own), f"{prefix}scene.from", base)
    return tree


def _scene_from(own: Tree, where: str, base: Path) -> Tree:
    file = own.pop("from")
    if not isinstance(file, str):
        raise ConfigError("not a file", where=where, value=file, accepted="a YAML file with a scene")
    scene = read_table(base / file).get("scene")
    if not isinstance(scene, dict) or "from" in scene:
        raise ConfigError(
            "the file has no table scene", where=where, value=file, accepted="a file with the table scene"
        )
    return merge(scene, own)
