"""Scenes of pyrender as scenes of BlinkGL. Nothing of pyrender is imported: its objects are read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from blinkgl.errors import ConfigError
from blinkgl.front.poses import Pose
from blinkgl.front.surfaces import Material
from blinkgl.scene import types as data
from blinkgl.scene.geometry.meshes import make_mesh, transform_mesh
from blinkgl.scene.surfaces.images import content_hash
from blinkgl.scene.worlds.from_file import CV_FROM_GL, split_rigid
from blinkgl.types.trees import Tree

Theirs = Any  # an object of pyrender, which is not imported
_TRIANGLES, _REPEAT = 4, 10497  # OpenGL's codes


class Taken(NamedTuple):
    """What is taken of a scene. lens : arguments of a Camera, place : its pose.   bodies : mesh, material, pose and
    name of each.   lights : tables of a Light.   background : linear.   notes : what is not drawn."""

    lens: dict[str, float]
    place: Pose
    bodies: list[tuple[data.Mesh, Material, Pose, str]]
    lights: list[Tree]
    background: float
    notes: tuple[str, ...]


def taken(source: Theirs, height: int, width: int) -> Taken:
    """Return what is taken of a ``pyrender.Scene`` that is drawn in width x height px. Raises ConfigError: no
    perspective camera, no triangles."""
    notes: list[str] = []
    lens, place = _camera(source, height, width)
    # Its sets of nodes have no order; ids and names count in that of their addition.
    order = {node: k for k, node in enumerate(source._digraph)}  # noqa: SLF001
    bodies = [b for node in sorted(source.mesh_nodes, key=order.__getitem__) for b in _bodies(source, node, notes)]
    shining = sorted(source.light_nodes, key=order.__getitem__)
    lights = [_lamp(node.light, source.get_pose(node)) for node in shining]
    if np.any(source.ambient_light):
        notes.append("ambient light")
    # It shows colours by a gamma of 2.2, and the background's as it is.
    grey = np.asarray(source.bg_color, float)[:3] ** 2.2
    if np.ptp(grey) > 1e-6:
        notes.append("the background's colour (drawn as its mean)")
    if not bodies:
        accepted = "a scene with meshes of triangles"
        raise ConfigError("no triangles", where="Scene.from_pyrender.scene", value=notes or None, accepted=accepted)
    return Taken(lens, place, bodies, lights, float(grey.mean()), tuple(notes))


def _camera(source: Theirs, height: int, width: int) -> tuple[dict[str, float], Pose]:
    node = source.main_camera_node
    if node is None or type(node.camera).__name__ not in ("PerspectiveCamera", "IntrinsicsCamera"):
        kind = None if node is None else type(node.camera).__name__
        accepted = "a scene with a PerspectiveCamera or an IntrinsicsCamera"
        raise ConfigError("no such camera", where="Scene.from_pyrender.scene", value=kind, accepted=accepted)
    lens_of = node.camera
    if hasattr(lens_of, "fx"):
        # Its principal point counts from the picture's corner, ours from the first pixel's centre.
        lens = {"fx": lens_of.fx, "fy": lens_of.fy, "cx": lens_of.cx - 0.5, "cy": lens_of.cy - 0.5}
    else:
        fy = height / 2 / math.tan(lens_of.yfov / 2)
        lens = {"fx": fy * width / height / (lens_of.aspectRatio or width / height), "fy": fy}
    lens = {key: float(number) for key, number in {**lens, "near": lens_of.znear or 0.05}.items()}
    return lens, Pose.from_matrix(split_rigid(source.get_pose(node))[0] @ CV_FROM_GL)


def _bodies(source: Theirs, node: Theirs, notes: list[str]) -> Iterator[tuple[data.Mesh, Material, Pose, str]]:
    """Yield a body for each primitive of a node, and for each of its instances."""
    for primitive in node.mesh.primitives:
        if primitive.mode != _TRIANGLES:
            notes.append("primitives other than triangles")
            continue
        points = np.asarray(primitive.positions, np.float64)
        faces = np.arange(len(points)) if primitive.indices is None else np.asarray(primitive.indices)
        material = _material(primitive, notes)
        normals = primitive.normals if primitive.material.smooth else None
        # pyrender has v upwards from the picture's lower edge.
        uvs = None if primitive.texcoord_0 is None else primitive.texcoord_0[:, :2] * [1, -1] + [0, 1]
        origin: list[np.ndarray] = []
        common: dict[str, Any] = {"normals": normals, "uvs": uvs, "source": origin, "where": "Scene.from_pyrender"}
        raw = make_mesh(points, faces.reshape(-1, 3), **common, name=node.mesh.name or "mesh")
        if primitive.color_0 is not None:
            raw = replace(raw, colours=np.asarray(primitive.color_0, np.float32)[origin[0], :3].clip(0, 1))
        raw = replace(raw, source_hash=content_hash(raw.vertices.tobytes(), raw.faces.tobytes(), raw.uvs.tobytes()))
        # A primitive with poses is drawn once for each (instances).
        for place in [np.eye(4)] if primitive.poses is None else primitive.poses:
            rigid, shape = split_rigid(source.get_pose(node) @ place)
            named = node.name or node.mesh.name or "mesh"
            yield transform_mesh(raw, shape), material, Pose.from_matrix(rigid), named


def _material(primitive: Theirs, notes: list[str]) -> Material:
    paint = primitive.material
    if not hasattr(paint, "baseColorFactor"):
        notes.append(f"a {type(paint).__name__} (drawn grey)")
        return Material(color=(0.5, 0.5, 0.5), both_sides=bool(paint.doubleSided))
    for key, words in (("occlusionTexture", "occlusion maps"), ("wireframe", "wire frames")):
        if getattr(paint, key, None):
            notes.append(words)
    colours = primitive.color_0
    clear = paint.baseColorFactor[3] < 1 or (colours is not None and np.min(colours[:, 3:], initial=1) < 1)
    if paint.alphaMode != "OPAQUE" and clear:
        notes.append(f"opacity of {paint.alphaMode} (drawn opaque)")
    textures = ("baseColorTexture", "metallicRoughnessTexture", "normalTexture", "emissiveTexture")
    keys = dict(zip(textures, ("image", "metallic_roughness_map", "normal_map", "emission_map"), strict=True))
    maps = {name: _pixels(getattr(paint, key), notes) for key, name in keys.items() if getattr(paint, key) is not None}
    return Material(
        **maps,
        color=tuple(float(c) for c in paint.baseColorFactor[:3]),
        metallic=float(paint.metallicFactor),
        roughness=float(paint.roughnessFactor),
        emission=tuple(float(c) for c in paint.emissiveFactor[:3]),
        both_sides=bool(paint.doubleSided),
    )


def _pixels(texture: Theirs, notes: list[str]) -> np.ndarray:
    """Return (h, w, 3) uint8 of a texture."""
    if texture.sampler is not None and {texture.sampler.wrapS, texture.sampler.wrapT} != {_REPEAT}:
        notes.append("textures that do not repeat (drawn repeating)")
    pixels = np.asarray(texture.source)
    pixels = pixels if pixels.dtype == np.uint8 else np.rint(np.clip(pixels, 0, 1) * 255).astype(np.uint8)
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    return np.ascontiguousarray(pixels[..., :3] if pixels.shape[2] > 2 else np.repeat(pixels[..., :1], 3, axis=2))


def _lamp(light: Theirs, pose: np.ndarray) -> dict[str, object]:
    """Return the table of a light, which shines along its -z: lux and candela over pi are the radiance of a white
    surface."""
    back, place = pose[:3, 2] / np.linalg.norm(pose[:3, 2]), pose[:3, 3].tolist()
    lamp = {"strength": float(light.intensity / math.pi), "color": tuple(float(c) for c in light.color[:3])}
    if type(light).__name__ == "DirectionalLight":
        angles = math.degrees(math.asin(back[2].clip(-1, 1))), math.degrees(math.atan2(back[1], back[0]))
        return {"kind": "sun", "elevation": angles[0], "azimuth": angles[1], **lamp}
    if type(light).__name__ == "PointLight":
        return {"kind": "point", "position": place, **lamp}
    outer = light.outerConeAngle
    cone = {"angle": math.degrees(2 * outer), "edge": 1 - light.innerConeAngle / outer}
    return {"kind": "spot", "position": place, "look_at": (pose[:3, 3] - back).tolist(), **cone, **lamp}
