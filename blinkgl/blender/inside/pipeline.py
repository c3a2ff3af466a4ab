"""The import, step by step. Start here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy
import colours
import exporting
import kept
import opening
import survey
from said import Refused, Table

import motion
import shapes


def run(job: dict, out: Path, doing: Callable[[str], None]) -> dict:
    """Writes ``out``; the report: blender, rows, cameras, camera, size, first, last, fps, duration_s."""
    doing("opening the file")
    opening.open_file(Path(job["source"]), job["fps"])
    scene = motion.choose_scene(job["scene"])
    view_layer = bpy.context.view_layer
    table = Table()
    things = kept.in_picture(view_layer)
    everything = things + [o for o in kept.instanced(things) if o not in things]
    survey.survey(scene, things, everything, table)
    # Armatures alone are a clip for a figure of another file, as Mixamo sends them without skin.
    clip = any(o.type == "ARMATURE" for o in everything) and bool(bpy.data.actions)
    if not clip and not any(o.type in kept.MESH_LIKE or o.is_instancer for o in everything):
        raise Refused("the scene shows no shape", accepted="a scene with a mesh that is rendered")
    kept.make_visible(view_layer, things)

    doing("looking at its motion")
    shapes.stop_simulations(everything, table)
    clock = motion.set_clock(scene, job["frames"], job["keys_per_frame"])
    gone = motion.without_extent([o for o in things if o.type in kept.MESH_LIKE], clock, table)
    scene.frame_set(clock.first)

    doing("making meshes")
    made = shapes.even_offsets(everything)
    meshes = shapes.meshes_of_others(everything, table)
    more, unseen = shapes.instances_as_objects(everything, meshes, table)
    made += [*meshes.values(), *more]
    twins = shapes.twins(everything)
    shapes.apply_modifiers(everything, table)
    scene.frame_set(clock.first)
    moving = shapes.compare(twins, clock.some(5), table)
    if moving:
        doing("baking vertex animations")
        shapes.bake(moving, twins, clock.all(), table)
    shapes.remove(twins)
    scene.frame_set(clock.first)

    baking = colours.Baking(job["bake"]["size"], job["bake"]["seconds"], table)
    colours.make_plain(everything + made, baking, doing)
    scene.frame_set(clock.first)

    doing("writing the GLB")
    if job["clips"]:
        motion.offer_clips(table)
    exporting.export(out, things, everything, made, unseen | gone, job["clips"], table)
    cameras = [o for o in things if o.type == "CAMERA"]
    return {
        "blender": bpy.app.version_string,
        "rows": table.listed(),
        "cameras": [o.name for o in cameras if o.data.type != "PANO"],
        "camera": scene.camera.name if scene.camera in cameras else None,
        "size": [scene.render.resolution_x, scene.render.resolution_y],
        **clock.said(),
    }
