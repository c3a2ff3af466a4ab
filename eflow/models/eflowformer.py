"""E-FlowFormer (Li et al., "BlinkFlow", IROS 2023): E-RAFT with features enhanced by a transformer, and a supervised
matching layer."""

from __future__ import annotations

import itertools
import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from eflow.config import EFlowFormerConfig
from eflow.machine import runs_once
from eflow.models.contract import initialise
from eflow.models.eraft import Correlation, Eraft
from eflow.models.unets import Consensus, Residual, double, seen_cells
from eflow.ops.attention import ConditionalPosition, GlobalAttention, WindowAttention, sine_position
from eflow.ops.correlation import channels_of, pixel_grid
from eflow.ops.resample import bilinear_upsample
from eflow.types import Batch

LAYERS = {"base": 4, "small": 2, "tiny": 1}
WINDOW, REDUCTION, MLP_RATIO, PER_HEAD = 10, 4, 4, 32

START_GAIN = 0.25
RATE = 20.0
"""Prior and gain learn faster by this factor than their logarithms would."""
_TOKENS = 1024


class Mlp(nn.Sequential):
    """Norm, linear layer to four times the channels, GELU, linear layer. Without gradients it processes blocks of
    tokens, whose hidden layer stays in the cache."""

    def __init__(self, dim: int):
        super().__init__(
            nn.LayerNorm(dim),
            nn.Linear(dim, MLP_RATIO * dim),
            nn.GELU(),
            nn.Linear(MLP_RATIO * dim, dim),
        )

    def forward(self, input: Tensor) -> Tensor:
        # Gradients need the hidden layers anyway, and a GPU is faster without blocks.
        if not runs_once(input):
            return super().forward(input)
        blocks = input.reshape(-1, input.shape[-1]).split(_TOKENS)
        return torch.cat([super(Mlp, self).forward(block) for block in blocks]).view(input.shape)


class EnhancementLayer(nn.Module):
    """Local self-attention, conditional position, global self-attention, MLP, global cross-attention, MLP; with pre-
    norm.

    twins : an MLP after the local attention, too, and keys reduced by a dense convolution, as in Twins-SVT."""

    def __init__(self, dim: int, twins: bool):
        super().__init__()
        # The largest number that divides the channels: 4 of 128, 2 of 112.
        heads = next(k for k in range(max(dim // PER_HEAD, 1), 0, -1) if dim % k == 0)
        self.norm_local, self.local = nn.LayerNorm(dim), WindowAttention(dim, heads, WINDOW)
        self.mlp_local = Mlp(dim) if twins else None
        self.position = ConditionalPosition(dim)
        self.norm_global, self.globally = nn.LayerNorm(dim), GlobalAttention(dim, heads, REDUCTION, dense=twins)
        self.mlp_global = Mlp(dim)
        self.norm_cross, self.cross = nn.LayerNorm(dim), GlobalAttention(dim, heads, REDUCTION, dense=twins)
        self.mlp_cross = Mlp(dim)

    def forward(self, x: Tensor) -> Tensor:
        """Return x (2N, h, w, C) enhanced: features of the old windows, then of the new ones. In cross-attention each
        half queries the other."""
        x = x + self.local(self.norm_local(x))
        if self.mlp_local is not None:
            x = x + self.mlp_local(x)
        x = self.position(x)
        y = self.norm_global(x)
        x = x + self.globally(y, y)
        x = x + self.mlp_global(x)
        y = self.norm_cross(x)
        # The halves exchanged: old queries new, new queries old.
        x = x + self.cross(y, torch.cat(y.chunk(2)[::-1]))
        return x + self.mlp_cross(x)


class QuickContext(nn.Module):
    """A U-Net with one more scale. It reads the features of both windows at 1/8 and the correlation around zero flow,
    and returns state and context of the GRU and a first flow. An affine field fitted at the coarsest scale carries
    motion to areas without events (:class:`~eflow.models.unets.Consensus`); only cells near events weigh in it."""

    def __init__(self, features: int, taps: int, hidden: int):
        super().__init__()
        seen, deep = 3 * features, 2 * features
        self.cost = nn.Conv2d(taps, features, 1)
        self.down = nn.Conv2d(seen, deep, 3, 2, 1)
        self.deep = nn.Sequential(Residual(deep), Consensus(deep), Residual(deep))
        self.up = nn.Conv2d(deep + seen, 2 * hidden, 3, padding=1)
        self.context, self.flow = (nn.Conv2d(2 * hidden, c, 3, padding=1) for c in (2 * hidden, 2))

    def forward(self, old: Tensor, new: Tensor, taps: Tensor, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Return state and context (N, 2 hidden, h, w) and flow (N, 2, h, w), px of 1/8, of features, correlation
        and the cells of 16 px that have events nearby, (N, 1, h / 2, w / 2) rounded up."""
        seen = torch.cat([new, old, F.relu(self.cost(taps))], 1)
        before, consensus, after = self.deep
        deep = after(consensus(before(F.relu(self.down(seen))), cells))
        # Half of an odd size is rounded up, so the doubled map is cut.
        deep = double(deep)[..., : seen.shape[-2], : seen.shape[-1]]
        both = F.relu(self.up(torch.cat([deep, seen], 1)))
        return self.context(both), self.flow(both).float()


class EFlowFormer(Eraft[EFlowFormerConfig]):
    """E-FlowFormer. With ``layers=0`` and ``init="zero"`` it is E-RAFT, with the same names of parameters.

    With ``quick`` it has the same correlation, layers (none by default) and GRU, but cheaper encoders and another
    initial flow."""

    Config = EFlowFormerConfig

    def __init__(self, config: EFlowFormerConfig):
        super().__init__(config)
        count = config.layers
        if count is None:
            count = 0 if config.quick else LAYERS[config.size]
        dim = self.widths.features
        self.layers = nn.ModuleList([EnhancementLayer(dim, config.attention == "twins") for _ in range(count)])
        self.norm = nn.LayerNorm(dim) if count else None
        self.log_prior = self.log_gain = None
        self.project = None
        if config.quick:
            self.project = nn.Conv2d(self.widths.trunk[-1], dim, 1)
            initialise(self.project)
            assert isinstance(self.context, QuickContext)
            nn.init.normal_(self.context.flow.weight, std=1e-3)  # its flow is near zero at the start
        elif config.init == "match" and config.match_prior is not None:
            # A displacement of match_prior cells lowers the logit by 1/2: the factor is 1 / (2 sigma^2).
            # Logits of untrained features differ by about 1; the gain makes them small beside the prior.
            self.log_prior = nn.Parameter(torch.tensor(-math.log(2 * config.match_prior**2) / RATE))
            self.log_gain = nn.Parameter(torch.tensor(math.log(START_GAIN) / RATE))
        initialise(self.layers)

    def encoders(self) -> tuple[nn.Module, nn.Module]:
        if not self.config.quick:
            return super().encoders()
        w = self.widths
        widths = itertools.pairwise((self.config.input.bins, *w.trunk))
        layers = [part for a, b in widths for part in (nn.Conv2d(a, b, 3, 2, 1), nn.ReLU(inplace=True))]
        return nn.Sequential(*layers), QuickContext(w.trunk[-1], channels_of(w.levels, w.radius), w.hidden)

    def encode(self, batch: Batch) -> tuple[Correlation, Tensor, Tensor, Tensor | None]:
        if self.project is None:
            return super().encode(batch)
        both = self.features(torch.cat([batch["old"], batch["new"]]))
        correlation = self._correlation(*self.enhance(*self.project(both).chunk(2)))
        old, new = both.chunk(2)
        still = pixel_grid(old.shape[-2], old.shape[-1], old).expand(len(old), -1, -1, -1)
        cells = seen_cells(torch.cat([batch["old"], batch["new"]], 1), 16)
        seen, flow = self.context(old, new, correlation.lookup(still), cells)
        first, warm = bilinear_upsample(flow) if self.training else None, batch.get("flow_init")
        return correlation, seen, flow if warm is None else warm, first

    def enhance(self, f1: Tensor, f2: Tensor) -> tuple[Tensor, Tensor]:
        if self.norm is None:
            return f1, f2
        x = torch.cat([f1, f2])
        # Channels last for attention, after the position code is added.
        x = (x + sine_position(x.shape[-2], x.shape[-1], x.shape[1], x).to(x.dtype)).permute(0, 2, 3, 1)
        for layer in self.layers:
            x = layer(x)
        return self.norm(x).permute(0, 3, 1, 2).chunk(2)

    def start(self, correlation: Correlation, warm: Tensor | None, like: Tensor) -> tuple[Tensor, Tensor | None]:
        if self.config.init == "zero":
            return super().start(correlation, warm, like)
        matched = correlation.match(*self._prior())
        # matched * 0 keeps the matching layer in the graph, so that all parameters have a gradient.
        return (matched if warm is None else matched * 0 + warm), bilinear_upsample(matched) if self.training else None

    def _prior(self) -> tuple[Tensor | None, Tensor | None]:
        """Return the cost of a displacement and the gain of the logits, both learnt: without them the softmax of
        features that know nothing yet is flat, and its expectation the middle of the image, far worse than no
        flow at all."""
        if self.log_prior is None or self.log_gain is None:
            return None, None
        # Logarithms keep both positive.
        return (RATE * self.log_prior.float()).exp(), (RATE * self.log_gain.float()).exp()
