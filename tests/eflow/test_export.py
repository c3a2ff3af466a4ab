"""``eflow export``: files that answer other inputs than the traced one as torch does, or do not appear."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from blinkgl.errors import AssetError  # noqa: E402
from eflow import checkpoint as ckpt  # noqa: E402
from eflow.cli import run  # noqa: E402
from eflow.export import export  # noqa: E402
from eflow.infer import predict  # noqa: E402
from eflow.models import FlowPrediction, build_model, model_config  # noqa: E402

NETWORKS = [
    {"name": "ev_flownet", "width": 8, "consensus": True},
    {"name": "spike_flownet", "width": 8, "steps": 2},
    {"name": "eraft", "size": "tiny", "iterations": 2, "padding": "start"},
    {"name": "eflowformer", "size": "tiny", "iterations": 2},
    {"name": "eflowformer", "size": "tiny", "quick": True, "levels": 2},
]


def network(**tree):
    torch.manual_seed(0)
    model = build_model(model_config(tree)).eval()
    for name, p in model.named_parameters():  # flow heads start near zero: agreement of nothing shows nothing
        if "heads." in name or ".flow" in name:
            torch.nn.init.normal_(p, std=0.05)
    return model


def answers_alike(model, answer, height, width):
    """Three random inputs that the export did not see; predict pads as E-RAFT's code or at the end."""
    for seed in (7, 8, 9):
        torch.manual_seed(seed)
        windows = {k: torch.randn(1, model.representation.channels, height, width) for k in model.reads}
        wanted = predict(model, windows).flow.numpy()
        flow = answer({k: v.numpy() for k, v in windows.items()})
        assert flow.shape == wanted.shape and np.abs(wanted).max() > 0.1
        assert np.abs(flow - wanted).max() < 1e-3 * np.abs(wanted).max()


@pytest.mark.parametrize("tree", NETWORKS, ids=lambda tree: "-".join(map(str, tree.values())))
def test_torchscript(tmp_path, tree):
    model = network(**tree)
    export(model, tmp_path / "n.pt", "torchscript", 130, 150)
    script = torch.jit.load(tmp_path / "n.pt")
    answers_alike(model, lambda w: script(*map(torch.from_numpy, w.values())).detach().numpy(), 130, 150)


@pytest.mark.parametrize(
    "tree",
    [NETWORKS[0], *(pytest.param(tree, marks=pytest.mark.slow) for tree in NETWORKS[1:])],
    ids=lambda tree: "-".join(map(str, tree.values())),
)
def test_onnx(tmp_path, capsys, tree):
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    model, weights, out = network(**tree), tmp_path / "n.safetensors", tmp_path / "n.onnx"
    ckpt.write_tensors(weights, model.state_dict(), ckpt.metadata_of(model))
    assert run(["export", str(weights), "--onnx", str(out), "--size", "150x130"]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith(f"written and checked: {out}, reads {', '.join(model.reads)}, ") and not printed.err
    session = runtime.InferenceSession(str(out), providers=["CPUExecutionProvider"])
    assert [entry.name for entry in session.get_inputs()] == list(model.reads)
    answers_alike(model, lambda windows: session.run(["flow"], windows)[0], 130, 150)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["n.onnx", "n.safetensors"]


def test_an_operator_that_onnx_lacks_is_one_line(tmp_path, monkeypatch):
    pytest.importorskip("onnxscript")
    model = network(name="ev_flownet", width=4)
    usual = model.forward
    monkeypatch.setattr(model, "forward", lambda batch: torch.linalg.eigvals(batch["new"]) and usual(batch))
    with pytest.raises(AssetError, match=r"^\S+n\.onnx: ONNX lacks an operator of this network: .*--torchscript$") as e:
        export(model, tmp_path / "n.onnx", "onnx", 32, 32)
    assert "\n" not in str(e.value) and not list(tmp_path.iterdir())


def test_a_file_that_answers_otherwise_does_not_appear(tmp_path, monkeypatch):
    """What NumPy computed in forward is a constant of the trace."""
    model = network(name="ev_flownet", width=4)
    usual = model.forward
    by_numpy = lambda batch: FlowPrediction([torch.from_numpy(usual(batch).flow.numpy() * 1.0)])
    monkeypatch.setattr(model, "forward", by_numpy)
    with pytest.raises(AssetError, match=r"n\.pt: the exported network gives another flow \(got '.* px'\)$"):
        export(model, tmp_path / "n.pt", "torchscript", 32, 32)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "options, line",
    [
        ([], "no file to write; expected --onnx OUT or --torchscript OUT"),
        (["--torchscript", "x.pt", "--size", "8x8"], "--size: too small (got '8x8'); expected at least 32 px a side"),
        (["--torchscript", "x.pt", "--size", "8"], "--size: not a size (got '8'); expected WIDTHxHEIGHT, e.g. 640x480"),
        (["--onnx", "x.onnx"], "--onnx: onnx is not installed; run "),
    ],
)
def test_what_is_refused(tmp_path, monkeypatch, capsys, options, line):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert run(["export", "real_small", *options]) == 2
    assert capsys.readouterr().err.startswith(f"error: {line}") and not list(tmp_path.iterdir())
