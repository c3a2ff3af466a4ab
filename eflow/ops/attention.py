"""Spatially separable attention (Twins-SVT, Chu et al., NeurIPS 2021): inside local windows, and from all tokens to
sub-sampled keys.

Maps are (N, h, w, C). They are padded to multiples of the window, and padded tokens are masked as keys, since zero
tokens in a softmax would weaken the others.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class WindowAttention(nn.Module):
    """Multi-head self-attention inside ``window`` x ``window`` squares."""

    def __init__(self, dim: int, heads: int, window: int):
        super().__init__()
        self.heads, self.window = heads, window
        self.qkv, self.proj = nn.Linear(dim, 3 * dim), nn.Linear(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        n, h, w, c = x.shape
        s = self.window
        # -h % s is the padding up to the next multiple.
        down, right = -h % s, -w % s
        x = F.pad(x, (0, 0, 0, right, 0, down))
        rows, columns = (h + down) // s, (w + right) // s
        # Tokens as windows of s x s: split both axes, then put the two window axes together.
        tokens = x.view(n, rows, s, columns, s, c).transpose(2, 3).reshape(n * rows * columns, s * s, c)
        q, k, v = self.qkv(tokens).view(len(tokens), s * s, 3, self.heads, c // self.heads).permute(2, 0, 3, 1, 4)
        mask = None
        # While compiling, the size is unknown and may need the mask.
        if torch.compiler.is_compiling() or down or right:
            # True where a key is a real token, the same for all queries of a window.
            tall = torch.arange(rows * s, device=x.device) < h
            real = tall[:, None] & (torch.arange(columns * s, device=x.device) < w)
            real = real.view(rows, s, columns, s).transpose(1, 2).reshape(1, rows * columns, 1, 1, s * s)
            mask = real.expand(n, -1, 1, s * s, -1).reshape(n * rows * columns, 1, s * s, s * s)
        # softmax(q k^T / sqrt(d)) v, per head.
        out = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        out = self.proj(out.transpose(1, 2).reshape(len(tokens), s * s, c))
        return out.view(n, rows, columns, s, s, c).transpose(2, 3).reshape(n, rows * s, columns * s, c)[:, :h, :w]


class GlobalAttention(nn.Module):
    """Attention from every token of ``x`` to a sub-sampled map of ``source`` (itself, or the other window's features).

    The reduction is a strided convolution, depth-wise or dense, and a layer norm."""

    def __init__(self, dim: int, heads: int, reduction: int, dense: bool):
        super().__init__()
        self.heads, self.reduction = heads, reduction
        self.q, self.kv, self.proj = nn.Linear(dim, dim), nn.Linear(dim, 2 * dim), nn.Linear(dim, dim)
        self.reduce = nn.Conv2d(dim, dim, reduction, reduction, groups=1 if dense else dim)
        self.norm = nn.LayerNorm(dim)

    def forward(self, x: Tensor, source: Tensor) -> Tensor:
        n, h, w, c = x.shape
        # One key for each block of r x r tokens.
        r = self.reduction
        # At most r - 1 rows are padded, so that every reduced cell holds a real token and no key needs masking.
        padded = F.pad(source, (0, 0, 0, -w % r, 0, -h % r))
        keys = self.norm(self.reduce(padded.permute(0, 3, 1, 2)).permute(0, 2, 3, 1).reshape(n, -1, c))
        split = lambda t: t.view(n, -1, self.heads, c // self.heads).transpose(1, 2)
        k, v = self.kv(keys).chunk(2, -1)
        out = F.scaled_dot_product_attention(split(self.q(x.reshape(n, h * w, c))), split(k), split(v))
        return self.proj(out.transpose(1, 2).reshape(n, h, w, c))


class ConditionalPosition(nn.Module):
    """x + depth-wise 3x3 convolution of x (Chu et al., "Conditional Positional Encodings")."""

    def __init__(self, dim: int):
        super().__init__()
        self.conv = nn.Conv2d(dim, dim, 3, padding=1, groups=dim)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)


def sine_position(h: int, w: int, dim: int, like: Tensor) -> Tensor:
    """Return a 2-D sine code (1, dim, h, w) (Parmar et al.; layout of DETR): sine and cosine of y, then of x, at dim/4
    wavelengths from 2π to 2π·10^4 tokens. It is not normalised by the size, so that a crop and the full frame have the
    same periods."""
    k = torch.arange(dim // 4, device=like.device, dtype=torch.float32)
    # Wavelengths 2 pi 10^(4 k / K): the exponent falls linearly with k.
    rate = torch.exp(-math.log(1e4) * k / (dim // 4))
    y = torch.arange(h, device=like.device, dtype=torch.float32)[None] * rate[:, None]
    x = torch.arange(w, device=like.device, dtype=torch.float32)[None] * rate[:, None]
    # Rows depend on y alone, columns on x alone.
    rows = torch.cat([y.sin(), y.cos()])[:, :, None].expand(-1, -1, w)
    columns = torch.cat([x.sin(), x.cos()])[:, None, :].expand(-1, h, -1)
    return torch.cat([rows, columns])[None]
