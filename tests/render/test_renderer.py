"""The renderer's own promises: culling changes nothing, super-sampling is the mean, nothing unasked is made."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import AssetError
from blinkgl.labels import LABELS, LabelRequest
from blinkgl.render import resources
from blinkgl.render.canvas import screen_rectangle
from blinkgl.render.draw_items import MAX_RADIUS, DrawItem, _draw_item, _Facets, _Greys, box_corners
from blinkgl.render.frames import Rectangle, merged
from blinkgl.render.moment import Moment, cam_from_obj, cam_from_obj_rate
from blinkgl.render.renderer import Renderer
from blinkgl.render.resources import HALF_LEAST, HALF_MOST, half_floats
from blinkgl.scene.geometry import primitives
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Light, Material, Mesh, Part, Scene, SceneObject, Texture
from render_scenes import LEVEL, SECOND, cube, curve, drift, largest_speed, pose, rig, scene, still, thing

PLAIN = RenderConfig(image_antialiasing="none")


def world(width=96, height=72, objects=12, light=Light()):
    rng = np.random.default_rng(5)
    image = rng.integers(0, 256, (32, 32, 3), dtype=np.uint8)
    made = []
    for i in range(objects):
        mesh = [primitives.cuboid(), primitives.sphere(), primitives.torus()][i % 3]
        material = (
            Material(Texture(image), base_color=(1.0, 0.8, 0.5), unlit=i % 4 == 0)
            if i % 2
            else Material(base_color=(0.2, 0.5, 0.9))
        )
        centre = rng.uniform((-6, -2, -3), (6, 9, 3))  # some behind the camera, some outside the view
        made.append(SceneObject(f"object {i}", i + 1, (Part(mesh, material),), curve(i, centre, 0.5, 1.0)))
    f = 0.8 * width
    camera = Rig.alone(
        PinHole(width, height, f, f, (width - 1) / 2, (height - 1) / 2), curve(99, (0, -4, 0), 0.1, 0.1, LEVEL)
    )
    return Scene(tuple(made), camera, 0, SECOND, light, background=0.25)


ALL = LabelRequest(*LABELS)


def buffers(frame):
    named = {k: getattr(frame, k) for k in ("colour", "depth", "ids", "normals", "velocity")}
    for k in ("forward", "backward"):
        named.update({f"{k}.{n}": getattr(getattr(frame, k), n) for n in ("flow", "valid", "occluded")})
    return named


def test_frustum_culling_changes_no_pixel(gl, monkeypatch):
    with Renderer(gl, world(), PLAIN) as renderer:
        culled = (
            [renderer.luminance(t).read() for t in (0, SECOND // 2)],
            buffers(renderer.labels(SECOND // 2, ALL, SECOND, 0)),
        )
        drawn = renderer.stats.triangles
        monkeypatch.setattr(Moment, "visible", property(lambda self: renderer.items))
        renderer.stats.triangles = 0
        full = (
            [renderer.luminance(t).read() for t in (0, SECOND // 2)],
            buffers(renderer.labels(SECOND // 2, ALL, SECOND, 0)),
        )
        assert drawn < renderer.stats.triangles, "the scene has something to cull"
    for a, b in zip(culled[0], full[0]):
        np.testing.assert_array_equal(a, b)
    for name in culled[1]:
        np.testing.assert_array_equal(culled[1][name], full[1][name], err_msg=name)


def test_back_face_culling_of_closed_meshes_changes_no_pixel(gl):
    scene = world()
    with Renderer(gl, scene, PLAIN) as renderer:
        assert any(not item.two_sided for item in renderer.items)
        culled = renderer.luminance(0).read()
        for item in renderer.items:
            item.two_sided = True
        np.testing.assert_array_equal(culled, renderer.luminance(0).read())


def test_two_renderers_in_one_context_do_not_disturb_each_other(gl):
    """Programs, and with them uniforms such as the light, belong to the context."""
    dim, bright = world(light=Light(sun=0.1, sky=0.1)), world(light=Light(sun=1.0, sky=0.8))
    with Renderer(gl, dim, PLAIN) as a, Renderer(gl, bright, PLAIN) as b:
        alone = a.luminance(0).read()
        b.luminance(0).read()
        np.testing.assert_array_equal(alone, a.luminance(0).read())
        assert b.luminance(0).read().mean() > alone.mean()


def test_only_what_is_asked_for_is_made(gl):
    gl.shaders.clear()
    with Renderer(gl, world(), PLAIN) as renderer:
        renderer.luminance(0).read()
        assert {name for name, _ in gl.shaders.compiled} == {"luminance.glsl"}
        renderer.labels(0, LabelRequest("depth"))
        defines = [dict(d) for name, d in gl.shaders.compiled if name == "label.glsl"]
        assert defines and all(not any(k.startswith("OUT_") and k != "OUT_DEPTH" for k in d) for d in defines)
        frame = renderer.labels(0, LabelRequest("depth"))
        assert frame.ids is None and frame.forward is None and frame.colour is None


def test_nothing_hit_is_background(gl):
    scene = world(objects=0)
    with Renderer(gl, scene, PLAIN) as renderer:
        assert (renderer.luminance(0).read() == np.float32(0.25)).all()
        frame = renderer.labels(0, ALL, SECOND, 0)
    assert (frame.ids == 0).all() and np.isinf(frame.depth).all()
    assert not frame.forward.valid.any() and (frame.forward.flow == 0).all() and not frame.forward.occluded.any()


def test_reduced_velocity_samples_the_full_one(gl):
    """A quarter of the pixels in each direction: the largest speed of a smooth field changes little."""
    with Renderer(gl, world(width=192, height=144), PLAIN) as renderer:
        full, reduced = largest_speed(renderer.velocity(0).read()), largest_speed(renderer.velocity(0, every=4).read())
    assert 0.7 * full < reduced <= 1.05 * full


@pytest.mark.parametrize("width, height, every", [(98, 147, 49), (23, 15, 4), (3, 5, 7), (12, 8, 4)])
def test_small_pictures_cover_the_whole_image(gl, width, height, every):
    """(98 * (1 / 49) is 1.9999999999999998.) Pixels are W / w apart: a wall that drifts shows
    its velocity at exactly those places."""
    small = (max(1, height // every), max(1, width // every))
    wall = SceneObject(
        "wall", 1, (Part(primitives.cuboid(), Material(unlit=True)),), drift((-1.0, 4, 0), (1.0, 4.5, 0))
    )
    camera = Rig.alone(
        PinHole(width, height, 0.2 * width, 0.2 * width, (width - 1) / 2, (height - 1) / 2), still(rotation=LEVEL)
    )
    scene = Scene((wall,), camera, 0, SECOND)
    with Renderer(gl, scene, PLAIN) as renderer:
        made = (
            renderer.velocity(0, every).read(),
            renderer.velocity_of_movers(0, every).read(),
            renderer.brightness(0, every).read(),
        )
        assert all(a.shape == (*small, 2) and a.dtype == np.float32 for a in made)
    fewer = PinHole.centred(small[1], small[0], 0.2 * small[1], 0.2 * width * small[0] / height)
    with Renderer(gl, scene.with_camera(fewer), PLAIN) as renderer:
        np.testing.assert_allclose(
            made[0], renderer.velocity(0).read() * (width / small[1], height / small[0]), rtol=1e-4, atol=1e-4
        )


# ---- matrices ----------------------------------------------------------------------------------------------------


def test_projection_puts_points_on_the_documented_pixel():
    camera = PinHole(640, 480, 500.0, 510.0, 300.0, 250.0, near=0.1)
    rng = np.random.default_rng(0)
    points = rng.uniform((-1, -1, 0.2), (1, 1, 9), (50, 3))
    clip = np.column_stack([points, np.ones(50)]) @ camera.clip_from_cam().T
    ndc = clip[:, :3] / clip[:, 3:]
    window = (ndc[:, :2] + 1) / 2 * (640, 480) - 0.5
    np.testing.assert_allclose(window, points[:, :2] / points[:, 2:] * (500, 510) + (300, 250), atol=1e-10)
    np.testing.assert_allclose(ndc[:, 2], 0.1 / points[:, 2], rtol=1e-14)
    np.testing.assert_allclose(clip[:, 3], points[:, 2], rtol=1e-14)


# --- Poses to clip space: the frustum's planes lie where the image ends, and stacks of poses are stacks of single
# ones.

CAMERA = PinHole(64, 40, 50.0, 70.0, 20.0, 28.0)  # nothing about it is symmetric


def seen_at(x: float, y: float, depth: float = 3.0) -> np.ndarray:
    """The point in camera axes that pixel coordinates (x, y) show."""
    return depth * np.array([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, 1.0])


@pytest.mark.parametrize(
    "plane, inside, outside",
    [
        (0, (-0.4, 20), (-0.6, 20)),
        (1, (63.4, 20), (63.6, 20)),
        (2, (30, -0.4), (30, -0.6)),
        (3, (30, 39.4), (30, 39.6)),
    ],
)
def test_a_plane_is_where_the_image_ends(plane, inside, outside):
    planes = CAMERA.frustum_planes()
    assert planes.shape == (5, 3)
    np.testing.assert_allclose(np.linalg.norm(planes, axis=1), 1.0)
    assert (planes @ seen_at(*inside) > 0).all()
    assert (planes @ seen_at(*outside) < 0).tolist() == [k == plane for k in range(5)]


def test_the_last_plane_is_the_cameras_own():
    planes = CAMERA.frustum_planes()
    assert (planes @ [0, 0, 1.0])[4] > 0 > (planes @ [0, 0, -1.0])[4]


def poses(count: int, seed: int) -> np.ndarray:
    dice = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.random(count, dice).as_matrix(), dice.normal(size=(count, 3))
    return T


def test_stacks_of_cameras_and_objects():
    cameras, objects = poses(5, 0), poses(5, 1)
    together = cam_from_obj(cameras, objects)
    for k in range(5):
        np.testing.assert_allclose(together[k], np.linalg.inv(cameras[k]) @ objects[k], atol=1e-14)
        np.testing.assert_array_equal(together[k], cam_from_obj(cameras[k], objects[k]))


def test_the_rate_is_the_limit_of_differences():
    def at(t: float, seed: int) -> np.ndarray:
        dice = np.random.default_rng(seed)
        axis, speed, T = dice.normal(size=3), dice.normal(size=3), np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_rotvec(t * axis).as_matrix(), 1 + t * speed
        return T

    step = 1e-5
    rate = lambda seed: (at(0.3 + step, seed) - at(0.3 - step, seed)) / (2 * step)
    camera, thing = np.stack([at(0.3, 1), at(0.3, 2)]), np.stack([at(0.3, 3), at(0.3, 4)])
    got = cam_from_obj_rate(camera, np.stack([rate(1), rate(2)]), thing, np.stack([rate(3), rate(4)]))
    for k in range(2):
        wanted = (
            cam_from_obj(at(0.3 + step, 1 + k), at(0.3 + step, 3 + k))
            - cam_from_obj(at(0.3 - step, 1 + k), at(0.3 - step, 3 + k))
        ) / (2 * step)
        np.testing.assert_allclose(got[k], wanted, atol=1e-8)


# --- What can be drawn in float32 at all.


def mesh(reach: float) -> Mesh:
    corners = np.array([[-reach, 0, 0], [reach, 0, 0], [0, reach / 2, 0]]) + [0.0, 3.0, 0.0]
    return Mesh(
        corners,
        np.array([[0, 1, 2]], np.int32),
        np.zeros((3, 3), np.float32),
        np.zeros((3, 2), np.float32),
        True,
        "sheet",
    )


def item_of(shape: Mesh, material: Material | None = None) -> DrawItem:
    body = thing("sheet", 1, shape, still(), material)
    return _draw_item(2, body, body.parts[0], scene([body]), _Greys(False), _Facets(Light()))


def test_the_largest_mesh_and_one_that_is_larger():
    centre = np.hypot(1.0, 0.25)  # of the box; the farthest corner is the left one
    item = item_of(mesh(MAX_RADIUS / centre * (1 - 1e-12)))
    assert item.radius == pytest.approx(MAX_RADIUS) and not item.two_sided and item.lit
    for reach in (MAX_RADIUS, np.nan):
        with pytest.raises(AssetError, match="sheet: mesh is too large to be drawn in float32"):
            item_of(mesh(reach))


def test_exactly_the_largest_radius_is_drawn():
    flat = Mesh(
        np.array([[-MAX_RADIUS, 0, 0], [MAX_RADIUS, 0, 0], [0, 0, 0.0]]),
        np.array([[0, 1, 2]], np.int32),
        np.zeros((3, 3), np.float32),
        np.zeros((3, 2), np.float32),
        True,
        "line",
    )
    assert item_of(flat, Material(both_sides=True)).radius == MAX_RADIUS


def lit(*rows) -> np.ndarray:
    return np.array(rows, np.float32)[..., None]


@pytest.mark.parametrize(
    ("image", "half"),
    [
        (lit([0, HALF_LEAST], [1, HALF_MOST]), True),  # black is exact, and both ends are in
        (lit([0.5, HALF_LEAST * (1 - 1e-6)]), False),  # 1/2048 of a darker texel is less than it tells apart
        (lit([0.5, HALF_MOST * 1.001]), False),
        (lit([0.5, np.inf]), False),
        (lit([0.0, 0.0]), False),  # nothing to gain, and nothing to divide by
        (lit([*[0.0] * 99, 50 * HALF_LEAST]), False),  # coarse levels would be darker than any texel
        (lit([*[0.0] * 99, 200 * HALF_LEAST]), True),
        (np.array([[[1e-6, 0.5, 0.0]]], np.float32), True),  # of a colour the brightest channel counts
        (np.array([[[1e-6, 1e-5, 0.0]], [[1, 1, 1]]], np.float32), False),
    ],
)
def test_half_floats_where_they_hold_a_picture(image, half):
    stored = half_floats(image)
    assert stored.dtype == (np.float16 if half else np.float32)
    brightest = image.max(axis=2, keepdims=True)
    with np.errstate(invalid="ignore"):
        assert (np.abs(stored.astype(np.float64) - image) <= brightest / 2048).all() or not half
    if not half:
        assert stored is image


def test_8_bits_of_srgb_are_half_floats():
    codes = np.arange(256, dtype=np.uint8)[None]
    image = resources.luminance_image(np.repeat(codes[..., None], 3, axis=2), (0.3, 0.3, 0.3))[..., None]
    assert half_floats(image).dtype == np.float16


def test_frames_of_half_floats_are_those_of_floats(gl, monkeypatch):
    """Their texels are rounded to 1/2048, their mip levels once more; rates are differences of neighbours. A picture of
    floats stays as it is."""
    rng = np.random.default_rng(3)
    coded = Texture(rng.integers(0, 256, (64, 64, 3), np.uint8), "codes")
    whole = Texture(rng.random((64, 64, 3), np.float32), "floats")
    kinds: list[np.dtype] = []
    of = half_floats
    monkeypatch.setattr(resources, "half_floats", lambda image: kinds.append(image.dtype) or of(image))

    def drawn(texture: Texture) -> tuple[np.ndarray, np.ndarray]:
        body = thing("box", 1, cube(0.8), drift((0, 3, 0), (0.5, 3, 0)), Material(texture=texture))
        with Renderer(gl, scene([body], rig(80, 60, 75.0)), RenderConfig(antialiasing="taps4")) as renderer:
            return renderer.luminance(100_000_000).read(), renderer.brightness(100_000_000).read()[..., 1]

    half, half_rate = drawn(coded)
    assert kinds == [np.float32] and drawn(whole) and len(kinds) == 1
    monkeypatch.setattr(resources, "half_floats", lambda image: image)
    true, rate = drawn(coded)
    off = np.abs(half - true)
    assert 0 < off.max() <= true.max() / 1024, "they differ, or nothing was compared"
    assert np.abs(half_rate - rate).max() <= 2e-3 * np.abs(rate).max() > 0


# --- Where on the screen something can be: no less than it covers, and no more than a pixel on every side besides.

CAMERA_RECTANGLES = PinHole(64, 40, 50.0, 70.0, 20.0, 28.0, near=0.1)


def item(low, high):
    return SimpleNamespace(corners=box_corners(np.array(low, float), np.array(high, float)))


def test_a_box_is_inside_its_rectangle_with_a_pixel_to_spare_and_no_more():
    dice = np.random.default_rng(0)
    seen = 0
    for _ in range(300):
        low = dice.uniform(-0.5, 0, 3)
        high = low + dice.uniform(0.05, 0.8, 3)
        T = pose([*dice.uniform(-2, 2, 2), dice.uniform(1.5, 6)], Rotation.from_rotvec(dice.normal(size=3)))
        corners = (
            np.array(
                [
                    [(low, high)[a][0], (low, high)[b][1], (low, high)[c][2]]
                    for a in (0, 1)
                    for b in (0, 1)
                    for c in (0, 1)
                ]
            )
            @ T[:3, :3].T
            + T[:3, 3]
        )
        x, y = (
            CAMERA_RECTANGLES.fx * corners[:, 0] / corners[:, 2] + CAMERA_RECTANGLES.cx,
            CAMERA_RECTANGLES.fy * corners[:, 1] / corners[:, 2] + CAMERA_RECTANGLES.cy,
        )
        # Pixels, both ends included.
        x0, x1, y0, y1 = (
            math.floor(x.min()) - 1,
            math.ceil(x.max()) + 1,
            math.floor(y.min()) - 1,
            math.ceil(y.max()) + 1,
        )
        x0, x1, y0, y1 = max(x0, 0), min(x1, 63), max(y0, 0), min(y1, 39)
        found = screen_rectangle(item(low, high), T, CAMERA_RECTANGLES)
        if x0 > x1 or y0 > y1:
            assert found is None
        else:
            seen += 1
            assert (found.x0, found.y0, found.x1 - 1, found.y1 - 1) == (x0, y0, x1, y1)
    assert 100 < seen < 300


def test_what_reaches_the_near_plane_may_be_anywhere():
    everywhere = Rectangle(0, 0, 64, 40)
    box = item([-0.1, -0.1, -0.1], [0.1, 0.1, 0.1])
    assert screen_rectangle(box, pose([0, 0, 0.2]), CAMERA_RECTANGLES) == everywhere, "a corner exactly on it"
    assert screen_rectangle(box, pose([0, 0, 0.1]), CAMERA_RECTANGLES) == everywhere
    assert screen_rectangle(box, pose([5, 0, 0.2]), CAMERA_RECTANGLES) == everywhere
    assert screen_rectangle(box, pose([0, 0, 0.3]), CAMERA_RECTANGLES) != everywhere
    assert (
        screen_rectangle(box, pose([0, 0, -1.0]), CAMERA_RECTANGLES) is None
        and screen_rectangle(box, pose([0, 0, 0.0]), CAMERA_RECTANGLES) is None
    )


@pytest.mark.parametrize(
    "a, b, meet",
    [
        ((0, 0, 2, 2), (2, 0, 4, 2), False),
        ((0, 0, 2, 2), (1, 1, 3, 3), True),
        ((0, 0, 2, 2), (0, 2, 2, 4), False),
        ((0, 0, 9, 9), (3, 3, 4, 4), True),
        ((0, 0, 2, 2), (5, 0, 6, 2), False),
        ((0, 0, 2, 2), (1, 5, 2, 6), False),
    ],
)
def test_rectangles_meet_where_they_share_a_pixel(a, b, meet):
    a, b = Rectangle(*a), Rectangle(*b)
    assert a.meets(b) is b.meets(a) is meet
    union = a.union(b)
    assert union == b.union(a) == Rectangle(min(a.x0, b.x0), min(a.y0, b.y0), max(a.x1, b.x1), max(a.y1, b.y1))
    assert merged([a, b]) == ([union] if meet else sorted([a, b], key=lambda r: (r.y0, r.x0)))


def test_scale():
    assert Rectangle(1, 2, 4, 9).scaled(3) == Rectangle(3, 6, 12, 27)


def test_merging_goes_on_until_none_meet():
    """The union of two meets a third that neither did."""
    chain = [
        Rectangle(0, 0, 2, 2),
        Rectangle(5, 5, 6, 6),
        Rectangle(1, 1, 5, 2),
        Rectangle(4, 1, 6, 9),
        Rectangle(20, 0, 21, 1),
    ]
    assert merged(chain) == [Rectangle(0, 0, 6, 9), Rectangle(20, 0, 21, 1)] == merged(chain[::-1])
    assert merged([]) == []
