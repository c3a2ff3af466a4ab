"""check and show: every variant compiles, errors point at the user's line, and production
does not know the debugger."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from debugger_scene import edit

from blinkgl.gl.shader import expand

# ------------------------------------------------------------------------------------------------- what compiles


def test_everything_compiles(shader):
    status, out, _ = shader("check", "--json")
    result = json.loads(out)
    assert status == 0 and result["errors"] == []
    known = {
        "colour.glsl": 138,
        "debug.glsl": 14,
        "downsample.glsl": 3,
        "edges.glsl": 2,
        "gather.glsl": 3,
        "label.glsl": 140,
        "luminance.glsl": 410,
        "shadow.glsl": 28,
        "specks.glsl": 1,
        "velocity.glsl": 84,
    }
    assert result["programs"] == known, "a new program or variant: its number is written here"


# ------------------------------------------------------------------------------------------------- what does not


def test_an_error_is_shown_at_its_own_line_through_the_includes(shader, shaders):
    edit(
        shaders / "include/displacement.glsl",
        "    float w_next = 1.0 / INVERSE_DEPTH + d.z;",
        "    float w_next = depht / INVERSE_DEPTH + d.z;",
    )
    line = next(
        i
        for i, text in enumerate((shaders / "include/displacement.glsl").read_text().splitlines(), 1)
        if "depht" in text
    )
    status, out, err = shader("check", shaders / "include/displacement.glsl", "--shaders", shaders)
    assert status == 1 and err == ""
    lines = out.splitlines()
    first = next(i for i, text in enumerate(lines) if "depht" in text)
    assert lines[first].startswith(f"include/displacement.glsl:{line}:20: error: ") and "fragment stage" in lines[first]
    shown = next(i for i, text in enumerate(lines) if text.startswith(">"))
    assert "float w_next = depht" in lines[shown]
    assert lines[shown + 1].index("^") == lines[shown].index("depht")
    assert "in 70 of 140 variants of label.glsl" in out  # those with a flow


def test_a_link_error_is_shown_at_the_declaration(shader, shaders):
    edit(shaders / "include/vertex.glsl", "out vec3 local;", "out vec4 local;")
    edit(shaders / "include/vertex.glsl", "local = position;", "local = vec4(position, 1.0);")
    status, out, _ = shader("check", "label.glsl", "--shaders", shaders, "--json")
    errors = json.loads(out)["errors"]
    assert status == 1 and errors and all(e["file"] == "include/vertex.glsl" and "local" in e["text"] for e in errors)
    declared = (shaders / "include/vertex.glsl").read_text().splitlines()[errors[0]["line"] - 1]
    assert declared in ("in vec3 local;", "out vec4 local;") and "^" in errors[0]["excerpt"]


def test_include_cycle_and_missing_include(shader, shaders):
    (shaders / "include/light.glsl").write_text('#include "light.glsl"\n')
    status, out, _ = shader("check", "luminance.glsl", "--shaders", shaders)
    assert status == 1 and "include/light.glsl:1:1: error: include cycle" in out and "^" in out
    (shaders / "include/light.glsl").write_text('\n#include "nothere.glsl"\n')
    status, out, _ = shader("check", "luminance.glsl", "--shaders", shaders)
    assert status == 1 and "include/light.glsl:2:1: error: no such shader file" in out


def test_files_select_programs_and_a_file_elsewhere_brings_its_folder(shader, shaders):
    (shaders / "mine.glsl").write_text(
        "#version 430 core\n#ifdef VERTEX_SHADER\nin vec3 p;\nvoid main() { gl_Position = vec4(p, 1.0); }\n#endif\n"
        "#ifdef FRAGMENT_SHADER\nout vec4 c;\nvoid main() { c = vec4(oops); }\n#endif\n"
    )
    status, out, _ = shader("check", shaders / "mine.glsl")
    assert status == 1 and "mine.glsl:8:24: error" in out
    status, out, _ = shader("check", "cover.glsl", "--json")
    assert status == 0 and set(json.loads(out)["programs"]) == {"downsample.glsl", "gather.glsl"}


# ------------------------------------------------------------------------------------------------- show, preprocessor


def test_show_is_what_the_compiler_gets(shader):
    status, out, _ = shader("show", "label.glsl", "--define", "OUT_VELOCITY=0", "-D", "LIT", "--stage", "fragment")
    assert status == 0 and out == expand("label.glsl", "fragment", {"OUT_VELOCITY": 0, "LIT": 1}).text
    status, out, _ = shader("show", "label.glsl", "-D", "OUT_VELOCITY=0", "--numbers")
    assert status == 0 and "include/motion.glsl:" in out and "vec2 velocity(" in out


# ------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("passes", "CONFIG", "--out", "TMP", "--pass", "depht"), ["--pass", "depht", "depth"]),
        (("probe", "CONFIG", "--pixel", "96,0"), ["--pixel", "96,0", "X < 96"]),
        (("probe", "CONFIG", "--pixel", "-1,3"), ["--pixel", "0 <= X"]),
        (("probe", "CONFIG", "--pixel", "3"), ["--pixel", "not a pixel"]),
        (("probe", "CONFIG", "--pixel", "3,4", "--time", "9"), ["--time", "9", "0 to 0.4 s"]),
        (("diff", "CONFIG", "--time", "nan"), ["--time", "0 to 0.4 s"]),
        (("diff", "CONFIG", "--tolerance", "depth=x"), ["--tolerance", "depth=x"]),
        (("diff", "CONFIG", "--tolerance", "dept=1"), ["--tolerance", "dept", "depth"]),
        (("diff", "CONFIG", "--pass", "triangle"), ["--pass", "triangle"]),
        (("diff", "CONFIG", "--shaders", "/nowhere/shaders"), ["--shaders", "no such shader folder"]),
        (("check", "--shaders", "TMP"), ["--shaders", "no shaders in this folder"]),
        (("check", "--shaders", "CONFIG"), ["--shaders", "not a folder"]),
        (("check", "--shaders", "OLDER"), ["--shaders", "has no debug.glsl"]),
        (("check", "nothing.glsl"), ["nothing.glsl", "label.glsl"]),
        (("check", "--backend", "vulkan"), ["gl.backend", "vulkan"]),
        (("check", "--device", "97", "--backend", "egl"), ["gl"]),
        (("show", "nothing.glsl"), ["nothing.glsl", "label.glsl"]),
        (("show", "label.glsl", "--stage", "tessellation"), ["--stage", "tessellation"]),
        (("show", "label.glsl", "--define", "2X"), ["2X"]),
        (("probe", "/nowhere.yaml", "--pixel", "1,1"), ["/nowhere.yaml", "no such file"]),
        (("serve", "CONFIG", "--port", "70000"), ["--port"]),
        (("passes", "CONFIG", "--out", "CONFIG"), ["is a file"]),
        (("diff", "CONFIG", "--set", "gl.device=97", "--set", "gl.backend=egl"), ["gl"]),
    ],
)
def test_bad_input_is_one_line_and_2(shader, config, tmp_path, arguments, words):
    (tmp_path / "older").mkdir()
    (tmp_path / "older/label.glsl").write_text("void main() {}\n")
    places = {"CONFIG": config, "TMP": str(tmp_path), "OLDER": str(tmp_path / "older")}
    arguments = [places.get(a, a) for a in arguments]
    status, out, err = shader(*arguments)
    assert (status, out) == (2, "") and err.startswith("error: ") and err.count("\n") == 1, err
    assert all(word in err for word in words), err


def test_unreadable_shader_folder(shader, shaders, monkeypatch):
    import os

    real = os.access
    # Root may read anything.
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != shaders and real(path, mode))
    status, _, err = shader("check", "--shaders", shaders)
    assert status == 2 and err.startswith("error: --shaders: shader folder cannot be read") and err.count("\n") == 1
