"""Filters on the camera against their definitions, on streams made for them; any chunking, and state."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from blinkgl.config.base import validate
from blinkgl.config.readout import FlickerFilter, RateFilter, ReadoutConfig, TrailFilter
from blinkgl.errors import ConfigError, EventDataError
from blinkgl.events import Events
from blinkgl.events.filters import make_filter
from tests.events.clips import assert_same

HEIGHT, WIDTH = 20, 24


def stream(rows):
    """Events of (t, x, y, p)."""
    t, x, y, p = np.array(sorted(rows), np.int64).reshape(-1, 4).T
    return Events(x.astype(np.uint16), y.astype(np.uint16), np.ascontiguousarray(t), p.astype(np.uint8))


def noisy(n=6000, seed=0, span_us=40_000):
    rng = np.random.default_rng(seed)
    columns = zip(
        rng.integers(0, span_us, n), rng.integers(0, 6, n), rng.integers(0, 5, n), rng.integers(0, 2, n), strict=True
    )
    return stream(columns)


BURSTS = [  # one pixel: (t, p); threshold 1000
    *((100, 1), (1100, 1), (1600, 1)),  # a burst: 1000 apart still belongs
    *((2700, 1), (2800, 1)),  # 1100 later: another
    *((2900, 0),),  # a single one of the other polarity
    *((2950, 1), (3000, 1), (3100, 1), (3200, 1)),
]


@pytest.mark.parametrize(
    "keep, times",
    [
        ("first", [100, 2700, 2900, 2950]),
        ("second", [1100, 2800, 3000]),
        ("not_first", [1100, 1600, 2800, 3000, 3100, 3200]),
    ],
)
def test_trail_passes_its_part_of_every_burst(keep, times):
    config = TrailFilter(keep=keep, threshold_us=1000)
    events = stream([(t, 7, 3, p) for t, p in BURSTS] + [(150, 8, 3, 0)])  # a neighbour is no part of it
    passed = make_filter(config, HEIGHT, WIDTH).step(events)
    mine = passed.part(passed.x == 7)
    assert mine.t.tolist() == times
    assert (len(passed) - len(mine)) == (keep == "first")


@pytest.mark.parametrize("keep", ["first", "second", "not_first"])
def test_trail_equals_its_definition_on_noise(keep):
    """Every burst by itself, nothing clever."""
    events, threshold = noisy(), 900
    wanted = []
    for pixel in np.unique(events.y.astype(int) * WIDTH + events.x):
        of_it = np.flatnonzero(events.y.astype(int) * WIDTH + events.x == pixel)
        t, p = events.t[of_it], events.p[of_it]
        breaks = np.flatnonzero((np.diff(t) > threshold) | (np.diff(p.astype(int)) != 0)) + 1
        for burst in np.split(of_it, breaks):
            wanted += {"first": burst[:1], "second": burst[1:2], "not_first": burst[1:]}[keep].tolist()
    passed = make_filter(TrailFilter(keep=keep, threshold_us=threshold), HEIGHT, WIDTH).step(events)
    assert_same(passed, events.part(np.array(sorted(wanted))))
    assert 0 < len(passed) < len(events)


def test_rate_passes_all_below_and_its_limit_above():
    config = RateFilter(events_per_second=1e6, period_us=200)  # 200 a period
    rng = np.random.default_rng(1)

    def made(per_period, periods):
        t = np.sort(rng.integers(0, 200 * periods, per_period * periods))
        return stream([(k, i % WIDTH, i % HEIGHT, 1) for i, k in enumerate(t)])

    quiet = made(100, 50)
    assert_same(make_filter(config, HEIGHT, WIDTH).step(quiet), quiet)
    busy, stage = made(1000, 50), make_filter(config, HEIGHT, WIDTH)
    passed = stage.step(busy)
    counts = np.bincount(passed.t // 200, minlength=50)
    assert counts.max() == 200 and abs(counts[1:].mean() / 200 - 1) < 0.03, counts
    assert stage.dropped == len(busy) - len(passed)
    # The first period's limit is spent at once; from the second on events pass all through the period.
    late = [np.mean(passed.t[passed.t // 200 == k] % 200 > 150) for k in range(50)]
    assert late[0] == 0 and 0.2 < np.mean(late[1:]) < 0.3


def test_rate_knows_an_idle_period():
    config = RateFilter(events_per_second=10_000, period_us=1000)  # 10
    rows = [(t, 0, 0, 1) for t in (*range(0, 1000, 10), *range(5000, 5010))]
    passed = make_filter(config, HEIGHT, WIDTH).step(stream(rows))
    assert (passed.t < 1000).sum() == 10 and (passed.t >= 5000).sum() == 10


def flickering(hz, cycles, x=5, y=6, t0=1000, size=3):
    """ON events of ``size`` pixels at the start of each period, OFF at its middle."""
    period = 1e6 / hz
    return [
        (int(t0 + (k + half / 2) * period) + i, x + i % 2, y + i // 2, 1 - half)
        for k in range(cycles)
        for half in (0, 1)
        for i in range(size)
    ]


def test_flicker_drops_what_flickers_in_the_band_after_its_start():
    config = FlickerFilter(low_hz=90, high_hz=130, start=6, stop_below=4)
    inside, slow, fast = flickering(100, 20), flickering(50, 10, x=12), flickering(300, 60, x=16)
    passed = make_filter(config, HEIGHT, WIDTH).step(stream(inside + slow + fast))
    mine = passed.part((passed.x >= 5) & (passed.x < 8))
    assert (passed.x >= 12).sum() == len(slow) + len(fast), "neither is in the band"
    # The first burst follows no OFF event; the next starts the clock, and six distances later it counts as flicker.
    onsets = sorted({t for t, x, y, p in inside if p == 1 and (x, y) == (5, 6)})
    assert mine.t.max() < onsets[7] and mine.t.max() > onsets[6], "the seventh distance is dropped"
    only = make_filter(config.model_copy(update={"mode": "pass"}), HEIGHT, WIDTH).step(stream(inside + slow + fast))
    assert_same(stream([tuple(r) for e in (passed, only) for r in zip(e.t, e.x, e.y, e.p, strict=True)]),
                stream(inside + slow + fast))  # fmt: skip


def test_flicker_ends_with_the_light_and_is_of_a_block():
    config = FlickerFilter(low_hz=90, high_hz=130)
    lamp = flickering(100, 20)
    end = lamp[-1][0]
    after = [(end + 30_000, 5, 6, 0), (end + 31_000, 6, 6, 1), (end + 31_500, 6, 6, 0)]
    elsewhere = [(150_000 + k, 8, 6, k % 2) for k in range(5)]  # x = 8: the next block of four
    passed = make_filter(config, HEIGHT, WIDTH).step(stream(lamp + after + elsewhere))
    assert (passed.x == 8).sum() == 5
    assert (passed.t > end).sum() == 3, "a pause longer than the lowest frequency's period ends it"


def test_flicker_counts_back_for_bursts_that_come_too_soon():
    config = FlickerFilter(low_hz=90, high_hz=130, start=6, stop_below=4)

    def bursts(distances_ms):
        """One ON event, 400 us later one OFF event, at these distances; whether each ON event passes."""
        onsets = np.cumsum([1000, *(1000 * d for d in distances_ms)]).astype(int)
        events = stream([(1, 5, 6, 0), *((t + 400 * half, 5, 6, 1 - half) for t in onsets for half in (0, 1))])
        passed = make_filter(config, HEIGHT, WIDTH).step(events)
        return np.isin(onsets, passed.t[passed.p == 1]).tolist()

    long_ago = [True]  # the first burst has none before it
    assert bursts([10] * 7) == long_ago + [True] * 5 + [False] * 2, "the sixth distance in the band starts it"
    assert bursts([10] * 4 + [1] * 2 + [10] * 3) == long_ago + [True] * 9, "4 less 2 and 3 are 5"
    stops = bursts([10] * 6 + [1] * 3 + [10] * 2)
    assert stops == long_ago + [True] * 5 + [False] * 3 + [True] * 3, "6 less 3 are below 4; 5 do not start it again"


STAGES = (
    TrailFilter(threshold_us=700),
    TrailFilter(keep="not_first", threshold_us=700),
    RateFilter(events_per_second=50_000, period_us=1000),
    FlickerFilter(start=2, stop_below=1, high_hz=2000),
)


@pytest.mark.parametrize("config", STAGES, ids=lambda c: c.kind)
def test_any_chunking_and_a_saved_state_give_the_same(config):
    events = noisy(seed=3)
    whole = make_filter(config, HEIGHT, WIDTH)
    expected = whole.step(events)
    parts, stage = [], make_filter(config, HEIGHT, WIDTH)
    for a, b in itertools.pairwise([0, 1, 1, 37, 2000, 2001, 6000]):
        parts.append(stage.step(events.part(slice(a, b))))
        again = make_filter(config, HEIGHT, WIDTH)
        again.load_state_dict(stage.state_dict())
        stage = again
    assert_same(Events.concatenate(parts), expected)
    assert 0 < stage.dropped == whole.dropped == len(events) - len(expected)
    with pytest.raises(EventDataError, match="another filter"):
        stage.load_state_dict({"dropped": np.array([1])})


@pytest.mark.parametrize(
    "tree, where",
    [
        ({"kind": "trail", "keep": "third"}, "filters.0.keep"),
        ({"kind": "stc"}, "filters.0.kind"),
        ({"kind": "rate", "events_per_second": 1000}, "filters.0.period_us"),
        ({"kind": "flicker", "low_hz": 600}, "filters.0.low_hz"),
        ({"kind": "flicker", "stop_below": 9}, "filters.0.stop_below"),
    ],
)
def test_bad_filters_are_refused(tree, where):
    with pytest.raises(ConfigError) as caught:
        validate(ReadoutConfig, {"filters": [tree]})
    assert caught.value.where == where
