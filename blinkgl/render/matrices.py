"""The only place where poses become clip-space matrices: float64, camera-relative, cast to float32 once.

Clip space: x right, y DOWN, w = Z along the optical axis, reversed-Z with the far plane at infinity
(depth = near / Z in [0, 1], 1 at the near plane). Because y points down in clip space already, row 0 of every
image is the top row and ``gl_FragCoord.xy - 0.5`` is the user's pixel: no image is ever flipped. The matrix from camera
axes to it is the camera model's (:meth:`blinkgl.camera.CameraModel.clip_from_cam`).
"""

from __future__ import annotations

import numpy as np


def cam_from_obj(T_world_cam: np.ndarray, T_world_obj: np.ndarray) -> np.ndarray:
    """(..., 4, 4) float64 T_cam_obj. The translations are subtracted before they are rotated, so that a scene
    far from the origin loses no more than the rounding of its own coordinates."""
    R_t = np.swapaxes(T_world_cam[..., :3, :3], -1, -2)
    rotation = R_t @ T_world_obj[..., :3, :3]
    out = np.zeros((*rotation.shape[:-2], 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = (R_t @ (T_world_obj[..., :3, 3:] - T_world_cam[..., :3, 3:]))[..., 0]
    out[..., 3, 3] = 1.0
    return out


def cam_from_obj_rate(
    T_world_cam: np.ndarray, dT_world_cam: np.ndarray, T_world_obj: np.ndarray, dT_world_obj: np.ndarray
) -> np.ndarray:
    """(..., 4, 4) float64 d(T_cam_obj)/dt, 1/s, by the product rule on :func:`cam_from_obj`."""
    R_t = np.swapaxes(T_world_cam[..., :3, :3], -1, -2)
    dR_t = np.swapaxes(dT_world_cam[..., :3, :3], -1, -2)
    offset = T_world_obj[..., :3, 3:] - T_world_cam[..., :3, 3:]
    d_offset = dT_world_obj[..., :3, 3:] - dT_world_cam[..., :3, 3:]
    out = np.zeros(np.broadcast_shapes(T_world_cam.shape, T_world_obj.shape))
    out[..., :3, :3] = dR_t @ T_world_obj[..., :3, :3] + R_t @ dT_world_obj[..., :3, :3]
    out[..., :3, 3] = (dR_t @ offset + R_t @ d_offset)[..., 0]
    return out


def mat4_bytes(matrices: np.ndarray) -> bytes:
    """GLSL mat4 (column-major float32) of one (4, 4) float64 matrix."""
    return np.ascontiguousarray(matrices.T, dtype=np.float32).tobytes()


def rows_xyw_bytes(matrix: np.ndarray) -> bytes:
    """GLSL mat4x3 (4 columns of 3) with the x, y, w rows of a (4, 4) clip-space matrix."""
    return np.ascontiguousarray(matrix[[0, 1, 3]].T, dtype=np.float32).tobytes()


def linear_xyw_bytes(matrix: np.ndarray) -> bytes:
    """GLSL mat3 with the x, y, w rows of the linear part of a (4, 4) clip-space matrix: of differences of positions."""
    return np.ascontiguousarray(matrix[[0, 1, 3], :3].T, dtype=np.float32).tobytes()


DEPTH_ROOM = 2.0
"""A fragment may lie a fraction of a pixel outside of its triangle, and outside of the
part's depths by the slope there."""


def inverse_depth_bits(centre_z: np.ndarray, radius: np.ndarray, near: float) -> np.ndarray:
    """(n, 2) uint32 of bounding spheres, ``inverse_depths`` of guard.glsl: the smallest 1/Z that a fragment can have,
    as the bits of a float32, and the largest's less those. centre_z, radius : (n,) float64."""
    farthest, nearest = np.maximum(centre_z + radius, near), np.maximum(centre_z - radius, near)
    inverse = np.empty((len(centre_z), 2), np.float32)
    inverse[:, 0], inverse[:, 1] = 1 / (DEPTH_ROOM * farthest), DEPTH_ROOM / nearest
    bits = inverse.view(np.uint32)
    bits[:, 1] -= bits[:, 0]
    return bits
