"""Which objects are in the picture: those that Blender would render, in collections that it would render."""

from __future__ import annotations

import bpy

MESH_LIKE = ("MESH", "CURVE", "SURFACE", "FONT", "META")
NEVER_SEEN = ("EMPTY", "ARMATURE", "CAMERA", "LATTICE", "SPEAKER", "LIGHT_PROBE")


def in_picture(view_layer: bpy.types.ViewLayer) -> list[bpy.types.Object]:
    """In the scene's order. What helps without being seen (empties, armatures) counts even when it is hidden."""
    found: set[str] = set()
    waiting = [(view_layer.layer_collection, False)]
    while waiting:
        layer, hidden = waiting.pop()
        if layer.exclude:
            continue
        hidden = hidden or layer.collection.hide_render
        found |= {
            o.name_full for o in layer.collection.objects if o.type in NEVER_SEEN or not (o.hide_render or hidden)
        }
        waiting += [(child, hidden) for child in layer.children]
    for thing in bpy.context.scene.objects:  # an armature may be hidden away wherever it is
        if thing.name_full in found:
            found |= {m.object.name_full for m in thing.modifiers if m.type == "ARMATURE" and m.object is not None}
    return [thing for thing in bpy.context.scene.objects if thing.name_full in found]


def make_visible(view_layer: bpy.types.ViewLayer, kept: list[bpy.types.Object]) -> None:
    """What Blender would render and does not show in its viewport is not evaluated; from here on it is."""
    shown = {thing.name_full for thing in kept}
    waiting = [view_layer.layer_collection]
    while waiting:
        layer = waiting.pop()
        if layer.exclude:
            continue
        if any(thing.name_full in shown for thing in layer.collection.all_objects):
            layer.hide_viewport = layer.collection.hide_viewport = False
        waiting += layer.children
    for thing in kept:
        thing.hide_viewport = False
        if thing.name_full not in view_layer.objects:  # its collection is excluded
            bpy.context.scene.collection.objects.link(thing)
        thing.hide_set(False)


def instanced(kept: list[bpy.types.Object]) -> list[bpy.types.Object]:
    """The objects of the collections that ``kept`` show, and of those that these show, each once."""
    found: dict[str, bpy.types.Object] = {}
    waiting = list(kept)
    while waiting:
        thing = waiting.pop()
        if thing.instance_type == "COLLECTION" and thing.instance_collection is not None:
            for inner in thing.instance_collection.all_objects:
                if inner.name_full not in found:
                    found[inner.name_full] = inner
                    waiting.append(inner)
    return list(found.values())
