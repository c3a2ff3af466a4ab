"""The label pass: any subset of the buffers that ground truth is made of, drawn in one go."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from blinkgl.render.matrices import rows_xyw_bytes
from blinkgl.render.passes.base import Output, Pass, ScenePass, Shot

if TYPE_CHECKING:
    from blinkgl.render.painter import Painter, Uniforms
    from blinkgl.render.resources import DrawItem, Kind


class Buffer(NamedTuple):
    """What label.glsl writes under OUT_<name>. set : gives it its uniforms, for each item."""

    name: str
    format: str
    set: Callable[[Uniforms, DrawItem, Shot], None] | None = None


def _id(uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
    uniforms["instance_id"].value = shot.scene.objects[item.object_index].instance_id


def _normal(uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
    rotation = shot.moment.T_cam_obj[item.object_index, :3, :3]
    uniforms["camera_from_local"].write(np.ascontiguousarray(rotation.T, np.float32).tobytes())


def _velocity(uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
    uniforms["rate"].write(rows_xyw_bytes(shot.moment.rates.mvp[item.object_index]))
    uniforms["image_size"].value = shot.size


def _flow(way: str) -> Callable[[Uniforms, DrawItem, Shot], None]:
    def set_flow(uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
        index = item.object_index
        difference = shot.ends[way].mvp[index] - shot.moment.mvp[index]
        uniforms[f"difference_{way}"].write(rows_xyw_bytes(difference))
        uniforms["image_size"].value = shot.size

    return set_flow


BUFFERS = {buffer.name: buffer for buffer in (
    Buffer("DEPTH", "R32F"),
    Buffer("ID", "R32UI", _id),
    Buffer("NORMAL", "RGBA32F", _normal),
    Buffer("VELOCITY", "RG32F", _velocity),
    Buffer("FLOW_FORWARD", "RGBA32F", _flow("forward")),
    Buffer("FLOW_BACKWARD", "RGBA32F", _flow("backward")),
)}


@dataclass(frozen=True)
class Geometry(ScenePass):
    """Outputs of these names, of :data:`BUFFERS`, as the shader writes them; 0 where nothing is hit. One sample, at the pixel's centre.
    Flow wants the moment at its other end, "forward" or "backward"."""

    names: tuple[str, ...] = ("DEPTH",)
    program: ClassVar[str] = "label.glsl"

    @property
    def outputs(self) -> tuple[Output, ...]:
        return tuple(Output(name, BUFFERS[name].format) for name in self.names)

    def defines(self, kind: Kind | None) -> dict[str, Any]:
        return {f"OUT_{name}": i for i, name in enumerate(self.names)}

    def set(self, painter: Painter, uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
        for name in self.names:
            if (set_buffer := BUFFERS[name].set) is not None:
                set_buffer(uniforms, item, shot)

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        return (cls(names) for count in range(1, len(BUFFERS) + 1) for names in combinations(BUFFERS, count))
