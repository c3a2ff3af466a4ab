"""What reads, converts, checks or learns needs neither OpenGL nor the libraries of scenes and plots: each command runs
in a process where importing them fails."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from tiny_recipe import TINY

from blinkgl.config.run import load_run
from blinkgl.dataset.run import run_dataset
from blinkgl.io.formats import write_events
from blinkgl.types.events import Events

GUARD = """
import sys
class Forbidden:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"moderngl", "glcontext", "trimesh", "fcl", "skimage", "mujoco", "matplotlib"}:
            raise ImportError(f"{name} is forbidden here")
sys.meta_path.insert(0, Forbidden())
"""


@pytest.fixture(scope="module")
def there(tmp_path_factory) -> Path:
    """A data set, frames, and recordings of a moving and a still scene."""
    folder = tmp_path_factory.mktemp("light")
    (folder / "guard").mkdir()
    (folder / "guard/sitecustomize.py").write_text(GUARD)
    labels = {"flow": ["forward"], "images": True, "depth": True}
    (folder / "recipe.yaml").write_text(yaml.safe_dump({**TINY, "labels": labels}))
    run_dataset(load_run(folder / "recipe.yaml"), folder / "set")
    rng = np.random.default_rng(0)
    np.save(folder / "frames.npy", (rng.random((6, 48, 64)) * 255).astype(np.uint8))
    t = np.sort(rng.integers(0, 400_000, 20_000))
    x, y = (rng.integers(0, size, 20_000).astype(np.uint16) for size in (64, 48))
    write_events(folder / "e.npz", Events(x, y, t, rng.integers(0, 2, 20_000).astype(np.uint8)), 48, 64)
    return folder


@pytest.mark.parametrize(
    "words",
    [
        "blinkgl simulate frames.npy --fps 30 -o made.h5",
        "blinkgl convert e.npz made.raw",
        "blinkgl compare e.npz e.npz",
        "-c import blinkgl.recordings.calibration, blinkgl.show.calibrate",  # its page of plots needs them
        "blinkgl verify set",
        "blinkgl report set -o made.html",
        "blinkgl export set -o shards",
        "blinkgl export set -o dsec --layout dsec",
        "blinkgl view set --save view.html",
        "blinkgl configs",
        "eflow predict real_small e.npz --window-ms 100",
        "eflow evaluate real_small set",
        "eflow models",
    ],
)
def test_a_command_runs_without_opengl_and_plots(there, words):
    module, *rest = words.split(" ", 1) if words.startswith("-c") else words.split()
    needs = {"eflow": "torch", "view": "viser"}
    for name in (module, rest[0]):
        if importlib.util.find_spec(needs.get(name, "numpy")) is None:
            pytest.skip(f"{needs[name]} is not installed")
    paths = os.pathsep.join([str(there / "guard"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, *([] if module == "-c" else ["-m"]), f"{module}.cli" if module == "eflow" else module, *rest],
        cwd=there,
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
