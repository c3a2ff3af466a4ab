"""A file of the user's own, from the command line: what it registers reaches commands, workers and verify."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from blinkgl import open_events

MINE = Path(__file__).parents[1] / "examples/plugins"


def command(folder: Path, *words: str) -> tuple[int, str]:
    environment = {k: v for k, v in os.environ.items() if k != "BLINKGL_PLUGINS"}
    done = subprocess.run(
        [sys.executable, "-m", "blinkgl", *words], cwd=folder, env=environment, capture_output=True, text=True
    )
    return done.returncode, done.stdout + done.stderr


def test_four_parts_of_ones_own_reach_everything(tmp_path):
    """The file of docs/extending.md: emulator, label, primitive and event format, in commands, workers and verify; its
    folder has a character that separates paths elsewhere."""
    tmp_path = tmp_path / "of a:b"
    tmp_path.mkdir()
    shutil.copy(MINE / "mine.py", tmp_path)
    small = ["--set", "camera.width=48", "--set", "camera.height=36", "--set", "output.sequences=2"]
    run = ["generate", str(MINE / "mine.yaml"), "--out", "set", *small]
    status, said = command(tmp_path, *run)
    assert status == 2 and "unknown" in said and not (tmp_path / "set").exists()
    status, said = command(tmp_path, "--plugin", "mine.py", *run, "--workers", "2")
    assert status == 0, said
    (folder, _) = sorted(path.parent for path in (tmp_path / "set").glob("*/*/manifest.json"))
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["emulator"] == "toy" and len(manifest["versions"]["plug-in mine"]) == 16
    height = np.load(min((folder / "height").glob("*.npy")))
    assert 0.5 < height.max() < 0.6001 and height.min() == 0, "of the ramp, world units"
    status, said = command(tmp_path, "--plugin", "mine.py", "verify", "set", "--deep")
    assert status == 0 and "serializ" not in said, said
    status, said = command(tmp_path, "verify", "set")
    assert status == 2 and "made with the plug-in mine (sha256" in said and "--plugin FILE" in said
    converts = ["--plugin", "mine.py", "convert"]
    assert command(tmp_path, *converts, str(folder / "events.h5"), "e.nine")[0] == 0
    assert command(tmp_path, *converts, "e.nine", "back.h5")[0] == 0
    there, here = (open_events(path).read() for path in (folder / "events.h5", tmp_path / "back.h5"))
    assert len(there) > 300 and all(np.array_equal(getattr(there, k), getattr(here, k)) for k in "xytp")
    (tmp_path / "e.nine").write_bytes((tmp_path / "e.nine").read_bytes() + b"x")
    status, said = command(tmp_path, *converts, "e.nine", "back.h5")
    assert status == 2 and "truncated" in said
    (tmp_path / "mine.py").write_text((tmp_path / "mine.py").read_text() + "\n# another\n")
    status, said = command(tmp_path, "--plugin", "mine.py", "verify", "set")
    assert status == 2 and "which differs here" in said
    np.save(tmp_path / "frames.npy", (np.random.default_rng(0).random((6, 24, 32)) * 255).astype(np.uint8))
    simulate = ["--plugin", "mine.py", "simulate", "frames.npy", "--fps", "30", "--emulator", "toy", "-o", "s.nine"]
    assert command(tmp_path, *simulate)[0] == 0


def test_a_label_of_ones_own_agrees_with_its_reference(tmp_path):
    here = ["--plugin", str(MINE / "mine.py"), "shader", "diff", str(MINE / "mine.yaml"), "--time", "0.1"]
    status, said = command(tmp_path, *here, "--pass", "height", "--out", "diff")
    assert status == 0 and "agrees with the reference" in said


def test_nodes_of_ray_load_the_file(tmp_path):
    pytest.importorskip("ray")
    small = ["--set", "camera.width=48", "--set", "camera.height=36", "--num", "2", "--workers", "2"]
    words = ["generate", str(MINE / "mine.yaml"), "--out", "set", *small, "--executor", "ray"]
    status, said = command(tmp_path, "--plugin", str(MINE / "mine.py"), *words)
    assert status == 0, said


EMULATOR = (
    "from blinkgl.events import register\nfrom blinkgl.events.esim import Esim\nclass Other(Esim): ...\nregister(Other)"
)
FORMAT = "from blinkgl.io.formats import FORMATS, register\nregister(FORMATS['evt3'])"
PRIMITIVE = "from blinkgl.scene.geometry.primitives import register\n@register\ndef cuboid(a: float = 1.0): ..."
LAYOUT = "from blinkgl.layouts.export import LAYOUTS, register\nregister(LAYOUTS['dsec'])"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "--plugin: no such file (got "),
        ("1 / 0", "mine.py: the plug-in fails (got 'ZeroDivisionError: division by zero')"),
        ("def", "mine.py: the plug-in fails (got 'SyntaxError: "),
        ("import mine_again", "ModuleNotFoundError"),
        (EMULATOR, "TypeError: emulator 'esim': there is one already, Esim"),
        (FORMAT, "TypeError: event format 'evt3': there is one already"),
        (PRIMITIVE, "TypeError: primitive 'cuboid': there is one already"),
        (LAYOUT, "TypeError: layout 'dsec': there is one already"),
    ],
)
def test_one_that_cannot_be_loaded_is_a_line(tmp_path, text, said):
    if text is not None:
        (tmp_path / "mine.py").write_text(text)
    status, line = command(tmp_path, "--plugin", "mine.py", "configs")
    assert status == 2 and said in line and line.startswith("error: ") and line.count("\n") == 1
