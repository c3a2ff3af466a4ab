"""All-pairs correlation, its lookup, and the matching layer.

The volume of feature maps f1, f2 (N, D, h, w) is C[i, j] = <f1_i, f2_j> / sqrt(D); its pyramid average-pools the target
axis; a lookup reads (2r+1)^2 bilinear taps around a target coordinate on each level (RAFT, Teed & Deng, ECCV 2020,
sec. 3.2).

Two implementations give the same taps, those of RAFT's 81 grid samples (a test compares):
- dense: one (2r+2)^2 integer gather per token and level. All taps share one sub-pixel fraction, so they are one 2-D
  interpolation of the patch. It is differentiable on any device; on the CPU without gradients a numba kernel does it.
- on demand: the correlations of the patch are computed from pooled features at look-up; memory is linear in tokens.
"""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from blinkgl.machine.kernels import kernel
from eflow.machine import fp32, runs_once

# Largest number of tokens with a dense volume, whose memory grows with their square.
DENSE_TOKENS = 8192
# Tokens per block of an on-demand look-up, and rows per block of the matching layer.
_CHUNK, _ROWS = 2048, 256


def channels_of(levels: int, radius: int) -> int:
    """Return the number of taps of a look-up."""
    return levels * (2 * radius + 1) ** 2


def pixel_grid(h: int, w: int, like: Tensor) -> Tensor:
    """Return coordinates (x, y), (1, 2, h, w) float32."""
    y, x = torch.meshgrid(
        torch.arange(h, device=like.device, dtype=torch.float32),
        torch.arange(w, device=like.device, dtype=torch.float32),
        indexing="ij",
    )
    return torch.stack([x, y])[None]


class DenseCorrelation:
    """The whole volume in memory, (N h w, h, w) fp32, and its pooled levels. The product is fp32 even under autocast:
    in bf16 a match can be wrong by a quarter of a pixel."""

    def __init__(self, f1: Tensor, f2: Tensor, levels: int = 4, radius: int = 4):
        n, d, h, w = f1.shape
        self.shape, self.radius = (n, h, w), radius
        # 1 / sqrt(D) keeps the products' spread independent of D (RAFT, section 3.2).
        with fp32(f1):
            scaled = f1.float().flatten(2).transpose(1, 2) * (1 / math.sqrt(d))
            self.volume = torch.bmm(scaled, f2.float().flatten(2))
            self.levels = [self.volume.view(n * h * w, 1, h, w)]
            for _ in range(levels - 1):
                # Only the target's axes are pooled: every source pixel keeps its own row.
                self.levels.append(F.avg_pool2d(self.levels[-1], 2))
        self.levels = [v.squeeze(1) for v in self.levels]

    def lookup(self, coords: Tensor) -> Tensor:
        """Return the taps (N, taps, h, w) fp32 around target coordinates (N, 2, h, w) fp32.

        Channel (level*side + dy)*side + dx with side = 2r+1; zero outside the image."""
        if runs_once(coords):
            return _lookup_cpu(self.levels, coords, self.radius)
        n, h, w = self.shape
        flat = coords.permute(0, 2, 3, 1).reshape(-1, 2)
        taps = []
        # Coordinates of a level are those of full resolution divided by its scale.
        for level, volume in enumerate(self.levels):
            index, inside, fraction = patch_index(flat / 2**level, volume.shape[-2], volume.shape[-1], self.radius)
            # ``inside`` sets taps outside the image to 0: their clamped index reads another pixel.
            patch = volume.flatten(1).gather(1, index.flatten(1)).view_as(inside) * inside
            taps.append(lerp_patch(patch, fraction))
        return torch.cat(taps, 1).view(n, h, w, -1).permute(0, 3, 1, 2)

    def match(self, prior: Tensor | None = None, gain: Tensor | None = None) -> Tensor:
        """Return the flow of the matching layer, see :func:`expected_flow`."""
        _, h, w = self.shape
        return expected_flow(self.volume, h, w, prior, gain)


class OnDemandCorrelation:
    """Correlation without a volume: memory is linear in the number of tokens; a look-up computes (2r+2)^2 dot products
    per token and level."""

    def __init__(self, f1: Tensor, f2: Tensor, levels: int = 4, radius: int = 4):
        n, d, h, w = f1.shape
        self.shape, self.radius = (n, h, w), radius
        with fp32(f1):
            self.f1 = f1.float().flatten(2).transpose(1, 2) / math.sqrt(d)  # (N, hw, D)
            pooled, self.levels = f2.float(), []
            for level in range(levels):
                pooled = F.avg_pool2d(pooled, 2) if level else pooled
                # Pooling is linear: <f1, pool f2> = pool <f1, f2>.
                self.levels.append(pooled)

    def lookup(self, coords: Tensor) -> Tensor:
        """Return what :meth:`DenseCorrelation.lookup` returns."""
        n, h, w = self.shape
        flat = coords.permute(0, 2, 3, 1).reshape(n, h * w, 2)
        with fp32(coords):
            rows = []
            # In blocks of source tokens, so that the gathered patches stay small.
            for start in range(0, h * w, _CHUNK):
                part, taps = slice(start, start + _CHUNK), []
                for level, f2 in enumerate(self.levels):
                    at = flat[:, part].reshape(-1, 2) / 2**level
                    index, inside, fraction = patch_index(at, f2.shape[-2], f2.shape[-1], self.radius)
                    tokens = f2.flatten(2).transpose(1, 2)  # (N, cells, D)
                    picked = torch.stack(
                        [
                            t[i]
                            for t, i in zip(tokens, index.view(n, -1, index.shape[-1] * index.shape[-2]), strict=True)
                        ]
                    )
                    # The dot product with each of the patch's (2r + 2)^2 features.
                    patch = torch.einsum("ntd,ntkd->ntk", self.f1[:, part], picked)
                    taps.append(lerp_patch(patch.reshape(inside.shape) * inside, fraction))
                row = torch.cat(taps, 1)
                rows.append(row.view(n, -1, row.shape[1]))
            return torch.cat(rows, 1).view(n, h, w, -1).permute(0, 3, 1, 2)

    def match(self, prior: Tensor | None = None, gain: Tensor | None = None) -> Tensor:
        """Return what :meth:`DenseCorrelation.match` returns."""
        source, target = self.f1, self.levels[0].flatten(2)
        n, h, w = self.shape
        with fp32(source):
            parts = [
                expected_position(source[:, s : s + _CHUNK] @ target, h, w, prior, gain, s)
                for s in range(0, h * w, _CHUNK)
            ]
            return torch.cat(parts, 2).view(n, 2, h, w) - pixel_grid(h, w, target)


def expected_flow(volume: Tensor, h: int, w: int, prior: Tensor | None = None, gain: Tensor | None = None) -> Tensor:
    """Return the flow of the matching layer, (N, 2, h, w) low-resolution px, fp32: V0 = E_P[coords] - grid, with P the
    softmax of each row of ``volume`` (N, hw, hw) over the targets. prior, gain : see :func:`expected_position`."""
    with fp32(volume):
        return expected_position(volume, h, w, prior, gain).view(-1, 2, h, w) - pixel_grid(h, w, volume)


def expected_position(
    logits: Tensor, h: int, w: int, prior: Tensor | None = None, gain: Tensor | None = None, first: int = 0
) -> Tensor:
    """Return the expected (x, y), (N, 2, rows), of logits (N, rows, h*w). It is computed from the marginals, by sums,
    which do not use TF32 or bf16 products.

    gain : () factor of the logits.   prior : () cost of a displacement, 1/cells²: ``prior`` times its squared length is
    subtracted from the logit of a target.   first : token of the first row."""
    # Blocks of rows that fit the cache.
    if not torch.is_grad_enabled() and not torch.compiler.is_compiling() and logits.shape[1] > _ROWS:
        parts = [
            expected_position(logits[:, s : s + _ROWS], h, w, prior, gain, first + s)
            for s in range(0, logits.shape[1], _ROWS)
        ]
        return torch.cat(parts, 2)
    x = torch.arange(w, device=logits.device, dtype=torch.float32)
    y = torch.arange(h, device=logits.device, dtype=torch.float32)
    logits = logits.float() if gain is None else gain * logits.float()
    if prior is not None:
        token = torch.arange(first, first + logits.shape[1], device=logits.device)
        # Squared distances from each source token, along x and along y.
        across, down = ((x - (token % w)[:, None]) ** 2, (y - (token // w)[:, None]) ** 2)
        far = (down[:, :, None] + across[:, None]).flatten(1)
        logits = logits - prior.float() * far
    # E[x] from the sum over y, and E[y] from the sum over x.
    p = logits.softmax(-1).unflatten(-1, (h, w))
    return torch.stack([(p.sum(-2) * x).sum(-1), (p.sum(-1) * y).sum(-1)], 1)


def patch_index(coords: Tensor, h: int, w: int, radius: int = 4) -> tuple[Tensor, Tensor, Tensor]:
    """Return flat indices (M, 2r+2, 2r+2) of the patches floor(c) - r … floor(c) + r + 1 around coords c (M, 2),
    clamped into h x w; which of them are inside, (M, 2r+2, 2r+2) bool; and the fractions (M, 2)."""
    # Beyond this every tap is outside; the clamp also keeps integers defined for diverging flow.
    x, y = (coords[:, k].clamp(-(radius + 2.0), size + radius + 1.0) for k, size in ((0, w), (1, h)))
    coords = torch.stack([x, y], 1)
    base = coords.floor()
    # 2r + 2 integer taps contain the neighbours of all 2r + 1 bilinear ones.
    offsets = torch.arange(-radius, radius + 2, device=coords.device)
    ix, iy = (base[:, k].long()[:, None] + offsets for k in (0, 1))
    inside = ((iy >= 0) & (iy < h))[:, :, None] & ((ix >= 0) & (ix < w))[:, None, :]
    return iy.clamp(0, h - 1)[:, :, None] * w + ix.clamp(0, w - 1)[:, None, :], inside, coords - base


def lerp_patch(patch: Tensor, fraction: Tensor) -> Tensor:
    """Return bilinear taps (M, (2r+1)^2) of integer taps (M, 2r+2, 2r+2) and fractions (M, 2)."""
    fx, fy = fraction[:, 0, None, None], fraction[:, 1, None, None]
    # All taps share the fraction, so the patch is interpolated as a whole, first in y, then in x.
    rows = torch.lerp(patch[:, :-1], patch[:, 1:], fy)
    return torch.lerp(rows[:, :, :-1], rows[:, :, 1:], fx).flatten(1)


def _lookup_cpu(levels: list[Tensor], coords: Tensor, radius: int) -> Tensor:
    n, _, h, w = coords.shape
    flat = coords.detach().permute(0, 2, 3, 1).reshape(-1, 2).contiguous().numpy()
    out = np.empty((len(flat), channels_of(len(levels), radius)), np.float32)
    for level, volume in enumerate(levels):
        _taps(volume.detach().numpy(), flat, np.float32(0.5**level), radius, level * (2 * radius + 1) ** 2, out)
    return torch.from_numpy(out).view(n, h, w, -1).permute(0, 3, 1, 2)


@kernel
def _taps(volume, coords, scale, radius, first, out):
    _, h, w = volume.shape
    side = 2 * radius + 1
    patch = np.empty((side + 1, side + 1), np.float32)
    for m in range(len(coords)):
        x = min(max(coords[m, 0] * scale, np.float32(-radius - 2)), np.float32(w + radius + 1))
        y = min(max(coords[m, 1] * scale, np.float32(-radius - 2)), np.float32(h + radius + 1))
        # NaN gives NaN, as in the other implementations.
        if not (np.isfinite(x) and np.isfinite(y)):
            out[m, first : first + side * side] = np.nan
            continue
        bx, by = np.floor(x), np.floor(y)
        fx, fy = x - bx, y - by
        left, top = int(bx) - radius, int(by) - radius
        # The whole patch is inside: no test per tap.
        if left >= 0 and top >= 0 and left + side < w and top + side < h:
            for j in range(side + 1):
                for i in range(side + 1):
                    patch[j, i] = volume[m, top + j, left + i]
        else:
            for j in range(side + 1):
                for i in range(side + 1):
                    yy, xx = top + j, left + i
                    patch[j, i] = volume[m, yy, xx] if 0 <= yy < h and 0 <= xx < w else np.float32(0)
        # The same order of interpolation as lerp_patch.
        for j in range(side):
            for i in range(side):
                a = patch[j, i] + fy * (patch[j + 1, i] - patch[j, i])
                b = patch[j, i + 1] + fy * (patch[j + 1, i + 1] - patch[j, i + 1])
                out[m, first + j * side + i] = a + fx * (b - a)


def local_correlation(f1: Tensor, f2: Tensor, radius: int = 4) -> Tensor:
    """Return <f1(x), f2(x + d)> / D for |d| <= radius, (N, (2r+1)^2, h, w), with rows of dy and zeros outside (the 9x9
    cost of STE-FlowNet)."""
    h, w = f1.shape[-2:]
    # With zeros around f2 every displacement is a slice of it.
    padded = F.pad(f2, (radius,) * 4)
    side = 2 * radius + 1
    return torch.stack(
        [(f1 * padded[..., dy : dy + h, dx : dx + w]).mean(1) for dy in range(side) for dx in range(side)], 1
    )
