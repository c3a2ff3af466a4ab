"""Sections of a configuration from the arguments of a call: a name, a table, or the model itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from blinkgl.config.base import Config
from blinkgl.config.problems import validate_field
from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import ConfigError
from blinkgl.front import arguments as check
from blinkgl.labels import LABELS

Section = str | Mapping[str, Any] | Config
"""A section of a configuration: the name of a preset or kind, a table of its keys, or the model itself."""


def events_tree(emulator: Section) -> dict[str, Any]:
    """Return ``events:`` of a name, a table with ``emulator``, or a configuration. Raises ConfigError."""
    from blinkgl.recordings.simulation import emulator_config

    if not isinstance(emulator, (str, Mapping, Config)):
        raise ConfigError(
            "not an emulator",
            where="emulator",
            value=emulator,
            accepted="a name, or a table such as {'emulator': 'v2e', 'cutoff_hz': 200}",
        )
    tree = (
        emulator.model_dump()
        if isinstance(emulator, Config)
        else {"emulator": emulator}
        if isinstance(emulator, str)
        else check.plain(emulator)
    )
    emulator_config(tree)
    return tree


NAMED = {
    "images": (
        "preset",
        "a frame camera",
        "a preset's name, or a table such as {'exposure_us': 10000, 'photon_noise': True}",
    ),
    "imu": ("preset", "an inertial unit", "a preset's name, or a table such as {'rate': 400}"),
    "tracks": ("choose", "point tracks", "grid, random, surface, or a table such as {'points': 100}"),
}
"""Sections of a configuration: the key set by a text, its description, the accepted values."""


def section_tree(key: str, given: Any) -> dict[str, Any]:
    """Return a section of :data:`NAMED`, from a name, a table, or a configuration. Raises ConfigError."""
    named, what, accepted = NAMED[key]
    if not isinstance(given, (str, Mapping, Config)):
        raise ConfigError(f"not {what}", where=key, value=given, accepted=accepted)
    if isinstance(given, Config):
        tree = given.model_dump(exclude_unset=True)
    else:
        tree = {named: given} if isinstance(given, str) else check.plain(given)
    validate_field(SequenceConfig, key, tree)
    return tree


_FORMER = {"flow": "'forward', as in labels.flow of a YAML", "flow_backward": "'backward', as in labels.flow of a YAML"}
OF_EVENTS = ("events",)
"""Labels that belong to events and not to a time."""


def label_names(labels: Sequence[str | float]) -> set[str | float]:
    """Return the names, and the intervals of flow, s. Raises ConfigError: no such label (:mod:`blinkgl.labels`)."""
    # Intervals are requested by numbers.
    known = [*dict.fromkeys(one.said for one in LABELS.values() if one.said != "flow_intervals"), *OF_EVENTS]
    wanted = check.one_of(labels, "labels", (list, tuple, set, frozenset), "a list of names of labels")
    for name in wanted:
        if isinstance(name, str) and name in _FORMER:
            raise ConfigError("has another name", where="labels", value=name, accepted=_FORMER[name])
        if name not in known and not is_interval(name):
            raise ConfigError("unknown label", where="labels", value=name, accepted=", ".join(known))
    return set(wanted)


def is_interval(label: Any) -> bool:
    """Whether a label is the interval of a flow, s; ``labels.flow`` checks which ones are valid."""
    return isinstance(label, (int, float)) and not isinstance(label, bool)


def labels_tree(labels: Sequence[str | float]) -> dict[str, Any]:
    """Return the ``labels:`` that requests exactly these. Raises ConfigError as :func:`label_names`."""
    wanted = label_names(labels)
    everything: dict[str, Any] = {}
    asked: dict[str, Any] = {}
    for label in LABELS.values():
        label.ask(everything)
        if label.said in wanted:
            label.ask(asked)
    if intervals := [float(one) for one in wanted if is_interval(one)]:
        asked["flow"] = [*asked.get("flow", ()), *sorted(intervals)]
    tree = {key: asked.get(key, [] if isinstance(value, list) else False) for key, value in everything.items()}
    return {**tree, **{name: name in wanted for name in OF_EVENTS}}


SECTIONS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "emulator": ("events", events_tree),
    "labels": ("labels", labels_tree),
    **{key: (key, partial(section_tree, key)) for key in NAMED},
    "sensor": ("sensor", check.plain),
}
"""Argument -> key of the configuration, and the function that reads it."""


def sections(readers: Mapping[str, tuple[str, Callable[[Any], Any]]], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sections of the given arguments that are not None. readers : as :data:`SECTIONS`. Raises
    ConfigError."""
    return {key: read(given[name]) for name, (key, read) in readers.items() if given.get(name) is not None}
