"""Every YAML block of the hand-written pages is accepted, alone or as a part of a configuration; README runs."""

from __future__ import annotations

import ast
import configparser
import errno
import os
import re
from pathlib import Path

import numpy as np
import pytest
from sentences import template

from blinkgl import load_sensor, read_events, read_flow
from blinkgl.config.reader import parse_yaml, to_yaml
from blinkgl.config.run import load_run
from blinkgl.dataset.generate import generate_run

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


def table(text: str) -> list[list[str]]:
    """The cells of every row of the Markdown's tables."""
    rows = [line.strip().strip("|").split("|") for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row] for row in rows]


def words(text: str) -> list[str]:
    return re.findall(r"`([^`]+)`", text)


def test_keys_named_to_those_who_come_from_elsewhere_are_there():
    known = "".join(
        (REPOSITORY / f"docs/{page}.md").read_text("utf-8") for page in ("configuration", "commands", "sensors")
    )
    columns = [row[1] for row in table((REPOSITORY / "docs/coming_from.md").read_text("utf-8")) if len(row) == 2]
    keys = {key for cell in columns for word in words(cell) for key in re.findall(r"--?[a-z-]{3,}|[a-z_]{3,}", word)}
    values = {"uniform", "displacement", "brightness", "clean", "noisy", "motion", "linear", "davis", "file", "aedat"}
    named = [key for key in sorted(keys - values) if not re.search(rf"(?<![a-z_]){re.escape(key)}(?![a-z_])", known)]
    assert len(keys) > 50 and not named


def test_messages_of_troubleshooting_are_said():
    """Every message that the page explains stands in a string of the sources, or in the set-up script."""
    said = [(REPOSITORY / "tools/setup.sh").read_text("utf-8"), os.strerror(errno.ENOSPC).lower()]
    for folder in ("blinkgl", "eflow", "tools"):
        for path in sorted((REPOSITORY / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, (ast.Constant, ast.JoinedStr)):
                    said.append(template(node))
    text = "\n".join(said)
    rows = table((REPOSITORY / "docs/troubleshooting.md").read_text("utf-8"))
    parts = [part.strip() for row in rows for message in words(row[0]) for part in message.split("…")]
    assert len(parts) >= 20 and [part for part in parts if part not in text] == []


def test_the_summary_of_sensors_is_that_of_the_measured_tables():
    page = (REPOSITORY / "docs/sensors.md").read_text("utf-8")
    measured = (REPOSITORY / "docs/results.md").read_text("utf-8").partition("With the shipped file")[2]
    rows = [row for row in table(measured.partition("Before a motionless")[0]) if row[0].startswith("davis")]
    for camera in ("davis240c", "davis346"):
        for name, column in (("rate", 2), ("judge", -1)):
            line = next(row for row in table(page) if row[0].startswith(f"{name}, {camera}"))
            for emulator in range(3):
                cells = [row[column].split(",")[emulator].strip() for row in rows if row[0] == camera]
                values = [float(cell) for cell in cells if cell != "–"]
                assert [min(values), max(values)] == pytest.approx(
                    [float(word) for word in (re.findall(r"[\d.]+", line[1 + emulator]) * 2)[:2]]
                ), (camera, name, emulator)


def test_costs_of_qualities_are_those_of_the_measured_table():
    """docs/sensors.md rounds docs/trade.md, relative to `balanced`."""
    trade = (REPOSITORY / "docs/trade.md").read_text("utf-8").partition("\n## What accuracy is worth")[0]
    rows = {row[0].strip("*"): row for row in table(trade)}
    sensors = (REPOSITORY / "docs/sensors.md").read_text("utf-8")
    shown = {row[0].partition(",")[0].strip("`"): row for row in table(sensors)}
    for quality in ("fast", "accurate", "reference"):
        for column, measured in ((1, 2), (2, 3)):
            value = float(rows[quality][measured].partition(" ")[0])
            assert float(shown[quality][column]) == pytest.approx(value, abs=0.051), quality


def test_extras_that_pages_name_can_be_installed():
    config = configparser.ConfigParser()
    config.read(REPOSITORY / "setup.cfg")
    known = set(config["options.extras_require"])
    for path in (*PAGES, REPOSITORY / "docs/configuration.md", REPOSITORY / "docs/commands.md"):
        text = path.read_text("utf-8")
        named = re.findall(r"\bextra `?\[?(\w+)[`\]]", text) + re.findall(r"EXTRAS=([\w,]+)", text)
        assert {extra for names in named for extra in names.split(",")} <= known, path.name


def test_the_programs_that_read_without_blinkgl_read_what_blinkgl_reads(tmp_path):
    torch = pytest.importorskip("torch")
    programs = re.findall(r"^```python\n(.*?)^```", (REPOSITORY / "docs/reading.md").read_text("utf-8"), re.S | re.M)
    assert len(programs) == 3
    names: dict = {}
    for program in programs:
        assert "blinkgl" not in program.partition("# noqa")[0]
        exec(program, names)
    small = ["camera.width=48", "camera.height=36", "time.duration=0.2", "scene.objects.count=4"]
    (report,) = generate_run(load_run("demo", small), tmp_path / "out")
    folder = report.path
    begin, end = 130_000, 171_234
    ours = read_events(folder / "events.h5").window(begin, end)
    theirs = names["read_events"](folder, begin, end)
    assert len(ours) > 100 and all(np.array_equal(a, b) for a, b in zip((ours.x, ours.y, ours.t, ours.p), theirs))
    labels = names["read_labels"](folder, 0)
    flow, valid = read_flow(folder / "flow/forward/000000.png")
    np.testing.assert_array_equal(labels["flow"][0][valid], flow[valid])
    np.testing.assert_array_equal(labels["flow"][1], valid)
    np.testing.assert_array_equal(labels["ids"] > 0, np.isfinite(labels["depth"]))
    assert labels["image"].shape == (36, 48, 3)
    grid, flow, valid = names["Windows"](folder)[0]
    assert grid.shape == (5, 36, 48) and flow.shape == (2, 36, 48) and valid.dtype == torch.bool
    window = read_events(folder / "events.h5").window(int(labels["from_us"]), int(labels["to_us"]))
    assert float(grid.sum()) == pytest.approx(float((2.0 * window.p - 1).sum()), abs=0.01)
