"""Displacement and brightness on rendered scenes: what they promise, against what the frames then do."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.config.timeline import BrightnessTimeline, DisplacementTimeline
from blinkgl.events import Esim, emulator_of
from blinkgl.events.v2e_model import lin_log
from blinkgl.labels import LabelRequest
from blinkgl.render.renderer import Renderer
from blinkgl.timeline import make_timeline
from tests.render.render_scenes import mixed_scene

MS = 1_000_000
PLAIN = RenderConfig(image_antialiasing="none")
ESIM = EsimConfig(threshold_sigma=0.0)


@pytest.fixture(scope="module")
def world():
    """Everything moves for 0.15 s, turning round in between."""
    from dataclasses import replace

    return replace(mixed_scene(96, 72), t1_ns=150 * MS)


def times_of(config, renderer, response=Esim.response(ESIM)) -> np.ndarray:
    scene = renderer.scene
    return np.array(list(make_timeline(config, scene.t0_ns, scene.t1_ns, renderer, response)))


def picture(array: np.ndarray):
    """What a renderer draws, read by whoever asks."""
    return SimpleNamespace(read=lambda: array)


@pytest.mark.parametrize(
    "config, inside",
    [
        (DisplacementTimeline(max_px=0.5, sample_every=1), [(100, 0.5)]),
        (DisplacementTimeline(max_px=0.3, percentile=50, sample_every=2), [(50, 0.3)]),
        (DisplacementTimeline(max_px=0.3, percentile=50, max_px_peak=0.4, sample_every=1), [(50, 0.3), (100, 0.4)]),
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


def test_a_still_background_has_no_say_in_the_percentile():
    class Picture:
        def velocity_of_movers(self, t_ns, every):
            speed = np.zeros((10, 10, 2), np.float32)
            speed[0, :5, 0] = [100, 100, 100, 100, np.inf]
            return picture(speed)

    t = make_timeline(DisplacementTimeline(max_px=1.0, percentile=50), 0, 100 * MS, Picture(), Esim.response(ESIM))
    assert t.pace(0) == pytest.approx(100) and set(np.diff(list(t))[:-1]) == {98 * MS // 10} and t.looks == 12


@pytest.mark.parametrize("fraction, percent", [(0.3, 95), (0.15, 80)])
def test_brightness_bound_holds_between_frames(gl, world, fraction, percent):
    """|dL| from frame to frame of the pixels that show the same surface: the percentile keeps to the fraction of C."""
    config = BrightnessTimeline(max_fraction_of_threshold=fraction, percentile=percent, sample_every=1, min_step_us=20)
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
        assert 0.4 * fraction * 0.2 < worst <= 1.1 * fraction * 0.2
        fewer = times_of(
            BrightnessTimeline(
                max_fraction_of_threshold=2 * fraction, percentile=percent, sample_every=4, min_step_us=20
            ),
            renderer,
        )
        assert len(fewer) == pytest.approx(len(times) / 2, rel=0.15)


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
