"""What the renderer is asked for and what it returns besides plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LabelRequest:
    """Which buffers :meth:`Renderer.labels` returns; what is not asked for is not computed."""

    colour: bool = False
    depth: bool = False
    ids: bool = False
    normals: bool = False
    velocity: bool = False
    flow_forward: bool = False
    flow_backward: bool = False
    occlusion: bool = False


@dataclass(frozen=True, eq=False)
class Flow:
    """flow : (H, W, 2) float32 px, +x right, +y down, from t to t' at reference t; 0 where not valid.
    valid : (H, W) bool, something is hit and it is in front of the camera at t'.
    occluded : (H, W) bool or None, valid but not visible at t' (hidden by a surface, or outside the image)."""

    flow: np.ndarray
    valid: np.ndarray
    occluded: np.ndarray | None


@dataclass(frozen=True, eq=False)
class LabelFrame:
    """Ground truth at t_ns. Buffers that were not requested are None.

    colour : (H, W, 3) float32 linear radiance.     depth : (H, W) float32 Z along the optical axis; inf: nothing hit.
    ids : (H, W) uint32; 0: nothing hit.            normals : (H, W, 3) float32 unit, camera axes (OpenCV), facing the camera.
    velocity : (H, W, 2) float32 px/s at t."""

    t_ns: int
    colour: np.ndarray | None = None
    depth: np.ndarray | None = None
    ids: np.ndarray | None = None
    normals: np.ndarray | None = None
    velocity: np.ndarray | None = None
    forward: Flow | None = None
    backward: Flow | None = None


@dataclass
class RenderStats:
    """Wall seconds since the renderer was made; triangles counts what was submitted after culling."""

    frames: int = 0
    triangles: int = 0
    render_s: float = 0.0
    readback_s: float = 0.0
