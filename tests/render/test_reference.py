"""The float64 reference renderer against closed forms, and its hierarchy against the exhaustive loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.render import casting
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Light, Material, Texture
from blinkgl.srgb import linear_from_srgb
from blinkgl.tools.shader_debugger import appearance, reference
from exhaustive import nearest_exhaustive
from render_scenes import (
    FACING,
    LEVEL,
    SECOND,
    cube,
    curve,
    drift,
    mesh,
    mixed_scene,
    quad,
    rig,
    scene,
    sphere,
    still,
    thing,
)

MS = 1_000_000


def rays_of(cam: PinHole) -> np.ndarray:
    y, x = np.mgrid[0 : cam.height, 0 : cam.width].astype(float)
    return np.stack([(x - cam.cx) / cam.fx, (y - cam.cy) / cam.fy, np.ones_like(x)], 2)


def project(rig: Rig, world: np.ndarray, t_ns: int) -> np.ndarray:
    """Plain pin-hole projection of (..., 3) world points: (..., 2) px."""
    cam, m = rig.sensors[0].camera, rig.path.pose(t_ns)
    local = (world - m[:3, 3]) @ m[:3, :3]
    return local[..., :2] / local[..., 2:] * [cam.fx, cam.fy] + [cam.cx, cam.cy]


# ------------------------------------------------------------------------------------------------- closed forms


def test_plane_depth_flow_and_velocity():
    """Tilted plane, drifting and turning: X = s r with n.(s r - p) = 0, and the rigid motion of that point."""
    tilt = LEVEL * Rotation.from_euler("xy", [140, 15], degrees=True)
    path = drift((0.1, 4, 0.2), (0.4, 4.6, -0.1), tilt, tilt * Rotation.from_rotvec([0.1, -0.2, 0.3]))
    world = scene([thing("plane", 7, quad(50, 50), path)])
    cam, t0, t1 = world.camera, 200 * MS, 700 * MS
    frame = reference.render(world, t0, forward_ns=t1)
    m0, m1 = path.pose(t0), path.pose(t1)

    rays = rays_of(cam) @ world.rig.path.pose(t0)[:3, :3].T
    normal = m0[:3, 2]
    depth = (normal @ m0[:3, 3]) / (rays @ normal)
    seen = (depth > 0) & (np.abs((depth[..., None] * rays - m0[:3, 3]) @ m0[:3, :2]).max(-1) < 49.9)
    assert seen.mean() > 0.5
    np.testing.assert_array_equal(frame.instance[seen], 7)
    np.testing.assert_allclose(frame.depth[seen], depth[seen], rtol=2e-14)

    point = depth[..., None] * rays
    local = (point - m0[:3, 3]) @ m0[:3, :3]
    after = local @ m1[:3, :3].T + m1[:3, 3]
    flow = project(world.rig, after, t1) - np.stack(np.meshgrid(np.arange(cam.width), np.arange(cam.height)), 2)
    valid = seen & frame.forward.valid
    np.testing.assert_allclose(frame.forward.flow[valid], flow[valid], rtol=1e-10, atol=1e-10)

    body_rate = np.array([0.1, -0.2, 0.3])  # the rotation takes one second
    rate = np.array([0.3, 0.6, -0.3]) + np.cross(m0[:3, :3] @ body_rate, point - m0[:3, 3])
    rate = rate @ world.rig.path.pose(t0)[:3, :3]
    r = rays_of(cam)
    velocity = (rate[..., :2] - r[..., :2] * rate[..., 2:]) / depth[..., None] * [cam.fx, cam.fy]
    np.testing.assert_allclose(frame.velocity[seen], velocity[seen], rtol=1e-9, atol=1e-9)


def sphere_depth(cam: PinHole, centre: np.ndarray, radius: float) -> np.ndarray:
    """Z of the nearer intersection for a camera-frame centre; nan where missed."""
    r = rays_of(cam)
    a, b, c = (r * r).sum(-1), r @ centre, centre @ centre - radius**2
    with np.errstate(invalid="ignore"):
        return (b - np.sqrt(b * b - a * c)) / a


def test_sphere_converges_to_the_analytic_one_with_order_two():
    """The chord error of a subdivided sphere falls as the square of its edge; depth and flow follow."""
    path = drift((0.2, 4.0, 0.1), (-0.1, 4.4, 0.3))
    eye = rig()
    cam = eye.sensors[0].camera
    depth = sphere_depth(cam, LEVEL.inv().apply([0.2, 4.0, 0.1]), 1.0)
    inner = np.nan_to_num(sphere_depth(cam, LEVEL.inv().apply([0.2, 4.0, 0.1]), 0.85), nan=-1) > 0  # away from the rim
    y, x = np.mgrid[0 : cam.height, 0 : cam.width].astype(float)
    point = (depth[..., None] * rays_of(cam)) @ LEVEL.as_matrix().T + [-0.3, 0.4, 0.2]
    flow = project(eye, point, SECOND) - np.stack([x, y], 2)
    errors = []
    for level in (2, 3, 4, 5):
        world = scene([thing("ball", 1, sphere(1.0, level), path)], eye)
        frame = reference.render(world, 0, forward_ns=SECOND)
        errors.append(
            (np.abs(frame.depth - depth)[inner].mean(), np.linalg.norm(frame.forward.flow - flow, axis=2)[inner].mean())
        )
    slopes = -np.polyfit([2, 3, 4, 5], np.log2(errors), 1)[0]
    np.testing.assert_allclose(slopes, 2.0, atol=0.3)
    assert errors[-1][0] < 3e-4  # an edge of 0.035: sagitta 1.5e-4, seen obliquely


def test_cube_depth_ids_normals_and_flow():
    """Slab intersection in the cube's frame gives depth and side; the rigid motion of that point gives the flow."""
    turn0 = Rotation.from_rotvec([0.3, 0.5, -0.2])
    path = drift((0.3, 5.0, -0.2), (-0.2, 4.5, 0.1), turn0, turn0 * Rotation.from_rotvec([-0.3, 0.2, 0.4]))
    eye = drift((0, 0, 0), (0.3, 0.2, -0.1), LEVEL, LEVEL * Rotation.from_rotvec([0.05, -0.04, 0.1]))
    world = scene([thing("box", 9, cube(1.0), path)], rig(path=eye))
    cam, t0, t1 = world.camera, 100 * MS, 600 * MS
    frame = reference.render(world, t0, forward_ns=t1)

    c0, m0, m1 = eye.pose(t0), path.pose(t0), path.pose(t1)
    d = rays_of(cam) @ c0[:3, :3].T @ m0[:3, :3]
    o = (c0[:3, 3] - m0[:3, 3]) @ m0[:3, :3]
    near, far = np.sort(np.stack([(-1 - o) / d, (1 - o) / d]), axis=0)
    enter, leave = near.max(-1), far.min(-1)
    seen = enter < leave
    np.testing.assert_array_equal(frame.hit, seen)
    np.testing.assert_array_equal(frame.instance, np.where(seen, 9, 0))
    np.testing.assert_allclose(frame.depth[seen], enter[seen], rtol=1e-13)
    side = near.argmax(-1)
    outward = -np.sign(np.take_along_axis(d, side[..., None], -1)) * np.eye(3)[side]
    np.testing.assert_allclose(frame.normal[seen], (outward @ m0[:3, :3].T)[seen], atol=1e-6)  # normals are float32

    local = o + enter[..., None] * d
    flow = project(world.rig, local @ m1[:3, :3].T + m1[:3, 3], t1) - project(
        world.rig, local @ m0[:3, :3].T + m0[:3, 3], t0
    )
    np.testing.assert_allclose(frame.forward.flow[seen], flow[seen], atol=1e-10)
    # what turns away is hidden by the cube itself: its outward normal at t1 against the ray from the camera
    away = ((outward @ m1[:3, :3].T) * (local @ m1[:3, :3].T + m1[:3, 3] - eye.pose(t1)[:3, 3])).sum(-1) > 0
    there = project(world.rig, local @ m1[:3, :3].T + m1[:3, 3], t1)
    outside = ((there < -0.5) | (there >= [cam.width - 0.5, cam.height - 0.5])).any(-1)
    assert away[seen].any() and not away[seen].all()
    np.testing.assert_array_equal(frame.forward.occluded[seen], (away | outside)[seen])


def test_camera_rotation_is_the_homography():
    """x' ~ K R10 K^-1 x whatever is seen there: the flow does not depend on depth."""
    eye = drift((1, 2, 3), (1, 2, 3), LEVEL, LEVEL * Rotation.from_rotvec([0.06, -0.09, 0.2]))
    base = mixed_scene()
    frozen = tuple(
        replace(o, path=still(o.path.pose(0)[:3, 3] + [1, 2, 3], Rotation.from_matrix(o.path.pose(0)[:3, :3])))
        for o in base.objects
    )
    world = scene(frozen, rig(path=eye))
    cam, t0, t1 = world.camera, 0, 800 * MS
    frame = reference.render(world, t0, forward_ns=t1)
    assert len(np.unique(frame.instance)) >= 5
    H = cam.K @ eye.pose(t1)[:3, :3].T @ eye.pose(t0)[:3, :3] @ np.linalg.inv(cam.K)
    y, x = np.mgrid[0 : cam.height, 0 : cam.width].astype(float)
    there = np.stack([x, y, np.ones_like(x)], 2) @ H.T
    flow = there[..., :2] / there[..., 2:] - np.stack([x, y], 2)
    assert frame.forward.valid.all()
    np.testing.assert_allclose(frame.forward.flow, flow, atol=2e-12)


def test_velocity_is_the_limit_of_flow_with_order_one():
    world, t0 = mixed_scene(80, 60), 400 * MS
    hits = casting.cast(world, t0)
    velocity = casting.velocity(world, hits)
    steps = np.array([16 * MS, 8 * MS, 4 * MS, 2 * MS, MS])
    errors = [np.abs(casting.flow_to(world, hits, t0 + int(dt)).flow / (dt * 1e-9) - velocity).mean() for dt in steps]
    order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order == pytest.approx(1.0, abs=0.1)
    # symmetric difference: two orders further down, the twist agrees with the motion itself
    h = MS // 10
    middle = (casting.flow_to(world, hits, t0 + h).flow - casting.flow_to(world, hits, t0 - h).flow) / (2 * h * 1e-9)
    np.testing.assert_allclose(middle, velocity, atol=1e-5 * np.abs(velocity).max())


# ------------------------------------------------------------------------------------------------- the hierarchy


def soup(seed: int, n: int):
    """Triangles of all sizes, some doubled, some degenerate, some sharing vertices."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-2, 2, (n, 1, 3)) + rng.normal(size=(n, 3, 3)) * rng.choice([0.02, 0.2, 1.0], (n, 1, 1))
    corners[: n // 8] = corners[n // 8 : 2 * (n // 8)]
    corners[-5:, 2] = corners[-5:, 1]
    return mesh(corners.reshape(-1, 3), np.arange(3 * n).reshape(n, 3), name="soup")


def test_hierarchy_equals_exhaustive_search_bit_for_bit(monkeypatch):
    heap = soup(1, 600)
    world = scene(
        [
            *mixed_scene().objects,
            thing("soup", 11, heap, curve(8, (0, 5, 0), 0.5, 1.0)),
            thing("twin", 12, heap, curve(8, (0, 5, 0), 0.5, 1.0)),  # equal depths everywhere: the lower part wins
            thing("axis-aligned", 13, quad(0.4, 0.4, splits=7), still((0, 3, -1.5))),
        ],
        rig(64, 48, 60.0),
    )
    for t in (0, 510 * MS):
        fast = casting.cast(world, t)
        with monkeypatch.context() as patch:
            patch.setattr(casting, "nearest_tree", nearest_exhaustive)
            slow = casting.cast(world, t)
        for name in ("hit", "depth", "instance", "part", "triangle", "front", "bary", "local"):
            np.testing.assert_array_equal(getattr(fast, name), getattr(slow, name), err_msg=name)
        assert {3, 4, 11} <= set(np.unique(fast.instance)) and 12 not in fast.instance


def test_no_cracks_between_triangles():
    """Rays through the vertices and edges of a fine mesh, exactly: none slips through."""
    grid = quad(1.0, 1.0, splits=32)
    eye = Rig.alone(PinHole(65, 65, 64.0, 64.0, 32.0, 32.0), still())
    world = scene([thing("sheet", 1, grid, still((0, 0, 2.0)))], eye)  # one vertex exactly in every second pixel
    assert casting.cast(world, 0).hit[casting.pixel_grid(world.camera).max(1) < 64].all()
    ball = scene([thing("ball", 1, sphere(1.0, 3), still((0, 0, 3.0)))], eye)
    local = sphere(1.0, 3)
    corner = local.vertices[local.vertices[:, 2] < -0.5] + [0, 0, 3.0]
    xy = corner[:, :2] / corner[:, 2:] * 64.0 + 32.0
    assert casting.cast(ball, 0, xy).hit.all()


# ------------------------------------------------------------------------------------------------- extremes


def test_tiny_motion_keeps_its_relative_precision():
    """A drift of 1e-9 units: 4e-8 px, still right to 1e-9 of itself, where subtracting projections leaves 1e-6."""
    step = 1e-9
    path = drift((0, 0, 4.0), (step, 0, 4.0))
    eye = rig(path=still())
    frame = reference.render(scene([thing("plane", 1, quad(9, 9), path)], eye), 0, forward_ns=SECOND)
    np.testing.assert_allclose(frame.forward.flow[..., 0], eye.sensors[0].camera.fx * step / 4.0, rtol=1e-12)
    np.testing.assert_array_equal(frame.forward.flow[..., 1], 0.0)


def test_behind_the_camera_at_the_other_time():
    """The camera drives through a fence: what it has passed is invalid, not flung to a wrong finite place."""
    eye = drift((0, 0, 0), (0, 4.0, 0), LEVEL, LEVEL)
    fence = thing("fence", 1, quad(0.6, 0.6), still((0, 3.0, 0), FACING))
    wall = thing("wall", 2, quad(30, 30), still((0, 9.0, 0), FACING))
    world = scene([fence, wall], rig(path=eye))
    frame = reference.render(world, 0, forward_ns=SECOND)
    on_fence = frame.instance == 1
    assert on_fence.any() and (frame.instance[~on_fence] == 2).all()
    assert not frame.forward.valid[on_fence].any() and not frame.forward.occluded[on_fence].any()
    assert np.isnan(frame.forward.flow[on_fence]).all()
    assert frame.forward.valid[~on_fence].all()
    np.testing.assert_allclose(frame.forward.depth[on_fence], -1.0, atol=1e-12)
    # the wall comes from 9 to 5 units: positions about the principal point grow by 9/5
    y, x = np.mgrid[0 : world.camera.height, 0 : world.camera.width].astype(float)
    r = np.stack([x - world.camera.cx, y - world.camera.cy], 2)
    np.testing.assert_allclose(frame.forward.flow[~on_fence], (r * 0.8)[~on_fence], atol=1e-11)
    y, x = np.argwhere(on_fence)[0]
    assert "behind the camera" in reference.why(world, frame, "forward", x, y)


def test_in_front_of_the_near_plane_is_not_seen():
    world = scene([thing("wall", 2, quad(30, 30), still((0, 0, 1.0)))], rig(path=still(), near=1.5))
    assert not casting.cast(world, 0).hit.any()


# ------------------------------------------------------------------------------------------------- faces and looks


def test_back_faces():
    inside = rig(path=still(rotation=LEVEL))
    assert not casting.cast(scene([thing("box", 1, cube(3.0), still())], inside), 0).hit.any()
    lined = scene([thing("box", 1, cube(3.0), still(), Material(both_sides=True))], inside)
    frame = reference.render(lined, 0)
    assert frame.hit.all()
    rays = rays_of(lined.camera) @ LEVEL.as_matrix().T
    assert ((frame.normal * rays).sum(-1) < 0).all()  # turned towards the camera
    opened = scene([thing("sheet", 1, quad(9, 9), still((0, 0, 2.0)))], rig(path=still()))  # normal +z: its back
    frame = reference.render(opened, 0)
    assert frame.hit.all()
    np.testing.assert_allclose(frame.normal, np.broadcast_to([0.0, 0, -1], frame.normal.shape), atol=1e-12)


def test_light_and_luma():
    light = Light(sun_direction=(0.0, 0.6, 0.8), sun=0.7, sky=0.3)
    up = thing("ground", 1, quad(50, 50), still(), Material(base_color=(0.5, 0.25, 1.0)))
    over = rig(path=still((0, 0, 3), Rotation.from_euler("x", 180, degrees=True)))
    frame = reference.render(scene([up], over, light), 0)
    expected = np.array([0.5, 0.25, 1.0]) * (0.7 * 0.8 + 0.3)
    np.testing.assert_allclose(frame.colour, np.broadcast_to(expected, frame.colour.shape), rtol=1e-12)
    np.testing.assert_allclose(frame.luminance, expected @ [0.2126, 0.7152, 0.0722], rtol=1e-12)
    unlit = thing("ground", 1, quad(50, 50), still(), Material(base_color=(0.5, 0.25, 1.0), unlit=True))
    np.testing.assert_allclose(reference.render(scene([unlit], over, light), 0).colour[5, 5], [0.5, 0.25, 1.0])
    nothing = scene([thing("far", 1, cube(), still((0, -9, 0)))], background=0.35)
    frame = reference.render(nothing, 0, forward_ns=SECOND)
    np.testing.assert_array_equal(frame.luminance, 0.35 * (appearance.LUMA.sum()))
    assert not frame.forward.valid.any() and not frame.forward.occluded.any() and np.isinf(frame.depth).all()


def test_texture_is_upright_decoded_and_repeats():
    """A quad that fills the image texel by pixel: the picture itself, row 0 at the top, sRGB decoded."""
    rng = np.random.default_rng(5)
    image = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
    eye = Rig.alone(
        PinHole(16, 12, 20.0, 20.0, 7.5, 5.5), still((0, 0, 2.0), Rotation.from_euler("x", 180, degrees=True))
    )
    sheet = quad(0.8, 0.6)  # 16 x 12 px at distance 2
    paint = Material(texture=Texture(image), unlit=True)
    frame = reference.render(scene([thing("picture", 1, sheet, still(), paint)], eye), 0)
    linear = linear_from_srgb(image / 255.0)
    np.testing.assert_allclose(frame.colour, linear, atol=1e-6)  # uv are float32
    assert linear_from_srgb(np.array([0.0, 1.0, 0.5])) == pytest.approx([0, 1, 0.21404114], abs=1e-8)

    texture = Texture(linear.astype(np.float32))
    middle = appearance.sample_bilinear(texture, np.array([[1 / 16, 1 / 12]]))[0]  # where texels 0 and 1 meet
    np.testing.assert_allclose(middle, texture.image[:2, :2].astype(float).mean((0, 1)), rtol=1e-12)
    uv = rng.uniform(size=(50, 2))
    np.testing.assert_allclose(
        appearance.sample_bilinear(texture, uv), appearance.sample_bilinear(texture, uv + [3.0, -2.0]), atol=1e-12
    )
    corner = appearance.sample_bilinear(texture, np.array([[0.0, 0.0]]))[0]  # wraps round to the last row and column
    np.testing.assert_allclose(corner, texture.image[np.ix_([0, -1], [0, -1])].astype(float).mean((0, 1)), rtol=1e-12)


# ------------------------------------------------------------------------------------------------- occlusion


def test_occluded_by_a_moving_card_and_by_the_image_border():
    """A card slides over a wall: occluded exactly under its new projection or outside the image."""
    card = thing("card", 2, quad(0.5, 0.5), drift((-0.8, 0.1, 2.0), (0.4, 0.1, 2.0)))
    wall = thing("wall", 1, quad(40, 40), drift((0, 0, 4.0), (1.0, 0, 4.0)))
    world = scene([wall, card], rig(path=still()))
    cam = world.camera
    frame = reference.render(world, 0, forward_ns=SECOND)
    y, x = np.mgrid[0 : cam.height, 0 : cam.width].astype(float)
    on_wall = frame.instance == 1
    new_x = x + cam.fx * 1.0 / 4.0
    assert np.abs(frame.forward.flow[on_wall] - [cam.fx / 4.0, 0.0]).max() < 1e-12
    left, right = (cam.cx + cam.fx * (0.4 + s * 0.5) / 2.0 for s in (-1, 1))
    top, bottom = (cam.cy + cam.fy * (0.1 + s * 0.5) / 2.0 for s in (-1, 1))
    under = (new_x > left) & (new_x < right) & (y > top) & (y < bottom)
    outside = new_x >= cam.width - 0.5
    assert (under & on_wall).any() and (outside & on_wall).any()
    np.testing.assert_array_equal(frame.forward.occluded[on_wall], (under | outside)[on_wall])
    np.testing.assert_array_equal(frame.forward.outside[on_wall], outside[on_wall])
    assert not frame.forward.occluded[~on_wall].any()
    px, py = np.argwhere(under & on_wall)[0][::-1]
    assert reference.why(world, frame, "forward", px, py).startswith("hidden at t' by card")
    px, py = np.argwhere(outside & on_wall & ~under)[0][::-1]
    assert "outside the image" in reference.why(world, frame, "forward", px, py)


# ------------------------------------------------------------------------------------------------- helpers


def test_silhouette_band():
    world = scene(
        [
            thing("ground", 1, quad(500, 500), still((0, 0, -1.0))),
            thing("step", 2, quad(0.3, 0.3), still((0.0, 3.0, 0.2), FACING)),
        ]
    )
    frame = reference.render(world, 0)
    band = reference.silhouette_band(frame.instance, frame.depth)
    edge = np.zeros_like(band)
    ids = np.pad(frame.instance, 1, mode="edge")
    for dy in (0, 1, 2):
        for dx in (0, 1, 2):
            edge |= ids[dy : dy + band.shape[0], dx : dx + band.shape[1]] != frame.instance
    np.testing.assert_array_equal(band, edge)  # the steep ground makes no band of its own
    wide = reference.silhouette_band(frame.instance, frame.depth, width=3)
    assert (wide & band == band).all() and band.sum() * 2 < wide.sum() < band.sum() * 4
    # the same id on both sides: the jump in depth gives it away
    same = np.where(frame.instance > 0, 1, 0)
    jump = reference.silhouette_band(same, frame.depth)
    card = frame.instance == 2
    assert jump[card & band].mean() > 0.95 and not jump[card & ~band].any()
