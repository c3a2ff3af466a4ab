"""Augmentations: what they do to events is what they must do to the voxel grid, and they
form the groups they should."""

from dataclasses import replace

import numpy as np
import pytest

from blinkgl.errors import EventDataError
from eflow.data.representation import VoxelGrid
from eflow.data.window import RawSample, Window

H, W, SPAN = 12, 20, 100_000


def sample(rectified=False) -> RawSample:
    rng = np.random.default_rng(3)

    def window(t0):
        n = 500
        x, y = rng.integers(0, W, n).astype(np.uint16), rng.integers(0, H, n).astype(np.uint16)
        if rectified:
            x, y = x.astype(np.float32) + np.float32(0.25), y.astype(np.float32) - np.float32(0.5)
        return Window(
            x, y, np.sort(rng.integers(t0, t0 + SPAN, n)), rng.integers(0, 2, n).astype(np.uint8), t0, t0 + SPAN
        )

    flow, back = rng.normal(size=(2, H, W, 2)).astype(np.float32)
    return RawSample(
        window(7 * SPAN),
        window(8 * SPAN),
        H,
        W,
        "s/0",
        "s",
        flow,
        rng.random((H, W)) > 0.3,
        back,
        rng.random((H, W)) > 0.3,
    )


@pytest.mark.parametrize("rectified", [False, True])
def test_on_voxels_they_are_exact(rectified):
    """For any normalisation of the grid: flips of the array, minus, and minus the flipped
    bins with the windows swapped."""
    s = sample(rectified)
    for normalise in ("none", "nonzero", "all"):
        grid = VoxelGrid(15, normalise)
        of = lambda s: np.stack([grid(s.old, H, W), grid(s.new, H, W)])
        before = of(s)
        close = lambda a, b: np.testing.assert_allclose(a, b, atol=3e-5)
        close(of(s.flip("x")), before[..., ::-1])
        close(of(s.flip("y")), before[..., ::-1, :])
        close(of(s.invert()), -before)
        close(of(s.reverse()), -before[::-1, ::-1])
        turned = s.transpose()
        close(np.stack([grid(w, W, H) for w in (turned.old, turned.new)]), before.swapaxes(-1, -2))


@pytest.mark.parametrize("rectified", [False, True])
def test_what_is_left_out_is_a_part_of_the_grid(rectified):
    s = sample(rectified)
    rest, grid = s.without(3, 5), VoxelGrid(15, "none")
    assert (rest.height, rest.width) == (H - 3, W - 5)
    for whole, part in ((s.old, rest.old), (s.new, rest.new)):
        np.testing.assert_allclose(grid(part, H - 3, W - 5), grid(whole, H, W)[:, : H - 3, 5:], atol=3e-5)
    assert (rest.flow == s.flow[: H - 3, 5:]).all() and (rest.valid == s.valid[: H - 3, 5:]).all()
    assert (rest.backward == s.backward[: H - 3, 5:]).all() and rest.old.x.dtype == s.old.x.dtype
    with pytest.raises(EventDataError, match=r"^s/0: nothing is left of the sample \(got \(12, 0\)\)"):
        s.without(H, 0)


def test_flow_follows():
    s = sample()
    np.testing.assert_array_equal(s.flip("x").flow, s.flow[:, ::-1] * np.float32([-1, 1]))
    np.testing.assert_array_equal(s.flip("y").flow, s.flow[::-1] * np.float32([1, -1]))
    turned = s.transpose()
    assert (turned.height, turned.width) == (W, H)
    np.testing.assert_array_equal(turned.flow[3, 5], s.flow[5, 3, ::-1])
    np.testing.assert_array_equal(turned.valid, s.valid.T)
    np.testing.assert_array_equal(turned.transpose().flow, s.flow)
    assert s.invert().flow is s.flow
    r = s.reverse()
    np.testing.assert_array_equal(r.flow, s.backward)  # the backward flow, not minus the forward flow
    np.testing.assert_array_equal(r.valid, s.backward_valid)
    assert (r.old.t1, r.new.t0) == (s.old.t1, s.new.t0)  # the reference time stays
    with pytest.raises(ValueError, match="backward"):
        replace(s, backward=None).reverse()


def test_nothing_is_edited_in_place():
    s = sample()
    before = [getattr(w, k).copy() for w in (s.old, s.new) for k in "xytp"] + [s.flow.copy()]
    rng = np.random.default_rng(0)
    s.flip("x"), s.flip("y"), s.invert(), s.reverse()
    s.drop(0.5, rng), s.hot_pixels(3, 1e4, rng), s.noise(100, rng)
    for a, b in zip(before, [getattr(w, k) for w in (s.old, s.new) for k in "xytp"] + [s.flow]):
        np.testing.assert_array_equal(a, b)


def test_drop_keeps_the_right_share_in_order():
    s = sample()
    kept = [len(s.drop(0.3, np.random.default_rng(i)).new) for i in range(200)]
    assert abs(np.mean(kept) / 500 - 0.7) < 4 * np.sqrt(0.21 / 500 / 200)
    assert len(s.drop(0.0, np.random.default_rng(0)).new) == 500
    assert (np.diff(s.drop(0.5, np.random.default_rng(1)).new.t) >= 0).all()


def test_noise_and_hot_pixels_have_their_rates():
    rng = np.random.default_rng(5)
    s = sample()
    added = [len(s.noise(50.0, rng).new) - 500 for _ in range(50)]
    mean = 50 * 0.1 * H * W
    assert abs(np.mean(added) - mean) < 4 * np.sqrt(mean / 50)
    hot = s.hot_pixels(2, 5000.0, rng)
    count = np.zeros((H, W))
    np.add.at(count, (hot.new.y, hot.new.x), 1)
    top = np.argsort(count.ravel())[-2:]
    assert (count.ravel()[top] > 350).all()
    for w in (hot.old, hot.new):
        assert (np.diff(w.t) >= 0).all() and w.t[0] >= w.t0 and w.t[-1] < w.t1
