"""Checkpoints that cannot be meant: refused by name when they are read."""

from __future__ import annotations

import json
import math

import pytest

torch = pytest.importorskip("torch")

from blinkgl.errors import AssetError  # noqa: E402
from eflow.checkpoint import keep_best, load_model, metadata_of, read_state, read_tensors, write_tensors  # noqa: E402
from eflow.models import build_model, model_config  # noqa: E402


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda t: t.reshape(-1).__setitem__(0, float("nan")), "holds NaN or infinity"),
        (lambda t: t.reshape(-1).__setitem__(0, float("inf")), "holds NaN or infinity"),
    ],
)
def test_weights_that_are_not_numbers(tmp_path, change, message):
    model = build_model(model_config({"name": "ev_flownet", "width": 4}))
    tensors = {k: v.clone() for k, v in model.state_dict().items()}
    name = next(k for k, v in tensors.items() if v.is_floating_point())
    write_tensors(tmp_path / "w.safetensors", tensors, metadata_of(model))
    load_model(tmp_path / "w.safetensors")
    change(tensors[name])
    write_tensors(tmp_path / "w.safetensors", tensors, metadata_of(model))
    with pytest.raises(AssetError, match=f"w.safetensors: tensor '{name}' {message}"):
        load_model(tmp_path / "w.safetensors")
    tensors[name] = torch.ones(tensors[name].shape, dtype=torch.int32)
    write_tensors(tmp_path / "w.safetensors", tensors, metadata_of(model))
    with pytest.raises(AssetError, match=f"tensor '{name}' has another type"):
        load_model(tmp_path / "w.safetensors")


@pytest.mark.parametrize("step", [True, -1, 1.5, "5", None])
def test_states_without_a_step(tmp_path, step):
    (tmp_path / "state.json").write_text(json.dumps({"format": "eflow-1", "step": step}))
    with pytest.raises(AssetError, match="state.json: damaged"):
        read_state(tmp_path)


def test_the_best_weights_after_a_score_of_nan(tmp_path):
    model = build_model(model_config({"name": "ev_flownet", "width": 4}))
    kept = []
    for step, score in enumerate((math.nan, math.nan, 0.5, math.nan, 0.7, 0.3)):
        keep_best(tmp_path, model, None, step, score)
        kept.append(int(read_tensors(tmp_path / "best.safetensors")[1]["step"]))
    assert kept == [0, 0, 2, 2, 2, 5]
