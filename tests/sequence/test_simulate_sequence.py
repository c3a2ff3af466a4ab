"""One generator of what happens in time, and what its consumers may count on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from blinkgl.config.run import load_run
from blinkgl.events import Events
from blinkgl.gl import create_context
from blinkgl.render.renderer import Renderer
from blinkgl.sequence import EventChunk, GroundTruth, Picture, simulate_sequence
from blinkgl.sequence.request import SequenceRequest

SMALL = {
    "seed": 4,
    "camera": {"width": 48, "height": 36},
    "time": {"duration": 0.1, "label_rate": 30, "start": 0.25},
    "scene": {
        "kind": "random",
        "objects": {"count": 3, "distance": [2, 4]},
        "pool": {"primitives": ["cuboid", "sphere"], "variants": 2},
        "textures": {"procedural": ["checks", "fbm"], "variants": 2, "photographs": False, "max_size": 64},
    },
    "labels": {"flow": ["forward", "backward"], "depth": True},
    "preview": {"enabled": False},
}


def config_of(tmp_path: Path, **changes):
    path = tmp_path / "run.yaml"
    path.write_text(yaml.safe_dump({**SMALL, **changes}))
    return load_run(path).sequence(0)


def events_of(items) -> Events:
    return Events.concatenate([item.events for item in items if isinstance(item, EventChunk)])


def assert_same(a: Events, b: Events) -> None:
    assert len(a) == len(b) > 0
    for column in "xytp":
        np.testing.assert_array_equal(getattr(a, column), getattr(b, column))


# --- order ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"timeline": {"kind": "uniform", "fps": 47}},
        {
            "events": {"emulator": "v2e", "preset": "noisy"},
            "readout": {"events_per_second": 200_000, "queue_events": 200},
        },
    ],
    ids=["default", "uniform", "read-out"],
)
def test_ground_truth_comes_between_the_events_before_and_after_its_time(tmp_path, gl, changes):
    """The label rate and the frames' have no common divisor, so most labels lie inside a chunk."""
    config = config_of(tmp_path, **changes)
    with simulate_sequence(SequenceRequest(config, 0, pictures_hz=50), gl) as sequence:
        items = list(sequence)
    last_us, done_us, inside = None, config.time.t0_ns // 1000, 0
    for item in items:
        if isinstance(item, EventChunk):
            assert item.t_ns // 1000 >= done_us
            if len(item.events):
                assert (np.diff(item.events.t) >= 0).all()
                assert item.events.t[0] >= done_us, "what a chunk gives was not promised to be over"
                last_us = int(item.events.t[-1])
            done_us = item.t_ns // 1000
        else:
            assert item.t_ns // 1000 == done_us and (last_us is None or isinstance(item, Picture) or last_us < done_us)
        inside += isinstance(item, GroundTruth)
    truths = [item for item in items if isinstance(item, GroundTruth)]
    assert [t.t_ns for t in truths] == list(config.time.label_times_ns) and [t.k for t in truths] == list(
        range(len(truths))
    )
    assert [t.forward_ns is not None for t in truths] == [True] * config.time.label_count + [
        False
    ] and sequence.labels == config.time.label_count
    assert len([item for item in items if isinstance(item, Picture)]) > 3
    assert done_us == config.time.t1_ns // 1000 and sequence.events == len(events_of(items)) > 100


def test_what_is_asked_for_is_what_is_drawn(tmp_path, gl, monkeypatch):
    """And it changes nothing of the rest: events are the same with and without labels and pictures between them."""
    config = config_of(tmp_path)
    drawn = []

    def spy(name, draw):
        def spied(self, *args, **kwargs):
            drawn.append(name)
            return draw(self, *args, **kwargs)

        monkeypatch.setattr(Renderer, name, spied)

    for name in ("luminance", "colour", "labels", "velocity", "velocity_of_movers"):
        spy(name, getattr(Renderer, name))
    made = {}
    for name, wanted, expected in (
        ("everything", {"pictures_hz": 40}, {"luminance", "colour", "labels"}),
        ("events", {"labels": False}, {"luminance"}),
        ("labels", {"events": False}, {"colour", "labels"}),
    ):
        drawn.clear()
        made[name] = list(simulate_sequence(SequenceRequest(config, 0, **wanted), gl))
        assert set(drawn) == expected, "the timeline draws nothing"
    assert_same(events_of(made["everything"]), events_of(made["events"]))
    assert not events_of(made["labels"]).t.size
    for a, b in zip((i for i in made["everything"] if isinstance(i, GroundTruth)), made["labels"], strict=True):
        assert a.frame.values.keys() == b.frame.values.keys() and a.frame.values
        for name in ("images", "depth"):
            np.testing.assert_array_equal(getattr(a.frame, name), getattr(b.frame, name))
        assert a.frame.backward is b.frame.backward is None or np.array_equal(
            a.frame.backward.flow, b.frame.backward.flow
        )


# --- its end ----------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("own_contexts")
@pytest.mark.parametrize("how", ["break", "error", "never begun", "exhausted"])
def test_opengl_is_let_go_however_it_ends(tmp_path, how, monkeypatch):
    released = []
    monkeypatch.setattr(
        Renderer, "release", lambda self, _release=Renderer.release: (released.append(self), _release(self))
    )
    config = config_of(tmp_path)

    def consume():
        if how == "never begun":
            with simulate_sequence(SequenceRequest(config, 0)) as sequence:
                return sequence
        sequence = simulate_sequence(SequenceRequest(config, 0))
        for k, _ in enumerate(sequence):
            if how == "break" and k == 5:
                break
            if how == "error" and k == 5:
                raise RuntimeError("the consumer's own")
        return sequence

    if how == "error":
        with pytest.raises(RuntimeError, match="the consumer's own"):
            consume()
        assert len(released) == 1
    else:
        sequence = consume()
        assert released == [sequence.renderer] and sequence.renderer.gl.released


def test_two_at_once_are_as_one_after_the_other(tmp_path):
    """Each has a context of its own, and draws in it, whoever drew last."""
    config = config_of(tmp_path, labels={"flow": ["forward"]})
    alone = list(simulate_sequence(SequenceRequest(config, 0)))
    other = create_context()
    with other, simulate_sequence(SequenceRequest(config, 0)) as a, simulate_sequence(SequenceRequest(config, 0)) as b:
        together = []
        for x, _ in zip(a, b, strict=True):
            together += [x]
            other.make_current()
        truths = [(x, y) for x, y in zip(together, alone, strict=True) if isinstance(x, GroundTruth)]
        assert_same(events_of(together), events_of(alone))
        assert truths and all(np.array_equal(x.frame.images, y.frame.images) for x, y in truths)


# --- what is said -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("look_at", "seen"), [([0, 0, 0], True), ([0, -1.3, 0], True), ([-6, 0, 0], False), ([-3, 0, 3], False)]
)
def test_a_camera_that_never_sees_a_body_is_said(tmp_path, gl, look_at, seen):
    """Towards the body, past its middle with an edge in the picture, away from it, and above it."""
    scene = {
        "kind": "explicit",
        "meshes": {"box": {"primitive": "cuboid"}},
        "objects": [{"mesh": "box", "keyframes": [{"time": 0}, {"time": 1, "euler": [0, 0, 40]}]}],
        "camera": {"position": [-3, 0, 0], "look_at": look_at},
    }
    config = config_of(tmp_path, camera={"width": 48, "height": 36, "fov": 60}, scene=scene)
    with simulate_sequence(SequenceRequest(config, 0), gl) as sequence:
        list(sequence)
        said = [line for line in sequence.notes if "in the camera's view" in line]
    assert said == ([] if seen else ["no body is ever in the camera's view: its pose may be meant otherwise"])


def test_a_camera_that_turns_to_a_body_sees_it(tmp_path, gl):
    """Any instant counts, the last, too."""
    way = [{"time": t, "position": [-3, 0, 0], "look_at": at} for t, at in ((0.25, [-6, 0.5, 0]), (0.35, [0, 0, 0]))]
    scene = {
        "kind": "explicit",
        "meshes": {"box": {"primitive": "cuboid"}},
        "objects": [{"mesh": "box"}],
        "camera": {"keyframes": way},
    }
    with simulate_sequence(SequenceRequest(config_of(tmp_path, scene=scene), 0), gl) as sequence:
        list(sequence)
        assert not [line for line in sequence.notes if "view" in line]


def test_a_body_that_breathes_into_view_is_in_view(tmp_path, gl):
    """At rest it is beside the picture; breathing brings it in."""
    scene = {
        "kind": "explicit",
        "meshes": {"box": {"primitive": "cuboid"}},
        "objects": [{"mesh": "box", "position": [0, 2.88, 0]}],
        "camera": {"position": [-3, 0, 0], "look_at": [0, 0, 0]},
    }
    for deform, seen in ((None, False), ({"kind": "breathe", "amount": [0, 0.9, 0], "period": 0.1}, True)):
        scene["objects"][0]["deform"] = deform
        config = config_of(tmp_path, camera={"width": 48, "height": 36, "fov": 60}, scene=scene)
        with simulate_sequence(SequenceRequest(config, 0), gl) as sequence:
            list(sequence)
            said = [line for line in sequence.notes if "in the camera's view" in line]
        assert len(said) == (not seen)
