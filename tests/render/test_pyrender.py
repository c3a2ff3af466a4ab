"""An independent rasteriser, pyrender, draws the same scenes: depth, ids and unlit colour agree.

It runs in a process of its own (two OpenGL bindings do not share one). Needs the extra [check]; skipped without it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import pyrender_peer
from blinkgl.config.sequence import RenderConfig
from blinkgl.labels import LabelRequest
from blinkgl.render import reference
from blinkgl.render.renderer import Renderer
from render_scenes import mixed_scene

if pyrender_peer.available():
    pytest.skip(pyrender_peer.available(), allow_module_level=True)

TIMES = [300_000_000, 650_000_000]
NEAR = 1.5  # in front of everything: pyrender's 24-bit depth is then good to 2^-24 Z / near


def byte_textures(world):
    """The same scene with linear textures of whole 255ths, which pyrender can hold exactly."""

    def whole(part):
        texture = part.material.texture
        if texture is None:
            return part
        image = (np.rint(texture.image * 255) / 255).astype(np.float32)
        return replace(part, material=replace(part.material, texture=replace(texture, image=image)))

    return replace(world, objects=tuple(replace(o, parts=tuple(map(whole, o.parts))) for o in world.objects))


@pytest.fixture(scope="module")
def world():
    return byte_textures(mixed_scene(unlit=True))


@pytest.fixture(scope="module")
def peer(world):
    return pyrender_peer.render(world, TIMES, near=NEAR)


@pytest.mark.parametrize("moment", [0, 1])
def test_depth_ids_and_colour_agree(gl, world, peer, moment):
    t = TIMES[moment]
    true = reference.render(world, t)
    with Renderer(gl, world, RenderConfig(image_antialiasing="none")) as renderer:
        ours = renderer.labels(t, LabelRequest("images", "depth", "ids"))
    assert true.depth.min() > NEAR
    band = reference.silhouette_band(true.instance, true.depth)
    assert band.mean() < 0.15 and len(np.unique(true.instance)) == 5

    ids = peer["ids"][moment]
    np.testing.assert_array_equal(ids[~band], ours.ids[~band])
    assert (ids != ours.ids).sum() <= 0.02 * band.sum()  # silhouettes, pixel by pixel
    for depth in (ours.depth, true.depth):
        relative = np.abs(peer["depth"][moment].astype(np.float64) / depth - 1)[~band]
        assert np.median(relative) < 1e-6 and relative.max() < 1e-5

    # pyrender filters 8-bit texels and 8-bit mip levels in 8-bit arithmetic: a few units in the last place, no bias
    error = (peer["colour"][moment] - 255.0 * ours.colour)[~band]
    assert np.abs(error).max() < 4.0 and np.quantile(np.abs(error), 0.99) < 2.0
    assert np.abs(error.mean(axis=0)).max() < 0.3


def test_failure_is_one_line(world, monkeypatch):
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")
    monkeypatch.setenv("EGL_DEVICE_ID", "999")
    with pytest.raises(RuntimeError, match="pyrender failed: .*[Dd]evice") as error:
        pyrender_peer.render(world, [0])
    assert "\n" not in str(error.value)
