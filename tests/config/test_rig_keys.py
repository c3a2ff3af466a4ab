"""`rig:` and `sensors:`: what a sensor has of the top, of its preset and of itself, and what is refused in one line."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from blinkgl.config.reader import parse_yaml
from blinkgl.config.rig import PlaceConfig
from blinkgl.config.run import RunTemplate, load_run
from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import ConfigError
from tests.refusals import refusal


def read(text: str) -> SequenceConfig:
    return RunTemplate(parse_yaml(text, "test"), None).sequence(0)  # type: ignore[bad-argument-type]


def refused(text: str) -> str:
    return refusal(ConfigError, read, text)


def test_a_sensor_has_what_the_top_says_and_what_it_says_itself():
    config = read(
        "{camera: {width: 40, fov: 50}, events: {emulator: v2e, cutoff_hz: 30}, labels: {depth: true}, sensors: ["
        "{name: a}, {name: b, camera: {width: 20}, events: {cutoff_hz: 90}}, {name: c, events: {emulator: esim}},"
        "{name: f, images: {}}, {name: i, imu: {rate: 50}}]}"
    )
    a, b, c, f, i = config.sensors
    assert [s.camera.width for s in (a, b, c, f)] == [40, 20, 40, 40] and b.camera.fov == 50
    assert (a.events.cutoff_hz, b.events.cutoff_hz, c.events.emulator) == (30, 90, "esim")
    assert a.labels.depth and a.labels.flow and f.events is None and i.events is None
    assert not f.labels.depth and not f.labels.flow and not f.labels.images, "a frame camera has the labels it asks for"
    assert [s.sees for s in config.sensors] == [True, True, True, True, False]
    own = config.of_sensor(1)
    assert own.camera == b.camera and own.events == b.events and own.sensors is None and not own.preview.enabled


def test_presets_are_laid_under_what_is_said_by_name():
    left, right, imu = read(
        "{rig: stereo, sensors: [{name: imu, imu: {}}, {name: right, place: {position: [0.25, 0, 0]}}]}"
    ).sensors
    assert (left.name, right.name, imu.name) == ("left", "right", "imu") and right.place.T[0, 3] == 0.25
    assert left.pair == "right" and right.pair == "left"


def test_places():
    turned = PlaceConfig(position=(1, 2, 3), euler=(0, 0, 90)).T
    assert np.allclose(turned[:3, :3] @ [1, 0, 0], [0, 1, 0]) and turned[:3, 3].tolist() == [1, 2, 3]
    assert np.allclose(PlaceConfig(quaternion=(2, 0, 0, 2)).T[:3, :3], turned[:3, :3])
    rows = [[0.0, -1.000004, 0, 1], [1, 0.0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    T = PlaceConfig(matrix=rows).T
    assert np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-15 and np.allclose(T, turned, atol=1e-5)
    exact = PlaceConfig(matrix=turned.round(15).tolist()).T
    assert np.abs(exact - turned).max() < 1e-12


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("rig: kitti", "rig: unknown rig (got 'kitti'); expected one of davis, dsec, mvsec, stereo"),
        ("sensors: []", "sensors: the rig has no sensor"),
        ("sensors: {a: {}}", "sensors: not a list"),
        ("sensors: [left]", "sensors.0: not a table of keys (got 'left')"),
        ("sensors: [{}]", "sensors.0.name: is required"),
        ("sensors: [{name: left}, {name: Left}]", "sensors.1.name: two sensors have the same name (got 'Left')"),
        ("sensors: [{name: a/b}]", "sensors.0.name: not a name for folders (got 'a/b')"),
        ("sensors: [{name: ..}]", "sensors.0.name: not a name for folders"),
        ("sensors: [{name: rig.yaml}]", "sensors.0.name: not a name for folders"),
        ("sensors: [{name: a, timeline: {kind: uniform}}]", "sensors.0.timeline: the sensors of a rig share the clock"),
        ("sensors: [{name: a, time: {start: 3}}]", "sensors.0.time: the sensors of a rig share the clock"),
        ("sensors: [{name: a, images: {times: [7]}}]", "sensors.0.images.times: "),
        ("sensors: [{name: a, images: {rate: 10, times: [0.7]}}]", "sensors.0.images.rate: "),
        ("sensors: [{name: a, camera: {width: 0}}]", "sensors.0.camera.width: too small"),
        ("sensors: [{name: a, gain: 1}]", "sensors.0.gain: unknown key"),
        ("{sensors: [{name: a}], imu: {}}", "imu: belongs to a sensor, not to the rig"),
        ("{sensors: [{name: a}], images: {}}", "images: belongs to a sensor, not to the rig"),
        ("{sensors: [{name: a}], frames: {folders: x}}", "sensors: recorded frames have only one camera"),
        (
            "{sensors: [{name: a}], scene: {kind: file, path: x.glb, intrinsics: file}}",
            "scene.intrinsics: the file's camera cannot be used for a rig",
        ),
        ("labels: {disparity: true}", "labels.disparity: a single camera has no disparity"),
        (
            "{labels: {disparity: true}, rig: stereo, sensors: [{name: c}]}",
            "sensors.2.labels.disparity: this sensor has no pair",
        ),
        ("sensors: [{name: a, pair: b}]", "sensors.0.pair: no such camera on the rig (got 'b')"),
        ("sensors: [{name: a, pair: b}, {name: b, imu: {}}]", "sensors.0.pair: no such camera on the rig (got 'b')"),
        ("sensors: [{name: a, pair: b}, {name: b}]", "sensors.0.pair: the two are not a rectified pair"),
    ],
)
def test_one_clear_line(text, said):
    assert said in refused(text)


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("{position: [.nan, 0, 0]}", "position.0: not a finite number"),
        ("{matrix: [[1,0,0,0],[0,1,0,0],[0,0,.inf,0],[0,0,0,1]]}", "matrix.2.2: not a finite number"),
        ("{matrix: [[1,0,0,0],[0,1,0,0],[0,0,2,0],[0,0,0,1]]}", "matrix: the matrix is no rotation"),
        ("{matrix: [[1,0,0,0],[0,1,0,0],[0,0,-1,0],[0,0,0,1]]}", "matrix: the matrix contains a reflection"),
        ("{matrix: [[1,0,0,0],[0,1,0,0],[0,0,1,0],[1,0,0,1]]}", "matrix: the last row of a pose is not 0, 0, 0, 1"),
        ("{matrix: [[1,0,0,0],[0,1,0,0],[0,0,1,0]]}", "matrix: too few entries"),
        ("{quaternion: [0, 0, 0, 0]}", "quaternion: a quaternion must not be zero"),
        ("{euler: [0, 0, 1], quaternion: [1, 0, 0, 0]}", "only one of euler, quaternion, matrix"),
        (
            "{position: [1, 0, 0], matrix: [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}",
            "position: the matrix contains the position",
        ),
    ],
)
def test_places_that_are_none(place, said):
    line = refused(f"sensors: [{{name: a, place: {place}}}]")
    assert "sensors.0.place" in line and said in line


@pytest.mark.parametrize(
    ("top", "own", "fx_fy"),
    [
        ("focal: 60", "fx: 50, fy: 51", (50, 51)),
        ("fx: 50, fy: 51", "focal: 60", (60, 60)),
        ("fx: 50, fy: 51", "fy: 52", (50, 52)),
        ("fov: 50", "focal: 60", (60, 60)),
        ("focal: 60", "cx: 3", (60, 60)),
    ],
)
def test_a_sensor_that_says_how_long_its_lens_is_does_not_have_it_of_the_top(top, own, fx_fy):
    config = read(f"{{camera: {{width: 40, height: 30, {top}}}, sensors: [{{name: a, camera: {{{own}}}}}]}}")
    assert config.sensors[0].camera.model.intrinsics[:2] == fx_fy


def test_two_ways_of_its_own_are_still_refused():
    said = refused("{camera: {width: 40, focal: 60}, sensors: [{name: a, camera: {fov: 50, focal: 9}}]}")
    assert said == "sensors.0.camera: give fov or focal, not both"


def test_a_calibration_takes_the_place_of_a_presets_camera(tmp_path):
    """Whole: no focal length, principal point, distortion or place of `rig: mvsec` remains."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("y", 1.0, degrees=True).as_matrix(), (-0.1, 0.001, 0)
    lens = {"camera_model": "pinhole", "intrinsics": [226.0, 225.0, 173.0, 133.0], "resolution": [346, 260]}
    bent = {"distortion_model": "equidistant", "distortion_coeffs": [-0.05, 0.01, 0.0, 0.0]}
    chain = {"cam0": lens | bent, "cam1": lens | {"distortion_model": "none", "T_cn_cnm1": T.tolist()}}
    (tmp_path / "k.yaml").write_text(yaml.safe_dump(chain), encoding="utf-8")
    cameras = [{"calibration": "k.yaml", "calibration_name": name} for name in chain]
    sensors = [{"name": n, "pair": None, "camera": c} for n, c in zip(("left", "right"), cameras)]
    (tmp_path / "run.yaml").write_text(yaml.safe_dump({"rig": "mvsec", "sensors": sensors}), encoding="utf-8")
    left, right = load_run(tmp_path / "run.yaml").sequence(0).sensors
    assert (left.camera.model.kind, right.camera.model.kind) == ("equidistant", "pinhole")
    assert left.camera.model.intrinsics == right.camera.model.intrinsics == (226.0, 225.0, 173.0, 133.0)
    np.testing.assert_allclose(right.place.T, np.linalg.inv(T), atol=1e-12)
    assert left.events is not None
    (tmp_path / "run.yaml").write_text("rig: mvsec\ncamera: {calibration: k.yaml}", encoding="utf-8")
    with pytest.raises(ConfigError, match="camera.calibration: sensor 'left' has a camera of its own .got 'k.yaml'"):
        load_run(tmp_path / "run.yaml")


def test_a_calibration_places_its_cameras(tmp_path):
    """Kalibr's T_cn_cnm1 leads from camera n - 1 to n; the rig's origin is the first camera."""
    turned = np.eye(4)
    turned[:3, :3], turned[:3, 3] = Rotation.from_euler("y", 10, degrees=True).as_matrix(), (-0.1, 0.01, 0.02)
    shifted = np.eye(4)
    shifted[:3, 3] = (-0.05, 0, 0)
    lens = {"camera_model": "pinhole", "distortion_model": "none", "distortion_coeffs": [], "resolution": [64, 48],
            "intrinsics": [50.0, 50.0, 31.5, 23.5]}  # fmt: skip
    chain = {
        "cam0": lens,
        "cam1": lens | {"T_cn_cnm1": turned.tolist(), "T_cam_imu": turned.tolist()},
        "cam2": lens | {"T_cn_cnm1": shifted.tolist()},
    }
    (tmp_path / "k.yaml").write_text(yaml.safe_dump(chain))
    sensors = [{"name": n, "camera": {"calibration": "k.yaml", "calibration_name": n}} for n in chain]
    sensors.append({**sensors[2], "name": "own", "place": {"position": [1, 0, 0]}})
    sensors[1]["imu"] = {"rate": 100}
    (tmp_path / "run.yaml").write_text(yaml.safe_dump({"sensors": sensors}))
    made = load_run(tmp_path / "run.yaml").sequence(0)
    places = [sensor.place.T for sensor in made.sensors]
    expected = [np.eye(4), np.linalg.inv(turned), np.linalg.inv(shifted @ turned)]
    np.testing.assert_allclose(places[:3], expected, atol=1e-9)
    np.testing.assert_allclose(places[3][:3, 3], (1, 0, 0))
    unit = made.sensors[1].imu
    np.testing.assert_allclose(unit.position, turned[:3, 3], atol=1e-12)
    np.testing.assert_allclose(Rotation.from_euler("xyz", unit.rotation, degrees=True).as_matrix(), turned[:3, :3])


def test_a_sensor_of_labels_alone_is_a_camera():
    """It inherits the camera of the top, and its labels are written; an inertial unit alone is none."""
    config = read(
        "camera: {width: 64, height: 48}\n"
        "sensors: [{name: left}, {name: truth, events: null, labels: {depth: true}}, {name: unit, imu: {rate: 100}},"
        " {name: points, events: null, tracks: {points: 10}}]"
    )
    assert [one.sees for one in config.sensors] == [True, True, False, True]
    assert [one.name for one in config.cameras()] == ["left", "truth", "points"]
    assert config.sensors[1].camera.width == 64 and config.sensors[1].events is None


def test_a_camera_beside_an_inertial_unit_stays():
    """`imu:` alone makes an inertial unit; with a camera of its own the sensor has both."""
    config = read("sensors: [{name: left, camera: {fov: 70}, imu: {rate: 200}}, {name: right, camera: {fov: 70}}]")
    left, right = config.sensors
    assert left.sees and left.events == right.events and left.labels == right.labels
    assert left.imu is not None and left.imu.rate == 200 and right.imu is None
    assert [one.name for one in config.cameras()] == ["left", "right"]


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ("events: null, camera: {fov: 70}", "camera: is not used: the sensor has no camera"),
        ("events: null, imu: {}, camera: {fov: 70}", "camera: is not used: the sensor has no camera"),
        ("imu: {}, readout: {events_per_second: 1e6}", "readout: is not used: the sensor has no camera"),
        ("images: {rate: 10}, readout: {events_per_second: 1e6}", "readout: is not used: the sensor has no events"),
        ("events: null, labels: {depth: true}, readout: {}", "readout: is not used: the sensor has no events"),
    ],
)
def test_a_key_that_would_not_be_used_is_refused(keys, said):
    line = refused(f"sensors: [{{name: right}}, {{name: left, {keys}}}]")
    assert f"sensors.1.{said}; expected events: {{}} beside it, or without this key" in line


def test_cameras_of_euroc_are_where_their_files_say(tmp_path):
    """T_BS is the camera's pose on the body; a ``place`` of the recipe's own comes first."""
    for k, x in ((0, 0.0), (1, 0.11)):
        (tmp_path / f"cam{k}.yaml").write_text(
            f"T_BS: {{cols: 4, rows: 4, data: [0,-1,0,{x}, 1,0,0,0.02, 0,0,1,0, 0,0,0,1]}}\nresolution: [752, 480]\n"
            "camera_model: pinhole\nintrinsics: [458.7, 457.3, 367.2, 248.4]\n"
            "distortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
        )
    cameras = [{"name": f"c{k}", "camera": {"calibration": f"cam{k}.yaml"}} for k in (0, 1)]
    cameras.append({**cameras[1], "name": "own", "place": {"position": [5, 0, 0]}})
    (tmp_path / "r.yaml").write_text(yaml.safe_dump({"sensors": cameras}))
    places = [one.place.T for one in load_run(tmp_path / "r.yaml").sequence(0).sensors]
    for T, position in zip(places, ([0, 0.02, 0], [0.11, 0.02, 0])):
        np.testing.assert_allclose(T[:3], [[0, -1, 0, position[0]], [1, 0, 0, 0.02], [0, 0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(places[2][:3, 3], [5, 0, 0])
