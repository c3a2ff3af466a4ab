"""A file of the user's own, from the command line: what it registers reaches commands, workers and verify."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from tiny_recipe import TINY

PAGE = (Path(__file__).parents[1] / "docs/extending.md").read_text(encoding="utf-8")


def toy(folder: Path) -> Path:
    """The emulator of docs/extending.md, as a file."""
    section = PAGE.partition("\n## An emulator\n")[2].partition("\n## ")[0]
    path = folder / "mine.py"
    path.write_text(re.search(r"```python\n(.*?)```", section, re.S)[1])
    return path


def command(folder: Path, *words: str) -> tuple[int, str]:
    environment = {k: v for k, v in os.environ.items() if k != "BLINKGL_PLUGINS"}
    done = subprocess.run(
        [sys.executable, "-m", "blinkgl", *words], cwd=folder, env=environment, capture_output=True, text=True
    )
    return done.returncode, done.stdout + done.stderr


def test_an_emulator_of_ones_own_reaches_everything(tmp_path):
    toy(tmp_path)
    recipe = {**TINY, "events": {"emulator": "toy"}, "output": {"split": "train", "sequences": 2}}
    (tmp_path / "run.yaml").write_text(yaml.safe_dump(recipe))
    np.save(tmp_path / "frames.npy", (np.random.default_rng(0).random((6, 24, 32)) * 255).astype(np.uint8))
    status, said = command(tmp_path, "generate", "run.yaml", "--out", "set")
    assert status == 2 and "unknown" in said and not (tmp_path / "set").exists()
    status, said = command(tmp_path, "--plugin", "mine.py", "generate", "run.yaml", "--out", "set", "--workers", "2")
    assert status == 0, said
    (manifest, _) = sorted((tmp_path / "set").glob("*/*/manifest.json"))
    versions = json.loads(manifest.read_text())["versions"]
    assert len(versions["plug-in mine"]) == 16
    assert command(tmp_path, "--plugin", "mine.py", "verify", "set", "--deep")[0] == 0
    status, said = command(tmp_path, "verify", "set")
    assert status == 2 and "made with the plug-in mine (sha256" in said and "--plugin FILE" in said
    (tmp_path / "mine.py").write_text((tmp_path / "mine.py").read_text() + "\n# another\n")
    status, said = command(tmp_path, "--plugin", "mine.py", "verify", "set")
    assert status == 2 and "which differs here" in said
    simulate = ["--plugin", "mine.py", "simulate", "frames.npy", "--fps", "30", "--emulator", "toy", "-o", "e.h5"]
    assert command(tmp_path, *simulate)[0] == 0 and (tmp_path / "e.h5").is_file()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "--plugin: no such file (got "),
        ("1 / 0", "mine.py: the plug-in fails (got 'ZeroDivisionError: division by zero')"),
        ("def", "mine.py: the plug-in fails (got 'SyntaxError: "),
        ("TWICE", "TypeError: emulator 'toy': there is one already, Toy"),
    ],
)
def test_one_that_cannot_be_loaded_is_a_line(tmp_path, text, said):
    if text is not None:
        (tmp_path / "mine.py").write_text(text.replace("TWICE", 2 * (toy(tmp_path).read_text() + "\n")))
    status, line = command(tmp_path, "--plugin", "mine.py", "configs")
    assert status == 2 and said in line and line.startswith("error: ") and line.count("\n") == 1
