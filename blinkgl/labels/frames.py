"""Requests for labels, and the frames that the renderer returns."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from blinkgl.config.labels import LabelsConfig
from blinkgl.labels.table import LABELS, label_of
from blinkgl.labels.values import Flow


class LabelRequest:
    """The labels that :meth:`Renderer.labels` returns, by name: ``LabelRequest("depth", "flow_forward")``; others are
    not computed.

    intervals_ns : intervals of the labels that lead to several times, "flow_intervals".
    categories : pattern of names and number of the category, for labels of object categories.
    Iterating gives the names in the order of the table. Raises KeyError: no such label."""

    def __init__(self, *names: str, intervals_ns: Iterable[int] = (), categories: tuple[tuple[str, int], ...] = ()):
        asked = {label_of(name).name for name in names}
        self.names = tuple(name for name in LABELS if name in asked)
        self.intervals_ns, self.categories = tuple(intervals_ns), categories

    @property
    def buffers(self) -> tuple[str, ...]:
        """Return the labels whose shader outputs must be drawn, in the order of the table."""
        # In the table's order, not the request's: equal requests share one pass.
        drawn = {other for name in self.names for other in (name, *LABELS[name].needs)}
        return tuple(name for name, label in LABELS.items() if name in drawn and label.buffer)

    @property
    def there(self) -> tuple[str, ...]:
        """Return the labels whose shader outputs must be drawn at the other times."""
        drawn = {other for name in self.names for other in LABELS[name].there}
        return tuple(name for name in LABELS if name in drawn)

    @property
    def each(self) -> LabelRequest:
        """Return the request for labels that are drawn once per interval."""
        return LabelRequest(*(other for name in self.names for other in LABELS[name].each))

    def only(self, names: Iterable[str]) -> LabelRequest:
        """Return the request for these names only."""
        return LabelRequest(*names, intervals_ns=self.intervals_ns, categories=self.categories)

    def without(self, *names: str) -> LabelRequest:
        return self.only(name for name in self.names if name not in names)

    def within(self, before_ns: int, after_ns: int) -> LabelRequest:
        """Return the request with only the intervals that end in [before_ns, after_ns], as in :func:`ending_within`."""
        there = ending_within(self.intervals_ns, before_ns, after_ns)
        return LabelRequest(*self.names, intervals_ns=there, categories=self.categories)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def __bool__(self) -> bool:
        return bool(self.names)

    @property
    def _said(self) -> tuple:
        return self.names, self.intervals_ns, self.categories

    def __eq__(self, other: object) -> bool:
        return isinstance(other, LabelRequest) and self._said == other._said

    def __hash__(self) -> int:
        return hash(self._said)

    def __repr__(self) -> str:
        names = [repr(name) for name in self.names]
        return (
            f"LabelRequest({', '.join([*names, f'intervals_ns={self.intervals_ns}'] if self.intervals_ns else names)})"
        )


def asked_for(labels: LabelsConfig) -> LabelRequest:
    """Return the request of ``labels:``."""
    asked = [name for name, label in LABELS.items() if label.asked(labels)]
    intervals = {ns for name in asked for ns in LABELS[name].intervals(labels)}
    categories = next((classes for name in asked if (classes := LABELS[name].categories(labels))), ())
    return LabelRequest(*asked, intervals_ns=sorted(intervals), categories=categories)


def ending_within(intervals_ns: Iterable[int], before_ns: int, after_ns: int) -> list[int]:
    """Return the intervals that end in [before_ns, after_ns], with a tolerance of 1 µs: label times are rounded to ns,
    and a multiple of 1/30 s differs from that of the label interval."""
    # Times of files are whole microseconds: an interval may end up to one beyond the sequence, and is then
    # cut at its end.
    there = {min(max(ns, before_ns), after_ns) for ns in intervals_ns if before_ns - 1000 < ns < after_ns + 1000}
    return sorted(there - {0})


class LabelFrame:
    """Ground truth at t_ns. Every requested label is an attribute of its name; the others are None.

    colour : (H, W, 3) float32 linear radiance (label "images").
    depth : (H, W) float32 Z along the optical axis; inf: nothing hit.   ids : (H, W) uint32; 0: nothing hit.
    normals : (H, W, 3) float32 unit, camera axes (OpenCV), facing the camera.
    velocity : (H, W, 2) float32 px/s at t.
    flow_intervals : :class:`~blinkgl.labels.intervals.Flows` over the configured intervals.
    forward, backward : :class:`Flow`, with the occlusion mask if requested.
    values : all of them by the name of the label."""

    def __init__(self, t_ns: int, values: dict[str, Any]):
        self.t_ns, self.values = t_ns, values

    def __getattr__(self, name: str) -> Any:
        if name != "values" and (name in self.values or name in LABELS):
            return self.values.get(name)
        raise AttributeError(f"no label '{name}'; there are {', '.join(LABELS)}")

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *LABELS]

    @property
    def colour(self) -> np.ndarray | None:
        return self.values.get("images")

    @property
    def forward(self) -> Flow | None:
        return self._flow("forward")

    @property
    def backward(self) -> Flow | None:
        return self._flow("backward")

    def _flow(self, towards: str) -> Flow | None:
        flow = self.values.get(f"flow_{towards}")
        return None if flow is None else Flow(flow.flow, flow.valid, self.values.get(f"occlusion_{towards}"))
