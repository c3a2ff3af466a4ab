"""Explicit scenes: named meshes and materials, objects and camera with poses or key frames, as written in the YAML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.camera import CameraModel
from blinkgl.config.base import placed
from blinkgl.config.deform import AnimationConfig, animation_of
from blinkgl.config.materials import MaterialConfig
from blinkgl.config.poses import KeyedMotionConfig, PoseConfig, TrajectoryConfig, rigid_matrix
from blinkgl.config.primitives import PRIMITIVES
from blinkgl.config.scene import ExplicitSceneConfig, MeshConfig, ObjectConfig, object_names
from blinkgl.errors import AssetError, ConfigError
from blinkgl.machine.extras import install
from blinkgl.scene.geometry import BUILDERS
from blinkgl.scene.geometry.figure import SPACINGS
from blinkgl.scene.geometry.living import deforming
from blinkgl.scene.geometry.meshes import transform_mesh
from blinkgl.scene.geometry.primitives import POINT_AREA
from blinkgl.scene.geometry.tangents import split_mirrored
from blinkgl.scene.importing.mesh_files import Asset, border_of, clip_of, load_asset, sides_of
from blinkgl.scene.importing.polygons import texture_of
from blinkgl.scene.lights import LampPath, make_light, waveform_of
from blinkgl.scene.motion.collision import resolve_collisions
from blinkgl.scene.motion.curves import path_along_curve
from blinkgl.scene.motion.dynamics import simulate
from blinkgl.scene.motion.paths import KeyframePath, OffsetPath, StaticPath, smoothed
from blinkgl.scene.motion.pose_path import PosePath
from blinkgl.scene.motion.trajectories import look_rotation
from blinkgl.scene.reading import contents, existing
from blinkgl.scene.rig import Rig
from blinkgl.scene.shapes.sweep import gait
from blinkgl.scene.surfaces.coats import COATS, coat
from blinkgl.scene.surfaces.images import content_hash, decode_alpha, decode_image, decode_numbers, photographs
from blinkgl.scene.surfaces.textures import procedural_texture
from blinkgl.scene.types import Gloss, Map, Mask, Material, Mesh, Part, Scene, SceneObject, Texture
from blinkgl.scene.worlds.sky import with_environment
from blinkgl.types.poses import pose_of

_IMAGE = "an image file"
_PROCEDURAL_SIZE = 1024
# A camera (OpenCV axes) that looks along the world's +x with z up.
_LEVEL_CAMERA = Rotation.from_matrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))


@dataclass(frozen=True, eq=False)
class InMemory:
    """Meshes and textures that are not in files, by the names of the mesh and of the material they belong to; they
    replace what the configuration gives there."""

    meshes: dict[str, Mesh] = field(default_factory=dict)
    textures: dict[str, Texture] = field(default_factory=dict)
    maps: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    """By material and key: (h, w, 3) uint8 as the key's file would be, (h, w) for the mask."""


def explicit_scene(
    config: ExplicitSceneConfig,
    camera: CameraModel,
    t0_ns: int,
    t1_ns: int,
    base: Path,
    memory: InMemory = InMemory(),
    px_per_slope: float = 0.0,
) -> Scene:
    """Return the configured scene; nothing is random, and collisions are searched only if configured.

    px_per_slope : of the sharpest camera of a rig, for levels of detail; the camera's own where it is larger.

    Raises ConfigError (missing file, bad parameter; with ``collisions``, bodies that touch at the start; with
    ``physics``, what :func:`simulate` raises) and AssetError."""
    log: list[str] = []
    omissions: dict[str, None] = {}
    objects = _objects(config, t0_ns, t1_ns, base, memory, log, omissions)
    path = motion_path(config.camera, t0_ns, t1_ns, "scene.camera", base, camera=True, log=log)
    objects = [
        obj if item.mesh in memory.meshes else _in_detail(obj, item, config, camera, path, px_per_slope)
        for obj, item in zip(objects, config.objects, strict=True)
    ]
    bodies = {obj.name: item.physics for obj, item in zip(objects, config.objects) if item.physics is not None}
    if config.collisions:
        # Falling objects are not stopped here: the physics engine lets them bounce off the others' final paths.
        falling = {name for name, body in bodies.items() if body.kind == "dynamic"}
        others = [obj for obj in objects if obj.name not in falling]
        result = resolve_collisions(others, path, 1.01 * camera.near_corner, t0_ns, t1_ns)
        if result.at_start:
            raise ConfigError(
                f"{result.at_start[0]}, at the start",
                where="scene.collisions",
                accepted="bodies apart at the start, or collisions: false",
            )
        resolved = {obj.name: obj for obj in result.objects}
        objects = [resolved.get(obj.name, obj) for obj in objects]
        path, log = result.camera_path, log + list(result.log)
    dynamics = None
    if config.physics is not None:
        objects, dynamics = simulate(objects, bodies, config.physics, t0_ns, t1_ns)
    light, objects = with_environment(
        config.light.environment, make_light(config.light, lamp_paths(t0_ns, t1_ns, base, log)), base, objects
    )
    return Scene(
        objects,
        Rig.alone(camera, path),
        t0_ns,
        t1_ns,
        light=light,
        background=config.background,
        log=tuple(log),
        omissions=tuple(omissions),
        dynamics=dynamics,
    )


def _objects(
    config: ExplicitSceneConfig,
    t0_ns: int,
    t1_ns: int,
    base: Path,
    memory: InMemory,
    log: list[str],
    omissions: dict[str, None],
) -> list[SceneObject]:
    """Return the objects in their order, numbered from 1. log, omissions : get the notes on their files."""
    materials = {
        name: _material(m, base, f"scene.materials.{name}", memory.textures.get(name), memory.maps.get(name, {}))
        for name, m in config.materials.items()
    }
    assets: dict[tuple[str, bool, AnimationConfig | None], Asset] = {}
    objects, names = [], object_names([item.name for item in config.objects], [item.mesh for item in config.objects])
    for k, item in enumerate(config.objects):
        where = f"scene.objects.{k}"
        own, animation = item.material is None, animation_of(item.animation)
        key = item.mesh, own, animation
        # Read once, and shared by all objects that play and wear the same.
        if key not in assets:
            arguments = config.meshes[item.mesh], item.mesh, own, base, config.max_faces, memory.meshes
            assets[key] = _asset(*arguments, animation, f"{where}.animation")
            log += [line for line in assets[key].log if line not in log]
            omissions.update(dict.fromkeys(assets[key].omissions))
        if config.meshes[item.mesh].primitive == "point" and not _glows(item, config):
            raise ConfigError(
                "a point of light that emits none",
                where=f"{where}.material",
                value=item.material,
                accepted="a material with emission above 0 in a scene that is not unlit",
            )
        parts = _parts(assets[key], item, None if item.material is None else materials[item.material], config)
        if item.deform is not None:
            if animation is not None:
                raise ConfigError(
                    "deform and animation exclude each other", where=f"{where}.deform", accepted="deform or animation"
                )
            parts = deforming(parts, item.deform)
        path = _object_path(item, parts, t0_ns, t1_ns, where, base, log)
        # Ids begin at 1: in a picture of ids 0 stands for nothing.
        objects.append(SceneObject(names[k], k + 1, tuple(parts), path, item.category))
    return objects


def _glows(item: ObjectConfig, config: ExplicitSceneConfig) -> bool:
    material = None if item.material is None else config.materials[item.material]
    return material is not None and any(material.emission) and not (material.unlit or config.light.unlit)


def _parts(asset: Asset, item: ObjectConfig, material: Material | None, config: ExplicitSceneConfig) -> list[Part]:
    """Return an asset's parts at an object's size. material : replaces its own."""
    matrix = np.diag(np.broadcast_to(np.asarray(item.scale, float), 3))
    point = config.meshes[item.mesh].primitive == "point"
    parts = []
    for part in asset.parts:
        worn = part.material if material is None else material
        sides = sides_of(part.material, config.both_sides)
        if material is not None and material.both_sides is not None:
            sides = material.both_sides
        worn = replace(worn, unlit=worn.unlit or config.light.unlit, both_sides=sides)
        if point:
            # Its emission is an intensity.
            red, green, blue = (one / POINT_AREA for one in worn.emission)
            worn = replace(worn, emission=(red, green, blue))
        mesh = transform_mesh(part.mesh, matrix)
        if material is not None and worn.bumps is not None and mesh.deformer is None:
            mesh, _ = split_mirrored(mesh)  # a deforming mesh keeps its seams: its joints count its vertices
        parts.append(Part(mesh, worn))
    return parts


def _in_detail(
    obj: SceneObject,
    item: ObjectConfig,
    config: ExplicitSceneConfig,
    camera: CameraModel,
    path: PosePath,
    px_per_slope: float,
) -> SceneObject:
    """Return a body whose primitive has levels of detail with the coarsest vertices that are at most :data:`APART` px
    from each other when it is nearest to the camera."""
    mesh = config.meshes[item.mesh]
    builder = BUILDERS.get(mesh.primitive or "")
    if builder is None or builder.at_level is None or len(obj.parts) != 1 or item.deform is not None:
        return obj
    part, times = obj.parts[0], np.linspace(path.t0_ns, path.t1_ns, 65).astype(np.int64)
    apart = obj.path.poses(times)[:, :3, 3] - path.poses(times)[:, :3, 3]
    # From the height of the body's middle, which may come as near as half of its radius.
    middle, size = (part.mesh.vertices.max(axis=0) + part.mesh.vertices.min(axis=0)) / 2, part.mesh.radius / 2
    nearest = max(float(np.linalg.norm(apart + middle, axis=1).min()) - size / 2, camera.near)
    px_per_unit = max(camera.px_per_slope, px_per_slope) / nearest * float(np.max(item.scale))
    level = max((k for k, spacing in enumerate(SPACINGS) if spacing * px_per_unit <= APART), default=0)
    if not level:
        return obj
    with _parameters_of(item.mesh):
        coarse = builder.at_level(level, **mesh.parameters)
    matrix = np.diag(np.broadcast_to(np.asarray(item.scale, float), 3))
    return replace(obj, parts=(replace(part, mesh=transform_mesh(coarse, matrix)),))


APART = 4.0
"""px between neighbouring vertices of a body by formula: its outline leaves the round one by less than a pixel."""


def _object_path(
    item: ObjectConfig, parts: Sequence[Part], t0_ns: int, t1_ns: int, where: str, base: Path, log: list[str]
) -> PosePath:
    """Return an object's path from its pose, key frames, trajectory, or way, at the speed that its steps need."""
    way = item.way
    if way is None:
        return motion_path(item, t0_ns, t1_ns, where, base, log=log)
    speed = way.speed or gait(parts)[1] or 1.0
    form = {"closed": way.closed, "level": way.level, "start": way.start}
    return path_along_curve(way.points, speed, t0_ns, t1_ns, **form, where=f"{where}.way")


def motion_path(
    config: KeyedMotionConfig,
    t0_ns: int,
    t1_ns: int,
    where: str,
    base: Path,
    camera: bool = False,
    log: list[str] | None = None,
) -> PosePath:
    """Return the configured pose over [t0, t1], or the path through its key frames (whose times are seconds on the
    sequence's clock) or a file's poses. Raises ConfigError and AssetError."""
    if config.trajectory is not None:
        return trajectory_path(config.trajectory, t0_ns, t1_ns, f"{where}.trajectory", base, log)
    euler = next((k.euler for k in (config, *config.keyframes) if k.euler is not None), None)
    if camera and euler is not None and log is not None:
        x, y, z, w = (Rotation.from_euler("xyz", euler, degrees=True) * _LEVEL_CAMERA).as_quat().round(7) + 0.0
        log.append(
            f"{where}: euler turns OpenCV's axes (x right, y down, z forward), as quaternion does; "
            f"up to version 0.2 it turned a camera that looks along +x, whose euler {list(euler)} is "
            f"quaternion [{w}, {x}, {y}, {z}]"
        )
    if not config.keyframes:
        return StaticPath(pose_matrix(config, camera), t0_ns, t1_ns)
    poses = np.stack([pose_matrix(k, camera) for k in config.keyframes])
    times = [round(k.time * 1e9) for k in config.keyframes]
    return KeyframePath(times, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]), config.interpolation)


def lamp_paths(t0_ns: int, t1_ns: int, base: Path, log: list[str]) -> LampPath:
    """Return what makes the paths of lamps that move in a sequence. log : gets what was guessed."""
    return lambda motion, where: motion_path(motion, t0_ns, t1_ns, where, base, camera=True, log=log)


def trajectory_path(
    config: TrajectoryConfig, t0_ns: int, t1_ns: int, where: str, base: Path, log: list[str] | None = None
) -> PosePath:
    """Return a C2 spline through the poses of a file. log : gets what was guessed. Raises AssetError, as
    :func:`read_trajectory`, and ConfigError where the file does not cover [t0, t1], or lacks the sensor's pose on its
    body."""
    from blinkgl.io.trajectories import PoseFile, read_trajectory

    file = existing(config.file, base, f"{where}.file", "a trajectory")
    form = None if config.form == "auto" else config.form
    declared = PoseFile(form, config.columns, config.time_unit, config.maps_from, config.axes, config.rate)
    t_ns, poses = read_trajectory(file, declared, log)
    # From the file's clock to the scene's.
    t_ns = t_ns - (t_ns[0] - t0_ns if config.start is None else round(config.start * 1e9))
    if t_ns[0] > t0_ns or t_ns[-1] < t1_ns:
        raise ConfigError(
            "the trajectory does not cover the sequence, with the label interval before the first label",
            where=where,
            value=f"{t_ns[0] * 1e-9:.6g} to {t_ns[-1] * 1e-9:.6g} s on its clock",
            accepted=f"{t0_ns * 1e-9:.6g} to {t1_ns * 1e-9:.6g} s: a shorter time.duration, or another start",
        )
    # Poses of the sequence, those that smoothing reads beside it, and some more for the spline.
    aside = round(1e9 * config.smooth)
    first = max(0, int(np.searchsorted(t_ns, t0_ns - aside)) - _BEYOND)
    last = int(np.searchsorted(t_ns, t1_ns + aside)) + _BEYOND
    t_ns, poses = t_ns[first:last], poses[first:last]
    positions, rotations = smoothed(t_ns, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]), aside)
    _check_speeds(config, t_ns, positions, rotations, where)
    path = KeyframePath(t_ns, positions, rotations)
    return path if config.T_body_sensor is None else OffsetPath(path, _on_body(config.T_body_sensor, where, base))


def _check_speeds(
    config: TrajectoryConfig, t_ns: np.ndarray, positions: np.ndarray, rotations: Rotation, where: str
) -> None:
    """Raise ConfigError where consecutive poses are too far apart for a real motion."""
    seconds = np.diff(t_ns) * 1e-9
    speed = np.linalg.norm(np.diff(positions, axis=0), axis=1) / seconds
    turn = np.degrees((rotations[1:] * rotations[:-1].inv()).magnitude()) / seconds
    for rate, limit, key, unit, guess in (
        (speed, config.speed_limit, "speed_limit", "units/s", "positions in mm, or a jump?"),
        (turn, config.turn_limit, "turn_limit", "degrees/s", "quaternions in another order, or a jump?"),
    ):
        k = int(np.argmax(rate))
        if rate[k] > limit:
            raise ConfigError(
                f"the trajectory is too fast: {guess}",
                where=f"{where}.{key}",
                value=f"{rate[k]:.4g} {unit} at {t_ns[k] * 1e-9:.6g} s",
                accepted=f"at most {limit:g} {unit}, or another {key}",
            )


def _on_body(given: object, where: str, base: Path) -> np.ndarray:
    """Return T_body_sensor, (4, 4), of a matrix or of EuRoC's sensor.yaml."""
    from blinkgl.config.camchain import read_place_on_body

    if not isinstance(given, str):
        return rigid_matrix(given)
    return read_place_on_body(existing(given, base, f"{where}.T_body_sensor", "EuRoC's sensor.yaml"))


_BEYOND = 8
"""Number of poses outside the sequence that the spline uses: farther ones change it by less than 1e-4 of their own
size."""


def pose_matrix(config: PoseConfig, camera: bool = False) -> np.ndarray:
    """Return T_world_body, (4, 4).

    quaternion, or euler about the world's x, then y, then z : the rotation itself, for a camera that of its OpenCV
    axes.
    nothing : no rotation; a camera looks along +x with z up.
    look_at : a camera's z axis (x level), an object's x axis (y level) points there.
    """
    if config.look_at is not None:
        R = look_rotation(np.subtract(config.look_at, config.position))
        # A camera's columns are right, down and ahead, an object's ahead, left and up.
        axes = R if camera else np.column_stack([R[:, 2], -R[:, 0], -R[:, 1]])
    elif config.quaternion is not None:
        w, x, y, z = config.quaternion
        # Configurations have the scalar first, scipy has it last.
        axes = Rotation.from_quat([x, y, z, w]).as_matrix()
    elif config.euler is not None:
        axes = Rotation.from_euler("xyz", config.euler, degrees=True).as_matrix()
    else:
        axes = _LEVEL_CAMERA.as_matrix() if camera else np.eye(3)
    return pose_of(config.position, axes)


def primitive_mesh(config: MeshConfig, name: str) -> Mesh:
    """Return the primitive of ``scene.meshes.name``. Raises ConfigError for a bad parameter."""
    assert config.primitive is not None
    with _parameters_of(name):
        return BUILDERS[config.primitive](**config.parameters)


def check_primitive(kind: str, parameters: Mapping[str, object], name: str) -> None:
    """Raise ConfigError for what :func:`primitive_mesh` would refuse; for living primitives, whose parameters are
    independent, without making one."""
    with _parameters_of(name):
        (BUILDERS[kind].checked if PRIMITIVES[kind].use == "living" else BUILDERS[kind])(**parameters)


def _parameters_of(name: str) -> AbstractContextManager[None]:
    at = f"scene.meshes.{name}.parameters"
    return placed(lambda where: ".".join(filter(None, (at, where.partition(".")[2]))), of=(AssetError,))


def _asset(
    config: MeshConfig,
    name: str,
    own_materials: bool,
    base: Path,
    max_faces: int,
    memory: Mapping[str, Mesh],
    animation: AnimationConfig | None,
    animation_key: str,
) -> Asset:
    if animation is not None and (name in memory or config.file is None):
        raise ConfigError(
            "only glTF files have animations", where=animation_key, value=name, accepted="null, or deform"
        )
    if name in memory or config.primitive is not None:
        mesh = memory[name] if name in memory else primitive_mesh(config, name)
        material = Material()
        if own_materials and name not in memory and config.primitive is not None and config.primitive in COATS:
            seed = config.parameters.get("coat", 0)
            assert isinstance(seed, (int, float))  # as the builder has checked
            material = Material(coat(config.primitive, seed))
        return Asset(name, mesh.source_hash, (Part(mesh, material),))
    assert config.file is not None
    file = existing(config.file, base, f"scene.meshes.{name}.file", "a mesh file")
    return load_asset(
        file,
        border=border_of(file, base),
        max_faces=max_faces,
        uv_size=config.uv_size,
        keep_materials=own_materials,
        up=config.up,
        play=None if animation is None else clip_of(animation, base, animation_key),
    )


def _material(
    config: MaterialConfig,
    base: Path,
    where: str,
    texture: Texture | None = None,
    maps: Mapping[str, np.ndarray] = MappingProxyType({}),
) -> Material:
    if config.texture is not None:
        texture = texture_of(existing(config.texture, base, f"{where}.texture", _IMAGE), config.max_size)
    elif config.procedural is not None:
        texture = procedural_texture(config.procedural, config.seed, min(config.max_size, _PROCEDURAL_SIZE))
    elif config.photograph is not None:
        bundled = photographs()
        if config.photograph not in bundled:
            raise ConfigError(
                "no such photograph",
                where=f"{where}.photograph",
                value=config.photograph,
                accepted="one of: " + ", ".join(bundled) if bundled else f"run {install('scikit-image')}",
            )
        texture = texture_of(bundled[config.photograph], config.max_size)
    # glTF's convention: green is roughness, blue is metallic, each times the material's number.
    rough = _map(config, "metallic_roughness_map", base, where, maps)
    shines = config.metallic > 0 or config.roughness < 1 or rough is not None
    plain = texture, config.color, config.uv_scale, config.unlit, config.both_sides
    return Material(
        *plain,
        gloss=Gloss(config.metallic, config.roughness, rough) if shines else None,
        bumps=_map(config, "normal_map", base, where, maps),
        bump_scale=config.normal_scale,
        emission=config.emission,
        emission_map=_map(config, "emission_map", base, where, maps),
        emission_over_time=waveform_of(config.emission_over_time),
        mask=_mask(config, base, where, maps),
    )


def _map(config: MaterialConfig, key: str, base: Path, where: str, maps: Mapping[str, np.ndarray]) -> Map | None:
    """Return the map of the image file of a key, or in memory; None: neither."""
    if key in maps:
        return Map(Texture(maps[key], key))
    value = getattr(config, key)
    if value is None:
        return None
    data = contents(existing(value, base, f"{where}.{key}", _IMAGE), "image")
    decode = decode_image if key == "emission_map" else decode_numbers
    pixels = decode(data, config.max_size, f"{where}.{key}: {value}")
    return Map(Texture(pixels, Path(value).name, content_hash(data)))


def _mask(config: MaterialConfig, base: Path, where: str, maps: Mapping[str, np.ndarray]) -> Mask | None:
    """Return the mask; None where nothing of it is below the cutoff. Raises ConfigError where all is."""
    alpha = maps.get("mask")
    if alpha is None:
        if config.mask is None:
            return None
        data = contents(existing(config.mask, base, f"{where}.mask", _IMAGE), "image")
        place = f"{where}.mask: {config.mask}"
        alpha = decode_alpha(data, config.max_size, place)
        if alpha is None:
            alpha = decode_numbers(data, config.max_size, place).mean(axis=2).round().astype(np.uint8)
    if alpha.max() < 255 * config.cutoff:
        raise ConfigError(
            "the mask removes the whole surface",
            where=f"{where}.cutoff",
            value=config.cutoff,
            accepted=f"a mask with a value above it; the largest value is {alpha.max() / 255:.3g}",
        )
    return Mask(alpha, cutoff=config.cutoff) if alpha.min() < 255 * config.cutoff else None
