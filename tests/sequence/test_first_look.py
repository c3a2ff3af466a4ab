"""quality: auto: a first look at a sequence says what it would say if it looked closely, and changes nothing but the
step."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from blinkgl.config.run import load_run
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.sequence import simulate_sequence
from blinkgl.sequence.first_look import LEAST_EVENTS, WORTH, Look, first_look
from blinkgl.sequence.request import SequenceRequest

CLIPS = Path(__file__).parents[2] / "configs" / "trade"


def clip(name: str, *overrides: str):
    template = load_run(CLIPS / f"{name}.yaml", ["quality=auto", *overrides])
    return template.sequence(0), template.base


def look_at(gl, name: str, *overrides: str) -> dict:
    config, base = clip(name, *overrides)
    with simulate_sequence(SequenceRequest(config, 0, base=base, labels=False), gl) as sequence:
        return {**sequence.timeline.info(), "used": sequence.timeline.config.max_px}


def test_steps_are_longer_where_that_costs_little(gl):
    """Where the suite, which measured everything, says so: 2 px are 1.09 times as wrong as 1 px in tiny_textures, 1.51
    times in photographs (docs/trade.md)."""
    soft, grainy = look_at(gl, "tiny_textures"), look_at(gl, "photographs")
    assert (soft["max_px"], soft["used"], soft["first_look"]["twice"]) == (2.0, 2.0, True)
    assert (grainy["max_px"], grainy["used"], grainy["first_look"]["twice"]) == (1.0, 1.0, False)
    assert soft == look_at(gl, "tiny_textures"), "the same look again"
    finer = look_at(gl, "tiny_textures", "timeline.max_px=0.25")
    assert finer["used"] == 0.5 and finer["first_look"] != soft["first_look"]


def test_there_is_nothing_to_tell_by(gl):
    """Nothing moves, or nothing lasts: the step stays as it is."""
    config, base = clip("tiny_textures", "camera.width=96", "camera.height=72")
    scene = sequence_scene(config, 0, base)
    with Renderer(gl, scene, config.render) as renderer:
        look = partial(first_look, renderer, scene, config.timeline, config.events)
        for unseen in (look((0, 10_000_000), lambda t_ns: 0.0), look((0, 1_000_000), lambda t_ns: 400.0)):
            assert unseen.events == 0 and np.isnan(unseen.error) and not unseen.twice
            assert unseen.facts() == {"events": 0, "error": None, "error_of_twice": None, "twice": False}
    assert Look(0.5, 0.5 * WORTH, LEAST_EVENTS).twice
    assert not Look(0.5, 0.5 * WORTH, LEAST_EVENTS - 1).twice and not Look(0.5, 0.501 * WORTH, LEAST_EVENTS).twice
