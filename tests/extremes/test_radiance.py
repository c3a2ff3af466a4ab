"""Light from nothing to 1e9, in the passes and in the emulators."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.config.events import EsimConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Esim
from blinkgl.labels import LabelRequest
from blinkgl.render import reference
from blinkgl.render.renderer import Renderer
from blinkgl.scene.types import Light, Material, Texture
from tests.extremes.measures import FACING
from tests.render.render_scenes import LEVEL, SECOND, drift, quad, rig, scene, still, thing

TILTED = LEVEL * Rotation.from_euler("x", 160, degrees=True)
RADIANCES = [0.0, 1e-12, 1e-9, 1e-6, 1e-3, 1.0, 1e3, 1e6, 1e9]


def bars(**keys):
    """One upright bar per radiance, side by side before a LEVEL camera."""
    return [
        thing(f"bar{k}", k + 1, quad(0.4, 2), still((k - 4, 8, 0), FACING), Material(base_color=(v, v, v), **keys))
        for k, v in enumerate(RADIANCES)
    ]


@pytest.mark.parametrize("antialiasing", ["none", "ssaa4"])
def test_radiance_of_twenty_one_decades(gl, promise, antialiasing):
    """Float32 targets keep 2^-24 of any radiance; the luma weights' sum and the box filter round a few times more."""
    world = scene(bars(unlit=True), rig(90, 24, 80.0))
    with Renderer(gl, world, RenderConfig(antialiasing=antialiasing)) as renderer:
        luminance, colour = renderer.luminance(0).read(), renderer.labels(0, LabelRequest("images", "ids"))
    worst = 0.0
    for k, v in enumerate(RADIANCES):
        inside = np.zeros(luminance.shape, bool)
        inside[1:-1, 1:-1] = colour.ids[1:-1, 1:-1] == k + 1
        inside &= np.roll(inside, 1, 1) & np.roll(inside, -1, 1)  # not the bar's edge, which super-sampling blends
        assert inside.sum() > 20
        if v == 0.0:
            assert (luminance[inside] == 0).all() and (colour.colour[inside] == 0).all()
        else:
            worst = max(worst, np.abs(luminance[inside] / v - 1).max(), np.abs(colour.colour[inside] / v - 1).max())
    promise(f"radiance 1e-12 to 1e9, {antialiasing}: relative", worst, 5e-7)


@pytest.mark.parametrize("sun, sky", [(1e9, 0.0), (0.0, 1e-12), (1e9, 1e-12), (0.0, 0.0)])
def test_suns_from_nothing_to_1e9(gl, promise, sun, sky):
    light = Light(sun=sun, sky=sky)
    world = scene([thing("wall", 1, quad(9, 9), still((0, 4, 0), TILTED))], light=light)
    true = reference.render(world, 0)
    with Renderer(gl, world, RenderConfig()) as renderer:
        luminance = renderer.luminance(0).read()
    assert np.isfinite(luminance).all()
    scale = np.abs(true.luminance).max()
    promise(
        f"sun {sun:g}, sky {sky:g}: luminance, relative",
        np.abs(luminance - true.luminance).max() / max(scale, 1e-300),
        1e-6,
    )


def test_a_hot_texel_among_black_ones(gl, promise):
    """One texel of 1e9 in a black HDR texture: mip levels keep its mean (they are box means
    in float32), nothing overflows."""
    image = np.zeros((64, 64, 3), np.float32)
    image[20, 30] = 1e9
    paint = Material(texture=Texture(image), unlit=True)
    world = scene([thing("sky", 1, quad(4, 4), still((0, 8, 0), FACING), paint)], rig(32, 32, 40.0))
    # Every pixel holds 2.7 x 2.7 whole textures.
    wide = scene(
        [
            thing(
                "sky",
                1,
                quad(40, 40),
                still((0, 4, 0), FACING),
                Material(texture=Texture(image), unlit=True, uv_scale=(1600.0, 1600.0)),
            )
        ],
        rig(32, 32, 30.0),
    )
    with Renderer(gl, world, RenderConfig()) as renderer:
        near = renderer.luminance(0).read()
        assert np.isfinite(near).all() and near.min() == 0 and near.max() > 1e8
    with Renderer(gl, wide, RenderConfig()) as renderer:
        luminance = renderer.luminance(0).read()
    promise(
        "a texel of 1e9 among 4095 black ones, minified: mean, relative",
        np.abs(luminance.mean() / (1e9 / 4096) - 1),
        1e-5,
    )


@pytest.mark.parametrize("low, high", [(0.0, 1e9), (1e-12, 1e9), (1e-9, 1e-3), (1e3, 1e9), (0.0, 1e-12)])
def test_esim_between_any_two_radiances(promise, low, high):
    """Events count |d ln(I + eps)| / C, the logarithm in 2^-25 steps: off by one at most,
    where a level is all but reached."""
    config = EsimConfig(contrast_threshold=0.1, threshold_sigma=0, log_eps=1e-9)
    esim = Esim(1, 1, config)
    esim.step(np.full((1, 1), low, np.float32), 0)
    up = esim.step(np.full((1, 1), high, np.float32), SECOND)
    down = esim.step(np.full((1, 1), low, np.float32), 2 * SECOND)
    wanted = np.log((np.float64(np.float32(high)) + 1e-9) / (np.float64(np.float32(low)) + 1e-9)) / 0.1
    promise(f"ESIM from {low:g} to {high:g}: events too many or few", abs(len(up) - int(wanted)), 1)
    assert (up.p == 1).all() and (down.p == 0).all() and abs(len(up) - len(down)) <= 1


def test_the_logarithm_against_float64(promise):
    """Fixed point with 2^-25 steps: absolute, not relative, so that levels are equally spaced everywhere."""
    from blinkgl.events.arith import Q_ONE, log_q25

    v = np.concatenate([np.logspace(-9, 9, 100_001), [2.0**-30, 2.0**30]]).astype(np.float32)
    promise("ln of 2^-30 to 2^30: absolute", np.abs(log_q25(v) / Q_ONE - np.log(v.astype(np.float64))).max(), 1.3e-7)


def test_more_light_than_the_emulators_take_is_refused(gl):
    """2^30 is where fixed-point logarithms end: the pass draws 1e12 well, the emulator says
    what it cannot use, and where."""
    world = scene(
        [thing("wall", 1, quad(9, 9), still((0, 4, 0), FACING), Material(base_color=(1e6,) * 3))],
        rig(8, 6, 8.0),
        Light((0, -1, 0), 1e6, 0.0),
    )
    with Renderer(gl, world, RenderConfig()) as renderer:
        luminance = renderer.luminance(0).read()
    np.testing.assert_allclose(luminance, 1e12, rtol=1e-6)
    with pytest.raises(EventDataError, match="frame 0: intensity at pixel x=0, y=0 cannot be used .* 0 to 1.07e\\+09"):
        Esim(6, 8).step(luminance, 0)


def test_a_moving_dark_thing_before_a_black_sky_fires_nothing(gl):
    """Radiances below log_eps are the same darkness: 1e-12 against 0 is a change of 1e-9 in the logarithm."""
    world = scene(
        [
            thing(
                "ghost",
                1,
                quad(0.5, 0.5),
                drift((-1, 4, 0), (1, 4, 0), FACING),
                Material(base_color=(1e-12,) * 3, unlit=True),
            )
        ],
        rig(40, 30, 40.0),
    )
    esim, events = Esim(30, 40, EsimConfig(contrast_threshold=0.001)), 0
    with Renderer(gl, world, RenderConfig()) as renderer:
        for k in range(11):
            events += len(esim.step(renderer.luminance(k * SECOND // 10).read(), k * SECOND // 10))
    assert events == 0
