"""The renderer's own promises: culling changes nothing, super-sampling is the mean, nothing unasked is made."""

import numpy as np
import pytest

from blinkgl.camera import PinHole
from blinkgl.config.sequence import RenderConfig
from blinkgl.labels import LABELS, LabelRequest
from blinkgl.render.moment import Moment
from blinkgl.render.renderer import Renderer
from blinkgl.scene.geometry import primitives
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Light, Material, Part, Scene, SceneObject, Texture
from blinkgl.timeline.sampling import largest_speed
from render_scenes import LEVEL, SECOND, curve, drift, still

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


# ---- per-pixel helpers -------------------------------------------------------------------------------------------


def test_largest_speed():
    velocity = np.zeros((3, 4, 2), np.float32)
    velocity[1, 2] = (3, 4)
    velocity[0, 0] = (np.inf, 0)
    velocity[0, 1] = (np.nan, 0)
    assert largest_speed(velocity) == 5.0
    assert largest_speed(np.zeros((2, 2, 2), np.float32)) == 0.0
