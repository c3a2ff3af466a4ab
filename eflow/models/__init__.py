"""The networks behind one contract (:mod:`eflow.models.contract`).

In:    a model configuration; tensors of events.
Out:   flow.
Start: contract.py, then ev_flownet.py, the smallest.
"""

from __future__ import annotations

from blinkgl.config.base import Config, validate
from eflow.config import ModelConfig
from eflow.models.contract import FlowModel, FlowPrediction, parameters_of

NAMES = ("eflowformer", "eraft", "ste_flownet", "ev_flownet", "spike_flownet")

__all__ = ["NAMES", "FlowModel", "FlowPrediction", "build_model", "model_config", "parameters_of"]


def build_model(config) -> FlowModel:
    """The network a model configuration (:mod:`eflow.config`) describes, freshly
    initialised from torch's current seed."""
    if config.name == "eraft":
        from eflow.models.eraft import Eraft as model
    elif config.name == "eflowformer":
        from eflow.models.eflowformer import EFlowFormer as model
    elif config.name == "ev_flownet":
        from eflow.models.ev_flownet import EvFlowNet as model
    elif config.name == "spike_flownet":
        from eflow.models.spike_flownet import SpikeFlowNet as model
    else:
        from eflow.models.ste_flownet import SteFlowNet as model
    return model(config)


class _Holder(Config):
    model: ModelConfig


def model_config(tree: dict):
    """Plain data, e.g. ``{"name": "eraft"}``, to a validated model configuration. Raises ConfigError."""
    return validate(_Holder, {"model": tree}).model
