"""Light and materials beside a path tracer: scenes of one effect each, which Blender's Cycles has drawn at path
depth 1 (``golden/cycles_light.npz``).

Diffuse scenes: floor, ball, box, open sheet. Metal: five balls of five roughnesses, graded by themselves. Of each the
relative difference of colours, (theirs - ours) / (theirs + 0.01), over pixels off silhouettes and, of hard shadows,
farther than two texels from their edges. Of a frame camera's defocus and motion blur every pixel is graded that they
change by more than 2 %.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.config.images import ImagesConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.imaging import FrameCamera
from blinkgl.imaging.sensor import decode
from blinkgl.scene.geometry.primitives import cuboid, grid, sphere
from blinkgl.scene.lights import lamp_pose
from blinkgl.scene.motion.paths import KeyframePath, StaticPath
from blinkgl.scene.motion.trajectories import look_rotation
from blinkgl.scene.rig import Rig
from blinkgl.scene.surfaces.images import load_panorama
from blinkgl.scene.types import Fog, Gloss, Lamp, Light, Map, Mask, Material, Mesh, Part, Scene, SceneObject, Texture
from blinkgl.scene.worlds.sky import panorama_light
from blinkgl.tools.shader_debugger import reference
from blinkgl.tools.shader_debugger.lamps import near_an_edge
from blinkgl.tools.shader_debugger.session import DebugRenderer
from render_scenes import placed

EXPOSURE_US = 20_000
ROUGHNESSES = (0.1, 0.25, 0.45, 0.7, 1.0)
WHITE = (1.0, 1.0, 1.0)
WARM, BLUE = (1.0, 0.8, 0.6), (0.65, 0.8, 1.0)
SUN = (-0.48, -0.6, 0.64)


@dataclass(frozen=True, eq=False)
class Case:
    """One effect. graded : ids of the objects that are looked at.   images : of the frame camera that takes the
    picture, all of which is looked at where that makes more than 2 % of difference; None: it is a plain one."""

    name: str
    scene: Scene
    graded: tuple[int, ...]
    shadows: bool = False
    images: dict[str, Any] | None = None


def _body(number: int, mesh: Mesh, place, material: Material, turn=(0.0, 0.0, 0.0), category="object") -> SceneObject:
    return placed(number, mesh, place, Rotation.from_euler("xyz", turn, degrees=True), material, category)


def _seen(objects, light: Light, size: tuple[int, int]) -> Scene:
    eye = np.array([0.3, -5.2, 2.6])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = look_rotation(np.array([0.1, 0.3, 0.45]) - eye), eye
    camera = PinHole.centred(*size, 1.5 * size[0], near=0.1)
    return Scene(tuple(objects), Rig.alone(camera, StaticPath(T)), 0, 1_000_000, light, 0.3)


def matt(light: Light, size=(64, 48), **paint) -> Scene:
    """Floor, ball, box and an open sheet; ``paint``: more of the materials of the last three."""
    return _seen(
        [
            _body(1, grid(width=14, depth=14), (0, 0, 0), Material(base_color=(0.62, 0.6, 0.57)), category="ground"),
            _body(
                2,
                sphere(radius=0.5, segments=96, rings=48),
                (-0.7, 0, 0.8),
                Material(base_color=(0.8, 0.35, 0.3), **paint),
            ),
            _body(3, cuboid(), (0.5, 0.6, 0.55), Material(base_color=(0.5, 0.75, 0.6), **paint), (0, 0, 30)),
            _body(
                4,
                grid(width=0.9, depth=0.7),
                (0.5, -0.9, 0.9),
                Material(base_color=(0.7, 0.7, 0.3), both_sides=True, **paint),
                (50, 0, 15),
            ),
        ],
        light,
        size,
    )


def metal(light: Light, smooth: bool, size=(80, 32)) -> Scene:
    """Balls of metal, of the smooth ones of :data:`ROUGHNESSES` or of the others."""
    ball = sphere(radius=0.42, segments=128, rings=64)
    balls = [
        _body(
            k + 1,
            ball,
            (0.95 * (k - 2) + 0.1, 0.3, 0.45),
            Material(base_color=(1.0, 0.77, 0.34), gloss=Gloss(1.0, roughness)),
        )
        for k, roughness in enumerate(ROUGHNESSES)
        if (roughness < 0.3) is smooth
    ]
    scene = _seen(balls, light, size)
    return scene.with_camera(replace(scene.camera, fx=0.9 * size[0], fy=0.9 * size[0]))


def dimples(size: int = 64) -> Map:
    """A normal map, without anything that a texel could not hold."""
    y, x = np.mgrid[0:size, 0:size] / size * 2 * np.pi
    slope = np.stack([np.cos(2 * x) * np.sin(2 * y), np.sin(2 * x) * np.cos(2 * y), np.full_like(x, 2.0)], axis=-1)
    normals = 0.5 + 0.5 * slope / np.linalg.norm(slope, axis=-1, keepdims=True)
    return Map(Texture(np.clip(255 * normals, 0, 255).round().astype(np.uint8)))


def lattice(size: int = 64) -> Mask:
    y, x = np.mgrid[0:size, 0:size] / size * 2 * np.pi
    return Mask(np.clip(255 * (0.6 + 0.5 * np.sin(2 * x) * np.sin(2 * y)), 0, 255).round().astype(np.uint8))


def tinted(scene: Scene) -> Scene:
    """With colours of vertices on all but the floor."""

    def one(thing: SceneObject) -> SceneObject:
        (part,) = thing.parts
        v = part.mesh.vertices
        colours = 0.6 + 0.4 * np.sin(3.0 * v + [0.0, 2.0, 4.0])
        mesh = replace(part.mesh, colours=colours.astype(np.float32))
        return thing if thing.category == "ground" else replace(thing, parts=(Part(mesh, part.material),))

    return replace(scene, objects=tuple(one(thing) for thing in scene.objects))


def moving(scene: Scene) -> Scene:
    """Of :func:`matt`: ball and box fly, and the camera turns and goes by, all evenly, for as long as the exposure."""

    def path(T: np.ndarray, way, turn=(0.0, 0.0, 0.0)) -> KeyframePath:
        R = Rotation.from_matrix(T[:3, :3])
        after = R * Rotation.from_rotvec(np.radians(turn))
        ends = [T[:3, 3], T[:3, 3] + np.asarray(way)]
        return KeyframePath([0, EXPOSURE_US * 1000], ends, Rotation.concatenate([R, after]), interpolation="linear")

    ways = {2: ((0.35, 0.0, 0.1), (0.0, 0.0, 0.0)), 3: ((-0.1, -0.3, 0.0), (0.0, 0.0, 6.0))}
    objects = tuple(
        replace(thing, path=path(thing.path.pose(0), *ways[thing.instance_id])) if thing.instance_id in ways else thing
        for thing in scene.objects
    )
    seen = path(scene.camera_path.pose(0), (0.05, 0.0, 0.02), (0.0, 1.0, 0.0))
    return replace(scene, objects=objects, t1_ns=EXPOSURE_US * 1000, rig=replace(scene.rig, path=seen))


def taken(renderer: DebugRenderer, images: dict[str, Any]) -> np.ndarray:
    """(H, W, 3) radiance that a frame camera's image is made of, to a step of 16 bits."""
    scene = renderer.scene
    linear = {"response": "linear", "bits": 16, "white": 2.0, "max_px": 0.25, "max_instants": 1024, "times": (0.0,)}
    camera = FrameCamera(renderer, ImagesConfig(**{**linear, **images}), 0, (scene.t0_ns, scene.t1_ns))
    return 2.0 * decode(camera.take().image, "linear", 2.2, 16)


def cases(panoramas: Path | None) -> Iterator[Case]:
    """Each effect by itself, beside a plain sun and sky."""
    every = (1, 2, 3, 4)
    plain = Light(SUN, 0.7, 0.5)
    point = Lamp("point", (3.0, 2.4, 1.8), StaticPath(lamp_pose((-0.4, -1.6, 2.0))))
    outer = math.radians(25)
    spot = Lamp(  # an edge without a width, Blender's is another curve
        "spot",
        (9.0, 9.0, 8.0),
        StaticPath(lamp_pose((1.4, -0.8, 3.2), (-0.3, 0.25, -1.0))),
        inner=outer * (1 - 1e-6),
        outer=outer,
    )
    yield Case("sun and sky", matt(plain), every)
    yield Case("coloured sun and sky", matt(replace(plain, sun_color=WARM, sky_color=BLUE)), every)
    yield Case("point light", matt(Light(SUN, 0.0, 0.0, lamps=(point,))), every)
    yield Case("spot light", matt(Light(SUN, 0.0, 0.0, lamps=(spot,))), every)
    yield Case("hard shadows", matt(replace(plain, shadows="hard", shadow_size=2048)), every, True)
    yield Case("hard shadows of a spot light", matt(Light(SUN, 0.0, 0.1, lamps=(spot,), shadows="hard")), every, True)
    wide = replace(plain, shadows="soft", sun_size=math.radians(8))
    yield Case("soft shadows, sun of 8 degrees", matt(wide), every, True)
    yield Case("normal map", matt(plain, bumps=dimples()), (2, 3, 4))
    yield Case("light of its own", matt(plain, emission=(0.3, 0.2, 0.5)), (2, 3, 4))
    yield Case("holes", matt(plain, mask=lattice()), every)
    yield Case("colours of vertices", tinted(matt(plain)), (2, 3, 4))
    yield Case("fog", replace(matt(plain), fog=Fog(0.12, 0.5)), every)
    yield Case("defocus", matt(plain), every, images={"exposure_us": 1.0, "lens": {"aperture": 0.25, "focus": 4.8}})
    yield Case("motion blur", moving(matt(plain)), every, images={"exposure_us": EXPOSURE_US})
    for smooth, kind in ((True, "metal"), (False, "metal, rough")):
        yield Case(f"{kind}, sun and sky", metal(plain, smooth), (1, 2, 3, 4, 5))
    for file in sorted(panoramas.glob("*.hdr")) if panoramas is not None else ():
        # The path tracer's pictures were metered by the brightest channel of each pixel.
        image, metered = load_panorama(file)
        then = 0.8 / float(np.percentile(image.max(axis=2), 90))
        light = panorama_light(file, 0.0, then / metered, Light(), file.name)
        yield Case(f"panorama {file.stem}", matt(light), every)
        for smooth, kind in ((True, "metal"), (False, "metal, rough")):
            yield Case(f"{kind}, panorama {file.stem}", metal(light, smooth), (1, 2, 3, 4, 5))


def graded(gl, case: Case, theirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((H, W) relative difference of our picture from theirs, (H, W) ids of the objects where it counts, else 0)."""
    with DebugRenderer(gl, case.scene, RenderConfig(image_antialiasing="ssaa4")) as renderer:
        at_once = ours = renderer.colour(0).read()
        if case.images is not None:
            ours = taken(renderer, case.images)
        maps = renderer.maps
    true = reference.render(case.scene, 0)
    if case.images is not None:
        counts = relative(at_once, ours) > 0.02
    else:
        counts = np.isin(true.instance, case.graded) & ~reference.silhouette_band(true.instance, true.depth)
    if case.scene.light.shadows == "hard":
        counts &= ~near_an_edge(case.scene, true, maps)
    return relative(ours, theirs), np.where(counts, np.maximum(true.instance, 1), 0)


def relative(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """(H, W) difference of two (H, W, 3), of theirs."""
    return np.abs(theirs - ours).mean(axis=2) / (theirs.mean(axis=2) + 0.01)
