"""What a run's folder says of a run that may not go on, and what it keeps."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from blinkgl.dataset.run_folder import RunFolder
from blinkgl.errors import OutputError

ENVIRONMENT = {"numpy": "2.0", "opengl": "llvmpipe, 4.5"}


def plan(identity: dict[str, str], base: str = "."):
    return SimpleNamespace(
        identity=identity,
        template=SimpleNamespace(base=Path(base)),
        recipe_text=lambda: "seed: 1\n",
        tasks=SimpleNamespace(splits=["test", "train"], number=lambda name: None),
    )


def begun(out: Path, identity=None, assets=None, environment=None) -> RunFolder:
    folder = RunFolder(out)
    (out / ".run").mkdir(parents=True, exist_ok=True)
    folder.begin(plan(identity or {"": "a"}), assets or {}, environment or ENVIRONMENT, 3)
    return folder


@pytest.mark.parametrize(
    "before, now, said",
    [
        ({"a": "1"}, {"a": "2"}, "a (changed)"),
        ({"a": "1", "b": "1"}, {"b": "1"}, "a (gone)"),
        ({"b": "1"}, {"a": "1", "b": "1"}, "a (new)"),
        ({"a": "1", "b": "1", "c": "1"}, {"b": "2", "c": "2", "d": "1"}, "a (gone), b (changed), c (changed) …"),
        ({"a": "1", "b": "1"}, {"b": "2", "c": "2"}, "a (gone), b (changed), c (new)"),
        (
            {"x": "1", **{f"f{k}": "1" for k in range(5)}},
            {f"f{k}": "2" for k in range(5)},
            "f0 (changed), f1 (changed), f2 (changed) …",
        ),
    ],
)
def test_files_that_are_not_those_the_run_began_with(tmp_path, before, now, said):
    """The first three by name, each with what became of it; dots where there are more."""
    folder = begun(tmp_path / "out", assets=before)
    folder.check(plan({"": "a"}), before, False)
    folder.check(plan({"": "a"}), now, True)
    with pytest.raises(OutputError) as caught:
        folder.check(plan({"": "a"}), now, False)
    assert f"the pools are not those the run began with: {said}; expected" in str(caught.value) or str(
        caught.value
    ).split("began with: ")[1].startswith(said + ";")


@pytest.mark.parametrize(
    "ours, theirs, names",
    [
        ({"": "b"}, {"": "a"}, "the configuration"),
        ({"x": "1", "y": "2"}, {"x": "1", "y": "1"}, "y"),
        ({"x": "1"}, {"x": "1", "z": "1"}, "z"),
        ({"x": "2", "y": "2"}, {"x": "1", "z": "1"}, "x, y, z"),
    ],
)
def test_the_run_of_another_recipe(tmp_path, ours, theirs, names):
    folder = begun(tmp_path / "out", identity=theirs)
    folder.check(plan(ours), {}, True)
    with pytest.raises(OutputError, match=rf"holds the run of another recipe \(different: {names}\)"):
        folder.check(plan(ours), {}, False)


def test_another_installation(tmp_path):
    folder = begun(tmp_path / "out")
    folder.check_environment(ENVIRONMENT, False)
    folder.check_environment({**ENVIRONMENT, "numba": "1"}, False)
    folder.check_environment({**ENVIRONMENT, "numpy": "1.0"}, True)
    with pytest.raises(
        OutputError,
        match=r"the run began with another installation: numpy 2.0, now 1.0; opengl llvmpipe, 4.5, now Voodoo",
    ):
        folder.check_environment({"numpy": "1.0", "opengl": "Voodoo"}, False)


def test_what_identifies_a_run_is_written_and_stays(tmp_path):
    folder = begun(tmp_path / "out", identity={"g": "1"}, assets={"m": "h"})
    record = json.loads((tmp_path / "out/.run/run.json").read_text())
    assert (
        record["groups"] == {"g": "1"}
        and record["environment"] == ENVIRONMENT
        and record["mixed"] == []
        and record["num"] == 3
    )
    assert record["base"] == str(Path.cwd()) and folder.begun
    assert (tmp_path / "out/.run/recipe.yaml").read_text() == "seed: 1\n" and json.loads(
        (tmp_path / "out/.run/assets.json").read_text()
    ) == {"m": "h"}
    begun(tmp_path / "out", identity={"g": "1"}, assets={"m": "h"})
    assert json.loads((tmp_path / "out/.run/run.json").read_text())["mixed"] == []
    begun(tmp_path / "out", identity={"g": "2"}, assets={"m": "i"})
    begun(tmp_path / "out", identity={"g": "1"}, environment={"numpy": "3"})
    record = json.loads((tmp_path / "out/.run/run.json").read_text())
    assert record["groups"] == {"g": "1"} and record["environment"] == ENVIRONMENT, "the beginning stays"
    assert record["mixed"] == [
        {"environment": ENVIRONMENT, "groups": {"g": "2"}},
        {"environment": {"numpy": "3"}, "groups": {"g": "1"}},
    ]


def test_a_run_of_which_nothing_came_leaves_nothing(tmp_path):
    for keep in (False, True):
        out = tmp_path / f"out{keep}"
        folder = begun(out)
        for name in ("train", ".run/logs"):
            (out / name).mkdir()
        for name in ("index.jsonl", ".run/failed.json", ".run/costs.jsonl", ".run/logs/worker-1.log"):
            (out / name).write_text("")
        folder.forget(plan({}), keep)
        assert sorted(p.relative_to(out).as_posix() for p in out.rglob("*")) == (
            [".run", ".run/logs", ".run/logs/worker-1.log"] if keep else []
        )


def test_what_lies_at_a_sequences_name(tmp_path):
    folder = begun(tmp_path)
    (tmp_path / "train/empty").mkdir(parents=True)
    (tmp_path / "train/file").write_text("x")
    (tmp_path / "train/link").symlink_to(tmp_path / "train/empty")
    (tmp_path / "train/odd").mkdir()
    (tmp_path / "train/odd/x").write_text("")
    assert [folder.state(f"train/{name}") for name in ("nothing", "empty", "file", "link")] == [
        None,
        None,
        "not a folder",
        "not a folder",
    ]
    assert "manifest" in folder.state("train/odd")
    assert [folder.occupied(f"train/{name}") for name in ("nothing", "empty", "file", "link", "odd")] == [
        False,
        False,
        True,
        False,
        True,
    ]
    for k in range(3):
        folder.put_away("train/odd")
        assert (tmp_path / f".run/damaged/train/odd-{k}/x").exists() and not (tmp_path / "train/odd").exists()
        (tmp_path / "train/odd").mkdir()
        (tmp_path / "train/odd/x").write_text("")


def test_one_run_at_a_time_and_no_trace_of_one_that_was_refused(tmp_path):
    out = tmp_path / "a/b"
    with RunFolder(out).locked():
        with pytest.raises(OutputError, match="another run is at work in this folder"), RunFolder(out).locked():
            pass
        assert out.is_dir()
    assert not (tmp_path / "a").exists()
    out.mkdir(parents=True)
    with RunFolder(out).locked() as _:
        (out / "kept").write_text("")
    assert (out / "kept").exists()
    (out / ".run").symlink_to(tmp_path)
    with pytest.raises(OutputError, match="is a symbolic link"), RunFolder(out).locked():
        pass


def test_logs_of_workers_that_began_nothing(tmp_path):
    out = tmp_path / "out"
    folder = RunFolder(out)
    with folder.locked():
        (out / ".run/logs").mkdir(parents=True)
        (out / ".run/logs/worker-1.log").write_text("")
        folder.take_back_logs()
        assert not (out / ".run").exists(), "the run made it"
        (out / ".run/logs").mkdir(parents=True)
        (out / ".run/logs/worker-1.log").write_text("")
    folder = RunFolder(out)
    with folder.locked():
        (out / ".run/logs/worker-2.log").write_text("")
        folder.take_back_logs()
    assert [p.name for p in (out / ".run/logs").iterdir()] == ["worker-1.log"], "an earlier run's stay"
