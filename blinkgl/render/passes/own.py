"""Passes of plug-ins, as the shader debugger shows them: ``blinkgl shader passes demo --plugin mine.py``."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.labels.label import KINDS
from blinkgl.render.passes.base import Pass


@dataclass(frozen=True, eq=False)
class OwnPass:
    """One output of a registered pass. Parts as of :func:`register`."""

    name: str
    pass_: Pass
    output: str
    title: str
    unit: str
    kind: str
    tolerance: float
    reference: Callable[[Any, Any], np.ndarray] | None


OWN: dict[str, OwnPass] = {}
"""By ``name``, in the order of registration."""


def register(
    name: str,
    pass_: Pass,
    *,
    output: str = "",
    title: str = "",
    unit: str = "",
    kind: str = "scalar",
    tolerance: float = 0.0,
    reference: Callable[[Any, Any], np.ndarray] | None = None,
) -> OwnPass:
    """Let ``blinkgl shader`` show an output of a pass as the buffer ``name``; return its row.

    output : name of the output; "": the first.   title, unit : above its picture.   kind : how it is shown, as of a
    label's view: scalar, depth, signed, ids, mask, light, unit or motion.
    reference : (scene, frame) -> (H, W[, channels]), what the pass should write, for ``diff`` and ``probe``.
    ``frame`` has what the ray caster found: ``hit``, ``instance``, ``depth``, ``normal``, ``local``, ``uv``, ``t_ns``.
    tolerance : largest absolute difference from it, in ``unit``.

    Raises TypeError naming the part that is wrong, or a name that is taken; nothing is then registered."""

    def unless(right: object, part: str, problem: str) -> None:
        if not right:
            raise TypeError(f"pass {name!r}: `{part}` {problem}")

    unless(
        isinstance(name, str) and re.fullmatch(r"[a-z](_?[a-z0-9])*", name),
        "name",
        "is not a word of a-z, 0-9 and single _",
    )
    unless(name not in OWN, "name", "is taken: there is such a pass already")
    unless(isinstance(pass_, Pass), "pass_", "is no instance of Pass")
    program, outputs = Path(pass_.program), [one.name for one in pass_.outputs]
    # A relative name is one of the shader folder, whose loader reports what is not there.
    unless(not program.is_absolute() or program.is_file(), "program", f"is no file: {program}")
    unless(outputs, "outputs", "is empty: a pass that writes depth alone has no buffer to show")
    unless(output in ("", *outputs), "output", f"is none of {', '.join(outputs)}")
    unless(kind in KINDS, "kind", f"is none of {', '.join(KINDS)}")
    unless(tolerance >= 0.0, "tolerance", "is no number of at least 0")
    unless(reference is None or callable(reference), "reference", "is no function")
    OWN[name] = OwnPass(
        name=name,
        pass_=pass_,
        output=output or outputs[0],
        title=title or name.replace("_", " "),
        unit=unit,
        kind=kind,
        tolerance=float(tolerance),
        reference=reference,
    )
    return OWN[name]


def own_passes() -> list[type[Pass]]:
    """Return the classes of the registered passes."""
    # One class may be registered for several of its outputs.
    return list(dict.fromkeys(type(one.pass_) for one in OWN.values()))


def own_programs() -> list[Path]:
    """Return the registered passes' GLSL files outside the shader folder."""
    paths = dict.fromkeys(Path(one.program) for one in own_passes())
    return [path for path in paths if path.is_absolute()]
