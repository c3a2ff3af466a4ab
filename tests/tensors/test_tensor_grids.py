"""Grids made of events on their device, against those made of the same events in NumPy."""

import numpy as np
import pytest
import torch

from blinkgl.events import grids
from blinkgl.tensors import TensorEsim, event_counts, latest_times, time_surface, voxel_grid
from blinkgl.tensors.batch import NEVER_US


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
