"""What can be drawn in float32 at all."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.errors import AssetError
from blinkgl.render.resources import MAX_RADIUS, DrawItem, _draw_item, _Facets, _Greys
from blinkgl.scene.types import Light, Material, Mesh
from render_scenes import scene, still, thing


def mesh(reach: float) -> Mesh:
    corners = np.array([[-reach, 0, 0], [reach, 0, 0], [0, reach / 2, 0]]) + [0.0, 3.0, 0.0]
    return Mesh(
        corners,
        np.array([[0, 1, 2]], np.int32),
        np.zeros((3, 3), np.float32),
        np.zeros((3, 2), np.float32),
        True,
        "sheet",
    )


def item_of(shape: Mesh, material: Material | None = None) -> DrawItem:
    body = thing("sheet", 1, shape, still(), material)
    return _draw_item(2, body, body.parts[0], scene([body]), _Greys(False), _Facets(Light()))


def test_the_largest_mesh_and_one_that_is_larger():
    centre = np.hypot(1.0, 0.25)  # of the box; the farthest corner is the left one
    item = item_of(mesh(MAX_RADIUS / centre * (1 - 1e-12)))
    assert item.radius == pytest.approx(MAX_RADIUS) and not item.two_sided and item.lit
    for reach in (MAX_RADIUS, np.nan):
        with pytest.raises(AssetError, match="sheet: mesh is too large to be drawn in float32"):
            item_of(mesh(reach))


def test_exactly_the_largest_radius_is_drawn():
    flat = Mesh(
        np.array([[-MAX_RADIUS, 0, 0], [MAX_RADIUS, 0, 0], [0, 0, 0.0]]),
        np.array([[0, 1, 2]], np.int32),
        np.zeros((3, 3), np.float32),
        np.zeros((3, 2), np.float32),
        True,
        "line",
    )
    assert item_of(flat, Material(double_sided=True)).radius == MAX_RADIUS
