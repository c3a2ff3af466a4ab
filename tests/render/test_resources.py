"""What can be drawn in float32 at all."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import AssetError
from blinkgl.render import resources
from blinkgl.render.draw_items import MAX_RADIUS, DrawItem, _draw_item, _Facets, _Greys
from blinkgl.render.renderer import Renderer
from blinkgl.render.resources import HALF_LEAST, HALF_MOST, half_floats
from blinkgl.scene.types import Light, Material, Mesh, Texture
from render_scenes import cube, drift, rig, scene, still, thing


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


def lit(*rows) -> np.ndarray:
    return np.array(rows, np.float32)[..., None]


@pytest.mark.parametrize(
    ("image", "half"),
    [
        (lit([0, HALF_LEAST], [1, HALF_MOST]), True),  # black is exact, and both ends are in
        (lit([0.5, HALF_LEAST * (1 - 1e-6)]), False),  # 1/2048 of a darker texel is less than it tells apart
        (lit([0.5, HALF_MOST * 1.001]), False),
        (lit([0.5, np.inf]), False),
        (lit([0.0, 0.0]), False),  # nothing to gain, and nothing to divide by
        (lit([*[0.0] * 99, 50 * HALF_LEAST]), False),  # coarse levels would be darker than any texel
        (lit([*[0.0] * 99, 200 * HALF_LEAST]), True),
        (np.array([[[1e-6, 0.5, 0.0]]], np.float32), True),  # of a colour the brightest channel counts
        (np.array([[[1e-6, 1e-5, 0.0]], [[1, 1, 1]]], np.float32), False),
    ],
)
def test_half_floats_where_they_hold_a_picture(image, half):
    stored = half_floats(image)
    assert stored.dtype == (np.float16 if half else np.float32)
    brightest = image.max(axis=2, keepdims=True)
    with np.errstate(invalid="ignore"):
        assert (np.abs(stored.astype(np.float64) - image) <= brightest / 2048).all() or not half
    if not half:
        assert stored is image


def test_8_bits_of_srgb_are_half_floats():
    codes = np.arange(256, dtype=np.uint8)[None]
    image = resources.luminance_image(np.repeat(codes[..., None], 3, axis=2), (0.3, 0.3, 0.3))[..., None]
    assert half_floats(image).dtype == np.float16


def test_frames_of_half_floats_are_those_of_floats(gl, monkeypatch):
    """Their texels are rounded to 1/2048, their mip levels once more; rates are differences of neighbours. A picture of
    floats stays as it is."""
    rng = np.random.default_rng(3)
    coded = Texture(rng.integers(0, 256, (64, 64, 3), np.uint8), "codes")
    whole = Texture(rng.random((64, 64, 3), np.float32), "floats")
    kinds: list[np.dtype] = []
    of = half_floats
    monkeypatch.setattr(resources, "half_floats", lambda image: kinds.append(image.dtype) or of(image))

    def drawn(texture: Texture) -> tuple[np.ndarray, np.ndarray]:
        body = thing("box", 1, cube(0.8), drift((0, 3, 0), (0.5, 3, 0)), Material(texture=texture))
        with Renderer(gl, scene([body], rig(80, 60, 75.0)), RenderConfig(antialiasing="taps4")) as renderer:
            return renderer.luminance(100_000_000).read(), renderer.brightness(100_000_000).read()[..., 1]

    half, half_rate = drawn(coded)
    assert kinds == [np.float32] and drawn(whole) and len(kinds) == 1
    monkeypatch.setattr(resources, "half_floats", lambda image: image)
    true, rate = drawn(coded)
    off = np.abs(half - true)
    assert 0 < off.max() <= true.max() / 1024, "they differ, or nothing was compared"
    assert np.abs(half_rate - rate).max() <= 2e-3 * np.abs(rate).max() > 0
