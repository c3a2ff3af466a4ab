"""Paths against scipy, finite differences and their own definition."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline, Slerp

from blinkgl.errors import ConfigError
from blinkgl.scene.motion.paths import CutPath, KeyframePath, OffsetPath, StaticPath, rigid
from blinkgl.scene.motion.pose_path import PosePath
from blinkgl.types.poses import pose_of
from tests.refusals import refusal
from tests.scene.motion.rates import body_rate

SECOND = 1_000_000_000
MILLION_SECONDS = 1_000_000 * SECOND


def random_keys(seed, count=7, start_ns=0, turn=None):
    rng = np.random.default_rng(seed)
    times = start_ns + np.r_[0, np.cumsum(rng.integers(SECOND // 10, SECOND // 3, count - 1))]
    if turn is None:
        rotations = Rotation.random(count, rng=rng)
    else:
        steps = Rotation.from_rotvec(rng.normal(scale=turn, size=(count, 3)))
        rotations = Rotation.concatenate([np.prod(list(steps[: k + 1])) for k in range(count)])
    return times, rng.normal(size=(count, 3)), rotations


def every_kind():
    spline = KeyframePath(*random_keys(0))
    offset = pose_of((0.5, 0.1, -2), Rotation.from_rotvec([0.3, -1, 0.2]).as_matrix())
    middle = (spline.t0_ns + spline.t1_ns) // 2
    return {
        "static": StaticPath(offset, 0, SECOND),
        "spline": spline,
        "linear": KeyframePath(*random_keys(1), "linear"),
        "one key": KeyframePath([5], [[1.0, 2, 3]], Rotation.identity(1)),
        "cut": CutPath(spline, middle),
        "cut before": CutPath(spline, spline.t0_ns - 5),
        "offset": OffsetPath(spline, offset),
        "offset of cut": OffsetPath(CutPath(spline, middle), offset),
    }


@pytest.mark.parametrize("kind", every_kind())
def test_protocol_batches_ends_and_rigidity(kind):
    path = every_kind()[kind]
    assert isinstance(path, PosePath)
    times = np.linspace(path.t0_ns - SECOND, path.t1_ns + SECOND, 101).astype(np.int64)
    T = path.poses(times)
    assert T.shape == (101, 4, 4) and T.dtype == np.float64
    assert np.array_equal(T, np.stack([path.pose(t) for t in times]))
    assert np.abs(T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1) - np.eye(3)).max() < 1e-14
    assert (np.linalg.det(T[:, :3, :3]) > 0).all() and (T[:, 3] == [0, 0, 0, 1]).all()
    for outside, end in ((path.t0_ns - 1, path.t0_ns), (path.t1_ns + 1, path.t1_ns)):
        assert np.array_equal(path.pose(outside), path.pose(end))
        assert not path.derivative(outside).any()
    for ta, tb in ((path.t0_ns - SECOND, path.t0_ns - 1), (path.t1_ns + 1, path.t1_ns + SECOND)):
        assert path.speed_bound(ta, tb) == (0.0, 0.0)
    assert path.is_static == (np.ptp(T, axis=0).max() == 0)
    assert not any(path.derivative(t)[3].any() for t in times)
    if path.is_static:
        assert not path.derivative(path.t0_ns).any() and path.speed_bound(0, SECOND) == (0.0, 0.0)


@given(st.integers(0, 10**6), st.integers(2, 9))
@settings(max_examples=30, deadline=None)
def test_spline_equals_scipy(seed, count):
    times, positions, rotations = random_keys(seed, count)
    path = KeyframePath(times, positions, rotations.as_quat())
    seconds = (times - times[0]) * 1e-9
    at = np.r_[times, np.random.default_rng(seed).integers(times[0], times[-1], 40)]
    s = (at - times[0]) * 1e-9
    T = path.poses(at)
    assert np.abs(T[:, :3, 3] - CubicSpline(seconds, positions)(s)).max() < 1e-12
    spline = RotationSpline(seconds, rotations)
    assert np.abs(T[:, :3, :3] - spline(s).as_matrix()).max() < 1e-12
    D = np.stack([path.derivative(t) for t in at])
    assert np.abs(D[:, :3, 3] - CubicSpline(seconds, positions)(s, 1)).max() < 1e-10
    rate = np.array([body_rate(a, b) for a, b in zip(T, D)])
    assert np.abs(rate - spline(s, 1)).max() < 1e-10 * max(1, np.abs(rate).max())


def test_linear_equals_slerp():
    times, positions, rotations = random_keys(3)
    path = KeyframePath(times, positions, rotations, "linear")
    at = np.linspace(times[0], times[-1], 57).astype(np.int64)
    T = path.poses(at)
    expected = np.stack([np.interp(at, times, positions[:, k]) for k in range(3)], axis=1)
    assert np.abs(T[:, :3, 3] - expected).max() < 1e-12
    assert np.abs(T[:, :3, :3] - Slerp(times - times[0], rotations)(at - times[0]).as_matrix()).max() < 1e-12


@pytest.mark.parametrize("kind", ["spline", "linear", "offset", "cut"])
def test_derivative_is_the_limit_of_differences_at_second_order(kind):
    path = every_kind()[kind]
    # Away from the key frames, where a linear path has no derivative and a spline a jump in its third.
    knots = getattr(path, "key_times_ns", every_kind()["spline"].key_times_ns)
    middles = (knots[:-1] + knots[1:]) // 2 + 1234
    steps = np.array([16, 8, 4, 2]) * 1_000_000
    if kind == "cut":  # one of the middles may be the cut; the others still have to converge
        middles = middles[middles < path.t_cut_ns - 2 * steps[0]]
    exact = np.stack([path.derivative(t) for t in middles])
    numeric = [(path.poses(middles + h) - path.poses(middles - h)) / (2e-9 * h) for h in steps]
    errors = [np.abs(one - exact).max() for one in numeric]
    order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 1.7 < order < 2.3, errors


@pytest.mark.parametrize("interpolation, order", [("spline", 1.0), ("linear", -1.0)])
def test_second_derivative_is_continuous_at_the_keys_of_a_spline_only(interpolation, order):
    path = KeyframePath(*random_keys(5, turn=0.5), interpolation)
    steps = np.array([8, 4, 2, 1]) * 500_000
    rates = lambda dt: np.array([path.derivative(k + dt) for k in path.key_times_ns[1:-1]])
    jumps = [np.abs(rates(h) - 2 * rates(0) + rates(-h)).max() / (h * 1e-9) for h in steps]
    fitted = np.polyfit(np.log(steps), np.log(jumps), 1)[0]
    assert abs(fitted - order) < 0.3, jumps  # continuous: O(h); a jump in velocity: O(1/h)


@given(st.integers(0, 10**6), st.floats(0, 1), st.floats(0, 1), st.sampled_from(["spline", "linear", "offset", "cut"]))
@settings(max_examples=80, deadline=None)
def test_speed_bound_is_never_exceeded(seed, a, b, kind):
    path = KeyframePath(*random_keys(seed, 5), "linear" if kind == "linear" else "spline")
    span = path.t1_ns - path.t0_ns
    if kind == "offset":
        T = path.pose(path.t0_ns)
        T[:3, 3] = [1, -2, 0.5]
        path = OffsetPath(path, T)
    if kind == "cut":
        path = CutPath(path, path.t0_ns + span // 3)
    ta, tb = (int(-0.1 * span + 1.2 * span * x) + path.t0_ns for x in sorted((a, b)))
    v_bound, w_bound = path.speed_bound(ta, tb)
    for t in np.linspace(ta, tb, 60).astype(np.int64):
        D = path.derivative(t)
        assert np.linalg.norm(D[:3, 3]) <= v_bound * (1 + 1e-9) + 1e-12
        assert np.linalg.norm(body_rate(path.pose(t), D)) <= w_bound * (1 + 1e-9) + 1e-12


@given(st.integers(0, 10**6), st.floats(0, 1), st.floats(0, 1), st.floats(0.05, 2))
@settings(max_examples=60, deadline=None)
def test_approach_bound_is_never_exceeded(seed, a, b, turn):
    rng = np.random.default_rng(seed)
    path = KeyframePath(*random_keys(seed, 5, turn=turn))
    ta, tb = (int(x * (path.t1_ns - path.t0_ns)) for x in sorted((a, b)))
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    points = rng.normal(size=(40, 3))
    points *= 0.7 / np.linalg.norm(points, axis=1, keepdims=True)
    bound = path.approach_bound(normal, 0.7, ta, tb)
    v, w = path.speed_bound(ta, tb)
    assert bound <= (v + 0.7 * w) * (1 + 1e-9)
    for t in np.linspace(ta, tb, 40).astype(np.int64):
        D = path.derivative(t)
        assert np.abs((points @ D[:3, :3].T + D[:3, 3]) @ normal).max() <= bound * (1 + 1e-9) + 1e-12


def test_approach_bound_of_what_slides_and_turns_on_a_plane_is_zero():
    turned = Rotation.from_rotvec([0.4, -0.2, 0.9])
    yaw = Rotation.from_rotvec([[0, 0, 0], [0, 0, 1], [0, 0, 3], [0, 0, 2]]) * turned
    path = KeyframePath(np.arange(4) * SECOND, [[0, 0, 1], [1, 0, 1], [2, 3, 1], [0, 1, 1]], yaw)
    assert path.approach_bound(np.array([0.0, 0, 1]), 2.0, 0, 3 * SECOND) < 1e-8
    assert path.approach_bound(np.array([1.0, 0, 0]), 2.0, 0, 3 * SECOND) > 1


def test_a_path_that_starts_at_a_million_seconds_is_the_same_path():
    here, there = KeyframePath(*random_keys(2)), KeyframePath(*random_keys(2, start_ns=MILLION_SECONDS))
    at = np.random.default_rng(0).integers(here.t0_ns, here.t1_ns, 200)
    assert np.array_equal(here.poses(at), there.poses(at + MILLION_SECONDS))
    for t in at[:20]:
        assert np.array_equal(here.derivative(t), there.derivative(t + MILLION_SECONDS))
        assert here.speed_bound(t, t + 999) == there.speed_bound(t + MILLION_SECONDS, t + MILLION_SECONDS + 999)
    # One nanosecond is still seen there: float seconds would have steps of 0.1 us.
    t = int(at[0]) + MILLION_SECONDS
    moved = there.pose(t + 1)[:3, 3] - there.pose(t)[:3, 3]
    assert np.allclose(moved, 1e-9 * there.derivative(t)[:3, 3], rtol=0, atol=1e-15)


def test_a_cut_path_stays_and_says_so():
    path = KeyframePath(*random_keys(4))
    cut = CutPath(path, path.t0_ns + SECOND // 2)
    assert np.array_equal(cut.pose(cut.t_cut_ns - 1), path.pose(cut.t_cut_ns - 1))
    assert np.array_equal(cut.pose(path.t1_ns), path.pose(cut.t_cut_ns))
    assert cut.t1_ns == cut.t_cut_ns and not cut.is_static
    assert not cut.derivative(cut.t_cut_ns).any() and cut.derivative(cut.t_cut_ns - 1).any()
    assert cut.speed_bound(cut.t_cut_ns, path.t1_ns) == (0.0, 0.0)


def test_an_offset_path_derivative_has_the_lever_arm():
    # Pure spin of 2 rad/s about z, arm 3 along x: the offset origin moves at 6 units/s.
    spin = KeyframePath([0, SECOND], np.zeros((2, 3)), Rotation.from_rotvec([[0, 0, 0], [0, 0, 2]]), "linear")
    T = pose_of((3, 0, 0))
    assert np.allclose(OffsetPath(spin, T).derivative(0)[:3, 3], [0, 6, 0], atol=1e-12)
    assert np.isclose(OffsetPath(spin, T).speed_bound(0, SECOND)[0], 6)


@pytest.mark.parametrize(
    "times, positions, turns",
    [
        ([], np.zeros((0, 3)), np.zeros((0, 4))),
        ([0, 5, 5], np.zeros((3, 3)), Rotation.identity(3)),
        ([0, 1], np.zeros((2, 2)), Rotation.identity(2)),
        ([0, 1], [[0, 0, np.nan]] * 2, Rotation.identity(2)),
        ([0, 1], np.zeros((2, 3)), np.zeros((2, 4))),
        ([0, 1], np.zeros((2, 3)), Rotation.identity(3)),
    ],
)
def test_bad_keys_are_refused(times, positions, turns):
    with pytest.raises(ValueError, match="key frames have increasing times|zero norm|single quaternion|shape"):
        KeyframePath(times, positions, turns)


def test_a_pose_that_is_not_rigid_is_refused():
    for bad in (np.diag([2.0, 2, 2, 1]), np.diag([-1.0, 1, 1, 1]), np.full((4, 4), np.nan), np.eye(3)):
        refusal(ConfigError, rigid, bad, match="not rigid")
