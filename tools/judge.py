"""A two-sample test of recordings by a classifier (Lopez-Paz and Oquab, ICLR 2017) on local patches of events
(:mod:`~blinkgl.recordings.patches`): it is trained on some time windows and tested on the others. An area under the
curve of 0.5 is guessing, 1 certainty.

Two questions. For a single patch: which recording is it from? That measures how different the two look, for any scene.
For the same patch in both: which is which? There the scene cancels, so a tenth of the events missing is detected at
once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from blinkgl.errors import EventDataError
from blinkgl.recordings.patches import LEAST_IN_PATCH, LEAST_PATCHES, NAMES, WINDOWS, patches
from blinkgl.types.events import Events

FOLDS = 4
MOST_PATCHES = 20_000
_BINS, _ROUNDS, _RATE = 24, 80, 0.15
_TELLING = 3


@dataclass(frozen=True)
class Judgement:
    """Result of a test. auc : mean over the folds; below 0.5 is chance, too.   spread : their standard deviation.
    patches : of both sides together.   window_us : of a patch.   paired : AUC of identifying two patches of one place
    and time; None where there are no pairs.   telling : the most important features, (name, share of the gain)."""

    auc: float
    spread: float
    patches: int
    window_us: float
    paired: float | None = None
    telling: tuple[tuple[str, float], ...] = ()


def judge(a: Events, b: Events, size: tuple[int, int], span_us: tuple[int, int]) -> Judgement:
    """Distinguish b from a, of sensors of one size, in the same time span [span_us[0], span_us[1]). Patches that are
    nearly empty on both sides are left out. Raises EventDataError: too few patches with events."""
    features = [patches(events, size, span_us) for events in (a, b)]
    full = np.maximum(features[0][0], features[1][0]) >= LEAST_IN_PATCH
    own, other = (values[full] for _, values in features)
    label = np.repeat([0.0, 1.0], int(full.sum()))
    window = np.nonzero(full)[0]
    window_us = (span_us[1] - span_us[0]) / WINDOWS
    alone = _judged(np.concatenate([own, other]), label, np.tile(window, 2), window_us)
    # The order of the two is random, and must be identified.
    swapped = np.random.default_rng(0).integers(0, 2, len(own)).astype(float)
    try:
        paired = _judged((own - other) * (2 * swapped - 1)[:, None], swapped, window, window_us).auc
    except EventDataError:  # half as many as there are patches
        paired = None
    return replace(alone, paired=paired)


def judge_unlike(
    a: Events, b: Events, size_a: tuple[int, int], size_b: tuple[int, int], span_us: tuple[int, int]
) -> Judgement:
    """Compare sensors of different sizes by their non-empty patches at any position. Differences of the scenes count,
    too."""
    counted = [patches(events, size, span_us) for events, size in ((a, size_a), (b, size_b))]
    full = [count >= LEAST_IN_PATCH for count, _ in counted]
    x = np.concatenate([values[some] for (_, values), some in zip(counted, full)])
    label = np.repeat([0.0, 1.0], [int(some.sum()) for some in full])
    window = np.concatenate([np.nonzero(some)[0] for some in full])
    return _judged(x, label, window, (span_us[1] - span_us[0]) / WINDOWS)


def judge_halves(a: Events, size: tuple[int, int], span_us: tuple[int, int]) -> Judgement:
    """Compare a recording's own halves, divided in space and time like a chessboard: the result for two streams of one
    camera and one scene, 0.5 except for chance."""
    count, values = patches(a, size, span_us)
    full = count >= LEAST_IN_PATCH
    t, y, x = np.nonzero(full)
    return _judged(values[full], ((t + y + x) % 2).astype(float), t, (span_us[1] - span_us[0]) / WINDOWS)


def _judged(x: np.ndarray, label: np.ndarray, window: np.ndarray, window_us: float) -> Judgement:
    counts = np.bincount(label.astype(int), minlength=2)
    if counts.min() < LEAST_PATCHES:
        raise EventDataError(
            "too few patches with events for a judge",
            where="compare --judge",
            value=int(counts.min()),
            accepted=f"{LEAST_PATCHES} or more of either side",
        )
    if len(x) > MOST_PATCHES:
        keep = np.random.default_rng(0).permutation(len(x))[:MOST_PATCHES]
        x, label, window = x[keep], label[keep], window[keep]
    # Folds are stretches of time, so that no window is both trained on and tested.
    fold = window * FOLDS // WINDOWS
    areas, gains = [], np.zeros(x.shape[1])
    for k in range(FOLDS):
        train, test = fold != k, fold == k
        if min(label[test].sum(), (1 - label[test]).sum()) >= 5 and 0 < label[train].mean() < 1:
            score, gained = boosted(x[train], label[train], x[test])
            areas.append(area(score, label[test]))
            gains += gained
    if not areas:
        raise EventDataError(
            "all events have the same time, so a judge cannot be trained and tested", where="compare --judge"
        )
    shares = gains / max(gains.sum(), 1e-30)
    telling = tuple((NAMES[k], float(shares[k])) for k in np.argsort(-gains)[:_TELLING])
    return Judgement(float(np.mean(areas)), float(np.std(areas)), len(x), float(window_us), telling=telling)


def boosted(x: np.ndarray, label: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return scores of ``other`` (M, F) by gradient boosting of stumps (Friedman 2001) with the logistic loss, trained
    on ``x`` (N, F) and ``label`` (N,) of 0 and 1; features are cut at quantiles. Also (F,) the gain of each feature."""
    count = x.shape[1]
    cuts = [np.unique(np.quantile(x[:, f], np.arange(1, _BINS) / _BINS)) for f in range(count)]
    code = lambda data: np.stack([np.searchsorted(cuts[f], data[:, f], side="right") for f in range(count)], 1)
    own, there = code(x), code(other)
    # The codes of all features in one range of numbers, so that one count makes all histograms.
    flat = (own + np.arange(count) * _BINS).ravel()
    score, result, gained = np.zeros(len(x)), np.zeros(len(other)), np.zeros(count)
    for _ in range(_ROUNDS):
        chance = 1 / (1 + np.exp(-score))
        # The gradient and the curvature of the logistic loss.
        pull, weight = label - chance, chance * (1 - chance)
        add = lambda v: np.bincount(flat, np.repeat(v, count), count * _BINS).reshape(count, _BINS).cumsum(axis=1)
        g, h = add(pull), add(weight)
        rest_g, rest_h = g[:, -1:] - g, h[:, -1:] - h
        # By how much a Newton step in either part of a cut lowers the loss; the 1 regularises.
        gain = g**2 / (h + 1) + rest_g**2 / (rest_h + 1)
        # A cut behind the last bin divides nothing.
        gain[:, -1] = 0
        f, b = np.unravel_index(int(np.argmax(gain)), gain.shape)
        gained[f] += max(float(gain[f, b] - g[f, -1] ** 2 / (h[f, -1] + 1)), 0.0)
        low, high = g[f, b] / (h[f, b] + 1), rest_g[f, b] / (rest_h[f, b] + 1)
        score += _RATE * np.where(own[:, f] <= b, low, high)
        result += _RATE * np.where(there[:, f] <= b, low, high)
    return result, gained


def area(score: np.ndarray, label: np.ndarray) -> float:
    """Return the area under the curve of true against false positives: how often one of the second kind has the higher
    score (Mann and Whitney), ties half."""
    from scipy.stats import mannwhitneyu

    positive = label > 0.5
    above = mannwhitneyu(score[positive], score[~positive], method="asymptotic").statistic
    return float(above / (positive.sum() * (~positive).sum()))
