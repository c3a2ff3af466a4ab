"""An independent rasteriser, pyrender 0.1.45, drew the same scene: depth, ids and unlit colour agree.

``golden/pyrender.npz`` holds what it made of the scene below: colour (2, H, W, 3) uint8 linear * 255, depth (2, H, W)
float32, ids (2, H, W) uint8. It was made once, by commit a598621f, which could run pyrender:
``pyrender_peer.render(byte_textures(mixed_scene(unlit=True)), TIMES, near=NEAR)`` in tests/render.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from blinkgl.config.sequence import RenderConfig
from blinkgl.labels import LabelRequest
from blinkgl.render import reference
from blinkgl.render.renderer import Renderer
from render_scenes import mixed_scene

TIMES = [300_000_000, 650_000_000]
NEAR = 1.5  # in front of everything: pyrender's 24-bit depth is then good to 2^-24 Z / near
PEER = np.load(Path(__file__).parents[1] / "golden" / "pyrender.npz")


def byte_textures(world):
    """The same scene with linear textures of whole 255ths, which pyrender can hold exactly."""

    def whole(part):
        texture = part.material.texture
        if texture is None:
            return part
        image = (np.rint(texture.image * 255) / 255).astype(np.float32)
        return replace(part, material=replace(part.material, texture=replace(texture, image=image)))

    return replace(world, objects=tuple(replace(o, parts=tuple(map(whole, o.parts))) for o in world.objects))


@pytest.mark.parametrize("moment", [0, 1])
def test_depth_ids_and_colour_agree(gl, moment):
    world, t = byte_textures(mixed_scene(unlit=True)), TIMES[moment]
    true = reference.render(world, t)
    with Renderer(gl, world, RenderConfig(image_antialiasing="none")) as renderer:
        ours = renderer.labels(t, LabelRequest("images", "depth", "ids"))
    assert true.depth.min() > NEAR
    band = reference.silhouette_band(true.instance, true.depth)
    assert band.mean() < 0.15 and len(np.unique(true.instance)) == 5

    ids = PEER["ids"][moment]
    np.testing.assert_array_equal(ids[~band], ours.ids[~band])
    assert (ids != ours.ids).sum() <= 0.02 * band.sum()  # silhouettes, pixel by pixel
    for depth in (ours.depth, true.depth):
        relative = np.abs(PEER["depth"][moment].astype(np.float64) / depth - 1)[~band]
        assert np.median(relative) < 1e-6 and relative.max() < 1e-5

    # pyrender filters 8-bit texels and 8-bit mip levels in 8-bit arithmetic: a few units in the last place, no bias
    error = (PEER["colour"][moment] - 255.0 * ours.colour)[~band]
    assert np.abs(error).max() < 4.0 and np.quantile(np.abs(error), 0.99) < 2.0
    assert np.abs(error.mean(axis=0)).max() < 0.3
