"""Opens a file, exports it by Blender's exporter of glTF, and has baked what that cannot say. A part of convert.py."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from baking import FURTHEST, SEEN, Clock, Refused, Track, bake, keep_out, sample, write_keys
from glb import read, write
from rates import rate_of

Blender = Any  # bpy's objects have no types

MOST_FRAMES = 100_000
CONSTANT = 1e-7
ROUNDS = 3  # how often a scene is exported at most
# What the exporter takes for a material that is missing.
NO_MATERIAL = (
    None,
    {
        "uv_info": {},
        "udim_info": {},
        "vc_info": dict.fromkeys(("color", "alpha", "color_type", "alpha_type")) | {"alpha_mode": "OPAQUE"},
    },
)
UNKNOWN = {
    "VOLUME": "volumes", "POINTCLOUD": "point clouds", "CURVES": "hair", "GREASEPENCIL": "grease pencil",
}  # fmt: skip


def names(objs: Iterable[Blender], limit: int = 3) -> str:
    """Return 'a', 'b', 'c' and 4 more."""
    listed = [f"'{getattr(obj, 'name', obj)}'" for obj in objs]
    return ", ".join(listed[:limit]) + (f" and {len(listed) - limit} more" if len(listed) > limit else "")


def cause(problem: Exception) -> str:
    """Return the last line of an error that says something: operators put a traceback before, its place behind."""
    lines = [line.strip() for line in str(problem).splitlines() if line.strip()]
    message = [line for line in lines if not line.startswith(("Location:", "File ", "Error: Python", "Traceback", "^"))]
    return (message or ["no reason given"])[-1].removeprefix("Error: ")[:300]


# --- opening ----------------------------------------------------------------------------------------------------------


def libraries() -> Path:
    """Return the folder of Blender's own Python packages."""
    return Path(bpy.utils.resource_path("LOCAL"), "python", "lib", "python3.11", "site-packages")


def open_file(source: Path, fps: float | None) -> None:
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
    # The user's start-up file would add its own camera, light and cube.
    operators.read_factory_settings(use_empty=True)
    # Independent of the defaults: text blocks marked 'register' and drivers' expressions are never run.
    bpy.context.preferences.filepaths.use_scripts_auto_execute = False
    try:
        if ending == ".blend":
            operators.open_mainfile(filepath=str(source), load_ui=False, use_scripts=False)
        else:
            # Alembic's seconds become frames when it is read, and USD's codes are taken as frames.
            set_rate(bpy.context.scene, fps or rate_of(source, libraries()) or 24.0)
            if "FINISHED" not in openers.get(ending, usd)(str(source)):
                raise Refused(f"Blender cannot read it as {ending[1:].upper()}", "a whole file of that kind")
    except RuntimeError as problem:  # errors of operators
        raise Refused(f"Blender cannot read it ({cause(problem)})", "a whole file") from problem
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


def set_rate(scene: Blender, fps: float) -> None:
    """Set the frames per second, which Blender stores as a whole number over a divisor."""
    scene.render.fps = max(round(fps), 1)
    scene.render.fps_base = scene.render.fps / fps


def clock_of(frames: list[int] | None, per: int) -> Clock:
    """Return the scene's time, set to ``per`` key frames per frame. Refused: too many."""
    scene = bpy.context.scene
    first, last = frames or (scene.frame_start, scene.frame_end)
    if last < first or (last - first) * per > MOST_FRAMES:
        raise Refused(
            f"frames {first} to {last} with {per} keys each cannot be exported",
            f"--frames FIRST LAST, at most {MOST_FRAMES} keys, or fewer --keys-per-frame",
        )
    return Clock(first, last, per)


# --- what is rendered -------------------------------------------------------------------------------------------------


def rendered() -> tuple[list[Blender], list[str]]:
    """Return the objects of the view layer that Blender renders at some time, shown so that they are evaluated, and
    lines about others. Objects that the camera does not see are hidden."""
    objects, unseen, hidden = [], [], []
    shown = set(collections(bpy.context.view_layer.layer_collection))
    for obj in bpy.context.view_layer.objects:
        if obj.type in SEEN and obj.type != "CAMERA" and (obj.is_holdout or not obj.visible_camera):
            unseen.append(obj)
        elif shown.isdisjoint(collection.name for collection in obj.users_collection):
            hidden.append(obj)
        elif not obj.hide_render or obj.animation_data is not None:  # which may show it later
            obj.hide_viewport = False
            obj.hide_set(False)
            obj.show_instancer_for_viewport = obj.show_instancer_for_render
            objects.append(obj)
    for obj in unseen + hidden:
        obj.hide_render = True
    lines = [f"invisible to the camera, or cut out of the picture: {names(unseen)}"] if unseen else []
    return objects, lines + ([f"in collections that are not rendered: {names(hidden)}"] if hidden else [])


def collections(layer: Blender) -> Iterator[str]:
    """Yield the names of a layer's collections that are rendered."""
    if not (layer.exclude or layer.collection.hide_render or layer.holdout or layer.indirect_only):
        yield layer.collection.name
        for child in layer.children:
            yield from collections(child)


def realize(objs: list[Blender]) -> None:
    """Convert instances of geometry nodes to faces of the object itself, because the exporter leaves them out."""
    group = bpy.data.node_groups.new("Realize", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "GeometryNodeRealizeInstances", "NodeGroupOutput")
    start, real, end = (group.nodes.new(kind) for kind in kinds)
    group.links.new(start.outputs[0], real.inputs[0])
    group.links.new(real.outputs[0], end.inputs[0])
    for obj in objs:
        if any(m.type == "NODES" and m.show_viewport for m in obj.modifiers):
            obj.modifiers.new("Realize", "NODES").node_group = group


# --- what glTF cannot store -------------------------------------------------------------------------------------------


def left_out(objs: list[Blender], clock: Clock) -> list[str]:
    """Return lines about what glTF cannot represent."""
    scene, lines = clock.scene, []

    def say(problem: str, some: Iterable[Blender], limit: int = 3) -> None:
        if some := list(some):
            lines.append(f"{problem}: {names(some, limit)}")

    for kind, words in UNKNOWN.items():
        say(f"glTF has no {words}; left out", (obj for obj in objs if obj.type == kind))
    lamps = [obj for obj in objs if obj.type == "LIGHT"]
    say("glTF has no area lights; left out", (obj for obj in lamps if obj.data.type == "AREA"))
    say("lights with key frames shine as at their brightest", (lamp for lamp in lamps if lamp.data.animation_data))
    cameras = [obj for obj in objs if obj.type == "CAMERA"]
    others = (obj for obj in cameras if obj.data.type != "PERSP")
    say("orthographic and panoramic cameras are not drawn; left out", others)
    say("cameras with a keyed lens keep that of the first frame", (one for one in cameras if one.data.animation_data))
    say("the shift of the lens is left out", (one for one in cameras if one.data.shift_x or one.data.shift_y))
    # The file's own frames: the markers stand where the stretched time has them.
    cuts = sorted((frame, marker.camera.name) for marker, frame in clock.markers if marker.camera is not None)
    shown = [cut for cut in cuts if cut[0] <= clock.first][-1:]
    shown += [cut for cut in cuts if clock.first < cut[0] <= clock.last]
    if len(shown) > 1:
        shots = ", ".join(f"'{name}' from frame {frame}" for frame, name in shown[:8])
        lines.append(f"the scene cuts between cameras ({shots}): import one shot, --frames FIRST LAST")
    strands = ("OBJECT", "COLLECTION")
    say("particles and hair are left out", (
        obj for obj in objs if any(p.settings.render_type not in strands for p in obj.particle_systems)
    ))  # fmt: skip
    say("drivers that need Python are not run", (
        obj for obj in objs if obj.animation_data is not None
        and any(d.driver.type == "SCRIPTED" and not d.driver.is_simple_expression for d in obj.animation_data.drivers)
    ))  # fmt: skip
    used = {slot.material for obj in objs for slot in obj.material_slots if slot.material is not None}
    odd = sorted((m for m in used if not has_plain_colour(m)), key=lambda m: m.name)
    say("materials without a plain colour or image look different (bake them in Blender)", odd, 8)
    nodes = [
        (m, node.inputs["Alpha"]) for m in used if m.use_nodes for node in m.node_tree.nodes if "Alpha" in node.inputs
    ]
    clear = {m for m, alpha in nodes if not alpha.links and alpha.default_value == 0}
    say("materials with an alpha of 0 are invisible", sorted(clear, key=lambda m: m.name))
    pictures = [i for i in bpy.data.images if i.source == "FILE" and not i.packed_file and i.users]
    say("missing images", (i for i in pictures if not os.path.isfile(bpy.path.abspath(i.filepath))))
    missing = (one for one in bpy.data.libraries if not os.path.isfile(bpy.path.abspath(one.filepath)))
    say("missing linked libraries", (one.filepath for one in missing))
    render, world = scene.render, scene.world
    if render.pixel_aspect_x != render.pixel_aspect_y:
        aspect = f"{render.pixel_aspect_x:g} : {render.pixel_aspect_y:g}"
        lines.append(f"pixels are square: their aspect of {aspect} is left out")
    if world is not None and shines(world):
        lines.append(
            f"the light of the world '{world.name}' is left out (declare scene.light.sky or light.environment)"
        )
    if scene.unit_settings.scale_length != 1:
        lines.append(
            f"a unit of the scene is {scene.unit_settings.scale_length:g} m, in the GLB it is 1 m (scale it in Blender)"
        )
    if clock.simulated:
        lines.append("simulations are computed at whole frames: between them motion is straight")
    return lines


def shines(world: Blender) -> bool:
    """Return whether a world is not black."""
    if not world.use_nodes:
        return any(world.color)
    inputs = [node.inputs for node in world.node_tree.nodes if node.type == "BACKGROUND"]
    return any(c.links or s.links or (s.default_value and any(c.default_value[:3])) for c, s, *_ in inputs)


def has_plain_colour(material: Blender) -> bool:
    """Return whether the exporter supports the colour: that of a Principled or an emitting surface, or a still
    picture's in the coordinates of the mesh."""
    nodes = material.node_tree.nodes if material.use_nodes else ()
    outputs = [node for node in nodes if node.type == "OUTPUT_MATERIAL" and node.is_active_output]
    links = outputs[0].inputs["Surface"].links if outputs else ()
    if not links or links[0].from_node.type not in ("BSDF_PRINCIPLED", "EMISSION"):
        return not material.use_nodes
    surface = links[0].from_node
    colour = surface.inputs["Base Color" if surface.type == "BSDF_PRINCIPLED" else "Color"]
    paint = colour.links[0].from_node if colour.links else None
    # A plain colour, unless its nodes are animated.
    if paint is None or paint.type in ("VERTEX_COLOR", "RGB"):
        return material.node_tree.animation_data is None
    if paint.type != "TEX_IMAGE" or paint.projection != "FLAT":
        return False
    where = paint.inputs["Vector"].links
    # Mappings become KHR_texture_transform.
    while where and where[0].from_node.type == "MAPPING":
        where = where[0].from_node.inputs["Vector"].links
    # The exporter writes a picture's numbers, which glTF takes as sRGB.
    image = paint.image
    still = image is None or (image.source in ("FILE", "GENERATED") and image.colorspace_settings.name == "sRGB")
    return still and (not where or where[0].from_socket.name == "UV")


# --- the GLB ----------------------------------------------------------------------------------------------------------


def forgive(module: str, function: str, instead: Blender, failed: dict[str, str]) -> None:
    """Let one of the exporter's functions return ``instead`` where it raises, and store the name of its first
    argument."""
    place = import_module(f"io_scene_gltf2.blender.exp.{module}")
    whole = getattr(place, function)

    def careful(what: Blender, *others: Blender, **more: Blender) -> Blender:
        try:
            return whole(what, *others, **more)
        except Exception as problem:  # noqa: BLE001 - one bad material or mesh, named, does not cost the scene
            failed[what.name] = cause(problem)
            return instead

    setattr(place, function, careful)


def export(clock: Clock, out: Path, clips: bool, tracks: list[Track]) -> dict[str, int]:
    """Write the GLB, with the key frames of what is baked, and return what it has."""
    for part in ("object", "armature", "shapekeys"):  # the exporter's own limit of 1e-4 would remove slow motions
        import_module(f"io_scene_gltf2.blender.exp.animation.sampled.{part}.keyframes").fcurve_is_constant = is_constant
    out.unlink(missing_ok=True)
    clock.go(clock.here)  # its pose becomes the nodes' rest
    render, base = clock.scene.render, clock.scene.render.fps_base
    render.fps_base = clock.per / base  # the exporter divides frames by fps times base, where Blender has fps over base
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
    render.fps_base = base
    if not out.is_file():
        raise Refused("Blender's exporter wrote nothing")
    tree, binary = read(out)
    if tracks:
        write_keys(tracks, tree, binary)
        write(out, tree, binary)
    return counts(tree)


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
            # Without indices the vertices' order gives the triangles. Mode 4: separate triangles.
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


def steady(clock: Clock, objs: list[Blender]) -> None:
    """Give lights with key frames the greatest energy that they have at nine times."""
    keyed = [obj for obj in objs if obj.type == "LIGHT" and obj.data.animation_data is not None]
    # glTF's lights are constant: the brightest of nine times stands for the whole.
    best = dict.fromkeys(keyed, (0.0, 1.0, 1.0, 1.0))
    for k in range(9 if keyed else 0):
        clock.go(clock.first + k * (clock.last - clock.first) / 8)
        for obj in keyed:
            data = obj.evaluated_get(clock.graph).data
            best[obj] = max(best[obj], (data.energy, *data.color))
    for obj, (energy, *colour) in best.items():
        obj.data.animation_data_clear()
        obj.data.energy, obj.data.color = energy, colour


def written(
    job: dict, out: Path, say: Callable[..., None], clock: Clock, broken: set[str], owners: dict, figures: bool
) -> tuple[dict[str, int], list[Track], dict[str, str]]:
    """Write ``out`` until it plays as Blender shows it: what differs is baked, and more of it at each round. Return the
    counts of the file, the baked tracks, and why others are not baked."""
    tracks: list[Track] = []
    tried, reasons = set(broken), {}
    for number in range(ROUNDS):
        say(doing="writing the GLB")
        exported = export(clock, out, job["clips"], tracks)
        if not exported["meshes"] and not figures:  # a clip for another's figure
            raise Refused("the scene has no surface", "a scene with a rendered mesh that has faces")
        if job["clips"] or not owners:
            break
        say(compare=clock.per, finest=clock.finest())
        verdict = json.loads(sys.stdin.readline())
        differ = {owner for name in verdict["differs"] for owner in owners.get(name, {name})} - tried
        denser = verdict["denser"]
        if number == ROUNDS - 1 or not (differ or denser > 1):
            break
        clock.stretch(clock.per * denser)
        say(doing=f"baking {len(differ)} objects")
        room = 1e6 * job["bake_mb"] - sum(track.size for track in tracks)
        more, why = bake(clock, differ, room)
        tracks, reasons, tried = tracks + more, reasons | why, tried | differ
        if denser == 1 and tried == broken | why.keys():
            break
    return exported, tracks, reasons


def run(job: dict, out: Path, say: Callable[..., None]) -> dict:
    """Write ``out`` and return the report, for the fields of :class:`blinkgl.blender.importing.Imported`."""
    say(doing="opening the file")
    open_file(Path(job["source"]), job["fps"])
    if job["scene"] is not None:
        if job["scene"] not in bpy.data.scenes:
            raise Refused(f"the file has no scene '{job['scene']}'", f"one of: {names(bpy.data.scenes, 20)}")
        bpy.context.window.scene = bpy.data.scenes[job["scene"]]
        if job["fps"] is not None:  # the scene that the file shows has it already
            set_rate(bpy.context.scene, job["fps"])
    scene = bpy.context.scene
    objs, lines = rendered()
    if (
        job["fps"] is None
        and job["source"].lower().endswith((".usd", ".usdc", ".usdz"))
        and not rate_of(Path(job["source"]), libraries())
    ):
        lines.append("its time codes per second cannot be read: 24 are assumed (--fps declares others)")
    realize(objs)
    clock = clock_of(job["frames"], job["keys_per_frame"])
    say(doing="evaluating the scene")
    broken, owners = sample(clock, out.with_name("seen.npz"))
    keep_out(clock, broken)
    if broken:
        lines.append(f"left out, further away than {FURTHEST:g} or no number: {names(sorted(broken))}")
    lines += left_out(objs, clock)
    steady(clock, objs)
    for picture in [picture for picture in bpy.data.images if picture.source == "TILED"]:
        bpy.data.images.remove(picture)  # the exporter stops at it
    failed: dict[str, str] = {}
    for place, what, instead in (("material.materials", "gather_material", NO_MATERIAL), ("mesh", "gather_mesh", None)):
        forgive(place, what, instead, failed)
    figures = any(obj.type == "ARMATURE" for obj in objs)
    exported, tracks, reasons = written(job, out, say, clock, set(broken), owners, figures)
    lines += [f"'{name}' cannot be exported, it is left out or plain ({why})" for name, why in sorted(failed.items())]
    cameras = [obj for obj in objs if obj.type == "CAMERA" and obj.data.type == "PERSP"]
    scene.frame_set(scene.frame_start)
    active = scene.camera if scene.camera in cameras else None
    return {
        "blender": bpy.app.version_string,
        "counts": exported,
        "left_out": lines,
        "cameras": [obj.name for obj in cameras],
        "camera": active and active.name,
        "size": [scene.render.resolution_x, scene.render.resolution_y],
        "frames": [clock.first, clock.last],
        "fps": clock.fps,
        "keys_per_frame": clock.per,
        "duration_s": clock.seconds(clock.last),
        "baked": sorted({track.name for track in tracks}),
        "baked_mb": sum(track.size for track in tracks) / 1e6,
        "unbaked": reasons,
    }
