"""EV-FlowNet (Zhu et al., "EV-FlowNet: Self-Supervised Optical Flow Estimation for Event-based
Cameras", RSS 2018), supervised here."""

from __future__ import annotations

import itertools

import torch
import torch.nn.functional as F
from torch import nn

from eflow.config import EvFlowNetConfig
from eflow.data.representation import CountsAndTimes, VoxelGrid
from eflow.models.contract import FlowModel, FlowPrediction, initialise
from eflow.models.unets import Consensus, Residual, ScaledTanh, double, encoder_widths, seen_cells, to_size
from eflow.types import Batch


class EvFlowNet(FlowModel[EvFlowNetConfig]):
    """A U-Net on one window: four stride-2 convolutions, two residual blocks, and four decoders with nearest-neighbour
    upsampling, skips and a tanh flow head. Every decoder also reads the flow of the previous one."""

    Config = EvFlowNetConfig
    divisor, least = 16, 32
    reads = ("new",)

    def __init__(self, config: EvFlowNetConfig):
        super().__init__()
        self.config = config
        self.representation = CountsAndTimes() if config.input == "counts" else VoxelGrid(config.bins)
        # Input channels, then those of the four encoders, each twice as many as before.
        widths = (self.representation.channels, *encoder_widths(config))
        w = widths[1]
        self.encoders = nn.ModuleList([nn.Conv2d(a, b, 3, 2, 1) for a, b in itertools.pairwise(widths)])
        self.residuals = nn.Sequential(Residual(8 * w), Residual(8 * w))
        self.consensus = Consensus(8 * w) if config.consensus else None
        self.decoders = nn.ModuleList(
            [
                nn.Conv2d(c, c_out, 3, padding=1)
                for c, c_out in ((16 * w, 4 * w), (8 * w + 2, 2 * w), (4 * w + 2, w), (2 * w + 2, w // 2))
            ]
        )
        heads = [ScaledTanh(c) for c in (4 * w, 2 * w, w, w // 2)]
        self.heads = nn.ModuleList(heads)
        initialise(self)
        for head in heads:
            head.calm()

    def forward(self, batch: Batch) -> FlowPrediction:
        self.check_input(batch)
        x = batch["new"]
        height, width = x.shape[-2:]
        skips = []
        for encoder in self.encoders:
            x = F.relu(encoder(x))
            skips.append(x)
        x, flows = self.residuals[0](x), []
        if self.consensus is not None:
            x = self.consensus(x, seen_cells(batch["new"], self.divisor))
        x = self.residuals[1](x)
        # From coarse to fine; skips are used from the last encoder to the first.
        for decoder, head in zip(self.decoders, self.heads, strict=True):
            # Flow divided by its largest value is as large as the features.
            parts = [x, skips.pop()] + ([flows[-1].to(x.dtype) / head.largest] if flows else [])
            x = F.relu(decoder(double(torch.cat(parts, 1))))
            flows.append(head(x))
        full = [to_size(f, height, width) for f in (flows if self.training else flows[-1:])]
        return FlowPrediction(full, kind="scales")
