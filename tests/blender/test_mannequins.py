"""Rigged figures that others made: vertices are where Blender's own importer of glTF has them.

``golden/mannequins.npz`` holds, of each figure, twenty times at which its clip has a key (s), its height (m) and where
150 vertices, drawn by lot, are at these times by Blender 4.5.15, (20, 150, 3) float32, z up. It was made once, by
``tests/blender/played.py`` of commit 152f2965.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from shared_data import shared

from blinkgl.camera import PinHole
from blinkgl.scene.importing import gltf
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.worlds.from_file import from_document

GOLDEN = np.load(Path(__file__).parents[1] / "golden" / "mannequins.npz")
NS = 1_000_000_000


def drawn(path: Path, times: np.ndarray) -> np.ndarray:
    """(T, V, 3) by BlinkGL's importer."""
    end, found = round(times[-1] * NS), []
    scene = from_document(
        gltf.read(path), PinHole.centred(160, 120, 150.0), 0, end, camera_path=StaticPath(np.eye(4), 0, end)
    )
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


@pytest.mark.parametrize("figure", ["running", "cheering", "push_ups"])
def test_vertices_are_where_blender_has_them(figure):
    """Each of Blender's vertices beside the one of ours that moves most like it: vertices that lie in one place at one
    time need not do so at another."""
    true, height = GOLDEN[figure].astype(float), float(GOLDEN[f"{figure}_height"])
    ours = drawn(shared(f"data/assets/characters/mannequin_{figure}.glb"), GOLDEN[f"{figure}_times"])
    paths = [np.moveaxis(points, 1, 0).reshape(points.shape[1], -1) for points in (ours, true)]
    nearest = cKDTree(paths[0]).query(paths[1])[1]
    assert np.linalg.norm(ours[:, nearest] - true, axis=2).max() < 1e-5 * height
    assert np.ptp(true, axis=0).max() > 0.3 * height, "it moves"
