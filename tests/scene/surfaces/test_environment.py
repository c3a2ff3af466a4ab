"""Panoramas as light: harmonics against sums over all pixels, the sun that is taken out, what is no panorama."""

from __future__ import annotations

import math

import cv2
import lobes
import numpy as np
import pytest

from blinkgl.errors import AssetError
from blinkgl.scene.lights import ambient
from blinkgl.scene.surfaces import gloss
from blinkgl.scene.surfaces.environment import FINER, environment, pixel_directions, quartic, turned
from blinkgl.scene.surfaces.images import (
    HDR_WHITE,
    MAX_HDR_PIXELS,
    cube_faces,
    load_image,
    load_panorama,
    panorama_picture,
)
from tests.refusals import refusal
from tests.shared_data import shared
from tests.videos import put_exr


def normals(count=200, seed=0):
    n = np.random.default_rng(seed).normal(size=(count, 3))
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def summed(image, n):
    """(N, 3) radiance of a white surface: the sum over all pixels of the panorama."""
    directions, solid = pixel_directions(*image.shape[:2])
    flux = (image * solid[:, None, None]).reshape(-1, 3).astype(np.float64)
    return np.stack([np.maximum(0.0, directions.reshape(-1, 3) @ one) @ flux for one in n]) / np.pi


def received(found, n):
    around = ambient(found.quadric, n, found.quartic)
    return around + sum(np.maximum(0.0, n @ sun.towards)[:, None] * sun.strength for sun in found.suns)


def sky(height=64, sun=None, radius=0.02, brightness=0.0):
    """Blue above, brown below, and a disc."""
    directions, _ = pixel_directions(height, 2 * height)
    up = directions[..., 2:]
    image = np.where(up > 0, [0.3, 0.5, 0.9], [0.2, 0.15, 0.1]) * (1 + 0.3 * directions[..., :1])
    if sun is not None:
        image[directions @ sun > math.cos(radius)] = brightness
    return image.astype(np.float32)


def test_pixels_cover_the_sphere_and_lie_where_the_sky_box_shows_them():
    directions, solid = pixel_directions(48, 96)
    assert solid.sum() * 96 == pytest.approx(4 * np.pi)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=1e-12)
    image = (directions * 0.5 + 0.5).astype(np.float32)
    for face, axis in zip(cube_faces(image, 9), ([1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1])):
        seen = face[4, 4] * 2 - 1
        assert seen @ np.array(axis) > 0.98 * np.linalg.norm(seen), axis


def test_the_same_light_from_everywhere_is_white_furnace():
    """A white surface under constant radiance is as bright as that."""
    found = environment(np.full((32, 64, 3), 0.7, np.float32))
    assert not found.suns
    np.testing.assert_allclose(ambient(found.quadric, normals()), 0.7, atol=1e-3)


def test_a_smooth_sky_is_its_harmonics():
    image = sky()
    true = summed(image, normals())
    error = np.abs(received(environment(image), normals()) - true)
    assert error.mean() < 0.01 * true.mean()


def test_whether_there_is_a_sun_does_not_depend_on_the_exposure():
    towards = np.array([0.3, 0.2, 0.93]) / np.linalg.norm([0.3, 0.2, 0.93])
    for brightness, suns in ((3.0, 0), (5000.0, 1)):
        image = sky(128, towards, 0.03, brightness)
        assert [len(environment(factor * image).suns) for factor in (0.01, 1.0, 100.0)] == [suns] * 3


def test_a_sun_is_found_and_taken_out():
    towards = np.array([0.3, -0.6, 0.74])
    towards /= np.linalg.norm(towards)
    image = sky(256, towards, 0.03, 5000.0)
    found = environment(image)
    (sun,) = found.suns
    assert math.degrees(math.acos(min(1.0, sun.towards @ towards))) < 0.3
    assert sun.size == pytest.approx(0.06, rel=0.2)
    np.testing.assert_allclose(sun.strength, 5000.0 * 0.03**2, rtol=0.1)  # radiance times pi r² of the disc, / pi
    true = summed(image, normals())
    assert np.abs(received(found, normals()) - true).mean() < 0.01 * true.mean()
    without = environment(sky(256))
    np.testing.assert_allclose(found.quadric, without.quadric, atol=0.01)
    assert not environment(image, suns=0).suns


def test_turned_is_what_turning_the_picture_gives():
    towards = np.array([0.8, 0.0, 0.6])
    image = sky(128, towards, 0.05, 3000.0)
    quarter = np.roll(image, -64, axis=1)  # a quarter of 256 columns to the left: from +x towards +y
    one, other = turned(environment(image), math.pi / 2), environment(quarter)
    np.testing.assert_allclose(one.quadric, other.quadric, atol=1e-6)
    assert one.quartic is None and other.quartic is None, "smooth, but for its sun"
    np.testing.assert_allclose(one.suns[0].towards, other.suns[0].towards, atol=1e-9)
    assert one.suns[0].towards[1] > 0.7


def windows(height=64):
    """Bright, in a dark room: too wide for lamps, and too narrow for nine numbers."""
    directions, _ = pixel_directions(height, 2 * height)
    image = np.full((height, 2 * height, 3), 0.2, np.float32)
    for towards in ([1, 0, 0.3], [-0.9, 0.2, 0.4], [0.1, 1, 0.2]):
        image[directions @ (np.array(towards) / np.linalg.norm(towards)) > math.cos(0.45)] = [3.0, 2.5, 2.0]
    return image


def test_what_nine_numbers_lack_is_measured_and_taken_where_it_matters():
    """Exact: the root mean square of what comes on top, and that nothing of order 4 is left."""
    n, image = normals(4000), windows()
    found = environment(image)
    form, size = quartic(image, *pixel_directions(*image.shape[:2]))
    np.testing.assert_allclose(found.quartic, form, atol=1e-12)
    finer = np.einsum("ni,nj->nij", n, n).reshape(-1, 9)
    finer = np.einsum("ni,cij,nj->nc", finer, form, finer)
    np.testing.assert_allclose(np.sqrt((finer**2).mean(axis=0)), size, rtol=0.03)
    few = normals(60)
    true = summed(image, few)
    error, without = (np.abs(received(one, few) - true).mean() for one in (found, found._replace(quartic=None)))
    assert without > 0.01 * true.mean() > 2.5 * error
    # A little less of it, among even light, and it is not worth nine numbers more.
    even = float(true.mean()) * size.max() / (FINER * true.mean())
    for more, taken in ((1.1, False), (0.7, True)):
        assert (environment(image + np.float32(more * even)).quartic is not None) == taken


@pytest.mark.parametrize(
    "name, most, finer", [("city", 0.004, True), ("park", 0.005, False), ("warehouse", 0.0085, True)]
)
def test_real_panoramas(name, most, finer):
    """Mean error over directions, of the mean."""
    image, _ = load_panorama(shared(f"data/assets/hdri/{name}.hdr"))
    few = normals(60)
    true = summed(image, few)
    found = environment(image)
    assert bool(found.suns) == (name != "city") and (found.quartic is not None) == finer
    assert np.abs(received(found, few) - true).mean() <= most * true.mean()


def written(path, image):
    assert cv2.imwrite(str(path), np.ascontiguousarray(image[..., ::-1]))
    return path


def test_hdr_exr_and_eight_bits_are_read(tmp_path):
    image = sky(64, np.array([0, 0, 1.0]), 0.3, 50.0)
    read, factor = load_panorama(written(tmp_path / "a.hdr", image))
    np.testing.assert_allclose(read, image, rtol=0.02, atol=0.01)
    # Metered by luminance, and rows near the zenith and the nadir by their small solid angle.
    luminance, solid = read @ [0.2126, 0.7152, 0.0722] * factor, pixel_directions(64, 128)[1]
    below = [
        float((solid[:, None] * (luminance < level)).sum() / (128 * solid.sum())) for level in (0.8 * 0.98, 0.8 * 1.02)
    ]
    assert below[0] < 0.9 < below[1]
    read, _ = load_panorama(put_exr(tmp_path / "a.exr", image))
    np.testing.assert_array_equal(read, image)
    texture = np.clip(read * 0.8 / np.percentile(read.max(axis=2), 90), 0, 1.5)
    np.testing.assert_allclose(load_image(tmp_path / "a.exr"), texture, rtol=0.02, atol=0.01)
    read, factor = load_panorama(written(tmp_path / "a.png", np.full((4, 8, 3), 188, np.uint8)))
    assert factor == 1.0 and read == pytest.approx(np.float32(0.503), rel=0.01)


def test_what_is_no_panorama(tmp_path):
    image = sky(16)
    bad, negative, endless = image.copy(), image.copy(), image.copy()
    bad[3, 5, 0], negative[2, 2], endless[7, 1, 1] = np.nan, -1, np.inf
    huge = written(tmp_path / "huge.hdr", image).read_bytes().replace(b"-Y 16 +X 32", b"-Y 15000 +X 30000")
    (tmp_path / "huge.hdr").write_bytes(huge)
    for path, expected in (
        (put_exr(tmp_path / "nan.exr", bad), "x=5, y=3: a pixel is not a radiance .got .nan"),
        (put_exr(tmp_path / "inf.exr", endless), "x=1, y=7: a pixel is not a radiance .got .*inf"),
        (put_exr(tmp_path / "minus.exr", negative), "a pixel is not a radiance .got -1"),
        (written(tmp_path / "square.hdr", image[:, :16]), "not a panorama .got '16x16'.; expected twice as wide"),
        (written(tmp_path / "black.hdr", 0 * image), "the panorama is black"),
        (
            tmp_path / "huge.hdr",
            f"the image is too large .got '30000x15000'.; expected at most {MAX_HDR_PIXELS / 1e6:.0f}",
        ),
    ):
        refusal(AssetError, load_panorama, path, match=expected)


# --- What shines, and its surroundings: two looks at a blurred picture against the integral over the lobe.


@pytest.fixture(scope="module")
def made():
    """Surroundings that the table was not fitted by."""
    picture = lobes.surroundings(np.random.default_rng(20))
    return picture, gloss.blurred(picture)


@pytest.mark.parametrize("roughness, most", [(0.1, 0.01), (0.25, 0.015), (0.4, 0.025), (0.6, 0.02), (0.95, 0.02)])
def test_two_looks_are_the_lobe(made, roughness, most):
    """Median relative difference, at cosines and roughnesses between those of the table. One look, as surroundings were
    looked up before, is 2 to 6 % off."""
    rng, errors = np.random.default_rng(3), []
    for cosine in (0.35, 0.65, 0.9):
        n, along = lobes.facing(rng, 16)
        true = lobes.integral(made[0], n, along, cosine, roughness)
        away = cosine * n - np.sqrt(1 - cosine**2) * along
        seen = gloss.mirrored_radiance(made[1], n, away, np.full(len(n), cosine), np.full(len(n), roughness))
        errors.append(np.abs(seen - true) / (true + 0.01))
    assert np.median(errors) < most


def test_a_lobe_along_the_normal_is_what_surroundings_are_blurred_by(made):
    """Of fewer pixels where it is wide, too."""
    n, along = lobes.facing(np.random.default_rng(4), 12)
    for k in (4, 8, gloss.LEVELS - 1):
        roughness = k / (gloss.LEVELS - 1)
        true = lobes.integral(made[0], n, along, 1.0, roughness)
        seen = gloss.mirrored(made[1], n, np.full(len(n), roughness))
        np.testing.assert_allclose(seen, true, rtol=0.01, atol=2e-3 if k > 4 else 0.02)


def test_a_mirror_looks_once():
    n, along = lobes.facing(np.random.default_rng(5), 3)
    away = 0.6 * n - 0.8 * along
    for way, roughness, _ in gloss.both(n, away, gloss.looks()[:1, 38].repeat(3, axis=0)):
        np.testing.assert_allclose(way, away, atol=1e-6)
        assert (roughness == 0).all()


def test_looks_are_shares_of_one_whole():
    cells = gloss.looks()
    assert cells.shape == (*gloss.energy().shape[:2], 5)
    assert (cells >= 0).all() and (cells[..., 4] <= 1).all() and (cells[..., [1, 3]] <= 1).all()


def test_the_drawn_sky_is_as_bright_as_its_light(tmp_path):
    """An evenly blue sky over dark ground: both are scaled by the luminance of nine tenths of the solid angle."""
    image = np.tile(np.array([0.1, 0.2, 2.0], np.float32), (32, 64, 1))
    image[20:] = 0.05
    radiance, factor = load_panorama(written(tmp_path / "a.hdr", image))
    drawn = panorama_picture(tmp_path / "a.hdr")
    np.testing.assert_allclose(drawn, np.clip(radiance * factor, 0, HDR_WHITE), rtol=1e-6)
    grey = written(tmp_path / "a.png", np.full((4, 8, 3), 188, np.uint8))
    np.testing.assert_array_equal(panorama_picture(grey), load_image(grey))
