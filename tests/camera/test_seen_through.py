"""The float64 reference and random worlds ask the camera model, whichever it is."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.camera import CAMERA_MODELS
from blinkgl.config.scene import RandomSceneConfig
from blinkgl.render import casting, reference
from blinkgl.scene.geometry.primitives import grid
from blinkgl.scene.motion.paths import KeyframePath, StaticPath
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Material, Part, Scene, SceneObject
from blinkgl.scene.worlds.random_world import random_world

SECOND = 1_000_000_000
CAMERAS = [model(48, 36, 30.0, 32.0, 22.0, 18.5, **getattr(model, "sample", {})) for model in CAMERA_MODELS.values()]
every = pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.kind)


def wall(camera):
    """A wall 4 m ahead that drifts by 0.3 m in x and -0.5 m in z each second, seen by a camera at rest in the
    origin."""
    path = KeyframePath(
        [0, SECOND], [(0, 0, 4.0), (0.3, 0, 3.5)], Rotation.concatenate([Rotation.identity()] * 2), "linear"
    )
    sheet = SceneObject("wall", 1, (Part(grid(width=40, depth=40), Material(double_sided=True)),), path)
    return Scene((sheet,), Rig.alone(camera, StaticPath(np.eye(4))), 0, SECOND)


@every
def test_the_reference_sees_through_it(camera):
    scene = wall(camera)
    frame = reference.render(scene, 0, forward_ns=SECOND)
    xy = casting.pixel_grid(camera).reshape(36, 48, 2)
    rays = camera.rays(xy)
    points = 4.0 * rays / rays[..., 2:]
    assert frame.hit.all()
    np.testing.assert_allclose(frame.depth, 4.0, rtol=1e-13)
    there = camera.project(points + np.array([0.3, 0, -0.5]))
    np.testing.assert_allclose(frame.forward.flow, there - xy, atol=1e-10)
    np.testing.assert_allclose(frame.velocity, camera.jacobian(points) @ [0.3, 0, -0.5], atol=1e-10)
    np.testing.assert_array_equal(frame.forward.occluded, ((there < -0.5) | (there >= [47.5, 35.5])).any(axis=-1))


@every
def test_a_random_world_places_in_its_view(camera, tmp_path):
    config = RandomSceneConfig(objects={"count": 3, "in_view": 1.0}, textures={"photographs": False})
    scene = random_world(config, camera, 0, SECOND // 10, "train", 1, 0, tmp_path)
    assert scene.camera is camera and len(scene.objects) > 3
