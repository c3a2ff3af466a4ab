"""Rigged figures that others made, against Blender's own importer: vertices at twenty times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from shared_data import shared

import played
from blinkgl.blender import process
from blinkgl.camera import PinHole
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.motion.trajectories import look_rotation
from blinkgl.scene.worlds.from_file import from_gltf
from gltf_at import Played

pytestmark = pytest.mark.skipif(bool(process.available()), reason=process.available() or "there")
NS = 1_000_000_000
FIGURES = ["running", "cheering", "push_ups"]
CAMERA = PinHole.centred(160, 120, 150.0)
POSE = np.eye(4)
POSE[:3, 3] = (3.0, -4.0, 1.6)
POSE[:3, :3] = look_rotation(np.array([0.0, 0.0, 1.0]) - POSE[:3, 3])


@pytest.fixture(scope="module")
def theirs():
    """``theirs(figure)``: (path, times, what Blender makes of it), each once."""
    kept: dict = {}

    def get(figure: str):
        if figure not in kept:
            path = shared(f"data/assets/characters/mannequin_{figure}.glb")
            times = played.key_times(path, 20)
            kept[figure] = path, times, played.play(path, times)
        return kept[figure]

    return get


def apart(ours: np.ndarray, true: np.ndarray) -> float:
    """Largest distance of a vertex (T, V, 3) from the one of (T, W, 3) that moves most like it: vertices that lie in
    one place at one time need not do so at another."""
    flat = [np.moveaxis(points, 1, 0).reshape(points.shape[1], -1) for points in (ours, true)]
    pairs = cKDTree(flat[1]).query(flat[0])[1]
    return float(np.linalg.norm(ours - true[:, pairs], axis=2).max())


def scene_of(path: Path, times: np.ndarray):
    end = round(times[-1] * NS)
    return from_gltf(path, CAMERA, 0, end, camera_path=StaticPath(POSE, 0, end))


def drawn(path: Path, times: np.ndarray) -> np.ndarray:
    """(T, V, 3) by BlinkGL's importer."""
    scene, found = scene_of(path, times), []
    for t in times:
        t_ns, points = round(t * NS), []
        for thing in scene.objects:
            T = thing.path.pose(t_ns)
            for part in thing.parts:
                mesh = part.mesh
                at = mesh.vertices if mesh.deformer is None else mesh.deformer.positions(mesh, t_ns)
                points.append(at @ T[:3, :3].T + T[:3, 3])
        found.append(np.concatenate(points))
    return np.stack(found)


def judged(path: Path, times: np.ndarray) -> np.ndarray:
    """(T, V, 3) straight from the specification."""
    one = Played(path)
    nodes = [i for i, node in one.document.nodes.items() if node.mesh is not None]
    return np.stack([np.concatenate([one.of(i, t) for i in nodes]) for t in times])


@pytest.mark.parametrize("who", [judged, drawn])
@pytest.mark.parametrize("figure", FIGURES)
def test_vertices_are_where_blender_has_them(theirs, figure, who):
    path, times, true = theirs(figure)
    assert len(times) == 20 and true.shape[1] > 6000
    height = np.ptp(true[0, :, 2])
    ours = who(path, times)
    assert apart(ours, true) < 1e-5 * height and apart(true, ours) < 1e-5 * height
    assert np.ptp(true, axis=0).max() > 0.3 * height, "it moves"
