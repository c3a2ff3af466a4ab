"""Where objects are: boxes in the picture and in space."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from blinkgl.labels.files import Form
from blinkgl.labels.label import Drawn, Key, Label
from blinkgl.labels.semantics import SEMANTICS_KEY, Categories, categories_of

if TYPE_CHECKING:
    from blinkgl.config.labels import LabelsConfig


@dataclass(frozen=True, eq=False)
class Boxes:
    """N objects of which something would be in the picture, did nothing hide it, in the scene's order.

    instance : (N,) int64, as in ``ids``.   category : (N,) int64, as in ``semantics``.   kind : (N,) text, what the
    name says it is.
    visible_box : (N, 4) float64 px, left, top, right, bottom edges of the pixels that show it (the top-left pixel's are
    -0.5, -0.5, 0.5, 0.5); 0 where none does.   visible_pixels : (N,) int64.
    amodal_box : (N, 4) float64 px, of all of it before the near plane, whether hidden, in the picture or beside it.
    cut_box : (N, 4) float64 px, the same, cut at the picture's edges.
    amodal_pixels : (N,) int64, pixels of the picture that would show it, did nothing hide it.
    size : (N, 3) float64, of its box in space along that one's axes, world units.
    T_cam_box, T_world_box : (N, 4, 4) float64, from the box's axes, which are the object's, and its middle, to the
    camera's and to the world's.   occluded : (N,) float64, share of ``amodal_pixels`` that is hidden.
    truncated : (N,) float64, share of ``amodal_box`` that is outside the picture.
    resolution : (2,) int64 width and height of the picture, px."""

    instance: np.ndarray
    category: np.ndarray
    kind: np.ndarray
    visible_box: np.ndarray
    visible_pixels: np.ndarray
    amodal_box: np.ndarray
    cut_box: np.ndarray
    amodal_pixels: np.ndarray
    size: np.ndarray
    T_cam_box: np.ndarray
    T_world_box: np.ndarray
    occluded: np.ndarray
    truncated: np.ndarray
    resolution: np.ndarray

    def __len__(self) -> int:
        return len(self.instance)


SHAPES: dict[str, tuple[tuple[int, ...], str]] = {
    "instance": ((), "i"),
    "category": ((), "i"),
    "kind": ((), "U"),
    "visible_box": ((4,), "f"),
    "visible_pixels": ((), "i"),
    "amodal_box": ((4,), "f"),
    "cut_box": ((4,), "f"),
    "amodal_pixels": ((), "i"),
    "size": ((3,), "f"),
    "T_cam_box": ((4, 4), "f"),
    "T_world_box": ((4, 4), "f"),
    "occluded": ((), "f"),
    "truncated": ((), "f"),
}
"""Array -> its shape behind the objects, NumPy's kind of number."""


class ObjectBoxes(Label):
    """:class:`Boxes` of the objects that are in the picture or behind something in it."""

    name = "boxes"
    about = "boxes of objects, in the picture (visible, whole) and in space, .npz and KITTI's text (docs/boxes.md)"
    kind, needs = "mask", ("ids",)
    shard = "boxes.npz"

    @property
    def keys(self) -> dict[str, Key]:
        return {**super().keys, "semantics": SEMANTICS_KEY}

    def categories(self, labels: LabelsConfig) -> Categories:
        return categories_of(labels)

    def finish(self, drawn: Drawn) -> Boxes:
        from blinkgl.render.boxes import boxes_of

        return boxes_of(drawn.scene, drawn.t_ns, drawn.raw("ids"), drawn.categories)

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
        return (Form("boxes", "npz", _npz, _read), Form("boxes_kitti", "txt", _kitti))

    def problem(self, value: Boxes) -> str | None:
        if not all(np.isfinite(getattr(value, name)).all() for name, (_, kind) in SHAPES.items() if kind == "f"):
            return "a number that is not finite"
        if (np.diff(value.amodal_box.reshape(-1, 2, 2), axis=1) < 0).any() or (value.size < 0).any():
            return "a box of negative size"
        return (
            None if (value.visible_pixels <= value.amodal_pixels).all() else "more of an object is seen than there is"
        )

    def agrees(self, one: Boxes, other: Boxes) -> bool:
        """Which pixels show an object is the renderer's to say, where it is in space is not."""
        return np.array_equal(one.instance, other.instance) and all(
            np.allclose(getattr(one, name), getattr(other, name), rtol=1e-6, atol=1e-6)
            for name in ("amodal_box", "size", "T_cam_box", "T_world_box")
        )

    def drawn_on(self, picture: np.ndarray, value: Boxes) -> np.ndarray:
        from blinkgl.io.overlays import with_boxes

        return with_boxes(picture, value)

    views = property(lambda self: ())


def _npz(value: Boxes) -> bytes:
    from blinkgl.io.boxes import encode_boxes

    return encode_boxes(value)


def _read(path: str | os.PathLike) -> Boxes:
    from blinkgl.io.boxes import read_boxes

    return read_boxes(path)


def _kitti(value: Boxes) -> bytes:
    from blinkgl.io.boxes import kitti_text

    return kitti_text(value).encode()


def empty() -> dict[str, Any]:
    """The arrays of no object, but for ``resolution``."""
    kinds = {"i": np.int64, "f": np.float64, "U": "U1"}
    return {name: np.zeros((0, *more), kinds[kind]) for name, (more, kind) in SHAPES.items()}
