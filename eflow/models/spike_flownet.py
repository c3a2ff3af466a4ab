"""Spike-FlowNet (Lee et al., "Spike-FlowNet: Event-based Optical Flow Estimation with Energy-Efficient Hybrid Neural
Networks", ECCV 2020), supervised here."""

from __future__ import annotations

import itertools

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from eflow.config import SpikeFlowNetConfig
from eflow.data.representation import CountSlices
from eflow.models.contract import FlowModel, FlowPrediction, initialise
from eflow.models.unets import CHANNELS, Residual, to_size


class _Fire(torch.autograd.Function):
    """Spike where the membrane exceeds the threshold; backwards a straight-through gradient 1 / threshold."""

    @staticmethod
    def forward(ctx, membrane: Tensor, threshold: float) -> Tensor:
        ctx.threshold = threshold
        return (membrane > threshold).to(membrane.dtype)

    @staticmethod
    def backward(ctx, gradient: Tensor):
        return gradient / ctx.threshold, None


class SpikeFlowNet(FlowModel):
    """Spiking encoder, ordinary residual blocks and decoders.

    The window is halved into two groups of ``steps`` count frames; spike step s sees frame s of both groups (four
    channels). Each encoder layer is a bias-free stride-2 convolution into integrate-and-fire neurons with soft reset;
    its *accumulated input current* over all steps is the skip connection and, at the last
    layer, the residual blocks' input."""

    divisor, least = 16, 32

    def __init__(self, config: SpikeFlowNetConfig):
        super().__init__()
        self.config = config
        self.representation = CountSlices(2 * config.steps)
        widths = (4, *CHANNELS)
        self.encoders = nn.ModuleList([nn.Conv2d(a, b, 3, 2, 1, bias=False) for a, b in itertools.pairwise(widths)])
        self.residuals = nn.Sequential(Residual(512), Residual(512))
        inputs = (512, 128 + 256 + 2, 64 + 128 + 2, 64 + 64 + 2)  # decoder features, skip, flow; at 1/16, 1/8, 1/4, 1/2
        self.ups = nn.ModuleList([nn.ConvTranspose2d(c, c_out, 4, 2, 1) for c, c_out in zip(inputs, (128, 64, 64))])
        self.heads = nn.ModuleList(
            [nn.Sequential(nn.Conv2d(c, 32, 3, padding=1), nn.LeakyReLU(0.1), nn.Conv2d(32, 2, 1)) for c in inputs]
        )
        initialise(self)
        for head in self.heads:
            nn.init.normal_(head[-1].weight, std=1e-3)

    def forward(self, batch: dict) -> FlowPrediction:
        self.check_input(batch)
        steps = batch["new"]
        n, _, height, width = steps.shape
        groups = steps.view(n, 2, self.config.steps, 2, height, width)
        membranes: list[Tensor | float] = [0.0] * 4
        currents: list[Tensor | float] = [0.0] * 4
        for s in range(self.config.steps):
            x = groups[:, :, s].reshape(n, 4, height, width)
            for layer, encoder in enumerate(self.encoders):
                current = encoder(x).float()
                currents[layer] = currents[layer] + current
                membrane = membranes[layer] + current
                x = _Fire.apply(membrane, self.config.threshold)
                # Soft reset: what exceeds the threshold stays.
                membranes[layer] = membrane - self.config.threshold * x.detach()
        x, flows = self.residuals(F.leaky_relu(currents[3], 0.1)), []
        for scale, head in enumerate(self.heads):
            flows.append(head(x).float())
            if scale < 3:
                up = F.leaky_relu(self.ups[scale](x), 0.1)
                x = torch.cat(
                    [
                        up,
                        currents[2 - scale].to(up.dtype),
                        F.interpolate(flows[-1], scale_factor=2, mode="bilinear").to(up.dtype),
                    ],
                    1,
                )
        full = [to_size(f, height, width) for f in (flows if self.training else flows[-1:])]
        return FlowPrediction(full, kind="scales")
