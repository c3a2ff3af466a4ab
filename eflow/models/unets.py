"""What the encoder-decoder baselines share."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

CHANNELS = (64, 128, 256, 512)
"""Encoder widths at 1/2, 1/4, 1/8, 1/16."""


class Residual(nn.Module):
    """x + conv-relu-conv of x, 3x3, then relu."""

    def __init__(self, channels: int):
        super().__init__()
        self.conv1, self.conv2 = (
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.Conv2d(channels, channels, 3, padding=1),
        )

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.conv2(F.relu(self.conv1(x))))


def double(x: Tensor) -> Tensor:
    """Nearest-neighbour upsampling by two."""
    return F.interpolate(x, scale_factor=2, mode="nearest")


def to_size(flow: Tensor, height: int, width: int) -> Tensor:
    """Flow in full-resolution px, resampled bilinearly to the full size (its unit does not change)."""
    return F.interpolate(flow.float(), (height, width), mode="bilinear", align_corners=False)


class ScaledTanh(nn.Module):
    """A bounded flow head: tanh of a 1x1 convolution times ``largest`` px; starts near zero flow."""

    def __init__(self, channels: int, largest: float = 256.0):
        super().__init__()
        self.conv, self.largest = nn.Conv2d(channels, 2, 1), largest

    def forward(self, x: Tensor) -> Tensor:
        return self.largest * torch.tanh(self.conv(x).float())

    def calm(self) -> None:
        """Small initial weights: a saturated tanh would not learn."""
        nn.init.normal_(self.conv.weight, std=1e-4)
        nn.init.zeros_(self.conv.bias)
