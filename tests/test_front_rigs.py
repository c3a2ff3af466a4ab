"""Rigs in Python: what they record is what files hold; wrong ones say which argument."""

from __future__ import annotations

import numpy as np
import pytest

import blinkgl
from blinkgl import Camera, Rig, RigSensor, Timeline, record
from blinkgl.errors import ConfigError
from blinkgl.io.imu import read_imu
from blinkgl.io.sequence_tables import read_exposures
from blinkgl.sequence_files.rig_dir import read_sensors
from tests.test_front import box_scene

TURNED = np.array([[0.0, 0, 1, 0.02], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
RIG = Rig(
    RigSensor("left", pair="right", labels=["forward", "depth", "disparity", "images"], tracks={"points": 20}),
    RigSensor("right", pair="left", position=(0.2, 0, 0), emulator="v2e"),
    RigSensor(
        "fish", camera=Camera(40, 30, focal=28, lens="equidistant", distortion=(-0.02, 0.005, 0, 0)), euler=(0, 10, 0)
    ),
    RigSensor("rgb", camera={"fov": 90}, images={"rate": 20, "exposure_us": 2000}, imu={"rate": 100}),
    RigSensor("imu", imu="adis16448", matrix=TURNED),
)
TIMELINE = Timeline("uniform", fps=60)


@pytest.fixture(scope="module")
def recorded():
    return record(box_scene(), RIG, timeline=TIMELINE, labels=["forward"])


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("rig") / "out"
    assert len(blinkgl.generate(box_scene(), out, rig=RIG, timeline=TIMELINE, labels=["forward"]).made) == 1
    return out / "train/sequence_000000"


def test_arrays_are_what_the_files_hold(recorded, written):
    assert list(recorded.cameras) == ["left", "right", "fish", "rgb"] and set(recorded.units) == {"rgb", "imu"}
    for name in ("left", "right", "fish"):
        events, mine = blinkgl.read_events(written / name / "events.h5"), recorded[name].events
        assert len(mine) > 100 and all(np.array_equal(getattr(events, k), getattr(mine, k)) for k in "xytp"), name
        flow, valid = blinkgl.read_flow(written / name / "flow/forward/000000.png")
        assert np.abs(flow - recorded[name].flow[0])[valid].max() <= 0.5 / 128
    assert len(recorded["rgb"].events) == 0 and not (written / "rgb/events.h5").exists()
    assert len(recorded["rgb"].camera) == len(read_exposures(written / "rgb")) > 0
    np.testing.assert_array_equal(np.load(written / "left/disparity/000000.npy"), recorded["left"].labels[0].disparity)
    for folder, name in ((written / "rgb", "rgb"), (written / "imu", "imu")):
        np.testing.assert_array_equal(read_imu(folder)["acceleration"], recorded.units[name].acceleration)
    places = read_sensors(written)
    for name, T in recorded.T_rig_sensor.items():
        np.testing.assert_array_equal(places[name]["T_rig_sensor"], T)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: RigSensor("a/b"), "RigSensor.name: not a name for folders"),
        (lambda: RigSensor("a", euler=(0, 0, 1), quaternion=(1, 0, 0, 0)), "RigSensor: only one of euler"),
        (lambda: RigSensor("a", matrix=np.diag([1.0, 1, -1, 1])), "RigSensor.matrix: the matrix contains a reflection"),
        (lambda: RigSensor("a", matrix=np.full((4, 4), np.nan)), "RigSensor.matrix"),
        (lambda: RigSensor("a", matrix=np.eye(3)), "RigSensor.matrix: array of another type or shape"),
        (lambda: RigSensor("a", position=(0, np.nan, 0)), "RigSensor.position"),
        (lambda: RigSensor("a", camera=Camera(pose=(1, 0, 0))), "RigSensor.camera: a sensor moves with its rig"),
        (lambda: RigSensor("a", camera=5), "RigSensor.camera: not accepted: int"),
        (lambda: RigSensor("a", events=False, emulator="v2e"), "RigSensor.emulator: the sensor has no events"),
        (lambda: RigSensor("a", imu={"rate": 0}), "imu.rate"),
        (lambda: RigSensor("a", readout={"rows": 1}), "RigSensor.rows: unknown key"),
        (Rig, "Rig.sensors: the rig has no sensor"),
        (lambda: Rig("left"), "Rig.sensors\\[0\\]: not accepted: str"),
        (lambda: Rig(RigSensor("a"), RigSensor("A")), "Rig.sensors.1.name: two sensors have the same name"),
        (lambda: Rig(preset="kitti"), "Rig.preset: unknown rig"),
        (lambda: record(box_scene(), 7), "rig: not accepted: int"),
        (lambda: record(box_scene(), Rig(RigSensor("a", pair="b"))), "sensors.0.pair: no such camera on the rig"),
        (lambda: blinkgl.generate(box_scene(), "x", rig="stereo", imu="ideal"), "imu: belongs to a sensor"),
    ],
)
def test_wrong_rigs_say_which_argument(call, said):
    with pytest.raises(ConfigError, match=said):
        call()


def test_a_camera_that_is_not_there(recorded):
    with pytest.raises(ConfigError, match="no such camera on the rig.*left, right, fish, rgb"):
        recorded["imu"]


def test_what_is_said_of_one_camera_is_the_firsts(recorded):
    assert recorded.events is recorded["left"].events and recorded.flow.shape == recorded["left"].flow.shape
    assert recorded.imu is None and recorded.config.sensors is not None
    assert recorded.rig_t_us.tolist() == [0, *recorded.image_t_us.tolist()] and len(recorded.T_world_rig) > 2
    alone = record(box_scene(), labels=["forward"])
    assert list(alone.cameras) == [""] and alone[""].events is alone.events
    np.testing.assert_array_equal(alone.T_world_rig, recorded.T_world_rig)


def test_items_name_their_sensor():
    with blinkgl.simulate_sequence(box_scene(), RIG, timeline=TIMELINE, labels=[]) as sequence:
        assert {item.sensor for item in sequence} == {"left", "right", "fish", "rgb"}
        assert [name for name, _, _ in sequence.inertial_units()] == ["imu"] and sequence.height > 0
    assert {item.sensor for item in blinkgl.simulate_sequence(box_scene(), labels=[])} == {""}


def test_former_names_stay_for_one_release(recorded):
    with pytest.deprecated_call(match=r"record\(source, rig\)"):
        former = blinkgl.record_rig(box_scene(), RIG, timeline=TIMELINE, labels=["forward"])
    assert isinstance(former, blinkgl.RigRecording) and set(former.imu) == {"rgb", "imu"}
    np.testing.assert_array_equal(former.t_us, recorded.rig_t_us)
    with pytest.deprecated_call(match="simulate_sequence"):
        made = blinkgl.simulate_rig(box_scene(), RIG, timeline=TIMELINE, labels=[])
    with made as sequence:
        assert {member.name for member, _ in sequence} == {member.name for member in sequence.members}
