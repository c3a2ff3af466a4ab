"""Animations of a glTF file: selecting clips, also from other files, and the deformers of the meshes that follow
them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from blinkgl.config.deform import AnimationConfig
from blinkgl.errors import ConfigError
from blinkgl.scene.geometry.meshes import faces_with_area
from blinkgl.scene.importing import gltf
from blinkgl.scene.importing.parts import RawMesh, transformed
from blinkgl.scene.reading import existing
from blinkgl.scene.shapes.clips import PATHS, Clip, Playing, Track
from blinkgl.scene.shapes.skeleton import Skeleton, Still
from blinkgl.scene.shapes.skin import Morphs, Skin
from blinkgl.scene.types import Deformer, Mesh

Motion = Callable[[int], tuple[np.ndarray, np.ndarray]]


class Animation:
    """A clip of a file, ``tracks``, with its timing, ``playing``. document : whose nodes move.   skeleton : all of its
    nodes, in the file's world."""

    def __init__(self, document: gltf.Document, tracks: list[Track], playing: Playing):
        self.document, self.tracks, self.playing, self._places = document, tracks, playing, document.places
        self._tries: dict[tuple[int, int], list[np.ndarray]] = {}
        self.skeleton: Skeleton = document.skeleton(Clip(document.rest(), tracks, playing))
        self._moved: dict[int, list[Track]] = {}
        for track in (track for track in tracks if track.path in PATHS):
            self._moved.setdefault(track.joint, []).append(track)

    def moves(self, node: int) -> bool:
        """Return whether a node or one of its ancestors is moved."""
        return any(self._places[step] in self._moved for step in self.document.chain(node))

    def tracks_of(self, node: int) -> list[Track]:
        """Return the tracks that move a node or one of its ancestors."""
        return [track for step in self.document.chain(node) for track in self._moved.get(self._places[step], ())]

    def motion(self, node: int, turn: np.ndarray, before: np.ndarray) -> Motion:
        """Return the function that gives (turn @ T @ before, its rate), ((4, 4), (4, 4) 1/s), of a node's transform T
        to the file's world at a time in ns."""
        place = self._places[node]

        def at(t_ns: int) -> tuple[np.ndarray, np.ndarray]:
            world, rate = self.skeleton.at(int(t_ns))
            return turn @ world[place] @ before, turn @ rate[place] @ before

        return at

    def tries(self, node: int, t0_ns: int, t1_ns: int) -> list[np.ndarray]:
        """Return the node's transforms to the file's world at irregular times in [t0, t1], which no period meets."""
        if (t0_ns, t1_ns) not in self._tries:
            # The fractional parts of multiples of the golden ratio lie evenly and never repeat.
            times = (t0_ns + round((0.618033988749895 * k % 1) * (t1_ns - t0_ns)) for k in range(32))
            self._tries[t0_ns, t1_ns] = [self.skeleton.at(t)[0] for t in times]
        return [world[self._places[node]] for world in self._tries[t0_ns, t1_ns]]

    def deformer(
        self,
        node: int,
        raw: RawMesh,
        source: np.ndarray,
        at_rest: np.ndarray,
        turn: np.ndarray,
        on_path: bool = False,
    ) -> Deformer | None:
        """Return the deformer of a mesh made from one of a node's raw ones; None where it is rigid, or follows the
        object's path.

        source : (W,) index of the raw mesh's vertex of each of the mesh's.
        at_rest : (4, 4) from the raw mesh to the object's axes.
        turn : (4, 4) from the file's world to the object's axes.   on_path : the object's own path moves the node."""
        skin = self.document.nodes[node].skin
        bound = raw.binding if skin is not None else None
        morphs = self._morphs(node, raw, source, at_rest)
        where = f"{self.document.path.name}, mesh of node '{self.document.nodes[node].name}'"
        if bound is not None and skin is not None:
            # glTF ignores the transform of a node that shows a skin: the joints alone place its vertices.
            joints, bind = self.document.skin(skin)
            before = np.linalg.inv(at_rest)
            return Skin(
                self.skeleton,
                joints,
                bind,
                bound[0][source],
                bound[1][source],
                morphs,
                after=turn,
                before=before,
                where=where,
            )
        if self.moves(node) and not on_path:
            place = self._places[node]
            return Skin.rigid(
                self.skeleton, place, len(source), morphs, inverse_bind=np.linalg.inv(at_rest), after=turn, where=where
            )
        return None if morphs is None else Skin.morphing(morphs, where)

    def _morphs(self, node: int, raw: RawMesh, source: np.ndarray, at_rest: np.ndarray) -> Morphs | None:
        """Return the targets that have a weight at any time."""
        if raw.targets is None:
            return None
        positions, normals = raw.targets
        place, playing = self._places[node], self.playing
        mine = [t for t in self.tracks if t.joint == place and t.path == "weights"]
        whole = self.document.morph_weights(node, max(len(positions), 1))
        # Entry 1 of a cubic key is its value; 0 and 2 are tangents.
        values = [t.values[:, 1] if t.values.ndim == 3 else t.values for t in mine]
        # Targets whose weight is always 0 would cost memory on the card.
        used = np.flatnonzero(np.any([whole != 0, *(np.abs(v).max(axis=0) > 0 for v in values)], axis=0))
        if not len(used):
            return None

        def weights(t_ns: int) -> tuple[np.ndarray, np.ndarray]:
            time, speed = playing.at(t_ns)
            now, change = mine[-1].at(time) if mine else (whole, np.zeros(len(whole)))
            # ``change`` is per second of the clip, which plays at ``speed``.
            return now[used], speed * change[used]

        moving = bool(mine) and not playing.is_static
        morphs = Morphs(
            positions=positions[used],
            normals=None if normals is None else normals[used],
            weights=weights,
            is_static=not moving,
            period_ns=playing.period_ns if moving else None,
            span_ns=playing.span_ns if moving else 0,
            timescale_ns=playing.timescale_ns(mine),
            jumps=partial(playing.jumps, mine),
        )
        return morphs.taken(source).transformed(at_rest[:3, :3])


def play(document: gltf.Document, config: AnimationConfig, base: Path, where: str) -> Animation:
    """Return a file's animation as configured. where : key of the configuration.
    Raises ConfigError (a missing clip or file) and AssetError (an invalid clip)."""
    theirs = document
    if config.file is not None:
        theirs = gltf.read(existing(config.file, base, f"{where}.file", "a gltf or glb file"), materials=False)
    names = clip_names(theirs)
    index = names.index(config.clip) if config.clip in names else config.clip
    if not isinstance(index, int) or not 0 <= index < len(names):
        accepted = (
            f"one of: {', '.join(names)}, or an index below {len(names)}" if names else "null (the file has none)"
        )
        raise ConfigError("no such animation in the file", where=where, value=config.clip, accepted=accepted)
    tracks = theirs.tracks(index)
    if theirs is not document:
        tracks = _by_name(theirs, tracks, document, f"{where}.file", config.file or "")
    times = [track.times for track in tracks]
    # A clip begins at its own time 0, as in its file: its first key, when it comes later, is held until then.
    first = float(min(0.0, *(t[0] for t in times))) if times else 0.0
    last = float(max(first, *(t[-1] for t in times))) if times else 0.0
    return Animation(document, tracks, Playing(first, last, config.speed, config.phase - first, config.loop))


def meshes_at_rest(document: gltf.Document, node: int) -> tuple[list[RawMesh], np.ndarray]:
    """Return (meshes of a node at rest, (4, 4) from them to the file's world): a skin's joints are at their nodes,
    morph targets have the weights of the file."""
    mesh, skin = document.nodes[node].mesh, document.nodes[node].skin
    assert mesh is not None
    raws = document.raw_meshes(mesh)
    bound = skin is not None and any(raw.binding is not None for raw in raws)
    joints, bind = document.skin(skin) if bound and skin is not None else ([], np.zeros((0, 4, 4)))
    posed = [_at_rest(document, node, raw, joints, bind) for raw in raws]
    return posed, np.eye(4) if bound else document.world(node)


def _at_rest(document: gltf.Document, node: int, raw: RawMesh, joints: Sequence[int], bind: np.ndarray) -> RawMesh:
    """Return one of a node's meshes; in the file's world where there are joints."""
    if raw.targets is not None:
        positions, normals = raw.targets
        weights = document.morph_weights(node, len(positions))
        raw = replace(raw, vertices=raw.vertices + np.tensordot(weights, positions, 1), targets=None)
        if raw.normals is not None and normals is not None:
            raw = replace(raw, normals=raw.normals + np.tensordot(weights, normals, 1))
    if len(joints):
        shape = Mesh(raw.vertices, raw.faces, raw.normals, raw.uvs)  # type: ignore[arg-type]
        if raw.binding is None:  # follows the node, without joints
            return transformed(raw, document.world(node))
        skin = Skin(document.skeleton(Still(document.rest())), joints, bind, *raw.binding, where=document.path.name)
        # Joints that mirror turn faces and normals round.
        mirrored = skin.mirrored(0)
        turned = None if raw.normals is None else skin.normals(shape, 0) * np.where(mirrored, -1.0, 1.0)[:, None]
        faces = np.where(mirrored[raw.faces[:, :1]], raw.faces[:, ::-1], raw.faces)
        raw = replace(raw, vertices=skin.positions(shape, 0), normals=turned, binding=None, faces=faces)
    return raw


def shown(document: gltf.Document, node: int, animation: Animation | None) -> tuple[list[RawMesh], np.ndarray] | None:
    """Return :func:`meshes_at_rest` of a node, of an animated one those that its deformer moves; None where nothing of
    it is ever visible: it is hidden, has a scale of 0, or no surface."""
    n = document.nodes[node]
    if not n.shows:
        return None
    if animation is None:
        raws, world = meshes_at_rest(document, node)
    else:
        assert n.mesh is not None
        raws, world = document.raw_meshes(n.mesh), document.world(node)
        grows = any(track.path == "scale" for track in animation.tracks_of(node))
        if (grows or (n.skin is not None and raws)) and np.linalg.matrix_rank(world[:3, :3]) < 3:
            world = np.eye(4)  # a rest pose without size, from which no motion can start
    raws = [raw for raw in raws if len(raw.faces) and faces_with_area(raw.vertices @ world[:3, :3].T, raw.faces).any()]
    return (raws, world) if raws else None


def clip_names(document: gltf.Document) -> list[str]:
    """Return the names of a file's animations; the index of an unnamed one."""
    return [str(a.get("name", i)) for i, a in enumerate(document.tree.get("animations", []))]


def _by_name(theirs: gltf.Document, tracks: list[Track], mine: gltf.Document, where: str, file: str) -> list[Track]:
    """Return tracks of another file's nodes on the nodes of the same names; those of missing nodes are left out and
    reported."""
    # In reverse order, so that the first node of a name is kept.
    places = {node.name: place for place, node in reversed(list(enumerate(mine.nodes.values())))}
    names = [node.name for node in theirs.nodes.values()]
    matrices = {node.name for node in mine.nodes.values() if node.matrix is not None}
    matching = [
        Track(places[names[t.joint]], t.path, t.times, t.values, t.interpolation)
        for t in tracks
        if names[t.joint] in places and t.path in PATHS and names[t.joint] not in matrices
    ]
    if not matching:
        raise ConfigError(
            "the clip's file moves no joint with a name of this file",
            where=where,
            value=file,
            accepted="a file with joints such as: " + ", ".join(list(places)[:5]),
        )
    if missing := {names[t.joint] for t in tracks} - set(places):
        some = sorted(missing)
        listed = ", ".join(some[:5]) + (", …" if len(some) > 5 else "")
        mine.omissions.add(f"joints of '{Path(file).name}' that it has not: {listed}")
    return matching
