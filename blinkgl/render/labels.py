"""What a row of the labels may read to finish its value: buffers drawn at the label's times."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from blinkgl.labels import Flow, Label, LabelFrame
from blinkgl.render.boxes import boxes_of
from blinkgl.render.occlusion import flow_and_reach, occlusion_mask
from blinkgl.scene.types import Scene
from blinkgl.types.boxes import Boxes


@dataclass(frozen=True, eq=False)
class Seen:
    """Everything drawn of one time. drawn : buffers.   ends : the other times of labels, ns, by ``towards``.
    there : buffers at those times.   leading : frames of labels over intervals, by interval."""

    t_ns: int
    drawn: dict[str, np.ndarray]
    ends: dict[str, int]
    there: dict[str, dict[str, np.ndarray]]
    leading: dict[int, LabelFrame]
    categories: tuple[tuple[str, int], ...]


class DrawnLabel:
    """The :class:`blinkgl.labels.label.Drawn` of one label: what it may read."""

    def __init__(self, label: Label, scene: Scene, seen: Seen, value_of: Callable[[str], Any]):
        towards = label.towards or ""
        self.scene, self.t_ns, self.end_ns = scene, seen.t_ns, seen.ends.get(towards)
        self.categories = seen.categories
        self.leading: Mapping[int, Any] = seen.leading if label.each else {}
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
