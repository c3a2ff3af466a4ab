"""Boxes of objects (:class:`blinkgl.types.boxes.Boxes`) from their vertices in float64 and a picture of ids.

Objects are clipped at the near plane, and their corners are projected. For a pinhole camera the box of the corners is
that of the object, since a projected triangle is a triangle. Through a lens its edges bend, by less than the size of
the triangles.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.labels.semantics import Categories, category_of, class_of
from blinkgl.machine.kernels import kernel
from blinkgl.render.casting import cast, vertices_at
from blinkgl.render.moment import cam_from_obj
from blinkgl.scene.types import Scene, SceneObject
from blinkgl.types.boxes import Boxes, no_boxes
from blinkgl.types.poses import pose_of


def boxes_of(scene: Scene, t_ns: int, ids: np.ndarray, categories: Categories) -> Boxes:
    """Return the boxes of the objects in front of the camera at t_ns. ids : (H, W) uint32 visible instances."""
    camera, T_world_cam = scene.camera, scene.camera_path.pose(t_ns)
    shown = extents(ids, 1 + max((obj.instance_id for obj in scene.objects), default=0))
    # Edges of the picture: pixel centres are whole numbers.
    whole = np.array([-0.5, -0.5, camera.width - 0.5, camera.height - 0.5])
    rows = []
    for obj in scene.objects:
        T_world_obj = obj.path.pose(t_ns)
        T_cam_obj = cam_from_obj(T_world_cam, T_world_obj)
        x0, y0, x1, y1, seen = (int(n) for n in shown[obj.instance_id])
        # The ball's radius is that of the shape at rest, which says nothing of a deforming one.
        if not seen and not obj.deforms and _aside(camera, obj, T_cam_obj):
            continue
        vertices, faces = _solid(obj, t_ns, T_cam_obj)
        if not len(faces):
            continue
        px, drawn = _projected(camera, vertices @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3], faces)
        if not len(drawn):
            continue
        corners = px[np.unique(drawn)]
        amodal = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
        if not seen and ((amodal[2:] < whole[:2]) | (amodal[:2] > whole[2:])).any():
            continue
        holed = any(part.material.mask is not None for part in obj.parts)
        amodal, alone = _holed(scene, obj, t_ns, amodal) if holed else (amodal, _covered(px, drawn, ids.shape))
        pixels = max(alone, seen)
        # An object between the pixel centres has no box.
        if not pixels:
            continue
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        # The box has the object's axes; its origin is the box's middle.
        middle = pose_of(0.5 * (low + high))
        # The part of the box in the picture, and its area relative to the whole.
        inside = np.clip(amodal.reshape(2, 2), whole[:2], whole[2:])
        area = np.prod(amodal[2:] - amodal[:2])
        rows.append(
            {
                "instance": obj.instance_id,
                "category": category_of(obj, categories),
                "kind": class_of(obj),
                "visible_box": np.array([x0 - 0.5, y0 - 0.5, x1 + 0.5, y1 + 0.5]) if seen else np.zeros(4),
                "visible_pixels": seen,
                "amodal_box": amodal,
                "cut_box": inside.ravel(),
                "amodal_pixels": pixels,
                "size": high - low,
                "T_cam_box": T_cam_obj @ middle,
                "T_world_box": T_world_obj @ middle,
                "occluded": 1.0 - seen / pixels,
                "truncated": 1.0 - float(np.prod(inside[1] - inside[0]) / area) if area > 0 else 0.0,
            }
        )
    made = no_boxes()
    if rows:
        made = {
            name: np.array([row[name] for row in rows], None if none.dtype.kind == "U" else none.dtype)
            for name, none in made.items()
        }
    return Boxes(**made, resolution=np.array([camera.width, camera.height], np.int64))


def _aside(camera: CameraModel, obj: SceneObject, T_cam_obj: np.ndarray) -> bool:
    """Return whether the ball around an object is outside the picture."""
    return bool((camera.frustum_planes() @ T_cam_obj[:3, 3] < -obj.radius).any())


def _solid(obj: SceneObject, t_ns: int, T_cam_obj: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices of all parts at t_ns, (V, 3) float64, object axes, and the faces, (F, 3): of open surfaces
    that are drawn from one side only, those that show it to the camera."""
    vertices, faces, begin = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    # The camera's centre in the object's axes.
    eye = -T_cam_obj[:3, :3].T @ T_cam_obj[:3, 3]
    for part in obj.parts:
        at, shown, side = vertices_at(part.mesh, t_ns), part.mesh.faces.astype(np.int64), part.side(t_ns)
        if side and not part.mesh.closed:
            a, b, c = (at[shown[:, k]] for k in range(3))
            shown = shown[side * np.einsum("fk,fk->f", np.cross(b - a, c - a), eye - a) > 0]
        vertices.append(at)
        faces.append(shown + begin)
        begin += len(vertices[-1])
    return np.concatenate(vertices), np.concatenate(faces)


def _covered(px: np.ndarray, faces: np.ndarray, shape: tuple[int, ...]) -> int:
    """Return the pixels of the picture that a body would cover if nothing were in front of it."""
    mask = np.zeros(shape, np.bool_)
    cover(px, faces, mask)
    return int(np.count_nonzero(mask))


def _holed(scene: Scene, obj: SceneObject, t_ns: int, box: np.ndarray) -> tuple[np.ndarray, int]:
    """Return (the amodal box of a body with holes, the pixels of the picture that it covers): of the pixel centres in
    the box of its triangles whose rays meet it, as if it were alone. The box is that one where it is
    farther away from the picture than :data:`WIDEST` of its sizes."""
    camera = scene.camera
    size = np.array([camera.width, camera.height])
    # Pixel centres are whole numbers: the first and the last ones in the box.
    low, high = np.ceil(box[:2]), np.floor(box[2:])
    near, far = np.maximum(low, -WIDEST * size), np.minimum(high, (1 + WIDEST) * size - 1)
    if (far < near).any():
        return box, 0
    x, y = (np.arange(a, b + 1) for a, b in zip(near, far, strict=True))
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    met = xy[cast(replace(scene, objects=(obj,)), t_ns, xy).hit]
    pixels = int(np.count_nonzero(((met >= 0) & (met <= size - 1)).all(axis=1)))
    if not len(met):
        return box, 0
    around = np.concatenate([met.min(axis=0) - 0.5, met.max(axis=0) + 0.5])
    # Sides beyond what was looked at stay as they are.
    around = np.where(np.concatenate([low < near, high > far]), box, around)
    return np.concatenate([np.maximum(around[:2], box[:2]), np.minimum(around[2:], box[2:])]), pixels


WIDEST = 2
"""Pictures' sizes beside the picture in which a body with holes is looked for."""


def _projected(camera: CameraModel, points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (M, 2) px and (F', 3) of the triangles of (V, 3) points, camera axes, clipped at the near plane, without
    those that the camera cannot project."""
    points, faces = before(points, faces, camera.near)
    px = np.full((len(points), 2), np.nan)
    used = np.unique(faces)
    px[used] = camera.project(points[used])
    return px, faces[np.isfinite(px[faces]).all(axis=(1, 2))]


def before(points: np.ndarray, faces: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles of (V, 3) points clipped at Z = near: points followed by those of the cuts, and the faces beyond
    it."""
    # Corners beyond the plane, and their number per triangle.
    there = points[:, 2] >= near
    count = there[faces].sum(axis=1)
    kept, extra = [faces[count == 3]], [points]
    begin = len(points)
    for inside in (1, 2):
        some = faces[count == inside]
        if not len(some):
            continue
        # Rotated so that the corner on its own side comes first.
        alone = np.argmax(there[some] == (inside == 1), axis=1)
        a, b, c = (some[np.arange(len(some)), (alone + k) % 3] for k in range(3))
        cuts = []
        for other in (b, c):
            # Intersections of the two sides with the plane; exactly at near, despite rounding.
            share = (near - points[a, 2]) / (points[other, 2] - points[a, 2])
            cut = points[a] + share[:, None] * (points[other] - points[a])
            cut[:, 2] = near
            extra.append(cut)
            cuts.append(begin + np.arange(len(some)))
            begin += len(some)
        ab, ac = cuts
        # One corner inside leaves a triangle, two a quadrilateral, which is two triangles.
        kept += [np.stack([a, ab, ac], 1)] if inside == 1 else [np.stack([ab, b, c], 1), np.stack([ab, c, ac], 1)]
    return np.concatenate(extra), np.concatenate(kept)


_EDGE = 1e-9
"""px: a pixel centre this near to an edge is in the triangles on both sides."""


@kernel(error_model="numpy")
def cover(px: np.ndarray, faces: np.ndarray, mask: np.ndarray) -> None:
    """Set ``mask`` (H, W) where a pixel centre is in one of the triangles (F, 3) of (V, 2) float64 px, edges
    included."""
    height, width = mask.shape
    for f in range(len(faces)):
        ax, ay = px[faces[f, 0]]
        bx, by = px[faces[f, 1]]
        cx, cy = px[faces[f, 2]]
        # Twice the signed area; clockwise triangles are reversed.
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        if area < 0.0:
            bx, by, cx, cy = cx, cy, bx, by
        # Rows whose centres lie within the triangle's height.
        first = int(max(np.ceil(min(ay, by, cy) - _EDGE), 0.0))
        last = int(min(np.floor(max(ay, by, cy) + _EDGE), height - 1.0))
        if not max(ax, bx, cx) >= -_EDGE or not min(ax, bx, cx) <= width - 1.0 + _EDGE:
            continue
        for y in range(first, last + 1):
            # The part of the row on the inner side of each edge: a x + b >= 0.
            left, right = 0.0, width - 1.0
            for px0, py0, px1, py1 in ((ax, ay, bx, by), (bx, by, cx, cy), (cx, cy, ax, ay)):
                slope = py0 - py1
                rest = (px1 - px0) * (y - py0) + (py1 - py0) * px0
                if slope > 0.0:
                    left = max(left, -rest / slope)
                elif slope < 0.0:
                    right = min(right, -rest / slope)
                elif rest < 0.0:
                    # A horizontal edge: the row is on its inner side as a whole, or not at all.
                    right = -1.0
            if not left <= right + 2.0 * _EDGE:
                continue
            for x in range(int(np.ceil(left - _EDGE)), int(np.floor(right + _EDGE)) + 1):
                mask[y, x] = True


@kernel
def extents(ids: np.ndarray, count: int) -> np.ndarray:
    """Return (count, 5) int64: for every id below ``count`` the first and last column and row of its pixels, as x0, y0,
    x1, y1, and their number."""
    out = np.zeros((count, 5), np.int64)
    # Ids without pixels keep a first column and row beyond the picture.
    out[:, 0], out[:, 1] = ids.shape[1], ids.shape[0]
    for y in range(ids.shape[0]):
        for x in range(ids.shape[1]):
            k = ids[y, x]
            out[k, 0] = min(out[k, 0], x)
            out[k, 1] = min(out[k, 1], y)
            out[k, 2] = max(out[k, 2], x)
            out[k, 3] = y
            out[k, 4] += 1
    return out
