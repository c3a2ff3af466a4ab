"""What kind of thing is seen: categories of objects by their names, as numbers."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from blinkgl.config.base import Refused
from blinkgl.errors import ConfigError
from blinkgl.labels import files, grading
from blinkgl.labels.files import Form
from blinkgl.labels.label import Drawn, Key, Label, View

if TYPE_CHECKING:
    from blinkgl.config.labels import LabelsConfig
    from blinkgl.render.reference import ReferenceFrame
    from blinkgl.scene.types import Scene, SceneObject

Categories = tuple[tuple[str, int], ...]
"""Pattern -> number, in order."""
_KINDS = (
    "sky", "ground", "wall", "cuboid", "cylinder", "sphere", "icosphere", "cone", "torus", "capsule", "prism",
    "pyramid", "figure", "flag", "fish", "grid", "die",
)  # fmt: skip
BY_NAME: Categories = (*((kind, k) for k, kind in enumerate(_KINDS, 1)), ("*", 255))
"""``semantics: true``: sky 1, ground 2, wall 3, shapes from 4 on, 255 for other names. Data sets hold these numbers:
new kinds come at the end."""


def _a_table(value: Any) -> Any:
    """One message for what is neither of the two, instead of one for each."""
    if isinstance(value, bool):
        return value
    if not isinstance(value, dict):
        raise Refused(
            "no table of patterns", value=value, accepted="a table such as {'chair*': 7, '*': 0}, or true or false"
        )
    for pattern, number in value.items():
        if not isinstance(pattern, str) or not 1 <= len(pattern) <= 200:
            raise Refused("not a pattern of names", value=pattern, accepted="text of 1 to 200 characters")
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= 65535:
            raise Refused(f"no number of a category for '{pattern}'", value=number, accepted="0 to 65535")
    return value


SEMANTICS_KEY = Key(
    Annotated[bool | dict[str, int], BeforeValidator(_a_table)],
    Field(
        False,
        description='category of what is seen, 16-bit PNG: a table of patterns, `{"wall-*": 1, "chair*": 7, "*": 0}`, '
        "the first that fits an object's name, its meshes' or its category counts, 0 where none does; true: by kind of "
        "shape, sky 1, ground 2, wall 3, cuboid 4 … (docs/boxes.md)",
    ),
)


def categories_of(labels: LabelsConfig) -> Categories:
    """The table that ``labels:`` asks for; that by kinds where it says none."""
    asked = labels.semantics  # type: ignore[missing-attribute]
    return tuple(asked.items()) if isinstance(asked, dict) and asked else BY_NAME


def class_of(thing: SceneObject) -> str:
    """What kind of thing an object is, by its name: "cuboid" of "cuboid-3#12", "Chair" of "Chair.001"; "ground", "wall"
    and "sky" by their category."""
    if thing.category != "object":
        return thing.category
    return re.sub(r"([#.\-_ ]\d+)+$", "", thing.name) or thing.name


def names_of(thing: SceneObject) -> list[str]:
    """What patterns are compared with."""
    return [thing.name, class_of(thing), *(part.mesh.name for part in thing.parts)]


def category_of(thing: SceneObject, categories: Categories) -> int:
    """Number of an object's category; 0: no pattern fits."""
    names = names_of(thing)
    return next((number for pattern, number in categories if any(fnmatchcase(n, pattern) for n in names)), 0)


class Semantics(Label):
    """(H, W) uint16 category of the object that is seen; 0: nothing hit, or no pattern fits its name."""

    name = "semantics"
    about = "category of what is seen, by names or a table of patterns, 16-bit PNG"
    unit, kind = "0: nothing, or no category", "ids"
    needs, dtype = ("ids",), np.uint16
    shard = "semantics.png"

    @property
    def keys(self) -> dict[str, Key]:
        return {"semantics": SEMANTICS_KEY}

    def categories(self, labels: LabelsConfig) -> Categories:
        return categories_of(labels)

    def check(self, scene: Scene, labels: LabelsConfig) -> None:
        categories = categories_of(labels)
        if scene.objects and not any(
            fnmatchcase(name, pattern)
            for thing in scene.objects
            for name in names_of(thing)
            for pattern, _ in categories
        ):
            raise ConfigError(
                "no object has a name that one of the patterns fits",
                where="labels.semantics",
                value=[pattern for pattern, _ in categories],
                accepted="patterns of "
                + ", ".join(dict.fromkeys(class_of(thing) for thing in scene.objects))
                + "; '*': 0 lets scenes pass that have none",
            )

    def facts(self, scene: Scene, labels: LabelsConfig) -> dict[str, Any]:
        categories = categories_of(labels)
        of_objects = {thing.name: category_of(thing, categories) for thing in scene.objects}
        return {"categories": {"patterns": dict(categories), "objects": of_objects}}

    def finish(self, drawn: Drawn) -> np.ndarray:
        return _of(drawn.scene, drawn.categories or BY_NAME, drawn.raw("ids"))

    @property
    def forms(self) -> tuple[Form, ...]:
        return (files.ids_png("semantics"),)

    def problem(self, value: np.ndarray) -> str | None:
        return None if value.dtype == np.uint16 else f"{value.dtype} and not uint16"

    def reference(self, scene: Scene, frame: ReferenceFrame) -> np.ndarray:
        return _of(scene, BY_NAME, frame.instance)

    @property
    def views(self) -> tuple[View, ...]:
        it = lambda value: value
        judged = "mismatch", 0.0, grading.different
        return (View(self.name, self.name, self.unit, self.kind, it, self.reference, *judged, same_triangle=False),)


def _of(scene: Scene, categories: Categories, ids: np.ndarray) -> np.ndarray:
    numbers = np.zeros(1 + max((thing.instance_id for thing in scene.objects), default=0), np.uint16)
    for thing in scene.objects:
        numbers[thing.instance_id] = category_of(thing, categories)
    return numbers[ids]
