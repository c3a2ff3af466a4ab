"""Optics of the event camera against SciPy, closed forms, the frame camera's lens, and its own colour pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import convolve
from scipy.special import j0, j1
from scipy.stats import norm

from blinkgl.config.optics import OpticsConfig
from blinkgl.config.problems import validate
from blinkgl.config.run import RunTemplate
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import ConfigError
from blinkgl.gl import create_context
from blinkgl.imaging.optics import Optics, kernels_of, spread
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.sequence import SequenceRequest, simulate_sequence
from tests.refusals import refusal


def optics_of(**tree):
    return validate(OpticsConfig, tree, where="optics")


def config_of(objects=(), materials=None, **more):
    tree = {
        "camera": {"width": 48, "height": 36, "fov": 40},
        "time": {"duration": 0.05, "label_rate": 20},
        "events": {"emulator": "esim", "contrast_threshold": 0.2, "threshold_sigma": 0},
        "labels": {"flow": [], "images": False, "occlusion": False},
        "scene": {
            "kind": "explicit",
            "background": 0.2,
            "meshes": {
                "ball": {"primitive": "icosphere", "parameters": {"subdivisions": 3}},
                "wall": {"primitive": "cuboid"},
            },
            "materials": materials or {"m": {"color": [0, 0, 0], "emission": [1, 1, 1]}},
            "objects": list(objects),
            "camera": {"position": [-10, 0, 0]},
        },
        **more,
    }
    return RunTemplate(tree, Path()).sequence(0)


def ball(size=0.2, **more):
    return {"mesh": "ball", "material": "m", "scale": size, **more}


@pytest.mark.parametrize("shape", [(1, 9), (9, 1), (5, 7), (11, 11)])
def test_the_spread_is_scipys_convolution(shape):
    rng = np.random.default_rng(1)
    light, weights = rng.uniform(0, 5, (37, 53)).astype(np.float32), rng.uniform(0, 1, shape)
    np.testing.assert_allclose(
        spread(light, weights), convolve(light.astype(np.float64), weights, mode="nearest"), rtol=1e-6
    )


def test_a_gaussian_has_the_light_of_the_normal_law_in_each_pixel():
    row, column = kernels_of(optics_of(psf={"kind": "gaussian", "sigma": 1.3}).psf)
    edges = np.arange(len(row[0]) + 1) - len(row[0]) / 2
    np.testing.assert_allclose(row[0], np.diff(norm.cdf(edges, scale=1.3)), atol=1e-4)
    assert row.sum() == pytest.approx(1) and (column[:, 0] == row[0]).all()


def test_an_airy_pattern_encircles_the_energy_of_its_closed_form():
    """1 - J0² - J1² (Born and Wolf, 8.5.2), up to the light beyond the third dark ring."""
    (weights,) = kernels_of(optics_of(psf={"kind": "airy", "radius": 4.0}).psf)
    place = np.arange(len(weights)) - len(weights) // 2
    distance = np.hypot(place[:, None], place)
    whole = 1 - j0(10.1735) ** 2 - j1(10.1735) ** 2
    for radius in (2.0, 4.0, 7.0):
        x = 3.8317 * radius / 4.0
        share = (1 - j0(x) ** 2 - j1(x) ** 2) / whole
        assert weights[distance <= radius].sum() == pytest.approx(share, abs=0.03)


def test_a_point_spread_keeps_the_light_of_a_star_and_its_place():
    config = config_of([ball(0.05, position=[0, 0.31, 0.17])])
    with create_context() as gl, Renderer(gl, sequence_scene(config, 0), config.render) as renderer:
        sharp = renderer.luminance(0).read().astype(np.float64) - 0.2
        blurred = Optics(renderer, optics_of(psf={"kind": "gaussian", "sigma": 1.5})).light(0).astype(np.float64) - 0.2
    assert blurred.sum() == pytest.approx(sharp.sum(), rel=1e-3) and blurred.max() < 0.4 * sharp.max()
    y, x = np.mgrid[:36, :48]
    for axis in (x, y):
        assert (axis * blurred).sum() / blurred.sum() == pytest.approx((axis * sharp).sum() / sharp.sum(), abs=2e-3)


def test_defocus_spreads_a_ball_over_the_disc_of_a_thin_lens():
    """A ball at depth 10, focus at 5: a disc of the diameter aperture f |1/10 - 1/5|."""
    config = config_of([ball(0.2)])
    lens = {"lens": {"aperture": 0.8, "focus": 5}, "lens_points": 256}
    with create_context() as gl, Renderer(gl, sequence_scene(config, 0), config.render) as renderer:
        light = Optics(renderer, optics_of(**lens)).light(0).astype(np.float64) - 0.2
        focal = renderer.scene.camera.fx
        in_focus = Optics(renderer, optics_of(lens={"aperture": 0.8, "focus": 10})).light(0) - 0.2
    diameter = 0.8 * focal * abs(1 / 10 - 1 / 5)
    y, x = np.mgrid[:36, :48]
    squares = (x - 23.5) ** 2 + (y - 17.5) ** 2
    # The mean square distance from the middle of a disc is an eighth of its diameter's square, and those of a spread
    # and of what is spread add up.
    own, spread_ = ((squares * seen).sum() / seen.sum() for seen in (in_focus.astype(np.float64), light))
    assert spread_ - own == pytest.approx(diameter**2 / 8, rel=0.05)


def test_colour_filters_give_each_pixel_the_light_of_its_colour():
    materials = {"m": {"color": [0, 0, 0], "emission": [0.9, 0.4, 0.1]}}
    config = config_of([ball(3.0)], materials, optics={"bayer": "rggb"})
    with create_context() as gl, Renderer(gl, sequence_scene(config, 0), RenderConfig()) as renderer:
        light = Optics(renderer, config.optics).light(0)
    middle = light[16:20, 22:26]
    np.testing.assert_allclose(middle[0::2, 0::2], 0.9, rtol=1e-6)
    np.testing.assert_allclose(middle[0::2, 1::2], 0.4, rtol=1e-6)
    np.testing.assert_allclose(middle[1::2, 1::2], 0.1, rtol=1e-6)


def test_events_of_a_sequence_come_through_its_optics():
    """A blurred edge that passes makes its events over more columns, and as many of them in all of its contrast."""
    way = {
        "interpolation": "linear",
        "keyframes": [{"time": 0, "position": [0, 1, 0]}, {"time": 0.1, "position": [0, 0.2, 0]}],
    }
    spans, counts = [], []
    for optics in (None, {"psf": {"kind": "gaussian", "sigma": 2.0}}):
        body = {"mesh": "wall", "material": "m", "scale": [1, 2, 40], **way}
        sequence = simulate_sequence(SequenceRequest(config_of([body], optics=optics), 0)).alone
        events = [chunk.events for chunk in sequence.chunks()]
        t, x = (np.concatenate([getattr(e, name) for e in events]) for name in ("t", "x"))
        spans.append(np.mean([np.ptp(t[x == column]) for column in np.unique(x)]))
        counts.append(len(t))
    assert spans[1] > 1.5 * spans[0] and counts[1] == pytest.approx(counts[0], rel=0.25)


@pytest.mark.parametrize(
    ("tree", "words"),
    [
        ({}, "optics that change nothing"),
        ({"psf": {"kind": "kernel", "weights": [[0.5, 0.2, 0.2]]}}, "does not sum to 1"),
        ({"psf": {"kind": "kernel", "weights": [[0.5, 0.5]]}}, "a kernel has a middle"),
        ({"psf": {"kind": "gaussian", "sigma": 0}}, "optics.psf.sigma"),
        ({"bayer": "rgb"}, "optics.bayer"),
    ],
)
def test_optics_that_no_lens_has_are_one_line(tree, words):
    assert words in refusal(ConfigError, optics_of, **tree)
