"""The dominant motion of a flow field, the affine field nearest to most of it, and flow that is drawn towards it.

Most flow in recordings is that of a camera, which one affine field describes nearly (Odobez and Bouthemy, "Robust
multiresolution estimation of parametric motion models", 1995). Networks estimate each place of it with errors of its
own, which the field over all of them has not.
"""

from __future__ import annotations

import numpy as np

from eflow.types import Flow, Mask, Numbers

MOST_PIXELS = 20_000
"""Of more pixels with events every n-th is used."""
LEAST_PIXELS = 20
"""With events, for a field of six numbers to say anything."""
NEAR = 0.4
"""Share of the median length of the dominant motion by which flow may be off it to be drawn half of the way there."""
AFFINE, OTHER = 0.2, 0.4
"""Mean distance from the dominant motion, as a share of the mean length: up to the first the flow is taken for that of
a camera alone, from the second on for that of depth and bodies, and is not drawn anywhere."""
QUANTUM_PX = 0.1
"""Added to that distance: flow of a still camera is never exactly zero."""
_ROUNDS = 7


def dominant_motion(flow: Flow, hit: Mask) -> tuple[Numbers, float]:
    """Return the affine field (H, W, 2) float64 px nearest to most of the flow (H, W, 2) px at the pixels ``hit``
    (H, W), and the mean distance of the flow from it there, as a share of the flow's mean length. Least absolute
    distances, by reweighted least squares."""
    height, width = hit.shape
    larger = max(height, width)
    y, x = np.nonzero(hit)
    n = -(-len(x) // MOST_PIXELS)
    y, x = y[::n], x[::n]
    # Coordinates of about 1 condition the least squares.
    basis = np.stack([np.ones(len(x)), x / larger - 0.5, y / larger - 0.5], axis=1)
    field = flow[y, x].astype(np.float64)
    fit = np.linalg.lstsq(basis, field, rcond=None)[0]
    for _ in range(_ROUNDS):
        root = np.sqrt(1 / np.maximum(np.hypot(*(field - basis @ fit).T), QUANTUM_PX))[:, None]
        fit = np.linalg.lstsq(basis * root, field * root, rcond=None)[0]
    distance = np.hypot(*(field - basis @ fit).T)
    rows, columns = (np.arange(size)[:, None] / larger - 0.5 for size in (height, width))
    affine = fit[0] + columns[None] * fit[1] + rows[:, None] * fit[2]
    return affine, float(distance.mean() / max(np.hypot(*field.T).mean(), 1e-9))


def toward_dominant(flow: Flow, hit: Mask) -> Flow:
    """Return the flow (H, W, 2) px with each vector drawn towards the dominant motion: by a share of
    1 / (1 + (distance / d)²), where d is :data:`NEAR` of that motion's median length, times 1 where all of the flow is
    nearly affine, falling to 0 where it is not (:data:`AFFINE`, :data:`OTHER`). What moves its own way is far off and
    stays. hit : (H, W) pixels with events; of fewer than :data:`LEAST_PIXELS`, and with NaN or infinity anywhere, the
    flow is returned as it is."""
    if np.count_nonzero(hit) < LEAST_PIXELS or not np.isfinite(flow).all():
        return flow
    affine, off = dominant_motion(flow, hit)
    alone = np.clip((OTHER - off) / (OTHER - AFFINE), 0, 1)
    near = NEAR * np.median(np.hypot(*affine[hit].T)) + QUANTUM_PX
    share = alone / (1 + ((flow - affine) ** 2).sum(-1, keepdims=True) / near**2)
    return (flow + share * (affine - flow)).astype(np.float32)
