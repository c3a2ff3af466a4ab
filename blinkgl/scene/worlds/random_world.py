"""Random worlds: a textured sky box, ground, walls, and objects from a pool, resting or flying, mostly in view.

After "BlinkFlow" (IROS 2023), section III: random scale, rotation, texture and placement; way-points in free space
joined by splines; whoever collides stops. The world is z up, in metres, ground at ``ground.height``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.camera import CameraModel
from blinkgl.config.base import tag_of
from blinkgl.config.camera import camera_radius
from blinkgl.config.deform import AnimationConfig, DeformConfig, RandomDeformConfig
from blinkgl.config.physics import BodyConfig, RandomPhysicsConfig
from blinkgl.config.scene import RandomSceneConfig, SkyConfig, WallsConfig
from blinkgl.errors import ConfigError
from blinkgl.rng import Role, generator
from blinkgl.scene.geometry.deforming import deforming
from blinkgl.scene.geometry.meshes import scale_mesh
from blinkgl.scene.geometry.primitives import cuboid, grid
from blinkgl.scene.importing.mesh_files import Asset
from blinkgl.scene.lights import MAX_LAMPS, make_light, random_lamps
from blinkgl.scene.motion.body_shapes import Barrier
from blinkgl.scene.motion.collision import resolve_collisions
from blinkgl.scene.motion.dynamics import Exploded, simulate
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.motion.trajectories import FreeSpace, look_rotation, random_camera_path, random_path
from blinkgl.scene.motion.ways import random_way
from blinkgl.scene.reading import contents
from blinkgl.scene.rig import Rig
from blinkgl.scene.shapes.deformer import filled, gait
from blinkgl.scene.surfaces.images import IMAGE_SUFFIXES, SKY_SIDES, content_hash, load_image, shrink
from blinkgl.scene.types import Lamp, Material, Mesh, Part, Scene, SceneObject, Texture
from blinkgl.scene.worlds.pool import Pool, files_below, object_pool, resolve, split_of, texture_pool
from blinkgl.scene.worlds.sky import PANORAMA_INSET, panorama_light, panorama_textures, sky_box

_PLACEMENTS = 300  # positions tried for an object before it is left out
_CAMERA_PATHS = 6  # camera paths tried for one that runs into nothing; the last is cut where it does
_GAP = 0.05  # m between bounding spheres at t0
_STAND_OFF = 0.8  # m beyond the clearance that way-points keep from the camera: nothing should fill the view


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
    """The ``sequence``-th random scene of a run; arguments as :func:`blinkgl.scene.build.build_scene`."""
    rng, rng_motion, rng_texture, rng_shape = (
        generator(seed, sequence, role) for role in (Role.SCENE, Role.TRAJECTORY, Role.TEXTURE, Role.SHAPE)
    )
    objects, textures = pools(config, base)
    log: list[str] = []
    omissions: dict[str, None] = {}
    floor = config.ground.height if config.ground else 0.0
    unlit = config.light.unlit

    T_cam, target = _viewpoint(config, rng, floor)
    clearance = camera_radius(camera, config.camera_clearance)
    if clearance > config.region.height:
        raise ConfigError(
            "the region is too low for a camera that keeps this far from everything",
            where="scene.region.height",
            value=config.region.height,
            accepted=f"at least {clearance:.4g} m (scene.camera_clearance, or the "
            "distance of the near plane's corners: camera.near and camera.fov)",
        )
    backdrop, panorama = [], None
    if config.sky:
        parts, panorama = _sky(config.sky, textures, rng_texture, split, base, log)
        backdrop.append(("sky", "sky", parts, StaticPath(_shift(floor), t0_ns, t1_ns)))
    if config.ground:
        size = config.ground.size or (config.sky.size if config.sky else 4 * config.region.width)
        mesh = grid(width=size, depth=size, subdivisions=config.ground.subdivisions)
        repeats = size / _log_uniform(rng_texture, config.ground.tile)
        material = Material(textures.draw(rng_texture, split, log), uv_scale=(repeats, repeats), unlit=unlit)
        backdrop.append(("ground", "ground", (Part(mesh, material),), StaticPath(_shift(floor), t0_ns, t1_ns)))
    backdrop += [
        (f"wall-{k}", "wall", parts, StaticPath(T, t0_ns, t1_ns))
        for k, (parts, T) in enumerate(_walls(config.walls, config, textures, rng, rng_texture, split, floor, log))
    ]

    dice = rng, rng_texture, rng_shape
    placed = _place(config, camera, objects, textures, dice, split, T_cam, clearance, floor, log, omissions)
    centres = np.array([T[:3, 3] for *_, T, _, _ in placed]).reshape(-1, 3)
    radii = np.array([radius for *_, radius, _ in placed])
    half = config.region.width / 2
    low, high = np.array([-half, -half, floor]), np.array([half, half, floor + config.region.height])
    ground_z = floor if config.ground else None

    # What goes by itself is not thrown.
    lifeless = [name for name, parts, *_ in placed if _gait(parts)[0] == "anyhow"]
    bodies = _bodies(config.physics, lifeless, generator(seed, sequence, Role.PHYSICS))
    items = list(backdrop)
    for k, (name, parts, T, radius, resting) in enumerate(placed):
        if name in bodies:
            items.append((name, "object", parts, StaticPath(T, t0_ns, t1_ns)))
            continue
        others = np.arange(len(placed)) != k
        space = FreeSpace(
            low,
            high,
            ground_z,
            np.vstack([centres[others], T_cam[:3, 3]]),
            np.append(radii[others], clearance + _STAND_OFF),
        )
        goes, speed = _gait(parts)
        if goes == "anyhow" or (goes == "level" and speed == 0):
            turns = resting or goes == "level"
            path = random_path(rng_motion, t0_ns, t1_ns, config.object_motion, space, radius, T, on_ground=turns)
        elif speed == 0 or config.object_motion.kind == "static":
            path = StaticPath(T, t0_ns, t1_ns)
        else:
            path = random_way(rng_motion, t0_ns, t1_ns, space, radius, T, speed, flat=goes == "upright")
        items.append((name, "object", parts, path))
    scene_objects = tuple(
        SceneObject(name, k + 1, parts, motion, category) for k, (name, category, parts, motion) in enumerate(items)
    )
    space = FreeSpace(low + [0, 0, clearance], high, ground_z, centres, radii + _STAND_OFF)
    # A camera that was stopped would see a still world from then on: another path is better.
    for _ in range(_CAMERA_PATHS):
        path = random_camera_path(rng_motion, t0_ns, t1_ns, config.camera_motion, space, clearance, target, T_cam)
        # What falls is stopped by nothing: the engine knows the others' paths, as they are after this.
        others = tuple(o for o in scene_objects if o.name not in bodies)
        result = resolve_collisions(others, path, clearance, t0_ns, t1_ns)
        if not any("camera" in event.cut for event in result.events):
            break
    # Bounding spheres were apart, so only one that sinks into ground or wall can touch at t0: leave it out.
    ours = {o.name for o in others if o.category == "object"}
    bad = ours & {name for c in result.at_start for name in (c.first, c.second)}
    if bad:
        result = resolve_collisions(tuple(o for o in others if o.name not in bad), path, clearance, t0_ns, t1_ns)
        log.append("left out, touching something at the start: " + ", ".join(sorted(bad)))
    log += result.log
    resolved = {o.name: o for o in result.objects}
    kept, dynamics = tuple(resolved.get(o.name, o) for o in scene_objects if o.name not in bad), None
    while config.physics is not None and dynamics is None and any(o.name in bodies for o in kept):
        sides, eye = _sides(config, floor), (result.camera_path, clearance)
        try:
            kept, dynamics = simulate(kept, bodies, config.physics, t0_ns, t1_ns, camera=eye, sides=sides)
        except Exploded as error:  # squeezed between two that nothing stops
            kept = tuple(o for o in kept if o.name != error.body)
            log.append(f"left out, it came to be faster than scene.physics.max_speed: {error.body}")
    lamps: tuple[Lamp, ...] = ()
    if config.lights is not None:
        lamps = random_lamps(config.lights, generator(seed, sequence, Role.LIGHT), half, floor)
        if len(lamps) + len(config.light.lights) + 1 > MAX_LAMPS:
            raise ConfigError(
                "too many lights",
                where="scene.lights.count",
                value=config.lights.count[1],
                accepted=f"at most {MAX_LAMPS - 1} with those of scene.light.lights",
            )
    light = make_light(config.light, rng, lamps)
    if config.sky is not None and config.sky.lights and panorama is not None:
        light = panorama_light(panorama.file, panorama.angle, panorama.brightness, light, panorama.where)
    return Scene(
        objects=kept,
        rig=Rig.alone(camera, result.camera_path),
        t0_ns=t0_ns,
        t1_ns=t1_ns,
        light=light,
        background=config.background,
        log=tuple(log),
        omissions=tuple(omissions),
        dynamics=dynamics,
    )


def pools(config: RandomSceneConfig, base: Path) -> tuple[Pool, Pool]:
    """(object pool, texture pool); the same pools, with their caches, for the same configuration in one process."""
    return _object_pool(config.pool, base.resolve(), config.textures.max_size), _texture_pool(
        config.textures, base.resolve()
    )


_object_pool = lru_cache(maxsize=4)(lambda config, base, size: object_pool(config, base, max_texture=max(size, 64)))
_texture_pool = lru_cache(maxsize=4)(texture_pool)


def _viewpoint(config: RandomSceneConfig, rng, floor: float) -> tuple[np.ndarray, np.ndarray]:
    """(T_world_cam at t0, point looked at): near the edge of the region, looking across its middle."""
    half = config.region.width / 2
    around = rng.uniform(0, 2 * math.pi)
    low, high = config.region.camera_height
    position = np.array([0, 0, floor]) + [
        *(rng.uniform(0.4, 0.85) * half * np.array([math.cos(around), math.sin(around)])),
        rng.uniform(low, min(high, config.region.height)),
    ]
    target = np.array([*rng.uniform(-0.2, 0.2, 2) * half, floor + rng.uniform(0.05, 0.3) * config.region.height])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = look_rotation(target - position), position
    return T, target


def _place(config, camera, objects: Pool, textures: Pool, dice, split, T_cam, clearance, floor, log, omissions):
    """[(name, parts, T_world_obj, bounding radius, resting)]: no two bounding spheres, nor the camera's, overlap."""
    settings, region = config.objects, config.region
    rng, rng_texture, rng_shape = dice
    placed: list[tuple] = []
    if settings.count == 0:
        return placed
    centres, radii = [T_cam[:3, 3]], [clearance]
    for k in range(settings.count):
        asset, said = _playing(objects.draw(rng, split, log), config, rng_shape)
        radius = 0.5 * _log_uniform(rng, (settings.size[0], min(settings.size[1], region.height)))
        resting = config.ground is not None and rng.random() >= settings.flying
        goes, _ = _gait(asset.parts)
        if goes == "anyhow":
            rotation = _rotation(rng, resting)
        else:
            resting = goes == "upright" and config.ground is not None
            rotation = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * math.pi)]).as_matrix()
        changed, word = _changing(asset, settings.deform, rng_shape)
        parts = _dress(config, changed, radius, textures, rng_texture, split, log)
        lowest = min(_lowest(p.mesh, rotation[2]) for p in parts)
        in_view = rng.random() < settings.in_view
        for _ in range(_PLACEMENTS):
            position = _candidate(config, camera, rng, T_cam, floor, in_view, resting)
            if resting:
                position[2] = floor - lowest
            elif not floor + (radius if config.ground else 0) + _GAP <= position[2] <= floor + region.height:
                continue
            gap = np.linalg.norm(np.array(centres) - position, axis=1) - radii - radius
            if (
                (np.abs(position[:2]) <= region.width / 2).all()
                and gap.min() > _GAP
                and gap[0] > max(radius, _STAND_OFF)
            ):
                break
        else:
            log.append(
                f"object {k} ({asset.name}, radius {radius:.2f} m) left out: no free place in {_PLACEMENTS} tries"
            )
            continue
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation, position
        centres.append(position)
        radii.append(radius)
        placed.append((f"{asset.name}#{k}", parts, T, radius, resting))
        log.extend(f"{asset.name}#{k} {text}" for text in (said, word) if text)
        log.extend(line for line in asset.log if line not in log)
        omissions.update(dict.fromkeys(asset.omissions))
    return placed


def _playing(asset: Asset, config: RandomSceneConfig, rng) -> tuple[Asset, str]:
    """The asset as it plays one of its file's animations, and what to say of it. Nothing is drawn for others."""
    if asset.replay is None or config.pool.animation == "rest":
        return asset, ""
    clip, speed, phase = int(rng.integers(len(asset.clips))), float(rng.uniform(0.8, 1.25)), float(rng.uniform(0, 10))
    playing = asset.replay(AnimationConfig(clip=clip, speed=speed, phase=phase)).normalised()
    return playing, f"plays '{asset.clips[clip]}'"


def _changing(asset: Asset, config: RandomDeformConfig, rng) -> tuple[Asset, str]:
    """The asset, of bounding radius 1, as its shape changes, and what to say of it: now and then, by formula. All
    shapes fit into the sphere of radius 1."""
    if config.share == 0 or rng.random() >= config.share or any(p.mesh.deformer is not None for p in asset.parts):
        return asset, ""
    kinds = config.kinds or tuple(DeformConfig.members.models)
    model = DeformConfig.members.models[kinds[int(rng.integers(len(kinds)))]]
    drawn = model.drawn(rng, float(rng.uniform(*config.strength)), _log_uniform(rng, config.period))
    parts = deforming(asset.parts, drawn)
    reach = max(
        float(np.linalg.norm(points, axis=1).max()) + margin for points, margin in (filled(p.mesh) for p in parts)
    )
    smaller = [replace(part, mesh=scale_mesh(part.mesh, 1 / reach)) for part in asset.parts]
    return replace(asset, parts=deforming(smaller, drawn)), f"deforms: {tag_of(model)[1]}"


def _lowest(mesh: Mesh, up: np.ndarray) -> float:
    """Height of its lowest point at any time, along (3,) up in its axes."""
    if mesh.deformer is None:
        return float((mesh.vertices @ up).min())
    points, margin = filled(mesh)
    # A figure's feet are on the ground, and not as far above it as they might be below between two times.
    return float((points @ up).min()) - (0.0 if mesh.deformer.goes == "upright" else margin)


def _candidate(config, camera, rng, T_cam, floor, in_view, resting) -> np.ndarray:
    """A position to try: along a pixel's ray at a log-uniform distance, or anywhere in the region."""
    region = config.region
    if not in_view:
        half = region.width / 2
        return rng.uniform([-half, -half, floor], [half, half, floor + region.height])
    pixel = rng.uniform([-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5])
    ray = T_cam[:3, :3] @ camera.rays(pixel)
    if resting:
        ray[2] = 0.0
    return T_cam[:3, 3] + ray / np.linalg.norm(ray) * _log_uniform(rng, config.objects.distance)


def _gait(parts: Iterable[Part]) -> tuple[str, float]:
    return gait(part.mesh for part in parts)


def _rotation(rng, resting: bool) -> np.ndarray:
    """(3, 3). Flying: uniform over rotations. Resting: any heading, upright or, for half of them, lying on its side."""
    if not resting:
        return Rotation.random(rng=rng).as_matrix()
    heading, tipped, axis = rng.uniform(0, 2 * math.pi), rng.random() < 0.3, int(rng.integers(2))
    tip = Rotation.from_rotvec(np.eye(3)[axis] * (math.pi / 2 if tipped else 0.0))
    return (Rotation.from_rotvec([0, 0, heading]) * tip).as_matrix()


def _dress(config, asset, radius, textures, rng, split, log) -> tuple[Part, ...]:
    """The asset at its size, with its own materials or a random texture and tint."""
    tint = 1 - config.objects.tint * rng.random(3)
    repeats = _log_uniform(rng, config.objects.texture_scale)
    parts = []
    texture = None if asset.has_materials else textures.draw(rng, split, log)
    for part in asset.parts:
        mesh = scale_mesh(part.mesh, radius)
        if asset.has_materials:
            material = replace(
                part.material,
                unlit=part.material.unlit or config.light.unlit,
                double_sided=part.material.double_sided or not mesh.closed,
            )
        else:
            material = Material(
                texture, tuple(float(c) for c in tint), (repeats, repeats), config.light.unlit, not mesh.closed
            )
        parts.append(Part(mesh, material))
    return tuple(parts)


def _bodies(config: RandomPhysicsConfig | None, names: list[str], rng) -> dict[str, BodyConfig]:
    """Those of the objects that fall, by name. As many numbers are drawn for each, whether it falls or not."""
    found = {}
    for name in names if config is not None else ():
        falls, thrown, around, axis = rng.random(), rng.random(), rng.uniform(0, 2 * math.pi), rng.normal(size=3)
        elevation, speed, spin = rng.uniform(0, math.pi / 3), rng.uniform(*config.speed), rng.uniform(*config.spin)
        density, friction = _log_uniform(rng, config.density), rng.uniform(*config.friction)
        restitution = rng.uniform(*config.restitution)
        if falls >= config.share:
            continue
        if thrown >= config.thrown:
            speed = spin = 0.0
        flat = speed * math.cos(elevation)
        found[name] = BodyConfig(
            density=density,
            friction=friction,
            rolling=config.rolling,
            restitution=restitution,
            velocity=(flat * math.cos(around), flat * math.sin(around), speed * math.sin(elevation)),
            spin=tuple(spin * axis / np.linalg.norm(axis)),
        )
    return found


def _sides(config: RandomSceneConfig, floor: float) -> list[Barrier]:
    """Of the region, as far out as walls stand, so that no object is in one; its floor where there is no ground."""
    reach = 0.5 * config.objects.size[1] + _GAP
    out = config.region.width / 2 + reach
    sides = [Barrier((sx, sy, 0.0), -out) for sx, sy in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))]
    sides.append(Barrier((0.0, 0.0, -1.0), -(floor + config.region.height + reach)))
    if config.ground is None:
        sides.append(Barrier((0.0, 0.0, 1.0), floor - reach))
    return sides


def _sky(config: SkyConfig, textures: Pool, rng, split, base, log) -> tuple[tuple[Part, ...], _Panorama | None]:
    """The box around everything, and the panorama that is on it."""
    brightness = float(rng.uniform(*config.brightness))
    repeats, inset = _log_uniform(rng, config.repeat), 1.0
    panorama = None
    if config.panoramas:
        panorama = _panorama(config, rng, split, textures.test_fraction, base, brightness)
        images, repeats, inset = panorama.sides, 1.0, PANORAMA_INSET
    elif config.per_face:
        images = [textures.draw(rng, split, log) for _ in SKY_SIDES]
    else:
        images = [textures.draw(rng, split, log)] * len(SKY_SIDES)
    return sky_box(config.size, config.subdivisions, images, brightness, repeats, inset), panorama


class _Panorama(NamedTuple):
    """Of a sky. sides : of its box.   angle : rad by which it is turned, from +x towards +y."""

    file: Path
    where: str
    sides: list[Texture]
    angle: float
    brightness: float


def _panorama(config: SkyConfig, rng, split, test_fraction, base, brightness: float) -> _Panorama:
    """A panorama of this split, turned to a random heading."""
    files = []
    for i, given in enumerate(config.panoramas):
        path, where = resolve(given, base), f"scene.sky.panoramas.{i}"
        if not path.exists():
            raise ConfigError(
                "no such file or folder",
                where=where,
                value=given,
                accepted="an equirectangular image or a folder of them",
            )
        files += [path] if path.is_file() else files_below(path, where, given, IMAGE_SUFFIXES, "images")
    hashed = sorted({content_hash(contents(f, "image")): f for f in files}.items())
    mine = [(h, f) for h, f in hashed if split_of(h, test_fraction) == split]
    if not mine:
        raise ConfigError(
            f"none of the {len(hashed)} panoramas falls to split '{split}'",
            where="scene.sky.panoramas",
            accepted="more panoramas, or another scene.textures.test_fraction",
        )
    digest, file = mine[int(rng.integers(len(mine)))]
    image = shrink(load_image(file), 4096)
    columns = int(rng.integers(image.shape[1]))
    sides = panorama_textures(np.roll(image, columns, axis=1), file.stem, digest)
    return _Panorama(file, str(file), sides, -2 * math.pi * columns / image.shape[1], brightness)


def _walls(walls: WallsConfig, config: RandomSceneConfig, textures, rng, rng_texture, split, floor, log):
    """(parts, T_world_wall) of slabs outside the region, far enough for any object whose origin stays inside."""
    out = config.region.width / 2 + config.objects.size[1] / 2 + walls.thickness / 2 + _GAP
    for side in rng.permutation(4)[: walls.count]:
        height, length = float(rng.uniform(*walls.height)), 2 * out
        mesh = cuboid(extents=(walls.thickness, length, height), subdivisions=8)
        tile = _log_uniform(rng_texture, walls.tile)
        material = Material(
            textures.draw(rng_texture, split, log), uv_scale=(length / tile, height / tile), unlit=config.light.unlit
        )
        turn = Rotation.from_rotvec([0, 0, math.pi / 2 * side])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.round(turn.as_matrix()), turn.apply([out, 0, 0]) + [0, 0, floor + height / 2]
        yield (Part(mesh, material),), T


def _shift(z: float) -> np.ndarray:
    T = np.eye(4)
    T[2, 3] = z
    return T


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(math.log(bounds[0]), math.log(bounds[1]))))
