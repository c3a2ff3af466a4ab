"""A camera with a lens in whole sequences: files, verification, rectified labels, tracks, the frame camera, layouts."""

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from blinkgl.camera.pinhole import rectified
from blinkgl.cli import run
from blinkgl.config.reader import to_yaml
from blinkgl.config.run import load_run
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import ConfigError
from blinkgl.io.flow import read_flow

LENS = {"width": 64, "height": 48, "fov": 75, "lens": "radtan", "distortion": [-0.3, 0.1, 1e-3, -2e-3]}
RUN = {
    "seed": 4,
    "camera": LENS,
    "time": {"duration": 0.1, "label_rate": 20},
    "timeline": {"kind": "displacement", "max_px": 1.0},
    "scene": {
        "objects": {"count": 4, "distance": [2, 5]},
        "camera_motion": {"speed": 1.5, "rotation_rate": [60, 90]},
        "pool": {"primitives": ["cuboid", "cone"], "variants": 6},
        "textures": {"procedural": ["checks"], "variants": 4, "photographs": False, "max_size": 32},
    },
    "labels": {"flow": ["forward"], "depth": True, "ids": True, "events": True},
    "tracks": {"points": 64, "choose": "grid"},
    "images": {
        "rate": 20,
        "exposure_us": 4000,
        "row_us": 40,
        "lens": {"aperture": 0.02, "focus": 3},
        "also": ["sharp"],
    },
    "preview": {"enabled": False},
    "groups": {
        "bent": {"seed": 4, "output": {"sequences": 1, "name": "bent"}},
        "flat": {"seed": 4, "output": {"sequences": 1, "name": "flat"}, "labels": {"pixels": "rectified"}},
    },
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lenses")
    (folder / "run.yaml").write_text(to_yaml(RUN), encoding="utf-8")
    assert run(["generate", str(folder / "run.yaml"), "--out", str(folder / "out")]) == 0
    return folder / "out"


def test_verify_knows_the_lens(made, tmp_path):
    assert verify_dataset(made, deep=2).problems == {}
    for name, change in (
        ("rectify_map.h5", lambda path: h5py.File(path, "r+")["rectify_map"].write_direct(np.zeros((48, 64, 2), "f4"))),
        ("camchain.yaml", lambda path: path.write_text(path.read_text().replace("-0.3\n", "-0.29\n"))),
    ):
        copy = tmp_path / name
        shutil.copytree(made, copy)
        path = copy / "train/bent_000000" / name
        before = path.read_bytes()
        change(path)
        assert path.read_bytes() != before
        found = str(verify_dataset(copy).problems)
        assert name in found


def test_rectified_labels_are_where_the_map_leads(made):
    bent, flat = (made / f"train/{name}_000000" for name in ("bent", "flat"))
    for name in ("events.h5", "frame_camera/images/000000.png", "rectify_map.h5"):
        assert (bent / name).read_bytes() == (flat / name).read_bytes()  # nothing of the sensor's own has changed
    camera = load_run(bent / "config.yaml").sequence(0).camera.model
    one, other = (np.load(folder / "depth/000000.npy") for folder in (bent, flat))
    assert (one != other).mean() > 0.5
    with h5py.File(bent / "rectify_map.h5") as file:
        to = np.rint(file["rectify_map"][()]).astype(int)
    inside = (to >= 0).all(axis=-1) & (to < [64, 48]).all(axis=-1)
    there = other[np.clip(to[..., 1], 0, 47), np.clip(to[..., 0], 0, 63)]
    assert np.quantile(np.abs(one / there - 1)[inside], 0.8) < 0.03
    assert rectified(camera).width == 64


@pytest.mark.parametrize("name", ["bent", "flat"])
def test_tracks_are_in_the_labels_pixels(made, name):
    folder = made / f"train/{name}_000000"
    tracks = np.load(folder / "tracks.npz")
    flow, valid = read_flow(folder / "flow/forward/000000.png")
    x, y = tracks["query_points"][:, 2].astype(int), tracks["query_points"][:, 1].astype(int)
    moved = tracks["target_points"][:, 1] - tracks["target_points"][:, 0]
    seen = valid[y, x] & ~tracks["occluded"][:, 0]
    assert seen.sum() > 20
    off = np.abs(flow[y, x] - moved)[seen].max(axis=-1)
    assert np.quantile(off, 0.9) < 1 / 128 and np.abs(moved[seen]).max() > 1  # the PNG's quantum


def test_a_file_s_own_camera_has_no_lens(tmp_path):
    scene = {"kind": "file", "path": "a.glb", "intrinsics": "file"}
    Path(tmp_path / "run.yaml").write_text(to_yaml({"camera": LENS, "scene": scene}), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"scene.intrinsics: the file's camera is a pin-hole camera \(got 'file'\)"):
        load_run(tmp_path / "run.yaml")
