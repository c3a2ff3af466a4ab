"""Ground truth at one time: the buffers of the label pass, finished by the rows of the labels, which may read the
buffers of other times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from blinkgl.camera import PinHole
from blinkgl.labels import LABELS, Flow, Label, LabelFrame, LabelRequest
from blinkgl.machine.compiling import working_clock
from blinkgl.render.boxes import boxes_of
from blinkgl.render.canvas import Frame
from blinkgl.render.moment import Moment, View
from blinkgl.render.occlusion import flow_and_reach, occlusion_mask
from blinkgl.render.passes import Geometry
from blinkgl.scene.types import Scene
from blinkgl.types.boxes import Boxes

if TYPE_CHECKING:
    from blinkgl.render.renderer import Renderer

KEPT = 3
"""Number of times whose buffers are kept: neighbouring labels use the same moments."""


class Labels:
    """Makes the label frames of one renderer. camera : of another picture at the same place; None: the scene's."""

    def __init__(self, renderer: Renderer, camera: PinHole | None = None):
        self._renderer, self._view = renderer, None if camera is None else View.of(camera)
        self.scene = renderer.scene if camera is None else renderer.scene.with_camera(camera)
        self._kept: dict[tuple[int, tuple[str, ...]], dict[str, np.ndarray]] = {}

    def frame(self, t_ns: int, request: LabelRequest, forward_ns: int | None, backward_ns: int | None) -> LabelFrame:
        """Return the label frame; see :meth:`Renderer.labels`."""
        draw = self._renderer
        ends: dict[str, int] = {}
        for towards, end_ns in (("forward", forward_ns), ("backward", backward_ns)):
            if who := [name for name in request if LABELS[name].towards == towards]:
                if end_ns is None:
                    raise TypeError(f"label '{who[0]}' leads to another time: t_{towards}_ns")
                ends[towards] = end_ns
        there = {
            towards: self._buffers(end_ns, names)
            for towards, end_ns in ends.items()
            if (names := LabelRequest(*(name for name in request if LABELS[name].towards == towards)).there)
        }
        each = request.each
        leading = {ns: self.frame(t_ns, each, t_ns + ns, None) for ns in request.intervals_ns} if each else {}
        drawn: dict[str, np.ndarray] = {}
        if names := request.buffers:
            frame = self._drawn(names, t_ns, ends)
            drawn = {name: frame.read(name) for name in names}
        values: dict[str, Any] = {}
        for name in request:
            if LABELS[name].anti_aliased:
                at = self._moment(t_ns)
                values[name] = (draw.colour(t_ns) if self._view is None else draw.flat_colour(at)).read()
        started = working_clock()
        for name in request:
            self._finished(name, _Seen(t_ns, drawn, ends, there, leading, request.categories), values)
        draw.stats.render_s += working_clock() - started
        return LabelFrame(t_ns, {name: values[name] for name in request})

    def _finished(self, name: str, seen: _Seen, values: dict[str, Any]) -> Any:
        if name not in values:
            label = LABELS[name]
            value = label.finish(_Drawn(label, self.scene, seen, lambda other: self._finished(other, seen, values)))
            camera = self.scene.camera
            if (wrong := label.wrong(value, camera.height, camera.width)) is not None:
                raise TypeError(f"label '{name}': `finish` gives {wrong}")
            values[name] = value
        return values[name]

    def shown_at(self, x: int, y: int, t_ns: int) -> str:
        """Return the text of :meth:`Renderer.shown_at`."""
        number = int(self._buffers(t_ns, LabelRequest("ids").buffers)["ids"][y, x])
        names = [
            f"object '{o.name}' (id {number})"
            for o in self._renderer.scene.objects
            if number and o.instance_id == number
        ]
        return names[0] if names else "the background"

    def _moment(self, t_ns: int) -> Moment:
        moment = self._renderer.moment(t_ns)
        return moment if self._view is None else moment.through(self._view)

    def _drawn(self, names: tuple[str, ...], t_ns: int, ends: dict[str, int]) -> Frame:
        draw = self._renderer
        pass_ = draw.geometry(names) if self._view is None else Geometry(names)
        return draw.draw(pass_, self._moment(t_ns), {name: self._moment(t) for name, t in ends.items()})

    def _buffers(self, t_ns: int, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        """Return buffers of these labels at a time, as the shader wrote them."""
        key = (t_ns, names)
        if key not in self._kept:
            frame = self._drawn(names, t_ns, {})
            self._kept[key] = {name: frame.read(name) for name in names}
            # Neighbouring labels use the same moments; the oldest is dropped first.
            while len(self._kept) > KEPT:
                self._kept.pop(next(iter(self._kept)))
        return self._kept[key]


@dataclass(frozen=True, eq=False)
class _Seen:
    """Everything drawn of one time. drawn : buffers.   ends : the other times of labels, ns, by ``towards``.
    there : buffers at those times.   leading : frames of labels over intervals, by interval."""

    t_ns: int
    drawn: dict[str, np.ndarray]
    ends: dict[str, int]
    there: dict[str, dict[str, np.ndarray]]
    leading: dict[int, LabelFrame]
    categories: tuple[tuple[str, int], ...]


class _Drawn:
    """The :class:`blinkgl.labels.label.Drawn` of one label: what it may read."""

    def __init__(self, label: Label, scene: Scene, seen: _Seen, value_of: Callable[[str], Any]):
        towards = label.towards or ""
        self.scene, self.t_ns, self.end_ns = scene, seen.t_ns, seen.ends.get(towards)
        self.categories = seen.categories
        self.leading = seen.leading if label.each else {}
        self._label, self._drawn, self._there = label, seen.drawn, seen.there.get(towards, {})
        self._value_of = value_of

    def raw(self, name: str) -> np.ndarray:
        return self._allowed(self._drawn, name, (self._label.name, *self._label.needs), "needs")

    def value(self, name: str) -> Any:
        self.raw(name)
        return self._value_of(name)

    def there(self, name: str) -> np.ndarray:
        return self._allowed(self._there, name, self._label.there, "there")

    def flow(self, name: str) -> Flow:
        return Flow(*flow_and_reach(self.raw(name)))

    def occlusion(self, flow: str) -> np.ndarray:
        assert self.end_ns is not None
        value, z_there = self.value(flow), self.raw(flow)[..., 2]
        there = self.there("depth"), self.there("ids")
        return occlusion_mask(self.scene, self.end_ns, value.flow, z_there, value.valid, self.raw("ids"), *there)

    def boxes(self) -> Boxes:
        return boxes_of(self.scene, self.t_ns, self.raw("ids"), self.categories)

    def _allowed(self, buffers: dict[str, np.ndarray], name: str, known: tuple[str, ...], part: str) -> np.ndarray:
        if name not in known or name not in buffers:
            raise TypeError(f"label '{self._label.name}': `finish` looks at '{name}', which is not among its `{part}`")
        return buffers[name]
