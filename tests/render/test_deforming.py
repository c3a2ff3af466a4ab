"""Shapes that change with time, drawn, against the float64 reference, which moves the vertices and casts rays at
them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from skinned import arm

from blinkgl.config.deform import BendConfig, BreatheConfig, FlagConfig, TwistConfig, WaveConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.labels import LabelRequest
from blinkgl.render.renderer import Renderer
from blinkgl.scene.geometry.living import figure as figure_of
from blinkgl.scene.geometry.meshes import transform_mesh
from blinkgl.scene.shapes.skeleton import Locals, Skeleton
from blinkgl.scene.shapes.skin import Morphs, Skin
from blinkgl.scene.shapes.table import deformer_of
from blinkgl.scene.types import Material
from blinkgl.tools.shader_debugger import reference
from render_scenes import FACING, LEVEL, drift, length, quad, rates, rig, scene, smooth_texture, sphere, still, thing

MS = 1_000_000
T0, T1, T_BACK = 300 * MS, 400 * MS, 200 * MS
LABELS = LabelRequest(
    "depth", "ids", "normals", "velocity", "flow_forward", "flow_backward", "occlusion_forward", "occlusion_backward"
)
SPIN = Rotation.from_rotvec([0.1, -0.2, 0.3])
FORMS = {
    "wave": WaveConfig(),
    "flag": FlagConfig(along="x", towards="z"),
    "twist": TwistConfig(angle=120),
    "bend": BendConfig(),
    "breathe": BreatheConfig(amount=(0.3, 0.2, -0.2)),
}


def by_formula(mesh, kind):
    return replace(mesh, deformer=deformer_of(FORMS[kind], mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)))


def world(mesh, texture=None, moves=True, camera_moves=True):
    path = drift((0.2, 4, 0.1), (-0.1, 4.4, 0.3), Rotation.identity(), SPIN) if moves else still((0.2, 4, 0.1))
    eye = drift((0, 0, 0), (0.2, 0.1, -0.1), LEVEL, LEVEL * SPIN) if camera_moves else None
    wall = thing("wall", 1, quad(9, 9), still((0, 9, 0), FACING))
    return scene([thing("body", 3, mesh, path, Material(texture, (0.9, 0.5, 0.3))), wall], rig(path=eye))


def graded(gl, what, t=T0, forward=T1, backward=T_BACK):
    ref = reference.render(what, t, forward_ns=forward, backward_ns=backward)
    with Renderer(gl, what, RenderConfig(image_antialiasing="none")) as renderer:
        labels = renderer.labels(t, LABELS, forward, backward)
    off = ref.hit & ~reference.silhouette_band(ref.instance, ref.depth)
    return ref, labels, off


@pytest.mark.parametrize("kind", FORMS)
def test_motions_of_a_millionth_of_a_pixel(gl, kind):
    """The body and the camera stand still: nothing but the shape moves."""
    what = world(by_formula(sphere(1.0, 4), kind), moves=False, camera_moves=False)
    ref, labels, off = graded(gl, what, forward=T0 + 30, backward=T0 - 30)
    off &= ref.instance == 3
    for flow, true in ((labels.forward, ref.forward), (labels.backward, ref.backward)):
        motion = length(true.flow)[off]
        assert 1e-8 < np.median(motion) < 1e-5
        # Of the largest motion: near a knot of the wave itself nothing moves. Where a triangle is seen from its edge,
        # its corners' # snapping to 1/256 px is a larger part of it.
        error = length(flow.flow - true.flow)[off] / motion.max()
        assert np.quantile(error, 0.99) <= 1e-5 and error.max() <= 1e-3
    limit = labels.forward.flow[off] / 30e-9
    assert length(labels.velocity[off] - limit).max() <= 1e-5 * length(limit).max()


@pytest.mark.parametrize("kind", FORMS)
@pytest.mark.parametrize("textured", [False, True])
def test_rate_of_luminance_is_that_of_the_frames(gl, kind, textured):
    egg = transform_mesh(sphere(1.0, 4), np.diag([1.0, 0.5, 0.8]))
    what = world(by_formula(egg, kind), smooth_texture() if textured else None, moves=False, camera_moves=False)
    ref = reference.render(what, T0)
    with Renderer(gl, what, RenderConfig(antialiasing="none"), whole=True) as renderer:
        rate, true = rates(renderer, T0)
    off = ref.hit & (ref.instance == 3) & ~reference.silhouette_band(ref.instance, ref.depth, width=3)
    error = np.abs(rate - true)[off]
    assert np.abs(true[off]).max() > 0.1
    assert np.quantile(error, 0.9) < 0.03 * np.abs(true[off]).max()


# ------------------------------------------------------------------------------------------------- skins


def bar():
    tilted = np.eye(4)
    tilted[:3, :3], tilted[2, 3] = Rotation.from_euler("x", 20, degrees=True).as_matrix(), -1
    return transform_mesh(arm(), tilted)


def morphing(mesh):
    """The same, pulled to two other shapes besides."""
    skin, up = mesh.deformer, mesh.vertices[:, 2:]
    deltas = np.stack([0.3 * np.sin(3 * up) * [1, 0, 0], 0.2 * up * [0, 1, 0]])
    normals = np.stack(
        [-0.9 * np.cos(3 * up) * mesh.normals[:, :1] * [0, 0, 1], -0.2 * mesh.normals[:, 1:2] * [0, 0, 1.0]]
    )
    weights = lambda t: (np.sin([7e-9 * t, 3e-9 * t]), np.array([7, 3]) * np.cos([7e-9 * t, 3e-9 * t]))
    morphs = Morphs(deltas, normals, weights, span_ns=2 * 10**9)
    given = skin.skeleton, skin.bones, skin.inverse_bind, skin.joints, skin.weights
    return replace(mesh, deformer=Skin(*given, morphs, after=skin.after, before=skin.before))


def person():
    """One that runs, its head up in the picture."""
    return transform_mesh(
        figure_of(clip="run", height=2.2), np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, -1.2], [0, 0, 0, 1]])
    )


FIGURES = {"skin": bar, "skin and morphs": lambda: morphing(bar()), "a person": person}


SHAPES = {kind: (lambda kind=kind: by_formula(sphere(1.0, 4), kind)) for kind in FORMS}


@pytest.mark.parametrize("shape", [*SHAPES, *FIGURES])
def test_every_label(gl, shape):
    what = world((SHAPES | FIGURES)[shape]())
    ref, labels, off = graded(gl, what)
    body = off & (ref.instance == 3)
    assert body.sum() > (1000 if shape in SHAPES else 500)
    np.testing.assert_array_equal(labels.ids[off], ref.instance[off])
    np.testing.assert_allclose(labels.depth[off], ref.depth[off], rtol=1e-5)
    for flow, true in ((labels.forward, ref.forward), (labels.backward, ref.backward)):
        error = length(flow.flow - true.flow)[off]
        assert np.median(length(true.flow)[body]) > 1.0
        assert np.median(error) <= 1e-5 and error.max() <= 1e-2
    scale = np.median(length(ref.velocity)[body])
    error = length(labels.velocity - ref.velocity)[off] / scale
    assert np.median(error) < 2e-6 and error.max() < 1e-4
    np.testing.assert_allclose(labels.normals[off], (ref.normal @ what.camera_path.pose(T0)[:3, :3])[off], atol=5e-5)
    assert (labels.forward.occluded != ref.forward.occluded)[off].mean() < 0.03


class Spinning:
    """One joint that turns as a rigid body on a path would."""

    period_ns, span_ns, is_static = None, 10**9, False

    def __init__(self, path):
        self.path = path

    def locals(self, t_ns):
        T, dT = self.path.pose(t_ns), self.path.derivative(t_ns)
        out = Locals.rest(1)
        q = out.rotation[0] = Rotation.from_matrix(T[:3, :3]).as_quat()
        w = T[:3, :3].T @ dT[:3, :3]
        turn = Rotation.from_quat(q)
        rate = np.array([w[2, 1], w[0, 2], w[1, 0]])
        x, y, z, s = turn.as_quat()
        out.d_rotation[0] = 0.5 * np.array(
            [s * rate[0] + y * rate[2] - z * rate[1], s * rate[1] + z * rate[0] - x * rate[2],
             s * rate[2] + x * rate[1] - y * rate[0], -x * rate[0] - y * rate[1] - z * rate[2]]
        )  # fmt: skip
        out.translation[0], out.d_translation[0] = T[:3, 3], dT[:3, 3]
        return out


def test_a_turning_skeleton_is_the_turning_body(gl):
    """All vertices follow one joint that moves as the body's path does: the same picture, to the last id."""
    path = drift((0.2, 4, 0.1), (-0.1, 4.4, 0.3), Rotation.identity(), Rotation.from_rotvec([0.9, 0.4, -0.7]))
    ball = sphere(0.8, 4)
    skinned = replace(ball, deformer=Skin.rigid(Skeleton([-1], Spinning(path)), 0, len(ball.vertices)))
    rigid, bones = (
        scene([thing("body", 3, mesh, way, Material(base_color=(0.9, 0.5, 0.3)))], rig())
        for mesh, way in ((ball, path), (skinned, still()))
    )
    with Renderer(gl, rigid, RenderConfig()) as a, Renderer(gl, bones, RenderConfig(), whole=True) as b:
        for t in range(50 * MS, 950 * MS, 100 * MS):
            one, two = (r.labels(t, LABELS, t + 10 * MS, t - 10 * MS) for r in (a, b))
            np.testing.assert_array_equal(one.ids, two.ids)
            for flow, other in ((one.forward, two.forward), (one.backward, two.backward)):
                error = np.abs(flow.flow - other.flow)
                assert error.max() <= 1e-5
                assert np.abs(flow.flow).max() > 0.3
            on = one.ids > 0
            apart = np.abs(one.velocity - two.velocity)[on]
            assert np.quantile(apart, 0.999) <= 1e-5 * np.abs(one.velocity).max()
            assert np.quantile(np.abs(one.depth[on] / two.depth[on] - 1), 0.99) <= 1e-6
