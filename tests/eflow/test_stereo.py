"""Both eyes of a rig's sequence as one sample of a torch data set."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from blinkgl.config.reader import parse_yaml
from blinkgl.config.sequence import RunTemplate
from blinkgl.dataset import generate_sequence
from blinkgl.errors import AssetError
from eflow.data.dataset import FlowDataset
from eflow.data.representation import VoxelGrid
from eflow.data.sources import open_source
from eflow.data.stereo import StereoDataset

RIG = """
camera: {width: 48, height: 32}
time: {duration: 0.1, label_rate: 20}
timeline: {kind: uniform, fps: 80}
labels: {disparity: true, images: false}
scene: {objects: {count: 2, distance: [2, 4]}, textures: {photographs: false, variants: 2, max_size: 32}}
preview: {enabled: false}
rig: stereo
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("stereo")
    config = RunTemplate(parse_yaml(RIG, "test"), out).sequence(0)
    generate_sequence(config, 0, out, None)
    return out


def test_a_sample_has_both_eyes(made):
    data, grid = StereoDataset(made, VoxelGrid(bins=3)), VoxelGrid(bins=3)
    assert len(data) == 2 and data.pairs[0].baseline == 0.1
    sample, folder = data[1], made / "train/sequence_000000"
    for eye in ("left", "right"):
        alone = FlowDataset([open_source(folder / eye)], grid)[1]
        assert all(torch.equal(sample[eye][key], alone[key]) for key in ("old", "new", "flow", "valid"))
    assert np.array_equal(sample["disparity"].numpy(), np.load(folder / "left/disparity/000001.npy"))
    batch = next(iter(DataLoader(data, batch_size=2)))
    assert batch["left"]["new"].shape == batch["right"]["new"].shape == (2, 3, 32, 48)
    assert batch["disparity"].shape == (2, 32, 48) and batch["left"]["name"][0].endswith("left/000000")


def test_flow_is_learnt_of_every_eye(made):
    assert len(open_source(made)) == 4


def test_no_pair_is_said(made):
    with pytest.raises(AssetError, match="no stereo pair"):
        StereoDataset(made / "train/sequence_000000/left", VoxelGrid(bins=3))
