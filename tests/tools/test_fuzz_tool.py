"""The fuzz of file formats: a short seeded run, and that it tells defects from refusals."""

from __future__ import annotations

import subprocess
import sys

SHORT = ("e.txt", "e.h5", "e.npz", "e.raw", "flow.png", "flow.flo", "0.pfm", "frames.npy", "mesh.ply", "run.yaml")


def test_no_format_has_a_defect():
    """In a process of its own: this one has threads, which cannot be forked."""
    command = [sys.executable, "-m", "blinkgl.tools.fuzz", *SHORT, "--mutants", "12", "--seed", "3"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(" 0 defects") == len(SHORT)
