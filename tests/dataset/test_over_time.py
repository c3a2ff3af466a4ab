"""Tracks and an inertial unit in a data set: files, verify, explain; `verify` sees them altered; bad input."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset.explain import explain
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import AssetError
from blinkgl.io.imu import read_imu
from blinkgl.io.sequence_tables import read_tracks
from runs import generated

CONFIG = """
camera: {width: 48, height: 36}
time: {duration: 0.1, label_rate: 50}
imu: {preset: adis16448, rate: 1000, position: [0.05, 0, 0]}
tracks: {points: 60, choose: surface, rate: 200}
labels: {flow: [], occlusion: false}
preview: {enabled: false}
scene: {kind: random, pool: {primitives: [cuboid]}, textures: {photographs: false, max_size: 32}}
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return generated(tmp_path_factory.mktemp("over_time"), CONFIG) / "out"


def sequence_of(root: Path) -> Path:
    return next(root.rglob("manifest.json")).parent


def test_files_and_the_same_again(made):
    folder = sequence_of(made)
    assert verify_dataset(made, deep=1).clean
    imu, tracks = read_imu(folder), read_tracks(folder)
    assert imu["t_ns"].tolist() == [k * 1_000_000 for k in range(121)]
    told = np.loadtxt(folder / "imu/imu.csv", delimiter=",")
    t, rate, acceleration = told[:, 0], told[:, 1:4], told[:, 4:]
    assert np.array_equal(t, imu["t_ns"]) and np.array_equal(rate, imu["rate"])
    assert not np.array_equal(imu["rate"], imu["ideal_rate"])
    kalibr = yaml.safe_load((folder / "imu/imu.yaml").read_text())
    assert kalibr["update_rate"] == 1000 and kalibr["gyroscope_noise_density"] == 1.6968e-4
    assert np.array(kalibr["T_cam_imu"])[:3, 3].tolist() == [0.05, 0, 0]
    assert tracks["t_us"].tolist() == list(range(20_000, 120_001, 5_000))
    assert tracks["target_points"].shape == (60, 21, 2) and not tracks["occluded"].all(axis=1).any()
    poses = np.load(folder / "poses.npz")  # the unit moves with the camera of poses.npz
    assert np.array_equal(poses["t_ns"][:2], [0, 20_000_000]) and np.linalg.norm(acceleration.mean(0)) < 60


@pytest.mark.parametrize("read, file", [(read_tracks, "tracks.npz"), (read_imu, "imu/imu.h5")])
def test_damaged_files_are_one_line(made, tmp_path, read, file):
    shutil.copytree(sequence_of(made), tmp_path / "s")
    (tmp_path / "s" / file).write_bytes(b"PK")
    with pytest.raises(AssetError, match=file):
        read(tmp_path / "s")


def test_explain_counts_them(tmp_path):
    (tmp_path / "c.yaml").write_text(CONFIG)
    told = explain(load_run(tmp_path / "c.yaml"))
    passes = {one.name: one for one in told.passes}
    assert passes["inertial unit"].count == 121 and passes["point tracks"].count == 21
    told = explain(load_run(tmp_path / "c.yaml", ["imu=null", "tracks=null"]))
    assert {"inertial unit", "point tracks"} <= {what for what, _ in told.left_out}


@pytest.mark.parametrize(
    "options, said",
    [
        (["imu.rate=2000"], "imu.rate: too large (got 2000); expected a number greater than 0 and at most 1000"),
        (["imu.noise=1"], "imu.noise: unknown key"),
        (
            ["tracks.choose=edges"],
            "tracks.choose: unknown choice (got 'edges'); expected 'grid' or 'surface'",
        ),
        (["tracks.points=1000000", "tracks.rate=10000"], "tracks.points: 1e+09 positions (got 1000000)"),
        (["frames={folders: [x], fps: 30}"], "imu: recorded frames do not tell where their camera was"),
        (
            ["imu=null", "frames={folders: [x], fps: 30}"],
            "tracks: recorded frames do not tell where their surfaces are",
        ),
    ],
)
def test_bad_input_in_one_line(tmp_path, capsys, options, said):
    (tmp_path / "c.yaml").write_text(CONFIG)
    sets = [word for option in options for word in ("--set", option)]
    assert run(["generate", str(tmp_path / "c.yaml"), "--out", str(tmp_path / "d"), *sets]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert said in error and not (tmp_path / "d").exists()
