"""Flow and images at other pixels: upsampled to full resolution, by learned convex combinations (RAFT, Teed & Deng,
ECCV 2020, sec. 3.3) or bilinear; warped by a flow field."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from eflow.machine import fp32
from eflow.ops.correlation import pixel_grid

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


def backward_warp(image: Tensor, flow: Tensor, border: str = "zero") -> Tensor:
    """Return an image (N, C, h, w) sampled at x + flow(x), bilinear.

    flow : (N, 2, h, w) px of this resolution. border : the image outside is "zero", or repeats its edge
    ("replicate")."""
    h, w = image.shape[-2:]
    with fp32(image):
        at = (pixel_grid(h, w, flow) + flow.float()).permute(0, 2, 3, 1)
        beyond = {"zero": "zeros", "replicate": "border"}[border]
        # A tensor [w, h] as divisor would make a GPU wait for its two numbers.
        # grid_sample takes -1 to 1 between the image's outer edges (align_corners=False).
        normal = torch.stack([(2 * at[..., k] + 1) / size - 1 for k, size in ((0, w), (1, h))], -1)
        return F.grid_sample(image.float(), normal, align_corners=False, padding_mode=beyond)


def forward_warp(flow: Tensor) -> Tensor:
    """Return a flow field (N, 2, h, w) px moved along itself to the next reference time, for a warm start.

    Every vector is splatted bilinearly to its end point; several vectors are averaged; pixels without a vector are
    0."""
    n, _, h, w = flow.shape
    at = (pixel_grid(h, w, flow) + flow).flatten(2)
    # Channels 0 and 1: sum of the splatted flow; channel 2: sum of the weights.
    base = at.floor()
    total = flow.new_zeros(n, 3, h * w)
    values = torch.cat([flow.flatten(2), torch.ones_like(at[:, :1])], 1)
    for dx in (0, 1):
        for dy in (0, 1):
            corner = base + torch.tensor([dx, dy], device=flow.device, dtype=flow.dtype)[:, None]
            # Bilinear weight of this corner.
            weight = (1 - (at - corner).abs()).prod(1, keepdim=True)
            inside = (corner[:, :1] >= 0) & (corner[:, :1] < w) & (corner[:, 1:] >= 0) & (corner[:, 1:] < h)
            x, y = corner[:, :1].clamp(0, w - 1).long(), corner[:, 1:].clamp(0, h - 1).long()
            total.scatter_add_(2, (y * w + x).expand(-1, 3, -1), values * weight * inside)
    # Mean of the vectors at a pixel, 0 without one.
    return (total[:, :2] / total[:, 2:].clamp(min=1e-6) * (total[:, 2:] > 1e-6)).view(n, 2, h, w)
