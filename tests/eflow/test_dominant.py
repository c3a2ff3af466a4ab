"""Flow drawn towards its dominant affine motion (eflow/methods/dominant.py)."""

import numpy as np
import pytest

from eflow.methods.dominant import LEAST_PIXELS, dominant_motion, toward_dominant

HEIGHT, WIDTH = 60, 90


def turning(rate: float = 0.05) -> np.ndarray:
    """Flow of a camera that rolls and drifts, px: affine by definition."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([4 - rate * (y - 20), -1 + rate * (x - 50)], axis=-1).astype(np.float32)


def everywhere() -> np.ndarray:
    return np.ones((HEIGHT, WIDTH), bool)


def test_an_affine_field_is_itself():
    affine, off = dominant_motion(turning(), everywhere())
    np.testing.assert_allclose(affine, turning(), atol=1e-5)
    assert off < 1e-5
    np.testing.assert_allclose(toward_dominant(turning(), everywhere()), turning(), atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_errors_of_single_places_shrink_and_a_body_keeps_its_motion(seed):
    rng = np.random.default_rng(seed)
    truth = turning()
    body = np.zeros((HEIGHT, WIDTH), bool)
    body[20:34, 30:46] = True  # 4 % of the picture moves against it
    truth[body] = (-6, 5)
    flow = truth + rng.normal(0, 0.4, truth.shape).astype(np.float32)
    hit = rng.random((HEIGHT, WIDTH)) < 0.3
    drawn = toward_dominant(flow, hit)
    error = lambda f, where: np.hypot(*(f - truth)[where].T).mean()
    assert error(drawn, ~body) < 0.4 * error(flow, ~body)
    assert error(drawn, body) < 1.1 * error(flow, body)


def test_a_still_camera_keeps_its_bodies():
    flow = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    flow[10:30, 10:40] = (3, 1)
    drawn = toward_dominant(flow, everywhere())
    np.testing.assert_allclose(drawn[15:25, 15:35], flow[15:25, 15:35], atol=0.01)
    assert np.abs(drawn[40:]).max() < 0.1


def test_flow_of_depth_and_bodies_is_left():
    """Layers that slide by at 1 to 4 px have no motion that most of the picture shares."""
    flow = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    flow[..., 0] = 1 + np.random.default_rng(0).permutation(np.arange(WIDTH) % 4)
    np.testing.assert_allclose(toward_dominant(flow, everywhere()), flow, atol=0.02)


def test_a_large_picture_is_fitted_by_every_nth_pixel():
    large = np.repeat(np.repeat(turning(), 8, 0), 8, 1)
    drawn = toward_dominant(large, np.ones(large.shape[:2], bool))
    assert drawn.shape == large.shape and drawn.dtype == np.float32
    np.testing.assert_allclose(drawn, large, atol=0.4)  # within one of its steps


def test_a_few_pixels_say_nothing():
    hit = np.zeros((HEIGHT, WIDTH), bool)
    hit.ravel()[: LEAST_PIXELS - 1] = True
    flow = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 2)).astype(np.float32)
    assert toward_dominant(flow, hit) is flow


def test_silent_and_still():
    nothing = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    assert not toward_dominant(nothing, everywhere()).any()


def test_flow_that_is_not_finite_is_left():
    flow = np.ones((HEIGHT, WIDTH, 2), np.float32)
    flow[3, 4, 0] = np.nan
    assert toward_dominant(flow, everywhere()) is flow
