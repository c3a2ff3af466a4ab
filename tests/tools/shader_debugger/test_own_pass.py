"""A pass of a plug-in (examples/plugins/outline.py) is drawn, shown, probed, compared and checked as our own."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from debugger_scene import edit

import blinkgl
from blinkgl.machine import plugins
from blinkgl.render.passes import Geometry, Input, Output, ScreenPass
from blinkgl.render.passes.own import OWN, register

MINE = Path(__file__).parents[3] / "examples/plugins"


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """A copy of the example, which is forgotten after the test."""
    for name in ("outline.py", "outline.glsl"):
        shutil.copy(MINE / name, tmp_path)
    monkeypatch.setenv("BLINKGL_PLUGINS", "[]")
    before = [dict(table) for table in (plugins._PATHS, plugins._LOADED, OWN)]
    yield tmp_path / "outline.py"
    for table, was in zip((plugins._PATHS, plugins._LOADED, OWN), before):
        table.clear()
        table.update(was)


def test_it_is_shown_probed_compared_and_checked(shader, config, mine, tmp_path):
    plug_in = ("--plugin", mine)
    status, _, err = shader("passes", config, "-o", tmp_path / "out", "--pass", "outline", "--pass", "id", *plug_in)
    assert status == 0, err
    ids, edges = (np.load(tmp_path / f"out/{name}.npy") for name in ("id", "outline"))
    np.testing.assert_array_equal(edges[:, :-1], ids[:, 1:] != ids[:, :-1])
    assert 0 < edges.mean() < 0.5
    y, x = np.argwhere(edges)[0]
    rows = json.loads(shader("probe", config, "-p", f"{x},{y}", "--json", *plug_in)[1])["buffers"]
    assert next(row for row in rows if row["name"] == "outline")["gpu"] == 1.0
    status, out, _ = shader("diff", config, "--pass", "outline", *plug_in)
    assert status == 0 and "agrees with the reference" in out
    status, out, _ = shader("check", mine.with_suffix(".glsl"), *plug_in)
    assert status == 0 and "1 variants" in out and "all compile and link" in out


def test_without_a_reference_it_is_shown_and_probed_and_cannot_be_compared(shader, config, mine):
    edit(mine, ", reference=reference)", ")")
    rows = json.loads(shader("probe", config, "-p", "3,3", "--json", "--plugin", mine)[1])["buffers"]
    row = next(row for row in rows if row["name"] == "outline")
    assert row["note"] == "the plug-in gives no reference" and row["gpu"] in (0.0, 1.0) and row["ok"] is None
    status, _, err = shader("diff", config, "--pass", "outline", "--plugin", mine)
    assert status == 2 and "unknown pass" in err and err.count("\n") == 1


def test_a_wrong_program_and_one_that_does_not_compile_are_shown(shader, config, mine, tmp_path):
    program = mine.with_suffix(".glsl")
    edit(program, "? 1.0 : 0.0", "? 0.0 : 1.0")
    status, out, _ = shader("diff", config, "--pass", "outline", "--plugin", mine)
    assert status == 1 and "FAIL" in out
    edit(program, "own != beside", "own != besid")
    line = next(i for i, text in enumerate(program.read_text().splitlines(), 1) if "besid " in text)
    status, out, _ = shader("check", program, "--plugin", mine)
    assert status == 1 and f"{program}:{line}:" in out and f">   {line} | " in out
    status, _, err = shader("passes", config, "-o", tmp_path / "out", "--pass", "outline", "--plugin", mine)
    assert status == 2 and err.startswith(f"error: {program}:{line}: ") and not (tmp_path / "out/outline.npy").exists()


def test_a_file_that_no_pass_uses_names_the_option(shader):
    status, _, err = shader("check", MINE / "outline.glsl")
    assert status == 2 and err.count("\n") == 1 and "no pass uses it" in err and "--plugin FILE.py" in err


def test_the_public_renderer_draws_it(mine):
    plugins.load_plugins([mine])
    scene = blinkgl.Scene(blinkgl.Camera(160, 120, pose=blinkgl.look_at((-2, -0.5, 0.8), (0, 0, 0))), duration=0.2)
    with blinkgl.Renderer(scene + blinkgl.Primitive("cuboid")) as renderer:
        edges = renderer.draw(OWN["outline"].pass_, 100_000_000).read()
        ids = renderer.frame(0.1, ["ids"]).ids
        np.testing.assert_array_equal(edges[:, :-1], ids[:, 1:] != ids[:, :-1])
        for wrong, message in (((OWN["outline"], 0), "not a pass"), ((OWN["outline"].pass_, 0.1), "t_ns: not a whole")):
            with pytest.raises(blinkgl.BlinkGLError, match=message):
                renderer.draw(*wrong)


class _Bare(ScreenPass):
    program = "gather.glsl"
    inputs = (Input("ids", Geometry(("ids",))),)
    outputs = (Output("edge", "R32F"),)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"name": "Edge"}, "`name` is not a word"),
        ({"pass_": None}, "`pass_` is no instance of Pass"),
        ({"output": "x"}, "`output` is none of edge"),
        ({"kind": "film"}, "`kind` is none of scalar"),
        ({"tolerance": -1.0}, "`tolerance` is no number"),
        ({"reference": 3}, "`reference` is no function"),
    ],
)
def test_what_register_refuses(change, message):
    with pytest.raises(TypeError, match=message):
        register(**{"name": "bare", "pass_": _Bare(), **change})
    assert "bare" not in OWN
