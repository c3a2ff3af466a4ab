"""quality: auto: a first look at a sequence says what it would say if it looked closely, and changes nothing but the
step."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml

from blinkgl.config.run import load_run
from blinkgl.config.sequence import RenderConfig
from blinkgl.dataset.generate import generate_run
from blinkgl.events import Events, emulator_of
from blinkgl.events.camera import EventCamera, EventFrame, emulate
from blinkgl.events.grids import masked, voxel_grid
from blinkgl.render.cutouts import lattice, mask_of
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.sequence import EventChunk, simulate_sequence
from blinkgl.sequence.first_look import BINS, FINER, LEAST_EVENTS, TILES, TRUE, WORTH, Look, first_look
from blinkgl.sequence.request import SequenceRequest
from test_simulate_sequence import SMALL, assert_same

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


@pytest.mark.parametrize("name", ["tiny_textures", "dense_texture"])
def test_equals_slow_twin(gl, name):
    """Whole pictures, drawn one by one, at one instant."""
    config, base = clip(name, "camera.width=96", "camera.height=72")
    scene = sequence_scene(config, 0, base)
    span, pace = (0, 40_000_000), 400.0
    noiseless = emulator_of(config.events).noiseless(config.events)
    tiles = lattice(96, 72, *TILES)
    assert len(tiles) == 4
    mask = mask_of(tiles, 72, 96)
    middles = (span[1] * k // 6 for k in (1, 3, 5))
    error, twice, norm, count = 0.0, 0.0, 0.0, 0
    finer = scene.with_camera(scene.camera.resized(FINER * 96, FINER * 72))
    with Renderer(gl, scene, config.render) as plain, Renderer(gl, finer, TRUE) as fine:
        found = first_look(plain, scene, config.timeline, config.events, span, lambda t_ns: pace)

        def grid(times, pictures):
            sensor = EventCamera(noiseless, None, 72, 96, 1)
            chunks = [c for _, c in emulate([EventFrame(t, p) for t, p in zip(times, pictures)], sensor)]
            events = masked(Events.concatenate(chunks), mask)
            return voxel_grid(events, first // 1000, last // 1000 + 1, 72, 96, BINS).astype(float), len(events)

        for middle in middles:
            times = [middle + k * round(0.5e9 / pace) for k in range(-4, 5)]
            first, last = times[0], times[-1]
            blocks = [
                fine.luminance(t).read().reshape(72, FINER, 96, FINER).mean(axis=(1, 3), dtype=np.float64)
                for t in times
            ]
            true, n = grid(times, [np.float32(b) for b in blocks])
            mine = [plain.luminance(t).read() for t in times]
            error += ((grid(times[::2], mine[::2])[0] - true) ** 2).sum()
            twice += ((grid(times[::4], mine[::4])[0] - true) ** 2).sum()
            norm, count = norm + (true**2).sum(), count + n
    assert count > 300 and found.events == pytest.approx(count, rel=0.02)
    assert found.error == pytest.approx(np.sqrt(error / norm), rel=0.03)
    assert found.error_of_twice == pytest.approx(np.sqrt(twice / norm), rel=0.03)


@pytest.mark.parametrize("name", ["tiny_textures", "photographs"])
def test_events_are_those_of_the_step_that_it_chose(gl, name):
    small = ("camera.width=96", "camera.height=72", "time.duration=0.06")
    config, base = clip(name, *small)

    def events_of(config):
        with simulate_sequence(SequenceRequest(config, 0, base=base, labels=False), gl) as sequence:
            chunks = [item.events for item in sequence if isinstance(item, EventChunk)]
            return Events.concatenate(chunks), sequence.timeline.config.max_px

    looked, max_px = events_of(config)
    plain = config.timeline.model_copy(update={"first_look": False, "max_px": max_px})
    assert_same(looked, events_of(config.model_copy(update={"timeline": plain}))[0])


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


def test_it_is_recorded(tmp_path):
    slow = {
        "timeline": {"max_step_us": 1e6},
        "time": {"duration": 1.0, "label_rate": 10},
    }  # what moves in a small picture
    tree = {**SMALL, **slow, "quality": "auto", "output": {"sequences": 1}}
    (tmp_path / "run.yaml").write_text(yaml.safe_dump(tree))
    list(generate_run(load_run(tmp_path / "run.yaml"), tmp_path / "out"))
    (manifest,) = (tmp_path / "out").rglob("manifest.json")
    timeline = json.loads(manifest.read_text())["timeline"]
    assert timeline["kind"] == "displacement" and timeline["max_px"] == (
        2.0 if timeline["first_look"]["twice"] else 1.0
    )
    assert timeline["first_look"]["events"] > 0


def test_true_pictures_are_the_filtered_ones():
    assert RenderConfig(antialiasing="edges", mip_bias=-1.0) == TRUE
