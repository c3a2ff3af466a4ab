"""Sensors on a rig: what a configuration makes of one, and two eyes in a test, which no configuration asks for yet."""

import math

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.config.camera import CameraConfig
from blinkgl.config.lights import LightConfig, RandomLightsConfig
from blinkgl.config.problems import validate
from blinkgl.config.scene import ExplicitSceneConfig, RandomSceneConfig
from blinkgl.config.sequence import RenderConfig, SequenceConfig
from blinkgl.errors import ConfigError
from blinkgl.labels import LabelRequest
from blinkgl.render import casting
from blinkgl.render.renderer import Renderer
from blinkgl.rng import Role, generator
from blinkgl.scene.build import build_scene, sequence_scene
from blinkgl.scene.geometry.primitives import cuboid, grid
from blinkgl.scene.lights import beam, is_coloured, lamp_pose, lamps_of, make_light, random_lamps
from blinkgl.scene.motion.paths import KeyframePath, StaticPath
from blinkgl.scene.rig import Rig, Sensor
from blinkgl.scene.surfaces.environment import pixel_directions
from blinkgl.scene.surfaces.textures import procedural_texture
from blinkgl.scene.types import Light, Material, Part, Scene, SceneObject
from blinkgl.types.poses import pose_of
from tests.refusals import refusal

SECOND = 1_000_000_000
BASELINE = 0.12
CAMERA = PinHole(64, 48, 55.0, 55.0, 31.5, 23.5)
CONFIG = validate(
    SequenceConfig,
    {
        "camera": {"width": 64, "height": 48, "focal": 55},
        "time": {"duration": 0.1, "label_rate": 20},
        "labels": {"depth": True},
    },
)


def offset(x, turn=(0.0, 0.0, 0.0)):
    return pose_of((x, 0, 0), Rotation.from_rotvec(turn).as_matrix())


def stereo(T_right=None):
    """A wall at 4 m and a box before it, seen by two eyes on a rig that slides and turns; the left one sits in its
    origin."""
    paint = Material(procedural_texture("fbm", 1, 128), both_sides=True, unlit=True)
    wall = SceneObject(
        "wall",
        1,
        (Part(grid(width=30, depth=30), paint),),
        StaticPath(pose_of((0, 0, 4))),
    )
    box = SceneObject(
        "box",
        2,
        (Part(cuboid(extents=(0.6, 0.6, 0.6)), paint),),
        StaticPath(pose_of((0.1, 0, 2))),
    )
    turns = Rotation.from_rotvec([[0, 0, 0], [0.02, -0.03, 0.05]])
    path = KeyframePath([0, SECOND], [(0, 0, 0), (0.2, 0.05, 0.3)], turns, "linear")
    sensors = (
        Sensor(CAMERA),
        Sensor(CAMERA, offset(BASELINE) if T_right is None else T_right),
    )
    return Scene((wall, box), Rig(path, sensors), 0, SECOND)


def test_a_configuration_makes_one_sensor_in_the_rigs_origin(tmp_path):
    scene = sequence_scene(CONFIG, 0, tmp_path)
    (sensor,) = scene.sensors
    assert sensor.camera == CONFIG.camera.model == scene.camera
    np.testing.assert_array_equal(sensor.T_rig_cam, np.eye(4))
    assert sensor.baseline is None
    assert scene.camera_path is scene.rig.path  # the same object: today's numbers to the last bit


def test_disparity_is_focal_length_times_baseline_over_depth(gl):
    scene = stereo()
    frames = []
    for number in (0, 1):
        with Renderer(gl, scene.seen_by(number), RenderConfig()) as renderer:
            frames.append(renderer.labels(0, LabelRequest("depth", "ids")))
    left, right = frames
    xy = casting.pixel_grid(CAMERA)
    rays = CAMERA.rays(xy)
    points = rays * left.depth.reshape(-1, 1)
    there = CAMERA.project(points - [BASELINE, 0, 0])  # in the right eye's axes
    disparity = CAMERA.fx * BASELINE / left.depth.ravel()
    np.testing.assert_allclose(xy - there, np.stack([disparity, 0 * disparity], axis=1), atol=1e-4)
    x, y = np.rint(there).astype(int).T
    seen = (x >= 0) & (left.ids.ravel() == 2)
    agree = right.ids[y[seen], x[seen]] == 2
    assert seen.sum() > 50 and agree.mean() > 0.95  # the rest is the box's edge, half a pixel off


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: stereo().seen_by(2), r"^seen_by: no such sensor \(got 2\); expected 0 to 1"),
        (lambda: stereo(2 * np.eye(4)).seen_by(1).camera_path, r"pose is not rigid"),
    ],
)
def test_what_no_rig_is(make, message):
    refusal(ConfigError, make, match=message)


# --- Lights of a configuration, drawn ones, and what is refused.

SPOT = {"kind": "spot", "position": [1, 2, 3], "look_at": [1, 2, 0], "strength": 4, "angle": 40, "edge": 0.5}


def light(**tree) -> Light:
    return make_light(validate(LightConfig, tree, where="scene.light"), None)


def test_nothing_white_is_clipped_in_the_default_light():
    """However it faces the sun and the sky."""
    normals = np.random.default_rng(0).normal(size=(1000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    made = Light()
    around = made.sky * (0.5 + 0.5 * normals[:, 2])
    received = made.sun * np.maximum(0, normals @ made.sun_direction) + around
    assert 0.9 < received.max() <= 1.0


def test_lamps_of_a_configuration():
    made = light(
        lights=[
            SPOT,
            {"kind": "point", "position": [0, 0, 2], "color": [1, 0.5, 0], "strength": 2, "reach": 9},
            {"kind": "sun", "elevation": 0, "azimuth": 90, "strength": 0.5, "size": 2},
        ],
        sun_color=[1, 0.5, 0.25],
    )
    sun, other, point, spot = lamps_of(made)  # as the shader has them
    assert sun.strength == pytest.approx((0.6, 0.3, 0.15)) and sun.size == pytest.approx(math.radians(0.53))
    np.testing.assert_allclose(sun.path.pose(0)[:3, 2], made.sun_direction, atol=1e-12)
    np.testing.assert_allclose(other.path.pose(0)[:3, 2], [0, 1, 0], atol=1e-12)
    assert point.strength == (2, 1, 0) and point.reach == 9 and point.path.pose(5)[:3, 3].tolist() == [0, 0, 2]
    np.testing.assert_allclose(spot.path.pose(0)[:3, 2], [0, 0, 1], atol=1e-12)  # it shines down
    assert (spot.inner, spot.outer) == pytest.approx((math.radians(10), math.radians(20)))


@pytest.mark.parametrize("shines", [(0, 0, -1), (0, 1, 0), (1, 2, 3), (0, -1e-3, 0)])
def test_a_lamps_pose_is_rigid_and_shines_where_it_should(shines):
    R = lamp_pose((1, 2, 3), shines)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(-R[:, 2], np.array(shines) / np.linalg.norm(shines), atol=1e-12)
    assert np.linalg.det(R) > 0


def test_a_spot_light_fades_by_the_square_of_the_cosines_ramp():
    made = light(sun=0, lights=[SPOT])
    (lamp,) = lamps_of(made)
    angles = np.radians([0.0, 9.0, 15.0, 21.0])
    points = np.array([1, 2, 3]) + 2.0 * np.stack([np.sin(angles), 0 * angles, -np.cos(angles)], axis=1)
    towards, strength = beam(lamp, lamp.path.pose(0), points)
    ramp = (math.cos(angles[2]) - math.cos(math.radians(20))) / (
        math.cos(math.radians(10)) - math.cos(math.radians(20))
    )
    np.testing.assert_allclose(strength[:, 0], np.array([1, 1, ramp**2, 0]) * 4 / 2**2, atol=1e-12)
    np.testing.assert_allclose(towards * 2.0, np.array([1, 2, 3]) - points, atol=1e-12)


@pytest.mark.parametrize(
    "tree, expected",
    [
        ({"sun": -1}, "scene.light.sun: .*got -1"),
        ({"sun": math.inf}, "scene.light.sun"),
        ({"sky_color": [1, 1]}, "scene.light.sky_color"),
        ({"lights": [{"kind": "lamp"}]}, "scene.light.lights.0.*sun.*point.*spot"),
        ({"lights": [{"kind": "point"}]}, "scene.light.lights.0.*position"),
        ({"lights": [{"kind": "point", "position": [0, 0, 1], "strength": -2}]}, "lights.0.*strength.*got -2"),
        ({"lights": [{"kind": "point", "position": [0, 0, 1], "strength": math.inf}]}, "lights.0.*strength"),
        ({"lights": [{"kind": "sun", "position": [0, 0, 1]}]}, "lights.0.*position"),
        ({"lights": [{"kind": "point", "position": [0, 0, 1], "angle": 4}]}, "lights.0.*angle"),
        ({"lights": [{**SPOT, "look_at": [1, 2, 3]}]}, "look_at: must differ from the position"),
        ({"lights": [SPOT] * 32}, "scene.light.lights: too many lights .got 32.; expected at most 31"),
        ({"environment": {"map": "a.hdr"}, "unlit": True}, "scene.light.environment: these lights have no effect"),
        ({"environment": {}}, "scene.light.environment.map"),
        ({"environment": {"map": "a.hdr", "strength": -1}}, "environment.strength.*got -1"),
        ({"lights": [SPOT], "unlit": True}, "scene.light.lights: these lights have no effect"),
    ],
)
def test_what_is_refused(tree, expected):
    refusal(ConfigError, light, match=expected, **tree)


def test_random_lights():
    """As many as asked for, in their ranges, of a stream of their own."""
    config = RandomLightsConfig(count=[2, 5], kinds=["sun", "point", "spot"], height=[2, 3])
    drawn = [random_lamps(config, generator(7, k, Role.LIGHT), 10.0) for k in range(40)]
    assert {len(lamps) for lamps in drawn} == {2, 3, 4, 5}
    assert {lamp.kind for lamps in drawn for lamp in lamps} == {"sun", "point", "spot"}
    for lamp in (lamp for lamps in drawn for lamp in lamps):
        low, high = config.sun_strength if lamp.kind == "sun" else config.strength
        assert low * 0.999 <= max(lamp.strength) <= high * 1.001 and min(lamp.strength) >= 0.49 * max(lamp.strength)
        pose = lamp.path.pose(0)
        if lamp.kind != "sun":
            assert 2.0 <= pose[2, 3] <= 3.0 and np.abs(pose[:2, 3]).max() <= 10.0
        if lamp.kind != "point":
            assert pose[2, 2] > 0, "it shines downwards"
    again = random_lamps(config, generator(7, 3, Role.LIGHT), 10.0)
    assert [a.strength for a in again] == [b.strength for b in drawn[3]]


def test_bad_random_lights():
    for tree, expected in (
        ({"lights": {"count": [3, 1]}}, "lights.count: the range must be .fewest, most."),
        ({"lights": {"count": [0, 99]}}, "lights.count.1"),
        ({"lights": {"angle": [10, 179]}}, "lights.angle: out of range"),
        ({"lights": {"kinds": []}}, "lights.kinds"),
        ({"lights": {}, "light": {"unlit": True}}, "lights: these lights have no effect"),
        ({"sky": {"lights": True}}, "sky.lights: only panoramas can light the scene"),
        (
            {"sky": {"lights": True, "panoramas": "a.hdr"}, "light": {"unlit": True}},
            "sky.lights: these lights have no effect",
        ),
        ({"light": {"environment": {"map": "a.hdr"}}}, "light.environment: a random world uses the light of its sky"),
    ):
        refusal(ConfigError, validate, RandomSceneConfig, tree, where="scene", match=expected)


def panorama(folder):
    """A dark hall with one window, towards +y."""
    directions, _ = pixel_directions(64, 128)
    image = np.full((64, 128, 3), 0.05, np.float32)
    image[directions @ np.array([0, 0.8, 0.6]) > math.cos(0.15)] = (200.0, 150.0, 100.0)
    assert cv2.imwrite(str(folder / "hall.hdr"), image[..., ::-1].copy())
    return "hall.hdr"


def test_a_panorama_is_sky_and_light_at_once(tmp_path):
    """Of a random world and of an explicit one: the sun stands where the sky is brightest."""
    camera = CameraConfig(width=32, height=24)
    tree = {
        "objects": {"count": 1},
        "sky": {"panoramas": panorama(tmp_path), "lights": True, "brightness": 0.5},
        "textures": {"procedural": ["checks"], "photographs": False, "variants": 2, "test_fraction": 0},
        "pool": {"primitives": ["cuboid"], "variants": 2},
    }
    fixed = {
        "kind": "explicit",
        "meshes": {"box": {"primitive": "cuboid"}},
        "objects": [{"mesh": "box"}],
        "camera": {"position": [-3, 0, 1]},
        "light": {"environment": {"map": "hall.hdr", "strength": 0.5, "heading": 30}},
    }
    for config in (validate(RandomSceneConfig, tree), validate(ExplicitSceneConfig, fixed)):
        scene = build_scene(config, camera, 0, 10**9, base=tmp_path)
        (sun,) = lamps_of(scene.light)
        assert scene.light.sun == scene.light.sky == 0 and is_coloured(scene.light)
        (sky,) = (thing for thing in scene.objects if thing.category == "sky")
        best, where = 0.0, None
        for part in sky.parts:  # the middle of the brightest texels, on the box
            image = part.material.texture.image.sum(axis=2)
            y, x = (c.mean() for c in np.nonzero(image > 0.9 * image.max()))
            if image.max() > best and (image > 0.9 * image.max()).mean() < 0.3:
                uv = np.array([(x + 0.5) / image.shape[1], (y + 0.5) / image.shape[0]])
                corner = np.linalg.lstsq(
                    np.c_[part.mesh.uvs, np.ones(len(part.mesh.uvs))], part.mesh.vertices, rcond=None
                )[0]
                best, where = image.max(), np.array([*uv, 1.0]) @ corner
        assert sun.path.pose(0)[:3, 2] @ where > 0.99 * np.linalg.norm(where)
    towards = sun.path.pose(0)[:3, 2]
    assert math.degrees(math.atan2(towards[1], towards[0])) == pytest.approx(120, abs=1)  # +y, turned by 30
    with pytest.raises(ConfigError, match="scene.light.environment.map: no such file .got 'none.hdr'"):
        tree = {**fixed, "light": {"environment": {"map": "none.hdr"}}}
        build_scene(validate(ExplicitSceneConfig, tree), camera, 0, 10**9, base=tmp_path)
