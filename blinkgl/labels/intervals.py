"""Flow from each label's time over chosen intervals, for example hundredths of a second beside tenths, or many
consecutive ones (continuous flow). It is drawn as forward flow, once per interval."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from blinkgl.config.labels import LabelsConfig
from blinkgl.labels.files import Form
from blinkgl.labels.flow import seconds_of
from blinkgl.labels.label import Drawn, Label
from blinkgl.labels.values import Flow
from blinkgl.types.trees import Tree


@dataclass(frozen=True, eq=False)
class Flows:
    """Flow from one time to K others.

    t_ns : the label's time.   interval_ns : (K,) int64, increasing, negative: back.
    flow : (K, H, W, 2) float32 px, 0 where not valid.   valid : (K, H, W) bool."""

    t_ns: int
    interval_ns: np.ndarray
    flow: np.ndarray
    valid: np.ndarray

    def over(self, seconds: float) -> Flow:
        """Return the flow over this interval, to the nearest microsecond. Raises KeyError: it is not among them."""
        k = int(np.argmin(np.abs(self.interval_ns - seconds * 1e9))) if len(self.interval_ns) else -1
        # 500 ns are half a microsecond.
        if k < 0 or abs(self.interval_ns[k] - seconds * 1e9) > 500:
            there = ", ".join(f"{ns * 1e-9:.9g}" for ns in self.interval_ns)
            raise KeyError(f"no flow over {seconds} s; there is flow over {there or 'none'} s")
        return Flow(self.flow[k], self.valid[k])


@dataclass(frozen=True, eq=False)
class Occlusions:
    """Occlusion at the ends of :class:`Flows`: t_ns, interval_ns as there; occluded (K, H, W) bool."""

    t_ns: int
    interval_ns: np.ndarray
    occluded: np.ndarray


class _OverIntervals(Label):
    """A value with one array per interval. ``arrays``: name -> (shape after (K, H, W), dtype); ``made``: its class."""

    kind, off = "motion", "no interval in labels.flow"
    arrays: dict[str, tuple[tuple[int, ...], Any]]
    made: type

    def intervals(self, labels: LabelsConfig) -> tuple[int, ...]:
        # Increasing, whatever their order in the configuration.
        return tuple(sorted(round(s * 1e9) for s in seconds_of(labels)))

    def _stacked(self, drawn: Drawn, arrays: dict[str, list[np.ndarray]]) -> Any:
        camera = drawn.scene.camera
        stacks = {
            name: np.stack(arrays[name]) if arrays[name] else np.zeros((0, camera.height, camera.width, *more), dtype)
            for name, (more, dtype) in self.arrays.items()
        }
        return self.made(drawn.t_ns, np.array([*drawn.leading], np.int64), **stacks)

    def wrong(self, value: Any, height: int, width: int) -> str | None:
        count = len(value.interval_ns)
        for name, (more, _) in self.arrays.items():
            if (shape := np.shape(getattr(value, name))) != (count, height, width, *more):
                return f"not {width}x{height} px, {count} times: {name} {shape}"
        return None

    def own(self, value: Any) -> Any:
        arrays = {name: np.array(getattr(value, name), dtype) for name, (_, dtype) in self.arrays.items()}
        return self.made(int(value.t_ns), np.array(value.interval_ns, np.int64), **arrays)

    @property
    def forms(self) -> tuple[Form, ...]:
        # The folders are flow/intervals and occlusion/intervals, of names such as "flow_intervals".
        return (Form(f"{self.name.split('_')[0]}/intervals", "h5", self._encode, self._read),)

    def _encode(self, value: Any) -> bytes:
        from blinkgl.io.intervals import encode_intervals

        return encode_intervals(value.t_ns, value.interval_ns, {name: getattr(value, name) for name in self.arrays})

    def _read(self, path: str | os.PathLike) -> Any:
        from blinkgl.io.intervals import read_intervals

        from_us, interval_ns, arrays = read_intervals(path, tuple(self.arrays))
        # Files count whole microseconds, as DSEC's do.
        return self.made(from_us * 1000, interval_ns, **arrays)

    views = property(lambda self: ())  # the debugger shows it as the flow label at other times


class FlowIntervals(_OverIntervals):
    """:class:`Flows`: ``flow_forward`` from the label's time over each of the intervals."""

    name, title, unit = "flow_intervals", "flow over intervals", "px"
    each = ("flow_forward",)
    shard = "flow_intervals.h5"
    stamps = "flow/intervals_timestamps.txt"
    arrays, made = {"flow": ((2,), np.float32), "valid": ((), bool)}, Flows

    def asked(self, labels: LabelsConfig) -> bool:
        return bool(seconds_of(labels))

    def ask(self, tree: Tree) -> None:
        tree["flow"] = [*tree.get("flow", ()), 0.01]

    def finish(self, drawn: Drawn) -> Flows:
        flows = [frame.values["flow_forward"] for frame in drawn.leading.values()]
        return self._stacked(drawn, {name: [getattr(flow, name) for flow in flows] for name in self.arrays})


class OcclusionIntervals(_OverIntervals):
    """:class:`Occlusions`: ``occlusion_forward`` at the end of each interval."""

    name, title, unit = "occlusion_intervals", "occlusion over intervals", ""
    off = "labels.occlusion: false, or no interval in labels.flow"
    each = ("flow_forward", "occlusion_forward")
    arrays, made = {"occluded": ((), bool)}, Occlusions

    said = property(lambda self: "occlusion")

    def asked(self, labels: LabelsConfig) -> bool:
        return bool(seconds_of(labels)) and labels.occlusion

    def ask(self, tree: dict[str, object]) -> None:
        tree["occlusion"] = True

    def finish(self, drawn: Drawn) -> Occlusions:
        masks = [frame.values["occlusion_forward"] for frame in drawn.leading.values()]
        return self._stacked(drawn, {"occluded": masks})
