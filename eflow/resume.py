"""Where a training begins: at another network's weights, or at a run's newest checkpoint."""

from __future__ import annotations

import json
import re
from pathlib import Path

from torch import Tensor

from blinkgl.errors import AssetError, ConfigError
from eflow import checkpoint as ckpt
from eflow.config import TrainConfig
from eflow.models import FlowModel

_FREE = {"run"}
"""Parts of the configuration that may change between a run and its resumption (how it runs, not what it computes)."""
_GONE = {"optim.clock": "wall", "optim.scale_gamma": 1.0, "optim.loss.relative": 0.0, "optim.loss.log": 0.0}
"""Keys that earlier versions had, and their defaults: what they compute today."""


def resume_run(out: Path, config: TrainConfig, model: FlowModel, optimizer, ema) -> tuple[int, float]:
    """Restores everything from the newest checkpoint; returns its step and the seconds that it took."""
    folder = ckpt.newest(out)
    if folder is None:
        raise AssetError("no checkpoint to resume from", where=str(out), accepted="a run folder of eflow train")
    state = ckpt.read_state(folder)
    saved, now = _leaves(state.get("config", {})), {**_GONE, **_leaves(json.loads(config.model_dump_json()))}
    saved = {**_GONE, **saved}
    for path in sorted({*saved, *now}):
        free = path.split(".")[0] in _FREE or re.fullmatch(r"data\.(train\.\d+\.)?workers", path)
        if not free and saved.get(path) != now.get(path):
            raise ConfigError(
                "differs from the run that is resumed",
                where=path,
                value=now.get(path),
                accepted=f"{saved.get(path)!r}, or a new run with init_from",
            )
    weights, _ = ckpt.read_tensors(folder / "weights.safetensors")
    averaged = ckpt.read_tensors(folder / "ema.safetensors")[0] if ema is not None else {}
    ckpt.load_weights(model, weights, str(folder / "weights.safetensors"))
    ckpt.load_optimizer(folder / "optimizer.safetensors", model, optimizer)
    for k in ema or ():
        if k not in averaged or averaged[k].shape != ema[k].shape:
            raise AssetError(f"lacks the tensor '{k}' of this model", where=str(folder / "ema.safetensors"))
        ema[k].copy_(averaged[k])
    return state["step"], state["seconds"]


def _leaves(tree, prefix: str = "") -> dict[str, object]:
    if isinstance(tree, dict) and tree:
        return {
            k: v for key, node in tree.items() for k, v in _leaves(node, f"{prefix}.{key}" if prefix else key).items()
        }
    if isinstance(tree, list) and tree and isinstance(tree[0], dict):
        return {k: v for i, node in enumerate(tree) for k, v in _leaves(node, f"{prefix}.{i}").items()}
    return {prefix: tree}


def weights_of(config: TrainConfig) -> tuple[dict[str, Tensor], str]:
    """The weights that ``init_from`` names, and that name. Raises AssetError: of another model."""
    model = ckpt.load_model(config.init_from, expected=None)
    if model.config.name != config.model.name:
        raise AssetError(
            "checkpoint of another model",
            where=f"init_from: {config.init_from}",
            value=model.config.name,
            accepted=config.model.name,
        )
    return model.state_dict(), config.init_from
