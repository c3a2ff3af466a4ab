"""Statistics of windows: of patterns whose numbers are known, and a page that says what was counted."""

import itertools

import matplotlib.pyplot as plt
import numpy as np
import pytest

pytest.importorskip("torch")

from tiny_recipe import TINY

from blinkgl.config.reader import to_yaml
from blinkgl.tools import data_statistics as ds
from blinkgl.types.events import Events
from eflow.data.window import Window


def window(x, y, t, p, t0, t1) -> Window:
    return Window(np.array(x, np.uint16), np.array(y, np.uint16), np.array(t, np.int64), np.array(p, np.uint8), t0, t1)


def test_statistics_of_a_known_pattern():
    """A column of 20 pixels, each of which fires three times, 2 ms apart; 10x20 px; flow 3 px."""
    y = np.repeat(np.arange(20), 3)
    t = np.tile([100, 2100, 4100], 20)
    order = np.argsort(t, kind="stable")
    new = window(np.full(60, 4), y[order], t[order], np.ones(60), 0, 5000)
    old = window([1, 2], [1, 2], [-10, -5], [0, 0], -5000, 0)
    found = ds.statistics(old, new, (20, 10), 3.0)
    assert found["events"] == pytest.approx(0.3) and found["density"] == pytest.approx(0.1) and found["flow"] == 3
    assert found["on"] == pytest.approx(60 / 62) and found["interval"] == pytest.approx(2) and found["repeats"] == 3
    unknown = ds.statistics(old, new, (20, 10), None)
    assert np.isnan(unknown["flow"]) and np.isnan(unknown["density"]) and unknown["events"] == found["events"]


@pytest.mark.parametrize("width", [1, 3, 8])
def test_the_width_of_a_line(width):
    hit = np.zeros((400, 40), bool)
    hit[:, 5 : 5 + width] = True
    assert ds.edge_width(hit) == pytest.approx(width, rel=0.03)
    assert ds.edge_width(np.zeros((4, 4), bool)) == 0
    single = np.zeros((9, 9), bool)
    single[4, 4] = True
    assert ds.edge_width(single) == 0.5


def test_tiles_cover_a_recording_and_hold_its_events():
    rng = np.random.default_rng(1)
    n = 200_000
    t = np.sort(rng.integers(10_000, 510_000, n))
    events = Events(*(rng.integers(0, s, n).astype(np.uint16) for s in (300, 140)), t, np.ones(n, np.uint8))
    pairs = list(ds.tiles(events, 140, 300, np.random.default_rng(0)))
    assert len(pairs) % 2 == 0  # two tiles of 128 px in 300 columns
    begins = sorted({old.t0 for old, _ in pairs})
    ends = {old.t0: old.t1 for old, _ in pairs}
    assert begins[0] == t[0] and all(ends[a] == b for a, b in itertools.pairwise(begins))
    for old, new in pairs:
        assert old.t1 == new.t0 and 5_000 <= new.t1 - new.t0 <= 100_000 and max(new.x.max(), new.y.max()) < ds.SIDE
        expected = (new.t1 - new.t0) / 500_000 * n * (128 / 300) * (128 / 140)
        assert len(new) == pytest.approx(expected, rel=0.25)


def test_the_page_has_every_recording_and_what_lies_inside(tmp_path):
    rng = np.random.default_rng(0)
    rows = lambda factor: [{k: factor * float(rng.uniform(0.5, 1)) for k in ds.STATISTICS} for _ in range(40)]
    found = {"one": rows(1), "ecd_rotation/x": rows(9)}
    found["one"][0]["flow"] = np.nan
    made = {k: ds.column(rows(1) + rows(1), k) for k in ds.STATISTICS}
    assert len(ds.column(found["one"], "flow")) == 39
    assert ds.inside(found["one"], made["flow"], "flow") > 0.9
    assert ds.inside(found["ecd_rotation/x"], made["flow"], "flow") == 0
    text = ds.page("the command", made, found, {"one": "a", "ecd_rotation/x": "b"}, "images/p.png")
    assert "the command" in text and text.count("| one |") == 2 and text.count("| ecd_rotation/x |") == 2
    ds.draw(made, found, tmp_path / "p.png")
    height, width = plt.imread(tmp_path / "p.png").shape[:2]
    assert width > 3 * height


def test_recordings_are_found_by_their_endings(tmp_path):
    for name in ("a/x.raw", "a/events.txt", "a/calib.txt", "b/y.aedat4", "b/z.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = [p.relative_to(tmp_path).as_posix() for p in ds.recordings(tmp_path)]
    assert found == ["a/events.txt", "a/x.raw", "b/y.aedat4"]


def test_of_a_recipe_as_training_gets_it(tmp_path, monkeypatch):
    """Windows of 40 events or more of 5 to 100 ms, each with the length of its flow; as many as were asked for."""
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(to_yaml({**TINY, "labels": {**TINY["labels"], "flow": ["forward", "backward"]}}))
    rows = ds.of_recipe(str(recipe), 12, 0)
    assert len(rows) == 12
    events, flow = ds.column(rows, "events"), ds.column(rows, "flow")
    area = TINY["camera"]["width"] * TINY["camera"]["height"]
    assert len(events) == len(flow) == 12 and (events * area >= ds.LEAST - 1e-6).all() and (flow > 0).all()
    assert len(set(events)) > 6, "windows differ"
