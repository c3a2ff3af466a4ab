"""What workers share: who is given which threads, what ends a run, what is added up, what is said beforehand."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from blinkgl.config.run import load_run
from blinkgl.dataset import work
from blinkgl.dataset.explain import PROBES, explain
from blinkgl.dataset.plan import Plan, check_output
from blinkgl.dataset.work import Job, Maker, SequenceLog, environment_differences
from blinkgl.errors import ConfigError, OutputError, may_pass

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


def test_installations_that_differ():
    one = {"numpy": "2.4", "opengl": "a, 4.5"}
    assert environment_differences(one, dict(one)) == ""
    assert environment_differences(one, {"numpy": "2.3", "opengl": "a, 4.5", "numba": "1"}) == (
        "numpy 2.4 and 2.3; numba None and 1"
    )


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


def test_logs_stop_nothing(tmp_path):
    log = SequenceLog(tmp_path, "train/a_000001")
    log.write("one\n\n")
    log.write("two")
    stamp = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d "
    assert re.fullmatch(f"{stamp}one\n{stamp}two\n", (tmp_path / ".run/logs/train/a_000001.log").read_text())
    (tmp_path / "file").touch()
    SequenceLog(tmp_path / "file", "a").write("nowhere")


def test_output_that_cannot_be_a_data_set(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "real/train").mkdir(parents=True)
    (tmp_path / "link").symlink_to("real")
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd/test").symlink_to("nowhere")
    for fine in ("none", "real", "link"):
        check_output(tmp_path / fine)
    with pytest.raises(OutputError, match="file: is a file; expected a folder"):
        check_output(tmp_path / "file")
    with pytest.raises(
        OutputError, match=r"odd/test: is a symbolic link; expected a folder .--out itself may be a link"
    ):
        check_output(str(tmp_path / "odd"))


# --- the preview's feeder ---------------------------------------------------------------------------------------------


# --- explain ----------------------------------------------------------------------------------------------------------

EXPLAINED = {
    "camera": {"width": 64, "height": 48},
    "time": {"duration": 0.2, "label_rate": 20, "start": 0.5},
    "scene": {
        "kind": "random",
        "objects": {"count": 3},
        "textures": {"photographs": False, "max_size": 64, "variants": 2},
        "pool": {"primitives": ["cuboid"], "variants": 2},
    },
    "labels": {"flow": ["forward", "backward"], "depth": True, "ids": True},
    "preview": {"enabled": True, "rate": 30},
}


def test_how_often_each_pass_is_drawn(tmp_path):
    path = tmp_path / "run.yaml"
    tree = {**EXPLAINED, "timeline": {"kind": "uniform", "fps": 100}}
    path.write_text(yaml.safe_dump({**tree, "render": {"image_antialiasing": "none", "antialiasing": "none"}}))
    told = explain(load_run(path))
    assert told.frames == 26 and {p.name: p.count for p in told.passes} == {
        "event frames": 26,
        "colour": 5,
        "labels": 4,
        "preview": int(0.25 * 30) + 1,
        "event kernel": 26,
    }
    assert told.seconds == pytest.approx(sum(p.seconds for p in told.passes)) and all(
        p.seconds > 0 for p in told.passes
    )
    assert told.seconds_per_simulated_second == pytest.approx(told.seconds / 0.25)
    assert told.scene["bodies"].startswith("3 objects") and told.scene["camera"].endswith(", moving")
    assert PROBES == 12 and told.machine and "velocity pass" in dict(told.left_out)
    labels = next(p for p in told.passes if p.name == "labels")
    assert set(labels.why.split(", ")) == {
        "flow_forward",
        "flow_backward",
        "occlusion_forward",
        "occlusion_backward",
        "depth",
        "ids",
    }


# --- one task ---------------------------------------------------------------------------------------------------------


def made(tmp_path, monkeypatch, make):
    """(message or exception, log, progress messages) of the first task, with ``make`` in the place of the renderer."""
    told = []
    monkeypatch.setattr(work, "generate_sequence", make)
    try:
        outcome = Maker(recipe(tmp_path, a={})).make(1, 2, told.append)
    except BaseException as error:  # noqa: BLE001 - it is what is asked for
        outcome = error
    return outcome, (tmp_path / "out/.run/logs/train/a_000001.log").read_text(), told


@pytest.mark.parametrize(
    "error, line, expected, stop",
    [
        (ConfigError("bad", where="a.b", value=3), "a.b: bad (got 3)", True, False),
        (
            OutputError("cannot write: no space left on the device"),
            "cannot write: no space left on the device",
            True,
            True,
        ),
        (ValueError("odd\n  words"), "ValueError: odd words", False, False),
    ],
)
def test_a_sequence_that_cannot_be_made(tmp_path, monkeypatch, error, line, expected, stop):
    """The reason in one line, in the message and in the log, which has the traceback besides."""

    def make(*_, **__):
        raise error

    message, log, told = made(tmp_path, monkeypatch, make)
    assert message == {
        "kind": "failed", "task": 1, "error": line, "expected": expected, "final": not may_pass(error), "stop": stop
    }  # fmt: skip
    assert f"failed: {line}\n" in log and "Traceback (most recent call last)" in log and told == []


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_a_sequence_that_is_interrupted(tmp_path, monkeypatch, error):
    def make(*_, **__):
        raise error

    outcome, log, _ = made(tmp_path, monkeypatch, make)
    assert type(outcome) is error and log.endswith(" interrupted\n") and "Traceback" not in log
