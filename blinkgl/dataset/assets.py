"""The files that a run's scenes may use: whether they are there, and the hashes that tell two machines' files apart."""

from __future__ import annotations

import hashlib
import json
import posixpath
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from blinkgl.config.base import placed
from blinkgl.config.run import Group, RunTemplate, without_places
from blinkgl.config.scene import ExplicitSceneConfig, FileSceneConfig, RandomSceneConfig
from blinkgl.config.sequence import SequenceConfig
from blinkgl.dataset.plan import Plan
from blinkgl.errors import AssetError, ConfigError
from blinkgl.events.thresholds import measured_thresholds
from blinkgl.io.trajectories import TIMES
from blinkgl.scene.build import check_assets as check_scene, panorama_of
from blinkgl.scene.importing.mesh_files import border_of, identity_of
from blinkgl.scene.motion.dynamics import engine_version
from blinkgl.scene.reading import contents, existing, resolve
from blinkgl.scene.surfaces.images import IMAGE_SUFFIXES, content_hash
from blinkgl.scene.worlds.pool import files_below
from blinkgl.scene.worlds.random_world import forget_pools, pools
from blinkgl.sequence.recorded import matching_folders, used_images


def check_assets(plan: Plan) -> dict[str, str]:
    """Return the content hash of every file that the run's scenes may use, by name; frame folders by name and size.

    Raises ConfigError and AssetError: missing folders, empty pools, pools too small for the split, too few frame
    folders."""
    forget_pools()
    hashes: dict[str, str] = {}
    for group in plan.used:
        with placed(str, before=f"in group '{group.name}': " if group.name else ""):
            _check_group(group, plan.counts[group.name], hashes)
    return hashes


def libraries(plan: Plan) -> dict[str, str]:
    """Return versions of libraries that only some runs use and that affect the bytes. Raises ConfigError where one
    is not installed."""
    return {"mujoco": engine_version()} if any(_falls(group.template.tree) for group in plan.used) else {}


def digest(hashes: dict[str, str]) -> str:
    """Return one hash of :func:`check_assets`, to compare machines."""
    return hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()


_ASSET_CORNERS = 48
"""Configurations whose files are checked: enough for every choice of a file, few enough for scenes that take long."""


def _check_group(group: Group, count: int, hashes: dict[str, str]) -> None:
    base = group.template.base
    _hash_thresholds(group.template, base, hashes)
    if _falls(group.template.tree):
        engine_version()
    for config in _asset_corners(group.template):
        if config.frames is not None:
            folders = matching_folders(config.frames, base)
            last = group.first + count - 1
            if len(folders) > 1 and last >= len(folders):
                raise ConfigError(
                    f"{len(folders)} folders are too few for sequence {last}",
                    where="frames.folders",
                    value=list(config.frames.folders),
                    accepted=f"at least {last + 1} folders, or fewer output.sequences",
                )
            for folder in folders:
                # One bad folder is set aside alone; frames that are too far apart are an error of the recipe.
                with suppress(AssetError):
                    used_images(config.frames, folder)
                for path in sorted(folder.rglob("*")):
                    if path.is_file():
                        name = f"frames/{folder.name}/{path.relative_to(folder).as_posix()}"
                        _note(hashes, name, f"{path.stat().st_size} bytes")
            continue
        check_scene(config.scene, base, config.output.split)
        _hash_scene_files(config.scene, base, hashes)


def _asset_corners(template: RunTemplate) -> Iterator[SequenceConfig]:
    """Yield configurations that represent the scenes and frame folders that can be drawn; each once."""
    seen = set()
    for config in template.corners[:_ASSET_CORNERS]:
        recipe = repr((config.scene, config.frames))
        if recipe not in seen:
            seen.add(recipe)
            yield config


def _hash_thresholds(template: RunTemplate, base: Path, hashes: dict[str, str]) -> None:
    """Note the measured thresholds of the pixels of all cameras. Raises AssetError and EventDataError; for recorded
    frames, whose size is not known yet, only AssetError."""
    used = {
        (name, camera.config.camera.height, camera.config.camera.width, config.frames is None)
        for config in template.corners[:_ASSET_CORNERS]
        for camera in config.cameras()
        if camera.gives_events and (name := getattr(camera.config.events, "threshold_map", None)) is not None
    }
    for name, height, width, drawn in sorted(used):
        file = existing(name, base, "events.threshold_map", "a .npy file of thresholds")
        if drawn:
            measured_thresholds(str(file), height, width)
        _note(hashes, without_places(name), content_hash(contents(file, "threshold map")))


def _falls(tree: object) -> bool:
    """Return whether some draw of a recipe may have physics."""
    return any(physics is not None for physics in _values(tree, "physics"))


def _values(tree: object, key: str) -> Iterator[object]:
    """Yield what ``key`` says anywhere in plain data."""
    if isinstance(tree, dict):
        yield from [tree[key]] if key in tree else ()
    for value in tree.values() if isinstance(tree, dict) else tree if isinstance(tree, (list, tuple)) else ():
        yield from _values(value, key)


def _note(hashes: dict[str, str], name: str, value: str) -> None:
    """Note a file by its name, without the place of its folder: the same files may be elsewhere tomorrow."""
    while hashes.get(name, value) != value:  # of another folder that is called the same
        name += "'"
    hashes[name] = value


def _hash_scene_files(scene, base: Path, hashes: dict[str, str]) -> None:
    def file(path: Path, name: str) -> None:
        data = contents(path, "file")
        _note(hashes, without_places(name), content_hash(data))
        for beside, digest in identity_of(path, data, border_of(path, base)).files.items():
            _note(hashes, without_places((Path(name).parent / beside).as_posix()), digest)

    if isinstance(scene, RandomSceneConfig):
        for entry in (entry for pool in pools(scene, base) for entry in pool.entries if entry.file is not None):
            folder = without_places(entry.source)
            _note(hashes, f"{folder}/{entry.name}", entry.shape)
            for beside, digest in entry.beside:
                _note(hashes, posixpath.normpath(f"{folder}/{Path(entry.name).parent.as_posix()}/{beside}"), digest)
        for name in scene.sky.panoramas if scene.sky else ():
            path = resolve(name, base)
            for paths in (
                files_below(path, "scene.sky.panoramas", name, IMAGE_SUFFIXES, "images") if path.is_dir() else [path]
            ):
                _note(hashes, f"{without_places(name)}/{paths.name}", content_hash(contents(paths, "panorama")))
    # A random world has files of its own besides its pools only in its light: trajectories of lamps.
    tree = scene.light.model_dump() if isinstance(scene, RandomSceneConfig) else scene.model_dump()
    for used in dict.fromkeys([*_values(tree, "file"), *_values(tree, "T_body_sensor")]):
        if isinstance(used, str) and resolve(used, base).is_file():  # a mesh, a trajectory, a clip
            file(resolve(used, base), used)
    for trajectory in _values(tree, "trajectory"):
        # Poses without times take them from there.
        used = Path(trajectory["file"]).with_name(TIMES).as_posix() if isinstance(trajectory, dict) else None
        if used is not None and resolve(used, base).is_file():
            file(resolve(used, base), used)
    if isinstance(scene, ExplicitSceneConfig):
        for used in {used: None for m in scene.materials.values() for used in m.files.values()}:
            file(resolve(used, base), used)
    elif isinstance(scene, FileSceneConfig):
        file(resolve(scene.path, base), scene.path)
    if not isinstance(scene, RandomSceneConfig) and (panorama := panorama_of(scene.light)) is not None:
        file(resolve(panorama, base), panorama)
