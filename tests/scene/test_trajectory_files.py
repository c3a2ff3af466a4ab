"""Trajectories of other programs, in and out: a flight by formula comes back; what is wrong in a file is named."""

import json

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from blinkgl import (
    AssetError,
    Camera,
    ConfigError,
    Keyframes,
    Primitive,
    Scene,
    Trajectory,
    read_trajectory,
    record,
    write_trajectory,
)
from blinkgl.config.run import load_run
from blinkgl.front.runs import configured
from blinkgl.io import trajectories
from blinkgl.scene.build import check_assets, sequence_scene
from blinkgl.scene.motion.paths import smoothed
from tests.refusals import refusal
from tests.scene.gltf_files import arm_file

EPOCH = 1_403_636_579_758_555_392
RNG = np.random.default_rng


def circle(t):
    """(N, 4, 4) at (N,) s: radius 2 about the z axis, looking inwards (OpenCV axes)."""
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, 0, 3], T[:, 1, 3] = 2 * np.cos(t), 2 * np.sin(t)
    zero = np.zeros_like(t)
    T[:, :3, 0] = np.stack([-np.sin(t), np.cos(t), zero], 1)
    T[:, :3, 1] = (0, 0, -1)
    T[:, :3, 2] = np.stack([-np.cos(t), -np.sin(t), zero], 1)
    return T


def euroc_csv(t_ns, T):
    x, y, z, w = Rotation.from_matrix(T[:, :3, :3]).as_quat().T
    rows = [
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x"
    ]
    rows += [
        f"{t},{a:.12f},{b:.12f},{c:.12f},{q[0]:.12f},{q[1]:.12f},{q[2]:.12f},{q[3]:.12f},0.5"
        for t, (a, b, c), q in zip(t_ns.tolist(), T[:, :3, 3], zip(w, x, y, z))
    ]
    return "\n".join(rows) + "\n"


@pytest.fixture
def flight(tmp_path):
    """A second and a half at 100 Hz, of an epoch's clock, in both forms."""
    t = np.arange(151) * 0.01
    t_ns = EPOCH + np.arange(151) * 10_000_000
    write_trajectory(tmp_path / "tum.txt", t_ns, circle(t))
    (tmp_path / "euroc.csv").write_text(euroc_csv(t_ns, circle(t)))
    return tmp_path


def test_both_forms_say_the_same_to_the_nanosecond(flight):
    for name in ("tum.txt", "euroc.csv"):
        t_ns, T = read_trajectory(flight / name)
        assert t_ns[0] == EPOCH and (np.diff(t_ns) == 10_000_000).all()
        assert np.allclose(T, circle(np.arange(151) * 0.01), atol=1e-9)
    write_trajectory(flight / "again.txt", t_ns, T)
    again, T_again = read_trajectory(flight / "again.txt")
    assert np.array_equal(again, t_ns) and np.allclose(T_again, T, atol=1e-11)
    write_trajectory(flight / "early.txt", np.array([-1_500_000_000, -1]), T[:2])
    assert read_trajectory(flight / "early.txt")[0].tolist() == [-1_500_000_000, -1]


T_S = np.arange(40) * 0.02


def table(titles: str, rows, separator: str) -> str:
    return titles + "\n" * bool(titles) + "\n".join(separator.join(f"{v:.9f}" for v in row) for row in rows) + "\n"


def read_of(folder, name: str, text: str, **options):
    """Times, poses and notes of a file with this text."""
    (folder / name).write_text(text)
    notes = []
    return (*read_trajectory(folder / name, notes=notes, **options), notes)


def poses_of(T: np.ndarray, order: str) -> np.ndarray:
    """(N, 7): the columns that ``order`` names."""
    by = dict(zip(("x", "y", "z"), T[:, :3, 3].T))
    by |= dict(zip(("qx", "qy", "qz", "qw"), Rotation.from_matrix(T[:, :3, :3]).as_quat().T))
    return np.stack([by[name] for name in order.split()], axis=1)


def named(T: np.ndarray) -> str:
    """Poses in seconds, with a heading."""
    return table("#t[s] x y z qx qy qz qw", np.column_stack([T_S, poses_of(T, "x y z qx qy qz qw")]), " ")


@pytest.mark.parametrize("separator", [" ", ", ", ",", "\t", ";"])
@pytest.mark.parametrize(("unit", "scale"), [("s", 1), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
@pytest.mark.parametrize(
    ("titles", "order"),
    [
        ("# timestamp{}, x, y, z, qx, qy, qz, qw", "x y z qx qy qz qw"),  # ESIM's
        ("# timestamp{} tx ty tz qw qx qy qz", "x y z qw qx qy qz"),
        ("time{} q_w q_x q_y q_z p_x p_y p_z", "qw qx qy qz x y z"),
        ("#t{} pos_x pos_y pos_z x y z w", "x y z qx qy qz qw"),
        ("#timestamp{}, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []",
         "x y z qw qx qy qz"),
        ("time{},position.x,position.y,position.z,orientation.x,orientation.y,orientation.z,orientation.w",
         "x y z qx qy qz qw"),
        ("#t{} x y z w x y z", "x y z qw qx qy qz"),
    ],
)  # fmt: skip
def test_a_heading_says_order_and_unit_whatever_separates(tmp_path, titles, order, unit, scale, separator):
    T = circle(T_S)
    rows = np.column_stack([T_S * scale, poses_of(T, order)])
    t_ns, read, notes = read_of(tmp_path, "t.txt", table(titles.format(f" [{unit}]"), rows, separator))
    assert np.allclose(t_ns, T_S * 1e9, atol=2) and np.allclose(read, T, atol=1e-7) and notes == []
    # Without a unit: asked for, and what is declared counts.
    times = np.round(T_S * 1e9).astype(np.int64) * int(scale) // 10**9 if unit != "s" else np.round(T_S, 2)
    text = "\n".join(separator.join([f"{t}", *(f"{v:.9f}" for v in row)]) for t, row in zip(times, rows[:, 1:]))
    text = f"{titles.format('')}\n{text}\n"
    if "p_RS_R_x" not in titles and "# timestamp{}, x" not in titles:
        with pytest.raises(AssetError, match=r"no unit of the times is stated .*; try time_unit: (s|us) if"):
            read_of(tmp_path, "t.txt", text)
    t_ns, read, notes = read_of(tmp_path, "t.txt", text, time_unit=unit)
    assert np.allclose(t_ns, T_S * 1e9, atol=2) and np.allclose(read, T, atol=1e-7) and notes == []


ESIM, TUM = "# timestamp, x, y, z, qx, qy, qz, qw", "# ground truth\n# timestamp tx ty tz qx qy qz qw"
EUROC = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x [m]"


@pytest.mark.parametrize(
    ("heading", "times", "order", "said"),
    [
        (TUM, "{:.4f}", "x y z qx qy qz qw", "TUM's poses"),
        (TUM, "{:.9f}", "x y z qx qy qz qw", "TUM's poses"),
        (TUM, "{:.0f}", "x y z qx qy qz qw", None),
        (ESIM, "ns", "x y z qx qy qz qw", "ESIM's poses"),
        (ESIM, "{:.6f}", "x y z qx qy qz qw", "the Event Camera Dataset's poses"),
        (ESIM, "{:.3f}", "x y z qx qy qz qw", None),
        (EUROC, "ns", "x y z qw qx qy qz", "EuRoC's poses"),
        ("", "{:.6f}", "x y z qx qy qz qw", "the Event Camera Dataset's poses"),
        ("", "{:.5f}", "x y z qx qy qz qw", None),
        ("", "ns", "x y z qx qy qz qw", None),
        ("", "ns", "x y z qw qx qy qz", None),
    ],
)
def test_layouts_that_are_known_by_name(tmp_path, heading, times, order, said):
    """All others are asked for, with what to paste, which reads the very file."""
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, 0, 3], T[:, :3, :3] = T_S, Rotation.from_rotvec(np.outer(T_S, (0, 0, 1))).as_matrix()
    stamps = [f"{round(t * 1e9)}" if times == "ns" else times.format(t * (1e6 if ".0f" in times else 1)) for t in T_S]
    rows = [" ".join([stamp, *map("{:.9f}".format, row)]) for stamp, row in zip(stamps, poses_of(T, order))]
    text = "\n".join([heading, *rows]) + "\n"
    if said is None:
        refusal(AssetError, read_of, tmp_path, "t.txt", text, match="no heading names|no unit of the times")
        unit = "ns" if times == "ns" else "us" if ".0f" in times else "s"
        t_ns, read, _ = read_of(tmp_path, "t.txt", text, columns=f"t {order}", time_unit=unit)
    else:
        t_ns, read, notes = read_of(tmp_path, "t.txt", text)
        assert len(notes) == 1 and said in notes[0]
    assert np.allclose(t_ns, T_S * 1e9, atol=2) and np.allclose(read, T, atol=1e-7)


def test_other_programs_files(tmp_path):
    """KITTI, TartanAir, COLMAP and NeRF, written as their documentation says."""
    T = circle(T_S)
    (tmp_path / "poses.txt").write_text("\n".join(" ".join(f"{v:.9f}" for v in one[:3].ravel()) for one in T))
    (tmp_path / "times.txt").write_text("\n".join(f"{t:.6e}" for t in T_S))
    for given in ({}, {"rate": 50}):
        t_ns, read = read_trajectory(tmp_path / "poses.txt", **given)
        assert np.allclose(t_ns, T_S * 1e9, atol=2) and np.allclose(read, T, atol=1e-7)
    inverse = np.linalg.inv(T)
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
    ]
    for k in reversed(range(len(T))):
        numbers = " ".join(f"{v:.9f}" for v in poses_of(inverse[k : k + 1], "qw qx qy qz x y z")[0])
        lines += [f"{k + 1} {numbers} 1 frame_{k}.png", "1.0 2.0 -1"]
    assert np.allclose(read_of(tmp_path, "images.txt", "\n".join(lines), rate=50)[1], T, atol=1e-6)
    opengl = T @ np.diag([1, -1, -1, 1.0])
    frames = [{"file_path": f"./r_{k}", "time": t, "transform_matrix": one.tolist()} for k, (t, one) in
              enumerate(zip(T_S.tolist(), opengl))]  # fmt: skip
    tree = {"camera_angle_x": 0.7, "frames": frames}
    t_ns, read, notes = read_of(tmp_path, "transforms.json", json.dumps(tree))
    assert np.allclose(t_ns, T_S * 1e9, atol=2) and np.allclose(read, T, atol=1e-9) and "opengl" in notes[0]
    # x forwards, y right, z down: OpenCV's z, x, y.
    ned = T.copy()
    ned[:, :3, :3] = T[:, :3, :3] @ np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
    rows = poses_of(ned, "x y z qx qy qz qw")
    assert np.allclose(read_of(tmp_path, "pose_left.txt", table("", rows, " "), rate=50)[1], T, atol=1e-6)
    assert np.allclose(read_of(tmp_path, "w2c.txt", named(inverse), maps_from="world")[1], T, atol=1e-6)


def test_a_camera_at_three_hundred_metres_a_second_is_said(tmp_path):
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, 0, 3] = T_S * 300
    *_, notes = read_of(tmp_path, "t.txt", named(T))
    assert notes == ["t.txt: the body moves at 300 units/s: another unit of time or length? (time_unit)"]


def scene(pose) -> Scene:
    made = Scene(Camera(48, 36, pose=pose), duration=0.2, label_rate=20)
    made += Primitive("cuboid", extents=(0.5, 0.6, 0.7))
    return made


@pytest.mark.parametrize("name", ["tum.txt", "euroc.csv"])
def test_the_camera_flies_it(flight, name):
    drawn = record(scene(Trajectory(flight / name)), labels=["forward"], imu={"rate": 100, "gravity": (0, 0, 0)})
    path = scene(Trajectory(flight / name)).build(drawn.config).camera_path
    t = np.linspace(0, 0.25, 41)
    assert np.allclose(path.poses((t * 1e9).astype(np.int64)), circle(t), atol=1e-6)
    assert np.allclose(drawn.imu.acceleration[2:-2], (0, 0, 2), atol=2e-3), "towards the middle: 1 rad/s at 2 m"
    assert drawn.valid.any() and np.abs(drawn.flow).max() > 0.1
    later = scene(Trajectory(flight / name, start=EPOCH * 1e-9 + 0.5))
    late = later.build(configured(later).sequence(0)).camera_path
    assert np.allclose(late.pose(100_000_000), circle(np.array([0.6]))[0], atol=1e-4), "a float of an epoch: 0.2 µs"


def test_an_object_flies_it_and_from_yaml(flight):
    (flight / "c.yaml").write_text(
        "time: {duration: 0.2, label_rate: 20}\n"
        "scene: {kind: explicit, meshes: {ball: {primitive: sphere}}, camera: {position: [-5, 0, 0]},"
        " objects: [{mesh: ball, trajectory: {file: tum.txt}}]}\n"
    )
    config = load_run(flight / "c.yaml").sequence(0)
    check_assets(config.scene, flight)
    made = sequence_scene(config, 0, flight)
    assert np.allclose(made.objects[0].path.pose(123_000_000), circle(np.array([0.123]))[0], atol=1e-6)
    (flight / "tum.txt").unlink()
    refusal(ConfigError, check_assets, config.scene, flight, match=r"scene\.objects\.0\.trajectory\.file: no such file")


def test_smoothing_takes_noise_away_and_no_line_off_its_way():
    t_ns, rng = np.arange(200) * 10_000_000, RNG(0)
    straight = np.outer(np.arange(200), (0.01, -0.02, 0.03))
    turning = Rotation.from_rotvec(np.outer(np.arange(200) * 0.02, (0, 0, 1)))
    p, q = smoothed(t_ns, straight, turning, 100_000_000)
    assert np.allclose(p, straight, atol=1e-12) and (q.inv() * turning).magnitude().max() < 1e-4
    noisy, shaken = (
        straight + 0.01 * rng.normal(size=(200, 3)),
        turning * Rotation.from_rotvec(0.01 * rng.normal(size=(200, 3))),
    )
    p, q = smoothed(t_ns, noisy, shaken, 100_000_000)
    inner = slice(15, -15)
    assert np.std(p[inner] - straight[inner]) < 0.4 * 0.01
    assert np.mean((q.inv() * turning).magnitude()[inner]) < 0.4 * np.mean((shaken.inv() * turning).magnitude())
    assert smoothed(t_ns, noisy, shaken, 0)[0] is noisy
    flipped = Rotation.from_quat(-shaken.as_quat() * np.where(np.arange(200) % 2, 1, -1)[:, None])
    assert np.allclose(smoothed(t_ns, noisy, flipped, 100_000_000)[1].as_matrix(), q.as_matrix(), atol=1e-12)


GOOD = "0.000000 1 2 3 0 0 0 1\n0.1 1 2 3 0 0 0 1\n0.2 1 2 3 0 0 0 1\n0.3 1 2 3 0 0 0 1\n"


@pytest.mark.parametrize(
    "text, said",
    [
        ("", "no trajectory (got '0 poses')"),
        ("# only a word\n0.000000 1 2 3 0 0 0 1\n", "no trajectory (got '1 poses')"),
        (GOOD + "0.4 1 2 3 0 0 1\n", "line 5 is no pose"),
        (GOOD + "0.4 1 2 nan 0 0 0 1\n", "line 5 is no pose"),
        (GOOD + "0.4 1 2 x 0 0 0 1\n", "line 5 is no pose"),
        (GOOD + "0.3 1 2 3 0 0 0 1\n", "line 5 is at the time of the one before"),
        (GOOD + "0.25 1 2 3 0 0 0 1\n", "line 5 is before the one before"),
        (GOOD + "9.0 1 2 3 0 0 0 1\n", "a gap before line 5"),
        (GOOD + "0.4 1 2 3 0 0 0 0.5\n", "line 5 has no rotation"),
        ("#t[s] x y z qx qy qz qw\n0 1 2 3 0 0 0 1\ninf 1 2 3 0 0 0 1\n", "line 3 is no pose"),
        ("#t [s] x y z qx qy qz qw\n0 1 2 3 0 0 0 1\n10000000 1 2 3 0 0 0 1\n", "another unit of time"),
        (
            "#t_s x y z qx qy qz qw\n1403636579763555584 1 2 3 0 0 0 1\n1403636579763655584 1 2 3 0 0 0 1\n",
            "too large: another unit",
        ),
        ("1,2,3\n4,5,6\n", "line 1 is no pose"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 0\n", "poses without times"),
        ("1 0 0 0 0 2 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 0\n", "line 1 is no pose"),
        ('{"frames": [{"transform_matrix": 3}]}', "no transforms.json"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(tmp_path, text, said):
    message = refusal(AssetError, read_of, tmp_path, "t.txt", text)
    assert said in message and "t.txt" in message


def test_what_a_sequence_cannot_have(flight, tmp_path):
    with pytest.raises(ConfigError, match="does not cover the sequence"):
        record(scene(Trajectory(flight / "tum.txt", start=EPOCH * 1e-9 + 1.4)))
    refusal(ConfigError, Trajectory, flight / "missing.txt", match="no such file")
    refusal(ConfigError, Trajectory, "x", form="vins", match=r"Trajectory\.form")
    for wrong in ({"form": "vins"}, {"axes": "enu"}, {"maps_from": "here"}, {"time_unit": "h"}, {"columns": "t x y z"}):
        refusal(ConfigError, read_trajectory, flight / "tum.txt", match=next(iter(wrong)), **wrong)
    with pytest.raises(ConfigError, match="times do not increase"):
        write_trajectory(tmp_path / "x.txt", np.array([2, 1]), circle(np.zeros(2)))
    (flight / "c.yaml").write_text(
        "scene: {kind: explicit, meshes: {ball: {primitive: sphere}}, objects: [{mesh: ball}],"
        " camera: {position: [-5, 0, 0], trajectory: {file: tum.txt}}}\n"
    )
    refusal(ConfigError, load_run, flight / "c.yaml", match="give a trajectory, a fixed pose or keyframes")


SENSOR = """# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
         0.0, 0.0, 0.0, 1.0]

# Camera specific definitions.
rate_hz: 20
resolution: [188, 120]
camera_model: pinhole
intrinsics: [114.66, 114.32, 91.8, 62.1] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""


def test_a_camera_beside_the_body_that_the_file_is_of(flight):
    """EuRoC's truth is of its inertial unit; `T_BS` of the camera's sensor.yaml leads from there to the camera."""
    (flight / "sensor.yaml").write_text(SENSOR)
    numbers = yaml.safe_load(SENSOR)["T_BS"]["data"]
    T_BS = np.array(numbers).reshape(4, 4)
    camera = Camera(
        calibration=flight / "sensor.yaml", pose=Trajectory(flight / "euroc.csv", T_body_sensor=flight / "sensor.yaml")
    )
    assert camera.tree["lens"] == "radtan" and camera.tree["fx"] == 114.66 and camera.tree["width"] == 188
    beside = Scene(camera, (Primitive("cuboid"),), duration=0.2, label_rate=20)
    said = scene(Trajectory(flight / "euroc.csv", T_body_sensor=T_BS))
    for made in (beside, said):
        config = made.template().sequence(0)
        path = made.build(config).camera_path
        t = np.linspace(0.05, 0.2, 7)
        expected = circle(t) @ T_BS
        assert np.abs(path.poses(np.round(t * 1e9).astype(np.int64)) - expected).max() < 2e-6
    # In a run's file, relative to it; an object may ride on the body, too.
    tree = said.template().tree
    tree["scene"]["camera"] = {"trajectory": {"file": "euroc.csv", "T_body_sensor": "sensor.yaml"}}
    tree["scene"]["objects"][0]["trajectory"] = {"file": "tum.txt", "T_body_sensor": T_BS.tolist()}
    (flight / "run.yaml").write_text(yaml.safe_dump(tree))
    built = sequence_scene(load_run(flight / "run.yaml").sequence(0), 0, flight)
    assert np.abs(built.camera_path.pose(100_000_000) - built.objects[0].path.pose(100_000_000)).max() < 1e-9


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("T_BS", "T_SB"), "no place on a body"),
        (("0.0148655429818", "1.0148655429818"), "T_BS: not a rigid transform"),
        (("0.0148655429818", ".nan"), "T_BS: not a rigid transform"),
        (("0.0, 0.0, 0.0, 1.0]", "0.0, 0.0]"), "T_BS: not a rigid transform"),
        (None, "T_body_sensor: no such file"),
    ],
)
def test_a_body_of_which_the_file_says_nothing(flight, change, said):
    if change:
        (flight / "sensor.yaml").write_text(SENSOR.replace(*change))
    made = scene(Trajectory(flight / "euroc.csv", T_body_sensor=flight / "sensor.yaml"))
    config = made.template().sequence(0)
    with pytest.raises(ConfigError, match=said):
        check_assets(config.scene)
        made.build(config)


def test_a_place_on_the_body_that_is_none():
    with pytest.raises(ConfigError, match="Trajectory.T_body_sensor: the matrix contains a reflection"):
        Trajectory("a.txt", T_body_sensor=np.diag([1.0, 1, -1, 1]))
    with pytest.raises(ConfigError, match="Trajectory.T_body_sensor: array of another type or shape"):
        Trajectory("a.txt", T_body_sensor=np.eye(3))


def test_what_goes_faster_than_anything_flies_is_refused(tmp_path):
    t_ns, T = EPOCH + np.arange(151) * 10_000_000, circle(np.arange(151) * 0.01)
    after = lambda k, factor: np.where(np.arange(151)[:, None, None] < k, np.eye(4), factor)
    up = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1.5], [0, 0, 0, 1]])
    write_trajectory(tmp_path / "mm", t_ns, T * np.array([[1, 1, 1, 1000]] * 3 + [[1] * 4]))
    write_trajectory(tmp_path / "jump", t_ns, after(20, up) @ T)
    write_trajectory(tmp_path / "turned", t_ns, T @ after(20, np.diag([-1.0, 1, -1, 1])))
    write_trajectory(tmp_path / "later", t_ns, after(100, up) @ T)  # which the sequence does not see
    for name, key, value in (
        ("mm", "speed_limit", "2000 units/s"),
        ("jump", "speed_limit", "150 units/s at 0.19 s"),
        ("turned", "turn_limit", "degrees/s at 0.19 s"),
    ):
        made = scene(Trajectory(tmp_path / name))
        with pytest.raises(ConfigError, match=f"trajectory.{key}: the trajectory is too fast.*{value}"):
            made.build(made.template().sequence(0))
    for name, more in (("later", {}), ("mm", {"speed_limit": 1e4})):
        tree = scene(Trajectory(tmp_path / name)).template().tree
        tree["scene"]["camera"]["trajectory"].update(more)
        (tmp_path / "run.yaml").write_text(yaml.safe_dump(tree))
        assert sequence_scene(load_run(tmp_path / "run.yaml").sequence(0), 0, tmp_path).camera_path.t1_ns


UNITS = {"[m]": 1, "[mm]": 1e-3, "(cm)": 1e-2, " [km]": 1e3, "": 1, " (meters)": 1, "[Millimetre]": 1e-3}


@pytest.mark.parametrize("unit, metres", UNITS.items())
def test_a_heading_states_the_unit_of_positions(tmp_path, unit, metres):
    T = circle(np.arange(5) * 0.1)
    x, y, z, w = Rotation.from_matrix(T[:, :3, :3]).as_quat().T
    rows = [f"t [s],x{unit},y{unit},z{unit},qw,qx,qy,qz,vx,fov"]
    rows += [f"{k / 10},{T[k, 0, 3]},{T[k, 1, 3]},0,{w[k]},{x[k]},{y[k]},{z[k]},1,60" for k in range(5)]
    _, poses, notes = read_of(tmp_path, "p.csv", "\n".join(rows))
    assert np.abs(poses[:, :3, 3] - T[:, :3, 3] * metres).max() < 1e-9
    assert "p.csv: left out: columns that are no pose: vx, fov" in notes


@pytest.mark.parametrize("axes", ["x[ft],y[ft],z[ft]", "x[m],y[mm],z[m]", "x[m],y,z"])
def test_other_units_of_positions_are_refused(tmp_path, axes):
    text = f"t[s],{axes},qw,qx,qy,qz\n" + "".join(f"{k},0,0,0,1,0,0,0\n" for k in range(3))
    with pytest.raises(AssetError, match="no such unit of positions.*m, cm, mm or km of all three"):
        read_of(tmp_path, "p.csv", text)


def test_frames_without_times_follow_their_names(tmp_path):
    T = circle(np.arange(12) * 0.1)
    frames = [
        {"file_path": f"images/{k}.png", "transform_matrix": (T[k] @ np.diag([1, -1, -1, 1])).tolist()}
        for k in range(12)
    ]
    order = RNG(0).permutation(12)
    tree = {"frames": [frames[k] for k in order], "applied_scale": 0.5, "scale": 1}
    _, poses, notes = read_of(tmp_path, "transforms.json", json.dumps(tree), rate=10)
    assert np.abs(poses - T).max() < 1e-9
    assert "transforms.json: applied_scale, scale: not applied, poses are as in the file" in notes
    assert "transforms.json: frames in the order of their names" in notes


def test_poses_of_several_cameras_are_said(tmp_path):
    rows = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    for k in range(4):
        rows += [f"{k} 1 0 0 0 {k} 0 0 {k % 2} cam{k % 2}_{k}.png", "0 0 -1"]
    *_, notes = read_of(tmp_path, "images.txt", "\n".join(rows) + "\n", rate=10)
    assert "images.txt: poses of 2 cameras, read as one path" in notes


@pytest.mark.parametrize("start", ["", "./", "images/../"])
def test_frames_of_nerf_by_any_spelling_of_their_names(tmp_path, start):
    T = circle(np.arange(11) * 0.1) @ np.diag([1, -1, -1, 1])
    frames = [{"file_path": f"{start}train/r_{k}", "transform_matrix": T[k].tolist()} for k in range(11)]
    _, poses, _ = read_of(tmp_path, "transforms.json", json.dumps({"frames": frames[::-1]}), rate=10)
    assert np.abs(poses - circle(np.arange(11) * 0.1)).max() < 1e-9
    alike = json.dumps({"frames": [{**frame, "file_path": "a"} for frame in frames]})
    assert len(read_of(tmp_path, "transforms.json", alike, rate=10)[1]) == 11


TUM = "# timestamp tx ty tz qx qy qz qw\n" + "".join(f"{k * 0.1:.6f} {k * 0.01} 0 0 0 0 0 1\n" for k in range(6))
NAMED = "t_us,x,y,z,qx,qy,qz,qw\n" + "".join(f"{k * 100_000},{k * 0.01},0,0,0,0,0,1\n" for k in range(6))
KITTI = "".join(f"1 0 0 {k * 0.01} 0 1 0 0 0 0 1 0\n" for k in range(6))


@pytest.mark.parametrize(
    ("text", "declared", "line"),
    [
        (TUM, {"rate": 30.0}, "the poses have times; rate is not used"),
        (TUM, {"times": "times.txt"}, "the poses have times; times is not used"),
        (NAMED, {"time_unit": "ns"}, "the file says us; time_unit: ns is used"),
        (NAMED, {"form": "euroc"}, "the heading names the columns otherwise than form: euroc, and is used"),
        (NAMED, {"columns": "t x y z qw qx qy qz"},
         "the heading names the columns otherwise; columns: t x y z qw qx qy qz is used"),
        (KITTI, {"form": "kitti", "rate": 10.0, "time_unit": "s"}, "time_unit is not used, because of rate"),
        (KITTI, {"form": "kitti", "rate": 10.0, "times": "times.txt"}, "times is not used, because of rate"),
        (KITTI, {"rate": 10.0, "columns": "t x y z qx qy qz qw"}, "columns is not used, because of form kitti"),
    ],
)  # fmt: skip
def test_whatever_is_declared_of_poses_is_used_or_said(tmp_path, text, declared, line):
    path, notes = tmp_path / "poses.txt", []
    path.write_text(text, encoding="utf-8")
    trajectories.read_trajectory(path, trajectories.PoseFile(**declared), notes)
    assert f"poses.txt: {line}" in notes
    plain = []
    alone = {"rate": 10.0} if text == KITTI else {}
    trajectories.read_trajectory(path, trajectories.PoseFile(**alone), plain)
    assert not any("not used" in one or "otherwise" in one or "says" in one for one in plain)


def test_a_file_of_times_that_is_not_there_is_named(tmp_path):
    (tmp_path / "poses.txt").write_text(KITTI, encoding="utf-8")
    with pytest.raises(AssetError, match="nosuch.txt: no such file; expected a file of times, or rate: in Hz"):
        trajectories.read_trajectory(tmp_path / "poses.txt", trajectories.PoseFile(times=tmp_path / "nosuch.txt"))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint64, np.int64])
def test_times_that_fall_are_refused_of_any_type(tmp_path, dtype):
    """Differences of unsigned numbers wrap."""
    times, poses = np.array([3, 2, 1], dtype), np.tile(np.eye(4), (3, 1, 1))
    with pytest.raises(ConfigError, match="times do not increase"):
        write_trajectory(tmp_path / "t.txt", times, poses)
    with pytest.raises(ConfigError, match="times do not increase"):
        Keyframes.from_arrays(times, poses)
    write_trajectory(tmp_path / "t.txt", times[::-1], poses)


@pytest.mark.parametrize("what", ["scaled", "mirrored", "nan", "nan place", "last row"])
def test_poses_that_are_not_rigid_are_not_written(tmp_path, what):
    poses = np.tile(np.eye(4), (3, 1, 1))
    place, value = {
        "scaled": ((1, slice(3), slice(3)), 2 * np.eye(3)), "mirrored": ((1, 0, 0), -1), "nan": ((1, 0, 0), np.nan),
        "nan place": ((1, 0, 3), np.nan), "last row": ((1, 3, 0), 1),
    }[what]  # fmt: skip
    poses[place] = value
    with pytest.raises(ConfigError, match=r"poses\[1\]|poses: "):
        write_trajectory(tmp_path / "t.txt", np.arange(3), poses)
    assert not (tmp_path / "t.txt").exists()


def test_what_is_guessed_of_a_trajectory_is_said_wherever_one_moves(tmp_path):
    """A camera before a file's scene, and lamps in every kind of scene."""
    (tmp_path / "way.txt").write_text("".join(f"{k * 0.5:.6f} 0 0 0 0 0 0 1\n" for k in range(6)), encoding="utf-8")
    arm_file().write(tmp_path / "arm.glb")
    way = {"trajectory": {"file": "way.txt"}}
    lamp = {"lights": [{"kind": "point", "motion": way}]}
    box = {"meshes": {"a": {"primitive": "cuboid"}}, "objects": [{"mesh": "a"}], "camera": {}}
    for scene in (
        {"kind": "file", "path": "arm.glb", "pose": way},
        {"kind": "file", "path": "arm.glb", "pose": {}, "light": lamp},
        {"kind": "explicit", **box, "light": lamp},
        {"kind": "random", "objects": {"count": 1}, "light": lamp},
    ):
        (tmp_path / "r.yaml").write_text(yaml.safe_dump({"scene": scene, "time": {"duration": 0.2}}))
        made = sequence_scene(load_run(tmp_path / "r.yaml").sequence(0), 0, tmp_path)
        assert [line for line in made.log if line.startswith("way.txt: read as TUM's")], scene["kind"]


@pytest.mark.parametrize("kind", ["explicit", "file"])
def test_files_of_clips_are_looked_for_before_work_starts(tmp_path, kind):
    arm_file().write(tmp_path / "arm.glb")
    clip = {"clip": 0, "file": "gone.glb"}
    world = {"meshes": {"a": {"file": "arm.glb"}}, "objects": [{"mesh": "a", "animation": clip}], "camera": {}}
    scene = {"kind": kind, **(world if kind == "explicit" else {"path": "arm.glb", "animation": clip})}
    (tmp_path / "r.yaml").write_text(yaml.safe_dump({"scene": scene}))
    with pytest.raises(ConfigError, match=r"animation.file: no such file \(got 'gone.glb'"):
        check_assets(load_run(tmp_path / "r.yaml").sequence(0).scene, tmp_path)


def test_a_heading_of_twelve_columns_is_no_kitti(tmp_path):
    heading = "# timestamp[s] tx ty tz qx qy qz qw vx vy vz m\n"
    rows = "".join(f"{k * 0.1:.6f} {k * 0.01} 0 0 0 0 0 1 0 0 0 1\n" for k in range(6))
    (tmp_path / "p.txt").write_text(heading + rows, encoding="utf-8")
    t_ns, T = trajectories.read_trajectory(tmp_path / "p.txt")
    assert t_ns.tolist() == [k * 10**8 for k in range(6)] and T[5, 0, 3] == pytest.approx(0.05)
