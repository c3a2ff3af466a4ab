"""Without what POSIX systems alone have: one process makes data sets, more are refused in one line."""

import subprocess
import sys

import pytest
import yaml

from tests.tiny_recipe import TINY

WITHOUT = """
import sys
for name in ("fcntl", "resource", "termios", "pwd", "grp"):
    sys.modules[name] = None  # as if it were not there: importing it raises ImportError
from blinkgl.cli import run
sys.exit(run(sys.argv[1:]))
"""


def without_posix(*arguments: object) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", WITHOUT, *map(str, arguments)], capture_output=True, text=True, check=False
    )


@pytest.fixture
def recipe(tmp_path):
    path = tmp_path / "tiny.yaml"
    path.write_text(yaml.safe_dump(TINY))
    return path


def test_one_process_makes_a_data_set_and_looks_through_it(tmp_path, recipe):
    out = tmp_path / "out"
    for arguments in (["generate", recipe, "--out", out, "--quiet"], ["verify", out], ["report", out]):
        made = without_posix(*arguments)
        assert made.returncode == 0, made.stderr
    assert (out / "report.html").is_file()


def test_worker_processes_are_refused(tmp_path, recipe):
    made = without_posix("generate", recipe, "--out", tmp_path / "out", "--workers", 2)
    assert made.returncode == 2 and not (tmp_path / "out").exists()
    assert made.stderr == (
        "error: --workers: worker processes need a POSIX system (got 2); expected none: this process alone\n"
    )
