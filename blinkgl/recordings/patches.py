"""Features of patches of events (a few pixels by a time window), by which the judge (:mod:`~blinkgl.tools.judge`)
distinguishes recordings.

Some describe single pixels (rates, intervals), some neighbours (direction of motion, continuity over the patch's
border), some the whole sensor (bursts), some the adjacent patches in space and time.
"""

from __future__ import annotations

import numpy as np

from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Events

SIDE_PX = 16
WINDOWS = 16
"""Number of time windows; a patch is SIDE_PX x SIDE_PX pixels by one of them."""
LEAST_IN_PATCH = 8
"""Events; patches with fewer are not used."""
LEAST_PATCHES = 100
"""Fewer patches with events are not enough."""
NEAR_US = 2000
"""An event has company where an adjacent pixel fired at most this long before."""
_BURST = 64
"""Parts of a window in which the sensor's events are counted; the usual count is over ``_BURST // 2`` of them."""
_PIXEL, _BESIDE = 14, 8

NAMES = (
    "ON events",
    "OFF events",
    "balance of polarity",
    "turns of polarity",
    "intervals",
    "short intervals",
    "company beside",
    "pixels that fired",
    "events of the busiest pixel",
    "crowding in pixels",
    "events of a pixel",
    "intervals before ON against before OFF",
    "turns to ON",
    "intervals that grow",
    "motion along x",
    "motion along y",
    "links over the patch's border",
    "events at one time",
    "bursts over the sensor",
    "events unlike beside",
    "motion unlike beside, x",
    "motion unlike beside, y",
    "polarity unlike beside",
    "more than before",
    "more than after",
)
"""Names of the features, in order."""


def patches(events: Events, size: tuple[int, int], span_us: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of events of each patch, (T, Y, X) int, and its features, (T, Y, X, F) float32, ``NAMES``.

    size : (height, width) px.   span_us : divided into ``WINDOWS``."""
    height, width = size
    shape = WINDOWS, -(-height // SIDE_PX), -(-width // SIDE_PX)
    window = (span_us[1] - span_us[0]) / WINDOWS
    e = events.window(*span_us)
    t = e.t - span_us[0]
    pixel, beside, times = np.zeros((*shape, _PIXEL)), np.zeros((*shape, _BESIDE)), np.zeros((*shape, 2))
    _of_pixels(e.x, e.y, t, e.p, window, size, pixel)
    _of_neighbours(e.x, e.y, t, e.p, window, size, beside)
    _of_times(e.x, e.y, t, window, _bursts(t, window), times)
    on, off, turns, pairs, log_gap, short, active, most, square, to_on, on_gap, off_gap, runs, growing = np.moveaxis(
        pixel, -1, 0
    )
    company, inside, inside_near, border, border_near, near, right, down = np.moveaxis(beside, -1, 0)
    count = on + off
    some, two, linked = np.maximum(count, 1), np.maximum(pairs, 1), np.maximum(near, 1)
    to_off = turns - to_on
    both = (to_on > 0) & (to_off > 0)
    x, y = right / linked, down / linked
    # An event of each polarity is added, so that few events give no extreme share.
    log, on_share = np.log1p(count), (on + 1) / (count + 2)
    names = (
        np.log1p(on),
        np.log1p(off),
        np.abs(on - off) / some,
        turns / two,
        # Without a pair, e^20 µs, about eight minutes, stands for the interval.
        np.where(pairs > 0, log_gap / two, 20.0),
        short / two,
        company / some,
        np.log1p(active),
        most,
        square / some,
        count / np.maximum(active, 1),
        np.where(both, on_gap / np.maximum(to_on, 1) - off_gap / np.maximum(to_off, 1), 0.0),
        (to_on + 1) / (turns + 2),
        growing / np.maximum(runs, 1),
        x,
        y,
        border_near / np.maximum(border, 1) - inside_near / np.maximum(inside, 1),
        times[..., 0] / some,
        times[..., 1] / some,
        np.abs(log - _beside(log)),
        np.abs(x - _beside(x)),
        np.abs(y - _beside(y)),
        np.abs(on_share - _beside(on_share)),
        np.diff(log, axis=0, prepend=log[:1]),
        -np.diff(log, axis=0, append=log[-1:]),
    )
    return count.astype(np.int64), np.stack(names, -1).astype(np.float32)


def _beside(values: np.ndarray) -> np.ndarray:
    """Return the mean over the patches left, right, above and below, where they exist."""
    padded = np.pad(values, ((0, 0), (1, 1), (1, 1)), constant_values=np.nan)
    four = np.stack([padded[:, :-2, 1:-1], padded[:, 2:, 1:-1], padded[:, 1:-1, :-2], padded[:, 1:-1, 2:]])
    there = np.isfinite(four)
    mean = np.where(there, four, 0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
    return np.where(there.any(axis=0), mean, values)


def _bursts(t: np.ndarray, window: float) -> np.ndarray:
    """Return the logarithm of the sensor's events in short parts of the time relative to the usual count around
    them."""
    parts = WINDOWS * _BURST
    count = np.bincount(np.minimum((t / window * _BURST).astype(np.int64), parts - 1), minlength=parts).astype(float)
    # A mean over half a window: slower changes of the rate are motion, not bursts.
    usual = np.convolve(count, np.full(_BURST // 2 + 1, 1 / (_BURST // 2 + 1)), "same")
    return np.log((count + 1) / (usual + 1))


@kernel
def _of_pixels(x, y, t, p, window, size, sums):
    """Compute sums over each pixel's own events in a patch."""
    # 0, 1: ON, OFF events; 2: turns of polarity; 3: pairs of successive events; 4: sum of their ln intervals; 5: short
    # ones; 6: pixels that fired; 7: most events of a pixel; 8: sum of 1 + 2 + … n over pixels; 9: turns to ON; 10, 11:
    # ln intervals before turns to ON, to OFF; 12: runs of three of one polarity; 13: growing less shrinking intervals.
    last = np.full(size, -1, np.int64)
    before = np.zeros(size, np.uint8)
    gap_before = np.full(size, -1, np.int64)  # of one polarity; -1: the event before was of the other, or the first
    seen = np.full(size, -1, np.int64)
    count = np.zeros(size, np.int64)
    for i in range(len(t)):
        k = min(int(t[i] / window), sums.shape[0] - 1)
        at = y[i], x[i]
        s = sums[k, y[i] // SIDE_PX, x[i] // SIDE_PX]
        s[0 if p[i] else 1] += 1
        gap = t[i] - last[at] if last[at] >= 0 else -1
        turn = p[i] != before[at]
        # The first event of a pixel in a window has no interval: it would reach into another window.
        if seen[at] != k:
            seen[at], count[at], gap = k, 0, -1
            s[6] += 1
        else:
            log_gap = np.log(max(gap, 1))
            s[2] += turn
            s[3] += 1
            s[4] += log_gap
            s[5] += gap < NEAR_US
            if turn:
                s[9] += p[i]
                s[10 if p[i] else 11] += log_gap
            elif gap_before[at] >= 0:
                s[12] += 1
                s[13] += np.sign(gap - gap_before[at])
        gap_before[at] = -1 if turn else gap
        count[at] += 1
        s[7] = max(s[7], count[at])
        s[8] += count[at]
        last[at], before[at] = t[i], p[i]


@kernel
def _of_neighbours(x, y, t, p, window, size, sums):
    """Compute sums over the preceding events of the eight pixels around each event."""
    # 0: events with company; 1, 2: neighbours inside the patch, and those linked (the same polarity, half a window ago
    # at most); 3, 4: the same across its border; 5: links; 6, 7: sums of their steps to the right, down.
    height, width = size
    last = np.full(size, -1, np.int64)
    before = np.zeros(size, np.uint8)
    for i in range(len(t)):
        k = min(int(t[i] / window), sums.shape[0] - 1)
        r, c = y[i], x[i]
        s = sums[k, r // SIDE_PX, c // SIDE_PX]
        company = False
        for dr in (-1, 0, 1):
            for dc in (-1, 0, 1):
                rr, cc = r + dr, c + dc
                if (dr == 0 and dc == 0) or not (0 <= rr < height and 0 <= cc < width):
                    continue
                company = company or (last[rr, cc] >= 0 and t[i] - last[rr, cc] < NEAR_US)
                linked = last[rr, cc] >= 0 and t[i] - last[rr, cc] < window / 2 and before[rr, cc] == p[i]
                inside = rr // SIDE_PX == r // SIDE_PX and cc // SIDE_PX == c // SIDE_PX
                s[1 if inside else 3] += 1
                s[2 if inside else 4] += linked
                if linked:  # what fired there before came from there
                    s[5] += 1
                    s[6] -= dc
                    s[7] -= dr
        s[0] += company
        last[r, c], before[r, c] = t[i], p[i]


@kernel
def _of_times(x, y, t, window, bursts, sums):
    """Count events with the same time as the previous one, anywhere, and the sensor's activity."""
    for i in range(len(t)):
        k = min(int(t[i] / window), sums.shape[0] - 1)
        s = sums[k, y[i] // SIDE_PX, x[i] // SIDE_PX]
        s[0] += i > 0 and t[i] == t[i - 1]
        s[1] += bursts[min(int(t[i] / window * _BURST), len(bursts) - 1)]
