"""Kinds of primitive bodies: the names that a YAML may use, and the numbers that data sets store for them.

A new kind needs a row here and a builder in ``scene/geometry`` (docs/extending.md).
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Literal, NamedTuple


class PrimitiveKind(NamedTuple):
    """A kind of primitive. use : "pool", a rigid body that random worlds draw; "living", a body that moves by itself
    and is drawn only if it is named; "prop", only for explicit scenes.
    category : its number in ``labels: {semantics: true}``; None: 255, as for any other name.
    seed : the number that its random shapes depend on; None: its name."""

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
    "point": PrimitiveKind("prop", 18),
    "figure": PrimitiveKind("living", 13, 9),
    "flag": PrimitiveKind("living", 14, 10),
    "fish": PrimitiveKind("living", 15, 11),
}
"""The kinds by name. Seeds and categories of kinds in published data sets must never change."""


def kinds(*uses: str) -> tuple[str, ...]:
    """Return the names of the kinds of these uses, in the order of the table."""
    return tuple(name for name, kind in PRIMITIVES.items() if kind.use in uses)


def seed_of(name: str) -> int:
    """Return the seed of a kind's random shapes; adding another kind does not change it."""
    seed = PRIMITIVES[name].seed
    return zlib.crc32(name.encode()) if seed is None else seed


def or_registered(value: object, validate: Callable[[object], object]) -> object:
    """Accept a kind that a plug-in registered beside those that ``validate`` knows."""
    return value if isinstance(value, str) and value in PRIMITIVES else validate(value)
