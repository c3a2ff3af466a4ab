"""Finished scenes: glTF files, ``trimesh.Scene`` and ``pyrender.Scene`` objects.

    scene = from_gltf("room.glb", camera, t0_ns, t1_ns)
    scene = from_trimesh(trimesh.load_scene("room.obj"), camera, t0_ns, t1_ns)
    scene = from_pyrender(pyrender_scene, camera, t0_ns, t1_ns)

``camera`` is a :class:`~blinkgl.camera.CameraModel`. Each node that shows a mesh becomes one object; a
node's scale is baked into its vertices, what remains is its rigid pose. Cameras, which look along -z with y up in all
three, get OpenCV axes. glTF's world (y up) is turned z up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.camera import CameraModel, PinHole, focal_length
from blinkgl.config.deform import AnimationConfig, animation_of
from blinkgl.config.scene import FileSceneConfig
from blinkgl.errors import AssetError, ConfigError
from blinkgl.scene.geometry.meshes import closed_together, make_mesh
from blinkgl.scene.importing import gltf
from blinkgl.scene.importing.animations import Animation, clip_names, play, rest_pieces
from blinkgl.scene.importing.mesh_files import has_own_vertices, with_own_vertices
from blinkgl.scene.lights import MAX_LAMPS, lamp_of_gltf, make_light
from blinkgl.scene.motion.paths import KeyframePath, StaticPath
from blinkgl.scene.omissions import Omissions
from blinkgl.scene.reading import reading
from blinkgl.scene.rig import Rig
from blinkgl.scene.shapes.deformer import Deformer
from blinkgl.scene.surfaces.images import content_hash, shrink
from blinkgl.scene.types import Light, Material, Part, PosePath, Scene, SceneObject, Texture
from blinkgl.scene.worlds.explicit import motion_path
from blinkgl.scene.worlds.pool import resolve
from blinkgl.scene.worlds.sky import with_environment

if TYPE_CHECKING:
    import trimesh

CV_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])  # its own inverse
_ANIMATION_STEP = 1 / 60  # s between the samples that a spline is laid through
_MAX_SAMPLES = 20_000


def scene_from_file(config: FileSceneConfig, camera: CameraModel, t0_ns: int, t1_ns: int, base: Path) -> Scene:
    """A ``scene: {kind: file}``."""
    path = resolve(config.path, base)
    if not path.is_file():
        raise ConfigError("no such file", where="scene.path", value=config.path, accepted="a gltf or glb file")
    if path.suffix.lower() not in (".gltf", ".glb"):
        raise ConfigError("not a glTF scene", where="scene.path", value=config.path, accepted="a .gltf or .glb file")
    camera_path = (
        None if config.pose is None else motion_path(config.pose, t0_ns, t1_ns, "scene.pose", base, camera=True)
    )
    scene = from_gltf(
        path,
        camera,
        t0_ns,
        t1_ns,
        camera_name=config.camera,
        camera_path=camera_path,
        intrinsics=config.intrinsics,
        animation=config.animation,
        base=base,
        light=make_light(config.light),
        lights_gain=config.lights_gain if config.lights == "file" else None,
        background=config.background,
        max_faces=config.max_faces,
        max_texture=config.max_texture_size,
    )
    light, objects = with_environment(config.light.environment, scene.light, base, scene.objects)
    scene = replace(scene, light=light, objects=objects)
    return unlit(scene) if config.light.unlit else scene


def from_gltf(
    path: Path | str,
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
    background: float = 0.2,
    max_faces: int = 5_000_000,
    max_texture: int = 2048,
) -> Scene:
    """A glTF 2.0 file with its materials, cameras and node animations.

    camera_name : name or index of the file's camera (None: the first), unless ``camera_path`` is given.
    intrinsics : "config": those of ``camera``; "file": fx = fy = height / 2 / tan(yfov / 2), centred, near = znear.
    animation : name or index, or more (:class:`~blinkgl.config.deform.AnimationConfig`, whose files are below
    ``base``).
        Translations and rotations of nodes are sampled at 60 Hz and joined by a C2 spline; what a path cannot be
        (scales that change, jumps, skins, morph targets) changes the object's shape instead, exactly.
    lights_gain : None: ``light`` alone shines. A number: the file's own lights, times it, in the place of its sun.
    What the file asks for and is not drawn is in the scene's ``omissions``.
    Raises AssetError (file), ConfigError (camera, animation or lights that are not there).
    """
    with reading("scene", str(path)):
        own = lights_gain is not None
        document = gltf.read(Path(path), max_faces=max_faces, max_texture=max_texture, lights=own)
        return _from_document(
            document,
            camera,
            t0_ns,
            t1_ns,
            camera_name,
            camera_path,
            intrinsics,
            _animation(document, animation, Path(base)),
            light,
            lights_gain,
            background,
        )


def _from_document(
    document: gltf.Document,
    camera,
    t0_ns,
    t1_ns,
    camera_name,
    camera_path,
    intrinsics,
    animation,
    light,
    lights_gain,
    background,
) -> Scene:
    if lights_gain is not None:
        light = _with_lights(document, animation, t0_ns, t1_ns, light, lights_gain)
    objects = []
    for index, node in document.nodes.items():
        if node.mesh is None:
            continue
        if animation is None:
            pieces, world = rest_pieces(document, index)
            if any(len(p.faces) for p in pieces):
                place, baked = split_rigid(gltf.Z_UP @ world)
                parts = _parts(pieces, baked, node.name, document.where, document.log)
                objects.append((node.name, parts, StaticPath(place, t0_ns, t1_ns)))
            continue
        pieces = document.mesh_pieces(node.mesh, changing=True)
        if not any(len(p.faces) for p in pieces):
            continue
        skinned = node.skin is not None and any(p.binding is not None for p in pieces)
        if skinned or _beyond_a_path(animation, index):
            motion, baked, on_path, turn = (
                StaticPath(None, t0_ns, t1_ns),
                gltf.Z_UP @ document.world(index),
                False,
                gltf.Z_UP,
            )
        else:
            motion, baked = _motion(document, index, animation, t0_ns, t1_ns)
            on_path, turn = True, np.eye(4)

        deformer = None
        if skinned or not on_path or any(p.targets is not None for p in pieces):
            deformer = partial(animation.deformer, index, at_rest=baked, turn=turn, on_path=on_path)
        parts = _parts(pieces, baked, node.name, document.where, document.log, deformer)
        objects.append((node.name, parts, motion))
    if not objects:
        raise AssetError("the scene has no faces", where=document.where, accepted="a scene with a mesh")
    if camera_path is None or intrinsics == "file":
        index = _camera_node(document, camera_name)
        if document.tree["cameras"][document.nodes[index].camera]["type"] == "orthographic":
            document.omissions.add("an orthographic camera (drawn in perspective)")
        if camera_path is None:
            camera_path, _ = _motion(document, index, animation, t0_ns, t1_ns, CV_FROM_GL)
        if intrinsics == "file":
            camera = _gltf_intrinsics(document, index, camera)
    return _scene(
        objects, Rig.alone(camera, camera_path), t0_ns, t1_ns, light, background, document.log, document.omissions
    )


def from_trimesh(
    scene: trimesh.Scene | trimesh.Trimesh,
    camera: CameraModel | None = None,
    t0_ns: int = 0,
    t1_ns: int = 1_000_000_000,
    *,
    camera_path: PosePath | None = None,
    up: str = "z",
    near: float = 0.05,
    light: Light = Light(),
    background: float = 0.2,
    max_faces: int = 5_000_000,
    max_texture: int = 2048,
) -> Scene:
    """A ``trimesh.Scene``.

    camera : intrinsics; None takes the scene's own camera (resolution, K).
    camera_path : None takes the scene's camera transform.
    up : "y" turns the world z up. Normals are made anew (crease angle), because trimesh's round off every edge.
    """
    from blinkgl.scene.importing.trimesh_pieces import piece_of_trimesh

    turn = _turn(up)
    log, omissions = [], Omissions("the trimesh scene")
    objects = []
    for name in sorted(scene.graph.nodes_geometry):
        matrix, geometry = scene.graph[name]
        mesh = scene.geometry[geometry]
        if not hasattr(mesh, "faces") or not len(mesh.faces):
            omissions.add("points and lines")
            continue
        where = f"trimesh geometry '{geometry}'"
        if len(mesh.faces) > max_faces:
            raise AssetError(
                "the mesh has too many faces", where=where, value=len(mesh.faces), accepted=f"at most {max_faces}"
            )
        rigid, baked = split_rigid(turn @ matrix)
        piece = piece_of_trimesh(mesh, max_texture=max_texture, where=where, file_normals=False, omissions=omissions)
        objects.append((str(name), _parts([piece], baked, str(name), where, log), StaticPath(rigid, t0_ns, t1_ns)))
    if (camera is None or camera_path is None) and not scene.has_camera:
        raise ConfigError(
            "the trimesh scene has no camera",
            where="from_trimesh",
            accepted="camera and camera_path, or scene.set_camera()",
        )
    if camera_path is None:
        camera_path = StaticPath(split_rigid(turn @ scene.camera_transform)[0] @ CV_FROM_GL, t0_ns, t1_ns)
    if camera is None:
        (width, height), (fx, fy) = (int(v) for v in scene.camera.resolution), scene.camera.focal
        camera = PinHole.centred(width, height, float(fx), float(fy), near)
    if not objects:
        raise AssetError("the scene has no faces", where="from_trimesh", accepted="a scene with a mesh")
    return _scene(objects, Rig.alone(camera, camera_path), t0_ns, t1_ns, light, background, log, omissions)


def from_pyrender(
    scene: Any,
    camera: CameraModel,
    t0_ns: int = 0,
    t1_ns: int = 1_000_000_000,
    *,
    camera_path: PosePath | None = None,
    intrinsics: str = "file",
    up: str = "z",
    light: Light | None = None,
    background: float | None = None,
    max_texture: int = 2048,
) -> Scene:
    """A ``pyrender.Scene`` (pyrender itself is not imported here).

    camera : width, height and, with intrinsics="config", the rest; "file" takes the main
    camera's yfov or fx, fy, cx, cy.
    light : None takes the direction of the first directional light, if there is one; strengths are BlinkGL's.
    background : None takes the mean of ``scene.bg_color``.
    """
    turn = _turn(up)
    log, omissions = [], Omissions("the pyrender scene")
    objects = []
    # pyrender keeps nodes in a set: order them by what they are.
    order = sorted(
        scene.mesh_nodes,
        key=lambda n: (
            str(n.name or n.mesh.name or ""),
            np.asarray(scene.get_pose(n)).tobytes(),
            [np.asarray(p.positions).tobytes() for p in n.mesh.primitives],
        ),
    )
    for number, node in enumerate(order):
        name = str(node.name or node.mesh.name or f"mesh-{number}")
        pieces = [_pyrender_piece(p, max_texture, name) for p in node.mesh.primitives if getattr(p, "mode", 4) == 4]
        if len(pieces) < len(node.mesh.primitives):
            omissions.add("points and lines")
        if not pieces:
            continue
        _pyrender_omissions(node.mesh.primitives, omissions)
        rigid, baked = split_rigid(turn @ scene.get_pose(node))
        objects.append(
            (name, _parts(pieces, baked, name, f"pyrender mesh '{name}'", log), StaticPath(rigid, t0_ns, t1_ns))
        )
    if not objects:
        raise AssetError("the scene has no faces", where="from_pyrender", accepted="a scene with a mesh")
    node = scene.main_camera_node
    if node is None and (camera_path is None or intrinsics == "file"):
        raise ConfigError(
            "the pyrender scene has no camera",
            where="from_pyrender",
            accepted="a camera node, or camera_path and intrinsics='config'",
        )
    if camera_path is None:
        camera_path = StaticPath(split_rigid(turn @ scene.get_pose(node))[0] @ CV_FROM_GL, t0_ns, t1_ns)
    if intrinsics == "file":
        camera = _pyrender_intrinsics(node.camera, camera)
    if light is None:
        suns = sorted(getattr(scene, "directional_light_nodes", ()), key=lambda n: str(n.name or ""))
        light = Light()
        if suns:  # it shines along its -z axis
            T, _ = split_rigid(turn @ scene.get_pose(suns[0]))
            light = replace(light, sun_direction=tuple(float(v) for v in T[:3, 2]))
    if background is None:
        background = float(np.mean(np.asarray(scene.bg_color, float)[:3]))
    return _scene(objects, Rig.alone(camera, camera_path), t0_ns, t1_ns, light, background, log, omissions)


def unlit(scene: Scene) -> Scene:
    """The scene with radiance = albedo everywhere."""

    def of(parts):
        return tuple(Part(p.mesh, replace(p.material, unlit=True)) for p in parts)

    return replace(scene, objects=tuple(replace(o, parts=of(o.parts)) for o in scene.objects))


def split_rigid(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T, A), both (4, 4), with matrix = T @ A: T rigid, its rotation the nearest to the linear part (polar
    decomposition), A what is left: scale, shear, mirroring."""
    matrix = np.asarray(matrix, np.float64)
    linear = matrix[:3, :3]
    if not np.isfinite(matrix).all() or abs(np.linalg.det(linear)) < 1e-300:
        raise AssetError("a node's transform is singular or not finite", where="scene", value=matrix.tolist())
    u, _, vt = np.linalg.svd(linear)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    T, A = np.eye(4), np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, matrix[:3, 3]
    A[:3, :3] = rotation.T @ linear
    return T, A


def _scene(objects: Iterable, rig: Rig, t0_ns, t1_ns, light, background, log, omissions: Omissions) -> Scene:
    made, names = [], set()
    for k, (name, parts, path) in enumerate(objects):
        name = name if name not in names else f"{name}#{k}"
        names.add(name)
        made.append(SceneObject(name, k + 1, parts, path))
    return Scene(tuple(made), rig, t0_ns, t1_ns, light, background, tuple(dict.fromkeys(log)), omissions.lines())


def _parts(
    pieces: list[gltf.Piece],
    baked: np.ndarray,
    name: str,
    where: str,
    log: list[str],
    deformer: Callable[[gltf.Piece, np.ndarray], Deformer | None] | None = None,
) -> tuple[Part, ...]:
    parts = []
    for piece in (gltf.transformed(p, baked) for p in pieces if len(p.faces)):
        source: list[np.ndarray] | None = [] if deformer is not None or has_own_vertices(piece) else None
        textured = piece.material is not None and piece.material.texture is not None
        mesh = make_mesh(
            piece.vertices,
            piece.faces,
            normals=piece.normals,
            uvs=piece.uvs,
            name=name,
            where=where,
            source_hash=content_hash(piece.vertices.tobytes(), np.ascontiguousarray(piece.faces, np.int64).tobytes()),
            project_degenerate=not textured,
            log=log,
            source=source,
        )
        if source is not None and has_own_vertices(piece):
            mesh = with_own_vertices(mesh, piece, source)
        if deformer is not None and source is not None:
            mesh = replace(mesh, deformer=deformer(piece, source[0]))
        parts.append(Part(mesh, piece.material or Material()))
    if closed_together(tuple(p.mesh for p in parts)):
        parts = [Part(replace(p.mesh, closed=True), p.material) for p in parts]
    return tuple(parts)


def _turn(up: str) -> np.ndarray:
    if up not in ("y", "z"):
        raise ConfigError("unknown up axis", value=up, accepted="y or z")
    return gltf.Z_UP if up == "y" else np.eye(4)


# ---- glTF
def _animation(document: gltf.Document, given: str | int | AnimationConfig | None, base: Path) -> Animation | None:
    names = clip_names(document)
    if given is None or (given == 0 and not names):
        return None
    if len(names) > 1 and given == 0:
        document.omissions.add(f"animations beside '{names[0]}' (scene.animation chooses one of: {', '.join(names)})")
    return play(document, animation_of(given, loop=False), base, "scene.animation")


def _beyond_a_path(animation: Animation, node: int) -> bool:
    """Whether a node moves in a way that is no rigid path: its scale changes, or it jumps."""
    return any(
        track.interpolation == "STEP" or (track.path == "scale" and np.ptp(track.values, axis=0).max() > 0)
        for track in animation.tracks_of(node)
    )


_HERE = np.eye(4)


def _motion(
    document: gltf.Document,
    node: int,
    animation: Animation | None,
    t0_ns: int,
    t1_ns: int,
    local: np.ndarray = _HERE,
):
    """(PosePath of T_world_node @ local, matrix to bake into the node's vertices)."""
    mine = [] if animation is None else animation.tracks_of(node)
    rest, baked = split_rigid(gltf.Z_UP @ document.world(node))
    if animation is None or not mine:
        return StaticPath(rest @ local, t0_ns, t1_ns), baked
    times = animation.sample_times([track.times for track in mine], t0_ns, t1_ns, _ANIMATION_STEP, _MAX_SAMPLES)
    place = document.places[node]
    poses, first = [], None
    for t in times:
        T, A = split_rigid(gltf.Z_UP @ animation.skeleton.at(int(t))[0][place])
        first = A if first is None else first
        poses.append(T @ local)
    if any(track.interpolation == "STEP" for track in mine):
        document.log.append(
            f"{document.path.name}: jumps in the animation of node '{document.nodes[node].name}' are smoothed"
        )
    poses = np.stack(poses)
    return KeyframePath(times, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]), "spline", document.where), first


def _with_lights(
    document: gltf.Document, animation: Animation | None, t0_ns: int, t1_ns: int, light: Light, gain: float
) -> Light:
    """The file's lights in the place of the sun: the strongest, where there are too many."""
    found = document.lights()
    if not found:
        raise ConfigError("the file has no lights", where="scene.lights", value="file", accepted="config")
    room = MAX_LAMPS - len(light.lamps)
    kept = sorted(found, key=lambda node: -found[node]["intensity"] * max(found[node]["color"]))[:room]
    if len(found) > room:
        document.omissions.add(f"{len(found) - room} of {len(found)} lights (the weakest; at most {room} shine)")
    lamps = [
        lamp_of_gltf(found[node], _motion(document, node, animation, t0_ns, t1_ns)[0], gain) for node in sorted(kept)
    ]
    return replace(light, sun=0.0, lamps=(*light.lamps, *lamps))


def _camera_node(document: gltf.Document, name: str | int | None) -> int:
    found = {i: n for i, n in document.nodes.items() if n.camera is not None}
    if not found:
        raise ConfigError(
            "the file has no camera", where="scene.pose", accepted="a camera pose here, or a file with a camera"
        )
    names = {}
    for i, n in found.items():
        cameras = document.tree.get("cameras", [])
        if n.camera >= len(cameras):
            raise AssetError(
                "the file is no valid glTF (a reference to cameras that does not exist)",
                where=document.where,
                value=n.camera,
            )
        names.setdefault(str(cameras[n.camera].get("name", n.name)), i)
        names.setdefault(n.name, i)
    order = list(found)
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


# ---- pyrender
def _pyrender_omissions(primitives, omissions: Omissions) -> None:
    for primitive in primitives:
        if getattr(primitive, "color_0", None) is not None:
            omissions.add("vertex colours (left out)")
        material = primitive.material
        if getattr(material, "alphaMode", None) not in (None, "OPAQUE"):
            omissions.add(f"alpha {material.alphaMode} (drawn opaque)")
        if np.any(getattr(material, "emissiveFactor", None)):
            omissions.add("emissive light")
        if getattr(material, "normalTexture", None) is not None:
            omissions.add("normal maps")


def _pyrender_piece(primitive, max_texture: int, name: str) -> gltf.Piece:
    positions = np.asarray(primitive.positions, np.float64)
    faces = (
        np.arange(len(positions)).reshape(-1, 3)
        if primitive.indices is None
        else np.asarray(primitive.indices).reshape(-1, 3)
    )
    uvs = (
        None if primitive.texcoord_0 is None else np.asarray(primitive.texcoord_0, np.float64)[:, :2] * [1, -1] + [0, 1]
    )
    source = primitive.material
    material = None
    if source is not None:
        factor = getattr(source, "baseColorFactor", None)
        texture = getattr(getattr(source, "baseColorTexture", None), "source", None)
        if texture is not None:
            image = np.asarray(texture.convert("RGB") if hasattr(texture, "convert") else texture)
            image = np.round(image * 255).astype(np.uint8) if image.dtype.kind == "f" else image
            image = image[..., None] if image.ndim == 2 else image
            image = image[..., :3] if image.shape[2] >= 3 else np.repeat(image[..., :1], 3, axis=2)
            texture = Texture(
                shrink(np.ascontiguousarray(image), max_texture), f"{name} texture", content_hash(image.tobytes())
            )
        colour = (1.0, 1.0, 1.0) if factor is None else tuple(float(c) for c in np.asarray(factor, float)[:3])
        material = Material(texture, colour, double_sided=bool(getattr(source, "doubleSided", False)))
    normals = None if primitive.normals is None else np.asarray(primitive.normals, np.float64)
    return gltf.Piece(positions, faces, normals, uvs, material)


def _pyrender_intrinsics(source, camera: CameraModel) -> PinHole:
    near = float(getattr(source, "znear", None) or camera.near)
    if hasattr(source, "yfov"):
        focal = focal_length(camera.height, source.yfov)
        # pyrender scales x by the aspect ratio: the viewport's, unless the camera states one.
        aspect = getattr(source, "aspectRatio", None) or camera.width / camera.height
        return PinHole.centred(camera.width, camera.height, focal * camera.width / camera.height / aspect, focal, near)
    if hasattr(source, "fx"):
        # pyrender counts from the image's corner, we from the first pixel's centre.
        return PinHole(
            camera.width,
            camera.height,
            float(source.fx),
            float(source.fy),
            float(source.cx) - 0.5,
            float(source.cy) - 0.5,
            near,
        )
    raise ConfigError(
        "only perspective and intrinsics cameras are supported", where="from_pyrender", value=type(source).__name__
    )
