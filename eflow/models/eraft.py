"""E-RAFT (Gehrig et al., "E-RAFT: Dense Optical Flow from Event Cameras", 3DV 2021), based on RAFT (Teed & Deng, ECCV
2020)."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TypeAlias, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from eflow.config import EFlowFormerConfig, EraftConfig
from eflow.data.representation import VoxelGrid
from eflow.machine import fp32
from eflow.models.contract import FlowModel, FlowPrediction, initialise
from eflow.ops.correlation import DENSE_TOKENS, DenseCorrelation, OnDemandCorrelation, channels_of, pixel_grid
from eflow.ops.resample import convex_upsample
from eflow.types import Batch

R = TypeVar("R", EraftConfig, EFlowFormerConfig)
Correlation: TypeAlias = DenseCorrelation | OnDemandCorrelation
Context: TypeAlias = "list[tuple[Tensor, Tensor]]"
"""Weights over [hidden, motion], and the contribution of the context, of each convolution of a GRU."""


@dataclass(frozen=True)
class Widths:
    """Numbers of channels.

    trunk : at 1/2, 1/4, 1/8. features : of the correlated maps. hidden : of the GRU's state, context and motion
    features. levels, radius : of the correlation look-up."""

    trunk: tuple[int, int, int]
    features: int
    hidden: int
    levels: int
    radius: int


SIZES = {
    "base": Widths((64, 96, 128), 256, 128, 4, 4),
    "small": Widths((48, 64, 96), 128, 96, 4, 3),
    "tiny": Widths((32, 48, 64), 128, 48, 3, 3),
}


def widths_of(config: EraftConfig | EFlowFormerConfig) -> Widths:
    """Return the widths of a configuration: those of its size, unless it sets them."""
    own = {f.name: getattr(config, f.name) for f in fields(Widths)}
    return replace(SIZES[config.size], **{k: v for k, v in own.items() if v is not None})


class ResidualBlock(nn.Module):
    """A residual block: two convolutions and a shortcut (He et al., CVPR 2016)."""

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
    """The CNN of RAFT, (N, inputs, H, W) -> (N, outputs, H/8, W/8). widths : channels at 1/2, 1/4, 1/8."""

    # As RAFT: instance norm for the features to correlate, batch norm for the context.
    def __init__(self, inputs: int, widths: tuple[int, int, int], outputs: int, norm: str):
        make = {"instance": nn.InstanceNorm2d, "batch": nn.BatchNorm2d}[norm]
        half, quarter, eighth = widths
        blocks = [
            ResidualBlock(a, b, s, make)
            for a, b, s in (
                (half, half, 1),
                (half, half, 1),
                (half, quarter, 2),
                (quarter, quarter, 1),
                (quarter, eighth, 2),
                (eighth, eighth, 1),
            )
        ]
        super().__init__(
            nn.Conv2d(inputs, half, 7, 2, 3), make(half), nn.ReLU(inplace=True), *blocks, nn.Conv2d(eighth, outputs, 1)
        )


class MotionEncoder(nn.Module):
    """Converts correlation taps and flow to ``hidden`` motion channels; the last two are the flow itself."""

    def __init__(self, taps: int, hidden: int):
        super().__init__()
        # 3:1 of correlation and flow features, as in RAFT's motion encoder.
        wide, narrow = hidden + hidden // 2, hidden // 2
        self.corr1, self.corr2 = nn.Conv2d(taps, 2 * hidden, 1), nn.Conv2d(2 * hidden, wide, 3, padding=1)
        self.flow1, self.flow2 = nn.Conv2d(2, hidden, 7, padding=3), nn.Conv2d(hidden, narrow, 3, padding=1)
        self.join = nn.Conv2d(wide + narrow, hidden - 2, 3, padding=1)

    def forward(self, taps: Tensor, flow: Tensor) -> Tensor:
        relu = lambda x: F.relu(x, inplace=True)
        c = relu(self.corr2(relu(self.corr1(taps))))
        f = relu(self.flow2(relu(self.flow1(flow))))
        joined = relu(self.join(torch.cat([c, f], 1)))
        # The flow itself is appended unchanged.
        return torch.cat([joined, flow.to(joined.dtype)], 1)


class SepConvGru(nn.Module):
    """GRU with 1x5, then 5x1 convolutions over [hidden, context, motion]; update and reset gates are one convolution.

    The context is the same in all iterations, so its part of every convolution is computed once (:meth:`prepare`)."""

    def __init__(self, hidden: int):
        super().__init__()
        self.hidden = hidden  # also the channels of the context and of motion
        self.gates = nn.ModuleList(
            [nn.Conv2d(3 * hidden, 2 * hidden, k, padding=p) for k, p in (((1, 5), (0, 2)), ((5, 1), (2, 0)))]
        )
        self.candidates = nn.ModuleList(
            [nn.Conv2d(3 * hidden, hidden, k, padding=p) for k, p in (((1, 5), (0, 2)), ((5, 1), (2, 0)))]
        )

    def prepare(self, context: Tensor) -> Context:
        """Return the weights over [hidden, motion] and the contribution of the context (with bias) of each
        convolution."""
        ready, first, last = [], self.hidden, 2 * self.hidden
        # Slices of each weight: [hidden | context | motion].
        for conv in (c for pair in zip(self.gates, self.candidates, strict=True) for c in pair):
            assert isinstance(conv, nn.Conv2d)
            weight = torch.cat([conv.weight[:, :first], conv.weight[:, last:]], 1)
            ready.append((weight, F.conv2d(context, conv.weight[:, first:last], conv.bias, padding=conv.padding)))
        return ready

    def forward(self, h: Tensor, ready: Context, motion: Tensor) -> Tensor:
        for i, gate in enumerate(self.gates):
            assert isinstance(gate, nn.Conv2d)
            (w_gate, c_gate), (w_new, c_new) = ready[2 * i], ready[2 * i + 1]
            # Update gate z, reset gate r; the candidate sees the reset state (Cho et al. 2014).
            z, r = torch.sigmoid(F.conv2d(torch.cat([h, motion], 1), w_gate, padding=gate.padding) + c_gate).chunk(2, 1)
            q = torch.tanh(F.conv2d(torch.cat([r * h, motion], 1), w_new, padding=gate.padding) + c_new)
            # (1 - z) h + z q.
            h = torch.lerp(h, q.to(h.dtype), z.to(h.dtype))
        return h


class Update(nn.Module):
    """One refinement step."""

    def __init__(self, taps: int, hidden: int):
        super().__init__()
        self.motion, self.gru = MotionEncoder(taps, hidden), SepConvGru(hidden)
        self.flow_head = nn.Sequential(
            nn.Conv2d(hidden, 2 * hidden, 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(2 * hidden, 2, 3, padding=1)
        )
        self.mask_head = nn.Sequential(
            nn.Conv2d(hidden, 2 * hidden, 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(2 * hidden, 9 * 64, 1)
        )

    def forward(
        self, h: Tensor, ready: Context, taps: Tensor, flow: Tensor, with_mask: bool
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return hidden state, Δflow and mask logits (None unless wanted).

        h (N, hidden, h, w); ready: of :meth:`SepConvGru.prepare`; taps (N, taps, h, w); flow (N, 2, h, w)."""
        h = self.gru(h, ready, self.motion(taps, flow))
        # 0.25 balances the gradients of the two heads, as RAFT does.
        return h, self.flow_head(h), 0.25 * self.mask_head(h) if with_mask else None


class Eraft(FlowModel[R]):
    """E-RAFT (Gehrig et al., 3DV 2021), with RAFT's arithmetic in a faster order: look-ups by one gather, the context's
    part of the GRU's convolutions once, masks and upsampling only where they are used (a test compares)."""

    Config = EraftConfig

    def __init__(self, config: R):
        super().__init__()
        self.config, self.widths = config, widths_of(config)
        w = self.widths
        # A look-up of RAFT divides by the size of a level minus one, so the top level needs two cells.
        self.divisor, self.least = 8, 8 * 2**w.levels
        if config.padding == "start":
            self.pad_to, self.pad_start = 32, True
        # Number of iterations in evaluation beyond those of training.
        unseen = max(config.iterations - config.train_iterations, 0)
        self._most = unseen if config.burn_in is None else config.burn_in
        self.representation = VoxelGrid(config.input.bins, config.input.normalise, config.input.bounds)
        self.features, self.context = self.encoders()
        self.update = Update(channels_of(w.levels, w.radius), w.hidden)
        initialise(self)
        # The first Δflow is near zero.
        last = self.update.flow_head[-1]
        assert isinstance(last, nn.Conv2d)
        nn.init.normal_(last.weight, std=1e-3)

    def forward(self, batch: Batch) -> FlowPrediction:
        """Return the flow of a batch. Optional ``batch["flow_init"]`` (N, 2, H/8, W/8): warm start, low-resolution
        px."""
        self.check_input(batch)
        correlation, seen, flow, first = self.encode(batch)
        # One CNN computes the initial state and the context of the GRU.
        h, c = seen.chunk(2, 1)
        h, c = torch.tanh(h), F.relu(c)
        flows = [] if first is None or not self.training else [first]

        grid = pixel_grid(h.shape[-2], h.shape[-1], h)
        context = self.update.gru.prepare(c)
        iterations = self.config.train_iterations if self.training else self.config.iterations
        h, flow = self._burn_in(h, flow, context, correlation, grid) if self.training else (h, flow)
        for i in range(iterations):
            # RAFT detaches the flow: gradients go through each update alone.
            flow = flow.detach()
            wanted = self.training or i == iterations - 1
            step = lambda h, flow: self.update(h, context, correlation.lookup(grid + flow), flow, wanted)  # noqa: B023
            if self.training and self.config.checkpoint_iterations:
                h, delta, mask = checkpoint(step, h, flow, use_reentrant=False)
            else:
                h, delta, mask = step(h, flow)
            # Iterations beyond those of training are damped.
            beyond = 0 if self.training else max(i + 1 - self._most - self.config.train_iterations, 0)
            with fp32(flow):
                # Flow is accumulated in fp32: bf16 would lose updates of a thousandth of a px.
                flow = flow + self.config.damping**beyond * delta.float()
            if wanted:
                flows.append(convex_upsample(flow, mask, self.config.border))
        return FlowPrediction(
            flows if self.training else flows[-1:],
            has_match=self.training and first is not None,
            low=flow,
        )

    @torch.no_grad()
    def _burn_in(
        self, h: Tensor, flow: Tensor, context: Context, correlation: Correlation, grid: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return state and flow after a random number of refinements without gradients.

        The following refinements then learn to continue from any flow, and to stay at the right one. Half of the draws
        are 0, since every prediction starts with the first refinement. The number comes from torch's generator, whose
        state is in checkpoints."""
        most = self._most
        if not most:
            return h, flow
        # Uniform over [0, 2 most): half of the draws give no refinement.
        draw = int(torch.randint(2 * most, ()))
        for _ in range(max(draw - most + 1, 0)):
            h, delta, _mask = self.update(h, context, correlation.lookup(grid + flow), flow, False)
            with fp32(flow):
                flow = flow + delta.float()
        return h, flow

    # ---- what E-FlowFormer changes -------------------------------------------------------------------------------

    def encoders(self) -> tuple[nn.Module, nn.Module]:
        """Return the CNN of the features to correlate, and that of state and context."""
        bins, w = self.config.input.bins, self.widths
        return (
            Trunk(bins, w.trunk, w.features, "instance"),
            Trunk(bins, w.trunk, 2 * w.hidden, self.config.context_norm),
        )

    def encode(self, batch: Batch) -> tuple[Correlation, Tensor, Tensor, Tensor | None]:
        """Return the correlation, state and context (N, 2 hidden, h, w) before their activations, and the two fields of
        :meth:`start`."""
        # Both windows share the weights, so they are one batch.
        f1, f2 = self.enhance(*self.features(torch.cat([batch["old"], batch["new"]])).chunk(2))
        correlation = self._correlation(f1, f2)
        return correlation, self.context(batch["new"]), *self.start(correlation, batch.get("flow_init"), f1)

    def enhance(self, f1: Tensor, f2: Tensor) -> tuple[Tensor, Tensor]:
        return f1, f2

    def start(self, correlation: Correlation, warm: Tensor | None, like: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return the initial low-resolution flow of the GRU, and the supervised full-resolution flow it came from, if
        any."""
        n, _, h, w = like.shape
        zero = torch.zeros(n, 2, h, w, device=like.device, dtype=torch.float32)
        return (zero if warm is None else zero + warm), None

    def _correlation(self, f1: Tensor, f2: Tensor) -> Correlation:
        tokens = f1.shape[-1] * f1.shape[-2]
        if self.config.correlation == "on_demand" or (self.config.correlation == "auto" and tokens > DENSE_TOKENS):
            return OnDemandCorrelation(f1, f2, self.widths.levels, self.widths.radius)
        return DenseCorrelation(f1, f2, self.widths.levels, self.widths.radius)
