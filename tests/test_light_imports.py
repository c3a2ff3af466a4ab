"""What reads, converts, checks or learns needs neither OpenGL nor the libraries of scenes and plots; what packs nothing
by Blosc and writes no video needs neither hdf5plugin nor PyAV: each command runs in a process where importing them
fails."""

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

SCENES = {"moderngl", "glcontext", "trimesh", "fcl", "skimage", "mujoco", "matplotlib"}
CODECS = {"hdf5plugin", "av", "imageio", "imageio_ffmpeg", "tifffile", "lxml", "mapbox_earcut", "mujoco"}
"""What does not fit beside a card (tools/gpu_wheels.txt), and what is not needed there."""
GUARD = """
import sys
class Forbidden:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in FORBIDDEN:
            raise ModuleNotFoundError(f"{name} is forbidden here")
sys.meta_path.insert(0, Forbidden())
"""


@pytest.fixture(scope="module")
def there(tmp_path_factory) -> Path:
    """A data set, frames, and recordings of a moving and a still scene."""
    folder = tmp_path_factory.mktemp("light")
    for guard, names in {"scenes": SCENES, "codecs": CODECS}.items():
        (folder / guard).mkdir()
        (folder / guard / "sitecustomize.py").write_text(GUARD.replace("FORBIDDEN", repr(names)))
    labels = {"flow": ["forward"], "images": True, "depth": True}
    (folder / "recipe.yaml").write_text(yaml.safe_dump({**TINY, "labels": labels}))
    run_dataset(load_run(folder / "recipe.yaml"), folder / "set")
    rng = np.random.default_rng(0)
    np.save(folder / "frames.npy", (rng.random((6, 48, 64)) * 255).astype(np.uint8))
    t = np.sort(rng.integers(0, 400_000, 20_000))
    x, y = (rng.integers(0, size, 20_000).astype(np.uint16) for size in (64, 48))
    for name in ("e.npz", "packed.h5"):
        write_events(folder / name, Events(x, y, t, rng.integers(0, 2, 20_000).astype(np.uint8)), 48, 64)
    return folder


def ran(there: Path, guard: str, words: str) -> subprocess.CompletedProcess:
    """A command in ``there`` where the modules of this guard cannot be imported."""
    module, *rest = words.split(" ", 1) if words.startswith("-c") else words.split()
    needs = {"eflow": "torch", "view": "viser"}
    for name in (module, rest[0]):
        if importlib.util.find_spec(needs.get(name, "numpy")) is None:
            pytest.skip(f"{needs[name]} is not installed")
    paths = os.pathsep.join([str(there / guard), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [sys.executable, *([] if module == "-c" else ["-m"]), f"{module}.cli" if module == "eflow" else module, *rest],
        cwd=there,
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
    )


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
    done = ran(there, "scenes", words)
    assert done.returncode == 0, done.stderr


GZIP = "--set output.compression=gzip --set preview.enabled=false"
SHORT = "--set data.crop=[32,32] --set data.augment.scale_probability=0 --set optim.steps=2 --set run.device=cpu"


@pytest.mark.parametrize(
    "words",
    [
        f"blinkgl generate recipe.yaml --out gzip {GZIP}",
        f"blinkgl generate recipe.yaml --out gzip_by_workers --workers 1 {GZIP}",
        "-c import blinkgl.show.compile_kernels as kernels; kernels._of_a_sequence()",
        f"eflow train --model ev_flownet-tiny --data recipe.yaml --out trained {SHORT}",
    ],
)
def test_a_command_runs_without_blosc_and_video(there, words):
    done = ran(there, "codecs", words)
    assert done.returncode == 0, done.stderr


def test_what_blosc_has_packed_says_what_is_missing(there):
    for words, said in {
        "convert e.npz other.h5": "no Blosc for HDF5 (got 'zstd'); use pip install hdf5plugin, or in a recipe",
        "convert packed.h5 other.npz": "packed.h5: compressed with an HDF5 filter that is not installed",
        "generate recipe.yaml --out zstd": "use pip install hdf5plugin, or in a recipe output.compression: gzip",
    }.items():
        done = ran(there, "codecs", f"blinkgl {words}")
        assert done.returncode and said in done.stderr, done.stderr
    assert not (there / "other.h5").exists() and not list(there.glob("zstd/*/*"))
