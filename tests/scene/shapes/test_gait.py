"""What figures do: rounds without a seam, rates of their own, feet that do not slide; ways at one speed."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.scene.geometry.living import figure
from blinkgl.scene.motion.ways import Way, way_path
from blinkgl.scene.shapes.gait import CLIPS, PARENTS, J, Proportions, clip_of
from blinkgl.scene.shapes.skeleton import Skeleton

MS = 1_000_000
BODIES = [Proportions(), Proportions(1.2, 1.2, 0.85, 1.1, 1.3)]
CASES = [(name, 0) for name in CLIPS] + [("dance", k) for k in range(1, 8)] + [("wave", 1), ("walk", 5), ("run", 9)]


def places(cycle, times):
    """(N, 21, 4, 4)"""
    skeleton = Skeleton(PARENTS, cycle)
    return np.array([skeleton.at(int(t))[0] for t in times])


@pytest.mark.parametrize(("name", "variant"), CASES)
def test_a_round_has_no_seam_and_its_rate_is_that_of_its_places(name, variant):
    cycle = clip_of(name, BODIES[0], 1.1, 0.3, variant)
    skeleton, period, h = Skeleton(PARENTS, cycle), cycle.period_ns, 2000
    np.testing.assert_array_equal(*(skeleton.at(t)[0] for t in (MS, MS + 7 * period)))
    for t in (0, 123 * MS, period - h, 10**15 + 77 * MS):
        rate = skeleton.at(t)[1]
        before, after = (skeleton.at(t + dt)[0] for dt in (-h, h))
        np.testing.assert_allclose(rate, (after - before) / (2e-9 * h), atol=2e-5)
    # Twice differentiable where it begins again, too.
    t = np.arange(-3, 4) * (period // 2000)
    second = np.diff(places(cycle, t)[:, :, :3, 3], n=2, axis=0)
    assert np.abs(np.diff(second, axis=0)).max() < 0.2 * np.abs(second).max() + 1e-9
    assert np.abs(skeleton.at(0)[1]).max() > 0.02


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize(("name", "tempo"), [("walk", 1), ("walk", 0.6), ("walk", 1.6), ("run", 1), ("run", 1.4)])
def test_feet_on_the_ground_do_not_slide(body, name, tempo):
    """Of the heel and the ball of each foot, while it is no higher than 2 mm: how far it comes, in parts of a step."""
    cycle = clip_of(name, body, tempo)
    period = cycle.period_ns * 1e-9
    step = cycle.speed * period / 2
    assert 0.28 * body.height * tempo**0.5 < step < 0.9 * body.height * tempo**0.5
    times = np.arange(800) * cycle.period_ns // 400  # two rounds
    world = places(cycle, times)
    for side in "lr":
        foot, toes = world[:, J[f"foot_{side}"]], world[:, J[f"toes_{side}"]]
        heel = foot[:, :3, :3] @ [-body.heel, 0, -body.ankle] + foot[:, :3, 3]
        ball = toes[:, :3, :3] @ [0, 0, -body.ball_height] + toes[:, :3, 3]
        tip = ball + toes[:, :3, :3] @ [body.toes, 0, 0]
        assert min(heel[:, 2].min(), ball[:, 2].min(), tip[:, 2].min()) > -0.005 * body.height
        assert min(heel[:, 2].min(), ball[:, 2].min()) < 0.002 * body.height
        for point in (heel, ball):
            point[:, 0] += cycle.speed * times * 1e-9
            down = point[:, 2] < 0.002 * body.height / 1.75
            starts, ends = (np.flatnonzero(np.diff(np.r_[0, down.astype(int), 0]) == s) for s in (1, -1))
            stands = [slice(a, b) for a, b in zip(starts, ends) if b - a > 8]
            assert stands
            slid = max(np.ptp(point[s, :2], axis=0).max() for s in stands)
            assert slid < 0.03 * step, f"{slid / step:.1%} of a step"
        # One that goes is in the air half the time or so, and then well above the ground.
        assert np.maximum(heel[:, 2], ball[:, 2]).max() > 0.06 * body.height


@pytest.mark.parametrize("variant", range(8))
def test_who_dances_or_waves_stands_on_the_ground(variant):
    for name in ("dance", "wave", "stand"):
        mesh = figure(clip=name, variant=variant)
        lows = [mesh.deformer.positions(mesh, t)[:, 2].min() for t in range(0, 2000 * MS, 130 * MS)]
        assert min(lows) > -0.02 and max(lows) < 0.02


# ------------------------------------------------------------------------------------------------- ways


@pytest.mark.parametrize("closed", [False, True])
def test_a_way_is_gone_along_at_one_speed_with_the_nose_ahead(closed):
    points = [(0, 0, 0.5), (2, 0, 0.5), (3, 2, 0.5), (1, 3, 0.5), (-1, 1.5, 0.5)]
    path = way_path(points, 1.3, 0, 4 * 10**9, closed=closed, start=0.2)
    times = np.linspace(0, 4 * 10**9, 400).astype(np.int64)
    T, dT = (np.array([f(int(t)) for t in times]) for f in (path.pose, path.derivative))
    speed = np.linalg.norm(dT[:, :3, 3], axis=1)
    np.testing.assert_allclose(speed, 1.3, rtol=5e-3)
    np.testing.assert_allclose((T[:, :3, 0] * dT[:, :3, 3]).sum(axis=1), 1.3, rtol=5e-3)
    np.testing.assert_allclose(T[:, 2, 2], 1, atol=1e-9)
    way = Way(points, closed)
    np.testing.assert_allclose(T[0, :3, 3], way.at(np.array([0.2 * way.length]))[0][0], atol=1e-4)
    at = way.at(np.linspace(0, way.length, 2000))[0]
    assert all(np.linalg.norm(at - p, axis=1).min() < 0.01 for p in points)
    if closed:
        np.testing.assert_allclose(way.at(np.array([0.0]))[0], way.at(np.array([way.length]))[0], atol=1e-9)


def test_beyond_its_end_a_way_goes_straight_on():
    path = way_path([(0, 0, 0), (1, 0, 0)], 2.0, 0, 2 * 10**9)
    np.testing.assert_allclose(path.pose(2 * 10**9)[:3, 3], [4, 0, 0], atol=1e-9)


def test_a_nose_goes_up_with_the_way():
    path = way_path([(0, 0, 0), (1, 0, 1)], 1.0, 0, 10**9, level=False)
    np.testing.assert_allclose(path.pose(5 * 10**8)[:3, 0], np.array([1, 0, 1]) / 2**0.5, atol=1e-9)
    np.testing.assert_allclose(path.pose(5 * 10**8)[2, 1], 0, atol=1e-9)
