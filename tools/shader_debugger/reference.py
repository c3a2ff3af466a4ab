"""The float64 reference renderer: computes every buffer of every pass by casting rays on the CPU.

It shares with the rasteriser only :mod:`blinkgl.scene.types` and the camera models: no GLSL, no clip space, no
projection matrix. It supports any camera model whose rays point forward (Z > 0). Tests and the shader debugger compare
the GPU with it. Rays, hits and flow are in :mod:`blinkgl.render.casting`, light and textures in
:mod:`blinkgl.tools.shader_debugger.appearance`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from blinkgl.render.casting import Flow, Hits, cast, flow_to, moved_in_space, scene_parts, velocity
from blinkgl.scene.types import Scene
from blinkgl.tools.shader_debugger.appearance import Surface, surface


@dataclass(frozen=True, eq=False)
class ReferenceFrame(Surface, Hits):
    """All buffers of one image; (H, W, ...) float64 unless said otherwise. See :class:`Hits`, :class:`Flow` and
    :class:`~blinkgl.tools.shader_debugger.appearance.Surface` for the fields. velocity : (H, W, 2) px/s at t, nan where
    nothing is hit.
    forward, backward : flow to the requested times, else None."""

    velocity: np.ndarray
    forward: Flow | None
    backward: Flow | None

    def hits(self) -> Hits:
        """Return the hits at the pixel centres, row by row."""
        images = (name for name in Hits.__dataclass_fields__ if name != "t_ns")
        flat = {name: (a := getattr(self, name)).reshape(self.hit.size, *a.shape[2:]) for name in images}
        return Hits(t_ns=self.t_ns, **flat)

    def scene_flow(self, scene: Scene) -> np.ndarray:
        """Return (H, W, 3) world units, as :func:`moved_in_space` to the forward flow's time; 0 where nothing is
        hit."""
        assert self.forward is not None
        moved = moved_in_space(scene, self.hits(), self.forward.t_ns).reshape(*self.hit.shape, 3)
        return np.where(self.hit[..., None], moved, 0.0)


def render(
    scene: Scene,
    t_ns: int,
    *,
    forward_ns: int | None = None,
    backward_ns: int | None = None,
    xy: np.ndarray | None = None,
) -> ReferenceFrame:
    """Return every buffer at t_ns, with the flow to forward_ns and to backward_ns where given.

    xy : (H, W, 2) image points, px, of a picture of any size; None: all pixel centres."""
    shape = (scene.camera.height, scene.camera.width) if xy is None else xy.shape[:2]
    hits = cast(scene, t_ns, None if xy is None else xy.reshape(-1, 2))
    looks = surface(scene, hits)

    def images(values: object) -> dict[str, Any]:
        return {k: v if k == "t_ns" else v.reshape(*shape, *v.shape[1:]) for k, v in vars(values).items()}

    def flow(to_ns: int | None) -> Flow | None:
        return None if to_ns is None else Flow(**images(flow_to(scene, hits, to_ns)))

    return ReferenceFrame(
        **images(hits),
        **images(looks),
        velocity=velocity(scene, hits).reshape(*shape, 2),
        forward=flow(forward_ns),
        backward=flow(backward_ns),
    )


def why(scene: Scene, frame: ReferenceFrame, way: str, x: int, y: int) -> str:
    """Return one line that says why the point at a pixel is invalid or occluded at the end of its flow ``way``,
    "forward" or "backward"; "" where it is visible at both times."""
    flow = getattr(frame, way)
    depth, (part, triangle) = flow.depth[y, x], flow.hidden_by[y, x]
    if not frame.hit[y, x]:
        return "nothing hit"
    if not flow.valid[y, x]:
        return f"behind the camera at t' (Z' = {depth:.6g})"
    if flow.outside[y, x]:
        return "outside the image at t' (x' = {:.3f}, y' = {:.3f})".format(*(frame.xy[y, x] + flow.flow[y, x]))
    if depth < scene.camera.near:
        return f"in front of the near plane at t' (Z' = {depth:.6g} < {scene.camera.near:g})"
    if part >= 0:
        return f"hidden at t' by {scene_parts(scene)[part][0].name}, triangle {triangle}"
    return "seen from its culled back at t'" if flow.occluded[y, x] else ""


def silhouette_band(ids: np.ndarray, depth: np.ndarray, width: int = 1, jump: float = 0.02) -> np.ndarray:
    """Return (H, W) bool: pixels within ``width`` px (8-neighbourhood) of an id change or a jump in depth.

    ids : (H, W) integers.   depth : (H, W), inf or nan where nothing is hit.   A jump is a second difference of 1 / Z
    along x or y above ``jump`` of its largest value there: 1 / Z of a plane is affine in the image, however steep the
    plane, so slanted ground is not taken for an edge.
    """
    # Second differences of 1/Z vanish on a plane; along x and along y in turn.
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.nan_to_num(1.0 / np.asarray(depth, np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    band = (ndimage.maximum_filter(ids, 3) != ids) | (ndimage.minimum_filter(ids, 3) != ids)
    for axis in (0, 1):
        z, b = np.swapaxes(inverse, 0, axis), np.swapaxes(band, 0, axis)
        b[1:-1] |= np.abs(z[2:] - 2.0 * z[1:-1] + z[:-2]) > jump * np.maximum(np.maximum(z[2:], z[1:-1]), z[:-2])
    return ndimage.binary_dilation(band, np.ones((3, 3)), iterations=width - 1) if width > 1 else band
