"""What the encoder-decoder baselines share."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

WIDTHS = {"base": 64, "small": 32, "tiny": 16}
"""Channels of the first encoder, at 1/2; each further one has twice as many."""


def encoder_widths(config) -> tuple[int, int, int, int]:
    """Channels at 1/2, 1/4, 1/8, 1/16: of the configuration's ``width``, or of its ``size``."""
    width = config.width or WIDTHS[config.size]
    return width, 2 * width, 4 * width, 8 * width


class LeakyResidual(nn.Module):
    """x + leaky-conv-leaky-conv of x, as Spike-FlowNet and STE-FlowNet have it: no activation after the sum."""

    def __init__(self, channels: int, bias: bool):
        super().__init__()
        self.conv1, self.conv2 = (nn.Conv2d(channels, channels, 3, padding=1, bias=bias) for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        return x + leaky(self.conv2(leaky(self.conv1(x))))


def leaky(x: Tensor) -> Tensor:
    """Leaky ReLU with slope 0.1."""
    return F.leaky_relu(x, 0.1)


class UpDecoder(nn.Module):
    """Transposed convolutions of Spike-FlowNet and STE-FlowNet, each to twice the size: one to 32 channels and from
    there to flow in px *of that size*, one (but for the ``last``) to features for the next decoder."""

    def __init__(self, inputs: int, features: int | None, bias: bool):
        super().__init__()
        self.up_flow, self.flow = nn.ConvTranspose2d(inputs, 32, 4, 2, 1, bias=bias), nn.Conv2d(32, 2, 1, bias=bias)
        self.up = None if features is None else nn.ConvTranspose2d(inputs, features, 4, 2, 1, bias=bias)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor | None]:
        return self.flow(self.up_flow(x)).float(), None if self.up is None else leaky(self.up(x))


def initialise_wide(module: nn.Module) -> None:
    """Normal weights of variance 3 / (kernel area x inputs), biases zero, as Spike-FlowNet and STE-FlowNet start; flow
    heads near zero flow."""
    for m in module.modules():
        if isinstance(m, (nn.Conv2d, nn.ConvTranspose2d)):
            nn.init.normal_(m.weight, std=math.sqrt(3 / (m.kernel_size[0] * m.kernel_size[1] * m.in_channels)))
            if m.bias is not None:
                nn.init.zeros_(m.bias)
    for m in module.modules():
        if isinstance(m, UpDecoder):
            nn.init.normal_(m.flow.weight, std=1e-3)


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
    """Flow resampled bilinearly to another size; its unit does not change."""
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
