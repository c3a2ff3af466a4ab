"""Where bf16 is not good enough: softmax and expectation, coordinates, flow accumulation,
upsampling (errors of px otherwise)."""

from __future__ import annotations

import torch
from torch import Tensor


def fp32(x: Tensor) -> torch.autocast:
    """Context in which autocast is off on ``x``'s device: an fp32 island. Cast the inputs with ``.float()``."""
    return torch.autocast(x.device.type if x.device.type in ("cpu", "cuda") else "cpu", enabled=False)
