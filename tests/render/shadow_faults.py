"""Acne and floating, counted: shadows of random frames against rays cast in float64.

Each frame has a sun of its own, a ball, a box, an open sheet and a standing box over a floor. Of the pixels that
the sun could light, off silhouettes and more than two pixels from the edge of a shadow: how many are dark and should be
lit (acne), how many lit and should be dark (floating). The sheet, which is in its own way, is the hard case.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.config.sequence import RenderConfig
from blinkgl.render import reference
from blinkgl.render.renderer import Renderer
from blinkgl.scene.geometry.primitives import cuboid, grid, icosphere
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.motion.trajectories import look_rotation
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Light, Material, Part, Scene, SceneObject

SKY = 0.2


def frame(rng: np.random.Generator, size: int) -> Scene:
    """A scene of one moment."""

    def body(number, mesh, place, turned=True, category="object", **paint):
        T = np.eye(4)
        T[:3, :3] = Rotation.random(rng=rng).as_matrix() if turned else np.eye(3)
        T[:3, 3] = place
        return SceneObject(f"{number}", number, (Part(mesh, Material(**paint)),), StaticPath(T), category)

    elevation, azimuth = rng.uniform(0.35, 1.4), rng.uniform(-math.pi, math.pi)
    flat = math.cos(elevation)
    towards = (flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation))
    eye, target = np.array([*rng.uniform(-0.5, 0.5, 2), 1.6]), np.array([0.0, 4.5, 0.4])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = look_rotation(target - eye), eye
    objects = (
        body(1, grid(width=20, depth=20, subdivisions=4), (0, 5, 0), False, "ground"),
        body(2, icosphere(), (-0.9, 4.5, rng.uniform(0.6, 1.2))),
        body(3, cuboid(), (0.9, 4.0, rng.uniform(0.9, 1.3))),
        body(4, grid(width=1.0, depth=0.8, subdivisions=2), (0.1, 3.6, 1.4), double_sided=True),
        body(5, cuboid(extents=(0.5, 0.4, 0.6)), (0.1, 5.5, 0.3), False),
    )
    light = Light(towards, 1.0, SKY, shadows="hard", shadow_size=size)
    return Scene(objects, Rig.alone(PinHole.centred(96, 72, 90.0), StaticPath(T)), 0, 1, light)


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
