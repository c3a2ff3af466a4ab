"""E-RAFT (Gehrig et al., "E-RAFT: Dense Optical Flow from Event Cameras", 3DV 2021) on RAFT
(Teed & Deng, ECCV 2020)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from eflow.config import EraftConfig
from eflow.data.representation import VoxelGrid
from eflow.models.contract import FlowModel, FlowPrediction, initialise
from eflow.ops.correlation import CHANNELS, DENSE_TOKENS, DenseCorrelation, OnDemandCorrelation, pixel_grid
from eflow.ops.precision import fp32
from eflow.ops.upsample import convex_upsample, convex_upsample_slow

FEATURES, HIDDEN, CONTEXT = 256, 128, 128


class ResidualBlock(nn.Module):
    """Two convolutions beside a shortcut (He et al., CVPR 2016)."""

    def __init__(self, inputs: int, outputs: int, stride: int, norm: type[nn.Module]):
        super().__init__()
        self.conv1, self.norm1 = nn.Conv2d(inputs, outputs, 3, stride, 1), norm(outputs)
        self.conv2, self.norm2 = nn.Conv2d(outputs, outputs, 3, 1, 1), norm(outputs)
        self.shortcut = (
            nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride), norm(outputs)) if stride > 1 else nn.Identity()
        )

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.norm1(self.conv1(x)), inplace=True)
        y = F.relu(self.norm2(self.conv2(y)), inplace=True)
        return F.relu(self.shortcut(x) + y, inplace=True)


class Trunk(nn.Sequential):
    """(N, inputs, H, W) -> (N, outputs, H/8, W/8)."""

    def __init__(self, inputs: int, outputs: int, norm: str):
        make = {"instance": nn.InstanceNorm2d, "batch": nn.BatchNorm2d}[norm]
        blocks = [
            ResidualBlock(a, b, s, make)
            for a, b, s in ((64, 64, 1), (64, 64, 1), (64, 96, 2), (96, 96, 1), (96, 128, 2), (128, 128, 1))
        ]
        super().__init__(
            nn.Conv2d(inputs, 64, 7, 2, 3), make(64), nn.ReLU(inplace=True), *blocks, nn.Conv2d(128, outputs, 1)
        )


class MotionEncoder(nn.Module):
    """Correlation taps and flow to 128 motion channels, the last two the flow itself."""

    def __init__(self):
        super().__init__()
        self.corr1, self.corr2 = nn.Conv2d(CHANNELS, 256, 1), nn.Conv2d(256, 192, 3, padding=1)
        self.flow1, self.flow2 = nn.Conv2d(2, 128, 7, padding=3), nn.Conv2d(128, 64, 3, padding=1)
        self.join = nn.Conv2d(192 + 64, 128 - 2, 3, padding=1)

    def forward(self, taps: Tensor, flow: Tensor) -> Tensor:
        relu = lambda x: F.relu(x, inplace=True)
        c = relu(self.corr2(relu(self.corr1(taps))))
        f = relu(self.flow2(relu(self.flow1(flow))))
        joined = relu(self.join(torch.cat([c, f], 1)))
        return torch.cat([joined, flow.to(joined.dtype)], 1)


class SepConvGru(nn.Module):
    """GRU with 1x5, then 5x1 convolutions over [hidden, context, motion]; update and reset gates share one convolution.

    The context does not change over the iterations, so its third of every convolution is computed
    once (:meth:`prepare`)."""

    def __init__(self):
        super().__init__()
        inputs = HIDDEN + CONTEXT + 128
        self.gates = nn.ModuleList(
            [nn.Conv2d(inputs, 2 * HIDDEN, k, padding=p) for k, p in (((1, 5), (0, 2)), ((5, 1), (2, 0)))]
        )
        self.candidates = nn.ModuleList(
            [nn.Conv2d(inputs, HIDDEN, k, padding=p) for k, p in (((1, 5), (0, 2)), ((5, 1), (2, 0)))]
        )

    def prepare(self, context: Tensor) -> list[tuple[Tensor, Tensor]]:
        """For each convolution, its weights over [hidden, motion] and the context's contribution (bias included)."""
        ready = []
        for conv in (c for pair in zip(self.gates, self.candidates, strict=True) for c in pair):
            weight = torch.cat([conv.weight[:, :HIDDEN], conv.weight[:, HIDDEN + CONTEXT :]], 1)
            ready.append(
                (weight, F.conv2d(context, conv.weight[:, HIDDEN : HIDDEN + CONTEXT], conv.bias, padding=conv.padding))
            )
        return ready

    def forward(self, h: Tensor, ready: list[tuple[Tensor, Tensor]], motion: Tensor) -> Tensor:
        for i, gate in enumerate(self.gates):
            (w_gate, c_gate), (w_new, c_new) = ready[2 * i], ready[2 * i + 1]
            z, r = torch.sigmoid(F.conv2d(torch.cat([h, motion], 1), w_gate, padding=gate.padding) + c_gate).chunk(2, 1)
            q = torch.tanh(F.conv2d(torch.cat([r * h, motion], 1), w_new, padding=gate.padding) + c_new)
            h = torch.lerp(h, q.to(h.dtype), z.to(h.dtype))
        return h

    def forward_slow(self, h: Tensor, context: Tensor, motion: Tensor) -> Tensor:
        """The twin: every convolution over everything."""
        for gate, candidate in zip(self.gates, self.candidates, strict=True):
            z, r = torch.sigmoid(gate(torch.cat([h, context, motion], 1))).chunk(2, 1)
            q = torch.tanh(candidate(torch.cat([r * h, context, motion], 1)))
            h = (1 - z) * h + z * q
        return h


class Update(nn.Module):
    """One refinement step."""

    def __init__(self):
        super().__init__()
        self.motion, self.gru = MotionEncoder(), SepConvGru()
        self.flow_head = nn.Sequential(
            nn.Conv2d(HIDDEN, 256, 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(256, 2, 3, padding=1)
        )
        self.mask_head = nn.Sequential(
            nn.Conv2d(HIDDEN, 256, 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(256, 9 * 64, 1)
        )

    def forward(
        self, h: Tensor, context, taps: Tensor, flow: Tensor, with_mask: bool
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """h (N, 128, h, w), context: :meth:`SepConvGru.prepare`'s result (or the context itself: the slow twin), taps
        (N, 324, h, w), flow (N, 2, h, w) -> hidden, Δflow, mask logits (None unless wanted)."""
        motion = self.motion(taps, flow)
        h = self.gru.forward_slow(h, context, motion) if isinstance(context, Tensor) else self.gru(h, context, motion)
        # 0.25 balances the gradients of the two heads, as RAFT does.
        return h, self.flow_head(h), 0.25 * self.mask_head(h) if with_mask else None


class Eraft(FlowModel):
    """E-RAFT. ``plain = True`` switches to the RAFT-style slow twin of lookup, GRU, mask head and upsampling."""

    divisor, least = 8, 128  # below 128 px the top of the pyramid has one cell

    def __init__(self, config):
        super().__init__()
        self.config: EraftConfig = config
        self.representation = VoxelGrid(config.input.bins, config.input.normalise, config.input.bounds)
        self.features = Trunk(config.input.bins, FEATURES, "instance")
        self.context = Trunk(config.input.bins, HIDDEN + CONTEXT, config.context_norm)
        self.update = Update()
        self.plain = False
        initialise(self)
        # The first Δflows are near zero, whatever the depth.
        nn.init.normal_(self.update.flow_head[-1].weight, std=1e-3)

    def forward(self, batch: dict) -> FlowPrediction:
        """Optional ``batch["flow_init"]`` (N, 2, H/8, W/8): warm start, low-resolution px."""
        self.check_input(batch)
        f1, f2 = self.enhance(*self.features(torch.cat([batch["old"], batch["new"]])).chunk(2))
        h, c = self.context(batch["new"]).split([HIDDEN, CONTEXT], 1)
        h, c = torch.tanh(h), F.relu(c)
        correlation = self._correlation(f1, f2)
        flow, first = self.start(correlation, batch.get("flow_init"), f1)
        flows = [] if first is None or not self.training else [first]

        grid = pixel_grid(*f1.shape[-2:], f1)
        context = c if self.plain else self.update.gru.prepare(c)
        iterations = self.config.train_iterations if self.training else self.config.iterations
        for i in range(iterations):
            flow = flow.detach()
            wanted = self.training or self.plain or i == iterations - 1
            step = lambda h, flow: self.update(h, context, correlation.lookup(grid + flow), flow, wanted)  # noqa: B023
            if self.training and self.config.checkpoint_iterations:
                h, delta, mask = checkpoint(step, h, flow, use_reentrant=False)
            else:
                h, delta, mask = step(h, flow)
            with fp32(flow):
                flow = flow + delta.float()
            if wanted:
                flows.append((convex_upsample_slow if self.plain else convex_upsample)(flow, mask))
        return FlowPrediction(
            flows if self.training else flows[-1:],
            has_match=self.training and first is not None,
            low=flow,
            backward_match=self.backward(correlation),
        )

    # ---- what E-FlowFormer changes -------------------------------------------------------------------------------

    def enhance(self, f1: Tensor, f2: Tensor) -> tuple[Tensor, Tensor]:
        return f1, f2

    def start(self, correlation, warm: Tensor | None, like: Tensor) -> tuple[Tensor, Tensor | None]:
        """Low-resolution flow the GRU starts from, and the supervised full-resolution field it came from, if any."""
        n, _, h, w = like.shape
        zero = torch.zeros(n, 2, h, w, device=like.device, dtype=torch.float32)
        return (zero if warm is None else zero + warm), None

    def backward(self, correlation) -> Tensor | None:
        return None

    def _correlation(self, f1: Tensor, f2: Tensor):
        tokens = f1.shape[-1] * f1.shape[-2]
        if self.config.correlation == "on_demand" or (self.config.correlation == "auto" and tokens > DENSE_TOKENS):
            return OnDemandCorrelation(f1, f2)
        return DenseCorrelation(f1, f2, slow=self.plain)
