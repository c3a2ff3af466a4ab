"""Upsampling of flow to full resolution, by learned convex combinations (RAFT, Teed & Deng, ECCV 2020, sec. 3.3) or
bilinear."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from eflow.precision import fp32

SCALE = 8


def convex_upsample(flow: Tensor, mask: Tensor, border: str = "replicate") -> Tensor:
    """Return flow (N, 2, 8h, 8w) full-resolution px, fp32, as convex combinations of flow (N, 2, h, w) low-resolution
    px.

    mask : (N, 9*64, h, w) logits; channel k*64 + 8*i + j is neighbour k (row-major 3x3) of sub-pixel (i, j).
    border : neighbours outside the image repeat the edge ("replicate") or are "zero" as in RAFT's code, which turns a
    constant 24 px into 10.7 px in the corners unless the network was trained with it.
    """
    n, _, h, w = flow.shape
    with fp32(flow):
        # The weights of the nine neighbours sum to 1 for each of the 64 sub-pixels.
        weights = mask.float().view(n, 9, SCALE * SCALE, h * w).softmax(1)
        padded = _padded(flow, border)
        neighbours = torch.stack([padded[..., dy : dy + h, dx : dx + w] for dy in range(3) for dx in range(3)], 2).view(
            n, 2, 9, 1, h * w
        )
        fine = torch.stack([(weights * neighbours[:, c]).sum(1) for c in range(2)], 1)  # (N, 2, 64, h*w)
        # Channel (component, i, j) becomes pixel (8 y + i, 8 x + j).
        return F.pixel_shuffle(fine.view(n, 2 * SCALE * SCALE, h, w), SCALE)


def _padded(flow: Tensor, border: str) -> Tensor:
    """Return the flow in full-resolution px, padded by one pixel."""
    return F.pad(SCALE * flow.float(), (1, 1, 1, 1), mode={"replicate": "replicate", "zero": "constant"}[border])


def bilinear_upsample(flow: Tensor) -> Tensor:
    """Return flow (N, 2, h, w) low-resolution px upsampled to (N, 2, 8h, 8w) full-resolution px, bilinear."""
    with fp32(flow):
        return SCALE * F.interpolate(flow.float(), scale_factor=SCALE, mode="bilinear", align_corners=False)
