"""The program that Blender runs for ``blinkgl import``: opens a file and exports it by Blender's exporter of glTF.

    python convert.py FOLDER        FOLDER/job.json in; FOLDER/scene.glb out

It needs only ``bpy`` and NumPy and imports nothing of BlinkGL, since Blender is GPL.
job.json: source (absolute path), shown (as the user wrote it), scene (name or null), frames ([first, last] or null),
fps (or null), keys_per_frame, clips. ``blinkgl.blender.importing`` writes it.

Standard output has one JSON object per line: ``{"blender"}``, ``{"doing"}`` for progress, ``{"report"}`` when scene.glb
is complete, or ``{"error", "where", "accepted"}``. Blender's own output goes to standard error.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import struct
import sys
import traceback
from collections.abc import Iterable
from importlib import import_module
from math import gcd
from pathlib import Path
from typing import Any

import numpy as np

MOST_FRAMES = 100_000
MOST_SHAPES = 200
"""Largest number of frames of a shape that is baked frame by frame."""
MOVED = 1e-5
"""Smallest change, as a fraction of a shape's size."""
CONSTANT = 1e-7
STILL = set(
    """ARRAY BEVEL DATA_TRANSFER DECIMATE EDGE_SPLIT MIRROR MULTIRES NORMAL_EDIT REMESH SCREW SOLIDIFY SUBSURF
    TRIANGULATE UV_PROJECT UV_WARP WEIGHTED_NORMAL WELD WIREFRAME""".split()
)
"""Modifiers that do not change in time by themselves."""
UNKNOWN = {
    "VOLUME": "volumes", "META": "metaballs", "POINTCLOUD": "point clouds", "CURVES": "hair",
    "GREASEPENCIL": "grease pencil", "LIGHT_PROBE": "light probes", "SPEAKER": "speakers", "LATTICE": "lattices",
}  # fmt: skip


class Refused(Exception):
    """A line for the user: what is wrong, and what would be accepted."""

    def __init__(self, problem: str, accepted: str | None = None):
        super().__init__(problem)
        self.problem, self.accepted = problem, accepted


def names(things: Iterable[Any], limit: int = 3) -> str:
    """Return 'a', 'b', 'c' and 4 more."""
    listed = [f"'{thing.name}'" for thing in things]
    return ", ".join(listed[:limit]) + (f" and {len(listed) - limit} more" if len(listed) > limit else "")


# --- opening ----------------------------------------------------------------------------------------------------------


def open_file(bpy: Any, source: Path, fps: float | None) -> None:
    """Load the file as Blender's data, without scripts. Refused: damaged, of another kind, or saved by a newer
    Blender."""
    operators = bpy.ops.wm
    openers = {
        ".fbx": lambda path: operators.fbx_import(filepath=path),
        ".obj": lambda path: operators.obj_import(filepath=path),
        ".dae": lambda path: operators.collada_import(filepath=path),
        ".abc": lambda path: operators.alembic_import(filepath=path, set_frame_range=True, as_background_job=False),
    }
    usd = lambda path: operators.usd_import(filepath=path, import_textures_mode="IMPORT_PACK", set_frame_range=True)
    ending = source.suffix.lower()
    operators.read_factory_settings(use_empty=True)
    # Independent of the defaults: text blocks marked 'register' and drivers' expressions are never run.
    bpy.context.preferences.filepaths.use_scripts_auto_execute = False
    try:
        if ending == ".blend":
            operators.open_mainfile(filepath=str(source), load_ui=False, use_scripts=False)
        else:
            set_rate(bpy.context.scene, fps or 24.0)  # Alembic's seconds become frames when it is read
            if "FINISHED" not in openers.get(ending, usd)(str(source)):
                raise Refused(f"Blender cannot read it as {ending[1:].upper()}", "a whole file of that kind")
    except RuntimeError as problem:  # errors of operators
        text = " ".join(str(problem).split()).removeprefix("Error: ")
        raise Refused(f"Blender cannot read it ({text[:200]})", "a whole file") from problem
    saved, here = tuple(bpy.data.version[:2]), tuple(bpy.app.version[:2])
    if saved > here:  # it would leave out unknown data silently
        raise Refused(f"saved by Blender {saved[0]}.{saved[1]}, newer than the {here[0]}.{here[1]} that would open it")
    if bpy.context.preferences.filepaths.use_scripts_auto_execute:
        raise Refused("the file's scripts could not be switched off")
    if ending in (".fbx", ".dae"):  # their importers do not set the scene's length
        spans = [tuple(action.frame_range) for action in bpy.data.actions]
        if spans:
            bpy.context.scene.frame_start = round(min(first for first, _ in spans))
            bpy.context.scene.frame_end = round(max(last for _, last in spans))
    if fps is not None:
        set_rate(bpy.context.scene, fps)


def set_rate(scene: Any, fps: float) -> None:
    """Set the frames per second, which Blender stores as a whole number over a divisor."""
    scene.render.fps = max(round(fps), 1)
    scene.render.fps_base = scene.render.fps / fps


def set_clock(scene: Any, frames: list[int] | None, per: int) -> dict:
    """Set the scene to ``per`` key frames per frame: its time is stretched and its frame rate multiplied by ``per``.
    Returns first, last (frames of the file), fps (of the file) and duration_s."""
    first, last = frames or (scene.frame_start, scene.frame_end)
    render = scene.render
    fps = render.fps / render.fps_base
    common = gcd(render.frame_map_old, render.frame_map_new)
    new = render.frame_map_new // common * per
    if last < first or (last - first) * per > MOST_FRAMES or new > 900 or render.fps * per > 32767:
        raise Refused(
            f"frames {first} to {last} with {per} keys each cannot be exported",
            f"--frames FIRST LAST, at most {MOST_FRAMES} keys, or fewer --keys-per-frame",
        )
    render.frame_map_old, render.frame_map_new = render.frame_map_old // common, new
    render.fps *= per
    scene.frame_start, scene.frame_end = first * per, last * per
    return {"first": first, "last": last, "fps": fps, "duration_s": (last - first) / fps}


# --- what glTF cannot store -------------------------------------------------------------------------------------------


def rendered(bpy: Any) -> list[Any]:
    """Return the objects of the view layer that Blender would render, and show them, so that they are evaluated."""
    found = []
    for thing in bpy.context.view_layer.objects:
        if not (thing.hide_render or all(collection.hide_render for collection in thing.users_collection)):
            thing.hide_viewport = False
            thing.hide_set(False)
            found.append(thing)
    return found


def check(things: list[Any]) -> None:
    """Refuse objects whose result would be wrong."""
    for thing in things:
        if thing.instance_type in ("VERTS", "FACES"):
            raise Refused(
                f"'{thing.name}' has instances at its vertices or faces", "real objects (Apply > Make Instances Real)"
            )
        shown = thing.instance_collection if thing.instance_type == "COLLECTION" else None
        if shown is not None and any(shown.instance_offset):
            raise Refused(f"'{thing.name}' is an instance of a collection with an offset", "an instance offset of 0")
        others = [m for m in active_modifiers(thing) if m.type != "ARMATURE"]
        if others and thing.type == "MESH" and thing.data.shape_keys is not None:
            raise Refused(
                f"'{thing.name}' has shape keys and modifiers ({others[0].name}); glTF cannot store both",
                "applied modifiers, or no shape keys",
            )


def active_modifiers(thing: Any) -> list[Any]:
    """Return the modifiers that the viewport shows."""
    return [modifier for modifier in thing.modifiers if modifier.show_viewport]


def realize(bpy: Any, things: list[Any]) -> None:
    """Convert instances of geometry nodes to faces of the object itself, because the exporter leaves them out."""
    group = bpy.data.node_groups.new("Realize", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "GeometryNodeRealizeInstances", "NodeGroupOutput")
    start, real, end = (group.nodes.new(kind) for kind in kinds)
    group.links.new(start.outputs[0], real.inputs[0])
    group.links.new(real.outputs[0], end.inputs[0])
    for thing in things:
        if any(modifier.type == "NODES" for modifier in active_modifiers(thing)):
            thing.modifiers.new("Realize", "NODES").node_group = group


def bake_shapes(bpy: Any, things: list[Any]) -> list[str]:
    """Convert shapes that change by other means than bones and shape keys to a shape key per frame; return their
    names."""
    scene, candidates, faces = bpy.context.scene, {}, {}
    for thing in things:
        kinds = {modifier.type for modifier in active_modifiers(thing)} - {"ARMATURE"}
        if thing.type == "MESH" and not kinds <= STILL:
            candidates[thing] = []
    for frame in range(scene.frame_start, scene.frame_end + 1) if candidates else ():
        scene.frame_set(frame)  # in order, as simulations require
        graph = bpy.context.evaluated_depsgraph_get()
        for thing, shapes in candidates.items():
            shown = thing.evaluated_get(graph)
            mesh = shown.to_mesh()
            places = np.empty((len(mesh.vertices), 3), np.float32)
            mesh.vertices.foreach_get("co", places.ravel())
            if len(mesh.polygons) != faces.setdefault(thing, len(mesh.polygons)):
                raise Refused(f"the number of faces of '{thing.name}' changes", "the same faces in all frames")
            shown.to_mesh_clear()
            if not shapes or len(shapes) <= MOST_SHAPES or changed(shapes[0], places):
                shapes.append(places)
    scene.frame_set(scene.frame_start)
    moving = [thing for thing, shapes in candidates.items() if any(changed(shapes[0], one) for one in shapes)]
    graph = bpy.context.evaluated_depsgraph_get()
    meshes = {thing: bpy.data.meshes.new_from_object(thing.evaluated_get(graph), depsgraph=graph) for thing in moving}
    for thing, mesh in meshes.items():
        as_shape_keys(thing, mesh, candidates[thing], scene.frame_start)
    return [thing.name for thing in moving]


def changed(first: np.ndarray, other: np.ndarray) -> bool:
    """Return whether positions or number of vertices differ."""
    if first.shape != other.shape:
        return True
    return bool(len(first)) and float(np.abs(other - first).max()) > MOVED * float(np.ptp(first, axis=0).max())


def as_shape_keys(thing: Any, mesh: Any, shapes: list[np.ndarray], first: int) -> None:
    """Create one shape key per frame, linearly interpolated. Refused: too many frames."""
    if len(shapes) > MOST_SHAPES:
        raise Refused(
            f"the shape of '{thing.name}' changes for more than {MOST_SHAPES} frames",
            "a shorter part: --frames FIRST LAST",
        )
    thing.modifiers.clear()
    thing.data = mesh
    thing.shape_key_add(name="Basis", from_mix=False)
    for k in range(1, len(shapes)):
        block = thing.shape_key_add(name=f"frame {first + k}", from_mix=False)
        block.data.foreach_set("co", shapes[k].ravel())
        for frame, value in ((k - 1, 0.0), (k, 1.0), (k + 1, 0.0)):
            if frame < len(shapes):
                block.value = value
                block.keyframe_insert("value", frame=first + frame)
    for layer in mesh.shape_keys.animation_data.action.layers if len(shapes) > 1 else ():
        for curve in (c for strip in layer.strips for bag in strip.channelbags for c in bag.fcurves):
            for point in curve.keyframe_points:
                point.interpolation = "LINEAR"


def left_out(bpy: Any, things: list[Any]) -> list[str]:
    """Return lines about what glTF cannot represent."""
    lines = []
    for kind, words in UNKNOWN.items():
        if found := [thing for thing in things if thing.type == kind]:
            lines.append(f"glTF has no {words}; left out: {names(found)}")
    if lamps := [thing for thing in things if thing.type == "LIGHT" and thing.data.type == "AREA"]:
        lines.append(f"glTF has no area lights; left out: {names(lamps)}")
    if wide := [thing for thing in things if thing.type == "CAMERA" and thing.data.type == "PANO"]:
        lines.append(f"glTF has no panoramic cameras; left out: {names(wide)}")
    if hairy := [thing for thing in things if getattr(thing, "particle_systems", None)]:
        lines.append(f"particles and hair are left out: {names(hairy)}")
    used = {slot.material for thing in things for slot in thing.material_slots if slot.material is not None}
    if odd := sorted((m for m in used if not has_plain_colour(m)), key=lambda m: m.name):
        lines.append(
            f"materials without a plain colour or image look different (bake them in Blender): {names(odd, 8)}"
        )
    pictures = [i for i in bpy.data.images if i.source == "FILE" and not i.packed_file and i.users]
    if gone := [i for i in pictures if not os.path.isfile(bpy.path.abspath(i.filepath))]:
        lines.append(f"missing images: {names(gone)}")
    if libraries := [one for one in bpy.data.libraries if not os.path.isfile(bpy.path.abspath(one.filepath))]:
        lines.append(f"missing linked libraries: {names(libraries)}")
    return lines


def has_plain_colour(material: Any) -> bool:
    """Return whether the exporter supports the colour: that of a Principled or an emitting surface, or a picture's."""
    if not material.use_nodes:
        return True
    outputs = [node for node in material.node_tree.nodes if node.type == "OUTPUT_MATERIAL" and node.is_active_output]
    links = outputs[0].inputs["Surface"].links if outputs else ()
    if not links or links[0].from_node.type not in ("BSDF_PRINCIPLED", "EMISSION"):
        return False
    surface = links[0].from_node
    colour = surface.inputs["Base Color" if surface.type == "BSDF_PRINCIPLED" else "Color"]
    return not colour.links or colour.links[0].from_node.type in ("TEX_IMAGE", "VERTEX_COLOR", "RGB")


# --- the GLB ----------------------------------------------------------------------------------------------------------


def export(bpy: Any, out: Path, clips: bool) -> dict:
    """Write the GLB and return its JSON."""
    for part in ("object", "armature", "shapekeys"):  # the exporter's own limit of 1e-4 would remove slow motions
        import_module(f"io_scene_gltf2.blender.exp.animation.sampled.{part}.keyframes").fcurve_is_constant = is_constant
    bpy.ops.export_scene.gltf(
        filepath=str(out),
        export_format="GLB",
        use_active_scene=True,
        use_renderable=True,
        export_apply=True,
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
    if not out.is_file():
        raise Refused("Blender's exporter wrote nothing")
    with open(out, "rb") as file:
        head = file.read(20)
        return json.loads(file.read(struct.unpack("<I", head[12:16])[0]))


def is_constant(keyframes: list) -> bool:
    """Return whether all key frames of a channel are equal, except for the rounding of float32 matrices."""
    values = np.array([list(key.value) for key in keyframes], float)
    return bool((np.ptp(values, axis=0) <= CONSTANT * np.maximum(np.abs(values).max(axis=0), 1e-3)).all())


def counts(tree: dict) -> dict[str, int]:
    """Return the counts of the GLB's contents."""
    nodes, accessors = tree.get("nodes", []), tree.get("accessors", [])
    triangles = 0
    for node in nodes:
        for primitive in tree["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            which = primitive.get("indices", primitive["attributes"]["POSITION"])
            triangles += accessors[which]["count"] // 3 if primitive.get("mode", 4) == 4 else 0
    return {
        "meshes": sum("mesh" in node for node in nodes),
        "triangles": triangles,
        "skins": len(tree.get("skins", [])),
        "cameras": sum("camera" in node for node in nodes),
        "lights": sum("KHR_lights_punctual" in node.get("extensions", {}) for node in nodes),
        "materials": len(tree.get("materials", [])),
        "animations": len(tree.get("animations", [])),
    }


def run(bpy: Any, job: dict, out: Path, say: Any) -> dict:
    """Write ``out`` and return the report: blender, counts, left_out, cameras, camera, size, first, last, fps,
    duration_s."""
    say(doing="opening the file")
    open_file(bpy, Path(job["source"]), job["fps"])
    if job["scene"] is not None:
        if job["scene"] not in bpy.data.scenes:
            raise Refused(f"the file has no scene '{job['scene']}'", f"one of: {names(bpy.data.scenes, 20)}")
        bpy.context.window.scene = bpy.data.scenes[job["scene"]]
    scene = bpy.context.scene
    things = rendered(bpy)
    check(things)
    realize(bpy, things)
    clock = set_clock(scene, job["frames"], job["keys_per_frame"])
    say(doing="checking shapes")
    baked = bake_shapes(bpy, things)
    say(doing="writing the GLB")
    found = counts(export(bpy, out, job["clips"]))
    if not found["meshes"] and not any(thing.type == "ARMATURE" for thing in things):  # a clip for another's figure
        raise Refused("the scene has no surface", "a scene with a rendered mesh that has faces")
    cameras = [thing for thing in things if thing.type == "CAMERA" and thing.data.type != "PANO"]
    return {
        "blender": bpy.app.version_string,
        "counts": found | {"shapes baked frame by frame": len(baked)},
        "left_out": left_out(bpy, things),
        "cameras": [thing.name for thing in cameras],
        "camera": scene.camera.name if scene.camera in cameras else None,
        "size": [scene.render.resolution_x, scene.render.resolution_y],
        **clock,
    }


def main(folder: Path) -> int:
    """Return the exit status: 0, or 1 when a line reports an error."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # Blender and its libraries print to standard output from C
    sys.stdout = sys.stderr
    end_with_the_parent()

    def say(**words: object) -> None:
        answers.write(json.dumps(words) + "\n")

    try:
        import bpy
    except ImportError as problem:
        say(error=f"bpy cannot be imported by Python {sys.version_info.major}.{sys.version_info.minor}: {problem}")
        return 1
    job = json.loads((folder / "job.json").read_text())
    say(blender=bpy.app.version_string)
    try:
        say(report=run(bpy, job, folder / "scene.glb", say))
    except Refused as problem:
        say(error=problem.problem, where=job["shown"], accepted=problem.accepted)
        return 1
    except Exception as problem:  # noqa: BLE001 - one line for the user, whatever Blender makes of the file
        traceback.print_exc()
        text = " ".join(str(problem).split())[:300]
        say(error=f"Blender cannot import it ({type(problem).__name__}: {text})", where=job["shown"], accepted=None)
        return 1
    return 0


def end_with_the_parent() -> None:
    """End this process when its parent is killed (on Linux only; elsewhere it continues until it is done)."""
    try:
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    except (OSError, AttributeError):
        pass


if __name__ == "__main__":
    status = main(Path(sys.argv[1]))
    sys.stderr.flush()
    os._exit(status)  # not by Blender's own exit, which sometimes never returns
