"""Shader files: includes, variants, cache, and errors that name the user's file and line on any driver."""

from __future__ import annotations

import re

import numpy as np
import pytest

from blinkgl.gl import ShaderError, ShaderLoader, Target, expand
from blinkgl.gl.shader import normalised, translate

PROGRAM = """// a comment before the version is fine
#version 430 core
#include "value.glsl"
#ifdef VERTEX_SHADER
#include "twice.glsl"
void main() {
    vec2 corner = vec2(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1);
    gl_Position = vec4(corner, 0.0, twice(0.5));
}
#endif
#ifdef FRAGMENT_SHADER
#include "twice.glsl"
out float colour;
void main() {
    colour = twice(value()) BROKEN;
}
#endif
"""
VALUE = '#include "twice.glsl"\nfloat value() {\n    return twice(GAIN);\n}\n'
TWICE = (
    '/* not\n#include "missing.glsl"\nhere */ float twice(float x) { return 2.0 * x; }\n// #include "missing.glsl"\n'
)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "include").mkdir()
    write(
        tmp_path,
        {"program.glsl": PROGRAM.replace("BROKEN", ""), "include/value.glsl": VALUE, "include/twice.glsl": TWICE},
    )
    return tmp_path


def write(folder, files):
    for name, text in files.items():
        (folder / name).write_text(text)


@pytest.fixture
def loader(gl, folder):
    loader = ShaderLoader(gl.ctx, folder)
    yield loader
    loader.clear()


def drawn(gl, program) -> float:
    vertices = gl.ctx.vertex_array(program, [])
    with Target(gl, 2, 2, ("R32F",), depth=False) as target:
        target.clear()
        vertices.render(vertices=3)
        value = target.read()
    vertices.release()
    assert np.ptp(value) == 0
    return float(value[0, 0])


def test_includes_and_defines(gl, loader):
    """A diamond of includes, one of them only inside an #ifdef, compiles and each variant computes its own value."""
    assert drawn(gl, loader.program("program.glsl", {"GAIN": 1.5})) == 6.0
    assert drawn(gl, loader.program("program.glsl", {"GAIN": "(0.25 + 0.25)"})) == 2.0
    assert drawn(gl, loader.program("program.glsl", {"GAIN": 1e-5})) == np.float32(4e-5)


def test_cache(loader):
    first = loader.program("program.glsl", {"GAIN": 1.0, "LIT": True, "OFF": False})
    assert loader.program("program.glsl", {"LIT": 1, "GAIN": 1.0}) is first
    assert loader.program("program.glsl", {"GAIN": 1.0}) is not first


def test_expanded_source(folder):
    source = expand("program.glsl", "fragment", {"GAIN": 2.0, "ON": True}, folder)
    lines = source.text.splitlines()
    assert lines[:4] == ["#version 430 core", "#define FRAGMENT_SHADER 1", "#define GAIN 2.0", "#define ON 1"]
    assert len(lines) == len(source.origin)
    assert sum("#version" in line for line in lines) == 1
    for line, (file, number) in zip(lines, source.origin):  # every line but the blanked #version is the file's own
        if file:
            original = (folder / file).read_text().splitlines()[number - 1]
            assert line.replace("# include", "#include") == original or (line == "" and original.startswith("#version"))
    assert {file for file, _ in source.origin} == {"", "program.glsl", "include/value.glsl", "include/twice.glsl"}


# --- compile errors ---------------------------------------------------------------------------------------------------


def test_compile_error_names_file_and_line(loader, folder):
    write(folder, {"program.glsl": PROGRAM.replace("BROKEN", "* nothing")})
    with pytest.raises(ShaderError) as caught:
        loader.program("program.glsl", {"GAIN": 1.0})
    assert re.match(r"program\.glsl:15: .*nothing.* \[fragment stage\]$", str(caught.value))
    assert "\n" not in str(caught.value)
    assert ">   15 |     colour = twice(value()) * nothing;" in caught.value.detail
    assert "    13 | out float colour;" in caught.value.detail
    assert caught.value.log


def test_compile_error_in_an_include_of_an_include(loader, folder):
    write(folder, {"include/twice.glsl": TWICE + "float broken() { return absent; }\n"})
    with pytest.raises(ShaderError, match=r"^include/twice\.glsl:5: .*absent.* \[vertex stage\]$") as caught:
        loader.program("program.glsl", {"GAIN": 1.0})
    assert ">    5 | float broken() { return absent; }" in caught.value.detail


def test_error_inside_a_define_points_at_its_use(loader):
    with pytest.raises(ShaderError, match=r"^include/value\.glsl:3: .*unheard_of"):
        loader.program("program.glsl", {"GAIN": "unheard_of"})


def test_link_error_names_the_program(loader, folder):
    write(
        folder,
        {
            "program.glsl": "#ifdef VERTEX_SHADER\nout vec2 a; void main() { a = vec2(0); gl_Position = vec4(0); "
            "}\n#endif\n#ifdef FRAGMENT_SHADER\nin vec3 a; out vec4 c; void main() { c = vec4(a, 1); }\n#endif\n"
        },
    )
    with pytest.raises(ShaderError, match=r"^program\.glsl: .*[Ll]inker"):
        loader.program("program.glsl")


@pytest.mark.parametrize(
    "message",
    [
        "0:{line}(24): error: `nothing' undeclared",  # Mesa
        '0({line}) : error C1503: undefined variable "nothing"',  # NVIDIA
        "ERROR: 0:{line}: 'nothing' : undeclared identifier",  # AMD, Apple, ANGLE
    ],
)
def test_error_formats_of_all_drivers(folder, message):
    sources = {stage: expand("program.glsl", stage, {"GAIN": 1.0}, folder) for stage in ("vertex", "fragment")}
    line = sources["fragment"].origin.index(("include/value.glsl", 3)) + 1
    log = f"GLSL Compiler failed\n\nfragment_shader\n===============\n{message.format(line=line)}\n"
    error = translate(log, sources)
    assert (
        str(error).startswith("include/value.glsl:3: ") and "nothing" in str(error) and "[fragment stage]" in str(error)
    )
    assert ">    3 |     return twice(GAIN);" in error.detail


def test_error_in_a_generated_line_shows_it(folder):
    sources = {"vertex": expand("program.glsl", "vertex", {"GAIN": 1.0}, folder)}
    error = translate("x\nvertex_shader\n===\n0:3(1): preprocessor error: bad define\n", sources)
    assert str(error) == "program.glsl (generated line 3: #define GAIN 1.0): bad define [vertex stage]"


# --- loading errors ---------------------------------------------------------------------------------------------------


def test_include_cycle(folder):
    write(folder, {"include/twice.glsl": '#include "value.glsl"\n'})
    with pytest.raises(
        ShaderError,
        match=r"^include/twice\.glsl:1: include cycle: include/value\.glsl -> include/twice\.glsl -> "
        r"include/value\.glsl$",
    ):
        expand("program.glsl", "vertex", folder=folder)


@pytest.mark.parametrize(
    "line, message",
    [
        (
            '#include "absent.glsl"',
            (
                r"program\.glsl:2: no such shader file \(got 'include/absent\.glsl'\); expected one of twice\.glsl, "
                r"value\.glsl"
            ),
        ),
        ("#include <value.glsl>", r"program\.glsl:2: malformed #include \(got '<value\.glsl>'\)"),
        ("#include", r"program\.glsl:2: malformed #include"),
        ('#include "../program.glsl"', r"program\.glsl:2: include outside the shader folder"),
        ('#include "/etc/passwd"', r"program\.glsl:2: include outside the shader folder"),
    ],
)
def test_bad_includes(folder, line, message):
    write(folder, {"program.glsl": f"\n{line}\n"})
    with pytest.raises(ShaderError, match="^" + message):
        expand("program.glsl", "vertex", folder=folder)


def test_missing_program_and_version_in_an_include(folder):
    with pytest.raises(ShaderError, match=r"no such shader file \(got 'absent.glsl'\); expected one of program\.glsl"):
        expand("absent.glsl", "vertex", folder=folder)
    write(folder, {"include/twice.glsl": "#version 430\n"})
    with pytest.raises(ShaderError, match=r"^include/twice\.glsl:1: #version must be"):
        expand("program.glsl", "vertex", folder=folder)
    (folder / "binary.glsl").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ShaderError, match="not UTF-8 text"):
        expand("binary.glsl", "vertex", folder=folder)


def test_bad_defines():
    assert normalised({"B": 2, "A": True, "C": None, "D": False}) == (("A", "1"), ("B", "2"))
    assert normalised(None) == ()
    for name in ("1A", "GL_A", "A B", "A__B", "", "A-B"):
        with pytest.raises(ShaderError, match="not a valid GLSL name"):
            normalised({name: 1})
    for value in (float("nan"), float("inf"), "1\n#error"):
        with pytest.raises(ShaderError, match="#define A needs"):
            normalised({"A": value})


def test_shipped_shaders_load(gl):
    """Every program that ships compiles without defines or says which it needs; none of its includes is missing."""
    import blinkgl.render.renderer  # noqa: F401 - adds includes that are no files
    from blinkgl.gl.shader import shader_folder

    names = sorted(entry.name for entry in shader_folder().iterdir() if entry.name.endswith(".glsl"))
    assert names
    for name in names:
        for stage in ("vertex", "fragment"):
            assert expand(name, stage).text
