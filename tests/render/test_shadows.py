"""Shadows of suns and spot lights: edges of known geometry, the float64 reference, no acne, nothing that floats."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.config.sequence import RenderConfig
from blinkgl.render.passes import shadow_maps
from blinkgl.render.passes.shadow import ShadowMap
from blinkgl.render.renderer import Renderer
from blinkgl.scene.lights import lamp_pose
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.types import Lamp, Light, Material, Part, SceneObject
from blinkgl.tools.shader_debugger import reference
from render_scenes import LEVEL, SECOND, cube, curve, drift, quad, rig, scene, sphere, still, thing
from shadow_faults import coarse_frame, contact_frame, faults, frame as random_frame, leaks, towards_of

PLAIN = RenderConfig(image_antialiasing="none")
SEEN = ShadowMap.seen
DOWN = LEVEL * Rotation.from_rotvec([-0.45, 0, 0])
SLANT = np.array([-0.5, -0.3, 1.0]) / np.sqrt(1.34)


def floor(size=15):
    return SceneObject("ground", 1, (Part(quad(size, size), Material()),), still((0, 5, -1)), "ground")


def sunlit(*objects, sky=0.0, towards=SLANT, shadows="hard", size=2048, **more):
    light = Light(tuple(towards), 1.0, sky, shadows=shadows, shadow_size=size, **more)
    return scene([floor(), *objects], rig(path=still((0, 0, 1.0), DOWN)), light)


def drawn(gl, world, t=0, **options):
    with Renderer(gl, world, PLAIN, **options) as renderer:
        return renderer.luminance(t).read().astype(np.float64)


def ground_points(world, t=0):
    """(reference frame, (n, 3) world places of the ground's pixels)."""
    ref = reference.render(world, t)
    on = ref.instance == 1
    return ref, on, ref.local[on] + [0, 5, -1]


@pytest.mark.parametrize("kind", ["sun", "spot"])
def test_the_edge_of_a_balls_shadow_is_where_it_should_be(gl, kind):
    """Within a texel of its map: what is farther from the edge is dark or lit altogether; and half of the light is gone
    within half a texel of it."""
    radius, centre = 0.5, np.array([0.2, 4.0, 0.6])
    ball = thing("ball", 2, sphere(radius, 5), still(centre))
    place = centre + 3.0 * SLANT
    world = sunlit(ball, size=512)
    if kind == "spot":
        lamp = Lamp("spot", (9.0, 9.0, 9.0), StaticPath(lamp_pose(place, -SLANT)), inner=0.7, outer=0.8)
        world = replace(world, light=Light(sun=0, sky=0, lamps=(lamp,), shadows="hard", shadow_size=512))
    seen = drawn(gl, world)
    lit = drawn(gl, replace(world, light=replace(world.light, shadows="off")))
    _, on, points = ground_points(world)
    if kind == "sun":
        distance = np.linalg.norm(np.cross(points - centre, SLANT), axis=1) - radius
        wide = 2 * radius / 500
    else:
        way = points - place
        axis = np.linalg.norm(np.cross(way, centre - place), axis=1) / np.linalg.norm(way, axis=1)
        distance, wide = axis - radius, 2 * np.linalg.norm(way, axis=1) * math.tan(0.8) / 500
        distance = np.where(lit[on] > 0.01, distance, np.nan)
    share = seen[on] / np.where(lit[on] > 0, lit[on], 1.0)
    inner, outer = distance < -wide, distance > wide
    assert inner.sum() > 150 and outer.sum() > 1000
    np.testing.assert_allclose(share[inner], 0.0, atol=1e-6)
    np.testing.assert_allclose(share[outer], 1.0, atol=1e-4)
    assert (share[distance < -0.5 * wide] < 0.5).all() and (share[distance > 0.5 * wide] > 0.5).all()


def moving_world(seed, camera=True, shadows="hard", lamps=()):
    """Ball, box, open sheet over a floor, all moving, random sun."""
    rng = np.random.default_rng(seed)
    towards = tuple(towards_of(rng, 0.4, 1.4))
    things = [
        thing("ball", 2, sphere(0.5, 4), curve(seed, (-0.9, 4.5, 0.0), 0.3, 0.4)),
        thing("box", 3, cube(0.4), curve(seed + 1, (0.8, 4.0, -0.1), 0.3, 0.5)),
        thing("sheet", 4, quad(0.5, 0.4), curve(seed + 2, (0.1, 3.6, 0.6), 0.2, 0.6), Material(both_sides=True)),
        thing("standing", 5, cube(0.3), still((0.1, 5.5, -0.7))),
    ]
    eye = curve(seed + 3, (0, 0, 1.0), 0.2, 0.05, DOWN) if camera else still((0, 0, 1.0), DOWN)
    light = Light(towards, 1.0, 0.2, shadows=shadows, shadow_size=1024, lamps=lamps)
    return scene([floor(), *things], rig(96, 72, 90.0, eye), light)


def errors(gl, world, t):
    """(share of wrong pixels: dark where the reference is lit, lit where it is dark), off silhouettes and shadow
    edges."""
    ref = reference.render(world, t)
    seen = drawn(gl, world, t)
    lit = reference.render(replace(world, light=replace(world.light, shadows="off")), t).luminance
    dark = ref.luminance < lit - 1e-6
    edge = reference.silhouette_band(2 * ref.instance + dark, ref.depth, width=2)
    graded = ref.hit & ~edge & (lit > 0.25)  # sky alone: no sun there
    wrong = np.abs(seen - ref.luminance) > 0.1 * (lit - 0.2)
    return (wrong & graded & ~dark).sum() / graded.sum(), (wrong & graded & dark).sum() / graded.sum()


def test_nothing_shadows_itself_and_nothing_floats(gl):
    """Random suns, poses and views, against rays cast in float64: acne would be dark pixels that should be lit, a
    shadow that begins too far from what throws it lit ones that should be dark."""
    found = np.array([errors(gl, moving_world(seed), SECOND // 3) for seed in range(12)])
    assert found.mean() < 2e-3 and found.max() < 0.02, found


def test_soft_shadows_are_a_mean_over_the_sun(gl):
    """A box over the floor and a wide sun: the penumbra is that of the reference's 64 suns."""
    world = sunlit(thing("box", 2, cube(0.5), still((0.2, 4.0, 0.6))), shadows="soft", size=512, sun_size=0.12)
    ref, on, _ = ground_points(world)
    hard = drawn(gl, replace(world, light=replace(world.light, shadows="hard")))[on]
    seen, true = drawn(gl, world)[on], ref.luminance[on]
    half = (true > 0.05 * SLANT[2]) & (true < 0.95 * SLANT[2])
    assert half.sum() > 100
    assert np.abs(seen - true)[half].mean() < 0.12 < np.abs(hard - true)[half].mean()
    assert np.abs(seen - true).mean() < 0.01


@pytest.mark.parametrize("crowd", [False, True])
def test_each_camera_of_a_rig_has_the_shadows_that_it_sees(gl, crowd):
    """Two that look at different things share the map where it holds what both see, and get what they get alone."""
    movers = [thing(f"ball {x}", 3, sphere(0.3), drift((x - 0.1, 4, 0.3), (x, 4, 0.3))) for x in (-4.0, 0.0, 4.0)]
    stays = [] if crowd else [thing("wall", 4, cube(2.0), still((0, 30, 0)))]
    one = sunlit(*movers, *stays)
    apart = [replace(one, rig=replace(one.rig, path=still((x, 0, 1.0), DOWN))) for x in (-4.0, 0.0, 4.0)]
    alone = [drawn(gl, world, SECOND // 2) for world in apart]
    bare = drawn(gl, replace(apart[2], light=replace(one.light, shadows="off")), SECOND // 2)
    assert (alone[2] != bare).sum() > 20
    with ExitStack() as stack:
        renderers: list[Renderer] = []
        for world in apart:
            beside = renderers[0] if renderers else None
            renderers.append(stack.enter_context(Renderer(gl, world, PLAIN, beside=beside)))
        for k in (0, 1, 2, 1, 0):
            np.testing.assert_array_equal(renderers[k].luminance(SECOND // 2).read(), alone[k], err_msg=str(k))


def test_a_still_camera_sees_shadows_move(gl):
    """What is lit by a lamp behind something that moves is drawn again, too."""
    world = moving_world(3, camera=False)
    with Renderer(gl, world, PLAIN) as renderer, Renderer(gl, world, PLAIN, whole=True) as whole:
        for t in (0, SECOND // 4, SECOND // 2):
            np.testing.assert_array_equal(renderer.luminance(t).read(), whole.luminance(t).read())


def test_the_shadow_of_a_lamp_that_moves_over_a_still_scene_is_drawn_anew(gl):
    path = drift((-2, 3, 3), (2, 3, 3), Rotation.from_matrix(lamp_pose((0, 0, 0), (0.1, 0.3, -1.0))[:3, :3]))
    lamps = (Lamp("spot", (8.0, 8.0, 8.0), path),)
    world = sunlit(thing("box", 2, cube(0.5), still((0.2, 4.0, 0.6))), lamps=lamps, size=256)
    with Renderer(gl, world, PLAIN) as renderer:
        seen = [renderer.luminance(t).read().copy() for t in (0, SECOND)]
    np.testing.assert_array_equal(seen[1], drawn(gl, world, SECOND))
    assert np.abs(seen[1] - seen[0]).max() > 0.05


def test_who_casts(gl):
    """Objects and walls; not the ground, the sky, nor what is unlit."""
    for category, unlit, casts in (
        ("object", False, True),
        ("wall", False, True),
        ("object", True, False),
        ("sky", False, False),
    ):
        body = SceneObject("box", 2, (Part(cube(0.5), Material(unlit=unlit)),), still((0.2, 4.0, 0.6)), category)
        world = sunlit(body)
        with Renderer(gl, world, PLAIN) as renderer:
            assert bool(shadow_maps(world, renderer.items)) == casts
            assert isinstance(renderer.luminance(0).read(), np.ndarray)


def test_no_more_than_four_lamps_cast(gl):
    lamps = tuple(Lamp("spot", (2.0, 2.0, 2.0), StaticPath(lamp_pose((k - 2, 3, 3), (0.1, 0.3, -1)))) for k in range(5))
    world = sunlit(thing("box", 2, cube(0.5), still((0.2, 4.0, 0.6))), lamps=lamps, size=256)
    ref, seen = reference.render(world, 0), drawn(gl, world)
    with Renderer(gl, world, PLAIN) as renderer:
        assert [m.lamp.kind for m in shadow_maps(world, renderer.items)] == ["sun", "spot", "spot", "spot"]
    off = ref.hit & ~reference.silhouette_band(ref.instance, ref.depth)
    assert np.median(np.abs(seen - ref.luminance)[off]) < 1e-5


def test_the_rate_keeps_to_what_is_lit(gl):
    """dL/dt of a surface in the shadow is that of its other light; the shadow's own motion is not in it."""
    roof = thing("roof", 2, quad(3, 3), still((0, 4, 2)), Material(both_sides=True))
    turn = Rotation.from_rotvec([0, 0.4, 0])
    world = sunlit(roof, thing("ball", 3, sphere(0.4), drift((0, 4, 0), (0, 4, 0.2), None, turn)), sky=0.3)
    dark = replace(world, light=replace(world.light, sun=0.0, shadows="off"))
    with Renderer(gl, world, PLAIN, whole=True) as renderer, Renderer(gl, dark, PLAIN, whole=True) as other:
        mine, theirs = (r.brightness(SECOND // 2).read()[..., 1] for r in (renderer, other))
    ref = reference.render(world, SECOND // 2)
    inside = (ref.instance == 3) & ~reference.silhouette_band(ref.instance, ref.depth, width=2)
    assert inside.sum() > 100
    np.testing.assert_allclose(mine[inside], theirs[inside], atol=1e-5)


@pytest.mark.parametrize("frames", [4, pytest.param(200, marks=pytest.mark.slow)])
def test_faults_over_random_frames(gl, frames):
    """Counted against rays cast in float64."""
    rng = np.random.default_rng(0)
    graded, acne, floating = np.array([faults(gl, random_frame(rng, 1024)) for _ in range(frames)]).T
    assert graded.min() > 1000
    assert acne.sum() <= 1e-4 * graded.sum() and floating.sum() <= 1e-4 * graded.sum()
    assert (acne / graded).max() < 2.5e-3 and (floating / graded).max() < 2.5e-3  # the worst of 200 has 0.23 %


@pytest.mark.parametrize("shadows", ["hard", "soft"])
@pytest.mark.parametrize("kind", ["sun", "spot"])
def test_no_light_along_the_line_where_something_stands(gl, kind, shadows):
    """Boxes on the ground, a stack, a plate 2 cm thick, something as small as a foot."""
    rng = np.random.default_rng(5)
    blocked, lit = np.sum([leaks(gl, contact_frame(rng, kind, shadows)) for _ in range(3)], axis=0)
    assert blocked > 600
    assert lit <= 1e-3 * blocked


def test_what_few_triangles_make_round_is_not_in_its_own_shadow(gl):
    """The facets are steeper to the light than the normals that are smoothed over them."""
    rng = np.random.default_rng(0)
    graded, acne, _ = np.sum([faults(gl, coarse_frame(rng, 1024)) for _ in range(12)], axis=0)
    assert graded > 20_000
    assert acne <= 1e-4 * graded
