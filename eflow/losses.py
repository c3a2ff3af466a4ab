"""The training loss."""

from __future__ import annotations

import torch
from torch import Tensor

from eflow.config import LossConfig
from eflow.models.contract import FlowPrediction

L1 = LossConfig()


def sequence_loss(
    prediction: FlowPrediction,
    flow: Tensor,
    valid: Tensor,
    *,
    loss: LossConfig = L1,
    gamma: float = 0.8,
    match_weight: float = 0.5,
    count: Tensor | None = None,
) -> Tensor:
    """sum over i of w_i · mean over valid pixels of the error of V_i (:func:`pixel_error`).

    flow : (N, 2, H, W) px. valid : (N, H, W) bool; what lies outside (|gt| >= 400 included) may hold anything, NaN too.
    w_i = gamma^(N - i) for refinements 1 … N of one field, and ``match_weight`` for the matching layer's, which would
    have gamma^N in the BlinkFlow paper (whose exponent N - 1 is a misprint), 1.45 % of the whole at N = 12.
    Decoder scales weigh the same, sum 1.
    count : number to divide by instead of the batch's valid pixels (data-parallel training: the mean over ranks).

    The mean is over *valid* pixels, so that sparse ground truth has the gradient scale of dense. No valid pixel: 0.
    """
    target = torch.where(valid[:, None], flow, 0)
    total = (valid.sum() if count is None else count).clamp(min=1)
    last = len(prediction.flows) - 1
    sum_ = flow.new_zeros(())
    for i, predicted in enumerate(prediction.flows):
        if prediction.kind == "scales":
            weight = 1 / (last + 1)
        else:
            weight = match_weight if prediction.has_match and i == 0 else gamma ** (last - i)
        error = pixel_error(predicted.float(), target, loss)
        sum_ = sum_ + weight * torch.where(valid, error, 0).sum() / total
    return sum_


def pixel_error(predicted: Tensor, target: Tensor, loss: LossConfig) -> Tensor:
    """(N, 2, H, W) px, twice -> (N, H, W): the sum of ``loss``'s terms, each times its weight. With e the end-point
    error and k = ``loss.knee`` px:

    l1: |du| + |dv|.   epe: e.
    length: |log((|flow| + k) / (|true flow| + k))|. What is uncertain is best left short by the other terms (their
    minimum is the median of each component); this one is smallest at the median of the length, whatever the direction.
    """
    difference = predicted - target
    total = predicted.new_zeros(predicted.shape[0], *predicted.shape[2:])
    if loss.l1:
        total = total + loss.l1 * difference.abs().sum(1)
    if loss.epe:
        total = total + loss.epe * ((difference**2).sum(1) + 1e-6).sqrt()  # a root whose slope is finite at 0
    if loss.length:
        length = ((predicted**2).sum(1) + 1e-6).sqrt()
        total = total + loss.length * (torch.log(length + loss.knee) - torch.log(target.norm(dim=1) + loss.knee)).abs()
    return total
