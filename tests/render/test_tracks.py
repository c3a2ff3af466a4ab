"""Tracks: equal to flow labels and masks at their times, seen or not by another route, on shapes that change, too."""

import numpy as np
import pytest

from blinkgl import Camera, ConfigError, Deform, Keyframes, Material, Pose, Primitive, Scene, look_at, record
from blinkgl.config.over_time import TracksConfig
from blinkgl.front.runs import configured
from blinkgl.render import casting
from blinkgl.render.tracks import track_points

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
    with pytest.raises(ConfigError, match="not point tracks"):
        record(empty, tracks=7)
    assert configured(empty, tracks="surface").sequence(0).tracks.choose == "surface"
