"""Poses to clip space: the frustum's planes lie where the image ends, and stacks of poses are stacks of single ones."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.render.moment import cam_from_obj, cam_from_obj_rate

CAMERA = PinHole(64, 40, 50.0, 70.0, 20.0, 28.0)  # nothing about it is symmetric


def seen_at(x: float, y: float, depth: float = 3.0) -> np.ndarray:
    """The point in camera axes that pixel coordinates (x, y) show."""
    return depth * np.array([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, 1.0])


@pytest.mark.parametrize(
    "plane, inside, outside",
    [
        (0, (-0.4, 20), (-0.6, 20)),
        (1, (63.4, 20), (63.6, 20)),
        (2, (30, -0.4), (30, -0.6)),
        (3, (30, 39.4), (30, 39.6)),
    ],
)
def test_a_plane_is_where_the_image_ends(plane, inside, outside):
    planes = CAMERA.frustum_planes()
    assert planes.shape == (5, 3)
    np.testing.assert_allclose(np.linalg.norm(planes, axis=1), 1.0)
    assert (planes @ seen_at(*inside) > 0).all()
    assert (planes @ seen_at(*outside) < 0).tolist() == [k == plane for k in range(5)]


def test_the_last_plane_is_the_cameras_own():
    planes = CAMERA.frustum_planes()
    assert (planes @ [0, 0, 1.0])[4] > 0 > (planes @ [0, 0, -1.0])[4]


def test_projection_lands_where_the_camera_says():
    x, y, depth = 11.25, 33.5, 7.0
    clip = CAMERA.clip_from_cam() @ [*seen_at(x, y, depth), 1.0]
    window = (clip[:2] / clip[3] + 1) / 2 * [CAMERA.width, CAMERA.height]
    np.testing.assert_allclose(window, [x + 0.5, y + 0.5], rtol=1e-12)
    assert clip[3] == pytest.approx(depth) and clip[2] / clip[3] == pytest.approx(CAMERA.near / depth)


def poses(count: int, seed: int) -> np.ndarray:
    dice = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.random(count, dice).as_matrix(), dice.normal(size=(count, 3))
    return T


def test_stacks_of_cameras_and_objects():
    cameras, objects = poses(5, 0), poses(5, 1)
    together = cam_from_obj(cameras, objects)
    for k in range(5):
        np.testing.assert_allclose(together[k], np.linalg.inv(cameras[k]) @ objects[k], atol=1e-14)
        np.testing.assert_array_equal(together[k], cam_from_obj(cameras[k], objects[k]))


def test_the_rate_is_the_limit_of_differences():
    def at(t: float, seed: int) -> np.ndarray:
        dice = np.random.default_rng(seed)
        axis, speed, T = dice.normal(size=3), dice.normal(size=3), np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_rotvec(t * axis).as_matrix(), 1 + t * speed
        return T

    step = 1e-5
    rate = lambda seed: (at(0.3 + step, seed) - at(0.3 - step, seed)) / (2 * step)
    camera, thing = np.stack([at(0.3, 1), at(0.3, 2)]), np.stack([at(0.3, 3), at(0.3, 4)])
    got = cam_from_obj_rate(camera, np.stack([rate(1), rate(2)]), thing, np.stack([rate(3), rate(4)]))
    for k in range(2):
        wanted = (
            cam_from_obj(at(0.3 + step, 1 + k), at(0.3 + step, 3 + k))
            - cam_from_obj(at(0.3 - step, 1 + k), at(0.3 - step, 3 + k))
        ) / (2 * step)
        np.testing.assert_allclose(got[k], wanted, atol=1e-8)
