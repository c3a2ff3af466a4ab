"""Data sets and checkpoints of other people: whatever is wrong with them is one line."""

import json

import numpy as np
import pytest

from blinkgl.errors import AssetError, BlinkGLError, OutputError
from blinkgl.io.flow import write_flow_png

torch = pytest.importorskip("torch", reason="the extra [eflow] is not installed")

from eflow import checkpoint  # noqa: E402
from eflow.checkpoint import FORMAT, load_model, newest, write_tensors  # noqa: E402
from eflow.data.sources import numbered, open_source  # noqa: E402
from eflow.models import build_model  # noqa: E402
from eflow.train import _held  # noqa: E402
from flow_data import blinkflow_set, blinkgl_set, dsec_set  # noqa: E402


def test_files_beside_labels_are_no_labels(tmp_path):
    for name in ("000002.png", "._000002.png", ".DS_Store.png", "000010.png"):
        (tmp_path / name).write_bytes(b"")
    assert {k: path.name for k, path in numbered(tmp_path, "png").items()} == {2: "000002.png", 10: "000010.png"}
    for name in ("final.png", "²²².png", "2.png"):
        (tmp_path / name).write_bytes(b"")
        with pytest.raises(AssetError, match="not the number of a label"):
            numbered(tmp_path, "png")
        (tmp_path / name).unlink()


@pytest.mark.parametrize("made", [blinkgl_set, dsec_set])
@pytest.mark.parametrize("text", ["20000, 99999999999999999999999\n", "1, x\n", "1\n", "5, 5\n", "7, 3\n"])
def test_a_list_of_times_that_is_none(tmp_path, made, text):
    made(tmp_path)
    for path in tmp_path.rglob("forward_timestamps.txt"):
        path.write_text(text)
    with pytest.raises(BlinkGLError, match="no time|not an interval"):
        open_source(tmp_path)


def test_a_name_without_a_number(tmp_path):
    for made, folder, name in ((dsec_set, "flow/forward", "x.png"), (blinkflow_set, "forward_flow", "x.npy")):
        root = made(tmp_path / made.__name__)
        place = next(path for path in root.rglob("*") if path.as_posix().endswith(folder))
        write_flow_png(place / f"._{name}", np.zeros((4, 4, 2), np.float32), np.ones((4, 4), bool))
        open_source(root)
        (place / name).write_bytes(b"")
        with pytest.raises(AssetError, match="not the number of a label"):
            open_source(root)


@pytest.mark.parametrize("text", ["[" * 200_000, "{}", '{"version": 1, "samples": true, "backward": true}', "\xff"])
def test_windows_that_are_none(tmp_path, text):
    (tmp_path / "windows.json").write_text(text, encoding="latin-1")
    with pytest.raises(AssetError, match=r"windows\.json: not"):
        open_source(tmp_path)


def test_an_index_leads_nowhere(tmp_path):
    root = blinkgl_set(tmp_path / "set", sequences=1)
    (root / "train/link").symlink_to(root / "train/seq_000000")
    for name in ("../other", "/etc", "train/link"):
        (root / "index.jsonl").write_text(json.dumps({"path": name}) + "\n")
        with pytest.raises(AssetError, match="not a path inside the folder|a symbolic link"):
            open_source(root)


def test_folders_beside_checkpoints_are_none(tmp_path):
    for name in ("²", "000000010", "x", "٣"):
        (tmp_path / "checkpoints" / name).mkdir(parents=True)
    assert newest(tmp_path).name == "000000010"


@pytest.mark.parametrize(
    "model",
    [
        {"name": "ste_flownet", "width": 512},
        {"name": "eflowformer", "layers": 32, "features": 1024, "trunk": [1024, 1024, 1024], "hidden": 1024},
    ],
)
def test_a_checkpoint_is_compared_before_its_network_is_made(tmp_path, model, monkeypatch):
    path = tmp_path / "weights.safetensors"
    write_tensors(path, {"a": torch.zeros(1)}, {"format": FORMAT, "model": json.dumps(model)})
    made = []

    def build(config):
        made.append(torch.empty(0).device.type)
        return build_model(config)

    monkeypatch.setattr(checkpoint, "build_model", build)
    with pytest.raises(BlinkGLError, match="tensor|model"):
        load_model(path)
    assert set(made) <= {"meta"}


def test_two_trainings_do_not_share_a_folder(tmp_path):
    with _held(tmp_path / "run", False, bool):
        for resume in (False, True):
            with (
                pytest.raises(OutputError, match="another run uses this folder"),
                _held(tmp_path / "run", resume, bool),
            ):
                pass
    assert not (tmp_path / "run").exists()
    with _held(tmp_path / "run", False, lambda: True):
        (tmp_path / "run/config.yaml").write_text("")
    with pytest.raises(OutputError, match="output folder exists"), _held(tmp_path / "run", False, bool):
        pass
    with _held(tmp_path / "run", True, bool):
        pass
