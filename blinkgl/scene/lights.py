"""Radiance of a white surface under lights, in float64: the numbers that the renderer passes to its shaders.

Every strength is the radiance of a white surface that faces the light: for a sun at any distance, for a point or spot
light at 1 world unit (it falls with the square of the distance). An irradiance of E (W/m²) is therefore a strength of E
/ pi, and an intensity of I (W/sr) is I / pi.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from blinkgl.config.lights import (
    LightConfig,
    PointLampConfig,
    RandomLightsConfig,
    SpotLampConfig,
    SunLampConfig,
    direction_of,
)
from blinkgl.config.poses import KeyedMotionConfig
from blinkgl.config.waveforms import CodeConfig, LightKeysConfig, PwmConfig, SineConfig
from blinkgl.scene.motion.paths import OffsetPath, StaticPath
from blinkgl.scene.motion.pose_path import PosePath
from blinkgl.scene.surfaces.environment import Environment, pixel_directions
from blinkgl.scene.surfaces.gloss import blurred
from blinkgl.scene.types import Lamp, Light
from blinkgl.scene.waveforms import Code, Keys, Pwm, Sine, Waveform
from blinkgl.types.poses import pose_of

MAX_LAMPS = 32
"""Largest number of lamps of a scene: every lit pixel evaluates each."""
_SKY_SIZE = (64, 128)  # of the plain sky, which has an edge at the horizon and is uniform otherwise
NEAREST = 1e-3
"""World units; points nearer to a point or spot light than this are lit as if they were this far."""


def lamp_pose(position: ArrayLike = (0.0, 0.0, 0.0), shines: ArrayLike = (0.0, 0.0, -1.0)) -> np.ndarray:
    """Return T_world_lamp, (4, 4), of a lamp at ``position`` that shines in the direction (3,), of any length."""
    z = -np.asarray(shines, np.float64)
    z = z / np.linalg.norm(z)
    # Any axis that is not nearly parallel to z.
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return pose_of(position, np.stack([x, np.cross(z, x), z], axis=1))


def _scaled(color: Sequence[float] | np.ndarray, factor: float) -> tuple[float, float, float]:
    r, g, b = (float(factor * c) for c in color)
    return r, g, b


def lamps_of(light: Light) -> tuple[Lamp, ...]:
    """Return the sun, where there is one, and the lamps, in the shaders' order: suns, point lights, spot lights."""
    lamps = light.lamps
    if light.sun:
        strength = _scaled(light.sun_color, light.sun)
        towards = lamp_pose(shines=-np.asarray(light.sun_direction))
        lamps = (Lamp("sun", strength, StaticPath(towards), size=light.sun_size, over_time=light.over_time), *lamps)
    return tuple(sorted(lamps, key=lambda lamp: ("sun", "point", "spot").index(lamp.kind)))


MAX_SHADOWS, MAX_SOFT = 4, 2
"""Largest number of lamps whose shadows are drawn, and of soft ones, whose programs are long: each needs a map and a
texture unit."""


def shadowing(light: Light) -> tuple[int, ...]:
    """Return which of :func:`lamps_of` cast shadows: suns, then spot lights, the first of each."""
    if light.shadows == "off":
        return ()
    lamps = lamps_of(light)
    suns, spots = ([k for k, lamp in enumerate(lamps) if lamp.kind == kind] for kind in ("sun", "spot"))
    most = MAX_SOFT if light.shadows == "soft" else MAX_SHADOWS
    suns = suns[:most]
    return (*suns, *spots[: most - len(suns)])


def quadric_of(light: Light) -> np.ndarray:
    """Return the light of the surroundings per channel, (3, 4, 4), for :func:`ambient`; world axes."""
    one = np.zeros((4, 4))
    # The quadric n^T Q n with n = (x, y, z, 1): a constant, and half of the linear term on either side of the diagonal.
    one[3, 3] = 0.5
    one[2, 3] = one[3, 2] = 0.25  # 0.5 + 0.5 n_z
    sky = light.sky * np.asarray(light.sky_color, np.float64)[:, None, None] * one
    return sky if light.quadric is None else sky + np.asarray(light.quadric, np.float64)


def is_coloured(light: Light) -> bool:
    """Return whether any light is not white, so that a surface's luminance is not its albedo's times a number."""
    forms = [form for form in (quadric_of(light), quartic_of(light)) if form is not None]
    return any(len(set(lamp.strength)) > 1 for lamp in lamps_of(light)) or any((f != f[:1]).any() for f in forms)


def quartic_of(light: Light) -> np.ndarray | None:
    """Return the order-4 light of the surroundings, (3, 9, 9), for :func:`ambient`; world axes. None: only
    :func:`quadric_of`."""
    return None if light.quartic is None else np.asarray(light.quartic, np.float64)


def ambient(quadric: np.ndarray, normal: np.ndarray, quartic: np.ndarray | None = None) -> np.ndarray:
    """Return the radiance of a white surface with (..., 3) unit normals, (..., 3), from light of the surroundings: (n,
    1) Q (n, 1) per channel, not below 0. quadric : (3, 4, 4), symmetric, in the axes of the normals.   quartic : (3, 9,
    9), a form of the nine products of two coordinates, which is added."""
    n = np.concatenate([normal, np.ones((*normal.shape[:-1], 1))], axis=-1)
    # n^T Q n of each channel.
    sums = np.einsum("...i,cij,...j->...c", n, quadric, n)
    if quartic is not None:
        pairs = np.einsum("...i,...j->...ij", normal, normal).reshape(*normal.shape[:-1], 9)
        sums = sums + np.einsum("...i,cij,...j->...c", pairs, quartic, pairs)
    return np.maximum(sums, 0.0)


def seen_around(light: Light) -> np.ndarray:
    """Return the radiance of the surroundings, (h, w, 3) float32, without lamps, as a panorama with pixels as in
    :func:`~blinkgl.scene.surfaces.environment.pixel_directions`. Light known only by its quadric is replaced by the
    radiance of a white surface under it, which is as smooth."""
    height, width = _SKY_SIZE if light.surroundings is None else light.surroundings.shape[:2]
    picture = np.zeros((height, width, 3), np.float32)
    if light.surroundings is not None:
        picture += light.surroundings
    elif light.quadric is not None:
        directions, _ = pixel_directions(height, width)
        picture += ambient(np.asarray(light.quadric, np.float64), directions, quartic_of(light))
    # Rows run from the zenith downwards: the upper half is the sky.
    picture[: height // 2] += np.float32(light.sky) * np.asarray(light.sky_color, np.float32)
    return picture


def surroundings_of(light: Light) -> np.ndarray:
    """Return (levels, h, w, 3) float32: :func:`seen_around` mirrored by surfaces of several roughnesses
    (:func:`~blinkgl.scene.surfaces.gloss.blurred`)."""
    if light.quadric is None and light.surroundings is None:  # one column suffices
        return _half_a_sky() * (np.float32(light.sky) * np.asarray(light.sky_color, np.float32))
    return blurred(seen_around(light))


@lru_cache(maxsize=1)
def _half_a_sky() -> np.ndarray:
    """Return (levels, h, 1, 3): the same in all columns."""
    return blurred(seen_around(Light(sun=0.0, sky=1.0)))[:, :, :1]


def beam(lamp: Lamp, pose: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the light of a lamp at (N, 3) points, both in world axes: (N, 3) unit vectors towards it, and (N, 3)
    strength, the radiance of a white surface that faces it, without shadows. pose : (4, 4) T_world_lamp."""
    axis, strength = pose[:3, 2], np.asarray(lamp.strength, np.float64)
    if lamp.kind == "sun":
        return np.broadcast_to(axis, points.shape), np.broadcast_to(strength, points.shape)
    way = pose[:3, 3] - points
    distance = np.maximum(np.linalg.norm(way, axis=-1), NEAREST)
    towards = way / distance[:, None]
    fall = distance**-2.0
    if math.isfinite(lamp.reach):
        # The window of KHR_lights_punctual: 0 at the reach, and no change nearby.
        fall = fall * np.maximum(0.0, 1.0 - (distance / lamp.reach) ** 4)
    if lamp.kind == "spot":
        # KHR_lights_punctual: 1 within the inner angle, 0 from the outer one on.
        scale, offset = lamp.cone
        fall = fall * np.clip(towards @ axis * scale + offset, 0.0, 1.0) ** 2
    return towards, fall[:, None] * strength


# ---- from the configuration ---------------------------------------------------------------------------------------


LampPath = Callable[[KeyedMotionConfig, str], PosePath]
"""The path of a lamp's motion: T_world of a camera's axes, from its configuration and where that stands."""


def make_light(
    config: LightConfig,
    path_of: LampPath,
    rng: np.random.Generator | None = None,
    further: Sequence[Lamp] = (),
) -> Light:
    """Return the light of a scene. The sun's direction is drawn where the configuration leaves it open and ``rng`` is
    given.
    path_of : makes the paths of lamps that move.   further : lamps in addition to the configuration's."""
    drawn = () if rng is None else (float(rng.uniform(25, 80)), float(rng.uniform(-180, 180)))
    return Light(
        sun_direction=config.sun_direction(*drawn),
        sun=config.sun,
        sky=config.sky,
        sun_color=config.sun_color,
        sky_color=config.sky_color,
        sun_size=math.radians(config.sun_size),
        over_time=waveform_of(config.over_time),
        lamps=(*(_lamp(k, one, path_of) for k, one in enumerate(config.lights)), *further),
        shadows=config.shadows,
        shadow_size=config.shadow_size,
    )


def waveform_of(config: SineConfig | PwmConfig | CodeConfig | LightKeysConfig | None) -> Waveform | None:
    """Return the factor over time that a configuration describes; None: constant."""
    if config is None:
        return None
    if isinstance(config, LightKeysConfig):
        times = tuple(round(key.time * 1e9) for key in config.keys)
        return Keys(times, tuple(key.factor for key in config.keys), config.interpolation == "hold")
    kinds = {SineConfig: Sine, PwmConfig: Pwm, CodeConfig: Code}
    return kinds[type(config)](**config.model_dump(exclude={"kind"}))


_AS_A_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])
"""T_camera_lamp: a lamp shines along its -z axis, a camera looks along its z axis."""


def _lamp(k: int, config: SunLampConfig | PointLampConfig | SpotLampConfig, path_of: LampPath) -> Lamp:
    lamp = replace(_still(config), name=f"lights[{k}]", over_time=waveform_of(config.over_time))
    if isinstance(config, SunLampConfig) or config.motion is None:
        return lamp
    return replace(lamp, path=OffsetPath(path_of(config.motion, f"scene.light.lights.{k}.motion"), _AS_A_CAMERA))


def _still(config: SunLampConfig | PointLampConfig | SpotLampConfig) -> Lamp:
    """Return a lamp as it is without its motion and its changes over time."""
    strength = _scaled(config.color, config.strength)
    if isinstance(config, SunLampConfig):
        shines = -np.asarray(direction_of(config.elevation, config.azimuth))
        return Lamp("sun", strength, StaticPath(lamp_pose(shines=shines)), size=math.radians(config.size))
    reach = math.inf if config.reach is None else config.reach
    if not isinstance(config, SpotLampConfig):
        return Lamp("point", strength, StaticPath(lamp_pose(config.position or (0.0, 0.0, 0.0))), reach)
    outer = math.radians(config.angle / 2)
    pose = np.eye(4)
    if config.position is not None and config.look_at is not None:
        pose = lamp_pose(config.position, np.subtract(config.look_at, config.position))
    return Lamp(
        kind="spot",
        strength=strength,
        path=StaticPath(pose),
        reach=reach,
        inner=outer * (1 - config.edge),
        outer=outer,
        size=config.size,
    )


def lit_by(panorama: Environment, factor: float, light: Light) -> Light:
    """Return the light with a panorama's instead of its sun and sky. factor : on its radiance."""
    suns = [
        Lamp(
            kind="sun",
            strength=_scaled(sun.strength, factor),
            path=StaticPath(lamp_pose(shines=-sun.towards)),
            size=sun.size,
            over_time=light.over_time,
        )
        for sun in panorama.suns
    ]
    around, finer = (
        None if form is None else tuple(tuple(tuple(float(factor * v) for v in row) for row in one) for one in form)
        for form in (panorama.quadric, panorama.quartic)
    )
    lamps, picture = (*suns, *light.lamps), panorama.picture * np.float32(factor)
    return replace(light, sun=0.0, sky=0.0, lamps=lamps, quadric=around, quartic=finer, surroundings=picture)


LUMENS_PER_WATT = 683.0
"""Divisor of photometric units of files; Blender's exporter multiplies by it."""


def lamp_of_gltf(light: Mapping[str, Any], path: PosePath, gain: float) -> Lamp:
    """Return the lamp of an entry of KHR_lights_punctual: lux of a directional light, candela of others."""
    # Photometric units over 683 are radiometric ones; over pi they are the radiance of a white surface.
    strength = _scaled(light["color"], gain * light["intensity"] / (LUMENS_PER_WATT * math.pi))
    if light["type"] == "directional":
        return Lamp("sun", strength, path)
    reach = light["range"] or math.inf
    if light["type"] == "point":
        return Lamp("point", strength, path, reach)
    # The extension's angles are from the axis to the edge, as a lamp's are.
    return Lamp("spot", strength, path, reach, light["spot"]["innerConeAngle"], light["spot"]["outerConeAngle"])


def random_lamps(config: RandomLightsConfig, rng: np.random.Generator, half_width: float) -> tuple[Lamp, ...]:
    """Return the lamps of a random world, whose ground is at z = 0. half_width : of the region, m."""
    lamps = []
    for _ in range(int(rng.integers(config.count[0], config.count[1] + 1))):
        kind = config.kinds[int(rng.integers(len(config.kinds)))]
        low, high = np.log(config.sun_strength if kind == "sun" else config.strength)
        hue, saturation = rng.uniform(0, 2 * math.pi), rng.uniform(0, config.saturation)
        # Three cosines a third of a turn apart: a colour of this hue.
        color = 0.5 + 0.5 * np.cos(hue + np.array([0.0, 2.0, 4.0]) * math.pi / 3)
        color = 1 - saturation * (1 - color / color.max())
        strength = _scaled(color, np.exp(rng.uniform(low, high)))
        place = np.array([*rng.uniform(-half_width, half_width, 2), rng.uniform(*config.height)])
        # A spot light shines on the ground between the region's middle and the place below it.
        target = np.array([*(place[:2] * rng.uniform(0, 1)), 0.0])
        # Drawn for lamps of every kind, so that the kind changes no later draw.
        elevation, azimuth, angle = rng.uniform(25, 80), rng.uniform(-180, 180), rng.uniform(*config.angle)
        if kind == "sun":
            pose = lamp_pose(shines=-np.asarray(direction_of(elevation, azimuth)))
            # 0.53 degrees is the sun's diameter as seen from the earth.
            lamps.append(Lamp("sun", strength, StaticPath(pose), size=math.radians(0.53)))
        elif kind == "point":
            lamps.append(Lamp("point", strength, StaticPath(lamp_pose(place))))
        else:
            outer = math.radians(angle / 2)
            pose = lamp_pose(place, target - place)
            lamps.append(Lamp("spot", strength, StaticPath(pose), inner=0.8 * outer, outer=outer, size=0.1))
    return tuple(lamps)
