"""`blinkgl export --layout`: what other people's loaders ask for, restated in loaders.py, and what they then hold."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import cv2
import h5py
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from blinkgl import read_events
from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset.run import run_dataset
from blinkgl.errors import AssetError, ConfigError, OutputError
from blinkgl.io.flow import read_flow_npy
from blinkgl.io.formats import open_events
from blinkgl.io.imu import read_imu
from blinkgl.io.reading import EventReading
from blinkgl.io.sequence_tables import read_tracks
from blinkgl.layouts import LAYOUTS, Source, dsec, export as exporting, export_layout, point_tracks
from blinkgl.layouts.source import Planned, sources_of
from loaders import (
    blinkflow_sequence,
    dsec_disparity,
    dsec_flow,
    dsec_sequence,
    eraft_sequence,
    eventkubric_sample,
    multiflow_sample,
    rectify_map,
    tapvid,
)

HEIGHT, WIDTH = 24, 32
RECIPE = {
    "seed": 5,
    "camera": {"width": WIDTH, "height": HEIGHT},
    "time": {"duration": 0.4, "label_rate": 10, "start": 7.0},
    "timeline": {"kind": "uniform", "fps": 60},
    "scene": {
        "kind": "random",
        "objects": {"count": 2},
        "pool": {"primitives": ["cuboid"], "variants": 4},
        "textures": {"procedural": ["checks", "fbm"], "variants": 4, "photographs": False, "max_size": 64},
    },
    "events": {"emulator": "esim", "contrast_threshold": 0.1},
    "labels": {"flow": ["forward", "backward"], "float_flow": ["npy"], "depth": True, "occlusion": True},
    "tracks": {"points": 30},
    "imu": {"preset": "ideal", "rate": 100},
    "preview": {"enabled": False},
}


def generate(folder, recipe, num=1):
    folder.mkdir(exist_ok=True)
    path = folder / "recipe.yaml"
    path.write_text(yaml.safe_dump(recipe))
    run_dataset(load_run(path), folder / "out", num=num)
    return folder / "out"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return generate(tmp_path_factory.mktemp("data"), RECIPE)


@pytest.fixture(scope="module")
def sequence(data):
    return data / "train/sequence_000000"


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """Made with nothing to learn from."""
    recipe = {**RECIPE, "time": {"duration": 0.1}, "labels": {"flow": [], "images": False}}
    return generate(tmp_path_factory.mktemp("bare"), {k: v for k, v in recipe.items() if k not in ("tracks", "imu")})


def exported(data, tmp_path, layout):
    assert export_layout(data, tmp_path / layout, layout).sequences == 1
    return tmp_path / layout


def label_times(sequence):
    return np.loadtxt(sequence / "flow/forward_timestamps.txt", dtype="int64", delimiter=",")


def same(columns, events):
    for got, name in zip(columns, "xytp", strict=True):
        np.testing.assert_array_equal(got, getattr(events, name))


def test_dsec(data, sequence, tmp_path):
    folder = exported(data, tmp_path, "dsec") / "train/sequence_000000"
    assert list((tmp_path / "dsec/train").iterdir()) == [folder], "their provider takes every entry for a sequence"
    events, found = read_events(sequence / "events.h5"), list(dsec_sequence(folder, HEIGHT, WIDTH))
    assert len(found) == 4
    for (number, start, end, flow, valid, before, during), k in zip(found, range(4)):
        assert (number, start, end) == (2 * k + 2, *label_times(sequence)[k])
        same(before, events.window(2 * start - end, start))
        same(during, events.window(start, end))
        true, _ = read_flow_npy(sequence / f"flow/forward_npy/{k:06d}.npy")
        assert valid.any() and np.abs(flow - true)[valid].max() <= 0.5 / 128
        image = cv2.imread(str(folder / f"images/left/ev_inf/{number:06d}.png"))
        np.testing.assert_array_equal(image, cv2.imread(str(sequence / f"images/{k:06d}.png")))
        back, _ = dsec_flow(folder / f"flow/backward/{number:06d}.png")
        assert back.shape == (HEIGHT, WIDTH, 2)
    backward = np.loadtxt(folder / "flow/backward_timestamps.txt", dtype="int64", delimiter=",")
    np.testing.assert_array_equal(backward[1:], label_times(sequence)[:-1, ::-1])
    calibration = yaml.safe_load((folder / "calibration/cam_to_cam.yaml").read_text())
    K = np.load(sequence / "poses.npz")["K"]
    assert calibration["intrinsics"]["cam0"]["camera_matrix"] == [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    assert calibration["intrinsics"]["camRect0"]["resolution"] == [WIDTH, HEIGHT]
    assert not (folder / "disparity").exists() and not (folder / "events/right").exists()
    assert (tmp_path / "dsec/test").is_dir(), "bflow's provider asserts both splits"


def test_what_loaders_will_miss_is_said(data, stereo, tmp_path):
    """A split that they open, a second camera, a second label; training sequences never land in test/."""
    one = generate(tmp_path / "one", {**RECIPE, "time": {**RECIPE["time"], "duration": 0.1}})
    said = {
        "eraft": ["nothing in test/, which its loaders open"],
        "mvsec": ["sequence_000000: no davis/right, which some loaders open (rig: stereo)"],
        "dsec": [],
    }
    for layout, lines in said.items():
        found = [s for s in export_layout(data, tmp_path / layout, layout).said if "published loaders expect" not in s]
        assert found == lines and not list((tmp_path / layout).glob("test/*"))
    assert not [s for s in export_layout(stereo, tmp_path / "two", "mvsec").said if "davis/right" in s]
    assert "sequence_000000: one label, and bflow's loader opens two or more" in (
        export_layout(one, tmp_path / "one_dsec", "dsec").said
    )


def test_dsecs_provider_is_named_where_it_finds_what_it_asserts(data, stereo, tmp_path):
    """It asserts a folder of disparities: a monocular data set is not for it."""
    opened_by = [export_layout(one, tmp_path / one.name, "dsec").opened_by for one in (data, stereo)]
    assert "(not DSEC's provider, which asks for 'rig: stereo'" in opened_by[0]
    assert opened_by[1].startswith("DSEC's provider, ")


def test_eraft(data, sequence, tmp_path):
    folder = exported(data, tmp_path, "eraft") / "train/sequence_000000"
    events, found = read_events(sequence / "events.h5"), list(eraft_sequence(folder, HEIGHT, WIDTH))
    assert [number for number, *_ in found] == [2, 4, 6, 8]
    for number, t, before, after in found:
        assert t == label_times(sequence)[number // 2 - 1, 0]
        same(before, events.window(t - 100_000, t))
        same(after, events.window(t, t + 100_000))
        assert (folder / f"flow/forward/{number:06d}.png").is_file()


def test_blinkflow(data, sequence, tmp_path):
    folder = exported(data, tmp_path, "blinkflow") / "training/sequence/000000"
    events, found = read_events(sequence / "events.h5"), list(blinkflow_sequence(folder))
    assert [i for i, *_ in found] == [1, 2, 3, 4]
    start_us = 7_000_000
    for i, t, flow, before, during in found:
        assert t + start_us == label_times(sequence)[i - 1, 0]
        for columns, (a, b) in ((before, (t - 100_000, t)), (during, (t, t + 100_000))):
            expected = events.window(start_us + a, start_us + b)
            same([*columns[:2], columns[2].astype("i8") + start_us, columns[3]], expected)
        true = np.load(sequence / f"flow/forward_npy/{i - 1:06d}.npy")
        hidden = cv2.imread(str(sequence / f"occlusion/forward/{i - 1:06d}.png"), -1) > 0
        np.testing.assert_array_equal(flow[..., :2], true[..., :2])
        np.testing.assert_array_equal(flow[..., 2], (true[..., 2] > 0) & ~hidden)
        back = np.load(folder / f"backward_flow/{i - 1:06d}.npy")
        np.testing.assert_array_equal(back, np.load(sequence / f"flow/backward_npy/{i - 1:06d}.npy"))


def test_mvsec(data, sequence, tmp_path):
    stem = exported(data, tmp_path, "mvsec") / "train/sequence_000000"
    events = read_events(sequence / "events.h5")
    images = np.loadtxt(sequence / "images/timestamps.txt", dtype="int64")
    with h5py.File(f"{stem}_data.hdf5") as file:
        left = file["davis/left"]
        assert left["events"].dtype == np.float64 and left["events"].shape == (len(events), 4)
        np.testing.assert_array_equal(left["events"][:, :2], np.stack([events.x, events.y], 1))
        np.testing.assert_allclose(left["events"][:, 2], events.t * 1e-6, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(left["events"][:, 3], np.where(events.p, 1, -1))
        assert left["image_raw"].shape == (5, HEIGHT, WIDTH) and left["image_raw"].dtype == np.uint8
        np.testing.assert_allclose(left["image_raw_ts"], images * 1e-6)
        first = np.searchsorted(events.t, images)
        np.testing.assert_array_equal(left["image_raw_event_inds"], np.minimum(first, len(events) - 1))
        np.testing.assert_array_equal(left["imu"][:, :3], read_imu(sequence)["acceleration"])
        np.testing.assert_allclose(left["imu_ts"], read_imu(sequence)["t_ns"] * 1e-9)
    with h5py.File(f"{stem}_gt.hdf5") as file:
        depth = np.load(sequence / "depth/000001.npy")
        np.testing.assert_array_equal(
            file["davis/left/depth_image_raw"][1], np.where(np.isfinite(depth), depth, np.nan)
        )
        np.testing.assert_allclose(file["davis/left/pose"][0], np.eye(4), atol=1e-12)
    with np.load(f"{stem}_gt_flow_dist.npz", allow_pickle=False) as flow:
        np.testing.assert_allclose(flow["timestamps"], label_times(sequence)[:, 0] * 1e-6)
        true = np.load(sequence / "flow/forward_npy/000002.npy")
        got = np.stack([flow["x_flow_dist"][2], flow["y_flow_dist"][2]], -1)
        np.testing.assert_array_equal((got != 0).any(-1), true[..., 2] > 0)
        np.testing.assert_allclose(got, true[..., :2], atol=2e-6)
    with open_events(f"{stem}_data.hdf5") as file:
        assert file.format == "mvsec"


def test_tapvid(data, sequence, tmp_path):
    folder = exported(data, tmp_path, "tapvid")
    (name, video), *others = tapvid(folder / "train/sequence_000000.pkl").items()
    tracks = read_tracks(sequence)
    assert name == "sequence_000000" and not others
    np.testing.assert_array_equal(video["occluded"], tracks["occluded"])
    raster = video["points"] * [WIDTH, HEIGHT] - 0.5  # a reader multiplies by the size of its video
    np.testing.assert_allclose(raster, tracks["target_points"], atol=1e-4)
    for k, frame in enumerate(video["video"]):
        np.testing.assert_array_equal(frame[..., ::-1], cv2.imread(str(sequence / f"images/{k:06d}.png")))


def test_eventkubric(data, sequence, tmp_path, monkeypatch):
    monkeypatch.setattr(point_tracks, "TIMES", 5)
    monkeypatch.setattr(point_tracks, "SECONDS", 0.4)
    folder = exported(data, tmp_path, "eventkubric")
    (x, y, t, p), rgb, points, occluded = eventkubric_sample(folder / "train/sequence_000000", 5, 0.4)
    tracks, events = read_tracks(sequence), read_events(sequence / "events.h5")
    part = events.window(tracks["t_us"][0], tracks["t_us"][0] + 400_000)
    for name, theirs in (("x", x), ("y", y), ("t", t // 1000 + tracks["t_us"][0]), ("p", (p + 1) // 2)):
        np.testing.assert_array_equal(getattr(part, name), theirs)
    np.testing.assert_allclose(points - 0.5, tracks["target_points"], atol=1e-4)  # theirs count from the corner
    np.testing.assert_array_equal(occluded, tracks["occluded"])
    for k, frame in enumerate(rgb):
        np.testing.assert_array_equal(frame[..., ::-1], cv2.imread(str(sequence / f"images/{k:06d}.png")))
    with open_events(folder / "train/sequence_000000/events/0000000000.npz") as file:  # says its own unit, ns
        assert file.read().t.tolist() == (part.t - tracks["t_us"][0]).tolist()
        assert file.notes == ["read as vid2e's arrays: ns"]


def test_generate_writes_a_layout_too_when_all_are_whole(tmp_path, capsys):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(yaml.safe_dump(RECIPE))
    asked = ["generate", str(recipe), "--out", f"{tmp_path}/out", "--quiet", "--layout"]
    assert run([*asked, "colmap"]) == 2 and "no such layout" in capsys.readouterr().err
    (tmp_path / "out-tapvid").mkdir()
    (tmp_path / "out-tapvid/mine").touch()
    assert run([*asked, "tapvid"]) == 2 and "out-tapvid" in capsys.readouterr().err
    assert not (tmp_path / "out").exists(), "nothing is made for an export that cannot be written"
    assert run([*asked, "blinkflow"]) == 0
    assert capsys.readouterr().out == "", "--quiet"
    assert blinkflow_sequence(next((tmp_path / "out-blinkflow/training").rglob("config.yaml")).parent)


@pytest.mark.parametrize(
    "layout, lines",
    [
        ("dsec", ["labels: {flow: [forward]}"]),
        ("eraft", ["labels: {flow: [forward]}"]),
        ("blinkflow", ["labels: {flow: [forward]}"]),
        ("mvsec", ["labels: {flow: [forward]}", "labels: {images: true}"]),
        ("tapvid", ["tracks: {points: 256}", "labels: {images: true}"]),
        ("eventkubric", ["labels: {images: true}"]),
    ],
)
def test_what_lacks_is_named_with_the_yaml_that_makes_it(layout, lines, bare, tmp_path, capsys):
    assert run(["export", str(bare), "--layout", layout, "--out", str(tmp_path / "there")]) == 2
    error = capsys.readouterr().err.strip()
    assert "\n" not in error and all(line in error for line in lines), error
    assert list(tmp_path.iterdir()) == [], "nothing is written"


def test_flow_over_another_time_than_the_loaders_windows(data, tmp_path):
    other = generate(
        tmp_path, {**RECIPE, "time": {"duration": 0.06, "label_rate": 30}, "tracks": {"points": 4, "rate": 7}}
    )
    for layout, line in (
        ("eraft", "time: {label_rate: 10}"),
        ("blinkflow", "time: {label_rate: 25}"),
        ("tapvid", "without a rate"),
    ):
        with pytest.raises(AssetError, match=line.replace("{", "\\{")):
            export_layout(other, tmp_path / "there", layout)
    assert not (tmp_path / "there").exists()


def test_multiflow(tmp_path):
    labels = {"flow": [0.01, 0.1, 0.25, 0.305, 0.5], "images": True}
    recipe = {**{k: v for k, v in RECIPE.items() if k not in ("tracks", "imu")}, "labels": labels}
    recipe["timeline"] = {"kind": "uniform", "fps": 30}
    short = generate(tmp_path / "short", {**recipe, "labels": {**labels, "flow": [0.1, 0.2]}})
    line = "a label with 0.4 s before it.*'time: {duration: 1, label_rate: 2}'"
    with pytest.raises(AssetError, match="0.5 s after the label.*'labels: {flow: .0.1, 0.2"):
        export_layout(short, tmp_path / "there", "multiflow")
    data = generate(tmp_path / "data", {**recipe, "time": {"duration": 1, "label_rate": 2, "start": 3}})
    folder = exported(data, tmp_path, "multiflow") / "train"
    assert [f.name for f in folder.iterdir()] == ["sequence_000000_000000"], "the second label has 0.5 s after it"
    events, images, flows = multiflow_sample(folder / "sequence_000000_000000", HEIGHT, WIDTH)
    sequence = data / "train/sequence_000000"
    true = read_events(sequence / "events.h5").window(3_100_000, 4_100_000)
    same([*events[:2], events[2] + 3_100_000, events[3]], true)
    for image, k in zip(images, (0, 1)):
        np.testing.assert_array_equal(image, cv2.imread(str(sequence / f"images/{k:06d}.png")))
    with h5py.File(sequence / "flow/intervals/000000.h5") as file:
        own = dict(zip(file["interval_ns"][()].tolist(), file["flow"][()]))
    assert sorted(flows) == [410_000, 500_000, 650_000, 900_000], "0.305 s is no multiple of 10 ms"
    for t, flow in flows.items():
        np.testing.assert_array_equal(flow, own[(t - 400_000) * 1000])
    slow = generate(tmp_path / "slow", {**recipe, "time": {"duration": 0.8, "label_rate": 2.5, "start": 3}})
    with pytest.raises(AssetError, match=line):
        export_layout(slow, tmp_path / "there", "multiflow")
    assert not (tmp_path / "there").exists()


def test_refusals(data, sequence, tmp_path):
    for arguments, error, said in (
        ((data, tmp_path / "new", "cityscapes"), ConfigError, "webdataset, dsec"),
        ((tmp_path / "none", tmp_path / "new", "dsec"), AssetError, "no such data set"),
        ((tmp_path, tmp_path / "new", "dsec"), AssetError, "no sequences found"),
        ((data, data, "dsec"), OutputError, "output folder exists"),
    ):
        with pytest.raises(error, match=said):
            export_layout(*arguments)
    shutil.copytree(sequence, tmp_path / "cut/train/a")
    (tmp_path / "cut/train/a/flow/forward/000001.png").unlink()
    with pytest.raises(AssetError, match="damaged sequence: flow/forward/000001.png: missing"):
        export_layout(tmp_path / "cut", tmp_path / "new", "dsec")
    shutil.copytree(sequence, tmp_path / "twice/train/a")
    shutil.copytree(sequence, tmp_path / "twice/test/a")
    with pytest.raises(OutputError, match="two sequences would be written to the same place"):
        export_layout(tmp_path / "twice", tmp_path / "new", "eraft")
    assert not (tmp_path / "new").exists()
    assert run(["export", str(data), "--layout", "dsec", "--seed", "3", "--out", str(tmp_path / "new")]) == 2


def test_another_size_is_said_and_one_sequence_is_enough(sequence, tmp_path, capsys):
    assert run(["export", str(sequence), "--layout", "dsec", "--out", str(tmp_path / "a")]) == 0
    said = capsys.readouterr().out
    assert "640x480" in said and "32x24" in said and "1 sequence for DSEC" in said
    assert exporting._size(LAYOUTS["tapvid"], []) == []


STEREO = {
    **{k: v for k, v in RECIPE.items() if k not in ("tracks", "imu", "scene")},
    "time": {"duration": 0.2, "label_rate": 10},
    "labels": {"flow": ["forward"], "depth": True},
}


@pytest.fixture(scope="module")
def stereo(tmp_path_factory):
    """A wall seen by two cameras 0.1 m apart that approach it."""
    pose = lambda time, x: {"time": time, "position": [x, 0.05, 0], "look_at": [x + 1, 0.05, 0]}
    scene = {
        "kind": "explicit",
        "meshes": {"wall": {"primitive": "cuboid", "parameters": {"extents": [1, 20, 20]}}},
        "materials": {"checked": {"procedural": "checks", "uv_scale": [20, 20]}},
        "objects": [{"mesh": "wall", "material": "checked", "position": [2.5, 0, 0]}],
        "camera": {"keyframes": [pose(0, 0), pose(1, 0.5)]},
    }
    return (
        generate(
            tmp_path_factory.mktemp("rig"),
            {**STEREO, "scene": scene, "rig": "stereo", "sensors": [{"name": "unit", "imu": {"rate": 200}}]},
        )
        / "train/sequence_000000"
    )


def test_only_eyes_that_look_the_same_way_side_by_side_have_a_baseline():
    def eye(*pose):
        T = np.eye(4)
        T[:3, 3], T[:3, :3] = pose[:3], Rotation.from_rotvec(pose[3:]).as_matrix()
        return SimpleNamespace(camera=SimpleNamespace(K=np.eye(3)), poses={"T_world_cam": T[None]})

    straight = eye(0, 0, 0, 0, 0, 0)
    assert dsec._baseline(straight, eye(0.2, 0, 0, 0, 0, 0)) == pytest.approx(0.2)
    for other in ((0.2, 0.1, 0, 0, 0, 0), (-0.2, 0, 0, 0, 0, 0), (0.2, 0, 0, 0, 0.05, 0), (0.2, 0, 0, 0.05, 0, 0)):
        assert dsec._baseline(straight, eye(*other)) is None, other


def test_a_stereo_rig_has_a_right_eye_disparity_and_a_calibration(stereo, tmp_path):
    folder = exported(stereo.parents[1], tmp_path, "dsec") / "train/sequence_000000"
    poses = np.load(stereo / "left/poses.npz")
    eyes = {eye: read_events(stereo / eye / "events.h5") for eye in ("left", "right")}
    found = list(dsec_disparity(folder, HEIGHT, WIDTH))
    assert len(found) == 2, "the first of three, which the provider drops, is of no label"
    for k, (disparity, windows) in enumerate(found):
        t = label_times(stereo / "left")[k, 0]
        depth = 2.0 - poses["T_world_cam"][k + 1, 0, 3]  # the wall's face is at x = 2
        assert disparity == pytest.approx(poses["K"][0, 0] * 0.1 / depth, abs=0.5 / 256 + 1e-5)
        for eye, window in windows.items():
            same(window, eyes[eye].window(t - 50_000, t))
    assert list(dsec_sequence(folder, HEIGHT, WIDTH))
    calibration = yaml.safe_load((folder / "calibration/cam_to_cam.yaml").read_text())
    T_30 = np.array(calibration["extrinsics"]["T_30"])  # a point of the left camera, seen from the right
    np.testing.assert_allclose(T_30[:3], np.array([[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0]]), atol=1e-9)
    Q = np.array(calibration["disparity_to_depth"]["cams_03"])
    point = Q @ [10.0, 12.0, disparity[12, 10], 1.0]
    quantum = depth**2 / (poses["K"][0, 0] * 0.1) / 256
    assert point[2] / point[3] == pytest.approx(depth, abs=0.6 * quantum)
    with h5py.File(exported(stereo, tmp_path, "mvsec") / "train/sequence_000000_data.hdf5") as file:
        assert len(file["davis/right/events"]) == len(eyes["right"])
        imu = read_imu(stereo / "unit")
        np.testing.assert_array_equal(file["davis/left/imu"][:, :3], imu["acceleration"])
    assert (folder / "imu/imu.csv").read_bytes() == (stereo / "unit/imu/imu.csv").read_bytes()


LENS = {
    **{k: v for k, v in STEREO.items() if k != "camera"},
    "scene": RECIPE["scene"],
    "camera": {"width": WIDTH, "height": HEIGHT, "fov": 60, "lens": "radtan", "distortion": [-0.2, 0.05, 0, 0]},
}


def test_a_lens_that_distorts_has_its_rectify_map_and_truth_that_is_rectified(tmp_path):
    raw = generate(tmp_path / "raw", LENS)
    with pytest.raises(AssetError, match="labels: {pixels: rectified}"):
        export_layout(raw, tmp_path / "there", "dsec")
    flat = generate(tmp_path / "flat", {**LENS, "labels": {**LENS["labels"], "pixels": "rectified"}})
    folder = exported(flat, tmp_path, "dsec") / "train/sequence_000000"
    table = rectify_map(folder / "events/left/rectify_map.h5", HEIGHT, WIDTH)
    K = np.load(flat / "train/sequence_000000/poses.npz")["K"]
    rays = cv2.undistortPoints(np.array([[[3.0, 4.0]]]), K, np.array(LENS["camera"]["distortion"]), R=np.eye(3), P=K)
    np.testing.assert_allclose(table[4, 3], rays[0, 0], atol=1e-2)
    calibration = yaml.safe_load((folder / "calibration/cam_to_cam.yaml").read_text())
    assert calibration["intrinsics"]["cam0"]["distortion_coeffs"] == pytest.approx([-0.2, 0.05, 0, 0])
    assert list(dsec_sequence(folder, HEIGHT, WIDTH))


def messages(path):
    """Topic -> [(time, message)], by rosbags' own deserialisation."""
    rosbags = pytest.importorskip("rosbags.highlevel", reason="optional extra [formats]")
    found = {}
    with rosbags.AnyReader([path]) as bag:
        for connection, t_ns, data in bag.messages():
            found.setdefault(connection.topic, []).append((t_ns, bag.deserialize(data, connection.msgtype)))
    return found


def test_rosbag_on_the_topics_of_esim(data, sequence, tmp_path):
    """Events, images, depth, flow in px/s, poses and the inertial unit, at their own times."""
    pytest.importorskip("rosbags.rosbag1", reason="optional extra [formats]")
    path = exported(data, tmp_path, "rosbag") / "train/sequence_000000.bag"
    found, events = messages(path), read_events(sequence / "events.h5")
    assert set(found) == {"/imu", "/pose"} | {
        f"/cam0/{name}" for name in ("events", "image_raw", "camera_info", "depthmap", "optic_flow")
    }
    with open_events(path) as file:
        assert (file.height, file.width) == (HEIGHT, WIDTH) and file.notes == []
        same([getattr(file.read(), k) for k in "xytp"], events)
    rows = [e for _, message in found["/cam0/events"] for e in message.events]
    assert [(e.x, e.y, e.ts.sec * 10**6 + e.ts.nanosec // 1000, int(e.polarity)) for e in rows] == list(
        zip(events.x.tolist(), events.y.tolist(), events.t.tolist(), events.p.tolist())
    )
    times, labels = np.loadtxt(sequence / "images/timestamps.txt", dtype="int64"), label_times(sequence)
    for topic, at in (("image_raw", times), ("camera_info", times), ("depthmap", labels[:, 0])):
        assert [t for t, _ in found[f"/cam0/{topic}"]] == (at * 1000).tolist()
    for k, (_, image) in enumerate(found["/cam0/image_raw"]):
        grey = cv2.imread(str(sequence / f"images/{k:06d}.png"), 0)
        assert image.encoding == "mono8" and np.abs(image.data.reshape(HEIGHT, WIDTH).astype(int) - grey).max() <= 1
    for k, (_, depth) in enumerate(found["/cam0/depthmap"]):
        values = depth.data.view("<f4").reshape(HEIGHT, WIDTH)
        np.testing.assert_array_equal(values, np.load(sequence / f"depth/{k:06d}.npy"))
    for k, (t_ns, flow) in enumerate(found["/cam0/optic_flow"]):
        true = np.load(sequence / f"flow/forward_npy/{k:06d}.npy")
        speed = np.where(true[..., 2] > 0, true[..., 0] * 10, np.nan)  # 100 ms
        np.testing.assert_allclose(flow.flow_x.reshape(HEIGHT, WIDTH), speed, rtol=1e-6)
        assert t_ns == labels[k, 0] * 1000
    poses = np.load(sequence / "poses.npz")
    for (t_ns, message), t, T in zip(found["/pose"], poses["t_ns"], poses["T_world_cam"], strict=True):
        q, p = message.pose.orientation, message.pose.position
        np.testing.assert_allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), T[:3, :3], atol=1e-12)
        assert (t_ns, [p.x, p.y, p.z]) == (t, T[:3, 3].tolist())
    K = found["/cam0/camera_info"][0][1].K
    np.testing.assert_array_equal(K.reshape(3, 3), poses["K"])
    imu = read_imu(sequence)
    np.testing.assert_array_equal([m.linear_acceleration.x for _, m in found["/imu"]], imu["acceleration"][:, 0])


def test_rosbag_of_a_stereo_rig_and_of_bare_events(stereo, bare, tmp_path):
    pytest.importorskip("rosbags.rosbag1", reason="optional extra [formats]")
    path = exported(stereo.parents[1], tmp_path, "rosbag") / "train/sequence_000000.bag"
    with pytest.raises(AssetError, match=r"2 topics of events, and none is chosen; expected one of --stream 0"):
        open_events(path)
    with open_events(path, EventReading(stream="/cam0/events")) as file:
        assert file.notes == []
        same([getattr(file.read(), k) for k in "xytp"], read_events(stereo / "left/events.h5"))
    assert export_layout(bare, tmp_path / "bare", "rosbag").said == ()


def test_rosbag_of_depth_alone_has_its_labels_times(data, sequence, tmp_path):
    """Without pictures and flow the times are those of backward flow, else of the poses."""
    pytest.importorskip("rosbags.rosbag1", reason="optional extra [formats]")
    source, labels = Source.open(sequence), label_times(sequence)[:, 0] * 1000
    for gone in (("images", "flow/forward"), ("images", "flow")):
        files = {name: about for name, about in source.manifest["files"].items() if not name.startswith(gone)}
        LAYOUTS["rosbag"].write(replace(source, manifest={**source.manifest, "files": files}), tmp_path)
        topics = messages(tmp_path / "sequence_000000.bag")
        (tmp_path / "sequence_000000.bag").unlink()
        assert [t for t, _ in topics["/cam0/depthmap"]] == labels.tolist()
        assert [t for t, _ in topics["/cam0/camera_info"]][: len(labels)] == labels.tolist()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_plan_lacks_what_its_sequence_lacks(data, bare, layout):
    for made in (data, bare):
        recipe = load_run(made / ".run/recipe.yaml")
        source = sources_of(made)[0]
        planned = Planned.of(recipe.sequence(0), made)
        assert LAYOUTS[layout].missing(planned) == LAYOUTS[layout].missing(source)


def test_a_layout_that_a_recipe_cannot_give_is_refused_before_it_is_generated(tmp_path, capsys):
    path = tmp_path / "recipe.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in RECIPE.items() if key != "tracks"}))
    assert run(["generate", str(path), "--out", str(tmp_path / "out"), "--layout", "tapvid", "--quiet"]) == 2
    assert "layout 'tapvid' takes point tracks" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
