"""Boxes, categories, tracks and an inertial unit in whole data sets: written, verified, shown by the report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from blinkgl import Renderer, load
from blinkgl.cli import run
from blinkgl.config.reader import to_yaml
from blinkgl.dataset.shards import sample
from blinkgl.dataset.verify import verify_dataset
from blinkgl.io.boxes import read_boxes
from blinkgl.io.images import read_ids
from blinkgl.report.collect import collect

RUN = {
    "seed": 5,
    "camera": {"width": 64, "height": 48, "fov": 60},
    "time": {"duration": 0.05, "label_rate": 40},
    "timeline": {"kind": "uniform", "fps": 80},
    "scene": {
        "objects": {"count": 3, "distance": [2, 4]},
        "pool": {"primitives": ["cuboid", "flag"], "variants": 4},
        "textures": {"procedural": ["checks"], "variants": 4, "photographs": False, "max_size": 32},
    },
    "labels": {"boxes": True, "semantics": {"ground": 2, "*": 1}, "scene_flow": True, "ids": True},
    "tracks": {"points": 20, "choose": "surface", "rate": 200},
    "imu": {"rate": 200},
    "preview": {"rate": 40},
}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("shown")
    (folder / "run.yaml").write_text(to_yaml(RUN), encoding="utf-8")
    assert run(["generate", str(folder / "run.yaml"), "--out", str(folder / "out")]) == 0
    return folder


def folder_of(made: Path) -> Path:
    return next((made / "out").rglob("manifest.json")).parent


def test_written_and_verified(made):
    assert verify_dataset(made / "out", deep=1).problems == {}
    folder = folder_of(made)
    boxes, ids = read_boxes(folder / "boxes/000001.npz"), read_ids(folder / "ids/000001.png")
    assert boxes.visible_pixels.sum() == np.count_nonzero(ids) and set(boxes.category.tolist()) == {1, 2}
    semantics = read_ids(folder / "semantics/000001.png")
    ground = int(boxes.instance[boxes.kind == "ground"][0])
    assert (semantics[ids == ground] == 2).all() and (semantics[(ids > 0) & (ids != ground)] == 1).all()
    poses = np.load(folder / "poses.npz")  # of the start and every label
    row = int(np.flatnonzero(poses["object_ids"] == boxes.instance[-1])[0])
    np.testing.assert_allclose(boxes.T_world_box[-1, :3, :3], poses["T_world_obj"][row, 2, :3, :3], atol=1e-12)
    told = json.loads((folder / "manifest.json").read_text())["categories"]
    assert told["patterns"] == {"ground": 2, "*": 1} and told["objects"]["ground"] == 2
    stamps = [line.split(",") for line in (folder / "scene_flow/timestamps.txt").read_text().splitlines()[1:]]
    assert [[int(a), int(b)] for a, b in stamps] == [[25_000, 50_000], [50_000, 75_000]]
    endings = {name.partition(".")[2] for name, _ in sample(folder, 0)}
    assert {"boxes.npz", "boxes.txt", "semantics.png", "scene_flow.npy"} <= endings


def test_report_shows_them(made):
    others = dict(collect(made / "out").examples[0].others)
    frame = collect(made / "out").examples[0].image
    assert {"boxes", "semantics", "scene flow", "point tracks, 20"} <= set(others)
    assert (others["boxes"] != frame).any() and (others["point tracks, 20"] != frame).any()


def test_a_table_that_fits_nothing_is_refused(made, tmp_path, capsys):
    tree = {**RUN, "labels": {"semantics": {"car*": 1, "bus": 2}}}
    (tmp_path / "a.yaml").write_text(to_yaml(tree), encoding="utf-8")
    assert run(["generate", str(tmp_path / "a.yaml"), "--out", str(tmp_path / "out")]) != 0
    said = " ".join(capsys.readouterr().err.split())
    assert (
        "labels.semantics: no object has a name that one of the patterns fits (got ['car*', 'bus']); expected" in said
    )
    assert "cuboid" in said and "Traceback" not in said and not list((tmp_path / "out").rglob("manifest.json"))
    with Renderer(load(tmp_path / "a.yaml")) as renderer:
        assert renderer.frame(0.05, labels=["semantics"]).semantics.max() > 1  # by kinds of shape
