"""Error metrics of flow (NumPy, float64) and the training loss (torch).

Averages follow BlinkFlow: over the valid pixels of a frame, then over the frames of a scene, then over scenes. A frame
without a valid pixel is skipped and counted.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from eflow.config import LossConfig
from eflow.models.contract import FlowPrediction
from eflow.types import Mask, Numbers

NAMES = {
    "AEE": "end-point error, px",
    "outlier": "share of pixels with EPE > 3 px and > 5 % of |gt|, %",
    "1PE": "share of pixels with EPE > 1 px, %",
    "2PE": "share of pixels with EPE > 2 px, %",
    "3PE": "share of pixels with EPE > 3 px, %",
    "AE2D": "angle between the 2-D flow vectors (BlinkFlow's angular error), degrees",
    "AE3D": "angle between (u, v, 1) vectors (DSEC's angular error), degrees",
    "cosine": "mean cosine between the 2-D flow vectors",
}
MAX_FLOW = 400.0


def frame_metrics(predicted: Numbers, truth: Numbers, valid: Mask) -> dict[str, float] | None:
    """Return all metrics of :data:`NAMES` for one frame, or None if it has no valid pixel.

    predicted, truth : (H, W, 2) px. valid : (H, W) bool. Pixels with |gt| >= 400 are excluded, too; occluded pixels are
    included. A NaN in the prediction makes the metrics NaN.
    """
    gt = np.asarray(truth, np.float64)[valid]
    pr = np.asarray(predicted, np.float64)[valid]
    keep = np.hypot(gt[:, 0], gt[:, 1]) < MAX_FLOW
    gt, pr = gt[keep], pr[keep]
    if not len(gt):
        return None
    epe = np.hypot(*(pr - gt).T)
    size = np.hypot(*gt.T)
    angle = angle_2d(pr, gt)
    # NaN > 3 is false: without this a prediction of NaN would have no outliers.
    share = lambda mask: float(100 * np.mean(mask)) if np.isfinite(epe).all() else float("nan")
    return {
        "AEE": float(epe.mean()),
        "outlier": share((epe > 3) & (epe > 0.05 * size)),
        **{f"{n}PE": share(epe > n) for n in (1, 2, 3)},
        "AE2D": float(np.degrees(angle).mean()),
        "AE3D": float(np.degrees(angle_3d(pr, gt)).mean()),
        "cosine": float(np.cos(angle).mean()),
    }


def angle_2d(a: Numbers, b: Numbers) -> Numbers:
    """Return the angle in radians between vectors (..., 2).

    It is atan2(|cross|, dot), which is accurate at 0 and 180 degrees where arccos is not. If one vector is zero the
    angle is 90 degrees; if both are, it is 0."""
    cross, dot = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], (a * b).sum(-1)
    angle = np.arctan2(np.abs(cross), dot)
    # atan2(0, 0) is 0, but a flow of zero has no direction to agree with.
    zero_a, zero_b = (a == 0).all(-1), (b == 0).all(-1)
    return np.where(zero_a & zero_b, 0.0, np.where(zero_a | zero_b, np.pi / 2, angle))


def angle_3d(a: Numbers, b: Numbers) -> Numbers:
    """Return the angle in radians between (u, v, 1) and (u', v', 1)."""
    a3, b3 = (np.concatenate([f, np.ones_like(f[..., :1])], -1) for f in (a, b))
    return np.arctan2(np.linalg.norm(np.cross(a3, b3), axis=-1), (a3 * b3).sum(-1))


@dataclass
class Tally:
    """Collects the metrics of frames and averages them."""

    frames: dict[str, list[dict[str, float]]] = field(default_factory=dict)
    skipped: int = 0

    def add(self, scene: str, metrics: dict[str, float] | None) -> None:
        if metrics is None:
            self.skipped += 1
        else:
            self.frames.setdefault(scene, []).append(metrics)

    def scenes(self) -> dict[str, dict[str, float]]:
        """Return the mean over the frames of each scene, and their number."""
        return {
            scene: {**{k: float(np.mean([f[k] for f in rows])) for k in rows[0]}, "frames": len(rows)}
            for scene, rows in sorted(self.frames.items())
        }

    def total(self) -> dict[str, float]:
        """Return the mean over scenes; empty if nothing was scored."""
        scenes = list(self.scenes().values())
        if not scenes:
            return {}
        return {
            **{k: float(np.mean([s[k] for s in scenes])) for k in scenes[0] if k != "frames"},
            "frames": sum(s["frames"] for s in scenes),
        }


# ---------------------------------------------------------------------------------------------------------------------
# The training loss.

L1 = LossConfig()


def sequence_loss(
    prediction: FlowPrediction,
    flow: Tensor,
    valid: Tensor,
    *,
    loss: LossConfig = L1,
    gamma: float = 0.8,
    match_weight: float = 0.5,
    count: Tensor | None = None,
) -> Tensor:
    """Return the sum over i of w_i · mean over valid pixels of the error of V_i (:func:`pixel_error`).

    flow : (N, 2, H, W) px. valid : (N, H, W) bool; invalid pixels may have any value, NaN included.
    w_i is gamma^(N - i) for the refinements 1 … N of a field and ``match_weight`` for the flow of the matching layer.
    (The BlinkFlow paper gives it gamma^N, with a misprint in the exponent: 1.45 % of the total at N = 12.) The scales
    of a decoder have equal weights that sum to 1.
    count : number to divide by instead of the batch's valid pixels (data-parallel training: the mean over ranks).

    The mean is over *valid* pixels, so that gradients do not depend on how sparse the ground truth is. Without a valid
    pixel the loss is 0.
    """
    target = torch.where(valid[:, None], flow, 0)
    total = (valid.sum() if count is None else count).clamp(min=1)
    last = len(prediction.flows) - 1
    sum_ = flow.new_zeros(())
    for i, predicted in enumerate(prediction.flows):
        if prediction.kind == "scales":
            weight = 1 / (last + 1)
        else:
            weight = match_weight if prediction.has_match and i == 0 else gamma ** (last - i)
        error = pixel_error(predicted.float(), target, loss)
        sum_ = sum_ + weight * torch.where(valid, error, 0).sum() / total
    return sum_


def pixel_error(predicted: Tensor, target: Tensor, loss: LossConfig) -> Tensor:
    """Return the weighted sum of the terms of ``loss`` at each pixel, (N, H, W), of two flows (N, 2, H, W) px.

    With the end-point error e and k = ``loss.knee`` px:
    l1: |du| + |dv|.   epe: e.
    length: |log((|flow| + k) / (|true flow| + k))|. Under uncertainty the other terms favour short flow, since the
    median of each component minimises them; this term is minimal at the median of the length.
    """
    difference = predicted - target
    total = predicted.new_zeros(predicted.shape[0], *predicted.shape[2:])
    if loss.l1:
        total = total + loss.l1 * difference.abs().sum(1)
    if loss.epe:
        total = total + loss.epe * ((difference**2).sum(1) + 1e-6).sqrt()  # finite slope at 0
    if loss.length:
        length = ((predicted**2).sum(1) + 1e-6).sqrt()
        total = (
            total
            + loss.length * (torch.log(length + loss.knee) - torch.log((target**2).sum(1).sqrt() + loss.knee)).abs()
        )
    return total
