"""Bursts of a camera of events and frames: where its frames are reset or read out, pixels all over the sensor fire at
once, nearly all with one polarity, once per frame. Emulators have no such bursts.

In DAVIS240 recordings 12 % of the events of slider_depth and 19 % of evbench_davis240 lie in one or two ms per frame.
They are not noise: without them polarity sums follow the frames less well (0.90 instead of 0.91, 0.84 instead of 0.86),
so pixels near their level fire. Their number depends on light, their times do not.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, median_filter

from blinkgl.types.events import Events

BIN_US = 250
AROUND_MS = 5.0
"""Time on each side that gives the usual rate."""
TIMES, LEAST = 3.0, 15
"""A bin of a burst has this many times the events of those around it, and at least this many more."""
ONE_POLARITY = 0.85
NEAR = 0.02
"""Tolerance of the bursts' period, as a fraction of the time of some frames."""
MOST_FRAMES, LEAST_OTHERS = 4, 2


def frame_bursts(events: Events, interval_us: float) -> np.ndarray:
    """Return bursts of one polarity at the frames' interval, (N, 2) int64, [begin, end) in µs, in time order, not
    overlapping.
    events : of the whole sensor, in time order."""
    if not len(events):
        return np.empty((0, 2), np.int64)
    begin = int(events.t[0])
    bins = (events.t - begin) // BIN_US
    count = np.bincount(bins)
    on = np.bincount(bins, events.p)
    width = 2 * round(AROUND_MS * 1000 / BIN_US) + 1
    usual = median_filter(count, width, mode="nearest")
    pure = np.maximum(on, count - on) >= ONE_POLARITY * count
    high = (count > TIMES * usual + LEAST) & pure
    # A burst's flanks: bins beside it that are higher than usual.
    wide = binary_dilation(high)
    # Rises and falls alternate: the begin and the end of each run of bins.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], wide, [False]]).astype(np.int8)))
    spans = begin + BIN_US * edges.reshape(-1, 2).astype(np.int64)
    middle = spans.mean(axis=1)
    apart = np.abs(middle[:, None] - middle[None]) / interval_us
    frames = np.round(apart)
    # Bursts of the camera's frames recur after the time of one to four frames.
    partner = (frames >= 1) & (frames <= MOST_FRAMES) & (np.abs(apart - frames) <= NEAR * frames)
    return spans[partner.sum(axis=1) >= LEAST_OTHERS]


def inside_any(t_us: np.ndarray, spans: np.ndarray) -> np.ndarray:
    """Return which of the times lie in one of ``spans``, (N,) bool."""
    if not len(spans):
        return np.zeros(len(t_us), bool)
    last = np.searchsorted(spans[:, 0], t_us, side="right") - 1
    return (last >= 0) & (t_us < spans[np.maximum(last, 0), 1])
