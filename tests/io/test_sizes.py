"""Small files that claim gigabytes: nothing of that size is made, and files of their size are read."""

from __future__ import annotations

import bz2
import functools
import re
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import av
import numpy as np
import pytest
import tifffile
from PIL import Image

from blinkgl.errors import AssetError
from blinkgl.io.formats import open_events
from blinkgl.io.frames import open_frames
from blinkgl.io.images import NpzReader, read_png
from blinkgl.io.records import check_claim, most_unpacked, unpacked
from blinkgl.io.ros import event_array, typestore
from blinkgl.io.sequence_tables import read_poses, read_tracks
from blinkgl.io.stills import open_stills
from blinkgl.types.events import Events
from eflow.data.mvsec import NpzTruth

SIDE = 9000


@functools.cache
def png(width: int, height: int, bits: int, colour: int) -> bytes:
    """A black picture, by the specification's chunks."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    row, packer = bytes(1 + width * bits * {0: 1, 2: 3, 6: 4}[colour] // 8), zlib.compressobj(1)
    data = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def exr(width: int, height: int, rows: int | None = None) -> bytes:
    """Black RGB of float32 by OpenEXR's file layout, zip of 16 rows; the chunks after ``rows`` are missing."""

    def attribute(name: bytes, kind: bytes, value: bytes) -> bytes:
        return name + b"\0" + kind + b"\0" + struct.pack("<I", len(value)) + value

    channels = b"".join(c + b"\0" + struct.pack("<iBBBBii", 2, 0, 0, 0, 0, 1, 1) for c in (b"B", b"G", b"R")) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    head = struct.pack("<II", 20000630, 2) + attribute(b"channels", b"chlist", channels)
    head += attribute(b"compression", b"compression", b"\3") + attribute(b"lineOrder", b"lineOrder", b"\0")
    head += attribute(b"dataWindow", b"box2i", window) + attribute(b"displayWindow", b"box2i", window)
    head += attribute(b"pixelAspectRatio", b"float", struct.pack("<f", 1))
    head += attribute(b"screenWindowCenter", b"v2f", bytes(8)) + attribute(
        b"screenWindowWidth", b"float", struct.pack("<f", 1)
    )
    head, count = head + b"\0", -(-height // 16)
    block = zlib.compress(bytes(16 * width * 12), 9)
    body = [struct.pack("<ii", 16 * k, len(block)) + block for k in range(count if rows is None else rows // 16)]
    starts = np.cumsum([len(head) + 8 * count, *map(len, body)])[: len(body)]
    return head + starts.astype("<u8").tobytes().ljust(8 * count, b"\0") + b"".join(body)


def npz(path: Path, **arrays: tuple[tuple[int, ...], str]) -> None:
    """An archive of arrays of zeros, each packed piece by piece."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, (shape, kind) in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                dtype = np.dtype(kind)
                np.lib.format.write_array_header_1_0(
                    member, {"descr": dtype.str, "fortran_order": False, "shape": shape}
                )
                left = int(np.prod(shape)) * dtype.itemsize
                for at in range(0, left, 1 << 24):
                    member.write(bytes(min(1 << 24, left - at)))


def bag(path: Path, form: str) -> None:
    """Six million events at one place: 78 MB of a message."""
    count = 5_400_000
    if form in ("BZ2", "LZ4"):
        from rosbags.rosbag1 import Writer

        zero = np.zeros(count)
        kind, data = event_array(Events(*(zero.astype(k) for k in ("u2", "u2", "i8", "u1"))), 24, 32)
        writer = Writer(path)
        writer.set_compression(Writer.CompressionFormat[form])
        with writer:
            writer.write(writer.add_connection("/events", kind, typestore=typestore(False)), 1, data)
        return
    from rosbags import rosbag2

    plugin = rosbag2.StoragePlugin.SQLITE3 if form == "sqlite" else rosbag2.StoragePlugin.MCAP
    modes = {"mcap chunks": rosbag2.CompressionMode.STORAGE, "mcap file": rosbag2.CompressionMode.FILE}
    mode = modes.get(form, rosbag2.CompressionMode.MESSAGE)
    writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with writer:
        topic = writer.add_connection("/events", "dvs_msgs/msg/EventArray", typestore=typestore(True))
        head = b"\0\1\0\0" + struct.pack("<III", 0, 0, 1) + b"\0" + bytes(3) + struct.pack("<III", 24, 32, count)
        writer.write(topic, 1, head + bytes(16 * count + 16))


def mov(path: Path) -> None:
    """A video of 64x48 px whose pictures say, inside, that they have 16000x16000."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream("png", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "rgb24"
        for k in range(3):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), k * 20, np.uint8), format="rgb24")
            for packet in [*stream.encode(frame), *(stream.encode() if k == 2 else ())]:
                file.mux(packet)
    data, at = bytearray(path.read_bytes()), 0
    while (at := data.find(b"IHDR", at)) >= 0:
        data[at + 4 : at + 12] = struct.pack(">II", 16_000, 16_000)
        data[at + 17 : at + 21] = struct.pack(">I", zlib.crc32(data[at : at + 17]))
        at += 4
    path.write_bytes(data)


def still(path: Path) -> object:
    return open_stills(path).read()


def events(path: Path) -> object:
    return open_events(path).read()


def frames(path: Path) -> object:
    return list(open_frames(path))


POSES = {"K": ((3, 3), "f8"), "near": ((), "f8"), "object_names": ((0,), "U1")}
LARGE, PACKED = "9000x9000 px is too large", "unpacks to more than 100 times its size"
BMP = b"BM" + struct.pack("<IIIIiiHHIIIIII", 54, 0, 54, 40, SIDE, SIDE, 1, 24, *[0] * 6)
RADIANCE = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 9000 +X 9000\n"
Y4M = b"YUV4MPEG2 W16000 H16000 F25:1 C420\nFRAME\n" + bytes(99)
CLAIMS = {
    "a.exr": (lambda p: p.write_bytes(exr(16_000, 16_000, 48)), still, r"OpenEXR .*; expected at most 16777216 px"),
    "a.png": (lambda p: p.write_bytes(png(SIDE, SIDE, 16, 2)), still, LARGE + r" \(at most 42 Mpx in"),
    "flow.png": (lambda p: p.write_bytes(png(SIDE, SIDE, 16, 2)), read_png, LARGE),
    "a.tif": (lambda p: tifffile.imwrite(p, np.zeros((SIDE, SIDE), np.float32), compression="zlib"), still, LARGE),
    "a.gif": (lambda p: Image.new("L", (SIDE, SIDE)).save(p), still, LARGE),
    "a.bmp": (lambda p: p.write_bytes(BMP), still, LARGE),
    "a.pgm": (lambda p: p.write_bytes(b"P5 9000 9000 65535\n"), still, LARGE),
    "a.hdr": (lambda p: p.write_bytes(RADIANCE), still, LARGE),
    "frames.npz": (lambda p: npz(p, frames=((400, 1000, 1000), "u1")), frames, PACKED),
    "many.npz": (lambda p: npz(p, **dict.fromkeys("xyp", ((30_000_000,), "u1")), t_us=((30_000_000,), "i8")),
                 events, PACKED),
    "poses.npz": (lambda p: npz(p, t_ns=((4_000_000,), "i8"), T_world_cam=((4_000_000, 4, 4), "f8"), **POSES),
                  read_poses, PACKED),
    "other.npz": (lambda p: npz(p, t_ns=((7,), "i8"), T_world_cam=((4_000_000, 4, 4), "f8"), **POSES), read_poses,
                  "'T_world_cam' has the wrong shape or type"),
    "tracks.npz": (lambda p: npz(p, t_us=((4_000_000,), "i8"), target_points=((9, 4_000_000, 2), "f4")),
                   lambda p: read_tracks(p.parent), f"has the wrong shape|no such array|{PACKED}"),
    "flow.npz": (lambda p: npz(p, timestamps=((1 << 26,), "f8"), x_flow_dist=((9,), "f4"), y_flow_dist=((9,), "f4")),
                 NpzTruth, PACKED),
    "bz2.bag": (lambda p: bag(p, "BZ2"), events, f"bz2.bag: damaged bag: {PACKED}"),
    "lz4.bag": (lambda p: bag(p, "LZ4"), events, f"lz4.bag: damaged bag: {PACKED}"),
    "sqlite": (lambda p: bag(p, "sqlite"), events, f"sqlite: damaged bag: {PACKED}"),
    "mcap messages": (lambda p: bag(p, "mcap"), events, f"damaged bag: {PACKED}"),
    "mcap file": (lambda p: bag(p, "mcap file"), events, f"damaged bag: {PACKED}"),
    "mcap chunks": (lambda p: bag(p, "mcap chunks"), events, f"damaged bag: {PACKED}"),
    "a.mov": (mov, frames, "video too large .got '16000x16000'.; expected at most 64 Mpx a frame|Invalid argument"),
    "a.y4m": (lambda p: p.write_bytes(Y4M), frames, "video too large|cannot read video"),
}  # fmt: skip


@pytest.fixture(scope="module")
def claims(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("claims")
    for name, (make, _, _) in CLAIMS.items():
        make(folder / name)
    return folder


def test_claims_are_refused_before_memory_is_taken(claims):
    """Each in a process that may take 1 GB more than the imports."""
    program = (
        "import json, resource, sys; from pathlib import Path; from tests.io.test_sizes import CLAIMS\n"
        "from blinkgl.errors import BlinkGLError\n"
        "size = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_DATA, (2 << 30, 2 << 30))\n"
        "for name in CLAIMS:\n"
        "    try: CLAIMS[name][1](Path(sys.argv[1]) / name); print('read')\n"
        "    except BlinkGLError as error: print(error)\n"
        "    except MemoryError: print('MemoryError')\n"
        # Not ru_maxrss, which begins with what the process that started this one held.
        "print(Path('/proc/self/status').read_text().partition('VmHWM:')[2].split()[0])\n"
    )
    run = subprocess.run([sys.executable, "-c", program, str(claims)], capture_output=True, text=True)
    assert run.returncode == 0, (run.returncode, run.stderr)
    *lines, peak = run.stdout.splitlines()
    for (name, (_, _, message)), line in zip(CLAIMS.items(), lines, strict=True):
        assert re.search(message, line), (name, line)
    assert int(peak) < 1.6e6, f"{int(peak) / 1e6:.1f} GB"


def test_files_of_their_size_are_read(tmp_path):
    (tmp_path / "a.exr").write_bytes(exr(640, 480))
    assert open_stills(tmp_path / "a.exr").read().shape == (480, 640, 3)
    (tmp_path / "a.png").write_bytes(png(3000, 2000, 16, 2))
    assert read_png(tmp_path / "a.png").shape == (2000, 3000, 3)
    npz(tmp_path / "a.npz", frames=((60, 1000, 1000), "u1"), timestamps_us=((60,), "i8"))
    with NpzReader(tmp_path / "a.npz") as file:
        assert file["frames"].nbytes == 60_000_000


def test_a_limit_of_one_place():
    assert most_unpacked(10) == 1 << 28 and most_unpacked(10**7) == 10**9 and most_unpacked(10, 99) == 1000
    check_claim(10**9, "a", 10**7)
    with pytest.raises(AssetError, match=r"a: unpacks to more than 100 times its size \(got '1000000001 bytes'\)"):
        check_claim(10**9 + 1, "a", 10**7)
    with pytest.raises(AssetError, match="a: too large for this machine's memory"):
        check_claim(1 << 60, "a")
    text = np.random.default_rng(0).bytes(5000)
    assert unpacked(bz2.BZ2Decompressor, bz2.compress(text) + bz2.compress(b"x")) == text + b"x"
    for data, message in ((bz2.compress(bytes(10**6)), "unpacks to more"), (bz2.compress(text)[:-9], "is cut")):
        with pytest.raises(ValueError, match=message):
            unpacked(bz2.BZ2Decompressor, data, 1)
