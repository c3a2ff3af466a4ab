"""Speeds of surfaces without a picture: against the velocities that the label pass draws, and bounds between looks
against dense looks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from blinkgl.camera import Equidistant, Radtan
from blinkgl.config.sequence import RenderConfig
from blinkgl.labels import LabelRequest
from blinkgl.render.renderer import Renderer
from blinkgl.scene.motion.paths import CutPath, KeyframePath, OffsetPath, PausedPath, StaticPath
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Deformer
from render_scenes import (
    FACING,
    LEVEL,
    SECOND,
    cube,
    curve,
    drift,
    largest_speed,
    mixed_scene,
    quad,
    rig,
    scene,
    still,
    thing,
)
from tests.skinned import arm

MS = 1_000_000
PLAIN = RenderConfig(image_antialiasing="none")


def seen(world, t_ns, gl, share=99.0):
    """(largest and percentile of the look, the same of all drawn pixels that move)."""
    with Renderer(gl, world, PLAIN) as renderer:
        look = renderer.motion.look(t_ns)
        velocity = renderer.labels(t_ns, LabelRequest("velocity")).velocity
    moving = np.linalg.norm(velocity, axis=-1)
    moving = moving[moving > 0]
    return (look.largest, look.percentile(share)), (moving.max(), np.percentile(moving, share))


@pytest.mark.parametrize("camera_moves", [True, False])
@pytest.mark.parametrize("t_ns", [100 * MS, 550 * MS, 900 * MS])
def test_speeds_are_those_of_the_drawn_velocities(gl, camera_moves, t_ns):
    """Hidden surfaces count, so a look may be faster; not slower, but for pixels' distance from corners."""
    mine, drawn = seen(mixed_scene(camera_moves=camera_moves), t_ns, gl)
    assert 0.98 * drawn[0] < mine[0] < 1.6 * drawn[0]
    assert 0.7 * drawn[1] < mine[1] < 1.6 * drawn[1]


def test_a_wall_through_the_edges_of_the_view_is_cut_there(gl):
    """A plane of two triangles, a hundred times as large as the picture: the fastest point in view is in a corner."""
    world = scene([thing("wall", 1, quad(300, 300), still((0, 4, 0), FACING))],
                  rig(path=curve(3, (0, 0, 0), 0.3, 0.2, LEVEL)))  # fmt: skip
    mine, drawn = seen(world, SECOND // 3, gl)
    assert mine[0] == pytest.approx(drawn[0], rel=0.02)


@pytest.mark.parametrize("lens", [(Radtan, (-0.25, 0.06, 0.001, -0.001, 0)), (Equidistant, (-0.02, 0.01, 0, 0))])
def test_speeds_in_the_pixels_of_a_lens(gl, lens):
    kind, distortion = lens
    camera = kind(160, 120, 110.0, 112.0, 78.0, 61.0, 0.05, *distortion)
    world = scene(
        [thing("box", 1, cube(3.0), still((0, 8, 0))), thing("wall", 2, quad(40, 40), still((0, 12, 0), FACING))],
        Rig.alone(camera, curve(5, (0, 0, 0), 0.3, 0.2, LEVEL)),
    )
    mine, drawn = seen(world, SECOND // 2, gl)
    assert mine[0] == pytest.approx(drawn[0], rel=0.08)


def test_of_a_large_mesh_some_faces_speak_for_all(gl):
    """160,000 faces: the look takes at most MOST of them, and a part that is wholly in view FEW."""
    wall = thing("wall", 1, quad(2, 2, 283), drift((0, 6, 0), (0.5, 6.5, 0.2), FACING))
    mine, drawn = seen(scene([wall]), SECOND // 2, gl)
    assert mine[0] == pytest.approx(drawn[0], rel=0.03)
    assert mine[1] == pytest.approx(drawn[1], rel=0.05)


def test_a_deforming_body_moves_as_its_label_says(gl):
    world = scene([thing("arm", 1, arm(), still((0, 4, -1)))])
    mine, drawn = seen(world, SECOND // 7, gl)
    assert mine[0] == pytest.approx(drawn[0], rel=0.1)


# --- what the ends of an interval do not show


def velocities(path, ta, tb, count=400):
    times = np.linspace(ta, tb, count).astype(np.int64)
    D = np.array([path.derivative(int(t)) for t in times])
    T = path.poses(times)
    W = np.einsum("tji,tjk->tik", T[:, :3, :3], D[:, :3, :3])
    return D[:, :3, 3], np.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], axis=1)


def off_segment(points):
    a, b = points[0], points[-1]
    length = ((b - a) ** 2).sum()
    s = np.clip((points - a) @ (b - a) / length, 0, 1) if length else np.zeros(len(points))
    return np.linalg.norm(points - a - s[:, None] * (b - a), axis=1).max()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 999), st.floats(0, 0.9), st.floats(0.002, 0.3), st.integers(2, 24))
def test_velocities_stay_as_near_to_their_ends_as_a_path_says(seed, start, span, keys):
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(0.4 * rng.uniform(-1, 1, (keys, 3)))
    path = KeyframePath(np.linspace(0, SECOND, keys).astype(np.int64), rng.normal(0, 1, (keys, 3)), turns)
    ta, tb = int(start * SECOND), min(int((start + span) * SECOND), SECOND)
    linear, angular = path.unseen(ta, tb)
    v, w = velocities(path, ta, tb)
    assert off_segment(v) <= linear * (1 + 1e-9) + 1e-9
    # phi' is the angular velocity but for terms of second order in the angle.
    assert off_segment(w) <= angular + 0.1 * np.linalg.norm(w, axis=1).max() + 1e-9
    arm_path = OffsetPath(path, [[1, 0, 0, 0.3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    assert off_segment(velocities(arm_path, ta, tb)[0]) <= sum(arm_path.unseen(ta, tb)) + 0.1 * np.abs(w).max() + 1e-9


def test_what_a_cut_and_a_pause_leave_out_is_bounded():
    path = KeyframePath([0, SECOND], [[0, 0, 0], [3, 0, 0]], Rotation.identity(2))
    cut = CutPath(path, SECOND // 2)
    assert cut.unseen(0, SECOND // 4) == (0.0, 0.0) == cut.unseen(6 * SECOND // 10, SECOND)
    assert cut.unseen(SECOND // 4, 3 * SECOND // 4)[0] >= 3.0
    paused = PausedPath(path, SECOND // 2, 100 * MS, 50 * MS)
    assert paused.unseen(0, SECOND // 4) == (0.0, 0.0)
    assert paused.unseen(450 * MS, 750 * MS)[0] >= 3.0
    assert StaticPath().unseen(0, SECOND) == (0.0, 0.0)


@pytest.mark.parametrize("seed", range(6))
def test_nothing_between_two_looks_is_faster_than_they_show_unless_they_say_so(gl, seed):
    """Random worlds, intervals of 0.2 to 100 ms: where ``hides`` says no, 40 looks inside are within the tolerance."""
    rng = np.random.default_rng(seed)
    times = np.linspace(0, SECOND, 60).astype(np.int64)

    def shaking(centre, base=None):
        turns = (base or Rotation.identity()) * Rotation.from_rotvec(0.05 * rng.normal(0, 1, (60, 3)))
        return KeyframePath(times, np.asarray(centre) + 0.02 * rng.normal(0, 1, (60, 3)), turns)

    world = scene(
        [
            thing("wall", 1, quad(6, 6), still((0, 7, 0), FACING)),
            thing("card", 2, quad(0.5, 0.5), shaking((0.4, 4, 0.2), FACING)),
            thing("outside", 3, cube(0.4), curve(seed, (2.6, 3, 0), 0.6, 0.5)),
        ],
        rig(path=shaking((0, 0, 0), LEVEL) if seed % 2 else None),
    )
    calm = 0
    with Renderer(gl, world, PLAIN) as renderer:
        motion = renderer.motion
        for _ in range(60):
            span = int(10 ** rng.uniform(5.3, 8))
            ta = int(rng.integers(0, SECOND - span))
            a, b = motion.look(ta), motion.look(ta + span)
            tolerance = 0.15 / (span * 1e-9)  # px/s: a tenth of a step of 1.5 px
            if not motion.hides(a, b, tolerance):
                calm += 1
                inside = max(motion.look(int(t)).largest for t in np.linspace(ta, ta + span, 42)[1:-1])
                assert inside <= max(a.largest, b.largest) + 1.5 * tolerance
            assert motion.fastest(ta, ta + span, 1.5)[0] >= max(a.largest, b.largest)
    assert calm > 5, "otherwise every step would be examined to the end"


def test_what_is_out_of_view_at_both_ends_may_come_in_between(gl):
    """A ball that crosses within 10 ms, and one that stays far outside."""
    crosses = drift((-30, 3, 0), (30, 3, 0), seconds=0.1)
    away = drift((-30, 3, 0), (-25, 3, 0), seconds=0.1)
    for path, hidden in ((crosses, True), (away, False)):
        world = replace(scene([thing("ball", 1, cube(0.2), path)]), t1_ns=100 * MS)
        with Renderer(gl, world, PLAIN) as renderer:
            motion = renderer.motion
            a, b = motion.look(30 * MS), motion.look(70 * MS)
            assert a.largest == b.largest == 0.0
            assert motion.hides(a, b, 10.0) is hidden
            assert (motion.fastest(30 * MS, 70 * MS, 1.0)[0] > 1e4) is hidden


class Trembling(Deformer):
    """A deformer that does not say how fast it changes."""

    glsl = "waves"
    rows = 5

    def positions(self, mesh, t_ns):
        return mesh.vertices

    def velocity(self, mesh, t_ns):
        return np.zeros_like(mesh.vertices)

    def normals(self, mesh, t_ns):
        return mesh.normals

    def numbers(self, t_ns):
        return np.zeros((5, 4))

    rates = numbers

    def changes(self, t_ns, there_ns):
        return np.zeros((5, 4))


def test_a_deformer_without_a_time_scale_is_examined_everywhere(gl):
    body = replace(quad(0.5, 0.5), deformer=Trembling())
    with Renderer(gl, scene([thing("jelly", 1, body, still((0, 4, 0), FACING))]), PLAIN) as renderer:
        motion = renderer.motion
        assert motion.unbounded == ["jelly"]
        assert motion.hides(motion.look(0), motion.look(1000), 1.0)


def test_velocity_pictures_of_the_preview_keep_their_pixels(gl):
    """They are drawn as before: for people, and where brightness decides the step."""
    with Renderer(gl, mixed_scene(), PLAIN) as renderer:
        drawn = renderer.velocity(SECOND // 3).read()
        label = renderer.labels(SECOND // 3, LabelRequest("velocity")).velocity
    np.testing.assert_allclose(drawn, label, rtol=1e-5, atol=1e-4 * largest_speed(label))
