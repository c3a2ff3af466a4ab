"""The first look at a scene: what it says grows with the step, and with what the pixel leaves out."""

from __future__ import annotations

import numpy as np

from blinkgl.config.sequence import RenderConfig
from blinkgl.tools.first_look import first_look
from render_scenes import cube, mixed_scene, scene, still, thing


def test_steps_and_pixels(gl):
    world = mixed_scene(80, 60)
    look = lambda name, px=1.0: first_look(gl, world, RenderConfig(antialiasing=name), 0.5, px)
    edges, further, none = look("edges"), look("edges", 2.0), look("none")
    assert further.pixel == edges.pixel and further.step > 1.4 * edges.step > 0
    assert none.pixel > 1.5 * edges.pixel


def test_nothing_moves(gl):
    world = scene([thing("box", 1, cube(0.5), still((0, 4, 0)))])
    assert np.isnan(first_look(gl, world, RenderConfig(), 0.1)).all()
