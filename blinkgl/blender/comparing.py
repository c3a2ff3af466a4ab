"""Comparison of what a GLB plays with what Blender itself sees, at the times of ``inside/baking.sample``."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from blinkgl.camera import PinHole
from blinkgl.config.deform import AnimationConfig
from blinkgl.scene.importing import gltf
from blinkgl.scene.importing.animations import Animation, clip_names, play
from blinkgl.scene.importing.parts import Z_UP
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.types import SceneObject
from blinkgl.scene.worlds.from_file import from_document

AT_FRAMES, BETWEEN = 1e-4, 8e-4
"""Largest distances at frames and between frames, of a obj's size."""
MOST_PER_FRAME = 8
"""Largest number of key frames per frame of the whole scene; what needs more is baked alone."""
_NOTHING = 1e-6  # of its size: a obj that small is hidden

At = Callable[[int], np.ndarray]
"""Returns (V, 3) points in the world at one of the times."""
Difference = tuple[float, float]
"""Largest distance of something from where Blender has it, of its size, and the share of the times at which it is too
large."""


def compare(
    glb: Path, seen: Path | None, per: int = 1, finest: int = MOST_PER_FRAME
) -> tuple[dict[str, Difference], int, tuple[str, ...]]:
    """Return how ``glb``, which has ``per`` key frames per frame, differs from ``seen`` (None: from nothing):
    (differences by name; by how much more key frames per frame, up to ``finest``, would mend the figures that differ
    between frames only; lines of what is not drawn). Raises AssetError if it cannot be loaded."""
    document = gltf.read(glb, max_faces=1 << 31, max_texture=16384)
    clips = clip_names(document)
    shown = [node for node in document.nodes.values() if node.mesh is not None]
    if not shown:  # a clip for a figure of another file
        for index in range(len(clips)):
            document.tracks(index)
        return {}, 1, ()
    table = {"times": np.zeros(1)} if seen is None else dict(np.load(seen))
    t_ns = [round(1e9 * t) for t in table["times"]]
    still = StaticPath(np.eye(4), 0, t_ns[-1] + 1)
    scene = from_document(document, PinHole.centred(32, 32, 32.0), 0, t_ns[-1] + 1, camera_path=still)
    if seen is None:
        return {}, 1, scene.omissions
    theirs: dict[str, list[np.ndarray]] = {}
    objs = json.loads(str(table["things"]))
    for k, (name, _) in enumerate(objs):
        theirs.setdefault(name, []).append(table[f"arr_{k}"])
    ours, changing = _played(document, scene.objects, t_ns), {name for name, changes in objs if changes}
    morphs = ["targets" in mesh["primitives"][0] for mesh in document.tree["meshes"]]
    deforming = {node.name for node in shown if node.skin is not None or morphs[node.mesh or 0]}
    differs: dict[str, Difference] = {}
    denser = 1
    for name in sorted(theirs.keys() | ours.keys()):
        those, mine = theirs.get(name, []), ours.get(name, [])
        error = _distances(those, mine) if those and mine else np.ones(len(t_ns))
        at, between = (float(error[table["whole"] == whole].max(initial=0.0)) for whole in (True, False))
        # The error of straight lines goes down with the square of their number.
        factor = 2 ** math.ceil(math.log2(max(between / BETWEEN, 1.0)) / 2)
        other = name in changing or len(mine) > len(those)
        if name in deforming and factor * per <= min(finest, MOST_PER_FRAME) and at <= AT_FRAMES and not other:
            denser = max(denser, factor)
        elif other or at > AT_FRAMES or between > BETWEEN:
            share = float((error > np.where(table["whole"], AT_FRAMES, BETWEEN)).mean())
            differs[name] = max(at, between), share
    return differs, denser, scene.omissions


def _played(document: gltf.Document, objects: Sequence[SceneObject], t_ns: Sequence[int]) -> dict[str, list[At]]:
    """Return what the GLB plays, by name: surfaces and cameras."""
    names = {node.name for node in document.nodes.values()}
    ours: dict[str, list[At]] = {}
    # All at one time, since a skeleton keeps one time.
    poses = np.array([[made.path.pose(t) for made in objects] for t in t_ns])
    for k, made in enumerate(objects):
        name = made.name if made.name in names else made.name.rpartition("#")[0]
        ours.setdefault(name, []).append(partial(_surface, made, poses[:, k], t_ns))
    animation = play(document, AnimationConfig(loop=False), Path(), "animation") if clip_names(document) else None
    for index, node in document.nodes.items():
        if node.camera is not None:
            ours.setdefault(node.name, []).append(partial(_axes, document, index, animation, t_ns))
    return ours


def _surface(made: SceneObject, poses: np.ndarray, t_ns: Sequence[int], k: int) -> np.ndarray:
    shapes = [(part.mesh, part.mesh.deformer) for part in made.parts]
    points = [mesh.vertices if deformer is None else deformer.positions(mesh, t_ns[k]) for mesh, deformer in shapes]
    return np.concatenate(points) @ poses[k, :3, :3].T + poses[k, :3, 3]


def _axes(document: gltf.Document, node: int, animation: Animation | None, t_ns: Sequence[int], k: int) -> np.ndarray:
    moving = animation is not None and animation.skeleton.at(t_ns[k])[0][document.places[node]]
    world = Z_UP @ (document.world(node) if animation is None else moving)
    # The matrix's columns are the node's axes; here they are rows of length 1, without its scale.
    axes = world[:3, :3].T / np.linalg.norm(world[:3, :3], axis=0)[:, None]
    return world[:3, 3] + np.concatenate([np.zeros((1, 3)), axes])


def _distances(those: Sequence[np.ndarray], ours: Sequence[At]) -> np.ndarray:
    """Return (T,) the largest distance of a point of ``those`` from ``ours``, of its instance's size; 1 where only one
    of the two is seen.

    A point belongs to the vertex whose path over time is nearest, in a few random directions of all times together:
    one tree for all instances of a name."""
    sizes = np.stack([np.ptp(points, axis=1).max(axis=1) for points in those])  # (instances, T)
    largest = np.fmax.reduce(sizes, axis=1)[:, None]
    # A comparison with NaN is false, so that what is not there is hidden, too.
    hidden = ~(sizes > _NOTHING * largest)
    # Times at which all instances are seen, or else those at which the first one is.
    common = ~hidden.any(axis=0) if (~hidden.any(axis=0)).any() else ~hidden[0]
    directions = np.random.default_rng(0).normal(size=(sizes.shape[1], 3, 8)) * common[:, None, None]
    counts = [points.shape[1] for points in those]
    true = np.nan_to_num(np.concatenate(those, axis=1))
    played = [np.concatenate([at(k) for at in ours]).astype(np.float32) for k in range(sizes.shape[1])]
    tree = KDTree(sum(points @ way for points, way in zip(played, directions)))
    nearest = tree.query(sum(points @ way for points, way in zip(true, directions)))[1]
    starts = np.cumsum([0, *counts[:-1]])
    error = np.zeros(sizes.shape)
    for k, points in enumerate(played):
        off = np.abs(points[nearest] - true[k]).max(axis=1)
        # Of an instance that shrinks, at least a tenth of its largest size counts.
        scale = np.fmax(sizes[:, k], 0.1 * largest[:, 0])
        # What float32 loses far from the origin is no difference.
        rounding = 4e-7 * np.maximum.reduceat(np.abs(true[k]).max(axis=1), starts)
        error[:, k] = np.maximum(np.maximum.reduceat(off, starts) - rounding, 0) / scale
        low, high = np.minimum.reduceat(points[nearest], starts), np.maximum.reduceat(points[nearest], starts)
        # Shrunk to a point, ours is as good as hidden; hidden on one side only is an error of 1.
        gone = (high - low).max(axis=1) <= _NOTHING * largest[:, 0]
        error[:, k] = np.where(hidden[:, k] | gone, (hidden[:, k] != gone) * 1.0, error[:, k])
    return error.max(axis=0)
