"""Published checkpoints, written here in their layout: the same flow as their own arithmetic, restated below, and
one line for everything else."""

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import torch.nn.functional as F  # noqa: E402

from blinkgl.errors import AssetError  # noqa: E402
from blinkgl.io.formats import write_events  # noqa: E402
from eflow.checkpoint import load_model  # noqa: E402
from eflow.cli import run  # noqa: E402
from eflow.infer import predict  # noqa: E402
from eflow.published import import_published  # noqa: E402
from flow_data import SPAN, moving_events  # noqa: E402


def published(channels: int = 15, seed: int = 0, prefix: str = "") -> dict[str, torch.Tensor]:
    """Random weights under the names and in the shapes of E-RAFT's code."""
    torch.manual_seed(seed)
    out = {}

    def conv(name, inputs, outputs, kernel, gain=1.0):
        size = (kernel, kernel) if isinstance(kernel, int) else kernel
        out[f"{name}.weight"] = torch.randn(outputs, inputs, *size) * gain / np.sqrt(inputs * size[0] * size[1])
        out[f"{name}.bias"] = 0.1 * torch.randn(outputs)

    def norm(name, width):
        out[f"{name}.weight"], out[f"{name}.bias"] = 1 + 0.1 * torch.randn(width), 0.1 * torch.randn(width)
        out[f"{name}.running_mean"], out[f"{name}.running_var"] = 0.1 * torch.randn(width), 1 + torch.rand(width)
        out[f"{name}.num_batches_tracked"] = torch.tensor(7)

    for tree, outputs in (("fnet", 256), ("cnet", 256)):
        conv(f"{tree}.conv1", channels, 64, 7)
        batch = tree == "cnet"
        if batch:
            norm(f"{tree}.norm1", 64)
        width = 64
        for layer, wide in ((1, 64), (2, 96), (3, 128)):
            for block in (0, 1):
                name = f"{tree}.layer{layer}.{block}"
                conv(f"{name}.conv1", width, wide, 3, 1.4)
                conv(f"{name}.conv2", wide, wide, 3, 1.4)
                if batch:
                    norm(f"{name}.norm1", wide), norm(f"{name}.norm2", wide)
                if width != wide:
                    conv(f"{name}.downsample.0", width, wide, 1)
                    if batch:
                        norm(f"{name}.downsample.1", wide)
                        for k in ("weight", "bias", "running_mean", "running_var", "num_batches_tracked"):
                            out[f"{name}.norm3.{k}"] = out[f"{name}.downsample.1.{k}"]  # registered twice there
                width = wide
        conv(f"{tree}.conv2", 128, outputs, 1)
    block = "update_block"
    conv(f"{block}.encoder.convc1", 324, 256, 1), conv(f"{block}.encoder.convc2", 256, 192, 3)
    conv(f"{block}.encoder.convf1", 2, 128, 7), conv(f"{block}.encoder.convf2", 128, 64, 3)
    conv(f"{block}.encoder.conv", 256, 126, 3)
    for i, kernel in ((1, (1, 5)), (2, (5, 1))):
        for letter in "zrq":
            conv(f"{block}.gru.conv{letter}{i}", 384, 128, kernel)
    conv(f"{block}.flow_head.conv1", 128, 256, 3), conv(f"{block}.flow_head.conv2", 256, 2, 3, 2.0)
    conv(f"{block}.mask.0", 128, 256, 3), conv(f"{block}.mask.2", 256, 576, 1, 8.0)
    return {prefix + k: v for k, v in out.items()}


def restated(w: dict, old, new, iterations: int):
    """E-RAFT's forward pass from the papers and the names above, with none of eflow's operations: padding at the left
    and top to multiples of 32, column-major taps, zeros beyond the edge when flow is upsampled."""

    def conv(name, x, stride=1):
        weight = w[f"{name}.weight"]
        return F.conv2d(x, weight, w[f"{name}.bias"], stride, [k // 2 for k in weight.shape[2:]])

    def norm(name, x):
        if f"{name}.weight" not in w:
            return F.instance_norm(x)
        arguments = (w[f"{name}.{k}"] for k in ("running_mean", "running_var", "weight", "bias"))
        return F.batch_norm(x, *arguments)

    def encoder(tree, x):
        x = norm(f"{tree}.norm1", conv(f"{tree}.conv1", x, 2)).relu()
        for layer in (1, 2, 3):
            for block in (0, 1):
                name, stride = f"{tree}.layer{layer}.{block}", 2 if layer > 1 and block == 0 else 1
                y = norm(f"{name}.norm1", conv(f"{name}.conv1", x, stride)).relu()
                y = norm(f"{name}.norm2", conv(f"{name}.conv2", y)).relu()
                if stride == 2:
                    x = norm(f"{name}.downsample.1", conv(f"{name}.downsample.0", x, 2))
                x = (x + y).relu()
        return conv(f"{tree}.conv2", x)

    height, width = old.shape[-2:]
    left, top = -width % 32, -height % 32
    old, new = (F.pad(x, (left, 0, top, 0)) for x in (old, new))
    f1, f2 = encoder("fnet", old), encoder("fnet", new)
    hidden, context = encoder("cnet", new).split(128, 1)
    hidden, context = hidden.tanh(), context.relu()
    n, d, h, wide = f1.shape
    pyramid = [torch.einsum("ndyx,ndvu->nyxvu", f1, f2).reshape(n * h * wide, 1, h, wide) / d**0.5]
    for _ in range(3):
        pyramid.append(F.avg_pool2d(pyramid[-1], 2))
    ys, xs = torch.meshgrid(torch.arange(h), torch.arange(wide), indexing="ij")
    grid = torch.stack([xs, ys]).float()[None]
    flow = torch.zeros(n, 2, h, wide)
    block = "update_block"
    for _ in range(iterations):
        at = (grid + flow).permute(0, 2, 3, 1).reshape(-1, 2)
        taps = []
        for level, volume in enumerate(pyramid):
            for dx in range(-4, 5):
                for dy in range(-4, 5):
                    point = at / 2**level + torch.tensor([dx, dy])
                    size = torch.tensor([volume.shape[-1] - 1.0, volume.shape[-2] - 1.0])
                    there = (2 * point / size - 1).view(-1, 1, 1, 2)
                    taps.append(F.grid_sample(volume, there, align_corners=True).view(n, 1, h, wide))
        c = conv(f"{block}.encoder.convc2", conv(f"{block}.encoder.convc1", torch.cat(taps, 1)).relu()).relu()
        f = conv(f"{block}.encoder.convf2", conv(f"{block}.encoder.convf1", flow).relu()).relu()
        motion = torch.cat([conv(f"{block}.encoder.conv", torch.cat([c, f], 1)).relu(), flow], 1)
        x = torch.cat([context, motion], 1)
        for i in (1, 2):
            z, r = (conv(f"{block}.gru.conv{k}{i}", torch.cat([hidden, x], 1)).sigmoid() for k in "zr")
            q = conv(f"{block}.gru.convq{i}", torch.cat([r * hidden, x], 1)).tanh()
            hidden = (1 - z) * hidden + z * q
        flow = flow + conv(f"{block}.flow_head.conv2", conv(f"{block}.flow_head.conv1", hidden).relu())
    weights = 0.25 * conv(f"{block}.mask.2", conv(f"{block}.mask.0", hidden).relu())
    weights = weights.view(n, 1, 9, 8, 8, h, wide).softmax(2)
    around = F.unfold(8 * flow, 3, padding=1).view(n, 2, 9, 1, 1, h, wide)
    fine = (weights * around).sum(2).permute(0, 1, 4, 2, 5, 3).reshape(n, 2, 8 * h, 8 * wide)
    return fine[..., top:, left:]


@pytest.mark.parametrize("entry", ["model", "state_dict", None])
def test_an_imported_network_gives_the_published_flow(tmp_path, entry):
    weights = published(prefix="module." if entry == "state_dict" else "")
    tree = weights if entry is None else {entry: weights, "epoch": 3, "best": 0.788}
    torch.save(tree, tmp_path / "dsec.tar")
    import_published(tmp_path / "dsec.tar", tmp_path / "eraft.safetensors")
    model = load_model(tmp_path / "eraft.safetensors")
    assert json.loads(model.config.model_dump_json())["input"] == {
        "bins": 15,
        "normalise": "nonzero",
        "bounds": "events",
    }
    torch.manual_seed(4)
    old, new = torch.randn(2, 1, 15, 140, 168)
    model.config = model.config.model_copy(update={"iterations": 2})
    flow = predict(model, {"old": old, "new": new}).flow
    with torch.inference_mode():
        expected = restated({k.removeprefix("module."): v for k, v in weights.items()}, old, new, 2)
    assert expected.shape == flow.shape == (1, 2, 140, 168) and expected.abs().mean() > 1
    assert (flow - expected).abs().max() < 1e-3 * expected.abs().max()


def test_predict_takes_what_import_makes(tmp_path, capsys):
    torch.save({"model": published()}, tmp_path / "mvsec_20.tar")
    out = tmp_path / "e.safetensors"
    assert run(["import", str(tmp_path / "mvsec_20.tar"), "--out", str(out)]) == 0
    assert "5.33 M parameters" in capsys.readouterr().out
    write_events(tmp_path / "e.h5", moving_events(128, 144, 0, 2 * SPAN), 128, 144)
    options = ["--window-ms", "80", "--end-ms", "170", "--iterations", "1"]
    assert run(["predict", str(out), str(tmp_path / "e.h5"), *options]) == 0
    assert run(["import", str(tmp_path / "mvsec_20.tar"), "--out", str(out)]) == 2
    assert "output file exists" in capsys.readouterr().err


def test_rafts_own_weights_are_refused(tmp_path):
    torch.save(published(channels=3, prefix="module."), tmp_path / "raft-things.pth")
    with pytest.raises(AssetError, match="RAFT's own weights see images and no events; expected E-RAFT's checkpoint"):
        import_published(tmp_path / "raft-things.pth", tmp_path / "r.safetensors")


class Trap:
    def __reduce__(self):
        return (print, ("sprung",))


@pytest.mark.parametrize("zipped", [True, False])
def test_code_in_a_checkpoint_is_refused_and_not_run(tmp_path, zipped, capsys):
    tree = {"model": published(), "more": Trap()}
    torch.save(tree, tmp_path / "trap.tar", _use_new_zipfile_serialization=zipped)
    assert run(["import", str(tmp_path / "trap.tar"), "--out", str(tmp_path / "x.safetensors")]) == 2
    said = capsys.readouterr()
    assert "holds more than tensors" in said.err and said.err.count("\n") == 1 and "sprung" not in said.out
    assert [p.name for p in tmp_path.iterdir()] == ["trap.tar"]


def test_truncated_files(tmp_path):
    for zipped in (True, False):
        torch.save({"model": published()}, tmp_path / "whole.tar", _use_new_zipfile_serialization=zipped)
        data = (tmp_path / "whole.tar").read_bytes()
        for size in (0, 1, 20, 1000, len(data) // 2, len(data) - 40):
            (tmp_path / "cut.tar").write_bytes(data[:size])
            with pytest.raises(AssetError, match=r"cut\.tar: ") as caught:
                import_published(tmp_path / "cut.tar", tmp_path / "x.safetensors")
            assert "\n" not in str(caught.value)
    (tmp_path / "cut.tar").write_bytes(b"not a checkpoint at all")
    with pytest.raises(AssetError, match="truncated or not a checkpoint"):
        import_published(tmp_path / "cut.tar", tmp_path / "x.safetensors")


@pytest.mark.parametrize(
    "change, message",
    [
        (
            lambda t: t.pop("cnet.layer3.0.downsample.0.bias"),
            r"lacks the tensor 'cnet\.layer3\.0\.downsample\.0\.bias'",
        ),
        (lambda t: t.update({"fnet.layer4.0.conv1.weight": torch.zeros(2)}), r"holds a tensor 'fnet\.layer4"),
        (
            lambda t: t.update({"update_block.gru.convz1.weight": torch.zeros(64, 384, 1, 5)}),
            r"tensor 'update_block\.gru\.convz1\.weight and update_block\.gru\.convr1\.weight' has another shape",
        ),
        (lambda t: t.update({"fnet.conv1.bias": torch.zeros(64, dtype=torch.int64)}), "has another shape or type"),
        (lambda t: t.update({"fnet.conv1.bias": torch.full((64,), np.nan)}), "holds NaN or infinity"),
        (lambda t: t.update({"fnet.conv1.weight": torch.zeros(64)}), r"'fnet\.conv1\.weight' has another shape"),
        (lambda t: t.update({"epoch": 3}), "'epoch' is no tensor"),
        (lambda t: t.clear(), "holds no tensors by name"),
    ],
)
def test_checkpoints_of_something_else(tmp_path, change, message):
    tree = published()
    change(tree)
    torch.save(tree, tmp_path / "other.tar")
    with pytest.raises(AssetError, match=rf"other\.tar: .*{message}"):
        import_published(tmp_path / "other.tar", tmp_path / "x.safetensors")
    assert not (tmp_path / "x.safetensors").exists()
    with pytest.raises(AssetError, match="none.tar: no such file"):
        import_published(tmp_path / "none.tar", tmp_path / "x.safetensors")
