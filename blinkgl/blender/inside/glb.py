"""A GLB's JSON and bytes, and key frames that are written into one.

A part of convert.py: it needs only NumPy.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np


def read(path: Path) -> tuple[dict, bytearray]:
    """Return (the JSON, the binary part)."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), bytearray(data[28 + length :])


def write(path: Path, tree: dict, binary: bytearray) -> None:
    """Write a GLB of both."""
    binary += bytes(-len(binary) % 4)
    if binary:
        tree.setdefault("buffers", [{}])[0]["byteLength"] = len(binary)
    text = json.dumps(tree, separators=(",", ":")).encode()
    # By the standard, chunks are of whole words, and text is filled up with spaces.
    text += b" " * (-len(text) % 4)
    parts = [struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(binary), b"BIN\0"), bytes(binary)]
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + sum(map(len, parts))) + b"".join(parts))


def add_values(tree: dict, binary: bytearray, values: np.ndarray, kind: str) -> int:
    """Add an accessor of float32 values, and return its index. kind : "SCALAR", "VEC3" …"""
    numbers = np.asarray(values, "<f4")
    binary += bytes(-len(binary) % 4)
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": numbers.nbytes}
    binary += numbers.tobytes()
    views, accessors = tree.setdefault("bufferViews", []), tree.setdefault("accessors", [])
    views.append(view)
    count = numbers.size if kind == "SCALAR" else len(numbers)
    accessors.append({"bufferView": len(views) - 1, "componentType": 5126, "count": count, "type": kind})
    return len(accessors) - 1


def add_keys(
    tree: dict, binary: bytearray, node: int, path: str, times: list[float], values: np.ndarray, kind: str = "LINEAR"
) -> None:
    """Add key frames of a node to the first animation. values : (K, n)."""
    animation = tree.setdefault("animations", [{"name": "Scene", "channels": [], "samplers": []}])[0]
    shape = {"rotation": "VEC4", "weights": "SCALAR"}.get(path, "VEC3")
    accessors = [add_values(tree, binary, *one) for one in ((np.array(times), "SCALAR"), (values, shape))]
    # The standard asks for the ends of a sampler's times, as the float32 that they have become.
    tree["accessors"][accessors[0]] |= {"min": [float(np.float32(times[0]))], "max": [float(np.float32(times[-1]))]}
    animation["samplers"].append({"input": accessors[0], "output": accessors[1], "interpolation": kind})
    aim = {"sampler": len(animation["samplers"]) - 1, "target": {"node": node, "path": path}}
    animation["channels"].append(aim)
