"""Functions and draws on tensors have the bits of those that the numba kernels use."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from blinkgl.events import arith, grids, philox  # noqa: E402
from blinkgl.tensors import (  # noqa: E402
    TensorEsim,
    arith as ours,
    event_counts,
    latest_times,
    time_surface,
    voxel_grid,
)
from blinkgl.tensors.batch import NEVER_US  # noqa: E402

RNG = np.random.default_rng(0)
WIDE32 = np.exp(RNG.uniform(-20, 20, 100_003)).astype(np.float32)
WIDE64 = np.exp(RNG.uniform(-40, 40, 100_003))


def same(a: torch.Tensor, b: np.ndarray) -> bool:
    return a.numpy().dtype == b.dtype and np.array_equal(a.numpy(), b)


def test_elementary_functions():
    v, w = torch.from_numpy(WIDE32), torch.from_numpy(WIDE64)
    out = torch.empty(len(v), dtype=torch.int32)
    ours.log_q25_(v.clone(), out, torch.empty_like(v), torch.empty_like(v))
    assert same(out, arith.log_q25(WIDE32))
    assert same(ours.log_f32(v), arith.log_f32(WIDE32)) and same(ours.log_f64(w), arith.log_f64(WIDE64))
    falls = np.minimum(WIDE32, 90)
    assert same(ours.exp_f32(-torch.from_numpy(falls)), arith.exp_f32(-falls))
    assert same(ours.fall_f64(w), arith.fall_f64(WIDE64))
    assert same(ours.sqrt(v), np.sqrt(WIDE32)) and same(ours.sqrt(w), np.sqrt(WIDE64))
    turns = RNG.random(100_003)
    for a, b in zip(ours.cos_sin_turn(torch.from_numpy(turns)), arith.cos_sin_turn(turns)):
        assert same(a + 0.0, b + 0.0)  # of zeros only the sign may differ


@pytest.mark.parametrize("seed", [0, 1, 2**63 + 12_345, 2**64 - 1])
def test_draws(seed):
    pixel, index = np.arange(10_001, dtype=np.uint64), np.uint64(2**40 + 7)
    key, tensor, number = ours.words_of(seed), torch.arange(10_001), 2**40 + 7
    for name in ("uniform2", "normal2", "rough_normal"):
        theirs = getattr(philox, name)(np.uint64(seed), pixel, np.uint64(3), index)
        made = getattr(ours, name)(key, tensor, 3, number)
        for a, b in zip(*((x if isinstance(x, tuple) else (x,)) for x in (made, theirs))):
            assert same(a, b), name


# --- Grids made of events on their device, against those made of the same events in NumPy.


@pytest.fixture(scope="module")
def events():
    rng = np.random.default_rng(0)
    emulator = TensorEsim(11, 17, envs=3, seed=1)
    draw = lambda: torch.from_numpy(np.exp(rng.normal(-1, 1, (3, 11, 17))).astype(np.float32))
    emulator.step(draw(), [0, 5_000, 7_000_000])
    return emulator.step(draw(), [10_000_000, 8_000_000, 20_000_000])


@pytest.mark.parametrize("bins", [1, 2, 5])
def test_voxel_grids_have_the_bits_of_the_numba_loop(events, bins):
    t0, t1 = torch.tensor([0, 5, 7_000]), torch.tensor([10_000, 8_000, 20_000])
    made = voxel_grid(events, t0, t1, bins)
    for k, chunk in enumerate(events.numpy()):
        wanted = grids.voxel_grid(chunk, int(t0[k]), int(t1[k]), 11, 17, bins)
        assert len(chunk) > 100 and np.array_equal(made[k].numpy(), wanted)


def test_counts_and_time_surfaces(events):
    counts, latest = event_counts(events), latest_times(events)
    surface = time_surface(latest, torch.tensor([10_000, 8_000, 20_000]), 3_000.0)
    for k, chunk in enumerate(events.numpy()):
        wanted, last = np.zeros((2, 11, 17), np.int32), np.full((2, 11, 17), NEVER_US)
        np.add.at(wanted, (chunk.p, chunk.y, chunk.x), 1)
        last[chunk.p, chunk.y, chunk.x] = chunk.t  # sorted by time: the last one stays
        assert np.array_equal(counts[k].numpy(), wanted) and np.array_equal(latest[k].numpy(), last)
        now = (10_000, 8_000, 20_000)[k]
        assert np.allclose(surface[k].numpy(), np.exp((last - now) / 3_000.0), rtol=1e-6, atol=0)
    assert torch.equal(latest_times(events, latest), latest)


def test_windows_without_length_are_empty_voxel_grids(events):
    for t0, t1 in ((5000, 5000), (torch.full((3,), 5000), torch.full((3,), 5000))):
        grid = voxel_grid(events, t0, t1, 4)
        assert grid.shape[1] == 4 and not grid.any()
