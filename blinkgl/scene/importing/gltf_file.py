"""A glTF 2.0 file's JSON and bytes, parsed and checked.

Reference: Khronos glTF 2.0 specification, sections 3.6 (buffers) and 4 (the GLB container).
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.errors import AssetError
from blinkgl.scene.importing import gltf_schema
from blinkgl.scene.importing.neighbours import Neighbours
from blinkgl.scene.reading import contents, reading
from blinkgl.types.poses import pose_of


def parse(data: bytes, where: str) -> tuple[dict, bytes, list[str]]:
    """Return (the JSON, checked by gltf_schema; the bytes in a GLB; the properties that glTF does not have). Raises
    AssetError."""
    binary = b""
    if data[:4] == b"glTF":
        if len(data) < 20:
            raise AssetError("the file is truncated", where=where, value=f"{len(data)} bytes")
        version, length = struct.unpack_from("<II", data, 4)
        if version != 2 or length > len(data):
            raise AssetError(
                "the file is truncated or not glTF 2",
                where=where,
                value=f"version {version}, {len(data)} of {length} bytes",
            )
        # A GLB: 12 bytes of header, then chunks of (length, kind, content); the first of each kind counts.
        position, chunks = 12, {}
        while position + 8 <= length:
            size, kind = struct.unpack_from("<II", data, position)
            if position + 8 + size > length:
                raise AssetError("the file is truncated inside a chunk", where=where)
            chunks.setdefault(kind, data[position + 8 : position + 8 + size])
            position += 8 + size
        # The kinds of chunks are the ASCII codes of "JSON" and "BIN\0".
        text, binary = chunks.get(0x4E4F534A, b""), chunks.get(0x004E4942, b"")
    else:
        text = data
    try:
        tree = json.loads(text.decode("utf-8-sig"), parse_float=_number)
    except (ValueError, RecursionError):
        raise AssetError("the file is no valid glTF (its JSON cannot be read)", where=where) from None
    unknown = list(dict.fromkeys(gltf_schema.unknown(gltf_schema.check(tree, where))))
    version, least = tree["asset"]["version"], tree["asset"].get("minVersion", "2.0")
    if not version.startswith("2") or least not in ("2", "2.0"):
        raise AssetError(
            "the file is no glTF 2.0",
            where=where,
            value=version if not version.startswith("2") else f"minVersion {least}",
            accepted="version 2.0",
        )
    return tree, binary, unknown


def _number(text: str) -> float:
    """Return a number of JSON, in which 36.0 is a whole one."""
    number = float(text)
    # Up to 2^53 every whole number is one float; beyond, a float stands for several.
    return int(number) if abs(number) < 2**53 and number == int(number) else number


def buffers_of(tree: dict, binary: bytes, near: Neighbours) -> list[bytes]:
    """Return the contents of all buffers, with the declared lengths. Raises AssetError."""
    buffers, where = [], str(near.path)
    for number, buffer in enumerate(tree.get("buffers", [])):
        # EXT_meshopt_compression leaves a buffer without content as its fallback.
        compressed = next((e for e in buffer.get("extensions", {}) if e.endswith("_meshopt_compression")), None)
        if compressed and "uri" not in buffer:
            raise needs(compressed, where)
        # Only the first buffer of a GLB may lack a URI: its content is the binary chunk.
        data, uri = binary if number == 0 else b"", buffer.get("uri")
        if uri is not None:
            beside = not uri.startswith("data:")
            data = contents(near.find(unquote(uri)), "buffer") if beside else embedded(uri, "buffer", where)
        if len(data) < buffer.get("byteLength", 0):
            raise AssetError(
                f"buffer {number} is truncated",
                where=where,
                value=len(data),
                accepted=f"{buffer.get('byteLength')} bytes",
            )
        buffers.append(data)
    return buffers


def embedded(uri: str, what: str, where: str) -> bytes:
    """Return the content of a data URI, whose base64 may have line breaks. Raises AssetError."""
    head, _, body = uri.partition(",")
    try:
        plain = unquote(body)
        if not head.endswith(";base64"):
            return plain.encode("latin-1")
        return base64.b64decode("".join(plain.split()), validate=True)
    except (binascii.Error, ValueError):
        raise AssetError(f"the embedded {what} is corrupt", where=where) from None


def files_of_gltf(data: bytes, near: Neighbours, key: str) -> Iterator[tuple[str, Path | None]]:
    """Yield the names of the files beside a glTF file that are its "buffers" or "images" (``key``), and what is there.
    Raises AssetError: a broken file, a buffer that is missing or beyond the border."""
    with reading("scene", str(near.path)):
        tree, _, _ = parse(data, str(near.path))
        for uri in (entry.get("uri") or "data:" for entry in tree.get(key, [])):
            if not uri.startswith("data:"):
                yield uri, near.optional((unquote(uri), uri)) if key == "images" else near.find(unquote(uri))


def needs(extension: str, where: str) -> AssetError:
    """Return the error for a file that cannot be read without an extension."""
    return AssetError(
        f"the file needs the extension {extension}, which BlinkGL does not draw",
        where=where,
        accepted="a glTF 2.0 export without it (uncompressed, PNG or JPEG images)",
    )


def item(tree: dict, key: str, index: object, where: str) -> dict:
    """Return an entry of a list of the file, by a reference to it."""
    items = tree.get(key, [])
    return items[index_of(index, len(items), key, where)]


def index_of(index: object, count: int, what: str, where: str) -> int:
    """Return a checked reference: an index below ``count``."""
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < count:
        raise AssetError(
            f"the file is no valid glTF (a reference to {what} that does not exist)", where=where, value=index
        )
    return index


# ---------------------------------------------------------------------------------------------------------------------
# The node hierarchy of a glTF 2.0 file: the nodes of its default scene, and their rest transforms.

MAX_NODES, _MAX_DEPTH = 200_000, 256


@dataclass(frozen=True, eq=False)
class Node:
    """A node: name, parent (None at the root), mesh, camera and skin index (None without), rest translation, quaternion
    x y z w, scale or matrix; weights of the mesh's morph targets where the node has its own; whether it and what is
    above it are visible (KHR_node_visibility)."""

    name: str
    parent: int | None
    mesh: int | None
    camera: int | None
    translation: tuple
    rotation: tuple
    scale: tuple
    matrix: np.ndarray | None
    skin: int | None = None
    weights: tuple | None = None
    visible: bool = True

    @property
    def shows(self) -> bool:
        """Return whether it shows a mesh."""
        return self.mesh is not None and self.visible

    def local(self) -> np.ndarray:
        """Return the rest transform to the parent, (4, 4)."""
        if self.matrix is not None:
            return self.matrix
        # R diag(scale): the scale multiplies the columns.
        return pose_of(self.translation, Rotation.from_quat(self.rotation).as_matrix() * self.scale)


def nodes_of(tree: dict, where: str) -> dict[int, Node]:
    """Return the nodes of the default scene (of the file, when it has none), parents first."""
    raw, scenes = tree.get("nodes", []), tree.get("scenes", [])
    if len(raw) > MAX_NODES:
        raise AssetError("the file has too many nodes", where=where, value=len(raw), accepted=f"at most {MAX_NODES}")
    if scenes:
        roots = scenes[index_of(tree.get("scene", 0), len(scenes), "scene", where)].get("nodes", [])
    else:
        children = {c for n in raw for c in n.get("children", [])}
        roots = [i for i in range(len(raw)) if i not in children]
    nodes: dict[int, Node] = {}
    # Depth first in the file's order; the end of the stack is next.
    stack = [(r, None, 0) for r in reversed(roots)]
    while stack:
        i, parent, depth = stack.pop()
        # A node that is met twice has two parents or is its own ancestor.
        if i in nodes or depth > _MAX_DEPTH:
            raise AssetError(
                "the nodes are no tree" if i in nodes else f"the nodes are nested more than {_MAX_DEPTH} deep",
                where=where,
                value=i,
            )
        n = raw[index_of(i, len(raw), "node", where)]
        # The file has the matrix column by column.
        matrix = np.array(n["matrix"], float).reshape(4, 4).T if n.get("matrix") else None
        translation, rotation, scale = (
            tuple(map(float, n.get(k, d)))
            for k, d in (("translation", (0, 0, 0)), ("rotation", (0, 0, 0, 1)), ("scale", (1, 1, 1)))
        )
        own = tuple(n["weights"]) if "weights" in n else None
        name = str(n.get("name") or f"node-{i}")
        visible = n.get("extensions", {}).get("KHR_node_visibility", {}).get("visible", True) is not False
        visible = visible and (parent is None or nodes[parent].visible)
        skin, camera = n.get("skin"), n.get("camera")
        nodes[i] = Node(
            name,
            parent,
            mesh=n.get("mesh"),
            camera=camera,
            translation=translation,
            rotation=rotation,
            scale=scale,
            matrix=matrix,
            skin=skin,
            weights=own,
            visible=visible,
        )
        stack += [(c, i, depth + 1) for c in reversed(n.get("children", []))]
    return nodes
