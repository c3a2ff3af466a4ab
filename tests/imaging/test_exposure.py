"""When rows are exposed, what an image is the mean of, and how automatic exposure follows the light."""

import math

import numpy as np
import pytest

from blinkgl.config.images import AutoExposureConfig
from blinkgl.imaging.exposure import Exposure, Setting, accumulate, decibels, factor, instants, next_setting

MS = 1_000_000


def test_a_global_shutter_takes_the_middles_of_equal_cells():
    exposure = Exposure(5 * MS, 10 * MS, 0.0, 7)
    times, weights = exposure.cells(4)
    assert times == [6_250_000, 8_750_000, 11_250_000, 13_750_000]
    assert (weights == 0.25).all() and weights.shape == (4, 7)
    assert exposure.end_ns == 15 * MS and exposure.middle_ns == 10 * MS


@pytest.mark.parametrize(
    ("exposure_ns", "row_ns", "count"),
    [(10 * MS, 300_000.0, 5), (200_000, 50_000.0, 9), (1 * MS, 1 * MS, 24), (MS, 1.5, 3)],
)
def test_each_row_weighs_the_cells_by_what_of_them_it_sees(exposure_ns, row_ns, count):
    exposure = Exposure(3 * MS, exposure_ns, row_ns, 24)
    times, weights = exposure.cells(count)
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

AUTO = AutoExposureConfig(target=0.2, lag=0.3, shortest_us=1, longest_us=1e9, max_gain_db=60)


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
    config = AutoExposureConfig(target=0.2, lag=0.0, shortest_us=100, longest_us=10_000, max_gain_db=20)
    now = Setting(1_000_000, 1.0)
    assert next_setting(config, now, 0.1, 0.1) == Setting(2_000_000, 1.0)
    assert next_setting(config, now, 0.01, 0.1) == Setting(10_000_000, pytest.approx(2.0))
    assert next_setting(config, now, 0.0, 0.1) == Setting(10_000_000, pytest.approx(10.0))
    assert next_setting(config, now, 1.0, 0.1) == Setting(200_000, 1.0)
    assert next_setting(config, Setting(200_000, 1.0), 1.0, 0.1) == Setting(100_000, 1.0)
    assert decibels(factor(13.7)) == pytest.approx(13.7) and factor(20.0) == pytest.approx(10.0)
