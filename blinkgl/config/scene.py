"""``scene:`` of the YAML: a random world, an explicit scene, or a scene file.

Relative paths are resolved against the YAML file's folder by :mod:`blinkgl.scene.build`, which also finds out
whether they exist; the models here only know shapes, units and limits.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from blinkgl.config.base import Config, Refused, one_of, rule
from blinkgl.config.deform import AnimationConfig, DeformConfig, RandomDeformConfig
from blinkgl.config.materials import TEXTURE_KINDS, MaterialConfig, Radiance, TextureKind
from blinkgl.config.physics import BodyConfig, PhysicsConfig, RandomPhysicsConfig
from blinkgl.config.places import Matrix, check_rigid
from blinkgl.config.primitives import PRIMITIVES, kinds
from blinkgl.config.trajectory import CameraMotion, ObjectMotion

POOLED, ALL_PRIMITIVES = kinds("pool", "living"), tuple(PRIMITIVES)


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError("the range must be [smallest, largest]")
    return value


def _as_pair(value: Any) -> Any:
    return (value, value) if isinstance(value, (int, float)) and not isinstance(value, bool) else value


def _as_list(value: Any) -> Any:
    return (value,) if isinstance(value, str) else value


def _one_of(words: tuple, kinds: tuple[str, ...] = ()):
    """Refuses what is neither one of ``words`` nor a list of ``kinds``: pydantic would name
    the union's first member only."""

    def check(value: Any) -> Any:
        listed = isinstance(value, (list, tuple)) and kinds
        if not (
            any(value is w or (isinstance(w, str) and value == w) for w in words)
            or (listed and all(v in kinds for v in value))
        ):
            said = ", ".join(str(w).lower() for w in words)
            raise ValueError(f"must be {said}" + (" or a list of " + ", ".join(kinds) if kinds else ""))
        return value

    return BeforeValidator(check)


def _number_or_three(value: Any) -> Any:
    items = value if isinstance(value, (list, tuple)) else [value]
    try:
        ok = (
            len(items) in ((3,) if items is value else (1,))
            and not any(isinstance(v, bool) for v in items)
            and [float(v) for v in items]
        )
    except (TypeError, ValueError):
        ok = False
    if not ok:
        raise ValueError("must be a number or a list of three")
    return value


def _parameter(value: Any) -> Any:
    """A word is not looked at before the primitive sees it; YAML 1.1 reads 1e-1 as text, too."""
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return _number_or_three(value)


def _greater_than_zero(value: Any) -> Any:
    values = value if isinstance(value, tuple) else (value,)
    if min(values) <= 0 or max(values) > 1e9:
        raise ValueError("must be greater than 0 and at most 1e9")
    return value


Positive = Annotated[float, Field(gt=0, le=1e9)]
Fraction = Annotated[float, Field(ge=0, le=1)]
PositiveRange = Annotated[tuple[Positive, Positive], BeforeValidator(_as_pair), AfterValidator(_ordered)]
Paths = Annotated[tuple[str, ...], BeforeValidator(_as_list)]
Vector3 = tuple[float, float, float]
# At 1e9 units float64 still tells 1e-7 units apart; beyond, a unit was mistaken, and float32 matrices would overflow in
# the end.
Coordinate = Annotated[float, Field(ge=-1e9, le=1e9)]
Position = tuple[Coordinate, Coordinate, Coordinate]


class ObjectsConfig(Config):
    """The random world's objects."""

    count: int = Field(20, ge=0, le=1000, description="number of objects")
    size: PositiveRange = Field((0.4, 2.2), description="diameter of an object's bounding sphere, m; log-uniform")
    distance: PositiveRange = Field(
        (2.0, 20.0), description="distance from the camera's first position, m; log-uniform"
    )
    flying: Fraction = Field(0.5, description="fraction that flies; the others rest on the ground")
    in_view: Fraction = Field(
        0.85, description="fraction placed in the camera's first field of view; the others anywhere around it"
    )
    tint: Fraction = Field(0.3, description="strength of the random colour factor on each object's texture")
    texture_scale: PositiveRange = Field(
        (0.7, 2.0), description="texture repeats over an object's texture coordinates; log-uniform"
    )
    deform: RandomDeformConfig = RandomDeformConfig()


class PoolConfig(Config):
    """Where the random world's objects come from."""

    primitives: Annotated[
        Literal["all"] | tuple[Literal[POOLED], ...], _one_of(("all",), POOLED)  # type: ignore[invalid-literal]
    ] = Field(
        "all",
        description="'all', which are the rigid ones, or a list of kinds; [] for none. A figure walks, runs, dances or "
        "waves, a fish swims, a flag flies",
    )
    variants: int = Field(24, ge=1, le=10_000, description="shapes of each primitive kind (aspect ratios, sides)")
    folders: Paths = Field((), description="folders searched recursively for obj, ply, stl, glb, gltf")
    up: Literal["auto", "y", "z"] = Field(
        "auto",
        description="the axis of the folders' files that points up; auto: y for glb and gltf, "
        "z for obj, ply, stl. Resting objects stand on it",
    )
    urdfs: Annotated[Literal["auto"] | bool, _one_of(("auto", True, False))] = Field(
        False,
        description="pybullet's random_urdfs; auto uses them when the wheel is installed, so that the same YAML "
        "gives other scenes there",
    )
    max_faces: int = Field(50_000, ge=1, le=50_000_000, description="a mesh with more triangles is refused")
    max_file_mb: float = Field(512.0, gt=0, description="a larger mesh file is refused unread")
    test_fraction: Fraction = Field(0.1, description="fraction of meshes kept for split 'test', chosen by content hash")
    keep_materials: bool = Field(False, description="use the meshes' own colours and textures where they have any")
    animation: Literal["random", "rest"] = Field(
        "random", description="what a file with animations does: it plays one of them, looped, or keeps its rest shape"
    )
    bad_assets: Literal["error", "skip"] = Field("error", description="skip logs an unusable mesh and draws another")


class TexturesConfig(Config):
    """Where the random world's textures come from."""

    procedural: Annotated[bool | tuple[TextureKind, ...], _one_of((True, False), TEXTURE_KINDS)] = Field(
        True, description="true, false or a list of kinds"
    )
    variants: int = Field(40, ge=1, le=100_000, description="textures of each procedural kind")
    photographs: bool = Field(True, description="the photographs bundled with scikit-image")
    folders: Paths = Field((), description="folders searched recursively for images (also .hdr)")
    max_size: int = Field(512, ge=8, le=8192, description="longer image sides are reduced to this, px")
    test_fraction: Fraction = Field(
        0.1, description="fraction of textures kept for split 'test', chosen by content hash"
    )
    bad_assets: Literal["error", "skip"] = Field("error", description="skip logs an unreadable image and draws another")


class SkyConfig(Config):
    """Textured box around everything, seen from inside, unlit."""

    kind: Literal["box"] = "box"
    size: float = Field(100.0, gt=0, le=1e6, description="edge length, m")
    subdivisions: int = Field(
        4, ge=1, le=256, description="cells per edge; 1 costs a third of the flow's precision, more than 4 gains none"
    )
    repeat: PositiveRange = Field((1.0, 3.0), description="texture repeats per face; log-uniform")
    per_face: bool = Field(True, description="a texture of its own on each face, or one on all")
    brightness: PositiveRange = Field((0.6, 1.1), description="factor on the texture's radiance; uniform")
    panoramas: Paths = Field(
        (),
        description="equirectangular images or folders of them (jpg, png, hdr, exr) used instead of the texture pool",
    )
    lights: bool = Field(
        False,
        description="the panorama lights the world, too, in the place of light.sun and light.sky: what is drawn and "
        "what shines are one picture",
    )

    @rule("lights", "#panoramas")
    def _a_panorama_lights(lights, panoramas):
        if lights and not [*panoramas]:
            raise Refused("only panoramas light", where="lights", value=lights, accepted="false, or sky.panoramas")


class GroundConfig(Config):
    """Textured square at a constant height."""

    size: float | None = Field(None, gt=0, le=1e6, description="edge length, m; null: as the sky box")
    height: float = Field(0.0, description="z of the ground, m")
    subdivisions: int = Field(8, ge=1, le=1024, description="cells per edge; more gains no precision, less costs some")
    tile: PositiveRange = Field((2.0, 8.0), description="edge of one texture repeat, m; log-uniform")


class WallsConfig(Config):
    """Textured vertical slabs on the sides of the region."""

    count: int = Field(0, ge=0, le=4, description="how many of the region's four sides have a wall")
    height: PositiveRange = Field((1.5, 5.0), description="m; uniform")
    thickness: float = Field(0.3, gt=0, description="m")
    tile: PositiveRange = Field((2.0, 6.0), description="edge of one texture repeat, m; log-uniform")


class RegionConfig(Config):
    """Box in which the camera and the objects live, centred on the z axis, standing on the ground."""

    width: float = Field(30.0, gt=0, le=1e6, description="edge in x and y, m")
    height: float = Field(8.0, gt=0, le=1e6, description="m")
    camera_height: PositiveRange = Field((1.0, 3.5), description="camera's first height above the ground, m; uniform")


Color = tuple[Radiance, Radiance, Radiance]
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
    visible: bool = Field(True, description="whether it is drawn, as a box around everything")
    size: float = Field(100.0, gt=0, le=1e6, description="edge of that box, m; it stands around the world's origin")


class LightConfig(Config):
    """A sun and a sky, white as long as nobody says otherwise: E(n) = sun * max(0, n.s) + sky * (0.5 + 0.5 n_z), and
    lights beside them."""

    sun: float = Field(0.9, ge=0, le=1e9, description="strength of the sun, radiance of a white facing surface")
    sky: float = Field(0.6, ge=0, le=1e9, description="strength of the sky")
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
    sun_strength: PositiveRange = Field((0.1, 0.6), description="of further suns; log-uniform")
    saturation: Fraction = Field(
        0.5, description="how colourful they are at most; the brightest channel is 1 and all hues are as likely"
    )
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


class RandomSceneConfig(Config):
    """A random world, as in the paper: objects from a pool between sky and ground."""

    kind: Literal["random"] = "random"
    objects: ObjectsConfig = ObjectsConfig()
    pool: PoolConfig = PoolConfig()
    textures: TexturesConfig = TexturesConfig()
    region: RegionConfig = RegionConfig()
    sky: SkyConfig | None = Field(SkyConfig(), description="null: none, the background is seen")
    ground: GroundConfig | None = Field(GroundConfig(), description="null: none; then every object flies")
    walls: Annotated[WallsConfig, BeforeValidator(lambda v: WallsConfig(count=4 * v) if isinstance(v, bool) else v)] = (
        Field(WallsConfig(), description="true: four walls")
    )
    light: LightConfig = LightConfig()
    fog: FogConfig | None = FOG
    lights: RandomLightsConfig | None = Field(
        None, description="null: none but those of light.lights; {} is enough for one to three point and spot lights"
    )
    object_motion: ObjectMotion = ObjectMotion(static_share=0.3)
    camera_motion: CameraMotion = CameraMotion()
    physics: RandomPhysicsConfig | None = Field(None, description="null: nothing falls. Needs the extra [physics]")
    camera_clearance: float = Field(
        0.3, gt=0, le=1e4, description="radius of the sphere round the camera centre that touches nothing, m"
    )
    background: float = Field(0.2, ge=0, le=1e9, description="linear radiance where nothing is hit")

    @rule("?lights", "sky.lights", "light.unlit", "?light.environment")
    def _lit(lights, sky_lights, unlit, environment):
        for where, given in (("lights", lights), ("sky.lights", sky_lights)):
            if given and unlit:
                raise Refused(
                    "nothing is lit by them", where=where, value="light.unlit: true", accepted="light.unlit: false"
                )
        if environment:
            raise Refused(
                "a random world is lit by its own sky",
                where="light.environment",
                accepted="sky.panoramas and sky.lights",
            )

    @rule("region.width", "region.height", "objects.size", "sky.size")
    def _sky_holds_everything(width: float, height: float, sizes: tuple[float, float], sky: float | None):
        least = max(1.2 * width, width + 2 * sizes[1], 2.2 * height)
        if sky is not None and sky < least:
            raise Refused(f"must be at least {least:g} to hold the region and its objects", where="sky.size", value=sky)

    @rule("region.camera_height", "region.height")
    def _camera_below_the_ceiling(camera_heights: tuple[float, float], height: float):
        if camera_heights[0] >= height:
            raise Refused(
                f"must begin below region.height {height:g}", where="region.camera_height", value=list(camera_heights)
            )

    @rule("objects.size", "region.height")
    def _objects_below_the_ceiling(sizes: tuple[float, float], height: float):
        if sizes[0] >= height:
            raise Refused(f"must begin below region.height {height:g}", where="objects.size", value=list(sizes))


class PoseConfig(Config):
    """Position, and at most one way to say the orientation."""

    position: Position = Field((0.0, 0.0, 0.0), description="m")
    quaternion: tuple[float, float, float, float] | None = Field(
        None, description="[w, x, y, z], need not be normalised"
    )
    euler: Vector3 | None = Field(None, description="degrees about the fixed x, y, z axes, applied in this order")
    look_at: Position | None = Field(
        None, description="point that the camera's z axis, or an object's x axis, is turned to"
    )

    @rule("quaternion", "euler", "look_at")
    def _one_orientation(quaternion, euler, look_at):
        given = [k for k, v in (("quaternion", quaternion), ("euler", euler), ("look_at", look_at)) if v is not None]
        if len(given) > 1:
            raise Refused("only one of quaternion, euler, look_at may be given, not " + " and ".join(given))

    @rule("quaternion")
    def _some_rotation(quaternion: tuple[float, ...] | None):
        if quaternion is not None and sum(q * q for q in quaternion) < 1e-12:
            raise Refused("a quaternion must not be zero", where="quaternion", value=list(quaternion))

    @rule("look_at", "position")
    def _some_direction(look_at, position):
        if look_at is not None and max(abs(a - b) for a, b in zip(look_at, position)) < 1e-9:
            raise Refused("must differ from the position", where="look_at", value=list(look_at))


class KeyframeConfig(PoseConfig):
    """A pose at a time."""

    time: float = Field(
        ge=-1e7, le=1e7, description="s on the sequence's clock (the first label is at time.start + 1 / label_rate)"
    )


class TrajectoryConfig(Config):
    """Poses of a file, and a C2 spline through them. They are T_world_body: of a camera with OpenCV's axes, of an
    object with its own. The file has to cover the sequence."""

    file: str = Field(description="TUM: t x y z qx qy qz qw; or EuRoC's CSV: t, x, y, z, qw, qx, qy, qz")
    form: Literal["auto", "tum", "euroc"] = Field("auto", description="auto: EuRoC's where lines have commas")
    start: float | None = Field(
        None,
        ge=-1e10,
        le=1e10,
        description="s on the file's clock that are 0 s on the sequence's; null: the first pose is at time.start",
    )
    smooth: float = Field(
        0.0,
        ge=0,
        le=60,
        description="each pose becomes the mean of those within so many s before and after, weighed by a triangle; 0: "
        "the spline passes them all",
    )
    speed_limit: float = Field(
        100.0,
        gt=0,
        le=1e9,
        description="world units/s from one pose to the next: what is faster is taken for a jump, or for poses in mm, "
        "and refused",
    )
    turn_limit: float = Field(7200.0, gt=0, le=1e9, description="degrees/s from one pose to the next, likewise")
    T_body_sensor: str | Matrix | None = Field(
        None,
        description="where this camera or object is on the body whose poses the file has, from its axes to the body's: "
        "EuRoC's sensor.yaml, whose T_BS that is, or four rows of four; null: it is that body",
    )

    @rule("T_body_sensor")
    def _a_place(place):
        if place is not None and not isinstance(place, str):
            check_rigid(place, "T_body_sensor")


class KeyedMotionConfig(PoseConfig):
    """A fixed pose, key frames, or a trajectory from a file; before the first and after the last the pose is held.
    From one key frame to the next a body turns the shortest way (for ``spline``: near it), so ``euler`` may change
    by less than 180 degrees per step; whole turns need key frames in between."""

    keyframes: tuple[KeyframeConfig, ...] = Field((), description="two or more poses with increasing times")
    interpolation: Literal["spline", "linear"] = Field(
        "spline", description="between key frames: C2 spline, or straight lines and slerp"
    )

    trajectory: TrajectoryConfig | None = Field(None, description="poses of a file, in place of a pose or key frames")

    @rule("?trajectory", "#keyframes", "position", "quaternion", "euler", "look_at")
    def _one_source(trajectory, keyframes, position, *orientation):
        if trajectory and (keyframes or any(position) or any(o is not None for o in orientation)):
            raise Refused("give a trajectory, a fixed pose or keyframes, not several of them", where="trajectory")

    @rule("keyframes.*.time")
    def _in_order(times: tuple[float, ...]):
        if len(times) == 1:
            raise Refused("one key frame is no motion; give two or more, or a fixed pose", where="keyframes")
        for k, (before, after) in enumerate(itertools.pairwise(times)):
            if after - before < 1e-6:
                raise Refused(
                    "the key frames' times must increase by at least 1e-6 s",
                    where=f"keyframes.{k + 1}.time",
                    value=after,
                )

    @rule("#keyframes", "position", "quaternion", "euler", "look_at")
    def _pose_or_keyframes(keyframes, position, *orientation):
        if keyframes and (any(position) or any(o is not None for o in orientation)):
            raise Refused("give a fixed pose or keyframes, not both")

    @rule("keyframes.*.euler", "keyframes.*.quaternion", "keyframes.*.look_at")
    def _shortest_turns(eulers: tuple, quaternions: tuple, look_ats: tuple):
        # Between poses the body turns the shortest way: half a turn has no shortest way, and more would go back.
        otherwise = [q is not None or at is not None for q, at in zip(quaternions, look_ats)]
        for k in range(len(eulers) - 1):
            if otherwise[k] or otherwise[k + 1]:
                continue
            steps = [abs(v - u) for u, v in zip(eulers[k] or (0, 0, 0), eulers[k + 1] or (0, 0, 0))]
            if max(steps) >= 180:
                raise Refused(
                    f"euler changes by {max(steps):g} degrees about {'xyz'[steps.index(max(steps))]} from key frame "
                    f"{k} to {k + 1}; it must be less than 180 (add key frames in between)"
                )


class WayConfig(Config):
    """A curve that a body follows at one speed, its x axis ahead; beyond an open end it goes straight on."""

    points: tuple[Position, ...] = Field(description="two or more places, m; the curve is smooth and passes them all")
    speed: float | None = Field(
        None,
        gt=0,
        le=1e4,
        description="m/s; null: as fast as a figure's steps or a fish's strokes take it, so that feet do not slide; "
        "1 for other bodies",
    )
    closed: bool = Field(False, description="from the last point back to the first, and on")
    level: bool = Field(True, description="its z axis stays up; false: its x axis goes up and down with the way")
    start: Fraction = Field(0.0, description="share of the way that lies behind it at time 0")

    @rule("#points", "closed")
    def _a_way(points, closed):
        least, given = (3 if closed else 2), len([*points])
        if given < least:
            raise Refused(f"a way needs {least} points or more", where="points", value=given)


class MeshConfig(Config):
    """A primitive with its parameters, or a file."""

    primitive: Literal[ALL_PRIMITIVES] | None = Field(None, description="kind of primitive")  # type: ignore[invalid-literal]
    parameters: dict[str, Annotated[int | float | Vector3 | str, BeforeValidator(_parameter)]] = Field(
        {},
        description="the primitive's sizes, numbers of faces, and what it does: see [primitives](#primitives)",
    )
    file: str | None = Field(None, description="obj, ply, stl, glb or gltf file")
    up: Literal["auto", "y", "z"] = Field(
        "auto",
        description="the file's axis that points up, which becomes the world's z: with y, the file's "
        "(x, y, z) is drawn at (x, -z, y). auto: y for glb and gltf, as their standard says; z (the file's own "
        "coordinates) for obj, ply, stl",
    )
    project_uvs: bool = Field(False, description="replace the file's texture coordinates by a box projection")
    uv_size: float = Field(
        1.0, gt=0, description="edge of one repeat of projected texture coordinates, in the mesh's units"
    )

    @rule("primitive", "file")
    def _one(primitive, file):
        if (primitive is None) == (file is None):
            raise Refused("give exactly one of primitive and file")

    @rule("file", "#parameters")
    def _parameters_of_a_primitive(file, parameters):
        if file is not None and parameters:
            raise Refused("parameters belong to a primitive, not to a file", where="parameters")

    @rule("?file", "up")
    def _up_of_a_file(file, up):
        if not file and up != "auto":
            raise Refused("up belongs to a file, not to a primitive", where="up", value=up)


class ObjectConfig(KeyedMotionConfig):
    """One object of an explicit scene."""

    name: str | None = Field(None, description="null: the mesh's name")
    mesh: str = Field(description="a name under scene.meshes")
    material: str | None = Field(None, description="a name under scene.materials; null: the file's own materials")
    scale: Annotated[float | Vector3, BeforeValidator(_number_or_three), AfterValidator(_greater_than_zero)] = Field(
        1.0, description="factor on the mesh, one or per axis"
    )
    category: Literal["object", "ground", "wall", "sky"] = Field(
        "object", description="what it is: collisions and drawing order"
    )
    animation: str | int | AnimationConfig | None = Field(
        None, description="clip of the mesh's gltf or glb file that it plays, looped; null: the file at rest"
    )
    physics: BodyConfig | None = Field(
        None,
        description="what it is to the engine of a scene with physics; null: it is in the way, where it stands "
        "or moves",
    )
    deform: DeformConfig | None = Field(
        None,
        description="how its shape changes with time, by formula, whatever it does by itself; null: it is rigid, but "
        "for figure, flag, fish",
    )
    way: WayConfig | None = Field(None, description="a curve that it follows, in place of a pose or key frames")

    @rule("?way", "?trajectory")
    def _a_way_or_a_trajectory(way, trajectory):
        if way and trajectory:
            raise Refused("give a way or a trajectory, not both", where="way")

    @rule("?way", "#keyframes", "position", "quaternion", "euler", "look_at")
    def _one_motion(way, keyframes, position, *orientation):
        if way and (keyframes or any(position) or any(o is not None for o in orientation)):
            raise Refused("give a way, a fixed pose or keyframes, not several of them")

    @rule("physics.kind", "?trajectory")
    def _the_engine_or_a_trajectory(kind, trajectory):
        if kind == "dynamic" and trajectory:
            raise Refused(
                "a dynamic body has no trajectory: the engine moves it",
                where="physics.kind",
                value=kind,
                accepted="fixed, which pushes what it meets on its way",
            )

    @rule("physics.kind", "#keyframes")
    def _the_engine_or_key_frames(kind, keyframes):
        if kind == "dynamic" and keyframes:
            raise Refused(
                "a dynamic body has no key frames: the engine moves it",
                where="physics.kind",
                value=kind,
                accepted="fixed, which pushes what it meets on its way, or a pose without key frames",
            )


def _known(used, known, key: str, table: str, at=None) -> None:
    for number, name in zip(at if at is not None else range(len(used)), used):
        if name not in known:
            raise Refused(
                f"no such name under {table}",
                where=f"objects.{number}.{key}",
                value=name,
                accepted="one of: " + ", ".join(known) if known else f"a name under {table}",
            )


def object_names(names: Iterable[str | None], meshes: Iterable[str]) -> list[str]:
    """Names of an explicit scene's objects: as given (None: not), else the mesh's, with the
    object's number where that is taken."""
    made: list[str] = []
    for number, (name, mesh) in enumerate(zip(names, meshes)):
        name = name or (mesh if mesh not in made else f"{mesh}#{number}")
        if name in made:
            raise Refused("the name is given to two objects", where=f"objects.{number}.name", value=name)
        made.append(name)
    return made


class ExplicitSceneConfig(Config):
    """A custom scene: named meshes and materials, objects with poses or key frames, the camera likewise."""

    kind: Literal["explicit"]
    meshes: dict[str, MeshConfig] = Field({}, description="by name")
    materials: dict[str, MaterialConfig] = Field({}, description="by name")
    objects: tuple[ObjectConfig, ...] = Field(min_length=1, description="at least one")
    collisions: bool = Field(
        False,
        description="true: find collisions along the trajectories and stop what collides there (what falls is not "
        "looked at: see physics)",
    )
    camera: KeyedMotionConfig = Field(description="pose or key frames; OpenCV axes: x right, y down, z forward")
    physics: PhysicsConfig | None = Field(
        None,
        description="null: nothing falls. {} is enough: gravity for objects that say physics. Needs the extra "
        "[physics]",
    )
    light: LightConfig = LightConfig()
    fog: FogConfig | None = FOG
    background: float = Field(0.2, ge=0, le=1e9, description="linear radiance where nothing is hit")
    max_faces: int = Field(5_000_000, ge=1, description="a mesh with more triangles is refused")

    @rule("objects.*.mesh", "#meshes")
    def _meshes_are_known(used, known):
        _known(used, known, "mesh", "scene.meshes")

    @rule("?physics", "objects.*.physics.kind")
    def _something_falls(physics: bool, kinds: tuple[str | None, ...]):
        for k, kind in enumerate(kinds):
            if kind is not None and not physics:
                raise Refused(
                    "the scene has no physics",
                    where=f"objects.{k}.physics",
                    accepted="scene.physics, too: {} is enough",
                )
        if physics and "dynamic" not in kinds:
            raise Refused(
                "no object falls", where="physics", accepted="objects with physics, of kind dynamic, or physics: null"
            )

    @rule("objects.*.name", "objects.*.mesh")
    def _names_differ(names: tuple[str | None, ...], meshes: tuple[str, ...]):
        object_names(names, meshes)

    @rule("objects.*.material", "#materials")
    def _materials_are_known(used, known):
        _known(
            [name for name in used if name is not None],
            known,
            "material",
            "scene.materials",
            at=[k for k, n in enumerate(used) if n is not None],
        )


class FileSceneConfig(Config):
    """A finished glTF/GLB scene with its cameras, materials and node animations. The file's y axis points up, as its
    standard says, and is drawn as the world's z: the file's (x, y, z) is at (x, -z, y). Poses given here are in that
    z-up world."""

    kind: Literal["file"]
    path: str = Field(description="gltf or glb file")
    camera: str | int | None = Field(None, description="name or index of the file's camera; null: the first")
    pose: KeyedMotionConfig | None = Field(
        None, description="camera motion used instead of the file's camera (z-up world)"
    )
    intrinsics: Literal["config", "file"] = Field(
        "config", description="focal length from the YAML's camera or from the file's (yfov)"
    )
    animation: str | int | AnimationConfig | None = Field(
        0, description="name or index of the animation played, at the file's own times; null: none"
    )
    light: LightConfig = LightConfig()
    fog: FogConfig | None = FOG
    lights: Literal["config", "file"] = Field(
        "config",
        description="file: the file's own lights (KHR_lights_punctual) shine in the place of light.sun, beside "
        "light.sky and light.lights",
    )
    lights_gain: Positive = Field(
        1.0,
        description="factor on the file's lights, whose lux and candela are divided by 683 lm/W, as Blender's exporter "
        "multiplies them",
    )
    background: float = Field(0.2, ge=0, le=1e9, description="linear radiance where nothing is hit")
    max_faces: int = Field(5_000_000, ge=1, description="a scene with more triangles is refused")
    max_texture_size: int = Field(2048, ge=1, le=16384, description="longer texture sides are reduced to this, px")

    @rule("lights", "light.unlit")
    def _lit(lights, unlit):
        if lights == "file" and unlit:
            raise Refused(
                "nothing is lit by them", where="lights", value=lights, accepted="config, or light.unlit: false"
            )


SceneConfig = one_of("kind", RandomSceneConfig, ExplicitSceneConfig, FileSceneConfig, default="random")
