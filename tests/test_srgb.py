"""The transfer curve against the standard's own numbers, and its inverse."""

import numpy as np
import pytest

from blinkgl.srgb import DECODE_8BIT, KNEE, linear_from_srgb, srgb_from_linear, to_srgb8, tone_mapped


def test_values_of_the_standard():
    """IEC 61966-2-1: 0.5 encoded is 0.21404 in linear light; the linear piece ends at 0.04045."""
    assert linear_from_srgb(0.5) == pytest.approx(0.2140411, abs=1e-7)
    assert linear_from_srgb(0.04045) == pytest.approx(0.04045 / 12.92)
    assert (
        linear_from_srgb(np.float64(0.5)).dtype == np.float64 and linear_from_srgb(np.float32(0.5)).dtype == np.float32
    )


def test_inverse():
    x = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(x)), x, atol=1e-7)
    np.testing.assert_array_equal(to_srgb8(DECODE_8BIT), np.arange(256))


def test_out_of_range_is_clipped():
    assert to_srgb8(np.array([-1, np.nan, 2, np.inf], np.float32)).tolist() == [0, 0, 255, 255]


def test_tone_mapping_leaves_what_fits_and_clips_nothing():
    """Nothing above 1, the order kept, hues kept, the knee smooth; and where nothing would clip the array itself."""
    plain = np.random.default_rng(0).random((5, 7, 3)).astype(np.float32)
    assert tone_mapped(plain, 1.0) is plain
    for brightest in (1.0001, 1.4, 30.0, 1e6):
        light = np.concatenate([np.linspace(0, 1.2, 500), np.geomspace(1.2, brightest, 500)]).astype(np.float32)
        light = light[light <= brightest]
        out = tone_mapped(light[None], brightest)[0]
        np.testing.assert_array_equal(out[light <= KNEE], light[light <= KNEE])
        assert (np.diff(out[np.argsort(light)]) >= -2e-7).all() and out.max() <= 1 + 1e-6
        assert tone_mapped(np.array([[brightest]], np.float32), brightest).item() == pytest.approx(1.0, abs=1e-5)
        # a knee without a kink: the slope just above it is still 1
        step = np.float32(1e-3)
        assert (tone_mapped(np.array([[KNEE + step]], np.float32), brightest).item() - KNEE) == pytest.approx(
            step, rel=0.02
        )
    colour = np.array([[[4.0, 2.0, 1.0]]], np.float32)
    out = tone_mapped(colour, 4.0)[0, 0]
    assert out[0] == pytest.approx(1.0, abs=1e-5) and out[1] / out[0] == pytest.approx(0.5) and out[2] < out[1]
