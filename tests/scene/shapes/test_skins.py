"""Skeletons, clips and skins in float64: rates are those of the positions, and what cannot be drawn is refused in
one line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp
from skinned import Swinging, arm

from blinkgl.errors import AssetError
from blinkgl.scene.geometry.meshes import transform_mesh
from blinkgl.scene.motion.paths import AffinePath
from blinkgl.scene.shapes.clips import Clip, Playing, Track
from blinkgl.scene.shapes.skeleton import Locals, Skeleton, Still
from blinkgl.scene.shapes.skin import Morphs, Skin, joined
from blinkgl.scene.shapes.sweep import sweep
from tests.refusals import refusal

MS = 1_000_000
RNG = np.random.default_rng(5)


def keyed(kind="LINEAR", playing=None, joints=3):
    """Random key frames on all properties of some joints in a chain."""
    times = np.array([0.0, 0.2, 0.5, 0.6, 1.0])
    per_key = 3 if kind == "CUBICSPLINE" else 1
    tracks = []
    for joint in range(joints):
        for path, n in (("translation", 3), ("rotation", 4), ("scale", 3)):
            values = RNG.normal(size=(len(times), per_key, n)) * 0.4 + (
                np.eye(4)[3] if n == 4 else 0.0 if path == "translation" else 1.0
            )
            values[-1] = values[0]
            if n == 4:
                values[:, per_key // 2] /= np.linalg.norm(values[:, per_key // 2], axis=1, keepdims=True)
            tracks.append(Track(joint, path, times, values if per_key == 3 else values[:, 0], kind))
    return tracks, Clip(Locals.rest(joints), tracks, playing or Playing(0, 1))


@pytest.mark.parametrize("kind", ["LINEAR", "CUBICSPLINE"])
@pytest.mark.parametrize("playing", [Playing(0, 1), Playing(0, 1, -1.7, 0.3), Playing(0, 1, 0.5, 0.1, loop=False)])
def test_rates_of_joints_are_those_of_their_places(kind, playing):
    _, clip = keyed(kind, playing)
    skeleton, h = Skeleton([-1, 0, 1], clip), 1000
    for t in (50 * MS, 333 * MS, 10**15 + 55 * MS) if playing.loop else (50 * MS, 333 * MS):
        _, rate = skeleton.at(t)
        before, after = (skeleton.at(t + dt)[0] for dt in (-h, h))
        np.testing.assert_allclose(rate, (after - before) / (2e-9 * h), atol=2e-7)
        assert np.abs(rate).max() > 0.1


def test_values_between_keys_are_the_specifications():
    tracks, clip = keyed("LINEAR")
    for t in (0.1, 0.55, 0.9):
        got = clip.locals(round(t * 1e9))
        turns = Slerp(tracks[1].times, Rotation.from_quat(tracks[1].values))(t).as_matrix()
        np.testing.assert_allclose(Rotation.from_quat(got.rotation[0]).as_matrix(), turns, atol=1e-12)
        np.testing.assert_allclose(
            got.translation[0], [np.interp(t, tracks[0].times, tracks[0].values[:, k]) for k in range(3)], atol=1e-14
        )
    tracks, clip = keyed("CUBICSPLINE")
    values = tracks[0].values
    for t in (0.1, 0.55, 0.9):
        i = np.searchsorted(tracks[0].times, t) - 1
        ends = slice(i, i + 2)
        curve = CubicHermiteSpline(tracks[0].times[ends], values[ends, 1], [values[i, 2], values[i + 1, 0]])
        np.testing.assert_allclose(clip.locals(round(t * 1e9)).translation[0], curve(t), atol=1e-12)
        np.testing.assert_allclose(tracks[0].at(t)[1], curve(t, 1), atol=1e-11)
    stepped, clip = keyed("STEP")
    np.testing.assert_array_equal(clip.locals(199 * MS).translation[0], stepped[0].values[0])
    np.testing.assert_array_equal(clip.locals(200 * MS).translation[0], stepped[0].values[1])
    assert not clip.locals(300 * MS).d_translation.any()


@pytest.mark.parametrize("kind", ["LINEAR", "STEP", "CUBICSPLINE"])
@pytest.mark.parametrize("seam", [False, True])
@pytest.mark.parametrize(
    "playing", [Playing(0, 1), Playing(0, 1.3, -1.7, 0.37), Playing(-0.1, 1, 2.3, 0.25), Playing(0, 1, 0.5, 0.1, False)]
)
def test_all_jumps_of_a_clip_are_known_to_the_nanosecond(kind, seam, playing):
    """Neighbouring times at which the clip is farther apart than its speed says have a jump between
    them, and no others have."""
    tracks, _ = keyed(kind, joints=1)
    if seam:
        tracks[0].values[-1] += 1.0
    clip = Clip(Locals.rest(1), tracks[:1], playing)
    end, at = 2_500 * MS, lambda t: clip.locals(int(t)).translation[0].copy()
    jumps = np.array(clip.jumps(0, end), np.int64)
    assert all(np.abs(at(t + 1) - at(t)).max() > 1e-6 for t in jumps.tolist())
    times = np.linspace(0, end, 20_001).astype(np.int64) + 37  # never at a jump
    places = np.array([at(t) for t in times])
    fast = np.abs(np.diff(places, axis=0)).max(axis=1) > 0.02
    inside = np.searchsorted(jumps, times[1:]) > np.searchsorted(jumps, times[:-1])
    assert (fast == inside).all() and (len(jumps) > 0) == (kind == "STEP" or (seam and playing.loop))


def test_a_clip_that_jumps_at_all_times_has_no_times_of_its_own():
    track = Track(0, "translation", np.array([0, 1e-6]), np.eye(3)[:2], "STEP")
    clip = Clip(Locals.rest(1), [track], Playing(0, 2e-6))
    assert clip.jumps(0, MS) == list(range(999, MS, 1000)) and clip.jumps(0, 500 * MS) == []


def test_clips_loop_hold_and_run_backwards():
    assert Playing(2, 5).at(0) == (2, 1) and Playing(2, 5).at(4 * 10**9)[0] == 3
    assert Playing(2, 5, -1).at(10**9) == (4, -1)
    assert Playing(2, 5, loop=False).at(9 * 10**9) == (5, 0.0)
    assert Playing(2, 5, loop=False, phase=1).at(0) == (3, 1)
    assert Playing(2, 2).is_static and Playing(2, 5, 0).is_static


def test_a_skin_moves_as_its_rate_says():
    mesh = arm()
    for t in (0, 137 * MS, 812_345_678):
        before, after = (mesh.deformer.positions(mesh, t + dt) for dt in (-1000, 1000))
        np.testing.assert_allclose(mesh.deformer.velocity(mesh, t), (after - before) / 2e-6, atol=1e-7)
    swept = sweep(mesh, 0, 10**9)
    low, high = swept.low, swept.high
    for t in np.linspace(0, 10**9, 200).astype(np.int64):
        at = mesh.deformer.positions(mesh, int(t))
        assert (at >= low).all() and (at <= high).all()


def test_a_skin_of_a_transformed_mesh_is_the_transformed_shape():
    mesh, matrix = arm(), np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec([0.3, -1, 0.5]).as_matrix() * 1.7
    matrix[:3, 3] = [1, 2, 3]
    moved = transform_mesh(mesh, matrix)
    for t in (0, 300 * MS):
        true = mesh.deformer.positions(mesh, t) @ matrix[:3, :3].T + matrix[:3, 3]
        np.testing.assert_allclose(moved.deformer.positions(moved, t), true, atol=1e-12)
        n, m = mesh.deformer.normals(mesh, t) @ matrix[:3, :3].T, moved.deformer.normals(moved, t)
        np.testing.assert_allclose(
            m / np.linalg.norm(m, axis=1)[:, None], n / np.linalg.norm(n, axis=1)[:, None], atol=1e-6
        )


def test_morph_targets_are_added_and_follow_the_joints():
    mesh = arm()
    skin, V = mesh.deformer, len(mesh.vertices)
    deltas = RNG.normal(size=(2, V, 3)) * 0.1
    weights = lambda t: (np.array([np.sin(t * 1e-9), 0.5]), np.array([np.cos(t * 1e-9), 0.0]))
    both = Skin(skin.skeleton, skin.bones, skin.inverse_bind, skin.joints, skin.weights, Morphs(deltas, None, weights))
    t = 400 * MS
    pulled = replace(mesh, vertices=mesh.vertices + np.tensordot(weights(t)[0], deltas, 1))
    np.testing.assert_allclose(both.positions(mesh, t), skin.positions(pulled, t), atol=1e-12)
    before, after = (both.positions(mesh, t + dt) for dt in (-1000, 1000))
    np.testing.assert_allclose(both.velocity(mesh, t), (after - before) / 2e-6, atol=1e-6)
    alone = Skin.morphing(Morphs(deltas, None, weights))
    np.testing.assert_allclose(alone.positions(mesh, t), pulled.vertices, atol=1e-15)


def test_skins_of_one_skeleton_can_be_one():
    one = arm()
    other = replace(one, vertices=one.vertices * 0.9, deformer=Skin.rigid(one.deformer.skeleton, 1, len(one.vertices)))
    both = joined([one.deformer, other.deformer, one.deformer])
    mesh = replace(one, vertices=np.vstack([one.vertices, other.vertices, one.vertices]))
    parts = [m.deformer.positions(m, 300 * MS) for m in (one, other, one)]
    np.testing.assert_allclose(both.positions(mesh, 300 * MS), np.vstack(parts), atol=1e-15)
    assert len(both.bones) == 3
    assert joined([one.deformer, arm().deformer]) is None  # another skeleton


BIND = np.tile(np.eye(4), (2, 1, 1))
NAN = np.where(np.arange(2)[:, None, None] == 1, np.nan, BIND)


@pytest.mark.parametrize(
    "said, make",
    [
        ("joint 1 of a skin is not finite", lambda: skin_of(inverse_bind=NAN)),
        ("joint 0 of a skin is singular", lambda: skin_of(inverse_bind=BIND * 0)),
        ("the weights of vertex 1 of a skin sum to zero", lambda: skin_of(weights=[[1, 0], [0, 0]])),
        ("vertex 0 of a skin has a weight that is negative or no number", lambda: skin_of(weights=[[-1, 2], [1, 0]])),
        ("vertex 0 of a skin has a weight that is negative or no number", lambda: skin_of(weights=[[np.nan, 1], [1,
        0]])), ("vertex 1 of a skin follows a joint that does not exist", lambda: skin_of(joints=[[0, 1], [2, 0]])),
        ("too many joints and morph targets", lambda: Skin(Skeleton([-1], Still(Locals.rest(1))), [0] * 400,
        np.tile(np.eye(4), (400, 1, 1)), [[0]], [[1]])),
    ],
)  # fmt: skip
def test_what_cannot_be_drawn_is_refused(said, make):
    assert refusal(AssetError, make, match=said).startswith(("somebody.glb", "skeleton", "skin"))


def skin_of(bones=(0, 1), inverse_bind=BIND, joints=((0, 1), (0, 1)), weights=((0.5, 0.5), (1, 0))):
    return Skin(Skeleton([-1, 0], Swinging()), bones, inverse_bind, joints, weights, where="somebody.glb")


@pytest.mark.parametrize("speed", [1.0, -2.0, 0.5])
@pytest.mark.parametrize("phase", [-5.0, 0.0, 0.25, 1.0, 7.0])
def test_a_clip_that_plays_once_moves_until_the_end_of_its_span(phase, speed):
    """Also one that begins late, and one that is over at 0; its path's bound of speed sees it from any time on."""
    playing = Playing(0.0, 1.0, speed, phase, loop=False)

    def motion(t_ns):
        place, rate = playing.at(t_ns)
        matrix, change = np.eye(4), np.zeros((4, 4))
        matrix[0, 3], change[0, 3] = 3 * place, 3 * rate
        return matrix, change

    end = 10**10
    path = AffinePath(motion, 0, end, np.eye(4), playing.span_ns, 10**8)
    times = np.arange(0, end, 10**7)
    moves = [t for t in times if playing.at(int(t))[1] != 0]
    assert max(moves, default=0) <= playing.span_ns
    for first in (0, 3 * 10**9, 5_400_000_000):
        fastest = max((np.linalg.norm(path.derivative(int(t))[:3, 3]) for t in times if t >= first), default=0)
        assert path.speed_bound(first, end)[0] >= fastest
