"""Hand-made glTF files for tests."""

import json
import struct
from pathlib import Path

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

    def array(self, values, kind: str, **more) -> int:
        values = np.ascontiguousarray(values)
        component = {"f4": 5126, "u4": 5125, "u2": 5123, "u1": 5121}[values.dtype.str[1:]]
        accessor = {"bufferView": self.view(values.tobytes()), "componentType": component, "count": len(values)}
        self.tree["accessors"].append({**accessor, "type": kind, **more})
        return len(self.tree["accessors"]) - 1

    def strided(self, rows, *parts: dict) -> None:
        """Accessors of three numbers each to one view of rows."""
        view = self.view(rows.tobytes())
        self.tree["bufferViews"][view]["byteStride"] = rows.strides[0]
        for part in parts:
            self.tree["accessors"].append({"bufferView": view, "count": len(rows), "type": "VEC3", **part})

    def mesh(self, vertices, faces, normals=None, uvs=None, material=None) -> int:
        attributes = {"POSITION": self.array(np.asarray(vertices, "f4"), "VEC3")}
        if normals is not None:
            attributes["NORMAL"] = self.array(np.asarray(normals, "f4"), "VEC3")
        if uvs is not None:
            attributes["TEXCOORD_0"] = self.array(np.asarray(uvs, "f4"), "VEC2")
        primitive = {"attributes": attributes, "indices": self.array(np.asarray(faces, "u4").ravel(), "SCALAR")}
        if material is not None:
            primitive["material"] = material
        return self.primitive(**primitive)

    def primitive(self, attributes: dict, **more) -> int:
        """A mesh of one primitive."""
        self.tree["meshes"].append({"primitives": [{"attributes": attributes, **more}]})
        return len(self.tree["meshes"]) - 1

    def node(self, root: bool = True, **fields) -> int:
        self.tree["nodes"].append(fields)
        if root:
            self.tree["scenes"][0]["nodes"].append(len(self.tree["nodes"]) - 1)
        return len(self.tree["nodes"]) - 1

    def clip(self, node: int, path: str, times, values, kind: str | None = "LINEAR") -> int:
        """One more channel of the animation.   times : or the number of the accessor that has them; it is returned."""
        widths = {"rotation": "VEC4", "weights": "SCALAR"}
        values = np.asarray(values, "f4")
        values = values.reshape(-1, 1) if path == "weights" else values.reshape(-1, values.shape[-1])
        clock = times if isinstance(times, int) else self.array(np.asarray(times, "f4"), "SCALAR")
        sampler = {"input": clock, "output": self.array(values, widths.get(path, "VEC3"))}
        (animation,) = self.tree.setdefault("animations", [{"channels": [], "samplers": []}])
        animation["samplers"].append({**sampler, "interpolation": kind} if kind else sampler)
        target = {"node": node, "path": path}
        animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})
        return clock

    def glb(self) -> bytes:
        tree = {**self.tree, "buffers": [{"byteLength": len(self.data)}]} if self.data else self.tree
        text = json.dumps(tree).encode()
        text += b" " * (-len(text) % 4)
        binary = self.data + b"\0" * (-len(self.data) % 4)
        body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
        return struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body

    def write(self, path: Path) -> Path:
        """Write a GLB, and return where."""
        path.write_bytes(self.glb())
        return path

    def gltf(self, folder, name="scene.gltf", uri="scene.bin"):
        (folder / uri).write_bytes(self.data) if ".." not in uri and not uri.startswith("/") else None
        path = folder / name
        path.write_text(json.dumps({**self.tree, "buffers": [{"byteLength": len(self.data), "uri": uri}]}))
        return path


def triangle(builder: GltfBuilder, **options) -> int:
    return builder.mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], **options)


def triangle_file(builder: GltfBuilder | None = None, tree: dict | None = None, **options) -> GltfBuilder:
    """A file with a triangle at a node of its own.   tree : entries of its JSON."""
    builder = builder or GltfBuilder()
    builder.tree.update(tree or {})
    builder.node(mesh=triangle(builder, **options))
    return builder


def textured_file(uri: str) -> GltfBuilder:
    """A triangle whose colour is an image beside the file."""
    surface = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    tree = {"materials": [surface], "images": [{"uri": uri}], "textures": [{"source": 0}]}
    return triangle_file(tree=tree, uvs=[(0, 0), (1, 0), (0, 1)], material=0)


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
    attributes["WEIGHTS_0"] = (
        builder.array(np.round(weights * 255).astype("u1"), "VEC4", normalized=True)
        if normalised
        else builder.array(weights.astype("f4"), "VEC4")
    )
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
    turns = np.array(TURNS)
    if kind == "CUBICSPLINE":
        turns = np.stack([0 * turns, turns, 0 * turns], axis=1)
    times = builder.clip(upper, "rotation", [0, 0.5, 1], turns, kind)
    if morphs:
        builder.clip(node, "weights", times, [0, 1, 0], None)
    builder.tree["animations"][0]["name"] = "wave"
    if change is not None:
        change(builder)
    return builder
