"""The fuzz of file formats: a short seeded run, and that it tells defects from refusals."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from blinkgl.errors import AssetError
from blinkgl.tools import fuzz

SHORT = ("e.txt", "e.h5", "e.npz", "e.raw", "flow.png", "flow.flo", "0.pfm", "frames.npy", "mesh.ply", "run.yaml")


def test_no_format_has_a_defect():
    """In a process of its own: this one has threads, which cannot be forked."""
    command = [sys.executable, "-m", "blinkgl.tools.fuzz", *SHORT, "--mutants", "12", "--seed", "3"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(" 0 defects") == len(SHORT)


def _bug(_):
    raise ZeroDivisionError


def _refuse(_):
    raise AssetError("not whole", where="a")


def _lines(_):
    raise PermissionError("two\nlines")


@pytest.mark.parametrize(
    "read, outcome",
    [
        (lambda _: None, fuzz.READ),
        (_refuse, fuzz.REFUSED),
        (_bug, "ZeroDivisionError at test_fuzz_tool.py"),
        (_lines, "several lines"),
        (lambda _: os.kill(os.getpid(), signal.SIGSEGV), "the process ends with status -11"),
        (lambda _: os._exit(0), "the process ends with status 0"),
        (lambda _: signal.pause(), "hangs"),
    ],
)
def test_outcomes_are_told_apart(read, outcome, tmp_path, monkeypatch):
    monkeypatch.setattr(fuzz, "WALL_S", 1.0)
    assert fuzz.in_a_process(read, tmp_path).startswith(outcome)


def test_the_same_seed_makes_the_same_mutants():
    whole = bytes(range(256)) * 4
    mutants = [fuzz.mutant("e.raw", whole, 0, k) for k in range(40)]
    assert mutants == [fuzz.mutant("e.raw", whole, 0, k) for k in range(40)]
    assert len(set(mutants)) > 35
