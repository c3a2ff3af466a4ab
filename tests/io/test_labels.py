"""Flow, images, masks, ids, arrays: round trips and independent readers."""

from __future__ import annotations

import os

import cv2
import numpy as np
import pytest

from blinkgl import srgb
from blinkgl.errors import AssetError
from blinkgl.io import flow as flow_files, images
from tests.shared_data import shared


def flow_field(height=37, width=51, scale=20.0, seed=0):
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(height, width, 2)) * scale).astype(np.float32), rng.random((height, width)) > 0.2


def test_dsec_flow_png_read_by_opencv(tmp_path):
    flow, valid = flow_field()
    assert flow_files.write_flow_png(tmp_path / "f.png", flow, valid) == 0
    rgb = cv2.imread(str(tmp_path / "f.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert rgb.dtype == np.uint16
    assert np.array_equal(rgb[..., 2], valid)
    decoded = (rgb[..., :2].astype(np.float64) - 2**15) / 128
    assert np.abs(decoded - flow)[valid].max() <= 0.5 / 128
    again, again_valid = flow_files.read_flow_png(tmp_path / "f.png")
    assert (
        np.array_equal(again_valid, valid) and np.array_equal(again[valid], decoded[valid]) and not again[~valid].any()
    )


def test_kitti_ground_truth():
    path = shared("data/flow/kitti/flow_gt.png")
    flow, valid = flow_files.read_flow_png(path, scale=64.0)
    assert flow.shape == (375, 1242, 2) and round(valid.mean(), 3) == 0.162
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    y, x = np.argwhere(valid)[1000]
    assert flow[y, x].tolist() == [(int(raw[y, x, 2]) - 2**15) / 64, (int(raw[y, x, 1]) - 2**15) / 64]


def test_flo_round_trip_and_unknown(tmp_path):
    flow, valid = flow_field()
    flow_files.write_flo(tmp_path / "f.flo", flow, valid)
    again, again_valid = flow_files.read_flo(tmp_path / "f.flo")
    assert np.array_equal(again_valid, valid) and np.array_equal(again[valid], flow[valid])
    assert np.array_equal(cv2.readOpticalFlow(str(tmp_path / "f.flo"))[valid], flow[valid])


def test_flo_real_files():
    flow, valid = flow_files.read_flo(shared("data/flow/middlebury/flow_gt.flo"))
    assert flow.shape == (388, 584, 2) and round(1 - valid.mean(), 3) == 0.016 and np.abs(flow).max() < 100
    path = shared("data/flow/tiny_mmflow/00001_flow.flo")
    assert np.array_equal(flow_files.read_flo(path)[0], cv2.readOpticalFlow(str(path)))


def test_pfm_real_file_and_orientation(tmp_path):
    image = images.read_pfm(shared("data/flow/tiny_mmflow/0000000-occ_weights_01.pfm"))
    assert image.shape == (50, 50) and np.isfinite(image).all()
    (tmp_path / "big.pfm").write_bytes(b"Pf\n1 2\n1.0\n" + np.array([1, 2], ">f4").tobytes())
    assert images.read_pfm(tmp_path / "big.pfm").ravel().tolist() == [2, 1]  # bottom row is stored first


@pytest.mark.parametrize(
    "read, name, data, message",
    [
        (flow_files.read_flo, "a.flo", b"PIEH", "wrong tag"),
        (flow_files.read_flo, "a.flo", flow_files.encode_flo(np.zeros((4, 4, 2)))[:-1], "truncated"),
        (flow_files.read_flo, "a.flo", b"PIEH" + b"\xff" * 8, "impossible"),
        (images.read_pfm, "a.pfm", b"P6\n1 1\n255\n", "wrong header"),
        (images.read_pfm, "a.pfm", images.encode_pfm(np.zeros((3, 3)))[:-1], "truncated"),
        (flow_files.read_flow_png, "a.png", b"\x89PNG..", "corrupt"),
        (flow_files.read_flow_png, "a.png", images.encode_mask(np.ones((3, 3))), "16-bit RGB"),
        (flow_files.read_flow_png, "a.png", b"", "corrupt"),
        (images.read_npy, "a.npy", images.encode_npy(np.zeros(10))[:-8], "truncated or malformed array"),
    ],
)
def test_bad_files(tmp_path, read, name, data, message):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(AssetError, match=message):
        read(tmp_path / name)
    with pytest.raises(AssetError, match="No such file"):
        read(tmp_path / ("no" + name))


class _Runs:
    """What unpickles it makes a folder."""

    def __init__(self, folder):
        self.folder = str(folder)

    def __reduce__(self):
        return os.mkdir, (self.folder,)


@pytest.mark.parametrize("checked", [True, False], ids=["by its header", "by NumPy, were the header not looked at"])
def test_a_pickle_in_an_archive_does_not_run(tmp_path, monkeypatch, checked):
    """Two locks, each alone enough."""
    np.savez(tmp_path / "a.npz", fine=np.arange(3), trap=np.array([_Runs(tmp_path / "ran")], object))
    if not checked:
        monkeypatch.setattr(images, "npy_header", lambda *_: None)
    with (
        pytest.raises(AssetError),
        images.numpy_errors(tmp_path / "a.npz"),
        images.NpzReader(tmp_path / "a.npz") as npz,
    ):
        assert npz["fine"].tolist() == [0, 1, 2]
        npz["trap"]
    assert not (tmp_path / "ran").exists()


def test_images_masks_ids(tmp_path):
    rng = np.random.default_rng(0)
    linear = rng.random((9, 11, 3), dtype=np.float32)
    (tmp_path / "i.png").write_bytes(images.encode_image(linear))
    assert np.array_equal(cv2.imread(str(tmp_path / "i.png"))[..., ::-1], srgb.to_srgb8(linear))
    assert np.array_equal(images.read_image(tmp_path / "i.png"), srgb.to_srgb8(linear))
    mask = rng.random((9, 11)) > 0.5
    (tmp_path / "m.png").write_bytes(images.encode_mask(mask))
    assert np.array_equal(images.read_mask(tmp_path / "m.png"), mask)
    ids = rng.integers(0, 65536, (9, 11)).astype(np.uint32)
    (tmp_path / "d.png").write_bytes(images.encode_ids(ids))
    assert np.array_equal(images.read_image(tmp_path / "d.png"), ids)
    with pytest.raises(ValueError, match="uint16"):
        images.encode_ids(np.array([[65536]]))
