"""A frame camera from the configuration to the files and those who read them."""

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest

from blinkgl.config.run import RunTemplate
from blinkgl.dataset.generate import generate_run
from blinkgl.dataset.shards import export_shards
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import AssetError
from blinkgl.imaging import CameraImage
from blinkgl.io.frame_camera import read_codes, read_exposures
from blinkgl.report.collect import collect
from blinkgl.sequence import EventChunk, GroundTruth, simulate_sequence
from blinkgl.sequence.request import SequenceRequest

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


def test_images_come_in_time_between_events_and_labels(made):
    config = template().sequence(0)
    seen, times = [], []
    for item in simulate_sequence(SequenceRequest(config, 0)):
        if isinstance(item, EventChunk):
            assert not len(item.events) or item.events.t[0] >= (times[-1] // 1000 if times else 0)
            done_us = item.t_ns // 1000
            assert not len(item.events) or item.events.t[-1] <= done_us
        elif isinstance(item, (CameraImage, GroundTruth)):
            assert item.t_ns // 1000 == done_us, "every event before it has come, and no other"
            times.append(item.t_ns)
            seen.append(item)
    assert times == sorted(times)
    images = [item for item in seen if isinstance(item, CameraImage)]
    assert [item.k for item in images] == list(range(10)) and len(seen) == 10 + 3
    for k in (0, 9):
        for name, codes in images[k].pictures.items():
            np.testing.assert_array_equal(codes, read_codes(made[0].path / f"frame_camera/{name}/{k:06d}.png"))


@pytest.mark.parametrize("old, new", [("start_us", "begin_us"), ("500000.000", "nan")])
def test_a_damaged_list_of_exposures_is_one_line(made, tmp_path, old, new):
    path = tmp_path / "frame_camera/exposures.csv"
    path.parent.mkdir()
    path.write_text((made[0].path / "frame_camera/exposures.csv").read_text().replace(old, new))
    with pytest.raises(AssetError, match="damaged list of exposures"):
        read_exposures(tmp_path)


def test_the_report_and_the_shards_have_them(made, tmp_path):
    report, out = made
    (example,) = collect(out).examples
    titles = [title for title, _ in example.others[:3]]
    assert titles[0] in {f"frame camera, {e.exposure_us / 1000:g} ms" for e in read_exposures(report.path)}
    assert titles[1:] == ["frame camera, sharp", "frame camera, clean"]
    assert all(p.dtype == np.uint8 and p.shape == (30, 40, 3) for _, p in example.others[:3])
    export_shards(out, tmp_path / "shards")
    with tarfile.open(tmp_path / "shards/train-000000.tar") as tar:
        files = {member.name: tar.extractfile(member).read() for member in tar}
    about = json.loads(files["sequence_000000_000001.json"])
    line = read_exposures(report.path)[about["camera"]["image"]]
    following = read_exposures(report.path)[about["camera"]["image"] + 1]
    assert line.end_us <= about["from_us"] < following.end_us and about["camera"]["gain_db"] == line.gain_db
    for ending, name in (("camera", "images"), ("camera_sharp", "sharp"), ("camera_clean", "clean")):
        path = report.path / f"frame_camera/{name}/{about['camera']['image']:06d}.png"
        assert files[f"sequence_000000_000001.{ending}.png"] == path.read_bytes()


def test_no_list_of_exposures_is_said(tmp_path):
    with pytest.raises(AssetError, match="no frame camera here"):
        read_exposures(tmp_path)
