"""Where on the screen something can be: no less than it covers, and no more than a pixel on every side besides."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.render.canvas import Rectangle, merged, screen_rectangle
from blinkgl.render.draw_items import box_corners

CAMERA = PinHole(64, 40, 50.0, 70.0, 20.0, 28.0, near=0.1)


def pose(position, turn=(0.0, 0.0, 0.0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), position
    return T


def item(low, high):
    return SimpleNamespace(corners=box_corners(np.array(low, float), np.array(high, float)))


def test_a_box_is_inside_its_rectangle_with_a_pixel_to_spare_and_no_more():
    dice = np.random.default_rng(0)
    seen = 0
    for _ in range(300):
        low = dice.uniform(-0.5, 0, 3)
        high = low + dice.uniform(0.05, 0.8, 3)
        T = pose([*dice.uniform(-2, 2, 2), dice.uniform(1.5, 6)], dice.normal(size=3))
        corners = (
            np.array(
                [
                    [(low, high)[a][0], (low, high)[b][1], (low, high)[c][2]]
                    for a in (0, 1)
                    for b in (0, 1)
                    for c in (0, 1)
                ]
            )
            @ T[:3, :3].T
            + T[:3, 3]
        )
        x, y = (
            CAMERA.fx * corners[:, 0] / corners[:, 2] + CAMERA.cx,
            CAMERA.fy * corners[:, 1] / corners[:, 2] + CAMERA.cy,
        )
        # Pixels, both ends included.
        x0, x1, y0, y1 = (
            math.floor(x.min()) - 1,
            math.ceil(x.max()) + 1,
            math.floor(y.min()) - 1,
            math.ceil(y.max()) + 1,
        )
        x0, x1, y0, y1 = max(x0, 0), min(x1, 63), max(y0, 0), min(y1, 39)
        found = screen_rectangle(item(low, high), T, CAMERA)
        if x0 > x1 or y0 > y1:
            assert found is None
        else:
            seen += 1
            assert (found.x0, found.y0, found.x1 - 1, found.y1 - 1) == (x0, y0, x1, y1)
    assert 100 < seen < 300


def test_what_reaches_the_near_plane_may_be_anywhere():
    everywhere = Rectangle(0, 0, 64, 40)
    box = item([-0.1, -0.1, -0.1], [0.1, 0.1, 0.1])
    assert screen_rectangle(box, pose([0, 0, 0.2]), CAMERA) == everywhere, "a corner exactly on it"
    assert screen_rectangle(box, pose([0, 0, 0.1]), CAMERA) == everywhere
    assert screen_rectangle(box, pose([5, 0, 0.2]), CAMERA) == everywhere
    assert screen_rectangle(box, pose([0, 0, 0.3]), CAMERA) != everywhere
    assert (
        screen_rectangle(box, pose([0, 0, -1.0]), CAMERA) is None
        and screen_rectangle(box, pose([0, 0, 0.0]), CAMERA) is None
    )


@pytest.mark.parametrize(
    "a, b, meet",
    [
        ((0, 0, 2, 2), (2, 0, 4, 2), False),
        ((0, 0, 2, 2), (1, 1, 3, 3), True),
        ((0, 0, 2, 2), (0, 2, 2, 4), False),
        ((0, 0, 9, 9), (3, 3, 4, 4), True),
        ((0, 0, 2, 2), (5, 0, 6, 2), False),
        ((0, 0, 2, 2), (1, 5, 2, 6), False),
    ],
)
def test_rectangles_meet_where_they_share_a_pixel(a, b, meet):
    a, b = Rectangle(*a), Rectangle(*b)
    assert a.meets(b) is b.meets(a) is meet
    union = a.union(b)
    assert union == b.union(a) == Rectangle(min(a.x0, b.x0), min(a.y0, b.y0), max(a.x1, b.x1), max(a.y1, b.y1))
    assert merged([a, b]) == ([union] if meet else sorted([a, b], key=lambda r: (r.y0, r.x0)))


def test_scale():
    assert Rectangle(1, 2, 4, 9).scaled(3) == Rectangle(3, 6, 12, 27)


def test_merging_goes_on_until_none_meet():
    """The union of two meets a third that neither did."""
    chain = [
        Rectangle(0, 0, 2, 2),
        Rectangle(5, 5, 6, 6),
        Rectangle(1, 1, 5, 2),
        Rectangle(4, 1, 6, 9),
        Rectangle(20, 0, 21, 1),
    ]
    assert merged(chain) == [Rectangle(0, 0, 6, 9), Rectangle(20, 0, 21, 1)] == merged(chain[::-1])
    assert merged([]) == []
