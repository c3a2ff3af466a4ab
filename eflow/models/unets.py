"""Parts that the encoder-decoder networks share."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from eflow.config import EvFlowNetConfig, SpikeFlowNetConfig, SteFlowNetConfig

WIDTHS = {"base": 64, "small": 32, "tiny": 16}
"""Channels of the first encoder, at 1/2; each further one has twice as many."""


def encoder_widths(config: EvFlowNetConfig | SpikeFlowNetConfig | SteFlowNetConfig) -> tuple[int, int, int, int]:
    """Return the channels at 1/2, 1/4, 1/8, 1/16, by the ``width`` of the configuration or its ``size``."""
    width = config.width or WIDTHS[config.size]
    return width, 2 * width, 4 * width, 8 * width


class LeakyResidual(nn.Module):
    """x + leaky-conv-leaky-conv of x, without an activation after the sum, as in Spike-FlowNet and STE-FlowNet."""

    def __init__(self, channels: int, bias: bool):
        super().__init__()
        self.conv1, self.conv2 = (nn.Conv2d(channels, channels, 3, padding=1, bias=bias) for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        return x + leaky(self.conv2(leaky(self.conv1(x))))


def leaky(x: Tensor) -> Tensor:
    """Return the leaky ReLU of x with slope 0.1."""
    return F.leaky_relu(x, 0.1)


class UpDecoder(nn.Module):
    """A decoder of Spike-FlowNet and STE-FlowNet: transposed convolutions to twice the size, one to 32 channels and
    then to flow in px *of that size*, the other to ``features`` for the next decoder (None: the last decoder)."""

    def __init__(self, inputs: int, features: int | None, bias: bool):
        super().__init__()
        self.up_flow, self.flow = nn.ConvTranspose2d(inputs, 32, 4, 2, 1, bias=bias), nn.Conv2d(32, 2, 1, bias=bias)
        self.up = None if features is None else nn.ConvTranspose2d(inputs, features, 4, 2, 1, bias=bias)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor | None]:
        # Flow is float32, with autocast, too.
        return self.flow(self.up_flow(x)).float(), None if self.up is None else leaky(self.up(x))


def initialise_wide(module: nn.Module) -> None:
    """Initialise weights by a normal distribution of variance 3 / (kernel area x inputs) and biases by 0, as in
    Spike-FlowNet and STE-FlowNet, and flow heads near zero flow."""
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


def seen_cells(events: Tensor, stride: int) -> Tensor:
    """Return 1 for the cells of ``stride`` px of event tensors (N, C, H, W) that have events within two cells, else 0:
    (N, 1, h, w). A few stray events do not count: such a cell has .6 of the pixels with events that the cell of a
    mean event has, or more."""
    # A cell that the border cuts has its share of what is inside.
    share = F.avg_pool2d((events != 0).any(1, keepdim=True).float(), stride, ceil_mode=True)
    usual = (share**2).sum((2, 3), keepdim=True) / share.sum((2, 3), keepdim=True).clamp(min=1e-9)
    return F.max_pool2d((share >= 0.6 * usual).float(), 5, stride=1, padding=2)


class Consensus(nn.Module):
    """x + a linear layer of the affine field nearest to x over the image.

    Each channel is fitted by least squares with learned weights: cells without information get small weights and
    receive the field of the others. A camera that rotates, or moves along a wall, moves the image by such a field,
    which convolutions cannot transport over long distances.

    There are ``groups`` maps of weights, each for its share of the channels. Coordinates are px of the input relative
    to the weighted mean, so that the size of the image does not matter."""

    SPAN = 64.0
    """Unit of the coordinates, px."""
    RIDGE = 0.02
    """Added to the variance of the coordinates, in SPAN²: a point or a line then has no slope across it."""

    def __init__(self, channels: int, groups: int = 4, stride: int = 16):
        super().__init__()
        self.groups, self.stride = groups, stride
        self.weight, self.mix = nn.Conv2d(channels, groups, 1), nn.Conv2d(channels, channels, 1)

    def forward(self, x: Tensor, seen: Tensor | float = 1.0) -> Tensor:
        # The weight of each cell, 0 to 1; none where the sensor is silent, whose features say only that.
        weight = torch.sigmoid(self.weight(x).float()) * seen
        with torch.autocast(x.device.type, enabled=False):
            field = self.fitted(x.float(), weight)
        return F.relu(x + self.mix(field.to(x.dtype)))

    def fitted(self, x: Tensor, weight: Tensor) -> Tensor:
        """Return the affine field nearest to x (N, C, h, w), with weights (N, groups, h, w); float32."""
        n, channels, height, width = x.shape
        unit = self.stride / self.SPAN
        v, u = torch.meshgrid(
            unit * torch.arange(height, dtype=x.dtype, device=x.device),
            unit * torch.arange(width, dtype=x.dtype, device=x.device),
            indexing="ij",
        )
        u, v = u.reshape(1, 1, -1), v.reshape(1, 1, -1)
        # 1e-4 keeps the sum above 0 if all weights vanish.
        w = weight.flatten(2) + 1e-4
        w = w / w.sum(2, keepdim=True)  # (N, groups, h w)
        # Coordinates relative to the weighted mean: mean and slopes then separate.
        u, v = u - (w * u).sum(2, keepdim=True), v - (w * v).sum(2, keepdim=True)
        # Weighted second moments: the normal equations of the slopes, a 2x2 system.
        uu, vv, uv = (
            (w * u * u).sum(2, keepdim=True) + self.RIDGE,
            (w * v * v).sum(2, keepdim=True) + self.RIDGE,
            (w * u * v).sum(2, keepdim=True),
        )
        det = uu * vv - uv * uv
        x = x.reshape(n, self.groups, channels // self.groups, height * width)
        with_weight = lambda a: torch.matmul(x, a.unsqueeze(-1))  # (N, groups, C / groups, 1)
        mean, xu, xv = with_weight(w), with_weight(w * u), with_weight(w * v)
        uu, vv, uv, det, u, v = (a.unsqueeze(2) for a in (uu, vv, uv, det, u, v))
        # Cramer's rule for both slopes.
        field = mean + (vv * xu - uv * xv) / det * u + (uu * xv - uv * xu) / det * v
        return field.reshape(n, channels, height, width)


def double(x: Tensor) -> Tensor:
    """Return x upsampled by two (nearest neighbour)."""
    return F.interpolate(x, scale_factor=2, mode="nearest")


def to_size(flow: Tensor, height: int, width: int) -> Tensor:
    """Return flow resampled bilinearly to another size; its unit does not change."""
    return F.interpolate(flow.float(), (height, width), mode="bilinear", align_corners=False)


class ScaledTanh(nn.Module):
    """A bounded flow head: tanh of a 1x1 convolution, times ``largest`` px."""

    def __init__(self, channels: int, largest: float = 256.0):
        super().__init__()
        self.conv, self.largest = nn.Conv2d(channels, 2, 1), largest

    def forward(self, x: Tensor) -> Tensor:
        return self.largest * torch.tanh(self.conv(x).float())

    def calm(self) -> None:
        """Initialise with small weights: a saturated tanh would not learn."""
        nn.init.normal_(self.conv.weight, std=1e-4)
        assert self.conv.bias is not None
        nn.init.zeros_(self.conv.bias)
