"""Reader of glTF 2.0 (.gltf with its buffers and images, .glb): meshes, materials, cameras, node hierarchy, animations.

Its own reader rather than trimesh's, because a scene's cameras, unlit and double-sided materials, node names and
animations are wanted, and because every count and path a file claims has to be checked before it is believed.
Reference: Khronos glTF 2.0 specification, sections 3.5 (scenes), 3.6 (buffers, accessors), 3.7 (meshes, skins), 3.9
(materials), 3.10 (cameras), 3.11 (animations); extensions KHR_materials_unlit, KHR_materials_emissive_strength,
KHR_texture_transform.

Coordinates stay as in the file (y up) until whoever asked turns them z up (:data:`Z_UP`). What a file asks for
and is not drawn is collected in :attr:`Document.omissions`.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from blinkgl.errors import AssetError
from blinkgl.scene.importing import gltf_schema
from blinkgl.scene.omissions import Omissions
from blinkgl.scene.reading import contents, reading
from blinkgl.scene.shapes.clips import PATHS, Track
from blinkgl.scene.shapes.skeleton import Locals, Motion, Skeleton
from blinkgl.scene.surfaces.images import content_hash, decode_alpha, decode_image, decode_numbers
from blinkgl.scene.types import REPEAT, Gloss, Map, Mask, Material, Texture, Wrap
from blinkgl.srgb import linear_from_srgb

# Columns: the file's x, y, z axes in a z-up world.
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
_DRAWN = {
    "KHR_materials_unlit",
    "KHR_materials_emissive_strength",
    "KHR_texture_transform",
    "KHR_mesh_quantization",
}
# Not drawn, and yet no reason to refuse a file that requires them: shape, base colour and motion are what they would
# be, only light is missing from the surface. Everything else that is required (compressed geometry or images,
# instances, other material models, what nobody has heard of) would be a scene that is not the file's.
_LIGHTS = "KHR_lights_punctual"
_LIGHT_ONLY = {
    _LIGHTS,
    "KHR_materials_clearcoat",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_materials_ior",
    "KHR_materials_iridescence",
    "KHR_materials_anisotropy",
    "KHR_materials_dispersion",
}
# Nothing to be seen in these.
_INVISIBLE = {"KHR_xmp_json_ld", "KHR_xmp"}
_DTYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MAX_NODES, _MAX_DEPTH = 200_000, 256
_MAX_ZEROS = 64_000_000  # bytes of an accessor without a buffer behind it (all zeros): nothing in the file bounds them
_WRAPS: dict[int, Wrap] = {33071: "clamp", 33648: "mirror"}
_NEAREST = 9728
_MAX_TIME = 1e7  # s, of an animation's keys
_MAX_SETS = 4  # of four joints per vertex
_MAX_TARGET_VERTICES = 8_000_000  # of a primitive's morph targets together


@dataclass(frozen=True, eq=False)
class Piece:
    """Raw triangles. normals, uvs (v down) and material may be None.

    binding : (V, k) joints of the node's skin and (V, k) weights; None: it has no skin.
    targets : morph targets, (n, V, 3) positions, likewise normals or None; None: it has none.
    colours : (V, 3) linear factors on the albedo; None: it has none."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    material: Material | None = None
    binding: tuple[np.ndarray, np.ndarray] | None = None
    targets: tuple[np.ndarray, np.ndarray | None] | None = None
    colours: np.ndarray | None = None


_INVISIBLE_MATERIAL = Material()
"""Of what is cut off everywhere."""


class _Place(NamedTuple):
    """Where a texture lies on a mesh: number of its set of coordinates, (3, 3) transform of them or None."""

    coordinates: int
    matrix: np.ndarray | None

    @classmethod
    def of(cls, info: dict) -> _Place:
        transform = info.get("extensions", {}).get("KHR_texture_transform") or {}
        return cls(transform.get("texCoord", info.get("texCoord", 0)), _texture_transform(transform))


def _surface_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) unit means of the faces round each vertex, by their area; 0 where there are none. Vertices in one place
    are not one: a file has several where its surface has an edge."""
    corners = vertices[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    out = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(out, faces[:, k], area)
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return np.divide(out, length, out=np.zeros_like(out), where=length > 0)


def transformed(piece: Piece, matrix: np.ndarray) -> Piece:
    """The piece under an affine (4, 4) map; a mirroring one turns the faces round, so that they keep facing out."""
    linear = matrix[:3, :3]
    determinant = float(np.linalg.det(linear))
    vertices = piece.vertices @ linear.T + matrix[:3, 3]
    # Cofactors instead of the inverse: also right for a map that flattens the mesh.
    cofactors = np.stack(
        [np.cross(linear[1], linear[2]), np.cross(linear[2], linear[0]), np.cross(linear[0], linear[1])]
    )
    normals = None if piece.normals is None else piece.normals @ cofactors.T * (1.0 if determinant >= 0 else -1.0)
    return replace(
        piece, vertices=vertices, normals=normals, faces=piece.faces if determinant >= 0 else piece.faces[:, ::-1]
    )


@dataclass(frozen=True, eq=False)
class Node:
    """name, parent (None at the root), mesh, camera and skin index (None without), rest translation, quaternion
    x y z w, scale or matrix; weights of the mesh's morph targets where the node says its own."""

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

    def local(self) -> np.ndarray:
        """(4, 4) transform to the parent, at rest."""
        if self.matrix is not None:
            return self.matrix
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat(self.rotation).as_matrix() * self.scale
        T[:3, 3] = self.translation
        return T


@dataclass(eq=False)
class Document:
    """A parsed file. ``nodes`` are those of the default scene, parents before children, by their index in the file.

    tree : its JSON, of the shape that :mod:`blinkgl.scene.importing.gltf_schema` demands.
    materials : False leaves the file's own materials out, and what they ask for unsaid.
    log : repairs and decisions.   omissions : what the file asks for and is not drawn.
    """

    path: Path
    tree: dict
    buffers: list[bytes]
    max_texture: int
    materials: bool
    omissions: Omissions
    nodes: dict[int, Node] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)
    _materials: dict = field(default_factory=dict)
    _textures: dict = field(default_factory=dict)

    @property
    def where(self) -> str:
        return str(self.path)

    def lights(self) -> dict[int, dict[str, Any]]:
        """Lights of the scene's nodes as KHR_lights_punctual has them, by the node's index, checked, with all that it
        leaves out filled in."""
        extension = self.tree.get("extensions", {}).get(_LIGHTS, {})
        gltf_schema.check(extension, f"{self.where}: {_LIGHTS}", gltf_schema.PunctualLights)
        table, found = gltf_schema.PunctualLights.model_validate(extension).lights, {}
        for index in self.nodes:
            if (reference := self.tree["nodes"][index].get("extensions", {}).get(_LIGHTS)) is not None:
                number = reference.get("light")
                if type(number) is not int or not 0 <= number < len(table):
                    raise AssetError(
                        "the file is no valid glTF (a reference to lights that does not exist)",
                        where=self.where,
                        value=number,
                    )
                found[index] = table[number].model_dump()
        return found

    # ---- geometry
    def world(self, node: int) -> np.ndarray:
        """(4, 4) transform of a node to the file's world, at rest."""
        T = np.eye(4)
        step: int | None = node
        while step is not None:
            T = self.nodes[step].local() @ T
            step = self.nodes[step].parent
        return T

    def mesh_pieces(self, mesh: int, changing: bool = False) -> list[Piece]:
        """The triangles of a mesh in its own coordinates, a piece per primitive; points and lines are left out.
        changing : with bindings to joints and morph targets; otherwise the file is said to ask for what is not
        drawn."""
        pieces = []
        for primitive in _item(self.tree, "meshes", mesh, self.where)["primitives"]:
            mode, attributes = primitive.get("mode", 4), primitive["attributes"]
            if mode not in (4, 5, 6):
                self.omissions.add("points and lines")
                continue
            if "POSITION" not in attributes:
                continue
            position = _item(self.tree, "accessors", attributes["POSITION"], self.where)
            if "KHR_draco_mesh_compression" in primitive.get("extensions", {}) and "bufferView" not in position:
                raise _needs("KHR_draco_mesh_compression", self.where)
            vertices = self._attribute(primitive, "POSITION", 3, position["count"])
            order = np.arange(len(vertices))
            if "indices" in primitive:
                order = self.accessor(primitive["indices"])
                if order.dtype.kind != "u" or order.shape[1] != 1:
                    raise AssetError(f"the indices of mesh {mesh} are no whole numbers", where=self.where)
                order = order.astype(np.int64).ravel()
            if primitive.get("targets") and not changing:
                self.omissions.add("morph targets (the base shape is drawn)")
            if "JOINTS_0" in attributes and not changing:
                self.omissions.add("skins (the shape as it was modelled is drawn)")
            material, uv_set, uv_matrix = self.material(primitive.get("material"))
            normals = self._attribute(primitive, "NORMAL", 3, len(vertices))
            uvs = self._attribute(primitive, f"TEXCOORD_{uv_set}", 2, len(vertices))
            if uvs is not None and uv_matrix is not None:
                uvs = uvs @ uv_matrix[:2, :2].T + uv_matrix[:2, 2]
            if material is _INVISIBLE_MATERIAL:
                continue
            colours = None
            if self.materials:
                material, colours = self._coloured(primitive, material, len(vertices))
                material = self._without_coordinates(material) if uvs is None else material
            piece = Piece(vertices, _triangles(order, mode), normals, uvs, material, colours=colours)
            if changing:
                bound, targets = self._binding(primitive, len(vertices)), self._targets(primitive, piece)
                piece = replace(piece, binding=bound, targets=targets)
            pieces.append(piece)
        return pieces

    def _binding(self, primitive: dict, count: int) -> tuple[np.ndarray, np.ndarray] | None:
        """((V, 4 n) joints, (V, 4 n) weights) of all the sets that a primitive has."""
        attributes, joints, weights = primitive["attributes"], [], []
        for number in range(_MAX_SETS):
            if f"JOINTS_{number}" not in attributes:
                break
            joints.append(self._attribute(primitive, f"JOINTS_{number}", 4, count))
            weights.append(self._attribute(primitive, f"WEIGHTS_{number}", 4, count))
            if weights[-1] is None:
                raise AssetError(
                    f"the file is no valid glTF (JOINTS_{number} without WEIGHTS_{number})", where=self.where
                )
        return (np.hstack(joints), np.hstack(weights)) if joints else None

    def _targets(self, primitive: dict, piece: Piece) -> tuple[np.ndarray, np.ndarray | None] | None:
        """Of a primitive whose base shape is ``piece``. A target without normals has those of its own surface: what
        they are more than those of the base surface, computed the same way."""
        targets, count = primitive.get("targets", []), len(piece.vertices)
        if len(targets) * count > _MAX_TARGET_VERTICES:
            raise AssetError(
                "the mesh has too many morph targets",
                where=self.where,
                value=f"{len(targets)} of {count} vertices",
                accepted=f"{_MAX_TARGET_VERTICES} vertices in all",
            )
        if not targets:
            return None

        def read(target: dict, name: str) -> np.ndarray:
            if name not in target:
                return np.zeros((count, 3))
            a = _item(self.tree, "accessors", target[name], self.where)
            if a["count"] != count or a["type"] != "VEC3":
                raise AssetError(
                    f"a morph target has another size than its mesh ({name})",
                    where=self.where,
                    value=f"{a['count']} {a['type']}",
                    accepted=f"{count} VEC3",
                )
            values = self.accessor(target[name]).astype(np.float64)
            if not (np.abs(values) <= 1e12).all():  # NaN compares false
                raise AssetError(f"a morph target is no number, or beyond 1e12 ({name})", where=self.where)
            return values

        positions = np.stack([read(t, "POSITION") for t in targets])
        if piece.normals is None:
            return positions, None
        base = None
        normals = np.zeros_like(positions)
        for number, target in enumerate(targets):
            if "NORMAL" in target:
                normals[number] = read(target, "NORMAL")
            elif positions[number].any():
                base = _surface_normals(piece.vertices, piece.faces) if base is None else base
                normals[number] = _surface_normals(piece.vertices + positions[number], piece.faces) - base
        return positions, normals if normals.any() else None

    def skin(self, index: int) -> tuple[list[int], np.ndarray]:
        """(joints as places among :attr:`nodes`, (m, 4, 4) inverse bind matrices). AssetError for a joint that is not
        in
        the scene, and for matrices that are missing or no numbers."""
        skin = _item(self.tree, "skins", index, self.where)
        joints, places = skin["joints"], self.places
        if len(joints) > _MAX_NODES:
            raise AssetError(
                "a skin has too many joints", where=self.where, value=len(joints), accepted=f"at most {_MAX_NODES}"
            )
        for joint in joints:
            if joint not in places:
                _index(joint, len(self.tree.get("nodes", [])), "node", self.where)
                raise AssetError("a skin names a joint that is not in the scene", where=self.where, value=joint)
        bind = np.tile(np.eye(4), (len(joints), 1, 1))
        if "inverseBindMatrices" in skin:
            a = _item(self.tree, "accessors", skin["inverseBindMatrices"], self.where)
            if a["type"] != "MAT4" or a["count"] < len(joints):
                raise AssetError(
                    "a skin has not one inverse bind matrix per joint",
                    where=self.where,
                    value=f"{a['count']} {a['type']}",
                    accepted=f"{len(joints)} MAT4",
                )
            bind = self.accessor(skin["inverseBindMatrices"])[: len(joints)].astype(np.float64)
            bind = bind.reshape(-1, 4, 4).swapaxes(1, 2)
        return [places[joint] for joint in joints], bind

    @property
    def places(self) -> dict[int, int]:
        """Node of the file -> its number among :attr:`nodes`, which is that of its joint in :meth:`skeleton`."""
        return {node: place for place, node in enumerate(self.nodes)}

    def rest(self) -> Locals:
        """Of all nodes; one that has a matrix has it in :meth:`skeleton`."""
        out = Locals.rest(len(self.nodes))
        for place, node in enumerate(self.nodes.values()):
            if node.matrix is None:
                turn = np.array(node.rotation)
                out.translation[place], out.rotation[place] = node.translation, turn / np.linalg.norm(turn)
                out.scale[place] = node.scale
        return out

    def skeleton(self, motion: Motion) -> Skeleton:
        """All nodes, moved by ``motion``, in the file's world."""
        places, nodes = self.places, list(self.nodes.values())
        parents = [-1 if node.parent is None else places[node.parent] for node in nodes]
        fixed = [np.eye(4) if node.matrix is None else node.matrix for node in nodes]
        return Skeleton(parents, motion, np.array(fixed).reshape(-1, 4, 4), [node.name for node in nodes], self.where)

    def morph_weights(self, node: int, count: int) -> np.ndarray:
        """(count,) of a node's mesh at rest. AssetError where there are others than targets."""
        mesh = _item(self.tree, "meshes", self.nodes[node].mesh, self.where)
        given = self.nodes[node].weights if self.nodes[node].weights is not None else mesh.get("weights", [0.0] * count)
        if len(given) != count:
            raise AssetError(
                "a mesh has not one weight per morph target", where=self.where, value=len(given), accepted=str(count)
            )
        return np.array(given, np.float64)

    def _attribute(self, primitive: dict, name: str, width: int, count: int) -> np.ndarray | None:
        """(count, width) float64, None without it. Its length is checked before it is read."""
        if name not in primitive["attributes"]:
            return None
        index = primitive["attributes"][name]
        a = _item(self.tree, "accessors", index, self.where)
        if a["count"] != count or _WIDTHS[a["type"]] != width:
            raise AssetError(
                f"the file is no valid glTF ({name} does not fit the positions)",
                where=self.where,
                value=f"{a['count']} {a['type']}",
                accepted=f"{count} VEC{width}",
            )
        return self.accessor(index).astype(np.float64)

    def _coloured(
        self, primitive: dict, material: Material | None, count: int
    ) -> tuple[Material | None, np.ndarray | None]:
        """The material, times the vertices' colour (linear) where they all have the same; else (V, 3) of them."""
        if "COLOR_0" not in primitive["attributes"]:
            return material, None
        index = primitive["attributes"]["COLOR_0"]
        width = _WIDTHS[_item(self.tree, "accessors", index, self.where)["type"]]
        given = self._attribute(primitive, "COLOR_0", 4 if width == 4 else 3, count)
        colours = np.clip(np.nan_to_num(given[:, :3]), 0, 1)
        if width == 4 and material is not None and material.mask is not None and (given[:, 3] < 1).any():
            self.omissions.add("opacity of vertex colours (left out)")
        material = material or Material()
        if len(colours) and not (colours == colours[0]).all():
            return material, colours
        factor = colours[0] * material.base_color if len(colours) else material.base_color
        return replace(material, base_color=tuple(float(c) for c in factor)), None

    def _without_coordinates(self, material: Material | None) -> Material | None:
        """Of a mesh that has no texture coordinates: there is no telling which way a normal map lies."""
        if material is None or material.bumps is None:
            return material
        self.omissions.add("normal maps on meshes without texture coordinates (left out)")
        return replace(material, bumps=None)

    def _base_colour(self, material: int | None) -> dict:
        if material is None:
            return {}
        return _item(self.tree, "materials", material, self.where).get("pbrMetallicRoughness", {})

    def accessor(self, index: int) -> np.ndarray:
        """(count, n) values; normalised integers become floats."""
        a = _item(self.tree, "accessors", index, self.where)
        count, width, dtype = a["count"], _WIDTHS[a["type"]], np.dtype(_DTYPES[a["componentType"]]).newbyteorder("<")
        if "bufferView" in a:
            values = self._view(a["bufferView"], a.get("byteOffset", 0), count, width, dtype, index)
        elif count * width * dtype.itemsize > _MAX_ZEROS:
            raise AssetError(
                f"accessor {index} has no buffer and too many values",
                where=self.where,
                value=count,
                accepted=f"at most {_MAX_ZEROS // 10**6} MB of zeros",
            )
        else:
            values = np.zeros((count, width), dtype)
        if "sparse" in a:
            where, what, n = a["sparse"]["indices"], a["sparse"]["values"], a["sparse"]["count"]
            kind = np.dtype(_DTYPES[where["componentType"]]).newbyteorder("<")
            at = self._view(where["bufferView"], where.get("byteOffset", 0), n, 1, kind, index)
            new = self._view(what["bufferView"], what.get("byteOffset", 0), n, width, dtype, index)
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
        begin = v.get("byteOffset", 0)
        start, item = begin + offset, width * dtype.itemsize
        stride = v.get("byteStride", 0) or item
        needed = start + (stride * (count - 1) + item if count else 0)
        if stride < item or needed > min(len(data), begin + v.get("byteLength", 0)):
            raise AssetError(f"the mesh is corrupt: accessor {accessor} reaches outside its buffer", where=self.where)
        return np.ndarray((count, width), dtype, data, start if count else 0, (stride, dtype.itemsize))

    # ---- materials
    def material(self, index: int | None) -> tuple[Material | None, int, np.ndarray | None]:
        """(material, texture coordinate set, 3x3 texture transform or None)."""
        if index is None:
            return None, 0, None
        if index not in self._materials:
            m, pbr = _item(self.tree, "materials", index, self.where), self._base_colour(index)
            info = pbr.get("baseColorTexture") or {}
            base = _Place.of(info)
            material = Material(
                texture=self._texture(info["index"]) if info and self.materials else None,
                base_color=tuple(float(c) for c in pbr.get("baseColorFactor", (1, 1, 1, 1))[:3]),
                unlit="KHR_materials_unlit" in m.get("extensions", {}),
                double_sided=m.get("doubleSided", False),
            )
            if self.materials:
                material, base = self._surface(material, m, pbr, base)
            self._materials[index] = (material, base.coordinates, base.matrix)
        return self._materials[index]

    def _surface(self, material: Material, m: dict, pbr: dict, base: _Place) -> tuple[Material, _Place]:
        """``material`` with all that glTF says of it beside its base colour, and the place of its coordinates: that of
        the first of its textures."""
        for name in m.get("extensions", {}):
            if name not in _DRAWN | _INVISIBLE:
                self.omissions.add(name)
        info = pbr.get("baseColorTexture") or {}
        if info and material.texture is not None:
            material = replace(material, wrap=self._wraps(info["index"]))
        material = self._masked(material, m, pbr)
        if material is _INVISIBLE_MATERIAL or material.unlit:
            return material, base
        if "occlusionTexture" in m:
            self.omissions.add("occlusion maps")
        emissive, bumps = m.get("emissiveTexture"), m.get("normalTexture")
        rough = pbr.get("metallicRoughnessTexture")
        if not info:
            base = _Place.of(next((one for one in (rough, bumps, emissive) if one), {}))
        strength = m.get("extensions", {}).get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        emission = tuple(float(c * strength) for c in m.get("emissiveFactor", (0, 0, 0)))
        if any(emission):
            material = replace(material, emission=emission, emission_map=self._map(emissive, base, "colour"))
        metallic, roughness = (min(float(pbr.get(f"{key}Factor", 1)), 1.0) for key in ("metallic", "roughness"))
        if metallic > 0 or roughness < 1 or rough:
            material = replace(material, gloss=Gloss(metallic, roughness, self._map(rough, base, "numbers")))
        if bumps and (bumped := self._map(bumps, base, "numbers")) is not None:
            material = replace(material, bumps=bumped, bump_scale=float(bumps.get("scale", 1.0)))
        return material, base

    def _masked(self, material: Material, m: dict, pbr: dict) -> Material:
        """With its holes. One that shows wholly is not masked; one that shows nowhere is _INVISIBLE_MATERIAL."""
        mode, factor = m.get("alphaMode", "OPAQUE"), float(pbr.get("baseColorFactor", (1, 1, 1, 1))[3])
        if mode == "OPAQUE":
            return material
        info = pbr.get("baseColorTexture") or {}
        alpha = self._texture(info["index"], "alpha") if info else None
        image = np.full((1, 1), 255, np.uint8) if alpha is None else alpha.image
        cutoff = float(m.get("alphaCutoff", 0.5)) if mode == "MASK" else 0.5
        least, most = (factor * float(v) / 255 for v in (image.min(), image.max()))
        if mode == "BLEND":
            if most < cutoff:
                self.omissions.add("alpha BLEND (drawn opaque)")
                return material
            self.omissions.add("alpha BLEND (cut off at a half)" if least < cutoff else "alpha BLEND (drawn opaque)")
        if most < cutoff:
            return _INVISIBLE_MATERIAL
        return replace(material, mask=Mask(image, factor, cutoff)) if least < cutoff else material

    def _map(self, info: dict | None, base: _Place, kind: str) -> Map | None:
        """A texture beside that of the base colour. kind : "colour" or "numbers"."""
        if not info:
            return None
        place, texture = _Place.of(info), self._texture(info["index"], kind)
        if texture is None:
            return None
        if place.coordinates != base.coordinates:
            self.omissions.add("maps on a second set of texture coordinates (left out)")
            return None
        whole = np.eye(3)
        own, first = (whole if one.matrix is None else one.matrix for one in (place, base))
        if abs(np.linalg.det(first)) < 1e-12:
            at = own
        else:
            at = own @ np.linalg.inv(first)
        a, b, c, d, e, f = (float(v) for v in np.round(at[:2], 12).ravel())
        return Map(texture, (a, b, c, d, e, f), self._wraps(info["index"]))

    def _wraps(self, index: int) -> tuple[Wrap, Wrap]:
        """Of a texture."""
        sampler = _item(self.tree, "textures", index, self.where).get("sampler")
        if sampler is None:
            return REPEAT
        settings = _item(self.tree, "samplers", sampler, self.where)
        if settings.get("magFilter") == _NEAREST:
            self.omissions.add("unfiltered textures (drawn smooth)")
        s, t = (_WRAPS.get(settings.get(key, 10497), "repeat") for key in ("wrapS", "wrapT"))
        return s, t

    def _texture(self, index: int, kind: str = "colour") -> Texture | None:
        """kind : "colour"; "numbers", as they are stored; "alpha", (h, w), None where the image is opaque."""
        source = _item(self.tree, "textures", index, self.where).get("source")
        if source is None:
            names = ", ".join(self.tree["textures"][index].get("extensions", {})) or "without an image"
            self.omissions.add(f"textures of another kind ({names})")
            return None
        if (source, kind) not in self._textures:
            image = _item(self.tree, "images", source, self.where)
            if "bufferView" in image:
                v = _item(self.tree, "bufferViews", image["bufferView"], self.where)
                buffer = self.buffers[_index(v["buffer"], len(self.buffers), "buffer", self.where)]
                begin = v.get("byteOffset", 0)
                data = buffer[begin : begin + v.get("byteLength", 0)]
            else:
                data = _fetch(image.get("uri", ""), self.path, "image")
            name = str(image.get("name") or f"image-{source}")
            decode = {"colour": decode_image, "numbers": decode_numbers, "alpha": decode_alpha}[kind]
            pixels = decode(data, self.max_texture, f"{self.where} (image '{name}')")
            self._textures[source, kind] = None if pixels is None else Texture(pixels, name, content_hash(data))
        return self._textures[source, kind]

    # ---- animations
    def tracks(self, animation: int) -> list[Track]:
        """What an animation moves, joints being places among :attr:`nodes`; what of it is not drawn is an omission."""
        a = _item(self.tree, "animations", animation, self.where)
        samplers, places, found = a["samplers"], self.places, []
        for channel in a["channels"]:
            node, path = channel["target"].get("node"), channel["target"]["path"]
            if path not in (*PATHS, "weights"):
                self.omissions.add("animation of other properties")
                continue
            if node not in self.nodes:
                continue
            if path != "weights" and self.nodes[node].matrix is not None:
                self.omissions.add("animation of nodes that have a matrix")
                continue
            sampler = samplers[_index(channel["sampler"], len(samplers), "animation sampler", self.where)]
            kind = sampler.get("interpolation", "LINEAR")
            width = 4 if path == "rotation" else self._target_count(node) if path == "weights" else 3
            per_key = 3 if kind == "CUBICSPLINE" else 1
            keys, given = (_item(self.tree, "accessors", sampler[key], self.where) for key in ("input", "output"))
            per_value = width if path == "weights" else 1  # weights are scalars, one after the other
            # Lengths first: the two are as long as the file says, whatever is behind them.
            fits = (
                keys["type"] == "SCALAR"
                and given["count"] == per_key * per_value * keys["count"] > 0
                and _WIDTHS[given["type"]] * per_value == width
            )
            times = self.accessor(sampler["input"]).astype(np.float64).ravel() if fits else np.zeros(0)
            values = self.accessor(sampler["output"]).astype(np.float64) if fits else np.zeros(0)
            where = f"the animation of {path} of node '{self.nodes[node].name}'"
            if fits and (np.diff(times) <= 0).any():
                first = int(np.argmax(np.diff(times) <= 0))
                raise AssetError(
                    f"{where} has times that do not increase (key {first + 1})",
                    where=self.where,
                    value=float(times[first + 1]),
                    accepted=f"more than {times[first]:g} s",
                )
            # Written so that NaN is refused: it compares false.
            if not fits or not (np.abs(values) <= 1e12).all() or not (np.abs(times) < _MAX_TIME).all():
                raise AssetError(f"{where} is corrupt", where=self.where)
            values = values.reshape(-1, per_key, width)
            if path == "rotation" and (np.linalg.norm(values[:, per_key // 2], axis=1) < 1e-9).any():
                raise AssetError(
                    f"the animation of node '{self.nodes[node].name}' has a rotation of zero", where=self.where
                )
            found.append(Track(places[node], path, times, values if per_key == 3 else values[:, 0], kind))
        return found

    def _target_count(self, node: int) -> int:
        """Morph targets of a node's mesh; 0 for one without."""
        mesh = self.nodes[node].mesh
        if mesh is None:
            return 0
        return max(len(p.get("targets", [])) for p in _item(self.tree, "meshes", mesh, self.where)["primitives"])


def read(
    path: Path,
    data: bytes | None = None,
    *,
    max_faces: int = 5_000_000,
    max_texture: int = 2048,
    materials: bool = True,
    lights: bool = False,
) -> Document:
    """Parses a file, checks its shape and its counts. lights : whether somebody asks for the file's
    (:meth:`Document.lights`). Raises AssetError naming it."""
    path = Path(path)
    where = str(path)
    with reading("scene", where):
        data = contents(path, "scene") if data is None else data
        tree, binary = _parse(data, where)
        for name in tree.get("extensionsRequired", []):
            if name not in _DRAWN | _LIGHT_ONLY | _INVISIBLE:
                raise _needs(name, where)
        document = Document(path, tree, _buffers(tree, binary, path), max_texture, materials, Omissions(path.name))
        document.nodes = _nodes(tree, where)
        _check_faces(document, max_faces)
        for name in tree.get("extensionsUsed", []):
            # What belongs to materials and textures is said where one is used, and lights by what they are.
            said_there = name.startswith(("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_"))
            if name not in _DRAWN | _LIGHT_ONLY | _INVISIBLE and not said_there:
                document.omissions.add(name)
        if not lights and any(_LIGHTS in tree["nodes"][i].get("extensions", {}) for i in document.nodes):
            document.omissions.add("lights (the configuration's sun and sky shine)")
    return document


def _needs(extension: str, where: str) -> AssetError:
    return AssetError(
        f"the file needs the extension {extension}, which BlinkGL does not draw",
        where=where,
        accepted="a glTF 2.0 export without it (uncompressed, PNG or JPEG images)",
    )


def inside(folder: Path, name: str, where: str) -> Path:
    """The file ``name`` below ``folder``. AssetError when it is absolute, leads out by
    ``..`` or by a link, or is missing."""
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
    except (OSError, ValueError, RuntimeError):  # a name too long for the file system, a link to itself
        within, found = True, False
    if not within:
        raise AssetError(
            "refers to a file outside its folder", where=where, value=name, accepted="a relative path below it"
        )
    if not found:
        raise AssetError("refers to a file that is missing", where=where, value=name)
    return target


def buffer_contents(path: Path, data: bytes) -> list[bytes]:
    """The external buffers of a .gltf file, in order."""
    with reading("scene", str(path)):
        tree, _ = _parse(data, str(path))
        uris = [b.get("uri") or "" for b in tree.get("buffers", [])]
        return [_fetch(uri, path, "buffer") for uri in uris if uri and not uri.startswith("data:")]


def to_linear(srgb: ArrayLike) -> tuple[float, float, float]:
    """Linear light of an sRGB colour (3,), what lies outside 0 to 1 cut off."""
    r, g, b = (float(c) for c in linear_from_srgb(np.clip(np.asarray(srgb, float), 0, 1)))
    return r, g, b


def _parse(data: bytes, where: str) -> tuple[dict, bytes]:
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
    gltf_schema.check(tree, where)
    if not tree["asset"]["version"].startswith("2"):
        raise AssetError("the file is no glTF 2", where=where, value=tree["asset"]["version"])
    return tree, binary


def _buffers(tree: dict, binary: bytes, path: Path) -> list[bytes]:
    buffers = []
    for number, buffer in enumerate(tree.get("buffers", [])):
        compressed = next((e for e in buffer.get("extensions", {}) if e.endswith("_meshopt_compression")), None)
        if compressed and "uri" not in buffer:
            raise _needs(compressed, str(path))
        data = _fetch(buffer["uri"] or "", path, "buffer") if "uri" in buffer else binary if number == 0 else b""
        if len(data) < buffer.get("byteLength", 0):
            raise AssetError(
                f"buffer {number} is truncated",
                where=str(path),
                value=len(data),
                accepted=f"{buffer.get('byteLength')} bytes",
            )
        buffers.append(data)
    return buffers


def _fetch(uri: str, path: Path, what: str) -> bytes:
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


def _nodes(tree: dict, where: str) -> dict[int, Node]:
    """Nodes of the default scene (of the file, when it has none), parents first."""
    raw, scenes = tree.get("nodes", []), tree.get("scenes", [])
    if len(raw) > _MAX_NODES:
        raise AssetError("the file has too many nodes", where=where, value=len(raw), accepted=f"at most {_MAX_NODES}")
    if scenes:
        roots = scenes[_index(tree.get("scene", 0), len(scenes), "scene", where)].get("nodes", [])
    else:
        children = {c for n in raw for c in n.get("children", [])}
        roots = [i for i in range(len(raw)) if i not in children]
    nodes: dict[int, Node] = {}
    stack = [(r, None, 0) for r in reversed(roots)]
    while stack:
        i, parent, depth = stack.pop()
        if i in nodes or depth > _MAX_DEPTH:
            raise AssetError(
                "the nodes are no tree" if i in nodes else f"the nodes are nested more than {_MAX_DEPTH} deep",
                where=where,
                value=i,
            )
        n = raw[_index(i, len(raw), "node", where)]
        matrix = np.array(n["matrix"], float).reshape(4, 4).T if n.get("matrix") else None
        rest = [
            tuple(map(float, n.get(k, d)))
            for k, d in (("translation", (0, 0, 0)), ("rotation", (0, 0, 0, 1)), ("scale", (1, 1, 1)))
        ]
        own = tuple(n["weights"]) if "weights" in n else None
        name = str(n.get("name") or f"node-{i}")
        nodes[i] = Node(name, parent, n.get("mesh"), n.get("camera"), *rest, matrix, n.get("skin"), own)
        stack += [(c, i, depth + 1) for c in reversed(n.get("children", []))]
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
            for primitive in _item(tree, "meshes", node.mesh, where)["primitives"]:
                position = primitive["attributes"].get("POSITION")
                vertices = _item(tree, "accessors", position, where)["count"] if position is not None else 0
                corners = vertices
                if "indices" in primitive:
                    corners = _item(tree, "accessors", primitive["indices"], where)["count"]
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
    (ox, oy), (sx, sy), r = (
        transform.get("offset", (0, 0)),
        transform.get("scale", (1, 1)),
        float(transform.get("rotation", 0)),
    )
    c, s = np.cos(r), np.sin(r)
    return (
        np.array([[1, 0, ox], [0, 1, oy], [0, 0, 1]])
        @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        @ np.diag([sx, sy, 1.0])
    )


def _item(tree: dict, key: str, index, where: str) -> dict:
    items = tree.get(key, [])
    return items[_index(index, len(items), key, where)]


def _index(index, count: int, what: str, where: str) -> int:
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < count:
        raise AssetError(
            f"the file is no valid glTF (a reference to {what} that does not exist)", where=where, value=index
        )
    return index
