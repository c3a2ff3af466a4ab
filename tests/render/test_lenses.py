"""Pictures and labels through lenses that distort, against the float64 caster that looks through the same model."""

from dataclasses import is_dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import blinkgl
from blinkgl.camera import CAMERA_MODELS, PinHole
from blinkgl.camera.drawing import seen_through
from blinkgl.camera.pinhole import rectified
from blinkgl.config.sequence import RenderConfig
from blinkgl.gl import create_context
from blinkgl.labels import LABELS, LabelRequest
from blinkgl.render import casting
from blinkgl.render.lens import places_of
from blinkgl.render.renderer import Renderer
from blinkgl.tools.shader_debugger import reference
from tests.render.test_materials import drift, hidden_ball

LENSES = {
    "radtan": {
        "lens": "radtan",
        "distortion": [-0.3, 0.1, 1e-3, -2e-3],
        "fx": 78.0,
        "fy": 81.0,
        "cx": 52.0,
        "cy": 40.0,
    },
    "pincushion": {"lens": "radtan", "distortion": [0.12, 0.02, 0, 0, 0.01], "fov": 65},
    "fisheye": {"lens": "equidistant", "distortion": [-0.02, 0.005, 0.002, -0.001], "fov": 95},
}
T, SPAN = 300_000_000, 120_000_000
EVERYTHING = LabelRequest(*LABELS)


@pytest.fixture(scope="module")
def gl():
    with create_context() as context:
        yield context


def scene_with(lens, **keys):
    path = blinkgl.Keyframes(
        {0: blinkgl.look_at((-2, 0, 1), (0, 0.4, 0)), 1: blinkgl.look_at((-1.8, 0.9, 1.2), (0, 0.4, 0.2))}
    )
    wave = blinkgl.Deform("wave", amplitude=0.1) if "wave" in keys.pop("shapes", ()) else None
    camera = blinkgl.Camera(104, 80, pose=keys.pop("pose", path), **lens)
    scene = blinkgl.Scene(camera, **keys)
    scene += blinkgl.Primitive("cuboid", material=blinkgl.Material(procedural="bricks"))
    spin = blinkgl.Keyframes({0: blinkgl.Pose((0.4, 1.0, 0.3)), 1: blinkgl.Pose((0.0, 1.4, 0.4), euler=(0, 40, 70))})
    scene += blinkgl.Primitive("icosphere", pose=spin, deform=wave)
    return scene.build(scene.template().sequence(0))


def next_facets(true, scene, t_ns=T):
    """Pixels whose ray meets another facet, or body, than the flat picture's nearest pixel shows."""
    flat = seen_through(scene.camera)
    nearest = np.floor(places_of(scene.camera, flat, scene.camera.width, scene.camera.height).places)
    drawn = casting.cast(scene.with_camera(flat), t_ns, nearest.reshape(-1, 2))
    same = (drawn.part == true.part.ravel()) & (drawn.triangle == true.triangle.ravel())
    return true.hit & ~same.reshape(true.hit.shape)


@pytest.fixture(scope="module", params=LENSES)
def seen(request, gl):
    """(labels, what they should be, next_facets, scene)"""
    with Renderer(gl, scene_with(LENSES[request.param]), RenderConfig()) as renderer:
        frame = renderer.labels(T, EVERYTHING, T + SPAN, T - SPAN)
        true = reference.render(renderer.scene, T, forward_ns=T + SPAN, backward_ns=T - SPAN)
        return frame, true, next_facets(true, renderer.scene), renderer.scene


def within(error, bound):
    assert error.max() <= bound, np.sort(error)[-10:]


def test_labels_are_those_of_the_rays(seen):
    """Of every pixel: up to silhouettes, and where the flat picture shows the facet beside the ray's."""
    frame, true, aside, scene = seen
    hit = true.hit
    assert hit.sum() > 1000 and aside.sum() > 50
    np.testing.assert_array_equal(frame.ids, true.instance)
    within(np.abs(frame.depth[hit] / true.depth[hit] - 1), 5e-6)
    turned = true.normal @ scene.camera_path.pose(T)[:3, :3]
    towards = (turned * scene.camera.rays(true.xy.reshape(-1, 2)).reshape(turned.shape)).sum(axis=-1)
    within(np.abs(frame.normals - turned)[hit & (towards < -2e-4)].max(axis=-1), 2e-5)
    within(np.abs(frame.velocity - true.velocity)[hit].max(axis=-1), 2e-3)
    for ours, theirs in ((frame.forward, true.forward), (frame.backward, true.backward)):
        np.testing.assert_array_equal(ours.valid, theirs.valid)
        assert np.abs(theirs.flow[ours.valid]).max() > 1
        within(np.abs(ours.flow - theirs.flow)[ours.valid].max(axis=-1), 2e-5)  # asked: 1e-3 px
        assert (ours.occluded != theirs.occluded).sum() <= 2


def test_through_the_near_plane_past_the_horizon_and_thinner_than_a_pixel(gl):
    """A floor that the camera stands on, needles, and a mesh whose facets are smaller than pixels."""
    camera = blinkgl.Camera(104, 80, pose=blinkgl.look_at((0, 0, 0.1), (3, 0.4, 0.25)), **LENSES["fisheye"])
    scene = blinkgl.Scene(camera)
    scene += blinkgl.Primitive("grid", width=40, depth=40)
    scene += blinkgl.Mesh(vertices=[(1, -0.5, 0.1), (1, 0.6, 0.3), (1, 0.6, 0.318)], faces=[(0, 1, 2), (0, 2, 1)])
    spin = blinkgl.Keyframes({0: blinkgl.Pose((3, 0.5, 0.8)), 1: blinkgl.Pose((3, 0.2, 1.0), euler=(0, 40, 70))})
    scene += blinkgl.Primitive("sphere", radius=0.5, rings=48, segments=96, pose=spin)
    with Renderer(gl, scene.build(scene.template().sequence(0)), RenderConfig()) as renderer:
        frame = renderer.labels(T, LabelRequest("ids", "depth", "flow_forward"), T + SPAN)
        true = reference.render(renderer.scene, T, forward_ns=T + SPAN)
    assert min((true.instance == k).sum() for k in (1, 2, 3)) > 10
    wrong = frame.ids != true.instance
    assert wrong.sum() <= 2, "a needle is a pixel wide at most"
    hit = true.hit & ~wrong
    within(np.abs(frame.depth[hit] / true.depth[hit] - 1), 1e-4)  # at the horizon a ray meets the floor far away
    valid = hit & frame.forward.valid & true.forward.valid
    within(np.abs(frame.forward.flow - true.forward.flow)[valid].max(axis=-1), 1e-3)


@pytest.mark.parametrize("kind, numbers", [("radtan", (-0.2, 0.05, 1e-3, 0, 0)), ("equidistant", (-0.02, 0.005, 0, 0))])
def test_through_holes(gl, kind, numbers):
    made = hidden_ball(drift((0, 2, 0), (0.4, 2, 0.1), Rotation.from_euler("x", 90, degrees=True)))
    old, model = made.camera, CAMERA_MODELS[kind]
    camera = model(old.width, old.height, *old.intrinsics, old.near, **dict(zip(model.coefficients, numbers)))
    with Renderer(gl, made.with_camera(camera), RenderConfig()) as renderer:
        frame = renderer.labels(T, LabelRequest("ids", "flow_forward"), T + SPAN)
        true = reference.render(renderer.scene, T, forward_ns=T + SPAN)
    assert set(np.unique(frame.ids)) == {0, 1, 2, 3} and (frame.ids != true.instance).sum() <= 2
    valid = (frame.ids == true.instance) & true.forward.valid
    within(np.abs(frame.forward.flow - true.forward.flow)[valid].max(axis=-1), 1e-4)


def test_shapes_that_change(gl):
    with Renderer(gl, scene_with(LENSES["radtan"], shapes=("wave",)), RenderConfig()) as renderer:
        frame = renderer.labels(T, LabelRequest("flow_forward", "ids", "velocity"), T + SPAN)
        true = reference.render(renderer.scene, T, forward_ns=T + SPAN)
        hit = true.hit
    np.testing.assert_array_equal(frame.forward.valid, true.forward.valid)
    np.testing.assert_array_equal(frame.ids[hit], true.instance[hit])
    within(np.abs(frame.forward.flow - true.forward.flow)[hit].max(axis=-1), 1e-4)
    within(np.abs(frame.velocity - true.velocity)[hit].max(axis=-1), 2e-3)


def test_rectified_labels_are_a_pin_hole_camera_s(gl):
    scene = scene_with(LENSES["radtan"])
    flat = rectified(scene.camera)
    assert isinstance(flat, PinHole)
    with Renderer(gl, scene, RenderConfig()) as lens, Renderer(gl, scene.with_camera(flat), RenderConfig()) as pin_hole:
        ours, theirs = (
            lens.labels(T, EVERYTHING, T + SPAN, T - SPAN, flat),
            pin_hole.labels(T, EVERYTHING, T + SPAN, T - SPAN),
        )
        for name in EVERYTHING:
            one, other = ours.values[name], theirs.values[name]
            arrays = (vars(one), vars(other)) if is_dataclass(one) else ({"": one}, {"": other})
            for field in arrays[0]:
                np.testing.assert_array_equal(arrays[0][field], arrays[1][field], f"{name} {field}")
        own = lens.labels(T, EVERYTHING, T + SPAN, T - SPAN)  # and the sensor's own are still what they were
        assert (own.ids != ours.ids).any()


# ---- light ----------------------------------------------------------------------------------------------------------


def board(lens):
    """A white square, turned a little, before black."""
    scene = blinkgl.Scene(
        blinkgl.Camera(104, 80, pose=blinkgl.look_at((-2, 0, 0), (0, 0, 0)), **lens),
        light=blinkgl.Light(unlit=True),
        background=0.0,
    )
    square = blinkgl.Material(color=(1.0, 1.0, 1.0))
    pose = blinkgl.Pose((0, 0.03, 0.02), euler=(7, 0, 0))
    scene += blinkgl.Primitive("cuboid", extents=(0.01, 1.9, 1.3), pose=pose, material=square)
    return scene.build(scene.template().sequence(0))


@pytest.mark.parametrize("lens", ["radtan", "fisheye"])
def test_edges_are_where_the_rays_have_them(gl, lens):
    scene = board(LENSES[lens])
    with Renderer(gl, scene, RenderConfig(antialiasing="ssaa4")) as renderer:
        picture = renderer.luminance(T).read().astype(float)
        grid = casting.pixel_grid(scene.camera)
        true = np.zeros(len(grid))
        offsets = (np.arange(10) + 0.5) / 10 - 0.5
        for dy in offsets:
            for dx in offsets:
                true += casting.cast(scene, T, grid + [dx, dy]).hit / 100.0
    true = true.reshape(picture.shape)
    assert picture.max() == pytest.approx(1.0) and 0.1 < true.mean() < 0.6
    middle_y, middle_x = 40, 52
    inside = true[middle_y - 12 : middle_y + 12, middle_x - 15 : middle_x + 15]
    assert inside.min() == pytest.approx(1.0)
    for edge in (
        (slice(middle_y - 12, middle_y + 12), slice(0, middle_x), 1),
        (slice(middle_y - 12, middle_y + 12), slice(middle_x, None), 1),
        (slice(0, middle_y), slice(middle_x - 15, middle_x + 15), 0),
        (slice(middle_y, None), slice(middle_x - 15, middle_x + 15), 0),
    ):
        rows, columns, axis = edge
        moved = picture[rows, columns].sum(axis=axis) - true[rows, columns].sum(axis=axis)
        assert abs(moved.mean()) < 0.02 and np.abs(moved).max() < 0.12, edge


def test_a_still_camera_takes_a_lens_s_picture_whole_where_anything_changed(gl):
    still = scene_with(LENSES["radtan"], pose=blinkgl.look_at((-2, 0, 1), (0, 0.4, 0)))
    with Renderer(gl, still, RenderConfig()) as parts, Renderer(gl, still, RenderConfig(), whole=True) as whole:
        assert not parts.whole
        before, drawn = None, None
        for t in (0, T, T + SPAN, T + SPAN, 2 * T):
            last, drawn = drawn, parts.luminance(t)
            ours, theirs = drawn.view(), whole.luminance(t).read()
            np.testing.assert_array_equal(ours, theirs)
            rows = drawn.rows_changed_since(last)
            if before is not None:
                assert rows == (0, len(theirs)) or (rows == (0, 0) and (theirs == before).all())
            before = theirs


def test_small_pictures_and_rates(gl):
    scene = scene_with(LENSES["fisheye"])
    with Renderer(gl, scene, RenderConfig()) as renderer:
        small = renderer.velocity_of_movers(T, 4).read()
        assert small.shape == (20, 26, 2)
        true = reference.render(renderer.scene, T)
        padded = np.pad(np.nan_to_num(true.velocity), ((2, 2), (2, 2), (0, 0)), mode="edge")
        blocks = np.stack([padded[dy : dy + 80 : 4, dx : dx + 104 : 4] for dy in range(8) for dx in range(8)])
        room = 0.02 * np.abs(blocks).max()
        assert ((small > blocks.min(axis=0) - room) & (small < blocks.max(axis=0) + room)).all()
        assert np.abs(small).max() > 10
        assert renderer.brightness(T, 4).read().shape == (20, 26, 2)
        h = 200_000
        rate = renderer.brightness(T).read()[..., 1]
        after, before = (renderer.brightness(T + s).read()[..., 0].astype(float) for s in (h, -h))
        slope = (after - before) / (2e-9 * h)
        inner = ~reference.silhouette_band(
            *(getattr(reference.render(renderer.scene, T), k) for k in ("instance", "depth")), 3
        )
        assert np.abs(slope[inner]).max() > 0.2
        assert np.quantile(np.abs(rate - slope)[inner], 0.95) < 0.05 * np.abs(slope[inner]).max()


def test_another_part_of_the_same_lens(gl):
    scene = scene_with(LENSES["radtan"])
    parts = [scene.camera.part(x, y, x + 52, y + 40, 2) for x, y in ((0, 0), (52, 40))]
    with Renderer(gl, scene.with_camera(parts[0]), RenderConfig()) as renderer:
        for part in parts:
            renderer.look_through(part)
            depth = renderer.labels(T, LabelRequest("depth")).depth
            true = reference.render(scene.with_camera(part), T)
            hit = true.hit
            within(np.abs(depth[hit] / true.depth[hit] - 1), 5e-6)
