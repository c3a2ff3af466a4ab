"""Every program in every variant that passes ask for, for some configuration and scene."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from typing import Any

from blinkgl.render.draw_items import MORE, Kind
from blinkgl.render.lighting import EXAMPLES
from blinkgl.render.passes import PASSES, Pass, ScenePass
from blinkgl.scene.shapes.table import DEFORMERS, define_of
from blinkgl.shader_debugger.session import LOOKUPS, Inspection

SURFACES = (("TINTED", "EMISSIVE"), ("EMISSIVE", "EMISSION_MAP"), ("GLOSSY",), ("BUMPED",), MORE)
"""What materials are beside a base colour: each of MORE alone, where it can be, and all of them."""
KINDS = [Kind(*switches) for switches in product((False, True), repeat=3)]


def kinds() -> list[Kind]:
    """Of materials all, and of shapes that change with time one each."""
    shapes = {
        (("DEFORM", 1), (define_of(deformer.glsl), 1), ("SHAPE_ROWS", 64), *sorted(sizes.items())): None
        for deformer in DEFORMERS.values()
        for sizes in deformer.examples
    }
    # Of materials each extra by itself, and all of them on a shape that changes.
    surfaces = [Kind(True, False, False, masked=True, more=("TINTED",), hued=True)]
    for hued in (False, True):
        surfaces += [Kind(True, True, False, hued=hued, more=more) for more in SURFACES]
    bent = next(iter(shapes))
    surfaces.append(Kind(True, True, True, bent, True, more=MORE))
    return [*KINDS, *(Kind(True, True, True, shape) for shape in shapes), *surfaces]


def lookups(program: str) -> list[dict[str, Any]]:
    """Defines of the variants in which the debugger has a production program show what it looks up."""
    return _defines(program, (type(pass_) for pass_ in LOOKUPS.values()))


def variants(program: str) -> list[dict[str, Any]] | None:
    """Defines of every variant of a program file, without :func:`lookups`; None for a file that no pass knows."""
    return _defines(program, (*PASSES, Inspection)) or None


def _lights(pass_: Pass, kind: Kind | None) -> list[dict[str, Any]]:
    """Of the plain light none, and of all that light can be an example each; of shapes one."""
    if kind is None or not (kind.lit and pass_.lit):
        return [{}]
    if kind.more:
        three = {"HUED": 1} if (kind.hued if pass_.one_channel else "GLOSSY" in kind.more) else {}
        found = [light | three for light in (EXAMPLES[0], EXAMPLES[-1])]
        return found if kind.whole else [{}, *found]
    if kind.shape:
        return [{}, EXAMPLES[-1]]
    hued = (kind.textured or not pass_.one_channel) and not kind.two_sided
    coloured = [light | {"HUED": 1} for light in EXAMPLES if "LIGHTS" in light] if hued else []
    return [{}, *EXAMPLES, *coloured]


def _defines(program: str, passes: Iterable[type[Pass]]) -> list[dict[str, Any]]:
    found: dict[tuple, dict[str, Any]] = {}
    for one in passes:
        for pass_ in one.every_kind() if one.program == program else ():
            for kind in kinds() if isinstance(pass_, ScenePass) else [None]:
                plain = pass_.defines(kind) | (kind.defines(pass_.lit) if kind is not None else {})
                # Fog does not look at the material: the plainest and the fullest stand for all.
                foggy = pass_.lit and kind in (KINDS[0], KINDS[-1])
                for more in (*_lights(pass_, kind), *([{"FOG": 1}] if foggy else [])):
                    defines = plain | more
                    found.setdefault(tuple(sorted(defines.items())), defines)
    return list(found.values())
