"""Every YAML block of the hand-written pages is accepted, alone or as a part of a configuration; README runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from blinkgl import load_sensor
from blinkgl.config.reader import parse_yaml, to_yaml
from blinkgl.config.run import load_run

REPOSITORY = Path(__file__).parents[2]
GENERATED = {"configuration", "eflow_configuration", "commands", "examples", "changelog"}
PAGES = [
    REPOSITORY / "README.md",
    *(path for path in sorted((REPOSITORY / "docs").glob("*.md")) if path.stem not in GENERATED),
]
BODY = {"mesh": "box", "position": [3, 0, 0]}
EUROC = """
resolution: [752, 480]
intrinsics: [458.654, 457.296, 367.215, 248.375]
camera_model: pinhole
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
T_BS: {cols: 4, rows: 4, data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
"""
KALIBR = """
cam0: &cam
  camera_model: pinhole
  intrinsics: [84.0, 84.0, 48.0, 36.0]
  distortion_model: radtan
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  resolution: [96, 72]
cam1: *cam
"""


def blocks() -> list:
    """(page, number, text) of every YAML block; those of eflow and of its cards have models of their own."""
    found = []
    for path in PAGES:
        for number, match in enumerate(re.finditer(r"^( *)```yaml\n(.*?)^ *```", path.read_text("utf-8"), re.S | re.M)):
            text = "".join(line[len(match[1]) :] for line in match[2].splitlines(keepends=True))
            if path.stem != "eflow":
                found.append(pytest.param(text, id=f"{path.stem}-{number}"))
    return found


def whole(tree: dict) -> dict:
    """A run of which the block is a part."""
    if "meshes" in tree or "objects" in tree:
        tree = {"scene": {"kind": "explicit", **tree}}
    scene = tree.get("scene")
    if scene and "kind" not in scene:
        scene["kind"] = "random" if "sky" in scene else "explicit"
    if scene and scene["kind"] == "explicit":
        scene.setdefault("meshes", {"box": {"primitive": "cuboid"}, "cloth": {"primitive": "grid"}})
        scene.setdefault("objects", [{**BODY, "mesh": next(iter(scene["meshes"]))}])
        scene.setdefault("camera", {"position": [0, 0, 1]})
    return tree


@pytest.mark.parametrize("text", blocks())
def test_a_block_is_accepted(text, tmp_path):
    (tmp_path / "cam0").mkdir()
    (tmp_path / "cam0" / "sensor.yaml").write_text(EUROC)
    (tmp_path / "camchain.yaml").write_text(KALIBR)
    tree, path = parse_yaml(text, "the page"), tmp_path / "run.yaml"
    if "sources" in tree:
        path.write_text(text)
        load_sensor(str(path))
    else:
        path.write_text(to_yaml(whole(tree)))
        load_run(path)


def test_the_configuration_of_eflow_is_accepted(tmp_path):
    pytest.importorskip("torch")
    from eflow.load_config import load_train_config

    (text,) = [
        match
        for match in re.findall(r"^```yaml\n(.*?)^```", (REPOSITORY / "docs/eflow.md").read_text("utf-8"), re.S | re.M)
        if match.startswith("data:")
    ]
    path = tmp_path / "train.yaml"
    path.write_text("model: {name: ev_flownet, size: tiny}\n" + text)
    load_train_config(path)


def test_the_program_of_readme_runs():
    (program,) = re.findall(r"^```python\n(.*?)^```", (REPOSITORY / "README.md").read_text("utf-8"), re.S | re.M)
    names: dict = {}
    exec(program, names)
    assert len(names["events"]) > 1000 and names["flow"].shape[1:] == (240, 320, 2)
