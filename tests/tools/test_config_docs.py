"""The pages of keys say what the models say, the page of commands what the commands say."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from pinned import only_with_pinned

from blinkgl.config import draw
from blinkgl.config.reader import to_yaml
from blinkgl.errors import BlinkGLError
from blinkgl.tools import command_docs, fuzz_configurations
from blinkgl.tools.config_docs import eflow_page, page

PAGES = {
    "docs/configuration.md": (page, "python -m blinkgl.tools.config_docs"),
    "docs/eflow_configuration.md": (eflow_page, "python -m blinkgl.tools.config_docs eflow"),
    "docs/commands.md": (command_docs.page, "python -m blinkgl.tools.command_docs"),
}


@pytest.mark.parametrize("name", PAGES)
def test_the_page_is_up_to_date(name):
    only_with_pinned("typer", "pydantic")
    made, command = PAGES[name]
    written = (Path(__file__).parents[2] / name).read_text()
    assert written == made(), f"run: {command} > {name}"


def test_the_page_of_keys_lists_every_distribution():
    shown = re.findall(r"`\{(\w+):", page().partition("\n## ")[0])
    assert set(draw._KINDS) <= set(shown)


# --- The fuzz of file formats: a short seeded run, and that it tells defects from refusals.

SHORT = ("e.txt", "e.h5", "e.npz", "e.raw", "flow.png", "flow.flo", "0.pfm", "frames.npy", "mesh.ply", "run.yaml")


def test_no_format_has_a_defect():
    """In a process of its own: this one has threads, which cannot be forked."""
    command = [sys.executable, "-m", "blinkgl.tools.fuzz", *SHORT, "--mutants", "12", "--seed", "3"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(" 0 defects") == len(SHORT)


def test_configurations_that_are_drawn_run_or_are_one_line():
    """Generated, verified and looked at; of the thousand that `make fuzz` draws, a few."""
    command = [sys.executable, "-m", "blinkgl.tools.fuzz", "configurations", "--mutants", "6", "--seed", "5"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0 and " 0 defects" in done.stdout, done.stdout + done.stderr
    small = fuzz_configurations.SMALL
    drawn = [fuzz_configurations.drawn(0, k) for k in range(200)]
    changed = {key for tree in drawn for key in tree if tree[key] != small.get(key)}
    assert {"events", "labels", "scene", "timeline", "images", "camera", "time"} <= changed


def test_a_panorama_that_is_missing_is_one_line(tmp_path):
    """Found by a configuration that was drawn: it was read without a look at whether it is there."""
    scene = {**fuzz_configurations.SMALL["scene"], "sky": {"panoramas": ["no.hdr"]}}
    (tmp_path / "run.yaml").write_text(to_yaml({**fuzz_configurations.SMALL, "scene": scene}))
    with pytest.raises(BlinkGLError, match=r"no.hdr: cannot read the panorama: No such file"):
        fuzz_configurations.check(tmp_path / "run.yaml")
