"""What load accepts can be drawn: combinations of ends that are looked at together, and no more of them than that."""

import itertools

import numpy as np
import pytest
from scipy import stats

from blinkgl.config.base import Config, rule
from blinkgl.config.draw import corners, draw, sites
from blinkgl.config.run import RunTemplate
from blinkgl.errors import ConfigError
from tests.refusals import refusal

# Sound at all low and at all high ends, or at each single one; refused by a combination.
MIXED = [
    (
        {"timeline": {"min_step_us": {"uniform": [100, 900]}, "max_step_us": {"uniform": [500, 2000]}}},
        "timeline: min_step_us must not exceed",
    ),
    (
        {"timeline": {"min_step_us": {"log_uniform": [100, 900]}, "max_step_us": {"integer": [500, 2000]}}},
        "timeline: min_step_us must not exceed",
    ),
    (
        {"time": {"duration": {"uniform": [0.1, 1]}, "label_rate": {"uniform": [1, 10]}}},
        "time: duration * label_rate must be at least 1",
    ),
    (
        {"time": {"duration": {"uniform": [0.1, 1]}, "label_rate": {"choice": [10, {"uniform": [1, 2]}]}}},
        "time: duration * label_rate must be at least 1",
    ),
    (
        {"scene": {"sky": {"size": {"uniform": [40, 100]}}, "region": {"width": {"uniform": [20, 40]}}}},
        "scene.sky.size: must be at least 48",
    ),
    (
        {"scene": {"objects": {"size": [1, {"uniform": [2, 40]}]}, "sky": {"size": {"uniform": [50, 120]}}}},
        "scene.sky.size: must be at least 110",
    ),
    ({"events": {"weighted": {"x": 1}}}, "events: not a table"),
    (
        {
            "events": {
                "emulator": "v2e",
                "photoreceptor_noise": {"choice": [False, True]},
                "cutoff_hz": {"choice": [0, 30]},
            }
        },
        "events: photoreceptor_noise needs",
    ),
    (
        {
            "events": {
                "emulator": "v2e",
                "photoreceptor_noise": {"choice": [False, True]},
                "preset": {"choice": ["noisy", "clean"]},
            }
        },
        "events: photoreceptor_noise needs",
    ),
    ({"events": {"emulator": {"choice": ["esim", "v2e"]}, "log_eps": 1e-3}}, "events.log_eps: unknown key"),
    (
        {
            "events": {
                "choice": [
                    {"emulator": "esim"},
                    {"emulator": "v2e", "leak_rate_hz": {"choice": [1, {"uniform": [5, 2e4]}]}},
                ]
            }
        },
        "events.leak_rate_hz: too large",
    ),
    (
        {"camera": {"near": {"uniform": [0.05, 7]}, "fov": {"uniform": [10, 100]}}},
        "scene.region.height: the region is too low",
    ),
    (
        {
            "readout": {"events_per_second": {"uniform": [1e4, 1e7]}, "queue_events": {"integer": [1, 2**24]}},
            "time": {"duration": {"uniform": [1, 3000]}, "start": 0},
        },
        "time.duration: delayed events",
    ),
    (
        {"time": {"duration": {"uniform": [1000, 4000]}, "label_rate": {"uniform": [1, 300]}}},
        "time.label_rate: 1200000 labels",
    ),
    (
        {
            "quality": {"choice": ["accurate", None]},
            "timeline": {"kind": {"choice": ["displacement", "uniform"]}, "max_px": 1},
        },
        "timeline.max_px: unknown key",
    ),
    (
        {
            "sensor": {"choice": [None, {"name": "x", "width": 9, "height": 9, "readout": {"queue_events": 16384}}]},
            "readout": {"choice": [None, {"events_per_second": 1}]},
        },
        "readout.queue_events: the last event of a full queue would wait more than an hour",
    ),
    ({"scene": {"objects": {"count": {"uniform": [1, 9]}}}}, "scene.objects.count: not a whole number"),
    ({"labels": {"depth": {"uniform": [0, 1]}}}, "labels.depth: not true or false"),
    (
        {
            "scene": {
                "kind": "explicit",
                "camera": {"keyframes": [{"time": 0}, {"time": {"uniform": [1, 5]}}, {"time": {"uniform": [2, 6]}}]},
                "meshes": {"a": {"primitive": "cuboid"}},
                "objects": [{"mesh": "a"}],
            }
        },
        "scene.camera.keyframes.2.time: the key frames' times",
    ),
    (
        {
            "scene": {
                "kind": "explicit",
                "camera": {},
                "meshes": {"choice": [{"a": {"primitive": "cuboid"}}, {"b": {"primitive": "cone"}}]},
                "objects": [{"mesh": {"choice": ["a", "b"]}}],
            }
        },
        "scene.objects.0.mesh: no such name",
    ),
    (
        {"frames": {"fps": {"log_uniform": [1e-3, 30]}, "count": {"integer": [3, 100]}}},
        "frames.fps: 100 frames at this rate last",
    ),
]


@pytest.mark.parametrize("tree, message", MIXED)
def test_mixed_corners_are_refused_when_the_file_is_read(tree, message):
    assert refusal(ConfigError, lambda: RunTemplate(tree, None).check()).startswith(message)


@pytest.mark.parametrize(
    "tree",
    [
        {"timeline": {"min_step_us": {"uniform": [100, 500]}, "max_step_us": {"uniform": [500, 2000]}}},
        {
            "sensor": {"choice": ["davis346", "dvxplorer"]},
            "events": {"emulator": {"choice": ["esim", "v2e", "voltmeter"]}, "refractory_us": {"uniform": [0, 9]}},
            "readout": {"choice": [None, {"row_ns": 5}]},
        },
        {
            "quality": {"choice": ["fast", "reference", None]},
            "timeline": {"max_step_us": {"uniform": [5000, 9000]}},
            "events": {"emulator": {"choice": ["esim", "v2e"]}},
        },
        {
            "scene": {
                "kind": {"choice": ["random"]},
                "lights": {"choice": [None, {"kinds": {"choice": [["sun"], ["point"]]}}]},
            }
        },
        {
            "events": {
                "choice": [
                    {"contrast_threshold": {"uniform": [0.1, 0.3]}},
                    {"emulator": "voltmeter", "k1": {"choice": [3, {"uniform": [4, 5]}]}},
                ]
            }
        },
    ],
)
def test_sound_recipes_are_accepted_and_drawn(tree):
    RunTemplate(tree, None).check()
    for index in range(40):
        RunTemplate(tree, None).sequence(index)


def test_independent_distributions_do_not_multiply():
    """Twenty distributions: 2^20 corners; only what is looked at together is combined."""
    tree = {
        "events": {
            key: {"uniform": [0.1, 0.5]}
            for key in ("contrast_threshold", "contrast_threshold_off", "threshold_sigma", "log_eps")
        },
        "camera": {"fov": {"uniform": [50, 60]}, "cx": {"uniform": [10, 20]}},
        "render": {"mip_bias": {"uniform": [-1, 0]}},
        "labels": {k: {"choice": [True, False]} for k in ("images", "depth", "ids", "normals", "velocity")},
        "scene": {
            "camera_motion": {k: [{"uniform": [1, 2]}, {"uniform": [2, 3]}] for k in ("speed", "rotation_rate")},
            "light": {"sun": {"uniform": [0, 1]}, "sky": {"uniform": [0, 1]}},
            "objects": {"count": {"integer": [1, 5]}},
        },
    }
    assert len(sites(tree)) == 19
    found = list(corners(tree))
    assert 64 <= len(found) <= 161
    for pair in itertools.product((50, 60), (1, 2)):
        assert any((t["camera"]["fov"], t["scene"]["camera_motion"]["speed"][0]) == pair for t in found)
    RunTemplate(tree, None).check()


@pytest.mark.parametrize("keys, function", [(("a", "nothing"), lambda a, b: None), (("a.b",), lambda a: None)])
def test_a_wrong_declaration_is_found_when_the_class_is_made(keys, function):
    with pytest.raises(TypeError):
        type(
            "Wrong",
            (Config,),
            {"__annotations__": {"a": int}, "a": 1, "_rule": rule(*keys)(function), "__module__": __name__},
        )


# --- Per-sequence parameter distributions.

TREE = {"a": {"uniform": [0.18, 0.25]}, "b": {"c": [{"integer": [1, 6]}, 5]}, "d": {"choice": ["x", "y"]}, "e": 3}


def test_same_seed_and_sequence_same_draw_and_others_differ():
    assert draw(TREE, 0, 3) == draw(TREE, 0, 3)
    assert draw(TREE, 0, 3)["a"] != draw(TREE, 0, 4)["a"] != draw(TREE, 1, 4)["a"]


def test_a_new_distribution_moves_no_other_draw():
    more = {"new": {"uniform": [0, 1]}, **TREE}
    assert draw(more, 5, 2)["a"] == draw(TREE, 5, 2)["a"]


def test_uniform_over_sequences_is_uniform():
    values = [draw({"a": {"uniform": [2, 4]}}, 0, i)["a"] for i in range(2000)]
    assert stats.kstest(values, "uniform", args=(2, 2)).pvalue > 1e-3


def test_log_uniform_is_uniform_in_log():
    values = np.log10([draw({"a": {"log_uniform": ["1e-4", 1e-2]}}, 0, i)["a"] for i in range(2000)])
    assert stats.kstest(values, "uniform", args=(-4, 2)).pvalue > 1e-3


def test_weighted_choice_follows_its_weights():
    values = [draw({"a": {"weighted": {"esim": 3, "v2e": 1}}}, 0, i)["a"] for i in range(2000)]
    share = values.count("esim")
    assert stats.binomtest(share, 2000, 0.75).pvalue > 1e-3 and set(values) == {"esim", "v2e"}


def test_integer_includes_both_ends_and_is_flat():
    values = [draw({"a": {"integer": [1, 4]}}, 0, i)["a"] for i in range(2000)]
    assert set(values) == {1, 2, 3, 4}
    assert stats.chisquare([values.count(k) for k in range(1, 5)]).pvalue > 1e-3


@pytest.mark.parametrize(
    "node, message",
    [
        ({"uniform": [2, 1]}, "p.q.uniform: not a range"),
        ({"uniform": [1]}, "p.q.uniform: not a range"),
        ({"uniform": "ab"}, "p.q.uniform: not a range"),
        ({"uniform": [-1e308, 1e308]}, "p.q.uniform: not a range"),
        ({"integer": [0, 10**19]}, "p.q.integer: not a range of whole numbers"),
        ({"uniform": [0, 10**400]}, "p.q.uniform: not a range"),
        ({"uniform": [0, "nan"]}, "p.q.uniform: not a range"),
        ({"log_uniform": [0, 1]}, "p.q.log_uniform: not a logarithmic range"),
        ({"integer": [1, 2.5]}, "p.q.integer: not a range of whole numbers"),
        ({"choice": []}, "p.q.choice: not a list of choices"),
        ({"weighted": {"a": 0}}, "p.q.weighted: not a table of weights"),
        ({"weighted": {"a": -1, "b": 3}}, "p.q.weighted: not a table of weights"),
    ],
)
def test_malformed_distributions_name_the_path(node, message):
    for function in (lambda t: draw(t, 0, 0), sites):
        with pytest.raises(ConfigError, match="^" + message):
            function({"p": {"q": node}})
