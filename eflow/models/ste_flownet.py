"""STE-FlowNet (Ding et al., "Spatio-Temporal Recurrent Networks for Event-Based Optical Flow
Estimation", AAAI 2022): the published network, supervised."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from eflow.config import SteFlowNetConfig
from eflow.data.representation import CountSlices
from eflow.models.contract import FlowModel, FlowPrediction
from eflow.models.unets import LeakyResidual, UpDecoder, encoder_widths, initialise_wide, leaky, to_size
from eflow.ops.correlation import local_correlation
from eflow.ops.resample import backward_warp
from eflow.types import Batch

RADII = {"base": 4, "small": 3, "tiny": 2}
TINY = 8
"""Width of ``tiny``: most parameters are in the GRUs, whose states include the correlations."""


class ConvGru(nn.Module):
    """A 3x3 convolutional GRU with as many hidden channels as inputs."""

    def __init__(self, channels: int):
        super().__init__()
        self.gates = nn.Conv2d(2 * channels, 2 * channels, 3, padding=1)
        self.candidate = nn.Conv2d(2 * channels, channels, 3, padding=1)

    def forward(self, x: Tensor, h: Tensor | None) -> Tensor:
        h = torch.zeros_like(x) if h is None else h
        # Update gate z, reset gate r, as in eraft.SepConvGru with square kernels.
        z, r = torch.sigmoid(self.gates(torch.cat([h, x], 1))).chunk(2, 1)
        return torch.lerp(h, torch.tanh(self.candidate(torch.cat([r * h, x], 1))).to(h.dtype), z.to(h.dtype))


class SteFlowNet(FlowModel[SteFlowNetConfig]):
    """STE-FlowNet: processes the count slices of the window one after the other, ``sweeps`` times.

    Every slice has its own flow at four scales, and each sweep adds to it. At each scale of the encoder, features of
    the slice (of a tower beside the encoder) are warped by its flow and correlated with those of slice 0. The ConvGRU
    of that scale reads the correlation and the output of the scale above; its state persists over slices and sweeps.
    Then the states are decoded from coarse to fine. The flow of the last slice is that of the window."""

    Config = SteFlowNetConfig
    divisor, least = 16, 32
    reads = ("new",)

    def __init__(self, config: SteFlowNetConfig):
        super().__init__()
        self.config = config
        self.representation = CountSlices(config.slices)
        self.radius = config.radius or RADII[config.size]
        width = config.width or (TINY if config.size == "tiny" else None)
        w1, w2, _, w4 = widths = encoder_widths(config.model_copy(update={"width": width}))
        # Channels of a GRU: features and correlation taps of its scale.
        taps = (2 * self.radius + 1) ** 2
        states = [w + taps for w in widths]
        self.encoders = nn.ModuleList([nn.Conv2d(a, b, 3, 2, 1) for a, b in zip((2, *states[:3]), widths, strict=True)])
        self.tower = nn.ModuleList([nn.Conv2d(a, b, 3, 2, 1) for a, b in itertools.pairwise(widths)])
        self.grus = nn.ModuleList([ConvGru(c) for c in states])
        self.entry = nn.Conv2d(states[3], w4, 3, padding=1)
        self.residuals = nn.Sequential(LeakyResidual(w4, bias=True), LeakyResidual(w4, bias=True))
        ups = (w2, w1, 4)
        inputs = (states[3] + w4, *(s + up + 2 for s, up in zip(states[2::-1], ups, strict=True)))
        self.decoders = nn.ModuleList([UpDecoder(c, up, bias=True) for c, up in zip(inputs, (*ups, None), strict=True)])
        initialise_wide(self)

    def forward(self, batch: Batch) -> FlowPrediction:
        self.check_input(batch)
        new = batch["new"]
        n, _, height, width = new.shape
        slices = new.view(n, self.config.slices, 2, height, width)
        hidden: list[Tensor | None] = [None] * 4
        # Flow of each slice at 1/8, 1/4, 1/2, 1/1, px of that scale.
        flows = [
            [torch.zeros(n, 2, height // s, width // s, device=new.device) for s in (8, 4, 2, 1)]
            for _ in range(self.config.slices)
        ]
        seen = [self._look(slices[:, i]) for i in range(self.config.slices)]
        for _ in range(self.config.sweeps):
            for i in range(self.config.slices):
                # seen[0]: features of slice 0, the reference of all correlations.
                for scale, (there, here) in enumerate(zip(seen[0], seen[i], strict=True)):
                    x = leaky(self.encoders[scale](hidden[scale - 1])) if scale else here
                    # The coarsest scale (1/16) has no flow.
                    aligned = here if scale == 3 else backward_warp(here, flows[i][2 - scale], border="replicate")
                    # The published code applies the activation twice, in the correlation and after it.
                    taps = leaky(leaky(local_correlation(there, aligned.to(here.dtype), self.radius)))
                    hidden[scale] = self.grus[scale](torch.cat([x, taps], 1), hidden[scale])
                flows[i] = self._decode([state for state in hidden if state is not None], flows[i])
        answer = [to_size(f * (height / f.shape[-2]), height, width) for f in flows[-1]]
        return FlowPrediction(answer if self.training else answer[-1:], kind="scales")

    def _look(self, counts: Tensor) -> list[Tensor]:
        """Return the features of a slice (N, 2, H, W) at 1/2, 1/4, 1/8, 1/16, independent of any state, for the
        correlation."""
        features = [leaky(self.encoders[0](counts))]
        for layer in self.tower:
            features.append(leaky(layer(features[-1])))
        return features

    def _decode(self, hidden: list[Tensor], before: list[Tensor]) -> list[Tensor]:
        """Return the decoders' flow from the states plus the slice's flow ``before``, coarse to fine."""
        # The coarsest state, and the output of the residual blocks.
        x = torch.cat([hidden[3], self.residuals(leaky(self.entry(hidden[3])))], 1)
        after = []
        for scale, decoder in enumerate(self.decoders):
            residual, up = decoder(x)
            after.append(before[scale] + residual)
            if up is not None:
                x = torch.cat([hidden[2 - scale], up, after[-1].to(up.dtype)], 1)
        return after
