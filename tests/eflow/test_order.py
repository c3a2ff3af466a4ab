"""The order of training samples: a function of (seed, epoch, position), whatever the
workers and wherever the run was cut."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from blinkgl.errors import BlinkGLError, ConfigError  # noqa: E402
from eflow.config import AugmentConfig  # noqa: E402
from eflow.data.dataset import FlowDataset, Key, Mixture, StepSampler, batches, collate, cropped, scaled  # noqa: E402
from eflow.data.representation import VoxelGrid  # noqa: E402
from eflow.data.sources import open_source  # noqa: E402
from flow_data import blinkflow_set, blinkgl_set, dsec_set  # noqa: E402

STRONG = AugmentConfig(
    vertical_flip=0.5,
    time_reversal=0.5,
    drop_probability=1,
    hot_probability=1,
    noise_probability=1,
    scale_probability=0.5,
)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return open_source(blinkgl_set(tmp_path_factory.mktemp("set")))


def test_every_sample_once_per_epoch_in_a_new_order():
    mixture = Mixture([5, 7], [5, 7], seed=3)
    epochs = [mixture.epoch(e) for e in range(3)]
    for keys in epochs:
        assert sorted((k.source, k.index) for k in keys) == [(s, i) for s, n in enumerate((5, 7)) for i in range(n)]
    assert epochs[0] != [Key(0, k.position, k.source, k.index) for k in epochs[1]]
    assert Mixture([5, 7], [5, 7], seed=4).epoch(0) != epochs[0]
    again = Mixture([5, 7], [5, 7], seed=3)
    assert [again.key(n) for n in (30, 2, 13)] == [epochs[2][6], epochs[0][2], epochs[1][1]]  # any order of asking


def test_a_source_of_a_small_share_is_drawn_in_every_epoch():
    mixture = Mixture([3, 3, 20], [1, 0.001, 0.001], seed=0)
    for epoch in range(3):
        sources = [key.source for key in mixture.epoch(epoch)]
        assert [sources.count(k) for k in range(3)] == [24, 1, 1]
    assert Mixture([3, 3], [1, 0], seed=0).counts == [6, 0]


def equal(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) if torch.is_tensor(a[k]) else a[k] == b[k] for k in a)


def test_workers_change_nothing(source):
    dataset = FlowDataset([source], VoxelGrid(), augment=STRONG, crop=(96, 112))
    sampler = StepSampler(Mixture([len(source)], [1], 0), 3, 1, 4)
    alone, with_workers = list(batches(dataset, sampler, 0)), list(batches(dataset, sampler, 2))
    assert len(alone) == 3 and all(equal(a, b) for a, b in zip(alone, with_workers, strict=True))


@pytest.mark.parametrize("workers", [0, 1])
def test_an_error_in_a_loader_process_stays_one_line(tmp_path, workers):
    root = blinkgl_set(tmp_path, sequences=1)
    source = open_source(root)
    path = root / "train/seq_000000/events.h5"
    path.write_bytes(path.read_bytes()[:1000])
    stream = batches(FlowDataset([source], VoxelGrid()), StepSampler(Mixture([len(source)], [1], 0), 2, 0, 3), workers)
    with pytest.raises(BlinkGLError, match=r"events\.h5: truncated") as caught:
        next(stream)
    assert "\n" not in str(caught.value)


def test_scale_scales_flow_by_the_true_factor():
    h, w = 40, 60
    flow = torch.stack([torch.full((h, w), 3.0), torch.full((h, w), -2.0)])
    valid = torch.ones(h, w, dtype=torch.bool)
    valid[:10] = False
    flow[:, :10] = 1e6
    sample = {
        "old": torch.rand(15, h, w),
        "new": torch.rand(15, h, w),
        "flow": flow,
        "valid": valid,
        "mask": torch.ones(h, w, dtype=torch.bool),
    }
    out = scaled(sample, 1.31)
    assert out["new"].shape == (15, 52, 79)
    got = out["flow"][:, out["valid"]]
    assert torch.allclose(got[0], torch.tensor(3.0 * 79 / 60)) and torch.allclose(got[1], torch.tensor(-2.0 * 52 / 40))
    assert not out["valid"][:13].any() and out["valid"][15:].all()
    assert scaled(sample, 0.5, least=(32, 32))["new"].shape == (15, 32, 32)


def test_sparse_truth_survives_scaling():
    """A twentieth of the pixels is valid, as of a lidar: each of them moves, with its own flow, and none is doubled."""
    h, w = 60, 80
    torch.manual_seed(0)
    v, u = torch.meshgrid(torch.arange(h) * 1.0, torch.arange(w) * 1.0, indexing="ij")
    valid = torch.rand(h, w) < 0.05
    flow = torch.where(valid, torch.stack([0.1 * u, -0.2 * v]), torch.nan)
    sample = {"new": torch.rand(2, h, w), "flow": flow, "valid": valid, "mask": torch.ones(h, w, dtype=torch.bool)}
    for factor in (0.7, 1.5):
        out = scaled(sample, factor)
        places = {(int((y + 0.5) * factor), int((x + 0.5) * factor)) for y, x in torch.nonzero(valid).tolist()}
        assert set(map(tuple, torch.nonzero(out["valid"]).tolist())) == places and len(places) > 0.9 * valid.sum()
        y, x = torch.nonzero(out["valid"], as_tuple=True)
        expected = torch.stack([0.1 * (x + 0.5) - 0.05 * factor, -0.2 * (y + 0.5) + 0.1 * factor])
        assert (out["flow"][:, y, x] - expected).abs().max() < 0.2  # within the pixel that it moved to


def test_refusals(source, tmp_path):
    sample = FlowDataset([source], VoxelGrid())[0]
    with pytest.raises(BlinkGLError, match="data.crop, .*: sample is smaller than the crop"):
        cropped(sample, (256, 256), np.random.default_rng(0), sample["name"])
    with pytest.raises(BlinkGLError, match="differ in size"):
        collate([sample, FlowDataset([open_source(blinkflow_set(tmp_path / "b"))], VoxelGrid())[0]])
    forward_only = open_source(blinkgl_set(tmp_path / "f", sequences=1, backward=False))
    with pytest.raises(ConfigError, match="data.augment.time_reversal: time reversal needs backward flow"):
        FlowDataset([forward_only], VoxelGrid(), augment=STRONG)


def test_unlabelled_data_cannot_be_trained_on(tmp_path):
    source = open_source(dsec_set(tmp_path, labels=1, test=True))
    dataset = FlowDataset([source], VoxelGrid())
    assert "flow" not in dataset[0]
    with pytest.raises(BlinkGLError, match="thun_00_a/000002: no ground truth to train on"):
        dataset[Key(0, 0, 0, 0)]


def test_a_window_that_nobody_reads_may_be_empty(source):
    from dataclasses import replace

    class Beginning:
        """Before the first label of a recording nothing has happened yet."""

        has_backward = True
        __len__ = lambda self: 1

        def __getitem__(self, i):
            return replace(source[0], old=source[0].old.take(np.zeros(len(source[0].old), bool)))

    with pytest.raises(BlinkGLError, match="no events in the old window"):
        FlowDataset([Beginning()], VoxelGrid())[0]
    sample = FlowDataset([Beginning()], VoxelGrid(), reads=("new",))[0]
    assert "old" not in sample and sample["new"].any()
