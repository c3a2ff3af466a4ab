"""Suns, point and spot lights: against closed form, the float64 reference, and the plain light beside them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.config.deform import TwistConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.render import casting, draw_items
from blinkgl.render.renderer import Renderer
from blinkgl.scene.lights import lamp_pose
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.shapes.table import deformer_of
from blinkgl.scene.types import Lamp, Light, Material
from blinkgl.tools.shader_debugger import reference
from render_scenes import (
    LEVEL,
    SECOND,
    cube,
    drift,
    mixed_scene,
    moved_scene,
    quad,
    rates,
    rig,
    scene,
    smooth_texture,
    sphere,
    still,
    thing,
)

PLAIN = RenderConfig()
SUN = Lamp("sun", (0.2, 0.1, 0.4), StaticPath(lamp_pose(shines=(1, 1, -1))))
POINT = Lamp("point", (6.0, 2.0, 1.0), StaticPath(lamp_pose((0.3, 3.0, 1.0))), reach=9.0)
SPOT = Lamp("spot", (8.0, 8.0, 20.0), StaticPath(lamp_pose((0, 2, 2), (0.1, 1.2, -2))), inner=0.3, outer=0.6)
LAMPS = (SUN, POINT, SPOT)


def grey(lamp):
    return replace(lamp, strength=(lamp.strength[1],) * 3)


def wall_at(distance=2.0):
    """A white wall across the camera's axis, and where each pixel's point of it is, (H, W, 3)."""
    wall = thing("wall", 1, quad(9, 9), still((0, distance, 0), Rotation.from_euler("x", 90, degrees=True)))
    world = scene([wall])
    xy = casting.pixel_grid(world.camera)
    points = world.camera.rays(xy) * distance @ np.asarray(LEVEL.as_matrix()).T
    return world, points.reshape(world.camera.height, world.camera.width, 3)


def luminance(gl, world, t=0):
    with Renderer(gl, world, PLAIN) as renderer:
        return renderer.luminance(t).read().astype(np.float64)


@pytest.mark.parametrize("reach", [math.inf, 1.8])
def test_a_point_light_falls_with_the_square_of_the_distance(gl, reach):
    world, points = wall_at()
    place = np.array([0.2, 0.5, -0.3])
    lamp = Lamp("point", (3.0, 3.0, 3.0), StaticPath(lamp_pose(place)), reach)
    world = replace(world, light=Light(sun=0, sky=0, lamps=(lamp,)))
    distance = np.linalg.norm(points - place, axis=-1)
    expected = 3.0 * (2.0 - 0.5) / distance**3 * np.maximum(0.0, 1.0 - (distance / reach) ** 4)
    np.testing.assert_allclose(luminance(gl, world), expected, rtol=2e-5, atol=2e-6)
    assert (expected == 0).any() == math.isfinite(reach)


def test_a_spot_light_shines_in_its_cone(gl):
    world, points = wall_at()
    place, axis = np.array([-0.1, 0.2, 0.1]), np.array([0.1, 1.0, 0.05])
    inner, outer = math.radians(8), math.radians(17)
    lamp = Lamp("spot", (5.0, 5.0, 5.0), StaticPath(lamp_pose(place, axis)), inner=inner, outer=outer)
    world = replace(world, light=Light(sun=0, sky=0, lamps=(lamp,)))
    way = points - place
    distance = np.linalg.norm(way, axis=-1)
    cosine = way @ axis / np.linalg.norm(axis) / distance
    share = np.clip((cosine - math.cos(outer)) / (math.cos(inner) - math.cos(outer)), 0, 1) ** 2
    expected = 5.0 * 1.8 / distance**3 * share
    np.testing.assert_allclose(luminance(gl, world), expected, rtol=1e-4, atol=2e-6)
    assert (share == 1).any() and (share == 0).any() and ((share > 0) & (share < 1)).sum() > 100


@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_every_light_is_the_references(gl, offset):
    """Of moving things, textured and not, and far from the origin."""
    light = Light(sun_color=(1.0, 0.9, 0.6), sky_color=(0.4, 0.6, 1.0), lamps=LAMPS)
    for textured in (True, False):
        world = mixed_scene(textured=textured)
        if offset:
            world = moved_scene(world, np.full(3, offset))
            moved = [np.add(lamp_pose(), 0) for _ in LAMPS]
            for T, lamp in zip(moved, LAMPS):
                T[:] = lamp.path.pose(0)
                T[:3, 3] += offset
            light = replace(light, lamps=tuple(replace(la, path=StaticPath(T)) for la, T in zip(LAMPS, moved)))
        world = replace(world, light=light)
        for t in (0, SECOND // 3):
            ref = reference.render(world, t)
            with Renderer(gl, world, RenderConfig(image_antialiasing="none")) as renderer:
                seen, colour = renderer.luminance(t).read(), renderer.colour(t).read()
            off = ref.hit & ~reference.silhouette_band(ref.instance, ref.depth)
            error, error_colour = np.abs(seen - ref.luminance)[off], np.abs(colour - ref.colour)[off]
            assert np.median(error) < 2e-6 and np.median(error_colour) < (2e-4 if textured else 2e-6)
            if not textured:
                assert np.quantile(error, 0.999) < 1e-4


@pytest.mark.parametrize("finer", [False, True])
def test_light_of_a_panorama_is_the_references(gl, finer):
    """Nine numbers per channel, or eighteen, turned into each object's axes; and their rate."""
    quadric = np.random.default_rng(1).normal(size=(3, 4, 4)) * 0.1
    quadric = quadric + quadric.swapaxes(1, 2) + np.diag([0, 0, 0, 1.0])
    quartic = np.random.default_rng(2).normal(size=(3, 9, 9)) * 0.04
    around, more = (
        tuple(tuple(map(tuple, one)) for one in form.tolist()) for form in (quadric, quartic + quartic.swapaxes(1, 2))
    )
    light = Light(sun=0, sky=0, quadric=around, quartic=more if finer else None)
    world, t = replace(mixed_scene(textured=False), light=light), SECOND // 3
    ref = reference.render(world, t)
    with Renderer(gl, world, RenderConfig(image_antialiasing="none"), whole=True) as renderer:
        seen, colour = renderer.luminance(t).read(), renderer.colour(t).read()
        rate, true = rates(renderer, t)
    ambients = {dict(defines).get("AMBIENT") for program, defines in gl.shaders.compiled if program == "luminance.glsl"}
    assert ("3" if finer else "2") in ambients
    off = ref.hit & ~reference.silhouette_band(ref.instance, ref.depth, width=3) & (ref.instance > 2)
    assert (
        np.quantile(np.abs(seen - ref.luminance)[off], 0.999) < 1e-4
        and np.median(np.abs(colour - ref.colour)[off]) < 1e-6
    )
    assert np.quantile(np.abs(rate - true)[off], 0.9) < 0.03 * np.abs(true[off]).max()


@pytest.mark.parametrize("finer", [False, True])
def test_flat_facets_are_lit_at_their_corners(gl, monkeypatch, finer):
    """As at every pixel, from before and from behind, of one channel and of three; where anything else counts it is
    done at every pixel."""
    around = np.random.default_rng(3).normal(size=(3, 4, 4)) * 0.1
    around = around + around.swapaxes(1, 2) + np.diag([0, 0, 0, 1.0])
    fourth = np.random.default_rng(4).normal(size=(3, 9, 9)) * 0.04
    nested = [
        tuple(tuple(map(tuple, one)) for one in form.tolist()) for form in (around, fourth + fourth.swapaxes(1, 2))
    ]
    light = Light(sun=0.4, sky=0, sun_color=(1.0, 0.8, 0.5), quadric=nested[0], quartic=nested[1] if finer else None)
    texture, sheet = Material(texture=smooth_texture()), quad(0.6, 0.6)
    bodies = [
        thing("box", 1, cube(0.5), still((-0.8, 3, 0), Rotation.from_euler("zx", [30, 20], degrees=True)), texture),
        thing("ball", 2, sphere(0.5, 3), still((0.8, 3, 0)), texture),
        thing("front", 3, sheet, still((0.2, 3.4, 0.9), Rotation.from_euler("x", 60, degrees=True))),
        thing("back", 4, sheet, still((-0.2, 3.4, -0.9), Rotation.from_euler("x", 240, degrees=True))),
    ]
    world = scene(bodies, light=light)
    unfiltered = RenderConfig(image_antialiasing="none")
    with Renderer(gl, world, unfiltered) as renderer:
        assert [item.kind.faceted for item in sorted(renderer.items, key=lambda i: i.object_index)] == [1, 0, 1, 1]
        flat = renderer.luminance(0).read(), renderer.colour(0).read()
        beside_rates = renderer.brightness(0).read()[..., 0]
    programs = [dict(defines) for _, defines in gl.shaders.compiled]
    assert any("FACETED" in one and one.get("AMBIENT") == ("3" if finer else "2") for one in programs)
    monkeypatch.setattr(draw_items._Facets, "flat", lambda *_: False)
    with Renderer(gl, world, unfiltered) as renderer:
        smooth = renderer.luminance(0).read(), renderer.colour(0).read()
    ids = reference.render(world, 0).instance
    assert all((ids == k).sum() > 100 for k in (1, 2, 3, 4))
    for one, other in zip(flat, smooth):
        np.testing.assert_allclose(one, other, rtol=2e-6, atol=1e-7)
    np.testing.assert_allclose(beside_rates, flat[0], rtol=2e-6, atol=1e-7)


MOVING = replace(POINT, path=drift((0.3, 3, 1), (0.8, 2.5, 0.4)))
TURNING = replace(
    SPOT,
    path=drift((0, 2, 2), (0.4, 2, 1.8), *(Rotation.from_euler(a, v, degrees=True) for a, v in (("x", 25), ("y", 20)))),
)


@pytest.mark.parametrize("lamp", [SUN, POINT, SPOT, MOVING, TURNING], ids=["sun", "point", "spot", "moving", "turning"])
@pytest.mark.parametrize("shape", ["rigid", "twist"])
def test_rate_of_luminance_under_a_lamp(gl, lamp, shape):
    """dL/dt of what moves and turns, under what stands and moves, is the frames' difference quotient."""
    egg = sphere(1.0, 4)
    if shape == "twist":
        egg = replace(egg, deformer=deformer_of(TwistConfig(angle=90), egg.vertices.min(0), egg.vertices.max(0)))
    path = drift((0.2, 4, 0.1), (-0.1, 4.2, 0.3), Rotation.identity(), Rotation.from_rotvec([0.1, -0.2, 0.3]))
    world = scene(
        [thing("body", 1, egg, path, Material(base_color=(0.9, 0.5, 0.3)))],
        rig(path=drift((0, 0, 0), (0.2, 0.1, -0.1), LEVEL)),
        Light(sun=0.3, sky=0.2, sky_color=(0.2, 0.5, 1.0), lamps=(lamp,)),
    )
    t = SECOND // 2
    ref = reference.render(world, t)
    with Renderer(gl, world, PLAIN, whole=True) as renderer:
        rate, true = rates(renderer, t)
    off = ref.hit & ~reference.silhouette_band(ref.instance, ref.depth, width=3)
    error = np.abs(rate - true)[off]
    assert np.abs(true[off]).max() > 0.1
    assert np.quantile(error, 0.9) < 0.03 * np.abs(true[off]).max()


def test_a_moving_lamp_has_all_drawn_again(gl):
    """A camera that stands still keeps no picture of what a moving lamp lights."""
    world = scene(
        [thing("wall", 1, quad(9, 9), still((0, 6, 0), Rotation.from_euler("x", 90, degrees=True))),
         thing("box", 2, cube(0.4), drift((-0.5, 4, 0.2), (0.5, 4, 0.2)))],
        light=Light(lamps=(MOVING,)),
    )  # fmt: skip
    with Renderer(gl, world, PLAIN) as renderer, Renderer(gl, world, PLAIN, whole=True) as whole:
        for t in (0, SECOND // 4, SECOND // 2):
            np.testing.assert_array_equal(renderer.luminance(t).read(), whole.luminance(t).read())
