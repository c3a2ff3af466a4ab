"""How far a flow can be trusted, pixel by pixel, for any network or method and without training for it: by how much the
answer changes when the same motion is shown otherwise.

Four views of a pair of windows have the same flow as the pair itself: mirrored left to right, mirrored top to bottom,
one half of the events (each drawn by lot), the other half. Where their flows disagree with that of the pair, something
other than the motion decides. It is a number that *ranks* errors (:func:`sparsification` says how well), no error bar:
views share what the network has wrong in all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from eflow.infer import StreamWindow

VIEWS = 4
SHARES = np.arange(20) / 20
"""Of pixels that are left out, most doubtful first."""


def disagreement(
    predictor: Callable[[StreamWindow], tuple[np.ndarray, np.ndarray]],
    window: StreamWindow,
    flow: np.ndarray,
) -> np.ndarray:
    """(H, W) float32 px: root mean square distance of the views' flows from ``flow`` (H, W, 2), the pair's own.

    predictor : of the network or method, without a warm start (each view would begin with the one before), and with
    zero flow for windows without events. Costs :data:`VIEWS` times the prediction; a function of its arguments."""
    height, width = flow.shape[:2]
    squared = np.zeros((height, width), np.float64)
    for axis, size, image_axis, component in (("x", width, 1, 0), ("y", height, 0, 1)):
        mirrored = replace(window, old=window.old.flipped(axis, size), new=window.new.flipped(axis, size))
        seen = np.flip(predictor(mirrored)[0], image_axis).copy()
        seen[..., component] *= -1
        squared += ((seen - flow) ** 2).sum(-1)
    lots = np.random.default_rng([abs(window.t_us), len(window.old), len(window.new)])
    old, new = (lots.random(len(w)) < 0.5 for w in (window.old, window.new))
    for half in (True, False):
        thinned = replace(window, old=window.old.take(old == half), new=window.new.take(new == half))
        squared += ((predictor(thinned)[0] - flow) ** 2).sum(-1)
    return np.sqrt(squared / VIEWS).astype(np.float32)


def sparsification(error: np.ndarray, doubt: np.ndarray, valid: np.ndarray) -> dict[str, np.ndarray] | None:
    """Mean error of what is left when the most doubtful pixels are left out, at each of :data:`SHARES`.

    error, doubt : (H, W). valid : (H, W) bool. Returns {"doubt": by doubt, "best": by the error itself, "chance": in no
    order}, each (len(SHARES),) float64; None where nothing is valid. Equal doubts count as in no order."""
    e, d = np.asarray(error, np.float64)[valid], np.asarray(doubt, np.float64)[valid]
    if not e.size:
        return None
    _, group, count = np.unique(d, return_inverse=True, return_counts=True)
    tied = (np.bincount(group, e) / count)[group]  # of equal doubts no order is known
    kept = np.maximum(np.ceil((1 - SHARES) * e.size).astype(int), 1)
    means = lambda values: np.cumsum(values)[kept - 1] / kept
    return {"doubt": means(tied[np.argsort(d)]), "best": means(np.sort(e)), "chance": np.full(len(kept), e.mean())}


def area(curves: dict[str, np.ndarray]) -> float:
    """Area between the curve by doubt and the best possible one, over that of chance: 0 ranks as the error itself does,
    1 says nothing, more is worse than nothing (AUSE, Ilg et al., ECCV 2018, over its value for a random order). NaN
    where all errors are equal."""
    chance = float((curves["chance"] - curves["best"]).sum())
    return float((curves["doubt"] - curves["best"]).sum()) / chance if chance > 0 else float("nan")
