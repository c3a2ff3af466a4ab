"""Contrast maximisation: derivatives, fields, and motions that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from blinkgl.errors import EventDataError
from eflow.data.window import Window
from eflow.methods import make_method
from eflow.methods.contrast import (
    MOST_EVENTS,
    _Cloud,
    affine_field,
    rotation_field,
    sharpest_length,
    sharpness,
)
from eflow.methods.iwe import flow_warp_loss, slope_at, vote, warped

H, W = 96, 128
CENTRE = np.array([(W - 1) / 2, (H - 1) / 2])
MOTIONS = {
    "translation": lambda p: np.broadcast_to([6.0, -3.0], p.shape),
    "fast": lambda p: np.broadcast_to([-14.0, 9.0], p.shape),
    "zoom": lambda p: (p - CENTRE) * 0.06,
    "affine": lambda p: (p - CENTRE) @ np.array([[0.03, 0.02], [-0.04, 0.01]]) + [3, 1],
}


def pictured(motion, seed=0, noise=0.1):
    """Windows [0, 50) and [50, 100) ms of points on short lines that move along a field, px a window, with noise."""
    rng = np.random.default_rng(seed)
    lines = []
    for _ in range(40):
        angle, length = rng.uniform(0, np.pi), rng.uniform(5, 25)
        along = np.linspace(-0.5, 0.5, 16)[:, None] * length * np.array([np.cos(angle), np.sin(angle)])
        lines.append(rng.uniform([0, 0], [W, H]) + along)
    points, rows = np.concatenate(lines), []
    for s in np.linspace(-1, 1, 120):
        at = points[rng.random(len(points)) < 0.15]
        for _ in range(6):
            at = at + motion(at) * s / 6
        at = np.rint(at + rng.uniform(-0.3, 0.3, at.shape))
        at = at[(at >= 0).all(1) & (at < [W, H]).all(1)]
        rows.append(np.column_stack([at, np.full(len(at), s)]))
    rows = np.concatenate(rows)
    k = int(noise * len(rows))
    rows = np.concatenate([rows, np.column_stack([rng.uniform([0, 0, -1], [W - 1, H - 1, 1], (k, 3))])])
    rows = rows[np.argsort(rows[:, 2], kind="stable")]
    t = ((rows[:, 2] + 1) * 50_000).astype(np.int64).clip(0, 99_999)

    def window(t0, t1):
        keep = (t >= t0) & (t < t1)
        x, y = rows[keep, :2].astype(np.uint16).T
        return Window(x, y, t[keep], np.ones(keep.sum(), np.uint8), t0, t1)

    return window(0, 50_000), window(50_000, 100_000)


def truth(motion):
    y, x = np.mgrid[:H, :W].reshape(2, -1).astype(float)
    return motion(np.column_stack([x, y])).reshape(H, W, 2)


def length(field):
    return np.hypot(field[..., 0], field[..., 1])


@pytest.mark.parametrize(
    ("field", "motion", "limit"),
    [
        ("translation", "translation", 0.15),
        ("affine", "zoom", 0.2),
        ("affine", "affine", 0.2),
    ],
)
def test_known_motions_are_found(field, motion, limit):
    old, new = pictured(MOTIONS[motion])
    flow = make_method(f"contrast-{field}")(old, new, H, W)
    assert flow.shape == (H, W, 2) and flow.dtype == np.float32
    assert length(flow - truth(MOTIONS[motion])).mean() < limit


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_windows_of_two_lengths(share):
    """MVSEC's, where a frame is missing: the same motion, cut elsewhere."""
    both = pictured(MOTIONS["translation"])
    x, y, t, p = (np.concatenate([getattr(w, k) for w in both]) for k in "xytp")
    middle = round(100_000 * share)
    old, new = t < middle, t >= middle
    windows = [Window(x[k], y[k], t[k], p[k], *ends) for k, ends in ((old, (0, middle)), (new, (middle, 100_000)))]
    expected = truth(MOTIONS["translation"]) * 2 * (1 - share)
    assert length(make_method("contrast-translation")(*windows, H, W) - expected).mean() < 0.15


def test_a_rotating_camera():
    focal = 150.0

    def motion(p):
        u, v = ((p - CENTRE) / focal).T
        return focal * np.column_stack(
            [0.02 * u * v + 0.03 * (1 + u * u) + 0.05 * v, 0.02 * (1 + v * v) + 0.03 * u * v - 0.05 * u]
        )

    flow = make_method("contrast-rotation", focal)(*pictured(motion), H, W)
    assert length(flow - truth(motion)).mean() < 0.15 < 0.04 * length(truth(motion)).mean()


@pytest.mark.parametrize("motion", ["translation", "fast", "zoom", "affine"])
@pytest.mark.parametrize("windows", [1, 2])
def test_the_length_of_a_right_direction_is_found(motion, windows):
    seen = pictured(MOTIONS[motion])[-windows:]
    for wrong in (0.95, 1.25, 2.2):
        factor, why = sharpest_length(list(seen), wrong * truth(MOTIONS[motion]))
        assert not why and factor * wrong == pytest.approx(1, abs=0.06)


def test_a_length_that_events_do_not_tell_stays():
    old, new = pictured(MOTIONS["translation"])
    assert sharpest_length([old, new], np.zeros((H, W, 2)))[0] == pytest.approx(1.0, abs=0.01)
    few = Window(new.x[:20], new.y[:20], new.t[:20], new.p[:20], new.t0, new.t1)
    assert sharpest_length([few], truth(MOTIONS["translation"])) == (1.0, "too few events")
    # It would be shorter than any that is tried.
    assert sharpest_length([new], 9 * truth(MOTIONS["translation"])) == (1.0, "no length is sharpest")


def test_a_shorter_flow_of_sparse_events_is_not_believed():
    """Of a tenth of the events in as much of the picture, whichever are drawn, the right flow is not shortened."""
    right = truth(MOTIONS["translation"])
    for draw in range(10):
        kept = [w.take(np.random.default_rng(draw).random(len(w)) < 0.1) for w in pictured(MOTIONS["translation"])]
        assert sharpest_length(kept, right)[0] > 0.95


def test_events_outside_the_sensor_say_nothing():
    """Rectified ones may lie there: they neither wrap to the other side nor end it."""
    seen, wrong = pictured(MOTIONS["zoom"]), 1.25 * truth(MOTIONS["zoom"])
    floats = [replace(w, x=w.x.astype(np.float32), y=w.y.astype(np.float32)) for w in seen]
    stray = np.tile(np.float32([-30.4, -0.6, W + 3, 5000]), 40)
    with_stray = [
        w.with_events(stray, stray[::-1], np.full(len(stray), w.t0 + 9), np.ones(len(stray), np.uint8)) for w in floats
    ]
    assert sharpest_length(with_stray, wrong) == sharpest_length(floats, wrong)


def test_the_derivative_of_the_sharpness():
    cloud = _Cloud.of(list(pictured(MOTIONS["affine"])), H, W)
    rng = np.random.default_rng(1)
    for blur in (1.0, 4.0):
        for field in (affine_field(cloud.x, cloud.y, H, W), rotation_field(cloud.x, cloud.y, H, W, 150.0)):
            p, way = (rng.normal(0, 3, field.basis[0].shape[1]) for _ in range(2))
            slope = field.pulled(sharpness(cloud, field.at(p), blur)[1]) @ way
            h = 1e-5
            by_hand = (
                sharpness(cloud, field.at(p + h * way), blur)[0] - sharpness(cloud, field.at(p - h * way), blur)[0]
            ) / (2 * h)
            assert slope == pytest.approx(by_hand, rel=5e-3)  # votes have a kink where a point crosses a pixel's border


def test_voting_and_its_adjoint():
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-3, 15, (2, 400))
    image, weights = np.zeros((10, 12)), rng.normal(size=(10, 12))
    vote(x, y, image)
    inside = (x >= 0) & (x < 11) & (y >= 0) & (y < 9)
    assert image.sum() == pytest.approx(inside.sum())
    slope, moved = np.empty((400, 2)), np.zeros((10, 12))
    slope_at(x, y, weights, slope)
    h = 1e-7  # no point crosses a pixel's border by so little
    vote(x + h, y, moved)
    assert ((moved - image) * weights).sum() / h == pytest.approx(slope[:, 0].sum(), rel=1e-5)
    assert not slope[~inside].any()


def test_flow_warp_loss():
    _, new = pictured(MOTIONS["fast"], noise=0.0)
    assert flow_warp_loss(new, np.zeros((H, W, 2))) == 1
    assert flow_warp_loss(new, truth(MOTIONS["fast"])) > 1.5 > flow_warp_loss(new, -truth(MOTIONS["fast"]))
    x = np.array([10, 12, 14], np.uint16)
    streak = Window(x, np.full(3, 5, np.uint16), np.array([0, 50, 100]), np.ones(3, np.uint8), 0, 100)
    image = warped(streak, np.broadcast_to([4.0, 0.0], (H, W, 2)))
    assert image[5, 10] == 3 and image.sum() == 3, "all three events in the pixel of the first"
    assert np.isnan(flow_warp_loss(streak.take(np.zeros(3, bool)), np.zeros((H, W, 2))))


def test_too_many_events_are_thinned_and_too_few_refused():
    old, new = pictured(MOTIONS["zoom"])
    many = old.take(np.repeat(np.arange(len(old)), 40))
    assert MOST_EVENTS / 2 < len(_Cloud.of([many, new], H, W).x) <= MOST_EVENTS
    none = new.take(np.zeros(len(new), bool))
    with pytest.raises(EventDataError, match="too few events for contrast maximisation.*got 49"):
        make_method("contrast-affine")(old.take(np.arange(49)), none, H, W)
