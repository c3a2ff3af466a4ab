"""bench_lod: what its renderers draw."""

from __future__ import annotations

import numpy as np

from blinkgl.config.sequence import RenderConfig, load_run
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import build_scene
from blinkgl.tools.bench_lod import Everything


def test_without_culling_every_triangle_is_drawn_and_the_picture_is_the_same(gl, config):
    one = load_run(config).sequence(0)
    world = build_scene(one.scene, one.camera, one.time.t0_ns, one.time.t1_ns, seed=one.seed)
    late = one.time.t1_ns  # the pane is behind the camera
    plain = RenderConfig(antialiasing="none")
    with Renderer(gl, world, plain, whole=True) as culled, Everything(gl, world, plain, whole=True) as whole:
        np.testing.assert_array_equal(whole.luminance(late).read(), culled.luminance(late).read())
        assert whole.stats.triangles == whole.triangles > culled.stats.triangles
