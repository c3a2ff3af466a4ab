"""Events to grids: the numba kernels against their slow twin and against what a grid must conserve."""

import numpy as np
import pytest

from blinkgl.errors import EventDataError
from eflow.data.representation import CountsAndTimes, CountSlices, VoxelGrid
from eflow.data.window import StreamWindow, Window
from eflow.ops import voxel
from eflow.writers import Answer, near_events

H, W = 13, 17


def window(n=400, seed=0, rectified=False, t0=49_000_000_000, span=100_000) -> Window:
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, W, n).astype(np.uint16), rng.integers(0, H, n).astype(np.uint16)
    if rectified:
        x, y = (x + rng.uniform(-2, 2, n)).astype(np.float32), (y + rng.uniform(-2, 2, n)).astype(np.float32)
    return Window(x, y, np.sort(rng.integers(t0, t0 + span, n)), rng.integers(0, 2, n).astype(np.uint8), t0, t0 + span)


def voxel_grid_slow(x, y, t, p, t0, t1, bins, height, width, *, normalise="nonzero") -> np.ndarray:
    """``voxel_grid`` event by event in Python: every cell of the grid asks the tent kernel for its weight."""
    # The definition itself: weight max(0, 1 - |distance|) in t, x and y.
    grid = np.zeros((bins, height, width), np.float64)
    for xi, yi, ti, pi in zip(x.astype(float), y.astype(float), t.tolist(), p.tolist(), strict=True):
        c = (bins - 1) * (ti - t0) / (t1 - t0)
        for b in range(bins):
            wt = max(0.0, 1 - abs(b - c))
            for yy in range(int(np.floor(yi)), int(np.floor(yi)) + 2):
                for xx in range(int(np.floor(xi)), int(np.floor(xi)) + 2):
                    if 0 <= yy < height and 0 <= xx < width:
                        grid[b, yy, xx] += (2 * pi - 1) * wt * max(0.0, 1 - abs(xx - xi)) * max(0.0, 1 - abs(yy - yi))
    grid = grid.astype(np.float32)
    cells = grid != 0 if normalise == "nonzero" else np.full(grid.shape, normalise == "all")
    if cells.any():
        values = grid[cells].astype(np.float64)
        std = values.std(ddof=1) if len(values) > 1 else 0.0
        grid[cells] = (values - values.mean()) / (std if std > 0 else 1.0)
    return grid


@pytest.mark.parametrize("rectified", [False, True])
@pytest.mark.parametrize("normalise", ["none", "nonzero", "all"])
def test_voxel_equals_its_slow_twin(rectified, normalise):
    w = window(rectified=rectified)
    args = (w.x, w.y, w.t, w.p, w.t0, w.t1, 15, H, W)
    fast, slow = voxel.voxel_grid(*args, normalise=normalise), voxel_grid_slow(*args, normalise=normalise)
    np.testing.assert_allclose(fast, slow, atol=2e-5)


def test_bounds_of_the_window_or_of_the_events():
    t = np.array([30_000, 50_000, 70_000])
    w = Window(np.zeros(3, np.uint16), np.zeros(3, np.uint16), t, np.ones(3, np.uint8), 0, 100_000)
    by_window = VoxelGrid(11, "none")(w, 1, 1).ravel()
    by_events = VoxelGrid(11, "none", "events")(w, 1, 1).ravel()
    np.testing.assert_allclose(by_window, np.eye(11)[[3, 5, 7]].sum(0), atol=1e-6)
    np.testing.assert_allclose(by_events, np.eye(11)[[0, 5, 10]].sum(0), atol=1e-6)


@pytest.mark.parametrize("representation", [VoxelGrid(), CountSlices(5), CountsAndTimes()])
def test_an_event_off_the_sensor_or_out_of_the_window_is_an_error(representation):
    for x, t in ((W, 5), (0, 101), (0, -1)):
        w = Window(np.array([x], np.uint16), np.zeros(1, np.uint16), np.array([t]), np.ones(1, np.uint8), 0, 100)
        with pytest.raises(EventDataError, match="1 events outside the window or the 17x13 sensor"):
            representation(w, H, W)


@pytest.mark.parametrize("representation", [VoxelGrid(), CountSlices(10), CountsAndTimes()])
def test_no_events_give_zeros_and_rectified_ones_work(representation):
    empty = window().take(np.zeros(400, bool))
    out = representation(empty, H, W)
    assert out.shape == (representation.channels, H, W) and out.dtype == np.float32 and not out.any()
    assert np.isfinite(representation(window(rectified=True), H, W)).all()


def test_counts_against_a_histogram():
    w = window(3000)
    counts = CountSlices(5)(w, H, W).reshape(5, 2, H, W)
    slice_ = (w.t - w.t0) * 5 // (w.t1 - w.t0)
    expected, _ = np.histogramdd(np.stack([slice_, w.p, w.y, w.x], 1), bins=[np.arange(n + 1) for n in (5, 2, H, W)])
    np.testing.assert_array_equal(counts, expected)


def test_pixels_near_events_whatever_the_tensor_says():
    """A grid that is normalised over all cells is nowhere 0."""
    one = Window(*(np.array([v], d) for v, d in ((6, "u2"), (5, "u2"), (5, "i8"), (1, "u1"))), 0, 10)
    grid = VoxelGrid(5, "all")(one, H, W)
    near = near_events(Answer(StreamWindow(0, one, one), np.zeros((H, W, 2), np.float32), grid))
    assert (grid != 0).all() and near.sum() == 49 and near[2:9, 3:10].all()
