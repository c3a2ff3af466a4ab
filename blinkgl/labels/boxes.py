"""Bounding boxes of objects, in the image and in 3-D."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from blinkgl.config.labels import LabelsConfig
from blinkgl.io.boxes import encode_boxes, kitti_text, read_boxes
from blinkgl.io.pictures import with_boxes
from blinkgl.labels.files import Form
from blinkgl.labels.label import Drawn, Label
from blinkgl.labels.semantics import Categories, categories_of
from blinkgl.types.boxes import SHAPES, Boxes


class ObjectBoxes(Label):
    """:class:`Boxes` of the objects that are visible in the image or hidden in it."""

    name = "boxes"
    kind, needs = "mask", ("ids",)
    shard = "boxes.npz"

    def categories(self, labels: LabelsConfig) -> Categories:
        return categories_of(labels)

    def finish(self, drawn: Drawn) -> Boxes:
        return drawn.boxes()

    def wrong(self, value: Boxes, height: int, width: int) -> str | None:
        for name, (more, kind) in SHAPES.items():
            array = np.asarray(getattr(value, name))
            if array.shape != (len(value), *more) or array.dtype.kind != kind:
                return f"{name} {array.dtype} {array.shape} of {len(value)} objects"
        if (size := np.asarray(value.resolution).tolist()) != [width, height]:
            return f"not {width}x{height} px: {size}"
        edges = np.array([width, height, width, height]) - 0.5
        if ((value.cut_box < -0.5) | (value.cut_box > edges)).any():
            return "a box cut at the picture's edges that is outside of them"
        return None

    def own(self, value: Boxes) -> Boxes:
        return Boxes(**{field.name: np.array(getattr(value, field.name)) for field in fields(Boxes)})

    @property
    def forms(self) -> tuple[Form, ...]:
        return (Form("boxes", "npz", encode_boxes, read_boxes), Form("boxes_kitti", "txt", _kitti))

    def drawn_on(self, picture: np.ndarray, value: Boxes) -> np.ndarray:
        return with_boxes(picture, value)

    views = property(lambda self: ())


def _kitti(value: Boxes) -> bytes:
    return kitti_text(value).encode()
