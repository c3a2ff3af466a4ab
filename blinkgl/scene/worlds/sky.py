"""The sky: a box of pictures around everything, or a panorama at infinity, which can also be the light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from blinkgl.config.lights import EnvironmentConfig
from blinkgl.config.scene import SkyConfig
from blinkgl.errors import ConfigError
from blinkgl.scene.geometry.primitives import parameter_hash, square
from blinkgl.scene.lights import lit_by
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.reading import contents, existing, resolve
from blinkgl.scene.surfaces.environment import environment, turned
from blinkgl.scene.surfaces.images import (
    IMAGE_SUFFIXES,
    SKY_SIDES,
    content_hash,
    cube_faces,
    load_panorama,
    panorama_picture,
    shrink,
)
from blinkgl.scene.types import FARTHEST, Light, Material, Mesh, Part, SceneObject, Texture
from blinkgl.scene.worlds.pool import files_below, split_of

_MARGIN = 1 / 16
PANORAMA_INSET = 1 / (1 + _MARGIN)
"""Fraction of a side's texture on its side of the box: the rest is for filtering."""


def sky_box(
    size: float, subdivisions: int, images: Sequence[Texture], brightness: float, repeats: float, inset: float = 1.0
) -> tuple[Part, ...]:
    """Return six inward squares around the origin. images : of the sides +x, -x, +y, -y, +z, -z.   inset : fraction of
    each texture that the side shows."""
    half, n, parts = size / 2, subdivisions, []
    for (forward, right, down), texture, side in zip(SKY_SIDES, images, ("+x", "-x", "+y", "-y", "+z", "-z")):
        positions, normals, uvs, faces = square(
            half * (forward - right + down), 2 * half * right, -2 * half * down, n, n
        )
        uvs = 0.5 + (uvs - 0.5) * inset
        mesh = Mesh(
            positions,
            faces.astype(np.int32),
            np.ascontiguousarray(normals, np.float32),
            uvs.astype(np.float32),
            name=f"sky {side}",
            source_hash=parameter_hash("sky", size, n, side, inset),
        )
        parts.append(Part(mesh, Material(texture, (brightness,) * 3, (repeats, repeats), unlit=True)))
    return tuple(parts)


def panorama_sky(textures: Sequence[Texture], brightness: float) -> tuple[Part, ...]:
    """Return a panorama of :func:`panorama_textures` as the parts of a sky at infinity.

    The box is so large that even in a view of 140 degrees no side is nearer than ``FARTHEST`` along its axis."""
    return sky_box(32 * FARTHEST, 4, textures, brightness, 1.0, PANORAMA_INSET)


def panorama_textures(image: np.ndarray, name: str, digest: str) -> list[Texture]:
    """Return six textures of an equirectangular image, for :func:`panorama_sky`."""
    # A quarter of the panorama's width for 90 degrees keeps its resolution at the horizon.
    sides = cube_faces(image, max(image.shape[1] // 4, 1), _MARGIN)
    return [
        Texture(side, f"{name} side {k}", content_hash(digest.encode(), bytes([k]))) for k, side in enumerate(sides)
    ]


def panorama_light(file: Path, angle: float, brightness: float, light: Light, where: str) -> Light:
    """Return ``light`` with a panorama instead of its sun and sky, as bright as :func:`panorama_picture` shows it times
    ``brightness``. angle : rotation, rad, from +x towards +y. Raises AssetError."""
    radiance, exposure = load_panorama(file, where)
    return lit_by(turned(environment(radiance), angle), exposure * brightness, light)


def with_environment(
    config: EnvironmentConfig | None, light: Light, base: Path, objects: Sequence[SceneObject]
) -> tuple[Light, tuple[SceneObject, ...]]:
    """Return (light, objects) of a scene that a panorama lights; unchanged where none does. Raises ConfigError and
    AssetError."""
    objects = tuple(objects)
    if config is None:
        return light, objects
    where = "scene.light.environment.map"
    file = existing(config.map, base, where, "an equirectangular image")
    light = panorama_light(file, np.radians(config.heading), config.strength, light, f"{where}: {config.map}")
    if config.visible:
        image = shrink(panorama_picture(file), 4096)
        # A panorama's columns are azimuth, so turning it about z moves them; it decreases to the right.
        image = np.roll(image, -round(config.heading / 360 * image.shape[1]), axis=1)
        textures = panorama_textures(image, file.stem, content_hash(contents(file, "image"), repr(config).encode()))
        parts = panorama_sky(textures, config.strength)
        number = 1 + max((obj.instance_id for obj in objects), default=0)
        objects = (*objects, SceneObject("sky", number, parts, StaticPath(), "sky", at_infinity=True))
    return light, objects


class Panorama(NamedTuple):
    """The panorama of a sky. sides : of its box.   angle : rotation, rad, from +x towards +y."""

    file: Path
    sides: list[Texture]
    angle: float
    brightness: float


def drawn_panorama(
    config: SkyConfig, rng: np.random.Generator, split: str, test_fraction: float, base: Path, brightness: float
) -> Panorama:
    """Return a random panorama of this split, turned to a random heading."""
    files = []
    for i, entry in enumerate(config.panoramas):
        path, where = resolve(entry, base), f"scene.sky.panoramas.{i}"
        if not path.exists():
            raise ConfigError(
                "no such file or folder",
                where=where,
                value=entry,
                accepted="an equirectangular image or a folder of them",
            )
        files += [path] if path.is_file() else files_below(path, where, entry, IMAGE_SUFFIXES, "images")
    # By content: neither names, copies nor the order of a folder change what is drawn.
    hashed = sorted({content_hash(contents(f, "image")): f for f in files}.items())
    mine = [(h, f) for h, f in hashed if split_of(h, test_fraction) == split]
    if not mine:
        raise ConfigError(
            f"none of the {len(hashed)} panoramas falls to split '{split}'",
            where="scene.sky.panoramas",
            accepted="more panoramas, or another scene.textures.test_fraction",
        )
    digest, file = mine[int(rng.integers(len(mine)))]
    image = shrink(panorama_picture(file), 4096)
    # Turned by whole columns, so that no pixel is interpolated.
    columns = int(rng.integers(image.shape[1]))
    sides = panorama_textures(np.roll(image, columns, axis=1), file.stem, digest)
    return Panorama(file, sides, -2 * math.pi * columns / image.shape[1], brightness)
