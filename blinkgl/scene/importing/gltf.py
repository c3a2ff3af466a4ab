"""Reader of glTF 2.0 (.gltf with its buffers and images, .glb): meshes, cameras, node hierarchy, skins, animations.

It replaces trimesh's reader, because a scene needs cameras, materials, node names and animations, and because every
count and path of a file must be checked before it is used. Reference: Khronos glTF 2.0, sections 3.5 to 3.11.

Coordinates stay y up; the caller turns them (:data:`~blinkgl.scene.importing.parts.Z_UP`). Features that are not drawn
are collected in :attr:`Document.omissions`.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.scene.importing import gltf_schema
from blinkgl.scene.importing.gltf_file import MAX_NODES, Node, buffers_of, index_of, item, needs, nodes_of, parse
from blinkgl.scene.importing.gltf_materials import DRAWN, INVISIBLE_EXTENSIONS, Materials
from blinkgl.scene.importing.neighbours import Neighbours
from blinkgl.scene.importing.parts import INVISIBLE, RawMesh, tinted
from blinkgl.scene.importing.polygons import OPACITY
from blinkgl.scene.reading import Omissions, contents, limit_faces, reading
from blinkgl.scene.shapes.clips import PATHS, Track
from blinkgl.scene.shapes.skeleton import Locals, Motion, Skeleton
from blinkgl.scene.types import Material
from blinkgl.types.trees import Tree

# Not drawn, but a file that requires these extensions is accepted: shape, base colour and motion are correct, only the
# light on the surface is missing. Any other required extension (compressed geometry or images, instances, other
# material models, unknown ones) would give a different scene, so it is refused.
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
# componentType is OpenGL's code of a type, from GL_BYTE to GL_FLOAT.
_DTYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
# The attributes that are read; texture coordinates count where a texture uses them, tangents follow from them, and
# what begins with "_" is the application's own.
_ATTRIBUTE = re.compile(r"POSITION|NORMAL|TANGENT|COLOR_0|TEXCOORD_\d+|JOINTS_[0-3]|WEIGHTS_[0-3]|_.*")
_MAX_ZEROS = 64_000_000  # bytes of an accessor without a buffer (all zeros): the file's size does not limit them
_MAX_TIME = 1e7  # s, of an animation's keys
_MAX_SETS = 4  # of four joints per vertex
_MAX_TARGET_VERTICES = 8_000_000  # of all morph targets of a primitive


@dataclass(eq=False)
class Document:
    """A parsed file. ``nodes`` are those of the default scene, parents before children, by their index in the file.

    tree : its JSON, in the form that :mod:`blinkgl.scene.importing.gltf_schema` checks.   materials : of the file.
    log : repairs and decisions.   omissions : features that are not drawn.
    """

    path: Path
    tree: dict
    buffers: list[bytes]
    materials: Materials
    omissions: Omissions
    nodes: dict[int, Node] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)

    @property
    def where(self) -> str:
        return str(self.path)

    def lights(self) -> dict[int, Tree]:
        """Return the lights of the scene's nodes by node index, in the form of KHR_lights_punctual, checked, with
        defaults filled in."""
        extension = self.tree.get("extensions", {}).get(_LIGHTS, {})
        table = gltf_schema.check(extension, f"{self.where}: {_LIGHTS}", gltf_schema.PunctualLights).lights
        extensions = {i: self.tree["nodes"][i].get("extensions", {}) for i, node in self.nodes.items() if node.visible}
        lights = {i: own[_LIGHTS].get("light") for i, own in extensions.items() if own.get(_LIGHTS) is not None}
        return {i: table[index_of(n, len(table), "lights", self.where)].model_dump() for i, n in lights.items()}

    # ---- geometry
    def world(self, node: int) -> np.ndarray:
        """Return the rest transform of a node to the file's world, (4, 4)."""
        T = np.eye(4)
        for step in self.chain(node):
            # From the node upwards: a parent's transform is applied after its child's.
            T = self.nodes[step].local() @ T
        return T

    def chain(self, node: int) -> Iterator[int]:
        """Yield a node and its ancestors."""
        step: int | None = node
        while step is not None:
            yield step
            step = self.nodes[step].parent

    def raw_meshes(self, mesh: int) -> list[RawMesh]:
        """Return the triangles of a mesh in its own coordinates, one entry per primitive, with bindings to joints and
        morph targets; points and lines are left out."""
        primitives = item(self.tree, "meshes", mesh, self.where)["primitives"]
        return [raw for one in primitives if (raw := self._primitive(one, mesh)) is not None]

    def _primitive(self, primitive: dict, mesh: int) -> RawMesh | None:
        """Return one primitive of a mesh; None: it has no visible surface."""
        mode, attributes = primitive.get("mode", 4), primitive["attributes"]
        # 4, 5 and 6 are triangles, strips and fans; the modes below are points and lines.
        if mode not in (4, 5, 6):
            self.omissions.add("points and lines")
            return None
        if "POSITION" not in attributes:
            return None
        position = item(self.tree, "accessors", attributes["POSITION"], self.where)
        if "KHR_draco_mesh_compression" in primitive.get("extensions", {}) and "bufferView" not in position:
            raise needs("KHR_draco_mesh_compression", self.where)
        vertices = self._attribute(primitive, "POSITION", 3, position["count"])
        assert vertices is not None
        faces = self._faces(primitive, mesh, len(vertices))
        material, uv_set, uv_matrix = self.materials.material(primitive.get("material"))
        if material is INVISIBLE:
            return None
        normals = self._attribute(primitive, "NORMAL", 3, len(vertices))
        uvs = self._attribute(primitive, f"TEXCOORD_{uv_set}", 2, len(vertices))
        if uvs is not None and uv_matrix is not None:
            uvs = uvs @ uv_matrix[:2, :2].T + uv_matrix[:2, 2]
        colours = None
        self.omissions.unknown("attributes", [name for name in attributes if not _ATTRIBUTE.fullmatch(name)])
        moved = {name for target in primitive.get("targets", []) for name in target}
        self.omissions.unknown("attributes of morph targets", moved - {"POSITION", "NORMAL", "TANGENT"})
        if self.materials.wanted:
            material, colours = self._coloured(primitive, material, len(vertices))
            if material is INVISIBLE:
                return None
            material = self._without_coordinates(material) if uvs is None else material
        binding, targets = self._binding(primitive, len(vertices)), self._targets(primitive, len(vertices))
        both = material is not None and bool(material.both_sides)
        return RawMesh(
            vertices=vertices,
            faces=faces,
            normals=normals,
            uvs=uvs,
            material=material,
            binding=binding,
            targets=targets,
            colours=colours,
            both_sides=both,
            flat=True,
        )

    def _faces(self, primitive: dict, mesh: int, count: int) -> np.ndarray:
        """Return the faces of a primitive of ``count`` vertices, (F, 3): separate triangles, a strip or a fan; without
        indices the vertices' order counts."""
        if "indices" not in primitive:
            order = np.arange(count)
        else:
            order = self.accessor(primitive["indices"])
            if order.dtype.kind != "u" or order.shape[1] != 1:
                raise AssetError(f"the indices of mesh {mesh} are no whole numbers", where=self.where)
            order = order.astype(np.int64).ravel()
        mode, n = primitive.get("mode", 4), max(len(order) - 2, 0)
        if mode == 4:
            return order[: len(order) // 3 * 3].reshape(-1, 3)
        first, odd = np.arange(n), np.arange(n) % 2
        if mode == 5:  # every other triangle of a strip has two corners exchanged
            return np.stack([order[first], order[first + 1 + odd], order[first + 2 - odd]], axis=1)
        # All triangles of a fan share the first vertex.
        return np.stack([order[first * 0], order[first + 1], order[first + 2]], axis=1)

    def _binding(self, primitive: dict, count: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return ((V, 4 n) joints, (V, 4 n) weights) of all sets of a primitive."""
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

    def _targets(self, primitive: dict, count: int) -> tuple[np.ndarray, np.ndarray | None] | None:
        """Return the morph targets of a primitive of ``count`` vertices. One without normals keeps those of the base
        shape."""
        targets = primitive.get("targets", [])
        if len(targets) * count > _MAX_TARGET_VERTICES:
            raise AssetError(
                "the mesh has too many morph targets",
                where=self.where,
                value=f"{len(targets)} of {count} vertices",
                accepted=f"{_MAX_TARGET_VERTICES} vertices in all",
            )
        if not targets:
            return None
        positions, normals = (
            np.stack([self._displacements(target, name, count) for target in targets])
            for name in ("POSITION", "NORMAL")
        )
        return positions, normals if normals.any() else None

    def _displacements(self, target: dict, name: str, count: int) -> np.ndarray:
        """Return the displacements of a morph target, (count, 3); 0 without them."""
        if name not in target:
            return np.zeros((count, 3))
        values = self._sized(target[name], count, 3, f"a morph target has another size than its mesh ({name})")
        if not (np.abs(values) <= 1e12).all():  # NaN compares false
            raise AssetError(f"a morph target is not a number, or beyond 1e12 ({name})", where=self.where)
        return values

    def skin(self, index: int) -> tuple[list[int], np.ndarray]:
        """Return (joints as indices of :attr:`nodes`, (m, 4, 4) inverse bind matrices). Raises AssetError for a joint
        that is not in the scene, and for matrices that are missing or not numbers."""
        skin = item(self.tree, "skins", index, self.where)
        joints, places = skin["joints"], self.places
        if len(joints) > MAX_NODES:
            raise AssetError(
                "a skin has too many joints", where=self.where, value=len(joints), accepted=f"at most {MAX_NODES}"
            )
        for joint in joints:
            if joint not in places:
                index_of(joint, len(self.tree.get("nodes", [])), "node", self.where)
                raise AssetError("a skin refers to a joint that is not in the scene", where=self.where, value=joint)
        bind = np.tile(np.eye(4), (len(joints), 1, 1))
        if "inverseBindMatrices" in skin:
            a = item(self.tree, "accessors", skin["inverseBindMatrices"], self.where)
            if a["type"] != "MAT4" or a["count"] < len(joints):
                raise AssetError(
                    "a skin does not have one inverse bind matrix per joint",
                    where=self.where,
                    value=f"{a['count']} {a['type']}",
                    accepted=f"{len(joints)} MAT4",
                )
            bind = self.accessor(skin["inverseBindMatrices"])[: len(joints)].astype(np.float64)
            # glTF stores matrices column by column.
            bind = bind.reshape(-1, 4, 4).swapaxes(1, 2)
        return [places[joint] for joint in joints], bind

    @cached_property
    def places(self) -> dict[int, int]:
        """Return node of the file -> its index in :attr:`nodes`, which is that of its joint in :meth:`skeleton`."""
        return {node: place for place, node in enumerate(self.nodes)}

    def rest(self) -> Locals:
        """Return the rest transforms of all nodes; a node's matrix, if any, is in :meth:`skeleton`."""
        out = Locals.rest(len(self.nodes))
        for place, node in enumerate(self.nodes.values()):
            if node.matrix is None:
                turn = np.array(node.rotation)
                out.translation[place], out.rotation[place] = node.translation, turn / np.linalg.norm(turn)
                out.scale[place] = node.scale
        return out

    def skeleton(self, motion: Motion) -> Skeleton:
        """Return all nodes as a skeleton, moved by ``motion``, in the file's world."""
        places, nodes = self.places, list(self.nodes.values())
        parents = [-1 if node.parent is None else places[node.parent] for node in nodes]
        fixed = [np.eye(4) if node.matrix is None else node.matrix for node in nodes]
        return Skeleton(parents, motion, np.array(fixed).reshape(-1, 4, 4))

    def morph_weights(self, node: int, count: int) -> np.ndarray:
        """Return the morph weights of a node's mesh at rest, (count,). Raises AssetError where their number differs."""
        mesh = item(self.tree, "meshes", self.nodes[node].mesh, self.where)
        own = self.nodes[node].weights
        weights = mesh.get("weights", [0.0] * count) if own is None else own
        if len(weights) != count:
            raise AssetError(
                "a mesh does not have one weight per morph target",
                where=self.where,
                value=len(weights),
                accepted=str(count),
            )
        return np.array(weights, np.float64)

    def _attribute(self, primitive: dict, name: str, width: int, count: int) -> np.ndarray | None:
        """Return an attribute, (count, width) float64, None without it."""
        index = primitive["attributes"].get(name)
        problem = f"the file is no valid glTF ({name} does not fit the positions)"
        return None if index is None else self._sized(index, count, width, problem)

    def _sized(self, index: int, count: int, width: int, problem: str) -> np.ndarray:
        """Return an accessor's values, (count, width) float64. Raises AssetError with this ``problem`` where it has
        another size, before it is read: a file may declare any."""
        a = item(self.tree, "accessors", index, self.where)
        if a["count"] != count or _WIDTHS[a["type"]] != width:
            has, accepted = f"{a['count']} {a['type']}", f"{count} VEC{width}"
            raise AssetError(problem, where=self.where, value=has, accepted=accepted)
        return self.accessor(index).astype(np.float64)

    def _coloured(
        self, primitive: dict, material: Material | None, count: int
    ) -> tuple[Material | None, np.ndarray | None]:
        """Return the material, times the vertices' colour (linear) where they all have the same; else their colours,
        (V, 3)."""
        if "COLOR_0" not in primitive["attributes"]:
            return material, None
        index = primitive["attributes"]["COLOR_0"]
        width = _WIDTHS[item(self.tree, "accessors", index, self.where)["type"]]
        colours = self._attribute(primitive, "COLOR_0", 4 if width == 4 else 3, count)
        assert colours is not None
        known = np.all(np.isfinite(colours), axis=1)
        if not known.all() or colours.min(initial=0) < 0 or colours.max(initial=0) > 1:
            self.omissions.add("colours beyond 0 to 1 (white where they are no numbers, else the nearest)")
        if width == 4 and (colours[:, 3] < 1).any() and self.materials.mode(primitive.get("material")) != "OPAQUE":
            self.omissions.add(OPACITY)
            if not colours[:, 3].any():
                return INVISIBLE, None
        return tinted(material, np.where(known[:, None], colours[:, :3], 1.0).clip(0, 1))

    def _without_coordinates(self, material: Material | None) -> Material | None:
        """Return the material of a mesh without texture coordinates, without normal map, whose direction is then
        unknown."""
        if material is None or material.bumps is None:
            return material
        self.omissions.add("normal maps on meshes without texture coordinates (left out)")
        return replace(material, bumps=None)

    def accessor(self, index: int) -> np.ndarray:
        """Return (count, n) values; normalised integers become floats."""
        a = item(self.tree, "accessors", index, self.where)
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
            # A sparse accessor replaces n of its values.
            where, what, n = a["sparse"]["indices"], a["sparse"]["values"], a["sparse"]["count"]
            kind = np.dtype(_DTYPES[where["componentType"]]).newbyteorder("<")
            at = self._view(where["bufferView"], where.get("byteOffset", 0), n, 1, kind, index)
            new = self._view(what["bufferView"], what.get("byteOffset", 0), n, width, dtype, index)
            if n and int(at.max()) >= count:
                raise AssetError(f"accessor {index} has a sparse index outside it", where=self.where)
            values = values.copy()
            values[at.ravel().astype(np.int64)] = new
        if a.get("normalized") and values.dtype.kind in "iu":
            # A normalised integer is divided by the largest of its type; the least signed one would be below -1.
            return np.maximum(values / float(np.iinfo(values.dtype).max), -1.0)
        return values

    def _view(self, view: int, offset: int, count: int, width: int, dtype: np.dtype, accessor: int) -> np.ndarray:
        v = item(self.tree, "bufferViews", view, self.where)
        data = self.buffers[index_of(v.get("buffer"), len(self.buffers), "buffer", self.where)]
        begin = v.get("byteOffset", 0)
        start, size = begin + offset, width * dtype.itemsize
        # Without a stride the elements follow each other without gaps.
        stride = v.get("byteStride", 0) or size
        needed = start + (stride * (count - 1) + size if count else 0)
        if stride < size or needed > min(len(data), begin + v.get("byteLength", 0)):
            raise AssetError(f"the mesh is corrupt: accessor {accessor} reaches outside its buffer", where=self.where)
        # An array with strides over the buffer, without a copy; the check above keeps it inside.
        return np.ndarray((count, width), dtype, data, start if count else 0, (stride, dtype.itemsize))

    # ---- animations
    def tracks(self, animation: int) -> list[Track]:
        """Return the tracks of an animation, with joints as indices of :attr:`nodes`; undrawn parts are added to
        omissions."""
        a = item(self.tree, "animations", animation, self.where)
        samplers, places, tracks = a["samplers"], self.places, []
        for channel in a["channels"]:
            node, path = channel["target"].get("node"), channel["target"]["path"]
            if path not in (*PATHS, "weights"):
                self.omissions.add("animation of other properties")
                continue
            # Blender keys the weights of shape keys that its modifiers have cost.
            if node not in self.nodes or (path == "weights" and not self._target_count(node)):
                continue
            if path != "weights" and self.nodes[node].matrix is not None:
                self.omissions.add("animation of nodes that have a matrix")
                continue
            sampler = samplers[index_of(channel["sampler"], len(samplers), "animation sampler", self.where)]
            kind = sampler.get("interpolation", "LINEAR")
            width = 4 if path == "rotation" else self._target_count(node) if path == "weights" else 3
            # A cubic key has three entries: in-tangent, value, out-tangent.
            per_key = 3 if kind == "CUBICSPLINE" else 1
            keys, outputs = (item(self.tree, "accessors", sampler[key], self.where) for key in ("input", "output"))
            per_value = width if path == "weights" else 1  # weights are scalars, one after the other
            # Lengths first: both are as long as the file declares.
            fits = (
                keys["type"] == "SCALAR"
                and outputs["count"] == per_key * per_value * keys["count"] > 0
                and _WIDTHS[outputs["type"]] * per_value == width
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
            tracks.append(Track(places[node], path, times, values if per_key == 3 else values[:, 0], kind))
        return tracks

    def _target_count(self, node: int) -> int:
        """Return the number of morph targets of a node's mesh; 0 for a node without one."""
        mesh = self.nodes[node].mesh
        if mesh is None:
            return 0
        return max(len(p.get("targets", [])) for p in item(self.tree, "meshes", mesh, self.where)["primitives"])


def read(
    path: Path,
    data: bytes | None = None,
    *,
    max_faces: int = 5_000_000,
    max_texture: int = 2048,
    materials: bool = True,
    lights: bool = False,
    border: Path | None = None,
) -> Document:
    """Parse a file, check its form and its counts. border : folder that its files lie below; None: its own.   lights :
    whether the file's lights are used (:meth:`Document.lights`). Raises AssetError naming it."""
    path = Path(path)
    where = str(path)
    with reading("scene", where):
        data = contents(path, "scene") if data is None else data
        tree, binary, unknown = parse(data, where)
        for name in tree.get("extensionsRequired", []):
            if name not in DRAWN | _LIGHT_ONLY | INVISIBLE_EXTENSIONS:
                raise needs(name, where)
        near = Neighbours(path, border, Omissions(path.name))
        near.omissions.unknown("properties", unknown)
        buffers = buffers_of(tree, binary, near)
        made = Materials(tree, buffers, near, max_texture, materials)
        document = Document(
            path=path,
            tree=tree,
            buffers=buffers,
            materials=made,
            omissions=near.omissions,
            nodes=nodes_of(tree, where),
            log=near.log,
        )
        _check_faces(document, max_faces)
        for name in dict.fromkeys([*tree.get("extensionsUsed", []), *_extensions(tree)]):
            # Extensions of materials and textures are reported where one is used, and lights by kind.
            said_there = name.startswith(("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_"))
            if name not in DRAWN | _LIGHT_ONLY | INVISIBLE_EXTENSIONS and not said_there:
                document.omissions.add(name)
        if "KHR_materials_variants" in tree.get("extensions", {}):
            document.omissions.add("variants of materials (the default is drawn)")
        if not lights and any(_LIGHTS in tree["nodes"][i].get("extensions", {}) for i in document.nodes):
            document.omissions.add("lights (the configuration's sun and sky shine)")
    return document


def _extensions(tree: Any) -> Iterator[str]:
    """Yield the names of extensions that anything in a file has."""
    for key, value in tree.items() if isinstance(tree, dict) else ((None, value) for value in tree):
        if key == "extensions" and isinstance(value, dict):
            yield from value
        if isinstance(value, dict) or (isinstance(value, list) and value and isinstance(value[0], (dict, list))):
            yield from _extensions(value)


def _check_faces(document: Document, max_faces: int) -> None:
    """Check the number of triangles of the scene, from the accessors' counts (for every node that shows a mesh)."""
    tree, where = document.tree, document.where

    def triangles(primitive: dict) -> int:
        references = primitive["attributes"].get("POSITION"), primitive.get("indices")
        counts = [item(tree, "accessors", one, where)["count"] for one in references if one is not None]
        # A strip or a fan has a triangle for every corner after the second.
        return max(counts, default=0) // (3 if primitive.get("mode", 4) == 4 else 1)

    meshes = Counter(node.mesh for node in document.nodes.values() if node.shows)
    primitives = {mesh: item(tree, "meshes", mesh, where)["primitives"] for mesh in meshes}
    limit_faces(sum(times * sum(map(triangles, primitives[mesh])) for mesh, times in meshes.items()), max_faces, where)
