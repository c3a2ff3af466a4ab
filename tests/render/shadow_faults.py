"""Acne and floating, counted: shadows of random frames against rays cast in float64.

Each frame has a sun of its own, a ball, a box, an open sheet and a standing box over a floor. Of the pixels that
the sun could light, off silhouettes and more than two pixels from the edge of a shadow: how many are dark and should be
lit (acne), how many lit and should be dark (floating). The sheet, which is in its own way, is the hard case. Where
things stand on each other, lit pixels are counted up to the very line (leaks).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.config.sequence import RenderConfig
from blinkgl.labels.frames import LabelRequest
from blinkgl.render.passes import shadow_maps
from blinkgl.render.renderer import Renderer
from blinkgl.render.shadows import scale_of
from blinkgl.scene.geometry.primitives import capsule, cone, cuboid, cylinder, grid, icosphere, torus
from blinkgl.scene.lights import lamp_pose
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.motion.trajectories import look_rotation
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Lamp, Light, Material, Scene
from blinkgl.tools.shader_debugger import reference
from blinkgl.tools.shader_debugger.appearance import seen_share
from blinkgl.tools.shader_debugger.lamps import lit_points
from render_scenes import placed

SKY = 0.2


def towards_of(rng: np.random.Generator, least: float, most: float) -> np.ndarray:
    """The direction to a random sun, which stands between two heights, rad."""
    elevation, azimuth = rng.uniform(least, most), rng.uniform(-math.pi, math.pi)
    flat = math.cos(elevation)
    return np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])


def frame(rng: np.random.Generator, size: int) -> Scene:
    """A scene of one moment."""

    def body(number, mesh, place, turned=True, category="object", **paint):
        return placed(number, mesh, place, Rotation.random(rng=rng) if turned else None, Material(**paint), category)

    towards = tuple(towards_of(rng, 0.35, 1.4))
    eye, target = np.array([*rng.uniform(-0.5, 0.5, 2), 1.6]), np.array([0.0, 4.5, 0.4])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = look_rotation(target - eye), eye
    objects = (
        body(1, grid(width=20, depth=20, subdivisions=4), (0, 5, 0), False, "ground"),
        body(2, icosphere(), (-0.9, 4.5, rng.uniform(0.6, 1.2))),
        body(3, cuboid(), (0.9, 4.0, rng.uniform(0.9, 1.3))),
        body(4, grid(width=1.0, depth=0.8, subdivisions=2), (0.1, 3.6, 1.4), both_sides=True),
        body(5, cuboid(extents=(0.5, 0.4, 0.6)), (0.1, 5.5, 0.3), False),
    )
    light = Light(towards, 1.0, SKY, shadows="hard", shadow_size=size)
    return Scene(objects, Rig.alone(PinHole.centred(96, 72, 90.0), StaticPath(T)), 0, 1, light)


def coarse_frame(rng: np.random.Generator, size: int) -> Scene:
    """The same over bodies of few triangles with smooth normals."""
    scene = frame(rng, size)
    meshes = (
        (icosphere(subdivisions=1), (-0.9, 4.5, 0.8)),
        (torus(), (0.9, 4.0, 0.8)),
        (capsule(radius=0.1, height=0.6, segments=8, rings=4), (0.1, 3.6, 0.9)),
        (cone(segments=10), (0.1, 5.5, 0.6)),
        (cylinder(radius=0.04, height=1.2, segments=10), (-0.3, 3.3, 0.9)),
        (icosphere(radius=0.15, subdivisions=2), (0.4, 3.2, 0.7)),
    )
    bodies = (
        placed(number, mesh, place, Rotation.random(rng=rng)) for number, (mesh, place) in enumerate(meshes, start=2)
    )
    return replace(scene, objects=(scene.objects[0], *bodies))


def faults(gl, scene: Scene) -> tuple[int, int, int]:
    """(pixels graded, dark that should be lit, lit that should be dark)."""
    ref = reference.render(scene, 0)
    open_ = reference.render(replace(scene, light=replace(scene.light, shadows="off")), 0).luminance
    with Renderer(gl, scene, RenderConfig()) as renderer:
        seen = renderer.luminance(0).read().astype(np.float64)
    dark = ref.luminance < open_ - 1e-6
    edge = reference.silhouette_band(2 * ref.instance + dark, ref.depth, width=2)
    sun = open_ - reference.render(replace(scene, light=replace(scene.light, sun=0.0, shadows="off")), 0).luminance
    graded = ref.hit & ~edge & (sun > 0.05)
    share = (seen - (open_ - sun)) / np.maximum(sun, 1e-9)
    return int(graded.sum()), int((graded & ~dark & (share < 0.9)).sum()), int((graded & dark & (share > 0.1)).sum())


def contact_frame(rng: np.random.Generator, kind: str, shadows: str) -> Scene:
    """A scene of one moment in which things stand on the ground and on each other: boxes, a stack, a thin plate, what
    is as small as a foot; and two boxes far away, so that a sun's map is as coarse as that of a whole world."""

    towards = towards_of(rng, 0.35, 1.3)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = look_rotation(np.array([0, 3.2, -1.3])), (0, 0, 1.4)
    boxes = (
        ((0.5, 0.4, 0.6), (-0.8, 3.2, 0.3)),
        ((0.6, 0.6, 0.3), (0.5, 2.9, 0.15)),
        ((0.3, 0.3, 0.3), (0.5, 2.9, 0.45)),
        ((0.6, 0.4, 0.02), (-0.1, 2.4, 0.01)),
        ((0.25, 0.1, 0.07), (0.1, 3.6, 0.035)),
        ((0.3, 0.3, 0.3), (-6.0, 8.0, 0.15)),
        ((0.3, 0.3, 0.3), (6.0, 9.0, 0.15)),
    )
    ground = placed(1, grid(width=20, depth=20), (0, 5, 0), category="ground")
    standing = (
        placed(k, cuboid(extents=size), place, Rotation.from_euler("z", rng.uniform(-3, 3)))
        for k, (size, place) in enumerate(boxes, start=2)
    )
    light = Light(tuple(towards), 1.0, SKY, shadows=shadows, shadow_size=1024)
    if kind == "spot":
        pose = StaticPath(lamp_pose([0, 3, 0] + 4 * towards, -towards))
        lamp = Lamp("spot", (12.0, 12.0, 12.0), pose, inner=0.6, outer=0.7)
        light = replace(light, sun=0.0, lamps=(lamp,))
    camera = PinHole.centred(200, 150, 170.0)
    return Scene((ground, *standing), Rig.alone(camera, StaticPath(T)), 0, 1, light=light)


def leaks(gl, scene: Scene) -> tuple[int, int]:
    """(pixels whose way to the lamp is blocked, a texel of its map aside, too; how many of them are lit)."""
    bare = replace(scene, light=replace(scene.light, shadows="off"))
    ref = reference.render(bare, 0)
    dark = reference.render(replace(bare, light=replace(bare.light, sun=0.0, lamps=())), 0).luminance
    sun = ref.luminance - dark
    with Renderer(gl, scene, RenderConfig(image_antialiasing="none")) as renderer:
        seen = renderer.luminance(0).read().astype(np.float64)
        ids = renderer.labels(0, LabelRequest("ids")).ids
        (map_,) = shadow_maps(scene, renderer.items)
    rows, points, own = lit_points(scene, ref)
    pose, (wide, wider, _, _) = map_.lamp.path.pose(0), scale_of(map_.lamp, map_.box, map_.texels)
    hard = replace(scene, light=replace(scene.light, shadows="hard"))  # one ray to the lamp's middle
    texel = wide + wider * ((pose[:3, 3] - points) @ pose[:3, 2])
    blocked = np.ones(len(rows), bool)
    for k in range(9):
        angle, far = 2 * math.pi * k / 8, min(k, 1)
        aside = far * (math.cos(angle) * pose[:3, 0] + math.sin(angle) * pose[:3, 1])
        blocked &= seen_share(hard, 0, map_.lamp, points + aside * texel[:, None], own) == 0
    graded = blocked & ((sun > 0.05) & (ids == ref.instance)).ravel()[rows]
    return int(graded.sum()), int((graded & ((seen - dark) > 0.1 * sun).ravel()[rows]).sum())
