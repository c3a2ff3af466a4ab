"""`blinkgl export --scene`: a sequence as an animated glTF, read back by our own importer and by trimesh."""

import cv2
import numpy as np
import pytest
import yaml

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset.run import run_dataset

HEIGHT, WIDTH = 36, 48
SCENE = {
    "kind": "explicit",
    "meshes": {
        "ball": {"primitive": "icosphere", "parameters": {"radius": 0.5}},
        "cloth": {"primitive": "cuboid", "parameters": {"extents": [1.2, 0.05, 0.8], "subdivisions": 3}},
        "floor": {"primitive": "grid", "parameters": {"width": 12, "depth": 12}},
    },
    "materials": {
        "checked": {"procedural": "checks", "uv_scale": [3, 2]},
        "striped": {"procedural": "stripes", "color": [0.5, 0.9, 0.3]},
    },
    "objects": [
        {"mesh": "floor", "material": "striped", "category": "ground", "name": "floor"},
        {
            "mesh": "ball",
            "material": "checked",
            "name": "ball",
            "keyframes": [
                {"time": 0, "position": [4, -0.8, 1]},
                {"time": 0.4, "position": [4, 0.2, 1.2], "euler": [0, 40, 90]},
            ],
        },
        {
            "mesh": "cloth",
            "material": "checked",
            "name": "cloth",
            "position": [3.2, 0.8, 1.4],
            "euler": [0, 0, -80],
            "deform": {"kind": "wave", "along": "x", "towards": "y", "amplitude": 0.1, "period": 0.5},
        },
    ],
    "camera": {
        "keyframes": [
            {"time": 0, "position": [0, 0, 1.2], "look_at": [4, 0, 1]},
            {"time": 0.4, "position": [0.3, 0.1, 1.3], "look_at": [4, 0, 1]},
        ]
    },
}
RECIPE = {
    "seed": 3,
    "camera": {"width": WIDTH, "height": HEIGHT, "fov": 70},
    "time": {"duration": 0.2, "label_rate": 10},
    "timeline": {"kind": "uniform", "fps": 60},
    "labels": {"flow": ["forward"], "float_flow": ["npy"], "depth": True},
    "preview": {"enabled": False},
}


def generate(folder, scene):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "recipe.yaml").write_text(yaml.safe_dump({**RECIPE, "scene": scene}))
    run_dataset(load_run(folder / "recipe.yaml"), folder / "out", num=1)
    return folder / "out/train/sequence_000000"


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return generate(tmp_path_factory.mktemp("scene"), SCENE)


@pytest.fixture(scope="module")
def exported(original):
    path = original.parents[2] / "scene.glb"
    assert run(["export", str(original), "--scene", str(path)]) == 0
    return path


def test_drawn_again_it_is_the_same_sequence(original, exported, tmp_path):
    again = generate(tmp_path, {"kind": "file", "path": str(exported), "intrinsics": "file", "animation": "sequence"})
    assert original != again
    for k in range(2):
        depth, drawn = (np.load(f / f"depth/{k:06d}.npy") for f in (original, again))
        there = np.isfinite(depth)
        assert (there != np.isfinite(drawn)).mean() < 0.01 and there.mean() > 0.4
        both = there & np.isfinite(drawn)
        off = np.abs(drawn[both] - depth[both]) / depth[both]
        assert np.median(off) < 1e-6 and np.percentile(off, 98) < 1e-4  # silhouettes may fall on either side
        flow, shown = (np.load(f / f"flow/forward_npy/{k:06d}.npy") for f in (original, again))
        apart = np.abs(flow - shown)[..., :2].max(-1)
        assert np.median(apart) < 1e-4 and np.percentile(apart, 98) < 1e-2
        image, seen = (cv2.imread(str(f / f"images/{k:06d}.png")).astype(int) for f in (original, again))
        assert np.median(np.abs(image - seen)) <= 1 and (np.abs(image - seen) <= 3).mean() > 0.97


def test_refusals(original, exported, tmp_path, capsys):
    for arguments, said in (
        ([str(original), "--scene", str(tmp_path / "a.gltf")], "expected .glb"),
        ([str(original), "--scene", str(tmp_path / "a.glb"), "--layout", "dsec"], "without --scene"),
        ([str(tmp_path), "--scene", str(tmp_path / "a.glb")], "a scene is of one sequence"),
        ([str(original)], "--scene FILE.glb"),
    ):
        assert run(["export", *arguments]) == 2
        error = capsys.readouterr().err.strip()
        assert said in error and "\n" not in error
    assert not list(tmp_path.iterdir())
