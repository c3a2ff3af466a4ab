"""A still camera redraws only what moves, and every pixel is as in a full redraw."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from blinkgl.camera import PinHole
from blinkgl.config.events import EsimConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.events import Esim
from blinkgl.render.renderer import LabelRequest, Renderer
from blinkgl.render.still import Rectangle, merged, screen_rectangle
from blinkgl.scene.motion.paths import KeyframePath
from blinkgl.tools import bench_still
from render_scenes import LEVEL, SECOND, cube, curve, drift, mixed_scene, scene, sphere, still, thing

PLAIN = RenderConfig(image_antialiasing="none")


def full_redraw(gl, world, config=PLAIN):
    renderer = Renderer(gl, world, config)
    renderer._still = False
    return renderer


@pytest.mark.parametrize("antialiasing", ["none", "msaa4", "ssaa2"])
@pytest.mark.parametrize("reuse", [True, False])
def test_identical_to_the_full_redraw(gl, antialiasing, reuse):
    config = RenderConfig(antialiasing=antialiasing)
    world = mixed_scene(camera_moves=False)
    out = np.empty((120, 160), np.float32) if reuse else None
    with Renderer(gl, world, config) as quick, full_redraw(gl, world, config) as slow:
        assert quick._still
        for t in range(0, SECOND, SECOND // 23):
            np.testing.assert_array_equal(quick.luminance(t, out=out), slow.luminance(t))



@pytest.mark.parametrize("kind", ["tri/16"])
def test_a_small_mover_makes_the_events_of_the_full_redraw(gl, kind):
    """The benchmark's scene (640x480, a ball whose rectangle is at most a twentieth of the image): every event, pixel, time and polarity."""
    made = bench_still.measure(gl, kind, 0.035, rounds=12, warm_up=8)  # compares the events itself
    assert made["events"] > 1000 and made["covered"] <= 0.052


def test_skipped_rows_do_not_depend_on_the_threads_share():
    """The kernel wakes fewer threads where rows are skipped; the events are the same for any number."""
    rng = np.random.default_rng(0)
    frames = np.repeat(rng.uniform(0.2, 0.9, (1, 300, 400)).astype(np.float32), 5, axis=0)
    for k in range(1, 5):
        frames[k, 20:280, 50:350] *= rng.uniform(0.7, 1.4, (260, 300)).astype(np.float32)
        frames[k:] = frames[k]
    whole, part = Esim(300, 400, EsimConfig()), Esim(300, 400, EsimConfig())
    for k, frame in enumerate(frames):
        a, b = whole.step(frame, 1_000_000 * k), part.step(frame, 1_000_000 * k, (20, 280))
        for name in ("x", "y", "t", "p"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("antialiasing", ["none", "ssaa2"])
def test_rates_are_identical_to_the_full_redraw(gl, antialiasing):
    config = SimpleNamespace(**{**vars(PLAIN), "antialiasing": antialiasing})
    world = mixed_scene(camera_moves=False)
    out, rate, full_rate = (np.empty((120, 160), np.float32) for _ in range(3))
    with Renderer(gl, world, config) as quick, full_redraw(gl, world, config) as slow:
        for k, t in enumerate(range(0, SECOND, SECOND // 17)):
            np.testing.assert_array_equal(quick.luminance(t, out=out, rate=rate), slow.luminance(t, rate=full_rate))
            np.testing.assert_array_equal(rate, full_rate)
            assert (rate != 0).any()
            if k % 5 == 4:
                quick.luminance(t, out=np.empty_like(out))  # another kind of frame in between


def test_other_passes_in_between_do_not_disturb(gl):
    world = mixed_scene(camera_moves=False)
    out = np.empty((120, 160), np.float32)
    with Renderer(gl, world, PLAIN) as quick, full_redraw(gl, world) as slow:
        for t in range(0, SECOND, SECOND // 7):
            np.testing.assert_array_equal(quick.luminance(t, out=out), slow.luminance(t))
            quick.velocity(t, 4)
            quick.colour(t)
            quick.luminance(t, out=np.empty_like(out))  # another array, then the first again


@pytest.mark.parametrize("seed", range(3))
def test_any_order_of_kinds_and_arrays(gl, seed):
    """Which array holds what is known: frames with and without rates, into old, new and swapped arrays, at times that go back and forth."""
    rng, world = np.random.default_rng(seed), mixed_scene(48, 36, camera_moves=False)
    arrays = [np.empty((36, 48), np.float32) for _ in range(3)]
    true_rate, before = np.empty((36, 48), np.float32), None
    with Renderer(gl, world, PLAIN) as quick, full_redraw(gl, world) as slow:
        for t in rng.integers(0, SECOND, 60).tolist():
            out, rate = arrays[rng.integers(2)], [None, arrays[2], np.empty_like(true_rate)][rng.integers(3)]
            image = quick.luminance(t, out=out, rate=rate)
            np.testing.assert_array_equal(image, slow.luminance(t, rate=true_rate))
            if rate is not None:
                np.testing.assert_array_equal(rate, true_rate)
            if before is not None:
                outside = np.ones_like(image, bool)
                for r in quick.changed:
                    outside[r.y0:r.y1, r.x0:r.x1] = False
                np.testing.assert_array_equal(image[outside], before[outside])
            before = image.copy()


def test_another_camera_takes_nothing_from_the_first(gl):
    """look_through: luminance, what has changed in it, and the surfaces that hide points at t' are the other camera's."""
    world = mixed_scene(48, 36, camera_moves=False)
    other = replace(world.camera, cx=world.camera.cx - 20, fx=world.camera.fx * 1.3)
    request = LabelRequest("flow_forward", "occlusion_forward")
    with Renderer(gl, world, PLAIN) as renderer, Renderer(gl, world.with_camera(other), PLAIN) as fresh:
        out = np.empty((36, 48), np.float32)
        for t in (0, SECOND // 9):
            renderer.luminance(t, out=out)
        assert renderer.changed and renderer.changed_rows is not None
        renderer.labels(0, request, SECOND // 9)
        renderer.look_through(other)
        assert renderer.changed is None and renderer.changed_rows is None
        np.testing.assert_array_equal(renderer.luminance(SECOND // 9, out=out), fresh.luminance(SECOND // 9))
        assert renderer.changed is None
        a, b = (r.labels(0, request, SECOND // 9).forward for r in (renderer, fresh))
        np.testing.assert_array_equal(a.flow, b.flow)
        np.testing.assert_array_equal(a.occluded, b.occluded)


def test_changes_are_where_they_are_said_to_be(gl):
    world = mixed_scene(camera_moves=False)
    with Renderer(gl, world, PLAIN) as renderer:
        before = renderer.luminance(0)
        assert renderer.changed == [Rectangle(0, 0, 160, 120)]
        for t in range(SECOND // 20, SECOND, SECOND // 20):
            now = renderer.luminance(t)
            outside = np.ones_like(now, bool)
            for r in renderer.changed:
                outside[r.y0:r.y1, r.x0:r.x1] = False
            np.testing.assert_array_equal(now[outside], before[outside])
            assert sum(r.area for r in renderer.changed) < 160 * 120
            before = now


def test_nothing_moves_nothing_is_drawn(gl):
    world = scene([thing("box", 1, cube(0.5), still((0, 4, 0)))])
    with Renderer(gl, world, PLAIN) as renderer:
        out = renderer.luminance(0, out=np.empty((120, 160), np.float32))
        drawn = renderer.stats.triangles
        renderer.luminance(SECOND, out=out)
        assert renderer.changed == [] and renderer.stats.triangles == drawn


def test_an_object_through_the_camera_and_out_of_the_image(gl):
    """Across the near plane every pixel is redrawn; out of sight nothing is, and its last place is mended."""
    path = KeyframePath([0, SECOND // 2, SECOND], [(0, 3, 0), (0, -3, 0), (40, 3, 0)], [(0, 0, 0, 1)] * 3, interpolation="linear")
    world = scene([thing("wall", 1, cube(0.5), still((1, 9, 0))), thing("ball", 2, sphere(0.8), path)])
    with Renderer(gl, world, PLAIN) as quick, full_redraw(gl, world) as slow:
        out = np.empty((120, 160), np.float32)
        for t in range(0, SECOND + 1, SECOND // 40):
            np.testing.assert_array_equal(quick.luminance(t, out=out), slow.luminance(t))


def test_a_moving_camera_or_nothing_still_is_drawn_whole(gl):
    with Renderer(gl, mixed_scene(camera_moves=True), PLAIN) as renderer:
        assert not renderer._still
        renderer.luminance(0)
        assert renderer.changed is None
    movers = scene([thing("ball", 1, sphere(0.5), curve(1, (0, 4, 0), 0.3, 0.2))])
    with Renderer(gl, movers, PLAIN) as renderer:
        assert not renderer._still


def test_speed_is_a_bound_and_exact_where_nothing_is_hidden(gl):
    world = mixed_scene(camera_moves=False)
    with Renderer(gl, world, PLAIN) as quick, full_redraw(gl, world) as slow:
        for t in range(0, SECOND, SECOND // 5):
            assert quick.speed(t) >= slow.speed(t) * (1 - 1e-6)
    alone = scene([thing("wall", 1, cube(2.0), still((0, 30, 0))), thing("ball", 2, sphere(0.5), drift((-1, 4, 0), (1, 4, 0), LEVEL))])
    with Renderer(gl, alone, PLAIN) as quick, full_redraw(gl, alone) as slow:
        assert quick.speed(SECOND // 2) == pytest.approx(slow.speed(SECOND // 2), rel=1e-6)


def test_rectangles():
    a, b, c = Rectangle(0, 0, 4, 4), Rectangle(3, 3, 6, 6), Rectangle(10, 0, 12, 2)
    assert merged([a, c, b]) == [Rectangle(0, 0, 6, 6), c]
    assert merged([a, b, Rectangle(5, 0, 11, 1)]) == [Rectangle(0, 0, 11, 6)]
    assert a.meets(b) and not a.meets(c) and a.area == 16 and b.scaled(2) == Rectangle(6, 6, 12, 12)


def test_screen_rectangle_contains_the_projection():
    camera = PinHole(200, 100, 150.0, 150.0, 99.5, 49.5)
    item = SimpleNamespace(low=np.array([-0.5] * 3), high=np.array([0.5] * 3))
    T = np.eye(4)
    T[:3, 3] = (1.0, -0.5, 4.0)
    r = screen_rectangle(item, T, camera)
    # nearest face at Z = 3.5: x from 0.5 to 1.5, y from -1 to 0
    assert r.x0 <= 99.5 + 150 * 0.5 / 4.5 and r.x1 > 99.5 + 150 * 1.5 / 3.5 and r.y0 <= 49.5 - 150 / 3.5 and r.y1 > 49.5
    T[2, 3] = 0.3
    assert screen_rectangle(item, T, camera) == Rectangle(0, 0, 200, 100)
    T[2, 3] = -3.0
    assert screen_rectangle(item, T, camera) is None
    T[:3, 3] = (100, 0, 4)
    assert screen_rectangle(item, T, camera) is None
