"""Light over time in events, images and labels: counts and times against crossings of the formulas, codes decoded from
events, exposures against integrals, and OpenGL against the float64 reference."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from blinkgl import Camera, Light, Pose, Primitive, Scene, record
from blinkgl.config.run import RunTemplate
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import ConfigError
from blinkgl.gl import create_context
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.sequence import SequenceRequest, simulate_sequence
from tests.refusals import refusal

C, EPS = 0.2, 1e-3
WALL = {"mesh": "wall", "position": [4, 0, 0], "scale": 20.0}
SINE = {"kind": "sine", "frequency": 120, "depth": 0.8}
KEY = {"time": 1, "factor": 1}
PWM = {"kind": "pwm", "frequency": 1000, "duty": 0.3}


def config_of(scene, **more):
    tree = {
        "camera": {"width": 12, "height": 8},
        "time": {"duration": 0.05, "label_rate": 20},
        "events": {"emulator": "esim", "contrast_threshold": C, "threshold_sigma": 0, "log_eps": EPS},
        "labels": {"flow": [], "images": False, "occlusion": False},
        "scene": {
            "kind": "explicit",
            "meshes": {
                "wall": {"primitive": "cuboid"},
                "led": {"primitive": "icosphere", "parameters": {"radius": 0.5}},
            },
            "objects": [WALL],
            "camera": {"position": [-8, 0, 0]},
            **scene,
        },
        **more,
    }
    return RunTemplate(tree, Path(".")).sequence(0)


def events_of(config):
    sequence = simulate_sequence(SequenceRequest(config, 0)).alone
    chunks = [chunk.events for chunk in sequence.chunks()]
    fields = (np.concatenate([getattr(e, name) for e in chunks]) for name in ("t", "x", "y", "p"))
    return (*fields, sequence)


def crossings(light, t1):
    """Return how often a pixel that sees ``light`` (t in s) crosses its levels: Rebecq et al. 2018, section 3."""
    signal = np.log(light(np.linspace(0, t1, 400_001)) + EPS)
    reference, count = signal[0], 0
    for value in signal:
        while value >= reference + C:
            reference, count = reference + C, count + 1
        while value <= reference - C:
            reference, count = reference - C, count + 1
    return count


@pytest.mark.parametrize("where", ["sun and sky", "lamp", "emission"])
def test_mains_flicker_makes_the_events_of_its_formula(where):
    """On a surface of any light: the sky's on the wall's near face, a sun's that faces it, and of its own."""
    dark = {"sun": 0.0, "sky": 0.0}
    facing = {"kind": "sun", "elevation": 0, "azimuth": 180, "strength": 0.5, "over_time": SINE}
    glowing = {"m": {"emission": [0.3] * 3, "emission_over_time": SINE}}
    scene, level = {
        "sun and sky": ({"light": {"sky": 0.4, "over_time": SINE}}, 0.2),
        "lamp": ({"light": {**dark, "lights": [facing]}}, 0.5),
        "emission": ({"light": dark, "materials": glowing, "objects": [{**WALL, "material": "m"}]}, 0.3),
    }[where]
    config = config_of(scene)
    _, x, y, _, _ = events_of(config)
    counts = np.bincount(y * 12 + x, minlength=96)
    due = crossings(lambda s: level * (1 + 0.8 * np.sin(2 * math.pi * 120 * s)), config.time.t1_ns * 1e-9)
    assert due > 100 and (counts == due).all(), (counts.min(), counts.max(), due)


def test_every_edge_of_a_pulse_width_makes_its_events_at_its_microsecond():
    config = config_of({"light": {"sky": 0.4, "over_time": PWM}})
    t, _, _, p, sequence = events_of(config)
    jumps = sequence.lights()["jump_t_ns"] // 1000
    assert jumps[:4].tolist() == [300, 1000, 1300, 2000] and set(t.tolist()) == set(jumps.tolist())
    each = math.floor(math.log((0.2 + EPS) / EPS) / C)
    assert (np.unique(t, return_counts=True)[1] == 96 * each).all()
    assert {bool(v) for v in p[np.isin(t, jumps[0::2])]} == {False}


def test_the_light_of_an_event_at_a_jump_is_read_from_the_table():
    """``lights.npz`` beside the edges by the formula: two lamps at 1000 and 700 Hz."""
    lamp = {"kind": "sun", "azimuth": 180, "elevation": 0, "strength": 0.4}
    slow = {"kind": "pwm", "frequency": 700, "duty": 0.5}
    lights = [{**lamp, "over_time": PWM}, {**lamp, "over_time": slow}]
    t, _, _, _, sequence = events_of(config_of({"light": {"sun": 0, "sky": 0.1, "lights": lights}}))
    table = sequence.lights()
    at = np.searchsorted(table["jump_t_ns"] // 1000, t, "right") - 1
    light = np.where((at >= 0) & (table["jump_t_ns"][at] // 1000 == t), table["jump_light"][at], -1)
    ends = lambda wave: {
        int(1e6 * (k + part) / wave["frequency"] + 1e-6) for k in range(50) for part in (0, wave["duty"])
    }
    both = ends(PWM) & ends(slow)
    for number, wave in enumerate((PWM, slow)):
        mine = np.isin(t, sorted(ends(wave) - both))
        assert mine.sum() > 5000 and (light[mine] == number).all()
    assert (light >= 0).all()


def test_a_code_is_read_from_the_events():
    bits = "1011001110001011"
    code = {"kind": "code", "bits": bits, "rate": 2000, "low": 0.1}
    config = config_of({"light": {"sky": 0.4, "over_time": code}})
    t, x, y, p, _ = events_of(config)
    own = (x == 5) & (y == 3)
    state, out = 1, []
    for k in range(64):
        inside = own & (t >= 500 * k) & (t < 500 * (k + 1))
        state = int(p[inside][0]) if inside.any() else state
        out.append(str(state))
    assert "".join(out) == bits * 4


def test_four_blinking_leds_are_told_apart_by_their_frequencies():
    """An optical marker: the events of each LED come at the edges of its own frequency only."""
    rates = (400, 500, 700, 900)
    places = [(-1, 1), (1, 1), (-1, -1), (1, -1)]
    wave = lambda f: {"kind": "pwm", "frequency": f}
    scene = {
        "light": {"sun": 0.0, "sky": 0.2},
        "materials": {f"m{f}": {"emission": [1.0] * 3, "emission_over_time": wave(f)} for f in rates},
        "objects": [
            {"mesh": "led", "name": f"led {f}", "material": f"m{f}", "position": [0, y, z]}
            for f, (y, z) in zip(rates, places)
        ],
    }
    config = config_of(scene, camera={"width": 64, "height": 48, "fov": 40})
    t, x, y, _, sequence = events_of(config)
    for f, (left, up) in zip(rates, places):
        mine = ((x < 32) == (left > 0)) & ((y < 24) == (up > 0))
        edges = {round(k * 1e6 / (2 * f)) for k in range(1, 400)}
        near = lambda v: any(v + d in edges for d in (-1, 0, 1))
        assert mine.any() and all(near(int(v)) for v in np.unique(t[mine])), f
    assert sequence.lights()["names"].tolist() == [f"led {f}" for f in rates]


NOISELESS = {
    "rate": 20,
    "response": "linear",
    "bits": 16,
    "white": 0.4,
    "black": 0,
    "photon_noise": False,
    "read_noise": 0,
}


def test_an_exposure_has_the_integral_of_the_light():
    """One instant suffices for a still picture, however often the light jumps in it."""
    images = {**NOISELESS, "exposure_us": 7300}
    config = config_of({"light": {"sky": 0.4, "over_time": PWM}}, images=images, labels={"flow": [], "images": False})
    sequence = simulate_sequence(SequenceRequest(config, 0, events=False)).alone
    taken = [item for item in sequence if type(item).__name__ == "CameraImage"]
    for image in taken:
        edges = np.arange(image.start_ns, image.end_ns, 1000)
        on = ((edges * 1e-9 * 1000) % 1 < 0.3 - 1e-9).mean()
        np.testing.assert_allclose(image.image / 65535, 0.2 * on / 0.4, rtol=2e-3)
    assert len(taken) >= 2 and {image.instants for image in taken} == {1}


def test_rows_of_a_rolling_shutter_see_the_light_of_their_own_time():
    images = {**NOISELESS, "exposure_us": 400, "row_us": 100}
    slow = {"kind": "pwm", "frequency": 500, "duty": 0.5}
    scene = {"light": {"sky": 0.4, "over_time": slow}}
    config = config_of(scene, images=images, camera={"width": 8, "height": 48}, labels={"flow": [], "images": False})
    sequence = simulate_sequence(SequenceRequest(config, 0, events=False)).alone
    image = next(item for item in sequence if type(item).__name__ == "CameraImage")
    starts = image.start_ns + np.arange(48) * image.row_ns
    on = [(((s + np.arange(400) * 1000.0) * 1e-9 * 500) % 1 < 0.5).mean() for s in starts]
    np.testing.assert_allclose(image.image[:, 4].mean(axis=-1) / 65535, 0.5 * np.array(on), atol=0.03)
    assert np.ptp(image.image[:, 4]) > 20_000


def test_a_lamp_moves_on_a_path_of_its_own():
    """Brightest where it hangs: a point light that passes before the wall."""
    keys = [{"time": 0, "position": [-7, -1.5, 0]}, {"time": 0.1, "position": [-7, 1.5, 0]}]
    lamp = {"kind": "point", "strength": 4, "motion": {"keyframes": keys, "interpolation": "linear"}}
    config = config_of({"light": {"sun": 0, "sky": 0, "lights": [lamp]}}, camera={"width": 32, "height": 8, "fov": 60})
    scene = sequence_scene(config, 0)
    with create_context() as gl, Renderer(gl, scene, RenderConfig()) as renderer:
        columns = [int(renderer.luminance(t).read()[4].argmax()) for t in (10_000_000, 50_000_000, 90_000_000)]
    assert columns[0] > 17 and columns[1] in (15, 16) and columns[2] < 14  # y is to the left


def test_a_scene_in_python_has_the_same_limit():
    wave = {"kind": "pwm", "frequency": 1e8}
    scene = Scene(
        Camera(16, 12, pose=Pose((-3, 0, 0))), light=Light(0, 0.3, over_time=wave), duration=0.1, label_rate=20
    )
    refusal(ConfigError, record, scene + Primitive("cuboid"), labels=[], match="the light changes too often")


def test_many_changes_are_said_before_anything_is_drawn(tmp_path):
    """Two a period: up and down."""
    scene = sequence_scene(config_of({"light": {"over_time": {**PWM, "frequency": 1e6}}}), 0)
    seconds = (scene.t1_ns - scene.t0_ns) * 1e-9
    assert f"light: its light changes {2e6 * seconds:,.0f} times" in " ".join(scene.log)


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        ({"light": {"over_time": {**PWM, "frequency": 1e9}}}, "over_time of light: the light changes too often"),
        ({"light": {"over_time": {**PWM, "duty": 1.2}}}, "scene.light.over_time.duty"),
        ({"light": {"over_time": {"kind": "code", "bits": "102", "rate": 5}}}, "scene.light.over_time.bits"),
        ({"light": {"over_time": {"kind": "keys", "keys": [KEY, KEY]}}}, "must increase"),
        ({"materials": {"m": {"emission_over_time": PWM}}}, "nothing emits that could change over time"),
        ({"light": {"lights": [{"kind": "point"}]}}, "a lamp has a position or a motion"),
        ({"light": {"unlit": True, "over_time": PWM}}, "these lights have no effect"),
    ],
)
def test_what_no_light_can_do_is_one_line(scene, words):
    assert words in refusal(ConfigError, lambda: sequence_scene(config_of(scene), 0))


@pytest.mark.parametrize("name", ["light", "lights[0]", "other"])
def test_a_body_may_be_called_as_a_light_is(name):
    """Each of the three that change keeps its own waveform, jumps and events."""
    lamp = {"kind": "point", "position": [1, 0, 2], "over_time": SINE}
    glowing = {"m": {"emission": [0.3] * 3, "emission_over_time": SINE}}
    body = {**WALL, "material": "m", "name": name}
    config = config_of({"light": {"over_time": PWM, "lights": [lamp]}, "materials": glowing, "objects": [body]})
    *_, sequence = events_of(config)
    assert len(sequence.lights()["jump_t_ns"]) > 5
    names = list(sequence.scene.waveforms)
    assert len(names) == 3 and names[0] == "light" and names[2] == (name if name == "other" else f"{name} (object)")
