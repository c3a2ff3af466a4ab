"""Which light made each event (``truth["light"]``): against the surfaces that shine alone, against pictures of scenes
with one lamp each (light adds up), through files."""

from __future__ import annotations

import io
import tarfile

import h5py
import numpy as np
import pytest

from blinkgl import Camera, Keyframes, Light, Material, Pose, Primitive, Scene, read_events, record
from blinkgl.cli import run
from blinkgl.config.run import RunTemplate
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import EventDataError
from blinkgl.gl import create_context
from blinkgl.io.event_labels import EventLabelsReader
from blinkgl.io.sequence_tables import read_lights
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.sequence import simulate_sequence
from blinkgl.sequence.request import SequenceRequest
from runs import generated

STRIPES = np.where((np.arange(128) // 8 % 2)[None, :, None], 220, 60).astype(np.uint8).repeat(128, 0).repeat(3, 2)
CODE = {"kind": "code", "bits": "10110", "rate": 1700}


def leds(shared: bool) -> Scene:
    """Four LEDs before a camera that moves: with codes of their own, or of one material."""
    way = Keyframes({0.0: Pose((-3, -0.1, 0)), 0.3: Pose((-3, 0.1, 0))}, interpolation="linear")
    scene = Scene(Camera(80, 60, fov=50, pose=way), light=Light(0, 0.2), background=0.05, duration=0.02, label_rate=50)
    one = Material(color=(0.1, 0.1, 0.1), emission=(2, 2, 2), emission_over_time=CODE)
    for k, (y, z) in enumerate([(-0.5, 0.4), (0.5, 0.4), (-0.5, -0.4), (0.5, -0.4)]):
        own = Material(color=(0.1,) * 3, emission=(2,) * 3, emission_over_time={**CODE, "rate": 1100 + 300 * k})
        scene += Primitive("cuboid", scale=0.2, pose=Pose((0, y, z)), material=one if shared else own)
    return scene


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("emulator", ["esim", "v2e", "voltmeter"])
def test_a_light_that_shines_alone_is_its_surface(emulator, shared):
    recording = record(leds(shared), emulator=emulator, labels=["events"])
    truth, names = recording.events.truth, list(recording.lights["names"])
    # Bodies have the instances 1 to 4 in the order of the scene, and so have the lights their numbers.
    assert len(names) == 4
    blinks = truth["light"] >= 0
    own = truth["instance"] == truth["light"] + 1
    assert blinks.sum() > 1000 and (own[blinks]).mean() > 0.99
    if emulator == "esim":
        # A pixel of which a corner is lit shows nothing at its centre and beside it.
        assert (own | (truth["instance"] == 0))[blinks].all()
        jumps = recording.lights["jump_t_ns"] // 1000
        assert set(recording.events.t[blinks]) <= set(jumps)


def two_lamps(lights, moves: bool) -> dict:
    wall = {"primitive": "cuboid"}
    end = [-2, 0.4 if moves else 0.0, 0]
    return {
        "camera": {"width": 24, "height": 16},
        "time": {"duration": 0.04, "label_rate": 25},
        "timeline": {"kind": "uniform", "fps": 2000},
        "render": {"antialiasing": "none"},
        "events": {"emulator": "esim", "contrast_threshold": 0.05, "threshold_sigma": 0},
        "labels": {"events": True, "flow": [], "images": False, "occlusion": False},
        "scene": {
            "kind": "explicit",
            "light": {"sun": 0.0, "sky": 0.05, "lights": lights},
            "meshes": {"wall": wall},
            "objects": [{"mesh": "wall", "position": [4, 0, 0], "scale": 8.0}],
            "camera": {"keyframes": [{"time": 0, "position": [-2, 0, 0]}, {"time": 0.04, "position": end}]},
        },
    }


A = {"kind": "point", "position": [-1, 1.2, 0], "strength": 8.0, "over_time": {"kind": "sine", "frequency": 90}}
B = {"kind": "point", "position": [-1, -1.2, 0], "strength": 8.0, "over_time": {"kind": "sine", "frequency": 130}}


def pictures(tree, times):
    config = RunTemplate(tree, ".").sequence(0)
    with create_context() as gl, Renderer(gl, sequence_scene(config, 0), config.render) as renderer:
        return np.stack([renderer.luminance(int(t)).read().astype(np.float64) for t in times])


def test_where_lamps_overlap_the_larger_share_counts():
    """The oracle draws a scene per lamp: the other one dark, and the sky."""
    tree = two_lamps([A, B], moves=False)
    config = RunTemplate(tree, ".").sequence(0)
    with simulate_sequence(SequenceRequest(config)) as sequence:
        events = sequence.gather()
    times = np.arange(config.time.t0_ns, config.time.t1_ns + 1, 500_000)
    off = lambda lamp: {**lamp, "strength": 0.0}
    alone = [pictures(two_lamps(pair, moves=False), times) for pair in ([A, off(B)], [off(A), B])]
    after = np.minimum(np.searchsorted(times, 1000 * events.t + 500), len(times) - 1)
    changes = np.stack([one[after, events.y, events.x] - one[after - 1, events.y, events.x] for one in alone])
    toward = changes * np.where(events.p, 1, -1)
    clear = np.abs(toward[0] - toward[1]) > 1e-4 * np.abs(toward).max()
    assert len(events) > 20_000 and clear.mean() > 0.99
    assert (events.truth["light"] == toward.argmax(0))[clear].all()
    assert 0.2 < (events.truth["light"] == 0).mean() < 0.8


def striped(duration: float, **light) -> Scene:
    way = Keyframes({0.0: Pose((-2, -0.2, 0)), 1.0: Pose((-2, 3.8, 0))}, interpolation="linear")
    scene = Scene(
        Camera(48, 32, fov=60, pose=way), light=Light(unlit=not light, **light), duration=duration, label_rate=20
    )
    scene += Primitive("cuboid", extents=(0.1, 6, 6), pose=(0, 0, 0), material=Material(STRIPES))
    return scene


def test_what_moves_is_no_light():
    """A weak flicker before a camera that passes stripes: the events of stripes are of no light, and between two frames
    the light's share decides by the product rule."""
    scene = striped(0.05, sun=0.0, sky=0.5, over_time={"kind": "sine", "frequency": 40, "depth": 0.05})
    truth = record(scene, emulator="esim", labels=["events"]).events.truth
    assert len(truth) > 2000 and (truth["light"] == -1).mean() > 0.9
    assert (record(striped(0.05), emulator="esim", labels=["events"]).events.truth["light"] == -1).all()


def test_a_pixel_that_lags_behind_is_still_the_light_s():
    """V2E's low-pass follows a flash for milliseconds, in which no light changes; noise is of none."""
    flash = [{"time": 0, "factor": 0.2}, {"time": 0.01, "factor": 1}, {"time": 0.05, "factor": 1}]
    wave = {"kind": "keys", "interpolation": "hold", "keys": flash}
    scene = Scene(
        Camera(24, 16, fov=60, pose=Pose((-2, 0, 0))), light=Light(0, 0.3, over_time=wave), duration=0.05, label_rate=20
    )
    scene += Primitive("cuboid", extents=(0.1, 6, 6), material=Material(color=(0.5, 0.5, 0.5)))
    slow = {"emulator": "v2e", "cutoff_hz": 30, "shot_noise_rate_hz": 20, "leak_rate_hz": 5, "threshold_sigma": 0}
    events = record(scene, emulator=slow, labels=["events"]).events
    signal = events.cause == 0
    assert (events.t[signal] > 12_000).mean() > 0.3 and (~signal).sum() > 50
    assert (events.truth["light"][signal] == 0).all() and (events.truth["light"][~signal] == -1).all()


FILES = """
camera: {width: 80, height: 60, fov: 50}
time: {duration: 0.02, label_rate: 50}
events: {emulator: v2e}
labels: {events: true}
preview: {enabled: false}
scene:
  kind: explicit
  light: {sun: 0, sky: 0.2}
  meshes: {led: {primitive: cuboid}}
  materials:
    a: {emission: [2, 2, 2], emission_over_time: {kind: code, bits: "10110", rate: 1700}}
    b: {emission: [2, 2, 2], emission_over_time: {kind: pwm, frequency: 900}}
  objects:
    - {mesh: led, material: a, position: [0, 0.5, 0], scale: 0.4}
    - {mesh: led, material: b, position: [0, -0.5, 0], scale: 0.4}
  camera: {position: [-3, 0, 0]}
"""


def test_files_say_the_light_where_one_changes(tmp_path):
    out = generated(tmp_path, FILES) / "out"
    folder = next(out.rglob("event_labels.h5")).parent
    assert verify_dataset(out, deep=1).clean
    with EventLabelsReader(folder) as reader:
        assert reader.lights
    numbers = read_events(folder / "events.h5", truth=True).truth["light"]
    assert set(np.unique(numbers)) <= {-1, 0, 1} and (numbers >= 0).sum() > 1000
    assert len(read_lights(folder)["names"]) == 2
    assert run(["export", str(out), "--out", str(tmp_path / "shards")]) == 0
    with tarfile.open(next((tmp_path / "shards").rglob("*.tar"))) as tar:
        name = next(one for one in tar.getnames() if one.endswith("new.npz"))
        member = tar.extractfile(name)
        assert member is not None
        assert np.load(io.BytesIO(member.read()))["light"].dtype == np.int32
    with h5py.File(folder / "event_labels.h5", "r+") as file:
        file["light"][7] = -2
    with pytest.raises(EventDataError, match="light of event 7"), EventLabelsReader(folder) as reader:
        reader.read()
