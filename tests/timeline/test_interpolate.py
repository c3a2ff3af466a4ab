"""Frames between frames: against scipy's PCHIP, and against motion that is known."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from skimage import data

from blinkgl.timeline import interpolate


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
    assert all(np.array_equal(out[times.index(t)][0], f) for f, t in given) and all(
        b > a for a, b in itertools.pairwise(times)
    )
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


def test_a_ramp_that_moves_evenly_is_met_exactly():
    """x + 2 y, moved by (3, -1) px: both warps give the same values, whatever their weights."""
    y, x = np.mgrid[:24, :32].astype(np.float32)
    flow = np.broadcast_to(np.float32([3, -1]), (24, 32, 2))
    a, b = x + 2 * y + 9, (x - 3) + 2 * (y + 1) + 9
    out = list(interpolate._between(a, b, 1000, 5000, flow, -flow, 4))
    assert [t for _, t in out] == [2000, 3000, 4000]
    for k, (frame, _) in enumerate(out, 1):
        exact = (x - 3 * k / 4) + 2 * (y + k / 4) + 9
        assert np.abs(frame - exact)[6:-6, 6:-6].max() < 0.003  # a straight line in light is no cubic in its logarithm
    assert list(interpolate._between(a, b, 0, 10, flow, -flow, 1)) == []


@pytest.mark.parametrize("period, least", [(4, 0.78), (6, 0.93), (12, 0.99)])
def test_what_moves_by_half_a_pixel_keeps_its_contrast(period, least):
    """Of waves of ln I; a straight line between pixels keeps cos(pi / period): 0.71, 0.87, 0.97."""
    x = np.arange(48)[None, :] * np.ones((20, 1))
    wave = lambda shift: np.exp(0.5 * np.sin(2 * np.pi * (x + 0.25 - shift) / period)).astype(np.float32)
    flow = np.broadcast_to(np.float32([1, 0]), (20, 48, 2))
    ((middle, _),) = interpolate._between(wave(0), wave(1), 0, 2, flow, -flow, 2)
    inner, true = np.log(middle[:, 6:-6]), np.log(wave(0.5)[:, 6:-6])
    kept = (inner * true).sum() / (true * true).sum()
    assert least < kept <= 1.01 and kept > np.cos(np.pi / period) + 0.02 * (period < 12)


def test_nothing_overshoots_and_still_pixels_stay_as_they_are():
    """Dark beside light: no value that is not between its neighbours', wherever it is looked up."""
    rng = np.random.default_rng(0)
    light = rng.choice([0.0, 1e-4, 0.5, 1.0, 1e4], (20, 24)).astype(np.float32)
    log, out = np.log(light + np.float32(1e-3)), np.empty_like(light)
    places = np.stack(np.meshgrid(np.arange(24), np.arange(20)), -1).astype(np.float32)
    interpolate._look(light, log, places, out)
    np.testing.assert_array_equal(out, light)
    moved = places + rng.uniform(-3, 3, places.shape).astype(np.float32)
    moved[3, 4], moved[5, 6], moved[7, 8] = np.nan, np.inf, -1e30
    interpolate._look(light, log, moved, out)
    x, y = np.clip(np.nan_to_num(moved), 0, [23, 19]).transpose(2, 0, 1)
    around = np.stack(
        [light[f(y).astype(int), g(x).astype(int)] for f in (np.floor, np.ceil) for g in (np.floor, np.ceil)]
    )
    assert (out >= around.min(0)).all() and (out <= around.max(0)).all()


def test_pictures_are_blended_by_their_distance_in_time():
    """Nothing moves, but the light changes: a straight line in between."""
    a, b, still = (
        np.full((20, 20), 1.0, np.float32),
        np.full((20, 20), 5.0, np.float32),
        np.zeros((20, 20, 2), np.float32),
    )
    out = list(interpolate._between(a, b, 0, 8, still, still, 4))
    assert [(float(frame.mean()), t) for frame, t in out] == [(2.0, 2), (3.0, 4), (4.0, 6)]


def test_what_one_frame_does_not_see_comes_from_the_other():
    """A bar moves 8 px to the right: where it was, b alone shows the background; where it comes to, a alone does."""
    a, b = np.full((20, 40), 1.0, np.float32), np.full((20, 40), 3.0, np.float32)
    forward, backward = np.zeros((20, 40, 2), np.float32), np.zeros((20, 40, 2), np.float32)
    forward[:, 10:16, 0], backward[:, 18:24, 0] = 8, -8
    early, middle, late = (frame[10] for frame, _ in interpolate._between(a, b, 0, 8, forward, backward, 4))
    assert early[22] == pytest.approx(1.0, abs=0.02) and late[12] == pytest.approx(3.0, abs=0.02)
    assert (early[35], middle[35], late[35]) == (1.5, 2.0, 2.5), "what both see is blended"


def test_flows_agree_within_a_pixel_and_a_twentieth():
    agrees = interpolate._consistent(np.zeros((2, 3, 2), np.float32), np.zeros((2, 3, 2), np.float32))
    assert (agrees == 1).all() and agrees.dtype == np.float32
    flow, back = np.zeros((1, 5, 2), np.float32), np.zeros((1, 5, 2), np.float32)
    flow[0, :, 0], back[0, :, 0] = (40, 40, 0, 0, 0), (-37.1, -36.9, 0.9, 1.1, 0)
    back[0, 4, 1] = 1.1
    assert interpolate._consistent(flow, back)[0].tolist() == pytest.approx([1, 0.01, 1, 0.01, 0.01])


def test_displacement_keeps_means_of_medians_and_the_largest():
    seen = interpolate.Displacement()
    seen.add(np.linspace(0, 10, 101))
    seen.add(np.linspace(0, 4, 101))
    seen.add(np.full(5, 3.0))
    assert (seen.pairs, seen.median, seen.p99, seen.largest) == (
        3,
        pytest.approx((5 + 2 + 3) / 3),
        pytest.approx(9.9),
        10.0,
    )
    seen.inserted = 7
    assert str(seen) == (
        "displacement per given frame: median 3.3 px, 99th percentile 9.9 px, largest 10 px; "
        "7 frames interpolated by dense-flow warp, not recorded"
    )


def test_as_many_steps_as_the_quickest_but_a_few_pixels_ask_for(monkeypatch):
    """The 99.5th percentile of the displacement over max_px, rounded up; never more than there are nanoseconds."""
    flow = np.zeros((20, 50, 2), np.float32)
    flow[..., 0] = np.linspace(0, 5, 1000).reshape(20, 50)  # 99.5 %: 4.975 px
    monkeypatch.setattr(
        interpolate.cv2,
        "DISOpticalFlow_create",
        lambda preset: type("Dis", (), {"calc": lambda self, a, b, none: flow.copy()})(),
    )
    frames = [(np.full((20, 50), 0.5, np.float32), t) for t in (0, 1000)]
    count = lambda frames=frames, **more: len(list(interpolate.motion(frames, **more))) - 1
    assert [count(max_px=px) for px in (1.0, 4.97, 4.98, 0.5, 100.0)] == [5, 2, 1, 10, 1]
    assert count(max_px=0.01) == 64 and count(max_px=0.01, most=9) == 9
    assert count([(frames[0][0], 0), (frames[0][0], 3)], max_px=0.01) == 3
    flow[..., 0] = 0  # downwards counts as well
    flow[..., 1] = 2.5
    assert count(max_px=1.0) == 3


@pytest.mark.parametrize("preset", [cv2.DISOPTICAL_FLOW_PRESET_FAST, cv2.DISOPTICAL_FLOW_PRESET_MEDIUM])
def test_motion_of_frames_of_any_size(preset):
    """OpenCV itself raises, returns NaN or ends the process below 32 px a side."""
    for size in ((1, 1), (1, 300), (7, 8), (12, 64), (15, 300), (16, 16), (17, 130), (31, 40), (300, 16)):
        a, b = np.random.default_rng(0).integers(0, 256, (2, *size)).astype(np.uint8)
        flow = interpolate.DenseFlow(preset).forward(a, b)
        assert flow.shape == (*size, 2) and np.isfinite(flow).all()
        assert len(list(interpolate.motion([(np.full(size, 0.5, np.float32), t) for t in (0, 10)]))) == 2
