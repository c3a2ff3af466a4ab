"""Random trajectories: what was configured is what they do."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.config.problems import validate
from blinkgl.config.trajectory import CameraMotion, ObjectMotion
from blinkgl.errors import ConfigError
from blinkgl.scene.motion.paths import PausedPath, StaticPath
from blinkgl.scene.motion.trajectories import FreeSpace, look_rotation
from blinkgl.types.poses import pose_of
from tests.refusals import refusal
from tests.scene.motion.rates import statistics
from tests.scene.motion.starts import random_camera_path, random_path

SECOND = 1_000_000_000
SPACE = FreeSpace((-4, -4, 0), (4, 4, 3), 0.0, [[0, 0, 0.5], [2, 2, 0.5], [-2, 1, 1]], [0.5, 0.6, 0.4])
TARGET = np.array([0.0, 0.0, 0.5])


def rng(seed=0):
    return np.random.default_rng(seed)


def placed(x, y, z):
    return pose_of((x, y, z), Rotation.from_euler("xyz", [0.4, 0.2, 1.0]).as_matrix())


@pytest.mark.parametrize(
    "speed, rate, duration", [(1.0, 90.0, SECOND), (0.05, 5.0, SECOND), (8.0, 1500.0, SECOND), (1.0, 40.0, 20 * SECOND)]
)
def test_mean_speed_and_rate_are_the_configured_ones(speed, rate, duration):
    config = ObjectMotion(speed=speed, rotation_rate=rate)
    for seed in range(4):
        path = random_path(rng(seed), 0, duration, config, SPACE, 0.2)
        got = statistics(path, 0, duration, samples=2000)
        assert got.mean_speed == pytest.approx(speed, rel=5e-3)
        assert math.degrees(got.mean_rate) == pytest.approx(rate, rel=5e-3)
        assert got.mean_speed <= got.peak_speed < 5 * speed and got.mean_rate <= got.peak_rate < 4 * got.mean_rate
        assert path.t0_ns == 0 and path.t1_ns >= duration - 1


def test_ranges_are_drawn_per_body():
    config = ObjectMotion(speed=[0.5, 2.0], rotation_rate=[30, 90])
    found = [statistics(random_path(rng(s), 0, SECOND, config, SPACE, 0.1), 0, SECOND, 200) for s in range(12)]
    speeds = np.array([f.mean_speed for f in found])
    assert speeds.min() > 0.49 and speeds.max() < 2.02 and np.ptp(speeds) > 0.5


def test_waypoints_and_curve_lie_in_free_space():
    config = ObjectMotion(speed=3.0, waypoints=8)
    inside = 0
    for seed in range(20):
        path = random_path(rng(seed), 0, 2 * SECOND, config, SPACE, 0.3)
        keys = path.poses(path.key_times_ns)[:, :3, 3]
        # Way-points: all; refined keys lie on the curve, which is checked below.
        assert SPACE.depth(keys, 0.3).max() < 0.2
        inside += SPACE.depth(path.poses(np.linspace(0, 2 * SECOND, 300).astype(np.int64))[:, :3, 3], 0.3).max() <= 1e-3
    assert inside >= 17


def test_the_start_pose_is_kept_exactly_and_hemmed_in_bodies_get_out():
    start = placed(0.05, 0.0, 0.6)  # inside the first obstacle's bounding sphere
    for seed in range(5):
        path = random_path(rng(seed), 7, SECOND, ObjectMotion(speed=1.0), SPACE, 0.2, start)
        assert np.abs(path.pose(7) - start).max() < 1e-14
        distance = np.linalg.norm(
            path.poses(np.linspace(7, SECOND, 50).astype(np.int64))[:, :3, 3] - SPACE.centres[0], axis=1
        )
        assert distance.max() > 0.5
    camera = random_camera_path(rng(1), 7, SECOND, CameraMotion(shake=1.0), SPACE, 0.1, TARGET, start=start)
    assert np.abs(camera.pose(7) - start).max() < 1e-14


def test_on_the_ground_it_slides_and_turns_about_the_vertical():
    start = placed(2.0, -2.0, 0.21)
    path = random_path(rng(3), 0, SECOND, ObjectMotion(speed=1.0, rotation_rate=90), SPACE, 0.3, start, on_ground=True)
    T = path.poses(np.linspace(0, SECOND, 200).astype(np.int64))
    assert np.ptp(T[:, 2, 3]) < 1e-14
    # The world's vertical stays where it was in the body's frame: pure yaw.
    assert np.abs(T[:, 2, :3] - start[2, :3]).max() < 1e-12
    got = statistics(path, 0, SECOND)
    assert got.mean_speed == pytest.approx(1.0, rel=5e-3) and math.degrees(got.mean_rate) == pytest.approx(90, rel=5e-3)


def test_the_camera_keeps_its_target_in_view():
    config = CameraMotion(speed=1.0, rotation_rate=45.0, view_cone=15.0, roll=10.0)
    space = FreeSpace((-4, -4, 0), (4, 4, 3), 0.0, [TARGET], [1.5])
    for seed in range(12):
        path = random_camera_path(rng(seed), 0, SECOND, config, space, 0.2, TARGET)
        T = path.poses(np.linspace(0, SECOND, 100).astype(np.int64))
        aim = TARGET - T[:, :3, 3]
        cosine = np.einsum("ij,ij->i", aim / np.linalg.norm(aim, axis=1, keepdims=True), T[:, :3, 2])
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 30
        assert np.degrees(np.arcsin(np.abs(T[:, 2, 0]))).max() < 25
        assert (T[:, 2, 1] < 0).all()  # image down is world down
        assert statistics(path, 0, SECOND).mean_speed == pytest.approx(1.0, rel=5e-3)


def test_shake_adds_high_frequencies_only_to_the_rotation():
    calm = CameraMotion(speed=1.0, rotation_rate=20.0)
    shaky = calm.model_copy(update={"shake": 1.0})
    a, b = (random_camera_path(rng(5), 0, SECOND, c, SPACE, 0.1, TARGET) for c in (calm, shaky))
    times = np.linspace(0, SECOND, 400).astype(np.int64)
    A, B = a.poses(times), b.poses(times)
    assert np.abs(A[:, :3, 3] - B[:, :3, 3]).max() < 1e-9  # the curve is the same
    angle = Rotation.from_matrix(A[:, :3, :3].transpose(0, 2, 1) @ B[:, :3, :3]).magnitude()
    assert 0.5 < np.degrees(np.sqrt((angle**2).mean())) < 3.5
    assert statistics(b, 0, SECOND).mean_rate > 1.3 * statistics(a, 0, SECOND).mean_rate


def test_standing_still():
    still = ObjectMotion(kind="static")
    assert isinstance(random_path(rng(), 0, SECOND, still, SPACE, 0.2), StaticPath)
    assert random_path(rng(), 0, SECOND, ObjectMotion(speed=0, rotation_rate=0), SPACE, 0.2).is_static
    spin = random_path(rng(), 0, SECOND, ObjectMotion(speed=0, rotation_rate=50), SPACE, 0.2)
    assert statistics(spin, 0, SECOND).peak_speed < 1e-9 and not spin.is_static
    glide = random_path(rng(), 0, SECOND, ObjectMotion(speed=1, rotation_rate=0), SPACE, 0.2)
    assert statistics(glide, 0, SECOND).peak_rate < 1e-9
    share = [random_path(rng(s), 0, SECOND, ObjectMotion(static_share=0.5), SPACE, 0.2).is_static for s in range(60)]
    assert 15 <= sum(share) <= 45  # binomial(60, 1/2): outside with probability 1e-4
    assert random_camera_path(rng(), 0, SECOND, CameraMotion(kind="static"), SPACE, 0.2, TARGET).is_static


def test_look_rotation_is_a_rotation_with_a_level_horizon():
    for direction in ([1, 0, 0], [0.3, -2, 1], [0, 0, -1], [0, 0, 1], [0, 0, 0]):
        R = look_rotation(direction)
        assert np.allclose(R @ R.T, np.eye(3), atol=1e-14) and np.isclose(np.linalg.det(R), 1)
        assert abs(R[2, 0]) < 1e-14
        if np.any(direction):
            assert np.allclose(R[:, 2], np.array(direction) / np.linalg.norm(direction))


@pytest.mark.parametrize(
    "data, message",
    [
        ({"speeed": 1}, r"scene.object_motion.speeed: unknown key; expected 'speed'"),
        ({"speed": [2, 1]}, r"scene.object_motion.speed: the range must be"),
        ({"speed": -1}, r"scene.object_motion.speed.0: too small \(got -1\); expected a number from 0 to"),
        ({"speed": "fast"}, r"scene.object_motion.speed"),
        (
            {"waypoints": 1},
            r"scene.object_motion.waypoints: too small \(got 1\); expected a whole number from 2 to 1000",
        ),
        ({"smoothness": 1.5}, r"scene.object_motion.smoothness"),
        ({"kind": "circle"}, r"scene.object_motion.kind.*'spline' or 'static'"),
    ],
)
def test_bad_settings_are_named(data, message):
    refusal(ConfigError, validate, ObjectMotion, data, where="scene.object_motion", match=message)


# --- free space, by hand ----------------------------------------------------------------------------------------------

BOX = FreeSpace((-4, -4, 0), (4, 4, 3), 0.25, [[0, 0, 1], [2, 0, 1]], [0.5, 1.0])


def test_obstacles_that_a_body_began_in_are_left_out():
    at = np.array([[0, 0.5, 1.0]])
    assert BOX.depth(at, 0.25) == pytest.approx(0.25) and BOX.depth(at, 0.25, np.array([True, False])) == 0.0
    assert BOX.depth(at, 0.25, np.array([False, True])) == pytest.approx(0.25)
    free = FreeSpace((0, 0, 0), (1, 1, 1))
    assert free.depth(np.array([[0.5, 0.5, 0.0]]), 5.0) == 0.0, "neither ground nor obstacles"
    assert free.leg_is_free(np.zeros(3), np.ones(3), 5.0) and not free.leg_is_free(np.zeros(3), np.full(3, 1.01), 5.0)


@pytest.mark.parametrize(
    "a, b, free",
    [
        ((-3, -3, 1), (3, -3, 1), True),
        ((-3, -3, 1), (4.1, -3, 1), False),
        ((-4.5, -3, 1), (-4.2, -3, 1), True),  # outside of the box already, and no farther
        ((-4.5, -3, 1), (-4.6, -3, 1), False),
        ((-3, -3, 1), (-3, -3, 0.5), True),
        ((-3, -3, 1), (-3, -3, 0.4), False),  # into the ground
        ((-3, -3, 0.3), (-2, -3, 0.3), True),  # in it from the beginning, and no deeper
        ((-3, -3, 0.3), (-2, -3, 0.29), False),
        ((-3, 0, 1), (-0.75, 0, 1), True),
        ((-3, 0, 1), (-0.7, 0, 1), False),
        ((-3, 0, 1), (3.9, 0, 1), False),
        ((-3, 0.75, 1), (0.5, 0.75, 1), True),
        ((-3, 0.7, 1), (0.5, 0.7, 1), False),
        ((0, 0.5, 1), (0, 3, 1), True),  # out of an obstacle
        ((0, 0.5, 1), (0, 0.4, 1), False),
        ((0, 0.5, 1), (0, 0.5, 1), True),
    ],
)
def test_straight_legs_between_obstacles(a, b, free):
    assert BOX.leg_is_free(np.array(a, float), np.array(b, float), 0.25) is free


def test_what_is_no_free_space():
    for low, centres in (((0, 0, 1), []), ((0, 0, 0), [[1, 1, 1]])):
        with pytest.raises(ValueError, match="low has to be below high, and each centre needs a radius"):
            FreeSpace(low, (1, 1, 0.5), None, centres)


def test_looking_up_and_down():
    for z in (1, -1):
        assert look_rotation([0, 0, z])[:, 0].tolist() == [1, 0, 0]
    R = look_rotation([1e-10, 0, 1.0])
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-15) and abs(R[:, 0] @ R[:, 2]) < 1e-15
    assert look_rotation([0, 2, 0]).tolist() == [[1, 0, 0], [0, 0, 1], [0, -1, 0]] == look_rotation([0, 0, 0]).tolist()


# --- pieces of smooth motion, headings, pauses ------------------------------------------------------------------------


def unevenness(path, t_ns: int, span_ns: int) -> float:
    """|F + B| / |F| of the origin's displacement to the next and the last window: 0 for constant velocity."""
    before, now, after = path.poses(np.array([t_ns - span_ns, t_ns, t_ns + span_ns]))[:, :3, 3]
    return float(np.linalg.norm(after - 2 * now + before) / np.linalg.norm(after - now))


def test_way_points_per_second_make_short_sequences_smooth():
    """A fifth of a second is a piece of a motion and not six turns; a long sequence has as many turns per second."""
    fifth, uneven = SECOND // 5, {}
    for name, config in (("six", ObjectMotion()), ("per second", ObjectMotion(waypoints_per_s=2))):
        paths = [random_path(rng(s), 0, fifth, config, SPACE, 0.1) for s in range(30)]
        uneven[name] = np.median([unevenness(p, fifth // 2, fifth // 4) for p in paths])
    assert uneven["per second"] < 0.1 < 0.3 < uneven["six"]
    assert [ObjectMotion(waypoints_per_s=2).points(s) for s in (0.01, 0.5, 0.51, 10)] == [2, 2, 3, 21]
    assert ObjectMotion(waypoints_per_s=1000).points(1e6) == 10_000 and ObjectMotion().points(1e6) == 6


@pytest.mark.parametrize("heading, low, high", [("view", 0.99, 1.01), ("across", 0.0, 0.02)])
def test_a_camera_sets_out_along_its_view_or_across_it(heading, low, high):
    config = CameraMotion(heading=heading, waypoints_per_s=1, smoothness=1, rotation_rate=0, speed=1)
    signs = set()
    for seed in range(12):
        path = random_camera_path(rng(seed), 0, SECOND // 5, config, FreeSpace((-9, -9, 0), (9, 9, 9)), 0.1, TARGET)
        start, end = path.poses(np.array([0, SECOND // 5]))
        moved = (end - start)[:3, 3] / np.linalg.norm((end - start)[:3, 3])
        assert low <= abs(moved @ start[:3, 2]) <= high
        np.testing.assert_allclose(start[:3, :3], end[:3, :3], atol=1e-9)
        signs.add(np.sign(moved @ start[:3, 2]))
    assert signs == {-1.0, 1.0}, "there and back"


def test_a_pause_stands_still_and_goes_on_without_a_jump():
    config = ObjectMotion(pauses=1, waypoints_per_s=2, speed=1, rotation_rate=50)
    path = random_path(rng(4), 0, SECOND, config, SPACE, 0.1)
    other = random_path(rng(4), 0, SECOND, config.model_copy(update={"pauses": 0.0}), SPACE, 0.1)
    assert isinstance(path, PausedPath) and not path.is_static and path.t1_ns > other.t1_ns
    t = np.arange(0, SECOND, 10**6)
    poses, speeds = path.poses(t), np.array([np.linalg.norm(path.derivative(int(s))) for s in t])
    still = speeds == 0
    assert 0.1 <= still.mean() <= 0.5 and np.ptp(poses[still], axis=0).max() == 0
    assert np.abs(np.diff(speeds)).max() < 0.05 * speeds.max()  # softly
    begin, end, late = t[still][0], t[still][-1], path.hold_ns + path.ramp_ns
    assert path.speed_bound(begin, end) == (0.0, 0.0) and path.speed_bound(0, SECOND)[0] >= speeds.max() * 0.2
    for at in (10**7, int(begin) - 10**7, path.stop_ns + late + 10**7):  # the derivative is that of the pose
        step = 10**5
        differences = (path.pose(at + step) - path.pose(at - step)) / (2e-9 * step)
        np.testing.assert_allclose(path.derivative(at), differences, atol=2e-4)
    # and then it is where it would have been, later
    after = path.stop_ns + late + 2 * path.ramp_ns
    np.testing.assert_array_equal(path.pose(after), other.pose(after - late))
    share = [
        isinstance(random_path(rng(s), 0, SECOND, ObjectMotion(pauses=0.3), SPACE, 0.2), PausedPath) for s in range(60)
    ]
    assert 0.1 < np.mean(share) < 0.5
    camera = random_camera_path(rng(1), 0, SECOND, CameraMotion(pauses=1), SPACE, 0.1, TARGET)
    assert isinstance(camera, PausedPath)
