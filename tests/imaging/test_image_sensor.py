"""Photons, full well, read noise, gain, filters and response of the frame camera, each against its law."""

import numpy as np
import pytest
from scipy import stats

from blinkgl.imaging.sensor import PATTERNS, decode, encode, mosaic, readings

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
