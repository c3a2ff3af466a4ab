"""Scenes of pyrender: what is taken, against pyrender itself where it is installed, and what is named or refused."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

import blinkgl
import pyrender_peer
from blinkgl.errors import ConfigError
from tests.refusals import refusal


@pytest.fixture(scope="module")
def theirs():
    if missing := pyrender_peer.available():
        pytest.skip(missing)
    return pyrender_peer.own()


def drawn(scene):
    with blinkgl.Renderer(scene) as renderer:
        frame = renderer.frame(0.1, ["depth", "ids", "images"])
        return frame, renderer.scene


def test_pyrender_draws_the_same(theirs):
    """Off silhouettes: ids, depth to 24 bits, and unlit colour to 8 bits."""
    source = pyrender_peer.example(pyrender_peer.imported())
    scene = blinkgl.Scene.from_pyrender(source, 160, 120, light=blinkgl.Light(unlit=True))
    assert len(scene.objects) == 6  # the last of four meshes has three instances
    ours, built = drawn(scene)
    assert built.omissions == ()
    ids = np.minimum(ours.ids, 4)  # pyrender's instances have one id
    inner = ndimage.minimum_filter(theirs["ids"], 3) == ndimage.maximum_filter(theirs["ids"], 3)
    assert inner.mean() > 0.85 and len(np.unique(theirs["ids"][inner])) == 5
    np.testing.assert_array_equal(ids[inner], theirs["ids"][inner])
    there = inner & (ids > 0)
    assert np.abs(theirs["depth"][there] / ours.depth[there] - 1).max() < 2e-5
    # FLAT does not decode its textures: the first mesh's colours are sRGB codes, the others' numbers are linear.
    shown = np.where((ids == 1)[..., None], blinkgl_srgb(ours.colour), ours.colour)
    error = np.abs(255 * shown - theirs["colour"])[there]
    assert np.quantile(error, 0.95) < 2.5, np.quantile(error, [0.5, 0.9, 0.95, 1])


def blinkgl_srgb(linear):
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055)


def test_a_sun_shines_as_there(theirs):
    """Matt surfaces: pyrender takes Fresnel's 4 % and more from them and adds highlights. Its second mesh, of unequal
    scales, is left out: its normals are not those of the scaled faces."""
    source = pyrender_peer.example(pyrender_peer.imported())
    ours, _ = drawn(blinkgl.Scene.from_pyrender(source, 160, 120))
    on = ndimage.minimum_filter(ours.ids, 5) == ndimage.maximum_filter(ours.ids, 5)
    linear = (theirs["lit"] / 255.0) ** 2.2
    for number in (1, 3, 4, 5, 6):
        body = on & (ours.ids == number)
        there, here = linear[body].mean(axis=0), ours.colour[body].mean(axis=0)
        assert body.sum() > 150 and (np.abs(there - here) < 0.1 * here + 0.01).all(), (number, there, here)
    empty = ours.ids == 0
    np.testing.assert_allclose(np.median(linear[empty]), np.median(ours.colour[empty]), atol=0.003)


# ---- without pyrender: objects with its names and attributes


def named(kind, **fields):
    return type(kind, (SimpleNamespace,), {})(**fields)


def plain_material(**fields):
    given = dict(baseColorFactor=[1.0, 1, 1, 1], metallicFactor=0.0, roughnessFactor=1.0, emissiveFactor=[0.0, 0, 0])
    given |= dict.fromkeys(("baseColorTexture", "metallicRoughnessTexture", "normalTexture", "emissiveTexture"))
    given |= dict(occlusionTexture=None, wireframe=False, smooth=False, doubleSided=True, alphaMode="OPAQUE")
    return named("MetallicRoughnessMaterial", **{**given, **fields})


def triangle(**fields):
    points = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)
    given = dict(positions=points, indices=None, normals=None, texcoord_0=None, color_0=None, poses=None, mode=4)
    return SimpleNamespace(**{**given, "material": plain_material(), **fields})


class Node(SimpleNamespace):
    __hash__ = object.__hash__


EYE = named("PerspectiveCamera", yfov=math.radians(60), aspectRatio=None, znear=0.1)


def scene_with(primitives, camera=EYE, lights=(), **fields):
    place = np.eye(4)
    place[2, 3] = 4.0
    mesh = Node(pose=np.eye(4), name="m", mesh=SimpleNamespace(primitives=primitives, name=None))
    eye = None if camera is None else SimpleNamespace(pose=place, camera=camera)
    nodes = [Node(pose=pose, light=light) for light, pose in lights]
    given = dict(mesh_nodes=[mesh], main_camera_node=eye, light_nodes=nodes, ambient_light=np.zeros(3))
    given["_digraph"] = [mesh, *nodes]
    given |= dict(bg_color=np.array([0.5, 0.5, 0.5, 1.0]), get_pose=lambda node: node.pose)
    return SimpleNamespace(**{**given, **fields})


def test_lenses_by_formula():
    """The pixel of a point by the projection matrices of pyrender: corners of pixels there, centres here."""
    yfov, width, height = math.radians(50), 80, 60
    for aspect in (None, 2.0):
        lens = named("PerspectiveCamera", yfov=yfov, aspectRatio=aspect, znear=0.2)
        tree = blinkgl.Scene.from_pyrender(scene_with([triangle()], lens), width, height).camera.tree
        # x of clip space over the tangent, then half the width
        assert tree["fx"] == pytest.approx(width / 2 / ((aspect or width / height) * math.tan(yfov / 2)))
        assert tree["fy"] == pytest.approx(height / 2 / math.tan(yfov / 2)) and tree["near"] == 0.2
    lens = named("IntrinsicsCamera", fx=70.0, fy=71.0, cx=41.0, cy=29.0, znear=0.05)
    tree = blinkgl.Scene.from_pyrender(scene_with([triangle()], lens), width, height).camera.tree
    assert (tree["cx"], tree["cy"], tree["fx"], tree["fy"]) == (40.5, 28.5, 70.0, 71.0)


def test_lights_by_formula():
    """A white surface that faces a sun of pi has radiance 1; candela fall with the square of the distance."""
    towards = np.eye(4)  # shines along -z, onto the triangle
    for light, expected in (
        (named("DirectionalLight", color=[1.0, 0.5, 0.25], intensity=math.pi), [1, 0.5, 0.25]),
        (named("PointLight", color=[1.0, 1, 1], intensity=math.pi * 9), [1, 1, 1]),
        (
            named("SpotLight", color=[1.0, 1, 1], intensity=math.pi * 9, innerConeAngle=0.3, outerConeAngle=0.5),
            [1, 1, 1],
        ),
    ):
        place = towards.copy()
        place[2, 3] = 3.0
        frame, _ = drawn(blinkgl.Scene.from_pyrender(scene_with([triangle()], lights=[(light, place)]), 81, 61))
        assert frame.ids[30, 40] == 1
        np.testing.assert_allclose(frame.colour[30, 40], expected, atol=0.01)


def test_what_is_not_taken_is_named():
    odd = plain_material(occlusionTexture=object(), wireframe=True, alphaMode="BLEND", baseColorFactor=[1, 1, 1, 0.5])
    glossy = named("SpecularGlossinessMaterial", doubleSided=True, smooth=True)
    primitives = [triangle(material=odd), triangle(material=glossy), triangle(mode=1)]
    source = scene_with(primitives, ambient_light=np.full(3, 0.2), bg_color=np.array([0.1, 0.2, 0.3, 1]))
    scene = blinkgl.Scene.from_pyrender(source, 32, 24) + blinkgl.Primitive("cuboid")  # another body keeps the line
    _, built = drawn(scene)
    (line,) = built.omissions
    assert line == (
        "pyrender's scene is drawn without: occlusion maps; wire frames; opacity of BLEND (drawn opaque); a "
        "SpecularGlossinessMaterial (drawn grey); primitives other than triangles; ambient light; the background's "
        "colour (drawn as its mean)"
    )


@pytest.mark.parametrize(
    "source, problem",
    [
        (lambda: scene_with([triangle()], None), "no such camera (got None)"),
        (lambda: scene_with([triangle()], named("OrthographicCamera")), "no such camera (got 'OrthographicCamera')"),
        (lambda: scene_with([triangle(mode=0)]), "no triangles (got ['primitives other than triangles'])"),
    ],
)
def test_what_is_refused(source, problem):
    line = refusal(ConfigError, blinkgl.Scene.from_pyrender, source(), 32, 24)
    assert line.startswith("Scene.from_pyrender.scene: " + problem)
