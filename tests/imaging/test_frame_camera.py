"""A frame camera's images against what they stand for: means of instants, rows at their own times, a thin lens."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.config.images import AutoExposureConfig, ImagesConfig, exposure_starts
from blinkgl.config.sequence import RenderConfig
from blinkgl.imaging import FrameCamera
from blinkgl.imaging.exposure import Exposure, Setting, accumulate, decibels, factor, instants, next_setting
from blinkgl.imaging.lens import blur_px, samples
from blinkgl.imaging.sensor import PATTERNS, decode, encode, mosaic, readings
from blinkgl.render.renderer import Renderer
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Light, Material
from blinkgl.tools.shader_debugger.appearance import sample_bilinear
from tests.render.render_scenes import LEVEL, SECOND, cube, drift, quad, scene, smooth_texture, still, thing
from tests.timeline.test_motions import body_that_jumps, stepped_body

MS = 1_000_000
PLAIN = RenderConfig(image_antialiasing="none")
FINE = RenderConfig(image_antialiasing="ssaa2")
LINEAR = {"bits": 16, "response": "linear"}
STEP = 1 / 255
"""Of 8 bits, linear."""


TOWARDS = Rotation.from_euler("x", 90, degrees=True)
"""+z of a quad to world -y, where the camera is."""


def rig(width=48, height=36, focal=60.0, path=None):
    return Rig.alone(PinHole.centred(width, height, focal), path or still(rotation=LEVEL))


def moving(speed=(1.0, 0.0, 0.4), **of_rig):
    """A smooth wall behind a hard-edged box that passes before it; world +y is the way the camera looks."""
    wall = thing("wall", 1, quad(8, 6), still((0, 8, 0), TOWARDS), Material(smooth_texture(1), unlit=True))
    box = thing(
        "box", 2, cube(0.5), drift((0, 4, 0), tuple(np.add((0, 4, 0), speed))), Material(smooth_texture(2), unlit=True)
    )
    return scene([wall, box], rig(**of_rig), Light(), 0.1)


def camera_of(renderer, seed=1, span=(0, SECOND), **config):
    return FrameCamera(renderer, ImagesConfig(**config), seed, span)


def light_of(image, bits=16):
    return decode(image, "linear", 2.2, bits)


# --- motion blur ------------------------------------------------------------------------------------------------------


def test_an_image_is_the_mean_of_the_instants_of_its_exposure(gl):
    with Renderer(gl, moving(), FINE) as renderer:
        image = camera_of(renderer, exposure_us=200_000, rate=5, max_px=1e-3, max_instants=256, **LINEAR).take()
        times = [(k + 0.5) / 256 * 0.2 * SECOND for k in range(256)]
        mean = np.mean([renderer.colour(int(t)).read().astype(np.float64) for t in times], axis=0)
    assert image.instants == 256 and image.start_ns == 0 and image.end_ns == 200 * MS
    np.testing.assert_allclose(light_of(image.image), np.clip(mean, 0, 1), atol=0.51 / 65535)
    assert np.ptp(mean) > 0.5


def test_displacement_asks_for_enough_instants(gl):
    """3 px of motion in an exposure: as many instants as asked for give what 256 give, within half a step of 8 bits
    where surfaces are smooth, and but for few pixels where a hard edge passes; half the spacing, half the error."""
    with Renderer(gl, moving(), FINE) as renderer:
        take = lambda **how: camera_of(renderer, exposure_us=200_000, rate=5, **how, **LINEAR).take()
        truth = light_of(take(max_px=1e-3, max_instants=256).image)
        found = [take(max_px=px) for px in (0.5, 0.25, 0.125)]
        still_wall = moving(speed=(0, 0, 0))
    assert [image.instants for image in found] == sorted(image.instants for image in found)
    assert all(image.step_px <= px for image, px in zip(found, (0.5, 0.25, 0.125)))
    errors = [np.abs(light_of(image.image) - truth) / STEP for image in found]
    assert all((error <= 0.5).mean() > share for error, share in zip(errors, (0.9, 0.93, 0.96)))
    assert errors[0].mean() > 1.6 * errors[1].mean() > 2.5 * errors[2].mean()
    # a camera that turns past smooth surfaces alone: everywhere
    way = drift((0, 0, 0), (0.4, 0, 0), LEVEL, LEVEL)
    turning = replace(still_wall, rig=replace(still_wall.rig, path=way))
    with Renderer(gl, turning.__class__(turning.objects[:1], turning.rig, 0, SECOND), FINE) as renderer:
        take = lambda **how: camera_of(renderer, exposure_us=500_000, rate=2, **how, **LINEAR).take()
        truth, image = take(max_px=1e-3, max_instants=256), take()
    assert 2 <= image.instants <= 8 and np.ptp(light_of(truth.image)) > 0.3
    assert (np.abs(light_of(image.image) - light_of(truth.image)) <= 0.5 * STEP).all()


@pytest.mark.parametrize("world", [body_that_jumps, stepped_body])
def test_what_stands_elsewhere_for_a_moment_of_an_exposure_is_a_ghost(gl, world):
    """The mean of 2,000 pictures, to the part of the exposure that the most instants tell apart."""
    with Renderer(gl, world(), FINE) as renderer:
        image = camera_of(renderer, exposure_us=40_000, rate=25, max_instants=200, **LINEAR).take()
        truth = np.mean([renderer.colour(20_000 * k + 10_000).read() for k in range(2_000)], axis=0)
        at_rest = renderer.colour(1_000).read()
    assert image.instants == 200 and np.abs(truth - at_rest).max() > 0.01
    np.testing.assert_allclose(light_of(image.image), truth, atol=1 / 200)


def test_what_stands_still_is_drawn_once(gl):
    with Renderer(gl, moving(speed=(0, 0, 0)), FINE) as renderer:
        camera = camera_of(renderer, exposure_us=100_000, rate=5, also=("sharp", "clean"))
        image = camera.take()
    assert image.instants == 1
    np.testing.assert_array_equal(image.image, image.pictures["sharp"])
    np.testing.assert_array_equal(image.image, image.pictures["clean"])


def test_sharp_is_the_middle_and_blurred_is_not(gl):
    with Renderer(gl, moving(), FINE) as renderer:
        image = camera_of(renderer, exposure_us=200_000, rate=5, also=("sharp",), photon_noise=True, **LINEAR).take()
        middle = renderer.colour(image.middle_ns).read()
    np.testing.assert_allclose(light_of(image.pictures["sharp"]), np.clip(middle, 0, 1), atol=0.51 / 65535)
    assert np.abs(light_of(image.image) - np.clip(middle, 0, 1)).max() > 20 * STEP


# --- rolling shutter --------------------------------------------------------------------------------------------------


def test_rows_of_a_rolling_shutter_are_rendered_at_their_own_times(gl):
    """With an exposure as short as the time between two rows, each row is the picture at its own middle."""
    rows, row_us = 36, 5000.0
    with Renderer(gl, moving(speed=(2.0, 0, 0)), FINE) as renderer:
        camera = camera_of(
            renderer, exposure_us=row_us, row_us=row_us, rate=2, max_px=1e-4, max_instants=rows, **LINEAR
        )
        image = camera.take()
        own = np.stack([renderer.colour(int((y + 0.5) * row_us * 1000)).read()[y] for y in range(rows)])
        first = renderer.colour(int(0.5 * row_us * 1000)).read()
    assert image.end_ns - image.start_ns == round(rows * row_us * 1000) and image.row_ns == row_us * 1000
    np.testing.assert_allclose(light_of(image.image), np.clip(own, 0, 1), atol=0.51 / 65535)
    assert np.abs(own - first).max() > 0.1, "it moves while it is read"


# --- the lens ---------------------------------------------------------------------------------------------------------


def thin_lens(x, y, camera, aperture, focus, planes, count):
    """Radiance, float64, of pixels through a thin lens: rays from points spread over the aperture to where the pixel's
    own ray meets the plane in focus, and the nearest of the ``planes`` (depth, half width, half height, texture,
    its repeats)."""
    rng = np.random.default_rng(7)
    r, angle = np.sqrt(rng.random(count)) * aperture / 2, 2 * math.pi * rng.random(count)
    lens = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
    aim = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy]) * focus
    colour, hit = np.full((count, 3), 0.1), np.zeros(count, bool)
    for depth, half_x, half_y, texture, repeats in sorted(planes, key=lambda p: p[0]):
        at = lens + (aim - lens) * (depth / focus)
        inside = (np.abs(at) <= [half_x, half_y]).all(axis=1) & ~hit
        uv = np.stack([0.5 + 0.5 * at[:, 0] / half_x, 0.5 + 0.5 * at[:, 1] / half_y], axis=1)
        colour[inside] = sample_bilinear(texture, uv[inside] * repeats)
        hit |= inside
    return colour.mean(axis=0), colour.std(axis=0) / math.sqrt(count)


@pytest.mark.parametrize(("focus", "aperture"), [(4.0, 0.5), (8.0, 0.5), (2.5, 0.2)])
def test_defocus_agrees_with_rays_through_a_thin_lens(gl, focus, aperture):
    walls = [(8.0, 8.0, 6.0, smooth_texture(1), (6.0, 4.0)), (4.0, 0.8, 0.7, smooth_texture(2), (1.0, 1.0))]
    things = [
        thing(f"{d}", k + 1, quad(w, h), still((0, d, 0), TOWARDS), Material(texture, uv_scale=repeats, unlit=True))
        for k, (d, w, h, texture, repeats) in enumerate(walls)
    ]
    camera = PinHole.centred(48, 36, 60.0)
    with Renderer(gl, scene(things, Rig.alone(camera, still(rotation=LEVEL)), Light(), 0.1), FINE) as renderer:
        lens = {"aperture": aperture, "focus": focus}
        image = camera_of(renderer, lens=lens, max_px=0.125, max_instants=4096, also=("sharp",), **LINEAR).take()
    largest = float(blur_px(renderer_lens(lens), camera, np.array([4.0, 8.0])).max())
    assert image.instants == samples(largest, 0.25)
    seen, sharp = light_of(image.image), light_of(image.pictures["sharp"])
    edge = 60.0 * 0.8 / 4.0  # of the box, px from the middle
    for x, y in [(5, 5), (23, 17), (30, 20), (round(23.5 + edge), 17), (round(23.5 - edge) + 1, 20), (40, 30), (24, 8)]:
        # the mean over the pixel, which anti-aliasing takes too
        sub = [
            thin_lens(x + a, y + b, camera, aperture, focus, walls, 3000) for a in (-0.25, 0.25) for b in (-0.25, 0.25)
        ]
        true = np.mean([m for m, _ in sub], axis=0)
        noise = np.mean([s for _, s in sub], axis=0) / 2
        assert (np.abs(seen[y, x] - true) < 4 * noise + 0.012).all(), (x, y, seen[y, x], true, sharp[y, x])
    assert np.abs(seen - sharp).max() > 0.05


def renderer_lens(lens):
    return ImagesConfig(lens=lens).lens


def test_what_is_in_focus_stays_sharp_and_a_pin_hole_costs_nothing(gl):
    material = Material(smooth_texture(1), uv_scale=(6.0, 4.0), unlit=True)
    wall = thing("wall", 1, quad(8, 6), still((0, 5, 0), TOWARDS), material)
    with Renderer(gl, scene([wall], rig()), FINE) as renderer:
        focused = camera_of(renderer, lens={"aperture": 0.4, "focus": 5.0}, also=("sharp",), **LINEAR).take()
        assert focused.instants == 1
        np.testing.assert_array_equal(focused.image, focused.pictures["sharp"])
        through = camera_of(renderer, lens={"aperture": 0.8, "focus": 8.0}, also=("sharp",), **LINEAR).take()
        assert (
            through.instants >= 4 and np.abs(light_of(through.image) - light_of(through.pictures["sharp"])).max() > STEP
        )


# --- vignetting, exposure, filters ------------------------------------------------------------------------------------


@pytest.mark.parametrize("strength", [0.4, 1.0])
def test_vignetting_is_the_fourth_power_of_the_cosine(gl, strength):
    with Renderer(gl, scene([], rig(focal=20.0), background=0.8), PLAIN) as renderer:
        image = camera_of(renderer, vignetting=strength, **LINEAR).take()
    y, x = np.mgrid[:36, :48]
    squared = ((x - 23.5) / 20.0) ** 2 + ((y - 17.5) / 20.0) ** 2
    expected = 0.8 * (1 - strength * (1 - 1 / (1 + squared) ** 2))
    np.testing.assert_allclose(light_of(image.image), np.repeat(expected[..., None], 3, axis=2), atol=0.51 / 65535)


def test_automatic_exposure_approaches_its_end_as_its_lag_says(gl):
    """A uniform scene that clips nowhere: the product of exposure and gain over the images, against the closed form."""
    auto = {"target": 0.2, "lag": 0.15, "longest_us": 20_000, "max_gain_db": 40}
    with Renderer(gl, scene([], rig(), background=0.6), PLAIN) as renderer:
        camera = camera_of(renderer, rate=20, exposure_us=1500, white=2.0, auto_exposure=auto, **LINEAR)
        images = [camera.take() for _ in range(len(camera))]
    products = np.array([image.exposure_ns * image.gain for image in images])
    mean = 0.6 / 2.0 / 1.5e6  # per ns at gain 1
    t = np.array([image.start_ns for image in images]) * 1e-9
    end = 0.2 / mean
    expected = np.log(end) + (np.log(1.5e6) - np.log(end)) * np.exp(-t / 0.15)
    np.testing.assert_allclose(np.log(products), expected, atol=2e-4)  # codes of the readings are not rounded
    seen = np.array([light_of(image.image).mean() for image in images])
    np.testing.assert_allclose(seen, mean * products, rtol=1e-4)
    assert seen[-1] == pytest.approx(0.2, rel=0.01) and camera.due_ns is None


def test_gain_keeps_white_white_and_takes_fewer_photons_for_it(gl):
    with Renderer(gl, scene([], rig(), background=0.5), PLAIN) as renderer:
        found = {}
        for gain_db in (0.0, 20.0):
            image = camera_of(renderer, gain_db=gain_db, photon_noise=True, full_well=10_000, **LINEAR).take()
            found[gain_db] = light_of(image.image)
    for gain_db, x in found.items():
        electrons = 10_000 / 10 ** (gain_db / 20)
        assert x.mean() == pytest.approx(0.5, rel=5 / math.sqrt(0.5 * electrons * x.size))
        assert x.var() == pytest.approx(x.mean() / electrons, rel=0.08)


def test_black_level_bits_and_filters(gl):
    with Renderer(gl, moving(), FINE) as renderer:
        full = camera_of(renderer, bits=12, response="linear", black=0.0625).take()
        raw = camera_of(renderer, bits=12, response="linear", black=0.0625, bayer="grbg").take()
        light = renderer.colour(full.middle_ns).read()
    assert full.image.dtype == np.uint16 and full.image.shape == (36, 48, 3) and raw.image.shape == (36, 48)
    for y, x, channel in ((0, 0, 1), (0, 1, 0), (1, 0, 2), (1, 1, 1)):
        np.testing.assert_array_equal(raw.image[y::2, x::2], full.image[y::2, x::2, channel])
    assert full.image.min() >= round(0.0625 * 4095) and full.image.max() <= 4095
    still_image = np.floor((0.0625 + 0.9375 * np.clip(light, 0, 1)) * 4095 + 0.5)
    assert np.median(np.abs(still_image - full.image)) <= 3


# --- times ------------------------------------------------------------------------------------------------------------


def test_images_are_taken_while_their_exposure_fits(gl):
    assert exposure_starts(ImagesConfig(rate=10, exposure_us=50_000), 0, SECOND, 36) == [
        k * 100 * MS for k in range(10)
    ]
    assert len(exposure_starts(ImagesConfig(rate=10, exposure_us=100_000), 0, SECOND, 36)) == 10
    assert len(exposure_starts(ImagesConfig(rate=10, exposure_us=100_000, row_us=1), 0, SECOND, 36)) == 9
    assert exposure_starts(ImagesConfig(times=(0.5, 0.6)), 0, SECOND, 36) == [500 * MS, 600 * MS]
    with Renderer(gl, moving(), PLAIN) as renderer:
        camera = camera_of(renderer, times=(0.25, 0.5), exposure_us=10_000)
        due = []
        while camera.due_ns is not None:
            due.append(camera.due_ns)
            image = camera.take()
            assert image.t_ns == due[-1] and image.k == len(due) - 1
    assert due == [260 * MS, 510 * MS] and camera.facts()["images"] == 2


# --- When rows are exposed, what an image is the mean of, and how automatic exposure follows the light.


def test_a_global_shutter_takes_the_middles_of_equal_cells():
    exposure = Exposure(5 * MS, 10 * MS, 0.0, 7)
    cells, weights = exposure.cells(4)
    assert [middle for _, middle, _ in cells] == [6_250_000, 8_750_000, 11_250_000, 13_750_000]
    assert [(begin, end) for begin, _, end in cells][1:] == [
        (7_500_000, 10 * MS),
        (10 * MS, 12_500_000),
        (12_500_000, 15 * MS),
    ]
    assert (weights == 0.25).all() and weights.shape == (4, 7)
    assert exposure.end_ns == 15 * MS and exposure.middle_ns == 10 * MS


@pytest.mark.parametrize(
    ("exposure_ns", "row_ns", "count"),
    [(10 * MS, 300_000.0, 5), (200_000, 50_000.0, 9), (1 * MS, 1 * MS, 24), (MS, 1.5, 3)],
)
def test_each_row_weighs_the_cells_by_what_of_them_it_sees(exposure_ns, row_ns, count):
    exposure = Exposure(3 * MS, exposure_ns, row_ns, 24)
    cells, weights = exposure.cells(count)
    times = [middle for _, middle, _ in cells]
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, rtol=1e-12)
    # by brute force: in which cell are a million instants of the row's own exposure
    span = exposure.end_ns - exposure.start_ns
    for row in (0, 11, 23):
        seen = row * row_ns + exposure_ns * (np.arange(200_000) + 0.5) / 200_000
        share = np.bincount(np.minimum((seen / span * count).astype(int), count - 1), minlength=count) / 200_000
        np.testing.assert_allclose(weights[:, row], share, atol=2e-5)
        # so the mean time that a row sees is its own middle, as far as its cells reach
        middle = exposure.start_ns + row * row_ns + exposure_ns / 2
        assert abs(weights[:, row] @ np.array(times) - middle) <= span / count / 2 + 2


def test_as_many_instants_as_displacement_asks_for():
    exposure = Exposure(0, 20 * MS, 0.0, 10)
    assert instants(exposure, 0.0, 0.5, 1, 256) == 1, "nothing moves: once"
    assert instants(exposure, 200.0, 0.5, 1, 256) == 8, "4 px, half a pixel each"
    assert instants(exposure, 201.0, 0.5, 1, 256) == 9
    assert instants(exposure, 1e9, 0.5, 1, 256) == 256 and instants(exposure, 1e9, 0.5, 1, 7) == 7
    assert instants(exposure, 0.0, 0.5, 30, 256) == 30, "points of the lens"
    rolling = Exposure(0, 20 * MS, 2.0 * MS, 11)
    assert instants(rolling, 0.0, 0.5, 30, 256) == 60, "so many in every row's own exposure"


def test_light_is_added_up_row_by_row_and_rows_without_weight_stay():
    rng = np.random.default_rng(0)
    images, weights = rng.random((3, 4, 5, 4)).astype(np.float32), rng.random((3, 4))
    weights[1, 2] = 0.0
    images[1, 2] = np.nan
    total = np.zeros((4, 5, 3))
    for image, weight in zip(images, weights):
        accumulate(total, image, weight)
    expected = sum(w[:, None, None] * np.where(w[:, None, None] > 0, i[..., :3], 0) for i, w in zip(images, weights))
    np.testing.assert_allclose(total, expected, rtol=1e-12)


# --- automatic exposure -----------------------------------------------------------------------------------------------

AUTO = AutoExposureConfig(target=0.2, lag=0.3, longest_us=1e9, max_gain_db=60)


def settings(config, scene_means, setting, dt_s):
    """Products of exposure and gain, under light of which an exposure of 1 ns would give ``mean``."""
    out = [setting.product]
    for mean in scene_means:
        setting = next_setting(config, setting, mean * setting.product, dt_s)
        out.append(setting.product)
    return np.array(out)


@pytest.mark.parametrize("dt_s", [0.01, 0.05, 0.4])
def test_the_lag_is_first_order_in_the_logarithm_whatever_the_rate(dt_s):
    mean_per_ns = 1e-9
    products = settings(AUTO, [mean_per_ns] * 40, Setting(5_000_000, 1.0), dt_s)
    end = AUTO.target / mean_per_ns
    t = dt_s * np.arange(41)
    expected = math.log(end) + (math.log(5e6) - math.log(end)) * np.exp(-t / AUTO.lag)
    np.testing.assert_allclose(np.log(products), expected, atol=2e-6)


def test_time_changes_first_gain_beyond_it_and_both_keep_to_their_limits():
    config = AutoExposureConfig(target=0.2, lag=0.0, longest_us=10_000, max_gain_db=20)
    now = Setting(1_000_000, 1.0)
    assert next_setting(config, now, 0.1, 0.1) == Setting(2_000_000, 1.0)
    assert next_setting(config, now, 0.01, 0.1) == Setting(10_000_000, pytest.approx(2.0))
    assert next_setting(config, now, 0.0, 0.1) == Setting(10_000_000, pytest.approx(10.0))
    assert next_setting(config, now, 1.0, 0.1) == Setting(200_000, 1.0)
    assert next_setting(config, Setting(50_000, 1.0), 1.0, 0.1) == Setting(20_000, 1.0)
    assert decibels(factor(13.7)) == pytest.approx(13.7) and factor(20.0) == pytest.approx(10.0)


# --- Photons, full well, read noise, gain, filters and response of the frame camera, each against its law.

SEED = np.uint64(0xFEEDBEEF12345678)


def read(light, count, electrons=1000.0, gain=1e-3, well=1e9, photons=True, noise=0.0, seed=SEED, image=0):
    out = np.empty(count)
    light = np.broadcast_to(np.float64(light), count).copy()
    readings(light, electrons, gain, well, photons, noise, np.uint64(seed), np.uint64(image), out)
    return out


def drawn(mean, count, seed=SEED, image=0):
    """Electrons of ``count`` pixels: one for each of the light's units, and nothing else happens to them."""
    return read(mean, count, electrons=1.0, gain=1.0, well=1e18, seed=seed, image=image)


@pytest.mark.parametrize("mean", [0.05, 0.7, 4.0, 9.99, 10.0, 10.7, 33.3, 400.0, 20000.0])
def test_photons_are_poisson_distributed(mean):
    """Both methods, on either side of where they meet: the whole distribution by chi-square."""
    count = 200_000
    k = drawn(mean, count, SEED, np.uint64(3))
    assert (k >= 0).all() and (k == np.floor(k)).all()
    law = stats.poisson(mean)
    edges = np.unique(law.ppf(np.linspace(0.002, 0.998, 60)))
    expected = count * np.diff(np.concatenate([[0.0], law.cdf(edges), [1.0]]))
    found = np.bincount(np.searchsorted(edges, k), minlength=len(edges) + 1)
    keep = expected > 5
    chi2 = ((found - expected)[keep] ** 2 / expected[keep]).sum()
    assert stats.chi2.sf(chi2, keep.sum() - 1) > 1e-4, f"chi2 {chi2:.1f} of {keep.sum()} bins"
    assert abs(k.mean() - mean) < 5 * np.sqrt(mean / count)
    assert abs(k.var() / mean - 1) < 5 * np.sqrt((2 + 1 / mean) / count)


def test_read_noise_is_normal_and_adds_to_the_photons():
    alone = read(0.0, 200_000, photons=False, noise=6.0) / 1e-3
    assert stats.kstest(alone / 6.0, "norm").pvalue > 1e-3
    both = read(0.4, 200_000, noise=6.0) / 1e-3
    assert both.var() == pytest.approx(400 + 36, rel=0.02) and both.mean() == pytest.approx(400, abs=0.3)


def test_the_full_well_cuts_electrons_before_the_read_noise():
    x = read(5.0, 50_000, electrons=1000.0, well=1500.0, noise=3.0) / 1e-3
    assert x.mean() == pytest.approx(1500, abs=0.1) and x.std() == pytest.approx(3.0, rel=0.03), (
        "no photon noise is left"
    )
    assert (read(5.0, 1000, electrons=1000.0, well=1500.0) == 1.5).all()
    near = read(1.0, 50_000, electrons=1000.0, well=1000.0) / 1e-3
    assert near.max() == 1000.0 and 0.4 < (near == 1000.0).mean() < 0.6
    assert (read(1e12, 10, well=1e4) == 1e4 * 1e-3).all(), "any light"


def test_noise_is_a_function_of_seed_image_and_pixel():
    a = read(0.5, 4096, noise=2.0)
    np.testing.assert_array_equal(a, read(0.5, 4096, noise=2.0))
    np.testing.assert_array_equal(a[:100], read(0.5, 100, noise=2.0))
    others = [read(0.5, 4096, noise=2.0, image=1), read(0.5, 4096, noise=2.0, seed=SEED + np.uint64(1))]
    for b in others:
        assert abs(np.corrcoef(a, b)[0, 1]) < 5 / 64
    assert abs(np.corrcoef(a[:-1], a[1:])[0, 1]) < 5 / 64, "neighbours"


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_mosaic_has_of_each_pixel_the_colour_that_its_name_says(pattern):
    image = np.arange(5 * 7 * 3).reshape(5, 7, 3)
    out = mosaic(image, pattern)
    for y in range(5):
        for x in range(7):
            assert out[y, x] == image[y, x, "rgb".index(pattern[2 * (y % 2) + x % 2])]


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
@pytest.mark.parametrize(("response", "gamma"), [("srgb", 2.2), ("linear", 2.2), ("gamma", 2.2), ("gamma", 0.5)])
def test_responses_invert(response, gamma, bits):
    codes = np.arange(1 << bits)
    light = decode(codes, response, gamma, bits)
    assert light[0] == 0 and light[-1] == pytest.approx(1.0) and (np.diff(light) > 0).all()
    again = encode(light, response, gamma, bits)
    assert again.dtype == (np.uint8 if bits == 8 else np.uint16)
    np.testing.assert_array_equal(again, codes)
    # and any light comes back within half a code's step
    x = np.random.default_rng(1).random(20_000)
    step = np.gradient(light)
    assert (np.abs(decode(encode(x, response, gamma, bits), response, gamma, bits) - x) <= 1.01 * step.max()).all()
