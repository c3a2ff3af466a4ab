"""The card of a data set."""

import re

import numpy as np
import pytest
import yaml

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset.run import run_dataset
from blinkgl.errors import AssetError
from blinkgl.io.flow_png import read_flow_png
from blinkgl.report.card import card_of, facts_of, write_card
from blinkgl.report.collect import Collected, collect
from blinkgl.report.page import build_report
from blinkgl.sequence_files.index import read_index

RECIPE = {
    "seed": 2,
    "camera": {"width": 24, "height": 16},
    "time": {"duration": 0.1, "label_rate": 20},
    "timeline": {"kind": "uniform", "fps": 60},
    "scene": {
        "kind": "random",
        "objects": {"count": 1},
        "pool": {"primitives": ["cuboid"], "variants": 2},
        "textures": {"procedural": ["checks"], "variants": 2, "photographs": False, "max_size": 64},
    },
    "labels": {"flow": ["forward"], "depth": True},
    "preview": {"enabled": False},
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("card")
    (folder / "recipe.yaml").write_text(yaml.safe_dump(RECIPE))
    run_dataset(load_run(folder / "recipe.yaml"), folder / "tiny", num=2)
    assert run(["report", str(folder / "tiny"), "--card", "--license", "cc-by-4.0", "--url", "here.invalid"]) == 0
    return folder / "tiny"


def test_its_figures_are_those_of_the_files(data):
    facts = {fact.name: fact.value for fact in facts_of(collect(data, examples=0))}
    lines = read_index(data)
    seconds = sum(line["duration_us"] for line in lines) / 1e6
    events = sum(line["events"] for line in lines)
    assert facts["labels a second"] == pytest.approx(20) and facts["sequences"] == 2
    assert facts["events a second"] == pytest.approx(events / seconds)
    rates = [line["events"] / (line["duration_us"] * 1e-6) / (24 * 16) for line in lines]
    assert facts["events a pixel and second, median"] == pytest.approx(np.median(rates))
    assert facts["events a pixel and label interval, mean"] == pytest.approx(np.mean(rates) / 20)
    speeds = []
    for path in sorted(data.glob("train/*/flow/forward/*.png")):
        flow, valid = read_flow_png(path)
        speeds.append(np.hypot(*np.moveaxis(flow, -1, 0))[::8, ::8][valid[::8, ::8]])
    assert facts["flow over a label interval, median"] == pytest.approx(np.median(np.concatenate(speeds)), rel=1e-6)
    assert facts["events a pixel and px of flow"] == pytest.approx(
        facts["events a pixel and second, median"] / facts["image speed, median"]
    )


def test_cameras_of_a_rig_are_one_sequence(tmp_path, monkeypatch):
    """Five stereo sequences of 1.1 s are five sequences, ten cameras and 5.5 s, on the card and on the page."""
    line = {"duration_us": 1_100_000, "labels": 10, "frames": 30, "events": 1000, "bytes": 1, "emulator": "esim"}
    line |= {"split": "train", "width": 24, "height": 16}
    eyes = [line | {"path": f"train/s_{k}/{eye}", "sensor": eye} for k in range(5) for eye in ("left", "right")]
    found = Collected(tmp_path, eyes, None, {}, {}, [])
    facts = {fact.name: fact.value for fact in facts_of(found)}
    assert (facts["sequences"], facts["cameras"], facts["simulated time"]) == (5, 10, pytest.approx(5.5))
    assert facts["labels a second"] == pytest.approx(10)
    monkeypatch.setattr("blinkgl.report.card._files", lambda found: [])  # there are none
    assert "| train | 5 | 10 | 24x16 | esim |" in card_of(found, facts_of(found), None, None)
    page = re.sub(r"<[^>]*>\s*", " ", build_report(found))
    assert re.search(r"\b5 +sequences +10 +cameras +5.5 s +simulated", page)


def test_somebody_elses_page_is_left_alone(data, tmp_path, capsys):
    (tmp_path / "train").symlink_to(data / "train")
    (tmp_path / "README.md").write_text("# My notes\n")
    with pytest.raises(AssetError, match="did not write"):
        write_card(tmp_path)
    assert (tmp_path / "README.md").read_text() == "# My notes\n"
    assert run(["report", str(data), "--license", "mit"]) == 2
    assert "--card" in capsys.readouterr().err
