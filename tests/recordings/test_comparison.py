"""compare: against recordings whose statistics are known, and against the numbers on the data's own page."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from blinkgl.cli import run
from blinkgl.errors import EventDataError
from blinkgl.io.columns import windows
from blinkgl.io.formats import write_events
from blinkgl.recordings.comparison import compare
from blinkgl.types.events import Events
from tests.shared_data import shared

H, W = 40, 50


def poisson(rate_hz: float, on_share: float, seconds=4.0, seed=0, t0=0, pixels=None) -> Events:
    """Independent pixels with Poisson events; ``pixels`` (H, W) weights the rate."""
    rng = np.random.default_rng(seed)
    weights = np.ones((H, W)) if pixels is None else pixels
    n = rng.poisson(rate_hz * seconds * weights.sum())
    where = rng.choice(H * W, n, p=(weights / weights.sum()).ravel())
    return Events(
        (where % W).astype(np.uint16),
        (where // W).astype(np.uint16),
        t0 + np.sort(rng.integers(0, round(seconds * 1e6), n)),
        (rng.random(n) < on_share).astype(np.uint8),
    )


def test_recording_with_itself_and_shifted(tmp_path):
    pixels = np.random.default_rng(3).random((H, W)) ** 4
    a = poisson(50, 0.4, pixels=pixels)
    write_events(tmp_path / "a.npz", a, H, W)
    write_events(tmp_path / "b.npz", Events(a.x, a.y, a.t + 10**9, a.p), H, W)
    result = compare(tmp_path / "a.npz", tmp_path / "a.npz")
    assert (
        result.pixel_correlation == pytest.approx(1)
        and np.allclose(result.polarity_correlation, 1)
        and result.iei_distance == 0
    )
    with pytest.raises(EventDataError, match=r"no common time .*--zero-time"):
        compare(tmp_path / "a.npz", tmp_path / "b.npz")
    result = compare(tmp_path / "a.npz", tmp_path / "b.npz", zero_time=True)
    assert result.pixel_correlation == pytest.approx(1) and np.allclose(result.polarity_correlation, 1)


def test_slider_depth_gives_the_figures_on_its_page():
    """MANIFEST.md: summed polarity against log(I+10) change per interval correlates
    0.82-0.88; implied threshold ~0.5-0.6."""
    root = shared("data/events/slider_depth")
    result = compare(root / "events_chunk.txt", root)
    assert len(result.a.frame_correlation) == 4
    assert result.a.frame_correlation.min() > 0.80 and result.a.frame_correlation.max() < 0.90
    assert np.all((result.a.implied_threshold > 0.48) & (result.a.implied_threshold < 0.62))


def test_one_recording_is_described(tmp_path, capsys):
    events = poisson(20, 0.8)
    write_events(tmp_path / "a.h5", events, H, W)
    result = compare(tmp_path / "a.h5")
    assert result.b is None and result.a.count == len(events) and result.a.on_off_ratio == pytest.approx(4, rel=0.05)
    assert run(["compare", str(tmp_path / "a.h5"), "-o", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert "50x40" in out and f"{len(events):,}" in out and (tmp_path / "out/compare.png").stat().st_size > 10_000


def test_bad_input(tmp_path):
    write_events(tmp_path / "a.h5", poisson(5, 0.5), H, W)
    write_events(tmp_path / "b.h5", Events.empty(), H, W)
    with pytest.raises(EventDataError, match="b.h5: no events"):
        compare(tmp_path / "a.h5", tmp_path / "b.h5")
    np.savez(tmp_path / "f.npz", frames=np.ones((3, H, W + 2)), timestamps_us=[0, 1, 2])
    with pytest.raises(EventDataError, match=r"f\.npz: 52x40; .*a\.h5: 50x40"):
        compare(tmp_path / "a.h5", tmp_path / "f.npz")


# --- by hand, one figure at a time ------------------------------------------------------------------------------------


def listed(*rows) -> Events:
    """Events of (x, y, t, p)."""
    x, y, t, p = (np.array(column) for column in zip(*rows, strict=True))
    return Events(x.astype(np.uint16), y.astype(np.uint16), t.astype(np.int64), p.astype(np.uint8))


def test_every_figure_of_two_small_recordings(tmp_path):
    """Two pixels of A with intervals of 1, 10 and 0 µs and 20 s; B has one of 1000 µs."""
    a = listed(
        (0, 0, 1000, 1), (0, 0, 1001, 1), (0, 0, 1011, 0), (3, 2, 5000, 1), (3, 2, 5000, 1), (0, 0, 20_001_011, 1)
    )
    b = listed((1, 1, 1000, 1), (1, 1, 2000, 1), (1, 1, 20_001_011, 0))
    write_events(tmp_path / "a.npz", a, 3, 4)
    write_events(tmp_path / "b.npz", b, 3, 4)
    result = compare(tmp_path / "a.npz", tmp_path / "b.npz", interval_ms=10_000)
    assert result.edges_us.tolist() == [1000, 10_001_000, 20_001_012] and result.duration_s == pytest.approx(20.000012)
    assert (result.a.count, result.a.on, result.b.count, result.b.on) == (6, 5, 3, 2)
    np.testing.assert_allclose(result.a.rate_hz, [0.5, 1 / 10.000012])
    np.testing.assert_allclose(result.b.rate_hz, [0.2, 1 / 10.000012])
    np.testing.assert_allclose(result.rate_ratio, [0.4, 1.0])
    assert np.flatnonzero(result.a.iei).tolist() == [0, 10, 69] and result.a.iei.sum() == 4 and result.a.iei[0] == 2
    assert np.flatnonzero(result.b.iei).tolist() == [30, 69], "a millisecond, and all above ten seconds in the last"
    assert result.a.median_iei_us == pytest.approx(10**0.05) and result.b.median_iei_us == pytest.approx(10**3.05)
    assert result.a.on_off_ratio == 5 and result.b.on_off_ratio == 2 and result.iei_distance == 0.75
    counts = np.zeros((2, 3, 4))
    counts[0, 0, 0], counts[0, 2, 3], counts[1, 1, 1] = 4, 2, 3
    assert np.array_equal(result.a.counts, counts[0]) and np.array_equal(result.b.counts, counts[1])
    assert result.pixel_correlation == pytest.approx(np.corrcoef(counts[0].ravel(), counts[1].ravel())[0, 1])
    assert np.isfinite(result.polarity_correlation).all()
    said = {name: values for name, *values in result.rows()}
    assert said["sensor"] == ["4x3", "4x3"] and said["events"] == ["6", "3"]
    assert said["rate"] == ["3e-07 M/s", "1.5e-07 M/s"] and said["rate of a pixel"] == ["0.025 Hz", "0.0125 Hz"]
    assert said["ON / OFF"] == ["5.000", "2.000"] and said["active pixels"] == ["16.7 %", "8.3 %"]
    assert said["median interval of a pixel"] == ["0.00112 ms", "1.12 ms"]
    assert said["event-rate ratio B / A per interval"] == ["", "0.700 (0.400 … 1.000)"]
    assert said["interval distribution, KS distance"] == ["", "0.750"] and len(said) == 11
    plain = result.to_dict()
    assert plain["rate_ratio"] == [pytest.approx(0.4), 1.0] and plain["a"]["count"] == 6 and "counts" not in plain["a"]
    assert (
        plain["duration_s"] == pytest.approx(20.000012)
        and len(plain["iei_edges_us"]) == 71
        and plain["edges_us"][1] == 10_001_000
    )
    alone = compare(tmp_path / "a.npz", interval_ms=10_000)
    assert not alone.same_size and [len(row) for row in alone.rows()] == [3] * 7 and "b" not in alone.to_dict()


def test_what_cannot_be_divided_is_said_so(tmp_path):
    """No OFF event, no pixel with two events, nothing that differs between pixels."""
    write_events(tmp_path / "a.npz", listed((0, 0, 5, 1), (1, 0, 7, 1)), 1, 2)
    result = compare(tmp_path / "a.npz")
    assert result.a.on_off_ratio == np.inf and np.isnan(result.a.median_iei_us)
    assert result.to_dict()["a"]["on_off_ratio"] is result.to_dict()["a"]["median_iei_us"] is None
    both = compare(tmp_path / "a.npz", tmp_path / "a.npz")
    assert np.isnan(both.pixel_correlation) and np.isnan(both.polarity_correlation).all() and both.iei_distance == 0
    assert {r[0]: r[2] for r in both.rows()}["polarity sums A : B per interval, correlation"] == "–"


@pytest.mark.parametrize("cuts", [(), (1,), (2, 3), (1, 2, 3, 4, 5, 6), (6,)])
def test_windows_of_any_chunks(cuts):
    """An event on an edge belongs to the interval that begins there; intervals without events come, too."""
    events = listed(*((k, 0, t, 1) for k, t in enumerate((10, 19, 20, 39, 40, 71, 80))))
    bounds = [0, *cuts, len(events)]
    chunks = [
        Events(*(c[i:j] for c in (events.x, events.y, events.t, events.p))) for i, j in itertools.pairwise(bounds)
    ]
    found = [w.t.tolist() for w in windows(chunks, np.arange(20, 101, 20))]
    assert found == [[20, 39], [40], [71], [80]]
