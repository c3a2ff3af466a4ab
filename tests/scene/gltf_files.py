"""Hand-made glTF files for tests."""

import json
import struct

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.scene.geometry import BUILDERS

TURNS = [Rotation.from_rotvec([0, 0, a]).as_quat() for a in (0.0, 0.7, 0.0)]


class GltfBuilder:
    """Collects arrays and JSON; ``glb()`` and ``gltf(folder, name)`` write the two kinds of file."""

    def __init__(self):
        self.tree = {
            "asset": {"version": "2.0"},
            "accessors": [],
            "bufferViews": [],
            "meshes": [],
            "nodes": [],
            "scenes": [{"nodes": []}],
        }
        self.data = b""

    def view(self, raw: bytes) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(raw)})
        self.data += raw
        return len(self.tree["bufferViews"]) - 1

    def array(self, values, kind: str) -> int:
        values = np.ascontiguousarray(values)
        component = {"f4": 5126, "u4": 5125, "u2": 5123, "u1": 5121}[values.dtype.str[1:]]
        self.tree["accessors"].append(
            {"bufferView": self.view(values.tobytes()), "componentType": component, "count": len(values), "type": kind}
        )
        return len(self.tree["accessors"]) - 1

    def mesh(self, vertices, faces, normals=None, uvs=None, material=None) -> int:
        attributes = {"POSITION": self.array(np.asarray(vertices, "f4"), "VEC3")}
        if normals is not None:
            attributes["NORMAL"] = self.array(np.asarray(normals, "f4"), "VEC3")
        if uvs is not None:
            attributes["TEXCOORD_0"] = self.array(np.asarray(uvs, "f4"), "VEC2")
        primitive = {"attributes": attributes, "indices": self.array(np.asarray(faces, "u4").ravel(), "SCALAR")}
        if material is not None:
            primitive["material"] = material
        self.tree["meshes"].append({"primitives": [primitive]})
        return len(self.tree["meshes"]) - 1

    def node(self, root: bool = True, **fields) -> int:
        self.tree["nodes"].append(fields)
        if root:
            self.tree["scenes"][0]["nodes"].append(len(self.tree["nodes"]) - 1)
        return len(self.tree["nodes"]) - 1

    def glb(self) -> bytes:
        tree = {**self.tree, "buffers": [{"byteLength": len(self.data)}]} if self.data else self.tree
        text = json.dumps(tree).encode()
        text += b" " * (-len(text) % 4)
        binary = self.data + b"\0" * (-len(self.data) % 4)
        body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
        return struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body

    def gltf(self, folder, name="scene.gltf", uri="scene.bin"):
        (folder / uri).write_bytes(self.data) if ".." not in uri and not uri.startswith("/") else None
        path = folder / name
        path.write_text(json.dumps({**self.tree, "buffers": [{"byteLength": len(self.data), "uri": uri}]}))
        return path


def triangle(builder: GltfBuilder, **options) -> int:
    return builder.mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], **options)


def arm_file(kind="LINEAR", normalised=False, morphs=False, change=None) -> GltfBuilder:
    """A bar along y on two joints, the upper one of which turns about z and back in a second; its weights may be bytes,
    and a morph target may swell it."""
    bar = BUILDERS["cuboid"](extents=(0.4, 2.0, 0.4), subdivisions=4)
    up = np.clip(bar.vertices[:, 1] / 0.8 + 0.5, 0, 1)
    weights = np.stack([1 - up, up, 0 * up, 0 * up], axis=1)
    builder = GltfBuilder()
    mesh = builder.mesh(bar.vertices, bar.faces, normals=bar.normals)
    attributes = builder.tree["meshes"][mesh]["primitives"][0]["attributes"]
    attributes["JOINTS_0"] = builder.array(np.tile(np.array([0, 1, 0, 0], "u1"), (len(up), 1)), "VEC4")
    attributes["WEIGHTS_0"] = builder.array(
        np.round(weights * 255).astype("u1") if normalised else weights.astype("f4"), "VEC4"
    )
    if normalised:
        builder.tree["accessors"][attributes["WEIGHTS_0"]]["normalized"] = True
    if morphs:
        swell = builder.array((bar.vertices * [0.5, 0, 0]).astype("f4"), "VEC3")
        builder.tree["meshes"][mesh]["primitives"][0]["targets"] = [{"POSITION": swell}]
    upper = builder.node(root=False, name="upper", translation=[0, 1, 0])
    lower = builder.node(name="lower", children=[upper], translation=[0, -1, 0])
    bind = np.tile(np.eye(4, dtype="f4"), (2, 1, 1))
    bind[0, 3, 1], bind[1, 3, 1] = 1, 0  # columns first
    builder.tree["skins"] = [
        {"joints": [lower, upper], "inverseBindMatrices": builder.array(bind.reshape(2, 16), "MAT4")}
    ]
    node = builder.node(name="bar", mesh=mesh, skin=0, translation=[9, 9, 9])  # which a skin ignores
    times, turns = np.array([0, 0.5, 1], "f4"), np.array(TURNS, "f4")
    if kind == "CUBICSPLINE":
        turns = np.stack([0 * turns, turns, 0 * turns], axis=1).reshape(-1, 4)
    samplers = [
        {"input": builder.array(times, "SCALAR"), "output": builder.array(turns, "VEC4"), "interpolation": kind},
    ]
    channels = [{"sampler": 0, "target": {"node": upper, "path": "rotation"}}]
    if morphs:
        samplers.append({"input": samplers[0]["input"], "output": builder.array(np.array([0, 1, 0], "f4"), "SCALAR")})
        channels.append({"sampler": 1, "target": {"node": node, "path": "weights"}})
    builder.tree["animations"] = [{"name": "wave", "samplers": samplers, "channels": channels}]
    if change is not None:
        change(builder)
    return builder
