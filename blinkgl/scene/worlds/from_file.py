"""Complete scenes from glTF files.

    scene = from_document(gltf.read("room.glb"), camera, t0_ns, t1_ns)

``camera`` is a :class:`~blinkgl.camera.CameraModel`. Each node that shows a mesh becomes one object; a node's scale is
baked into its vertices, the rest is its rigid pose. Cameras, which look along -z with y up, get OpenCV axes. glTF's
world (y up) is turned z up.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from blinkgl.camera import CameraModel, PinHole, focal_length
from blinkgl.config.deform import AnimationConfig, animation_of
from blinkgl.config.scene import FileSceneConfig
from blinkgl.errors import AssetError, ConfigError
from blinkgl.scene.importing import gltf
from blinkgl.scene.importing.animations import Animation, Motion, clip_names, play, shown
from blinkgl.scene.importing.mesh_files import border_of
from blinkgl.scene.importing.parts import WHOLE, Z_UP, DeformerOf, RawMesh, part_of, transformed
from blinkgl.scene.lights import MAX_LAMPS, lamp_of_gltf, make_light
from blinkgl.scene.motion.paths import AffinePath, StaticPath, nearest_rotation
from blinkgl.scene.motion.pose_path import PosePath
from blinkgl.scene.reading import existing, reading
from blinkgl.scene.rig import Rig
from blinkgl.scene.surfaces.images import content_hash
from blinkgl.scene.types import Light, Part, Scene, SceneObject
from blinkgl.scene.worlds.explicit import lamp_paths, motion_path
from blinkgl.scene.worlds.sky import with_environment
from blinkgl.types.poses import pose_of

CV_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])  # its own inverse


def scene_from_file(config: FileSceneConfig, camera: CameraModel, t0_ns: int, t1_ns: int, base: Path) -> Scene:
    """Return the scene of ``scene: {kind: file}``."""
    path = existing(config.path, base, "scene.path", "a gltf or glb file")
    if path.suffix.lower() not in (".gltf", ".glb"):
        raise ConfigError("not a glTF scene", where="scene.path", value=config.path, accepted="a .gltf or .glb file")
    log: list[str] = []
    camera_path = None
    if config.pose is not None:
        camera_path = motion_path(config.pose, t0_ns, t1_ns, "scene.pose", base, camera=True, log=log)
    own = config.lights == "file"
    with reading("scene", str(path)):
        limits = {"max_faces": config.max_faces, "max_texture": config.max_texture_size}
        scene = from_document(
            gltf.read(path, **limits, border=border_of(path, base), lights=own),
            camera,
            t0_ns,
            t1_ns,
            camera_name=config.camera,
            camera_path=camera_path,
            intrinsics=config.intrinsics,
            animation=config.animation,
            base=base,
            light=make_light(config.light, lamp_paths(t0_ns, t1_ns, base, log)),
            lights_gain=config.lights_gain if own else None,
        )
    light, objects = with_environment(config.light.environment, scene.light, base, scene.objects)
    changes: dict = {"unlit": True} if config.light.unlit else {}
    changes |= {} if config.both_sides is None else {"both_sides": config.both_sides}
    scene = replace(scene, light=light, objects=objects, background=config.background, log=(*scene.log, *log))
    return dressed(scene, **changes)


def from_document(
    document: gltf.Document,
    camera: CameraModel,
    t0_ns: int,
    t1_ns: int,
    *,
    camera_name: str | int | None = None,
    camera_path: PosePath | None = None,
    intrinsics: str = "config",
    animation: str | int | AnimationConfig | None = 0,
    base: Path | str = ".",
    light: Light = Light(),
    lights_gain: float | None = None,
) -> Scene:
    """Return the scene of a parsed glTF 2.0 file, with its materials, cameras and node animations.

    camera_name : name or index of the file's camera (None: the first), unless ``camera_path`` is given.
    intrinsics : "config": those of ``camera``; "file": fx = fy = height / 2 / tan(yfov / 2), centred, near = znear.
    animation : name or index, or more (:class:`~blinkgl.config.deform.AnimationConfig`, whose files are below
        ``base``). Motion is exact between key frames. What a rigid path cannot represent (changing scales, jumps,
        skins, morph targets) deforms the object's shape.
    lights_gain : None: only ``light``. A number: the factor on the file's lights, which replace its sun. Features of
    the file that are not drawn are in the scene's ``omissions``.
    Raises AssetError (file), ConfigError (missing camera, animation or lights).
    """
    playing = _animation(document, animation, Path(base))
    if lights_gain is not None:
        light = _with_lights(document, playing, t0_ns, t1_ns, light, lights_gain)
    objects = _objects(document, playing, t0_ns, t1_ns)
    if camera_path is None or intrinsics == "file":
        index = _camera_node(document, camera_name)
        if document.tree["cameras"][document.nodes[index].camera]["type"] == "orthographic":
            document.omissions.add("an orthographic camera (drawn in perspective)")
        if camera_path is None:
            camera_path, _ = _motion(document, index, playing, t0_ns, t1_ns, CV_FROM_GL)
        if intrinsics == "file":
            camera = _gltf_intrinsics(document, index, camera)
    rig, log = Rig.alone(camera, camera_path), tuple(dict.fromkeys(document.log))
    return Scene(objects, rig, t0_ns, t1_ns, light, log=log, omissions=document.omissions.lines())


def _objects(document: gltf.Document, animation: Animation | None, t0_ns: int, t1_ns: int) -> tuple[SceneObject, ...]:
    """Return an object for each node that shows a mesh, numbered from 1, with distinct names."""
    made: list[SceneObject] = []
    names: set[str] = set()
    for index, node in document.nodes.items():
        shown_object = _object(document, index, animation, t0_ns, t1_ns)
        if shown_object is not None:
            name = node.name if node.name not in names else f"{node.name}#{len(made)}"
            names.add(name)
            made.append(SceneObject(name, len(made) + 1, *shown_object))
    if not made and not any(node.mesh is not None for node in document.nodes.values()):
        raise AssetError("the scene has no faces", where=document.where, accepted="a scene with a mesh")
    if not made:
        document.omissions.add(WHOLE)
    return tuple(made)


def _object(
    document: gltf.Document, index: int, animation: Animation | None, t0_ns: int, t1_ns: int
) -> tuple[tuple[Part, ...], PosePath] | None:
    """Return (parts, path) of a node that shows a mesh; None: one of which nothing is visible."""
    node, clip = document.nodes[index], shown(document, index, animation)
    if clip is None:
        return None
    raws, world = clip
    if animation is None:
        place, baked = split_rigid(Z_UP @ world)
        return _parts(raws, baked, node.name, document), StaticPath(place, t0_ns, t1_ns)
    skinned = node.skin is not None and any(raw.binding is not None for raw in raws)
    if skinned or _beyond_a_path(animation, index, t0_ns, t1_ns):
        # The shape itself moves, in the scene's axes.
        baked = Z_UP @ world
        deformer = partial(animation.deformer, index, at_rest=baked, turn=Z_UP)
        return _parts(raws, baked, node.name, document, deformer), StaticPath(None, t0_ns, t1_ns)
    path, baked = _motion(document, index, animation, t0_ns, t1_ns)
    deformer = None
    if any(raw.targets is not None for raw in raws):
        deformer = partial(animation.deformer, index, at_rest=baked, turn=np.eye(4), on_path=True)
    return _parts(raws, baked, node.name, document, deformer), path


def dressed(scene: Scene, **changes: bool) -> Scene:
    """Return the scene with these ``changes`` to all materials."""

    def of(parts):
        return tuple(Part(p.mesh, replace(p.material, **changes)) for p in parts)

    return replace(scene, objects=tuple(replace(o, parts=of(o.parts)) for o in scene.objects))


def split_rigid(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (T, A), both (4, 4), with matrix = T @ A: T rigid, its rotation the nearest to the linear part (polar
    decomposition), A the rest: scale, shear, reflection."""
    matrix = np.asarray(matrix, np.float64)
    linear = matrix[:3, :3]
    if not np.isfinite(matrix).all():
        raise AssetError("a node's transform is not finite", where="scene", value=matrix.tolist())
    rotation = nearest_rotation(linear)
    return pose_of(matrix[:3, 3], rotation), pose_of(axes=rotation.T @ linear)


def _parts(
    raws: list[RawMesh], baked: np.ndarray, name: str, document: gltf.Document, deformer: DeformerOf | None = None
) -> tuple[Part, ...]:
    """Return the parts of one node. baked : (4, 4) from its meshes to the object's axes."""
    parts = []
    for raw in (transformed(raw, baked) for raw in raws if len(raw.faces)):
        digest = content_hash(raw.vertices.tobytes(), np.ascontiguousarray(raw.faces, np.int64).tobytes())
        origin = {"name": name, "where": document.where, "source_hash": digest, "log": document.log}
        parts.append(part_of(raw, **origin, deformer=deformer))
    return tuple(parts)


# ---- glTF
def _animation(document: gltf.Document, given: str | int | AnimationConfig | None, base: Path) -> Animation | None:
    names = clip_names(document)
    if given is None or (given == 0 and not names):
        return None
    if len(names) > 1 and given == 0:
        document.omissions.add(f"animations beside '{names[0]}' (scene.animation chooses one of: {', '.join(names)})")
    animation = animation_of(given, loop=False)
    assert animation is not None
    return play(document, animation, base, "scene.animation")


def _beyond_a_path(animation: Animation, node: int, t0_ns: int, t1_ns: int) -> bool:
    """Return whether a node's motion is not a rigid path: it jumps, or its scale changes, as it also does where it
    turns below a node of unequal scales."""
    tracks = animation.tracks_of(node)
    if any(t.interpolation == "STEP" or (t.path == "scale" and np.ptp(t.values, axis=0).max() > 0) for t in tracks):
        return True
    shapes = animation.tries(node, t0_ns, t1_ns) if tracks else [np.eye(4)]
    # A shape that only turns keeps the products of its columns.
    products = np.array([shape[:3, :3].T @ shape[:3, :3] for shape in shapes])
    return bool((np.ptp(products, axis=0) > 1e-6 * np.abs(products).max()).any())


def _rigid(animation: Animation, node: int, t_ns: int) -> tuple[Motion, np.ndarray]:
    """Return (a node's motion without the matrix that is baked into its vertices, that matrix, of a time)."""
    baked = split_rigid(animation.motion(node, Z_UP, np.eye(4))(t_ns)[0])[1]
    # A node with a scale of 0 has no inverse.
    before = np.linalg.inv(baked) if np.linalg.matrix_rank(baked) == 4 else np.eye(4)
    return animation.motion(node, Z_UP, before), baked


_HERE = np.eye(4)


def _motion(
    document: gltf.Document,
    node: int,
    animation: Animation | None,
    t0_ns: int,
    t1_ns: int,
    local: np.ndarray = _HERE,
) -> tuple[PosePath, np.ndarray]:
    """Return (PosePath of T_world_node @ local, matrix to bake into the node's vertices)."""
    rest, baked = split_rigid(Z_UP @ document.world(node))
    if animation is None or not animation.moves(node):
        return StaticPath(rest @ local, t0_ns, t1_ns), baked
    motion, baked = _rigid(animation, node, t0_ns)
    clip, tracks = animation.playing, animation.tracks
    timing = clip.span_ns, clip.timescale_ns(tracks), partial(clip.jumps, tracks)
    return AffinePath(motion, t0_ns, t1_ns, local, *timing), baked


def _with_lights(
    document: gltf.Document, animation: Animation | None, t0_ns: int, t1_ns: int, light: Light, gain: float
) -> Light:
    """Return the light with the file's lights instead of the sun: the strongest, where there are too many."""
    lights = document.lights()
    if not lights:
        raise ConfigError("the file has no lights", where="scene.lights", value="file", accepted="config")
    # The configuration's own lamps come first; of the file's, the brightest fill the rest.
    room = MAX_LAMPS - len(light.lamps)
    kept = sorted(lights, key=lambda node: -lights[node]["intensity"] * max(lights[node]["color"]))[:room]
    if len(lights) > room:
        document.omissions.add(f"{len(lights) - room} of {len(lights)} lights (the weakest; at most {room} shine)")
    # In the order of the file again, so that the numbers of lamps do not depend on their brightness.
    lamps = [
        lamp_of_gltf(lights[node], _motion(document, node, animation, t0_ns, t1_ns)[0], gain) for node in sorted(kept)
    ]
    return replace(light, sun=0.0, lamps=(*light.lamps, *lamps))


def _camera_node(document: gltf.Document, name: str | int | None) -> int:
    holders = {i: (n.name, n.camera) for i, n in document.nodes.items() if n.camera is not None}
    if not holders:
        raise ConfigError(
            "the file has no camera", where="scene.pose", accepted="a camera pose here, or a file with a camera"
        )
    names = {}
    for i, (own_name, camera) in holders.items():
        cameras = document.tree.get("cameras", [])
        if camera >= len(cameras):
            raise AssetError(
                "the file is no valid glTF (a reference to cameras that does not exist)",
                where=document.where,
                value=camera,
            )
        # A camera may be asked for by its own name or its node's; the first of several wins.
        names.setdefault(str(cameras[camera].get("name", own_name)), i)
        names.setdefault(own_name, i)
    order = list(holders)
    if name is None:
        if len(order) > 1:
            document.omissions.add(
                f"cameras beside '{next(iter(names))}' (scene.camera chooses one of: {', '.join(names)})"
            )
        return order[0]
    if isinstance(name, int) and 0 <= name < len(order):
        return order[name]
    if name in names:
        return names[name]
    raise ConfigError(
        "no such camera in the file",
        where="scene.camera",
        value=name,
        accepted=f"one of: {', '.join(names)}, or an index below {len(order)}",
    )


def _gltf_intrinsics(document: gltf.Document, node: int, camera: CameraModel) -> PinHole:
    description = document.tree["cameras"][document.nodes[node].camera]
    perspective = description.get("perspective", {})
    yfov = perspective.get("yfov")
    if description["type"] != "perspective" or yfov is None:
        raise AssetError(
            "the camera is not a perspective one with a valid yfov",
            where=document.where,
            value=yfov,
            accepted="intrinsics: config",
        )
    znear = perspective.get("znear", camera.near)
    return PinHole.centred(
        camera.width,
        camera.height,
        focal_length(camera.height, yfov),
        near=float(znear) if 1e-9 <= znear <= 1e9 else camera.near,
    )
