"""Pictures of passes on the GPU: a frame stays there until it is read.

A :class:`Memory` owns one pass's target and, where frames are viewed, the memory of the views. The pass's next frame
overwrites it; reading an older frame raises an error.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import moderngl
import numpy as np

from blinkgl.errors import GLError
from blinkgl.gl import Target
from blinkgl.gl.framebuffer import checked_array
from blinkgl.machine.compiling import working_clock
from blinkgl.render.tensors import TextureReader

if TYPE_CHECKING:
    from blinkgl.render.moment import Moment
    from blinkgl.render.painter import Painter


class Output(NamedTuple):
    """An attachment: ``layout(location = i)`` of the fragment stage for the i-th output of a pass.

    format : key of :data:`blinkgl.gl.FORMATS`.
    components : how many of its format's are returned, the first ones; 0: all."""

    name: str
    format: str
    components: int = 0


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
            # The union may meet a third one, hence the loop.
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

    def __init__(self, memory: Memory, number: int, moment: Moment, changed: list[Rectangle] | None):
        self._memory, self._number, self.moment, self.changed = memory, number, moment, changed

    @property
    def t_ns(self) -> int:
        return self.moment.t_ns

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(output.name for output in self._memory.outputs)

    @property
    def width(self) -> int:
        return self._memory.target.width

    @property
    def height(self) -> int:
        return self._memory.target.height

    @property
    def target(self) -> Target:
        """Return the target that it was drawn into, for a pass that resolves or copies it."""
        return self._live.target

    def texture(self, output: str = "") -> moderngl.Texture:
        """Return the texture of an output (default: the first), or of :data:`DEPTH_BUFFER`, for another pass: as the
        program wrote it, with all components of its format."""
        if output == DEPTH_BUFFER:
            depth = self.target.depth
            if not isinstance(depth, moderngl.Texture):
                raise GLError(
                    "the pass has no readable depth buffer",
                    where=self._memory.name,
                    value=output,
                    accepted='one with `depth = "texture"`',
                )
            return depth
        return self.target.colour[self._memory.attachment(output)]

    def read(self, name: str = "", out: np.ndarray | None = None) -> np.ndarray:
        """Return a copy of an output, (H, W) or (H, W, C), dtype of its format; row 0 is the top row.

        out : written and returned when given (C-contiguous, that shape and dtype)."""
        return self._live.read(name, out)

    def view(self, name: str = "") -> np.ndarray:
        """Return an output as a read-only array in memory of the renderer that the next frame overwrites: no
        allocation, and only changed parts are transferred. Copy it to keep it."""
        return self._live.view(name, self)

    def tensor(self, device: object = "cuda", name: str = "") -> Any:
        """Return an output as a new torch tensor, (H, W) or (H, W, C), dtype of its format.

        device : torch's. On the GPU that draws it, the picture stays there if CUDA can share it; see
        :mod:`blinkgl.render.tensors`, and :meth:`transfer` for the way used.
        Raises GLError: no torch, no such device, no such output."""
        return self._live.tensor(device, name)

    def transfer(self, device: object = "cuda", name: str = "") -> str:
        """Return the way of :meth:`tensor`: "interop", "pinned" or "plain", with the reason why no faster way is
        used."""
        reader = self._live.reader(device, name)
        return f"{reader.way}: {reader.why}" if reader.why else reader.way

    def changed_since(self, before: Frame | None) -> list[Rectangle] | None:
        """Return rectangles outside which this frame equals ``before``; None: it may differ anywhere, because only
        consecutive frames of one pass are compared."""
        if before is None:
            return None
        # Another of its own class: private members may be used.
        follows = before._memory is self._memory and before._number == self._number - 1  # noqa: SLF001
        return self.changed if follows else None

    def rows_changed_since(self, before: Frame | None) -> tuple[int, int] | None:
        """Return (y0, y1): outside these rows it equals ``before``; None: it may differ anywhere."""
        changed = self.changed_since(before)
        if changed is None:
            return None
        return (min(r.y0 for r in changed), max(r.y1 for r in changed)) if changed else (0, 0)

    @property
    def _live(self) -> Memory:
        """Return the memory, which still holds this frame."""
        if self._memory.number != self._number:
            raise GLError(
                "this frame is no longer on the GPU: its pass has drawn another one",
                where=f"frame at {self.t_ns * 1e-9:.9g} s",
                accepted="read() before the next frame is drawn",
            )
        return self._memory


class Memory:
    """What one pass of one renderer has drawn last. name : of the pass, for errors.
    number : of the last frame; -1 after release."""

    def __init__(self, painter: Painter, target: Target, outputs: tuple[Output, ...], name: str):
        self.painter, self.target, self.outputs, self.name = painter, target, outputs, name
        self.number = 0
        self._held: dict[int, tuple[int, np.ndarray]] = {}  # attachment -> number of the stored frame, and its picture
        self._readers: dict[tuple[int, str], TextureReader] = {}  # by attachment and device

    def attachment(self, output: str) -> int:
        """Return the number of an output (default: the first). Raises GLError."""
        names = [o.name for o in self.outputs]
        if not names or (output and output not in names):
            raise GLError(
                "the pass has no such output",
                where=self.name,
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
            # Formats have one, two or four components; those beyond ``components`` are read and left out.
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

    def reader(self, device: object, name: str) -> TextureReader:
        """Return the reader of an attachment into tensors of a device; made when first needed."""
        i = self.attachment(name)
        if (i, str(device)) not in self._readers:
            self.painter.gl.resume()
            self.painter.finish()
            self._readers[i, str(device)] = TextureReader(self.painter.gl, self.target, i, device)
        return self._readers[i, str(device)]

    def tensor(self, device: object, name: str) -> Any:
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
