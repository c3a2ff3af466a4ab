"""Ground truth of one time from the buffers of the label pass: what is read, masked and, for occlusion, looked up at the other time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from blinkgl.labels import Flow, LabelFrame, LabelRequest
from blinkgl.machine.compiling import working_clock
from blinkgl.render.occlusion import occlusion_mask
from blinkgl.render.passes import Geometry

if TYPE_CHECKING:
    from blinkgl.render.renderer import Renderer

SURFACES = 3
"""Times whose surfaces are kept: neighbouring labels look at the same moments."""


OUTPUTS = {"depth": "DEPTH", "ids": "ID", "normals": "NORMAL", "velocity": "VELOCITY", "flow_forward": "FLOW_FORWARD", "flow_backward": "FLOW_BACKWARD"}
"""Name of a label -> its output of the label pass."""


def buffers_of(request: LabelRequest) -> tuple[str, ...]:
    """Outputs of the label pass that a request takes, in their order."""
    return tuple(OUTPUTS[name] for name in request.buffers)


class Labels:
    """Makes the label frames of one renderer."""

    def __init__(self, renderer: Renderer):
        self._renderer = renderer
        self._surfaces: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def frame(self, t_ns: int, request: LabelRequest, forward_ns: int | None, backward_ns: int | None) -> LabelFrame:
        """See :meth:`Renderer.labels`."""
        draw, result = self._renderer, {}
        if "images" in request:
            result["images"] = draw.colour(t_ns).read()
        if names := buffers_of(request):
            ends = {"forward": forward_ns} if "FLOW_FORWARD" in names else {}
            ends |= {"backward": backward_ns} if "FLOW_BACKWARD" in names else {}
            frame = draw.draw(Geometry(names), t_ns, ends)
            buffers = {name: frame.read(name) for name in names}
            if "depth" in request:
                result["depth"] = np.where(buffers["DEPTH"] > 0, buffers["DEPTH"], np.float32(np.inf))
            if "ids" in request:
                result["ids"] = buffers["ID"]
            if "normals" in request:
                result["normals"] = np.ascontiguousarray(buffers["NORMAL"][..., :3])
            if "velocity" in request:
                result["velocity"] = buffers["VELOCITY"]
            for way, other_ns in ends.items():
                flow = self._flow(buffers[f"FLOW_{way.upper()}"], buffers.get("ID"), other_ns, f"occlusion_{way}" in request)
                result[f"flow_{way}"] = Flow(flow.flow, flow.valid)
                if flow.occluded is not None:
                    result[f"occlusion_{way}"] = flow.occluded
        return LabelFrame(t_ns, result)

    def shown_at(self, x: int, y: int, t_ns: int) -> str:
        """See :meth:`Renderer.shown_at`."""
        number = int(self._surface(t_ns)[1][y, x])
        names = [f"object '{o.name}' (id {number})" for o in self._renderer.scene.objects if number and o.instance_id == number]
        return names[0] if names else "the background"

    def forget(self) -> None:
        """Nothing of what was drawn before is used again."""
        self._surfaces = {}

    def _flow(self, buffer: np.ndarray, ids: np.ndarray | None, t_other_ns: int, occlusion: bool) -> Flow:
        surface = self._surface(t_other_ns) if occlusion else None
        started = working_clock()
        w_next = buffer[..., 2]
        hit = buffer[..., 3] > 0
        valid = hit & (w_next > 0)
        flow = np.where(valid[..., None], buffer[..., :2], np.float32(0))
        occluded = None
        if surface is not None:
            occluded = occlusion_mask(flow, w_next, valid, ids, *surface, self._renderer.scene.camera.near)
        self._renderer.stats.render_s += working_clock() - started
        return Flow(flow, valid, occluded)

    def _surface(self, t_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """(depth, ids) at t_ns."""
        if t_ns not in self._surfaces:
            frame = self._renderer.draw(Geometry(("DEPTH", "ID")), t_ns)
            self._surfaces[t_ns] = frame.read("DEPTH"), frame.read("ID")
            while len(self._surfaces) > SURFACES:
                self._surfaces.pop(next(iter(self._surfaces)))
        return self._surfaces[t_ns]
