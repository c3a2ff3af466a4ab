"""Compiling kernels is told by itself and is in nobody's seconds."""

import os
import subprocess
import sys

import numba
import numpy as np
from rich.console import Console

from blinkgl import compiling
from blinkgl.dataset.clock import StageClock
from blinkgl.dataset.report import SequenceReport
from blinkgl.dataset.run import Outcome
from blinkgl.dataset.show import show_outcome


def test_compilation_is_counted_once():
    @numba.njit
    def inner(x):
        return x + 1

    @numba.njit
    def outer(x):
        return inner(x) * 2

    before = compiling.compiled_s()
    assert outer(3) == 8
    took = compiling.compiled_s() - before
    assert took > 0, "both, the inner one once"
    outer(4)
    assert compiling.compiled_s() == before + took, "compiled already"


def test_stages_and_total_are_without_compilation(monkeypatch):
    now = [10.0]
    monkeypatch.setattr(compiling.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(compiling, "_watch", watch := compiling._Watch())
    clock = StageClock()
    with clock("events"):
        now[0] += 1.0
        watch.on_start(None)
        watch.on_start(None)
        now[0] += 14.0
        watch.on_end(None)
        watch.on_end(None)
        now[0] += 0.5
    assert clock.seconds == {"events": 1.5} and clock.total == 1.5 and clock.compile_s == 14.0


def test_it_has_a_line_of_its_own(tmp_path, capsys):
    report = SequenceReport(0, tmp_path / "a", simulated_s=1.0, total_s=6.7, compile_s=14.2, seconds={"events": 1.0})
    outcome = _outcome(report)
    show_outcome(Console(width=100), outcome, tmp_path)
    out = capsys.readouterr().out
    assert "compiling kernels, once per machine: 14 s\n" in out and "6.70 s" in out
    report.compile_s = 0.0
    show_outcome(Console(width=100), outcome, tmp_path)
    assert "compiling" not in capsys.readouterr().out


def _outcome(report):
    outcome = Outcome.__new__(Outcome)
    outcome.made, outcome.set_aside, outcome.elapsed_s, outcome.found, outcome.planned = [report], {}, 21.0, 0, 1
    return outcome


def test_a_cold_and_a_warm_simulate(tmp_path):
    """The first says what it compiled; the second finds it on disk."""
    np.save(tmp_path / "f.npy", np.random.default_rng(0).integers(0, 255, (3, 8, 8), np.uint8))
    said = []
    for _ in range(2):
        done = subprocess.run([sys.executable, "-m", "blinkgl.cli", "simulate", str(tmp_path / "f.npy"), "--fps", "100", "--overwrite",
                               "-o", str(tmp_path / "e.npz")], capture_output=True, text=True, check=True,
                              env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")})
        said.append("compiling kernels, once per machine: " in done.stdout)
    assert said == [True, False]
