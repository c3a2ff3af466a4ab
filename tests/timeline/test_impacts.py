"""Adaptive steps over an impact: no step goes over it, and its events are those of a dense fixed rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from blinkgl.config.sequence import SequenceConfig
from blinkgl.events import Events
from blinkgl.scene.build import sequence_scene
from blinkgl.sequence import simulate_sequence
from blinkgl.sequence.request import SequenceRequest
from blinkgl.timeline import bounded_times
from blinkgl.tools.trade.matching import match_events
from tests.timeline.paces import Formula

MS = 1_000_000
WIDTH, HEIGHT = 48, 36
BASE = {
    "camera": {"width": WIDTH, "height": HEIGHT, "fov": 40},
    "time": {"duration": 0.3, "label_rate": 10},
    "events": {"emulator": "esim", "contrast_threshold": 0.15, "threshold_sigma": 0.0},
    "scene": {
        "kind": "explicit",
        "physics": {},
        "meshes": {
            "ball": {"primitive": "icosphere", "parameters": {"radius": 0.15}},
            "floor": {"primitive": "grid", "parameters": {"width": 8, "depth": 8}},
        },
        "materials": {
            "a": {"procedural": "fbm", "max_size": 64},
            "b": {"procedural": "checks", "uv_scale": [8, 8], "max_size": 64},
        },
        "objects": [
            {"mesh": "floor", "material": "b", "category": "ground"},
            {
                "mesh": "ball",
                "material": "a",
                "position": [1.5, 0, 0.5],
                "physics": {"restitution": 0.8, "spin": [0, 200, 100]},
            },
        ],
        "camera": {"position": [0, 0, 0.35], "look_at": [1.5, 0, 0.25]},
    },
}


STEADY = Formula(lambda t: 200.0, 1.0)


def configuration(**timeline):
    return SequenceConfig.model_validate({**BASE, "timeline": timeline})


@pytest.fixture(scope="module")
def falling():
    pytest.importorskip("mujoco")
    scene = sequence_scene(configuration(kind="uniform", fps=100), 0)
    return scene, replace(scene, dynamics=replace(scene.dynamics, impacts_ns=()))


def events_at_the_impact(gl, scene, at, **timeline):
    with simulate_sequence(
        SequenceRequest(
            configuration(**timeline), 0, scene=scene, labels=False, window_ns=(at - 12 * MS, at + 12 * MS)
        ),
        gl,
    ) as sequence:
        return Events.concatenate([chunk.events for chunk in sequence])


def test_events_at_an_impact_are_those_of_a_dense_fixed_rate(gl, falling):
    scene, blind = falling
    (at,) = scene.dynamics.impacts_ns
    dense = events_at_the_impact(gl, scene, at, kind="uniform", fps=20_000)
    assert len(dense) > 500

    def judged(world, max_px):
        found = events_at_the_impact(gl, world, at, kind="displacement", max_px=max_px)
        matching = match_events(dense, found, HEIGHT, WIDTH, 3000)
        return 1 - matching.matched.mean(), np.abs(matching.dt_us[matching.matched]).mean(), len(found) / len(dense)

    coarse, over_it, fine = judged(scene, 1.0), judged(blind, 1.0), judged(scene, 0.05)
    assert fine[0] < 0.03 and fine[1] < 150 and fine[2] == pytest.approx(1, abs=0.03)
    # A step that ends at the impact is better than one over it, which the bound over the whole step has to find.
    assert coarse[0] < 0.85 * over_it[0] and over_it[0] < 0.3


def test_no_step_goes_over_a_stop():
    stops = [10 * MS + 7, 10 * MS + 8, 33 * MS, 99 * MS + 999_999]
    times = np.array(list(bounded_times(STEADY, MS, 20 * MS, 0, 100 * MS, stops)))
    assert {10 * MS + 7, 33 * MS} <= set(times.tolist())
    # One a nanosecond after another, and one just before the end, would make frames of nothing.
    assert 10 * MS + 8 not in times and times[-1] == 100 * MS and stops[3] not in times
    assert (np.diff(times) > 0).all() and np.diff(times).max() <= 5 * MS
    np.testing.assert_array_equal(
        list(bounded_times(STEADY, MS, 20 * MS, 0, 100 * MS)),
        list(bounded_times(STEADY, MS, 20 * MS, 0, 100 * MS, [])),
    )


def test_frames_are_drawn_at_impacts(gl, falling):
    scene, _ = falling
    (at,) = scene.dynamics.impacts_ns
    config = configuration(kind="displacement", max_px=2.0)
    with simulate_sequence(SequenceRequest(config, 0, scene=scene, labels=False), gl) as sequence:
        assert at in [chunk.t_ns for chunk in sequence]
