"""One YAML in, a DSEC-layout sequence out: read back by independent readers, reproducible, whole or not at all."""

import hashlib
import json
from pathlib import Path

import cv2
import h5py
import hdf5plugin  # noqa: F401  (registers the Blosc filter for h5py)
import numba
import numpy as np
import pytest
import yaml
from shared_data import shared

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset import generate as generate_module
from blinkgl.dataset.generate import generate_run
from blinkgl.dataset.verify import verify_dataset
from blinkgl.io.dsec import DsecEventReader
from blinkgl.render.passes import Luminance
from blinkgl.sequence_files.sequence_dir import verify_sequence

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


def test_images_labels_and_poses_fit_together(sequence):
    stamps = [int(x) for x in (sequence / "images/timestamps.txt").read_text().split()]
    assert stamps == [3_050_000 + 50_000 * k for k in range(5)]
    poses = np.load(sequence / "poses.npz", allow_pickle=False)
    assert list(poses["t_ns"] // 1000) == [3_000_000, *stamps]
    for k in range(4):
        image = cv2.imread(str(sequence / f"images/{k:06d}.png"))
        assert image.shape == (48, 64, 3) and 5 < image.mean() < 250
        depth, ids = (
            np.load(sequence / f"depth/{k:06d}.npy"),
            cv2.imread(str(sequence / f"ids/{k:06d}.png"), cv2.IMREAD_UNCHANGED),
        )
        assert np.isfinite(depth[ids > 0]).all() and set(np.unique(ids)) <= {0, *poses["object_ids"]}


def test_flow_follows_from_depth_ids_and_poses(sequence):
    """The flow is recomputed in float64 from the other files: lift each pixel by its depth, move it with its object,
    project it into the next camera."""
    poses = np.load(sequence / "poses.npz", allow_pickle=False)
    K = poses["K"]
    index = {int(i): n for n, i in enumerate(poses["object_ids"])}
    y, x = np.mgrid[0:48, 0:64].astype(np.float64)
    for k in range(4):
        depth, ids = (
            np.load(sequence / f"depth/{k:06d}.npy"),
            cv2.imread(str(sequence / f"ids/{k:06d}.png"), cv2.IMREAD_UNCHANGED),
        )
        flow = np.load(sequence / f"flow/forward_npy/{k:06d}.npy")
        now, then = k + 1, k + 2
        errors = []
        for i in np.unique(ids[ids > 0]):
            at = (ids == i) & (flow[..., 2] > 0)
            rays = np.stack([(x[at] - K[0, 2]) / K[0, 0], (y[at] - K[1, 2]) / K[1, 1], np.ones(at.sum())])
            local = (
                np.linalg.inv(poses["T_world_obj"][index[i], now])
                @ poses["T_world_cam"][now]
                @ np.vstack([rays * depth[at], np.ones(at.sum())])
            )
            moved = np.linalg.inv(poses["T_world_cam"][then]) @ poses["T_world_obj"][index[i], then] @ local
            pixel = K @ (moved[:3] / moved[2])
            errors.append(np.hypot(pixel[0] - x[at] - flow[at, 0], pixel[1] - y[at] - flow[at, 1]))
        errors = np.concatenate(errors)
        assert np.median(errors) < 1e-4 and errors.max() < 1e-2


def test_the_poses_begin_with_the_first_frame(tmp_path):
    """A camera that moves 1 m/s along x on straight lines: its position is the clock, to the nanosecond."""
    scene = {
        "kind": "explicit",
        "meshes": {"box": {"primitive": "cuboid"}},
        "objects": [{"mesh": "box", "position": [3, 0, 0]}],
        "camera": {"interpolation": "linear", "keyframes": [{"time": t, "position": [t, 0, 0]} for t in (0, 10)]},
    }
    folder = generate(tmp_path, scene=scene, time={"duration": 0.2, "label_rate": 30, "start": 3.0000005})[0]
    poses = np.load(folder / "poses.npz", allow_pickle=False)
    start, interval = 3_000_000_500, 33_333_333
    assert poses["t_ns"].tolist() == [start + k * interval for k in range(8)]
    np.testing.assert_allclose(poses["T_world_cam"][:, 0, 3], poses["t_ns"] * 1e-9, rtol=0, atol=1e-12)


def test_a_clock_between_microseconds(tmp_path):
    """Start and labels that no µs count holds: labels, duration and events still agree."""
    for start in (7e-7, 3.0000009):
        folder = generate(tmp_path, out=f"{start}", time={"duration": 0.1, "label_rate": 30, "start": start})[0]
        manifest = json.loads((folder / "manifest.json").read_text())
        last = int((folder / "images/timestamps.txt").read_text().split()[-1])
        assert manifest["t_offset_us"] + manifest["duration_us"] == last
        assert verify_dataset(folder).clean


def test_events_that_leave_the_bus_late_are_no_part_of_the_recording(tmp_path):
    """With a sensor's read-out, too, windows are a partition of the recording, and nothing made is unaccounted for."""
    free = json.loads((generate(tmp_path, out="free")[0] / "manifest.json").read_text())
    folder = generate(tmp_path, out="slow", readout={"events_per_second": 4000, "queue_events": 40})[0]
    slow = json.loads((folder / "manifest.json").read_text())
    assert verify_dataset(folder).clean
    assert slow["events_late_in_readout"] > 0 and slow["events_lost_in_readout"] > 0
    assert slow["events"] + slow["events_late_in_readout"] + slow["events_lost_in_readout"] == free["events"]
    with DsecEventReader(folder / "events.h5") as reader:
        windows = [reader.slice(a, a + 50_000) for a in range(3_000_000, 3_250_000, 50_000)]
        assert sum(map(len, windows)) + int((next(reader.chunks()).t == 3_250_000).sum()) == slow["events"]


def test_manifest_is_complete(sequence):
    assert verify_sequence(sequence) == []
    manifest = json.loads((sequence / "manifest.json").read_text())
    assert manifest["seed"] == 4 and manifest["opengl"]["renderer"] and manifest["versions"]["numba"]
    with h5py.File(sequence / "events.h5") as file:
        assert manifest["events"] == len(file["events/t"])


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


def test_resolved_configuration_reproduces_the_sequence(tmp_path):
    second = generate(tmp_path, num=2, events={"emulator": "esim", "contrast_threshold": {"uniform": [0.1, 0.5]}})[1]
    again = list(generate_run(load_run(second / "config.yaml"), tmp_path / "again"))[0].path
    assert again.name == second.name
    assert digests(again)["events.h5"] == digests(second)["events.h5"]


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


@pytest.mark.parametrize(
    "option, message",
    [
        ("camera.widht=3", "camera.widht: unknown key; expected 'width' (nearest)"),
        ("scene.pool.folders=[nowhere]", "scene.pool.folders.0: "),
        ("scene.pool={primitives: []}", "scene.pool: "),
        ("gl={backend: egl, device: 99}", "gl"),
        ("events.emulator=blender", "events.emulator: unknown choice"),
    ],
)
def test_bad_input_is_one_line_and_status_2(tmp_path, capsys, option, message):
    out = tmp_path / "out"
    assert run(["generate", str(config_file(tmp_path)), "--out", str(out), "--set", option]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and "Traceback" not in error
    assert not out.exists() or not any(p.is_file() for p in out.rglob("*"))


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("meshes/a.obj", b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "NaN"),
        ("meshes/a.obj", b"v 0 0 0\nv 1 0 0\n", "no faces"),
        ("meshes/a.stl", bytes(80) + (10**9).to_bytes(4, "little") + bytes(50), "too many faces (got 1000000000)"),
        ("images/a.jpg", b"\xff\xd8\xff\xe0 not an image", "corrupt"),
    ],
)
def test_bad_assets_are_one_line_and_status_2_and_leave_nothing(tmp_path, capsys, name, content, message):
    """And a mended configuration may go to the same folder afterwards."""
    path = tmp_path / name
    path.parent.mkdir()
    path.write_bytes(content)
    key = (
        "scene.pool={primitives: [], folders: [%s]}"
        if name.startswith("meshes")
        else "scene.textures={procedural: false, photographs: false, folders: [%s]}"
    )
    out, config = tmp_path / "out", str(config_file(tmp_path))
    for count in ("1", "2"):
        assert (
            run(["generate", config, "--out", str(out), "--num", count, "--set", key % json.dumps(str(path.parent))])
            == 2
        )
        error = capsys.readouterr().err
        assert error.startswith(f"error: {path}") and message in error and error.count("\n") == 1
        assert not out.exists()
    assert run(["generate", config, "--out", str(out), "--quiet"]) == 0


def test_output_that_is_a_file(tmp_path, capsys):
    (tmp_path / "out").write_text("")
    assert run(["generate", str(config_file(tmp_path)), "--out", str(tmp_path / "out")]) == 2
    assert "is a file" in capsys.readouterr().err


# ---- real input, long input --------------------------------------------------------------------------------------


def test_flying_objects_from_real_meshes_and_photographs(tmp_path):
    meshes, textures = shared("data/assets/models_cc0"), shared("data/assets/textures_cc0")
    shipped = Path(__file__).parents[2] / "configs/flying_objects.yaml"
    template = load_run(
        shipped,
        [
            f"scene.pool.folders=[{json.dumps(str(meshes))}]",
            f"scene.textures.folders=[{json.dumps(str(textures))}]",
            "scene.pool.primitives=[]",
            "scene.textures.procedural=false",
            "camera.width=160",
            "camera.height=120",
            "time.duration=0.2",
            "preview.enabled=false",
            "timeline={kind: uniform, fps: 100}",
        ],
    )
    folder = list(generate_run(template, tmp_path / "out"))[0].path
    assert verify_sequence(folder) == []
    names = [
        o["name"] for o in json.loads((folder / "manifest.json").read_text())["objects"] if o["category"] == "object"
    ]
    assert len(names) >= 8
    with h5py.File(folder / "events.h5") as file:
        assert len(dsec_slice(file, 100_000, 300_000)["t"]) > 1000
