"""Where shadows can fall: nothing is left out, and what is left alone is drawn without looking into a map."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.config.sequence import RenderConfig
from blinkgl.render import umbras
from blinkgl.render.passes import shadow
from blinkgl.render.passes.shadow import shadow_maps
from blinkgl.render.rectangles import Rectangle
from blinkgl.render.renderer import Renderer
from blinkgl.scene.geometry.primitives import torus
from blinkgl.scene.lights import lamp_pose
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.motion.trajectories import look_rotation
from blinkgl.scene.types import Lamp, Light, Material, Part, SceneObject
from render_scenes import cube, quad, rig, scene, sphere, still, thing

PLAIN = RenderConfig(image_antialiasing="none")


def crowd(seed, shadows="hard", spot=False):
    """Bodies of many kinds, close together, over a floor and before a wall, seen from among them."""
    rng = np.random.default_rng(seed)

    def body(number, mesh, **paint):
        place = still(rng.uniform((-1.5, 2.0, -0.4), (1.5, 5.5, 1.2)), Rotation.random(rng=rng))
        return thing(f"{number}", number, mesh, place, Material(**paint))

    bodies = [
        body(2, sphere(0.4, 3)),
        body(3, cube(rng.uniform(0.2, 0.7))),
        body(4, torus(radius=0.4, tube=0.12)),
        body(5, quad(0.8, 0.5), double_sided=True),
        body(6, cube(0.3), double_sided=True),
        body(7, sphere(0.1, 2)),
    ]
    floor = SceneObject("ground", 1, (Part(quad(12, 12), Material()),), still((0, 5, -1)), "ground")
    wall = SceneObject(
        "wall", 8, (Part(quad(8, 4), Material()),), still((0, 7, 1), Rotation.from_rotvec([math.pi / 2, 0, 0])), "wall"
    )
    elevation, azimuth = rng.uniform(0.2, 1.5), rng.uniform(-math.pi, math.pi)
    flat = math.cos(elevation)
    towards = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
    target, eye = np.array([*rng.uniform(-0.5, 0.5, 2), 0.0]) + [0, 4, 0], rng.uniform((-1, -0.5, 0), (1, 2, 1.5))
    view = rig(96, 72, 80.0, still(eye, Rotation.from_matrix(look_rotation(target - eye))))
    light = Light(tuple(towards), 1.0, 0.2, shadows=shadows, shadow_size=256, sun_size=0.1)
    if spot:
        place = target + rng.uniform(1.5, 4) * towards
        lamp = Lamp("spot", (6.0,) * 3, StaticPath(lamp_pose(place, target - place)), inner=0.5, outer=0.7, size=0.2)
        light = replace(light, sun=0.0, lamps=(lamp,))
    return scene([floor, wall, *bodies], view, light)


def everywhere(moment, *args):
    """In the place of :func:`umbra`: all of it."""
    found = umbras.umbra(moment, *args)
    whole = Rectangle(0, 0, moment.view.camera.width, moment.view.camera.height)
    everyone = frozenset(np.flatnonzero(moment.stage.solids.casts).tolist())
    return found._replace(throws=everyone, places={number: [whole] for number in found.boxes})


def both(gl, world, monkeypatch):
    """The event frame as it is drawn, and with every surface looking into every map; unshadowed; where they fall."""
    with Renderer(gl, world, PLAIN) as renderer:
        seen = renderer.luminance(0).read()
        places = [one.umbra(renderer.moment(0)).places for one in shadow_maps(world, renderer.items)]
    with monkeypatch.context() as patch, Renderer(gl, world, PLAIN) as renderer:
        patch.setattr(shadow, "umbra", everywhere)
        full = renderer.luminance(0).read()
    with Renderer(gl, replace(world, light=replace(world.light, shadows="off")), PLAIN) as renderer:
        return seen, full, renderer.luminance(0).read(), places


@pytest.mark.parametrize("kind", ["hard", "soft", "spot"])
def test_no_shadow_is_left_out(gl, monkeypatch, kind):
    """Splitting a surface by rectangles changes the last bits at most: the light comes out of another program. (What
    light grazes is in its own shadow a little when it looks into the map, and is not when it does not.)"""
    monkeypatch.setattr(umbras, "DRAW", 30)  # as if drawing were cheap: more and smaller rectangles
    monkeypatch.setattr(shadow, "TRIANGLE", 0)
    monkeypatch.setattr(shadow, "DRAW", 0)
    dark, spared = 0.0, 0
    for seed in range(8):
        world = crowd(seed, "soft" if kind == "soft" else "hard", spot=kind == "spot")
        seen, full, open_, places = both(gl, world, monkeypatch)
        lit = open_ > 0.35  # of the sky at most 0.2
        np.testing.assert_allclose(seen[lit], full[lit], rtol=3e-6, atol=1e-6, err_msg=str(seed))
        dark += (lit & (full < 0.9 * open_)).mean() / 8
        spared += sum(number not in one for one in places for number in range(8))
    assert dark > 0.02 and spared > 0


def test_what_is_convex():
    assert umbras.is_convex(cube(0.5)) and umbras.is_convex(sphere(0.5, 3)) and umbras.is_convex(quad(1, 1))
    assert not umbras.is_convex(torus(radius=0.5, tube=0.2))


def test_a_polytope_holds_its_mesh():
    for mesh in (sphere(0.5, 3), torus(radius=0.5, tube=0.2), cube(0.3)):
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        corners = umbras.polytope(mesh, (low + high) / 2, (high - low) / 2)
        for way in np.random.default_rng(0).normal(size=(50, 3)):
            assert (corners @ way).max() >= (mesh.vertices @ way).max() - 1e-9
    ball = sphere(0.5, 3)
    assert np.linalg.norm(umbras.polytope(ball, np.zeros(3), np.full(3, 0.5)), axis=1).max() < 0.5 * 1.42
