"""Displacement and brightness on rendered scenes: what they promise, against what the frames then do."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import trapezoid

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.config.timeline import BrightnessTimeline, DisplacementTimeline
from blinkgl.events import Esim, emulator_of
from blinkgl.events.v2e_model import lin_log
from blinkgl.labels import LabelRequest
from blinkgl.render.renderer import Renderer
from blinkgl.scene.types import Material
from blinkgl.scene.waveforms import Sine
from blinkgl.timeline import make_timeline, together, uniform_times
from tests.render.render_scenes import FACING, drift, mixed_scene, quad, rig, scene, still, thing
from tests.timeline.paces import displacement_times

MS = 1_000_000
WHITE = Material(unlit=True)
PLAIN = RenderConfig(image_antialiasing="none")
ESIM = EsimConfig(threshold_sigma=0.0)


@pytest.fixture(scope="module")
def world():
    """Everything moves for 0.15 s, turning round in between."""
    return replace(mixed_scene(96, 72), t1_ns=150 * MS)


def times_of(config, renderer, response=Esim.response(ESIM)) -> np.ndarray:
    scene = renderer.scene
    return np.array(list(make_timeline(config, scene.t0_ns, scene.t1_ns, renderer, response)))


@pytest.mark.parametrize(
    "config, inside",
    [
        (DisplacementTimeline(max_px=0.5), [(100, 0.5)]),
        (DisplacementTimeline(max_px=0.3, percentile=50), [(50, 0.3)]),
        (DisplacementTimeline(max_px=0.3, percentile=50, max_px_peak=0.4), [(50, 0.3), (100, 0.4)]),
    ],
)
def test_displacement_over_whole_intervals(gl, world, config, inside):
    """The exact flow from each frame to the next keeps to the percentile's bound and to the peak's."""
    with Renderer(gl, world, PLAIN) as renderer:
        times = times_of(config, renderer)
        assert times[0] == 0 and times[-1] == 150 * MS and (np.diff(times) > 0).all()
        for a, b in zip(times[:-1:3].tolist(), times[1::3].tolist()):
            if b - a <= config.min_step_us * 1000:
                continue
            flow = renderer.labels(a, LabelRequest("flow_forward"), b).forward
            moved = np.linalg.norm(flow.flow, axis=-1)[flow.valid]
            for percent, bound in inside:
                assert np.percentile(moved[moved > 0], percent) <= bound * 1.05


def test_a_still_background_has_no_say_in_the_percentile(gl):
    """A card of a third of the picture moves at 100 px/s before a still wall, a dot of a hundredth of it at 300."""
    wall = thing("wall", 1, quad(5, 5), still((0, 3.1, 0), FACING), WHITE)
    card = thing("card", 2, quad(0.6, 0.6), drift((-0.1, 3, 0), (0.13, 3, 0), FACING, FACING, 0.1), WHITE)
    dot = thing("dot", 3, quad(0.1, 0.1), drift((-0.3, 3, 0.5), (0.39, 3, 0.5), FACING, FACING, 0.1), WHITE)
    world = replace(scene([wall, card, dot], rig(160, 120, 130.0)), t1_ns=100 * MS)
    with Renderer(gl, world, PLAIN) as renderer:
        look = renderer.motion.look(50 * MS)
        assert look.percentile(50) == pytest.approx(130 * 0.23 / 0.1 / 3, rel=1e-6)
        assert look.percentile(100) == look.largest == pytest.approx(130 * 0.69 / 0.1 / 3, rel=1e-6)
        config = DisplacementTimeline(max_px=1.0, percentile=50)
        t = make_timeline(config, 0, 100 * MS, renderer, Esim.response(ESIM))
        assert len(set(np.diff(list(t))[:-1])) == 1 and t.looks <= 12


@pytest.mark.parametrize("fraction, percent", [(0.3, 95), (0.15, 80)])
def test_brightness_bound_holds_between_frames(gl, world, fraction, percent, monkeypatch):
    """|dL| from frame to frame of the pixels that show the same surface: the percentile keeps to the fraction of C."""
    monkeypatch.setattr(BrightnessTimeline, "sample_every", 1)
    config = BrightnessTimeline(max_fraction_of_threshold=fraction, percentile=percent, min_step_us=20)
    with Renderer(gl, world, PLAIN) as renderer:
        times = times_of(config, renderer).tolist()
        worst = 0.0
        for a, b in zip(times[:-1:4], times[1::4]):
            (la, lb), (ia, ib) = zip(
                *(
                    (np.log(renderer.luminance(t).read() + 1e-3), renderer.labels(t, LabelRequest("ids")).ids)
                    for t in (a, b)
                )
            )
            change = np.abs(lb - la)[(ia == ib)]
            worst = max(worst, np.percentile(change[change > 0], percent))
        assert worst <= 1.1 * fraction * 0.2
        monkeypatch.undo()
        twice = BrightnessTimeline(max_fraction_of_threshold=2 * fraction, percentile=percent, min_step_us=20)
        fewer = times_of(twice, renderer)
        assert len(fewer) == pytest.approx(len(times) / 2, rel=0.15)


def test_what_moves_over_flat_colours_decides_steps_by_brightness(gl, monkeypatch):
    """Nothing has a rate: a white card moves before a dark wall at 58 px/s, then before one of its own colour."""
    monkeypatch.setattr(BrightnessTimeline, "sample_every", 1)
    card = thing("card", 2, quad(0.3, 0.3), drift((-0.1, 3.0, 0), (0.3, 3.0, 0), FACING, FACING, 0.3), WHITE)
    for colour, fastest in ((0.1, 130 * (0.4 / 0.3) / 3.0), (1.0, 0.0)):
        wall = thing("wall", 1, quad(5, 5), still((0, 3.1, 0), FACING), replace(WHITE, base_color=(colour,) * 3))
        world = replace(scene([wall, card], rig(160, 120, 130.0)), t1_ns=100 * MS)
        with Renderer(gl, world, PLAIN) as renderer:
            config = BrightnessTimeline(max_fraction_of_threshold=2)
            pace = make_timeline(config, 0, 100 * MS, renderer, Esim.response(ESIM)).pace(50 * MS)
            assert pace == pytest.approx(fastest / 2, rel=0.01)


def test_response_is_the_emulators_own_slope():
    luminance = np.array([0.0, 0.003, 0.02, 0.07, 0.09, 0.5, 2.0], np.float32)
    for config, signal in (
        (EsimConfig(contrast_threshold=0.3, contrast_threshold_off=0.2), lambda i: np.log(i + 1e-3)),
        (V2eConfig(), lambda i: np.array([lin_log(np.float32(v * V2eConfig().full_scale)) for v in i], float)),
        (
            VoltmeterConfig(),
            lambda i: VoltmeterConfig().k1 * np.log(i * VoltmeterConfig().full_scale + VoltmeterConfig().k2),
        ),
    ):
        response, h = emulator_of(config).response(config), 1e-3 * luminance.astype(float) + 1e-6
        slope = response.change(luminance, np.ones_like(luminance))
        np.testing.assert_allclose(slope, (signal(luminance + h) - signal(luminance + 0.0)) / h, rtol=0.02)
        drawn = response.signal(luminance)
        np.testing.assert_allclose(np.diff(drawn), np.diff(signal(luminance.astype(float))), rtol=1e-3, atol=1e-5)
    assert Esim.response(EsimConfig(contrast_threshold=0.3, contrast_threshold_off=0.2)).threshold == 0.2


# --- One timeline of several cameras: the strictest asks, each is told its own frames.


class Seen:
    """A camera that sees one speed, from ``until`` on another."""

    def __init__(self, before: float, after: float, until: int):
        self.before, self.after, self.until = before, after, until

    @property
    def motion(self):
        return self

    unbounded = ()

    def look(self, t_ns: int):
        speed = self.before if t_ns < self.until else self.after
        return SimpleNamespace(largest=speed, percentile=lambda percent: speed)

    def jumps(self, t0_ns: int, t1_ns: int) -> list[int]:
        return []

    def hides(self, a, b, tolerance: float):
        return False

    def bend(self, a, b):
        return 0.0


def made(seen, config=None):
    config = config or DisplacementTimeline(max_px=1.0, max_step_us=1e5)
    events = EsimConfig()
    return make_timeline(config, 0, 100 * MS, seen, emulator_of(events).response(events))


def test_no_step_is_longer_than_any_camera_allows():
    slow_then_fast, steady = made(Seen(20, 1000, 50 * MS)), made(Seen(200, 200, 0))
    both = together([slow_then_fast, steady])
    times = [list(one) for one in both]
    assert times[0] == times[1] and times[0][0] == 0 and times[0][-1] == 100 * MS
    steps = np.diff(times[0])
    early = np.array(times[0][1:]) <= 50 * MS
    assert steps[early].max() <= 5 * MS + 1 and steps[~early].max() <= 1 * MS + 1
    assert len(times[0]) > len(list(made(Seen(200, 200, 0)))), "one alone would not ask for so many"


def test_whoever_asks_first_decides_and_the_other_gets_the_same():
    a, b = map(iter, together([made(Seen(100, 300, 30 * MS)), made(Seen(200, 200, 0))]))
    first = [next(b), next(b), next(a)]
    rest = [*first[2:], *a]
    assert [first[0], first[1], *b] == rest


# --- Frame times: exact grids, and a displacement bound that holds.


def test_uniform_times_do_not_drift():
    times = list(uniform_times(300.0, 5, 5 + 10_000 * MS))
    assert times[0] == 5 and times[-1] == 5 + 10_000 * MS and len(times) == 3001
    assert times[300] == 5 + 1000 * MS, "rounding is per frame, so whole seconds are hit exactly"
    assert set(np.diff(times)) == {3_333_333, 3_333_334}


def test_uniform_end_is_included_even_off_the_grid():
    assert list(uniform_times(1000.0, 0, 2_500_000)) == [0, 1 * MS, 2 * MS, 2_500_000]


@pytest.mark.parametrize("speed, expected", [(0.0, 20 * MS), (100.0, 49 * MS // 10), (1e9, 1 * MS)])
def test_constant_speed_gives_the_obvious_step(speed, expected):
    times = list(displacement_times(0.5, 1 * MS, 20 * MS, 0, 200 * MS, lambda t: speed))
    assert times[0] == 0 and times[-1] == 200 * MS
    assert set(np.diff(times)[:-1]) == {expected} and 0 < times[-1] - times[-2] <= expected


def test_acceleration_inside_a_step_is_noticed():
    """Speed 10 px/s, then 1000 px/s from 50 ms on: the step that meets the jump has to be cut."""
    speed = lambda t: 10.0 if t < 50 * MS else 1000.0
    times = np.array(list(displacement_times(0.5, MS // 10, 20 * MS, 0, 100 * MS, speed)))
    for a, b in itertools.pairwise(times):
        assert max(speed(a), speed(b)) * (b - a) <= 0.5 * 1e9 * 1.001 or b - a <= MS // 10 + 1


@settings(max_examples=60, deadline=None)
@given(st.floats(0.05, 5), st.floats(0, 5000), st.floats(0, 2000), st.floats(0.5, 40), st.integers(0, 10**15))
def test_bound_and_order_hold_for_any_oscillation(max_px, mean, swing, rate, t0):
    low, high = MS // 10, 20 * MS
    speed = lambda t: abs(mean + swing * math.sin(2 * math.pi * rate * (t - t0) * 1e-9))
    times = np.array(list(displacement_times(max_px, low, high, t0, t0 + 100 * MS, speed)), dtype=np.int64)
    steps = np.diff(times)
    assert times[0] == t0 and times[-1] == t0 + 100 * MS
    assert (steps > 0).all() and (steps <= high).all() and (steps[:-1] >= low).all()
    for a, step, b in zip(times[:-1], steps, times[1:]):
        assert max(speed(a), speed(b)) * step <= max_px * 1e9 * (1 + 1e-6) or step <= low


@pytest.mark.parametrize("speed", [lambda t: 100 + 60 * np.sin(t / 3e7), lambda t: 5e-6 * t, lambda t: 300 - 2e-6 * t])
def test_few_steps_are_refused_where_the_pace_changes_smoothly(speed):
    """A tenth more paces than frames at most, and a tenth more frames than the bound takes."""
    asked = []
    counted = lambda t: asked.append(t) or speed(t)
    times = list(displacement_times(0.5, MS // 10, 20 * MS, 0, 100 * MS, cache(counted)))
    least = trapezoid(speed(np.linspace(0, 100 * MS, 10_001)), dx=1e-5) / 0.5
    assert len(asked) <= 1.1 * len(times)
    assert len(times) <= 1.1 * least + 2


def test_what_the_steps_of_a_rig_are_too_long_for_is_said_by_it():
    """Whichever camera it is of: the steps are the same."""
    config = DisplacementTimeline(max_px=1.0, min_step_us=1000.0)
    alone = made(Seen(9000, 9000, 0), config)
    list(alone)
    assert "9 times shorter" in alone.notes[0]
    for speeds in ((9000, 20), (20, 9000)):
        both = together([made(Seen(speed, speed, 0), config) for speed in speeds])
        for one in both:
            list(one)
        assert [line for one in both for line in one.notes] == list(alone.notes)


@pytest.mark.parametrize("config", [EsimConfig(), V2eConfig(), VoltmeterConfig()], ids=["esim", "v2e", "voltmeter"])
def test_a_light_changes_by_a_threshold_a_step_whatever_the_emulators_gain(config):
    wave, response = Sine(frequency=5, depth=0.9), emulator_of(config).response(config)
    steps = DisplacementTimeline(max_px=1.0, min_step_us=10.0, max_step_us=1e5)
    times = list(make_timeline(steps, 0, 1000 * MS, Seen(0, 0, 0), response, (), [wave]))
    signal = response.signal(np.array([5.0 * wave.factor(t) for t in times], np.float32))
    assert 0.5 < np.abs(np.diff(signal)).max() / response.threshold < 1.02
