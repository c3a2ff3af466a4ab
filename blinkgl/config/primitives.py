"""The kinds of primitive bodies: what a YAML may name, and the numbers that data sets hold of them.

A new kind is a row here and a builder in ``scene/geometry`` (docs/extending.md).
"""

from __future__ import annotations

import zlib
from typing import Literal, NamedTuple


class PrimitiveKind(NamedTuple):
    """use : "pool", a rigid body that random worlds draw; "living", one that moves by itself, drawn where it is asked
    for by name; "prop", for explicit scenes alone.
    category : its number among ``labels: {semantics: true}``; None: 255, as of any other name.
    seed : what its random shapes hang on; None: its name."""

    use: Literal["pool", "living", "prop"]
    category: int | None = None
    seed: int | None = None


PRIMITIVES = {
    "cuboid": PrimitiveKind("pool", 4, 0),
    "cylinder": PrimitiveKind("pool", 5, 1),
    "sphere": PrimitiveKind("pool", 6, 2),
    "icosphere": PrimitiveKind("pool", 7, 3),
    "cone": PrimitiveKind("pool", 8, 4),
    "torus": PrimitiveKind("pool", 9, 5),
    "capsule": PrimitiveKind("pool", 10, 6),
    "prism": PrimitiveKind("pool", 11, 7),
    "pyramid": PrimitiveKind("pool", 12, 8),
    "grid": PrimitiveKind("prop", 16),
    "die": PrimitiveKind("prop", 17),
    "figure": PrimitiveKind("living", 13, 9),
    "flag": PrimitiveKind("living", 14, 10),
    "fish": PrimitiveKind("living", 15, 11),
}
"""By name. Seeds and categories of the kinds that data sets were made with are fixed numbers, whatever comes later."""


def kinds(*uses: str) -> tuple[str, ...]:
    """Return the names of the kinds of these uses, in the order of the table."""
    return tuple(name for name, kind in PRIMITIVES.items() if kind.use in uses)


def seed_of(name: str) -> int:
    """Return the number that a kind's random shapes are seeded by; adding another kind does not change it."""
    seed = PRIMITIVES[name].seed
    return zlib.crc32(name.encode()) if seed is None else seed
