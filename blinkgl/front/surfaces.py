"""Light and materials in Python."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from blinkgl.config.lights import LightConfig
from blinkgl.config.materials import MaterialConfig
from blinkgl.errors import ConfigError
from blinkgl.front import arguments as check
from blinkgl.front.poses import Piece, signed_by
from blinkgl.scene import types as data
from blinkgl.scene.surfaces.images import content_hash

MAPS = ("metallic_roughness_map", "normal_map", "emission_map", "mask")


@signed_by(LightConfig, sun_elevation="elevation", sun_azimuth="azimuth")
class Light(Piece):
    """Light of a scene: a sun, a sky and other lamps. A white surface with normal n has radiance
    sun * max(0, n . s) + sky * (0.5 + 0.5 n_z), and the lamps' light in addition.

    elevation, azimuth : of the sun, degrees above the horizon and from +x towards +y (default 60, 40).
    sun_color, sky_color : (3,) linear factors, white by default.
    lights : tables as under ``light.lights`` of the YAML: ``{"kind": "point", "position": (0, 0, 2), "strength": 3}``,
    ``{"kind": "spot", "position": …, "look_at": …, "angle": 40}``, ``{"kind": "sun", "elevation": 20}``.
    environment : a panorama instead of sun and sky, as ``light.environment``: ``{"map": "park.hdr"}``.
    shadows : "off", "hard" or "soft".   sun_size : degrees, for soft shadows.   shadow_size : texels along a side of a
    shadow map.
    unlit : radiance = albedo everywhere.
    Raises ConfigError."""

    def __init__(
        self,
        sun: float = 0.6,
        sky: float = 0.4,
        *,
        lights: Sequence[Mapping[str, Any]] = (),
        environment: Mapping[str, Any] | None = None,
        **keys: object,
    ):
        check.one_of(lights, "Light.lights", (list, tuple), "a list of tables")
        renamed = {argument: key for key, argument in self._called.items()}
        tree = check.given(sun=sun, sky=sky, **{renamed.get(key, key): value for key, value in keys.items()})
        if environment is not None:
            tree["environment"] = check.given(**check.one_of(environment, "Light.environment", Mapping, "a table"))
        if lights:
            for k, one in enumerate(lights):
                check.one_of(one, f"Light.lights[{k}]", Mapping, "a table")
            tree["lights"] = [check.given(**one) for one in lights]
        self.tree = self._checked(LightConfig, tree)
        if environment is not None:
            check.existing(tree["environment"]["map"], "Light.environment.map")


@signed_by(MaterialConfig, texture="image")
class Material(Piece):
    """A surface: ``color`` times at most one texture, matt or glossy, with or without emission.

    image : an image file (sRGB; .hdr is linear), or an array: (h, w, 3) uint8 sRGB, or
    float, linear light from 0 to 1; row 0 is the top.
    color : (3,) linear factor.   procedural, seed : kind and number of a computed texture, such as "bricks".
    photograph : one of scikit-image's, such as "astronaut".   uv_scale : (2,) repeats.
    max_size : px, files with longer sides are reduced.
    unlit : radiance = albedo, whatever the light.   both_sides : draw faces from behind,
    too; None: as the mesh's file says.
    metallic, roughness : 0 to 1; 0 and 1 are matt; times ``metallic_roughness_map``, its blue and its green.
    emission : (3,) linear emitted radiance; times ``emission_map``, sRGB.
    normal_map : x to the right in the picture, y up, z outwards, 0 to 255 for -1 to 1; ``normal_scale`` times its x, y.
    mask : opacity: holes where it is below ``cutoff`` (0 to 1).
    Maps are files, or arrays (h, w, 3) uint8, of the mask (h, w) uint8.
    Raises ConfigError."""

    def __init__(self, image: str | os.PathLike | np.ndarray | None = None, **keys: object):
        if "texture" in keys:  # the YAML's name, which the argument's name would overwrite
            raise ConfigError("has another name", where="Material.texture", accepted="image=…, as in Material(image)")
        maps = {key: keys[key] for key in MAPS if keys.get(key) is not None}
        self.maps = {key: _map(map_, key) for key, map_ in maps.items() if not _is_file(map_)}
        self.image: data.Texture | None = None
        if image is not None and not _is_file(image):
            self.image, image = _texture(image), None
            if keys.get("procedural") is not None or keys.get("photograph") is not None:
                raise ConfigError("only one of image, procedural, photograph may be given", where="Material.image")
        tree = check.given(**{**keys, "texture": image, **{key: f"<{key}>" for key in self.maps}})
        self.tree = self._checked(MaterialConfig, tree)
        for key, file in {"image": image, **maps}.items():
            if file is not None and _is_file(file):
                check.existing(file, f"Material.{key}")


def _is_file(image: object) -> bool:
    return isinstance(image, (str, os.PathLike))


def _pixels(image: object, key: str, accepted: str) -> np.ndarray:
    """Return an array (h, w, 3), of a mask (h, w). Raises ConfigError."""
    where, shape = f"Material.{key}", (None, None) if key == "mask" else (None, None, 3)
    pixels = check.array(image, where, shape, accepted)
    if not pixels.size or max(pixels.shape) > 16384:
        raise ConfigError("size out of range", where=where, value=pixels.shape, accepted="1 to 16384 rows and columns")
    light = pixels.dtype.kind == "f" and key == "image"
    if light and pixels.max() > 1:
        raise ConfigError("values beyond 1", where=where, value=float(pixels.max()), accepted="0 to 1, or uint8 sRGB")
    if not (light and np.isfinite(pixels).all() and pixels.min() >= 0) and pixels.dtype != np.uint8:
        raise ConfigError("pixels cannot be used", where=where, value=str(pixels.dtype), accepted=accepted)
    return np.array(pixels, np.float32 if light else np.uint8, order="C")  # a copy: the scene is a value


def _map(image: object, key: str) -> np.ndarray:
    """Return an array (h, w, 3) uint8, of a mask (h, w)."""
    return _pixels(image, key, f"a file, or an array ({'h, w' if key == 'mask' else 'h, w, 3'}), uint8")


def _texture(image: object) -> data.Texture:
    pixels = _pixels(image, "image", "a file, or an array (h, w, 3), uint8 sRGB or float linear light from 0 to 1")
    return data.Texture(pixels, "image", content_hash(str((pixels.dtype, pixels.shape)).encode(), pixels.tobytes()))
