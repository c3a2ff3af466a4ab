"""Data sets that somebody else made: no name leads out of them, and whatever is wrong with them is one line."""

import contextlib
import html
import io
import os
import re
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from rich.table import Table
from tiny_recipe import TINY

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset import plan
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import AssetError, BlinkGLError
from blinkgl.io.frames import open_frames
from blinkgl.io.images import encode_png
from blinkgl.io.records import inside
from blinkgl.layouts import export_layout
from blinkgl.machine.terminal import plain_console, say
from blinkgl.report import page
from runs import forge

LABELS = {"flow": ["forward", "backward"], "depth": True, "boxes": True, "images": True, "ids": True}
ONE = {**TINY, "labels": LABELS, "tracks": {"points": 20}, "images": {"exposure_us": 5000, "bits": 10}}
RIG = {
    **{key: value for key, value in TINY.items() if key != "camera"},
    "labels": {"flow": ["forward"]},
    "sensors": [
        {"name": "left", "camera": TINY["camera"], "events": {}, "imu": {"rate": 200}},
        {"name": "right", "camera": TINY["camera"], "events": {}, "place": {"position": [0.1, 0, 0]}, "pair": "left"},
    ],
}


def made(folder: Path, recipe: dict) -> Path:
    path = folder / "recipe.yaml"
    path.write_text(yaml.safe_dump(recipe))
    run_dataset(load_run(path), folder / "set")
    return folder / "set"


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    return {
        kind: made(tmp_path_factory.mktemp(kind), recipe) / "train/sequence_000000"
        for kind, recipe in (("one", ONE), ("rig", RIG))
    }


@pytest.fixture
def one(sets, tmp_path) -> Path:
    shutil.copytree(sets["one"].parents[1], tmp_path / "set")
    return tmp_path / "set/train/sequence_000000"


@pytest.fixture
def rig(sets, tmp_path) -> Path:
    shutil.copytree(sets["rig"].parents[1], tmp_path / "set")
    return tmp_path / "set/train/sequence_000000"


def said(*arguments) -> list[str]:
    """Run a command that must refuse; return its lines."""
    error = io.StringIO()
    with contextlib.redirect_stderr(error):
        assert run([str(one) for one in arguments]) == 2
    lines = error.getvalue().splitlines()
    assert len(lines) == 1 and "Traceback" not in lines[0]
    return lines


def commands(sequence: Path, out: Path) -> list[tuple]:
    data = sequence.parents[1]
    return [
        ("export", data, "-o", out / "shards"),
        *(("export", data, "-o", out / name, "--layout", name) for name in ("dsec", "blinkflow", "mvsec", "tapvid")),
        ("view", sequence, "--save", out / "page.html"),
    ]


# ---- names that become paths -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("split", ["../../away", "/tmp/away", "a/b", "..", ".git", "a\\b", "a\x1b[31m", "", "a\0"])
def test_a_split_leads_nowhere(one, tmp_path, split):
    forge(one, split=split)
    before = sorted(tmp_path.rglob("*"))
    for command in commands(one, tmp_path / "out"):
        assert "damaged manifest: split: not" in said(*command)[0]
    assert [path for path in sorted(tmp_path.rglob("*")) if path not in before and path.name != "out"] == []


@pytest.mark.parametrize("name", ["../../../other/train/sequence_000000", "left/..", ".hidden", "/etc"])
def test_a_sensors_name_leads_to_no_other_data_set(rig, tmp_path, name):
    rows = yaml.safe_load((rig / "rig.yaml").read_text())
    shutil.copytree(rig.parents[1], tmp_path / "other")
    sensor = rows["sensors"].pop("left")
    rows["sensors"]["right"] |= {"pair": None}
    rows["sensors"] = {name: sensor, **rows["sensors"]}
    (rig / "rig.yaml").write_text(yaml.safe_dump(rows, sort_keys=False))
    forge(rig, "rig.yaml")
    for command in (
        ("export", rig.parents[1], "-o", tmp_path / "out", "--layout", "dsec"),
        ("view", rig, "--save", tmp_path / "page.html"),
    ):
        assert "rig.yaml: damaged: " in said(*command)[0]
    forge(rig, cameras=[name, "right"])
    assert "damaged manifest: cameras.0: not" in verify_dataset(rig.parents[1]).problems["train/sequence_000000"][0]


def test_links_out_of_a_data_set_are_not_followed(one, rig_or_other, tmp_path, capsys):
    other, data = rig_or_other, one.parents[1]
    (data / "train/sequence_000001").symlink_to(other / "train/sequence_000000")
    (data / "test").symlink_to(other / "train")
    assert run(["export", str(data), "-o", str(tmp_path / "out"), "--layout", "dsec"]) == 0
    assert [path.name for path in (tmp_path / "out/train").iterdir()] == ["sequence_000000"]
    printed = capsys.readouterr().out
    assert "left out: train/sequence_000001: a symbolic link, which is not followed" in printed
    assert "left out: test: a symbolic link, which is not followed" in printed


@pytest.fixture
def rig_or_other(sets, tmp_path) -> Path:
    return Path(shutil.copytree(sets["one"].parents[1], tmp_path / "other"))


def test_a_camera_that_is_a_link_is_refused(rig, tmp_path):
    shutil.move(rig / "left", tmp_path / "elsewhere")
    (rig / "left").symlink_to(tmp_path / "elsewhere")
    for layout in ("dsec", "webdataset"):
        line = said("export", rig.parents[1], "-o", tmp_path / "out", "--layout", layout)[0]
        assert "damaged sequence: left/" in line or "left: a symbolic link, which is not followed" in line
    assert not (tmp_path / "out").exists()


def test_an_inertial_unit_that_is_a_link_is_refused(rig, tmp_path):
    shutil.move(rig / "left/imu/imu.h5", tmp_path / "imu.h5")
    (rig / "left/imu/imu.h5").symlink_to(tmp_path / "imu.h5")
    for command in commands(rig, tmp_path / "out"):
        assert "imu/imu.h5: a symbolic link" in said(*command)[0]


@pytest.mark.parametrize("place", [".run/logs", ".run/logs/train", ".run/costs.jsonl", "train"])
def test_a_run_goes_on_in_no_folder_that_leads_elsewhere(one, tmp_path, place):
    data = one.parents[1]
    shutil.rmtree(one)
    target = data / place
    away = tmp_path / "away"
    if target.exists():
        shutil.move(target, away)
    else:
        away.mkdir()
    target.symlink_to(away)
    before = {path: path.stat().st_mtime_ns for path in [away, *away.rglob("*")]}
    recipe = data / ".run/recipe.yaml"
    assert "is a symbolic link" in said("generate", recipe, "-o", data, "--resume", "-q")[0]
    assert {path: path.stat().st_mtime_ns for path in [away, *away.rglob("*")]} == before


def test_a_list_of_times_names_files_beside_it_only(tmp_path):
    (tmp_path / "clip").mkdir()
    for place in ("a.png", "clip/b.png"):
        (tmp_path / place).write_bytes(encode_png(np.zeros((16, 16), np.uint8)))
    (tmp_path / "clip/images.txt").write_text("0.0 b.png\n0.1 ../a.png\n")
    (tmp_path / "clip/b.png").rename(tmp_path / "clip/b")
    with pytest.raises(Exception, match="names not a path inside the folder"):
        open_frames(tmp_path / "clip")


def test_one_rule_for_names(tmp_path):
    assert inside(tmp_path, "a/b.txt") == tmp_path / "a/b.txt"
    (tmp_path / "link").symlink_to("/etc")
    for name in ("", "/", "../a", "a/../../b", "a//b", "./a", "link", "link/passwd", "a\0", "x" * 300, os.sep + "etc"):
        with pytest.raises(Exception, match="names |a symbolic link"):
            inside(tmp_path, name)


# ---- text ------------------------------------------------------------------------------------------------------------

EVIL = "![x](/etc/hostname) <img src=x onerror=alert(1)> {1+1} [a](javascript:b) \x1b]0;title\x07 \u202etxt `c` **d**"


def test_the_viewer_shows_text_of_files_as_text(one):
    pytest.importorskip("viser", reason="the extra [view] is not installed")
    from blinkgl.viewer import page as viewed, views

    forge(one, emulator=EVIL)
    sequence = views.SequenceView(one)
    said = viewed._about(sequence)
    sequence.close()
    text = said.split("px, ")[1].split("events, ")[-1]
    assert re.fullmatch(r"(?:[0-9A-Za-z ]|&#\d+;)+", text), "letters, digits and references only"
    text = html.unescape(text).replace("\u2060", "")
    assert text.startswith("![x](/etc/hostname) <img src=x onerror=alert(1)> {1+1}")
    assert "\x1b" not in text and "\u202e" not in text


def test_a_report_shows_text_of_files_as_text(one, tmp_path):
    forge(one, emulator=EVIL, events_by_cause={EVIL: 1})
    assert run(["report", str(one.parents[1]), "-o", str(tmp_path / "page.html")]) == 0
    text = (tmp_path / "page.html").read_text()
    assert "&lt;img src=x onerror=alert(1)&gt;" in text and "<img src=x" not in text
    assert "\x1b" not in text and "\u202e" not in text


def test_terminal_and_messages_show_text_of_files_as_text(capsys):
    say(plain_console(), EVIL)
    table = Table()
    table.add_row(EVIL)
    plain_console().print(table)
    said = str(AssetError("x", where=EVIL, value=EVIL, accepted=EVIL))
    for text in (*capsys.readouterr().out.split("\n"), said):
        assert "\x1b" not in text and "\u202e" not in text and "\x07" not in text
    assert r"\x1b]0;title\x07 \u202etxt" in said


# ---- damaged files of sequences --------------------------------------------------------------------------------------

STAMPS = "flow/forward_timestamps.txt"


def arrays(path: Path, **changes) -> bytes:
    with np.load(path) as file:
        kept = {**{name: file[name] for name in file.files}, **changes}
    buffer = io.BytesIO()
    np.savez(buffer, **{name: value for name, value in kept.items() if value is not None})
    return buffer.getvalue()


def npy() -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(1, np.float32))
    return buffer.getvalue()


@pytest.mark.parametrize(
    "file, damage, message",
    [
        (STAMPS, lambda p: p.read_bytes().replace(b"0", b"p", 1), "line 2 is no time"),
        (STAMPS, lambda p: p.read_bytes() + b"1, 2\n", "files and time stamps differ in number"),
        (STAMPS, lambda p: b"0, 99999999999999999999999\n", "line 1 is no time"),
        (STAMPS, lambda p: b"5, 5\n", "line 1 is not an interval"),
        (STAMPS, lambda p: b"\xff\xfe\n", "not a text file in UTF-8"),
        ("poses.npz", lambda p: npy(), "cannot read"),
        ("poses.npz", lambda p: p.read_bytes()[:100], "cannot read"),
        ("poses.npz", lambda p: arrays(p, K=None), "no such array"),
        ("poses.npz", lambda p: arrays(p, K=np.eye(2)), "'K' has the wrong shape"),
        ("poses.npz", lambda p: arrays(p, t_ns=np.array(["a", "b", "c"])), "'t_ns' has the wrong shape or type"),
        ("poses.npz", lambda p: arrays(p, T_world_cam=np.full((3, 4, 4), np.nan)), "holds NaN"),
        ("poses.npz", lambda p: arrays(p, object_names=None), "no such array"),
        ("tracks.npz", lambda p: npy(), "cannot read"),
        ("tracks.npz", lambda p: arrays(p, t_us=np.zeros(3)), "'t_us' has the wrong shape or type"),
        ("boxes/000000.npz", lambda p: npy(), "cannot read"),
        ("flow/forward/000000.png", lambda p: encode_png(np.zeros((8, 8, 3), np.uint16)), "not of this sequence"),
        ("images/000000.png", lambda p: encode_png(np.zeros((8, 8, 3), np.uint8)), "not 32x32 px"),
        ("depth/000000.npy", lambda p: npy(), "not of this sequence"),
    ],
)
def test_a_damaged_file_is_one_line(one, tmp_path, file, damage, message):
    if not (one / file).is_file():
        pytest.skip(f"{file} is not in this set")
    (one / file).write_bytes(damage(one / file))
    forge(one, file)
    lines = []
    for command in commands(one, tmp_path / "out"):
        error = io.StringIO()
        with contextlib.redirect_stderr(error):
            status = run([str(part) for part in command])
        said = error.getvalue().splitlines()
        assert status in (0, 2) and len(said) == (status == 2), said
        lines += said
    assert any(message in line for line in lines), lines


@pytest.mark.parametrize(
    "changes",
    [
        {"frame_camera": {"pictures": ["../x"], "bits": 8}},
        {"frame_camera": None},
        {"objects": [{"id": "x"}]},
        {"objects": [{"id": 1, "box": [1, 2]}]},
        {"height": "32"},
        {"height": 65536, "width": 65536},
        {"events_by_cause": {"noise": "many"}},
    ],
)
def test_a_damaged_manifest_is_one_line(one, tmp_path, changes):
    forge(one, **changes)
    for command in commands(one, tmp_path / "out"):
        assert "damaged manifest: " in said(*command)[0]


def test_events_outside_the_picture_are_one_line(one, tmp_path):
    with h5py.File(one / "events.h5", "r+") as file:
        for name in ("height", "width"):
            file.attrs.pop(name, None)
        file["events/x"][...] = np.full(len(file["events/x"]), 60000)
    forge(one, "events.h5")
    for command in commands(one, tmp_path / "out"):
        if not {"tapvid", "dsec"} & {*command}:  # they have no events, or the file as it is
            assert "is outside the sensor" in said(*command)[0]


@pytest.mark.parametrize("text", ["sensors: {left: 3}", "sensors: []", "[]", "sensors: {left: {records: x}}", "a: ["])
def test_a_damaged_rig_is_one_line(rig, tmp_path, text):
    (rig / "rig.yaml").write_text(text)
    forge(rig, "rig.yaml")
    for command in commands(rig, tmp_path / "out")[1:]:
        assert "rig.yaml" in said(*command)[0]


# ---- two at once, and what is not whole ------------------------------------------------------------------------------


def test_resume_writes_an_index_that_is_missing(one):
    data = one.parents[1]
    before = (data / "index.jsonl").read_text()
    (data / "index.jsonl").unlink()
    assert run(["generate", str(data / ".run/recipe.yaml"), "-o", str(data), "--resume", "-q"]) == 0
    assert (data / "index.jsonl").read_text() == before


def test_a_report_elsewhere_changes_nothing_in_the_set_and_replaces_nothing_unasked(one, tmp_path):
    data, out = one.parents[1], tmp_path / "page.html"
    (data / "index.jsonl").unlink()
    before = sorted(data.rglob("*"))
    out.write_text("mine")
    assert "output file exists" in said("report", data, "-o", out)[0] and out.read_text() == "mine"
    assert run(["report", str(data), "-o", str(out), "--overwrite"]) == 0 and "<html" in out.read_text()
    assert sorted(data.rglob("*")) == before
    assert run(["report", str(data)]) == 0 and (data / "index.jsonl").is_file()


@pytest.mark.parametrize("part", ["train", "train/sequence_000000"])
def test_a_report_of_a_part_writes_nothing_into_it(one, tmp_path, part):
    data = one.parents[1]
    before = sorted(data.rglob("*"))
    assert "would be a foreign file; expected --out FILE" in said("report", data / part)[0]
    (data / ".run").rename(tmp_path / "run")  # a set as it is published
    assert "would be a foreign file" in said("report", data / part)[0]
    (tmp_path / "run").rename(data / ".run")
    assert run(["report", str(data / part), "-o", str(tmp_path / "page.html")]) == 0
    assert sorted(data.rglob("*")) == before and run(["verify", str(data)]) == 0


def test_links_where_the_user_stands_are_of_no_concern_to_an_export(one, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    (tmp_path / "here/train").symlink_to(one.parent)
    monkeypatch.chdir(tmp_path / "here")
    assert run(["export", str(one.parents[1]), "-o", str(tmp_path / "out"), "--layout", "mvsec"]) == 0


def test_an_export_says_what_it_leaves_out(one, tmp_path, capsys):
    half = one.parent / "sequence_000007"
    shutil.copytree(one, half)
    (half / "manifest.json").unlink()
    assert run(["export", str(one.parents[1]), "-o", str(tmp_path / "out")]) == 0
    assert "left out: train/sequence_000007: belongs to no sequence" in capsys.readouterr().out


def test_a_record_of_millions_costs_what_is_there(one, monkeypatch):
    data = one.parents[1]
    path = data / ".run/run.json"
    path.write_text(path.read_text().replace('"num": null', '"num": 10000000'))
    made, task = [], plan.Task
    monkeypatch.setattr(plan, "Task", lambda *of: made.append(of) or task(*of))
    problems = verify_dataset(data).problems["."]
    assert "and 9998999 more sequences that the recipe asks for are missing" in problems
    page.write_report(data)
    assert len(made) < 2000


@pytest.mark.parametrize("section", ["text", [1]])
def test_a_configuration_of_another_shape_is_a_line(one, tmp_path, section):
    path = one / "config.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), "output": section}))
    forge(one, "config.yaml")
    with pytest.raises(BlinkGLError) as raised:
        export_layout(one.parents[1], tmp_path / "dsec", "dsec")
    assert "\n" not in str(raised.value) and not (tmp_path / "dsec").exists()
