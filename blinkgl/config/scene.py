"""The ``scene:`` section: a random world, an explicit scene, or a scene file.

:mod:`blinkgl.scene.build` resolves relative paths against the YAML file's folder and checks that the files exist; these
models define only shapes, units and limits.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, WrapValidator

from blinkgl.config.base import Config, Former, Refused, always, one_of, rule
from blinkgl.config.deform import AnimationConfig, DeformConfig, RandomDeformConfig
from blinkgl.config.lights import FOG, FogConfig, LightConfig, RandomLightsConfig
from blinkgl.config.materials import TEXTURE_KINDS, MaterialConfig, TextureKind
from blinkgl.config.physics import BodyConfig, PhysicsConfig, RandomPhysicsConfig
from blinkgl.config.poses import KeyedMotionConfig, WayConfig
from blinkgl.config.primitives import PRIMITIVES, kinds, or_registered
from blinkgl.config.trajectory import CameraMotion, ObjectMotion
from blinkgl.config.values import (
    Fraction,
    Paths,
    Positive,
    PositiveRange,
    Vector3,
    greater_than_zero,
    number_or_three,
    parameter_value,
    word_or_list,
)

POOLED = kinds("pool", "living")
_Primitive = Literal[tuple(PRIMITIVES)]  # type: ignore[invalid-literal]


class ObjectsConfig(Config):
    """The random world's objects."""

    count: int = Field(20, ge=0, le=1000, description="number of objects")
    size: PositiveRange = Field((0.4, 2.2), description="diameter of an object's bounding sphere, m; log-uniform")
    distance: PositiveRange = Field(
        (2.0, 20.0), description="distance from the camera's first position, m; log-uniform"
    )
    flying: Fraction = Field(0.5, description="fraction of flying objects; the others rest on the ground")
    in_view: Fraction = Field(0.85, description="fraction placed in the camera's first field of view")
    tint: Fraction = Field(0.3, description="strength of the random colour factor on textures")
    texture_scale: PositiveRange = Field((0.7, 2.0), description="texture repeats over an object; log-uniform")
    deform: RandomDeformConfig = RandomDeformConfig()


BOTH_SIDES = Field(
    None,
    description="faces of files: true both sides, false the front alone; null: as each [file says](scenes.md#sides)",
)


class PoolConfig(Config):
    """Source of the random world's objects."""

    primitives: Annotated[
        Literal["all"] | tuple[Literal[POOLED], ...], word_or_list(("all",), POOLED)  # type: ignore[invalid-literal]
    ] = Field(
        "all",
        description="all: the rigid ones; []: none. Figures walk, run, dance or wave, fish swim, flags fly",
    )
    variants: int = Field(24, ge=1, le=10_000, description="random shapes per primitive kind (aspect ratios, sides)")
    folders: Paths = Field((), description="folders searched recursively for obj, ply, stl, off, 3mf, glb, gltf")
    up: Literal["auto", "y", "z"] = Field(
        "auto",
        description="upward axis of the files; auto: y for glb and gltf, z for others",
    )
    max_faces: int = Field(50_000, ge=1, le=50_000_000, description="meshes with more triangles are refused")
    max_file_mb: ClassVar[float] = 512.0
    former: ClassVar[dict[str, Former]] = {
        "urdfs": Former("folders: [...]", lambda value: value in (False, "auto")),
        "max_file_mb": always(max_file_mb),
    }
    test_fraction: Fraction = Field(0.1, description="fraction of meshes kept for split 'test', chosen by content hash")
    keep_materials: Literal["auto"] | bool = Field(
        "auto",
        description="auto: files with textures or colours keep them, others and primitives get the world's; true: "
        "figures, flags, fish and plain grey files keep theirs, too; false: none does",
    )
    animation: Literal["random", "rest"] = Field(
        "random", description="random: files play one of their animations, repeated"
    )
    bad_assets: Literal["error", "skip"] = Field("error", description="skip: logs an unusable mesh and draws another")


class TexturesConfig(Config):
    """Source of the random world's textures."""

    procedural: Annotated[bool | tuple[TextureKind, ...], word_or_list((True, False), TEXTURE_KINDS)] = Field(
        True, description="true: all kinds"
    )
    variants: int = Field(40, ge=1, le=100_000, description="textures per procedural kind")
    photographs: bool = Field(True, description="the photographs bundled with scikit-image")
    folders: Paths = Field((), description="folders searched recursively for images (also .hdr)")
    max_size: int = Field(512, ge=8, le=8192, description="longer image sides are reduced to this, px")
    test_fraction: Fraction = Field(
        0.1, description="fraction of textures kept for split 'test', chosen by content hash"
    )
    bad_assets: Literal["error", "skip"] = Field(
        "error", description="skip: logs an unreadable image and draws another"
    )


class SkyConfig(Config):
    """Textured box around the scene, seen from inside, unlit."""

    size: float = Field(100.0, gt=0, le=1e6, description="edge length, m")
    subdivisions: ClassVar[int] = 4
    """Cells per edge; 1 loses a third of the flow's precision, more than 4 gains none."""
    former: ClassVar[dict[str, Former]] = {"kind": always("box"), "subdivisions": always(subdivisions)}
    repeat: PositiveRange = Field((1.0, 3.0), description="texture repeats per face; log-uniform")
    per_face: bool = Field(True, description="true: one texture per face; false: one for all")
    brightness: PositiveRange = Field((0.6, 1.1), description="factor on the texture's radiance; uniform")
    panoramas: Paths = Field(
        (),
        description="equirectangular images or their folders (jpg, png, hdr, exr), drawn at infinity instead of the "
        "box",
    )
    lights: bool = Field(
        False,
        description="the panorama also lights the world, instead of light.sun and light.sky",
    )

    @rule("lights", "#panoramas")
    def _a_panorama_lights(lights, panoramas):
        if lights and not [*panoramas]:
            raise Refused(
                "only panoramas can light the scene", where="lights", value=lights, accepted="false, or sky.panoramas"
            )


class GroundConfig(Config):
    """Textured square at z = 0, as wide as the sky."""

    subdivisions: ClassVar[int] = 8
    """Cells per edge; more gains no precision and costs time."""
    former: ClassVar[dict[str, Former]] = {
        "size": always(None),
        "height": always(0),
        "subdivisions": always(subdivisions),
    }
    tile: PositiveRange = Field((2.0, 8.0), description="edge of one texture repeat, m; log-uniform")


class RegionConfig(Config):
    """Box on the ground, centred on the z axis, that contains camera and objects."""

    width: float = Field(30.0, gt=0, le=1e6, description="edge in x and y, m")
    height: float = Field(8.0, gt=0, le=1e6, description="m")
    camera_height: ClassVar[tuple[float, float]] = (1.0, 3.5)
    """Height of the camera's first position above the ground, m; uniform."""
    former: ClassVar[dict[str, Former]] = {"camera_height": always(camera_height)}


class RandomSceneConfig(Config):
    """A random world, as in the paper: objects from a pool between sky and ground."""

    kind: Literal["random"] = "random"
    objects: ObjectsConfig = ObjectsConfig()
    pool: PoolConfig = PoolConfig()
    textures: TexturesConfig = TexturesConfig()
    region: RegionConfig = RegionConfig()
    sky: SkyConfig | None = Field(SkyConfig(), description="null: no sky, only the background")
    ground: GroundConfig | None = Field(GroundConfig(), description="null: no ground; all objects fly")
    light: LightConfig = LightConfig()
    fog: FogConfig | None = FOG
    lights: RandomLightsConfig | None = Field(
        None, description="null: only light.lights; {}: one to three point and spot lights"
    )
    object_motion: ObjectMotion = ObjectMotion(static_share=0.3)
    camera_motion: CameraMotion = CameraMotion()
    physics: RandomPhysicsConfig | None = Field(None, description="null: nothing falls. Needs the extra [physics]")
    camera_clearance: float = Field(0.3, gt=0, le=1e4, description="radius of the empty sphere around the camera, m")
    background: float = Field(0.2, ge=0, le=1e9, description="linear radiance where nothing is hit")
    both_sides: bool | None = BOTH_SIDES
    former: ClassVar[dict[str, Former]] = {
        "walls": Former(
            "scene: {kind: explicit} with objects of category: wall",
            lambda value: value is False or (isinstance(value, dict) and not value.get("count")),
        )
    }

    @rule("?lights", "sky.lights", "light.unlit", "?light.environment")
    def _lit(lights, sky_lights, unlit, environment):
        for where, used in (("lights", lights), ("sky.lights", sky_lights)):
            if used and unlit:
                raise Refused(
                    "these lights have no effect", where=where, value="light.unlit: true", accepted="light.unlit: false"
                )
        if environment:
            raise Refused(
                "a random world uses the light of its sky",
                where="light.environment",
                accepted="sky.panoramas and sky.lights",
            )

    @rule("region.width", "region.height", "objects.size", "sky.size")
    def _sky_holds_everything(width: float, height: float, sizes: tuple[float, float], sky: float | None):
        least = max(1.2 * width, width + 2 * sizes[1], 2.2 * height)
        if sky is not None and sky < least:
            raise Refused(f"must be at least {least:g} to hold the region and its objects", where="sky.size", value=sky)

    @rule("region.height")
    def _camera_below_the_ceiling(height: float):
        low = RegionConfig.camera_height[0]
        if height <= low:
            raise Refused(
                "the camera starts above it", where="region.height", value=height, accepted=f"more than {low:g} m"
            )

    @rule("objects.size", "region.height")
    def _objects_below_the_ceiling(sizes: tuple[float, float], height: float):
        if sizes[0] >= height:
            raise Refused(f"must begin below region.height {height:g}", where="objects.size", value=list(sizes))


class MeshConfig(Config):
    """A primitive with its parameters, or a file."""

    primitive: Annotated[_Primitive, WrapValidator(or_registered), PlainSerializer(str)] | None = Field(
        None, description="kind of primitive"
    )
    parameters: dict[str, Annotated[int | float | Vector3 | str, BeforeValidator(parameter_value)]] = Field(
        {},
        description="see [primitives](#primitives)",
    )
    file: str | None = Field(None, description="obj, ply, stl, off, 3mf, glb or gltf file")
    up: Literal["auto", "y", "z"] = Field(
        "auto",
        description="y: the file's (x, y, z) is drawn at (x, -z, y); auto: y for glb and gltf, else z",
    )
    uv_size: ClassVar[float] = 1.0
    """Edge of one repeat of projected texture coordinates, m."""
    former: ClassVar[dict[str, Former]] = {"project_uvs": always(False), "uv_size": always(uv_size)}

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
    material: str | None = Field(None, description="a name under scene.materials; null: the file's materials")
    scale: Annotated[float | Vector3, BeforeValidator(number_or_three), AfterValidator(greater_than_zero)] = Field(
        1.0, description="factor on the mesh, one or one per axis"
    )
    category: Literal["object", "ground", "wall", "sky"] = Field(
        "object", description="for collisions and drawing order"
    )
    animation: str | int | AnimationConfig | None = Field(
        None, description="clip of the mesh's file, repeated; null: the rest shape"
    )
    physics: BodyConfig | None = Field(
        None,
        description="its physics; null: an obstacle",
    )
    deform: DeformConfig | None = Field(
        None,
        description="change of shape by formula; null: rigid, except figure, flag, fish",
    )
    way: WayConfig | None = Field(None, description="a curve to follow, instead of a pose or key frames")

    @rule("?way", "?trajectory")
    def _a_way_or_a_trajectory(way, trajectory):
        if way and trajectory:
            raise Refused("give a way or a trajectory, not both", where="way")

    @rule("?way", "#keyframes", "position", "quaternion", "euler", "look_at")
    def _one_motion(way, keyframes, position, *orientation):
        if way and (keyframes or any(position) or any(o is not None for o in orientation)):
            raise Refused("give a way, a fixed pose or keyframes, not several of them")

    @rule("physics.kind", "?trajectory", "#keyframes")
    def _the_engine_moves_it(kind, trajectory, keyframes):
        ways = (("trajectory", trajectory, ""), ("key frames", keyframes, ", or a pose without key frames"))
        for way, there, otherwise in ways:
            if kind == "dynamic" and there:
                raise Refused(
                    f"a dynamic body has no {way}: the engine moves it",
                    where="physics.kind",
                    value=kind,
                    accepted=f"fixed, which pushes what it meets on its way{otherwise}",
                )


def _known(used: tuple[str | None, ...], known: tuple[str, ...], key: str, table: str) -> None:
    for number, name in enumerate(used):
        if name is not None and name not in known:
            raise Refused(
                f"no such name under {table}",
                where=f"objects.{number}.{key}",
                value=name,
                accepted="one of: " + ", ".join(known) if known else f"a name under {table}",
            )


def object_names(names: Iterable[str | None], meshes: Iterable[str]) -> list[str]:
    """Return the names of an explicit scene's objects: the given name, else the mesh's (None: not given), with the
    object's number where that is in use."""
    made: list[str] = []
    for number, (name, mesh) in enumerate(zip(names, meshes)):
        name = name or (mesh if mesh not in made else f"{mesh}#{number}")
        if name in made:
            raise Refused("two objects have this name", where=f"objects.{number}.name", value=name)
        made.append(name)
    return made


class ExplicitSceneConfig(Config):
    """A custom scene: named meshes and materials, objects and a camera with poses or key frames."""

    kind: Literal["explicit"]
    meshes: dict[str, MeshConfig] = Field({}, description="by name")
    materials: dict[str, MaterialConfig] = Field({}, description="by name")
    objects: tuple[ObjectConfig, ...] = Field(min_length=1, description="one or more")
    collisions: bool = Field(
        False,
        description="true: stop objects that collide on their trajectories (not those of physics)",
    )
    camera: KeyedMotionConfig = Field(description="pose or key frames, OpenCV axes")
    physics: PhysicsConfig | None = Field(
        None,
        description="{}: gravity for objects with physics; null: nothing falls. Needs the extra [physics]",
    )
    light: LightConfig = LightConfig()
    fog: FogConfig | None = FOG
    background: float = Field(0.2, ge=0, le=1e9, description="linear radiance where nothing is hit")
    both_sides: bool | None = BOTH_SIDES
    max_faces: ClassVar[int] = 5_000_000
    former: ClassVar[dict[str, Former]] = {"max_faces": always(max_faces)}

    @rule("objects.*.mesh", "#meshes")
    def _meshes_are_known(used: tuple[str, ...], known: tuple[str, ...]):
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
                "no object has dynamic physics",
                where="physics",
                accepted="objects with physics, of kind dynamic, or physics: null",
            )

    @rule("objects.*.name", "objects.*.mesh")
    def _names_differ(names: tuple[str | None, ...], meshes: tuple[str, ...]):
        object_names(names, meshes)

    @rule("objects.*.material", "#materials")
    def _materials_are_known(used: tuple[str | None, ...], known: tuple[str, ...]):
        _known(used, known, "material", "scene.materials")


class FileSceneConfig(Config):
    """A complete glTF/GLB scene. The file's (x, y, z) is at (x, -z, y) in the world, in which poses are given."""

    kind: Literal["file"]
    path: str = Field(description="gltf or glb file")
    camera: str | int | None = Field(None, description="name or index of the file's camera; null: the first")
    pose: KeyedMotionConfig | None = Field(None, description="camera motion instead of the file's camera (z-up world)")
    intrinsics: Literal["config", "file"] = Field(
        "config", description="source of the focal length: camera of the YAML, or the file (yfov)"
    )
    animation: str | int | AnimationConfig | None = Field(0, description="name or index of the animation; null: none")
    light: LightConfig = LightConfig()
    fog: FogConfig | None = FOG
    lights: Literal["config", "file"] = Field(
        "config",
        description="file: the file's lights replace light.sun; light.sky and light.lights remain",
    )
    background: float = Field(0.2, ge=0, le=1e9, description="linear radiance where nothing is hit")
    both_sides: bool | None = BOTH_SIDES
    lights_gain: Positive = Field(
        1.0,
        description="factor on the file's lights (lux and candela are divided by 683 lm/W)",
    )
    max_faces: ClassVar[int] = 5_000_000
    max_texture_size: ClassVar[int] = 2048
    former: ClassVar[dict[str, Former]] = {"max_faces": always(max_faces), "max_texture_size": always(max_texture_size)}

    @rule("lights", "light.unlit")
    def _lit(lights, unlit):
        if lights == "file" and unlit:
            raise Refused(
                "these lights have no effect", where="lights", value=lights, accepted="config, or light.unlit: false"
            )


SceneConfig = one_of("kind", RandomSceneConfig, ExplicitSceneConfig, FileSceneConfig, default="random")


def lights_change(scene: RandomSceneConfig | ExplicitSceneConfig | FileSceneConfig) -> bool:
    """Return whether any light of a scene changes over time, of a lamp or of a material."""
    light = scene.light
    materials = scene.materials.values() if isinstance(scene, ExplicitSceneConfig) else ()
    waves = [
        light.over_time,
        *(lamp.over_time for lamp in light.lights),
        *(one.emission_over_time for one in materials),
    ]
    return any(wave is not None for wave in waves)
