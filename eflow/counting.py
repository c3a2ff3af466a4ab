"""Parameters and multiply-accumulates of a model, counted without memory on torch's meta device."""

from __future__ import annotations

import torch
from torch.utils.flop_counter import FlopCounterMode

from eflow.models import build_model, parameters_of


def count(config, height: int = 480, width: int = 640, *, plain: bool = True) -> tuple[int, float]:
    """(parameters, GMACs of one forward pass at batch 1): convolutions and matrix products, attention's included;
    gathers, normalisations and pointwise work are not counted.

    plain : the paper's arithmetic, i.e. mask head in every iteration and no hoisting; False: what inference here does.
    """
    with torch.device("meta"):
        model = build_model(config).eval()
        channels = model.representation.channels
        batch = {k: torch.zeros(1, channels, height, width) for k in ("old", "new")}
    if hasattr(model, "plain"):
        model.plain = plain
    counter = FlopCounterMode(display=False)
    with torch.inference_mode(), counter:
        model(batch)
    return parameters_of(model), counter.get_total_flops() / 2e9
