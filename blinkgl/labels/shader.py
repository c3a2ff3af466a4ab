"""What the label shader (``shaders/label.glsl``) includes that is no file: the table of labels in GLSL, and the
snippets that stand in rows."""

from __future__ import annotations

from blinkgl.labels.label import BUFFERS, VARYINGS
from blinkgl.labels.table import LABELS


def define_of(name: str) -> str:
    """The macro that says to which attachment a label goes."""
    return f"OUT_{name.upper()}"


def includes() -> dict[str, str]:
    """Texts by the name that they are included by: labels_need.glsl, labels.glsl, and
    labels/NAME.glsl of those labels whose source is their own."""
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
