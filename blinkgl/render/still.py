"""A camera that stands still: draw what does not move once, and after that only where something moves.

The still part of the scene is kept as a picture with its depth. For each frame the rectangles that moving objects
cover, now or in the frame before, are restored from it, the moving objects are drawn over them under a scissor, and
only those rectangles are read back. Every pixel gets the value that a full redraw would give it.
"""

from __future__ import annotations

import ctypes
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from blinkgl.gl import Target
from blinkgl.render.canvas import Canvas, Frame, Rectangle, merged

if TYPE_CHECKING:
    from blinkgl.camera import CameraModel
    from blinkgl.render.draw_items import DrawItem
    from blinkgl.render.passes.base import Shot

# OpenGL's enums: GL_READ_FRAMEBUFFER, GL_DRAW_FRAMEBUFFER; depth and colour bits; GL_NEAREST.
_READ_FRAMEBUFFER, _DRAW_FRAMEBUFFER = 0x8CA8, 0x8CA9
_DEPTH, _COLOUR_AND_DEPTH, _NEAREST = 0x0100, 0x4000 | 0x0100, 0x2600


def screen_rectangle(item: DrawItem, T_cam_obj: np.ndarray, camera: CameraModel) -> Rectangle | None:
    """Pixels that the item can touch, by its bounding box; None when it is out of the image."""
    bounds = camera.bounds(item.corners @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3])
    return None if bounds is None else Rectangle(*bounds)


class StillCanvas(Canvas):
    """Of a pass that draws the scene with a camera, or for a lamp, that stands still. The target always holds the
    whole last frame; what is kept beside it, the still objects' picture and the places of those that move, is nobody
    else's."""

    _picture: Target | None = None
    _covered: tuple[Rectangle, ...] = ()  # by what moves, in the last frame

    def draw(self, shot: Shot) -> Frame:
        pass_, painter, moment = self.pass_, self.painter, shot.moment
        visible, camera = pass_.items(moment), moment.view.camera
        movers = []
        for item in visible:
            if item.moves:
                rectangle = screen_rectangle(item, moment.T_cam_obj[item.object_index], camera)
                if rectangle is not None:
                    movers.append((item, rectangle))
        covered = [rectangle for _, rectangle in movers]
        # The first frame draws what stands still, once.
        if self._picture is None:
            self._picture = self.make_target(camera.width, camera.height)
            still = replace(shot, target=self._picture)
            pass_.begin(painter, still)
            pass_.paint(painter, still, [item for item in visible if not item.moves])
            stale = [Rectangle(0, 0, camera.width, camera.height)]
        else:
            # Where movers are now and where they were: both have to be restored.
            stale = merged([*self._covered, *covered])
        self._covered = tuple(covered)
        painter.prepare(self.target)
        for rectangle in stale:
            # Rectangles are in px of the image, the target may be finer.
            fine = rectangle.scaled(pass_.samples.grid)
            painter.gl.ctx.scissor = (fine.x0, fine.y0, fine.x1 - fine.x0, fine.y1 - fine.y0)
            # Restore first, then draw what touches the rectangle, under the scissor.
            self._restore(fine)
            pass_.paint(painter, shot, [item for item, place in movers if place.meets(rectangle)])
        painter.gl.ctx.scissor = None
        painter.stats.frames += 1
        return self.frame(shot, stale)

    def _restore(self, rectangle: Rectangle) -> None:
        """Copies the still picture's colour and depth into the target, inside the rectangle (px of the targets)."""
        gl = self.painter.gl
        if not hasattr(self, "_bind"):
            self._bind = gl.function("glBindFramebuffer", None, ctypes.c_uint, ctypes.c_uint)
            self._blit = gl.function("glBlitFramebuffer", None, *[ctypes.c_int] * 8, ctypes.c_uint, ctypes.c_uint)
        self._bind(_READ_FRAMEBUFFER, self._picture.fbo.glo)
        self._bind(_DRAW_FRAMEBUFFER, self.target.fbo.glo)
        # A pass without colour outputs has a depth buffer alone.
        edges = (rectangle.x0, rectangle.y0, rectangle.x1, rectangle.y1)
        self._blit(*edges, *edges, _COLOUR_AND_DEPTH if self.outputs else _DEPTH, _NEAREST)
        self.target.fbo.use()

    def release(self) -> None:
        if self._picture is not None:
            self._picture.release()
        super().release()
