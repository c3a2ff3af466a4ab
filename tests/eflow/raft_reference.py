"""RAFT's arithmetic as its paper and code have it (Teed & Deng, ECCV 2020), slow and obvious: the oracle of eflow's
faster order."""

import torch
import torch.nn.functional as F
from torch import Tensor

from eflow.models import eraft
from eflow.ops.correlation import DenseCorrelation


def lookup(levels: list[Tensor], coords: Tensor, radius: int = 4) -> Tensor:
    """Return the taps (N, taps, h, w): (2r+1)^2 bilinear grid samples per token and level.

    The normalisation divides by the size of a level minus 1, so levels of one cell would be NaN (inputs below 128 px
    with four levels); the models refuse such inputs."""
    n, _, h, w = coords.shape
    d = torch.arange(-radius, radius + 1, device=coords.device, dtype=coords.dtype)
    dy, dx = torch.meshgrid(d, d, indexing="ij")
    taps = []
    for level, volume in enumerate(levels):
        centre = coords.permute(0, 2, 3, 1).reshape(-1, 1, 1, 2) / 2**level
        at = centre + torch.stack([dx, dy], -1)[None]
        size = torch.tensor([volume.shape[-1] - 1, volume.shape[-2] - 1], device=coords.device, dtype=coords.dtype)
        # grid_sample takes -1 to 1 between the centres of the outermost cells (align_corners=True).
        sampled = F.grid_sample(volume[:, None], 2 * at / size - 1, align_corners=True)
        taps.append(sampled.view(n, h, w, -1))
    return torch.cat(taps, -1).permute(0, 3, 1, 2).contiguous()


class SampledCorrelation(DenseCorrelation):
    """The volume, looked up by grid samples."""

    def lookup(self, coords: Tensor) -> Tensor:
        return lookup(self.levels, coords, self.radius)


def convex_upsample(flow: Tensor, mask: Tensor, border: str = "replicate") -> Tensor:
    """Unfold, one large product, one permutation."""
    n, _, h, w = flow.shape
    weights = torch.softmax(mask.float().view(n, 1, 9, 8, 8, h, w), dim=2)
    padded = F.pad(8 * flow.float(), (1, 1, 1, 1), mode={"replicate": "replicate", "zero": "constant"}[border])
    patches = F.unfold(padded, [3, 3]).view(n, 2, 9, 1, 1, h, w)
    fine = torch.sum(weights * patches, dim=2).permute(0, 1, 4, 2, 5, 3)
    return fine.reshape(n, 2, 8 * h, 8 * w)


def gru(self, h: Tensor, context: Tensor, motion: Tensor) -> Tensor:
    """Every convolution over all channels."""
    for gate, candidate in zip(self.gates, self.candidates, strict=True):
        z, r = torch.sigmoid(gate(torch.cat([h, context, motion], 1))).chunk(2, 1)
        q = torch.tanh(candidate(torch.cat([r * h, context, motion], 1)))
        h = (1 - z) * h + z * q
    return h


def as_raft(patch, model) -> None:
    """Make ``model`` compute as RAFT does, with a mask in every iteration. patch : pytest's monkeypatch."""
    cell, update, widths = model.update.gru, model.update.forward, model.widths
    patch.setattr(cell, "prepare", lambda context: context)
    patch.setattr(cell, "forward", lambda h, context, motion: gru(cell, h, context, motion))
    patch.setattr(model.update, "forward", lambda h, ready, taps, flow, with_mask: update(h, ready, taps, flow, True))
    patch.setattr(model, "_correlation", lambda a, b: SampledCorrelation(a, b, widths.levels, widths.radius))
    patch.setattr(eraft, "convex_upsample", convex_upsample)
