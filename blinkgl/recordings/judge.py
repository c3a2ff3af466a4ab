"""Can two recordings be told apart? A two-sample test by a classifier (Lopez-Paz and Oquab, ICLR 2017) on local patches
of events: what it learns in some stretches of time is tried on the others. An area under the curve of 0.5 is guessing,
1 certainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from blinkgl.errors import EventDataError
from blinkgl.types.events import Events

SIDE_PX = 16
WINDOWS = 16
"""Of time; the classifier's patches are SIDE_PX x SIDE_PX pixels by one of them."""
FOLDS = 4
LEAST_IN_PATCH = 8
"""Events, on either side: of what is all but empty nothing can be said."""
LEAST_PATCHES = 100
"""Of either side; fewer say nothing."""
MOST_PATCHES = 20_000
NEAR_US = 2000
"""An event has company where a pixel beside it fired not longer ago."""
_BINS, _ROUNDS, _RATE = 24, 80, 0.15
_SUMS = 10


@dataclass(frozen=True)
class Judgement:
    """auc : mean over the folds; below 0.5 is chance, too.   spread : their standard deviation.   patches : of both
    sides together.   window_us : of a patch."""

    auc: float
    spread: float
    patches: int
    window_us: float


def judge(a: Events, b: Events, size: tuple[int, int], span_us: tuple[int, int]) -> Judgement:
    """Tells b from a, of sensors of one size, in the same span of time [span_us[0], span_us[1]). Patches that are all
    but empty on both sides are left out. EventDataError: too few patches with events."""
    features = [patches(events, size, span_us) for events in (a, b)]
    full = np.maximum(features[0][0], features[1][0]) >= LEAST_IN_PATCH
    x = np.concatenate([values[full] for _, values in features])
    label = np.repeat([0.0, 1.0], int(full.sum()))
    window = np.tile(np.nonzero(full)[0], 2)
    return _judged(x, label, window, (span_us[1] - span_us[0]) / WINDOWS)


def judge_unlike(
    a: Events, b: Events, size_a: tuple[int, int], size_b: tuple[int, int], span_us: tuple[int, int]
) -> Judgement:
    """Of sensors of different sizes: by the patches that are not all but empty, wherever they lie. What the two saw
    counts, too."""
    found = [patches(events, size, span_us) for events, size in ((a, size_a), (b, size_b))]
    full = [count >= LEAST_IN_PATCH for count, _ in found]
    x = np.concatenate([values[some] for (_, values), some in zip(found, full)])
    label = np.repeat([0.0, 1.0], [int(some.sum()) for some in full])
    window = np.concatenate([np.nonzero(some)[0] for some in full])
    return _judged(x, label, window, (span_us[1] - span_us[0]) / WINDOWS)


def judge_halves(a: Events, size: tuple[int, int], span_us: tuple[int, int]) -> Judgement:
    """A recording's own halves, dealt out in space and time like a chessboard's squares: what a judge says of two
    streams of one camera and one scene, 0.5 but for chance."""
    count, values = patches(a, size, span_us)
    full = count >= LEAST_IN_PATCH
    t, y, x = np.nonzero(full)
    return _judged(values[full], ((t + y + x) % 2).astype(float), t, (span_us[1] - span_us[0]) / WINDOWS)


def patches(events: Events, size: tuple[int, int], span_us: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """(T, Y, X) int number of events of each patch, and (T, Y, X, F) float32 what is told of it."""
    height, width = size
    ny, nx = -(-height // SIDE_PX), -(-width // SIDE_PX)
    sums = np.zeros((WINDOWS, ny, nx, _SUMS))
    part = events.window(*span_us)
    _gather(part.x, part.y, part.t, part.p, span_us[0], (span_us[1] - span_us[0]) / WINDOWS, height, width, sums)
    on, off, turns, pairs, log_gap, short, company, active, most, square = np.moveaxis(sums, -1, 0)
    count = on + off
    some, two = np.maximum(count, 1), np.maximum(pairs, 1)
    told = (
        np.log1p(on),
        np.log1p(off),
        np.abs(on - off) / some,
        turns / two,
        np.where(pairs > 0, log_gap / two, 20.0),
        short / two,
        company / some,
        np.log1p(active),
        most,
        square / some,
        count / np.maximum(active, 1),
    )
    return count.astype(np.int64), np.stack(told, -1).astype(np.float32)


@numba.njit(cache=True, nogil=True)
def _gather(x, y, t, p, begin, window, height, width, sums):
    last = np.full((height, width), -1, np.int64)
    before = np.zeros((height, width), np.uint8)
    seen = np.full((height, width), -1, np.int64)
    count = np.zeros((height, width), np.int64)
    for i in range(len(t)):
        k = min(int((t[i] - begin) / window), sums.shape[0] - 1)
        r, c = y[i], x[i]
        s = sums[k, r // SIDE_PX, c // SIDE_PX]
        s[0 if p[i] else 1] += 1
        if seen[r, c] != k:
            seen[r, c], count[r, c] = k, 0
            s[7] += 1
        else:
            gap = t[i] - last[r, c]
            s[3] += 1
            s[2] += p[i] != before[r, c]
            s[4] += np.log(max(gap, 1))
            s[5] += gap < NEAR_US
        count[r, c] += 1
        s[8] = max(s[8], count[r, c])
        s[9] += count[r, c]
        found = False
        for dr in (-1, 0, 1):
            for dc in (-1, 0, 1):
                rr, cc = r + dr, c + dc
                if (dr or dc) and 0 <= rr < height and 0 <= cc < width:
                    found = found or (last[rr, cc] >= 0 and t[i] - last[rr, cc] < NEAR_US)
        s[6] += found
        last[r, c], before[r, c] = t[i], p[i]


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
    fold = window * FOLDS // WINDOWS
    found = []
    for k in range(FOLDS):
        train, test = fold != k, fold == k
        if min(label[test].sum(), (1 - label[test]).sum()) >= 5 and 0 < label[train].mean() < 1:
            found.append(area(boosted(x[train], label[train], x[test]), label[test]))
    if not found:
        raise EventDataError("events at one time alone cannot be judged by another", where="compare --judge")
    return Judgement(float(np.mean(found)), float(np.std(found)), len(x), float(window_us))


def boosted(x: np.ndarray, label: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Scores of ``other`` (M, F) by gradient boosting of stumps (Friedman 2001) under the logistic loss, learnt of
    ``x`` (N, F) and ``label`` (N,) of 0 and 1; features are cut at quantiles."""
    count = x.shape[1]
    cuts = [np.unique(np.quantile(x[:, f], np.arange(1, _BINS) / _BINS)) for f in range(count)]
    code = lambda data: np.stack([np.searchsorted(cuts[f], data[:, f], side="right") for f in range(count)], 1)
    own, there = code(x), code(other)
    flat = (own + np.arange(count) * _BINS).ravel()
    score, result = np.zeros(len(x)), np.zeros(len(other))
    for _ in range(_ROUNDS):
        chance = 1 / (1 + np.exp(-score))
        pull, weight = label - chance, chance * (1 - chance)
        add = lambda v: np.bincount(flat, np.repeat(v, count), count * _BINS).reshape(count, _BINS).cumsum(axis=1)
        g, h = add(pull), add(weight)
        rest_g, rest_h = g[:, -1:] - g, h[:, -1:] - h
        gain = g**2 / (h + 1) + rest_g**2 / (rest_h + 1)
        gain[:, -1] = 0
        f, b = np.unravel_index(int(np.argmax(gain)), gain.shape)
        low, high = g[f, b] / (h[f, b] + 1), rest_g[f, b] / (rest_h[f, b] + 1)
        score += _RATE * np.where(own[:, f] <= b, low, high)
        result += _RATE * np.where(there[:, f] <= b, low, high)
    return result


def area(score: np.ndarray, label: np.ndarray) -> float:
    """Under the curve of true against false positives: how often one of the second kind has the higher score (Mann and
    Whitney), ties half."""
    from scipy.stats import rankdata

    positive = label > 0.5
    n, m = int(positive.sum()), int((~positive).sum())
    return float((rankdata(score)[positive].sum() - n * (n + 1) / 2) / (n * m))
