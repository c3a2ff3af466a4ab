"""Base class of labels: one class holds everything about one kind of ground truth.

A row of the table is an instance. :class:`Label` lists its attributes in the order of processing: configuration,
shader, CPU, files, reference. docs/extending.md has a complete example; :func:`blinkgl.labels.register` names what is
missing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

import numpy as np

from blinkgl.config.labels import LabelsConfig
from blinkgl.errors import AssetError
from blinkgl.labels import files, grading
from blinkgl.labels.files import Form
from blinkgl.scene.types import Scene
from blinkgl.types.boxes import Boxes

if TYPE_CHECKING:
    from blinkgl.labels.values import Flow

Towards = Literal["forward", "backward"]


class Buffer(NamedTuple):
    """A pixel of a shader's output: GLSL's type, components, dtype as read back."""

    glsl: str
    components: int
    dtype: np.dtype

    @property
    def bytes(self) -> int:
        return self.components * self.dtype.itemsize


BUFFERS = {
    "R32F": Buffer("float", 1, np.dtype(np.float32)),
    "RG32F": Buffer("vec2", 2, np.dtype(np.float32)),
    "RGBA32F": Buffer("vec4", 4, np.dtype(np.float32)),
    "R32UI": Buffer("uint", 1, np.dtype(np.uint32)),
}
VARYINGS = ("local", "normal", "rate", "forward", "backward")
_NUMBERS = {"f": "real", "u": "whole", "i": "whole", "b": "truth"}
KINDS = ("scalar", "depth", "signed", "ids", "mask", "light", "unit", "motion")


class Shot(Protocol):
    """What is drawn, as a label's uniforms see it: :class:`blinkgl.render.passes.base.Shot`. ends : moments at other
    times, by name ("forward", "backward")."""

    @property
    def moment(self) -> Any: ...
    @property
    def ends(self) -> Mapping[str, Any]: ...
    @property
    def scene(self) -> Scene: ...


class ReferenceFrame(Protocol):
    """What float64 rays through the pixel centres hit, (H, W, ...); :mod:`blinkgl.tools.shader_debugger.reference`
    makes it, and tests and the shader debugger compare the labels with it."""

    t_ns: int
    hit: np.ndarray
    depth: np.ndarray
    instance: np.ndarray
    normal: np.ndarray
    xy: np.ndarray
    velocity: np.ndarray

    def scene_flow(self, scene: Scene) -> np.ndarray:
        """Return (H, W, 3) world units to the forward flow's time; 0 where nothing is hit."""
        ...


@dataclass(frozen=True)
class View:
    """One array of a label that is shown and graded separately; most labels have only one.

    name, title, unit, kind : as of :class:`Label`.   of : the array (H, W[, C]) in a value.   reference : its correct
    value, from a scene and a :class:`ReferenceFrame`.   judged_in, tolerance : unit of its error, and the largest error
    that passes.
    error : (drawn, true, label interval in s) -> (H, W) >= 0.   statistic : "max" of the pixels' errors, or their
    "mean".
    same_triangle : compare only where both see the same triangle.   note : remark beside the result."""

    name: str
    title: str
    unit: str
    kind: str
    of: Callable[[Any], np.ndarray]
    reference: Callable[[Scene, ReferenceFrame], np.ndarray]
    judged_in: str
    tolerance: float
    error: Callable[[np.ndarray, np.ndarray, float], np.ndarray] = grading.absolute
    statistic: Literal["max", "mean"] = "max"
    same_triangle: bool = True
    note: str = ""


class Drawn(Protocol):
    """Input of :meth:`Label.finish`: the buffers of one time as the shader wrote them.

    scene : as it is drawn.   end_ns : the time that this label leads to; None: it is of one time.
    categories : pattern of names and number of the category, in order.
    t_ns : the time.   leading : for a label with ``each``, interval in ns -> frame of those labels over it. raw(name) :
    (H, W[, C]) buffer of a label, its own or one of ``needs``.   value(name) : that label's value. there(name) : buffer
    of a label in ``there``, at the time that this label leads to.
    flow(name) : the flow in a label's buffer.   occlusion(flow) : (H, W) bool, where the points of that flow's label
    are hidden at its end; needs "ids", and "depth" and "ids" there.   boxes() : of the objects; needs "ids"."""

    scene: Scene
    t_ns: int
    end_ns: int | None
    categories: tuple[tuple[str, int], ...]
    leading: Mapping[int, Any]

    def raw(self, name: str) -> np.ndarray: ...

    def value(self, name: str) -> Any: ...

    def there(self, name: str) -> np.ndarray: ...

    def flow(self, name: str) -> Flow: ...

    def occlusion(self, flow: str) -> np.ndarray: ...

    def boxes(self) -> Boxes: ...


class Label:
    """One kind of ground truth.

    A label that the shader draws says ten things and nothing else: ``name``, ``about``, ``unit``; ``buffer``, ``glsl``,
    ``varyings``, ``channels`` and ``uniforms``; ``reference`` and ``tolerance``. All the rest has a default, and is for
    labels that are made of others, lead to another time, lie on disk in several forms, or are no picture.

    What it is called
        name : key of ``labels:`` (unless ``asked`` looks at another), folder, attribute of a
        :class:`~blinkgl.labels.LabelFrame`.
        about : what it is and how it is written, for the page of keys; of a label that ``config/labels.py`` has no key
        of.
        title, unit : for tables.   kind : how a picture shows it, one of KINDS.
        off : what ``explain`` says of it when it is not asked for.

    What is drawn
        buffer : a key of BUFFERS; None: no output of the label shader.
        glsl : source of ``TYPE label_NAME()``, TYPE being the buffer's, with uniforms of its own and, by name,
        ``local`` (object-local position) and ``facing()`` (the surface's normal, object axes, on the camera's side),
        where ``varyings`` names "local" or "normal", and ``#include``; None: it stands in
        ``shaders/include/labels/NAME.glsl``. "rate", "forward", "backward": how a shape that changes with time moves
        (``DEFORM`` is defined then), as ``shaders/include/vertex.glsl`` says; "rate" is all that ``velocity()`` needs.
        of_shapes : uniforms that its ``glsl`` has of shapes that change (``DEFORM``) alone.
        needs : labels whose buffers are drawn with it.   there : labels whose buffers it reads at the other time.
        towards : "forward" or "backward": it leads from one label's time to the next or the
        one before; None: it is of one time.
        each : labels that lead forward, and are drawn for it once per interval of the request instead
        (:meth:`intervals`).
        anti_aliased : drawn by the colour pass instead, by the configuration's filter.   at_last :
        there at the end of the last interval, too.

    What it is
        channels : 0 for (H, W), n for (H, W, n); None: either (H, W) or (H, W, 3).   dtype : None: any.

    Files
        forms : how it lies on disk; the first is always written.   stamps : file of
        times, a line per label; None: none.
        shard : ending of its file in a shard; None: not there.

    The reference
        tolerance, judged_in, error … : as of :class:`View`."""

    name: str
    about: str = ""
    title: str = ""
    unit: str = ""
    kind: str = "scalar"
    off: str = ""

    buffer: str | None = None
    glsl: str | None = None
    varyings: tuple[str, ...] = ()
    of_shapes: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    there: tuple[str, ...] = ()
    towards: Towards | None = None
    each: tuple[str, ...] = ()
    anti_aliased: bool = False
    at_last: bool = False

    channels: int | None = 0
    dtype: Any = np.float32

    stamps: str | None = None
    shard: str | None = None

    tolerance: float
    judged_in: str = ""
    error = staticmethod(grading.absolute)

    @property
    def heading(self) -> str:
        return self.title or self.name

    # ---- configuration -------------------------------------------------------------------------------------------

    def asked(self, labels: LabelsConfig) -> bool:
        """Return whether ``labels:`` requests it."""
        return bool(getattr(labels, self.name))

    @property
    def said(self) -> str:
        """Return its name in Python calls, ``labels=["depth", …]``, which is the word that requests it in a YAML."""
        return self.name

    def intervals(self, labels: LabelsConfig) -> tuple[int, ...]:
        """Return, for a label with ``each``, its intervals from the label's time, ns, increasing."""
        return ()

    def categories(self, labels: LabelsConfig) -> tuple[tuple[str, int], ...]:
        """Return, for a label of object categories, pattern of names and number, in order."""
        return ()

    def check(self, scene: Scene, labels: LabelsConfig) -> None:
        """Raise ConfigError for requests in ``labels:`` that the scene cannot give."""

    def facts(self, scene: Scene, labels: LabelsConfig) -> dict[str, object]:
        """Return further entries of the manifest, by key: plain values."""
        return {}

    def ask(self, tree: dict[str, object]) -> None:
        """Request it in a tree of ``labels:``."""
        tree[self.name] = True

    def can_be_of(self, scene: Scene) -> bool:
        """Return whether it is defined for a scene; otherwise the shader debugger leaves it out."""
        return True

    # ---- the shader and the CPU ----------------------------------------------------------------------------------

    def uniforms(self, shot: Shot) -> Mapping[str, np.ndarray]:
        """Return values of the uniforms in ``glsl``, once per frame: name -> array whose first axis counts the scene's
        objects, (n,), (n, k) for a vector, (n, rows, columns) for a matrix. ``shot.moment`` has the poses and matrices,
        ``shot.ends[towards]`` those of the other time."""
        return {}

    def finish(self, drawn: Drawn) -> Any:
        """Return the label's value, of ``channels`` and ``dtype``, from the buffers."""
        raw = drawn.raw(self.name)
        return np.ascontiguousarray(raw[..., : self.channels]) if self.channels else raw

    def wrong(self, value: Any, height: int, width: int) -> str | None:
        """Return what is wrong with the shape or number type of a value, in words; None: nothing."""
        # Checked on every label: what `finish` of a plug-in gives has never been seen before.
        array = np.asarray(value)
        if array.shape[:2] != (height, width):
            return f"not {width}x{height} px: {array.shape}"
        shapes = (
            [(height, width), (height, width, 3)]
            if self.channels is None
            else [(height, width, self.channels) if self.channels else (height, width)]
        )
        # Only the kind of number matters here; :meth:`own` converts the width.
        kind = "" if self.dtype is None else np.dtype(self.dtype).kind
        if array.shape not in shapes or (kind and _NUMBERS.get(array.dtype.kind) != _NUMBERS[kind]):
            kind_words = f" {np.dtype(self.dtype)}" if kind else ""
            return f"{array.shape} {array.dtype} and not {' or '.join(map(str, shapes))}{kind_words}"
        if kind in ("u", "i") and array.dtype != self.dtype and array.size:
            limits = np.iinfo(str(np.dtype(self.dtype)))
            if int(array.min()) < limits.min or int(array.max()) > limits.max:
                return f"{array.min()} to {array.max()} and not {limits.min} to {limits.max}"
        return None

    def read(self, path: Path, form: Form, height: int, width: int) -> Any:
        """Return the value in a file of one of ``forms``, of a sequence of that size. Raises AssetError: damaged, or of
        another size or type."""
        assert form.read is not None, form.folder
        value = form.read(path)
        if (problem := self.wrong(value, height, width)) is not None:
            raise AssetError(f"not of this sequence: {problem}", where=str(path))
        return value

    def own(self, value: Any) -> Any:
        """Return a copy of a value, as it is written."""
        array = np.array(value)
        return array if self.dtype is None else array.astype(self.dtype, copy=False)

    # ---- files ---------------------------------------------------------------------------------------------------

    @property
    def forms(self) -> tuple[Form, ...]:
        return (files.npy(self.name),)

    def written(self, labels: LabelsConfig) -> tuple[Form, ...]:
        """Return those of ``forms`` that ``labels:`` requests; the label itself is requested."""
        return self.forms

    def drawn_on(self, picture: np.ndarray, value: Any) -> np.ndarray | None:
        """Return (H, W, 3) uint8: the value drawn over a picture, for a label that is not a picture itself; else
        None."""
        return None

    # ---- the reference -------------------------------------------------------------------------------------------

    def reference(self, scene: Scene, frame: ReferenceFrame) -> np.ndarray:
        """Return its correct value, (H, W[, C]) float64, from the float64 reference's hits; 0 or inf where nothing is
        hit, as in ``finish``."""
        raise NotImplementedError

    @property
    def views(self) -> tuple[View, ...]:
        """Return what the shader debugger shows and grades."""
        return (
            View(
                name=self.name,
                title=self.heading,
                unit=self.unit,
                kind=self.kind,
                of=lambda value: value,
                reference=self.reference,
                judged_in=self.judged_in or self.unit,
                tolerance=self.tolerance,
                error=self.error,
            ),
        )
