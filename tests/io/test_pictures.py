"""Pictures of arrays: which colour means which number."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest

from blinkgl.errors import ConfigError
from blinkgl.io import pictures
from blinkgl.io.colour import flow_colour
from blinkgl.io.pictures import EMPTY, component, finite_range, id_colours, map_scalar, picture

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


def test_components_of_vectors():
    vectors = np.array([[[3.0, 4.0, 12.0]]])
    assert component(vectors, "length") == component(vectors, "auto") == 13
    assert [float(component(vectors, axis)[0, 0]) for axis in "xyz"] == [3, 4, 12]
    assert component(vectors[..., 0], "z") == 3, "a number has no components"
    for bad in ("w", "xy", "", "q"):
        with pytest.raises(
            ConfigError, match="component: no such component .*expected one of auto, length, x, y, z|xyz"
        ):
            component(vectors, bad)


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


@pytest.mark.parametrize("hit", [None, "some", "none"])
def test_motion_by_the_wheel(hit):
    flow = np.zeros((1, 1000, 2), np.float32)
    flow[0, :, 0] = np.arange(1000)
    where = None if hit is None else np.arange(1000)[None] < (500 if hit == "some" else 0)
    rgb, said = picture("motion", flow, hit=where)
    top = 0.995 * (499 if hit == "some" else 999)
    assert said == {"kind": "wheel", "high": pytest.approx(top)}
    assert np.array_equal(rgb, flow_colour(flow, said["high"], where))
    assert picture("motion", flow, high=7.0)[1]["high"] == 7


@pytest.mark.parametrize(
    "kind, which, low, expected",
    [
        ("scalar", "auto", 1, ("viridis", 1 + 0.005 * 999, 1000 - 0.005 * 999, False)),
        ("depth", "auto", 1, ("viridis", 1 + 0.005 * 999, 1000 - 0.005 * 999, True)),
        ("depth", "auto", -10, ("viridis", -10 + 0.005 * 1010, 1000 - 0.005 * 1010, False)),
        ("signed", "auto", 1, ("RdBu_r", -(1000 - 0.005 * 999), 1000 - 0.005 * 999, False)),
        ("motion", "x", 1, ("RdBu_r", -(1000 - 0.005 * 999), 1000 - 0.005 * 999, False)),
        ("unit", "y", 1, ("RdBu_r", -(1000 - 0.005 * 999), 1000 - 0.005 * 999, False)),
        ("motion", "length", 1, ("viridis", None, None, False)),
        ("light", "x", 1, ("viridis", 1 + 0.005 * 999, 1000 - 0.005 * 999, False)),
    ],
)
def test_numbers_get_a_bar(kind, which, low, expected):
    values = np.linspace(low, 1000, 1000)[None]
    array = values if which == "auto" else np.stack([values, values, np.zeros_like(values)], axis=-1)
    rgb, said = picture(kind, array, which=which)
    name, least, most, log = expected
    assert said["kind"] == "bar" and said["map"] == name and said["log"] is log
    if least is not None:
        assert (said["low"], said["high"]) == pytest.approx((least, most))
    shown = pictures.component(array, which)
    assert np.array_equal(rgb, map_scalar(shown, name, said["low"], said["high"], log))
    given, said = picture(kind, array, which=which, colours="turbo", low=2.0, high=5.0)
    assert (said["map"], said["low"], said["high"]) == ("turbo", 2, 5) and given[0, -1].tolist() == code("turbo", 1.0)


def test_where_nothing_is_hit_nothing_is_shown():
    values = np.r_[RAMP, np.full(99, 1e9)][None]
    hit = values < 1e6
    rgb, said = picture("scalar", values, hit=hit)
    assert said["high"] == pytest.approx(995) and (rgb[~hit] == EMPTY).all() and (rgb[hit] != EMPTY).any(axis=-1).all()
