"""What made each event, in a data set: file, verify, resume, shards, report; `verify` sees it altered."""

from __future__ import annotations

import json
import shutil
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pytest

from blinkgl import AssetError, Events, read_events
from blinkgl.cli import run
from blinkgl.dataset.verify import verify_dataset
from blinkgl.io.event_labels import BLOCK, EventLabelsReader, EventLabelsWriter
from blinkgl.types.events import TRUTH
from runs import generated

CONFIG = """
camera: {width: 48, height: 36}
time: {duration: 0.05, label_rate: 50}
events: {emulator: EMULATOR}
labels: {events: true, ids: true}
preview: {enabled: false}
scene: {kind: random, pool: {primitives: [cuboid]}, textures: {photographs: false, max_size: 32}}
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return generated(tmp_path_factory.mktemp("told"), CONFIG.replace("EMULATOR", "esim")) / "out"


def sequence_of(root: Path) -> Path:
    return next(root.rglob("event_labels.h5")).parent


def test_a_row_per_event_of_what_the_scene_has(made):
    folder = sequence_of(made)
    manifest = json.loads((folder / "manifest.json").read_text())
    events = read_events(folder / "events.h5", truth=True)
    assert len(events) == manifest["events"] > 500 and events.cause is not None
    assert set(np.unique(events.truth["instance"])) <= {0, *(thing["id"] for thing in manifest["objects"])}
    assert verify_dataset(made, deep=1).clean
    assert "causes: true" in (folder / "config.yaml").read_text(), "asked for with it"
    with h5py.File(folder / "event_labels.h5") as file:
        assert {name: str(file[name].dtype) for name in file} == {
            "instance": "uint16",
            "depth": "float32",
            "velocity": "float32",
            "cause": "uint8",
        }


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda f: f["cause"].resize(7, axis=0), "columns of events differ in length"),
        (lambda f: f.__delitem__("depth"), "no dataset 'depth'"),
    ],
)
def test_damaged_files_are_one_line(made, tmp_path, change, said):
    folder = tmp_path / "s"
    shutil.copytree(sequence_of(made), folder)
    with h5py.File(folder / "event_labels.h5", "r+") as file:
        change(file)
    with pytest.raises(AssetError, match=said):
        EventLabelsReader(folder)
    assert not verify_dataset(folder).clean


def test_the_bytes_do_not_hang_on_the_chunks(tmp_path):
    n = BLOCK + 1000
    rng = np.random.default_rng(0)
    truth = np.zeros(n, TRUTH)
    truth["light"] = -1
    truth["instance"], truth["depth"] = rng.integers(0, 9, n), rng.random(n) + 1
    events = Events(*(np.zeros(n, t) for t in ("u2", "u2", "i8", "u1")), truth=truth)
    for name, edges in (("a", [0, n]), ("b", [0, 10, 10, 70_000, 140_000, n])):
        writer = EventLabelsWriter(tmp_path / name)
        edges = sorted(min(edge, n) for edge in edges)
        for i, j in pairwise(edges):
            writer.append(events.part(slice(i, j)))
        writer.close()
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    with EventLabelsReader(tmp_path / "a") as reader:
        assert np.array_equal(reader.read()[0], truth) and reader.count == n


# --- Causes of events in a data set: file, manifest, summary, report; `verify` sees them altered.

CONFIG_CAUSES_OF_SEQUENCES = """
camera: {width: 48, height: 36}
time: {duration: 0.05, label_rate: 100}
events: {emulator: v2e, causes: true, shot_noise_rate_hz: 100, leak_rate_hz: 50}
scene: {kind: random, pool: {primitives: [cuboid]}, textures: {photographs: false, max_size: 32}}
"""


def test_causes_from_the_run_to_the_report(tmp_path, capsys):
    out = generated(tmp_path, CONFIG_CAUSES_OF_SEQUENCES) / "out"
    assert "by cause" in capsys.readouterr().out
    path = next(out.rglob("manifest.json"))
    manifest = json.loads(path.read_text())
    counts = manifest["events_by_cause"]
    assert sum(counts.values()) == manifest["events"] and counts["hot"] == 0 < min(counts["leak"], counts["signal"])
    assert run(["verify", str(out)]) == 0 and run(["report", str(out)]) == 0
    assert "Hz/px</b><span>shot events" in next(out.glob("*.html")).read_text()

    with h5py.File(path.parent / "events.h5", "r+") as file:
        file["events/cause"][3] = (file["events/cause"][3] + 1) % 4
    assert run(["verify", str(out)]) != 0
