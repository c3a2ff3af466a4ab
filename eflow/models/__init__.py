"""The networks, all with one interface (:mod:`eflow.models.contract`).

In:    a model configuration; tensors of events.
Out:   flow.
Start: contract.py, then ev_flownet.py, the smallest.
"""

from __future__ import annotations

from collections.abc import Mapping

from blinkgl.config.base import Config
from blinkgl.config.problems import validate
from blinkgl.errors import ConfigError
from eflow.config import ModelConfig, NetworkConfig
from eflow.models.contract import FlowModel, FlowPrediction, parameters_of
from eflow.models.eflowformer import EFlowFormer
from eflow.models.eraft import Eraft
from eflow.models.ev_flownet import EvFlowNet
from eflow.models.spike_flownet import SpikeFlowNet
from eflow.models.ste_flownet import SteFlowNet

NETWORKS: dict[str, type[FlowModel]] = {
    model.Config.model_fields["name"].default: model
    for model in (EFlowFormer, Eraft, SteFlowNet, EvFlowNet, SpikeFlowNet)
}
"""The networks by the key ``name`` of their configuration: the only list of networks."""
SIZES = ("base", "small", "tiny")

_QUICK = {"size": "tiny", "quick": True, "trunk": (16, 32, 64), "levels": 2, "iterations": 1, "train_iterations": 1}

PRESETS: Mapping[str, Mapping[str, object]] = {
    name if size == "base" else f"{name}-{size}": {"name": name, "size": size} for name in NETWORKS for size in SIZES
} | {
    "eflowformer-twins": {"name": "eflowformer", "layers": 2, "attention": "twins"},
    "eflowformer-quick": {"name": "eflowformer", **_QUICK},
}
"""Configurations by the names of ``eflow train --model``: every network in every size."""

__all__ = [
    "NETWORKS",
    "PRESETS",
    "SIZES",
    "FlowModel",
    "FlowPrediction",
    "build_model",
    "model_config",
    "parameters_of",
    "preset",
]


def preset(name: str) -> Mapping[str, object]:
    """Return the configuration of a name in :data:`PRESETS`, as plain data. Raises ConfigError."""
    if name not in PRESETS:
        raise ConfigError("unknown model", where="--model", value=name, accepted="one of " + ", ".join(PRESETS))
    return PRESETS[name]


def build_model(config: NetworkConfig) -> FlowModel:
    """Return the network of a model configuration (:mod:`eflow.config`), initialised from torch's current seed."""
    return NETWORKS[config.name](config)


class _Holder(Config):
    model: ModelConfig


def model_config(tree: Mapping[str, object]) -> NetworkConfig:
    """Return the validated model configuration of plain data, e.g. ``{"name": "eraft"}``. Raises ConfigError."""
    return validate(_Holder, {"model": tree}).model
