"""Sections of a configuration from the arguments of a call: a name, a table, or the model itself."""

from __future__ import annotations

import numbers
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal, get_args, get_origin

from blinkgl.config.base import Config, members, placed
from blinkgl.config.problems import validate_field
from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import ConfigError
from blinkgl.front import arguments as check
from blinkgl.labels import LABELS
from blinkgl.types.trees import Tree

Section = str | Mapping[str, Any] | Config
"""A section of a configuration: the name of a preset or kind, a table of its keys, or the model itself."""


_EXAMPLES = {
    "emulator": {"emulator": "v2e", "cutoff_hz": 200},
    "images": {"exposure_us": 10000, "photon_noise": True},
    "imu": {"rate": 400},
    "tracks": {"points": 100},
}
"""Arguments that are a name, a table, or a configuration, and a table of each, for messages."""


def section_tree(argument: str, section: Section) -> Tree:
    """Return the section that an argument of :data:`_EXAMPLES` gives, as plain data. A text sets the first choice that
    the section's model has: an emulator, a preset, a way to choose points. Raises ConfigError."""
    from blinkgl.recordings.simulation import emulator_config

    key = _KEYS.get(argument, argument)
    models = members(SequenceConfig.model_fields[key].annotation)
    fields = models[0].model_fields.items()
    named = next(name for name, field in fields if get_origin(field.annotation) is Literal)
    if not isinstance(section, (str, Mapping, Config)):
        names = ", ".join(word for model in models for word in get_args(model.model_fields[named].annotation))
        accepted = f"{names}, or a table such as {_EXAMPLES[argument]}"
        raise ConfigError("not a name or a table", where=argument, value=section, accepted=accepted)
    if isinstance(section, Config):
        # Of a union, the default choice may be the one that is meant, too.
        tree = section.model_dump(exclude_unset=len(models) == 1)
    else:
        tree = {named: section} if isinstance(section, str) else check.plain(section)
    if key == "events":
        emulator_config(tree)
    else:
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


def is_interval(label: object) -> bool:
    """Whether a label is the interval of a flow, s; ``labels.flow`` checks which ones are valid."""
    return isinstance(label, numbers.Real) and not isinstance(label, bool)


def labels_tree(labels: Sequence[str | float]) -> Tree:
    """Return the ``labels:`` that requests exactly these. Raises ConfigError as :func:`label_names`."""
    wanted = label_names(labels)
    everything: dict[str, object] = {}
    asked: Tree = {}
    for label in LABELS.values():
        label.ask(everything)
        if label.said in wanted:
            label.ask(asked)
    if intervals := [float(one) for one in wanted if is_interval(one)]:
        asked["flow"] = [*asked.get("flow", ()), *sorted(intervals)]
    tree = {key: asked.get(key, [] if isinstance(value, list) else False) for key, value in everything.items()}
    return {**tree, **{name: name in wanted for name in OF_EVENTS}}


class Timeline:
    """Times at which frames are drawn for the emulator: ``Timeline("displacement", max_px=0.5)``.

    kind : "uniform" (fps, Hz), "displacement" (max_px, px) or "brightness" (max_fraction_of_threshold).
    values : keys of that kind, see ``timeline:`` in docs/configuration.md.
    Raises ConfigError."""

    @check.public()
    def __init__(self, kind: str = "displacement", **values: object):
        self.tree = {"kind": check.plain(kind), **check.plain(values)}
        with placed(lambda where: where.replace("timeline", "Timeline", 1)):
            validate_field(SequenceConfig, "timeline", self.tree)

    def __repr__(self) -> str:
        return f"Timeline({', '.join(f'{k}={v!r}' for k, v in self.tree.items())})"


_KEYS = {"emulator": "events"}
"""Keys of the configuration by argument, where they differ."""
_READERS: dict[str, Callable[[Any], Any]] = {
    "labels": labels_tree,
    "timeline": lambda given: check.one_of(given, "timeline", Timeline, "a Timeline").tree,
    **{argument: partial(section_tree, argument) for argument in _EXAMPLES},
}


def sections(arguments: Mapping[str, object]) -> Tree:
    """Return the sections of the configuration that the arguments give, without those that are None. Raises
    ConfigError."""
    return {
        _KEYS.get(name, name): _READERS.get(name, check.plain)(value)
        for name, value in arguments.items()
        if value is not None
    }
