"""Reader of glTF 2.0 (.gltf with its buffers and images, .glb): meshes, materials, cameras, node hierarchy, animations.

Its own reader rather than trimesh's, because a scene's cameras, unlit and double-sided materials, node names and
animations are wanted, and because every count and path a file claims has to be checked before it is believed.
Reference: Khronos glTF 2.0 specification, sections 3.5 (scenes), 3.6 (buffers, accessors), 3.7 (meshes), 3.9 (materials),
3.10 (cameras), 3.11 (animations); extensions KHR_materials_unlit, KHR_texture_transform.

Coordinates stay as in the file (y up) until :meth:`Document.pieces` or an importer turns them z up.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.errors import AssetError
from blinkgl.scene.images import content_hash, decode_image
from blinkgl.scene.types import Material, Texture
from blinkgl.srgb import linear_from_srgb

# Columns: the file's x, y, z axes in a z-up world.
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
SUPPORTED = {"KHR_materials_unlit", "KHR_texture_transform", "KHR_mesh_quantization", "KHR_materials_emissive_strength",
             "KHR_lights_punctual"}
_DTYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MAX_NODES, _MAX_DEPTH = 200_000, 256


@dataclass(frozen=True, eq=False)
class Piece:
    """Raw triangles. normals, uvs (v down) and material may be None."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    material: Material | None = None


def transformed(piece: Piece, matrix: np.ndarray) -> Piece:
    """The piece under an affine (4, 4) map; a mirroring one turns the faces round, so that they keep facing out."""
    linear = matrix[:3, :3]
    determinant = float(np.linalg.det(linear))
    vertices = piece.vertices @ linear.T + matrix[:3, 3]
    # Cofactors instead of the inverse: also right for a map that flattens the mesh.
    cofactors = np.stack([np.cross(linear[1], linear[2]), np.cross(linear[2], linear[0]), np.cross(linear[0], linear[1])])
    normals = None if piece.normals is None else piece.normals @ cofactors.T * (1.0 if determinant >= 0 else -1.0)
    return replace(piece, vertices=vertices, normals=normals, faces=piece.faces if determinant >= 0 else piece.faces[:, ::-1])


@contextmanager
def _valid(where: str):
    """What Python raises on JSON of the wrong shape, as one line."""
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, RecursionError, OverflowError, struct.error) as error:
        raise AssetError(f"the file is no valid glTF ({type(error).__name__}: {' '.join(str(error).split())[:80]})", where=where) from None


@dataclass(frozen=True)
class Node:
    """name, parent (None at the root), mesh and camera index (None without), rest translation, quaternion x y z w, scale
    or matrix."""

    name: str
    parent: int | None
    mesh: int | None
    camera: int | None
    translation: tuple
    rotation: tuple
    scale: tuple
    matrix: np.ndarray | None

    def local(self, translation=None, rotation=None, scale=None) -> np.ndarray:
        """(4, 4) transform to the parent, with animated values in place of the resting ones."""
        if self.matrix is not None:
            return self.matrix
        T = np.eye(4)
        turn = Rotation.from_quat(self.rotation if rotation is None else rotation).as_matrix()
        T[:3, :3] = turn * (self.scale if scale is None else scale)
        T[:3, 3] = self.translation if translation is None else translation
        return T


@dataclass(frozen=True, eq=False)
class Channel:
    """One animated property of a node: path translation | rotation | scale, times (K,) s, values (K, 3 or 4), interpolation
    LINEAR | STEP | CUBICSPLINE (then values (K, 3, n): in-tangent, value, out-tangent)."""

    node: int
    path: str
    times: np.ndarray
    values: np.ndarray
    interpolation: str

    def at(self, t: float) -> np.ndarray:
        """Value at t seconds, held outside the key frames (specification, 3.11 and appendix C)."""
        times = self.times
        values = self.values[:, 1] if self.interpolation == "CUBICSPLINE" else self.values
        i = int(np.searchsorted(times, t, side="right")) - 1
        if i < 0 or i >= len(times) - 1 or self.interpolation == "STEP":
            return values[min(max(i, 0), len(times) - 1)]
        h = times[i + 1] - times[i]
        s = (t - times[i]) / h
        if self.interpolation == "CUBICSPLINE":
            v = ((2 * s**3 - 3 * s**2 + 1) * values[i] + h * (s**3 - 2 * s**2 + s) * self.values[i, 2]
                 + (3 * s**2 - 2 * s**3) * values[i + 1] + h * (s**3 - s**2) * self.values[i + 1, 0])
            return v / np.linalg.norm(v) if self.path == "rotation" else v
        if self.path == "rotation":
            a, b = Rotation.from_quat(values[i]), Rotation.from_quat(values[i + 1])
            return (a * Rotation.from_rotvec(s * (a.inv() * b).as_rotvec())).as_quat()
        return (1 - s) * values[i] + s * values[i + 1]


@dataclass
class Document:
    """A parsed file. ``nodes`` are those of the default scene, parents before children, by their index in the file."""

    path: Path
    tree: dict
    buffers: list[bytes]
    max_texture: int
    textures: bool
    nodes: dict[int, Node] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)
    _materials: dict = field(default_factory=dict)
    _textures: dict = field(default_factory=dict)

    @property
    def where(self) -> str:
        return str(self.path)

    # ---- geometry
    def world(self, node: int, overrides: dict[int, dict] | None = None) -> np.ndarray:
        """(4, 4) transform of a node to the file's world; ``overrides``: node -> animated values."""
        T = np.eye(4)
        step: int | None = node
        while step is not None:
            T = self.nodes[step].local(**(overrides or {}).get(step, {})) @ T
            step = self.nodes[step].parent
        return T

    def mesh_pieces(self, mesh: int) -> list[Piece]:
        """The triangles of a mesh in its own coordinates, a piece per primitive; points and lines are left out."""
        with _valid(self.where):
            return self._mesh_pieces(mesh)

    def _mesh_pieces(self, mesh: int) -> list[Piece]:
        pieces = []
        for number, primitive in enumerate(_items(_item(self.tree, "meshes", mesh, self.where), "primitives", self.where)):
            mode = primitive.get("mode", 4)
            if mode not in (4, 5, 6):
                self.log.append(f"{self.path.name}: points or lines of mesh {mesh} left out")
                continue
            if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
                raise AssetError("Draco compression is not supported", where=self.where, accepted="an uncompressed export")
            attributes = primitive.get("attributes", {})
            if "POSITION" not in attributes:
                continue
            vertices = self.accessor(attributes["POSITION"]).astype(np.float64)
            order = self.accessor(primitive["indices"]).astype(np.int64).ravel() if "indices" in primitive else np.arange(len(vertices))
            if primitive.get("targets"):
                self.log.append(f"{self.path.name}: morph targets of mesh {mesh} are not supported, its base shape is used")
            if "JOINTS_0" in attributes:
                self.log.append(f"{self.path.name}: skinning of mesh {mesh} is not supported, its rest shape is used")
            material, uv_set, uv_matrix = self.material(primitive.get("material"))
            normals = self.accessor(attributes["NORMAL"]).astype(np.float64) if "NORMAL" in attributes else None
            uvs = self.accessor(attributes[f"TEXCOORD_{uv_set}"]).astype(np.float64) if f"TEXCOORD_{uv_set}" in attributes else None
            if uvs is not None and uv_matrix is not None:
                uvs = uvs @ uv_matrix[:2, :2].T + uv_matrix[:2, 2]
            pieces.append(Piece(vertices, _triangles(order, mode), normals, uvs, material))
        return pieces

    def pieces(self) -> list[Piece]:
        """The whole scene at rest as one object, z up."""
        return [transformed(p, Z_UP @ self.world(i)) for i, node in self.nodes.items() if node.mesh is not None
                for p in self.mesh_pieces(node.mesh)]

    def accessor(self, index: int) -> np.ndarray:
        """(count, n) values; normalised integers become floats."""
        a = _item(self.tree, "accessors", index, self.where)
        count, width = _count(a, self.where), _WIDTHS.get(a.get("type"))
        dtype = _DTYPES.get(a.get("componentType"))
        if dtype is None or width is None:
            raise AssetError(f"accessor {index} has an unknown type", where=self.where, value=[a.get("type"), a.get("componentType")])
        if "bufferView" in a:
            values = self._view(a["bufferView"], a.get("byteOffset", 0), count, width, np.dtype(dtype).newbyteorder("<"), index)
        else:
            values = np.zeros((count, width), dtype)
        if "sparse" in a:
            where, what, n = a["sparse"]["indices"], a["sparse"]["values"], _count(a["sparse"], self.where)
            at = self._view(where["bufferView"], where.get("byteOffset", 0), n, 1, np.dtype(_DTYPES[where["componentType"]]), index)
            new = self._view(what["bufferView"], what.get("byteOffset", 0), n, width, np.dtype(dtype), index)
            if n and int(at.max()) >= count:
                raise AssetError(f"accessor {index} has a sparse index outside it", where=self.where)
            values = values.copy()
            values[at.ravel().astype(np.int64)] = new
        if a.get("normalized") and values.dtype.kind in "iu":
            return np.maximum(values / float(np.iinfo(values.dtype).max), -1.0)
        return values

    def _view(self, view: int, offset: int, count: int, width: int, dtype: np.dtype, accessor: int) -> np.ndarray:
        v = _item(self.tree, "bufferViews", view, self.where)
        data = self.buffers[_index(v.get("buffer"), len(self.buffers), "buffer", self.where)]
        start = int(v.get("byteOffset", 0)) + int(offset)
        item = width * dtype.itemsize
        stride = int(v.get("byteStride", item)) or item
        needed = start + (stride * (count - 1) + item if count else 0)
        if start < 0 or offset < 0 or stride < item or needed > min(len(data), int(v.get("byteOffset", 0)) + int(v.get("byteLength", 0))):
            raise AssetError(f"the mesh is corrupt: accessor {accessor} reaches outside its buffer", where=self.where)
        return np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize))

    # ---- materials
    def material(self, index: int | None) -> tuple[Material | None, int, np.ndarray | None]:
        """(material, texture coordinate set, 3x3 texture transform or None)."""
        if index is None:
            return None, 0, None
        if index not in self._materials:
            m = _item(self.tree, "materials", index, self.where)
            pbr = m.get("pbrMetallicRoughness", {})
            info = pbr.get("baseColorTexture")
            texture = self._texture(info["index"]) if info is not None and self.textures else None
            transform = (info or {}).get("extensions", {}).get("KHR_texture_transform")
            uv_set = (transform or {}).get("texCoord", (info or {}).get("texCoord", 0))
            self._materials[index] = (Material(
                texture=texture, base_color=tuple(float(c) for c in pbr.get("baseColorFactor", (1, 1, 1, 1))[:3]),
                unlit="KHR_materials_unlit" in m.get("extensions", {}), double_sided=bool(m.get("doubleSided", False))),
                int(uv_set), _texture_transform(transform))
        return self._materials[index]

    def _texture(self, index: int) -> Texture | None:
        source = _item(self.tree, "textures", index, self.where).get("source")
        if source is None:
            self.log.append(f"{self.path.name}: texture {index} has no plain image, left out")
            return None
        if source not in self._textures:
            image = _item(self.tree, "images", source, self.where)
            if "bufferView" in image:
                v = _item(self.tree, "bufferViews", image["bufferView"], self.where)
                buffer = self.buffers[_index(v.get("buffer"), len(self.buffers), "buffer", self.where)]
                data = buffer[int(v.get("byteOffset", 0)) : int(v.get("byteOffset", 0)) + int(v.get("byteLength", 0))]
            else:
                data = _fetch(image.get("uri", ""), self.path, "image")
            name = str(image.get("name") or f"image-{source}")
            pixels = decode_image(data, self.max_texture, f"{self.where} (image '{name}')")
            self._textures[source] = Texture(pixels, name, content_hash(data))
        return self._textures[source]

    # ---- animations
    def channels(self, animation: int) -> list[Channel]:
        """Node animations; morph weights are left out with a log line."""
        with _valid(self.where):
            return self._channels(animation)

    def _channels(self, animation: int) -> list[Channel]:
        a = _item(self.tree, "animations", animation, self.where)
        samplers, found = _items(a, "samplers", self.where), []
        for channel in _items(a, "channels", self.where):
            node, path = channel.get("target", {}).get("node"), channel.get("target", {}).get("path")
            if node not in self.nodes:
                continue
            if path not in ("translation", "rotation", "scale") or self.nodes[node].matrix is not None:
                self.log.append(f"{self.path.name}: animation of {path} of node '{self.nodes[node].name}' is not supported")
                continue
            sampler = samplers[_index(channel.get("sampler"), len(samplers), "animation sampler", self.where)]
            times = self.accessor(sampler["input"]).astype(np.float64).ravel()
            values = self.accessor(sampler["output"]).astype(np.float64)
            kind, width = sampler.get("interpolation", "LINEAR"), 4 if path == "rotation" else 3
            per_key = 3 if kind == "CUBICSPLINE" else 1
            if (values.shape != (per_key * len(times), width) or not len(times) or not np.isfinite(values).all()
                    or not np.isfinite(times).all() or (np.diff(times) <= 0).any()):
                raise AssetError(f"the animation of {path} of node '{self.nodes[node].name}' is corrupt", where=self.where)
            found.append(Channel(node, path, times, values.reshape(-1, 3, width) if per_key == 3 else values, kind))
        return found


def read(path: Path, data: bytes | None = None, *, max_faces: int = 5_000_000, max_texture: int = 2048, textures: bool = True) -> Document:
    """Parses a file and checks its counts. Raises AssetError naming it."""
    path = Path(path)
    where = str(path)
    try:
        data = path.read_bytes() if data is None else data
    except OSError as error:
        raise AssetError(f"cannot read the scene: {error.strerror or error}", where=where) from None
    with _valid(where):
        tree, binary = _parse(data, where)
        required = [e for e in tree.get("extensionsRequired", []) if e not in SUPPORTED]
        if required:
            raise AssetError("the file needs an extension that is not supported", where=where, value=required[0],
                             accepted="a plain glTF 2.0 export")
        document = Document(path, tree, _buffers(tree, binary, path), max_texture, textures)
        document.nodes = _nodes(tree, where)
        _check_faces(document, max_faces)
    return document


def inside(folder: Path, name: str, where: str) -> Path:
    """The file ``name`` below ``folder``. AssetError when it is absolute, leads out by ``..`` or by a link, or is missing."""
    target = Path(folder) / name
    if not name or "\0" in name or Path(name).is_absolute() or "\\" in name or not target.resolve().is_relative_to(Path(folder).resolve()):
        raise AssetError("refers to a file outside its folder", where=where, value=name, accepted="a relative path below it")
    if not target.is_file():
        raise AssetError("refers to a file that is missing", where=where, value=name)
    return target


def buffer_contents(path: Path, data: bytes) -> list[bytes]:
    """The external buffers of a .gltf file, in order."""
    with _valid(str(path)):
        tree, _ = _parse(data, str(path))
        uris = [b.get("uri", "") for b in _items(tree, "buffers", str(path))]
        return [_fetch(uri, path, "buffer") for uri in uris if uri and not uri.startswith("data:")]


def to_linear(srgb) -> tuple[float, float, float]:
    return tuple(float(c) for c in linear_from_srgb(np.clip(np.asarray(srgb, float), 0, 1)))


def _parse(data: bytes, where: str) -> tuple[dict, bytes]:
    binary = b""
    if data[:4] == b"glTF":
        if len(data) < 20:
            raise AssetError("the file is truncated", where=where, value=f"{len(data)} bytes")
        version, length = struct.unpack_from("<II", data, 4)
        if version != 2 or length > len(data):
            raise AssetError("the file is truncated or not glTF 2", where=where, value=f"version {version}, {len(data)} of {length} bytes")
        position, chunks = 12, {}
        while position + 8 <= length:
            size, kind = struct.unpack_from("<II", data, position)
            if position + 8 + size > length:
                raise AssetError("the file is truncated inside a chunk", where=where)
            chunks.setdefault(kind, data[position + 8 : position + 8 + size])
            position += 8 + size
        text, binary = chunks.get(0x4E4F534A, b""), chunks.get(0x004E4942, b"")
    else:
        text = data
    try:
        tree = json.loads(text.decode("utf-8-sig"))
    except (ValueError, RecursionError):
        raise AssetError("the file is no valid glTF (its JSON cannot be read)", where=where) from None
    if not isinstance(tree, dict) or not str(tree.get("asset", {}).get("version", "")).startswith("2"):
        raise AssetError("the file is no glTF 2", where=where)
    return tree, binary


def _buffers(tree: dict, binary: bytes, path: Path) -> list[bytes]:
    buffers = []
    for number, buffer in enumerate(_items(tree, "buffers", str(path))):
        data = _fetch(buffer["uri"], path, "buffer") if "uri" in buffer else binary if number == 0 else b""
        if len(data) < int(buffer.get("byteLength", 0)):
            raise AssetError(f"buffer {number} is truncated", where=str(path), value=len(data),
                             accepted=f"{buffer.get('byteLength')} bytes")
        buffers.append(data)
    return buffers


def _fetch(uri: str, path: Path, what: str) -> bytes:
    if uri.startswith("data:"):
        head, _, body = uri.partition(",")
        try:
            return base64.b64decode(body, validate=True) if head.endswith(";base64") else unquote(body).encode("latin-1")
        except (binascii.Error, ValueError):
            raise AssetError(f"the embedded {what} is corrupt", where=str(path)) from None
    if "://" in uri:
        raise AssetError(f"the {what} is on a network", where=str(path), value=uri, accepted="a file beside it")
    return inside(path.parent, unquote(uri), str(path)).read_bytes()


def _nodes(tree: dict, where: str) -> dict[int, Node]:
    """Nodes of the default scene (of the file, when it has none), parents first."""
    raw = _items(tree, "nodes", where)
    if len(raw) > _MAX_NODES:
        raise AssetError("the file has too many nodes", where=where, value=len(raw), accepted=f"at most {_MAX_NODES}")
    scenes = _items(tree, "scenes", where)
    if scenes:
        roots = scenes[_index(tree.get("scene", 0), len(scenes), "scene", where)].get("nodes", [])
    else:
        children = {c for n in raw for c in n.get("children", [])}
        roots = [i for i in range(len(raw)) if i not in children]
    nodes: dict[int, Node] = {}
    stack = [(int(r), None, 0) for r in reversed(roots)]
    while stack:
        i, parent, depth = stack.pop()
        if i in nodes or depth > _MAX_DEPTH:
            raise AssetError("the nodes are no tree", where=where, value=i)
        n = raw[_index(i, len(raw), "node", where)]
        matrix = np.array(n["matrix"], float).reshape(4, 4).T if "matrix" in n else None
        rest = [tuple(map(float, n.get(k, d))) for k, d in (("translation", (0, 0, 0)), ("rotation", (0, 0, 0, 1)), ("scale", (1, 1, 1)))]
        numbers = np.concatenate([[0.0] if matrix is None else matrix.ravel(), *rest])
        if not np.isfinite(numbers).all() or np.linalg.norm(rest[1]) < 1e-9:
            raise AssetError("a node's transform is not finite", where=where, value=n.get("name", i))
        nodes[i] = Node(str(n.get("name") or f"node-{i}"), parent, n.get("mesh"), n.get("camera"), *rest, matrix)
        stack += [(int(c), i, depth + 1) for c in reversed(n.get("children", []))]
    return nodes


def _check_faces(document: Document, max_faces: int) -> None:
    """Triangles the scene would have, from the accessors' counts alone (every node that shows a mesh counts it)."""
    tree, where = document.tree, document.where
    per_mesh = {}
    for node in document.nodes.values():
        if node.mesh is None:
            continue
        if node.mesh not in per_mesh:
            total = 0
            for primitive in _items(_item(tree, "meshes", node.mesh, where), "primitives", where):
                position = primitive.get("attributes", {}).get("POSITION")
                vertices = _count(_item(tree, "accessors", position, where), where) if position is not None else 0
                corners = _count(_item(tree, "accessors", primitive["indices"], where), where) if "indices" in primitive else vertices
                total += max(corners // (3 if primitive.get("mode", 4) == 4 else 1), vertices // 3)
            per_mesh[node.mesh] = total
    total = sum(per_mesh[n.mesh] for n in document.nodes.values() if n.mesh is not None)
    if total > max_faces:
        raise AssetError("the mesh has too many faces", where=where, value=total, accepted=f"at most {max_faces}")


def _triangles(order: np.ndarray, mode: int) -> np.ndarray:
    if mode == 4:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    if len(order) < 3:
        return np.zeros((0, 3), np.int64)
    i = np.arange(len(order) - 2)
    if mode == 6:
        return np.stack([np.full(len(i), order[0]), order[i + 1], order[i + 2]], axis=1)
    odd = i % 2
    return np.stack([order[i], order[i + 1 + odd], order[i + 2 - odd]], axis=1)


def _texture_transform(transform: dict | None) -> np.ndarray | None:
    if not transform:
        return None
    (ox, oy), (sx, sy), r = transform.get("offset", (0, 0)), transform.get("scale", (1, 1)), float(transform.get("rotation", 0))
    c, s = np.cos(r), np.sin(r)
    return np.array([[1, 0, ox], [0, 1, oy], [0, 0, 1]]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ np.diag([sx, sy, 1.0])


def _items(tree: dict, key: str, where: str) -> list:
    items = tree.get(key, [])
    if not isinstance(items, list) or not all(isinstance(i, dict) for i in items):
        raise AssetError(f"the file is no valid glTF ('{key}' is no list of objects)", where=where)
    return items


def _item(tree: dict, key: str, index, where: str) -> dict:
    items = tree.get(key, [])
    return items[_index(index, len(items), key, where)]


def _index(index, count: int, what: str, where: str) -> int:
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < count:
        raise AssetError(f"the file is no valid glTF (a reference to {what} that does not exist)", where=where, value=index)
    return index


def _count(accessor: dict, where: str) -> int:
    count = accessor.get("count")
    if not isinstance(count, int) or count < 0:
        raise AssetError("the file is no valid glTF (an accessor without a count)", where=where, value=count)
    return count
