"""One frame of the renderer against the float64 reference, off silhouettes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.config.sequence import RenderConfig
from blinkgl.render.renderer import LabelFrame, LabelRequest, Renderer
from blinkgl.tools.shader_debugger import reference
from tests.render.render_scenes import LEVEL, SECOND, drift, length, rig

MOTION = LabelRequest("depth", "ids", "velocity", "flow_forward")


@dataclass(frozen=True)
class Errors:
    """Over the N pixels off silhouettes.

    flow : (N,) px.   size : (N,) px, the true flow's length.   velocity : (N,) relative to the median speed.
    depth : (N,) relative.   approach : (N,) depth now over depth then.   luminance : (N,) absolute.
    wrong_ids : pixels off silhouettes that show another object."""

    flow: np.ndarray
    size: np.ndarray
    velocity: np.ndarray
    depth: np.ndarray
    approach: np.ndarray
    luminance: np.ndarray
    wrong_ids: int
    frame: LabelFrame

    @property
    def relative(self) -> float:
        """Median error of the flow over its median length."""
        return float(np.median(self.flow) / np.median(self.size))

    @property
    def worst(self) -> float:
        """Largest error of the flow over its median length (single pixels may stand still)."""
        return float(self.flow.max() / np.median(self.size))


def moving_camera(near=0.05, step=1.0, **keys):
    turn = Rotation.from_rotvec(np.array([0.02, -0.01, 0.03]) * min(step, 1.0))
    return rig(near=near, path=drift((0, 0, 0), np.array([0.02, 0.01, -0.01]) * step, LEVEL, LEVEL * turn), **keys)


def compare(gl, world, t_ns: int = 0, to_ns: int = SECOND) -> Errors:
    true = reference.render(world, t_ns, forward_ns=to_ns)
    with Renderer(gl, world, RenderConfig()) as renderer:
        frame, luminance = renderer.labels(t_ns, MOTION, to_ns), renderer.luminance(t_ns).read()
    clear = true.hit & ~reference.silhouette_band(true.instance, true.depth)
    wrong = clear & (frame.ids != true.instance)
    np.testing.assert_array_equal(frame.forward.valid[clear & ~wrong], true.forward.valid[clear & ~wrong])
    for buffer in (frame.forward.flow, frame.velocity, luminance):
        assert np.isfinite(buffer).all()
    off = clear & ~wrong & true.forward.valid
    assert off.sum() >= 4
    speed = length(true.velocity)[off]
    return Errors(
        length(frame.forward.flow - true.forward.flow)[off], length(true.forward.flow)[off],
        length(frame.velocity - true.velocity)[off] / np.median(speed), np.abs(frame.depth[off] / true.depth[off] - 1),
        true.depth[off] / true.forward.depth[off], np.abs(luminance - true.luminance)[off], int(wrong.sum()), frame,
    )  # fmt: skip
