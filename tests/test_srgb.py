"""The transfer curve against the standard's own numbers, and its inverse."""

import numpy as np
import pytest

from blinkgl.srgb import DECODE_8BIT, linear_from_srgb, srgb_from_linear, to_srgb8


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
