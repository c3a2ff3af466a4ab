"""What Blender itself sees over time, and objects that show it where its exporter of glTF does not.

:func:`sample` writes points of everything that is rendered, at a few times; BlinkGL compares them with what the GLB
plays. :func:`bake` evaluates what differs at four times per frame. What only moves becomes a rigid node, anything else
morph targets, one for a time, as few as straight lines in between allow. A part of convert.py.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from glb import add_keys
from mathutils import Matrix

SEEN = ("MESH", "CURVE", "SURFACE", "FONT", "META", "CAMERA")
SIMULATED = {"CLOTH", "SOFT_BODY", "FLUID", "DYNAMIC_PAINT", "PARTICLE_SYSTEM", "GeometryNodeSimulationInput"}
SAMPLES, MOST_POINTS, MOST_EACH = 25, 400_000, 400
PER_FRAME = 4
FURTHEST = 1e9
"""Beyond it a place counts as broken."""
CLOSE = 5e-5
"""Error that straight lines between keys may have at a frame, of the size; between frames twelve times as much."""
MOST_KEYS, MOST_TARGET_VERTICES = 4000, 8_000_000
"""What BlinkGL reads of one mesh."""
WAITING = 64
Y_UP = Matrix(((1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1)))
NOT_EXPORTED = "glTF_not_exported"
"""Blender's exporter leaves out objects in a collection of that name, and keeps their children."""


class Refused(Exception):
    """A line for the user: what is wrong, and what would be accepted."""

    def __init__(self, problem: str, accepted: str | None = None):
        super().__init__(problem)
        self.problem, self.accepted = problem, accepted


_LARGEST_RATIO, _LAST_FRAME = 900, 1_048_574
"""Largest number of Blender's time remapping, and its last frame; beyond them it takes these without a word."""


class Clock:
    """The scene's time. first, last : frames.   fps : of the file.   per : key frames per frame.
    simulated : whether only whole frames in their order mean something.   here : the frame that the file shows.
    graph : the dependency graph of the time that :meth:`go` was called with."""

    def __init__(self, first: int, last: int, per: int):
        self.scene, self.first, self.last = bpy.context.scene, first, last
        self.here = self.scene.frame_current
        self.fps = self.scene.render.fps / self.scene.render.fps_base
        self.map = self.scene.render.frame_map_old, self.scene.render.frame_map_new
        self.markers = [(marker, marker.frame) for marker in self.scene.timeline_markers]
        kinds = {modifier.type for obj in self.scene.objects for modifier in obj.modifiers}
        kinds |= {node.bl_idname for group in bpy.data.node_groups for node in group.nodes}
        self.simulated = self.scene.rigidbody_world is not None or not SIMULATED.isdisjoint(kinds)
        self.graph: Any = None
        self.stretch(per)

    def stretch(self, per: int) -> None:
        """Set the scene to ``per`` key frames per frame: its time is stretched. Raises Refused: by more than Blender
        can."""
        if not self.counts(per):
            raise Refused(
                f"{per} key frames per frame of this scene are more than Blender counts", "a smaller --keys-per-frame"
            )
        self.per = per
        self.scene.render.frame_map_old, self.scene.render.frame_map_new = self._ratio(per)
        self.scene.frame_start, self.scene.frame_end = self.first * per, self.last * per
        for marker, frame in self.markers:
            marker.frame = frame * per

    def counts(self, per: int) -> bool:
        """Return whether Blender can count ``per`` key frames per frame. One, the file's own time, it can."""
        return per == 1 or (
            max(self._ratio(per)) <= _LARGEST_RATIO and max(abs(self.first), abs(self.last)) * per <= _LAST_FRAME
        )

    def finest(self) -> int:
        """Return the largest number of key frames per frame that doubling leads to; simulations have no more."""
        per = self.per
        while not self.simulated and self.counts(2 * per):
            per *= 2
        return per

    def _ratio(self, per: int) -> tuple[int, int]:
        common = math.gcd(self.map[0], self.map[1] * per)
        return self.map[0] // common, self.map[1] * per // common

    def seconds(self, frame: float) -> float:
        return (frame - self.first) / self.fps

    def go(self, frame: float) -> None:
        """Evaluate the scene at a frame, or between two."""
        # Frames are counted finer while it bakes; Blender takes the rest as a subframe.
        whole, part = divmod(frame * self.per, 1)
        self.scene.frame_set(int(whole), subframe=part)
        self.graph = bpy.context.evaluated_depsgraph_get()

    def play(self) -> None:
        """Fill the caches of simulations: a first time may differ from what they keep."""
        for frame in range(self.first, self.last + 1) if self.simulated else ():
            self.go(frame)

    def watch(self, frames: Iterable[float], owners: set[str] | None = None) -> Iterator[tuple]:
        """Yield (frame, key, object, matrix, (V, 3) points, vertex of each corner, a number of its faces) of every
        surface and camera that is rendered, instances too. A key is (owner, name, which); the owner is the object of
        the scene that shows it (``owners``: these alone). An object is valid until the next. A camera is four points:
        its place and the ends of its axes."""
        for frame in frames:
            self.go(frame)
            shapes: dict[str, tuple | None] = {}
            for one in self.graph.object_instances:
                obj, owner = one.object, one.parent if one.is_instance else one.object
                unwanted = owners is not None and owner.name not in owners
                # The mesh of a curve, an instance of its own, is the curve.
                itself = one.is_instance and owner.name == obj.name and owner.type != obj.type
                hidden = not one.show_self or obj.hide_render or owner.hide_render
                if unwanted or itself or hidden or obj.type not in SEEN:
                    continue
                if obj.name not in shapes:
                    shapes[obj.name] = surface(obj)
                if shapes[obj.name] is not None:
                    matrix = one.matrix_world
                    if obj.type == "CAMERA":
                        # The scale of a camera has no effect on its picture.
                        matrix = Matrix.LocRotScale(*matrix.decompose()[:2], None)
                    key = owner.name, obj.name, tuple(one.persistent_id) if one.is_instance else None
                    yield frame, key, obj, np.array(matrix), *shapes[obj.name]


def surface(obj: Any) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Return ((V, 3) vertices, vertex of each corner, a number of its faces) of an evaluated object; None without
    faces."""
    if obj.type == "CAMERA":
        return np.eye(4, 3, -1), np.arange(4), 0
    mesh = obj.to_mesh()
    if mesh is None or not len(mesh.polygons):
        return None
    points, corners = np.empty((len(mesh.vertices), 3), np.float32), np.empty(len(mesh.loops), np.int32)
    mesh.vertices.foreach_get("co", points.ravel())
    mesh.loops.foreach_get("vertex_index", corners)
    obj.to_mesh_clear()
    return points.astype(float), corners, zlib.crc32(corners)


def moved(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return (V, 3) points under a (4, 4) matrix."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def sample(clock: Clock, path: Path) -> tuple[set[str], dict[str, set[str]]]:
    """Write to ``path`` (npz) where points of every surface are at a few frames and between frames: ``times`` (T,) s,
    ``whole`` (T,) bool, ``things`` JSON: (name, whether its faces change) of each, ``arr_0`` … (T, n, 3) its points,
    NaN where it is not seen.

    Return (owners that are broken, owners of each object's name)."""
    # At whole frames and between them, where exporters interpolate.
    halves = 2 * (clock.last - clock.first)
    # Multiples of the golden ratio lie evenly over the clip; two steps make a frame.
    some = {round((0.618033988749895 * k % 1) * halves) for k in range(SAMPLES)} | {0, halves}
    frames = [clock.first + k / 2 for k in sorted(some) if k % 2 == 0 or not clock.simulated]
    clock.go(clock.first)
    most = min(MOST_EACH, max(MOST_POINTS // max(len(clock.graph.object_instances), 1), 8))
    seen: dict[tuple, list] = {}
    broken, owners = set(), {}
    clock.play()
    for frame in frames:
        for _, key, obj, matrix, points, corners, form in clock.watch([frame]):
            if key not in seen:
                picked = np.sort(np.random.default_rng(0).permutation(np.unique(corners))[:most])
                seen[key] = [form, False, picked, {}]
            owners.setdefault(obj.name, set()).add(key[0])
            if form != seen[key][0]:
                seen[key][1] = True
                continue
            seen[key][3][frame] = moved(points[seen[key][2]], matrix)
            if not (np.abs(seen[key][3][frame]) < FURTHEST).all():
                broken.add(key[0])
    kept = {key: one for key, one in seen.items() if key[0] not in broken}
    points = [
        [at.get(frame, np.full((len(picked), 3), np.nan)) for frame in frames] for *_, picked, at in kept.values()
    ]
    objs = json.dumps([(name, changes) for (_, name, _), (_, changes, *_) in kept.items()])
    whole = [frame == int(frame) for frame in frames]
    np.savez(path, *points, things=objs, times=[clock.seconds(frame) for frame in frames], whole=whole)
    return broken, owners


class Track:
    """One instance over time: the keys between which straight lines are close enough to what Blender has.

    name, owner : of its object, of what shows it.   data : its mesh at first, or the camera's data.
    deforms : whether its vertices move, not only its place.   kept : (frame, matrix, points in the world) of each key.
    seen : frames at which it is there; other : at which it has other faces.   coarse : whether it has keys at whole
    frames alone; over : bytes at which it was given up.   object : that shows it."""

    def __init__(self, owner: str, obj: Any, shape: np.ndarray, corners: int, form: int):
        self.name, self.owner, self.camera, self.original = obj.name, owner, obj.type == "CAMERA", obj.original
        self.shape, self.corners, self.form, self.deforms = shape, corners, form, False
        self.kept, self.waiting, self.seen, self.other, self.coarse, self.over = [], [], [], [], False, 0
        self.data = self.object = None
        ends = shape.min(axis=0), shape.max(axis=0)
        # Corner k lies at the upper end of axis a where bit a of k is set.
        self.box = np.array([[ends[k >> axis & 1][axis] for axis in range(3)] for k in range(8)])

    def add(self, frame: float, matrix: np.ndarray, shape: np.ndarray, form: int) -> None:
        """Take the next time."""
        self.seen.append(frame)
        if form != self.form:
            self.other.append(frame)
        if form != self.form or self.over or (self.coarse and frame != int(frame)):
            return
        if not self.deforms:
            # A place, a rotation and a scale, which is what a node's keys hold, make no shear.
            straight = np.array(Matrix.LocRotScale(*Matrix(matrix).decompose()))
            if np.abs(straight - matrix)[:3, :3].max() > 1e-5 * np.abs(matrix[:3, :3]).max() or np.abs(
                shape - self.shape
            ).max() > 0.02 * CLOSE * np.ptp(shape):
                self.bend()
        points = moved(shape if self.deforms else self.box, matrix)
        limit = CLOSE * (0.1 if self.camera else 1) * max(float(np.ptp(points, axis=0).max()), 1e-9)
        begin, _, start = self.kept[-1] if self.kept else (frame, None, points)
        stride = len(self.waiting) // 8 + 1  # every frame, and some between
        for at, _, passed in [one for k, one in enumerate(self.waiting) if one[0] == int(one[0]) or k % stride == 0]:
            # Where the straight line from the last key to this time passes at a time in between.
            line = start + (points - start) * ((at - begin) / (frame - begin))
            if np.abs(passed - line).max() > limit * (1 if at == int(at) else 12) or len(self.waiting) == WAITING:
                self.kept.append(self.waiting[-1])
                self.waiting = []
                break
        (self.waiting if self.kept else self.kept).append((frame, matrix, points))

    def bend(self) -> None:
        """Follow the vertices from now on, not the box around them."""
        self.deforms = True
        for past in (self.kept, self.waiting):
            past[:] = [(at, matrix, moved(self.shape, matrix)) for at, matrix, _ in past]

    def thin(self) -> None:
        """Keep whole frames alone, or give up."""
        if not self.coarse:
            self.coarse = True
            self.kept, self.waiting = (
                [one for one in some if one[0] == int(one[0])] for some in (self.kept, self.waiting)
            )
        else:
            self.over, self.kept, self.waiting = self.size, self.kept[:1], []

    def end(self, count: int) -> None:
        """Keep the last time, or one key where nothing moves. count : of all times."""
        self.kept += self.waiting[-1:]
        first = self.kept[0][2]
        if all(np.abs(points - first).max() <= CLOSE * np.ptp(first, axis=0).max() for *_, points in self.kept):
            del self.kept[1:]
        if len(self.seen) < count and not self.camera:
            self.bend()

    @property
    def base(self) -> int:
        """Return the key that is the base of the morph targets. Its faces are not collapsed, if there is such a key:
        those would not be drawn at all."""
        edges = [np.linalg.norm(np.diff(points, axis=0), axis=1) for *_, points in self.kept]
        lengths = [float(np.quantile(edge, 0.1)) for edge in edges]
        return 0 if lengths[0] > 0.1 * max(lengths) else int(np.argmax(lengths))

    @property
    def size(self) -> int:
        """Return about how many bytes the keys take in the GLB: positions and normals of morph targets."""
        # A node's key has 44 bytes: a time, a place, a quaternion and a scale, each number with 4 bytes.
        return 24 * self.corners * (len(self.kept) - 1) if self.deforms else 44 * len(self.kept)


def bake(clock: Clock, owners: set[str], room: float) -> tuple[list[Track], dict[str, str]]:
    """Put objects into the scene that show what the owners show, and take these out of the export. room : bytes for
    morph targets. Return (the tracks, for other names why they are not baked)."""
    tracks: dict[tuple, Track] = {}
    per_frame = clock.per if clock.simulated else max(PER_FRAME, clock.per)
    frames = [clock.first + k / per_frame for k in range((clock.last - clock.first) * per_frame + 1)]
    data: dict[str, Any] = {}
    clock.play()
    for frame, key, obj, matrix, points, corners, form in clock.watch(frames, owners):
        if key not in tracks:
            tracks[key] = Track(key[0], obj, points, len(corners), form)
            if obj.name not in data and obj.type == "CAMERA":
                data[obj.name] = obj.original.data
            elif obj.name not in data:
                keep = {"preserve_all_data_layers": True, "depsgraph": clock.graph}
                data[obj.name] = bpy.data.meshes.new_from_object(obj, **keep)
            tracks[key].data = data[obj.name]
        track = tracks[key]
        room += track.size
        track.add(frame, matrix, points, form)
        room -= track.size
        # The largest gives way first, so that the many small ones stay as they are.
        while room < 0 and not (largest := max(tracks.values(), key=lambda track: track.size)).over:
            room += largest.size
            largest.thin()
            room -= largest.size
    reasons: dict[str, str] = {}
    for track in tracks.values():
        track.end(len(frames))
        if track.other:
            reasons[track.owner] = f"its faces change, {len(track.other) / len(frames):.0%} of the time"
        elif track.over or len(track.kept) > MOST_KEYS or len(track.kept) * track.corners > MOST_TARGET_VERTICES:
            reasons.setdefault(track.owner, f"baked it would take more than {max(track.over, track.size) / 1e6:.1f} MB")
    why = {track.name: reasons[track.owner] for track in tracks.values() if track.owner in reasons}
    baked = [track for track in tracks.values() if track.owner not in reasons]
    keep_out(clock, owners - reasons.keys() | {track.name for track in baked})
    for track in baked:
        there = np.isin(frames, track.seen)
        # Where it appears or disappears; the first frame always counts.
        turns = np.flatnonzero(np.diff(there, prepend=not there[0]))
        # A little early, so that what float32 makes of the time is not after it.
        at = [max(clock.seconds(frames[k]) * (1 - 1.2e-7) - 1e-6, 0.0) for k in turns]
        track.shown = [] if there.all() else list(zip(at, there[turns].astype(float)))
        track.times = [clock.seconds(frame) for frame, *_ in track.kept]
        stand_in(clock, track)
    return baked, why


def keep_out(clock: Clock, names: Iterable[str]) -> None:
    """Leave objects of the scene out of the export; their children stay in it."""
    groups = bpy.data.collections
    hidden = groups.get(NOT_EXPORTED) or groups.new(NOT_EXPORTED)
    for name in set(names) & set(clock.scene.objects.keys()) - set(hidden.objects.keys()):
        hidden.objects.link(clock.scene.objects[name])


def stand_in(clock: Clock, track: Track) -> None:
    """Put an object into the scene that shows a track's keys: its mesh or camera, with a shape key per key where it
    deforms."""
    track.object = bpy.data.objects.new("baked", track.data.copy() if track.deforms else track.data)
    clock.scene.collection.objects.link(track.object)
    if not track.deforms:
        track.object.matrix_world = Matrix(track.kept[0][1])
        return
    track.object.shape_key_clear()
    base = track.base
    for frame, _, points in (track.kept[base], *track.kept[:base], *track.kept[base + 1 :]):
        block = track.object.shape_key_add(name=f"frame {frame:g}", from_mix=False)
        block.data.foreach_set("co", points.astype(np.float32).ravel())
    track.object.data.vertices.foreach_set("co", track.kept[base][2].astype(np.float32).ravel())


def write_keys(tracks: list[Track], tree: dict, binary: bytearray) -> None:
    """Write the keys of what is baked into the GLB, and its names."""
    nodes = {node["name"]: k for k, node in enumerate(tree["nodes"])}
    for track in tracks:
        node = nodes[track.object.name]
        tree["nodes"][node]["name"] = track.name
        if track.deforms:
            # Key k shows target k alone; the base is no target.
            values = {"weights": np.delete(np.eye(len(track.kept)), track.base, axis=1)}
        else:
            turn = Matrix() if track.camera else Y_UP.transposed()  # a camera's axes are glTF's
            parts = [(Y_UP @ Matrix(matrix) @ turn).decompose() for _, matrix, _ in track.kept]
            places, turns, scales = (np.array([tuple(part) for part in parts]) for parts in zip(*parts))
            # Blender's quaternions have w first, glTF's last.
            values = {"translation": places, "rotation": turns[:, [1, 2, 3, 0]], "scale": scales}
        for path, keys in values.items() if len(track.kept) > 1 else ():
            add_keys(tree, binary, node, path, track.times, keys)
        if track.shown:
            # A scale of 0 hides the object.
            scales = np.repeat([[shows] for _, shows in track.shown], 3, axis=1)
            add_keys(tree, binary, node, "scale", [t for t, _ in track.shown], scales, "STEP")
