"""A scene over its time as a binary glTF 2.0 that any viewer plays: nodes, textures, an animation, the camera, lights.

The file's y axis points up and its clock begins with the recording. Poses are sampled, shapes that change become morph
targets that are blended from one sample to the next; what glTF cannot say is returned in words.
"""

from __future__ import annotations

import json
import math
import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.errors import OutputError
from blinkgl.scene.lights import LUMENS_PER_WATT
from blinkgl.scene.types import FARTHEST, Lamp, Map, Material, Mesh, Part, PosePath, Scene, SceneObject, Texture, Wrap
from blinkgl.srgb import to_srgb8

ANIMATION = "sequence"
_LONGEST = 2**32 - 1
_FLOAT, _BYTE, _INDEX = 5126, 5121, 5125
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_WRAPS: dict[Wrap, int] = {"repeat": 10497, "mirror": 33648, "clamp": 33071}
_SKY = 100.0
"""World units of a glTF file that stand for ``FARTHEST`` there: players have a far plane."""
_Y_UP = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
"""Quaternion x, y, z, w from the world, z up, to glTF's axes."""
_CV_TO_GL = np.diag([1.0, -1.0, -1.0, 1.0])


def glb(scene: Scene, times_ns: ArrayLike, shape_times_ns: ArrayLike) -> tuple[bytes, list[str]]:
    """The file's bytes, and what of the scene is not in it, a line each.

    times_ns : increasing, at which moving poses are sampled.   shape_times_ns : likewise, for shapes that change.
    Raises OutputError: more than the 4 GB that the format holds."""
    return _Writer(scene, np.asarray(times_ns, np.int64), np.asarray(shape_times_ns, np.int64)).whole()


class _Writer:
    def __init__(self, scene: Scene, times_ns: np.ndarray, shape_times_ns: np.ndarray):
        self.scene, self.times_ns, self.shape_times_ns = scene, times_ns, shape_times_ns
        self.binary, self.said = bytearray(), list(scene.omissions)
        self.lists: dict[str, list[Any]] = {
            k: []
            for k in ("nodes", "meshes", "materials", "textures", "images", "samplers", "accessors", "bufferViews")
        }
        self.channels: list[dict[str, Any]] = []
        self.tracks: list[dict[str, Any]] = []
        self.known: dict[Any, int] = {}
        self.keep: list[Any] = []
        self.lamps: list[dict[str, Any]] = []

    def whole(self) -> tuple[bytes, list[str]]:
        """The whole file."""
        nodes = [self._object(one) for one in self.scene.objects]
        nodes += [self._camera(), *self._lights()]
        root = self._add("nodes", {"name": "world, z up", "rotation": _Y_UP, "children": nodes})
        self._left_out()
        used = {"KHR_lights_punctual": self.lamps, "KHR_materials_unlit": self._has_unlit()}
        extensions = [name for name, there in used.items() if there]
        tree = {
            "asset": {"version": "2.0", "generator": "BlinkGL"},
            "scene": 0,
            "scenes": [{"nodes": [root]}],
            "cameras": [self._lens()],
            **{k: v for k, v in self.lists.items() if v},
            **({"animations": [self._animation()]} if self.channels else {}),
            **({"extensionsUsed": extensions} if extensions else {}),
            **({"extensions": {"KHR_lights_punctual": {"lights": self.lamps}}} if self.lamps else {}),
            "buffers": [{"byteLength": len(self.binary)}],
        }
        text = json.dumps(tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        self.binary += bytes(-len(self.binary) % 4)
        total = 28 + len(text) + len(self.binary)
        if total > _LONGEST:
            raise OutputError("a scene of more than the 4 GB that a GLB holds", value=total)
        return (
            struct.pack("<4sII", b"glTF", 2, total)
            + struct.pack("<I4s", len(text), b"JSON")
            + text
            + struct.pack("<I4s", len(self.binary), b"BIN\0")
            + bytes(self.binary),
            list(dict.fromkeys(self.said)),
        )

    # ---- nodes ---------------------------------------------------------------------------------------------------

    def _object(self, one: SceneObject) -> int:
        extras = {"instance_id": one.instance_id, "category": one.category}
        node = self._node(one.name, one.path, extras=extras, mesh=self._mesh(one))
        if one.at_infinity:
            self.lists["nodes"][node]["scale"] = [_SKY / FARTHEST] * 3
            self.said.append(f"the sky's distance: it is a box at {16 * _SKY:g} units around the camera")
        if one.deforms:
            count = len(self.shape_times_ns)
            self._animate(node, "weights", self.shape_times_ns, np.eye(count, dtype=np.float32).reshape(-1))
        return node

    def _camera(self) -> int:
        return self._node("camera", self.scene.camera_path, turned=_CV_TO_GL, camera=0)

    def _lens(self) -> dict[str, Any]:
        camera = self.scene.camera
        fx, fy, cx, cy = camera.intrinsics
        perspective = {
            "yfov": 2 * math.atan(camera.height / 2 / fy),
            "aspectRatio": camera.width * fy / (camera.height * fx),
            "znear": camera.near,
        }
        if not isinstance(camera, PinHole):
            self.said.append("the lens's distortion")
        middle = ((camera.width - 1) / 2, (camera.height - 1) / 2)
        if max(abs(cx - middle[0]), abs(cy - middle[1])) > 1e-6:
            self.said.append("a principal point beside the middle of the picture")
        return {"type": "perspective", "name": "camera", "perspective": perspective}

    def _lights(self) -> list[int]:
        light, nodes = self.scene.light, []
        if light.sun > 0:
            pose = np.eye(4)
            s = np.array(light.sun_direction)
            aside = np.cross([0.0, 0.0, 1.0] if abs(s[2]) < 0.9 else [1.0, 0.0, 0.0], s)
            aside /= np.linalg.norm(aside)
            pose[:3, :3] = np.stack([aside, np.cross(s, aside), s], axis=1)  # it shines along -z
            strength = [light.sun * c for c in light.sun_color]
            nodes.append(self._add("nodes", self._placed("sun", pose) | self._shines("directional", strength)))
        for number, lamp in enumerate(light.lamps):
            kind = {"sun": "directional", "point": "point", "spot": "spot"}[lamp.kind]
            nodes.append(
                self._node(f"{lamp.kind} {number}", lamp.path, **self._shines(kind, list(lamp.strength), lamp))
            )
        return nodes

    def _shines(self, kind: str, strength: list[float], lamp: Lamp | None = None) -> dict[str, Any]:
        """Lux or candela, as Blender's exporter counts them: 683 lm/W."""
        top = max(*strength, 1e-30)
        one: dict[str, Any] = {
            "type": kind,
            "color": [v / top for v in strength],
            "intensity": top * LUMENS_PER_WATT * math.pi,
        }
        if lamp is not None and math.isfinite(lamp.reach):
            one["range"] = lamp.reach
        if lamp is not None and kind == "spot":
            one["spot"] = {"innerConeAngle": lamp.inner, "outerConeAngle": lamp.outer}
        self.lamps.append(one)
        return {"extensions": {"KHR_lights_punctual": {"light": len(self.lamps) - 1}}}

    def _node(self, name: str, path: PosePath, turned: np.ndarray | None = None, **more: Any) -> int:
        """A node on its path; moving ones get channels of the animation."""
        times = self.times_ns[:1] if path.is_static else self.times_ns
        poses = path.poses(times)
        poses = poses if turned is None else poses @ turned
        node = self._add("nodes", self._placed(name, poses[0]) | more)
        if not path.is_static:
            turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
            flips = np.sign(np.einsum("ij,ij->i", turns[1:], turns[:-1]))
            turns[1:] *= np.cumprod(np.where(flips == 0, 1, flips))[:, None]  # the short way from one to the next
            self._animate(node, "translation", self.times_ns, poses[:, :3, 3].astype(np.float32))
            self._animate(node, "rotation", self.times_ns, turns.astype(np.float32))
        return node

    def _placed(self, name: str, pose: np.ndarray) -> dict[str, Any]:
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
        return {"name": name, "translation": pose[:3, 3].tolist(), "rotation": turn.tolist(), "scale": [1.0, 1.0, 1.0]}

    def _animate(self, node: int, path: str, times_ns: np.ndarray, values: np.ndarray) -> None:
        stamps = self._once(("times", times_ns.tobytes()), lambda: self._stamps(times_ns))
        self.tracks.append({"input": stamps, "output": self._accessor(values), "interpolation": "LINEAR"})
        self.channels.append({"sampler": len(self.tracks) - 1, "target": {"node": node, "path": path}})

    def _stamps(self, times_ns: np.ndarray) -> int:
        return self._accessor(((times_ns - self.scene.t0_ns) * 1e-9).astype(np.float32), bounds=True)

    def _animation(self) -> dict[str, Any]:
        return {"name": ANIMATION, "channels": self.channels, "samplers": self.tracks}

    # ---- meshes --------------------------------------------------------------------------------------------------

    def _mesh(self, one: SceneObject) -> int:
        mesh: dict[str, Any] = {"name": one.name, "primitives": [self._primitive(p, one.deforms) for p in one.parts]}
        if one.deforms:
            mesh["weights"] = [1.0] + [0.0] * (len(self.shape_times_ns) - 1)
        return self._add("meshes", mesh)

    def _primitive(self, part: Part, deforms: bool) -> dict[str, Any]:
        mesh, material = part.mesh, part.material
        scale = np.asarray(material.uv_scale, np.float32)
        attributes = {
            "POSITION": self._once(("position", id(mesh)), lambda: self._accessor(mesh.vertices, 34962, bounds=True)),
            "NORMAL": self._once(("normal", id(mesh)), lambda: self._accessor(mesh.normals, 34962)),
            "TEXCOORD_0": self._once(
                ("uv", id(mesh), *material.uv_scale), lambda: self._accessor(mesh.uvs * scale, 34962)
            ),
        }
        if mesh.colours is not None:
            attributes["COLOR_0"] = self._once(("colour", id(mesh)), lambda: self._accessor(mesh.colours, 34962))
        primitive: dict[str, Any] = {
            "attributes": attributes,
            "indices": self._once(("faces", id(mesh)), lambda: self._indices(mesh)),
            "material": self._once(("material", id(material), part.culled), lambda: self._material(part)),
            "mode": 4,
        }
        if deforms:
            primitive["targets"] = [{"POSITION": v} for v in self._targets(mesh)]
        self.keep += [mesh, material]  # whose id is a key
        return primitive

    def _targets(self, mesh: Mesh) -> list[int]:
        """A morph target per sample: its difference to the shape at rest."""
        if mesh.deformer is None or mesh.deformer.is_static:
            rest = np.zeros_like(mesh.vertices)
            shapes = [rest if mesh.deformer is None else mesh.deformer.positions(mesh, 0) - mesh.vertices]
            shapes *= len(self.shape_times_ns)
        else:
            self.said.append("normals of shapes that change: they stay those at rest")
            shapes = [mesh.deformer.positions(mesh, int(t)) - mesh.vertices for t in self.shape_times_ns]
        return [self._accessor(shape, 34962, bounds=True) for shape in shapes]

    def _indices(self, mesh: Mesh) -> int:
        return self._accessor(mesh.faces.astype(np.uint32).reshape(-1), 34963, component=_INDEX)

    # ---- materials -----------------------------------------------------------------------------------------------

    def _material(self, part: Part) -> int:
        material, gloss = part.material, part.material.gloss
        colour = np.asarray(material.base_color, float)
        if colour.max() > 1:
            self.said.append("colours above 1, which are cut off")
        alpha = 1.0 if material.mask is None else material.mask.factor
        pbr: dict[str, Any] = {
            "baseColorFactor": [*np.clip(colour, 0, 1).tolist(), alpha],
            "metallicFactor": 0.0 if gloss is None else gloss.metallic,
            "roughnessFactor": 1.0 if gloss is None else gloss.roughness,
        }
        if material.texture is not None or material.mask is not None:
            pbr["baseColorTexture"] = {"index": self._base(material)}
        if gloss is not None and gloss.map is not None:
            pbr["metallicRoughnessTexture"] = {"index": self._map(gloss.map)}
        out: dict[str, Any] = {"pbrMetallicRoughness": pbr, "doubleSided": not part.culled}
        if material.bumps is not None:
            out["normalTexture"] = {"index": self._map(material.bumps), "scale": material.bump_scale}
        if any(material.emission):
            out["emissiveFactor"] = np.clip(material.emission, 0, 1).tolist()
        if material.emission_map is not None:
            out["emissiveTexture"] = {"index": self._map(material.emission_map)}
        if material.mask is not None:
            out |= {"alphaMode": "MASK", "alphaCutoff": material.mask.cutoff}
        if material.unlit:
            out["extensions"] = {"KHR_materials_unlit": {}}
        return self._add("materials", out)

    def _has_unlit(self) -> bool:
        return any("extensions" in m for m in self.lists["materials"])

    def _base(self, material: Material) -> int:
        texture, mask = material.texture, material.mask
        key = ("base", id(texture), id(mask), material.wrap)

        def make() -> int:
            picture = np.full((1, 1, 3), 255, np.uint8) if texture is None else _srgb(texture)
            if mask is not None:
                h, w = (max(a, b) for a, b in zip(picture.shape[:2], mask.alpha.shape))
                picture, alpha = (cv2.resize(np.ascontiguousarray(p), (w, h)) for p in (picture, mask.alpha))
                picture = np.dstack([picture, alpha])
            return self._texture(picture, material.wrap)

        self.keep += [texture, mask]
        return self._once(key, make)

    def _map(self, one: Map) -> int:
        if one.at != (1.0, 0.0, 0.0, 0.0, 1.0, 0.0):
            self.said.append("maps whose coordinates differ from the colour's: they are laid over it")
        self.keep.append(one.texture)
        return self._once(("map", id(one.texture), one.wrap), lambda: self._texture(_srgb(one.texture), one.wrap))

    def _texture(self, picture: np.ndarray, wrap: tuple[Wrap, Wrap]) -> int:
        order = [2, 1, 0, 3][: picture.shape[2]]
        ok, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., order]))
        assert ok
        image = self._add("images", {"mimeType": "image/png", "bufferView": self._view(data.tobytes())})
        sampler = self._once(
            ("sampler", wrap),
            lambda: self._add(
                "samplers", {"magFilter": 9729, "minFilter": 9987, "wrapS": _WRAPS[wrap[0]], "wrapT": _WRAPS[wrap[1]]}
            ),
        )
        return self._add("textures", {"source": image, "sampler": sampler})

    def _left_out(self) -> None:
        scene = self.scene
        for there, what in (
            (scene.fog is not None, "fog"),
            (scene.light.sky > 0, "light of the sky: viewers bring their own"),
            (scene.light.around is not None, "the surroundings' light"),
            (scene.background > 0, "the background's radiance"),
        ):
            if there:
                self.said.append(what)

    # ---- bytes ---------------------------------------------------------------------------------------------------

    def _accessor(
        self, array: np.ndarray, target: int | None = None, *, component: int = _FLOAT, bounds: bool = False
    ) -> int:
        dtype = np.uint32 if component == _INDEX else np.float32
        array = np.ascontiguousarray(array, dtype)
        rows = array if array.ndim == 2 else array[:, None]
        one: dict[str, Any] = {
            "bufferView": self._view(array.tobytes(), target),
            "componentType": component,
            "count": len(rows),
            "type": _TYPES[rows.shape[1]],
        }
        if bounds:
            one |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        return self._add("accessors", one)

    def _view(self, data: bytes, target: int | None = None) -> int:
        self.binary += bytes(-len(self.binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        self.binary += data
        return self._add("bufferViews", view | ({} if target is None else {"target": target}))

    def _add(self, kind: str, value: dict[str, Any]) -> int:
        self.lists[kind].append(value)
        return len(self.lists[kind]) - 1

    def _once(self, key: Any, make: Any) -> int:
        if key not in self.known:
            self.known[key] = make()
        return self.known[key]


def _srgb(texture: Texture) -> np.ndarray:
    """(h, w, 3) uint8; what is linear is coded, and cut off above 1."""
    return texture.image if texture.image.dtype == np.uint8 else to_srgb8(texture.image)
