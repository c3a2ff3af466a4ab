"""A frame camera from the configuration to the files and those who read them."""

import json
from pathlib import Path

import numpy as np
import pytest

from blinkgl.config.run import RunTemplate
from blinkgl.dataset.generate import generate_run
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import AssetError
from blinkgl.io.frame_camera import read_codes, read_exposures

RUN = {
    "seed": 5,
    "camera": {"width": 40, "height": 30},
    "time": {"duration": 0.1, "label_rate": 20, "start": 0.5},
    "scene": {
        "objects": {"count": 2, "distance": [2, 4]},
        "pool": {"primitives": ["sphere", "cuboid"], "variants": 2},
        "textures": {"procedural": ["checks", "fbm"], "variants": 2, "photographs": False, "max_size": 32},
        "camera_motion": {"speed": [2, 5], "rotation_rate": [60, 200]},
    },
    "images": {
        "rate": 70,
        "exposure_us": 6000,
        "row_us": 50,
        "bits": 12,
        "photon_noise": True,
        "gain_db": 12,
        "read_noise": 3,
        "max_instants": 3,
        "also": ["clean", "sharp"],
        "auto_exposure": {"lag": 0.05, "longest_us": 9000},
    },
    "preview": {"enabled": False},
}


def template(**images):
    return RunTemplate({**RUN, "images": {**RUN["images"], **images}}, Path("."))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("camera") / "out"
    (report,) = generate_run(template(), out)
    return report, out


def test_images_are_written_beside_everything_else_and_verified(made):
    report, out = made
    lines = read_exposures(report.path)
    assert len(lines) == 10 and [round(e.start_us) for e in lines[:3]] == [500_000, 514_286, 528_571]
    assert not (report.path / "images").exists(), "in the place of the instantaneous ones"
    for name in ("images", "clean", "sharp"):
        assert len(list((report.path / "frame_camera" / name).glob("*.png"))) == 10
        codes = read_codes(report.path / f"frame_camera/{name}/000009.png")
        assert codes.shape == (30, 40, 3) and codes.dtype == np.uint16 and 300 < codes.max() < 4096
    manifest = json.loads((report.path / "manifest.json").read_text())
    assert manifest["frame_camera"]["images"] == 10 and manifest["frame_camera"]["bits"] == 12
    assert report.seconds["images"] > 0
    assert verify_dataset(out, deep=1).clean


@pytest.mark.parametrize("old, new", [("start_us", "begin_us"), ("500000.000", "nan")])
def test_a_damaged_list_of_exposures_is_one_line(made, tmp_path, old, new):
    path = tmp_path / "frame_camera/exposures.csv"
    path.parent.mkdir()
    path.write_text((made[0].path / "frame_camera/exposures.csv").read_text().replace(old, new))
    with pytest.raises(AssetError, match="damaged list of exposures"):
        read_exposures(tmp_path)


def test_no_list_of_exposures_is_said(tmp_path):
    with pytest.raises(AssetError, match="no frame camera here"):
        read_exposures(tmp_path)
