"""What a run's folder says of a run that may not go on, and what it keeps."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from blinkgl.dataset import work
from blinkgl.dataset.run_folder import RunFolder
from blinkgl.dataset.work import Job, Maker
from blinkgl.errors import ConfigError, OutputError

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
    assert f"the pools have changed since the run began: {said}; expected" in str(caught.value) or str(
        caught.value
    ).split("have changed since the run began: ")[1].startswith(said + ";")


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


# --- What workers share: who is given which threads, what ends a run, what is added up, what is said beforehand.

# --- workers ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "error, stops",
    [
        (OSError(errno.ENOSPC, ""), True),
        (OSError(errno.EDQUOT, ""), True),
        (OSError(errno.EROFS, ""), True),
        (OSError(errno.EACCES, ""), True),
        (OSError(errno.EIO, ""), False),
        (OutputError("cannot write: no space left on the device"), True),
        (OutputError("cannot write: odd"), False),
        (ConfigError("no space"), False),
        (ValueError(), False),
    ],
)
def test_what_the_next_sequence_would_meet_too(error, stops):
    """Also as the cause of another error, however deep."""
    outer = RuntimeError()
    outer.__cause__ = KeyError()
    outer.__cause__.__cause__ = error
    assert work._disk_is_full(error) is work._disk_is_full(outer) is stops


def test_who_answers_for_the_code(monkeypatch):
    work._code.cache_clear()
    monkeypatch.setenv("BLINKGL_BUILD", "image-7")
    assert work.environment(None)["blinkgl"].endswith(" (image-7)") and work.environment(None)["opengl"] == "not used"
    work._code.cache_clear()
    monkeypatch.delenv("BLINKGL_BUILD")
    code = work._code()
    assert "code of shaders" in code and "code of blinkgl/render" in code
    assert all(re.fullmatch("[0-9a-f]{12}", v) for k, v in code.items() if k != "blinkgl")
    card = SimpleNamespace(renderer="Voodoo", version="4.5")
    assert work.environment(card)["opengl"] == "Voodoo, 4.5"
    work._code.cache_clear()


def recipe(tmp_path: Path, **groups) -> Job:
    text = yaml.safe_dump({"groups": {k: {"output": {"sequences": 2}, **v} for k, v in groups.items()}})
    return Job(str(tmp_path / "out"), str(tmp_path), text)


def test_groups_that_ask_for_different_opengl(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(work, "create_context", lambda *given: made.append(given) or SimpleNamespace(
        renderer="r", version="v", release=lambda: made.append("released")
    ))  # fmt: skip
    monkeypatch.setattr(work, "check_assets", lambda plan: {"a": "b"})
    with pytest.raises(
        ConfigError, match="gl: the groups need different OpenGL implementations; expected one gl section"
    ):
        Maker(recipe(tmp_path, a={"gl": {"device": 1}}, b={"gl": {"device": 2}})).open()
    assert made == []
    for device, expected in ((None, 3), (0, 0), (5, 5)):
        job = recipe(tmp_path, a={"gl": {"device": 3}}, b={"gl": {"device": 3}})
        with Maker(job, device) as maker:
            hello = maker.open()
        assert made == [("auto", expected), "released"], "the driver's choice, else the configuration's"
        assert hello["kind"] == "hello" and hello["pid"] == os.getpid() and len(hello["assets"]) == 64
        made.clear()
    job = Job(**recipe(tmp_path, a={}).to_dict())
    assert len(job.plan().tasks) == 2 and job.num is None


# --- one task ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_a_sequence_that_is_interrupted(tmp_path, monkeypatch, error):
    def make(*_, **__):
        raise error

    monkeypatch.setattr(work, "generate_sequence", make)
    with pytest.raises(error):
        Maker(recipe(tmp_path, a={})).make(1, 2, lambda message: None)
    log = (tmp_path / "out/.run/logs/train/a_000001.log").read_text()
    assert log.endswith(" interrupted\n") and "Traceback" not in log
