"""``eflow export``: ONNX files that say what torch says, at any size and batch that the exporter leaves open."""

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnxscript")
onnxruntime = pytest.importorskip("onnxruntime")

from blinkgl.errors import AssetError, ConfigError  # noqa: E402
from eflow import checkpoint as ckpt, export as exporting  # noqa: E402
from eflow.cli import run  # noqa: E402
from eflow.export import export_onnx  # noqa: E402
from eflow.infer import predict  # noqa: E402
from eflow.models import build_model, model_config  # noqa: E402


def network(**tree):
    torch.manual_seed(0)
    model = build_model(model_config(tree)).eval()
    for name, p in model.named_parameters():  # flow heads start near zero: agreement of nothing shows nothing
        if name.startswith(("heads.", "update.flow_head.2")):
            torch.nn.init.normal_(p, std=0.05)
    return model


def agrees(model, path, sizes, batch=1):
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    assert [i.name for i in session.get_inputs()] == list(model.reads)
    for height, width in sizes:
        tensors = {k: torch.randn(batch, model.representation.channels, height, width) for k in ("old", "new")}
        wanted = predict(model, tensors).flow.numpy()
        (flow,) = session.run(None, {k: tensors[k].numpy() for k in model.reads})
        assert flow.shape == (batch, 2, height, width) and np.abs(wanted).max() > 0.01
        assert np.abs(flow - wanted).max() <= 1e-4 * max(1, np.abs(wanted).max())


@pytest.mark.slow
def test_ev_flownet_of_any_size_and_batch(tmp_path, capsys):
    model = network(name="ev_flownet", width=8, input="voxel", bins=5, consensus=True)
    ckpt.write_tensors(tmp_path / "n.safetensors", model.state_dict(), ckpt.metadata_of(model))
    assert run(["export", str(tmp_path / "n.safetensors"), "--out", str(tmp_path / "n.onnx")]) == 0
    said = capsys.readouterr()
    assert "opset 18, sizes: multiples of 16, at least 32" in said.out and not said.err
    agrees(model, tmp_path / "n.onnx", [(32, 48), (64, 32)], batch=3)
    session = onnxruntime.InferenceSession(str(tmp_path / "n.onnx"), providers=["CPUExecutionProvider"])
    told = session.get_modelmeta().custom_metadata_map
    assert json.loads(told["representation"]) == {
        "name": "VoxelGrid",
        "bins": 5,
        "normalise": "nonzero",
        "bounds": "window",
    }
    assert json.loads(told["model"])["width"] == 8
    assert run(["export", str(tmp_path / "n.safetensors"), "--out", str(tmp_path / "n.onnx")]) == 2
    assert "exists" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["n.onnx", "n.safetensors"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "tree",
    [
        {"name": "spike_flownet", "width": 8, "steps": 2},
        {"name": "eraft", "size": "tiny", "iterations": 3, "train_iterations": 3},
    ],
    ids=lambda tree: tree["name"],
)
def test_other_networks_of_any_size(tmp_path, tree):
    model = network(**tree)
    export_onnx(model, tmp_path / "n.onnx")
    agrees(model, tmp_path / "n.onnx", [(128, 144), (160, 128)])


def test_what_is_not_exported(tmp_path, capsys):
    for model, message in (
        (network(name="ste_flownet", size="tiny"), "ste_flownet is not exported: its three sweeps"),
        (network(name="eraft", size="tiny", padding="start"), "own padding is not exported"),
        (network(name="eflowformer", size="tiny"), "--size: eflowformer is exported for one size only"),
    ):
        with pytest.raises(ConfigError, match=message):
            export_onnx(model, tmp_path / "n.onnx")
    with pytest.raises(ConfigError, match=r"--size: a size the network does not take .*100x32.*multiples of 16"):
        export_onnx(network(name="ev_flownet", width=8), tmp_path / "n.onnx", size=(32, 100))
    assert not list(tmp_path.iterdir())


def test_a_file_that_says_something_else_does_not_appear(tmp_path, monkeypatch):
    monkeypatch.setattr(exporting, "TOLERANCE", -1.0)
    with pytest.raises(AssetError, match="onnxruntime gives another flow"):
        export_onnx(network(name="ev_flownet", width=4), tmp_path / "n.onnx", size=(32, 32))
    assert not list(tmp_path.iterdir())


def test_without_the_extra_one_line_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert run(["export", "x", "--out", str(tmp_path / "n.onnx")]) == 2
    err = capsys.readouterr().err
    assert "onnx is not installed; run" in err and "onnx onnxscript onnxruntime" in err
