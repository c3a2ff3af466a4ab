"""The table of deformer classes.

    @register
    class Mine(Deformer):
        Config = MineConfig               # class MineConfig(DeformConfig): kind: Literal["mine"] = "mine"; …
        glsl, source = "mine", "vec3 deformed(vec3 p) …"

docs/extending.md has a complete example.
"""

from __future__ import annotations

from importlib import resources

import numpy as np

from blinkgl.config.base import tag_of
from blinkgl.config.deform import DeformConfig
from blinkgl.scene.shapes.closed_forms import Bend, Breathe, Flag, Twist, Wave
from blinkgl.scene.shapes.skin import Skin
from blinkgl.scene.types import Deformer

DEFORMERS: dict[str, type[Deformer]] = {}
"""Deformers by class name."""
FUNCTIONS = (
    "vec3 deformed(vec3 p)",
    "vec3 deformed_rate(vec3 p)",
    "vec3 deformed_change(vec3 p, int other)",
    "vec3 deformed_normal(vec3 p, vec3 n)",
    "vec3 deformed_normal_rate(vec3 p, vec3 n)",
)
"""Functions that the source of a deformer must define."""


def register(deformer: type[Deformer]) -> type[Deformer]:
    """Add a class to the table, and its ``Config`` to ``deform:``; return it.

    Raises TypeError naming the class and the part that is missing or of the wrong kind; nothing is then registered."""
    name = _checked(deformer)
    if deformer.Config is not None:
        DeformConfig.members[deformer.Config.model_fields["kind"].default] = deformer.Config
    DEFORMERS[name] = deformer
    return deformer


def deformer_of(config: DeformConfig, low: np.ndarray, high: np.ndarray) -> Deformer:
    """Return the deformer of a ``deform:`` configuration, for an object whose box at rest is (3,) low to high. Raises
    TypeError for a configuration without a class in the table."""
    for deformer in DEFORMERS.values():
        if deformer.Config is type(config):
            return deformer.of(config, np.asarray(low, np.float64), np.asarray(high, np.float64))
    raise TypeError(f"no deformer for {type(config).__name__}")


def define_of(glsl: str) -> str:
    """Return the macro that includes a deformer's source."""
    return f"DEFORM_{glsl.upper()}"


def includes() -> dict[str, str]:
    """Return texts by their include name: deforms.glsl, and deform/NAME.glsl of those with their own source."""
    sources = {deformer.glsl: deformer.source for deformer in DEFORMERS.values()}
    # Only the shape that a program is compiled for is included.
    lines = [
        line for name in sources for line in (f"#ifdef {define_of(name)}", f'#include "deform/{name}.glsl"', "#endif")
    ]
    own = {f"deform/{name}.glsl": text.lstrip("\n") for name, text in sources.items() if text is not None}
    return {"deforms.glsl": "\n".join(lines) + "\n", **own}


def _checked(deformer: object) -> str:
    if not (isinstance(deformer, type) and issubclass(deformer, Deformer)):
        raise TypeError(f"{deformer!r} is not a subclass of Deformer")
    name = deformer.__name__

    def unless(right: object, part: str, problem: str) -> None:
        if not right:
            raise TypeError(f"deformer {name}: `{part}` {problem}")

    unless(DEFORMERS.get(name, deformer) is deformer, "__name__", "is taken: there is such a deformer already")
    for part in sorted(deformer.__abstractmethods__):
        unless(False, part, "is missing")
    glsl = getattr(deformer, "glsl", "")
    unless(
        isinstance(glsl, str) and glsl.isidentifier() and glsl.islower(), "glsl", "is missing, or no word of a-z and _"
    )
    text = deformer.source
    if text is None:
        file = resources.files("blinkgl.shaders").joinpath(f"include/deform/{glsl}.glsl")
        unless(file.is_file(), "source", f"is missing, and so is the file shaders/include/deform/{glsl}.glsl")
        text = file.read_text(encoding="utf-8")
    for function in FUNCTIONS:
        unless(function in text, "source", f"does not define {function}")
    model = deformer.Config
    if model is not None:
        unless(
            isinstance(model, type) and issubclass(model, DeformConfig), "Config", f"is {model!r} and no DeformConfig"
        )
        key, kind = tag_of(model) or ("", "")
        unless(key == "kind", "Config.kind", 'is not of the form `kind: Literal["name"] = "name"`')
        unless(DeformConfig.members.get(kind, model) is model, "Config.kind", f"is taken: there is another '{kind}'")
        unless(deformer.of.__func__ is not Deformer.of.__func__, "of", "is missing")
    return name


for _one in (Wave, Flag, Twist, Bend, Breathe, Skin):
    register(_one)
