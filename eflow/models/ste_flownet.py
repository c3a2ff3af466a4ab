"""STE-FlowNet (Ding et al., "Spatio-Temporal Recurrent Networks for Event-Based Optical Flow
Estimation", AAAI 2022), supervised."""

from __future__ import annotations

import itertools

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from eflow.config import SteFlowNetConfig
from eflow.data.representation import CountSlices
from eflow.models.contract import FlowModel, FlowPrediction, initialise
from eflow.models.unets import CHANNELS, Residual, double, to_size
from eflow.ops.correlation import local_correlation
from eflow.ops.warp import backward_warp

TAPS = 81


class ConvGru(nn.Module):
    """3x3 convolutional GRU, as many hidden channels as inputs."""

    def __init__(self, channels: int):
        super().__init__()
        self.gates = nn.Conv2d(2 * channels, 2 * channels, 3, padding=1)
        self.candidate = nn.Conv2d(2 * channels, channels, 3, padding=1)

    def forward(self, x: Tensor, h: Tensor) -> Tensor:
        z, r = torch.sigmoid(self.gates(torch.cat([x, h], 1))).chunk(2, 1)
        return torch.lerp(h, torch.tanh(self.candidate(torch.cat([x, r * h], 1))).to(h.dtype), z.to(h.dtype))


class Decoder(nn.Module):
    """Fuses state, correlation, flow (and the coarser decoder's features) into a residual flow
    and features for the next scale."""

    def __init__(self, inputs: int, channels: int, last: bool):
        super().__init__()
        self.fuse = nn.Conv2d(inputs, channels, 3, padding=1)
        self.residuals = nn.Sequential(Residual(channels), Residual(channels))
        self.flow = nn.Conv2d(channels, 2, 3, padding=1)
        self.up = None if last else nn.Conv2d(channels, channels // 2, 3, padding=1)

    def forward(self, *parts: Tensor) -> tuple[Tensor, Tensor | None]:
        x = self.residuals(F.relu(self.fuse(torch.cat(parts, 1))))
        return self.flow(x).float(), None if self.up is None else F.relu(self.up(double(x)))


class SteFlowNet(FlowModel):
    """The window's count slices go through the encoder one after the other, a ConvGRU at each of four scales carrying
    state. Each of ``sweeps`` passes decodes from coarse to fine: at a scale, slice 0's state is correlated (9x9) with
    the states of the later slices i, warped back by i / slices of the current flow, averaged over i,
    and a decoder adds a residual to the flow."""

    divisor, least = 16, 32

    def __init__(self, config: SteFlowNetConfig):
        super().__init__()
        self.config = config
        self.representation = CountSlices(config.slices)
        widths = (2, *CHANNELS)
        self.encoders = nn.ModuleList([nn.Conv2d(a, b, 3, 2, 1) for a, b in itertools.pairwise(widths)])
        self.grus = nn.ModuleList([ConvGru(c) for c in CHANNELS])
        self.bottleneck = nn.Sequential(Residual(512), Residual(512))
        inputs = [c + TAPS + 2 + (0 if c == 512 else c) for c in CHANNELS]
        self.decoders = nn.ModuleList([Decoder(i, c, c == 64) for i, c in zip(inputs, CHANNELS, strict=True)])
        initialise(self)
        for decoder in self.decoders:
            nn.init.normal_(decoder.flow.weight, std=1e-3)

    def forward(self, batch: dict) -> FlowPrediction:
        self.check_input(batch)
        slices = batch["new"]
        n, _, height, width = slices.shape
        states = self._encode(slices.view(n, self.config.slices, 2, height, width))  # states[scale][slice]
        flow = torch.zeros(n, 2, height // 16, width // 16, device=slices.device)
        top, flows = self.bottleneck(states[3][-1]), []
        for sweep in range(self.config.sweeps):
            features = None
            for scale in (3, 2, 1, 0):
                first = states[scale][0]
                h, w = first.shape[-2:]
                flow = to_size(flow, h, w)  # full-resolution px at every scale
                local = flow.detach() / (height / h)
                taps = sum(
                    local_correlation(first, backward_warp(state, local * (i / self.config.slices)).to(first.dtype))
                    for i, state in enumerate(states[scale][1:], 1)
                ) / (self.config.slices - 1)
                parts = [top if scale == 3 else states[scale][-1], taps, local.to(taps.dtype)] + (
                    [] if features is None else [features]
                )
                residual, features = self.decoders[scale](*parts)
                flow = flow.detach() + residual
                if self.training:
                    flows.append(to_size(flow, height, width))
            flow = to_size(flow, height // 16, width // 16) if sweep < self.config.sweeps - 1 else flow
        return FlowPrediction(flows if self.training else [to_size(flow, height, width)], kind="scales")

    def _encode(self, slices: Tensor) -> list[list[Tensor]]:
        states: list[list[Tensor]] = [[] for _ in CHANNELS]
        for i in range(slices.shape[1]):
            x = slices[:, i]
            for scale, (encoder, gru) in enumerate(zip(self.encoders, self.grus, strict=True)):
                x = F.relu(encoder(x))
                x = gru(x, states[scale][-1] if i else torch.zeros_like(x))
                states[scale].append(x)
        return states
