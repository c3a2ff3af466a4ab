"""The target of a pass, and the handle of a drawn frame: a frame stays on the GPU until it is read.

A :class:`Canvas` owns one pass's target and, where frames are viewed, the memory of the views. The pass's next frame
overwrites it; reading an older frame raises an error.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import moderngl
import numpy as np

from blinkgl.errors import GLError
from blinkgl.gl import Target
from blinkgl.gl.framebuffer import checked_array
from blinkgl.machine.compiling import working_clock
from blinkgl.render.tensors import TextureReader

if TYPE_CHECKING:
    from blinkgl.camera import CameraModel
    from blinkgl.render.draw_items import DrawItem
    from blinkgl.render.moment import Moment
    from blinkgl.render.painter import Painter
    from blinkgl.render.passes.base import Pass, Shot


# ---------------------------------------------------------------------------------------------------------------------
# Rectangles of pixels.


class Rectangle(NamedTuple):
    """Pixels x0 <= x < x1, y0 <= y < y1."""

    x0: int
    y0: int
    x1: int
    y1: int

    def meets(self, other: Rectangle) -> bool:
        return self.x0 < other.x1 and other.x0 < self.x1 and self.y0 < other.y1 and other.y0 < self.y1

    def union(self, other: Rectangle) -> Rectangle:
        return Rectangle(min(self.x0, other.x0), min(self.y0, other.y0), max(self.x1, other.x1), max(self.y1, other.y1))

    def grown(self, margin: int, width: int, height: int) -> Rectangle:
        """Return it with ``margin`` px more on every side, within a picture of this size."""
        return Rectangle(
            max(0, self.x0 - margin),
            max(0, self.y0 - margin),
            min(width, self.x1 + margin),
            min(height, self.y1 + margin),
        )

    def scaled(self, factor: int) -> Rectangle:
        return Rectangle(self.x0 * factor, self.y0 * factor, self.x1 * factor, self.y1 * factor)


def merged(rectangles: list[Rectangle]) -> list[Rectangle]:
    """Return disjoint rectangles that cover the given ones, in a fixed order."""
    result: list[Rectangle] = []
    for rectangle in rectangles:
        while (other := next((r for r in result if r.meets(rectangle)), None)) is not None:
            result.remove(other)
            rectangle = rectangle.union(other)
        result.append(rectangle)
    return sorted(result, key=lambda r: (r.y0, r.x0))


DEPTH_BUFFER = "depth buffer"
"""An input's ``output`` that selects the depth texture of a pass."""


class Frame:
    """A pass's picture of a moment, on the GPU, until the same pass draws its next frame; later use raises GLError.

    moment : as the pass saw it.   t_ns : its time.   names : of its outputs; the first is the default.
    width, height : px.
    changed : rectangles in which it may differ from the same pass's previous frame; None: anywhere. See
    :meth:`changed_since`."""

    def __init__(self, canvas: Canvas, number: int, moment: Moment, changed: list[Rectangle] | None):
        self._canvas, self._number, self.moment, self.changed = canvas, number, moment, changed

    @property
    def t_ns(self) -> int:
        return self.moment.t_ns

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(output.name for output in self._canvas.outputs)

    @property
    def width(self) -> int:
        return self._canvas.target.width

    @property
    def height(self) -> int:
        return self._canvas.target.height

    @property
    def target(self) -> Target:
        """Return the target that it was drawn into, for a pass that resolves or copies it."""
        self._check()
        return self._canvas.target

    def texture(self, output: str = "") -> moderngl.Texture:
        """Return the texture of an output (default: the first), or of :data:`DEPTH_BUFFER`, for another pass: as the
        program wrote it, with all components of its format."""
        if output == DEPTH_BUFFER:
            if not isinstance(self._canvas.pass_.depth, str):
                raise GLError(
                    "the pass has no readable depth buffer",
                    where=type(self._canvas.pass_).__name__,
                    value=output,
                    accepted='one with `depth = "texture"`',
                )
            return self.target.depth
        return self.target.colour[self._canvas.attachment(output)]

    def read(self, name: str = "", out: np.ndarray | None = None) -> np.ndarray:
        """Return a copy of an output, (H, W) or (H, W, C), dtype of its format; row 0 is the top row.

        out : written and returned when given (C-contiguous, that shape and dtype)."""
        self._check()
        return self._canvas.read(name, out)

    def view(self, name: str = "") -> np.ndarray:
        """Return an output as a read-only array in memory of the renderer that the next frame overwrites: no
        allocation, and only changed parts are transferred. Copy it to keep it."""
        self._check()
        return self._canvas.view(name, self)

    def tensor(self, device: Any = "cuda", name: str = "") -> Any:
        """Return an output as a new torch tensor, (H, W) or (H, W, C), dtype of its format.

        device : torch's. On the GPU that draws it, the picture stays there if CUDA can share it; see
        :mod:`blinkgl.render.tensors`, and :meth:`transfer` for the way used.
        Raises GLError: no torch, no such device, no such output."""
        self._check()
        return self._canvas.tensor(device, name)

    def transfer(self, device: Any = "cuda", name: str = "") -> str:
        """Return the way of :meth:`tensor`: "interop", "pinned" or "plain", with the reason why no faster way is
        used."""
        self._check()
        reader = self._canvas.reader(device, name)
        return f"{reader.way}: {reader.why}" if reader.why else reader.way

    def changed_since(self, before: Frame | None) -> list[Rectangle] | None:
        """Return rectangles outside which this frame equals ``before``; None: it may differ anywhere, because only
        consecutive frames of one pass are compared."""
        if before is None:
            return None
        # Another of its own class: private members may be used.
        follows = before._canvas is self._canvas and before._number == self._number - 1  # noqa: SLF001
        return self.changed if follows else None

    def rows_changed_since(self, before: Frame | None) -> tuple[int, int] | None:
        """Return (y0, y1): outside these rows it equals ``before``; None: it may differ anywhere."""
        changed = self.changed_since(before)
        if changed is None:
            return None
        return (min(r.y0 for r in changed), max(r.y1 for r in changed)) if changed else (0, 0)

    def _check(self) -> None:
        if self._canvas.number != self._number:
            raise GLError(
                "this frame is no longer on the GPU: its pass has drawn another one",
                where=f"frame at {self.t_ns * 1e-9:.9g} s",
                accepted="read() before the next frame is drawn",
            )


class Canvas:
    """The target of one pass of one renderer. width, height : of the image.   number : of the last frame; -1 after
    release."""

    def __init__(self, pass_: Pass, painter: Painter, width: int, height: int):
        self.pass_, self.painter, self.number = pass_, painter, 0
        self.outputs = pass_.outputs
        self.target = self.make_target(width, height)
        self._held: dict[int, tuple[int, np.ndarray]] = {}  # attachment -> number of the stored frame, and its picture
        self._readers: dict[tuple[int, str], TextureReader] = {}  # by attachment and device
        self._used: dict[str, Frame] = {}  # inputs of the last frame

    def make_target(self, width: int, height: int) -> Target:
        pass_ = self.pass_
        return Target(
            self.painter.gl,
            *pass_.size(width, height),
            colour=tuple(o.format for o in self.outputs),
            depth=pass_.depth,
        )

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
        if any(part is None for part in parts):
            return None
        return self.pass_.changed(self.painter, merged([r for part in parts for r in part]))

    # ---- read-back -----------------------------------------------------------------------------------------------

    def attachment(self, output: str) -> int:
        """Return the number of an output (default: the first). Raises GLError."""
        names = [o.name for o in self.outputs]
        if not names or (output and output not in names):
            raise GLError(
                "the pass has no such output",
                where=type(self.pass_).__name__,
                value=output,
                accepted=", ".join(names) or "none",
            )
        return names.index(output) if output else 0

    def read(self, name: str, out: np.ndarray | None) -> np.ndarray:
        i = self.attachment(name)
        # Another context may have been made current in this thread since.
        self.painter.gl.resume()
        self.painter.finish()
        started = working_clock()
        if not self.outputs[i].components:
            out = self.target.read(i, out=out)
        else:
            picture = self._given_out(i, self.target.read(i))
            out = checked_array(out, picture.shape, picture.dtype)
            out[...] = picture
        self.painter.stats.readback_s += working_clock() - started
        return out

    def view(self, name: str, frame: Frame) -> np.ndarray:
        i = self.attachment(name)
        self.painter.gl.resume()
        number, picture = self._held.get(i, (0, None))
        if picture is None or number != self.number:
            # Only a picture of the previous frame is valid outside the changed rectangles.
            stale = frame.changed if number == self.number - 1 and number > 0 else None
            picture = self._update(i, picture, stale)
            self._held[i] = self.number, picture
        seen = picture.view()
        seen.flags.writeable = False
        return seen

    def reader(self, device: Any, name: str) -> TextureReader:
        """Return the reader of an attachment into tensors of a device; made when first needed."""
        i = self.attachment(name)
        if (i, str(device)) not in self._readers:
            self.painter.gl.resume()
            self.painter.finish()
            self._readers[i, str(device)] = TextureReader(self.painter.gl, self.target, i, device)
        return self._readers[i, str(device)]

    def tensor(self, device: Any, name: str) -> Any:
        """Return a new tensor."""
        components = self.outputs[self.attachment(name)].components
        reader = self.reader(device, name)
        self.painter.finish()
        started = working_clock()
        picture = reader.read()
        if components:
            picture = picture[..., :components]
        self.painter.stats.readback_s += working_clock() - started
        return picture

    def _update(self, i: int, picture: np.ndarray | None, stale: list[Rectangle] | None) -> np.ndarray:
        """Return the current picture of attachment ``i``; ``picture`` is valid outside ``stale``."""
        self.painter.finish()
        started = working_clock()
        if picture is None or stale is None:
            if self.outputs[i].components:
                picture = np.ascontiguousarray(self._given_out(i, self.target.read(i)))
            else:
                # Read straight into the memory held for it.
                picture = self.target.read(i, out=picture)
        else:
            for r in stale:
                part = self.target.read(i, region=(r.x0, r.y0, r.x1 - r.x0, r.y1 - r.y0))
                picture[r.y0 : r.y1, r.x0 : r.x1] = self._given_out(i, part)
        self.painter.stats.readback_s += working_clock() - started
        return picture

    def _given_out(self, i: int, array: np.ndarray) -> np.ndarray:
        return array[..., : self.outputs[i].components or None]

    def release(self) -> None:
        self.number = -1
        for reader in self._readers.values():
            reader.release()
        self._readers.clear()
        self.target.release()


# ---------------------------------------------------------------------------------------------------------------------
# A camera that stands still: draw the static part once, and afterwards only where something moves.
#
# The static part of the scene is kept as a picture with its depth. For each frame the rectangles that moving objects
# cover, now or in the previous frame, are restored from it, the moving objects are drawn over them under a scissor, and
# only those rectangles are read back. Every pixel gets the value of a full redraw.


def screen_rectangle(item: DrawItem, T_cam_obj: np.ndarray, camera: CameraModel) -> Rectangle | None:
    """Return the pixels that the item can touch, from its bounding box; None when it is outside the image."""
    bounds = camera.bounds(item.corners @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3])
    return None if bounds is None else Rectangle(*bounds)


class StillCanvas(Canvas):
    """The canvas of a pass that draws the scene for a camera or a lamp that stands still. The target always holds the
    whole last frame. It also keeps the picture of the static objects and the rectangles of moving ones."""

    _picture: Target | None = None
    _covered: tuple[Rectangle, ...] = ()  # by moving objects, in the last frame

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
        # The first frame draws the static part, once.
        if self._picture is None:
            self._picture = self.make_target(camera.width, camera.height)
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
            # Restore first, then draw what touches the rectangle, under the scissor.
            self._restore(fine)
            pass_.paint(painter, shot, [item for item, place in movers if place.meets(rectangle)])
        painter.gl.ctx.scissor = None
        painter.stats.frames += 1
        return self.frame(shot, stale)

    def _restore(self, rectangle: Rectangle) -> None:
        """Copy the static picture's colour and depth into the target, inside the rectangle (px of the targets)."""
        edges = (rectangle.x0, rectangle.y0, rectangle.x1, rectangle.y1)
        self._picture.copy_into(self.target, edges, depth=True)

    def release(self) -> None:
        if self._picture is not None:
            self._picture.release()
        super().release()
