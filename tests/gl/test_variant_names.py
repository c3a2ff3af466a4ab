"""Every #define of a variant is explained where a reader of the shader looks: in the comments of the program or of a
file that it includes; and a heading names no variant that nothing draws."""

import re
from pathlib import Path

import pytest

from blinkgl.gl.shader import expand, made_includes, stages_of
from blinkgl.scene.shapes.table import DEFORMERS
from blinkgl.tools.shader_debugger.check import lookups, variants

SHADERS = Path(__file__).parents[2] / "shaders"
PROGRAMS = sorted(path.name for path in SHADERS.glob("*.glsl"))
OF_SHAPES = {name for shape in DEFORMERS.values() for sizes in shape.examples for name in sizes}
"""Sizes of a shape's data, which its own file uses."""


def comments(program: str, defines: dict) -> str:
    files = {file for stage in stages_of(defines) for file in expand(program, stage, defines).files}
    texts = [(SHADERS / file).read_text(encoding="utf-8") for file in files if (SHADERS / file).is_file()]
    return "\n".join(re.findall(r"//.*", "\n".join([*texts, *made_includes().values()])))


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_define_of_a_variant_is_explained(program):
    every = variants(program) + lookups(program)
    unexplained = {
        key for defines in every for key in defines if key not in OF_SHAPES and not key.startswith(("DEFORM_", "OUT_"))
    }
    for defines in sorted(every, key=len, reverse=True):
        words = (
            set(re.findall(r"\b[A-Z][A-Z0-9_]+\b", comments(program, defines))) if unexplained & {*defines} else set()
        )
        unexplained -= words & {*defines}
    assert unexplained == set()


def test_the_table_of_the_event_pass_has_no_variant_that_nothing_draws():
    heading = re.match(r"#version.*\n((?://.*\n)+)", (SHADERS / "luminance.glsl").read_text(encoding="utf-8"))[1]
    rows = {
        name
        for line in re.findall(r"^// (?:Variants|        )   ([A-Z][A-Z0-9, ]+?)  ", heading, re.M)
        for name in re.findall(r"[A-Z][A-Z0-9_]+", line)
    }
    known = {key for defines in variants("luminance.glsl") + lookups("luminance.glsl") for key in defines}
    assert rows and rows <= known, rows - known
