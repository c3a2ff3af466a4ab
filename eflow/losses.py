"""The training loss."""

from __future__ import annotations

import torch
from torch import Tensor

from eflow.models.contract import FlowPrediction


def sequence_loss(
    prediction: FlowPrediction,
    flow: Tensor,
    valid: Tensor,
    *,
    gamma: float = 0.8,
    match_weight: float = 1.0,
    count: Tensor | None = None,
) -> Tensor:
    """sum over i of w_i · mean over valid pixels of |V_i - V_gt|_1 (both components summed).

    flow : (N, 2, H, W) px. valid : (N, H, W) bool; what lies outside (|gt| >= 400 included) may hold anything, NaN too.
    w_i = gamma^(N - i) for refinements 0 … N of one field (the BlinkFlow paper's exponent N - 1 is a misprint), w_0
    times ``match_weight`` when it is the matching layer's; w_i = 1 / (number of fields) for decoder scales.
    count : number to divide by instead of the batch's valid pixels (data-parallel training: the mean over ranks).

    The mean is over *valid* pixels, so that sparse ground truth has the gradient scale of dense. No valid pixel: 0.
    """
    target = torch.where(valid[:, None], flow, 0)
    total = (valid.sum() if count is None else count).clamp(min=1)
    last = len(prediction.flows) - 1
    loss = flow.new_zeros(())
    for i, predicted in enumerate(prediction.flows):
        if prediction.kind == "scales":
            weight = 1 / (last + 1)
        else:
            weight = gamma ** (last - i) * (match_weight if prediction.has_match and i == 0 else 1.0)
        error = (predicted.float() - target).abs().sum(1)
        loss = loss + weight * torch.where(valid, error, 0).sum() / total
    return loss
