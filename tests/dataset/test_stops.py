"""Whatever stops a command, whenever: one line, the status of the signal, nothing left, the same bytes in the end."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset.generate import generate_run
from blinkgl.dataset.run import run_dataset
from runs import NAMES, Listener, assert_same, recipe_file, temporaries, wait_for

BLINKGL = [sys.executable, "-P", "-m", "blinkgl"]


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("reference")
    list(generate_run(load_run(recipe_file(folder)), folder / "out"))
    return folder / "out"


def foreground() -> None:
    """Where the suite runs in a shell's background SIGINT is ignored, and children would inherit that."""
    os.setsid()
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def started(words: list[str]) -> subprocess.Popen:
    pipe = subprocess.PIPE
    return subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True, preexec_fn=foreground)  # noqa: PLW1509


def mine(mark: str) -> list[int]:
    """Processes whose command line, or environment, names the folder of the test."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            text = (entry / "cmdline").read_bytes() + (entry / "environ").read_bytes()
        except OSError:
            continue
        if mark.encode() in text and int(entry.name) != os.getpid() and (entry / "exe").exists():
            found.append(int(entry.name))
    return found


STOPS = {
    "INT": (lambda p: os.kill(p.pid, signal.SIGINT), 130),
    "TERM": (lambda p: os.kill(p.pid, signal.SIGTERM), 143),
    "HUP": (lambda p: os.kill(p.pid, signal.SIGHUP), 129),
    "INT of the group": (lambda p: os.killpg(p.pid, signal.SIGINT), 130),
    "TERM of the group": (lambda p: os.killpg(p.pid, signal.SIGTERM), 143),
    "TERM twice": (lambda p: [os.kill(p.pid, signal.SIGTERM) for _ in range(2)], 143),
    "CONT and TERM, as Slurm": (lambda p: [os.kill(p.pid, s) for s in (signal.SIGCONT, signal.SIGTERM)], 143),
    "KILL": (lambda p: p.kill(), None),
    "KILL of the group": (lambda p: os.killpg(p.pid, signal.SIGKILL), None),
}
INSTANTS = {
    "at once": lambda out: True,
    "begun": lambda out: (out / ".run/lock").exists(),
    "recorded": lambda out: (out / ".run/checksums.json").exists(),
    "writing the first": lambda out: bool(temporaries(out)),
    "between": lambda out: any((out / name).is_dir() for name in NAMES),
    "the last": lambda out: sum((out / name).is_dir() for name in NAMES) >= len(NAMES) - 1,
}
QUICK = [("INT", "writing the first", 0), ("TERM", "between", 2), ("KILL of the group", "recorded", 0)]
ALL = [(stop, instant, workers) for stop in STOPS for instant in INSTANTS for workers in (0, 3)]
CASES = [*QUICK, *(pytest.param(*case, marks=pytest.mark.slow) for case in ALL if case not in QUICK)]


@pytest.mark.parametrize("stop, instant, workers", CASES)
def test_generate(reference, tmp_path, stop, instant, workers):
    recipe, out = recipe_file(tmp_path), tmp_path / "out"
    line = [*BLINKGL, "generate", str(recipe), "--out", str(out), "--resume"]
    line += ["--workers", str(workers)] if workers else []
    process, (act, status) = started(line), STOPS[stop]
    wait_for(lambda: INSTANTS[instant](out) or process.poll() is not None)
    ended = process.poll() is not None
    if not ended:
        act(process)
    _, said = process.communicate()
    wait_for(lambda: not mine(str(out)))
    assert "Traceback" not in said, said
    if status is not None and process.returncode != 0:
        stopped = [text for text in said.splitlines() if "compil" not in text]
        # Before the first line of Python there is nobody to say it.
        lines = (["interrupted; --resume continues"], *([["interrupted"], []] if instant == "at once" else []))
        assert process.returncode in (status, status - 128 - 2 * (status - 128)) and stopped in lines, said
        assert instant == "at once" or (process.returncode, stopped) == (status, lines[0])
        assert not temporaries(out)
    assert run(line[len(BLINKGL) :] + ["--quiet"]) == 0
    assert_same(out, reference)


def test_from_a_terminal(reference, tmp_path):
    """Ctrl-C of a terminal reaches the driver alone: workers have sessions of their own."""
    recipe, out = recipe_file(tmp_path), tmp_path / "out"
    line = [*BLINKGL, "generate", str(recipe), "--out", str(out), "--workers", "2"]
    pid, terminal = pty.fork()
    if pid == 0:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.execv(line[0], line)
    said = b""
    pressed = False
    while True:
        try:
            data = os.read(terminal, 4096)
        except OSError:
            break
        if not data:
            break
        said += data
        if not pressed and any((out / name).is_dir() for name in NAMES):
            os.write(terminal, b"\x03")
            pressed = True
    _, status = os.waitpid(pid, 0)
    os.close(terminal)
    text = said.decode(errors="replace")
    assert os.waitstatus_to_exitcode(status) == 130 and text.count("interrupted; --resume continues") == 1, text
    assert "Traceback" not in text and not mine(str(out)) and not temporaries(out)
    assert run(["generate", str(recipe), "--out", str(out), "--resume", "--quiet"]) == 0
    assert_same(out, reference)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_simulate(tmp_path, number):
    """A command that cannot go on says so, and leaves no half file."""
    frames = tmp_path / "f.npy"
    np.save(frames, (np.random.default_rng(0).random((4000, 48, 64)) * 255).astype(np.uint8))
    line = [*BLINKGL, "simulate", str(frames), "--fps", "100", "--out", str(tmp_path / "e.h5")]
    process = started(line)
    wait_for(lambda: list(tmp_path.glob(".e.h5.*")) or process.poll() is not None)
    os.kill(process.pid, number)
    _, said = process.communicate()
    assert (process.returncode, said.splitlines()[-1]) == (128 + number, "interrupted"), said
    assert sorted(p.name for p in tmp_path.iterdir()) == ["f.npy"] and not mine(str(tmp_path))


def compiles(line: list[str], folder: Path) -> tuple[subprocess.Popen, str]:
    """The command with an empty folder for kernels, when it says that it compiles; and what it said before."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
    pipe = subprocess.PIPE
    process = subprocess.Popen(
        line,
        stdout=pipe,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment,
        preexec_fn=foreground,  # noqa: PLW1509
    )
    said = ""
    while "compiling the kernels that this needs" not in said:
        said += (text := process.stdout.readline())
        assert text, said
    return process, said


@pytest.mark.parametrize("kernels_again", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "act, workers, status",
    [
        (lambda p: os.kill(p.pid, signal.SIGTERM), 0, 143),
        pytest.param(lambda p: os.kill(p.pid, signal.SIGTERM), 2, 143, marks=pytest.mark.slow),
        pytest.param(lambda p: os.killpg(p.pid, signal.SIGTERM), 2, 143, marks=pytest.mark.slow),
        pytest.param(lambda p: os.kill(p.pid, signal.SIGINT), 0, 130, marks=pytest.mark.slow),
    ],
    ids=["TERM", "TERM with workers", "TERM of the group", "INT"],
)
def test_generate_while_it_compiles(reference, tmp_path, act, workers, status, kernels_again):
    """The same line goes on: with the kernels that were begun (minutes), or with those of this machine."""
    recipe, out = recipe_file(tmp_path), tmp_path / "out"
    line = [*BLINKGL, "generate", str(recipe), "--out", str(out), "--resume"]
    line += ["--workers", str(workers)] if workers else []
    process, _ = compiles(line, tmp_path / "kernels")
    act(process)
    rest = process.communicate()[0]
    wait_for(lambda: not mine(str(tmp_path)))
    said = [text for text in rest.splitlines() if "compil" not in text]
    assert (process.returncode, said) == (status, ["interrupted; --resume continues"]), rest
    assert not any((out / name).is_dir() for name in NAMES) and not temporaries(out)
    if kernels_again:
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
        done = subprocess.run([*line, "--quiet"], env=environment, capture_output=True, text=True)
        assert done.returncode == 0 and not done.stderr, done.stderr
    else:
        assert run(line[len(BLINKGL) :] + ["--quiet"]) == 0
    assert_same(out, reference)


def test_simulate_while_it_compiles(tmp_path):
    frames = tmp_path / "f.npy"
    np.save(frames, (np.random.default_rng(0).random((20, 48, 64)) * 255).astype(np.uint8))
    line = ["simulate", str(frames), "--fps", "100", "--out"]
    process, _ = compiles([*BLINKGL, *line, str(tmp_path / "e.h5")], tmp_path / "kernels")
    os.kill(process.pid, signal.SIGTERM)
    rest = process.communicate()[0]
    wait_for(lambda: not mine(str(tmp_path)))
    said = [text for text in rest.splitlines() if "compil" not in text]
    assert (process.returncode, said) == (143, ["interrupted"]), rest
    assert sorted(p.name for p in tmp_path.iterdir()) == ["f.npy", "kernels"]
    assert run([*line, str(tmp_path / "e.h5")]) == 0 == run([*line, str(tmp_path / "again.h5")])
    assert (tmp_path / "e.h5").read_bytes() == (tmp_path / "again.h5").read_bytes()


@pytest.mark.parametrize("lock", ["", "process 1 of a dead machine"])
def test_a_clock_that_jumps_back_and_the_lock_of_a_dead_machine(reference, tmp_path, monkeypatch, lock):
    """Each look at the clock is a day before the last one, what was written is of the future, and the lock file of the
    machine that died is still there: the run goes on with what it has, to the same bytes."""
    recipe, out = recipe_file(tmp_path), tmp_path / "out"
    now = [2_000_000_000.0]

    def back() -> float:
        now[0] -= 86400
        return now[0]

    monkeypatch.setattr(time, "time", back)
    monkeypatch.setattr(time, "time_ns", lambda: int(back() * 1e9))
    if lock:
        (out / ".run").mkdir(parents=True)
        (out / ".run/lock").write_text(lock)

    def stop(name: str, message: dict) -> bool:
        if sum((out / one).is_dir() for one in NAMES) < 2:
            return False
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_dataset(load_run(recipe), out, listener=Listener(stop, "done"), resume=True)
    whole = [name for name in NAMES if (out / name).is_dir()]
    assert 2 <= len(whole) < len(NAMES)
    for path in out.rglob("*"):
        os.utime(path, (4e9, 4e9))
    before = {name: (out / name / "manifest.json").stat().st_ino for name in whole}
    if lock:
        (out / ".run/lock").write_text(lock)
    assert run(["generate", str(recipe), "--out", str(out), "--resume", "--quiet"]) == 0
    assert {name: (out / name / "manifest.json").stat().st_ino for name in whole} == before
    assert not (out / ".run/lock").exists()
    assert_same(out, reference)
    assert run(["verify", str(out)]) == 0


# ---- what is imported ------------------------------------------------------------------------------------------------

SPY = "import os\nopen(os.environ['SPY'], 'a').write(__name__ + '\\n')\n"
"""A module of the user's folder under the name of one of the standard library's."""


@pytest.mark.parametrize("how", ["workers", "online loader", pytest.param("ray", marks=pytest.mark.slow)])
def test_workers_import_nothing_of_the_users_folder(tmp_path, how):
    if how == "ray":
        pytest.importorskip("ray", reason="Ray is not installed (extra [cluster])")
    here = tmp_path / "unpacked"
    here.mkdir()
    for name in ("queue", "statistics", "secrets", "colorsys"):
        (here / f"{name}.py").write_text(SPY)
    recipe = recipe_file(here)
    script = tmp_path / "script.py"
    script.write_text(
        "import blinkgl, sys\nif __name__ == '__main__':\n"
        f"    with blinkgl.OnlineSequences({str(recipe)!r}, workers=1) as samples:\n        next(iter(samples))\n"
    )
    generate = [*BLINKGL, "generate", "recipe.yaml", "--out", "out", "--num", "1", "--workers", "1", "--quiet"]
    words = {
        "workers": generate,
        "ray": [*generate, "--executor", "ray"],
        "online loader": [sys.executable, "-P", str(script)],
    }
    environment = {**os.environ, "SPY": str(tmp_path / "spy")}
    done = subprocess.run(words[how], cwd=here, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "spy").exists(), (tmp_path / "spy").read_text()


def test_no_program_of_ours_is_started_with_the_users_folder():
    root = Path(__file__).parents[2]
    bare = re.compile(r'sys\.executable,\s*"-m",\s*"?(blinkgl|eflow|module)')
    for path in (p for folder in ("blinkgl", "eflow", "tools") for p in (root / folder).rglob("*.py")):
        if path.name != "fingerprint.py":  # of the checkout that it stands in
            assert not bare.search(path.read_text()), path
