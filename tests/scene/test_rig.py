"""Sensors on a rig: what a configuration makes of one, and two eyes in a test, which no configuration asks for yet."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.config.problems import validate
from blinkgl.config.sequence import RenderConfig, SequenceConfig
from blinkgl.errors import ConfigError
from blinkgl.labels import LabelRequest
from blinkgl.render import casting, reference
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.geometry.primitives import cuboid, grid
from blinkgl.scene.motion.paths import KeyframePath, StaticPath
from blinkgl.scene.rig import Rig, Sensor
from blinkgl.scene.surfaces.textures import procedural_texture
from blinkgl.scene.types import Material, Part, Scene, SceneObject

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
    T = np.eye(4)
    T[:3, :3], T[0, 3] = Rotation.from_rotvec(turn).as_matrix(), x
    return T


def stereo(T_right=None):
    """A wall at 4 m and a box before it, seen by two eyes on a rig that slides and turns; the left one sits in its
    origin."""
    paint = Material(procedural_texture("fbm", 1, 128), double_sided=True, unlit=True)
    wall = SceneObject(
        "wall",
        1,
        (Part(grid(width=30, depth=30), paint),),
        StaticPath(offset(0) + [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 4], [0, 0, 0, 0]]),
    )
    box = SceneObject(
        "box",
        2,
        (Part(cuboid(extents=(0.6, 0.6, 0.6)), paint),),
        StaticPath(offset(0) + [[0, 0, 0, 0.1], [0, 0, 0, 0], [0, 0, 0, 2], [0, 0, 0, 0]]),
    )
    turns = Rotation.from_rotvec([[0, 0, 0], [0.02, -0.03, 0.05]])
    path = KeyframePath([0, SECOND], [(0, 0, 0), (0.2, 0.05, 0.3)], turns, "linear")
    sensors = (
        Sensor(CAMERA, folder="left"),
        Sensor(CAMERA, offset(BASELINE) if T_right is None else T_right, folder="right"),
    )
    return Scene((wall, box), Rig(path, sensors), 0, SECOND)


def test_a_configuration_makes_one_sensor_in_the_rigs_origin(tmp_path):
    scene = sequence_scene(CONFIG, 0, tmp_path)
    (sensor,) = scene.sensors
    assert sensor.camera == CONFIG.camera.model == scene.camera and sensor.folder == ""
    np.testing.assert_array_equal(sensor.T_rig_cam, np.eye(4))
    assert sensor.emulator is CONFIG.events and sensor.readout is None and sensor.labels is CONFIG.labels
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


@pytest.mark.parametrize("number", [0, 1])
def test_each_eye_agrees_with_the_reference(gl, number):
    """Depth, flow and velocity, by rays and analytic twists: a turned eye off the rig's centre of rotation has motion
    of its own."""
    scene = stereo(offset(BASELINE, (0.03, -0.1, 0.2))).seen_by(number)
    t, then = SECOND // 5, SECOND // 3
    truth = reference.render(scene, t, forward_ns=then)
    with Renderer(gl, scene, RenderConfig()) as renderer:
        drawn = renderer.labels(t, LabelRequest("depth", "flow_forward", "velocity"), then)
    sure = ~reference.silhouette_band(truth.instance, truth.depth)
    np.testing.assert_allclose(drawn.depth[sure], truth.depth[sure], rtol=1e-5)
    np.testing.assert_allclose(drawn.velocity[sure], truth.velocity[sure], atol=2e-3)
    both = sure & truth.forward.valid
    np.testing.assert_allclose(drawn.forward.flow[both], truth.forward.flow[both], atol=2e-4)
    assert np.abs(truth.velocity).max() > 2


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: Rig(StaticPath(np.eye(4)), ()), r"^Rig.sensors: a rig without a sensor; expected one or more"),
        (
            lambda: Rig(StaticPath(np.eye(4)), (Sensor(CAMERA, folder="a"), Sensor(CAMERA, folder="a"))),
            r"^Rig.sensors: two sensors have one folder \(got 'a'\); expected a folder each",
        ),
        (lambda: stereo().seen_by(2), r"^seen_by: no such sensor \(got 2\); expected 0 to 1"),
        (lambda: stereo(2 * np.eye(4)).seen_by(1).camera_path, r"pose is not rigid"),
    ],
)
def test_what_no_rig_is(make, message):
    with pytest.raises(ConfigError, match=message):
        make()
