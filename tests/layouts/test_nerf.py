"""`blinkgl export --layout nerf`: known corners of a scene, projected through what was written by readers that share no
code with the layout, must lie where a hand-made formula of the camera's way puts them.

The readers follow instant-ngp's nerf_loader.cu, COLMAP's "Output Format" page, LLFF's load_llff.py and EventNeRF's
data_loader_split.py: all have (0.5, 0.5) as the centre of the top-left pixel."""

import itertools
import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.cli import run
from blinkgl.errors import AssetError
from blinkgl.layouts import export_layout
from test_layouts import RECIPE, generate

WIDTH, HEIGHT, FOCAL, START, SPEED = 64, 48, 60.0, 7.0, 0.5
CORNERS = np.array([*itertools.product((-0.5, 0.5), repeat=3)])
LENS = (-0.1, 0.02, 0.001, -0.002, 0.003)
WAY = [{"time": START + t, "position": [-4, SPEED * t, 0.1], "look_at": [1, SPEED * t, 0.1]} for t in (0, 1)]
BASE = {
    **{k: v for k, v in RECIPE.items() if k not in ("tracks", "imu", "scene", "labels")},
    "camera": {"width": WIDTH, "height": HEIGHT, "focal": FOCAL},
    "time": {"duration": 0.4, "label_rate": 10, "start": START},
    "scene": {
        "kind": "explicit",
        "meshes": {"box": {"primitive": "cuboid"}},
        "materials": {"checked": {"procedural": "checks"}},
        "objects": [{"mesh": "box", "material": "checked"}],
        "camera": {"keyframes": WAY, "interpolation": "linear"},
    },
}
CAMERA = {"rate": 25, "exposure_us": 20_000, "row_us": 100, "also": ["sharp"]}
RECIPES = {
    "labels": {**BASE, "labels": {"flow": [], "images": True, "depth": True}},
    "frame_camera": {**BASE, "labels": {"flow": []}, "images": CAMERA},
    "lens": {
        **BASE,
        "labels": {"flow": [], "images": True},
        "camera": {**BASE["camera"], "lens": "radtan", "distortion": list(LENS)},
    },
}


@pytest.fixture(scope="module", params=RECIPES)
def made(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    data = generate(folder, RECIPES[request.param])
    notes = export_layout(data, folder / "nerf", "nerf").said
    return request.param, data / "train/sequence_000000", folder / "nerf/train/sequence_000000", notes


def true_px(t_s, lens=()):
    """The corners' places, (8, 2) px with (0.5, 0.5) as the first pixel's centre: the camera looks along x, so that its
    right is -y and its down is -z; it is at y = SPEED t, t from the sequence's start on."""
    x, y, z = CORNERS.T
    seen = np.stack([-(y - SPEED * t_s), -(z - 0.1), x + 4.0], axis=1)
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return cv2.projectPoints(seen, np.zeros(3), np.zeros(3), K, np.array(lens or (0.0,) * 5))[0][:, 0]


def projected(world_cam, K, lens=()):
    """The corners through a camera with OpenCV axes, of a world-to-camera matrix."""
    turn = Rotation.from_matrix(world_cam[:3, :3]).as_rotvec()
    return cv2.projectPoints(CORNERS, turn, world_cam[:3, 3], K, np.array([*lens, *[0.0] * (5 - len(lens))]))[0][:, 0]


def from_transforms(table, frame, key="transform_matrix"):
    c2w = np.array(frame[key]) @ np.diag([1, -1, -1, 1])  # OpenGL: y up, z back
    K = np.array([[table["fl_x"], 0, table["cx"]], [0, table["fl_y"], table["cy"]], [0, 0, 1]])
    return projected(np.linalg.inv(c2w), K, [table.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")])


def from_colmap(folder):
    """Yield name and pixels of each image."""
    (camera,) = (line.split() for line in (folder / "cameras.txt").read_text().splitlines() if line[:1] != "#")
    values = [float(word) for word in camera[4:]]
    assert camera[1] in ("PINHOLE", "FULL_OPENCV") and camera[2:4] == [str(WIDTH), str(HEIGHT)]
    K = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1]])
    lines = (folder / "images.txt").read_text().split("\n")
    for line in lines[::2]:  # the lines between list points
        if line:
            _, qw, qx, qy, qz, *place, _, name = line.split()
            turn = Rotation.from_quat([float(q) for q in (qx, qy, qz, qw)]).as_matrix()
            world_cam = np.vstack([np.column_stack([turn, [float(p) for p in place]]), [0, 0, 0, 1]])
            yield name, projected(world_cam, K, values[4:9])


def times_of(case, sequence):
    """Seconds since the start of the sequence: start, middle and end of the exposure of each frame."""
    if case != "frame_camera":
        return np.repeat(0.1 * np.arange(1, 6)[:, None], 3, axis=1)  # labels begin an interval after the start
    whole = 1e-6 * (CAMERA["exposure_us"] + (HEIGHT - 1) * CAMERA["row_us"])
    return np.arange(12)[:, None] / CAMERA["rate"] + np.array([0, whole / 2, whole])


def test_corners_are_where_they_were(made):
    case, sequence, folder, _ = made
    lens = LENS if case == "lens" else ()
    t = times_of(case, sequence)
    true = [true_px(t_s, lens) for t_s in t[:, 1]]
    table = json.loads((folder / "transforms.json").read_text())
    assert [frame["file_path"] for frame in table["frames"]] == [f"images/{k:06d}.png" for k in range(len(t))]
    for k, frame in enumerate(table["frames"]):
        assert np.abs(from_transforms(table, frame) - true[k]).max() < 0.01
        assert frame["t_us"] == pytest.approx(1e6 * (START + t[k, 1]), abs=1)
        if case == "frame_camera":
            for key, t_s in (("transform_matrix_start", t[k, 0]), ("transform_matrix_end", t[k, 2])):
                assert np.abs(from_transforms(table, frame, key) - true_px(t_s)).max() < 0.01
    assert (table["frames"][0]["time"], table["frames"][-1]["time"]) == (0, 1)
    for (name, px), expected in zip(from_colmap(folder / "sparse/0"), true, strict=True):
        assert (folder / "images" / name).is_file() and np.abs(px - expected).max() < 0.01


def test_llff(made):
    case, sequence, folder, notes = made
    if case == "lens":
        assert any("no lens" in line for line in notes)
        return
    rows = np.load(folder / "poses_bounds.npy")
    poses, bounds = rows[:, :-2].reshape(-1, 3, 5), rows[:, -2:]
    for pose, (_, t_s, _) in zip(poses, times_of(case, sequence), strict=True):
        down, right, back, place, (height, width, focal) = pose.T
        c2w = np.eye(4)
        c2w[:3] = np.stack([right, down, -back, place], axis=1)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        assert np.abs(projected(np.linalg.inv(c2w), K) - true_px(t_s)).max() < 0.01
    # Of depth labels what is seen, the front face; of the box its back, too.
    assert bounds == pytest.approx(np.broadcast_to([3.5, 3.5 if case == "labels" else 4.5], bounds.shape), abs=1e-3)


def test_eventnerf(made):
    case, sequence, folder, notes = made
    for split in ("train", "validation"):
        place = folder / "eventnerf" / split
        poses, intrinsics, images = (sorted((place / name).iterdir()) for name in ("pose", "intrinsics", "rgb"))
        t = times_of(case, sequence)
        assert len(poses) == len(intrinsics) == len(images) == len(t)
        for pose, inner, (_, t_s, _) in zip(poses, intrinsics, t):
            c2w = np.array(pose.read_text().split(), float).reshape(4, 4)
            K = np.array(inner.read_text().split(), float).reshape(5, 4)
            if case != "lens":
                assert np.abs(projected(np.linalg.inv(c2w), K[:3, :3]) - true_px(t_s)).max() < 0.01
            assert K[4].tolist() == ([*LENS[:2], 0, 0] if case == "lens" else [0] * 4)
        (file,) = (place / "events").iterdir()
        events, whole = np.load(file), np.load(folder / "events.npz")
        first, last = (round(1e6 * (START + at)) for at in (t[0, 1], t[-1, 1]))
        inside = (whole["t"] >= first) & (whole["t"] <= last)
        assert inside.sum() > 100 and set(np.unique(events["p"])) == {-1, 1}
        np.testing.assert_array_equal(events["t"], whole["t"][inside] - first)
        np.testing.assert_array_equal(events["x"], whole["x"][inside])
    assert any("k1 and k2" in line for line in notes) == (case == "lens")


def test_splits_share_no_frame_and_are_without_blur_where_they_can(made):
    case, _, folder, _ = made
    whole = json.loads((folder / "transforms.json").read_text())
    names = [whole[f"{split}_filenames"] for split in ("train", "val", "test")]
    assert sorted(itertools.chain(*names)) == [frame["file_path"] for frame in whole["frames"]]
    for split, listed in zip(("train", "val", "test"), names):
        frames = json.loads((folder / f"transforms_{split}.json").read_text())["frames"]
        shown = "sharp" if case == "frame_camera" and split != "train" else "images"
        assert [frame["file_path"] for frame in frames] == [name.replace("images", shown) for name in listed]
        assert all((folder / frame["file_path"]).is_file() for frame in frames)


def test_what_is_missing_is_named_and_nothing_is_written(tmp_path, capsys):
    bare = generate(tmp_path / "bare", {**BASE, "labels": {"flow": [], "images": False}})
    assert run(["export", str(bare), "--layout", "nerf", "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err == (
        f"error: {bare}/train/sequence_000000: layout 'nerf' takes two or more frames, which this sequence does not "
        "have; expected a data set made with 'labels: {images: true}'\n"
    )
    data = generate(tmp_path / "data", RECIPES["lens"])
    manifest = data / "train/sequence_000000/manifest.json"
    manifest.write_text(json.dumps({**json.loads(manifest.read_text()), "objects": []}))
    with pytest.raises(AssetError, match=r"takes depth, or boxes of bodies .* 'labels: \{depth: true\}'"):
        export_layout(data, tmp_path / "out", "nerf")
    assert not (tmp_path / "out").exists()


def test_bounds_where_depth_labels_show_nothing(tmp_path):
    """Those of the box of the only body, 3.5 to 4.5 in front of the camera; without it, a line."""
    sequence = generate(tmp_path / "data", RECIPES["labels"]) / "train/sequence_000000"
    for path in (sequence / "depth").glob("*.npy"):
        np.save(path, np.full_like(np.load(path), np.inf))
    export_layout(sequence, tmp_path / "out", "nerf")
    bounds = np.load(tmp_path / "out/train/sequence_000000/poses_bounds.npy")[:, 15:]
    np.testing.assert_allclose(bounds, np.tile([3.5, 4.5], (len(bounds), 1)), atol=1e-9)
    manifest = sequence / "manifest.json"
    manifest.write_text(json.dumps({**json.loads(manifest.read_text()), "objects": []}))
    with pytest.raises(AssetError, match=r"takes something in view, for near and far, .* 'scene: "):
        export_layout(sequence, tmp_path / "none", "nerf")


def test_rectified_frames_have_the_camera_without_its_lens_and_events_that_are_said(tmp_path):
    recipe = {**RECIPES["lens"], "labels": {**RECIPES["lens"]["labels"], "pixels": "rectified"}}
    notes = export_layout(generate(tmp_path / "data", recipe), tmp_path / "out", "nerf").said
    assert any("its frames are rectified, its events in the sensor's pixels" in line for line in notes)
    for k, (_, pixels) in enumerate(from_colmap(tmp_path / "out/train/sequence_000000/sparse/0"), 1):
        np.testing.assert_allclose(pixels, true_px(0.1 * k), atol=1e-6)
