"""Hand-made glTF files for tests."""

import json
import struct

import numpy as np


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
