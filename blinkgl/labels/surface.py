"""Labels of the surface at a pixel's centre: depth, normals, ids, velocity, scene flow, images."""

from __future__ import annotations

import numpy as np

from blinkgl.labels import files, grading
from blinkgl.labels.files import Form
from blinkgl.labels.label import Drawn, Label, ReferenceFrame, Shot, View
from blinkgl.scene.types import FARTHEST, Scene


class Depth(Label):
    """(H, W) float32 world units along the optical axis; inf: nothing hit, or a panorama's sky."""

    name = "depth"
    unit, kind = "world units", "depth"
    shard = "depth.npy"
    buffer = "R32F"
    judged_in, tolerance, error = "relative", 1e-5, staticmethod(grading.relative)

    def finish(self, drawn: Drawn) -> np.ndarray:
        raw = drawn.raw("depth")
        return np.where((raw > 0) & (raw < FARTHEST), raw, np.float32(np.inf))

    def reference(self, scene: Scene, frame: ReferenceFrame) -> np.ndarray:
        return np.where(frame.depth < FARTHEST, frame.depth, np.inf)


# ---------------------------------------------------------------------------------------------------------------------
# Direction of the surface.


class Normals(Label):
    """(H, W, 3) float32 unit, camera axes (OpenCV), facing the camera; 0 where nothing is hit."""

    name = "normals"
    unit, kind = "camera axes", "unit"
    shard = "normals.npy"
    buffer, varyings, channels = "RGBA32F", ("local", "normal"), 3
    judged_in, tolerance = "of a unit vector", 1e-3

    def uniforms(self, shot: Shot) -> dict[str, np.ndarray]:
        return {"camera_from_local": shot.moment.T_cam_obj}

    def reference(self, scene: Scene, frame: ReferenceFrame) -> np.ndarray:
        normal = frame.normal @ scene.camera_path.pose(frame.t_ns)[:3, :3]
        ray = scene.camera.rays(frame.xy.reshape(-1, 2)).reshape(normal.shape)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        # A smoothed normal may point away from the camera, so its part along the ray is limited to -1e-4.
        normal = normal - np.maximum((normal * ray).sum(axis=-1, keepdims=True) + 1e-4, 0.0) * ray
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        return np.where(frame.hit[..., None], normal, 0.0)


# ---------------------------------------------------------------------------------------------------------------------
# Visible object.


class Ids(Label):
    """(H, W) uint32 instance ids; 0: nothing hit."""

    name = "ids"
    title, unit, kind = "instance ids", "0: nothing hit", "ids"
    shard = "ids.png"
    buffer, dtype = "R32UI", np.uint32

    def uniforms(self, shot: Shot) -> dict[str, np.ndarray]:
        return {"instance_id": np.array([obj.instance_id for obj in shot.scene.objects], np.uint32)}

    @property
    def forms(self) -> tuple[Form, ...]:
        return (files.ids_png("ids"),)

    def reference(self, scene: Scene, frame: ReferenceFrame) -> np.ndarray:
        return frame.instance

    @property
    def views(self) -> tuple[View, ...]:
        return (
            View(
                name="id",
                title="instance id",
                unit=self.unit,
                kind=self.kind,
                of=lambda value: value,
                reference=self.reference,
                judged_in="mismatch",
                tolerance=0.0,
                error=grading.different,
                same_triangle=False,
            ),
        )


# ---------------------------------------------------------------------------------------------------------------------
# Motion of the surface in the image.


class Velocity(Label):
    """(H, W, 2) float32 px/s at the label's time; 0 where nothing is hit."""

    name = "velocity"
    title, unit, kind = "velocity label", "px/s", "motion"
    shard = "velocity.npy"
    buffer, varyings, channels = "RG32F", ("local", "rate"), 2
    judged_in, tolerance, error = "px per label interval", 1e-2, staticmethod(grading.motion_per_interval)

    def uniforms(self, shot: Shot) -> dict[str, np.ndarray]:
        # The rows x, y and w of clip space.
        return {"rate": shot.moment.rates.mvp[:, [0, 1, 3]]}

    def reference(self, scene: Scene, frame: ReferenceFrame) -> np.ndarray:
        return np.where(frame.hit[..., None], frame.velocity, 0.0)


# ---------------------------------------------------------------------------------------------------------------------
# Motion of the surface in space.


class SceneFlow(Label):
    """(H, W, 3) float32 world units: the motion of the pixel's point in the world until the next label's time, in the
    camera's axes at its own time; 0 where nothing is hit. It is 0 for static surfaces, however the camera moves: a
    point at X in the camera's axes moves to X + s, which at the other time is at T_cam'_cam (X + s) in that camera's
    axes."""

    name, title = "scene_flow", "scene flow"
    unit, kind = "world units", "scalar"
    towards = "forward"
    stamps, shard = "scene_flow/timestamps.txt", "scene_flow.npy"
    buffer, varyings, channels = "RGBA32F", ("local", "forward"), 3
    of_shapes = ("space_from_clip",)
    judged_in, tolerance, error = "world units", 1e-4, staticmethod(grading.absolute)

    def uniforms(self, shot: Shot) -> dict[str, np.ndarray]:
        now, then = shot.moment, shot.ends["forward"]
        to_camera = now.T_world_cam[:3, :3].T
        # Differences of poses, so that static objects have exactly 0.
        change = to_camera @ (then.T_world_obj - now.T_world_obj)[:, :3]
        # A sky at infinity is static: its box only follows the camera.
        change[[obj.at_infinity for obj in shot.scene.objects]] = 0.0
        # Of shapes that change: from a motion in the other time's clip space, x, y and w, to the camera's axes now.
        of_clip = to_camera @ then.T_world_cam[:3, :3] @ np.linalg.inv(then.view.projection[[0, 1, 3], :3])
        return {"change_in_space": change, "space_from_clip": np.tile(of_clip, (len(change), 1, 1))}

    def finish(self, drawn: Drawn) -> np.ndarray:
        raw = drawn.raw(self.name)
        # The fourth component says whether something is hit.
        return np.where(raw[..., 3:] > 0, raw[..., :3], np.float32(0))

    def reference(self, scene: Scene, frame: ReferenceFrame) -> np.ndarray:
        return frame.scene_flow(scene)


# ---------------------------------------------------------------------------------------------------------------------
# Appearance of the scene.


class Images(Label):
    """(H, W, 3) float32 linear radiance, anti-aliased by ``render.image_antialiasing``."""

    name, title, unit, kind = "images", "images", "linear radiance", "light"
    anti_aliased, at_last = True, True
    channels, dtype = None, None
    stamps, shard = "images/timestamps.txt", "image.png"

    @property
    def forms(self) -> tuple[Form, ...]:
        return (files.image_png("images"),)

    @property
    def views(self) -> tuple[View, ...]:
        return ()  # the debugger shows the steps of the colour pass, beginning with its lookups
