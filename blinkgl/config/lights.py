"""Lights of a scene: ``light:``, random lights, panoramas and fog."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from pydantic import BeforeValidator, Field

from blinkgl.config.base import Config, Former, Refused, always, one_of, rule
from blinkgl.config.materials import Radiance
from blinkgl.config.poses import KeyedMotionConfig
from blinkgl.config.values import (
    Color,
    Fraction,
    Position,
    Positive,
    PositiveRange,
    Vector3,
)
from blinkgl.config.waveforms import OVER_TIME, WaveformConfig

MAX_LIGHTS = 31  # plus the sun


class _LampConfig(Config):
    strength: Radiance = Field(
        1.0,
        description="radiance of a white surface that faces it; for point and spot lights at a distance of 1 m",
    )
    color: Color = Field((1.0, 1.0, 1.0), description="linear factor")
    over_time: WaveformConfig | None = OVER_TIME


class SunLampConfig(_LampConfig):
    """A further sun: parallel light."""

    kind: Literal["sun"]
    elevation: float = Field(60.0, ge=-90, le=90, description="degrees above the horizon")
    azimuth: float = Field(40.0, ge=-360, le=360, description="degrees from +x towards +y")
    size: float = Field(0.53, ge=0, le=45, description="angular diameter, degrees: softens soft shadows")


class _PlacedLampConfig(_LampConfig):
    position: Position | None = Field(None, description="m; or a motion")
    motion: KeyedMotionConfig | None = Field(
        None,
        description="pose, key frames or trajectory, instead of position and look_at; it shines along z",
    )
    reach: Positive | None = Field(
        None,
        description="distance, m, at which it has faded to zero, by the factor 1 - (distance / reach)^4; null: no "
        "limit",
    )

    @rule("position", "?motion")
    def _a_place(position, motion):
        if (position is None) == (not motion):
            raise Refused("a lamp has a position or a motion", where="position", value=position)


class PointLampConfig(_PlacedLampConfig):
    """Shines in all directions."""

    kind: Literal["point"]


class SpotLampConfig(_PlacedLampConfig):
    """Shines in a cone."""

    kind: Literal["spot"]
    look_at: Position | None = Field(None, description="a point on the axis of the cone, m; with a motion: null")
    angle: float = Field(60.0, ge=0.5, le=170, description="full angle of the cone, degrees")
    edge: Fraction = Field(0.2, description="fraction of the half angle over which it fades out")
    size: float = Field(0.1, ge=0, le=1e3, description="diameter, m: softens soft shadows")

    @rule("look_at", "position")
    def _some_direction(look_at, position):
        if (look_at is None) != (position is None):
            raise Refused("a spot light has a position and look_at, or a motion", where="look_at", value=look_at)
        if look_at is not None and max(abs(a - b) for a, b in zip(look_at, position)) < 1e-9:
            raise Refused("must differ from the position", where="look_at", value=list(look_at))


LampConfig = one_of("kind", SunLampConfig, PointLampConfig, SpotLampConfig)


class EnvironmentConfig(Config):
    """A panorama that lights a scene and is its sky."""

    map: str = Field(description="equirectangular image, hdr or exr; an 8-bit one has no bright sun")
    strength: Radiance = Field(
        1.0,
        description="factor on its radiance (scaled so that 90 % of the solid angle is darker than 0.8)",
    )
    heading: float = Field(0.0, ge=-360, le=360, description="rotation, degrees from +x towards +y")
    visible: bool = Field(True, description="whether it is drawn as a sky at infinity")
    former: ClassVar[dict[str, Former]] = {
        "size": Former("the key left out: a panorama is at infinity", lambda value: value == 100)
    }


class LightConfig(Config):
    """A sun and a sky, E(n) = sun * max(0, n.s) + sky * (0.5 + 0.5 n_z), and further lights."""

    sun: float = Field(0.6, ge=0, le=1e9, description="strength of the sun, radiance of a white facing surface")
    sky: float = Field(0.4, ge=0, le=1e9, description="strength of the sky")
    over_time: WaveformConfig | None = Field(
        None,
        description="factor over time on sun, sky or environment (docs/light.md)",
    )
    sun_elevation: float | None = Field(
        None,
        ge=-90,
        le=90,
        description="degrees above the horizon; null: random in [25, 80] (60 where nothing is random)",
    )
    sun_azimuth: float | None = Field(
        None, ge=-360, le=360, description="degrees from +x towards +y; null: random (40 where nothing is random)"
    )
    sun_color: Color = Field((1.0, 1.0, 1.0), description="linear factor")
    sky_color: Color = Field((1.0, 1.0, 1.0), description="linear factor")
    sun_size: float = Field(0.53, ge=0, le=45, description="angular diameter, degrees: softens soft shadows")
    lights: tuple[LampConfig, ...] = Field((), description="further suns, point and spot lights, in world coordinates")
    environment: EnvironmentConfig | None = Field(
        None,
        description="a panorama that lights the scene instead of sun and sky; in random worlds use sky.lights",
    )
    shadows: Annotated[Literal["off", "hard", "soft"], BeforeValidator(lambda v: "off" if v is False else v)] = Field(
        "off",
        description="hard: edges one texel wide, of at most four suns and spot lights; soft: wider for larger lights, "
        "up to 48 texels, of two",
    )
    shadow_size: int = Field(1024, ge=64, le=8192, description="side of each shadow map, texels")
    unlit: bool = Field(False, description="radiance = albedo on every surface")

    def sun_direction(self, elevation: float = 60.0, azimuth: float = 40.0) -> Vector3:
        """Return the unit vector towards the sun; the arguments (degrees) replace angles that the configuration leaves
        open."""
        return direction_of(
            elevation if self.sun_elevation is None else self.sun_elevation,
            azimuth if self.sun_azimuth is None else self.sun_azimuth,
        )

    @rule("#lights")
    def _not_too_many(lights):
        if (count := len([*lights])) > MAX_LIGHTS:
            raise Refused("too many lights", where="lights", value=count, accepted=f"at most {MAX_LIGHTS}")

    @rule("unlit", "#lights", "?environment", "?over_time", "shadows")
    def _lit(unlit, lights, environment, over_time, shadows):
        effects = {"lights": [*lights], "environment": environment, "over_time": over_time, "shadows": shadows != "off"}
        for where, used in effects.items():
            if unlit and used:
                raise Refused("these lights have no effect", where=where, value="unlit: true", accepted="unlit: false")


def direction_of(elevation: float, azimuth: float) -> Vector3:
    """Return the world unit vector at these angles in degrees: above the horizon, and from +x towards +y."""
    e, a = math.radians(elevation), math.radians(azimuth)
    return math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)


class RandomLightsConfig(Config):
    """Further lights of a random world, each at a random position in the region, above the ground."""

    count: tuple[Annotated[int, Field(ge=0, le=MAX_LIGHTS)], Annotated[int, Field(ge=0, le=MAX_LIGHTS)]] = Field(
        (1, 3), description="[fewest, most]; uniform"
    )
    kinds: Annotated[tuple[Literal["sun", "point", "spot"], ...], Field(min_length=1)] = Field(
        ("point", "spot"), description="kinds that are drawn, equally likely"
    )
    strength: PositiveRange = Field((3.0, 30.0), description="of point and spot lights; log-uniform")
    sun_strength: ClassVar[tuple[float, float]] = (0.1, 0.6)
    """Strength of further suns; log-uniform."""
    saturation: ClassVar[float] = 0.5
    """Largest saturation of a colour; the brightest channel is 1 and all hues are equally likely."""
    former: ClassVar[dict[str, Former]] = {"sun_strength": always(sun_strength), "saturation": always(saturation)}
    height: PositiveRange = Field((2.0, 6.0), description="above the ground, m; uniform")
    angle: PositiveRange = Field((30.0, 100.0), description="angle of a spot light's cone, degrees; uniform")

    @rule("count")
    def _fewest_first(count: tuple[int, int]):
        if count[0] > count[1]:
            raise Refused("the range must be [fewest, most]", where="count", value=list(count))

    @rule("angle")
    def _a_cone(angle: tuple[float, float]):
        if angle[1] > 170 or angle[0] < 0.5:
            raise Refused("out of range", where="angle", value=list(angle), accepted="0.5 to 170 degrees")


class FogConfig(Config):
    """A medium that absorbs light and adds its own, for event frames and images."""

    density: float = Field(gt=0, le=1e6, description="per world unit: 37 % of the light is left after 1 / density")
    radiance: Radiance = Field(0.7, description="linear radiance of the fog itself, which replaces the background")


FOG = Field(None, description="null: clear air")
