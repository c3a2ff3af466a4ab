"""What workers share: who is given which threads, what ends a run, what is added up, what is said beforehand."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from blinkgl.dataset import work
from blinkgl.dataset.plan import Plan
from blinkgl.dataset.work import Job, Maker
from blinkgl.errors import ConfigError, OutputError

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
    work._source_hash.cache_clear()
    monkeypatch.setenv("BLINKGL_BUILD", "image-7")
    assert work.environment(None)["blinkgl"].endswith(" (image-7)") and work.environment(None)["opengl"] == "not used"
    work._source_hash.cache_clear()
    monkeypatch.delenv("BLINKGL_BUILD")
    assert re.fullmatch("[0-9a-f]{12}", work._source_hash())
    card = SimpleNamespace(renderer="Voodoo", version="4.5")
    assert work.environment(card)["opengl"] == "Voodoo, 4.5"
    work._source_hash.cache_clear()


def recipe(tmp_path: Path, **groups) -> Job:
    text = yaml.safe_dump({"groups": {k: {"output": {"sequences": 2}, **v} for k, v in groups.items()}})
    return Job(str(tmp_path / "out"), str(tmp_path), text)


def test_groups_that_ask_for_different_opengl(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(work, "create_context", lambda *given: made.append(given) or SimpleNamespace(
        renderer="r", version="v", release=lambda: made.append("released")
    ))  # fmt: skip
    monkeypatch.setattr(Plan, "check_assets", lambda self: {"a": "b"})
    with pytest.raises(ConfigError, match="gl: the groups ask for different OpenGL; expected one gl section"):
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
