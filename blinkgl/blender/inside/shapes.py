"""Geometry that glTF can say: meshes without modifiers but the armatures', curves and texts as meshes, instances as
objects. What becomes of a shape is compared with Blender's own, at several frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import bpy
import numpy as np
from kept import MESH_LIKE
from mathutils import Matrix
from said import Table

# Results of stepping through time, which belong to the frames before: glTF has no place for them.
SIMULATED = {
    "CLOTH": "cloth",
    "SOFT_BODY": "soft body",
    "FLUID": "fluid",
    "DYNAMIC_PAINT": "dynamic paint",
    "PARTICLE_SYSTEM": "particle system",
    "PARTICLE_INSTANCE": "particle instances",
    "EXPLODE": "explode",
}
_NOTHING_TO_SEE = ("COLLISION", "SURFACE")
TOLERANCE = 1e-5  # of the shape's size: what a float32 chain of matrices costs
_MOST_COMPARED = 4_000_000  # vertices times frames
_MOST_BAKED = 64_000_000  # vertices times shapes of one mesh
_MOST_SHAPES = 200  # of one mesh: BlinkGL takes a thousand numbers per time, of all joints and shapes


def stop_simulations(things: Iterable[bpy.types.Object], table: Table) -> None:
    """Switched off, so that no frame waits for one and none writes its cache beside the file."""
    row = table["simulations"]
    for thing in things:
        for modifier in thing.modifiers:
            if modifier.type in SIMULATED:
                modifier.show_viewport = modifier.show_render = False
                if modifier.type != "PARTICLE_SYSTEM":
                    row.found += 1
                    row.notes.append(f"{SIMULATED[modifier.type]} of '{thing.name}' left out")
        for system in getattr(thing, "particle_systems", ()):
            hair = system.settings.type == "HAIR"
            kind = table["hair systems" if hair else "particle systems"]
            kind.found += 1
            kind.notes.append(f"'{system.name}' of '{thing.name}' left out")
    world = bpy.context.scene.rigidbody_world
    if world is not None:
        on_disk = world.point_cache is not None and world.point_cache.use_disk_cache
        if on_disk:  # would be written beside the user's file
            world.enabled = False
        bodies = [] if world.collection is None else list(world.collection.objects)
        row.found += len(bodies)
        row.came += 0 if on_disk else len(bodies)
        if bodies:
            how = "with their cache on disk left out" if on_disk else "as key frames"
            row.notes.append(f"{len(bodies)} rigid bodies {how}")


# ---------------------------------------------------------------------------------------------------------- evaluation


def evaluated_positions(thing: bpy.types.Object) -> np.ndarray | None:
    """(V, 3) float32 in the object's own coordinates, as Blender shows it now; None without a mesh."""
    return evaluated(thing)[0]


def evaluated(thing: bpy.types.Object) -> tuple[np.ndarray | None, int]:
    """:func:`evaluated_positions`, and the number of corners of all faces."""
    shown = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    try:
        mesh = shown.to_mesh()
    except RuntimeError:
        return None, 0
    if mesh is None:
        return None, 0
    found = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.vertices.foreach_get("co", found.ravel())
    corners = len(mesh.loops)
    shown.to_mesh_clear()
    return found, corners


@contextmanager
def without(things: Iterable[bpy.types.Object], kinds: tuple[str, ...]) -> Iterator[None]:
    """Modifiers of these kinds are switched off inside."""
    off = [m for thing in things for m in thing.modifiers if m.type in kinds and m.show_viewport]
    for modifier in off:
        modifier.show_viewport = False
    bpy.context.view_layer.update()
    try:
        yield
    finally:
        for modifier in off:
            modifier.show_viewport = True
        bpy.context.view_layer.update()


def generated(thing: bpy.types.Object) -> bpy.types.Mesh:
    """A new mesh of what the object shows now, with all its layers of data."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    return bpy.data.meshes.new_from_object(
        thing.evaluated_get(depsgraph), preserve_all_data_layers=True, depsgraph=depsgraph
    )


# ------------------------------------------------------------------------------------------------------------- meshes


def skinning(modifier: bpy.types.Modifier) -> bool:
    """What a skin can say: an armature that moves vertices by groups of weights."""
    return modifier.type == "ARMATURE" and modifier.object is not None and modifier.use_vertex_groups


def worth_applying(thing: bpy.types.Object) -> list[bpy.types.Modifier]:
    """Modifiers that are on and change the shape, the skin's own left out."""
    off = (*SIMULATED, *_NOTHING_TO_SEE)
    return [m for m in thing.modifiers if m.show_viewport and m.type not in off and not skinning(m)]


def apply_modifiers(things: list[bpy.types.Object], table: Table) -> None:
    """Meshes without modifiers but armatures; shape keys survive. ``things``: all that are in the picture."""
    applied = [o for o in things if o.type == "MESH" and worth_applying(o)]
    row = table["modifiers"]
    kinds: Counter = Counter()
    for thing in applied:
        listed = worth_applying(thing)
        row.found += len(listed)
        row.came += len(listed)
        kinds.update(m.type.lower().replace("_", " ") for m in listed)
        stack = [m for m in thing.modifiers if m in listed or (skinning(m) and m.show_viewport)]
        last = max((i for i, m in enumerate(stack) if skinning(m)), default=-1)
        if 0 <= last < len(stack) - 1:
            row.notes.append(f"'{thing.name}' was deformed by its armature first, now last")
    if kinds:
        row.notes.insert(0, "applied: " + ", ".join(f"{kind} {count}" for kind, count in sorted(kinds.items())))
    with without(things, ("ARMATURE",)):
        meshes = {}
        for thing in applied:
            keys = thing.data.shape_keys
            keyed = keys is not None and len(keys.key_blocks) > 1
            meshes[thing.name_full] = _with_keys(thing, table) if keyed else generated(thing)
    for thing in applied:
        _replace_mesh(thing, meshes[thing.name_full])
    for thing in things:  # the exporter looks at modifiers that are off, too
        for modifier in [m for m in getattr(thing, "modifiers", ()) if thing.type == "MESH"]:
            if not (skinning(modifier) and modifier.show_viewport):
                thing.modifiers.remove(modifier)


def _replace_mesh(thing: bpy.types.Object, mesh: bpy.types.Mesh) -> None:
    old = thing.data
    mesh.name = old.name
    # Materials that belong to the object, not to its mesh, stay with it.
    slots = [slot.material for slot in thing.material_slots]
    thing.data = mesh
    for k, material in enumerate(slots[: len(thing.material_slots)]):
        thing.material_slots[k].link = "DATA"
        if k < len(mesh.materials):
            mesh.materials[k] = material


def _with_keys(thing: bpy.types.Object, table: Table) -> bpy.types.Mesh:
    """The generated mesh with one shape key per key of the object's: each is generated alone. Exact where the modifiers
    are linear in the positions (subdivision, mirror, array); the comparison says where they are not."""
    keys = thing.data.shape_keys
    copy = thing.copy()
    copy.data = thing.data.copy()
    own = copy.data.shape_keys
    own.animation_data_clear()
    bpy.context.scene.collection.objects.link(copy)
    try:
        blocks = list(own.key_blocks)
        for block in blocks[1:]:
            block.value, block.mute = 0.0, block.mute
        bpy.context.view_layer.update()
        mesh = generated(copy)
        if mesh.shape_keys is not None:  # an evaluated mesh has none, but who knows
            mesh = mesh.copy()
        shapes: dict[str, np.ndarray] = {}
        for block in blocks[1:]:
            if block.mute:
                continue
            block.slider_max = max(block.slider_max, 1.0)
            block.value = 1.0
            bpy.context.view_layer.update()
            shape = evaluated_positions(copy)
            block.value = 0.0
            if shape is None or len(shape) != len(mesh.vertices):
                table["shape keys"].notes.append(
                    f"'{block.name}' of '{thing.name}' changes what the modifiers make of it"
                )
                continue
            shapes[block.name] = shape
    finally:
        bpy.data.objects.remove(copy)
    carrier = bpy.data.objects.new("carrier", mesh)
    carrier.shape_key_add(name=keys.key_blocks[0].name, from_mix=False)
    for name, shape in shapes.items():
        made = carrier.shape_key_add(name=name, from_mix=False)
        made.data.foreach_set("co", shape.ravel())
        block = keys.key_blocks[name]
        made.slider_min, made.slider_max, made.value = block.slider_min, block.slider_max, block.value
    bpy.data.objects.remove(carrier)
    _same_animation(keys, mesh.shape_keys)
    return mesh


def _same_animation(old: bpy.types.ID, new: bpy.types.ID) -> None:
    """Action, NLA tracks and drivers of one ID for another of its kind."""
    source = old.animation_data
    if source is None:
        return
    target = new.animation_data_create()
    if source.action is not None:
        target.action = source.action
        if source.action_slot is not None:
            target.action_slot = source.action_slot
    for driver in source.drivers:
        target.drivers.from_existing(src_driver=driver)
    for track in source.nla_tracks:
        made = target.nla_tracks.new()
        made.name, made.mute = track.name, track.mute
        for strip in track.strips:
            if strip.action is None:
                continue
            same = made.strips.new(strip.name, round(strip.frame_start), strip.action)
            for key in ("frame_start", "frame_end", "action_frame_start", "action_frame_end", "scale", "repeat",
                        "blend_type", "extrapolation", "influence", "use_reverse", "mute"):  # fmt: skip
                setattr(same, key, getattr(strip, key))


# ------------------------------------------------------------------------------------------------- what is not a mesh


def _follow(child: bpy.types.Object, other: bpy.types.Object) -> None:
    """As a child that stands where ``other`` does. (A curve's children would run along it.)"""
    if other.type in ("CURVE", "SURFACE"):
        bond = child.constraints.new("CHILD_OF")
        bond.target, bond.inverse_matrix = other, Matrix.Identity(4)
    else:
        child.parent, child.matrix_parent_inverse = other, Matrix.Identity(4)


def meshes_of_others(things: list[bpy.types.Object], table: Table) -> dict[str, bpy.types.Object]:
    """Curves, surfaces, texts and metaballs get a companion that is their mesh; those, by the names of their owners.
    They stay themselves, because others may follow them."""
    made = {}
    for thing in [o for o in things if o.type in MESH_LIKE and o.type != "MESH"]:
        row = table["curves, texts, metaballs"]
        row.found += 1
        mesh = generated(thing)
        if not len(mesh.polygons):
            bpy.data.meshes.remove(mesh)
            row.notes.append(f"'{thing.name}' has no surface")
            continue
        row.came += 1
        shape = bpy.data.objects.new(f"{thing.name} mesh", mesh)
        for collection in thing.users_collection:
            collection.objects.link(shape)
        _follow(shape, thing)
        made[thing.name_full] = shape
    if made:
        table["curves, texts, metaballs"].notes.insert(0, "as meshes")
    return made


def instances_as_objects(
    things: list[bpy.types.Object], meshes: dict[str, bpy.types.Object], table: Table
) -> tuple[list[bpy.types.Object], set[str]]:
    """Instances of vertices, faces and geometry nodes become objects, children of what made them, where they are now.
    (Instances of collections are exported as such.)
    ``meshes``: what :func:`meshes_of_others` made. Also the names of what is only there to be instanced."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    shown = {o.name_full for o in things}
    own = {name: len(o.data.vertices) for name, o in meshes.items()}
    found, made, copies = [], [], {}
    for instance in depsgraph.object_instances:
        if not instance.is_instance or instance.particle_system is not None:
            continue
        maker = instance.parent.original
        if maker.instance_type == "COLLECTION" or maker.name_full not in shown or instance.object.type not in MESH_LIKE:
            continue
        data = instance.object.data if instance.object.type == "MESH" else None
        if maker.type != "MESH" and len(data.vertices if data else ()) == own.get(maker.name_full, -1):
            continue  # how Blender lists the surface of a curve or text itself
        key = instance.object.original.name_full, 0 if data is None else data.as_pointer()
        if key not in copies:  # now: the iterator's objects do not outlive its next step
            # (Asked to preserve all layers, it would give the mesh of the object that makes the instances.)
            copies[key] = mesh = instance.object.to_mesh().copy()
            for k, material in enumerate(mesh.materials):
                mesh.materials[k] = None if material is None else material.original
            instance.object.to_mesh_clear()
        found.append((maker, copies[key], instance.matrix_world.copy()))
    row = table["instances"]
    for maker, mesh, matrix in found:
        if not len(mesh.polygons):
            continue
        row.found += 1
        row.came += 1
        thing = bpy.data.objects.new(f"{maker.name} instance", mesh)
        for collection in maker.users_collection:
            collection.objects.link(thing)
        _follow(thing, maker)
        thing.matrix_basis = maker.matrix_world.inverted_safe() @ matrix
        made.append(thing)
    if made:
        row.notes.append("as objects, where they stand in the first frame")
    unseen = set()
    for thing in things:
        if thing.instance_type in ("VERTS", "FACES"):
            thing.instance_type = "NONE"
            unseen |= {child.name_full for child in thing.children_recursive if child not in made}
            if not thing.show_instancer_for_render:
                unseen.add(thing.name_full)
    return made, unseen


def even_offsets(things: list[bpy.types.Object]) -> list[bpy.types.Object]:
    """Collections that are instanced about a point of their own: their instancers hand that over to a child. (The
    exporter forgets it where an instancer moves.) The new objects."""
    made, offsets = [], {}
    for thing in list(things):
        collection = thing.instance_collection if thing.instance_type == "COLLECTION" else None
        if collection is None or not any(collection.instance_offset):
            continue
        offsets[collection.name_full] = collection
        child = bpy.data.objects.new(f"{thing.name} origin", None)
        for owner in thing.users_collection:
            owner.objects.link(child)
        child.parent, child.matrix_parent_inverse = thing, Matrix.Identity(4)
        child.location = -collection.instance_offset
        thing.instance_type, thing.instance_collection = "NONE", None
        child.instance_type, child.instance_collection = "COLLECTION", collection
        made.append(child)
    for collection in offsets.values():
        collection.instance_offset = (0.0, 0.0, 0.0)
    return made


# --------------------------------------------------------------------------------------------------------- comparison


def twins(things: list[bpy.types.Object]) -> dict[str, bpy.types.Object]:
    """A copy of each object whose modifiers will be applied, to compare with afterwards: it keeps them."""
    made = {}
    for thing in [o for o in things if o.type == "MESH" and worth_applying(o)]:
        made[thing.name_full] = twin = thing.copy()
        bpy.context.scene.collection.objects.link(twin)
    return made


def compare(made: dict[str, bpy.types.Object], frames: list[int], table: Table) -> list[bpy.types.Object]:
    """Looks where an object's vertices and its twin's are at each frame, and says where they differ. The objects that
    have to be baked: no skin moves them, and all that differs is where their vertices are."""
    worst = dict.fromkeys(made, 0.0)
    budget = _MOST_COMPARED
    row, cache = table["modifiers"], {}
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        for name, twin in made.items():
            if budget < 0 or not np.isfinite(worst[name]):
                continue
            (true, corners), (ours, our_corners) = evaluated(twin), evaluated(bpy.data.objects[name])
            if true is None or ours is None or len(true) != len(ours) or corners != our_corners:
                worst[name] = np.inf
                continue
            budget -= len(true)
            if len(true):
                size = cache.setdefault(name, float(np.ptp(true, axis=0).max())) or 1.0
                worst[name] = max(worst[name], float(np.linalg.norm(true - ours, axis=1).max()) / size)
    baked = []
    for name, apart in worst.items():
        thing = bpy.data.objects[name]
        if not np.isfinite(apart):
            row.came -= 1
            row.notes.append(f"'{name}' changes how many faces it has: as in the first frame")
        elif apart > TOLERANCE:
            if thing.data.shape_keys is None and not any(skinning(m) for m in thing.modifiers):
                baked.append(thing)
            else:
                row.notes.append(f"'{name}' is off by up to {apart:.1g} of its size")
    return baked


def bake(things: list[bpy.types.Object], made: dict[str, bpy.types.Object], frames: list[int], table: Table) -> None:
    """Vertex animation as one shape key per frame, mixed linearly from one to the next."""
    shapes: dict[str, list[np.ndarray]] = {o.name_full: [] for o in things}
    steps = {}
    for thing in things:
        most = max(min(_MOST_SHAPES, _MOST_BAKED // max(len(thing.data.vertices), 1)), 1)
        steps[thing.name_full] = frames[:: -(-len(frames) // most)]
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        for name, found in shapes.items():
            if frame in steps[name]:
                found.append(evaluated_positions(made[name]))
    row = table["vertex animations"]
    for thing in things:
        row.found += 1
        found, times = shapes[thing.name_full], steps[thing.name_full]
        if any(s is None or len(s) != len(thing.data.vertices) for s in found):
            row.notes.append(f"'{thing.name}' changes how many vertices it has: as in the first frame")
            continue
        row.came += 1
        thing.data = thing.data.copy()
        thing.data.vertices.foreach_set("co", found[0].ravel())
        thing.shape_key_add(name="Basis", from_mix=False)
        for k in range(1, len(found)):
            block = thing.shape_key_add(name=f"frame {times[k]}", from_mix=False)
            block.data.foreach_set("co", found[k].ravel())
            for at, value in ((times[k - 1], 0.0), (times[k], 1.0), (times[min(k + 1, len(times) - 1)], 0.0)):
                if at != times[k] or value:
                    block.value = value
                    block.keyframe_insert("value", frame=at)
        action = thing.data.shape_keys.animation_data.action
        for layer in action.layers:
            for strip in layer.strips:
                for bag in strip.channelbags:
                    for curve in bag.fcurves:
                        for point in curve.keyframe_points:
                            point.interpolation = "LINEAR"
        apart = f", {times[1] - times[0]} keys apart" if len(times) > 1 and len(times) < len(frames) else ""
        row.notes.append(f"'{thing.name}' as {len(found) - 1} shapes{apart}")


def remove(made: dict[str, bpy.types.Object]) -> None:
    """The twins are not for the picture."""
    for twin in made.values():
        bpy.data.objects.remove(twin)
