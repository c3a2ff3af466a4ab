"""A second process that draws frames, too: the same bytes whoever draws what, and no harm when it goes."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from blinkgl.config.sequence import load_run
from blinkgl.dataset.generate import generate_sequence
from blinkgl.dataset.plan import Plan
from blinkgl.errors import EventDataError
from blinkgl.events.camera import EventCamera
from blinkgl.sequence import helper as helper_module
from blinkgl.sequence.helper import AHEAD, Hand, Helper, _both
from blinkgl.sequence.rendered import RenderedSequence

SMALL = {
    "seed": 5,
    "camera": {"width": 48, "height": 36},
    "time": {"duration": 0.1, "label_rate": 30, "start": 0.25},
    "timeline": {"kind": "displacement", "max_px": 0.25},
    "scene": {
        "kind": "random",
        "objects": {"count": 3, "distance": [2, 4]},
        "pool": {"primitives": ["cuboid", "sphere"], "variants": 2, "urdfs": False},
        "textures": {"procedural": ["checks", "fbm"], "variants": 2, "photographs": False, "max_size": 64},
    },
    "labels": {"flow": ["forward"], "ids": True},
    "preview": {"enabled": False},
}
STILL = {
    "kind": "explicit",
    "meshes": {
        "wall": {"primitive": "grid", "parameters": {"width": 14, "depth": 10}},
        "ball": {"primitive": "icosphere"},
    },
    "materials": {"wall": {"procedural": "checks", "seed": 3}, "dark": {"color": [0.1, 0.1, 0.1]}},
    "objects": [
        {"mesh": "wall", "material": "wall", "position": [5, 0, 0], "euler": [0, -90, 0]},
        {
            "mesh": "ball",
            "material": "dark",
            "keyframes": [{"time": 0, "position": [4, -0.5, 0]}, {"time": 1, "position": [4, 3, 0.5]}],
        },
    ],
    "camera": {"position": [0, 0, 0], "look_at": [4, 0, 0]},
}
"""A camera that stands still: whoever draws restores a picture of its own and draws what moves over it."""
CASES = {
    "esim": {},
    "hermite": {"timeline": {"kind": "uniform", "fps": 600, "reconstruction": "hermite"}},
    "pchip": {"timeline": {"kind": "displacement", "max_px": 0.25, "reconstruction": "pchip"}},
    "v2e": {"events": {"emulator": "v2e"}},
    "voltmeter": {"events": {"emulator": "voltmeter"}, "timeline": {"kind": "brightness"}},
    "truth of events": {"labels": {"flow": ["forward"], "events": True}},
    "images and preview": {"images": {"rate": 20}, "preview": {"enabled": True, "rate": 20}},
    "budget": {"timeline": {"kind": "budget", "max_time_error_us": 500}},
    "after a look": {
        "timeline": {"kind": "displacement", "max_px": 0.25, "first_look": True, "max_step_us": 1e6},
        "render": {"antialiasing": "edges2"},
    },
    "rig": {"rig": "stereo", "labels": {"flow": ["forward"], "disparity": True}},
    "rig of one": {"sensors": [{"name": "unit", "imu": {}}, {"name": "eye", "place": {"position": [0.1, 0, 0]}}]},
    "still": {"scene": STILL},
    "still, V2E": {"scene": STILL, "events": {"emulator": "v2e"}},
}


def sequence_of(tmp_path: Path, changes: dict):
    path = tmp_path / "run.yaml"
    path.write_text(yaml.safe_dump({**SMALL, **changes}))
    template = load_run(path)
    plan = Plan.of(template, 1)
    return plan.config(plan.tasks[0])


def bytes_of(folder: Path) -> dict[str, str]:
    return {
        p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


def made(config, out: Path, gl, helper=None) -> dict[str, str]:
    return bytes_of(generate_sequence(config, 0, out, gl, helper=helper).path)


@pytest.fixture(scope="module")
def helper(tmp_path_factory):
    with Helper(tmp_path_factory.mktemp("helper") / "log", patience_s=0.0) as one:
        yield one


@pytest.fixture
def at_once(monkeypatch):
    """A sequence begins when the helper takes part, as one does that is not a run's first, and the helper has drawn
    some frames before this process does, however little of the machine it gets."""
    shares, taken, since = Hand._shares, Hand._taken, {}

    def waits(self: Hand) -> bool:
        deadline = time.monotonic() + 120
        while not shares(self) and self.ready is None and self.works:
            assert time.monotonic() < deadline, "it does not come"
            time.sleep(0.01)
        return shares(self)

    def leaves_some(self: Hand):
        first = since.setdefault(self, self._helper.frames)
        return taken(self) if self._helper.frames >= first + 4 else None

    monkeypatch.setattr(Hand, "_shares", waits)
    monkeypatch.setattr(Hand, "_taken", leaves_some)


@pytest.mark.parametrize("name", CASES)
def test_whoever_draws_the_bytes_are_the_same(name, tmp_path, gl, helper, at_once):
    """Every file, the manifest's checksums included."""
    config = sequence_of(tmp_path, CASES[name])
    alone = made(config, tmp_path / "alone", gl)
    before = helper.frames
    assert made(config, tmp_path / "both", gl, helper) == alone and len(alone) > 5
    drawn = helper.frames - before
    assert (drawn == 0) == (name == "budget"), "a timeline that looks at frames is not shared, any other is"


def test_each_frame_comes_once_in_order_whoever_draws_it(tmp_path, gl, helper, at_once, monkeypatch):
    """This process is slow with some frames and the helper with none, and the other way round."""
    config = sequence_of(tmp_path, {"timeline": {"kind": "uniform", "fps": 1000}})
    times, step = [], EventCamera.step

    def slow(self: EventCamera, frame):
        times.append(frame.t_ns)
        if len(times) % 30 == 0:
            time.sleep(0.2)
        return step(self, frame)

    alone = made(config, tmp_path / "alone", gl)
    monkeypatch.setattr(EventCamera, "step", slow)
    before = helper.frames
    assert made(config, tmp_path / "both", gl, helper) == alone
    end_ns = 383_333_332  # a label interval after the last label
    assert times == [*range(250_000_000, end_ns, 1_000_000), end_ns], "every millisecond once, and the end"
    assert helper.frames - before >= AHEAD, "while this process slept, it drew all that it was given"


@pytest.mark.parametrize(
    ("kind", "how"),
    [
        pytest.param("displacement", signal.SIGKILL, id="displacement, killed"),
        pytest.param("displacement", signal.SIGSTOP, id="displacement, stopped", marks=pytest.mark.slow),
        pytest.param("uniform", signal.SIGKILL, id="uniform, killed", marks=pytest.mark.slow),
        pytest.param("uniform", signal.SIGSTOP, id="uniform, stopped", marks=pytest.mark.slow),
    ],
)
def test_without_the_helper_it_goes_on(how, kind, tmp_path, gl, at_once, monkeypatch):
    timeline = {"displacement": {"max_px": 0.1}, "uniform": {"fps": 1500}}[kind]
    config = sequence_of(tmp_path, {"timeline": {"kind": kind, **timeline}})
    alone = made(config, tmp_path / "alone", gl)
    step, count = EventCamera.step, [0]

    def strikes(self: EventCamera, frame):
        count[0] += 1
        if count[0] == 20 and helper.works:
            monkeypatch.setattr(helper_module, "SILENT_S", 0.5)
            os.kill(helper._popen.pid, how)
        return step(self, frame)

    monkeypatch.setattr(EventCamera, "step", strikes)
    with Helper(tmp_path / "log", patience_s=0.0) as helper:
        assert made(config, tmp_path / "both", gl, helper) == alone
        assert helper.frames > 0 and not helper.works and count[0] > 40
        again = made(config, tmp_path / "again", gl, helper)
        assert again == alone, "nor is it started again in this run"


def test_an_error_here_leaves_nothing_and_the_helper_serves_the_next(tmp_path, gl, helper, at_once, monkeypatch):
    config = sequence_of(tmp_path, {})
    alone = made(config, tmp_path / "alone", gl)

    def fails(self: EventCamera, frame):
        if self.frames == 15:
            raise EventDataError("not a number", where="luminance", value="nan", accepted="light")
        return step(self, frame)

    step, said = EventCamera.step, []
    with monkeypatch.context() as patch:
        patch.setattr(EventCamera, "step", fails)
        for one in (None, helper):
            with pytest.raises(EventDataError) as error:
                generate_sequence(config, 0, tmp_path / "bad", gl, helper=one)
            said.append(str(error.value))
            assert not [p for p in (tmp_path / "bad").rglob("*") if p.is_file()]
    assert said[0] == said[1] and "\n" not in said[0]
    before = helper.frames
    assert made(config, tmp_path / "next", gl, helper) == alone and helper.frames > before


def test_what_fails_in_the_helper_is_met_here(tmp_path, gl, at_once):
    """It cannot build the scene, or would draw another one: this process draws, and the log says why."""
    config, log = sequence_of(tmp_path, {}), tmp_path / "log"
    alone = made(config, tmp_path / "alone", gl)
    with Helper(log, patience_s=0.0) as helper:
        sequence = helper.sequence
        for wrong, said in (({"digest": "0"}, "does not come back"), ({"opengl": "a card"}, "draws with a card")):

            def other(*arguments, wrong=wrong):
                hand = sequence(*arguments)
                hand._opening.update(wrong)
                return hand

            helper.sequence = other
            assert made(config, tmp_path / said, gl, helper) == alone and helper.frames == 0
            assert said in log.read_text() and helper.works
        helper.sequence = sequence
        assert made(config, tmp_path / "well", gl, helper) == alone and helper.frames > 0


def test_it_is_not_started_before_it_pays(tmp_path, gl):
    config = sequence_of(tmp_path, {})
    with Helper(tmp_path / "log", patience_s=1000.0) as helper:
        made(config, tmp_path / "out", gl, helper)
        assert not helper.works and not (tmp_path / "log").exists()


def test_times_after_one_of_them_are_those_that_follow(tmp_path, gl):
    """Of every kind that another process may decide, with an impact to stop at."""
    for timeline in ({"kind": "displacement", "max_px": 0.3}, {"kind": "brightness"}, {"kind": "uniform", "fps": 700}):
        config = sequence_of(tmp_path, {"timeline": timeline})
        with RenderedSequence(
            config,
            0,
            gl,
            base=tmp_path,
            events=True,
            labels=False,
            pictures_hz=None,
            scene=None,
            renderer=None,
            window_ns=None,
        ) as sequence:
            one = sequence.timeline
            one.stops_ns = (one.t0_ns + 40_000_000,)
            times = list(one)
            assert len(times) > 20 and one.repeats and (one.stops_ns[0] in times or timeline["kind"] == "uniform")
            for k in (0, 7, len(times) - 2, len(times) - 1):
                assert list(one.after(times[k])) == times[k + 1 :]


@pytest.mark.parametrize(
    ("one", "other", "both"),
    [
        ((2, 5), (8, 9), (2, 9)),
        ((2, 5), (0, 0), (2, 5)),
        ((0, 0), (0, 0), (0, 0)),
        (None, (2, 5), None),
        ((2, 5), None, None),
    ],
)
def test_rows_that_hold_both(one, other, both):
    assert _both(one, other) == both


RUN = """
import sys
from blinkgl.sequence import helper
helper.PATIENCE_S = 0.0
from blinkgl import cli
sys.exit(cli.run(sys.argv[1:]))
"""


def helpers_of(pid: int) -> list[int]:
    found = []
    for task in Path("/proc").iterdir():
        try:
            if task.name.isdigit() and "helper_process" in (task / "cmdline").read_text():
                parent = (task / "stat").read_text().rpartition(")")[2].split()[1]
                found += [int(task.name)] if int(parent) == pid else []
        except OSError:
            continue
    return found


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_run_that_is_ended_takes_its_helper_along(how, tmp_path):
    """And leaves nothing half written."""
    path, out = tmp_path / "run.yaml", tmp_path / "out"
    path.write_text(yaml.safe_dump({**SMALL, "time": {"duration": 60.0, "label_rate": 30}}))
    process = subprocess.Popen(
        [sys.executable, "-c", RUN, "generate", str(path), "--out", str(out), "-q"],
        env={**os.environ, "NUMBA_NUM_THREADS": "2"},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        deadline = time.monotonic() + 120
        while not (found := helpers_of(process.pid)):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        time.sleep(3.0)  # so that it is drawing
        process.send_signal(how)
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == (-signal.SIGKILL if how == signal.SIGKILL else 130), said
    deadline = time.monotonic() + 60
    while any(Path(f"/proc/{pid}").exists() for pid in found):
        assert time.monotonic() < deadline, "it outlives its driver"
        time.sleep(0.05)
    if how != signal.SIGKILL:  # after which the next run tidies up
        assert "Traceback" not in said and not list(out.rglob("events.h5"))


@pytest.mark.slow
@pytest.mark.parametrize(("threads", "helped"), [("1", False), ("2", True)])
def test_only_who_has_a_core_to_spare_has_a_helper(threads, helped, tmp_path):
    """Two workers on two cores have one thread each, and no helper."""
    from blinkgl.dataset.work import thread_environment

    assert (
        thread_environment(2, 2, {})["NUMBA_NUM_THREADS"] == "1"
        and thread_environment(1, 2, {})["NUMBA_NUM_THREADS"] == "2"
    )
    program = (
        "import sys; from blinkgl.dataset.work import Job, Maker\n"
        "with Maker(Job(sys.argv[1], '.', sys.argv[2])) as maker:\n    maker.open(); print(maker.helper is not None)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path), yaml.safe_dump(SMALL)],
        env={**os.environ, "NUMBA_NUM_THREADS": threads},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == [str(helped)]
