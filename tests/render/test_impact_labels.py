"""Ground truth before, over and after an impact of a body that falls, drawn, against the float64 reference."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.config.sequence import RenderConfig, SequenceConfig
from blinkgl.labels import LabelRequest
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.tools.shader_debugger import reference

MS = 1_000_000
LABELS = LabelRequest("depth", "ids", "velocity", "flow_forward", "flow_backward")
TREE = {
    "camera": {"width": 96, "height": 72, "fov": 40},
    "time": {"duration": 0.3, "label_rate": 10},
    "scene": {
        "kind": "explicit",
        "physics": {},
        "meshes": {
            "die": {"primitive": "cuboid", "parameters": {"extents": [0.2, 0.2, 0.2]}},
            "floor": {"primitive": "grid", "parameters": {"width": 8, "depth": 8}},
        },
        "objects": [
            {"mesh": "floor", "category": "ground"},
            {
                "mesh": "die",
                "position": [1.5, 0, 0.35],
                "euler": [20, 30, 10],
                "physics": {"restitution": 0.7, "spin": [0, 200, 100], "velocity": [0, 0.3, 0]},
            },
        ],
        "camera": {"position": [0, 0, 0.45], "look_at": [1.5, 0, 0.15]},
    },
}


@pytest.fixture(scope="module")
def falling():
    """The scene, and the time of its first impact."""
    pytest.importorskip("mujoco")
    scene = sequence_scene(SequenceConfig.model_validate(TREE), 0)
    first = scene.dynamics.impacts_ns[0]
    assert 50 * MS < first < 300 * MS
    return scene, first


@pytest.mark.parametrize("before, after", [(-8, 8), (-20, 1), (-1, 30), (0, 5), (-5, 0), (-0.4, 0.6), (1, 9)])
def test_flow_over_an_impact_is_the_references(gl, falling, before, after):
    """There and back: from ms before (or after) the moment of the impact to ms after it, and the other way."""
    what, first = falling
    t, there = first + round(before * MS), first + round(after * MS)
    ref = reference.render(what, t, forward_ns=there, backward_ns=t - 10 * MS)
    back = reference.render(what, there, forward_ns=there + 10 * MS, backward_ns=t)
    with Renderer(gl, what, RenderConfig(image_antialiasing="none")) as renderer:
        labels = renderer.labels(t, LABELS, there, t - 10 * MS)
        later = renderer.labels(there, LABELS, there + 10 * MS, t)
    for theirs, ours in ((ref, labels), (back, later)):
        off = theirs.hit & ~reference.silhouette_band(theirs.instance, theirs.depth)
        assert np.array_equal(ours.ids[off], theirs.instance[off]) and (ours.ids[off] == 2).sum() > 50
        for mine, true in ((ours.forward, theirs.forward), (ours.backward, theirs.backward)):
            error = np.linalg.norm(mine.flow - true.flow, axis=-1)[off]
            assert np.median(error) <= 1e-5 and error.max() <= 1e-2
        speed = np.linalg.norm(theirs.velocity, axis=-1)
        error = np.linalg.norm(ours.velocity - theirs.velocity, axis=-1)[off]
        assert error.max() <= 1e-4 * max(speed[off].max(), 1.0)


def test_the_rate_turns_round_at_the_impact(gl, falling):
    """Just before it the die falls, just after it rises: velocity is of its own moment, and not a mean over it."""
    what, first = falling
    with Renderer(gl, what, RenderConfig(image_antialiasing="none")) as renderer:
        rates = []
        for t in (first - 3 * MS, first + 3 * MS):
            labels = renderer.labels(t, LABELS, t + MS, t - MS)
            rates.append(float(np.median(labels.velocity[labels.ids == 2][:, 1])))
    assert rates[0] > 20 and rates[1] < -5  # px/s, y down
