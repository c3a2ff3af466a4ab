"""Random worlds: a textured sky box, ground, and objects from a pool, resting or flying, mostly in view.

After "BlinkFlow" (IROS 2023), section III: random scale, rotation, texture and placement; waypoints in free space
joined by splines; objects that collide stop. The world is z up, in metres, ground at z = 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.camera import CameraModel
from blinkgl.config.base import placed
from blinkgl.config.camera import room_for
from blinkgl.config.deform import AnimationConfig, DeformConfig, RandomDeformConfig
from blinkgl.config.physics import BodyConfig, RandomPhysicsConfig
from blinkgl.config.scene import RandomSceneConfig, SkyConfig
from blinkgl.errors import ConfigError
from blinkgl.rng import Role, generator
from blinkgl.scene.geometry.living import deforming
from blinkgl.scene.geometry.meshes import scale_mesh
from blinkgl.scene.geometry.primitives import grid
from blinkgl.scene.importing.mesh_files import Asset, sides_of
from blinkgl.scene.lights import MAX_LAMPS, LampPath, make_light, random_lamps
from blinkgl.scene.motion.body_shapes import Barrier
from blinkgl.scene.motion.collision import resolve_collisions
from blinkgl.scene.motion.curves import random_path_along_curve
from blinkgl.scene.motion.dynamics import Exploded, simulate
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.motion.pose_path import PosePath
from blinkgl.scene.motion.trajectories import FreeSpace, look_rotation, random_camera_path, random_path
from blinkgl.scene.rig import Rig
from blinkgl.scene.shapes.sweep import filled, gait
from blinkgl.scene.surfaces.images import SKY_SIDES
from blinkgl.scene.types import Lamp, Light, Material, Mesh, Part, Scene, SceneObject
from blinkgl.scene.worlds.explicit import lamp_paths
from blinkgl.scene.worlds.pool import Pool, object_pool, texture_pool
from blinkgl.scene.worlds.sky import Panorama, drawn_panorama, panorama_light, panorama_sky, sky_box
from blinkgl.types.poses import pose_of

_PLACEMENTS = 300  # positions tried for an object before it is left out
_CAMERA_PATHS = 6  # camera paths tried until one is free of collisions; the last is cut at its collision
_GAP = 0.05  # m between bounding spheres at t0
_STAND_OFF = 0.8  # m beyond the clearance that waypoints keep from the camera, so that nothing fills the view
_Item = tuple[str, Literal["object", "ground", "sky"], tuple[Part, ...], PosePath]


def random_world(
    config: RandomSceneConfig,
    camera: CameraModel,
    t0_ns: int,
    t1_ns: int,
    split: str,
    seed: int,
    sequence: int,
    base: Path,
) -> Scene:
    """Return the ``sequence``-th random scene of a run; arguments as in :func:`blinkgl.scene.build.build_scene`."""
    rng, rng_motion, rng_texture, rng_shape = (
        generator(seed, sequence, role) for role in (Role.SCENE, Role.TRAJECTORY, Role.TEXTURE, Role.SHAPE)
    )
    objects, textures = pools(config, base)
    log = [*objects.notes, *textures.notes]
    omissions: dict[str, None] = {}

    T_cam, target = _viewpoint(config, rng)
    with placed(str):
        clearance = room_for(camera, config.camera_clearance, config.region.height)
    backdrop, panorama = _backdrop(config, textures, rng, rng_texture, split, base, log)
    items: list[_Item] = [(name, category, parts, StaticPath(T, t0_ns, t1_ns)) for name, category, parts, T in backdrop]

    dice = rng, rng_texture, rng_shape
    placements = _place(config, camera, objects, textures, dice, split, T_cam, clearance, log, omissions)
    # Objects with their own motion are not thrown.
    lifeless = [one.name for one in placements if gait(one.parts)[0] == "free"]
    bodies = _bodies(config.physics, lifeless, generator(seed, sequence, Role.PHYSICS))
    room = _Room(config, placements, T_cam, clearance)
    for k, one in enumerate(placements):
        path = (
            StaticPath(one.pose, t0_ns, t1_ns)
            if one.name in bodies
            else _object_path(config, one, room.beside(k), rng_motion, t0_ns, t1_ns)
        )
        items.append((one.name, "object", one.parts, path))
    scene_objects = tuple(
        SceneObject(name, k + 1, parts, motion, category, category == "sky" and panorama is not None)
        for k, (name, category, parts, motion) in enumerate(items)
    )
    camera_paths = (
        random_camera_path(rng_motion, t0_ns, t1_ns, config.camera_motion, room.for_camera(), clearance, target, T_cam)
        for _ in range(_CAMERA_PATHS)
    )
    # Bodies of the engine are left to it: their collisions are its own.
    kept, camera_path = _resolved(scene_objects, set(bodies), camera_paths, clearance, t0_ns, t1_ns, log)
    kept, dynamics = _fallen(config, kept, bodies, (camera_path, clearance), t0_ns, t1_ns, log)
    return Scene(
        objects=kept,
        rig=Rig.alone(camera, camera_path),
        t0_ns=t0_ns,
        t1_ns=t1_ns,
        light=_light(config, panorama, lamp_paths(t0_ns, t1_ns, base, log), rng, generator(seed, sequence, Role.LIGHT)),
        background=config.background,
        log=tuple(log),
        omissions=tuple(omissions),
        dynamics=dynamics,
    )


class _Placed(NamedTuple):
    """An object at t0. pose : (4, 4).   radius : of its bounding sphere.   resting : on the ground."""

    name: str
    parts: tuple[Part, ...]
    pose: np.ndarray
    radius: float
    resting: bool


class _Room:
    """Free space of a random world: the region without the others' bounding spheres at t0."""

    def __init__(self, config: RandomSceneConfig, placed: list[_Placed], T_cam: np.ndarray, clearance: float):
        half = config.region.width / 2
        self.low, self.high = np.array([-half, -half, 0.0]), np.array([half, half, config.region.height])
        self.ground_z = 0.0 if config.ground else None
        self.centres = np.array([one.pose[:3, 3] for one in placed]).reshape(-1, 3)
        self.radii = np.array([one.radius for one in placed])
        self.camera, self.clearance = T_cam[:3, 3], clearance

    def beside(self, number: int) -> FreeSpace:
        """Return the free space for one of the placed objects."""
        others = np.arange(len(self.radii)) != number
        centres, radii = np.vstack([self.centres[others], self.camera]), self.radii[others]
        return FreeSpace(self.low, self.high, self.ground_z, centres, np.append(radii, self.clearance + _STAND_OFF))

    def for_camera(self) -> FreeSpace:
        low = self.low + [0, 0, self.clearance]
        return FreeSpace(low, self.high, self.ground_z, self.centres, self.radii + _STAND_OFF)


def _backdrop(config, textures, rng, rng_texture, split, base, log):
    """Return ([(name, category, parts, pose)] of sky and ground, the panorama on the sky or None)."""
    backdrop, panorama = [], None
    if config.sky:
        parts, panorama = _sky(config.sky, textures, rng_texture, split, base, log)
        backdrop.append(("sky", "sky", parts, np.eye(4)))
    if config.ground:
        size = config.sky.size if config.sky else 4 * config.region.width
        mesh = grid(width=size, depth=size, subdivisions=config.ground.subdivisions)
        repeats = size / _log_uniform(rng_texture, config.ground.tile)
        texture = textures.draw(rng_texture, split, log)
        material = Material(texture, uv_scale=(repeats, repeats), unlit=config.light.unlit)
        backdrop.append(("ground", "ground", (Part(mesh, material),), np.eye(4)))
    rng.permutation(4)  # was used by removed walls; kept so that later draws stay the same
    return backdrop, panorama


def _object_path(config: RandomSceneConfig, one: _Placed, space: FreeSpace, rng, t0_ns: int, t1_ns: int) -> PosePath:
    """Return a random path or, for an object with its own motion, a way at the speed of its steps."""
    locomotion, speed = gait(one.parts)
    if locomotion == "free" or (locomotion == "level" and speed == 0):
        turns = one.resting or locomotion == "level"
        return random_path(rng, t0_ns, t1_ns, config.object_motion, space, one.radius, one.pose, on_ground=turns)
    if speed == 0 or config.object_motion.kind == "static":
        return StaticPath(one.pose, t0_ns, t1_ns)
    return random_path_along_curve(rng, t0_ns, t1_ns, space, one.radius, one.pose, speed, flat=locomotion == "upright")


def _resolved(objects, falling: set[str], camera_paths: Iterable[PosePath], clearance, t0_ns, t1_ns, log):
    """Return (the objects, stopped at collisions, without those that collide at the start; the camera's path).
    camera_paths : drawn one by one until one is not stopped: a stopped camera would see a still world from then on."""
    # Falling objects are not stopped here: the physics engine lets them bounce off the others' final paths.
    others = tuple(o for o in objects if o.name not in falling)
    for path in camera_paths:
        result = resolve_collisions(others, path, clearance, t0_ns, t1_ns)
        if not any("camera" in event.cut for event in result.events):
            break
    # Bounding spheres were apart, so only one that intersects ground or wall can touch at t0: leave it out.
    ours = {o.name for o in others if o.category == "object"}
    bad = ours & {name for c in result.at_start for name in (c.first, c.second)}
    if bad:
        result = resolve_collisions(tuple(o for o in others if o.name not in bad), path, clearance, t0_ns, t1_ns)
        log.append("left out, touching something at the start: " + ", ".join(sorted(bad)))
    log += result.log
    resolved = {o.name: o for o in result.objects}
    return tuple(resolved.get(o.name, o) for o in objects if o.name not in bad), result.camera_path


def _fallen(config, objects, bodies, eye, t0_ns, t1_ns, log):
    """Return (the objects without those that diverge, Dynamics or None). eye : the camera's path and clearance."""
    if config.physics is None:
        return objects, None
    while any(o.name in bodies for o in objects):
        sides = _sides(config)
        try:
            return simulate(objects, bodies, config.physics, t0_ns, t1_ns, camera=eye, sides=sides)
        except Exploded as error:  # squeezed between two that cannot be stopped
            objects = tuple(o for o in objects if o.name != error.body)
            log.append(f"left out, it came to be faster than scene.physics.max_speed: {error.body}")
    return objects, None


def _light(config: RandomSceneConfig, panorama: Panorama | None, path_of: LampPath, rng, rng_lamps) -> Light:
    lamps: tuple[Lamp, ...] = ()
    if config.lights is not None:
        lamps = random_lamps(config.lights, rng_lamps, config.region.width / 2)
        if len(lamps) + len(config.light.lights) + 1 > MAX_LAMPS:
            raise ConfigError(
                "too many lights",
                where="scene.lights.count",
                value=config.lights.count[1],
                accepted=f"at most {MAX_LAMPS - 1} with those of scene.light.lights",
            )
    light = make_light(config.light, path_of, rng, lamps)
    if config.sky is not None and config.sky.lights and panorama is not None:
        light = panorama_light(panorama.file, panorama.angle, panorama.brightness, light, str(panorama.file))
    return light


def pools(config: RandomSceneConfig, base: Path) -> tuple[Pool, Pool]:
    """Return (object pool, texture pool); the same pools, with their caches, for the same configuration in one
    process."""
    return _object_pool(config.pool, base.resolve(), config.textures.max_size), _texture_pool(
        config.textures, base.resolve()
    )


def forget_pools() -> None:
    """List the folders anew when they are next used: what they hold may have changed since another run."""
    _object_pool.cache_clear()
    _texture_pool.cache_clear()


# Listing a folder reads and hashes every file of it: once for all sequences of a run.
_object_pool = lru_cache(maxsize=4)(lambda config, base, size: object_pool(config, base, max_texture=max(size, 64)))
_texture_pool = lru_cache(maxsize=4)(texture_pool)


def _viewpoint(config: RandomSceneConfig, rng) -> tuple[np.ndarray, np.ndarray]:
    """Return (T_world_cam at t0, target point): near the edge of the region, looking across its middle."""
    half = config.region.width / 2
    around = rng.uniform(0, 2 * math.pi)
    low, high = config.region.camera_height
    position = np.array(
        [
            *(rng.uniform(0.4, 0.85) * half * np.array([math.cos(around), math.sin(around)])),
            rng.uniform(low, min(high, config.region.height)),
        ]
    )
    target = np.array([*rng.uniform(-0.2, 0.2, 2) * half, rng.uniform(0.05, 0.3) * config.region.height])
    return pose_of(position, look_rotation(target - position)), target


def _place(
    config, camera, objects: Pool, textures: Pool, dice, split, T_cam, clearance, log, omissions
) -> list[_Placed]:
    """Return the objects that found a place: no two bounding spheres, nor the camera's, overlap."""
    settings, region = config.objects, config.region
    rng, rng_texture, rng_shape = dice
    placed: list[_Placed] = []
    if settings.count == 0:
        return placed
    # The bodies placed so far, the camera first.
    centres, radii = np.empty((settings.count + 1, 3)), np.empty(settings.count + 1)
    centres[0], radii[0] = T_cam[:3, 3], clearance
    for k in range(settings.count):
        asset, playing = _playing(objects.draw(rng, split, log), config, rng_shape)
        radius = 0.5 * _log_uniform(rng, (settings.size[0], min(settings.size[1], region.height)))
        resting = config.ground is not None and rng.random() >= settings.flying
        locomotion, _ = gait(asset.parts)
        if locomotion == "free":
            rotation = _rotation(rng, resting)
        else:
            resting = locomotion == "upright" and config.ground is not None
            rotation = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * math.pi)]).as_matrix()
        changed, word = _changing(asset, settings.deform, rng_shape)
        parts = _dress(config, changed, radius, textures, rng_texture, split, log)
        # Row 2 of a rotation is the world's vertical in the object's axes.
        lowest = min(_lowest(p.mesh, rotation[2]) for p in parts)
        in_view, taken = rng.random() < settings.in_view, len(placed) + 1
        for _ in range(_PLACEMENTS):
            position = _candidate(config, camera, rng, T_cam, in_view, resting)
            if resting:
                position[2] = 0.0 - lowest  # never -0
            elif not (radius if config.ground else 0) + _GAP <= position[2] <= region.height:
                continue
            if max(abs(position[0]), abs(position[1])) > region.width / 2:
                continue
            gap = np.sqrt(((centres[:taken] - position) ** 2).sum(axis=1)) - radii[:taken] - radius
            # gap[0] is the distance from the camera.
            if gap.min() > _GAP and gap[0] > max(radius, _STAND_OFF):
                break
        else:
            log.append(
                f"object {k} ({asset.name}, radius {radius:.2f} m) left out: no free place in {_PLACEMENTS} tries"
            )
            continue
        centres[taken], radii[taken] = position, radius
        placed.append(_Placed(f"{asset.name}#{k}", parts, pose_of(position, rotation), radius, resting))
        log.extend(f"{asset.name}#{k} {text}" for text in (playing, word) if text)
        log.extend(line for line in asset.log if line not in log)
        omissions.update(dict.fromkeys(asset.omissions))
    return placed


def _playing(asset: Asset, config: RandomSceneConfig, rng) -> tuple[Asset, str]:
    """Return the asset playing one of its file's animations, and a log line. Nothing is drawn for others."""
    if asset.replay is None or config.pool.animation == "rest":
        return asset, ""
    clip, speed, phase = int(rng.integers(len(asset.clips))), float(rng.uniform(0.8, 1.25)), float(rng.uniform(0, 10))
    playing = asset.replay(AnimationConfig(clip=clip, speed=speed, phase=phase)).normalised()
    return playing, f"plays '{asset.clips[clip]}'"


def _changing(asset: Asset, config: RandomDeformConfig, rng) -> tuple[Asset, str]:
    """Return the asset, of bounding radius 1, with a deformer in some cases, and a log line. All its shapes fit into
    the sphere of radius 1."""
    if config.share == 0 or rng.random() >= config.share or any(p.mesh.deformer is not None for p in asset.parts):
        return asset, ""
    kinds = config.kinds or tuple(DeformConfig.members)
    kind = kinds[int(rng.integers(len(kinds)))]
    drawn = DeformConfig.members[kind].drawn(
        rng, float(rng.uniform(*config.strength)), _log_uniform(rng, config.period)
    )
    parts = deforming(asset.parts, drawn)
    # The farthest point of any shape over time: made smaller by it at rest, all shapes fit.
    reach = max(
        float(np.linalg.norm(points, axis=1).max()) + margin for points, margin in (filled(p.mesh) for p in parts)
    )
    smaller = [replace(part, mesh=scale_mesh(part.mesh, 1 / reach)) for part in asset.parts]
    return replace(asset, parts=deforming(smaller, drawn)), f"deforms: {kind}"


def _lowest(mesh: Mesh, up: np.ndarray) -> float:
    """Return the height of its lowest point at any time, along (3,) up in its axes."""
    if mesh.deformer is None:
        return float((mesh.vertices @ up).min())
    points, margin = filled(mesh)
    # A figure's feet are on the ground: the margin for times between samples is not used.
    return float((points @ up).min()) - (0.0 if mesh.deformer.locomotion == "upright" else margin)


def _candidate(config, camera, rng, T_cam, in_view, resting) -> np.ndarray:
    """Return a candidate position: along a pixel's ray at a log-uniform distance, or anywhere in the region."""
    region = config.region
    if not in_view:
        half = region.width / 2
        return rng.uniform([-half, -half, 0.0], [half, half, region.height])
    # The image begins half a pixel before the first pixel's centre.
    pixel = rng.random(2) * (camera.width, camera.height) - 0.5
    ray = T_cam[:3, :3] @ camera.rays(pixel)
    if resting:
        # Along the ground; the caller sets the height of a resting body.
        ray[2] = 0.0
    return T_cam[:3, 3] + ray / math.sqrt(ray @ ray) * _log_uniform(rng, config.objects.distance)


def _rotation(rng, resting: bool) -> np.ndarray:
    """Return (3, 3). Flying: uniform over rotations. Resting: any heading, upright or, for three in ten, lying on its
    side."""
    if not resting:
        return Rotation.random(rng=rng).as_matrix()
    heading, tipped, axis = rng.uniform(0, 2 * math.pi), rng.random() < 0.3, int(rng.integers(2))
    tip = Rotation.from_rotvec(np.eye(3)[axis] * (math.pi / 2 if tipped else 0.0))
    return (Rotation.from_rotvec([0, 0, heading]) * tip).as_matrix()


def _dress(config, asset, radius, textures, rng, split, log) -> tuple[Part, ...]:
    """Return the asset at its size, with its own materials or a random texture and tint."""
    tint = 1 - config.objects.tint * rng.random(3)
    # Drawn for every object, worn or not, so that a file's materials change no later draw.
    repeats = _log_uniform(rng, config.objects.texture_scale)
    parts = []
    texture = None if asset.has_materials else textures.draw(rng, split, log)
    for part in asset.parts:
        material = part.material
        if not asset.has_materials:
            material = replace(
                material, texture=texture, base_color=tuple(float(c) for c in tint), uv_scale=(repeats, repeats)
            )
        sides = sides_of(material, config.both_sides)
        material = replace(material, unlit=material.unlit or config.light.unlit, both_sides=sides)
        parts.append(Part(scale_mesh(part.mesh, radius), material))
    return tuple(parts)


def _bodies(config: RandomPhysicsConfig | None, names: list[str], rng) -> dict[str, BodyConfig]:
    """Return the falling objects by name. The same number of values is drawn for each object, falling or not."""
    if config is None:
        return {}
    falling: dict[str, BodyConfig] = {}
    for name in names:
        # All numbers of a body are drawn whether it falls or not: a changed share leaves the others' as they are.
        falls, thrown, around, axis = rng.random(), rng.random(), rng.uniform(0, 2 * math.pi), rng.normal(size=3)
        elevation, speed, spin = rng.uniform(0, math.pi / 3), rng.uniform(*config.speed), rng.uniform(*config.spin)
        density, friction = _log_uniform(rng, config.density), rng.uniform(*config.friction)
        restitution = rng.uniform(*config.restitution)
        if falls >= config.share:
            continue
        if thrown >= config.thrown:
            speed = spin = 0.0
        flat = speed * math.cos(elevation)
        falling[name] = BodyConfig(
            density=density,
            friction=friction,
            restitution=restitution,
            velocity=(flat * math.cos(around), flat * math.sin(around), speed * math.sin(elevation)),
            spin=tuple(spin * axis / np.linalg.norm(axis)),
        )
    return falling


def _sides(config: RandomSceneConfig) -> list[Barrier]:
    """Return the sides of the region, far enough out that no object intersects one; its floor where there is no
    ground."""
    reach = 0.5 * config.objects.size[1] + _GAP
    out = config.region.width / 2 + reach
    # Normals point inwards: normal . x >= offset is the inner side.
    sides = [Barrier((sx, sy, 0.0), -out) for sx, sy in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))]
    sides.append(Barrier((0.0, 0.0, -1.0), -(config.region.height + reach)))
    if config.ground is None:
        sides.append(Barrier((0.0, 0.0, 1.0), -reach))
    return sides


def _sky(config: SkyConfig, textures: Pool, rng, split, base, log) -> tuple[tuple[Part, ...], Panorama | None]:
    """Return the box around everything and None, or a sky at infinity and its panorama."""
    brightness = float(rng.uniform(*config.brightness))
    repeats = _log_uniform(rng, config.repeat)
    if config.panoramas:
        panorama = drawn_panorama(config, rng, split, textures.test_fraction, base, brightness)
        return panorama_sky(panorama.sides, brightness), panorama
    if config.per_face:
        images = [textures.draw(rng, split, log) for _ in SKY_SIDES]
    else:
        images = [textures.draw(rng, split, log)] * len(SKY_SIDES)
    return sky_box(config.size, config.subdivisions, images, brightness, repeats), None


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(math.log(bounds[0]), math.log(bounds[1]))))
