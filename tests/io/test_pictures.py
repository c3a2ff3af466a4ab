"""Pictures of arrays: which colour means which number; colours of flow against the published wheel."""

from __future__ import annotations

import colorsys

import matplotlib
import numpy as np
import pytest

from blinkgl.errors import ConfigError
from blinkgl.io.colour import flow_colour
from blinkgl.io.pictures import EMPTY, finite_range, id_colours, map_scalar, picture

RAMP = np.arange(1001, dtype=np.float64)


def code(name: str, at: float) -> list[int]:
    return [round(255 * v) for v in matplotlib.colormaps[name](at)[:3]]


def test_a_range_leaves_out_the_outermost_half_percent_of_either_side():
    assert finite_range(RAMP) == pytest.approx((5, 995)) and finite_range(RAMP, share=0.1) == pytest.approx((100, 900))
    assert finite_range(np.r_[RAMP, np.nan, np.inf, -np.inf]) == pytest.approx((5, 995))
    assert finite_range(RAMP - 300, signed=True) == pytest.approx((-695, 695))
    assert finite_range(300 - RAMP, signed=True) == pytest.approx((-695, 695))
    assert finite_range(np.array([np.nan])) == (0, 1)
    assert finite_range(np.full(9, 4.0)) == (2, 6) and finite_range(np.full(9, -4.0)) == (-6, -2)
    assert finite_range(np.zeros(9)) == (-0.5, 0.5) == finite_range(np.zeros(9), signed=True)


def test_numbers_by_a_colour_map():
    values = np.array([[-1, 0, 2.5, 5, 10, 99, np.nan, np.inf]])
    rgb = map_scalar(values, "viridis", 0, 10)
    assert (
        rgb.dtype == np.uint8
        and rgb[0].tolist() == [code("viridis", at) for at in (0.0, 0.0, 0.25, 0.5, 1.0, 1.0)] + [EMPTY.tolist()] * 2
    )
    ratios = map_scalar(np.array([[1.0, 10, 100, 0]]), "turbo", 1, 100, log=True)
    assert ratios[0].tolist() == [code("turbo", 0.0), code("turbo", 0.5), code("turbo", 1.0), EMPTY.tolist()]
    assert (map_scalar(np.array([[0.0, 1]]), "gray", 0, 1, log=True) == [[[0] * 3, [255] * 3]]).all(), "none from 0"
    assert map_scalar(np.array([[2.0, 3.0]]), "gray", 2, 2)[0].tolist() == [[0] * 3, [255] * 3]
    with pytest.raises(ConfigError, match=r"map: unknown colour map .got 'jet'.; expected one of viridis, turbo"):
        map_scalar(values, "jet", 0, 1)


KINDS = {
    "mask": (np.array([[True, False]]), [[245] * 3, [25] * 3], {"kind": "mask"}),
    "ids": (np.array([[0, 1]]), [EMPTY.tolist(), id_colours(np.array([[1]]))[0, 0].tolist()], {"kind": "ids"}),
    "light": (np.full((1, 2, 3), (0.0, 0.5, 2.0)), [[0, 188, 255]] * 2, {"kind": "light", "high": 1.0}),
    "unit": (np.array([[[0, 0, 0], [1, -1, 0.0]]]), [EMPTY.tolist(), [255, 0, 128]], {"kind": "unit"}),
    "uv": (np.array([[[0.25, 1.5], [np.nan, -0.25]]]), [[64, 128, 60], [0, 191, 60]], {"kind": "uv"}),
}


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_has_its_way(kind):
    array, colours, legend = KINDS[kind]
    rgb, said = picture(kind, array)
    assert rgb.dtype == np.uint8 and rgb[0].tolist() == colours and said == legend


def middlebury(u: float, v: float) -> np.ndarray:
    """Colour of a flow of at most unit length, by the published bands of hue (Baker et al. 2011)."""
    bands = [
        (15, (255, 0, 0), (0, 1, 0)),
        (6, (255, 255, 0), (-1, 0, 0)),
        (4, (0, 255, 0), (0, 0, 1)),
        (11, (0, 255, 255), (0, -1, 0)),
        (13, (0, 0, 255), (1, 0, 0)),
        (6, (255, 0, 255), (0, 0, -1)),
    ]
    ring = [np.array(start) + 255 * k / steps * np.array(way) for steps, start, way in bands for k in range(steps)]
    turn = (np.arctan2(-v, -u) / np.pi + 1) / 2 * 55
    low = int(turn) % 55
    hue = ring[low] * (1 - turn % 1) + ring[(low + 1) % 55] * (turn % 1)
    return 255 - np.hypot(u, v) * (255 - hue)


def test_flow_by_the_published_wheel():
    dice = np.random.default_rng(0)
    flow = dice.uniform(-5, 5, (30, 40, 2)).astype(np.float32)
    rgb = flow_colour(flow, 10.0)
    for y, x in dice.integers(0, 30, (200, 2)):
        u, v = np.round(flow[y, x] / 10.0 * 255) / 255
        np.testing.assert_allclose(rgb[y, x], middlebury(u, v), atol=0.51)


def test_hues_of_ids_follow_the_golden_ratio():
    """By colorsys, for eight numbers one by one."""
    ids = np.array([[1, 2, 3, 4], [5, 100, 4000, 65535]])
    for number, shown in zip(ids.ravel().tolist(), id_colours(ids).reshape(-1, 3).tolist()):
        value = 0.62 + 0.38 * (number * 0.7548776662 % 1)
        due = colorsys.hsv_to_rgb(number * 0.61803398875 % 1, 0.62, value)
        assert np.abs(np.array(due) * 255 - shown).max() <= 0.51, number
