"""A still camera redraws only what moves, and every pixel is as in a full redraw."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from blinkgl.config.events import EsimConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import GLError
from blinkgl.events import Events
from blinkgl.events.camera import EventCamera, EventFrame
from blinkgl.labels import LabelRequest
from blinkgl.render.antialiasing import samples_of
from blinkgl.render.passes import Luminance
from blinkgl.render.renderer import Renderer
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.types import Scene
from blinkgl.tools.bench_rows import probe_scene
from render_scenes import LEVEL, SECOND, cube, curve, drift, largest_speed, mixed_scene, scene, sphere, still, thing

PLAIN = RenderConfig(image_antialiasing="none")


def full_redraw(gl, world, config=PLAIN):
    return Renderer(gl, world, config, whole=True)


@pytest.mark.parametrize("antialiasing", ["none", "edges", "edges2", "ssaa2"])
def test_identical_to_the_full_redraw(gl, antialiasing):
    config = RenderConfig(antialiasing=antialiasing)
    world = mixed_scene(camera_moves=False)
    with Renderer(gl, world, config) as quick, full_redraw(gl, world, config) as slow:
        assert not quick.whole
        for t in range(0, SECOND, SECOND // 23):
            frame, true = quick.luminance(t), slow.luminance(t).read()
            np.testing.assert_array_equal(frame.view(), true)
            np.testing.assert_array_equal(frame.read(), true)


def one_mover() -> Scene:
    """The benchmark's scene at rest, 640x480, but for a ball that crosses the image in front of the others at 0.5 px a
    frame and covers 3.5 % of it."""
    world = probe_scene("tri/16", 640, 480)
    at, mover = world.camera_path.pose(0), world.objects[0]
    focal = world.camera.jacobian(np.array([0.0, 0.0, 1.0]))[0, 0]
    radius = float(np.linalg.norm(mover.parts[0].mesh.vertices, axis=1).max())
    distance = 2 * radius * focal / np.sqrt(0.035 * 640 * 480)
    speed = 0.5 / 0.002 * distance / focal
    seen = lambda s: at[:3, :3] @ [s, 0.1 * s, distance] + at[:3, 3]
    path = drift(seen(-speed / 4), seen(speed * 7 / 4), seconds=2.0)
    objects = tuple(
        replace(o, path=path if i == 0 else StaticPath(o.path.pose(0))) for i, o in enumerate(world.objects)
    )
    return replace(world, objects=objects, rig=replace(world.rig, path=StaticPath(at)))


def events_of(renderer: Renderer, rounds: int) -> tuple[Events, list[float]]:
    """Events of frames 2 ms apart, and the shares of the image that were drawn again."""
    camera, frame, events, covered = EventCamera(EsimConfig(), None, 480, 640, seed=1), None, [], []
    for t in range(0, rounds * 2_000_000, 2_000_000):
        before, frame = frame, renderer.luminance(t)
        rows = frame.rows_changed_since(before)
        events.append(camera.step(EventFrame(t, frame.read(), rows=rows)))
        if frame.changed is not None:
            covered.append(sum((r.x1 - r.x0) * (r.y1 - r.y0) for r in frame.changed) / (640 * 480))
    return Events.concatenate(events), covered


def test_a_small_mover_makes_the_events_of_the_full_redraw(gl):
    """Every event, pixel, time and polarity; a twentieth of the image is drawn again."""
    world = one_mover()
    with Renderer(gl, world, PLAIN) as quick, full_redraw(gl, world) as slow:
        (ours, covered), (theirs, _) = events_of(quick, 20), events_of(slow, 20)
    for name in "xytp":
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    assert len(ours) > 1000 and np.mean(covered[8:]) <= 0.052


@pytest.mark.parametrize("antialiasing", ["none", "edges", "edges2", "ssaa2"])
@pytest.mark.parametrize("seed", range(3))
def test_any_order_of_kinds_and_of_looking(gl, seed, antialiasing):
    """Frames at times that go back and forth, viewed, read, or not looked at at all; drawn
    finer by somebody else in between. What is viewed is right, and so is what is said to
    have changed since any frame."""
    rng, world = np.random.default_rng(seed), mixed_scene(48, 36, camera_moves=False)
    config = PLAIN.model_copy(update={"antialiasing": antialiasing})
    fine = Luminance(samples_of(antialiasing))
    drawn = []
    with Renderer(gl, world, config) as quick, full_redraw(gl, world, config) as slow:
        for t in rng.integers(0, SECOND, 60).tolist():
            frame, true = quick.luminance(t), slow.luminance(t)
            truth = true.read()
            for before, image in drawn[-3:]:
                where = frame.changed_since(before)
                if where is not None:
                    outside = np.ones_like(image, bool)
                    for r in where:
                        outside[r.y0 : r.y1, r.x0 : r.x1] = False
                    np.testing.assert_array_equal(image[outside], truth[outside])
            drawn.append((frame, truth))
            if rng.integers(3):
                np.testing.assert_array_equal(frame.view(), truth)
            if not rng.integers(4):
                np.testing.assert_array_equal(frame.read(), truth)
            if not rng.integers(6):
                quick.draw(fine, int(rng.integers(SECOND)))
        assert sum(b.changed_since(a) is not None for (a, _), (b, _) in itertools.pairwise(drawn)) > 10


def test_the_memory_of_a_view_is_the_renderers(gl):
    """Nobody can write into it, and what has not changed is not transferred: the same
    memory, wherever it is asked for."""
    world = mixed_scene(48, 36, camera_moves=False)
    with Renderer(gl, world, PLAIN) as renderer:
        frame = renderer.luminance(0)
        seen, copied = frame.view(), frame.read()
        with pytest.raises(ValueError, match="read-only"):
            seen[0, 0] = 1
        copied[...] = -1
        np.testing.assert_array_equal(renderer.luminance(SECOND // 7).view(), seen)
        assert (seen >= 0).all() and not np.array_equal(seen, copied)


def test_another_camera_takes_nothing_from_the_first(gl):
    """look_through: luminance, what has changed in it, and the surfaces that hide points at
    t' are the other camera's."""
    world = mixed_scene(48, 36, camera_moves=False)
    other = replace(world.camera, cx=world.camera.cx - 20, fx=world.camera.fx * 1.3)
    request = LabelRequest("flow_forward", "occlusion_forward")
    with Renderer(gl, world, PLAIN) as renderer, Renderer(gl, world.with_camera(other), PLAIN) as fresh:
        first = renderer.luminance(0)
        last = renderer.luminance(SECOND // 9)
        last.view()
        assert last.changed_since(first) and last.rows_changed_since(first) is not None
        renderer.labels(0, request, SECOND // 9)
        renderer.look_through(other)
        with pytest.raises(GLError, match="no longer on the GPU"):
            last.view()
        frame = renderer.luminance(SECOND // 9)
        assert frame.changed is None and frame.changed_since(last) is None and frame.rows_changed_since(last) is None
        np.testing.assert_array_equal(frame.view(), fresh.luminance(SECOND // 9).read())
        a, b = (r.labels(0, request, SECOND // 9).forward for r in (renderer, fresh))
        np.testing.assert_array_equal(a.flow, b.flow)
        np.testing.assert_array_equal(a.occluded, b.occluded)


@pytest.mark.parametrize("antialiasing", ["none", "edges"])
def test_changes_are_where_they_are_said_to_be(gl, antialiasing):
    world = mixed_scene(camera_moves=False)
    with Renderer(gl, world, PLAIN.model_copy(update={"antialiasing": antialiasing})) as renderer:
        frame, less = renderer.luminance(0), []
        before = frame.read()
        assert frame.changed_since(None) is None and frame.rows_changed_since(None) is None
        for t in range(SECOND // 20, SECOND, SECOND // 20):
            last, frame = frame, renderer.luminance(t)
            now = frame.read()
            outside, y = np.ones_like(now, bool), np.arange(120)
            for r in frame.changed_since(last):
                outside[r.y0 : r.y1, r.x0 : r.x1] = False
            np.testing.assert_array_equal(now[outside], before[outside])
            y0, y1 = frame.rows_changed_since(last)
            assert outside[(y < y0) | (y >= y1)].all() and not outside[y0].all() and not outside[y1 - 1].all()
            less.append((~outside).sum() < 160 * 120)
            before = now
        # A silhouette may look for its surface 13 px along itself: here sometimes at everything.
        assert any(less) if antialiasing == "edges" else all(less)
        assert renderer.luminance(0).changed_since(last) is None, "there was one in between"


def test_a_moving_camera_or_nothing_still_is_drawn_whole(gl):
    with Renderer(gl, mixed_scene(camera_moves=True), PLAIN) as renderer:
        assert renderer.whole
        first = renderer.luminance(0)
        assert renderer.luminance(1).changed_since(first) is None
    movers = scene([thing("ball", 1, sphere(0.5), curve(1, (0, 4, 0), 0.3, 0.2))])
    with Renderer(gl, movers, PLAIN) as renderer:
        assert renderer.whole


def test_speed_is_a_bound_and_exact_where_nothing_is_hidden(gl):
    world = mixed_scene(camera_moves=False)
    with Renderer(gl, world, PLAIN) as quick, full_redraw(gl, world) as slow:
        for t in range(0, SECOND, SECOND // 5):
            assert largest_speed(quick.velocity_of_movers(t).read()) >= largest_speed(
                slow.velocity_of_movers(t).read()
            ) * (1 - 1e-6)
    alone = scene(
        [
            thing("wall", 1, cube(2.0), still((0, 30, 0))),
            thing("ball", 2, sphere(0.5), drift((-1, 4, 0), (1, 4, 0), LEVEL)),
        ]
    )
    with Renderer(gl, alone, PLAIN) as quick, full_redraw(gl, alone) as slow:
        moved = [largest_speed(renderer.velocity_of_movers(SECOND // 2).read()) for renderer in (quick, slow)]
        assert moved[0] == pytest.approx(moved[1], rel=1e-6)


@pytest.mark.parametrize("first", ["camera", "elsewhere"])
def test_a_moment_seen_from_elsewhere_has_its_own_picture(gl, first):
    """Before and after frames of the camera, which stands still: what stands still is drawn anew for another place."""
    world, plain = mixed_scene(camera_moves=False), RenderConfig(antialiasing="none")

    def pictures(renderer):
        def elsewhere():
            moment = renderer.moment(0)
            T = moment.T_world_cam.copy()
            T[:3, 3] += 0.3 * T[:3, 0]
            return renderer.luminance(moment.from_place(moment.view, T)).read().copy()

        of_camera = lambda: renderer.luminance(0).read().copy()
        order = (of_camera, elsewhere, of_camera) if first == "camera" else (elsewhere, of_camera, elsewhere)
        return [draw() for draw in order]

    with Renderer(gl, world, plain) as renderer, Renderer(gl, world, plain, whole=True) as whole:
        for mine, anew in zip(pictures(renderer), pictures(whole), strict=True):
            np.testing.assert_array_equal(mine, anew)


def test_a_view_of_a_finer_pass_is_what_is_read(gl):
    """Its target has four values a pixel; only what has changed is copied."""
    with Renderer(gl, mixed_scene(camera_moves=False), RenderConfig(antialiasing="none")) as renderer:
        for t_ns in (0, SECOND // 4, SECOND // 2):
            frame = renderer.draw(Luminance(samples_of("ssaa2")), t_ns)
            np.testing.assert_array_equal(frame.view().copy(), frame.read())
