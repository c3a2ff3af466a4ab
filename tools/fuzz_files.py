"""Whole small files for :mod:`blinkgl.tools.fuzz`, written by other libraries or by a format's own rules."""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import cast

import av
import cv2
import h5py
import numpy as np
import tifffile
import torch
import trimesh
from PIL import Image
from safetensors.torch import save_file
from scipy.io import savemat
from trimesh.visual import TextureVisuals

from blinkgl.types.events import Events

HEIGHT, WIDTH = 24, 32
Make = Callable[[Path, Events], object]


def events() -> Events:
    rng = np.random.default_rng(5)
    columns = (rng.integers(0, size, 400) for size in (WIDTH, HEIGHT, 60_000, 2))
    x, y, t, p = (column.astype(kind) for column, kind in zip(columns, (np.uint16, np.uint16, np.int64, np.uint8)))
    return Events(x, y, np.sort(t), p)


def es(path: Path, e: Events) -> None:
    """Event Stream, version 2."""
    data, last = bytearray(b"Event Stream" + bytes([2, 0, 0, 1, WIDTH, 0, HEIGHT, 0])), 0
    for x, y, t, p in zip(e.x.tolist(), e.y.tolist(), e.t.tolist(), e.p.tolist()):
        data += b"\xff" * ((t - last) // 127) + bytes([(t - last) % 127 << 1 | p, x, 0, y, 0])
        last = t
    path.write_bytes(data)


def dat(path: Path, e: Events) -> None:
    rows = np.stack([e.t, e.x | e.y.astype(np.int64) << 14 | e.p.astype(np.int64) << 28], axis=1).astype("<u4")
    path.write_bytes(f"% Version 2\n% Height {HEIGHT}\n% Width {WIDTH}\n".encode() + bytes([12, 8]) + rows.tobytes())


def five_bytes(path: Path, e: Events) -> None:
    rows = zip(e.x.tolist(), e.y.tolist(), e.t.tolist(), e.p.tolist())
    path.write_bytes(b"".join(bytes([x, y, p << 7 | t >> 16, t >> 8 & 255, t & 255]) for x, y, t, p in rows))


def mat(path: Path, e: Events) -> None:
    savemat(path, {"events": {"x": e.x * 1.0, "y": e.y, "ts": e.t * 1.0, "p": e.p}}, do_compression=True)


def h5(*packed: object) -> Make:
    """Columns of a stranger's HDF5, packed by filters."""

    def make(path: Path, e: Events) -> None:
        with h5py.File(path, "w") as file:
            file["t_offset"] = np.array([7])
            for k, name in enumerate(("x", "y", "t", "p")):
                file.create_dataset(f"events/{name}s", data=getattr(e, name), chunks=(128,), **packed[k % len(packed)])

    return make


def rows(path: Path, e: Events) -> None:
    with h5py.File(path, "w") as file:
        file["davis/left/events"] = np.stack([e.x, e.y, e.t * 1e-6, e.p * 2.0 - 1], axis=1)


def mat73(path: Path, e: Events) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name in "xytp":
            file[name] = getattr(e, name)[None]
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")


def gz(path: Path, e: Events) -> None:
    with gzip.open(path, "wt") as file:
        file.writelines(f"{t} {x} {y} {p}\n" for x, y, t, p in zip(e.x, e.y, e.t, e.p))


def bag(path: Path, e: Events) -> None:
    from rosbags.rosbag1 import Writer

    from blinkgl.io.ros import event_array, typestore

    with Writer(path) as bag:
        kind, data = event_array(e, HEIGHT, WIDTH)
        bag.write(bag.add_connection("/events", kind, typestore=typestore(False)), 1, data)


def flow() -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    return np.dstack([x * 0.25 - 3, y * 0.5 - 6]), (x + y) % 7 > 0


def picture() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def stack(path: Path) -> None:
    """Pages with ImageJ's description, which states their interval."""
    tifffile.imwrite(path, np.stack([picture()[..., 0]] * 3), imagej=True, metadata={"finterval": 0.1, "axes": "TYX"})


def saved(path: Path) -> None:
    """By Pillow; kinds that hold several pictures get three."""
    more = [Image.fromarray(picture() // k) for k in (2, 3)] if path.suffix in (".gif", ".webp", ".png") else []
    if more:
        Image.fromarray(picture()).save(path, save_all=True, append_images=more, duration=50)
    else:
        Image.fromarray(picture()).save(path)


def exr(path: Path) -> None:
    """Of no compression, by OpenEXR's file layout: a scan line a block."""
    attribute = lambda name, kind, value: name + b"\0" + kind + b"\0" + struct.pack("<I", len(value)) + value
    channels = b"".join(name + b"\0" + struct.pack("<iIii", 2, 0, 1, 1) for name in (b"B", b"G", b"R")) + b"\0"
    window = struct.pack("<4i", 0, 0, WIDTH - 1, HEIGHT - 1)
    head = struct.pack("<II", 20000630, 2) + attribute(b"channels", b"chlist", channels)
    head += attribute(b"compression", b"compression", b"\0") + attribute(b"dataWindow", b"box2i", window)
    head += attribute(b"displayWindow", b"box2i", window) + attribute(b"lineOrder", b"lineOrder", b"\0")
    head += attribute(b"pixelAspectRatio", b"float", struct.pack("<f", 1))
    head += attribute(b"screenWindowCenter", b"v2f", bytes(8))
    head += attribute(b"screenWindowWidth", b"float", struct.pack("<f", 1)) + b"\0"
    size = 8 + WIDTH * 12
    starts = b"".join(struct.pack("<Q", len(head) + 8 * HEIGHT + k * size) for k in range(HEIGHT))
    lines = (picture().astype("<f4") / 255).transpose(0, 2, 1)
    path.write_bytes(
        head + starts + b"".join(struct.pack("<ii", k, size - 8) + line.tobytes() for k, line in enumerate(lines))
    )


def video(codec: str, pixels: str) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        with av.open(str(path), "w") as file:
            stream = cast(av.VideoStream, file.add_stream(codec, rate=10))
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pixels
            for k in range(3):
                frame = av.VideoFrame.from_ndarray(picture() // (k + 1), format="rgb24").reformat(format=pixels)
                for packet in [*stream.encode(frame), *(stream.encode() if k == 2 else ())]:
                    file.mux(packet)

    return make


def spring(path: Path) -> None:
    with h5py.File(path, "w") as file:
        double = np.repeat(np.repeat(flow()[0], 2, axis=0), 2, axis=1)
        file.create_dataset("flow", data=double, chunks=(24, 32, 2), compression="gzip")


POSES = "".join(f"{k / 10:.6f} {k / 9} 1 0 0 0 0 1\n" for k in range(30))
EUROC = "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []\n" + "".join(
    f"{1403636579763555584 + k * 10**7},{k / 9},1,0,1,0,0,0\n" for k in range(30)
)
KITTI = "1 0 0 {} 0 1 0 0 0 0 1 0\n"
COLMAP = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n" + "".join(
    f"{k} 1 0 0 0 {k / 9} 0 0 1 {k}.png\n1 2 3\n" for k in range(1, 9)
)
NERF = {"frames": [{"time": k / 10, "transform_matrix": [[1, 0, 0, k / 9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
                   for k in range(9)]}  # fmt: skip
KALIBR = """cam0:
  camera_model: pinhole
  distortion_model: radtan
  distortion_coeffs: [-0.1, 0.01, 0.0, 0.0]
  intrinsics: [500, 500, 320, 240]
  resolution: [640, 480]
  T_cam_imu: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""
OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix {rows: 3, cols: 3, dt: d, data: [500., 0., 320., 0., 500., 240., 0., 0., 1.]}
distortion_coefficients: !!opencv-matrix {rows: 1, cols: 5, dt: d, data: [-0.1, 0.01, 0., 0., 0.]}
"""
STAMPS = "# timestamp [s] filename\n" + "".join(f"1305031102.{k}00000 {k}.png\n" for k in range(1, 9))


def frame_set(path: Path) -> None:
    """A folder of pictures with a list of times, and calibration and poses beside it."""
    (path / "images").mkdir(parents=True)
    for k in range(1, 9):
        cv2.imwrite(str(path / f"images/{k}.png"), picture() // k)
    (path / "images/timestamps.txt").write_text("".join(f"{k / 10:.6f} {k}.png\n" for k in range(1, 9)))


def bag2(plugin: str) -> Make:
    def make(path: Path, e: Events) -> None:
        from rosbags import rosbag2

        from blinkgl.io.ros import typestore

        with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[plugin]) as bag:
            topic = bag.add_connection("/events", "dvs_msgs/msg/EventArray", typestore=typestore(True))
            names, kinds = ["x", "y", "s", "ns", "p"], ["<u2", "<u2", "<u4", "<u4", "u1"]
            # Every later event begins behind the polarity before it, times on multiples of four bytes.
            aligned = np.dtype({"names": names, "formats": kinds, "offsets": [1, 3, 7, 11, 15]})
            rows = np.zeros(len(e), aligned)
            rows["x"], rows["y"], rows["ns"], rows["p"] = e.x, e.y, e.t * 1000, e.p
            head = b"\0\1\0\0" + struct.pack("<III", 0, 0, 1) + bytes(4) + struct.pack("<III", HEIGHT, WIDTH, len(e))
            first = rows[:1].astype(list(zip(names, kinds))).tobytes()
            bag.write(topic, 1, head + first + rows[1:].tobytes())

    return make


def scene(path: Path) -> None:
    """A GLB with what `blinkgl import` writes: two bodies with materials and a picture, a camera, a lamp, a motion."""
    boxes = [trimesh.creation.box() for _ in range(2)]
    boxes[0].visual = TextureVisuals(np.zeros((len(boxes[0].vertices), 2)), image=Image.fromarray(picture()))
    data = cast(bytes, trimesh.Scene(boxes).export(file_type="glb"))
    length = int.from_bytes(data[12:16], "little")
    tree, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    binary += b"\0" * (-len(binary) % 4)
    for values, kind in ((np.arange(2, dtype="f4"), "SCALAR"), (np.eye(2, 3, dtype="f4"), "VEC3")):
        tree["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes})
        view = len(tree["bufferViews"]) - 1
        tree["accessors"].append({"bufferView": view, "componentType": 5126, "count": 2, "type": kind})
        binary += values.tobytes()
    last, moved = len(tree["accessors"]) - 1, next(k for k, node in enumerate(tree["nodes"]) if "mesh" in node)
    channel = {"sampler": 0, "target": {"node": moved, "path": "translation"}}
    tree["animations"] = [{"samplers": [{"input": last - 1, "output": last}], "channels": [channel]}]
    tree["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.8, "znear": 0.02}}]
    lamp = {"type": "spot", "intensity": 9, "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.4}}
    tree |= {"extensions": {"KHR_lights_punctual": {"lights": [lamp]}}, "extensionsUsed": ["KHR_lights_punctual"]}
    tree["nodes"] += [{"camera": 0}, {"extensions": {"KHR_lights_punctual": {"light": 0}}}]
    tree["scenes"][0]["nodes"] += [len(tree["nodes"]) - 2, len(tree["nodes"]) - 1]
    tree["buffers"][0]["byteLength"] = len(binary)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body)


def tensors(path: Path) -> None:
    """A checkpoint of torch, of either age, or of safetensors."""
    held = {f"fnet.{k}.weight": torch.full((4, 3), float(k)) for k in range(3)}
    if path.suffix == ".safetensors":
        save_file(held, path, {"model": "{}"})
    else:
        tree = {"model": held, "epoch": np.float64(3), "step": 7}
        torch.save(tree, path, _use_new_zipfile_serialization=path.stem != "old")
