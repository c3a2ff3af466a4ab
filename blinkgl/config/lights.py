"""``light:`` of a scene: lamps, panoramas, fog."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field

from blinkgl.config.base import Config, Refused, Removed, one_of, rule
from blinkgl.config.materials import Radiance
from blinkgl.config.values import (
    Color,
    Fraction,
    Position,
    Positive,
    PositiveRange,
    Vector3,
)

MAX_LIGHTS = 31  # and the sun


class _LampConfig(Config):
    strength: Radiance = Field(
        1.0,
        description="radiance of a white surface that faces it; of a point or spot light 1 m away from it, falling "
        "with the square of the distance",
    )
    color: Color = Field((1.0, 1.0, 1.0), description="linear factor")


class SunLampConfig(_LampConfig):
    """A further sun: parallel light."""

    kind: Literal["sun"]
    elevation: float = Field(60.0, ge=-90, le=90, description="degrees above the horizon")
    azimuth: float = Field(40.0, ge=-360, le=360, description="degrees from +x towards +y")
    size: float = Field(0.53, ge=0, le=45, description="its diameter in the sky, degrees: softens soft shadows")


class _PlacedLampConfig(_LampConfig):
    position: Position = Field(description="m")
    reach: Positive | None = Field(
        None,
        description="m at which it has faded to nothing, by 1 - (distance / reach)^4; null: it falls with the square "
        "of the distance alone",
    )


class PointLampConfig(_PlacedLampConfig):
    """Shines to all sides."""

    kind: Literal["point"]


class SpotLampConfig(_PlacedLampConfig):
    """Shines in a cone."""

    kind: Literal["spot"]
    look_at: Position = Field(description="a point on the cone's axis, m")
    angle: float = Field(60.0, ge=0.5, le=170, description="of the whole cone, degrees")
    edge: Fraction = Field(0.2, description="share of the half angle over which it fades out")
    size: float = Field(0.1, ge=0, le=1e3, description="its diameter, m: softens soft shadows")

    @rule("look_at", "position")
    def _some_direction(look_at, position):
        if max(abs(a - b) for a, b in zip(look_at, position)) < 1e-9:
            raise Refused("must differ from the position", where="look_at", value=list(look_at))


LampConfig = one_of("kind", SunLampConfig, PointLampConfig, SpotLampConfig)


class EnvironmentConfig(Config):
    """A panorama that lights a scene in the place of light.sun and light.sky, and is seen as its sky."""

    map: str = Field(description="equirectangular image: hdr or exr, or one of 8 bits, which knows no bright sun")
    strength: Radiance = Field(
        1.0, description="factor on its radiance, which is exposed so that its 90th percentile is 0.8"
    )
    heading: float = Field(0.0, ge=-360, le=360, description="degrees by which it is turned from +x towards +y")
    visible: bool = Field(True, description="whether it is drawn, as a sky at infinity")
    removed: ClassVar[Any] = {"size": Removed("no size: a panorama is at infinity", lambda value: value == 100)}


class LightConfig(Config):
    """A sun and a sky, white as long as nobody says otherwise: E(n) = sun * max(0, n.s) + sky * (0.5 + 0.5 n_z), and
    lights beside them."""

    sun: float = Field(0.6, ge=0, le=1e9, description="strength of the sun, radiance of a white facing surface")
    sky: float = Field(0.4, ge=0, le=1e9, description="strength of the sky")
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
    sun_size: float = Field(0.53, ge=0, le=45, description="its diameter in the sky, degrees: softens soft shadows")
    lights: tuple[LampConfig, ...] = Field(
        (), description="suns, point and spot lights beside the sun and the sky, in the world's coordinates"
    )
    environment: EnvironmentConfig | None = Field(
        None,
        description="a panorama that lights the scene; null: the sun and the sky shine. In random worlds: sky.lights",
    )
    shadows: Annotated[Literal["off", "hard", "soft"], BeforeValidator(lambda v: "off" if v is False else v)] = Field(
        "off",
        description="of objects and walls, cast by the sun, further suns and spot lights, four at most (soft: two); "
        "hard: edges are as wide as a texel of the shadow map; soft: by the size of the light, up to 48 texels",
    )
    shadow_size: int = Field(1024, ge=64, le=8192, description="texels a side of each shadow map")
    unlit: bool = Field(False, description="radiance = albedo on every surface")

    def sun_direction(self, elevation: float = 60.0, azimuth: float = 40.0) -> Vector3:
        """Unit vector towards the sun; the arguments (degrees) stand where the configuration leaves the angle open."""
        return direction_of(
            elevation if self.sun_elevation is None else self.sun_elevation,
            azimuth if self.sun_azimuth is None else self.sun_azimuth,
        )

    @rule("#lights")
    def _not_too_many(lights):
        if (given := len([*lights])) > MAX_LIGHTS:
            raise Refused("too many lights", where="lights", value=given, accepted=f"at most {MAX_LIGHTS}")

    @rule("unlit", "#lights", "?environment", "shadows")
    def _lit(unlit, lights, environment, shadows):
        for where, given in (("lights", [*lights]), ("environment", environment), ("shadows", shadows != "off")):
            if unlit and given:
                raise Refused("nothing is lit by them", where=where, value="unlit: true", accepted="unlit: false")


def direction_of(elevation: float, azimuth: float) -> Vector3:
    """Unit vector in the world, of angles in degrees: above the horizon, and from +x towards +y."""
    e, a = math.radians(elevation), math.radians(azimuth)
    return math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)


class RandomLightsConfig(Config):
    """Lights that a random world has beside its sun and sky, each at a place above the ground of the region."""

    count: tuple[Annotated[int, Field(ge=0, le=MAX_LIGHTS)], Annotated[int, Field(ge=0, le=MAX_LIGHTS)]] = Field(
        (1, 3), description="[fewest, most] lights; every number as likely"
    )
    kinds: Annotated[tuple[Literal["sun", "point", "spot"], ...], Field(min_length=1)] = Field(
        ("point", "spot"), description="each light is one of these, all as likely"
    )
    strength: PositiveRange = Field((3.0, 30.0), description="of point and spot lights, see light.lights; log-uniform")
    sun_strength: ClassVar[Any] = (0.1, 0.6)
    """Of further suns; log-uniform."""
    saturation: ClassVar[Any] = 0.5
    """How colourful they are at most; the brightest channel is 1 and all hues are as likely."""
    fixed: ClassVar[Any] = ("sun_strength", "saturation")
    height: PositiveRange = Field((2.0, 6.0), description="above the ground, m; uniform")
    angle: PositiveRange = Field((30.0, 100.0), description="of a spot light's cone, degrees; uniform")

    @rule("count")
    def _fewest_first(count: tuple[int, int]):
        if count[0] > count[1]:
            raise Refused("the range must be [fewest, most]", where="count", value=list(count))

    @rule("angle")
    def _a_cone(angle: tuple[float, float]):
        if angle[1] > 170 or angle[0] < 0.5:
            raise Refused("out of range", where="angle", value=list(angle), accepted="0.5 to 170 degrees")


class FogConfig(Config):
    """A medium that swallows light and sends its own, for event frames and images alike."""

    density: float = Field(gt=0, le=1e6, description="per world unit: light from 1 / density away has faded to 37 %")
    radiance: Radiance = Field(0.7, description="linear radiance of fog alone, which is what the background becomes")


FOG = Field(None, description="null: clear air")
