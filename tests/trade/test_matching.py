"""Matching and errors of event streams: cases that were worked out by hand, an exhaustive search, exact shifts."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from blinkgl.trade.matching import match_events
from blinkgl.trade.metrics import SpeedMaps, event_errors
from blinkgl.types.events import Events

H, W = 4, 5


def stream(*rows) -> Events:
    """Events from (x, y, t, p) rows, sorted by time."""
    rows = sorted(rows, key=lambda r: r[2])
    x, y, t, p = zip(*rows) if rows else ((), (), (), ())
    return Events(np.array(x, np.uint16), np.array(y, np.uint16), np.array(t, np.int64), np.array(p, np.uint8))


def train(*times, x=1, y=2, p=1) -> Events:
    return stream(*((x, y, t, p) for t in times))


def random_stream(n: int, span_us: int, seed: int) -> Events:
    rng = np.random.default_rng(seed)
    return Events(
        rng.integers(0, W, n).astype(np.uint16),
        rng.integers(0, H, n).astype(np.uint16),
        np.sort(rng.integers(0, span_us, n)),
        rng.integers(0, 2, n).astype(np.uint8),
    )


def pairs(a: Events, b: Events, limit_us: int) -> list[tuple[int, int]]:
    m = match_events(a, b, H, W, limit_us)
    return [(int(a.t[i]), int(b.t[j])) for i, j in enumerate(m.partner) if j >= 0]


SPEED = SpeedMaps(np.array([0]), np.full((1, H, W), 200.0, np.float32))


def errors(a: Events, b: Events, limit_us: int = 1000, **options):
    return event_errors(a, b, SPEED, 0, 100_000, limit_us=limit_us, **options)


def test_dropped_and_invented_events_are_counted():
    a = random_stream(4000, 100_000, 1)
    keep = np.arange(len(a)) % 8 != 0
    b = Events(a.x[keep], a.y[keep], a.t[keep], a.p[keep])
    e = errors(a, b)
    assert e.missed == pytest.approx(1 / 8) and e.extra == 0 and e.time_p95_us == 0 and e.count == pytest.approx(-1 / 8)
    e = errors(b, a)
    assert e.missed == 0 and e.extra == pytest.approx(1 / 7)


def cost_of(a: list[int], b: list[int], limit: int) -> float:
    """The least cost over all matchings, by trying them all."""
    best = np.inf
    for size in range(min(len(a), len(b)) + 1):
        for left in itertools.combinations(range(len(a)), size):
            for right in itertools.permutations(range(len(b)), size):
                distances = [abs(a[i] - b[j]) for i, j in zip(left, right)]
                if all(d <= limit for d in distances):
                    best = min(best, sum(distances) + limit / 2 * (len(a) + len(b) - 2 * size))
    return best


@pytest.mark.parametrize("seed", range(60))
def test_optimal_among_all_matchings(seed):
    rng = np.random.default_rng(seed)
    a, b = (sorted(rng.integers(0, 60, rng.integers(1, 6)).tolist()) for _ in range(2))
    limit = int(rng.integers(2, 40))
    found = match_events(train(*a), train(*b), H, W, limit)
    cost = float(np.abs(found.dt_us).sum()) + limit / 2 * (int((~found.matched).sum()) + found.extra)
    assert cost == cost_of(a, b, limit)
    used = found.partner[found.matched]
    assert len(set(used.tolist())) == len(used) and np.abs(found.dt_us).max(initial=0) <= limit


def test_window_and_mask():
    a = train(1000, 5000, 9000)
    b = stream((1, 2, 1010, 1), (1, 2, 9010, 1), (4, 3, 5000, 1))
    e = event_errors(a, b, SPEED, 0, 6000, limit_us=100)
    assert (e.reference_events, e.events, e.missed, e.extra) == (2, 2, 0.5, 0.5)
    mask = np.zeros((H, W), bool)
    mask[2, 1] = True
    e = event_errors(a, b, SPEED, 0, 10_000, limit_us=100, mask=mask)
    assert (e.reference_events, e.events, e.extra) == (3, 2, 0) and e.missed == pytest.approx(1 / 3)
    empty = event_errors(train(), train(), SPEED, 0, 10, limit_us=5)
    assert np.isnan(empty.missed) and np.isnan(empty.voxel) and np.isnan(empty.time_median_us) and np.isnan(empty.count)


def test_off_the_sensor_is_refused():
    with pytest.raises(ValueError, match="off the sensor"):
        match_events(train(1, x=W), train(1), H, W, 10)
    with pytest.raises(ValueError, match="limit_us"):
        match_events(train(1), train(1), H, W, 0)
