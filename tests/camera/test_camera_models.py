"""What every camera model of the table promises, and the pin-hole camera by hand."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.camera import CAMERA_MODELS, Equidistant, PinHole, Radtan, register
from blinkgl.camera.distorted import DistortedModel
from blinkgl.camera.pinhole import rectified, rectify_map
from blinkgl.config.scene import RandomSceneConfig
from blinkgl.errors import ConfigError
from blinkgl.render import casting
from blinkgl.scene.geometry.primitives import grid
from blinkgl.scene.motion.paths import KeyframePath, StaticPath
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Material, Part, Scene, SceneObject
from blinkgl.scene.worlds.random_world import random_world
from blinkgl.tools.shader_debugger import reference
from tests.refusals import refusal

SIZE = {
    "width": 120,
    "height": 90,
    "fx": 95.0,
    "fy": 110.0,
    "cx": 52.0,
    "cy": 48.5,
    "near": 0.1,
}  # nothing about it is symmetric
SAMPLES = {
    "pinhole": {},
    "radtan": {"k1": -0.3, "k2": 0.1, "p1": 0.002, "p2": -0.001, "k3": 0.02},
    "equidistant": {"k1": -0.02, "k2": 0.005, "k3": -0.003, "k4": 0.0005},
}
"""Values of each model's own parameters: a new model gives its own."""
CAMERAS = [model(**SIZE, **SAMPLES[kind]) for kind, model in CAMERA_MODELS.items()]
CAMERAS += [
    Radtan(**SIZE),
    Radtan(**SIZE, k1=0.4, k2=-0.02, p1=-0.01, p2=0.004),
    Equidistant(**SIZE),
    Equidistant(200, 150, 60.0, 62.0, 101.0, 70.0),
]  # sees 110 degrees off its axis
every = pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: f"{c.kind}-{math.degrees(c.half_angle):.0f}-degrees")


def pixels(camera, count=2000, seed=0):
    dice = np.random.default_rng(seed)
    return dice.uniform([-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5], (count, 2))


def differences(function, at, h=1e-6):
    return np.stack([(function(at + h * e) - function(at - h * e)) / (2 * h) for e in np.eye(at.shape[-1])], axis=-1)


@every
def test_rays_and_projection_are_each_others_inverse(camera):
    xy = pixels(camera)
    rays = camera.rays(xy)
    assert rays.shape == (2000, 3) and rays.dtype == np.float64
    for depth in (1e-3, 1.0, 1e6):
        np.testing.assert_allclose(camera.project(depth * rays), xy, atol=1e-10)
    again = camera.rays(camera.project(rays))
    np.testing.assert_allclose(np.cross(again, rays), 0, atol=1e-12)
    assert (np.sum(again * rays, axis=1) > 0).all()
    assert camera.rays(xy.reshape(50, 40, 2)).shape == (50, 40, 3) and camera.rays(xy[0]).shape == (3,)
    np.testing.assert_array_equal(camera.rays(xy[0]), rays[0])
    np.testing.assert_array_equal(camera.project(rays[0]), camera.project(rays)[0])


@every
def test_jacobians_are_the_derivatives(camera):
    xy = pixels(camera, 300)
    points = np.random.default_rng(1).uniform(0.5, 20, (300, 1)) * camera.rays(xy)
    J = camera.jacobian(points)
    assert J.shape == (300, 2, 3)
    np.testing.assert_allclose(J, differences(camera.project, points), rtol=1e-5, atol=2e-6 * np.abs(J).max())
    np.testing.assert_allclose(np.einsum("nij,nj->ni", J, points), 0, atol=1e-9)  # along the ray nothing moves
    R = camera.ray_jacobian(xy)
    np.testing.assert_allclose(R, differences(camera.rays, xy, 1e-4), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(camera.jacobian(camera.rays(xy)) @ R, np.tile(np.eye(2), (300, 1, 1)), atol=1e-9)


@every
def test_displacement_is_the_difference_of_projections(camera):
    xy = pixels(camera, 300)
    rays = camera.rays(xy)
    ahead = rays[:, 2] > 0.05
    xy, rays = xy[ahead], rays[ahead]
    dice = np.random.default_rng(2)
    depth, change = dice.uniform(1, 4, len(xy)), dice.normal(0, 0.05, (len(xy), 3))
    points = rays * (depth / rays[:, 2])[:, None]
    np.testing.assert_allclose(
        camera.displacement(rays, depth, change), camera.project(points + change) - camera.project(points), atol=1e-9
    )


@every
def test_everything_in_the_picture_is_inside_of_its_bounds(camera):
    xy = pixels(camera, 4000)
    rays = camera.rays(xy) / np.linalg.norm(camera.rays(xy), axis=1, keepdims=True)
    assert (
        np.arccos(np.clip(rays[:, 2], -1, 1)).max()
        <= camera.half_angle
        <= 1.1
        * np.arccos(
            np.clip(camera.rays(corners(camera))[:, 2] / np.linalg.norm(camera.rays(corners(camera)), axis=1), -1, 1)
        ).max()
    )
    assert (rays @ camera.frustum_planes().T >= 0).all()
    ahead = rays[rays[:, 2] > 1e-3]
    flat = ahead / ahead[:, 2:]
    stretch = np.linalg.norm(camera.jacobian(flat), ord=2, axis=(1, 2))
    assert stretch.max() <= camera.magnification
    if camera.half_angle < math.pi / 2:
        assert (
            camera.near * np.linalg.norm(flat, axis=1).max()
            <= camera.near_corner
            <= 1.1
            * camera.near
            * np.linalg.norm(camera.rays(corners(camera)) / camera.rays(corners(camera))[:, 2:], axis=1).max()
        )
        assert camera.magnification <= 1.5 * stretch.max()
    else:
        assert camera.near_corner == math.inf


def corners(camera):
    right, bottom = camera.width - 0.5, camera.height - 0.5
    return np.array([[-0.5, -0.5], [right, -0.5], [-0.5, bottom], [right, bottom]])


@every
def test_a_part_and_another_size_see_the_same(camera):
    part = camera.part(20, 10, 60, 50, 3)
    assert (part.width, part.height, part.near) == (120, 120, camera.near) and type(part) is type(camera)
    xy = pixels(part, 200)
    inside = (xy + 0.5) / 3 - 0.5 + [20, 10]
    np.testing.assert_allclose(part.rays(xy), camera.rays(inside), atol=1e-12)
    small = camera.resized(60, 30)
    xy = pixels(small, 200)
    np.testing.assert_allclose(
        small.rays(xy), camera.rays((xy + 0.5) * [camera.width / 60, camera.height / 30] - 0.5), atol=1e-12
    )


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"width": 0}, ".width: not a size \\(got 0\\); expected a whole number of px, 1 or more"),
        ({"height": 2.5}, ".height: not a size \\(got 2.5\\)"),
        ({"fx": -3.0}, ".fx: not a length \\(got -3.0\\); expected a finite number above 0"),
        ({"fy": math.inf}, ".fy: not a length \\(got inf\\)"),
        ({"near": 0.0}, ".near: not a length \\(got 0.0\\)"),
        ({"cy": math.nan}, ".cy: not a position \\(got nan\\); expected a finite number of px"),
    ],
)
@every
def test_what_no_camera_has(camera, changes, message):
    refusal(ConfigError, replace, camera, match=f"^{type(camera).__name__}{message}", **changes)


# ---- pin-hole, by hand ---------------------------------------------------------------------------------------------


PIN_HOLE = PinHole(**SIZE)


def test_pin_hole_by_hand():
    assert PinHole(640, 480, 500.0, 510.0, 300.0, 250.0).project(np.array([1.0, -2.0, 4.0])).tolist() == [425.0, -5.0]
    assert PIN_HOLE.rays(np.array([52.0 + 95.0, 48.5 - 55.0])).tolist() == [1.0, -0.5, 1.0]
    assert np.isnan(PIN_HOLE.project(np.array([[1.0, 1.0, 0.0], [1.0, 1.0, -1.0]]))).all()
    assert np.isnan(PIN_HOLE.jacobian(np.array([1.0, 1.0, -1.0]))).all()
    camera = PinHole(3, 1, 1.5, 1.0, 1.0, 0.0, near=2.0)
    assert camera.near_corner == pytest.approx(2 * math.sqrt(1 + 1 + 0.25)) and camera.half_angle == pytest.approx(
        math.atan(math.sqrt(1.25))
    )
    assert camera.magnification == pytest.approx(1.5 * 1.5)


@pytest.mark.parametrize("camera", [c for c in CAMERAS if c.kind != "pinhole"], ids=lambda c: c.kind)
def test_only_a_pin_hole_camera_is_drawn(camera):
    with pytest.raises(
        ConfigError,
        match=rf"camera: this camera model cannot be drawn \(got '{camera.kind}'\); expected a pin-hole camera",
    ):
        camera.clip_from_cam()


# ---- no wider than the picture -------------------------------------------------------------------------------------

LOPSIDED = [
    PinHole(40, 30, 35.0, 20.0, cx, cy, 0.5) for cx in (-3.0, 10.0, 33.0) for cy in (2.0, 14.5, 31.0)
]  # the corner that is farthest out is another in each


def border(camera):
    """Pixels along the four sides, left, right, top, bottom: each (100, 2)."""
    right, bottom = camera.width - 0.5, camera.height - 0.5
    x, y, one = np.linspace(-0.5, right, 100), np.linspace(-0.5, bottom, 100), np.ones(100)
    return [np.stack(s, axis=-1) for s in ((-0.5 * one, y), (right * one, y), (x, -0.5 * one), (x, bottom * one))]


@pytest.mark.parametrize(
    "camera", [*CAMERAS, *LOPSIDED], ids=lambda c: f"{c.kind}-{c.cx:g}-{c.cy:g}-{c.k1 if hasattr(c, 'k1') else ''}"
)
def test_planes_touch_the_picture(camera):
    """A culled object is one that is out of the picture; a plane a quarter of a pixel off draws too much, for ever."""
    planes = camera.frustum_planes()
    if camera.half_angle > math.pi / 2:
        assert planes.shape == (0, 3)
        return
    np.testing.assert_allclose(np.linalg.norm(planes, axis=1), 1)
    assert planes[4].tolist() == [0, 0, 1] and planes.dtype == np.float64
    exact = camera.kind == "pinhole"
    for plane, side in zip(planes, border(camera)):
        rays = camera.rays(side)
        nearest = (rays @ plane).min() / np.linalg.norm(rays, axis=1).max()
        assert abs(nearest) < 1e-12 if exact else -1e-12 < nearest < 0.1 / camera.fx


# --- A camera model that nothing but this file knows, and each part of it taken away in turn.


@dataclass(frozen=True)
class Stereographic(DistortedModel):
    """A direction at the angle theta to the axis is seen at 2 f tan(theta / 2), stretched by ``pull``."""

    kind: ClassVar[str] = "stereographic"
    coefficients: ClassVar[tuple[str, ...]] = ("pull",)
    reach: ClassVar[float] = np.inf

    pull: float = 1.0

    def project(self, points):
        points = np.asarray(points, np.float64)
        ahead = points[..., 2] + np.linalg.norm(points, axis=-1)
        return 2 * self.pull * points[..., :2] / ahead[..., None] * [self.fx, self.fy] + [self.cx, self.cy]

    def jacobian(self, points):
        points = np.asarray(points, np.float64)
        length = np.linalg.norm(points, axis=-1, keepdims=True)
        ahead = points[..., 2:] + length
        eye = np.broadcast_to(np.eye(3)[:2], (*points.shape[:-1], 2, 3))
        slope = points / length + [0, 0, 1]
        out = (
            2
            * self.pull
            * (eye / ahead[..., None] - points[..., :2, None] * slope[..., None, :] / ahead[..., None] ** 2)
        )
        return np.array([[self.fx], [self.fy]]) * out

    def rays(self, xy):
        u = (np.asarray(xy, np.float64) - [self.cx, self.cy]) / [self.fx, self.fy] / (2 * self.pull)
        return np.concatenate([2 * u, 1 - (u**2).sum(axis=-1, keepdims=True)], axis=-1)

    def ray_jacobian(self, xy):
        u = (np.asarray(xy, np.float64) - [self.cx, self.cy]) / [self.fx, self.fy] / (2 * self.pull)
        out = np.concatenate([np.broadcast_to(2 * np.eye(2), (*u.shape, 2)), -2 * u[..., None, :]], axis=-2)
        return out / [self.fx, self.fy] / (2 * self.pull)


@pytest.fixture
def stereographic():
    yield register(Stereographic)
    del CAMERA_MODELS["stereographic"]


def test_a_model_from_outside_is_in_the_table(stereographic):
    assert CAMERA_MODELS["stereographic"] is Stereographic and register(Stereographic) is Stereographic
    camera = Stereographic(64, 48, 40.0, 40.0, 31.5, 23.5)
    assert camera.part(0, 0, 32, 24, 2).pull == 1.0


def without(part, value=None):
    """The class with one part taken away, or another in its place."""
    parts = (
        "__annotations__",
        "kind",
        "coefficients",
        "reach",
        "pull",
        "project",
        "jacobian",
        "rays",
        "ray_jacobian",
    )
    body = {name: vars(Stereographic)[name] for name in parts if name != part} | (
        {} if value is None else {part: value}
    )
    return dataclass(frozen=True)(type("Spoiled", (DistortedModel,), body))


@pytest.mark.parametrize(
    "part, value, problem",
    [
        ("project", None, "camera model 'stereographic': `project` is missing"),
        ("jacobian", None, "camera model 'stereographic': `jacobian` is missing"),
        ("rays", None, "`rays` is missing"),
        ("ray_jacobian", None, "`ray_jacobian` is missing"),
        ("kind", 3, "camera model Spoiled: `kind` is not a name"),
    ],
)
def test_a_part_that_is_missing_or_wrong_is_named(part, value, problem):
    before = dict(CAMERA_MODELS)
    with pytest.raises(TypeError, match=problem):
        register(without(part, value))
    assert before == CAMERA_MODELS


def test_what_is_no_model_and_what_is_there_already(stereographic):
    with pytest.raises(TypeError, match="'pinhole' is not a subclass of CameraModel"):
        register("pinhole")

    @dataclass(frozen=True)
    class Other(PinHole):
        kind: ClassVar[str] = "stereographic"

    with pytest.raises(TypeError, match="camera model 'stereographic': there is one already, Stereographic"):
        register(Other)


# --- Rectified pixels, DSEC's convention, with OpenCV as the judge.

SIZE_RECTIFIED = (160, 120, 130.0, 128.0, 82.0, 57.5)
LENSES = [
    Radtan(*SIZE_RECTIFIED, k1=-0.35, k2=0.15, p1=1e-3, p2=-2e-3),
    Radtan(*SIZE_RECTIFIED, k1=0.2, k2=-0.03, k3=0.01),
    Equidistant(*SIZE_RECTIFIED, k1=-0.03, k2=0.01, k3=-0.004, k4=0.001),
]


@pytest.mark.parametrize("lens", LENSES, ids=lambda c: f"{c.kind} {c.k1}")
def test_the_map_there_and_back(lens):
    map_ = rectify_map(lens)
    assert map_.shape == (120, 160, 2) and map_.dtype == np.float32
    y, x = np.mgrid[:120, :160]
    grid = np.stack([x, y], axis=-1)
    back = lens.project(rectified(lens).rays(map_))
    assert np.abs(back - grid).max() < 1e-4  # asked: 1e-3 px
    # OpenCV goes back by its own formulas
    rays = rectified(lens).rays(map_).reshape(1, -1, 3)
    if lens.kind == "radtan":
        theirs, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), lens.K, np.array(lens.distortion))
    else:
        theirs, _ = cv2.fisheye.projectPoints(rays, np.zeros(3), np.zeros(3), lens.K, np.array(lens.distortion))
    assert np.abs(theirs.reshape(grid.shape) - grid).max() < 1e-4
    undistort = cv2.undistortPoints if lens.kind == "radtan" else cv2.fisheye.undistortPoints
    theirs = undistort(grid.reshape(1, -1, 2).astype(float), lens.K, np.array(lens.distortion), P=lens.K)
    middle = np.linalg.norm(grid - [82.0, 57.5], axis=-1) < 55  # further out its few steps do not converge
    assert np.abs(theirs.reshape(grid.shape) - map_)[middle].max() < 1e-3


def test_a_pin_hole_camera_s_is_the_identity():
    map_ = rectify_map(PinHole(*SIZE_RECTIFIED))
    y, x = np.mgrid[:120, :160]
    np.testing.assert_allclose(map_, np.stack([x, y], axis=-1), atol=1e-4)


# --- The float64 reference and random worlds ask the camera model, whichever it is.

SECOND = 1_000_000_000
CAMERAS_SEEN_THROUGH = [
    model(48, 36, 30.0, 32.0, 22.0, 18.5, **getattr(model, "sample", {})) for model in CAMERA_MODELS.values()
]
every_of_seen_through = pytest.mark.parametrize("camera", CAMERAS_SEEN_THROUGH, ids=lambda c: c.kind)


def wall(camera):
    """A wall 4 m ahead that drifts by 0.3 m in x and -0.5 m in z each second, seen by a camera at rest in the
    origin."""
    path = KeyframePath(
        [0, SECOND], [(0, 0, 4.0), (0.3, 0, 3.5)], Rotation.concatenate([Rotation.identity()] * 2), "linear"
    )
    sheet = SceneObject("wall", 1, (Part(grid(width=40, depth=40), Material(both_sides=True)),), path)
    return Scene((sheet,), Rig.alone(camera, StaticPath(np.eye(4))), 0, SECOND)


@every_of_seen_through
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


@every_of_seen_through
def test_a_random_world_places_in_its_view(camera, tmp_path):
    config = RandomSceneConfig(objects={"count": 3, "in_view": 1.0}, textures={"photographs": False})
    scene = random_world(config, camera, 0, SECOND // 10, "train", 1, 0, tmp_path)
    assert scene.camera is camera and len(scene.objects) > 3
