"""The table of labels, the only list of them.

register(Position())        # a Label: docs/extending.md has a complete example
"""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import resources
from typing import Any

from blinkgl.config.labels import LabelsConfig
from blinkgl.labels.label import BUFFERS, KINDS, VARYINGS, Label

LABELS: dict[str, Label] = {}
"""Labels by ``name``, in the order of registration, which all lists of labels use."""


def register(label: Label) -> Label:
    """Check every part of a row, add it to the table and its keys to ``labels:``; return it.

    Raises TypeError naming the label and the part that is missing or of the wrong kind, or a name that is in use;
    nothing is then registered."""
    _checked(label)
    if _has_own_key(label) and label.name not in LabelsConfig.model_fields:
        LabelsConfig.added.append(label.name)
    LABELS[label.name] = label
    return label


def _has_own_key(label: Label) -> bool:
    return type(label).asked is Label.asked


def label_of(name: str) -> Label:
    """Return the row of this name. Raises KeyError naming the existing ones."""
    if name not in LABELS:
        raise KeyError(f"no label '{name}'; there are {', '.join(LABELS)}")
    return LABELS[name]


def _checked(label: Any) -> None:
    """Check a row. Raises TypeError as :func:`register`."""
    name = getattr(label, "name", None)

    def unless(right: object, part: str, problem: str) -> None:
        if not right:
            raise TypeError(f"label {name!r}: `{part}` {problem}")

    unless(isinstance(label, Label), "label", "is no instance of Label")
    unless(
        isinstance(name, str) and re.fullmatch(r"[a-z](_?[a-z0-9])*", name),
        "name",
        "is not a word of a-z, 0-9 and single _",
    )
    unless(name not in LABELS, "name", "is taken: there is such a label already")
    if _has_own_key(label):
        unless(name not in LabelsConfig.settings, "name", "is taken: `labels:` has such a key for something else")
        new = name not in LabelsConfig.model_fields
        unless(not new or not hasattr(LabelsConfig, str(name)), "name", "cannot be a key")
        unless(not new or bool(label.about), "about", "is missing")
    unless(label.kind in KINDS, "kind", f"is {label.kind!r} and none of {', '.join(KINDS)}")
    _check_drawing(label, unless)
    # Two labels may share a folder if their files have different endings.
    taken = {form.folder + "." + form.ending: other.name for other in LABELS.values() for form in other.forms}
    for form in label.forms:
        at = form.folder + "." + form.ending
        unless(at not in taken, "forms", f"writes where label '{taken.get(at)}' does: {form.file(0)}")
    if type(label).views is Label.views:
        unless(type(label).reference is not Label.reference, "reference", "is missing")
        unless(getattr(label, "tolerance", None) is not None, "tolerance", "is missing")


def _check_drawing(label: Label, unless: Callable[[object, str, str], None]) -> None:
    """Check what the label shader needs, and the other labels that it uses."""
    buffers = (None, *BUFFERS)
    unless(label.buffer in buffers, "buffer", f"is {label.buffer!r} and none of {', '.join(BUFFERS)}")
    made = type(label).finish is not Label.finish or label.anti_aliased
    unless(label.buffer or made, "buffer", "is missing, and so is `finish`: nothing makes the label")
    file = f"include/labels/{label.name}.glsl"
    if label.buffer and label.glsl is None:
        there = resources.files("blinkgl.shaders").joinpath(file).is_file()
        unless(there, "glsl", f"is missing, and so is the file shaders/{file}")
    if label.glsl is not None:
        unless(f" label_{label.name}(" in label.glsl, "glsl", f"does not define label_{label.name}()")
    for part, known in (("varyings", VARYINGS), ("needs", LABELS), ("there", LABELS), ("each", LABELS)):
        unless({*getattr(label, part)} <= {*known}, part, f"names others than {', '.join(known)}")
    unless(label.towards or not label.there, "there", "is said, but not `towards` where the label leads")


# ---------------------------------------------------------------------------------------------------------------------
# Generated includes of the label shader (``shaders/label.glsl``): the table of labels in GLSL, and the snippets of
# rows.


def define_of(name: str) -> str:
    """Return the macro with a label's attachment number."""
    return f"OUT_{name.upper()}"


def includes() -> dict[str, str]:
    """Return texts by their include name: labels_need.glsl, labels.glsl, and labels/NAME.glsl of those labels with
    their own source."""
    drawn = [label for label in LABELS.values() if label.buffer]
    own = {f"labels/{label.name}.glsl": label.glsl.lstrip("\n") for label in drawn if label.glsl is not None}
    return {"labels_need.glsl": _needs(drawn), "labels.glsl": _written(drawn), **own}


def _needs(drawn: list) -> str:
    lines = []
    for varying in VARYINGS:
        who = [f"defined({define_of(label.name)})" for label in drawn if varying in label.varyings]
        if who:
            lines += [f"#if {' || '.join(who)}", f"#define NEEDS_{varying.upper()}", "#endif"]
    return "\n".join(lines) + "\n"


def _written(drawn: list) -> str:
    before, inside = [], []
    for label in drawn:
        define = define_of(label.name)
        before += [
            f"#ifdef {define}",
            f'#include "labels/{label.name}.glsl"',
            f"layout(location = {define}) out {BUFFERS[label.buffer].glsl} out_{label.name};",
            "#endif",
        ]
        inside += [f"#ifdef {define}", f"    out_{label.name} = label_{label.name}();", "#endif"]
    return "\n".join([*before, "void write_labels()", "{", *inside, "}"]) + "\n"
