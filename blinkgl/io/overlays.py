"""What is drawn over pictures for people: boxes, tracks with tails, curves."""

from __future__ import annotations

import cv2
import numpy as np

from blinkgl.io.pictures import id_colours
from blinkgl.labels.boxes import Boxes

_TEXT_PX = 9
"""Height of letters."""
_FROM_PX = 160
"""Pictures less wide than this have no room for words."""


def with_boxes(picture: np.ndarray, boxes: Boxes) -> np.ndarray:
    """(H, W, 3) uint8: a copy with the objects' boxes, in the colours of their ids: of what is seen in full lines, of
    the whole, cut at the picture's edges, in pale ones, and what they are called. Sky and ground, which are everywhere,
    have none."""
    out = np.ascontiguousarray(picture).copy()
    for k in range(len(boxes)):
        if boxes.kind[k] in ("sky", "ground"):
            continue
        colour = [int(c) for c in id_colours(boxes.instance[k : k + 1])[0]]
        pale = out.copy()
        _rectangle(pale, boxes.cut_box[k], colour)
        out = cv2.addWeighted(out, 0.55, pale, 0.45, 0)
        if boxes.visible_pixels[k]:
            _rectangle(out, boxes.visible_box[k], colour)
            if out.shape[1] >= _FROM_PX:
                left, top = boxes.visible_box[k, :2]
                _word(out, f"{boxes.kind[k]} {boxes.category[k]}", left + 2, top + _TEXT_PX + 1, colour)
    return out


def _rectangle(picture: np.ndarray, box: np.ndarray, colour: list[int]) -> None:
    """The outermost pixels inside a box's edges, px."""
    left, top, right, bottom = (int(v) for v in (*np.ceil(box[:2]), *np.floor(box[2:])))
    cv2.rectangle(picture, (left, top), (max(right, left), max(bottom, top)), colour, 1)


def _word(picture: np.ndarray, text: str, x: float, y: float, colour: list[int]) -> None:
    where, font = (int(x), int(y)), cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(picture, text, where, font, _TEXT_PX / 26, (0, 0, 0), 2, cv2.LINE_AA)
    cv2.putText(picture, text, where, font, _TEXT_PX / 26, colour, 1, cv2.LINE_AA)
