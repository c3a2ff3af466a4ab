"""Blender's own importer of glTF beside BlinkGL's: where each vertex of a skinned, morphed, animated file is at given
times.

Needs the extra [cycles] (:mod:`blinkgl.blender.process`). Between two key frames Blender blends quaternions linearly,
the standard asks for the arc: compare at :func:`key_times`.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np

from blinkgl.blender.process import Blender, how_it_ended, interpreter
from blinkgl.errors import BlinkGLError
from blinkgl.scene.importing import gltf

WORKER = Path(__file__).with_name("gltf_worker.py")


def key_times(path: Path, count: int, animation: int = 0) -> np.ndarray:
    """``count`` times (s) at which a channel of the animation has a key, evenly chosen from the first to the one before
    the last. (At the last one a channel of steps jumps, and float32 frames lie on either side of it.)"""
    document = gltf.read(path)
    samplers = document.tree["animations"][animation]["samplers"]
    every = np.unique(np.concatenate([document.accessor(s["input"]).astype(np.float64).ravel() for s in samplers]))
    return every[np.unique(np.linspace(0, max(len(every) - 2, 0), count).round().astype(int))]


def play(path: Path, times: np.ndarray) -> np.ndarray:
    """(T, V, 3) float64, z up: the vertices that Blender shows at each time (s), meshes in the order of their names.
    Raises BlinkGLError when there is no Blender, or when it stops."""
    steps = np.diff(times)
    fps = int(np.clip(round(1 / steps.min()), 24, 1000)) if len(steps) and steps.min() > 0 else 24
    job = {"file": str(Path(path).absolute()), "times": [float(t) for t in times], "fps": fps}
    with tempfile.TemporaryDirectory(prefix="blinkgl-gltf-") as name:
        folder = Path(name)
        (folder / "job.json").write_text(json.dumps(job))
        with Blender(WORKER, folder) as blender:
            for _ in blender.answers():
                pass
            status = blender.status()
            if status or not (folder / "played.npy").is_file():
                raise BlinkGLError(
                    f"Blender {how_it_ended(status)} while {blender.doing}: {blender.last_words()}", where=interpreter()
                )
        return np.load(folder / "played.npy", allow_pickle=False)
