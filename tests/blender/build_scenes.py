"""Scenes for the tests, built and evaluated by Blender: run by the interpreter that has bpy.

    python build_scenes.py FOLDER        FOLDER/NAME.blend (or another ending), FOLDER/NAME.npz with what Blender sees

NAME.npz: "OBJECT@FRAME" (V, 3) float64 vertices in the world, "OBJECT@FRAME" (4, 4) of cameras, "all@FRAME" (V, 3) of
everything that is shown, instances too. It imports nothing of BlinkGL.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy
import numpy as np

FOLDER = Path(sys.argv[1])
MESH_LIKE = ("MESH", "CURVE", "FONT", "META", "SURFACE")


def fresh(frames: int = 24, fps: int = 24):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.render.fps = 1, frames, fps
    return scene


def linked(thing):
    bpy.context.scene.collection.objects.link(thing)
    return thing


def keyed(thing, path: str, *values, frames=(1, 24)):
    for frame, value in zip(frames, values):
        setattr(thing, path, value)
        thing.keyframe_insert(path, frame=frame)


def cube(name: str, place=(0, 0, 0), size: float = 1.0):
    bpy.ops.mesh.primitive_cube_add(size=size, location=place)
    bpy.context.object.name = bpy.context.object.data.name = name
    return bpy.context.object


def grid(name: str, number: int, size: float = 2.0):
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=number, y_subdivisions=number, size=size)
    bpy.context.object.name = bpy.context.object.data.name = name
    return bpy.context.object


def material(name: str, **inputs):
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    for key, value in inputs.items():
        made.node_tree.nodes["Principled BSDF"].inputs[key.replace("_", " ")].default_value = value
    return made, made.node_tree


def save(name: str) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(FOLDER / f"{name}.blend"))


# --------------------------------------------------------------------------------------------------------------- truth


def vertices(shown, matrix) -> np.ndarray:
    mesh = shown.to_mesh()
    found = np.empty((0 if mesh is None else len(mesh.vertices), 3), np.float32)
    if mesh is not None:
        mesh.vertices.foreach_get("co", found.ravel())
    faces = mesh is not None and len(mesh.polygons)
    shown.to_mesh_clear()
    T = np.array(matrix, float)
    return found.astype(float) @ T[:3, :3].T + T[:3, 3] if faces else np.zeros((0, 3))


def truth(name: str, objects=(), cameras=(), everything: bool = False, per: int = 1) -> None:
    if (FOLDER / f"{name}.blend").exists():
        bpy.ops.wm.open_mainfile(filepath=str(FOLDER / f"{name}.blend"))
    scene, found = bpy.context.scene, {}
    for k in range((scene.frame_end - scene.frame_start) * per + 1):
        frame = scene.frame_start + k / per if per > 1 else scene.frame_start + k
        scene.frame_set(int(frame), subframe=frame - int(frame))
        graph, at = bpy.context.evaluated_depsgraph_get(), f"@{frame}"
        for thing in objects:
            shown = bpy.data.objects[thing].evaluated_get(graph)
            found[thing + at] = vertices(shown, shown.matrix_world)
        for camera in cameras:
            found[camera + at] = np.array(bpy.data.objects[camera].evaluated_get(graph).matrix_world, float)
        if everything:
            parts = []
            for i in graph.object_instances:
                original, seen = i.object.original, i.show_self and not i.particle_system
                itself = i.is_instance and i.parent.type in ("FONT", "CURVE")  # its mesh, which is the curve
                if i.object.hide_render or itself or (not i.is_instance and not original.show_instancer_for_render):
                    seen = False
                if seen and i.object.type in MESH_LIKE:
                    parts.append(vertices(i.object, i.matrix_world))
            found["all" + at] = np.concatenate(parts)
    np.savez(FOLDER / f"{name}.npz", **found)


# -------------------------------------------------------------------------------------------------------------- scenes


def rig(prefix: str = ""):
    """An armature of two bones with a column of seven rings that follows them."""
    bones = bpy.data.armatures.new("Rig")
    armature = linked(bpy.data.objects.new("Rig", bones))
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    lower, upper = bones.edit_bones.new(prefix + "lower"), bones.edit_bones.new(prefix + "upper")
    lower.head, lower.tail, upper.head, upper.tail = (0, 0, 0), (0, 0, 1), (0, 0, 1), (0, 0, 2)
    upper.parent = lower
    bpy.ops.object.mode_set(mode="OBJECT")
    rings, corners, faces = 6, [], []
    for k in range(rings + 1):
        z = 2 * k / rings
        corners += [(-0.2, -0.2, z), (0.2, -0.25, z), (0.2, 0.2, z), (-0.2, 0.2, z + 0.01)]
    for k in range(rings):
        for j in range(4):
            faces.append((4 * k + j, 4 * k + (j + 1) % 4, 4 * k + 4 + (j + 1) % 4, 4 * k + 4 + j))
    mesh = bpy.data.meshes.new("Column")
    mesh.from_pydata(corners, [], faces)
    column = linked(bpy.data.objects.new("Column", mesh))
    groups = [column.vertex_groups.new(name=bone.name) for bone in bones.bones]
    for k, corner in enumerate(mesh.vertices):
        share = min(max(corner.co.z - 0.5, 0.0), 1.0)
        groups[1].add([k], share, "REPLACE")
        groups[0].add([k], 1 - share, "REPLACE")
    bend = armature.pose.bones[prefix + "upper"]
    bend.rotation_mode = "XYZ"
    keyed(bend, "rotation_euler", (0, 0, 0), (0.9, 0.2, 0.3))
    keyed(armature, "location", (0, 0, 0.1), (1, 0, 0.3))
    return armature, column


def skin(column, armature) -> None:
    column.parent = armature
    column.modifiers.new("Armature", "ARMATURE").object = armature


def dancer() -> None:
    """Armature with a shape key, array, subdivision, animated camera, lights, a node material."""
    scene = fresh()
    armature, column = rig()
    column.shape_key_add(name="Basis")
    bulge = column.shape_key_add(name="bulge")
    for point in bulge.data:
        point.co.x *= 1 + 0.8 * math.sin(1.5 * point.co.z)
    keyed(bulge, "value", 0.0, 1.0)
    skin(column, armature)
    row = cube("Row", (0, 6, 0))
    row.modifiers.new("Subdivision", "SUBSURF").levels = 1
    array = row.modifiers.new("Array", "ARRAY")
    array.count, array.relative_offset_displace = 2, (0, 1.5, 0)
    checks, tree = material("Checks")
    pattern = tree.nodes.new("ShaderNodeTexChecker")
    pattern.inputs["Color1"].default_value, pattern.inputs["Color2"].default_value = (0.8, 0, 0, 1), (0, 0, 0.8, 1)
    tree.links.new(pattern.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    column.data.materials.append(checks)
    bpy.ops.mesh.primitive_plane_add(size=10)
    bpy.context.object.name = "Ground"
    bpy.context.object.data.materials.append(material("Plain", Base_Color=(0.2, 0.5, 0.1, 1))[0])
    camera = linked(bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye")))
    scene.camera = camera
    keyed(camera, "location", (6, -4, 2), (5, -5, 3))
    keyed(camera, "rotation_euler", (1.3, 0, 1.0), (1.1, 0, 0.8))
    for kind in ("SUN", "POINT", "AREA"):
        linked(bpy.data.objects.new(kind, bpy.data.lights.new(kind, kind))).location = (0, 0, 4)
    save("dancer")
    truth("dancer", ["Column", "Ground", "Row"], ["Eye"])


def mixamo() -> None:
    """A character as Mixamo sends one: FBX, bones named mixamorig:*, a hundred times too large and scaled back."""
    fresh(20, 30)
    armature, column = rig("mixamorig:")
    armature.scale = (0.01, 0.01, 0.01)
    armature.animation_data.action.layers[0].strips[0].channelbags[0].fcurves.clear()
    keyed(armature.pose.bones["mixamorig:upper"], "rotation_euler", (0, 0, 0), (0.9, 0.2, 0.3), frames=(1, 20))
    armature.location = (0, 0, 0)
    skin(column, armature)
    bpy.context.view_layer.update()
    truth("mixamo", ["Column"])
    plain = {"bake_anim_use_all_actions": False, "bake_anim_use_nla_strips": False, "bake_anim_simplify_factor": 0.0}
    bpy.ops.export_scene.fbx(filepath=str(FOLDER / "mixamo.fbx"), **plain)


def formats() -> None:
    """What other formats keep: a moving box, a bending column, under a camera."""
    scene = fresh()
    armature, column = rig()
    skin(column, armature)
    keyed(cube("Box", (3, 0, 0)), "location", (3, 0, 0), (3, 2, 1))
    camera = linked(bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye")))
    camera.location, camera.rotation_euler, scene.camera = (6, -4, 2), (1.3, 0, 1.0), camera
    truth("formats", ["Column", "Box"])
    bpy.ops.wm.usd_export(filepath=str(FOLDER / "formats.usdc"), export_animation=True)
    bpy.ops.wm.alembic_export(filepath=str(FOLDER / "formats.abc"), as_background_job=False)


def world() -> None:
    """Everything that moves, multiplies or is no mesh, and nothing that is simulated freely."""
    scene = fresh(12)
    wavy = grid("Wavy", 8)
    wavy.location = (0, 20, 0)
    wavy.modifiers.new("Wave", "WAVE").height = 0.3
    late = cube("Late", (0, 5, 0))
    late.modifiers.new("Bevel", "BEVEL").width = 0.1
    cutter = cube("Cutter", (0.4, 5.4, 0.4))
    cutter.hide_render = True
    boolean = late.modifiers.new("Boolean", "BOOLEAN")
    boolean.object = cutter
    # Along a curve, looked at by a camera; a driver, and a child of what it drives.
    path = bpy.data.curves.new("Path", "CURVE")
    path.dimensions = "3D"
    points = path.splines.new("BEZIER").bezier_points
    points.add(1)
    for point, place in zip(points, ((0, 0, 0), (4, 1, 1))):
        point.co, point.handle_left_type, point.handle_right_type = place, "AUTO", "AUTO"
    curve = linked(bpy.data.objects.new("Path", path))
    follower = cube("Follower", size=0.3)
    bond = follower.constraints.new("FOLLOW_PATH")
    bond.target, bond.use_fixed_location = curve, True
    keyed(bond, "offset_factor", 0.0, 1.0, frames=(1, 12))
    camera = linked(bpy.data.objects.new("Cam", bpy.data.cameras.new("Cam")))
    camera.location, scene.camera = (2, -8, 3), camera
    look = camera.constraints.new("TRACK_TO")
    look.target, look.track_axis, look.up_axis = follower, "TRACK_NEGATIVE_Z", "UP_Y"
    driven = cube("Driven", (0, 3, 0))
    driven.driver_add("location", 2).driver.expression = "frame*0.1"
    child = cube("Child", (0, 1, 0))
    child.parent = driven
    # Instances: of a collection, of geometry nodes.
    tree = bpy.data.collections.new("Tree")
    trunk = cube("Trunk", (1, 0, 0))
    keyed(trunk, "rotation_euler", (0, 0, 0), (0, 0, 1.5), frames=(1, 12))
    scene.collection.objects.unlink(trunk)
    tree.objects.link(trunk)
    for k in range(2):
        one = linked(bpy.data.objects.new(f"Tree {k}", None))
        one.instance_type, one.instance_collection = "COLLECTION", tree
        one.location, one.rotation_euler = (-5, 3 * k, 0), (0, 0, 0.5 * k)
    keyed(one, "location", (-5, 6, 0), (-5, 6, 3), frames=(1, 12))
    scatter = grid("Scatter", 3)
    scatter.location = (-8, -8, 0)
    nodes = bpy.data.node_groups.new("Scatter", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        nodes.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    start, end = nodes.nodes.new("NodeGroupInput"), nodes.nodes.new("NodeGroupOutput")
    on, ball = nodes.nodes.new("GeometryNodeInstanceOnPoints"), nodes.nodes.new("GeometryNodeMeshIcoSphere")
    both = nodes.nodes.new("GeometryNodeJoinGeometry")
    for a, b in (
        (start.outputs[0], on.inputs["Points"]),
        (ball.outputs["Mesh"], on.inputs["Instance"]),
        (on.outputs[0], both.inputs[0]),
        (start.outputs[0], both.inputs[0]),
        (both.outputs[0], end.inputs[0]),
    ):
        nodes.links.new(a, b)
    scatter.modifiers.new("Nodes", "NODES").node_group = nodes
    # No meshes.
    bpy.ops.object.text_add(location=(12, 4, 0))
    bpy.context.object.data.extrude = 0.1
    bpy.ops.curve.primitive_bezier_circle_add(location=(12, 8, 0))
    bpy.context.object.data.bevel_depth = 0.1
    # A body that falls.
    bpy.ops.rigidbody.world_add()
    cube("Falls", (20, 0, 4))
    bpy.ops.rigidbody.object_add()
    save("world")
    truth("world", cameras=["Cam"], everything=True)


def left_out() -> None:
    """What glTF has no words for, and what is hidden."""
    fresh(8)
    cube("Plain")
    hairy = grid("Hairy", 2)
    hairy.modifiers.new("Hair", "PARTICLE_SYSTEM")
    hairy.particle_systems[0].settings.type = "HAIR"
    linked(bpy.data.objects.new("Smoke", bpy.data.volumes.new("Smoke")))
    bpy.ops.object.metaball_add(type="BALL", location=(12, 0, 0))
    cube("Hidden", (0, 9, 0)).hide_render = True
    linked(bpy.data.objects.new("Panel", bpy.data.lights.new("Panel", "AREA"))).location = (0, 0, 3)
    fish = linked(bpy.data.objects.new("Fish", bpy.data.cameras.new("Fish")))
    fish.data.type = "PANO"
    save("left_out")


def unsaid() -> None:
    """Motion that the exporter of glTF has no words for, or not between frames; at 30/1.001 frames per second."""
    scene = fresh(8, 30)
    scene.render.fps_base = 1.001
    grid("Thick", 2).modifiers.new("Solidify", "SOLIDIFY").thickness = 0.1
    thick = bpy.context.object.modifiers[0]
    keyed(thick, "thickness", 0.1, 1.0, frames=(1, 8))
    both = cube("Both", (3, 0, 0))
    both.shape_key_add(name="Basis")
    for point in both.shape_key_add(name="wide").data:
        point.co.x *= 3
    both.modifiers.new("Bevel", "BEVEL").width = 0.1
    keyed(both.data.shape_keys, "eval_time", 0.0, 10.0, frames=(1, 8))
    both.data.shape_keys.use_relative = False
    armature, column = rig()
    column.location = (0, 3, 0)
    second = armature.copy()
    second.animation_data_clear()
    linked(second)
    keyed(second.pose.bones["lower"], "location", (0, 0, 0), (1, 0, 0), frames=(1, 8))
    for bones in (armature, second):
        column.modifiers.new("Armature", "ARMATURE").object = bones
    spin = cube("Spin", (6, 0, 0))
    spin.scale = (1, 0.2, 0.1)
    keyed(spin, "rotation_euler", (0, 0, 0), (0, 0, 7 * math.radians(250)), frames=(1, 8))
    comes = cube("Comes", (9, 0, 0))
    keyed(comes, "hide_render", True, False, frames=(1, 5))
    tree = bpy.data.collections.new("Tree")
    trunk = cube("Trunk", (1, 0, 0))
    keyed(trunk, "location", (1, 0, 0), (1, 0, 2), frames=(1, 8))
    scene.collection.objects.unlink(trunk)
    tree.objects.link(trunk)
    tree.instance_offset = (0.5, 0.25, 0)
    for k in range(2):
        one = linked(bpy.data.objects.new(f"Tree {k}", None))
        one.instance_type, one.instance_collection, one.location = "COLLECTION", tree, (-5, 3 * k, 0)
    spots, seed = grid("Spots", 2), cube("Seed", size=0.2)
    spots.location, seed.parent, spots.instance_type = (0, -5, 0), spots, "VERTS"
    bpy.ops.curve.primitive_bezier_circle_add(location=(12, 4, 0))
    ring = bpy.context.object
    ring.name, ring.data.resolution_u, ring.data.bevel_resolution = "Ring", 2, 0
    keyed(ring.data, "bevel_depth", 0.1, 0.5, frames=(1, 8))
    camera = linked(bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye")))
    keyed(camera, "rotation_euler", (1.3, 0, 1.0), (1.1, 0, 0), frames=(1, 8))
    scene.camera = camera
    save("unsaid")
    truth("unsaid", cameras=["Eye"], everything=True, per=2)


def named() -> None:
    """What cannot be baked, what is broken, and what glTF does not keep."""
    scene = fresh(8)
    scene.unit_settings.scale_length = 0.01
    build = cube("Builds").modifiers.new("Build", "BUILD")
    build.frame_start, build.frame_duration = -4, 10
    grid("Large", 60).modifiers.new("Wave", "WAVE")
    keyed(cube("Gone"), "location", (0, 0, 0), (1e20, 0, 0), frames=(1, 8))
    cube("Shadow").visible_camera = False
    cube("Away").users_collection[0].objects.unlink(bpy.context.object)
    away = bpy.data.collections.new("Away")
    away.objects.link(bpy.data.objects["Away"])
    scene.collection.children.link(away)
    away.hide_render = True
    for name in ("Empty", "Tiles"):
        made, tree = material(name)
        cube(name).data.materials.append(made)
        node = tree.nodes.new("ShaderNodeGroup" if name == "Empty" else "ShaderNodeTexImage")
        if name == "Empty":
            node.node_tree = bpy.data.node_groups.new("Empty", "ShaderNodeTree")
            node.node_tree.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
        else:
            node.image = bpy.data.images.new("Tiles", 8, 8, tiled=True)
        tree.links.new(node.outputs[0], tree.nodes["Principled BSDF"].inputs["Base Color"])
    lamp = linked(bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "SUN")))
    keyed(lamp.data, "energy", 0.0, 8.0, frames=(1, 8))
    for k, name in enumerate(("Left", "Right")):
        camera = linked(bpy.data.objects.new(name, bpy.data.cameras.new(name)))
        camera.data.shift_x = 0.1 * k
        scene.timeline_markers.new(name, frame=1 + 3 * k).camera = camera
    keyed(camera.data, "lens", 20.0, 80.0, frames=(1, 8))
    cube("Python").driver_add("location", 0).driver.expression = "str(frame) and 1"
    save("named")


def paints() -> None:
    """A colour, a picture, light of its own, and a pattern."""
    fresh()
    picture = bpy.data.images.new("stripes", 64, 64)
    texels = np.ones((64, 64, 4), np.float32)
    texels[..., 0], texels[..., 1], texels[..., 2] = np.arange(64) / 63, 0.2, 0.4
    picture.pixels.foreach_set(texels.ravel())
    picture.file_format, picture.filepath_raw = "PNG", str(FOLDER / "stripes.png")
    picture.save()
    picture.source = "FILE"
    made = {"Plain": material("Plain", Base_Color=(0.8, 0.1, 0.1, 1))[0]}
    made["Picture"], tree = material("Picture")
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = picture
    tree.links.new(node.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    made["Glow"], tree = material("Glow")
    glow, out = tree.nodes.new("ShaderNodeEmission"), tree.nodes["Material Output"]
    glow.inputs["Color"].default_value = (0.1, 0.9, 0.1, 1)
    tree.links.new(glow.outputs[0], out.inputs["Surface"])
    made["Pattern"], tree = material("Pattern")
    checker = tree.nodes.new("ShaderNodeTexChecker")
    tree.links.new(checker.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    for k, (name, paint) in enumerate(made.items()):
        cube(name, (2 * k, 0, 0)).data.materials.append(paint)
    save("paints")


def evil() -> None:
    """Two scripts that write a file, a driver with a formula that needs no Python, and a thing to see. That they do
    write where scripts are allowed is tried here."""
    fresh()
    marks = [FOLDER / "PWNED.text", FOLDER / "PWNED.driver"]
    text = bpy.data.texts.new("evil.py")
    text.write(f"open({str(marks[0])!r}, 'w').write('text')")
    text.use_module = True
    thing = cube("Thing")
    thing.driver_add("location", 1).driver.expression = "frame / 10"
    thing.driver_add("location", 0).driver.expression = f"bpy.data.libraries.write({str(marks[1])!r}, {{*()}}) or 1"
    save("evil")
    bpy.ops.wm.open_mainfile(filepath=str(FOLDER / "evil.blend"), use_scripts=True)
    bpy.context.scene.frame_set(3)
    (FOLDER / "control.txt").write_text(" ".join(mark.name for mark in marks if mark.exists()))
    for mark in marks:
        mark.unlink(missing_ok=True)


def rates() -> None:
    """A box at x = 2 t, by clocks of 60 and 30 frames a second, in formats whose rate Blender does not read."""
    for rate in (60, 30):
        fresh(1 + rate, rate)
        box = cube("Box")
        keyed(box, "location", (0, 0, 0), (2, 0, 0), frames=(1, 1 + rate))
        for curve in box.animation_data.action.fcurves:
            for key in curve.keyframe_points:
                key.interpolation = "LINEAR"
        for ending in ("usda", "usdc"):
            bpy.ops.wm.usd_export(filepath=str(FOLDER / f"rate{rate}.{ending}"), export_animation=True)
        bpy.ops.wm.alembic_export(filepath=str(FOLDER / f"rate{rate}.abc"), as_background_job=False)


def doors() -> None:
    """What the door of scenes does not draw: an orthographic camera, a world, pixels of two to one, a Non-Color base
    colour; and a spot of blend 0, which it does."""
    scene = fresh()
    painted = cube("Painted")
    made, tree = material("Data")
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = bpy.data.images.new("grey", 4, 4)
    node.image.colorspace_settings.name = "Non-Color"
    tree.links.new(node.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    painted.data.materials.append(made)
    for name, kind in (("Eye", "PERSP"), ("Plan", "ORTHO")):
        camera = linked(bpy.data.objects.new(name, bpy.data.cameras.new(name)))
        camera.data.type, camera.location = kind, (0, 0, 5)
        scene.camera = camera
    lamp = linked(bpy.data.objects.new("Spot", bpy.data.lights.new("Spot", "SPOT")))
    lamp.data.spot_blend, lamp.location = 0.0, (0, 0, 4)
    scene.render.pixel_aspect_x = 2.0
    scene.world = bpy.data.worlds.new("Evening")
    scene.world.use_nodes = True
    save("doors")


def odd() -> None:
    """Files that are refused."""
    fresh()
    save("empty")
    linked(bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT")))
    cube("Hidden").hide_render = True
    save("nothing_shown")
    whole = (FOLDER / "evil.blend").read_bytes()
    (FOLDER / "no_blender.blend").write_bytes(b"PK\x03\x04" + bytes(500))
    (FOLDER / "future.blend").write_bytes(whole.replace(b"BLENDER-v405", b"BLENDER-v999", 1))
    (FOLDER / "short.blend").write_bytes(whole[: len(whole) // 3])
    for ending in ("fbx", "usdc", "dae", "abc"):
        (FOLDER / f"garbage.{ending}").write_bytes(bytes(range(256)) * 8)


if __name__ == "__main__":
    for build in (dancer, mixamo, formats, world, left_out, unsaid, named, paints, evil, rates, doors, odd):
        build()
