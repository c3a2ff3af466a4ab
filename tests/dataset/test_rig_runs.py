"""Rigs in data sets: a rig of one is the single camera, two eyes agree with depth, poses and float64, and a run of rigs
is verified, resumed and read like any other."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
import yaml
from tiny_recipe import TINY

from blinkgl import open_events
from blinkgl.config.run import load_run
from blinkgl.dataset.deep import differences
from blinkgl.dataset.executor import Inline, Local
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.shards import export_shards
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import ConfigError, OutputError
from blinkgl.io.records import SEAL
from blinkgl.scene.build import sequence_scene
from blinkgl.sequence import simulate_sequence
from blinkgl.sequence.request import SequenceRequest
from blinkgl.sequence_files.sequence_dir import read_manifest
from blinkgl.tools.shader_debugger.reference import render as by_reference

WAY = [
    {"time": t, "position": [-2.5, y, 0.3], "look_at": [0, 0.3 * y, 0]} for t, y in ((-0.2, -0.4), (0, 0), (0.4, 0.8))
]
ONE = {
    "seed": 4,
    "camera": {"width": 64, "height": 48, "fov": 70},
    "time": {"duration": 0.1, "label_rate": 20},
    "timeline": {"kind": "displacement", "max_px": 1.5},
    "events": {"threshold_jitter": 0.02},
    "scene": {
        "kind": "explicit",
        "meshes": {
            "box": {"primitive": "cuboid"},
            "far": {"primitive": "grid", "parameters": {"width": 12, "depth": 12}},
        },
        "materials": {"m": {"procedural": "fbm", "max_size": 64}},
        "objects": [
            {
                "mesh": "box",
                "material": "m",
                "keyframes": [
                    {"time": -0.2, "position": [0, -0.3, 0]},
                    {"time": 0.1, "position": [0, 0, 0.1], "euler": [0, 10, 20]},
                    {"time": 0.4, "position": [0, 0.4, 0], "euler": [0, 20, 40]},
                ],
            },
            {"mesh": "far", "material": "m", "position": [4, 0, 0], "euler": [0, -90, 0]},
        ],
        "camera": {"keyframes": WAY},
    },
    "labels": {"depth": True, "ids": True, "float_flow": ["npy"]},
    "preview": {"enabled": False},
}
BOTH = {"images": {"rate": 20}, "imu": {"preset": "adis16448"}, "tracks": {"points": 9}}
PAIR = {
    **ONE,
    "labels": {**ONE["labels"], "disparity": True},
    "rig": "stereo",
    "sensors": [
        {"name": "rgb", "camera": {"width": 32, "height": 24}, "images": {"rate": 10}, "place": {"euler": [0, 15, 0]}},
        {"name": "unit", "imu": {"rate": 100}, "place": {"position": [0, 0.05, 0]}},
    ],
    "preview": {"enabled": True},
}


def recipe_file(folder, **tree):
    path = folder / "recipe.yaml"
    path.write_text(yaml.safe_dump(tree))
    return path


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Folder with ``out``, two sequences of a stereo rig with a frame camera and an inertial unit."""
    folder = tmp_path_factory.mktemp("pair")
    run_dataset(load_run(recipe_file(folder, **PAIR, output={"sequences": 2})), folder / "out", Inline())
    return folder


def config_of(folder):
    return load_run(folder / "recipe.yaml").sequence(0)


def test_a_rig_of_one_is_the_single_camera(tmp_path):
    single, rig = tmp_path / "single", tmp_path / "rig"
    for folder in (single, rig):
        folder.mkdir()
    own = {"labels": {**ONE["labels"], "images": True}}
    run_dataset(load_run(recipe_file(single, **{**ONE, **BOTH, **own})), single / "out")
    alone = {**ONE, **own, "sensors": [{"name": "cam", "events": {}, **BOTH, "labels": {"images": True}}]}
    run_dataset(load_run(recipe_file(rig, **alone)), rig / "out")
    a, b = single / "out/train/sequence_000000", rig / "out/train/sequence_000000/cam"
    assert sorted(differences(a, b)) == ["config.yaml: differs", "manifest.json: differs"]
    one, other = read_manifest(a), read_manifest(b)
    assert other.pop("sensor") == "cam"
    for manifest in (one, other):
        del manifest["files"], manifest[SEAL]
    assert one == other
    assert verify_dataset(rig / "out").clean


def test_disparity_is_f_b_over_z(pair):
    config, folder = config_of(pair), pair / "out/train/sequence_000000"
    scene, worst = sequence_scene(config, 0, pair), []
    for number, eye in enumerate(("left", "right")):
        drawn = np.load(folder / eye / "disparity/000000.npy")
        seen = scene.seen_by(number)
        true = by_reference(seen, config.time.label_times_ns[0])
        f, b = seen.camera.fx, 0.1
        same = (true.depth > 0) & np.isfinite(true.depth) & _inside(true.instance)
        worst.append(np.abs(drawn - f * b / np.where(same, true.depth, np.inf))[same].max())
        assert same.mean() > 0.5 and drawn[same].min() > 0.3
    assert max(worst) < 1e-4, "px"


def test_flow_of_both_eyes_is_that_of_depth_and_poses(pair):
    folder = pair / "out/train/sequence_000000"
    for eye in ("left", "right"):
        poses = np.load(folder / eye / "poses.npz")
        flow = np.load(folder / eye / "flow/forward_npy/000000.npy")
        depth = np.load(folder / eye / "depth/000000.npy").astype(np.float64)
        ids = cv2.imread(str(folder / eye / "ids/000000.png"), cv2.IMREAD_UNCHANGED)
        y, x = np.mgrid[:48, :64]
        K, (t, later) = poses["K"], (1, 2)
        rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1) * depth[..., None]
        for row, number in enumerate(poses["object_ids"]):
            on = (ids == number) & (flow[..., 2] > 0)
            assert on.sum() > 100
            points = np.concatenate([rays[on], np.ones((on.sum(), 1))], 1)
            move = (
                np.linalg.inv(poses["T_world_cam"][later])
                @ poses["T_world_obj"][row, later]
                @ np.linalg.inv(poses["T_world_obj"][row, t])
                @ poses["T_world_cam"][t]
            )
            moved = points @ move.T
            seen = moved[:, :2] / moved[:, 2:3] * [K[0, 0], K[1, 1]] + K[:2, 2]
            assert np.abs(seen - np.stack([x, y], -1)[on] - flow[on][:, :2]).max() < 2e-3, "px"


def test_verify_looks_at_every_sensor(pair, tmp_path):
    out = pair / "out"
    found = verify_dataset(out, deep=1)
    assert found.clean and found.sequences == 2 and len(found.deep) == 1, found.problems
    for eye in ("left", "rgb"):
        assert verify_dataset(out / "train/sequence_000000" / eye).clean
    copy = tmp_path / "out"
    shutil.copytree(out, copy)
    (copy / "train/sequence_000000/right/depth/000000.npy").write_bytes(b"x")
    events = copy / "train/sequence_000001/left"
    manifest = json.loads((events / "manifest.json").read_text())
    (events / "manifest.json").write_text(json.dumps({**manifest, "sensor": "middle"}))
    problems = verify_dataset(copy).problems
    assert "right/depth/000000.npy" in problems["train/sequence_000000"][0]
    assert "left/manifest.json" in problems["train/sequence_000001"][0]


def test_a_damaged_eye_is_made_again_with_its_rig(pair, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(pair / "out", out)
    shutil.rmtree(out / "train/sequence_000001/right")
    template = load_run(pair / "recipe.yaml")
    with pytest.raises(OutputError, match="output folder exists"):
        run_dataset(template, out)
    outcome = run_dataset(template, out, Local(workers=1), resume=True)
    assert outcome.found == 1 and len(outcome.made) == 1 and list(outcome.damaged) == ["train/sequence_000001"]
    for k in (0, 1):
        name = f"train/sequence_00000{k}"
        assert differences(pair / "out" / name, out / name) == [], "another process makes the same bytes"


def test_several_sensors_are_not_one_camera(pair):
    with pytest.raises(ConfigError, match="several sensors are simulated together"):
        _ = simulate_sequence(SequenceRequest(config_of(pair), base=pair)).alone


def _inside(ids: np.ndarray) -> np.ndarray:
    """Pixels whose neighbours show the same object."""
    same = ids > 0
    for axis in (0, 1):
        for step in (1, -1):
            same &= np.roll(ids, step, axis) == ids
    same[[0, -1]] = False
    same[:, [0, -1]] = False
    return same


def test_a_sensor_with_a_camera_and_an_inertial_unit_writes_both(tmp_path):
    """What it sees is what the same camera sees without the unit."""
    sensors = [{"name": "left", "camera": {"fov": 70}}, {"name": "right", "place": {"position": [0.1, 0, 0]}}]
    made = {}
    for name, own in (("without", {}), ("with", {"imu": {"rate": 200}})):
        (tmp_path / name).mkdir()
        left, right = sensors
        recipe = recipe_file(tmp_path / name, **TINY, sensors=[{**left, **own}, right])
        run_dataset(load_run(recipe), tmp_path / name / "out")
        made[name] = tmp_path / name / "out/train/sequence_000000/left"
    assert "imu" in {path.name for path in made["with"].iterdir()}
    files = sorted(path.name for path in made["without"].iterdir())
    assert "events.h5" in files and set(files) < {path.name for path in made["with"].iterdir()}
    assert len(open_events(made["with"] / "events.h5").read()) > 0
    assert (made["with"] / "events.h5").read_bytes() == (made["without"] / "events.h5").read_bytes()


def test_a_first_camera_that_sees_no_event_makes_no_twins_and_one_without_events_no_samples(tmp_path):
    sensors = [
        {"name": "frames", "images": {"rate": 20}, "labels": {"flow": ["forward"]}},
        {"name": "blind", "events": {"contrast_threshold": 5.0, "threshold_sigma": 0}},
        {"name": "eye", "events": {}},
    ]
    recipe = {**TINY, "labels": {**TINY["labels"], "flow": ["forward"]}, "output": {"sequences": 2}}
    for name, rig in (("twins", sensors[1:]), ("shards", sensors[:1] + sensors[2:])):
        run_dataset(load_run(recipe_file(tmp_path, **recipe, sensors=rig)), tmp_path / name)
    counts = [read_manifest(path)["events"] for path in sorted((tmp_path / "twins/train").glob("*/blind"))]
    result = verify_dataset(tmp_path / "twins")
    assert counts == [0, 0] and result.clean and not any("same events" in note for note in result.notes)
    notes = []
    written = export_shards(tmp_path / "shards", tmp_path / "out", note=notes.append)
    assert notes == [f"train/sequence_{k:06d}/frames: no events" for k in range(2)] and sum(written["train"]) == 2
