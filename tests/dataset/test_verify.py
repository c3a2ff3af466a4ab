"""What ``blinkgl verify`` finds: every kind of damage by its message, and nothing in a sound data set."""

import json
import shutil
from pathlib import Path

import cv2
import h5py
import hdf5plugin  # noqa: F401
import numpy as np
import pytest

from blinkgl.cli import run
from blinkgl.config.sequence import load_run
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import AssetError
from blinkgl.io.sequence_dir import _digest
from runs import NAMES, recipe_file


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sound")
    run_dataset(load_run(recipe_file(folder)), folder / "out", num=2)
    return folder / "out"


@pytest.fixture
def data(sound, tmp_path) -> Path:
    return Path(shutil.copytree(sound, tmp_path / "data"))


def forge(sequence: Path, name: str, **changes) -> None:
    """Brings the manifest in line with what was done to a file, as a bug in the writer would."""
    path = sequence / "manifest.json"
    manifest = json.loads(path.read_text())
    if name in manifest["files"]:
        manifest["files"][name] = _digest(sequence / name)
    path.write_text(json.dumps({**manifest, **changes}))


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def edit_events(sequence: Path, **columns) -> None:
    with h5py.File(sequence / "events.h5", "r+") as file:
        for name, change in columns.items():
            dataset = file["ms_to_idx" if name == "ms_to_idx" else f"events/{name}"]
            dataset[...] = change(dataset[...])
    forge(sequence, "events.h5")


def swap_times(t):
    k = int(np.argmax(np.diff(t) > 0))
    t[[k, k + 1]] = t[[k + 1, k]]
    return t


def set_last(value):
    def change(column):
        column[-1] = value
        return column
    return change


def test_a_sound_data_set_and_its_parts(sound, capsys):
    assert verify_dataset(sound).clean
    assert run(["verify", str(sound), "--deep", "--sample", "4"]) == 0
    assert "4 sequences, 4 made again and compared bit by bit: no problem found" in capsys.readouterr().out
    assert verify_dataset(sound / "train").sequences == 2 and verify_dataset(sound / NAMES[0]).clean


@pytest.mark.parametrize("damage, message", [
    (lambda s: flip(s / "events.h5"), "events.h5: checksum differs"),
    (lambda s: flip(s / "flow/forward/000001.png"), "flow/forward/000001.png: checksum differs"),
    (lambda s: (s / "images/000000.png").write_bytes((s / "images/000000.png").read_bytes()[:-10]), "images/000000.png: "),
    (lambda s: (s / "poses.npz").unlink(), "poses.npz: missing"),
    (lambda s: (s / "flow/forward/notes.txt").write_text("x"), "flow/forward/notes.txt: not in the manifest"),
    (lambda s: (s / "manifest.json").write_text("{"), "damaged manifest"),
    (lambda s: edit_events(s, t=swap_times), "events.h5: times decrease after event"),
    (lambda s: edit_events(s, x=set_last(64)), "events.h5: an event outside 64x48 px"),
    (lambda s: edit_events(s, p=set_last(2)), "events.h5: a polarity other than 0 and 1"),
    (lambda s: edit_events(s, t=set_last(9_000_000)), "events.h5: last event at 9000000 µs, the sequence ends at 250000 µs"),
    (lambda s: edit_events(s, ms_to_idx=set_last(1)), "events.h5: ms_to_idx[250] is 1, expected"),
    (lambda s: forge(s, "", events=3), "events.h5: columns of"),
    (lambda s: forge(s, "", labels=9), "flow/forward: 4 files, 4 time stamps, manifest says 9 labels"),
    (lambda s: forge(s, "", seed=None), "manifest.json: 'seed' is missing or no int"),
    (lambda s: ((s / "images/timestamps.txt").write_text("5\n4\n3\n2\n1\n"), forge(s, "images/timestamps.txt")), "images/timestamps.txt: times are not in order"),
    (lambda s: (cv2.imwrite(str(s / "images/000000.png"), np.zeros((4, 4, 3), np.uint8)), forge(s, "images/000000.png")), "images/000000.png: not 64x48 px"),
])
def test_damage_inside_a_sequence(data, damage, message):
    damage(data / NAMES[0])
    (data / "index.jsonl").unlink()
    problems = verify_dataset(data).problems
    assert list(problems) == [NAMES[0]] and len(problems[NAMES[0]]) <= 2 and message in problems[NAMES[0]][0]


@pytest.mark.parametrize("damage, message", [
    (lambda d: shutil.rmtree(d / NAMES[0]), "missing: the recipe asks for it"),
    (lambda d: (d / "train/readme.txt").write_text("x"), "train/readme.txt: belongs to no sequence"),
    (lambda d: (d / "train/.fly_000000.blinkgl-tmp-0123456789ab-1-0").mkdir() or
        (d / "train/.fly_000000.blinkgl-tmp-0123456789ab-1-0/events.h5").write_text(""), "left by a run that was cut off"),
    (lambda d: (d / "index.jsonl").write_text((d / "index.jsonl").read_text().replace('"events": ', '"events": 1')), "index.jsonl: out of date for"),
    (lambda d: (d / "index.jsonl").write_text('{"path": "../x"}\n'), "index.jsonl: damaged index"),
    (lambda d: (d / ".run/run.json").write_text("["), "the run's record is damaged"),
])
def test_damage_between_sequences(data, capsys, damage, message):
    damage(data)
    assert run(["verify", str(data)]) == 2
    assert message in capsys.readouterr().out


def test_deep_finds_what_checksums_cannot(data, capsys):
    """Events of another seed under a manifest that fits them."""
    sequence = data / NAMES[1]
    shutil.copy(data / NAMES[0] / "events.h5", sequence / "events.h5")
    forge(sequence, "events.h5", events=json.loads((data / NAMES[0] / "manifest.json").read_text())["events"])
    (data / "index.jsonl").unlink()
    assert verify_dataset(data).clean
    assert run(["verify", str(data), "--deep", "--sample", "9"]) == 2
    said = capsys.readouterr().out
    assert f"{NAMES[1]}: made again, events.h5: differs" in said and f"{NAMES[0]}:" not in said


def test_nothing_to_verify(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(AssetError, match="no sequence found|no such data set"):
            verify_dataset(path)


def test_eflow_reads_by_the_index(data):
    """A line taken out of the index takes the sequence out of training; without an index everything is found."""
    sources = pytest.importorskip("eflow.data.sources")
    assert len(sources.open_source(data)) == 16
    lines = (data / "index.jsonl").read_text().splitlines(keepends=True)
    (data / "index.jsonl").write_text("".join(lines[1:]))
    assert len(sources.open_source(data)) == 12
    (data / "index.jsonl").unlink()
    assert len(sources.open_source(data)) == 16
