"""What made each event, of whole sequences: whose it is, how it moved, whether it depends on anything that it should
not depend on."""

import numpy as np
import pytest

from blinkgl import (
    Camera,
    ConfigError,
    Keyframes,
    Light,
    Material,
    OutputError,
    Pose,
    Primitive,
    Scene,
    look_at,
    record,
    render_frame,
    write_events,
)
from blinkgl.config.run import RunTemplate
from blinkgl.events.truth import Surfaces, SurfaceTruth
from blinkgl.front.runs import configured
from blinkgl.sequence import simulate_sequence
from blinkgl.sequence.request import SequenceRequest
from blinkgl.types.events import Cause, Events
from tests.refusals import refusal

SQUARES = np.where(((np.indices((64, 64)) // 8).sum(0) % 2)[..., None], (230, 200, 60), (40, 60, 110)).astype(np.uint8)
CAMERA = Camera(72, 48, fov=60, pose=look_at((-3, 0, 0), (0, 0, 0)))
SPAN = dict(duration=0.05, label_rate=20)


def apart() -> Scene:
    """Two boxes before nothing, 2 in the left half of the picture and 1 in the right."""
    scene = Scene(CAMERA, **SPAN)
    for y in (-0.9, 0.9):
        way = Keyframes({0.0: Pose((0, y - 0.1, -0.1)), 0.2: Pose((0, y + 0.1, 0.1), euler=(0, 0, 40))})
        scene += Primitive("cuboid", extents=(0.4, 0.7, 0.9), pose=way, material=Material(SQUARES))
    return scene


def before_a_wall() -> Scene:
    """Box 2 passes before wall 1, which looks the same everywhere and so makes nothing itself."""
    scene = Scene(CAMERA, light=Light(unlit=True), **SPAN)
    scene += Primitive("cuboid", extents=(0.1, 9, 9), pose=(2, 0, 0), material=Material(color=(0.5, 0.5, 0.5)))
    way = Keyframes({0.0: Pose((0, -0.6, -0.1)), 0.2: Pose((0, 0.6, 0.1), euler=(0, 0, 30))})
    scene += Primitive("cuboid", extents=(0.4, 0.7, 0.9), pose=way, material=Material(SQUARES))
    return scene


def made(scene: Scene, **more):
    """The events of a scene with sections of a configuration laid over it."""
    template = configured(scene, labels=["events"])
    config = RunTemplate({**template.tree, **more}, template.base).sequence(0)
    with simulate_sequence(SequenceRequest(config, scene=scene.build(config))) as sequence:
        return sequence.gather()


@pytest.mark.parametrize("emulator", ["esim", "v2e", "voltmeter"])
def test_events_carry_the_object_that_made_them(emulator):
    for scene, whose in (
        (apart(), lambda e: np.where(e.x < CAMERA.tree["width"] / 2, 2, 1)),
        (before_a_wall(), lambda e: np.full(len(e), 2)),
    ):
        events = record(scene, labels=["events"], emulator=emulator).events
        signal = events.cause == Cause.SIGNAL
        right = events.truth["instance"] == whose(events)
        assert signal.sum() > 1000 and right[signal].mean() >= 0.995
        if emulator == "esim":
            assert right.mean() >= 0.9995  # a silhouette now and then


@pytest.mark.parametrize(
    "more",
    [
        {"timeline": {"kind": "uniform", "fps": 150}},  # five pixels from frame to frame
        {"render": {"antialiasing": "ssaa2"}},  # edges that cover a part of a pixel
        {"render": {"antialiasing": "edges"}},
        {"readout": {"events_per_second": 2e4}},  # long after it happened
    ],
    ids=["far apart", "ssaa2", "edges", "late"],
)
def test_it_is_theirs_whatever_stands_between(more):
    events = made(before_a_wall(), **more)
    assert len(events) > 1000 and (events.truth["instance"] == 2).mean() >= 0.995


def test_velocity_and_depth_are_those_of_the_surface():
    """A wall that fills the picture and slides sideways: everything moves alike, at one depth."""
    scene = Scene(CAMERA, light=Light(unlit=True), **SPAN)
    way = Keyframes({0.0: Pose((2.05, -0.3, 0)), 1.0: Pose((2.05, 3.7, 0))}, interpolation="linear")
    scene += Primitive("cuboid", extents=(0.1, 60, 60), pose=way, material=Material(SQUARES, uv_scale=(90, 90)))
    events = record(scene, labels=["events"]).events
    focal = scene.build(configured(scene).sequence(0)).camera.K[0, 0]
    assert len(events) > 1000 and (events.truth["instance"] == 1).all()
    assert np.allclose(events.truth["depth"], 5.0, rtol=1e-5)
    assert np.allclose(events.truth["velocity"], (-4.0 * focal / 5.0, 0.0), atol=1e-2)


def test_the_events_are_those_that_come_without_it():
    scene = apart()
    plain = record(scene, labels=["ids"]).events
    told = record(scene, labels=["ids", "events"]).events
    assert plain.truth is None and told.truth is not None
    assert all(np.array_equal(getattr(plain, name), getattr(told, name)) for name in "xytp")


def test_what_has_no_place_for_it_says_so(tmp_path):
    scene = apart()
    refusal(ConfigError, render_frame, scene, 0.0, labels=["events"], match="a label of events has no value at a time")
    events = record(scene, labels=["events"]).events
    with pytest.raises(OutputError, match="event files cannot store what caused the events"):
        write_events(tmp_path / "e.h5", events, 48, 72)
    assert not list(tmp_path.iterdir())


def test_what_a_pixel_still_follows_gives_way_to_the_same_instance_where_it_is_now():
    one = lambda instance, depth: Surfaces(
        np.array([[instance]]), np.array([[depth]], np.float32), np.zeros((1, 1, 2), np.float32)
    )
    truth = SurfaceTruth()
    truth.see(0, one(1, 2.0))
    truth.see(1_000_000, one(2, 5.0), np.array([[1.0]]))  # 1 has left, and is followed for a second
    event = Events(np.zeros(1, np.uint16), np.zeros(1, np.uint16), np.array([1_900]), np.ones(1, np.uint8))
    truth.see(2_000_000, one(2, 5.0), np.array([[1.0]]))
    assert truth.of(event, 2_000_000)["instance"] == 1
    truth.see(3_000_000, one(1, 3.0), np.array([[1.0]]))
    late = Events(event.x, event.y, np.array([2_900]), event.p)
    made = truth.of(late, 3_000_000)
    assert made["instance"] == 1 and made["depth"] == 3.0


@pytest.mark.parametrize("emulator", ["esim", "v2e"])
def test_what_passes_behind_a_body_at_rest_makes_its_own_events(emulator):
    """Posts (2 to 5) at rest before squares (1) that slide by: no event is of a post, though the pixels at its edges
    show a part of it."""
    scene = Scene(CAMERA, light=Light(unlit=True), **SPAN)
    way = Keyframes({0.0: Pose((2, -0.2, 0)), 0.2: Pose((2, 0.4, 0.1))}, interpolation="linear")
    scene += Primitive("cuboid", extents=(0.1, 9, 9), pose=way, material=Material(SQUARES))
    for y in (-0.8, -0.31, 0.17, 0.7):
        scene += Primitive("cuboid", extents=(0.1, 0.13, 4), pose=(0, y, 0), material=Material(color=(0.4,) * 3))
    quiet = {"emulator": emulator, "threshold_sigma": 0}
    quiet |= {"leak_rate_hz": 0, "shot_noise_rate_hz": 0} if emulator == "v2e" else {}
    truth = record(scene, emulator=quiet, labels=["events"]).events.truth
    assert len(truth) > 1000 and (truth["instance"] == 1).mean() > 0.999
