"""Radtan and equidistant: OpenCV as the judge, Newton's method on its way to the edge of its domain, distortion that
folds."""

import math

import cv2
import numpy as np
import pytest

from blinkgl.camera import Equidistant, Radtan
from blinkgl.camera.distorted import radius_limit
from blinkgl.errors import ConfigError

CALIBRATIONS = {  # fx, fy, cx, cy, then the coefficients in OpenCV's order; of the size of real ones
    "event camera": (346, 260, 252.0, 251.5, 182.0, 123.0, (-0.368, 0.149, -0.0003, -0.0005, 0.0)),
    "webcam": (640, 480, 610.0, 615.0, 322.0, 243.0, (0.12, -0.25, 0.001, 0.002, 0.1)),
    "wide": (752, 480, 458.0, 457.0, 367.0, 248.0, (-0.2834, 0.0739, 0.0002, 1.8e-05, 0.0)),
    "tangential": (320, 240, 300.0, 310.0, 160.0, 115.0, (-0.1, 0.02, 0.02, -0.03, 0.0)),
    "none": (320, 240, 300.0, 310.0, 160.0, 115.0, (0.0,) * 5),
}
FISHEYES = {
    "wide event camera": (346, 260, 190.0, 191.0, 170.0, 132.0, (-0.015, 0.02, -0.018, 0.004)),
    "160 degrees": (512, 512, 190.9, 190.9, 254.9, 256.8, (0.0034, 0.0007, -0.0021, 0.0002)),
    "none": (320, 240, 200.0, 210.0, 160.0, 115.0, (0.0,) * 4),
}


def radtan(name):
    *size, k = CALIBRATIONS[name]
    return Radtan(*size, 0.05, *k)


def fisheye(name):
    *size, k = FISHEYES[name]
    return Equidistant(*size, 0.05, *k)


def lens(camera):
    """Matrix and coefficients, as OpenCV takes them."""
    return camera.K, np.array(camera.distortion)


def seen(camera, count=3000):
    """Points ahead of the camera (at least 5 degrees) whose pixels fill the picture."""
    dice = np.random.default_rng(0)
    rays = camera.rays(dice.uniform([-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5], (count, 2)))
    rays = rays[rays[:, 2] > math.cos(math.radians(85)) * np.linalg.norm(rays, axis=1)]
    return rays * dice.uniform(0.2, 30, (len(rays), 1))


# ---- OpenCV --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_radtan_projects_as_opencv(name):
    camera, points = radtan(name), seen(radtan(name))
    expected, slopes = cv2.projectPoints(points, np.zeros(3), np.zeros(3), *lens(camera))
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)
    # OpenCV's derivative by the translation is ours by the point
    np.testing.assert_allclose(camera.jacobian(points).reshape(-1, 3), slopes[:, 3:6], rtol=1e-9, atol=1e-7)


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_radtan_undistorts_as_opencv(name):
    camera = radtan(name)
    xy = camera.project(seen(camera))
    steps = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
        expected = cv2.undistortPointsIter(xy[:, None], *lens(camera), np.eye(3), np.eye(3), steps)[:, 0]
    else:
        expected = cv2.undistortPoints(xy[:, None], *lens(camera), None, np.eye(3), np.eye(3), steps)[:, 0]
    np.testing.assert_allclose(camera.rays(xy)[:, :2], expected, atol=1e-7)


@pytest.mark.parametrize("name", FISHEYES)
def test_equidistant_projects_as_opencv(name):
    camera, points = fisheye(name), seen(fisheye(name))
    expected, slopes = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), *lens(camera))
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)
    ours = camera.jacobian(points).reshape(-1, 3)
    # f, c, k, rotation (3), translation (3), skew.
    np.testing.assert_allclose(ours, slopes[:, 11:14], rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("name", FISHEYES)
def test_equidistant_undistorts_as_opencv(name):
    camera = fisheye(name)
    points = seen(camera)
    points = points[
        points[:, 2] > 0.35 * np.linalg.norm(points, axis=1)
    ]  # 70 degrees: OpenCV's ten steps get no farther
    xy = camera.project(points)
    expected = cv2.fisheye.undistortPoints(xy[:, None], *lens(camera))[:, 0]
    rays = camera.rays(xy)
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], expected, atol=1e-6)


# ---- Newton's method and the edge of the domain --------------------------------------------------------------------


def test_the_limit_is_where_the_radial_part_turns():
    assert radius_limit((0.0, 0.0)) == math.inf and radius_limit((0.3,)) == math.inf
    assert radius_limit((-0.3,)) == pytest.approx(1 / math.sqrt(0.9))
    k = (-0.368, 0.149, 0.0)  # 1 - 1.104 s + 0.745 s² has no real root
    assert radius_limit(k) == math.inf
    # 1 + 1.5 s - s² = 0.
    assert radius_limit((0.5, -0.2)) == pytest.approx(math.sqrt((1.5 + math.sqrt(1.5**2 + 4)) / 2))


def test_radtan_sees_nothing_beyond_its_fold():
    """k1 = -0.3 turns back at r = 1.054: OpenCV maps points beyond into the picture again, here they are not seen."""
    camera = Radtan(64, 48, 80.0, 80.0, 31.5, 23.5, 0.05, k1=-0.3)
    limit = 1 / math.sqrt(0.9)
    just, beyond = np.array([0.999 * limit, 0, 1.0]), np.array([1.5 * limit, 0, 1.0])
    assert (
        np.isfinite(camera.project(just)).all()
        and np.isnan(camera.project(beyond)).all()
        and np.isnan(camera.jacobian(beyond)).all()
    )
    mapped = cv2.projectPoints(beyond[None], np.zeros(3), np.zeros(3), camera.K, np.array([-0.3, 0, 0, 0]))[0].ravel()
    assert 31.5 < mapped[0] < 64
    np.testing.assert_allclose(camera.rays(camera.project(just)), just, atol=1e-9)
    edge = 31.5 + 80 * camera.reach
    assert (
        np.isfinite(camera.rays(np.array([edge - 0.01, 23.5]))).all()
        and np.isnan(camera.rays(np.array([edge + 0.01, 23.5]))).all()
    )
    assert np.isnan(camera.project(np.array([0.1, 0.1, -1.0]))).all()


def test_newton_converges_up_to_the_edge_with_tangential_distortion():
    """From the inverse of the radial part alone, where that is not the answer: every point of the domain's inner 99.9
    % comes back."""
    camera = Radtan(100, 80, 90.0, 90.0, 49.5, 39.5, 0.05, k1=-0.25, k2=0.01, p1=0.01, p2=-0.015)
    dice = np.random.default_rng(5)
    angle, r = dice.uniform(0, 2 * math.pi, 20000), camera._limit * np.sqrt(dice.uniform(0, 0.998, 20000))
    u = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1)
    d, D = camera._distort(u)
    well = D[:, 0, 0] * D[:, 1, 1] - D[:, 0, 1] ** 2 > 1e-3  # nearer to the fold the problem itself is ill-conditioned
    assert well.mean() > 0.9
    back = camera._undistort(d[well])
    assert np.isfinite(back).all()
    assert (
        np.quantile(np.linalg.norm(back - u[well], axis=1), 0.99) < 1e-12
        and np.linalg.norm(back - u[well], axis=1).max() < 1e-9
    )


# ---- distortion that folds in the picture, and other bad input -----------------------------------------------------


def test_distortion_that_folds_in_the_picture_is_refused_with_the_radius():
    with pytest.raises(
        ConfigError,
        match=r"^Radtan: the distortion folds inside the image \(got '70.3 px from the principal point'\); "
        r"expected coefficients that are monotonic up to the image corners,  89.6 px",
    ):
        Radtan(140, 112, 100.0, 100.0, 69.5, 55.5, 0.05, k1=-0.3)
    assert Radtan(90, 60, 100.0, 100.0, 44.5, 29.5, 0.05, k1=-0.3).reach == pytest.approx(2 / 3 / math.sqrt(0.9))
    with pytest.raises(
        ConfigError, match=r"^Equidistant: the distortion folds inside the image \(got '62.8 px .*70.7 px"
    ):
        Equidistant(100, 100, 20.0, 20.0, 49.5, 49.5)
    with pytest.raises(ConfigError, match=r"^Radtan.k2: not a coefficient \(got nan\); expected a finite number"):
        Radtan(100, 80, 80.0, 80.0, 49.5, 39.5, 0.05, k2=math.nan)
    with pytest.raises(ConfigError, match=r"^Equidistant.k4: not a coefficient \(got inf\)"):
        Equidistant(100, 80, 80.0, 80.0, 49.5, 39.5, 0.05, k4=math.inf)
