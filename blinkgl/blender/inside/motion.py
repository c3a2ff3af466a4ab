"""Which scene, and when: the frames that are written down, as key frames that Blender itself has evaluated."""

from __future__ import annotations

from dataclasses import dataclass
from math import gcd

import bpy
from said import Refused, Table, names

_MOST_FRAMES = 100_000
_NOTHING = 1e-9  # of a scale


def choose_scene(name: str | None) -> bpy.types.Scene:
    """The scene of that name, else the one that the file was saved in."""
    if name is not None:
        if name not in bpy.data.scenes:
            raise Refused(f"the file has no scene '{name}'", accepted=f"one of: {names(bpy.data.scenes, 20)}")
        bpy.context.window.scene = bpy.data.scenes[name]
    return bpy.context.scene


@dataclass(frozen=True)
class Clock:
    """Frames as the exporter counts them: ``per`` of them are one of the file's."""

    first: int
    last: int
    per: int
    fps: float

    def all(self) -> list[int]:
        """Every frame that is written down."""
        return list(range(self.first, self.last + 1))

    def some(self, count: int) -> list[int]:
        """The first, the last and others between them."""
        return sorted({round(self.first + k * (self.last - self.first) / (count - 1)) for k in range(count)})

    def said(self) -> dict:
        """first, last: frames of the file; fps: of the file; duration_s: of the animation."""
        return {
            "first": self.first // self.per,
            "last": self.last // self.per,
            "fps": self.fps / self.per,
            "duration_s": (self.last - self.first) / self.fps,
        }


def set_clock(scene: bpy.types.Scene, frames: list[int] | None, per: int) -> Clock:
    """Sets the scene to ``per`` key frames per frame: its time is stretched and its frames come faster by as much."""
    first, last = frames or (scene.frame_start, scene.frame_end)
    if last < first or (last - first) * per > _MOST_FRAMES:
        raise Refused(
            f"frames {first} to {last} cannot be written down", accepted=f"--frames FIRST LAST, at most {_MOST_FRAMES}"
        )
    render = scene.render
    if per > 1:
        common = gcd(render.frame_map_old, render.frame_map_new)
        old, new = render.frame_map_old // common, render.frame_map_new // common * per
        if new > 900 or render.fps * per > 32767:
            raise Refused(f"{per} keys per frame are too many for this scene", accepted="fewer")
        render.frame_map_old, render.frame_map_new = old, new
        render.fps *= per
    scene.frame_start, scene.frame_end = first * per, last * per
    return Clock(first * per, last * per, per, render.fps / render.fps_base)


def offer_clips(table: Table) -> None:
    """Every action in a track of its own, at those whose names its slots bear or, for bones, that have them: that is
    where the exporter looks. What no object takes is said."""
    pairs: dict[tuple[str, str], tuple] = {}
    for owner in [*bpy.data.objects, *bpy.data.shape_keys]:
        moved = owner.animation_data
        if moved is None:
            continue
        strips = [strip for track in moved.nla_tracks for strip in track.strips]
        for player in [moved, *strips]:
            if player.action is not None:
                pairs.setdefault((owner.name_full, player.action.name_full), (owner, player.action, player.action_slot))
    taken = {action for _, action in pairs}
    for action in bpy.data.actions:
        for slot in action.slots if action.name_full not in taken else ():
            for owner in _takers(action, slot):
                pairs.setdefault((owner.name_full, action.name_full), (owner, action, slot))
    for owner, _, _ in pairs.values():
        moved = owner.animation_data or owner.animation_data_create()
        moved.action = None
        for track in list(moved.nla_tracks):
            moved.nla_tracks.remove(track)
    for owner, action, slot in pairs.values():
        track = owner.animation_data.nla_tracks.new()
        track.name = action.name
        strip = track.strips.new(action.name, max(round(action.frame_range[0]), 0), action)
        if slot is not None:
            strip.action_slot = slot
    row = table["actions"]
    offered = {action for _, action in pairs}
    row.came = len(offered)
    row.notes = [note for note in row.notes if "--clips" not in note]
    lost = [action for action in bpy.data.actions if action.name_full not in offered]
    if lost:
        row.notes.append(f"of nothing in the file: {names(lost)}")


def _takers(action: bpy.types.Action, slot: bpy.types.ActionSlot) -> list[bpy.types.ID]:
    if slot.target_id_type == "KEY":
        return [key for key in bpy.data.shape_keys if key.name == slot.name_display]
    if slot.target_id_type not in ("OBJECT", "UNSPECIFIED"):
        return []
    curves = [c for layer in action.layers for strip in layer.strips for bag in strip.channelbags for c in bag.fcurves]
    bones = {c.data_path.split('"')[1] for c in curves if c.data_path.startswith('pose.bones["')}
    if bones:
        rigs = [o for o in bpy.data.objects if o.type == "ARMATURE"]
        return [o for o in rigs if bones & {b.name for b in o.data.bones}]
    return [o for o in bpy.data.objects if o.name == slot.name_display]


def without_extent(things: list[bpy.types.Object], clock: Clock, table: Table) -> set[str]:
    """Names of objects that a scale of zero hides, always or at times: BlinkGL draws no scale that changes, and a pose
    without extent is none."""
    gone: dict[str, None] = {}
    for frame in clock.some(25):
        bpy.context.scene.frame_set(frame)
        graph = bpy.context.evaluated_depsgraph_get()
        for thing in things:
            if min(abs(s) for s in thing.evaluated_get(graph).matrix_world.to_scale()) < _NOTHING:
                gone[thing.name_full] = None
    if gone:
        table["meshes"].notes.append(f"hidden by a scale of 0, left out: {names(gone)}")
    return set(gone)
