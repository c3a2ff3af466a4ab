"""One YAML in, a DSEC-layout sequence out: read back by independent readers, reproducible, whole or not at all."""

import hashlib
import json
import shutil
from pathlib import Path

import cv2
import h5py
import hdf5plugin  # noqa: F401  (registers the Blosc filter for h5py)
import numba
import numpy as np
import pytest
import yaml

from blinkgl.camera.pinhole import rectified
from blinkgl.cli import run
from blinkgl.config.reader import to_yaml
from blinkgl.config.run import RunTemplate, load_run
from blinkgl.dataset import generate as generate_module
from blinkgl.dataset.generate import generate_run
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import AssetError, ConfigError
from blinkgl.io.flow import read_flow
from blinkgl.io.images import read_image
from blinkgl.io.sequence_tables import read_exposures
from blinkgl.render.passes import Luminance
from runs import generated

SMALL = {
    "seed": 4,
    "output": {"name": "tiny"},
    "camera": {"width": 64, "height": 48},
    "time": {"duration": 0.2, "label_rate": 20, "start": 3.0},
    "timeline": {"kind": "uniform", "fps": 200},
    "scene": {
        "kind": "random",
        "objects": {"count": 3},
        "pool": {"primitives": ["cuboid", "sphere"], "variants": 2},
        "textures": {"procedural": ["checks", "fbm"], "variants": 2, "photographs": False, "max_size": 64},
    },
    "labels": {
        "flow": ["forward", "backward"],
        "float_flow": ["npy"],
        "depth": True,
        "ids": True,
        "normals": True,
        "velocity": True,
    },
    "preview": {"enabled": False},
}


def config_file(tmp_path, **changes) -> Path:
    path = tmp_path / "run.yaml"
    path.write_text(yaml.safe_dump({**SMALL, **changes}))
    return path


def generate(tmp_path, out="out", num=None, **changes) -> list[Path]:
    return [r.path for r in generate_run(load_run(config_file(tmp_path, **changes)), tmp_path / out, num)]


def digests(folder: Path) -> dict[str, str]:
    return {
        p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


@pytest.fixture(scope="module")
def sequence(tmp_path_factory) -> Path:
    return generate(tmp_path_factory.mktemp("sequence"))[0]


# ---- the sequence, by readers that are not ours ------------------------------------------------------------------


def dsec_slice(file: h5py.File, t0_us: int, t1_us: int) -> dict[str, np.ndarray]:
    """The rule of DSEC's event slicer, written from the format's description: ms_to_idx brackets the window in whole
    milliseconds, the exact window is found inside, times are int64 and relative to t_offset."""
    offset = int(file["t_offset"][()])
    start, stop = t0_us - offset, t1_us - offset
    ms = file["ms_to_idx"]
    a, b = int(ms[start // 1000]), int(ms[-(-stop // 1000)])
    t = file["events/t"][a:b].astype(np.int64)
    inside = (t >= start) & (t < stop)
    return {"t": t[inside] + offset, **{k: file[f"events/{k}"][a:b][inside] for k in "xyp"}}


def test_events_by_the_dsec_slicer(sequence):
    with h5py.File(sequence / "events.h5") as file:
        assert int(file["t_offset"][()]) == 3_000_000
        assert [file[f"events/{k}"].dtype for k in "xypt"] == [np.uint16, np.uint16, np.uint8, np.uint32]
        everything = dsec_slice(file, 3_000_000, 3_250_000)
        assert len(everything["t"]) == len(file["events/t"]) > 500, "every event is inside [start, end)"
        assert (np.diff(everything["t"]) >= 0).all()
        assert everything["x"].max() < 64 and everything["y"].max() < 48 and set(everything["p"]) == {0, 1}
        windows = [dsec_slice(file, a, a + 50_000) for a in range(3_000_000, 3_250_000, 50_000)]
        assert sum(len(w["t"]) for w in windows) == len(everything["t"])
        assert all(len(w["t"]) for w in windows), "each label has events before and after it"


def test_flow_png_equals_the_float_flow_to_half_a_quantum(sequence):
    for direction in ("forward", "backward"):
        lines = (sequence / f"flow/{direction}_timestamps.txt").read_text().splitlines()
        assert lines[0].startswith("#") and len(lines) == 1 + 4
        for k in range(4):
            raw = cv2.imread(str(sequence / f"flow/{direction}/{k:06d}.png"), cv2.IMREAD_UNCHANGED)
            assert raw.dtype == np.uint16 and raw.shape == (48, 64, 3)
            png = (raw[..., :0:-1].astype(np.float64) - 2**15) / 128
            exact = np.load(sequence / f"flow/{direction}_npy/{k:06d}.npy")
            valid = raw[..., 0] == 1
            assert valid.mean() > 0.9
            assert np.abs(png - exact[..., :2])[valid].max() <= 0.5 / 128 + 1e-6
            start, end = (int(x) for x in lines[1 + k].split(","))
            assert start == 3_050_000 + 50_000 * k and end == start + (50_000 if direction == "forward" else -50_000)


# ---- reproducible ------------------------------------------------------------------------------------------------


def test_same_seed_same_bytes_whatever_the_threads(sequence, tmp_path):
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        again = generate(tmp_path)[0]
    finally:
        numba.set_num_threads(before)
    assert digests(again) == digests(sequence)


def test_another_seed_or_index_is_another_sequence_and_order_does_not_matter(sequence, tmp_path):
    first, second = generate(tmp_path, num=2)
    assert digests(first) == digests(sequence)
    assert digests(second)["events.h5"] != digests(first)["events.h5"]
    alone = generate(tmp_path, out="alone", output={"name": "tiny", "first_index": 1}, num=1)[0]
    assert digests(alone)["events.h5"] == digests(second)["events.h5"]
    other = generate(tmp_path, out="other", seed=5)[0]
    assert digests(other)["events.h5"] != digests(first)["events.h5"]


def test_a_still_camera_saves_work_and_changes_nothing(tmp_path, monkeypatch):
    scene = {
        **SMALL["scene"],
        "camera_motion": {"kind": "static"},
        "objects": {"count": 8, "distance": [2, 4]},
        "object_motion": {"speed": [1, 2], "static_share": 0.2},
    }
    for k, timeline in enumerate(
        (
            {"kind": "uniform", "fps": 200},
            {"kind": "displacement", "max_px": 0.3},
            {"kind": "brightness"},
        )
    ):
        quick = generate(tmp_path, out=f"quick {k}", scene=scene, timeline=timeline)[0]
        with monkeypatch.context() as patch:
            patch.setattr(Luminance, "still", False)
            slow = generate(tmp_path, out=f"slow {k}", scene=scene, timeline=timeline)[0]
        assert digests(quick) == digests(slow)
        with h5py.File(quick / "events.h5") as file:
            assert len(file["events/t"]) > 100


# ---- whole or not at all -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_failure_in_the_middle_leaves_nothing(tmp_path, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(generate_module, "_write_labels", fail)
    with pytest.raises(error):
        generate(tmp_path)
    assert [p for p in (tmp_path / "out").rglob("*") if p.is_file()] == []


def test_existing_output_is_refused_before_any_work(tmp_path, capsys, monkeypatch):
    folder = generate(tmp_path)[0]
    before = digests(folder)
    monkeypatch.setattr(generate_module, "create_context", lambda *_: pytest.fail("work was started"))
    assert run(["generate", str(config_file(tmp_path)), "--out", str(tmp_path / "out"), "--num", "3"]) == 2
    assert "output folder exists" in capsys.readouterr().err
    assert digests(folder) == before


# ---- the command line --------------------------------------------------------------------------------------------


# --- A camera with a lens in whole sequences: files, verification, rectified labels, tracks, the frame camera,
# layouts.

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
    return generated(tmp_path_factory.mktemp("lenses"), RUN) / "out"


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


# --- A frame camera from the configuration to the files and those who read them.

RUN_FRAME_CAMERA_RUNS = {
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
    return RunTemplate({**RUN_FRAME_CAMERA_RUNS, "images": {**RUN_FRAME_CAMERA_RUNS["images"], **images}}, Path("."))


@pytest.fixture(scope="module")
def made_of_frame_camera_runs(tmp_path_factory):
    out = tmp_path_factory.mktemp("camera") / "out"
    (report,) = generate_run(template(), out)
    return report, out


def test_images_are_written_beside_everything_else_and_verified(made_of_frame_camera_runs):
    report, out = made_of_frame_camera_runs
    lines = read_exposures(report.path)
    assert all(e.start_us < e.middle_us < e.end_us for e in lines)
    assert lines[0].middle_us == pytest.approx((lines[0].start_us + lines[0].end_us) / 2, abs=1)
    assert len(lines) == 10 and [round(e.start_us) for e in lines[:3]] == [500_000, 514_286, 528_571]
    assert not (report.path / "images").exists(), "in the place of the instantaneous ones"
    for name in ("images", "clean", "sharp"):
        assert len(list((report.path / "frame_camera" / name).glob("*.png"))) == 10
        codes = read_image(report.path / f"frame_camera/{name}/000009.png")
        assert codes.shape == (30, 40, 3) and codes.dtype == np.uint16 and 300 < codes.max() < 4096
    manifest = json.loads((report.path / "manifest.json").read_text())
    assert manifest["frame_camera"]["images"] == 10 and manifest["frame_camera"]["bits"] == 12
    assert report.seconds["images"] > 0
    assert verify_dataset(out, deep=1).clean


@pytest.mark.parametrize("old, new", [("start_us", "begin_us"), ("500000.000", "nan")])
def test_a_damaged_list_of_exposures_is_one_line(made_of_frame_camera_runs, tmp_path, old, new):
    path = tmp_path / "frame_camera/exposures.csv"
    path.parent.mkdir()
    path.write_text((made_of_frame_camera_runs[0].path / "frame_camera/exposures.csv").read_text().replace(old, new))
    with pytest.raises(AssetError, match="damaged list of exposures"):
        read_exposures(tmp_path)


def test_no_list_of_exposures_is_said(tmp_path):
    with pytest.raises(AssetError, match="the sequence has no frame camera"):
        read_exposures(tmp_path)
