"""The validation of interpolated frames: its arithmetic, and that it tells a pan from thin bars."""

from __future__ import annotations

import json

import numpy as np
import pytest

from blinkgl.sequence.qualify import MEASURES
from blinkgl.tools import validate_interpolation as tool


def row(scene: str, wrong: float, rate: float = 10.0, events: int = 5000, **values: float) -> dict:
    return {
        "scene": scene,
        "rate": rate,
        "reference_events": events,
        "wrong": wrong,
        **dict.fromkeys(MEASURES, 0.0),
        **values,
    }


def test_area_is_the_chance_to_be_told_apart():
    bad = np.array([False, False, True, True])
    assert tool.area(bad, np.array([1, 2, 3, 4])) == 1
    assert tool.area(bad, np.array([4, 3, 2, 1])) == 0
    assert tool.area(bad, np.array([1, 3, 2, 4])) == 0.75
    assert tool.area(bad, np.ones(4)) == 0.5
    assert np.isnan(tool.area(np.ones(3, bool), np.arange(3)))


def test_limits_are_what_most_good_pairs_are_within():
    rows = [row("a", 0.1, thin=k / 100) for k in range(101)] + [row("a", 0.9, thin=5.0)]
    assert tool.limits_of(rows, 0.5, 0.95)["thin"] == pytest.approx(0.95)


def test_what_limits_are_worth():
    rows = [row("a", 0.1), row("a", 0.2, thin=0.5), row("a", 0.8, thin=0.6), row("a", 0.9, hidden=0.1)]
    found = tool.judged(rows, {"thin": 0.4, "hidden": 0.2}, 0.5)
    assert (found["pairs"], found["good"], found["accepted"]) == (4, 0.5, 0.5)
    assert (found["good_accepted"], found["bad_refused"], found["accepted_good"]) == (0.5, 0.5, 0.5)
    assert found["wrong_median_accepted"] == 0.5
    assert tool.judged(rows, {}, 0.5)["accepted"] == 1 and tool.judged(rows, {"thin": -1.0}, 0.5)["accepted"] == 0


def test_frame_times_are_whole_nanoseconds():
    times = tool.frame_times(40.0)
    assert times[0] == 0 and len(times) == 41 and times[1] == 25_000_000 and times[-1] == 10**9


def test_scenes_are_made_of_what_configurations_are():
    for name, (scene, seed) in tool.scenes().items():
        tool.config_of(scene, seed)
        assert name == name.strip()


def test_thin_bars_are_told_from_a_slide(gl, monkeypatch, capsys, tmp_path):
    """On small pictures: bars that move by more than their width are bad and measured as thin; a slide is neither."""
    for name, value in (("WIDTH", 64), ("HEIGHT", 48), ("SPAN_S", 0.3), ("MIN_EVENTS", 20)):
        monkeypatch.setattr(tool, name, value)
    rows = []
    for name, rate in (("slide, fbm", 20.0), ("bars 0.1 m, still", 10.0)):
        scene, seed = tool.scenes()[name]
        dense = tool.draw(gl, scene, seed, (rate,), 0.5)
        assert set(dense.kept) == set(tool.frame_times(rate)) and dense.frames > len(dense.kept)
        rows += tool.rows_of(name, dense, rate, "motion")
    slide, bars = ([r for r in rows if r["scene"].startswith(kind)] for kind in ("slide", "bars"))
    assert len(slide) == 6 and len(bars) == 3 and all(set(MEASURES) <= set(r) for r in rows)
    assert max(r["wrong"] for r in slide) < 0.4 < min(r["wrong"] for r in bars)
    assert max(r["thin"] for r in slide) == 0 < 0.05 < min(r["thin"] for r in bars)
    tool.report(rows, 0.4, 0.95, str(tmp_path / "p.png"))
    assert "9 pairs of 2 scenes" in capsys.readouterr().out and (tmp_path / "p.png").stat().st_size > 5000
    (tmp_path / "r.json").write_text(json.dumps({"rows": rows}))
