"""Tracks: equal to flow labels and masks at their times, seen or not by another route, on shapes that change, too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl import Camera, ConfigError, Deform, Keyframes, Material, Pose, Primitive, Scene, look_at, record
from blinkgl.camera import Radtan
from blinkgl.config.deform import BreatheConfig
from blinkgl.config.over_time import TracksConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.front.runs import configured
from blinkgl.labels import LABELS, LabelRequest
from blinkgl.render import casting
from blinkgl.render.renderer import Renderer
from blinkgl.render.tracks import track_points
from blinkgl.scene.rig import Rig
from blinkgl.scene.shapes.table import deformer_of
from blinkgl.tools.shader_debugger import reference
from render_scenes import FACING, LEVEL, cube, drift, quad, rig, scene, sphere, still, thing

RNG = np.random.default_rng


def living() -> Scene:
    """A figure that walks, a flag, a box that turns and passes before them, a wall, and a camera that moves."""
    way = Keyframes({0.0: look_at((-3, -0.3, 0.1), (0, 0, 0)), 0.2: look_at((-2.9, 0.3, 0.2), (0, 0, 0))})
    scene = Scene(Camera(96, 64, fov=60, pose=way), duration=0.1, label_rate=20)
    scene += Primitive("cuboid", extents=(0.1, 9, 9), pose=(2, 0, 0), category="wall")
    scene += Primitive("figure", clip="run", height=1.2, tempo=2, pose=(0.3, -0.6, -0.6))
    scene += Primitive(
        "grid", width=0.8, depth=0.8, deform=Deform("wave", period=0.1), pose=Pose((0, 0.5, 0.3), euler=(0, 90, 0))
    )
    turns = Keyframes({0.0: Pose((-0.8, -0.6, -0.1)), 0.2: Pose((-0.8, 0.6, 0.1), euler=(0, 0, 30))})
    scene += Primitive("cuboid", extents=(0.2, 0.4, 0.5), pose=turns, material=Material(color=(0.7, 0.2, 0.1)))
    return scene


@pytest.fixture(scope="module")
def made():
    """(scene as it is drawn, its label times, what was drawn)"""
    source = living()
    drawn = record(source, labels=["forward", "backward", "occlusion", "ids", "depth"], tracks={"points": 96 * 64})
    config = drawn.config
    return source.build(config), list(config.time.label_times_ns), drawn


def test_of_every_pixel_they_are_the_labels(made):
    _, _, drawn = made
    tracks = drawn.tracks
    y, x = tracks.query_points[:, 1:].astype(int).T
    assert len(x) > 6000 and (tracks.query_points[:, 0] == 0).all() and len(np.unique(tracks.instance)) == 4
    label = drawn.labels[0]
    assert np.abs(tracks.target_points[:, 0] - np.column_stack([x, y])).max() < 1e-9 and not tracks.occluded[:, 0].any()
    assert np.mean(label.ids[y, x] == tracks.instance) > 0.995, "silhouettes may fall on either side"
    same = (label.ids[y, x] == tracks.instance) & (np.abs(label.depth[y, x] / tracks.depth[:, 0] - 1) < 1e-5)
    assert same.mean() > 0.99
    moved = tracks.target_points[:, 1] - tracks.target_points[:, 0]
    assert np.abs(moved - label.forward.flow[y, x])[same].max() < 1e-4
    assert np.linalg.norm(moved, axis=1).max() > 3
    hidden = label.forward.occluded[y, x]
    assert (hidden != tracks.occluded[:, 1])[same].sum() <= 2 and hidden[same].sum() > 100


@pytest.mark.parametrize("choose", ["grid", "surface"])
def test_seen_is_what_a_ray_through_their_place_meets(made, choose):
    scene, times, _ = made
    moments = range(times[0], times[-1] + 1, 12_500_000)
    tracks = track_points(scene, TracksConfig(points=2000, choose=choose), moments, RNG(3))
    assert len(tracks.query_points) > 1500 and len(tracks.t_us) == 9
    looked = 0
    for k, t_ns in enumerate(moments):
        inside = (tracks.depth[:, k] > scene.camera.near) & (
            (tracks.target_points[:, k] >= -0.5) & (tracks.target_points[:, k] < [95.5, 63.5])
        ).all(axis=1)
        xy, seen = tracks.target_points[inside, k], ~tracks.occluded[inside, k]
        hits = casting.cast(scene, t_ns, xy)
        own = (hits.part == tracks.surface[inside, 0]) & (np.abs(hits.depth / tracks.depth[inside, k] - 1) < 1e-7)
        assert not tracks.occluded[~inside, k].size or tracks.occluded[~inside, k].all()
        for i in np.flatnonzero(seen != own):  # then an edge is within a hundredth of a pixel
            around = casting.cast(scene, t_ns, xy[i] + 0.01 * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)]))
            triangles = {(int(p), int(f)) for p, f in zip(around.part, around.triangle)}
            assert len(triangles) > 1
        looked += len(seen)
    assert looked > 10_000


def test_queries_are_where_their_points_are_seen(made):
    scene, times, _ = made
    for choose in ("grid", "surface"):
        tracks = track_points(scene, TracksConfig(points=300, choose=choose), times, RNG(1))
        k, rows = tracks.query_points[:, 0].astype(int), np.arange(len(tracks.query_points))
        assert not tracks.occluded[rows, k].any() and len(rows) <= 300
        assert (len(set(k)) > 1) == (choose == "surface"), "seen first at different times"
        assert np.abs(tracks.target_points[rows, k] - tracks.query_points[:, :0:-1]).max() < 1e-6
    again = track_points(scene, TracksConfig(points=300, choose="surface"), times, RNG(1))
    assert np.array_equal(again.target_points, tracks.target_points)


def test_nothing_to_follow_and_too_much_of_it():
    empty = Scene(Camera(16, 12), duration=0.05, label_rate=20)
    empty += Primitive("sphere", radius=0.1, pose=(-50, 0, 0))
    for choose in ("grid", "surface"):
        tracks = record(empty, labels=[], tracks=choose).tracks
        assert tracks.target_points.shape == (0, 2, 2) and tracks.t_us.tolist() == [50_000, 100_000]
    with pytest.raises(ConfigError, match="positions"):
        record(empty, tracks={"points": 1_000_000, "rate": 10_000})
    with pytest.raises(ConfigError, match="tracks: not a name or a table"):
        record(empty, tracks=7)
    assert configured(empty, tracks="surface").sequence(0).tracks.choose == "surface"


# --- How far surfaces move in space, drawn, against poses and shapes put together by hand.

MS = 1_000_000
T0, T1 = 300 * MS, 420 * MS
REQUEST = LabelRequest("scene_flow", "depth", "ids", "flow_forward")
SPIN = Rotation.from_rotvec([0.4, -0.9, 0.6])
EYE = drift((0, 0, 0), (0.4, 0.2, -0.3), LEVEL, LEVEL * Rotation.from_rotvec([0.05, -0.1, 0.1]))


def world(camera=None):
    """A cube that tumbles, a ball that breathes and flies, a wall that stands; the camera moves."""
    ball = sphere(0.6, 3)
    breath = deformer_of(
        BreatheConfig(amount=(0.3, 0.2, -0.2), period=0.5), ball.vertices.min(axis=0), ball.vertices.max(axis=0)
    )
    things = (
        thing("cube", 2, cube(0.5), drift((-0.9, 4, 0.1), (-0.3, 4.6, 0.4), Rotation.identity(), SPIN)),
        thing("ball", 3, replace(ball, deformer=breath), drift((0.8, 4, 0), (0.7, 3.5, 0.2), SPIN, SPIN * SPIN)),
        thing("wall", 1, quad(9, 9), still((0, 9, 0), FACING)),
    )
    return scene(things, rig(path=EYE) if camera is None else Rig.alone(camera, EYE))


def shape_change(what, t0, t1):
    """(3, 4): what takes a point of the ball at t0 to its place at t1, object axes: breathing is linear, so it is found
    from where its vertices go."""
    mesh = what.objects[1].parts[0].mesh
    then, now = (mesh.deformer.positions(mesh, t) for t in (t0, t1))
    solved, *_ = np.linalg.lstsq(np.c_[then, np.ones(len(then))], now, rcond=None)
    assert np.abs(np.c_[then, np.ones(len(then))] @ solved - now).max() < 1e-12 and np.abs(now - then).max() > 0.02
    return solved.T


def by_hand(what, frame, t0, t1):
    """(H, W, 3) and (H, W, 3): the motion of what is seen, from its depth, and where it is then in the camera's axes at
    t1."""
    camera, out = what.camera, np.zeros((*frame.ids.shape, 3))
    c0, c1 = what.camera_path.pose(t0), what.camera_path.pose(t1)
    depth = np.where(np.isfinite(frame.depth), frame.depth, 0).astype(np.float64)
    y, x = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(np.stack([x.ravel(), y.ravel()], 1).astype(np.float64)).reshape(*frame.ids.shape, 3)
    seen = rays / rays[..., 2:] * depth[..., None]
    at = seen @ c0[:3, :3].T + c0[:3, 3]
    there = at.copy()
    for number, shape in ((2, np.eye(3, 4)), (3, shape_change(what, t0, t1))):
        path, on = what.objects[number - 2].path, frame.ids == number
        b0, b1 = path.pose(t0), path.pose(t1)
        local = (at[on] - b0[:3, 3]) @ b0[:3, :3]
        there[on] = (local @ shape[:, :3].T + shape[:, 3]) @ b1[:3, :3].T + b1[:3, 3]
    out[...] = (there - at) @ c0[:3, :3]
    return out, (there - c1[:3, 3]) @ c1[:3, :3]


@pytest.mark.parametrize("lens", [False, True])
@pytest.mark.parametrize("t1", [T1, T0 - 90 * MS])
def test_motion_in_space_is_that_of_poses_and_shapes(gl, lens, t1):
    """Rigid and breathing bodies, forward and back, through a lens, too. A wall has exactly 0 while the camera
    moves."""
    camera = Radtan(160, 120, 150.0, 152.0, 78.0, 61.0, 0.05, -0.2, 0.05, 1e-3) if lens else None
    what = world(camera)
    with Renderer(gl, what, RenderConfig(image_antialiasing="none")) as renderer:
        frame = renderer.labels(T0, REQUEST, t1)
    true, there = by_hand(what, frame, T0, t1)
    for number in (2, 3):
        on = frame.ids == number
        assert on.sum() > 500 and np.linalg.norm(true[on], axis=1).min() > 0.01
        np.testing.assert_allclose(frame.scene_flow[on], true[on], atol=3e-6)
    assert (frame.ids == 1).sum() > 3000 and not frame.scene_flow[frame.ids == 1].any()
    # and it is the other half of the flow: depth, flow and it say one thing of the other time
    valid = frame.forward.valid & (there[..., 2] > 0)
    y, x = np.nonzero(valid)
    found = what.camera.project(there[valid])
    np.testing.assert_allclose(np.stack([x, y], 1) + frame.forward.flow[valid], found, atol=2e-3)


def test_the_reference_says_the_same(gl):
    what = world()
    with Renderer(gl, what, RenderConfig(image_antialiasing="none")) as renderer:
        frame = renderer.labels(T0, REQUEST, T1)
    ref = reference.render(what, T0, forward_ns=T1)
    off = ref.hit & ~reference.silhouette_band(ref.instance, ref.depth)
    row = LABELS["scene_flow"]
    np.testing.assert_allclose(frame.scene_flow[off], row.reference(what, ref)[off], atol=3e-6)
