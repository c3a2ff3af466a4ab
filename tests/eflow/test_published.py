"""Published checkpoints, written here in their layout: the same flow as their own arithmetic, and one line for
everything else.

``tests/golden/eraft.npz`` is every seventh pixel of the flow of E-RAFT's forward pass, restated from the papers with
none of eflow's operations (``restated`` in this file at commit 21f2ecb4): padding at the left and top to multiples of
32, column-major taps, zeros beyond the edge when flow is upsampled. ``eraft_names.json`` has names and shapes.
"""

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")


from blinkgl.errors import AssetError  # noqa: E402
from blinkgl.io.formats import write_events  # noqa: E402
from eflow.checkpoint import load_model  # noqa: E402
from eflow.cli import run  # noqa: E402
from eflow.infer import predict  # noqa: E402
from eflow.published import import_published, read_published  # noqa: E402
from flow_data import SPAN, moving_events  # noqa: E402

GOLDEN = Path(__file__).parents[1] / "golden" / "eraft.npz"
NAMES = json.loads(GOLDEN.with_name("eraft_names.json").read_text())
GAINS = {"update_block.flow_head.conv2.weight": 2.0, "update_block.mask.2.weight": 8.0}


def published(prefix: str = "") -> dict[str, torch.Tensor]:
    """Random weights under the names and in the shapes of E-RAFT's code."""
    rng, out = np.random.default_rng(0), {}
    for name, shape in NAMES.items():
        drawn = torch.from_numpy(rng.standard_normal(shape, np.float32))
        if len(shape) == 4:
            drawn *= GAINS.get(name, 1.2) / np.sqrt(np.prod(shape[1:]))
        elif name.endswith("running_var"):
            drawn = 1 + drawn.abs()
        elif name.endswith("num_batches_tracked"):
            drawn = torch.tensor(7)
        else:
            drawn = 0.1 * drawn + name.endswith("weight")
        out[prefix + name] = drawn
        if ".downsample.1." in name:
            out[prefix + name.replace("downsample.1", "norm3")] = drawn  # registered twice there
    return out


def test_an_imported_network_gives_the_published_flow(tmp_path):
    weights = published(prefix="module.")
    beside = {"epoch": np.int64(3), "best": np.float64(0.788), "losses": [np.float32(1)]}  # NumPy's numbers, too
    torch.save({"state_dict": weights, **beside}, tmp_path / "dsec.tar")
    import_published(tmp_path / "dsec.tar", tmp_path / "eraft.safetensors")
    model = load_model(tmp_path / "eraft.safetensors")
    assert json.loads(model.config.model_dump_json())["input"] == {
        "bins": 15,
        "normalise": "nonzero",
        "bounds": "events",
    }
    old, new = torch.from_numpy(np.random.default_rng(4).standard_normal((2, 1, 15, 140, 168), np.float32))
    model.config = model.config.model_copy(update={"iterations": 2})
    flow = predict(model, {"old": old, "new": new}).flow
    assert flow.shape == (1, 2, 140, 168)
    expected = np.load(GOLDEN)["flow"]
    assert np.abs(flow[0, :, ::7, ::7].numpy() - expected).max() < 1e-3 * np.abs(expected).max()


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
    weights = published(prefix="module.")
    of_pictures = {k: v[:, :3] if k.endswith("net.conv1.weight") else v for k, v in weights.items()}
    torch.save(of_pictures, tmp_path / "raft-things.pth")
    with pytest.raises(AssetError, match="weights of RAFT are for images, not events; expected E-RAFT's checkpoint"):
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
    rng = np.random.default_rng(3)
    for _ in range(40):  # whatever torch raises, bytes that lie included
        damaged = bytearray(data)
        for place in rng.integers(0, 2000, 3):
            damaged[place] = rng.integers(256)
        (tmp_path / "cut.tar").write_bytes(damaged)
        with contextlib.suppress(AssetError):
            read_published(tmp_path / "cut.tar")
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
        (lambda t: t.update({"epoch": 3}), "'epoch' is not a tensor"),
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
