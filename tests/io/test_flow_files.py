"""Files of flow and of float images at the edges of what they can hold."""

from __future__ import annotations

import struct
import warnings
import zlib

import cv2
import numpy as np
import pytest

from blinkgl.errors import AssetError, OutputError
from blinkgl.io import flow as flow_files, images
from blinkgl.io.flow import read_flow, write_flow


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
        (b"\xff\xd8 \xff\xda \xff\xd9", None),
        (b"\xff\xd8 \xff\xda ", "cannot decode image (truncated)"),
        (b"\xff\xd8 \xff\xd9 \xff\xda ", "cannot decode image (truncated)"),
        (b"#?RADIANCE\n\n-Y 16384 +X 16384\n", None),
        (b"#?RADIANCE\n\n-Y 16384 +X 16385\n", "image of 16385x16384 px is too large"),
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
def test_headers_of_pfm(head, count, said):
    data = head + np.arange(count, dtype="<f4" if b"-" in head else ">f4").tobytes()
    if said is None:
        image = images.decode_pfm(data, "a")
        assert image.ravel().tolist() == list(range(count)) and image.dtype == np.float32 and image.shape[:2] == (1, 2)
    else:
        with pytest.raises(AssetError, match=said):
            images.decode_pfm(data, "a")
    for shape in ((2,), (2, 2, 2), (2, 2, 4), (1, 2, 2, 3)):
        with pytest.raises(ValueError, match="PFM holds"):
            images.encode_pfm(np.zeros(shape))
