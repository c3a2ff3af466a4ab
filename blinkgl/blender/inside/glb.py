"""A GLB's JSON and bytes, and what is written into one that Blender exported: right times, key frames of baked nodes.

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
    text += b" " * (-len(text) % 4)
    parts = [struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(binary), b"BIN\0"), bytes(binary)]
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + sum(map(len, parts))) + b"".join(parts))


def multiply_times(tree: dict, binary: bytearray, factor: float) -> None:
    """Multiply the times of all key frames."""
    for index in {sampler["input"] for animation in tree.get("animations", []) for sampler in animation["samplers"]}:
        accessor = tree["accessors"][index]
        begin = tree["bufferViews"][accessor["bufferView"]].get("byteOffset", 0) + accessor.get("byteOffset", 0)
        times = np.frombuffer(binary, "<f4", accessor["count"], begin) * np.float64(factor)
        binary[begin : begin + 4 * len(times)] = times.astype("<f4").tobytes()
        accessor["min"], accessor["max"] = [float(np.float32(times.min()))], [float(np.float32(times.max()))]


def add_keys(
    tree: dict, binary: bytearray, node: int, path: str, times: list[float], values: np.ndarray, kind: str = "LINEAR"
) -> None:
    """Add key frames of a node to the first animation. values : (K, n)."""
    given = []
    for numbers, shape in ((np.array(times, "<f4"), "SCALAR"), (np.asarray(values, "<f4"), path)):
        binary += bytes(-len(binary) % 4)
        view = {"buffer": 0, "byteOffset": len(binary), "byteLength": numbers.nbytes}
        binary += numbers.tobytes()
        tree.setdefault("bufferViews", []).append(view)
        types = {"rotation": "VEC4", "translation": "VEC3", "scale": "VEC3"}
        accessor = {
            "bufferView": len(tree["bufferViews"]) - 1,
            "componentType": 5126,
            "type": types.get(shape, "SCALAR"),
        }
        accessor["count"] = numbers.size if accessor["type"] == "SCALAR" else len(numbers)
        if shape == "SCALAR":
            accessor |= {"min": [float(numbers[0])], "max": [float(numbers[-1])]}
        tree.setdefault("accessors", []).append(accessor)
        given.append(len(tree["accessors"]) - 1)
    animation = tree.setdefault("animations", [{"name": "Scene", "channels": [], "samplers": []}])[0]
    animation["samplers"].append({"input": given[0], "output": given[1], "interpolation": kind})
    target = {"node": node, "path": path}
    animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})
