"""Metrics and baselines against cases worked out by hand."""

import numpy as np
import pytest

pytest.importorskip("torch")

from eflow.metrics import Tally, angle_2d, angle_3d, frame_metrics


def frame(*vectors) -> np.ndarray:
    return np.array(vectors, float)[None]


EVERY = np.ones((1, 4), bool)


def test_by_hand():
    truth = frame((3, 4), (100, 0), (0, 10), (1, 0))
    predicted = frame((3, 4), (104, 0), (0, 14), (1, 2))  # errors 0, 4, 4, 2
    m = frame_metrics(predicted, truth, EVERY)
    assert m["AEE"] == pytest.approx(10 / 4)
    assert m["outlier"] == pytest.approx(25)  # 4 px of 100 px is under 5 %: only the third counts
    assert (m["1PE"], m["2PE"], m["3PE"]) == (75, 50, 50)
    angles = [0, 0, 0, np.degrees(np.arctan2(2, 1))]
    assert m["AE2D"] == pytest.approx(np.mean(angles))
    assert m["cosine"] == pytest.approx((3 + 1 / np.sqrt(5)) / 4)
    third = np.degrees(np.arccos((104 * 100 + 1) / np.sqrt((104**2 + 1) * (100**2 + 1))))
    fourth = np.degrees(np.arccos((10 * 14 + 1) / np.sqrt((14**2 + 1) * 101)))
    last = np.degrees(np.arccos((1 + 1) / np.sqrt(6 * 2)))
    assert m["AE3D"] == pytest.approx((third + fourth + last) / 4)


def test_valid_mask_and_400_px_rule():
    truth, predicted = frame((1, 0), (400, 0), (0, 399.9), (5, 5)), np.zeros((1, 4, 2))
    m = frame_metrics(predicted, truth, np.array([[True, True, True, False]]))
    assert m["AEE"] == pytest.approx((1 + 399.9) / 2)
    truth[0, 3] = np.nan  # invalid pixels may hold anything
    assert frame_metrics(predicted, truth, np.array([[True, False, False, False]]))["AEE"] == 1
    assert frame_metrics(predicted, truth, np.zeros((1, 4), bool)) is None


def test_angles_at_the_ends():
    a = np.array([1.0, 0.0])
    assert angle_2d(a, -a) == np.pi and angle_2d(a, a) == 0
    assert angle_2d(a, a + (0, 1e-9)) == pytest.approx(1e-9)  # arccos of the rounded cosine would give 0
    assert angle_2d(a, np.zeros(2)) == pytest.approx(np.pi / 2) and angle_2d(np.zeros(2), np.zeros(2)) == 0
    assert angle_3d(np.zeros(2), np.zeros(2)) == 0
    assert angle_3d(np.array([1.0, 0]), np.zeros(2)) == pytest.approx(np.pi / 4)


def test_mean_of_scenes_of_frames():
    tally = Tally()
    for scene, value in (("a", 1.0), ("a", 3.0), ("b", 10.0)):
        tally.add(scene, frame_metrics(frame((value, 0)), frame((0, 0)), np.ones((1, 1), bool)))
    tally.add("b", None)
    assert tally.scenes()["a"]["AEE"] == 2 and tally.scenes()["a"]["frames"] == 2
    assert tally.total()["AEE"] == 6  # not (1 + 3 + 10) / 3
    assert tally.total()["frames"] == 3 and tally.skipped == 1
    assert Tally().total() == {}
