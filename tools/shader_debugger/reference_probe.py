"""What the float64 reference knows about one pixel: for tests and the shader debugger."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blinkgl.render.casting import Flow, Hits, cast, flow_to, local_at, relative_pose_at, scene_parts, vertices_at
from blinkgl.scene.types import Scene


@dataclass(frozen=True, eq=False)
class Probe:
    """One image point at t_ns and, if requested, at to_ns. float64, None when not there.

    world, camera : (3,) position of the surface point at t;   world_to, camera_to, xy_to : at t'.
    why : '' when the point is visible at both times, else one line saying why it is invalid or occluded.
    """

    hit: bool
    object_name: str = ""
    triangle: int = -1
    front: bool = False
    bary: np.ndarray | None = None
    corners: np.ndarray | None = None
    local: np.ndarray | None = None
    world: np.ndarray | None = None
    camera: np.ndarray | None = None
    valid: bool = False
    occluded: bool = False
    world_to: np.ndarray | None = None
    camera_to: np.ndarray | None = None
    xy_to: np.ndarray | None = None
    why: str = "nothing hit"


def probe(scene: Scene, t_ns: int, x: float, y: float, to_ns: int | None = None) -> Probe:
    """Return what is seen at image point (x, y) px at t_ns, and the position of that surface point at to_ns."""
    hits = cast(scene, t_ns, np.array([[x, y]]))
    if not hits.hit[0]:
        return Probe(False)
    thing, part = scene_parts(scene)[hits.part[0]]
    triangle = int(hits.triangle[0])

    def placed(pose: np.ndarray, at: int) -> np.ndarray:
        return pose[:3, :3] @ local_at(scene, hits, at)[0] + pose[:3, 3]

    later = {}
    if to_ns is not None:
        flow = flow_to(scene, hits, to_ns)
        valid = bool(flow.valid[0])
        later = {
            "valid": valid,
            "occluded": bool(flow.occluded[0]),
            "world_to": placed(thing.path.pose(to_ns), to_ns),
            "camera_to": placed(relative_pose_at(scene, thing, to_ns), to_ns),
            "xy_to": hits.xy[0] + flow.flow[0] if valid else None,
            "why": _why(scene, hits, flow),
        }
    return Probe(
        hit=True,
        object_name=thing.name,
        triangle=triangle,
        front=bool(hits.front[0]),
        bary=hits.bary[0],
        corners=vertices_at(part.mesh, t_ns)[part.mesh.faces[triangle]],
        local=hits.local[0],
        world=placed(thing.path.pose(t_ns), t_ns),
        camera=placed(relative_pose_at(scene, thing, t_ns), t_ns),
        **{"why": "", **later},
    )


def _why(scene: Scene, hits: Hits, flow: Flow) -> str:
    if not flow.valid[0]:
        return f"behind the camera at t' (Z' = {flow.depth[0]:.6g})"
    if flow.outside[0]:
        x, y = hits.xy[0] + flow.flow[0]
        return f"outside the image at t' (x' = {x:.3f}, y' = {y:.3f})"
    if flow.depth[0] < scene.camera.near:
        return f"in front of the near plane at t' (Z' = {flow.depth[0]:.6g} < {scene.camera.near:g})"
    if flow.hidden_by[0, 0] >= 0:
        return f"hidden at t' by {scene_parts(scene)[flow.hidden_by[0, 0]][0].name}, triangle {flow.hidden_by[0, 1]}"
    return "seen from its culled back at t'" if flow.occluded[0] else ""
