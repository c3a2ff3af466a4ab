"""Blender's own importer of glTF beside BlinkGL's: where each vertex of a skinned, morphed, animated file is at given
times, and which pixels a camera sees it in (by Cycles).

Needs the extra [cycles] (:mod:`blinkgl.blender.process`). Between two key frames Blender blends quaternions linearly,
the standard asks for the arc: compare at :func:`key_times`.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from blinkgl.blender.process import Blender, how_it_ended, interpreter
from blinkgl.camera import PinHole
from blinkgl.errors import BlinkGLError
from blinkgl.scene.importing import gltf
from blinkgl.trade.cycles import CV_FROM_BLENDER, blender_camera

WORKER = Path(__file__).with_name("gltf_worker.py")


@dataclass(frozen=True)
class Played:
    """positions : name of a mesh object -> (T, V, 3) float64, z up.   masks : (T, H, W) bool, without a camera (0,)."""

    positions: dict[str, np.ndarray]
    masks: np.ndarray

    def points(self) -> np.ndarray:
        """(T, all vertices, 3), in the order of the names."""
        return np.concatenate([self.positions[name] for name in sorted(self.positions)], axis=1)


def key_times(path: Path, count: int, animation: int = 0) -> np.ndarray:
    """``count`` times (s) at which a channel of the animation has a key, evenly chosen from the first to the one before
    the last. (At the last one a channel of steps jumps, and float32 frames lie on either side of it.)"""
    document = gltf.read(path)
    samplers = document.tree["animations"][animation]["samplers"]
    every = np.unique(np.concatenate([document.accessor(s["input"]).astype(np.float64).ravel() for s in samplers]))
    return every[np.unique(np.linspace(0, max(len(every) - 2, 0), count).round().astype(int))]


def play(path: Path, times: np.ndarray, camera: PinHole | None = None, T_world_cam: np.ndarray | None = None) -> Played:
    """What Blender makes of the file at each time (s). ``camera`` with its pose (4, 4), OpenCV axes in the z-up world:
    also silhouettes. Raises BlinkGLError when there is no Blender, or when it stops."""
    steps = np.diff(times)
    fps = int(np.clip(round(1 / steps.min()), 24, 1000)) if len(steps) and steps.min() > 0 else 24
    job: dict = {"file": str(Path(path).absolute()), "times": [float(t) for t in times], "fps": fps, "camera": None}
    if camera is not None:
        assert T_world_cam is not None
        job["camera"] = {
            "size": [camera.width, camera.height],
            "parameters": blender_camera(camera),
            "pose": (np.asarray(T_world_cam) @ CV_FROM_BLENDER).tolist(),
            "near": camera.near,
        }
    with tempfile.TemporaryDirectory(prefix="blinkgl-gltf-") as name:
        folder = Path(name)
        (folder / "job.json").write_text(json.dumps(job))
        with Blender(WORKER, folder) as blender:
            for _ in blender.answers():
                pass
            status = blender.status()
            if status or not (folder / "played.npz").is_file():
                raise BlinkGLError(
                    f"Blender {how_it_ended(status)} while {blender.doing}: {blender.last_words()}", where=interpreter()
                )
        with np.load(folder / "played.npz", allow_pickle=False) as stored:
            arrays = {key: stored[key] for key in stored.files}
    masks = arrays.pop("masks")
    return Played({key.partition(":")[2]: places for key, places in arrays.items()}, masks)
