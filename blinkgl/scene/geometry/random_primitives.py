"""Bodies of random proportions, for pools of objects."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from blinkgl.config.primitives import seed_of
from blinkgl.scene.geometry import living, primitives as solids
from blinkgl.scene.geometry.meshes import transform_mesh
from blinkgl.scene.geometry.primitives import parameter_hash
from blinkgl.scene.types import Mesh


class _Dice:
    """Draws the proportions of one body. index : its number within its kind."""

    def __init__(self, kind: str, index: int):
        self.rng, self.index = np.random.default_rng([seed_of(kind), index]), index

    def between(self, low: float, high: float) -> float:
        """Return a log-uniform value, rounded: the last bit of exp differs between platforms."""
        return round(math.exp(self.rng.uniform(math.log(low), math.log(high))), 6)

    def whole(self, low: int, high: int) -> int:
        return int(self.rng.integers(low, high))

    def phase(self) -> float:
        return round(self.rng.uniform(), 6)


def _flattened(mesh: Mesh, dice: _Dice) -> Mesh:
    return transform_mesh(mesh, np.diag([1, dice.between(0.6, 1), dice.between(0.6, 1)]))


def _figure(dice: _Dice) -> Mesh:
    # By its number, so that every part of a pool has all clips.
    does = ("walk", "dance", "run", "dance", "walk", "wave")[dice.index % 6]
    grown, parts = dice.between(1.2, 1.95), [dice.between(0.9, 1.1) for _ in range(3)]
    return living.figure(
        height=grown,
        build=dice.between(0.8, 1.3),
        legs=parts[0],
        arms=parts[1],
        # A small figure has a large head in proportion, as a child has.
        head=parts[2] * (1.75 / grown) ** 0.5,
        clip=does,
        variant=dice.index,
        tempo=dice.between(0.85, 1.2),
        phase=dice.phase(),
        coat=dice.index,
    )


def _flag(dice: _Dice) -> Mesh:
    height, wind = dice.between(0.5, 1.5), dice.between(0.5, 2)
    return living.flag(height=height, wind=wind, phase=dice.phase(), coat=dice.index)


def _fish(dice: _Dice) -> Mesh:
    deep, tempo = dice.between(0.65, 1.5), dice.between(0.7, 1.6)
    return living.fish(deep=deep, tempo=tempo, phase=dice.phase(), coat=dice.index)


# A kind draws its numbers in this order: another one would be other bodies under the same hashes.
RANDOM: dict[str, Callable[[_Dice], Mesh]] = {
    "cuboid": lambda dice: solids.cuboid(extents=[dice.between(0.25, 1) for _ in range(3)], subdivisions=2),
    "cylinder": lambda dice: solids.cylinder(radius=0.5, height=dice.between(0.3, 3)),
    "sphere": lambda dice: _flattened(solids.sphere(), dice),
    "icosphere": lambda dice: _flattened(solids.icosphere(subdivisions=dice.whole(1, 4)), dice),
    "cone": lambda dice: solids.cone(radius=0.5, height=dice.between(0.3, 3)),
    "torus": lambda dice: solids.torus(tube=dice.between(0.06, 0.25)),
    "capsule": lambda dice: solids.capsule(height=dice.between(0.1, 1.2)),
    "prism": lambda dice: solids.prism(sides=dice.whole(3, 9), height=dice.between(0.3, 3)),
    "pyramid": lambda dice: solids.pyramid(sides=dice.whole(3, 7), height=dice.between(0.5, 1.6)),
    "figure": _figure,
    "flag": _flag,
    "fish": _fish,
}
"""Kind -> a function that draws a body of it, about one unit large. Every kind of a pool has one."""


def random_primitive(kind: str, index: int) -> Mesh:
    """Return the ``index``-th body of a kind. No two have the same proportions, so a train/test split can separate
    bodies of different indices; ``source_hash`` is of (kind, index)."""
    mesh = RANDOM[kind](_Dice(kind, index))
    return replace(mesh, source_hash=random_primitive_hash(kind, index), name=f"{kind}-{index}")


def random_primitive_hash(kind: str, index: int) -> str:
    """Return the ``source_hash`` of :func:`random_primitive`, without making it."""
    return parameter_hash("random primitive", 1, kind, index)
