"""Categories of visible objects, by their names, as numbers."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase

import numpy as np

from blinkgl.config.labels import LabelsConfig
from blinkgl.config.primitives import PRIMITIVES
from blinkgl.errors import ConfigError
from blinkgl.labels import files, grading
from blinkgl.labels.files import Form
from blinkgl.labels.label import Drawn, Label, ReferenceFrame, View
from blinkgl.scene.types import Scene, SceneObject

Categories = tuple[tuple[str, int], ...]
"""Pattern -> number, in order."""
_CATEGORIES = {"sky": 1, "ground": 2, "wall": 3} | {
    name: kind.category for name, kind in PRIMITIVES.items() if kind.category is not None
}
BY_NAME: Categories = (*sorted(_CATEGORIES.items(), key=lambda row: row[1]), ("*", 255))
"""``semantics: true``: sky 1, ground 2, wall 3, shapes from 4, 255 for other names. Data sets store these numbers: new
kinds must come at the end."""


def categories_of(labels: LabelsConfig) -> Categories:
    """Return the table of ``labels:``; that by kinds where it has none."""
    asked = labels.semantics
    return tuple(asked.items()) if isinstance(asked, dict) and asked else BY_NAME


def class_of(obj: SceneObject) -> str:
    """Return an object's kind, from its name: "cuboid" of "cuboid-3#12", "Chair" of "Chair.001"; "ground", "wall" and
    "sky" by their category."""
    if obj.category != "object":
        return obj.category
    # The numbers that copies get: "#12" here, ".001" in Blender. A name of nothing else is kept.
    return re.sub(r"([#.\-_ ]\d+)+$", "", obj.name) or obj.name


def names_of(obj: SceneObject) -> list[str]:
    """Return the names that patterns are compared with."""
    return [obj.name, class_of(obj), *(part.mesh.name for part in obj.parts)]


def category_of(obj: SceneObject, categories: Categories) -> int:
    """Return the number of an object's category; 0: no pattern matches."""
    names = names_of(obj)
    # The first pattern that matches decides, so "*" may stand at the end for the rest.
    return next((number for pattern, number in categories if any(fnmatchcase(n, pattern) for n in names)), 0)


class Semantics(Label):
    """(H, W) uint16 category of the visible object; 0: nothing hit, or no pattern matches its name."""

    name = "semantics"
    unit, kind = "0: nothing, or no category", "ids"
    needs, dtype = ("ids",), np.uint16
    shard = "semantics.png"

    def categories(self, labels: LabelsConfig) -> Categories:
        return categories_of(labels)

    def check(self, scene: Scene, labels: LabelsConfig) -> None:
        categories = categories_of(labels)
        if scene.objects and not any(
            fnmatchcase(name, pattern) for obj in scene.objects for name in names_of(obj) for pattern, _ in categories
        ):
            raise ConfigError(
                "no object's name matches a pattern",
                where="labels.semantics",
                value=[pattern for pattern, _ in categories],
                accepted="patterns of "
                + ", ".join(dict.fromkeys(class_of(obj) for obj in scene.objects))
                + "; '*': 0 accepts scenes without any",
            )

    def facts(self, scene: Scene, labels: LabelsConfig) -> dict[str, object]:
        categories = categories_of(labels)
        of_objects = {obj.name: category_of(obj, categories) for obj in scene.objects}
        return {"categories": {"patterns": dict(categories), "objects": of_objects}}

    def finish(self, drawn: Drawn) -> np.ndarray:
        return _of(drawn.scene, drawn.categories or BY_NAME, drawn.raw("ids"))

    @property
    def forms(self) -> tuple[Form, ...]:
        return (files.ids_png("semantics"),)

    def reference(self, scene: Scene, frame: ReferenceFrame) -> np.ndarray:
        return _of(scene, BY_NAME, frame.instance)

    @property
    def views(self) -> tuple[View, ...]:
        it = lambda value: value
        judged = "mismatch", 0.0, grading.different
        return (View(self.name, self.name, self.unit, self.kind, it, self.reference, *judged, same_triangle=False),)


def _of(scene: Scene, categories: Categories, ids: np.ndarray) -> np.ndarray:
    # Index 0 is the background, which has category 0.
    numbers = np.zeros(1 + max((obj.instance_id for obj in scene.objects), default=0), np.uint16)
    for obj in scene.objects:
        numbers[obj.instance_id] = category_of(obj, categories)
    return numbers[ids]
