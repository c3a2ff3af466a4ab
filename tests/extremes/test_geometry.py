"""Sizes, depths, lenses and images at the ends of their ranges; against the float64 ray caster."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import AssetError, GLError
from blinkgl.labels import LabelRequest
from blinkgl.render import casting
from blinkgl.render.renderer import Renderer
from blinkgl.scene.types import Material
from blinkgl.tools.shader_debugger import reference
from tests.extremes.measures import MOTION, compare, moving_camera
from tests.render.render_scenes import (
    FACING,
    LEVEL,
    drift,
    length,
    mesh,
    mixed_scene,
    quad,
    rig,
    scene,
    smooth_texture,
    sphere,
    still,
    thing,
)

MS = 1_000_000
MEDIAN, WORST = 5e-7, 1e-5
TURN, SPIN = Rotation.from_rotvec([0.3, 0.5, -0.2]), Rotation.from_rotvec([0.01, -0.02, 0.03])


def test_sizes_of_nine_decades_in_one_scene(gl, promise):
    sizes = [1e-4, 1e-2, 1.0, 1e2, 1e5]
    objects = []
    for k, s in enumerate(sizes):
        x = 0.54 * (k - 2) * s
        objects.append(
            thing(
                f"ball{k}",
                k + 1,
                sphere(0.25 * s, 3),
                drift((x, 3 * s, 0), (x + 0.02 * s, 3 * s, 0.01 * s), TURN, TURN * SPIN),
            )
        )
    eye = rig(near=1e-5, path=drift((0, 0, 0), (1e-6, 0, -1e-6), LEVEL, LEVEL * SPIN))
    e = compare(gl, scene(objects, eye))
    assert set(np.unique(e.frame.ids)) == {0, 1, 2, 3, 4, 5} and e.wrong_ids == 0
    promise("sizes 1e-4 to 1e5 in one scene: flow, largest, relative", e.worst, WORST)
    promise("sizes 1e-4 to 1e5 in one scene: depth, largest, relative", e.depth.max(), 1e-5)


def test_depth_ratio_of_nine_decades(gl, promise):
    """Reversed-Z in float32 with the far plane at infinity: depth = near / Z has the same
    relative resolution everywhere."""
    depths = np.logspace(-3, 6, 10) * 1.2
    objects = [
        thing(f"q{k}", k + 1, quad(*[0.5 * z * (k + 1) / 10] * 2), drift((0, z, 0), (1e-3 * z, 1.001 * z, 0), FACING))
        for k, z in enumerate(depths)
    ]
    e = compare(gl, scene(objects, rig(near=1e-3, path=drift((0, 0, 0), (1e-6, 0, 0), LEVEL, LEVEL * SPIN))))
    assert len(np.unique(e.frame.ids)) == 11 and e.wrong_ids == 0
    promise("depth 1e-3 to 1e6: flow, largest, relative", e.worst, WORST)
    promise("depth 1e-3 to 1e6: depth, largest, relative", e.depth.max(), 1e-6)


def test_order_of_surfaces_close_behind_one_another(gl, promise):
    """Slanted, differently split quads a relative 1e-6 apart, from 0.01 to 1e6 units, near plane at 1e-3: interpolated
    depth is off by a few 2^-24 = 6e-8, so that 1e-6 is safe and 1e-7 is not."""
    tilt, wrong = FACING * Rotation.from_euler("xy", [30, 20], degrees=True), 0
    for z in (1e-2, 1.0, 1e2, 1e4, 1e6):
        pair = [
            thing("far", 1, quad(z, z, 3), still((0, z * (1 + 1e-6), 0), tilt)),
            thing("near", 2, quad(z, z, 5), still((0, z, 0), tilt)),
        ]
        world = scene(pair, rig(96, 72, 90.0, near=1e-3))
        with Renderer(gl, world, RenderConfig()) as renderer:
            ids = renderer.labels(0, LabelRequest("ids")).ids
        wrong += (ids != casting.cast(world, 0).instance.reshape(ids.shape)).sum()
    promise("surfaces a relative 1e-6 apart, 0.01 to 1e6 units: wrong pixels", wrong, 0)


@pytest.mark.parametrize("splits, median, worst", [(1, 2e-5, 4e-5), (32, MEDIAN, WORST)])
def test_a_ground_of_200_km(gl, promise, splits, median, worst):
    """The local position is interpolated over the triangle: its error is eps times the *triangle*. Two triangles of 2e5
    units seen from 1.5 units cost two digits; 32 x 32 cells cost nothing (the shipped
    ground and sky are subdivided for that)."""
    e = compare(
        gl, scene([thing("ground", 1, quad(1e5, 1e5, splits), drift((0, 0, -1.5), (0.1, 0, -1.5)))], moving_camera())
    )
    promise(f"ground of 2e5 units, {splits} x {splits} cells: flow, median, relative", e.relative, median)
    promise(f"ground of 2e5 units, {splits} x {splits} cells: flow, largest, relative", e.worst, worst)


@pytest.mark.parametrize("away, median, worst", [(0.0, 1e-6, 1e-3), (1e3, 5e-5, 1e-3), (1e4, 1e-3, 1e-2)])
def test_a_hundred_thousand_repeats_of_a_texture(gl, promise, away, median, worst):
    """Texture coordinates are float32 and count whole repeats from the mesh's middle: at n repeats from there they
    resolve n 2^-24 of one, and a steep texture (1.5 per repeat here) shows four times that. Near the middle, bilinear
    weights of 8 bits are all that is left. (Counted from a corner, the middle of this ground resolved 1/250.)"""
    paint = Material(texture=smooth_texture(1, 64), uv_scale=(1e5, 1e5), unlit=True)
    eye = rig(path=still((away, 0, 0), LEVEL * Rotation.from_rotvec([-0.6, 0, 0])))
    world = scene([thing("ground", 1, quad(1e5, 1e5, 32), still((0, 0, -1.5)), paint)], eye)
    with Renderer(gl, world, RenderConfig()) as renderer:
        luminance = renderer.luminance(0).read()
    near = np.s_[60:]  # magnified: mip maps do not come in
    error = np.abs(luminance - reference.render(world, 0).luminance)[near]
    promise(f"10^5 repeats on 2e5 units, {away:g} from the middle: luminance, median", np.median(error), median)
    promise(f"10^5 repeats on 2e5 units, {away:g} from the middle: luminance, largest", error.max(), worst)


def test_meshes_without_area_or_normals(gl):
    """Points and lines draw nothing; a zero normal is lit by half the sky and gives no NaN."""
    point = mesh(np.zeros((3, 3)), [[0, 1, 2]], np.zeros((3, 3)))
    line = mesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], np.zeros((3, 3)))
    plain = quad(3, 3)
    dark = mesh(plain.vertices, plain.faces, np.zeros((4, 3)))
    things = [
        thing("point", 1, point, still((0, 2, 0))),
        thing("line", 2, line, still((0, 2, 0))),
        thing("dark", 3, dark, still((0, 3, 0), FACING)),
    ]
    world = scene(things)
    with Renderer(gl, world, RenderConfig()) as renderer:
        labels = renderer.labels(0, LabelRequest(*MOTION, "normals", "images"), MS)
        luminance = renderer.luminance(0).read()
    assert (labels.ids == 3).mean() > 0.9
    np.testing.assert_allclose(luminance[labels.ids == 3], 0.5 * world.light.sky, rtol=1e-6)
    assert np.isfinite(labels.normals).all() and np.isfinite(labels.images).all() and np.isfinite(luminance).all()
    np.testing.assert_allclose(reference.render(world, 0).luminance, luminance, rtol=1e-6)


def test_a_mesh_beyond_float32_is_refused(gl):
    for size in (1e30, np.nan):
        with pytest.raises(AssetError, match="too large .* at most 1e\\+18 units"):
            Renderer(gl, scene([thing("giant", 1, quad(size, size), still((0, 3, 0)))]), RenderConfig())


@pytest.mark.parametrize("fov", [0.01, 1, 60, 170, 179.9])
def test_fields_of_view(gl, promise, fov):
    focal = 80 / np.tan(np.radians(fov) / 2)
    world = mixed_scene(textured=False)
    world = world.with_camera(replace(world.camera, fx=focal, fy=focal, cx=79.5, cy=59.5))
    e = compare(gl, world, 300 * MS, 301 * MS)
    assert e.wrong_ids <= 2  # at 179.9 degrees the objects are specks, all silhouette
    promise(f"field of view {fov:g} degrees: flow, median, relative", e.relative, 2e-6)
    promise(f"field of view {fov:g} degrees: flow, largest, relative", e.worst, WORST)


def sized(width, height):
    world = mixed_scene(textured=False)
    return world.with_camera(PinHole.centred(width, height, 0.94 * width))


@pytest.mark.parametrize("width, height", [(1, 1), (1, 7), (7, 1), (2, 2)])
def test_images_of_a_few_pixels(gl, promise, width, height):
    world = sized(width, height)
    true = reference.render(world, 300 * MS, forward_ns=310 * MS)
    with Renderer(gl, world, RenderConfig(antialiasing="ssaa4")) as renderer:
        labels = renderer.labels(300 * MS, LabelRequest(*MOTION, "occlusion_forward"), 310 * MS)
        assert renderer.luminance(300 * MS).read().shape == (height, width)
        assert renderer.velocity(300 * MS, 4).read().shape == (max(1, height // 4), max(1, width // 4), 2)
    same = labels.ids == true.instance
    assert same.mean() > 0.7
    promise(
        f"image of {width} x {height}: flow, largest, relative",
        (length(labels.forward.flow - true.forward.flow) / length(true.forward.flow))[same].max(),
        WORST,
    )


def test_an_image_beyond_opengl_is_refused(gl):
    for width, antialiasing in ((5000, "ssaa4"), (16384, "ssaa2")):
        with (
            Renderer(gl, sized(width, 2), RenderConfig(antialiasing=antialiasing)) as renderer,
            pytest.raises(GLError, match="exceeds this OpenGL's limit"),
        ):
            renderer.luminance(0).read()


@pytest.mark.parametrize("distance, area", [(4, 0.1), (30, 0.002)])
def test_triangles_far_below_a_pixel(gl, promise, distance, area):
    """41 000 visible triangles on 4 500 or 80 pixels: corners snap to 1/256 px, yet
    attributes come from the exact plane."""
    e = compare(
        gl,
        scene(
            [thing("ball", 1, sphere(1.0, 6), drift((0, distance, 0), (0.2, distance, 0.1), TURN, TURN * SPIN))],
            moving_camera(),
        ),
    )
    assert e.wrong_ids == 0
    promise(f"triangles of {area:g} px²: flow, largest, relative", e.worst, WORST)


def test_slivers_and_degenerate_triangles(gl, promise):
    """A plane cut into 400 random slivers, some thinner than 1e-3 px, and triangles without area. The gradient of a
    sliver's attributes divides by its width: the flow is off by up to 1e-3 px there and nowhere else."""
    rng, n = np.random.default_rng(0), 200
    below, above = np.sort(rng.uniform(-2, 2, n)), np.sort(rng.uniform(-2, 2, n))
    vertices = np.concatenate([np.stack([x, np.full(n, y), np.zeros(n)], 1) for x, y in ((below, -1.5), (above, 1.5))])
    i = np.arange(n - 1)
    faces = np.concatenate(
        [np.stack([i, i + 1, i + n], 1), np.stack([i + 1, i + 1 + n, i + n], 1), [[0, 0, 1], [3, 3, 3], [0, 1, 0]]]
    )
    sheet = mesh(vertices, faces, np.tile([0.0, 0, 1], (2 * n, 1)))
    for slant in (20, 80):
        path = drift((0, 4, 0), (0.2, 4, 0.1), LEVEL * Rotation.from_euler("x", 180 - slant, degrees=True))
        e = compare(gl, scene([thing("sheet", 1, sheet, path)], moving_camera()))
        promise(f"slivers seen at {slant} degrees: flow, median, relative", e.relative, MEDIAN)
        promise(f"slivers seen at {slant} degrees: flow, largest", e.flow.max(), 1e-2, "px")


@pytest.mark.parametrize("side", [2048, pytest.param(4096, marks=pytest.mark.slow)])
def test_large_images(gl, promise, side):
    """gl_FragCoord and the flow's ndc are exact in float32 up to 2^24 half pixels; the error in px grows with the image
    because the flow does."""
    world = sized(side, side)
    with Renderer(gl, world, RenderConfig()) as renderer:
        labels = renderer.labels(300 * MS, LabelRequest("ids", "flow_forward"), 310 * MS)
    xy = np.random.default_rng(0).integers(0, side, (3000, 2))
    hits = reference.cast(world, 300 * MS, xy)
    true = reference.flow_to(world, hits, 310 * MS).flow
    ids, flow = labels.ids[xy[:, 1], xy[:, 0]], labels.forward.flow[xy[:, 1], xy[:, 0]]
    same = ids == hits.instance
    assert same.mean() > 0.999
    error = length(flow - true)[same]
    promise(f"image of {side} x {side}: flow, median", np.median(error), 1e-5, "px")
    promise(f"image of {side} x {side}: flow, largest", error.max(), 1e-2, "px")
