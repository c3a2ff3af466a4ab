"""A glTF 2.0 file's JSON and bytes, parsed and checked; only files in its own folder are read.

Reference: Khronos glTF 2.0 specification, sections 3.6 (buffers) and 4 (the GLB container).
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.errors import AssetError
from blinkgl.scene.importing import gltf_schema
from blinkgl.scene.reading import contents, reading
from blinkgl.types.poses import pose_of


def parse(data: bytes, where: str) -> tuple[dict, bytes]:
    """Return (the JSON, checked by gltf_schema; the bytes in a GLB). Raises AssetError."""
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
        tree = json.loads(text.decode("utf-8-sig"))
    except (ValueError, RecursionError):
        raise AssetError("the file is no valid glTF (its JSON cannot be read)", where=where) from None
    gltf_schema.check(tree, where)
    version, least = tree["asset"]["version"], tree["asset"].get("minVersion", "2.0")
    if not version.startswith("2") or least not in ("2", "2.0"):
        raise AssetError(
            "the file is no glTF 2.0",
            where=where,
            value=version if not version.startswith("2") else f"minVersion {least}",
            accepted="version 2.0",
        )
    return tree, binary


def buffers_of(tree: dict, binary: bytes, path: Path) -> list[bytes]:
    """Return the contents of all buffers, with the declared lengths. Raises AssetError."""
    buffers = []
    for number, buffer in enumerate(tree.get("buffers", [])):
        # EXT_meshopt_compression leaves a buffer without content as its fallback.
        compressed = next((e for e in buffer.get("extensions", {}) if e.endswith("_meshopt_compression")), None)
        if compressed and "uri" not in buffer:
            raise needs(compressed, str(path))
        # Only the first buffer of a GLB may lack a URI: its content is the binary chunk.
        data = fetch(buffer["uri"] or "", path, "buffer") if "uri" in buffer else binary if number == 0 else b""
        if len(data) < buffer.get("byteLength", 0):
            raise AssetError(
                f"buffer {number} is truncated",
                where=str(path),
                value=len(data),
                accepted=f"{buffer.get('byteLength')} bytes",
            )
        buffers.append(data)
    return buffers


def fetch(uri: str, path: Path, what: str) -> bytes:
    """Return the content of a URI of the file at ``path``: embedded, or a file beside it. Raises AssetError."""
    if uri.startswith("data:"):
        head, _, body = uri.partition(",")
        try:
            return (
                base64.b64decode(body, validate=True) if head.endswith(";base64") else unquote(body).encode("latin-1")
            )
        except (binascii.Error, ValueError):
            raise AssetError(f"the embedded {what} is corrupt", where=str(path)) from None
    if "://" in uri:
        raise AssetError(f"the {what} is on a network", where=str(path), value=uri, accepted="a file beside it")
    return contents(inside(path.parent, unquote(uri), str(path)), what, str(path))


def buffer_contents(path: Path, data: bytes) -> list[bytes]:
    """Return the external buffers of a .gltf file, in order."""
    with reading("scene", str(path)):
        tree, _ = parse(data, str(path))
        uris = [b.get("uri") or "" for b in tree.get("buffers", [])]
        return [fetch(uri, path, "buffer") for uri in uris if uri and not uri.startswith("data:")]


def inside(folder: Path, name: str, where: str) -> Path:
    """Return the file ``name`` below ``folder``. Raises AssetError when it is absolute, leads out by ``..`` or by a
    link, or is missing."""
    target = Path(folder) / name
    try:
        within = (
            name
            and "\0" not in name
            and not Path(name).is_absolute()
            and "\\" not in name
            and target.resolve().is_relative_to(Path(folder).resolve())
        )
        found = within and target.is_file()
    except (OSError, ValueError, RuntimeError):  # a name too long for the file system, or a link to itself
        within, found = True, False
    if not within:
        raise AssetError(
            "refers to a file outside its folder", where=where, value=name, accepted="a relative path below it"
        )
    if not found:
        raise AssetError("refers to a file that is missing", where=where, value=name)
    return target


def needs(extension: str, where: str) -> AssetError:
    """Return the error for a file that cannot be read without an extension."""
    return AssetError(
        f"the file needs the extension {extension}, which BlinkGL does not draw",
        where=where,
        accepted="a glTF 2.0 export without it (uncompressed, PNG or JPEG images)",
    )


def item(tree: dict, key: str, index: Any, where: str) -> dict:
    """Return an entry of a list of the file, by a reference to it."""
    items = tree.get(key, [])
    return items[index_of(index, len(items), key, where)]


def index_of(index: Any, count: int, what: str, where: str) -> int:
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
        rest = [
            tuple(map(float, n.get(k, d)))
            for k, d in (("translation", (0, 0, 0)), ("rotation", (0, 0, 0, 1)), ("scale", (1, 1, 1)))
        ]
        own = tuple(n["weights"]) if "weights" in n else None
        name = str(n.get("name") or f"node-{i}")
        visible = n.get("extensions", {}).get("KHR_node_visibility", {}).get("visible", True) is not False
        visible = visible and (parent is None or nodes[parent].visible)
        nodes[i] = Node(name, parent, n.get("mesh"), n.get("camera"), *rest, matrix, n.get("skin"), own, visible)
        stack += [(c, i, depth + 1) for c in reversed(n.get("children", []))]
    return nodes
