"""Every program in every variant that passes ask for, for some configuration and scene."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from typing import Any

from blinkgl.render.passes import PASSES, Pass, ScenePass
from blinkgl.render.resources import Kind
from blinkgl.scene.shapes.table import DEFORMERS, define_of
from blinkgl.tools.shader_debugger.session import LOOKUPS, Inspection

KINDS = [Kind(*switches) for switches in product((False, True), repeat=3)]


def kinds() -> list[Kind]:
    """Of materials all, and of shapes that change with time one each."""
    shapes = {
        (("DEFORM", 1), (define_of(deformer.glsl), 1), ("SHAPE_ROWS", 64), *sorted(sizes.items())): None
        for deformer in DEFORMERS.values()
        for sizes in deformer.examples
    }
    return [*KINDS, *(Kind(True, True, True, shape) for shape in shapes)]


def lookups(program: str) -> list[dict[str, Any]]:
    """Defines of the variants in which the debugger has a production program show what it looks up."""
    return _defines(program, (type(pass_) for pass_ in LOOKUPS.values()))


def variants(program: str) -> list[dict[str, Any]] | None:
    """Defines of every variant of a program file, without :func:`lookups`; None for a file that no pass knows."""
    return _defines(program, (*PASSES, Inspection)) or None


def _defines(program: str, passes: Iterable[type[Pass]]) -> list[dict[str, Any]]:
    found: dict[tuple, dict[str, Any]] = {}
    for one in passes:
        for pass_ in one.every_kind() if one.program == program else ():
            for kind in kinds() if isinstance(pass_, ScenePass) else [None]:
                defines = pass_.defines(kind) | (kind.defines if kind is not None else {})
                foggy = pass_.foggy and kind in (KINDS[0], KINDS[-1])
                for one_of in (defines, defines | {"FOG": 1}) if foggy else (defines,):
                    found.setdefault(tuple(sorted(one_of.items())), one_of)
    return list(found.values())
