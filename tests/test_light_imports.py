"""What reads, converts, checks or learns needs neither OpenGL nor the libraries of scenes and plots; what packs nothing
by Blosc and writes no video needs neither hdf5plugin nor PyAV: the commands run one after the other in a process where
importing them fails."""

import functools
import importlib.util
import os
from pathlib import Path

import numpy as np
import pytest
import yaml
from apart import run_apart
from tiny_recipe import TINY

from blinkgl.config.run import load_run
from blinkgl.dataset.run import run_dataset
from blinkgl.io.formats import write_events
from blinkgl.types.events import Events

SCENES = {"moderngl", "glcontext", "trimesh", "fcl", "skimage", "mujoco", "matplotlib"}
CODECS = {"hdf5plugin", "av", "imageio", "imageio_ffmpeg", "tifffile", "lxml", "mapbox_earcut", "mujoco"}
"""What does not fit beside a card (tools/gpu_wheels.txt), and what is not needed there."""
GUARD = """
import importlib.metadata, sys
class Forbidden:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in FORBIDDEN:
            raise ModuleNotFoundError(f"{name} is forbidden here")
sys.meta_path.insert(0, Forbidden())
def version(name, installed=importlib.metadata.version):
    if name in FORBIDDEN:
        raise importlib.metadata.PackageNotFoundError(name)
    return installed(name)
importlib.metadata.version = version
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


@pytest.fixture(scope="module")
def ran(there):
    """``ran(guard, words)``: exit status and text of a command in ``there`` where the modules of this guard cannot be
    imported."""

    @functools.cache
    def all_of(guard: str) -> dict[str, tuple[int, str]]:
        paths = os.pathsep.join([str(there / guard), os.environ.get("PYTHONPATH", "")])
        listed = [words for words in COMMANDS[guard] if not lacking(words)]
        split = [words.split(" ", 1) if words.startswith("-c") else words.split() for words in listed]
        return dict(zip(listed, run_apart(split, there, PYTHONPATH=paths), strict=True))

    def one(guard: str, words: str) -> tuple[int, str]:
        if lacking(words):
            pytest.skip(f"{lacking(words)} is not installed")
        return all_of(guard)[words]

    return one


def lacking(words: str) -> str | None:
    """What the command needs and is not installed."""
    needs = {"eflow": "torch", "view": "viser"}
    return next((needs[w] for w in words.split()[:2] if w in needs and not importlib.util.find_spec(needs[w])), None)


GZIP = "--set output.compression=gzip --set preview.enabled=false"
SHORT = "--set data.crop=[32,32] --set data.augment.scale_probability=0 --set optim.steps=2 --set run.device=cpu"
WITHOUT_SCENES = [
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
]
WITHOUT_CODECS = [
    f"blinkgl generate recipe.yaml --out gzip {GZIP}",
    f"blinkgl generate recipe.yaml --out gzip_by_workers --workers 1 {GZIP}",
    "-c import blinkgl.show.compile_kernels as kernels; kernels._of_a_sequence()",
    f"eflow train --model ev_flownet-tiny --data recipe.yaml --out trained {SHORT}",
]
REFUSED = {
    "blinkgl convert e.npz other.h5": "no Blosc for HDF5 (got 'zstd'); use pip install hdf5plugin, or in a recipe",
    "blinkgl convert packed.h5 other.npz": "packed.h5: compressed with an HDF5 filter that is not installed",
    "blinkgl generate recipe.yaml --out zstd": "use pip install hdf5plugin, or in a recipe output.compression: gzip",
}
COMMANDS = {"scenes": WITHOUT_SCENES, "codecs": [*WITHOUT_CODECS, *REFUSED]}


@pytest.mark.parametrize("words", WITHOUT_SCENES)
def test_a_command_runs_without_opengl_and_plots(ran, words):
    status, said = ran("scenes", words)
    assert status == 0, said


@pytest.mark.parametrize("words", WITHOUT_CODECS)
def test_a_command_runs_without_blosc_and_video(ran, words):
    status, said = ran("codecs", words)
    assert status == 0, said


def test_what_blosc_has_packed_says_what_is_missing(there, ran):
    for words, line in REFUSED.items():
        status, said = ran("codecs", words)
        assert status and line in said, said
    assert not (there / "other.h5").exists() and not list(there.glob("zstd/*/*"))
