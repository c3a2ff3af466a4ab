"""Plane fitting on edges whose motion is known."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.errors import EventDataError
from eflow.data.window import Window
from eflow.methods.planes import PlaneFitting, normal_flow

H, W = 60, 80


def edge(angle, speed, every=1):
    """One event per pixel and crossing of a straight edge that moves across itself at ``speed`` px/s: x, y, t, p."""
    y, x = np.mgrid[:H, :W].reshape(2, -1)
    n = np.array([np.cos(angle), np.sin(angle)])
    t = ((x - W / 2) * n[0] + (y - H / 2) * n[1]) / speed
    t -= t.min()
    order = np.argsort(t, kind="stable")
    return np.repeat(x[order], every), np.repeat(y[order], every), t[order], n


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0, -1.9])
@pytest.mark.parametrize("speed", [30.0, 900.0])
def test_a_straight_edge(angle, speed):
    x, y, t, n = edge(angle, speed)
    motion = np.empty((len(t), 2))
    normal_flow(x, y, t, np.ones(len(t), np.int64), 0.0, H, W, motion)
    told = np.isfinite(motion).all(1)
    assert told.mean() > 0.9
    np.testing.assert_allclose(motion[told], np.broadcast_to(speed * n, (told.sum(), 2)), rtol=1e-6, atol=1e-9 * speed)


def test_later_events_of_a_strong_edge_do_not_count():
    x, y, t, _ = edge(0.4, 100.0)
    x, y = np.concatenate([x, x]), np.concatenate([y, y])
    t = np.concatenate([t, t + 0.015])  # the second comes after the first of the neighbour
    order = np.argsort(t, kind="stable")
    x, y, t = x[order], y[order], t[order]
    speed = {}
    for quiet in (0.0, 0.05):
        motion = np.empty((len(t), 2))
        normal_flow(x, y, t, np.ones(len(t), np.int64), quiet, H, W, motion)
        speed[quiet] = np.nanmedian(np.hypot(*motion.T))
    assert speed[0.05] == pytest.approx(100, rel=1e-6) and speed[0.0] > 110


def window(x, y, t_us, t0, t1):
    return Window(x.astype(np.uint16), y.astype(np.uint16), t_us, np.ones(len(x), np.uint8), t0, t1)


def test_two_edges_agree_on_the_full_motion():
    """Each edge shows the motion across itself alone; together they show all of it."""
    motion, parts = np.array([40.0, -25.0]), []
    for angle in (0.3, 1.9):
        n = np.array([np.cos(angle), np.sin(angle)])
        x, y, t, _ = edge(angle if n @ motion > 0 else angle + np.pi, abs(n @ motion))
        keep = (x + y) % 2 == (angle > 1)  # every other pixel sees the other edge
        parts.append((x[keep], y[keep], t[keep] - t.mean() + 1.0))
    fits = []
    for x, y, t in parts:
        out = np.empty((len(t), 2))
        normal_flow(x, y, t, np.ones(len(t), np.int64), 0.0, H, W, out)
        told = np.isfinite(out).all(1)
        fits.append((x[told], y[told], out[told]))
    x, y, v = (np.concatenate([f[k] for f in fits]) for k in range(3))
    flow = PlaneFitting._agreed(x, y, v, np.hypot(*v.T), H, W)[20:40, 20:60]
    assert np.hypot(*(flow - motion).reshape(-1, 2).T).mean() < 0.1 * np.hypot(*motion)


def test_the_method_on_windows_and_nothing_to_go_by():
    x, y, t, _ = edge(0.0, 400.0)
    t_us = (t * 1e6).astype(np.int64)
    half = int(t_us.max() // 2)
    old, new = (
        window(x[k], y[k], t_us[k], a, b) for k, a, b in ((t_us < half, 0, half), (t_us >= half, half, 2 * half + 2))
    )
    flow = PlaneFitting()(old, new, H, W)
    assert flow.shape == (H, W, 2) and flow.dtype == np.float32
    assert np.median(flow[..., 0]) == pytest.approx(400 * half * 1e-6, rel=0.1) and abs(np.median(flow[..., 1])) < 1
    with pytest.raises(EventDataError, match="no edge whose motion could be told"):
        PlaneFitting()(old.take(np.arange(5)), new.take(np.arange(2)), H, W)
