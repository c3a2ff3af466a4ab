"""One door to HDF5: no value of a file is decoded before filters, sizes, types and links are checked."""

from __future__ import annotations

import ast
import json
import re
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest

import blinkgl
import eflow
from blinkgl.errors import AssetError
from blinkgl.io.event_labels import EventLabelsReader
from blinkgl.io.flow import read_flow
from blinkgl.io.formats import open_events
from blinkgl.io.hdf5 import Data, Group, open_hdf5
from blinkgl.io.imu import read_imu
from blinkgl.io.intervals import intervals_in, read_intervals
from eflow.data.sources import read_rectify_map
from tests.io.test_columns import dsec, mvsec

SHAPE = (48, 64, 2)
RAW = 48 * 64 * 2 * 4


def packed(file: h5py.File, name: str, chunk: bytes, *filters: tuple, shape=SHAPE, dtype="<f4") -> None:
    """A data set of one chunk with any bytes and any pipeline of filters."""
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk(shape)
    for code, values in filters:
        plan.set_filter(code, h5py.h5z.FLAG_OPTIONAL, values)
    kind, space = h5py.h5t.py_create(np.dtype(dtype)), h5py.h5s.create_simple(shape)
    link = h5py.h5p.create(h5py.h5p.LINK_CREATE)
    link.set_create_intermediate_group(True)
    made = h5py.h5d.create(file.id, name.encode(), kind, space, plan, link)
    made.write_direct_chunk((0,) * len(shape), chunk)


def zeros_of_gzip(size: int) -> bytes:
    """RFC 1950: a block that stands for itself, as often as needed, an empty last one, and the sum of the zeros."""
    packer = zlib.compressobj(9)
    first, second = (packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH) for _ in range(2))
    return first + second * ((size >> 24) - 1) + b"\3\0" + struct.pack(">I", size % 65521 << 16 | 1)


def frame_of_zstd(size: int) -> bytes:
    """RFC 8878: one segment of ``size`` bytes in blocks that repeat a byte."""
    count = size >> 17
    blocks = (struct.pack("<I", (k == count - 1) | 1 << 1 | 1 << 17 + 3)[:3] + b"\0" for k in range(count))
    return struct.pack("<IBQ", 0xFD2FB528, 0b11100000, size) + b"".join(blocks)


GZIP = (1, (9,))
STORED = {
    "Fletcher32 over a byte": (b"\1", [(3, ())], "packed by an HDF5 filter that is not run here"),
    "szip": (b"\1" * 100, [(4, (141, 0, 8, 64))], "filter that is not run here .got '4 szip'"),
    "SZ": (b"\1" * 100, [(32017, ())], "filter that is not run here .got '32017 SZ"),
    "SZ3": (b"\1" * 100, [(32024, ())], "filter that is not run here .got '32024 SZ3"),
    "a bomb of gzip": (zeros_of_gzip(1 << 27), [GZIP], r"unpacks to more than its values .got '\d+ bytes'.; expected"),
    "gzip in gzip": (zlib.compress(zeros_of_gzip(1 << 26)), [GZIP, GZIP], "'.*' is packed twice"),
    "a bomb of zstd": (frame_of_zstd(1 << 30), [(32015, (3,))], "unpacks to more than its values"),
    "a bomb of LZ4": (struct.pack(">QI", 1 << 33, 1 << 30), [(32004, (0,))], "unpacks to more than its values"),
}  # fmt: skip


CLAIMS = "stores fewer|differ in length|has the wrong shape|chunks that are too large"


def _no_chunk(file: h5py.File, name: str, shape: tuple[int, ...], dtype: str) -> None:
    file.create_dataset(name, (60_000_000, *shape[1:]), dtype, chunks=(64, *shape[1:]), compression=1)


DOORS = {
    "flo5": ("flow", SHAPE, "<f4", read_flow),
    "dsec": ("events/x", (3,), "<u2", lambda path: open_events(path).read()),
    "mvsec": ("davis/left/events", (3, 4), "<f8", lambda path: open_events(path).read()),
    "columns": ("a/x", (3,), "<u2", lambda path: open_events(path).read()),
    "intervals": ("interval_ns", (3,), "<i8", intervals_in),
    "flow intervals": ("flow", (3, 4, 4, 2), "<f4", lambda path: read_intervals(path, ("flow",))),
    "event labels": ("velocity", (3, 2), "<f4", EventLabelsReader),
    "imu": ("rate", (3, 3), "<f8", lambda path: read_imu(path.parent.parent)),
    "rectify map": ("rectify_map", (4, 4, 2), "<f4", read_rectify_map),
}
"""Readers, and the data set in which each is attacked."""


def _whole(folder: Path, door: str) -> Path:
    """A whole file of a door, but for its data set."""
    path = folder / {"flo5": "a.flo5", "imu": "imu/imu.h5"}.get(door, "a.h5")
    path.parent.mkdir(exist_ok=True)
    if door in ("dsec", "mvsec"):
        (dsec if door == "dsec" else mvsec)(path)
    with h5py.File(path, "a") as file:
        if door == "columns":
            for name in "ytp":
                file[f"a/{name}"] = np.zeros(3, np.uint8)
        elif door == "flow intervals":
            file["from_us"], file["interval_ns"] = 0, np.arange(1, 4)
        elif door == "event labels":
            file["instance"], file["depth"] = np.zeros(3, np.uint16), np.ones(3, np.float32)
        elif door == "imu":
            file["t_ns"] = np.arange(3)
        file.pop(DOORS[door][0], None)
    return path


def test_every_door_refuses_before_it_decodes(tmp_path):
    """In a process of their own: these files have ended it by a signal, or filled 4 GB."""
    cases = []
    for door, (name, shape, dtype, _) in DOORS.items():
        for number, (chunk, filters, message) in enumerate([*STORED.values(), (b"", [], CLAIMS)]):
            (folder := tmp_path / door / str(number)).mkdir(parents=True)
            path = _whole(folder, door)
            cases.append((door, str(path), message))
            with h5py.File(path, "a") as file:
                if filters:
                    packed(file, name, chunk, *filters, shape=shape, dtype=dtype)
                else:
                    _no_chunk(file, name, shape, dtype)
                # A filter of hdf5plugin makes the reader load it, and with it those that crash.
                file.create_dataset("z/other", data=np.zeros(9), chunks=(9,), **hdf5plugin.Zstd())
    program = (
        "import json, sys; from pathlib import Path; from tests.io.test_hdf5_door import DOORS\n"
        "from blinkgl.errors import BlinkGLError\n"
        "for door, path, _ in json.load(sys.stdin):\n"
        "    try: DOORS[door][3](Path(path)); print('read')\n"
        "    except BlinkGLError as error: print(error)\n"
        # Not ru_maxrss, which begins with what the process that started this one held.
        "    peak = int(Path('/proc/self/status').read_text().partition('VmHWM:')[2].split()[0])\n"
        "    if peak > 1 << 20: print('more than 1 GB')\n"
    )
    run = subprocess.run([sys.executable, "-c", program], input=json.dumps(cases), capture_output=True, text=True)
    assert run.returncode == 0, (run.returncode, run.stderr)
    for (door, path, message), line in zip(cases, run.stdout.splitlines(), strict=True):
        assert re.search(message, line), (door, path, line, message)


def test_large_chunks_of_gzip_are_counted_before_they_are_unpacked(tmp_path):
    """A chunk of 2 MB may be as long as it unpacks to, and so unpack to 2 GB."""
    shape = (512, 512, 2)
    noise = np.random.default_rng(0).random(shape, np.float32)
    for name, chunk in (("sound", zlib.compress(noise.tobytes(), 1)), ("bomb", zeros_of_gzip(3 << 29))):
        assert 1 << 20 < len(chunk) < noise.nbytes
        with h5py.File(tmp_path / f"{name}.flo5", "w") as file:
            packed(file, "flow", chunk, GZIP, shape=shape)
    np.testing.assert_array_equal(read_flow(tmp_path / "sound.flo5")[0], noise[::2, ::2])
    with pytest.raises(AssetError, match="a chunk of dataset 'flow' unpacks to more than its values"):
        read_flow(tmp_path / "bomb.flo5")


@pytest.mark.parametrize(
    "value",
    [
        np.zeros(3, complex),
        np.array([h5py.Reference()] * 3, h5py.ref_dtype),
        np.array([np.arange(3)] * 3 + [None], object)[:3],
        np.zeros(3, [("a", "f4"), ("b", complex)]),
        np.zeros(3, "V7"),
    ],
    ids=["complex", "references", "lists", "records of others", "opaque"],
)
def test_types_that_are_neither_numbers_nor_text(tmp_path, value):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        kind = h5py.vlen_dtype(np.int8) if value.dtype == object and value[0] is not None else value.dtype
        file.create_dataset("d", data=value, dtype=h5py.ref_dtype if h5py.check_ref_dtype(value.dtype) else kind)
    with open_hdf5(tmp_path / "a.h5") as file:
        data = file.get("d")
        assert isinstance(data, Data) and data.shape == (3,)
        with pytest.raises(AssetError, match="a.h5: dataset 'd' holds neither numbers nor text"):
            data[:1]


def test_more_than_a_file_of_its_size_unpacks_to(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("d", (1 << 29,), "u1", chunks=(1 << 25,), compression="gzip")
        for k in range(16):
            data.id.write_direct_chunk((k << 25,), zeros_of_gzip(1 << 25))
        file.create_dataset("text", data="µ")
    with open_hdf5(tmp_path / "a.h5") as file:
        with pytest.raises(AssetError, match="a.h5: 'd': unpacks to more than 100 times its size .got '5368709"):
            file.get("d")[()]
        # In pieces no more is in memory than a chunk.
        assert file.get("d")[5:9].tolist() == [0] * 4
        assert file.get("text")[()] == "µ".encode() and file.get("none") is None


def test_what_is_left_of_a_file_can_be_read(tmp_path):
    """A data set that nobody asks for does not matter: only what is read is checked."""
    path = dsec(tmp_path / "e.h5")
    expected = open_events(path).read()
    with h5py.File(path, "a") as file:
        packed(file, "pictures", b"\1" * 100, (32024, ()))
        file["broken"] = h5py.SoftLink("/nowhere")
        file["kind"] = np.dtype("f4")
    read = open_events(path).read()
    for column in expected.columns:
        np.testing.assert_array_equal(getattr(read, column), getattr(expected, column))
    with open_hdf5(path) as file:
        assert isinstance(file.get("events"), Group) and file.get("kind") is None and "broken" not in file


def test_nothing_else_opens_hdf5():
    """Everywhere in the packages ``h5py.File`` writes, but for the door."""
    opened = []
    for package in (blinkgl, eflow):
        root = Path(package.__path__[0])
        for path in sorted(root.rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if not isinstance(node, ast.Call) or ast.unparse(node.func) not in ("h5py.File", "File"):
                    continue
                if len(node.args) < 2 or ast.unparse(node.args[1]) != "'w'":
                    opened.append(path.relative_to(root.parent).as_posix())
    assert opened == ["blinkgl/io/hdf5.py"]
