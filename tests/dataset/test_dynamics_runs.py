"""Falling bodies in data sets: the engine's version in manifests that used it and in no other, the same bytes whoever
makes them, what `verify --deep` says of another engine, and nothing half-written when something is wrong."""

from __future__ import annotations

import json
import shutil
import sys

import pytest

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset.executor import Inline
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import ConfigError
from blinkgl.io.records import sealed
from runs import recipe_file

FALLING = {
    "seed": 11,
    "camera": {"width": 48, "height": 36},
    "time": {"duration": 0.1, "label_rate": 20},
    "timeline": {"kind": "displacement", "max_px": 2.0},
    "scene": {
        "kind": "random",
        "objects": {"count": 4, "distance": [2, 6]},
        "pool": {"primitives": ["cuboid", "cone"], "variants": 8, "test_fraction": 0.3},
        "textures": {"procedural": ["checks"], "variants": 8, "photographs": False, "max_size": 32},
        "physics": {"share": 0.8, "thrown": 0.7},
    },
    "labels": {"flow": ["forward"]},
    "preview": {"enabled": False},
    "groups": {
        "fall": {"output": {"sequences": 2, "name": "fall"}},
        "still": {"output": {"sequences": 1, "name": "still"}, "scene": {"physics": None}},
    },
}


def manifest(folder):
    return json.loads((folder / "manifest.json").read_text())


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    pytest.importorskip("mujoco")
    folder = tmp_path_factory.mktemp("falling")
    run_dataset(load_run(recipe_file(folder, **FALLING)), folder / "out", Inline())
    return folder


def test_verify_deep_says_when_the_engine_differs(made, tmp_path):
    data = shutil.copytree(made / "out", tmp_path / "data")
    sound = verify_dataset(data, deep=3)
    assert sound.clean and len(sound.deep) == 3 and not sound.in_part
    # Another engine computed other poses, and wrote so.
    folder = data / "train/fall_000000"
    path, forged = folder / "manifest.json", manifest(folder)
    forged["versions"]["mujoco"] = "3.1.0"
    other = manifest(data / "train/fall_000001")["files"]["poses.npz"]
    shutil.copy(data / "train/fall_000001/poses.npz", folder / "poses.npz")
    forged["files"]["poses.npz"] = other
    path.write_text(sealed(forged))
    (data / "index.jsonl").unlink(missing_ok=True)
    shutil.rmtree(data / "train/fall_000001")
    shutil.rmtree(data / ".run")
    found = verify_dataset(data, deep=3)
    assert "train/fall_000000" in found.in_part
    assert any("made with mujoco 3.1.0, this machine has" in note for note in found.notes)
    assert "train/fall_000000" not in found.problems
    # The same engine, and other poses: that is damage, as with every other sequence.
    forged["versions"]["mujoco"] = sys.modules["mujoco"].__version__
    path.write_text(sealed(forged))
    assert any("poses.npz: differs" in line for line in verify_dataset(data, deep=3).problems["train/fall_000000"])


def test_without_mujoco_a_run_is_refused_before_any_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    template = load_run(recipe_file(tmp_path, **FALLING))
    with pytest.raises(ConfigError, match="in group 'fall': physics needs MuJoCo.*pip install"):
        run_dataset(template, tmp_path / "out", Inline())
    assert not (tmp_path / "out").exists()
    assert run(["generate", str(tmp_path / "recipe.yaml"), "--out", str(tmp_path / "out")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    still = load_run(recipe_file(tmp_path, **{**FALLING, "groups": {"still": FALLING["groups"]["still"]}}))
    assert run_dataset(still, tmp_path / "out", Inline()).made.count == 1
