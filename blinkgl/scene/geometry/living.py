"""Primitives with their own motion: people, cloth in wind, fish."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from blinkgl.config.deform import DeformConfig, FlagConfig
from blinkgl.errors import AssetError
from blinkgl.scene.geometry.figure import body_of
from blinkgl.scene.geometry.meshes import bounds, subdivided, weld
from blinkgl.scene.geometry.polygons import face_cross
from blinkgl.scene.geometry.primitives import Surface, join, lattice, primitive, square
from blinkgl.scene.shapes.closed_forms import Beat, Flag, Waves
from blinkgl.scene.shapes.gait import PARENTS, Proportions, clip_of
from blinkgl.scene.shapes.skeleton import Skeleton
from blinkgl.scene.shapes.skin import Skin
from blinkgl.scene.shapes.table import deformer_of
from blinkgl.scene.types import Deformer, Part


@primitive
def figure(
    height: float = 1.75,
    build: float = 1.0,
    legs: float = 1.0,
    arms: float = 1.0,
    head: float = 1.0,
    clip: str = "stand",
    variant: int = 0,
    tempo: float = 1.0,
    phase: float = 0.0,
    coat: int = 0,
    *,
    level: int = 0,
) -> tuple[Surface, Deformer]:
    """A person on z = 0, facing along x, who moves in place (an object's `way` moves it on). The texture is an atlas
    of the body's parts."""
    if height > 1000:
        raise AssetError("bad parameter", where="figure.height", value=height, accepted="a number up to 1000")
    proportions = Proportions(height, build, legs, arms, head)
    body = body_of(proportions, level)
    skeleton = Skeleton(PARENTS, clip_of(clip, proportions, tempo, phase, variant))
    skin = Skin(skeleton, range(len(PARENTS)), body.inverse_bind, body.joints, body.weights, where="figure")
    return (body.vertices, body.normals, body.uvs, body.faces), skin


@primitive
def flag(
    width: float = 1.5,
    height: float = 1.0,
    wind: float = 1.0,
    phase: float = 0.0,
    subdivisions: int = 40,
    coat: int = 0,
) -> tuple[Surface, Deformer]:
    """Cloth in wind, held at x = 0, along x and from z = 0 up, waving in y; the texture is mirrored on the back."""
    # Two sheets with a thin rim, so that the mesh is closed.
    thick = 0.004 * min(width, height)
    rows = max(round(subdivisions * height / width), 1)
    front = square((0, -thick, 0), (width, 0, 0), (0, 0, height), subdivisions, rows)
    back = square((width, thick, 0), (-width, 0, 0), (0, 0, height), subdivisions, rows)
    # The back shows the texture's mirror image, like translucent cloth.
    back[2][:, 0] = 1 - back[2][:, 0]
    rim = [
        square((0, thick, 0), (0, -2 * thick, 0), (0, 0, height), 1, rows),
        square((width, -thick, 0), (0, 2 * thick, 0), (0, 0, height), 1, rows),
        square((0, thick, 0), (width, 0, 0), (0, -2 * thick, 0), subdivisions, 1),
        square((0, -thick, height), (width, 0, 0), (0, 2 * thick, 0), subdivisions, 1),
    ]
    # More wind gives faster and larger waves.
    beat = Beat(0.75 / wind**0.7, -2 * math.pi * phase)
    config = FlagConfig(amplitude=0.1 * wind**0.3, period=beat.period, phase=360 * phase)
    low, high = np.array([0, -thick, 0]), np.array([width, thick, height])
    cloth = Flag.of(config, low, high)
    cloth.locomotion = "level"
    return join([front, back, *rim]), cloth


@primitive
def fish(
    length: float = 0.3, deep: float = 1.0, tempo: float = 1.0, phase: float = 0.0, coat: int = 0
) -> tuple[Surface, Deformer]:
    """A fish that swims along x, its nose at x = length / 2."""
    rings, segments = 48, 28
    # s: 0 at the nose, 1 at the end of the tail; rings are denser at both ends.
    s = (1 - np.cos(math.pi * np.arange(rings + 1) / rings)) / 2
    # Outlines along the body: trunk, tail fin, back fin and the stalk between.
    body = np.sqrt(np.clip(s / 0.78, 0, 1)) * np.clip(1 - (s / 0.80) ** 2.2, 0, 1) ** 0.8
    tail = np.exp(-(((s - 0.97) / 0.085) ** 2)) * (s < 1)
    fin = np.exp(-(((s - 0.40) / 0.13) ** 4))
    stalk = 0.022 * (np.sin(math.pi * np.clip(s, 0, 1)) ** 0.3)
    up = length * deep * (0.235 * body + 0.17 * tail + 0.07 * fin + stalk)
    under = length * deep * (0.215 * body + 0.17 * tail + 0.05 * np.exp(-(((s - 0.55) / 0.06) ** 2)) + stalk)
    wide = length * (0.105 * body + 0.010 * np.sin(math.pi * s) ** 0.5)
    angle = 2 * math.pi * np.arange(segments + 1) / segments
    # Fins are thin: parts higher than the body itself taper off.
    z = np.where(np.cos(angle) > 0, up[:, None], under[:, None]) * np.cos(angle)
    core = length * deep * (0.225 * body + stalk)[:, None]
    thin = np.clip((1 - np.clip(np.abs(z) / (core + 1e-9) - 0.25, 0, 1) ** 2), 0.06, 1)
    # The ring's ends and its lowest point lie in the plane of symmetry.
    y = -wide[:, None] * np.sin(angle) * thin
    y[:, [0, segments // 2, -1]] = 0
    notch = 0.10 * length * tail[:, None] * (np.abs(z) / (0.17 * length * deep) - 0.55)
    x = length * (0.5 - s)[:, None] - notch
    # The rings at nose and tail shrink to a point.
    positions = np.stack([x, y, z], axis=2)
    positions[[0, -1]] = positions[[0, -1]].mean(axis=1, keepdims=True)
    # Rows run to the tail, so the faces are reversed to face outwards.
    faces = lattice(segments, rings)[:, ::-1]
    flat = positions.reshape(-1, 3)
    # Triangles that collapse there are removed.
    area = face_cross(flat, faces)
    faces, area = (a[np.linalg.norm(area, axis=1) > 1e-12 * length**2] for a in (faces, area))
    uvs = np.stack(np.broadcast_arrays(angle / (2 * math.pi), s[:, None]), axis=2).reshape(-1, 2)
    # A wave that runs down the body, a little longer than it.
    wave = -2 * math.pi / (0.95 * length) * np.array([1.0, 0, 0])
    # The frequency falls with the root of the length; 1.9 Hz belong to 0.3 m.
    frequency = 1.9 * tempo * math.sqrt(0.3 / length)
    beat = Beat(1 / frequency, -2 * math.pi * phase)
    swim = Waves(
        np.array([0, 1.0, 0]),
        # The wave's amplitude grows from a tenth at the nose to the whole at the end of the tail.
        (np.array([-0.9 / length, 0, 0]), 0.55),
        ((wave, 0.0), (np.zeros(3), 0.0)),
        (0.085 * length, 0.0),
        (beat, beat),
    )
    # A wave is 0.95 lengths long, and the fish advances by 0.7 of one in a beat.
    swim.locomotion, swim.speed = "level", 0.7 * 0.95 * length / (beat.period_ns * 1e-9)
    return (flat, _smooth_normals(flat, faces, area), uvs, faces), swim


def _smooth_normals(positions: np.ndarray, faces: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Return (V, 3) mean normals of the faces around each point, also across seams of the texture."""
    points, welded = weld(positions, faces)
    total = np.zeros_like(points)
    np.add.at(total, welded, area[:, None])
    out = np.zeros_like(positions)
    out[faces] = total[welded]
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return np.where(length > 0, out / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])


# ---------------------------------------------------------------------------------------------------------------------
# ``deform:`` on the parts of one object.

EDGE = 1 / 12
"""Fraction of the object's longest side: longer edges are split, so that a box can bend."""


def deforming(parts: Sequence[Part], config: DeformConfig) -> tuple[Part, ...]:
    """Return the parts of one object, deformed together by ``deform:``; their triangles are as fine as that needs."""
    low, high = bounds([part.mesh for part in parts])
    deformer, edge = deformer_of(config, low, high), EDGE * float(np.max(high - low))
    return tuple(replace(part, mesh=replace(subdivided(part.mesh, edge), deformer=deformer)) for part in parts)
