"""One YAML in, a DSEC-layout sequence out: read back by independent readers, reproducible, whole or not at all."""

import hashlib
from pathlib import Path

import cv2
import h5py
import hdf5plugin  # noqa: F401  (registers the Blosc filter for h5py)
import numba
import numpy as np
import pytest
import yaml

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset import generate as generate_module
from blinkgl.dataset.generate import generate_run
from blinkgl.render.passes import Luminance

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
