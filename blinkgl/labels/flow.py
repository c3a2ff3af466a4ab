"""Optical flow to another label's time."""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np

from blinkgl.config.labels import LabelsConfig
from blinkgl.labels import grading
from blinkgl.labels.files import Form, later
from blinkgl.labels.label import Drawn, Label, Shot, Towards, View
from blinkgl.labels.values import Flow
from blinkgl.types.trees import Tree


def seconds_of(labels: LabelsConfig) -> tuple[float, ...]:
    """Return the intervals in ``labels.flow``, s."""
    return tuple(one for one in labels.flow if isinstance(one, float))


class FlowTo(Label):
    """:class:`Flow` to the next label's time or to the previous one; valid pixels beyond DSEC's ±256 px become invalid
    in the PNG, but not in the float files."""

    unit, kind = "px", "motion"
    buffer = "RGBA32F"

    def __init__(self, towards: Towards):
        self.varyings = ("local", towards)
        self.towards, self.name, self.title = towards, f"flow_{towards}", f"{towards} flow"
        self.off = "not in labels.flow"
        self.stamps, self.shard = f"flow/{towards}_timestamps.txt", "flow.png" if towards == "forward" else "back.png"

    said = property(lambda self: self.towards)

    def asked(self, labels: LabelsConfig) -> bool:
        return self.towards in labels.flow

    def ask(self, tree: Tree) -> None:
        tree["flow"] = [*tree.get("flow", ()), self.towards]

    def uniforms(self, shot: Shot) -> dict[str, np.ndarray]:
        # Matrices are subtracted in float64, of clip space the rows x, y and w, so that a still scene has
        # exactly no flow.
        assert self.towards is not None
        return {f"difference_{self.towards}": (shot.ends[self.towards].mvp - shot.moment.mvp)[:, [0, 1, 3]]}

    def finish(self, drawn: Drawn) -> Flow:
        return drawn.flow(self.name)

    def wrong(self, value: Flow, height: int, width: int) -> str | None:
        shapes = np.shape(value.flow), np.shape(value.valid)
        if shapes == ((height, width, 2), (height, width)):
            return None
        return f"not {width}x{height} px: flow {shapes[0]}, valid {shapes[1]}"

    def own(self, value: Flow) -> Flow:
        return Flow(np.array(value.flow), np.array(value.valid).astype(bool))

    @property
    def forms(self) -> tuple[Form, ...]:
        folder = f"flow/{self.towards}"
        # Float files have their own folders: DSEC loaders read every file of flow/forward as a PNG.
        return (
            Form(folder, "png", _png, _read),
            Form(folder + "_npy", "npy", _npy, _read),
            Form(folder + "_flo", "flo", _flo, _read),
        )

    def written(self, labels: LabelsConfig) -> tuple[Form, ...]:
        return (self.forms[0], *(form for form in self.forms[1:] if form.ending in labels.float_flow))

    @property
    def views(self) -> tuple[View, ...]:
        way = self.towards
        return (
            View(
                name=self.name,
                title=self.title,
                unit="px",
                kind="motion",
                of=lambda value: value.flow,
                reference=lambda scene, frame: self._of(frame, "flow"),
                judged_in="px",
                tolerance=1e-2,
                error=grading.motion,
            ),
            View(
                name=f"valid_{way}",
                title=f"valid, {way}",
                unit="",
                kind="mask",
                of=lambda value: value.valid,
                reference=lambda scene, frame: self._of(frame, "valid"),
                judged_in="mismatch",
                tolerance=0.0,
                error=grading.different,
            ),
        )

    def _of(self, frame, what: str) -> np.ndarray:
        true = frame.forward if self.towards == "forward" else frame.backward
        return true.valid if what == "valid" else np.where(true.valid[..., None], true.flow, 0.0)


def _encoder(name: str) -> Callable[[Flow], bytes | tuple[bytes, int]]:
    encode = later("flow", name)
    return lambda value: encode(value.flow, value.valid)


_png, _npy, _flo = (_encoder(name) for name in ("encode_flow_png", "encode_flow_npy", "encode_flo"))


def _read(path: str | os.PathLike) -> Flow:
    return Flow(*later("flow", "read_flow")(path))
