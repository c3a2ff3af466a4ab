"""Flow from a label's time to any others: equal to labels of their own; written, verified, explained, read, refused."""

from __future__ import annotations

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
from blinkgl.io.flow import read_flow
from blinkgl.io.intervals import read_intervals
from blinkgl.labels import LABELS, Flows, LabelRequest

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
    folder = tmp_path_factory.mktemp("intervals")
    (folder / "run.yaml").write_text(to_yaml(RUN), encoding="utf-8")
    assert run(["generate", str(folder / "run.yaml"), "--out", str(folder / "out")]) == 0
    return folder


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
        ({"interval_ns": value.interval_ns[::-1]}, "not intervals that increase"),
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
        with pytest.raises(ConfigError, match="no direction, and no interval"):
            renderer.frame(0.1, labels=[0.0])
    labels = record(load(made / "run.yaml"), labels=[0.1]).labels
    assert [len(one.flow_intervals.interval_ns) for one in labels] == [1, 1, 1, 0]
    assert labels[3].flow_intervals.flow.shape == (0, 36, 48, 2) and labels[0].forward is None


@pytest.mark.parametrize(
    "flow, said",
    [
        ([0.0], "labels.flow.0: no direction, and no interval (got 0.0); expected forward, backward, or an interval"),
        (["forward", "1/0"], "labels.flow.1: no direction, and no interval (got '1/0')"),
        (["1/"], "labels.flow.0: no direction, and no interval (got '1/')"),
        (["1e999999999"], "labels.flow.0: no direction, and no interval (got '1e999999999')"),
        (["fowards"], "labels.flow.0: no direction, and no interval (got 'fowards')"),
        ([True], "labels.flow.0: no direction, and no interval (got True)"),
        ([float("nan")], "labels.flow.0: no direction, and no interval (got nan)"),
        ([1e9], "labels.flow.0: no direction, and no interval (got 1000000000.0)"),
        ([0.01, "1/100"], "labels.flow: an interval twice (got 0.01); expected each once"),
        ([0.25], "labels.flow: no label's flow leads so far: it would end outside the sequence (got 0.25); expected"),
        ([-0.21], "expected intervals of at most 0.2 s, or a longer time.duration"),
    ],
)
def test_intervals_that_cannot_be_are_refused(flow, said, tmp_path):
    (tmp_path / "a.yaml").write_text(to_yaml({**RUN, "labels": {"flow": flow}}), encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        load_run(tmp_path / "a.yaml")
    assert said in str(error.value)
