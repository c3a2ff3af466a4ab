"""Scenes whose outlines crowd are drawn with samples, others not: rods that cross, holes, and their opposites."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.config.sequence import RenderConfig
from blinkgl.gl import create_context
from blinkgl.render.crowding import crowded_as
from blinkgl.render.renderer import Renderer
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Light, Mask, Material, Part, Scene, SceneObject
from render_scenes import LEVEL, SECOND, cube, mesh, quad, still

AS = {"edges": "ssaa4", "edges2": "ssaa8"}
CAMERA = PinHole(96, 72, 90.0, 90.0, 47.5, 35.5)


def scene_of(bodies):
    objects = [
        SceneObject(f"body {k}", k + 1, (Part(m, material),), path) for k, (m, material, path) in enumerate(bodies)
    ]
    return Scene(tuple(objects), Rig.alone(CAMERA, still(rotation=LEVEL)), 0, SECOND, light=Light(), background=0.4)


def rods(count, radius):
    rng = np.random.default_rng(5)
    rod = trimesh.creation.cylinder(radius, 3.0, sections=8)
    body = mesh(rod.vertices, rod.faces, rod.vertex_normals, closed=True, name="rod")
    place = lambda: (*rng.uniform(-1, 1, 1), rng.uniform(2, 4), *rng.uniform(-0.8, 0.8, 1))
    return [
        (body, Material(base_color=(k % 2,) * 3), still(place(), Rotation.random(random_state=k))) for k in range(count)
    ]


def leaves(count, size, least=0):
    rng, coverage = np.random.default_rng(6), np.full((16, 16), least, np.uint8)
    coverage[4:12, 4:12] = 255
    leaf = Material(base_color=(0.2, 0.5, 0.2), mask=Mask(coverage))
    place = lambda: (*rng.uniform(-1, 1, 1), 3.0, *rng.uniform(-0.8, 0.8, 1))
    return [(quad(size, size), leaf, still(place(), LEVEL)) for _ in range(count)]


@pytest.mark.parametrize(
    ("bodies", "words"),
    [
        (rods(60, 0.01), "outlines of several surfaces cross in "),
        (rods(2, 0.01), ""),
        (rods(3, 0.3), ""),
        (leaves(12, 0.2), "masked surfaces fill "),
        (leaves(1, 0.1), ""),
        (leaves(12, 0.2, least=200), ""),
        ([(cube(0.3), Material(), still((0, 3, 0)))], ""),
        ([], ""),
    ],
    ids=[
        "many rods",
        "two rods",
        "three thick ones",
        "leaves",
        "one small leaf",
        "leaves without holes",
        "a cube",
        "nothing",
    ],
)
def test_outlines_that_crowd_are_drawn_with_samples(bodies, words):
    with create_context() as gl:
        images = {}
        for asked in ("edges", "edges2", "ssaa4", "ssaa8", "none"):
            with Renderer(gl, scene_of(bodies), RenderConfig(antialiasing=asked)) as renderer:
                images[asked] = renderer.luminance(0).read().copy()
                filtered = asked.startswith("edges")
                assert (words in renderer.crowded) if filtered and words else renderer.crowded == ""
                assert renderer.antialiasing == (AS[asked] if filtered and words else asked)
    if words:
        np.testing.assert_array_equal(images["edges"], images["ssaa4"])
        np.testing.assert_array_equal(images["edges2"], images["ssaa8"])


@pytest.mark.parametrize(
    ("asked", "size", "drawn"),
    [
        ("edges", (640, 480), "ssaa4"),
        ("edges2", (1280, 720), "ssaa8"),
        ("edges2", (1920, 1080), "ssaa4"),
        ("edges2", (4096, 20), "ssaa4"),
    ],
)
def test_large_pictures_get_fewer_samples(asked, size, drawn):
    """8 x 8 samples of a large picture would take gigabytes, or a texture larger than OpenGL has."""
    assert crowded_as(asked, *size) == drawn
