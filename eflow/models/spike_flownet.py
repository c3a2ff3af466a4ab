"""Spike-FlowNet (Lee et al., "Spike-FlowNet: Event-based Optical Flow Estimation with Energy-Efficient Hybrid Neural
Networks", ECCV 2020): the published network, supervised here."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from eflow.config import SpikeFlowNetConfig
from eflow.data.representation import CountSlices
from eflow.models.contract import FlowModel, FlowPrediction
from eflow.models.unets import LeakyResidual, UpDecoder, encoder_widths, initialise_wide, to_size
from eflow.types import Batch


def integrate_and_fire(membrane: Tensor, threshold: float) -> tuple[Tensor, Tensor]:
    """Return (spikes, membrane afterwards). Neurons that spiked are reset to 0 (hard reset)."""
    # The threshold itself does not fire.
    fired = (membrane > threshold).to(membrane.dtype)
    # The surrogate gradient of Lee et al. 2020, 1 / threshold where a spike was, of a term that is 0.
    return fired + fired * (membrane - membrane.detach()) / threshold, membrane * (1 - fired)


class SpikeFlowNet(FlowModel[SpikeFlowNetConfig]):
    """A spiking encoder with ordinary residual blocks and decoders; no convolution has a bias.

    The window is divided into two groups of ``steps`` count frames; spike step s reads frame s of both groups (four
    channels). Each encoder layer is a stride-2 convolution into integrate-and-fire neurons with hard reset;
    its *accumulated input current* over all steps is the skip connection and, at the last
    layer, the input of the residual blocks. Flow is predicted at 1/8, 1/4, 1/2 and 1/1."""

    Config = SpikeFlowNetConfig
    divisor, least = 16, 32
    reads = ("new",)

    def __init__(self, config: SpikeFlowNetConfig):
        super().__init__()
        self.config = config
        self.representation = CountSlices(2 * config.steps)
        w1, w2, w3, w4 = widths = encoder_widths(config)
        self.encoders = nn.ModuleList(
            [nn.Conv2d(a, b, 3, 2, 1, bias=False) for a, b in itertools.pairwise((4, *widths))]
        )
        self.residuals = nn.Sequential(LeakyResidual(w4, bias=False), LeakyResidual(w4, bias=False))
        ups = (w2, w1, 4)
        # Skip, features of the previous decoder, and two channels of flow.
        inputs = (w4, *(skip + up + 2 for skip, up in zip((w3, w2, w1), ups, strict=True)))
        self.decoders = nn.ModuleList(
            [UpDecoder(c, up, bias=False) for c, up in zip(inputs, (*ups, None), strict=True)]
        )
        initialise_wide(self)

    def forward(self, batch: Batch) -> FlowPrediction:
        self.check_input(batch)
        steps = batch["new"]
        n, _, height, width = steps.shape
        # (first and second half of the window, step, polarity): a step takes one frame of each half.
        groups = steps.view(n, 2, self.config.steps, 2, height, width)
        membranes: list[Tensor | float] = [0.0] * 4
        currents: list[Tensor | float] = [0.0] * 4
        for s in range(self.config.steps):
            x = groups[:, :, s].reshape(n, 4, height, width)
            for layer, encoder in enumerate(self.encoders):
                # In float32: spikes depend on the sum over steps.
                current = encoder(x).float()
                currents[layer] = currents[layer] + current
                x, membranes[layer] = integrate_and_fire(membranes[layer] + current, self.config.threshold)
        x, flows = self.residuals(currents[3]), []
        for scale, decoder in enumerate(self.decoders):
            flow, up = decoder(x)
            flows.append(flow)
            if up is not None:
                skip = currents[2 - scale]
                assert isinstance(skip, Tensor)
                x = torch.cat([skip.to(up.dtype), up, flow.to(up.dtype)], 1)
        # Flow of a scale is in its own px.
        full = [to_size(f * (height / f.shape[-2]), height, width) for f in (flows if self.training else flows[-1:])]
        return FlowPrediction(full, kind="scales")
