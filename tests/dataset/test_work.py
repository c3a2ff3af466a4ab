"""What workers share: who is given which threads, what ends a run, what is added up, what is said beforehand."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from blinkgl.config.run import load_run
from blinkgl.config.sequence import PreviewConfig
from blinkgl.dataset import preview as preview_module, work
from blinkgl.dataset.explain import PROBES, explain
from blinkgl.dataset.plan import Plan, check_output
from blinkgl.dataset.preview import PreviewRecorder
from blinkgl.dataset.report import STAGES, SequenceReport, Totals
from blinkgl.dataset.work import Job, Maker, SequenceLog, environment_differences, thread_environment
from blinkgl.errors import ConfigError, OutputError, may_pass
from blinkgl.sequence import EventChunk, Picture
from blinkgl.sequence.clock import StageClock

# --- workers ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "workers, cores, share, drawing", [(1, 1, 1, "0"), (2, 1, 1, "0"), (3, 8, 2, "2"), (8, 8, 1, "0"), (0, 4, 4, None)]
)
def test_cores_are_divided(workers, cores, share, drawing):
    names = {name: str(share) for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    assert thread_environment(workers, cores, {}) == names | ({} if drawing is None else {"LP_NUM_THREADS": drawing})


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


def test_a_report_of_many():
    reports = [
        SequenceReport(k, Path(str(k)), 0.5, 10, 1000, 7, 3, {"render": 1.0, "write": 0.25}, 2.0, 3.0 - k)
        for k in range(3)
    ]
    totals = Totals()
    assert len(totals) == 0 and totals.add(reports[0]) is totals
    for report in reports[1:]:
        totals.add(report)
    assert len(totals) == 3 and totals.first is reports[0] and totals.compile_s == 3.0, "workers compile at once"
    assert totals.summary() == {
        "sequences": 3, "frames": 30, "events": 3000, "labels": 9, "simulated_s": 1.5, "total_s": 6.0,
        "seconds_per_simulated_second": 4.0, "events_per_second": 500.0, "render_s": 3.0, "write_s": 0.75,
        "scene_s": 0.0, "read-back_s": 0.0, "events_s": 0.0, "images_s": 0.0, "preview_s": 0.0, "other_s": 2.25,
    }  # fmt: skip
    assert STAGES == ("scene", "render", "read-back", "events", "images", "write", "preview")
    totals.seconds["render"] = 99.0
    assert totals.summary()["other_s"] == 0.0


def test_a_clock_adds_up(monkeypatch):
    now, compiled = [100.0], [7.0]
    monkeypatch.setattr("blinkgl.sequence.clock.working_clock", lambda: now[0])
    monkeypatch.setattr("blinkgl.sequence.clock.compiled_s", lambda: compiled[0])
    clock = StageClock()
    for seconds in (2.0, 3.0):
        with clock("a"):
            now[0] += seconds
    with pytest.raises(KeyError), clock("b"):
        now[0] += 1.0
        raise KeyError
    clock.add("b", 0.5)
    compiled[0] += 4.0
    assert clock.seconds == {"a": 5.0, "b": 1.5} and clock.total == 6.0 and clock.compile_s == 4.0


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


@pytest.mark.parametrize("rate, recorded", [(None, False), (50.0, False), (50.0, True)])
@pytest.mark.parametrize("fails", [False, True])
def test_the_preview_is_fed_and_ended(monkeypatch, rate, recorded, fails):
    """Closed at the end, thrown away after an error; nothing is made of a sequence without pictures."""
    calls = []

    class Video:
        def __init__(self, path, panels, fps):
            calls.append(("made", path, panels[0].about, fps))
            self.panels = panels

        def __getattr__(self, name):
            return lambda *given: calls.append((name, *given))

    class Panels:
        def __init__(self, height, width, **given):
            self.about = (height, width, given)

        def __getattr__(self, name):
            return lambda *given: calls.append((name, *given))

    monkeypatch.setattr(preview_module, "RigPreviewWriter", Video)
    monkeypatch.setattr(preview_module, "Panels", Panels)
    sequence = SimpleNamespace(
        name="", clock=StageClock(), pictures_hz=rate, height=3, width=4, t0_ns=2_500_000, t1_ns=10**9,
        config=SimpleNamespace(time=SimpleNamespace(interval_ns=50_000_000), frames=object() if recorded else None),
        rectifies=True, imu=lambda: None,  # neither tracks nor an inertial unit
    )  # fmt: skip
    velocity = np.full((3, 4, 2), 40, np.float32)
    try:
        folder = SimpleNamespace(path=lambda name: name)
        with PreviewRecorder(PreviewConfig(), [sequence], folder) as recorder:
            recorder.take(sequence, EventChunk(7_000_000, "events"))
            recorder.take(sequence, Picture(7_999_999, "image", None if recorded else velocity))
            if fails:
                raise KeyError
    except KeyError:
        assert fails
    if rate is None:
        assert calls == [] and "preview" not in sequence.clock.seconds
        return
    about = {
        "t0_us": 2500,
        "flow": not recorded,
        "rate_hz": 50.0,
        "fps": 25.0,
        "label": "frame",
    }
    assert calls[0] == ("made", "preview.mp4", (3, 4, about), 25.0)
    names = [name for name, *_ in calls[1:]]
    assert names == ["add_events", *([] if recorded else ["set_flow"]), "frame", "abort" if fails else "close"]
    assert calls[-2][1:] == (0, 7999, "image") and sequence.clock.seconds["preview"] >= 0
    if not recorded:
        assert (calls[2][1] == 2).all(), "px in a label interval"


# --- explain ----------------------------------------------------------------------------------------------------------

EXPLAINED = {
    "camera": {"width": 64, "height": 48},
    "time": {"duration": 0.2, "label_rate": 20, "start": 0.5},
    "scene": {
        "kind": "random",
        "objects": {"count": 3},
        "textures": {"photographs": False, "max_size": 64, "variants": 2},
        "pool": {"primitives": ["cuboid"], "variants": 2, "urdfs": False},
    },
    "labels": {"flow": ["forward", "backward"], "depth": True, "ids": True},
    "preview": {"enabled": True, "rate": 30},
}


@pytest.mark.parametrize(
    "changes, frames, samples, bytes_",
    [
        ({"timeline": {"kind": "uniform", "fps": 100}}, 26, 1, {"event frames": 8}),
        (
            {
                "timeline": {"kind": "uniform", "fps": 100},
                "render": {"antialiasing": "ssaa2"},
            },
            26,
            4,
            {"event frames with rates": 12},
        ),
    ],
)
def test_what_each_pass_holds_and_how_often_it_is_drawn(tmp_path, changes, frames, samples, bytes_):
    """Bytes a pixel: depth 4, luminance 4, its rate 4, colour 16, velocity 8, of labels what their buffers say."""
    path = tmp_path / "run.yaml"
    tree = {**EXPLAINED, **changes}
    tree["render"] = {"image_antialiasing": "none", "antialiasing": "none", **changes.get("render", {})}
    path.write_text(yaml.safe_dump(tree))
    told = explain(load_run(path))
    pixels = 64 * 48
    held = {p.name: (p.bytes / pixels, p.count) for p in told.passes}
    ((name, size),) = bytes_.items()
    assert told.frames == frames and held == {
        name: (size * samples, 26),
        "colour": (20, 5),
        "labels": (2 * 16 + 4 + 4 + 4, 4),
        "preview": (28, int(0.25 * 30) + 1),
        "event kernel": (0, 26),
    }
    assert told.seconds == pytest.approx(sum(p.seconds for p in told.passes)) and all(
        p.seconds > 0 for p in told.passes
    )
    assert told.seconds_per_simulated_second == pytest.approx(told.seconds / 0.25)
    assert told.scene["bodies"].startswith("3 objects") and told.scene["camera"].endswith(", moving")
    assert PROBES == 12 and told.machine and "velocity pass" in dict(told.left_out)
    assert ("anti-aliasing of event frames" in dict(told.left_out)) == (samples == 1)
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


def test_a_sequence_that_is_made(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(work.time, "monotonic", lambda: now[0])

    def make(config, index, out, gl, *, base, progress):
        assert (index, out, gl, base) == (1, str(tmp_path / "out"), None, tmp_path)
        assert config.output.name == "a"
        report = SequenceReport(index, tmp_path / "seq", 0.5, 10, 1000, 7, 3, {"render": 1.5}, 2.0, omissions=("lamp",))
        for step in (1.0, 0.1, 0.15, 0.16, 0.26):  # news after more than a quarter of a second
            now[0] += step
            progress(report, now[0] / 10)
        (tmp_path / "seq/sub").mkdir(parents=True)
        (tmp_path / "seq/a").write_bytes(b"12345")
        (tmp_path / "seq/sub/b").write_bytes(b"1")
        return report

    message, log, told = made(tmp_path, monkeypatch, make)
    assert (message["kind"], message["task"], message["bytes"]) == ("done", 1, 6)
    assert (
        message["report"]["path"] == str(tmp_path / "seq") and message["cpu_s"] >= 0 and message["peak_rss_kib"] > 1000
    )
    assert work.report_of(message).path == tmp_path / "seq" and work.report_of(message).events == 1000
    assert [m["fraction"] for m in told] == pytest.approx([0.1, 0.141, 0.167]) and told[0] == {
        "kind": "progress", "task": 1, "frames": 10, "events": 1000, "fraction": 0.1,
        "seconds": {"render": 1.5}, "omissions": ["lamp"],
    }  # fmt: skip
    assert f"attempt 2, pid {os.getpid()} on " in log
    assert "done in 2.00 s: 10 frames, 1000 events, 3 labels, 6 bytes; render 1.50 s\n" in log


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
