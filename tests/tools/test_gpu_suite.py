"""The suite for machines with a card runs whole on the processor, and what fails there is a line; what has to travel is
listed."""

from __future__ import annotations

import configparser
import json
import multiprocessing.forkserver
import os
import re
import shutil
import subprocess
import sys
from argparse import Namespace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("torch")

from blinkgl.config.run import load_run
from blinkgl.errors import AssetError
from blinkgl.tools import gpu_learning, gpu_pieces, gpu_suite

ROOT = Path(__file__).parents[2]


def names_of(text: str) -> set[str]:
    return {re.split(r"[><=;\[ ]", line.strip())[0].lower() for line in text.splitlines() if line.strip()}


def wheels(sort: str = "") -> list[str]:
    """What tools/gpu_wheels.txt lists: what travels, or what is "there" or stays at "home"."""
    lines = (ROOT / "tools" / "gpu_wheels.txt").read_text().splitlines()
    if not sort:
        return [line for line in lines if not line.startswith("#")]
    return [name for line in lines if line.startswith(f"# {sort}: ") for name in line.split()[2:]]


def test_the_list_of_wheels_is_whole():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    wanted = names_of(config["options"]["install_requires"]) | names_of(config["options.extras_require"]["learn"])
    lists = [names_of("\n".join(wheels(sort))) for sort in ("", "there", "home")]
    assert wanted <= set.union(*lists) and sum(map(len, lists)) == len(set.union(*lists))
    pinned = {line.split(";")[0].strip() for line in (ROOT / "constraints.txt").read_text().splitlines()}
    assert set(wheels()) <= pinned


# --- on this machine --------------------------------------------------------------------------------------------------


@pytest.fixture
def started_once(monkeypatch):
    """The processes of pieces are forked from one that has imported what they need, which takes longer than most."""
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(["blinkgl.tools.gpu_pieces"])
    monkeypatch.setattr(gpu_suite, "multiprocessing", SimpleNamespace(get_context=lambda _: server))
    yield
    multiprocessing.forkserver._forkserver._stop()


def test_stage_a_runs_here(started_once, tmp_path, capfd):
    """All but what compiles kernels, in processes; without what travels, the comparison with it says so."""
    pieces = [name for name in gpu_suite.STAGES["A"][1] if name != "compiling"]
    words = ["--small", "--device", "cpu", "--stage", "A", "--events", "1000", "--packed", str(tmp_path / "none")]
    status = gpu_suite.main(["--out", str(tmp_path), "--only", ",".join(pieces), *words])
    report = json.loads((tmp_path / "gpu_suite.json").read_text())
    found = report["stages"]["A"]
    absent = {"transfer", "fingerprint"}
    assert status == 0 and list(found) == pieces
    assert {name for name in pieces if found[name]["state"] == "done"} == set(pieces) - absent
    assert "use --pack before" in found["fingerprint"]["said"]
    rows = {name: {row[""]: row for row in piece["rows"]} for name, piece in found.items()}
    assert sum(row["events, all the same"] for row in rows["events"].values()) > 10_000
    assert {name.removesuffix(", turn 0") for name in rows["events"]} == set(gpu_pieces.VARIANTS)
    for row in rows["kernel"].values():  # the events that the row's name says, over and over
        # The thresholds differ by pixel, and pixels walk out of the clip's range (in numba
        # alike): the first steps have more events, so how many fit decides the mean.
        density = float(row[""].split(", ")[2].split()[0])
        assert 0.5 < 1e6 * row["Mev/s"] / row["frames/s"] / (density * 48 * 64) < 1.6
    assert all(row["passed"] for row in rows["frames"].values()) and "skin_morph" in gpu_pieces.GRADED
    assert all(row["frames go by"].startswith("plain") for row in rows["end_to_end"].values())
    assert rows["transfer"]["plain"]["same numbers"] and "asked for" in rows["transfer"]["interop"]["said"]
    page = (tmp_path / "gpu_suite.md").read_text()
    assert "| OpenGL: context | ok |" in page and page in capfd.readouterr().out
    assert "on cpu, no card" in report["device"]


def small(tmp_path: Path) -> Namespace:
    folders = {name: tmp_path / name for name in ("out", "scratch", "packed")}
    for folder in folders.values():
        folder.mkdir(exist_ok=True)
    return Namespace(device="cpu", small=True, **folders, seconds=60.0, seed=0, backend="auto", egl_device=0)


def dancers_of(row):
    """The run that the row generates, which loads a recipe of a hundred figures in each of its processes."""
    name, *words = row.args[1]
    return load_run(name, words[1::2])


def test_a_sequence_has_its_stages(tmp_path):
    rows = dict(gpu_pieces.sequences(small(tmp_path)))
    assert list(rows)[:2] == ["flying_objects, 64x48, 1 process", "dancers, 64x48, 1 process"]
    assert [group.count for group in dancers_of(rows["dancers, 64x48, 2 processes"]).groups if group.enabled] == [12]
    row = rows["flying_objects, 64x48, 2 processes"]()
    assert 0 < row["render, s/s"] < row["wall, s/s"] and row["processor, s/s"] > 0
    with pytest.raises(RuntimeError, match="status 2: error: .*camera.width"):
        gpu_pieces._generated(small(tmp_path), ["stereo"], (0, 48), 1)


def test_what_differs_from_what_travelled_is_a_share(monkeypatch):
    picture, counts = np.arange(100.0).reshape(10, 10), np.full((10, 10), 2)
    made = {"a/x.png": picture, "a/events.h5": counts, "a/new.png": picture}
    monkeypatch.setattr(gpu_pieces, "arrays_of", lambda name: made)
    other, fewer = picture.copy(), counts.copy()
    other[0, :3] += 5  # 2 % of the range are allowed
    other[1] += 1
    fewer[0, 0] = 0
    known = {"a/x.png": other, "a/events.h5": fewer, "b/y.png": picture, "a/gone.png": picture}
    row = gpu_pieces._beside_packed("a", known)
    assert (row["files"], row["other files"], row["events, theirs"]) == (3, 2, "200, 198")
    assert (row["values that differ, %"], row["where"]) == (pytest.approx(3), "a/x.png")
    assert gpu_pieces._beside_packed("a", known | {"a/x.png": picture[:5]})["values that differ, %"] == 100


# --- what may go wrong ------------------------------------------------------------------------------------------------

FAULTS = """
import os, signal, subprocess, sys, time
from blinkgl.errors import GLError
def wrong(error):
    raise error
def hang():
    subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)", __file__])
    time.sleep(600)
def rows(options):
    yield "first", lambda: {"value": 1.5}
    yield "no OpenGL", lambda: wrong(GLError("no usable OpenGL", where="gl.backend egl"))
    yield "full", lambda: wrong(RuntimeError("CUDA out of memory. Tried to allocate 2 GiB"))
    yield "killed", lambda: os.kill(os.getpid(), signal.SIGSEGV)
    yield "hangs", hang
    yield "several", lambda: [{"": "one", "value": 2}, {"": "two", "passed": False}]
    yield "an error", lambda: wrong(ZeroDivisionError("by 0"))
    yield "last", lambda: {"value": 3}
slow = lambda options: iter([("quick", lambda: {"value": 1}), ("slow", lambda: time.sleep(600))])
def broken(options):
    yield "quick", lambda: {"value": 1}
    raise GLError("the generator ends")
"""


@pytest.fixture
def faults(tmp_path, monkeypatch):
    """Stages A to C of pieces that go wrong, in processes that do without torch, whose import is most of their time."""
    (tmp_path / "faults.py").write_text(FAULTS)
    (tmp_path / "torch.py").write_text("raise ImportError('not here')")
    monkeypatch.syspath_prepend(tmp_path)
    pieces = {name: ("faults", f"of {name}", 1.0, 20.0) for name in ("rows", "slow", "broken", "gone")}
    monkeypatch.setattr(gpu_suite, "PIECES", pieces)
    stages = {"A": (60.0, ("rows", "broken", "gone")), "B": (60.0, ("slow", "rows"))}
    monkeypatch.setattr(gpu_suite, "STAGES", stages)
    return tmp_path


def test_what_goes_wrong_is_a_line_and_the_others_go_on(faults):
    assert (
        gpu_suite.main(["--device", "cpu", "--stage", "A", "--out", str(faults / "out"), "--only", "rows,broken,gone"])
        == 1
    )
    found = json.loads((faults / "out" / "gpu_suite.json").read_text())["stages"]["A"]
    assert {row[""]: row.get("said", row.get("value")) for row in found["rows"]["rows"]} == {
        "first": 1.5,
        "no OpenGL": "absent: gl.backend egl: no usable OpenGL",
        "full": "absent: CUDA out of memory. Tried to allocate 2 GiB",
        "killed": "the process ended with status -11",
        "hangs": "no result after 20 s",
        "one": 2,
        "two": None,
        "an error": "failed: ZeroDivisionError: by 0",
        "last": 3,
    }
    assert found["rows"]["state"] == "failed"
    assert found["broken"]["rows"] == [{"": "quick", "value": 1}]
    assert (found["broken"]["state"], found["broken"]["said"]) == ("absent", "the generator ends")
    assert found["gone"]["state"] == "failed" and "AttributeError" in found["gone"]["said"]
    for path in Path("/proc").glob("[0-9]*/cmdline"):  # what a row began ends with it
        try:
            assert str(faults).encode() not in path.read_bytes()
        except OSError:
            continue


def test_a_stage_ends_when_its_time_is_over(faults, monkeypatch):
    """The hour of the stage is over with the first result."""
    now, write = [0.0], gpu_suite.write
    monkeypatch.setattr(gpu_suite, "time", SimpleNamespace(monotonic=lambda: now[0]))

    def written(out, report):
        write(out, report)
        now[0] += 3600 * bool(report["stages"]["B"]["slow"]["rows"])

    monkeypatch.setattr(gpu_suite, "write", written)
    words = ["--device", "cpu", "--stage", "B", "--out", str(faults / "out"), "--only", "slow,rows"]
    assert gpu_suite.main(words) == 0
    found = json.loads((faults / "out" / "gpu_suite.json").read_text())["stages"]["B"]
    assert found["slow"]["rows"] == [{"": "quick", "value": 1}]
    assert found["slow"]["state"] == "cut" and re.fullmatch(
        "the time was over during '(quick|slow)'", found["slow"]["said"]
    )
    assert (found["rows"]["state"], found["rows"]["said"]) == ("cut", "the time was over during 'the start'")
    assert "cut, " in (faults / "out" / "gpu_suite.md").read_text()


@pytest.mark.parametrize("words", [["--stage", "AX"], ["--only", "doctor,nothing"], ["--minutes", "no"]])
def test_bad_arguments(words, capsys):
    with pytest.raises(SystemExit) as caught:
        gpu_suite.main(words)
    assert caught.value.code == 2 and re.search("unknown (X|nothing); expected|invalid float", capsys.readouterr().err)


def test_a_training_that_ends_says_why(tmp_path):
    options = small(tmp_path)
    with pytest.raises(AssetError, match="use --pack before"):
        next(gpu_learning.online(options))
    (tmp_path / "scratch" / "pool").mkdir()
    with pytest.raises(RuntimeError, match="no weights: error: .*pool"):
        gpu_learning._learnt(options, "ev_flownet", 0.1)


# --- in the environment of such a machine -----------------------------------------------------------------------------

THERE = (
    "numpy numba scipy pillow imageio opencv-python-headless scikit-image h5py PyYAML typer matplotlib jinja2".split()
)
LEARN = ["torch", "safetensors", "tensorboard"]


def made(tmp_path: Path, python: str, packages: list[str]) -> dict[str, str]:
    """Make the environment: only these packages, what travels beside them, and a copy of the tree that is not
    installed; return its variables."""

    def run(*words) -> None:
        done = subprocess.run([*map(str, words)], capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"cannot be made here: {' '.join((done.stdout + done.stderr).split())[-200:]}")

    run(python, "-m", "venv", tmp_path / "bare")
    pip = [tmp_path / "bare" / "bin" / "python", "-m", "pip", "install", "-q", "--only-binary", ":all:"]
    run(*pip, "-c", ROOT / "constraints.txt", *packages)
    run(*pip, "--no-deps", "--target", tmp_path / "site", *wheels())
    files = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in files.split("\0"):
        if (ROOT / name).is_file():
            (tmp_path / "tree" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, tmp_path / "tree" / name)
    for name in ("shaders", "configs", "tools"):
        (tmp_path / "tree" / "blinkgl" / name).symlink_to(f"../{name}")
    paths = os.pathsep.join([str(tmp_path / "tree"), str(tmp_path / "site")])
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "COV", "VIRTUAL"))}
    return {**clean, "PYTHONPATH": paths, "NUMBA_CACHE_DIR": str(tmp_path / "numba"), "MPLBACKEND": "Agg"}


@pytest.mark.slow
@pytest.mark.parametrize("torch", [True, False], ids=["this Python", "Python 3.12 without torch"])
def test_the_rehearsal_in_a_bare_environment(tmp_path, torch):
    """All stages, in this Python, whose build of torch for processors is at hand; and in the card's Python 3.12 what
    does not need torch, which there has gigabytes of CUDA."""
    other = Path("~/.pyenv/versions/3.12.1/bin/python3.12").expanduser()  # its shim on the PATH runs nothing
    python = sys.executable if torch else str(other) if other.exists() else shutil.which("python3.12")
    if python is None:
        pytest.skip("no Python 3.12")
    environment = made(tmp_path, python, [*THERE, *(LEARN if torch else [])])
    run = lambda *words: subprocess.run(
        [tmp_path / "bare/bin/python", "-m", "blinkgl.tools.gpu_suite", *words],
        cwd=tmp_path / "tree",
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if torch:
        packed = run("--pack", "out/card", "--small")
        assert packed.returncode == 0, packed.stderr
    done = run("--small", "--device", "cpu", "--out", "out/suite")
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "tree/out/suite/gpu_suite.json").read_text())
    states = {name: piece["state"] for stage in report["stages"].values() for name, piece in stage.items()}
    absent = {"transfer"} if torch else {*gpu_suite.NEED_TORCH, "fingerprint"}
    assert {name for name, state in states.items() if state == "absent"} == absent
    assert set(states) == set(gpu_suite.PIECES) and set(states.values()) == {"done", "absent"}
    assert (tmp_path / "tree/out/suite/online_half.safetensors").exists() == torch
