"""The GLB, by Blender's own exporter."""

from __future__ import annotations

import json
import struct
import sys
from importlib import import_module
from pathlib import Path

import bpy
import numpy as np
from kept import MESH_LIKE
from said import Refused, Table

_CONSTANT = 1e-7  # relative: noise of float32 matrices. The exporter's own is 1e-4, absolute: slow motions were lost.


def _hooks(outside: set[str], inside: set[str], unseen: set[str]) -> type:
    """What the exporter asks: only what is in the picture, and no surface twice. Names of objects that the scene shows
    itself, of those that its instances of collections show, and of those that are no surface themselves."""

    class Hooks:
        def gather_tree_filter_tag_hook(self, tree: object, settings: dict) -> None:
            for node in tree.nodes.values():
                thing = node.blender_object
                if thing is None or node.blender_type == node.BONE:
                    continue
                above, instanced = node.parent_uuid, False
                while above is not None:
                    instanced = instanced or tree.nodes[above].blender_type == node.INST_COLLECTION
                    above = tree.nodes[above].parent_uuid
                node.keep_tag = thing.name_full in (inside if instanced else outside)

        def gather_node_mesh_hook(self, hook: object, thing: bpy.types.Object, settings: dict) -> None:
            if thing is not None and (thing.name_full in unseen or (thing.type in MESH_LIKE and thing.type != "MESH")):
                hook.export_mesh = False

    return Hooks


def export(
    out: Path,
    things: list[bpy.types.Object],
    everything: list[bpy.types.Object],
    made: list[bpy.types.Object],
    unseen: set[str],
    clips: bool,
    table: Table,
) -> None:
    """Writes ``out`` and fills in what came. ``made``: objects that the import itself made."""
    added = {o.name_full for o in made}
    addon = sys.modules.get("io_scene_gltf2") or import_module("io_scene_gltf2")
    addon.glTF2ExportUserExtension = _hooks(
        {o.name_full for o in things} | added, {o.name_full for o in everything} | added, unseen
    )
    for part in ("object", "armature", "shapekeys"):
        import_module(f"io_scene_gltf2.blender.exp.animation.sampled.{part}.keyframes").fcurve_is_constant = is_constant
    try:
        bpy.ops.export_scene.gltf(
            filepath=str(out),
            export_format="GLB",
            use_active_scene=True,
            export_cameras=True,
            export_lights=True,
            export_influence_nb=8,
            export_current_frame=True,
            export_rest_position_armature=False,
            export_animation_mode="ACTIONS" if clips else "SCENE",
            export_anim_scene_split_object=False,
            export_anim_slide_to_zero=True,
            export_optimize_animation_size=False,
            export_optimize_animation_keep_anim_armature=clips,
            export_optimize_animation_keep_anim_object=False,
            export_try_omit_sparse_sk=False,
        )
    finally:
        del addon.glTF2ExportUserExtension
    if not out.is_file():
        raise Refused("Blender's exporter wrote nothing")
    count(json_of(out), table)


def is_constant(keyframes: list) -> bool:
    """Whether a channel says the same at all its key frames."""
    values = np.array([list(key.value) for key in keyframes], float)
    return bool((np.ptp(values, axis=0) <= _CONSTANT * np.maximum(np.abs(values).max(axis=0), 1e-3)).all())


def json_of(path: Path) -> dict:
    """The JSON of a GLB."""
    with open(path, "rb") as file:
        head = file.read(20)
        return json.loads(file.read(struct.unpack("<I", head[12:16])[0]))


def count(tree: dict, table: Table) -> None:
    """What glTF counts, into ``came``."""
    nodes, meshes = tree.get("nodes", []), tree.get("meshes", [])
    shown = [n for n in nodes if "mesh" in n]
    if not shown and not (table["armatures"].found and tree.get("animations")):
        raise Refused("the scene shows no surface", accepted="a scene with a mesh that has faces and is rendered")
    others = table["curves, texts, metaballs"].came + table["instances"].came
    table["meshes"].came = max(len(shown) - others, 0)
    faces = {k: _triangles(mesh, tree) for k, mesh in enumerate(meshes)}
    if shown:
        table["meshes"].notes.append(f"{sum(faces[n['mesh']] for n in shown):,} triangles")
    table["cameras"].came = sum("camera" in n for n in nodes)
    table["lights"].came = sum("KHR_lights_punctual" in n.get("extensions", {}) for n in nodes)
    skins = {s.get("skeleton", k) for k, s in enumerate(tree.get("skins", []))}
    table["armatures"].came = len(skins) if shown else table["armatures"].found
    baked = table["vertex animations"].came
    targets = [len(p.get("targets", ())) for mesh in meshes for p in mesh["primitives"][:1]]
    table["shape keys"].came = min(sum(targets), table["shape keys"].found) if not baked else table["shape keys"].came
    clips = tree.get("animations", [])
    if clips:
        listed = ", ".join(f"'{clip.get('name', k)}'" for k, clip in enumerate(clips[:5]))
        more = f" and {len(clips) - 5} more" if len(clips) > 5 else ""
        moved = len({c["target"].get("node") for clip in clips for c in clip["channels"]})
        table["animations"].found = table["animations"].came = len(clips)
        table["animations"].notes.append(f"{listed}{more}, {moved} nodes move")


def _triangles(mesh: dict, tree: dict) -> int:
    total = 0
    for primitive in mesh["primitives"]:
        if primitive.get("mode", 4) == 4:
            which = primitive.get("indices", primitive["attributes"]["POSITION"])
            total += tree["accessors"][which]["count"] // 3
    return total
