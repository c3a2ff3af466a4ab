"""Flow from a label's time to any others: equal to labels of their own; written, verified, explained, read, refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from blinkgl import Renderer, load, record
from blinkgl.cli import run
from blinkgl.config.reader import to_yaml
from blinkgl.config.run import load_run
from blinkgl.dataset.explain import explain
from blinkgl.dataset.shards import sample
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import AssetError, ConfigError
from blinkgl.io.boxes import read_boxes
from blinkgl.io.flow import read_flow
from blinkgl.io.images import read_ids
from blinkgl.io.intervals import read_intervals
from blinkgl.labels import LABELS, Flows, LabelRequest
from blinkgl.report.collect import collect
from runs import generated

MS = 1_000_000
RUN = {
    "seed": 3,
    "camera": {"width": 48, "height": 36, "fov": 60},
    "time": {"duration": 0.2, "label_rate": 20},
    "timeline": {"kind": "uniform", "fps": 40},
    "scene": {
        "objects": {"count": 3, "distance": [2, 4]},
        "pool": {"primitives": ["cuboid", "flag"], "variants": 4},
        "textures": {"procedural": ["checks"], "variants": 4, "photographs": False, "max_size": 32},
    },
    "labels": {"flow": ["forward", 0.05, -0.02, "1/100", 0.1], "float_flow": ["npy"]},
    "images": {"rate": 40, "exposure_us": 500, "max_instants": 1},
    "preview": {"enabled": False},
}
ASKED = [-20 * MS, 10 * MS, 50 * MS, 100 * MS]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return generated(tmp_path_factory.mktemp("intervals"), RUN)


def folder_of(made: Path) -> Path:
    return next((made / "out").rglob("manifest.json")).parent


def test_continuous_flow_is_as_many_labels_of_their_own(made):
    """Bit for bit, whatever kind of body; times outside the sequence are left out. The interval between two labels
    gives the forward label."""
    folder, both = folder_of(made), LabelRequest("flow_forward", "occlusion_forward")
    with Renderer(load(made / "run.yaml")) as renderer:
        draw = renderer._renderer  # at times in ns
        for k, t in enumerate((50, 100, 150, 200)):
            from_us, there, flows = read_intervals(folder / f"flow/intervals/{k:06d}.h5", ("flow", "valid"))
            _, same, hidden = read_intervals(folder / f"occlusion/intervals/{k:06d}.h5", ("occluded",))
            assert from_us == 1000 * t and there.tolist() == same.tolist() == (ASKED if k < 3 else ASKED[:3])
            for row, interval in enumerate(there):
                own = draw.labels(t * MS, both, t * MS + int(interval)).forward
                assert np.array_equal(flows["flow"][row], own.flow) and np.array_equal(flows["valid"][row], own.valid)
                assert np.array_equal(hidden["occluded"][row], own.occluded)
            flow, valid = read_flow(folder / f"flow/forward_npy/{k:06d}.npy")
            assert np.array_equal(flows["flow"][2], flow) and np.array_equal(flows["valid"][2], valid)
            assert np.abs(flows["flow"]).max() > 1 and flows["valid"].any()
    assert (folder / "flow/intervals_timestamps.txt").read_text().split() == ["50000", "100000", "150000", "200000"]
    with h5py.File(folder / "flow/intervals/000001.h5") as file:
        assert file["to_us"][()].tolist() == [80_000, 110_000, 150_000, 200_000]


def test_damaged_files_are_one_line(made, tmp_path):
    assert verify_dataset(made / "out", deep=1).problems == {}
    folder = tmp_path / "s"
    shutil.copytree(folder_of(made), folder)
    row, file = LABELS["flow_intervals"], folder / "flow/intervals/000000.h5"
    value = row.forms[0].read(file)
    for changes, said in (
        ({"interval_ns": value.interval_ns[::-1]}, "the intervals do not increase"),
        ({"valid": value.valid[1:]}, "arrays of different sizes"),
    ):
        file.write_bytes(row.forms[0].encode(Flows(**{**vars(value), **changes})))
        with pytest.raises(AssetError, match=said):
            row.forms[0].read(file)
    file.write_bytes(b"HDF")
    with pytest.raises(AssetError, match="not an HDF5 file"):
        row.forms[0].read(file)


def test_explain_python_and_shards(made):
    said = explain(load_run(made / "run.yaml"))
    [line] = [p.why for p in said.passes if p.name == "labels"]
    assert "flow over -0.02, 0.01, 0.05, 0.1 s: all of them inside the sequence for 3 of 4 labels" in line
    names = [name for name, _ in sample(folder_of(made), 0)]
    assert any(name.endswith(".flow_intervals.h5") for name in names)
    with Renderer(load(made / "run.yaml")) as renderer:
        frame = renderer.frame(0.1, labels=["forward", 0.02, -0.01, "occlusion"], to=0.12)
        assert np.array_equal(frame.flow_intervals.over(0.02).flow, frame.forward.flow)
        assert np.array_equal(frame.occlusion_intervals.occluded[1], frame.forward.occluded)
        with pytest.raises(KeyError, match="no flow over 0.5 s; there is flow over -0.01, 0.02 s"):
            frame.flow_intervals.over(0.5)
        with pytest.raises(ConfigError, match="not a direction or an interval"):
            renderer.frame(0.1, labels=[0.0])
    labels = record(load(made / "run.yaml"), labels=[0.1]).labels
    assert [len(one.flow_intervals.interval_ns) for one in labels] == [1, 1, 1, 0]
    assert labels[3].flow_intervals.flow.shape == (0, 36, 48, 2) and labels[0].forward is None


@pytest.mark.parametrize(
    "flow, said",
    [
        ([0.0], "labels.flow.0: not a direction or an interval (got 0.0); expected forward, backward, or an interval"),
        (["forward", "1/0"], "labels.flow.1: not a direction or an interval (got '1/0')"),
        (["1/"], "labels.flow.0: not a direction or an interval (got '1/')"),
        (["1e999999999"], "labels.flow.0: not a direction or an interval (got '1e999999999')"),
        (["fowards"], "labels.flow.0: not a direction or an interval (got 'fowards')"),
        ([True], "labels.flow.0: not a direction or an interval (got True)"),
        ([float("nan")], "labels.flow.0: not a direction or an interval (got nan)"),
        ([1e9], "labels.flow.0: not a direction or an interval (got 1000000000.0)"),
        ([0.01, "1/100"], "labels.flow: an interval is given twice (got 0.01); expected each once"),
        ([0.25], "labels.flow: the interval is too long: the flow would end outside the sequence (got 0.25); expected"),
        ([-0.21], "expected intervals of at most 0.2 s, or a longer time.duration"),
    ],
)
def test_intervals_that_cannot_be_are_refused(flow, said, tmp_path):
    (tmp_path / "a.yaml").write_text(to_yaml({**RUN, "labels": {"flow": flow}}), encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        load_run(tmp_path / "a.yaml")
    assert said in str(error.value)


# --- Boxes, categories, tracks and an inertial unit in whole data sets: written, verified, shown by the report.

RUN_SHOWN_LABELS = {
    "seed": 5,
    "camera": {"width": 64, "height": 48, "fov": 60},
    "time": {"duration": 0.05, "label_rate": 40},
    "timeline": {"kind": "uniform", "fps": 80},
    "scene": {
        "objects": {"count": 3, "distance": [2, 4]},
        "pool": {"primitives": ["cuboid", "flag"], "variants": 4},
        "textures": {"procedural": ["checks"], "variants": 4, "photographs": False, "max_size": 32},
    },
    "labels": {"boxes": True, "semantics": {"ground": 2, "*": 1}, "scene_flow": True, "ids": True},
    "tracks": {"points": 20, "choose": "surface", "rate": 200},
    "imu": {"rate": 200},
    "preview": {"rate": 40},
}


@pytest.fixture(scope="module")
def made_of_shown_labels(tmp_path_factory) -> Path:
    return generated(tmp_path_factory.mktemp("shown"), RUN_SHOWN_LABELS)


def test_written_and_verified(made_of_shown_labels):
    assert verify_dataset(made_of_shown_labels / "out", deep=1).problems == {}
    folder = folder_of(made_of_shown_labels)
    boxes, ids = read_boxes(folder / "boxes/000001.npz"), read_ids(folder / "ids/000001.png")
    assert boxes.visible_pixels.sum() == np.count_nonzero(ids) and set(boxes.category.tolist()) == {1, 2}
    semantics = read_ids(folder / "semantics/000001.png")
    ground = int(boxes.instance[boxes.kind == "ground"][0])
    assert (semantics[ids == ground] == 2).all() and (semantics[(ids > 0) & (ids != ground)] == 1).all()
    poses = np.load(folder / "poses.npz")  # of the start and every label
    row = int(np.flatnonzero(poses["object_ids"] == boxes.instance[-1])[0])
    np.testing.assert_allclose(boxes.T_world_box[-1, :3, :3], poses["T_world_obj"][row, 2, :3, :3], atol=1e-12)
    told = json.loads((folder / "manifest.json").read_text())["categories"]
    assert told["patterns"] == {"ground": 2, "*": 1} and told["objects"]["ground"] == 2
    stamps = [line.split(",") for line in (folder / "scene_flow/timestamps.txt").read_text().splitlines()[1:]]
    assert [[int(a), int(b)] for a, b in stamps] == [[25_000, 50_000], [50_000, 75_000]]
    endings = {name.partition(".")[2] for name, _ in sample(folder, 0)}
    assert {"boxes.npz", "boxes.txt", "semantics.png", "scene_flow.npy"} <= endings


def test_report_shows_them(made_of_shown_labels):
    pictures = dict(collect(made_of_shown_labels / "out").examples[0].pictures)
    assert {"boxes", "semantics", "scene flow", "point tracks, 20"} <= set(pictures)
    assert (pictures["boxes"] != pictures["point tracks, 20"]).any()


def test_a_table_that_fits_nothing_is_refused(made_of_shown_labels, tmp_path, capsys):
    tree = {**RUN_SHOWN_LABELS, "labels": {"semantics": {"car*": 1, "bus": 2}}}
    (tmp_path / "a.yaml").write_text(to_yaml(tree), encoding="utf-8")
    assert run(["generate", str(tmp_path / "a.yaml"), "--out", str(tmp_path / "out")]) != 0
    said = " ".join(capsys.readouterr().err.split())
    assert "labels.semantics: no object's name matches a pattern (got ['car*', 'bus']); expected" in said
    assert "cuboid" in said and "Traceback" not in said and not list((tmp_path / "out").rglob("manifest.json"))
    with Renderer(load(tmp_path / "a.yaml")) as renderer:
        assert renderer.frame(0.05, labels=["semantics"]).semantics.max() > 1  # by kinds of shape
