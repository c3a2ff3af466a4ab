"""Build a :class:`~blinkgl.scene.types.Scene` from its configuration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from blinkgl.config.camera import CameraConfig, camera_radius
from blinkgl.config.deform import AnimationConfig, animation_of
from blinkgl.config.lights import LightConfig
from blinkgl.config.poses import KeyedMotionConfig
from blinkgl.config.rig import RigSensorConfig, baseline_of
from blinkgl.config.scene import ExplicitSceneConfig, FileSceneConfig, RandomSceneConfig, SceneConfig
from blinkgl.config.sequence import SequenceConfig
from blinkgl.config.waveforms import MAX_CHANGES
from blinkgl.errors import ConfigError
from blinkgl.scene.reading import existing
from blinkgl.scene.rig import Rig, Sensor
from blinkgl.scene.types import Fog, Scene
from blinkgl.scene.worlds.explicit import check_primitive, explicit_scene
from blinkgl.scene.worlds.from_file import scene_from_file
from blinkgl.scene.worlds.pool import SPLITS
from blinkgl.scene.worlds.random_world import pools, random_world

_MANY_CHANGES = 10_000
"""Of the light: a note says what they cost before anything is drawn."""


def build_scene(
    config: SceneConfig,
    camera: CameraConfig,
    t0_ns: int,
    t1_ns: int,
    *,
    split: str = "train",
    seed: int = 0,
    sequence: int = 0,
    base: Path | str = ".",
    px_per_slope: float = 0.0,
) -> Scene:
    """Return the scene over [t0_ns, t1_ns].

    camera : the camera; a file's own may replace it (``scene.intrinsics``).   px_per_slope : of a rig's sharpest.
    split : 'train' or 'test', the part of the pools for random scenes.
    seed, sequence : random scenes are a function of these and the configuration; repetition gives identical arrays.
    base : folder that the configuration's relative paths start from.
    Raises ConfigError and AssetError.
    """
    if split not in SPLITS:
        raise ConfigError("unknown split", where="output.split", value=split, accepted="train or test")
    if not t0_ns < t1_ns:
        raise ValueError("build_scene: t0_ns must be before t1_ns")
    base = Path(base)
    if isinstance(config, RandomSceneConfig):
        scene = random_world(config, camera.model, t0_ns, t1_ns, split, seed, sequence, base)
    elif isinstance(config, ExplicitSceneConfig):
        scene = explicit_scene(config, camera.model, t0_ns, t1_ns, base, px_per_slope=px_per_slope)
    else:
        scene = scene_from_file(config, camera.model, t0_ns, t1_ns, base)
    return in_fog(scene, config)


def _counted_changes(scene: Scene) -> Scene:
    """Return the scene with a note where its light changes so often that this decides the number of frames. Raises
    ConfigError: more than :data:`MAX_CHANGES` times."""
    seconds, notes = (scene.t1_ns - scene.t0_ns) * 1e-9, scene.log
    for name, wave in scene.waveforms.items():
        if (changes := wave.per_second() * seconds) > MAX_CHANGES:
            raise ConfigError(
                "the light changes too often: each jump and turn needs its frames",
                where=f"over_time of {name}",
                value=f"{changes:.3g} times in {seconds:g} s",
                accepted=f"at most {MAX_CHANGES:,} times: a lower frequency, or a shorter time",
            )
        if changes > _MANY_CHANGES:
            notes += (f"{name}: its light changes {changes:,.0f} times, and each change needs up to two frames",)
    return replace(scene, log=notes)


def in_fog(scene: Scene, config: SceneConfig) -> Scene:
    """Return the scene with the fog of ``scene.fog`` in its configuration."""
    fog = config.fog
    return scene if fog is None else replace(scene, fog=Fog(fog.density, fog.radiance))


def sequence_scene(config: SequenceConfig, index: int, base: Path | str = ".") -> Scene:
    """Return the scene of sequence ``index`` of a run, with the sensors of the configuration.

    base : folder that the configuration's relative paths start from. Raises ConfigError and AssetError."""
    time, seed = config.time, config.seed
    scene = build_scene(
        _with_room(config) if config.sensors else config.scene,
        seen_by(config),
        time.t0_ns,
        time.t1_ns,
        split=config.output.split,
        seed=seed,
        sequence=index,
        base=base,
        px_per_slope=sharpest_of(config),
    )
    return equipped(scene, config)


def equipped(scene: Scene, config: SequenceConfig) -> Scene:
    """Return the scene with the sensors of the configuration, and a note on what its times leave out."""
    scene = _counted_changes(scene)
    scene = replace(scene, omissions=scene.omissions + config.time.cut)
    if config.sensors is None:
        return scene
    pairs: dict[str | None, RigSensorConfig] = {one.name: one for one in config.sensors}
    sensors = [Sensor(one.camera.model, one.place.T, baseline_of(one, pairs.get(one.pair))) for one in config.sensors]
    return replace(scene, rig=Rig(scene.rig.path, tuple(sensors)))


def seen_by(config: SequenceConfig) -> CameraConfig:
    """Return the camera that a scene is made for: a rig's first one; without one, the top level's."""
    return next((one.camera for one in config.sensors or () if one.sees), config.camera)


def sharpest_of(config: SequenceConfig) -> float:
    """Return the largest ``px_per_slope`` of a rig's cameras; 0: no rig."""
    return max((one.camera.model.px_per_slope for one in config.sensors or () if one.sees), default=0.0)


def _with_room(config: SequenceConfig) -> SceneConfig:
    """Return the scene's configuration in which a random world keeps clear of every camera of the rig."""
    scene = config.scene
    if not isinstance(scene, RandomSceneConfig):
        return scene
    # A camera beside the rig's origin stays within a ball around it, however the rig turns.
    reach = [
        float(np.linalg.norm(one.place.T[:3, 3])) + camera_radius(one.camera.model, scene.camera_clearance)
        for one in config.sensors or ()
        if one.sees
    ]
    return scene.model_copy(update={"camera_clearance": max([scene.camera_clearance, *reach])})


def check_assets(config: SceneConfig, base: Path | str = ".", split: str = "train") -> None:
    """Find missing folders, empty pools and every missing file that a sequence would open, before any work starts.
    Raises ConfigError or AssetError."""
    base = Path(base)
    if isinstance(config, RandomSceneConfig):
        objects, textures = pools(config, base)
        # A world without objects draws none, so that an empty pool is no fault there.
        if config.objects.count:
            objects.split(split)
        textures.split(split)
    elif isinstance(config, ExplicitSceneConfig):
        _check_motion(config.camera, base, "scene.camera")
        for k, item in enumerate(config.objects):
            _check_motion(item, base, f"scene.objects.{k}")
            _check_animation(item.animation, base, f"scene.objects.{k}.animation")
        for name, mesh in config.meshes.items():
            _exists(mesh.file, base, f"scene.meshes.{name}.file", "a mesh file")
            if mesh.primitive is not None:
                check_primitive(mesh.primitive, mesh.parameters, name)
        for name, material in config.materials.items():
            for key, used in material.files.items():
                _exists(used, base, f"scene.materials.{name}.{key}", "an image file")
    else:
        assert isinstance(config, FileSceneConfig)
        _exists(config.path, base, "scene.path", "a gltf or glb file")
        _check_motion(config.pose, base, "scene.pose")
        _check_animation(config.animation, base, "scene.animation")
    _exists(panorama_of(config.light), base, "scene.light.environment.map", "a panorama")
    for k, lamp in enumerate(config.light.lights):
        _check_motion(getattr(lamp, "motion", None), base, f"scene.light.lights.{k}.motion")


def _check_animation(animation: str | int | AnimationConfig | None, base: Path, where: str) -> None:
    if (clip := animation_of(animation)) is not None:
        _exists(clip.file, base, f"{where}.file", "a gltf or glb file")


def _check_motion(config: KeyedMotionConfig | None, base: Path, where: str) -> None:
    if config is None or config.trajectory is None:
        return
    _exists(config.trajectory.file, base, f"{where}.trajectory.file", "a trajectory")
    if isinstance(place := config.trajectory.T_body_sensor, str):
        _exists(place, base, f"{where}.trajectory.T_body_sensor", "EuRoC's sensor.yaml")


def panorama_of(light: LightConfig) -> str | None:
    """Return the file of the panorama that lights a scene; None: none."""
    return None if light.environment is None else light.environment.map


def _exists(path: str | None, base: Path, where: str, what: str) -> None:
    if path is not None:
        existing(path, base, where, what)
