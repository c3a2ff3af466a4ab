"""How far surfaces move in space, drawn, against poses and shapes put together by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.camera import Radtan
from blinkgl.config.deform import BreatheConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.labels import LABELS, LabelRequest
from blinkgl.render import reference
from blinkgl.render.renderer import Renderer
from blinkgl.scene.rig import Rig
from blinkgl.scene.shapes.table import deformer_of
from render_scenes import LEVEL, cube, drift, quad, rig, scene, sphere, still, thing

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
        thing("wall", 1, quad(9, 9), still((0, 9, 0), LEVEL * Rotation.from_euler("x", 180, degrees=True))),
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
