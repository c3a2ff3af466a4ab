"""The drawing of a pass into its target: anew, or only where something has changed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from blinkgl.gl import Target
from blinkgl.render.frames import Frame, Memory, Rectangle, merged
from blinkgl.render.passes.base import ScenePass

if TYPE_CHECKING:
    from blinkgl.camera import CameraModel, PinHole
    from blinkgl.render.draw_items import DrawItem
    from blinkgl.render.painter import Painter
    from blinkgl.render.passes.base import Pass, Shot


def target_of(pass_: Pass, painter: Painter, width: int, height: int) -> Target:
    """Return a new target of a pass, for an image of this size, px."""
    colour = tuple(output.format for output in pass_.outputs)
    return Target(painter.gl, *pass_.size(width, height), colour=colour, depth=pass_.depth)


class Canvas(Memory):
    """The target of one pass of one renderer. width, height : of the image, px."""

    def __init__(self, pass_: Pass, painter: Painter, width: int, height: int):
        self.pass_ = pass_
        target = target_of(pass_, painter, width, height)
        super().__init__(painter, target, pass_.outputs, type(pass_).__name__)
        self._used: dict[str, Frame] = {}  # inputs of the last frame

    def draw(self, shot: Shot) -> Frame:
        """Draw a moment into :attr:`target` and return the frame."""
        # A pass that reads its inputs pixel by pixel changes only where they change.
        changed = self._changed(shot)
        self._used = dict(shot.inputs) if self.pass_.pointwise else {}
        if changed is None or changed:
            self.pass_.begin(self.painter, shot)
            self.pass_.paint(self.painter, shot)
        return self.frame(shot, changed)

    def frame(self, shot: Shot, changed: list[Rectangle] | None) -> Frame:
        """Return the handle of the frame that has just been drawn."""
        self.number += 1
        return Frame(self, self.number, shot.moment, changed)

    def _changed(self, shot: Shot) -> list[Rectangle] | None:
        if not self.pass_.pointwise or not self._used:
            return None
        # Unknown for one input is unknown for all.
        parts = [frame.changed_since(self._used.get(name)) for name, frame in shot.inputs.items()]
        known = [part for part in parts if part is not None]
        if len(known) < len(parts):
            return None
        return self.pass_.changed(self.painter, merged([r for part in known for r in part]))


# ---------------------------------------------------------------------------------------------------------------------
# A camera that stands still: draw the static part once, and afterwards only where something moves.
#
# The static part of the scene is kept as a picture with its depth. For each frame the rectangles that moving objects
# cover, now or in the previous frame, are restored from it, the moving objects are drawn over them under a scissor, and
# only those rectangles are read back. Every pixel gets the value of a full redraw.


def screen_rectangle(item: DrawItem, T_cam_obj: np.ndarray, camera: PinHole) -> Rectangle | None:
    """Return the pixels that the item can touch, from its bounding box; None when it is outside the image."""
    bounds = camera.bounds(item.corners @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3])
    return None if bounds is None else Rectangle(*bounds)


class StillCanvas(Canvas):
    """The canvas of a pass that draws the scene for a camera or a lamp that stands still. The target always holds the
    whole last frame. It also keeps the picture of the static objects and the rectangles of moving ones."""

    _picture: Target | None = None
    _place: tuple[CameraModel, bytes] | None = None  # camera and pose that the picture was drawn from
    _covered: tuple[Rectangle, ...] = ()  # by moving objects, in the last frame

    def draw(self, shot: Shot) -> Frame:
        pass_, painter, moment = self.pass_, self.painter, shot.moment
        assert isinstance(pass_, ScenePass)
        visible, camera = pass_.items(moment), moment.view.camera
        movers = []
        for item in visible:
            if item.moves:
                rectangle = screen_rectangle(item, moment.T_cam_obj[item.object_index], camera)
                if rectangle is not None:
                    movers.append((item, rectangle))
        covered = [rectangle for _, rectangle in movers]
        # The first frame draws the static part, once; so does one that is seen from elsewhere.
        place = camera, moment.T_world_cam.tobytes()
        if self._picture is None or place != self._place:
            self._picture = self._picture or target_of(pass_, painter, camera.width, camera.height)
            self._place = place
            still = replace(shot, target=self._picture)
            pass_.begin(painter, still)
            pass_.paint(painter, still, [item for item in visible if not item.moves])
            stale = [Rectangle(0, 0, camera.width, camera.height)]
        else:
            # Present and previous rectangles of moving objects both have to be restored.
            stale = merged([*self._covered, *covered])
        self._covered = tuple(covered)
        painter.prepare(self.target)
        for rectangle in stale:
            # Rectangles are in px of the image, the target may be finer.
            fine = rectangle.scaled(pass_.samples.grid)
            painter.gl.ctx.scissor = (fine.x0, fine.y0, fine.x1 - fine.x0, fine.y1 - fine.y0)
            # Restore the static picture's colour and depth first, then draw what touches the rectangle, under the
            # scissor.
            self._picture.copy_into(self.target, (fine.x0, fine.y0, fine.x1, fine.y1), depth=True)
            pass_.paint(painter, shot, [item for item, place in movers if place.meets(rectangle)])
        painter.gl.ctx.scissor = None
        painter.stats.frames += 1
        return self.frame(shot, stale)

    def _update(self, i: int, picture: np.ndarray | None, stale: list[Rectangle] | None) -> np.ndarray:
        # Rectangles are in px of the image, the target may be finer.
        finer = self.pass_.samples.grid
        return super()._update(i, picture, None if stale is None else [r.scaled(finer) for r in stale])

    def release(self) -> None:
        if self._picture is not None:
            self._picture.release()
        super().release()
