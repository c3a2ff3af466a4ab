"""A panorama is a sky at infinity: seen in its directions from everywhere, and where its own mirror image says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.config.sequence import RenderConfig
from blinkgl.labels.frames import LabelRequest
from blinkgl.render.renderer import Renderer
from blinkgl.scene.geometry.primitives import cuboid, grid
from blinkgl.scene.lights import lit_by
from blinkgl.scene.motion.paths import KeyframePath, StaticPath
from blinkgl.scene.rig import Rig, Sensor
from blinkgl.scene.surfaces.environment import environment, pixel_directions
from blinkgl.scene.types import Gloss, Light, Material, Mesh, Part, Scene, SceneObject
from blinkgl.scene.worlds.sky import panorama_sky, panorama_textures
from blinkgl.tools.shader_debugger import reference

SECOND = 1_000_000_000
SPOT = np.array([0.8, 0.1, 0.25]) / np.linalg.norm([0.8, 0.1, 0.25])
CAMERA = PinHole(320, 240, 200.0, 200.0, 159.5, 119.5, near=0.05)
AHEAD = Rotation.from_matrix(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]))  # along +x, z up
MOVE = KeyframePath(
    [0, SECOND], [[-30, 20, 5], [40, -30, 9]], Rotation.concatenate([AHEAD, AHEAD * Rotation.from_rotvec([0, 0.15, 0])])
)
LABELS = LabelRequest("depth", "flow_forward", "velocity", "scene_flow", "ids")


def panorama(height: int = 512) -> np.ndarray:
    """(h, 2 h, 3) float32: dim, with a smooth spot of 3 degrees."""
    directions, _ = pixel_directions(height, 2 * height)
    away = np.degrees(np.arccos(np.clip(directions @ SPOT, -1, 1)))
    return np.repeat((0.05 + 0.8 * np.exp(-((away / 3.0) ** 2)))[..., None], 3, axis=2).astype(np.float32)


def world(path, *things: SceneObject) -> Scene:
    picture = panorama()
    parts = panorama_sky(panorama_textures(picture, "spot", "00"), 1.0)
    sky = SceneObject("sky", 1, parts, StaticPath(), "sky", at_infinity=True)
    light = lit_by(environment(picture), 1.0, Light())
    return Scene((sky, *things), Rig.alone(CAMERA, path), 0, SECOND, light=light)


def thing(name: str, number: int, mesh: Mesh, material: Material, T: np.ndarray | None = None) -> SceneObject:
    return SceneObject(name, number, (Part(mesh, material),), StaticPath(T), "object")


def spot_of(picture: np.ndarray) -> np.ndarray:
    """(2,) px: centroid of what is brighter than the panorama's dim part."""
    weight = np.maximum(picture - 0.1, 0)
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]]
    return np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()


@pytest.mark.parametrize("t_ns", [0, SECOND // 3, SECOND])
def test_it_is_seen_in_its_directions_from_everywhere_and_so_is_its_mirror_image(gl, t_ns):
    polished = Material(gloss=Gloss(metallic=1.0, roughness=0.0))
    mirror = thing("mirror", 2, grid(width=4000, depth=4000), polished)
    sky, mirrored = (world(MOVE, *more) for more in ((), (mirror,)))
    turn = MOVE.pose(t_ns)[:3, :3]
    pictures = {}
    for name, scene in (("sky", sky), ("mirror", mirrored)):
        with Renderer(gl, scene, RenderConfig(image_antialiasing="none")) as renderer:
            pictures[name] = renderer.luminance(t_ns).read().astype(np.float64)
    below = reference.render(mirrored, t_ns).instance == 2
    seen = CAMERA.project((SPOT @ turn)[None])
    assert np.abs(spot_of(pictures["sky"]) - seen[0]).max() < 0.5
    seen = CAMERA.project(((SPOT * [1, 1, -1]) @ turn)[None])
    assert np.abs(spot_of(np.where(below, pictures["mirror"], 0)) - seen[0]).max() < 0.5


def test_its_labels_are_a_rotations(gl):
    """Flow and velocity of what is infinitely far, in front of which even a wall at 10 km is; the reference agrees."""
    T = np.eye(4)
    T[:3, 3] = [10_000, 3_000, 500]
    scene = world(MOVE, thing("wall", 2, cuboid(extents=(10.0, 2_000.0, 1_000.0)), Material(), T))
    t, later = SECOND // 3, SECOND // 2
    with Renderer(gl, scene, RenderConfig()) as renderer:
        frame = renderer.labels(t, LABELS, later)
    ref = reference.render(scene, t, forward_ns=later)
    sky = (frame.ids == 1) & (ref.instance == 1)
    assert (frame.ids == 2).any() and sky.mean() > 0.5
    assert np.isinf(frame.depth[sky]).all() and np.isfinite(frame.depth[frame.ids == 2]).all()
    assert not frame.scene_flow[sky].any()
    y, x = np.nonzero(sky)
    rays = np.stack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones(len(x))], axis=1)
    turned = rays @ MOVE.pose(t)[:3, :3].T @ MOVE.pose(later)[:3, :3]
    expected = CAMERA.project(turned) - np.stack([x, y], axis=1)
    assert np.abs(frame.flow_forward.flow[sky] - expected).max() < 1e-3
    step = 1e-5
    turned = rays @ MOVE.pose(t)[:3, :3].T @ MOVE.pose(t + round(step * SECOND))[:3, :3]
    expected = (CAMERA.project(turned) - np.stack([x, y], axis=1)) / step
    assert np.abs(frame.velocity[sky] - expected).max() < 2e-3 * np.abs(expected).max()
    assert np.abs(ref.forward.flow[sky] - frame.flow_forward.flow[sky]).max() < 1e-3


def test_every_camera_of_a_rig_has_it_around_itself(gl):
    aside = np.eye(4)
    aside[0, 3] = 50.0
    scene = world(MOVE)
    scene = replace(scene, rig=Rig(MOVE, (Sensor(CAMERA), Sensor(CAMERA, aside))))
    with (
        Renderer(gl, scene.seen_by(0), RenderConfig()) as first,
        Renderer(gl, scene.seen_by(1), RenderConfig(), beside=first) as second,
    ):
        left, right = (one.luminance(SECOND // 3).read() for one in (first, second))
    np.testing.assert_array_equal(left, right)
