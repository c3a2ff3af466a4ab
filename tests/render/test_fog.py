"""Fog in pictures, event frames and their rates of change, against its closed form and against clear air."""

from dataclasses import replace

import numpy as np
import pytest

import blinkgl
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import ConfigError
from blinkgl.labels import LabelRequest
from blinkgl.render import casting
from blinkgl.render.colour import LUMA
from blinkgl.render.renderer import Renderer
from blinkgl.scene.types import Fog, Material
from blinkgl.tools.shader_debugger import appearance
from tests.render.render_scenes import LEVEL, SECOND, cube, curve, drift, rig, scene, smooth_texture, sphere, thing

PLAIN = RenderConfig(image_antialiasing="none")
FOG = Fog(0.12, 0.7)


def world(fog=FOG, path=None):
    """Lit, textured, unlit and plain things that move, before a background."""
    things = [
        thing("box", 1, cube(0.8), curve(1, (-1, 5, 0), 0.3, 0.6), Material(smooth_texture(1))),
        thing("ball", 2, sphere(0.9), curve(2, (1.2, 7, 0.4), 0.3, 0.6), Material(base_color=(0.9, 0.3, 0.2))),
        thing("lamp", 3, cube(0.5), curve(3, (0.4, 4, -0.9), 0.4, 0.2), Material(None, (0.6, 0.8, 0.9), unlit=True)),
    ]
    path = path or drift((0, 0, 0), (0.3, 0.9, 0.1), LEVEL, LEVEL)
    return replace(scene(things, rig(96, 72, 80.0, path), background=0.25), fog=fog)


def distances(renderer, t_ns):
    """(H, W) from the camera's centre, inf where nothing is hit."""
    depth = renderer.labels(t_ns, LabelRequest("depth")).depth.astype(np.float64)
    y, x = np.mgrid[: renderer.height, : renderer.width]
    rays = renderer.scene.camera.rays(np.stack([x, y], axis=-1))
    return depth * np.linalg.norm(rays, axis=-1)


@pytest.mark.parametrize("fog", [FOG, Fog(2.0, 0.3), Fog(1e-4, 5.0)])
def test_fog_is_its_closed_form_in_pictures_and_event_frames(gl, fog):
    t = SECOND // 3
    with Renderer(gl, world(None), PLAIN) as clear, Renderer(gl, world(fog), PLAIN) as foggy:
        d = distances(clear, t)
        hit, T = np.isfinite(d), np.exp(-fog.density * d)
        colour, luminance = clear.colour(t).read(), clear.luminance(t).read()
        expected = np.where(hit[..., None], colour * T[..., None] + fog.radiance * (1 - T[..., None]), fog.radiance)
        np.testing.assert_allclose(foggy.colour(t).read(), expected, atol=3e-6 * max(1, fog.radiance))
        expected = np.where(hit, luminance * T + fog.radiance * (1 - T), fog.radiance)
        np.testing.assert_allclose(foggy.luminance(t).read(), expected, atol=3e-6 * max(1, fog.radiance))
        assert 0.2 < hit.mean() < 0.9
        seen = foggy.colour(t).read() @ LUMA
        np.testing.assert_allclose(foggy.luminance(t).read(), seen, atol=2e-4)


def test_the_reference_sees_the_same_fog(gl):
    t, where = SECOND // 2, world()
    with Renderer(gl, where, PLAIN) as renderer:
        drawn, parts = renderer.colour(t).read(), renderer.scene
    hits = casting.cast(parts, t)
    true = appearance.surface(parts, hits).colour.reshape(drawn.shape)
    assert np.median(np.abs(drawn - true)) < 1e-3 and (np.abs(drawn - true).max(axis=2) < 0.02).mean() > 0.95


@pytest.mark.parametrize("path", [None, drift((0, 0, 0), (0, 0, 0), LEVEL, LEVEL)], ids=["moving", "still camera"])
def test_the_rate_of_change_is_that_of_the_frames(gl, path):
    """dL/dt of the shader against the difference of two frames 20 us apart, where no edge passes: of textured, lit and
    plain surfaces alike, which come nearer and slide by."""
    t, half = SECOND // 2, 10_000
    foggy, plain = world(Fog(0.25, 0.9), path), world(None, path)
    with Renderer(gl, foggy, PLAIN) as renderer, Renderer(gl, plain, PLAIN) as clear:
        rate, without = (r.brightness(t).read()[..., 1].astype(np.float64) for r in (renderer, clear))
        before, after = (renderer.luminance(t + s * half).read().astype(np.float64) for s in (-1, 1))
        d = [distances(clear, t + s * half) for s in (-1, 0, 1)]
    true = (after - before) / (2e-9 * half)
    inside = np.isfinite(d).all(axis=0)
    inside &= np.abs(np.where(inside, d[2], 0) - np.where(inside, d[0], 0)) < 1e-3
    assert inside.mean() > 0.15
    error = np.abs(rate - true)[inside]
    # float32 frames differ by 6e-8 / 20 us = 3e-3 per second
    assert np.median(error) < 0.01 and np.percentile(error, 95) < 0.08, (np.median(error), np.percentile(error, 95))
    assert np.median(np.abs(without - true)[inside]) > 4 * np.median(error), "without the fog's own term it is another"
    assert (rate[~np.isfinite(d[1])] == 0).all(), "fog without end does not change"


def test_fog_from_python():
    there = blinkgl.Scene(blinkgl.Camera(32, 24), fog=(0.5, 0.25)) + blinkgl.Primitive(
        "cuboid", pose=blinkgl.Pose((3, 0, 0))
    )
    clear = blinkgl.Scene(blinkgl.Camera(32, 24)) + blinkgl.Primitive("cuboid", pose=blinkgl.Pose((3, 0, 0)))
    foggy, plain = (blinkgl.render_frame(one, 0.1).colour for one in (there, clear))
    assert (foggy[0, 0] == 0.25).all() and not np.array_equal(foggy, plain)
    for wrong in ((1.0,), 3.0, (0.0, 1.0), ("a", 1)):
        with pytest.raises(ConfigError):
            blinkgl.Scene(blinkgl.Camera(32, 24), fog=wrong) + blinkgl.Primitive("cuboid")
