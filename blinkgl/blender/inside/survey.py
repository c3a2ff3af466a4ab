"""What is in the file, and what glTF or BlinkGL has no place for, before anything is changed."""

from __future__ import annotations

import bpy
from kept import MESH_LIKE
from said import Table, names

_LEFT_OUT = {
    "VOLUME": "volumes",
    "CURVES": "hair curves",
    "POINTCLOUD": "point clouds",
    "GREASEPENCIL": "grease pencil drawings",
    "GPENCIL": "grease pencil drawings",
    "SPEAKER": "speakers",
}


def survey(
    scene: bpy.types.Scene, things: list[bpy.types.Object], everything: list[bpy.types.Object], table: Table
) -> None:
    """Fills in ``found``, and notes on what cannot come. ``things`` are the scene's own, ``everything`` has what
    collections bring besides; ``came`` of what glTF counts is filled in from the GLB."""
    table["meshes"].found = sum(o.type == "MESH" for o in everything)
    for kind in ("curves, texts, metaballs", "instances"):
        table[kind]
    table["collection instances"].found = table["collection instances"].came = sum(
        o.instance_type == "COLLECTION" and o.instance_collection is not None for o in everything
    )
    _cameras(scene, [o for o in everything if o.type == "CAMERA"], table)
    _lights([o for o in everything if o.type == "LIGHT"], table)
    _armatures([o for o in everything if o.type == "ARMATURE"], everything, table)
    _keys(everything, table)
    _actions(table)
    _constraints(everything, table)
    _drivers(table)
    for kind in ("modifiers", "vertex animations", "materials", "pictures", "simulations"):
        table[kind]
    for thing in everything:
        if thing.type in _LEFT_OUT:
            row = table[_LEFT_OUT[thing.type]]
            row.found += 1
            row.notes = ["left out"]
    hidden = [o for o in scene.objects if o.type in MESH_LIKE and o not in everything]
    if hidden:
        row = table["hidden objects"]
        row.found, row.notes = len(hidden), [f"not rendered, left out: {names(hidden)}"]
    _libraries(table)
    scripts = [text for text in bpy.data.texts if text.use_module]
    if scripts:
        table["scripts"].found, table["scripts"].notes = len(scripts), [f"never run: {names(scripts)}"]
    if scene.world is not None:
        table["world"].found, table["world"].notes = 1, ["its light left out (the configuration's sun and sky shine)"]
    others = [s for s in bpy.data.scenes if s is not scene]
    if others:
        table["other scenes"].found, table["other scenes"].notes = len(others), [f"--scene chooses: {names(others)}"]
    scale = scene.unit_settings.scale_length
    if scene.unit_settings.system != "NONE" and abs(scale - 1) > 1e-6:
        table["units"].notes.append(f"one unit is {scale:g} m in Blender; numbers come as they are")


def _cameras(scene: bpy.types.Scene, cameras: list[bpy.types.Object], table: Table) -> None:
    row = table["cameras"]
    row.found = len(cameras)
    for camera in cameras:
        lens = camera.data
        if lens.type == "PANO":
            row.notes.append(f"'{camera.name}' is panoramic: left out")
        if lens.type == "ORTHO":
            row.notes.append(f"'{camera.name}' is orthographic, which BlinkGL draws in perspective")
        if lens.shift_x or lens.shift_y:
            row.notes.append(f"the shift of '{camera.name}' left out")
        if lens.dof.use_dof:
            row.notes.append(f"depth of field of '{camera.name}' left out")
        if lens.animation_data is not None and (lens.animation_data.action or lens.animation_data.drivers):
            row.notes.append(f"the lens of '{camera.name}' changes in time: as in the first frame")
    if any(marker.camera is not None for marker in scene.timeline_markers):
        row.notes.append("cuts between cameras left out: scene.camera chooses one")


def _lights(lights: list[bpy.types.Object], table: Table) -> None:
    row = table["lights"]
    row.found = len(lights)
    areas = [light for light in lights if light.data.type == "AREA"]
    if areas:
        row.notes.append(f"no area lights in glTF, left out: {names(areas)}")
    if any(light.data.animation_data is not None and light.data.animation_data.action for light in lights):
        row.notes.append("changing colours and strengths: as in the first frame")


def _armatures(armatures: list[bpy.types.Object], everything: list[bpy.types.Object], table: Table) -> None:
    row = table["armatures"]
    row.found = len(armatures)
    if armatures:
        row.notes.append(f"{sum(len(a.data.bones) for a in armatures)} bones")
    for armature in armatures:
        bent = [bone for bone in armature.data.bones if bone.bbone_segments > 1 and bone.use_deform]
        if bent:
            row.notes.append(f"bendy bones of '{armature.name}' as straight ones")
    for thing in everything:
        skins = [m for m in getattr(thing, "modifiers", ()) if m.type == "ARMATURE" and m.object and m.show_viewport]
        if any(m.use_deform_preserve_volume for m in skins):
            row.notes.append(f"'{thing.name}' keeps its volume in Blender, and is blended linearly here")
        if any(m.use_bone_envelopes for m in skins):
            row.notes.append(f"bone envelopes of '{thing.name}' left out")
        if len(skins) > 1:
            row.notes.append(f"'{thing.name}' has {len(skins)} armatures: the first moves it")
        if skins and thing.type == "MESH":
            bones = {b.name for b in skins[0].object.data.bones if b.use_deform}
            groups = {group.index for group in thing.vertex_groups if group.name in bones}
            most = max(
                (sum(g.group in groups and g.weight > 0 for g in v.groups) for v in thing.data.vertices), default=0
            )
            if most > 8:
                row.notes.append(f"vertices of '{thing.name}' follow up to {most} bones: the 8 heaviest")


def _keys(everything: list[bpy.types.Object], table: Table) -> None:
    row = table["shape keys"]
    meshes = {o.data.name_full: o.data for o in everything if o.type == "MESH" and o.data.shape_keys is not None}
    for mesh in meshes.values():
        blocks = list(mesh.shape_keys.key_blocks)[1:]
        row.found += len(blocks)
        if mute := [block for block in blocks if block.mute]:
            row.notes.append(f"switched off, left out: {names(mute)}")
        if not mesh.shape_keys.use_relative:
            row.notes.append(f"'{mesh.name}' steps through its keys by time, which is left out")


def _owners():
    """Every ID that may be animated."""
    for collection in (
        bpy.data.objects, bpy.data.armatures, bpy.data.cameras, bpy.data.lights, bpy.data.meshes, bpy.data.shape_keys,
        bpy.data.materials, bpy.data.node_groups, bpy.data.worlds, bpy.data.scenes, bpy.data.curves,
    ):  # fmt: skip
        yield from (owner for owner in collection if owner.animation_data is not None)
    yield from (m.node_tree for m in bpy.data.materials if m.node_tree is not None and m.node_tree.animation_data)


def _actions(table: Table) -> None:
    row = table["actions"]
    played: dict[str, None] = {}
    for owner in _owners():
        if owner.animation_data.action is not None:
            played[owner.animation_data.action.name_full] = None
        for track in owner.animation_data.nla_tracks:
            if not track.mute:
                played.update({s.action.name_full: None for s in track.strips if s.action is not None and not s.mute})
    row.found, row.came = len(bpy.data.actions), len(played)
    idle = [action for action in bpy.data.actions if action.name_full not in played]
    if idle:
        row.notes.append(f"not played by the scene: {names(idle)} (--clips brings each)")


def _constraints(everything: list[bpy.types.Object], table: Table) -> None:
    row = table["constraints"]
    count = sum(len(o.constraints) for o in everything)
    count += sum(len(bone.constraints) for o in everything if o.type == "ARMATURE" for bone in o.pose.bones)
    row.found = row.came = count
    if count:
        row.notes.append("as key frames of what they do")


def _drivers(table: Table) -> None:
    row, scripted = table["drivers"], []
    for owner in _owners():
        for curve in owner.animation_data.drivers:
            row.found += 1
            if curve.driver.type == "SCRIPTED" and not curve.driver.is_simple_expression:
                scripted.append(f"{owner.name}.{curve.data_path}")
    row.came = row.found - len(scripted)
    if row.came:
        row.notes.append("as key frames of what they do")
    if scripted:
        row.notes.append(f"Python, never run: {names(scripted)}")


def _libraries(table: Table) -> None:
    libraries = list(bpy.data.libraries)
    if libraries:
        row = table["linked libraries"]
        row.found = len(libraries)
        gone = [library for library in libraries if library.is_missing]
        row.came = len(libraries) - len(gone)
        row.notes += [f"missing: {bpy.path.abspath(library.filepath)}" for library in gone]
