"""Images of a frame camera as tensors, with the events of their exposures."""

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from blinkgl import read_events
from blinkgl.config.sequence import RunTemplate
from blinkgl.dataset.generate import generate_run
from blinkgl.errors import AssetError
from blinkgl.io.frame_camera import read_codes, read_exposures
from eflow.data.images import ImageDataset
from eflow.data.representation import VoxelGrid

RUN = {
    "camera": {"width": 32, "height": 24},
    "time": {"duration": 0.05, "label_rate": 20},
    "scene": {
        "objects": {"count": 2, "distance": [2, 4]},
        "pool": {"primitives": ["sphere"], "variants": 2, "urdfs": False},
        "textures": {"procedural": ["checks"], "variants": 2, "photographs": False, "max_size": 32},
        "camera_motion": {"speed": [2, 5], "rotation_rate": [60, 200]},
    },
    "images": {"preset": "deblurring", "rate": 40, "exposure_us": 10_000, "row_us": 20, "bits": 10, "max_instants": 4},
    "preview": {"enabled": False},
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    out = tmp_path_factory.mktemp("images") / "out"
    return list(generate_run(RunTemplate(RUN, out), out, 2)), out


def test_a_sample_is_an_image_its_partner_and_the_events_of_its_exposure(data):
    reports, out = data
    dataset = ImageDataset(out)
    assert len(dataset) == sum(len(read_exposures(report.path)) for report in reports) == 8
    for index in (0, 5):
        sample, folder, k = dataset[index], reports[index // 4].path, index % 4
        for name in ("images", "sharp"):
            codes = read_codes(folder / f"frame_camera/{name}/{k:06d}.png")
            np.testing.assert_array_equal(np.round(sample[name].numpy() * 1023), codes.transpose(2, 0, 1))
        line, everything, window = read_exposures(folder)[k], read_events(folder / "events.h5"), sample["window"]
        inside = (everything.t >= line.start_us) & (everything.t < line.end_us)
        np.testing.assert_array_equal(window.t, everything.t[inside])
        assert len(window) > 0 and sample["exposure_us"] == line.exposure_us == 10_000


def test_samples_are_collated_and_a_margin_takes_more_events(data):
    _, out = data
    narrow, wide = (ImageDataset(out, VoxelGrid(3, normalise="none"), margin_us=m) for m in (0, 5000))
    batch = next(iter(DataLoader(narrow, batch_size=3)))
    assert batch["images"].shape == batch["sharp"].shape == (3, 3, 24, 32) and batch["events"].shape == (3, 3, 24, 32)
    assert batch["images"].dtype == torch.float32 and 0 <= batch["images"].min() < batch["images"].max() <= 1
    assert wide[1]["events"].abs().sum() > narrow[1]["events"].abs().sum() > 0


def test_a_data_set_without_a_frame_camera_is_told_so(tmp_path):
    plain = {**RUN, "images": None}
    list(generate_run(RunTemplate(plain, tmp_path), tmp_path / "out"))
    with pytest.raises(AssetError, match="no images of a frame camera"):
        ImageDataset(tmp_path / "out")
