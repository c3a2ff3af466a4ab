"""ECF: bytes that Prophesee's own plugin wrote, and damage."""

import h5py
import numpy as np
import pytest

from blinkgl.errors import AssetError
from blinkgl.io import ecf
from blinkgl.io.formats import open_events

EVENT = np.dtype({"names": ["x", "y", "p", "t"], "formats": ["<u2", "<u2", "<i2", "<i8"], "offsets": [0, 2, 4, 8]})


def columns(x, y, t, p):
    return np.array(x, "u2"), np.array(y, "u2"), np.array(t, "i8"), np.array(p, "u1")


# What hdf5_ecf 1.0.1 made of these events (h5py 3.16, chunk = all of them): one of each form, and every long run.
WRITTEN = {
    "all in one": (
        columns(
            [2047, 0, 5, 1279, 640, 9], [0, 2047, 719, 3, 4, 5], [5, 5, 19, 20, 1 << 40, 1 << 40], [1, 0, 1, 1, 0, 1]
        ),
        "1a000000050000000000000002e111fcfeffffffffffffffff0200ff0f000bf0f07fff39002c130045000000500000000000",
    ),
    "x with p": (
        columns([2047, 5, 900, 4, 1000, 3] * 3, [7] * 18, np.arange(18) * 14, [1, 0] * 9),
        (
            "49000000000000000000000001e1e1e1e1e1e1e1e1e1e1e1e1e1e1e1e1e1f2"
            "00faff09000870167dff000af09870d1000670faff09000870167d00000000"
        ),
    ),
    "masks": (
        columns([*range(10, 16), 20, *range(100, 140)], [7] * 47, [1000] * 7 + [1015] * 40, [1] * 7 + [0] * 40),
        "bc000000e80300000000000007ff0f2800ff002f005f0180029f0c5f0d1f0edf0e9f0f5f101c118728",
    ),
    "one polarity": (
        columns(range(200), [2047] * 200, [9] * 200, [1] * 200),
        (
            "2003000009000000000000000fc800ffffc8001f00df009f015f021f03df039f045f051f06df069f075f081f09df099f0a5f0b1f0cdf0c9f"
            "0d5f0e1f0fdf0f9f105f111f12df129f135f141f15df159f165f171f18d018ffc800"
        ),
    ),
}


def check(got, want):
    for a, b in zip(got, want):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", WRITTEN)
def test_bytes_of_prophesees_plugin(name):
    events, text = WRITTEN[name]
    data = bytes.fromhex(text)
    check(ecf.decode(data, 16384, "e"), events)


@pytest.mark.parametrize("name", WRITTEN)
def test_damage_is_one_line(name):
    """Cut anywhere, or with bytes too many; flipped bits give events or that line, and never another exception."""
    data = bytes.fromhex(WRITTEN[name][1])
    for end in range(len(data)):
        with pytest.raises(AssetError, match="damaged: an ECF chunk"):
            ecf.decode(data[:end], 16384, "e.h5")
    with pytest.raises(AssetError, match="2 bytes after its last event"):
        ecf.decode(data + b"\0\0", 16384, "e.h5")
    with pytest.raises(AssetError, match="of an unknown form .got 3."):
        ecf.decode(bytes([data[0] | 3]) + data[1:], 16384, "e.h5")
    with pytest.raises(AssetError, match="too many events .got .*at most 2"):
        ecf.decode(data, 2, "e.h5")
    for k in range(8 * len(data)):
        flipped = bytearray(data)
        flipped[k // 8] ^= 1 << k % 8
        try:
            ecf.decode(bytes(flipped), 16384, "e.h5")
        except AssetError as error:
            assert str(error).startswith("e.h5: damaged") and "\n" not in str(error)


def table_of(path, chunks, count, *, filters=((ecf.FILTER, ()),), step=16384):
    """A file with such packed chunks, (bytes, filter mask) each."""
    with h5py.File(path, "w") as file:
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_chunk((step,))
        for number, values in filters:
            layout.set_filter(number, h5py.h5z.FLAG_OPTIONAL, values)
        space = h5py.h5s.create_simple((count,), (h5py.h5s.UNLIMITED,))
        made = h5py.h5d.create(
            file.create_group("CD").id, b"events", h5py.h5t.py_create(EVENT, logical=True), space, layout
        )
        for k, (data, mask) in enumerate(chunks):
            made.write_direct_chunk((k * step,), data, mask)


def test_a_chunk_that_was_not_packed(tmp_path):
    """The filter is optional: a program without it stores rows, and says so in the chunk's mask."""
    rows = np.zeros(16, EVENT)
    rows["x"], rows["t"] = np.arange(16), np.arange(16)
    (x, _, t, _), packed = WRITTEN["x with p"]
    rows["t"] -= 16
    table_of(tmp_path / "e.h5", [(rows.tobytes(), 1), (bytes.fromhex(packed), 0)], 32, step=16)
    with pytest.raises(AssetError, match="too many events"):
        open_events(tmp_path / "e.h5").read()
    (x, _, t, _), packed = WRITTEN["all in one"]
    table_of(tmp_path / "e.h5", [(rows.tobytes(), 1), (bytes.fromhex(packed), 0)], 22, step=16)
    events = open_events(tmp_path / "e.h5").read()
    np.testing.assert_array_equal(events.t, [*rows["t"], *t])
    np.testing.assert_array_equal(events.x, [*range(16), *x])


@pytest.mark.parametrize(
    "change, says",
    [
        (dict(chunks=[(bytes(13), 0)]), "1 bytes after its last event"),
        (dict(chunks=[(bytes(2), 0)]), "truncated"),
        (dict(chunks=[(bytes.fromhex(WRITTEN["all in one"][1]), 0)]), "fewer events .*got 6.; expected 7"),
        (dict(chunks=[(bytes(16), 1)]), "fewer events .*got 1.; expected 7"),
        (dict(chunks=[]), "damaged HDF5 file"),
        (dict(chunks=[], filters=((1, (4,)), (ecf.FILTER, ()))), "packed with ECF and another filter"),
    ],
    ids=["left over", "truncated", "fewer", "fewer rows", "no chunk", "two filters"],
)
def test_damaged_files_are_one_line(tmp_path, change, says):
    table_of(tmp_path / "e.h5", count=7, **change)
    with pytest.raises(AssetError, match=says) as caught:
        open_events(tmp_path / "e.h5").read()
    assert str(tmp_path / "e.h5") in str(caught.value) and "\n" not in str(caught.value)
