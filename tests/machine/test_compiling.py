"""Compiling kernels is told by itself and is in nobody's seconds."""

import os
import subprocess
import sys
from dataclasses import replace

import numba
import numpy as np
import pytest
from rich.console import Console

from blinkgl.dataset.report import SequenceReport
from blinkgl.dataset.run import Outcome
from blinkgl.machine import compiling
from blinkgl.sequence.clock import StageClock
from blinkgl.show.generate import show_outcome


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
    report = SequenceReport(0, tmp_path / "a", simulated_s=1.0, total_s=6.7, seconds={"events": 1.0})
    for compiled in (14.2, 0.0):
        outcome = Outcome(planned=1)
        outcome.made.add(replace(report, compile_s=compiled))
        show_outcome(Console(width=100), outcome, tmp_path)
        out = capsys.readouterr().out
        assert ("compiling kernels, once per machine: 14 s\n" in out) == (compiled > 0) and "6.70 s" in out


@pytest.mark.slow
def test_a_cold_and_a_warm_simulate(tmp_path):
    """The first says what it compiled; the second finds it on disk."""
    np.save(tmp_path / "f.npy", np.random.default_rng(0).integers(0, 255, (3, 8, 8), np.uint8))
    said = []
    for _ in range(2):
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "blinkgl.cli",
                "simulate",
                str(tmp_path / "f.npy"),
                "--fps",
                "100",
                "--overwrite",
                "-o",
                str(tmp_path / "e.npz"),
            ],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")},
        )
        said.append("compiling kernels, once per machine: " in done.stdout)
    assert said == [True, False]
