"""Optimal one-to-one matching of the events of two streams, within pixel and polarity.

The matching of two event trains of a pixel and polarity minimises

    sum over matched pairs |t_a - t_b|  +  limit / 2 * (events without a partner),    |t_a - t_b| <= limit,

which is the spike-train metric of Victor and Purpura (J. Neurophysiology 76, 1996) with cost 2 / limit per unit of
time: moving an event is cheaper than removing it and adding another one if it moves by at most ``limit``. An optimal
matching keeps the order of time, so dynamic programming over the two sorted trains finds it; only partners within
``limit`` are considered.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Events

_MISSED, _EXTRA, _MATCH = np.uint8(0), np.uint8(1), np.uint8(2)


@dataclass(frozen=True, eq=False)
class Matching:
    """A matching of two streams.

    partner : (len(reference),) int64, index of each reference event's partner in the judged stream; -1: it was missed.
    dt_us : (len(reference),) int64, judged minus reference time, µs; 0 where missed.   extra : judged events without a
    partner."""

    partner: np.ndarray
    dt_us: np.ndarray
    extra: int

    @property
    def matched(self) -> np.ndarray:
        """Return which reference events have a partner, (len(reference),) bool."""
        return self.partner >= 0


def match_events(reference: Events, judged: Events, height: int, width: int, limit_us: int) -> Matching:
    """Match two streams of one sensor. Events must be sorted by time only.

    limit_us : largest time between partners (> 0). Raises ValueError: limit or an event off the sensor."""
    if limit_us <= 0:
        raise ValueError("match_events: limit_us must be positive")
    for events in (reference, judged):
        if len(events) and (int(events.x.max()) >= width or int(events.y.max()) >= height):
            raise ValueError("match_events: an event lies off the sensor")
    starts_a, order_a = _trains(reference, height, width)
    starts_b, order_b = _trains(judged, height, width)
    t_a, t_b = np.asarray(reference.t, np.int64), np.asarray(judged.t, np.int64)
    partner = np.full(len(reference), -1, np.int64)
    _match(starts_a, order_a, t_a, starts_b, order_b, t_b, np.int64(limit_us), partner)
    paired = partner >= 0
    dt = np.zeros(len(reference), np.int64)
    dt[paired] = t_b[partner[paired]] - t_a[paired]
    return Matching(partner, dt, len(judged) - int(paired.sum()))


def _trains(events: Events, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return events grouped by pixel and polarity: (starts (2 H W + 1,), order (N,)); train k is
    ``order[starts[k]:starts[k + 1]]``, by time."""
    starts = np.zeros(2 * height * width + 1, np.int64)
    order = np.empty(len(events), np.int64)
    _group(events.x, events.y, events.p, width, starts, order)
    return starts, order


@kernel
def _group(x, y, p, width, starts, order):
    """Sort by counting; the sort is stable, so the order of time is kept within a train."""
    for i in range(len(x)):
        # Train 2 * pixel + polarity is counted one further on, so that the sums become beginnings.
        starts[2 * (np.int64(y[i]) * width + x[i]) + p[i] + 1] += 1
    for k in range(1, len(starts)):
        starts[k] += starts[k - 1]
    place = starts[:-1].copy()
    for i in range(len(x)):
        k = 2 * (np.int64(y[i]) * width + x[i]) + p[i]
        order[place[k]] = i
        place[k] += 1


@kernel
def _match(starts_a, order_a, t_a, starts_b, order_b, t_b, limit, partner):
    """Match each train by dynamic programming. cost[i][j] is the least cost (in half µs, so that integers suffice) of
    the first i events of a and the first j of b. Row i holds j from low[i], the number of b's events too early for
    event i - 1 of a, to high[i], the number of those not too late for it. Outside, events are always unmatched, at
    ``limit`` half µs each."""
    # Rows lie one after the other in cost and choice: cell (i, j) is at row_start[i] + j - low[i].
    low, high = np.empty(64, np.int64), np.empty(64, np.int64)
    row_start = np.empty(64, np.int64)
    cost, choice = np.empty(256, np.int64), np.empty(256, np.uint8)
    for k in range(len(starts_a) - 1):
        a0, n = starts_a[k], starts_a[k + 1] - starts_a[k]
        b0, m = starts_b[k], starts_b[k + 1] - starts_b[k]
        # Nothing can match: partner stays -1, and extra is counted from what is matched.
        if n == 0 or m == 0:
            continue
        # Scratch memory grows to the longest train so far, so most trains allocate nothing.
        if len(low) <= n:
            low, high, row_start = (
                np.empty(2 * n + 2, np.int64),
                np.empty(2 * n + 2, np.int64),
                np.empty(2 * n + 2, np.int64),
            )
        low[0] = high[0] = row_start[0] = 0
        cells = 1
        lo = hi = 0
        for i in range(1, n + 1):
            t = t_a[order_a[a0 + i - 1]]
            while lo < m and t_b[order_b[b0 + lo]] < t - limit:
                lo += 1
            while hi < m and t_b[order_b[b0 + hi]] <= t + limit:
                hi += 1
            low[i], high[i], row_start[i] = lo, hi, cells
            cells += hi - lo + 1
        if len(cost) < cells:
            cost, choice = np.empty(2 * cells, np.int64), np.empty(2 * cells, np.uint8)
        cost[0] = 0
        for i in range(1, n + 1):
            t = t_a[order_a[a0 + i - 1]]
            above, here = row_start[i - 1] - low[i - 1], row_start[i] - low[i]
            top = high[i - 1]
            for j in range(low[i], high[i] + 1):
                # Row i - 1 beyond its end: b's events up to j are extra there.
                best = cost[above + min(j, top)] + limit * max(j - top, 0) + limit
                what = _MISSED
                if j > low[i]:
                    other = cost[here + j - 1] + limit
                    if other < best:
                        best, what = other, _EXTRA
                    # Only b's events above low[i] are not too early for event i, so within a row every j but the
                    # first may match.
                    pair = (
                        cost[above + min(j - 1, top)]
                        + limit * max(j - 1 - top, 0)
                        + 2 * abs(t - t_b[order_b[b0 + j - 1]])
                    )
                    if pair <= best:
                        best, what = pair, _MATCH
                cost[here + j], choice[here + j] = best, what
        # Back along the choices. Judged events beyond a row's end were counted as extra on the way up, so they are
        # skipped.
        i, j = n, m
        while i > 0:
            j = min(j, high[i])
            what = choice[row_start[i] + j - low[i]]
            if what == _MATCH:
                partner[order_a[a0 + i - 1]] = order_b[b0 + j - 1]
                i, j = i - 1, j - 1
            elif what == _MISSED:
                i -= 1
            else:
                j -= 1
