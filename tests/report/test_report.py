"""The page says what the data set holds; nothing in it is fetched; what a stranger wrote is escaped."""

import base64
import json
import shutil
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset.run import run_dataset
from blinkgl.report import charts
from blinkgl.report.charts import histogram
from blinkgl.report.collect import Parameter, _walk, collect
from blinkgl.report.page import _counts, _parameter

RECIPE = {
    "seed": 5,
    "camera": {"width": 48, "height": 36},
    "time": {"duration": 0.2, "label_rate": 20},
    "timeline": {"kind": "uniform", "fps": 200},
    "scene": {
        "kind": "random",
        "objects": {"count": {"integer": [1, 3]}},
        "pool": {"primitives": ["cuboid"], "variants": 12, "test_fraction": 0.3},
        "textures": {
            "procedural": ["checks"],
            "variants": 12,
            "photographs": False,
            "max_size": 64,
            "test_fraction": 0.3,
        },
    },
    "labels": {"flow": ["forward"], "ids": True, "depth": True},
    "preview": {"enabled": False},
    "groups": {
        "fly": {
            "output": {"sequences": 5},
            "events": {
                "shares": [
                    {"share": 0.6, "value": {"emulator": "esim", "contrast_threshold": {"uniform": [0.2, 0.4]}}},
                    {"share": 0.4, "value": {"emulator": "esim", "contrast_threshold": 0.5}},
                ]
            },
        },
        "probe": {"output": {"split": "test", "sequences": 2}},
    },
}


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    (folder / "r.yaml").write_text(yaml.safe_dump(RECIPE))
    run_dataset(load_run(folder / "r.yaml"), folder / "out")
    return folder / "out"


class Reader(HTMLParser):
    """Tags balanced, no reference to anything outside."""

    VOID = frozenset({"meta", "img", "rect", "line"})

    def __init__(self):
        super().__init__()
        self.open, self.images, self.text, self.outside = [], [], [], []

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            if name in ("src", "href", "action", "xlink:href") and not (value or "").startswith("data:"):
                self.outside.append(value)
            if name == "src":
                self.images.append(value)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag in self.VOID:
            return
        while self.open and self.open[-1] != tag and self.open[-1] == "p":
            self.open.pop()
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-3:]}"
        self.open.pop()

    def handle_data(self, text):
        self.text.append(text)


def read(path: Path) -> Reader:
    reader = Reader()
    reader.feed(path.read_text())
    assert reader.outside == [] and reader.open == []
    return reader


def test_the_page_is_whole_and_shows_what_is_there(data, capsys):
    assert run(["report", str(data), "--examples", "3"]) == 0
    page = read(data / "report.html")
    text = " ".join(page.text)
    assert "url(" not in text and "@import" not in text and "<script" not in (data / "report.html").read_text()
    assert len(page.images) == 3 * 3, "depth, ids and occlusion; frame, events and flow are in the preview"
    pictures = [
        cv2.imdecode(np.frombuffer(base64.b64decode(i.split(",")[1]), np.uint8), cv2.IMREAD_COLOR) for i in page.images
    ]
    assert {p.shape for p in pictures} == {(36, 48, 3)} and sum(p.std() > 3 for p in pictures) >= 6, (
        "masks may be black"
    )
    for words in (
        "5 / 5",
        "2 / 2",
        "train, esim",
        "Displacement",
        "Depth",
        "instance id",
        "occluded, forward",
        "scene.objects.count",
        "events.contrast_threshold",
        "fly: uniform, 3 sequences",
        "fly: shares, 5 sequences",
        "made at the first attempt",
        "7 of 7",
        "None.",
    ):
        assert words in text, words
    assert run(["verify", str(data)]) == 0, "the page belongs to the data set"


def test_numbers_are_those_of_the_files(data):
    found = collect(data)
    index = [json.loads(line) for line in (data / "index.jsonl").read_text().splitlines()]
    assert found.sequences == index
    rates = sorted(1e6 * e["events"] / e["duration_us"] / (48 * 36) for e in index)
    np.testing.assert_allclose(sorted(found.quantities["rate"]), rates)
    assert 0 < found.quantities["displacement"].mean() < 50
    np.testing.assert_allclose(found.quantities["speed"], found.quantities["displacement"] * 20)  # labels every 50 ms
    parameters = {(p.group, p.path, p.kind): p for p in found.parameters}
    drawn = [
        yaml.safe_load((data / f"train/fly_{i:06d}/config.yaml").read_text())["events"]["contrast_threshold"]
        for i in range(5)
    ]
    assert sorted(parameters["fly", "events.contrast_threshold", "uniform"].values + [0.5, 0.5]) == sorted(drawn)


def test_what_is_missing_or_broken_is_said(data, tmp_path):
    copy = Path(shutil.copytree(data, tmp_path / "copy"))
    shutil.rmtree(copy / "train/fly_000001")
    (copy / "train/fly_000002/manifest.json").write_text("{")
    (copy / "train/fly_000003/flow/forward/000001.png").write_bytes(b"")
    (copy / ".run/failed.json").write_text(
        json.dumps({"train/fly_000001": "the mesh <script>alert(1)</script> is corrupt"})
    )
    assert run(["report", str(copy), "--out", str(tmp_path / "page.html"), "--examples", "7"]) == 0
    text = " ".join(read(tmp_path / "page.html").text)
    assert "<script>" not in (tmp_path / "page.html").read_text()
    for words in ("3 / 5", "Some sequences that the recipe asks for are missing", "is corrupt", "damaged manifest"):
        assert words in text, words


def test_no_data_set(tmp_path, capsys):
    assert run(["report", str(tmp_path)]) == 2
    assert "no sequence found" in capsys.readouterr().err


@pytest.fixture
def draw():
    """A macro of charts.html, as a template uses it."""

    def drawn(call, **values):
        template = charts._environment().from_string(
            '{% import "report/charts.html" as charts %}{{ charts.' + call + " }}"
        )
        return template.render(values)

    return drawn


def test_charts_are_drawn_and_strangers_words_are_escaped(draw):
    evil = "<b title=\"x\" onload='y'>"
    for drawn in (
        draw("bars(rows)", rows=[(evil, 1.0, 2.0)]),
        draw("stacked(parts)", parts=[(evil, 3.0), ("b", 1.0)]),
        draw("tiles(t)", t=[(evil, evil)]),
        draw("histogram(h, unit)", h=histogram(np.array([1.0, 2.0])), unit=evil),
    ):
        assert "<b title" not in drawn and "&lt;b title=&#34;x&#34;" in drawn and "onload='" not in drawn
    assert "left:100.0%" in draw("bars(rows)", rows=[("a", 1.0, 2.0)]) and "tick" not in draw(
        "bars(rows)", rows=[("a", 1.0, None)]
    )
    assert "75 %" in draw("stacked(parts)", parts=[("a", 3.0), ("b", 1.0)]) and "no values" in draw(
        "histogram(h)", h=None
    )
    assert draw("histogram(h)", h=histogram(np.arange(9.0))).count('class="bar"') == 9


def test_bars_of_counts_stand_apart_and_are_labelled_by_counts():
    h = histogram(np.array([6.0, 7.0, 7.0, 9.0]), span=(5.5, 9.5), bins=4, whole=True)
    assert (h.low, h.median, h.high) == (6, 7, 9)
    lefts = [x for x, _ in h.bars]
    assert len(lefts) == 3 and min(np.diff(lefts)) > 1.3 * h.bar_width
    middle = (h.left + h.right) / 2
    assert lefts[0] + h.bar_width / 2 == pytest.approx(middle - 1.5 * (h.right - h.left) / 4)


@pytest.mark.parametrize(
    ("kind", "spec"),
    [
        ("shares", [{"value": "a", "share": 0.25}, {"value": "b", "share": 0.75}]),
        ("weighted", {"a": 2.0, "b": 6.0}),
        ("choice", ["a", "b", "b", "b"]),
    ],
)
def test_expected_counts_add_up_to_those_drawn(kind, spec):
    rows = _counts(Parameter("run", "output.label", kind, spec, ["b", "a", "b", "b", "b", "b", "b", "b"]))
    assert sorted(rows) == [("a", 1, pytest.approx(2.0)), ("b", 7, pytest.approx(6.0))]


def test_numbers_are_counted_however_they_are_written():
    """A sequence's own file has 60.0 where the recipe has 60, and null is an option like another."""
    spec = [60, 8e-1, None, True, "60 Hz"]
    rows = _counts(Parameter("run", "a", "choice", spec, [60.0, 0.8, 0.8, None, True, "60 Hz"]))
    assert {name: count for name, count, _ in rows} == {"60": 1, "0.8": 2, "null": 1, "true": 1, "60 Hz": 1}
    assert sum(share for *_, share in rows) == pytest.approx(6)


def test_a_normal_distribution_is_a_range():
    spec, values = [0.2, 0.03, 0.1, 0.3], [0.18, 0.21, 0.22, 0.31]
    shown = _parameter(Parameter("run", "events.contrast_threshold", "normal", spec, values))
    assert shown["counts"] is None and shown["outside"] == 1 and (shown["histogram"].left, shown["histogram"].right)
    assert "of [0.1, 0.3]" in shown["coverage"]


def test_options_of_null_are_found_in_the_sequences():
    into: list[Parameter] = []
    _walk("run", {"a": {"choice": [None, 5]}, "b": {"choice": [1, 2]}}, (), [{"a": None, "b": 1}, {"a": 5}], into)
    assert [(one.path, one.values) for one in into] == [("a", [None, 5]), ("b", [1])]


@pytest.mark.parametrize(
    ("value", "short", "bytes_"),
    [(9999, "9999", "0.01 MB"), (999_400, "999 k", "0.999 MB"), (999_600, "1 M", "1 MB"), (999.6e6, "1 G", "1 GB")],
)
def test_numbers_are_short_at_every_unit(value, short, bytes_):
    assert charts.number(value) == short and charts.size(value) == bytes_
