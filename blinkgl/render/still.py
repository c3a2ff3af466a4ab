"""A camera that stands still: draw what does not move once, and after that only where something moves.

The still part of the scene is kept as a picture with its depth. For each frame the rectangles that moving objects cover,
now or in the frame before, are restored from it, the moving objects are drawn over them under a scissor, and only those
rectangles are read back. Every pixel gets the value that a full redraw would give it.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.render.resources import DrawItem

_READ_FRAMEBUFFER, _DRAW_FRAMEBUFFER = 0x8CA8, 0x8CA9
_COLOUR_AND_DEPTH, _NEAREST = 0x4000 | 0x0100, 0x2600


@dataclass(frozen=True)
class Rectangle:
    """Pixels x0 <= x < x1, y0 <= y < y1."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def area(self) -> int:
        return (self.x1 - self.x0) * (self.y1 - self.y0)

    def meets(self, other: Rectangle) -> bool:
        return self.x0 < other.x1 and other.x0 < self.x1 and self.y0 < other.y1 and other.y0 < self.y1

    def union(self, other: Rectangle) -> Rectangle:
        return Rectangle(min(self.x0, other.x0), min(self.y0, other.y0), max(self.x1, other.x1), max(self.y1, other.y1))

    def scaled(self, factor: int) -> Rectangle:
        return Rectangle(self.x0 * factor, self.y0 * factor, self.x1 * factor, self.y1 * factor)


def screen_rectangle(item: DrawItem, T_cam_obj: np.ndarray, camera: CameraModel) -> Rectangle | None:
    """Pixels that the item can touch, by its bounding box; None when it is out of the image."""
    low, high = item.low, item.high
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    points = corners @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3]
    bounds = camera.bounds(points)
    return None if bounds is None else Rectangle(*bounds)


def merged(rectangles: list[Rectangle]) -> list[Rectangle]:
    """Rectangles that do not meet and cover the given ones, in a fixed order."""
    result: list[Rectangle] = []
    for rectangle in rectangles:
        while (other := next((r for r in result if r.meets(rectangle)), None)) is not None:
            result.remove(other)
            rectangle = rectangle.union(other)
        result.append(rectangle)
    return sorted(result, key=lambda r: (r.y0, r.x0))


class Backdrop:
    """The still part of a scene in GL, and the bookkeeping of what has moved since the last frame.

    picture : Target with the still objects' luminance and depth.   frame : Target that frames are composed in."""

    def __init__(self, gl, picture, frame):
        self.picture, self.frame = picture, frame
        self._bind = gl.function("glBindFramebuffer", None, ctypes.c_uint, ctypes.c_uint)
        self._blit = gl.function("glBlitFramebuffer", None, *[ctypes.c_int] * 8, ctypes.c_uint, ctypes.c_uint)
        self._covered: list[Rectangle] = []

    def stale(self, covered: list[Rectangle]) -> list[Rectangle]:
        """Where the frame has to be drawn anew, given what moving objects cover now."""
        rectangles = merged(self._covered + covered)
        self._covered = covered
        return rectangles

    def restore(self, rectangle: Rectangle) -> None:
        """Copies the still picture's colour and depth into the frame, inside the rectangle (px of the targets)."""
        self._bind(_READ_FRAMEBUFFER, self.picture.fbo.glo)
        self._bind(_DRAW_FRAMEBUFFER, self.frame.fbo.glo)
        edges = (rectangle.x0, rectangle.y0, rectangle.x1, rectangle.y1)
        self._blit(*edges, *edges, _COLOUR_AND_DEPTH, _NEAREST)
        self.frame.fbo.use()
