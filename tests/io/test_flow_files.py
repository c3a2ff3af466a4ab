"""Files of flow and of float images at the edges of what they can hold."""

from __future__ import annotations

import os
import struct
import warnings
import zlib

import cv2
import numpy as np
import pytest

from blinkgl import srgb
from blinkgl.errors import AssetError, OutputError
from blinkgl.io import flow as flow_files, images
from blinkgl.io.flow import read_flow, write_flow
from tests.shared_data import shared


@pytest.mark.parametrize("ending, lost", [(".png", 1), (".flo", 0), (".npy", 0)])
def test_every_ending_gives_back_what_it_holds(tmp_path, ending, lost):
    flow = np.float32([[[1.5, -2.25], [0, 300], [7, 7]]])
    valid = np.array([[True, True, False]])
    path = tmp_path / f"a{ending}"
    path.write_text("older")
    assert write_flow(path, flow, valid) == lost
    again, stated = read_flow(path)
    assert stated.tolist() == [[True, not lost, False]] and again.dtype == np.float32
    assert again.tolist() == [[[1.5, -2.25], [0, 0 if lost else 300], [0, 0]]] and len(list(tmp_path.iterdir())) == 1
    for act in (lambda p: write_flow(p, flow, valid), read_flow):
        with pytest.raises(
            (AssetError, OutputError), match=r"unknown flow file ending .got '.exr'.; expected .png, .flo, .npy"
        ):
            act(tmp_path / "a.exr")


@pytest.mark.parametrize("scale, low, high", [(128.0, -256.0, 255.9921875), (64.0, -512.0, 511.984375)])
def test_the_ends_of_sixteen_bits(scale, low, high):
    half = 0.5 / scale
    flow = np.zeros((1, 6, 2), np.float32)
    flow[0, :, 1] = (low, low - 0.9 * half, low - 1.1 * half, high, high + 0.9 * half, high + 1.1 * half)
    data, lost = flow_files.encode_flow_png(flow, np.ones((1, 6), bool), scale=scale)
    code = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)[0]
    assert lost == 2 and code[:, 0].tolist() == [1, 1, 0, 1, 1, 0]
    assert code[:, 1].tolist() == [0, 0, 32768, 65535, 65535, 32768] and (code[:, 2] == 32768).all()


def png(width: int, height: int, cut: int | None = None) -> bytes:
    """The header of a PNG of that size, and no pixels."""
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0))
        + chunk(b"IEND", b"")
    )[:cut]


@pytest.mark.parametrize(
    "data, said",
    [
        (png(1 << 14, 1 << 14), None),
        (png((1 << 14) + 1, 1 << 14), "image of 16385x16384 px is too large (at most 256 Mpx)"),
        (png(0, 5), "image of 0x5 px is too large"),
        (png(5, 5, 44), "corrupt or truncated at byte 33"),
        (png(5, 5, 33), "corrupt or truncated at byte 33"),
        (png(5, 5, 32), "cannot decode image (corrupt or truncated)"),
        (png(5, 5).replace(b"IHDR", b"IHDX"), "cannot decode image (corrupt or truncated)"),
        (png(5, 5)[:-1] + b"x", "corrupt or truncated at byte 33"),
        (b"\xff\xd8 \xff\xda \xff\xd9", "a JPEG, where pictures without loss are read"),
        # 12 bytes a pixel, of at most 2^28.
        (b"#?RADIANCE\n\n-Y 4729 +X 4729\n", None),
        (b"#?RADIANCE\n\n-Y 4730 +X 4730\n", "image of 4730x4730 px is too large (at most 21 Mpx in "),
        (b"#?RADIANCE\n\n", "no size in its header"),
        (b"", "cannot decode image (corrupt or truncated)"),
        (b"unknown", None),
    ],
)
def test_what_opencv_would_pass_over(data, said):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem = images._image_problem(data)
    assert problem is None if said is None else said in problem


@pytest.mark.parametrize(
    "head, count, said",
    [
        (b"Pf\n2 1\n-1\n", 2, None),
        (b"PF 2 1 -0.5\r\n", 6, None),
        (b"Pf 2\n1\n+1.5e0 \n", 2, None),
        (b"Pf 2 1 .5\n", 2, None),
        (b"Pf\n2 1\n0\n", 2, "truncated or malformed"),
        (b"Pf\n2 1\n-1e999\n", 2, "truncated or malformed"),
        (b"Pf\n0 1\n-1\n", 0, "truncated or malformed"),
        (b"Pf\n1 0\n-1\n", 0, "truncated or malformed"),
        (b"Pf\n2 1\n-1\n", 3, "truncated or malformed"),
        (b"PF\n2 1\n-1\n", 2, "truncated or malformed"),
        (b"Pf\n2 1\n-\n", 2, "wrong header"),
        (b"Pg\n2 1\n-1\n", 2, "wrong header"),
    ],
)
def test_headers_of_pfm(tmp_path, head, count, said):
    path = tmp_path / "a.pfm"
    path.write_bytes(head + np.arange(count, dtype="<f4" if b"-" in head else ">f4").tobytes())
    if said is None:
        image = images.read_pfm(path)
        assert image.ravel().tolist() == list(range(count)) and image.dtype == np.float32 and image.shape[:2] == (1, 2)
    else:
        with pytest.raises(AssetError, match=said):
            images.read_pfm(path)


# --- Flow, images, masks, ids, arrays: round trips and independent readers.


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
    assert flow_files.write_flow(tmp_path / "f.flo", flow, valid) == 0
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
        (images.read_pfm, "a.pfm", b"Pf\n3 3\n-1.0\n" + bytes(35), "truncated"),
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
