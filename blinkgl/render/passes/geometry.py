"""The label pass, which draws any subset of the shader's labels at once; and the small picture of velocity."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from blinkgl.gl.shader import MADE, ShaderError
from blinkgl.labels import LABELS
from blinkgl.labels.table import define_of, includes
from blinkgl.render.moment import Moment, rows_xyw_bytes
from blinkgl.render.passes.base import Output, Pass, ScenePass, Shot

if TYPE_CHECKING:
    from blinkgl.gl.shader import Uniforms
    from blinkgl.render.draw_items import DrawItem, Kind
    from blinkgl.render.painter import Painter


MADE.append(includes)
LENS_UNIT = 7
"""Texture unit of the sample offsets of a lens's pixels."""
MOST_BUFFERS = 8
"""Number of outputs that every OpenGL 4 has (GL_MAX_DRAW_BUFFERS)."""
# Uniforms that a label may not give; "" is the program itself in a table of uniforms.
_OF_THE_PASS = {
    "", "mvp", "inverse_depths", "image_size", "clip_rate", "clip_forward", "clip_backward", "coverage", "cutoff",
    "lens_claims", "target_size", "lens_plane", "lens_focal", "lens_limit", "lens_k",
}  # fmt: skip


@dataclass(frozen=True)
class Geometry(ScenePass):
    """Outputs by the names of their labels, as the shader writes them; 0 where nothing is hit. One sample, at the
    pixel's centre. Labels that lead to another time need the moment there, "forward" or "backward".

    lens : macro of the camera model for which the pinhole picture is drawn: fragments are evaluated where its pixels'
    rays pass (:mod:`blinkgl.render.lens`), and motion is in its pixels; "": the pinhole camera's own picture.

    Raises TypeError, at the first frame, for a label whose ``uniforms`` are not those of its ``glsl``."""

    names: tuple[str, ...] = ("depth",)
    lens: str = ""
    program: ClassVar[str] = "label.glsl"

    @property
    def outputs(self) -> tuple[Output, ...]:
        return tuple(Output(name, LABELS[name].buffer or "") for name in self.names)

    def defines(self, kind: Kind | None) -> dict[str, Any]:
        through = {"LENS": 1, "LENS_CLAIMS": 1, "GEOMETRY_STAGE": 1, self.lens: 1} if self.lens else {}
        return {define_of(name): i for i, name in enumerate(self.names)} | through

    def paint(self, painter: Painter, shot: Shot, items: Iterable[DrawItem] | None = None) -> None:
        programs, values = self.programs(painter), self._values(shot)
        # Uniforms that only programs of changing shapes have.
        of_shapes = {name for label in self.names for name in LABELS[label].of_shapes}
        checked = set()
        for item in self.items(shot.moment) if items is None else items:
            uniforms = programs[item.kind]
            # Once per kind and frame: programs of one kind have the same uniforms.
            if item.kind not in checked:
                checked.add(item.kind)
                own = {k: v for k, v in values.items() if item.deformer is not None or k not in of_shapes}
                self._check(uniforms, own, item)
            self.dress_item(painter, shot, item, uniforms)
            # Values of the labels, of this item's object.
            for name, (_, rows) in values.items():
                if item.deformer is None and name in of_shapes:
                    continue
                uniforms[name].write(rows[item.object_index])
            painter.draw(uniforms, item, shot.moment.t_ns)

    def set(self, painter: Painter, uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
        for name in ("image_size", "target_size"):
            if name in uniforms:
                uniforms[name].value = shot.size
        # Uniforms of the lens: the ray through a fragment, and its model.
        if self.lens:
            assert painter.lens is not None
            painter.lens.set(uniforms, shot.moment, LENS_UNIT)

    def _values(self, shot: Shot) -> dict[str, tuple[str, list[bytes]]]:
        """Return uniform -> the label that gives it, and its bytes for each object."""
        count, values = len(shot.scene.objects), {}
        for label in (LABELS[name] for name in self.names):
            uniforms = label.uniforms(shot)
            for name, array in uniforms.items():
                array = np.asarray(array)
                if array.ndim not in (1, 2, 3) or len(array) != count:
                    raise TypeError(
                        f"label '{label.name}': `uniforms` gives '{name}' of shape {array.shape}, which does not "
                        f"begin with the {count} objects"
                    )
                if name in values or name in _OF_THE_PASS:
                    raise TypeError(
                        f"label '{label.name}': `uniforms` gives '{name}', which "
                        f"{values[name][0] if name in values else 'the pass'} gives, too"
                    )
                # GLSL stores matrices by columns.
                columns = np.swapaxes(array, 1, 2) if array.ndim == 3 else array
                kind = {"u": np.uint32, "i": np.int32}.get(array.dtype.kind, np.float32)
                values[name] = (label.name, [row.tobytes() for row in np.ascontiguousarray(columns, kind)])
        return values

    def _check(self, uniforms: Uniforms, values: dict[str, tuple[str, list[bytes]]], item: DrawItem) -> None:
        """Check that every uniform of the program is given, and no other (shaders that are being edited may have
        fewer)."""
        of_the_shape = item.deformer.textures if item.deformer is not None else ()
        if missing := uniforms.keys() - values.keys() - _OF_THE_PASS - {*of_the_shape}:
            name = min(missing)
            whose = [f"'{one}'" for one in self.names if name in (LABELS[one].glsl or "")]
            raise TypeError(
                f"label {whose[0] if len(whose) == 1 else ' or '.join(map(repr, self.names))}: `uniforms` gives no "
                f"'{name}'"
            )
        for name, (label, _) in values.items():
            # A uniform that the compiler removed is not in the program.
            try:
                uniforms[name]
            except ShaderError:
                # An edited file of the shader folder is not an error of the label's class.
                if LABELS[label].glsl is None:
                    raise
                raise TypeError(f"label '{label}': `uniforms` gives '{name}', which its `glsl` does not use") from None

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        """Yield each label alone, so that missing declarations show, and all at once, so that conflicts show; all
        subsets would be too many."""
        drawn = [name for name, label in LABELS.items() if label.buffer]
        yield from (cls((name,)) for name in drawn)
        yield cls(tuple(drawn[:MOST_BUFFERS]))
        yield from (cls(tuple(drawn[:MOST_BUFFERS]), lens) for lens in ("RADTAN", "EQUIDISTANT"))


# ---------------------------------------------------------------------------------------------------------------------
# Image velocity for the time sampling and the preview.


@dataclass(frozen=True)
class Velocity(ScenePass):
    """Output "velocity", (h, w, 2) float32 px/s of the full-size image, 0 where nothing is hit, on every n-th pixel in
    x and y.
    moving_only : leaves out objects that stand still, also where they hide something.
    lens : macro of the camera model whose pixels are used, where a pinhole picture is drawn for it."""

    every: int = 1
    moving_only: bool = False
    lens: str = ""
    program: ClassVar[str] = "velocity.glsl"
    outputs: ClassVar[tuple[Output, ...]] = (Output("velocity", "RG32F"),)

    def items(self, moment: Moment) -> list[DrawItem]:
        return [item for item in moment.visible if item.moves] if self.moving_only else moment.visible

    def defines(self, kind: Kind | None) -> dict[str, Any]:
        return ({} if self.every == 1 else {"SMALL": 1}) | ({"LENS": 1, self.lens: 1} if self.lens else {})

    def set(self, painter: Painter, uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
        width, height = shot.size
        uniforms["rate"].write(rows_xyw_bytes(shot.moment.rates.mvp[item.object_index]))
        uniforms["image_size"].value = width, height
        if self.lens:
            assert painter.lens is not None
            # With a lens, motion is in its own pixels at any size, so there is no scale.
            painter.lens.set(uniforms, shot.moment, 0)
        elif self.every != 1:
            camera = shot.moment.view.camera
            uniforms["image_scale"].write(np.array([camera.width / width, camera.height / height], np.float32))

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        return (cls(every, lens=lens) for every in (1, 4) for lens in ("", "RADTAN", "EQUIDISTANT"))
