"""Frames between frames: against scipy's PCHIP, and against motion that is known."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from skimage import data

from blinkgl.errors import EventDataError
from blinkgl.timeline import interpolate


def test_cubic_is_pchip_in_log_luminance():
    rng = np.random.default_rng(0)
    times = np.array([0, 7, 20, 22, 40, 61]) * 1_000_000 + 10**15
    frames = rng.random((6, 5, 7)).astype(np.float32)
    frames[3, 0] = frames[2, 0]  # flat pieces, too
    out = list(interpolate.cubic(zip(frames, times.tolist()), 5))
    assert [t for _, t in out[::5]] == times.tolist() and all(np.array_equal(a, b) for (a, _), b in zip(out[::5], frames))
    reference = PchipInterpolator((times - times[0]) * 1e-6, np.log(frames.astype(np.float64) + 1e-3), axis=0)
    inner = [(f, t) for f, t in out if times[1] <= t <= times[-2]]  # the ends have one neighbour only: linear here, quadratic there
    assert len(inner) == 16
    for frame, t in inner:
        assert np.abs(np.log(frame + 1e-3) - reference((t - times[0]) * 1e-6)).max() < 2e-4
    first = [f for f, t in out if times[0] < t < times[1]]
    assert all(((f >= np.minimum(frames[0], frames[1]) - 1e-5) & (f <= np.maximum(frames[0], frames[1]) + 1e-5)).all() for f in first)


def test_cubic_of_two_frames_and_of_tiny_gaps():
    a, b = np.full((2, 2), 0.1, np.float32), np.full((2, 2), 0.4, np.float32)
    out = list(interpolate.cubic([(a, 0), (b, 1000)], 2))
    assert [t for _, t in out] == [0, 500, 1000] and np.allclose(out[1][0] + 1e-3, np.sqrt(0.101 * 0.401), rtol=1e-5)
    assert [t for _, t in interpolate.cubic([(a, 0), (b, 1), (a, 2)], 4)] == [0, 1, 2], "times stay distinct"
    assert list(interpolate.cubic([], 4)) == [] and len(list(interpolate.cubic([(a, 0)], 4))) == 1


def scene(moved_px: float) -> np.ndarray:
    """A photograph moved right, and a patch of another one moved left over it."""
    big = data.camera().astype(np.float32) / 255
    patch = data.coins()[50:110, 50:110].astype(np.float32) / 255
    shift = lambda image, x, size: cv2.warpAffine(image, np.float32([[1, 0, x], [0, 1, 0]]), size)
    frame = shift(big[100:260], -40 + moved_px, (200, 160))
    layer, cover = (shift(p, 120 - moved_px, (200, 60)) for p in (patch, np.ones_like(patch)))
    frame[50:110] = frame[50:110] * (1 - cover) + layer * cover
    return frame


def test_motion_recovers_the_frames_that_were_left_out():
    statistics = interpolate.Displacement()
    given = [(scene(px), px * 1_000_000) for px in (0, 8, 16)]
    out = list(interpolate.motion(given, max_px=1.0, displacement=statistics))
    times = [t for _, t in out]
    assert all(np.array_equal(out[times.index(t)][0], f) for f, t in given) and all(b > a for a, b in itertools.pairwise(times))
    assert 7 <= statistics.median <= 9 and statistics.pairs == 2 and len(out) == 3 + statistics.inserted
    assert 14 <= statistics.inserted <= 24
    errors, blend = [], []
    for frame, t in out:
        if t % 8_000_000:
            px = t / 1_000_000
            a, s = int(px // 8), px % 8 / 8
            exact = scene(px)
            errors.append(np.abs(frame - exact)[8:-8, 16:-16].mean())
            blend.append(np.abs((1 - s) * given[a][0] + s * given[a + 1][0] - exact)[8:-8, 16:-16].mean())
    assert np.mean(errors) < 0.3 * np.mean(blend), (np.mean(errors), np.mean(blend))
    assert "interpolated by dense-flow warp, not recorded" in str(statistics)


def test_motion_inserts_nothing_where_nothing_moves():
    frame = scene(0)
    statistics = interpolate.Displacement()
    out = list(interpolate.motion([(frame, 0), (frame, 10), (frame, 20)], displacement=statistics))
    assert [t for _, t in out] == [0, 10, 20] and statistics.inserted == 0


def test_motion_is_bounded():
    out = list(interpolate.motion([(scene(0), 0), (scene(16), 10**6)], max_px=0.01, most=8))
    assert len(out) == 9


def test_motion_of_frames_too_small_for_dense_flow():
    for size in ((16, 16), (16, 300), (300, 16), (17, 130)):
        assert len(list(interpolate.motion([(np.zeros(size, np.float32), t) for t in (0, 10)]))) == 2
    for size in ((15, 300), (300, 15), (12, 64), (1, 1)):
        with pytest.raises(EventDataError, match=f"too small for dense flow .got '{size[1]}x{size[0]}'.; expected at least 16x16"):
            list(interpolate.motion([(np.zeros(size, np.float32), t) for t in (0, 10)]))
