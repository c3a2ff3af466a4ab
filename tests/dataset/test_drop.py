"""Sequences that are taken out on purpose, and those that vanish: run, verify, export, shards and report agree."""

from __future__ import annotations

import json
import shutil
import tarfile
from pathlib import Path

import pytest

from blinkgl.cli import run
from blinkgl.dataset.drop import drop
from blinkgl.errors import ConfigError
from blinkgl.sequence_files.index import read_index
from runs import NAMES, RECIPE, recipe_file, tree


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    assert run(["generate", str(recipe_file(folder)), "--out", str(folder / "out"), "--quiet"]) == 0
    return folder


@pytest.fixture
def out(whole, tmp_path) -> Path:
    shutil.copytree(whole / "out", tmp_path / "out")
    return tmp_path / "out"


def sequences_of(folder: Path, capsys) -> dict[str, set[str]]:
    """What each reader of a set finds, and what it says."""
    found = {"index": {line["path"] for line in read_index(folder)}}
    assert run(["export", str(folder), "--out", str(folder.parent / "shards")]) == 0
    with_shards = capsys.readouterr().out
    names = set()
    for shard in (folder.parent / "shards").glob("*.tar"):
        with tarfile.open(shard) as file:
            names |= {f"{shard.name.split('-')[0]}/{name.partition('.')[0]}" for name in file.getnames()}
    shutil.rmtree(folder.parent / "shards")
    found["shards"] = {name for name in NAMES if any(other.startswith(name) for other in names)}
    assert run(["export", str(folder), "--out", str(folder.parent / "dsec"), "--layout", "dsec"]) == 0
    with_dsec = capsys.readouterr().out
    listed = {p.name for p in (folder.parent / "dsec").rglob("*")}
    found["dsec"] = {name for name in NAMES if Path(name).name in listed}
    shutil.rmtree(folder.parent / "dsec")
    assert run(["report", str(folder)]) == 0
    with_report = capsys.readouterr().out
    page = (folder / "report.html").read_text()
    said = [text.count(": missing, and was not dropped") for text in (with_shards, with_dsec, with_report)]
    assert len(set(said)) == 1
    assert ("Some sequences that the recipe asks for are missing" in page) is bool(said[0])
    found["lost"] = said[0]
    return found


def test_every_reader_agrees_about_what_was_dropped(whole, out, capsys):
    first, second = NAMES[1], NAMES[4]
    assert drop(out, [first, str(out / second) + "/"]) == sorted([first, second])
    left = set(NAMES) - {first, second}
    assert sequences_of(out, capsys) == {"index": left, "shards": left, "dsec": left, "lost": 0}
    assert run(["verify", str(out)]) == 0
    assert "4 sequences, 2 dropped on purpose: no problem found\n" in capsys.readouterr().out.replace("\n  ", " ")
    assert run(["generate", str(whole / "recipe.yaml"), "--out", str(out), "--resume"]) == 0
    assert "all 4 sequences are complete" in capsys.readouterr().out
    # A larger run makes no dropped one either; taken back, they are made again, bit by bit.
    assert run(["drop", str(out), first, second, "--undo"]) == 0
    assert "generate --resume makes them again" in capsys.readouterr().out
    assert run(["verify", str(out)]) == 2
    assert run(["generate", str(whole / "recipe.yaml"), "--out", str(out), "--resume", "--quiet"]) == 0
    made = tree(out)
    made.pop("report.html")
    assert made == tree(whole / "out")


def test_what_vanishes_by_hand_is_said_by_every_reader(out, capsys):
    shutil.rmtree(out / NAMES[2])
    found = sequences_of(out, capsys)
    assert found["lost"] == 1 and found["shards"] == set(NAMES) - {NAMES[2]}
    assert run(["verify", str(out)]) == 2
    assert f"{NAMES[2]}: missing: the recipe asks for it" in capsys.readouterr().out
    assert run(["drop", str(out), NAMES[2]]) == 0, "on purpose after all"
    assert run(["verify", str(out)]) == 0 and sequences_of(out, capsys)["lost"] == 0


def test_a_published_set_has_only_its_index(out, capsys):
    shutil.rmtree(out / ".run")
    shutil.rmtree(out / NAMES[0])
    assert run(["export", str(out), "--out", str(out.parent / "shards")]) == 0
    assert f"left out: {NAMES[0]}: missing, and was not dropped" in capsys.readouterr().out
    assert drop(out, [NAMES[1]]) == [NAMES[1]]
    left = [line["path"] for line in read_index(out)]  # the lost one is still said
    assert len(left) == 5 and NAMES[0] in left and not (out / ".run").exists()


def test_conditions_on_the_index(out):
    lines = {line["path"]: line for line in read_index(out)}
    events = sorted(line["events"] for line in lines.values() if line["split"] == "train")
    wanted = {p for p, line in lines.items() if line["events"] <= events[1] and line["split"] == "train"}
    assert set(drop(out, where=[f"events<={events[1]}", "split = train"])) == wanted and len(wanted) == 2
    assert json.loads((out / ".run/dropped.json").read_text()) == dict.fromkeys(
        sorted(wanted), f"events<={events[1]} and split = train"
    )
    assert drop(out, where=["events < 0"]) == []
    (out / "index.jsonl").write_text("".join((out / "index.jsonl").read_text().splitlines(True)[:1]))  # cut off
    assert drop(out, where=["split = test"]) == sorted(NAMES[4:])


def test_conditions_on_keys_that_some_lines_have(out):
    """Lines as of a rig and of causes beside those of single cameras."""
    index = out / "index.jsonl"
    lines = [json.loads(line) for line in index.read_text().splitlines()]
    lines[-1] |= {"sensor": "left", "path": lines[-1]["path"] + "/left", "events_by_cause": {"noise": 3}}
    rig = lines[-1]["path"].removesuffix("/left")
    lines[0]["bytes"] = {"of": "somebody"}
    index.write_text("".join(json.dumps(line) + "\n" for line in lines))
    with pytest.raises(ConfigError, match="--where: unknown key .got 'events_by_cause'.; expected one of blinkgl, "):
        drop(out, where=["events_by_cause < 5"])
    assert drop(out, where=["bytes > 5", "sensor == left"]) == [rig]


def test_a_split_has_no_record_and_is_refused(out, capsys):
    before = tree(out)
    assert run(["drop", str(out / "train"), Path(NAMES[0]).name]) == 2
    assert f"a split of a data set, which keeps the record; expected {out}" in capsys.readouterr().err
    assert tree(out) == before and not (out / "train/index.jsonl").exists()


def test_cut_off_after_the_record(out, monkeypatch, capsys):
    """The folder is still there: verify says so, a run leaves it, and the same command ends it."""
    monkeypatch.setattr("blinkgl.dataset.drop.temporary_beside", lambda path: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        drop(out, [NAMES[0]])
    monkeypatch.undo()
    assert run(["verify", str(out)]) == 2 and "was dropped, and is here" in capsys.readouterr().out
    drop(out, [NAMES[0]])
    assert run(["verify", str(out)]) == 0


@pytest.mark.parametrize(
    "words, said",
    [
        ([], "nothing to drop; expected names of sequences, or --where 'events < 1000'"),
        (["train/fly_000099"], "out: no such sequence (got 'train/fly_000099'); expected SPLIT/NAME_000000 of this"),
        (["../out2"], "no such sequence (got '../out2')"),
        (["train"], "no such sequence (got 'train')"),
        (["--undo", NAMES[0]], f"was not dropped (got '{NAMES[0]}')"),
        (["--where", "events"], "--where: not a condition (got 'events'); expected KEY < VALUE"),
        (["--where", "colour = 3"], "--where: unknown key (got 'colour'); expected one of blinkgl, bytes, "),
        (["--where", "events < many"], "--where: not a number (got 'many'); expected such as "),
        (["--where", "split < train"], "--where: is a text (got 'split <'); expected = or !="),
        (["--where", "events => 3"], "--where: not a condition (got 'events => 3')"),
        (["--where", "emulator = 'v2e'"], "--where: not a condition (got "),
        (["--undo", "--where", "events > 0"], "--where: not with --undo: the index has no dropped sequences"),
    ],
)
def test_bad_input_changes_nothing(out, words, said, capsys):
    before = tree(out)
    assert run(["drop", str(out), *words]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert tree(out) == before and not (out / ".run/dropped.json").exists()


def test_no_set_and_a_run_at_work(tmp_path, out, capsys):
    from blinkgl.dataset.run_folder import RunFolder

    assert run(["drop", str(tmp_path / "none"), "a"]) == 2 and not (tmp_path / "none").exists()
    assert "no data set; expected the folder" in capsys.readouterr().err
    assert run(["drop", str(out / NAMES[0]), "a"]) == 2
    with RunFolder(out).locked():
        capsys.readouterr()
        assert run(["drop", str(out), NAMES[0]]) == 2
        assert "another run uses this folder" in capsys.readouterr().err
    assert (out / NAMES[0]).is_dir() and RECIPE
