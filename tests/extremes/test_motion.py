"""Flow and velocity where the motion, the clock or the place is extreme; against the float64 ray caster.

Why the errors are what they are: flow = (d.xy - ndc d.w) / w' with d = D p. D is rounded to float32 once (6e-8), p
comes from the rasteriser's perspective interpolation (a few 6e-8 of the triangle's size), and nothing is subtracted
that is nearly equal unless the true terms are. So the error is a few 1e-7 *of the
motion*, however small or large that is.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.config.sequence import RenderConfig
from blinkgl.labels import LabelRequest
from blinkgl.render.renderer import Renderer
from blinkgl.scene.motion.paths import KeyframePath
from blinkgl.timeline import uniform_times
from tests.extremes.measures import MOTION, compare, moving_camera
from tests.render.render_scenes import (
    FACING,
    LEVEL,
    SECOND,
    cube,
    curve,
    drift,
    length,
    mixed_scene,
    moved_scene,
    quad,
    rig,
    scene,
    sphere,
    still,
    thing,
)
from tests.timeline.paces import displacement_times

MS = 1_000_000
MEDIAN, WORST = 5e-7, 1e-5  # of the motion


def movers(px: float):
    """A turning ball and a wall before a turning camera; about ``px`` of motion over one second."""
    s, turn = px * 5 / 150, Rotation.from_rotvec([0.3, 0.5, -0.2])
    spin = Rotation.from_rotvec(np.array([0.3, -0.5, 0.2]) * min(px / 150, 2))
    pan = LEVEL * Rotation.from_rotvec(np.array([0.1, 0.2, -0.3]) * min(px / 150, 1))
    return scene(
        [
            thing("ball", 3, sphere(1.0, 4), drift((0.2, 4, 0.1), (0.2 - s, 4 + s, 0.1 + s / 2), turn, turn * spin)),
            thing("wall", 4, quad(30, 30, 8), drift((0, 9, 0), (s, 9 - 0.3 * s, 0), FACING)),
        ],
        rig(path=drift((0, 0, 0), (0.3 * s, 0, 0.2 * s), LEVEL, pan)),
    )


@pytest.mark.parametrize("px", [1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e3])
def test_motion_of_any_size(gl, promise, px):
    e = compare(gl, movers(px))
    assert 0.1 * px < np.median(e.size) < 10 * px and e.wrong_ids == 0
    promise(f"flow of {px:g} px: median, relative", e.relative, MEDIAN)
    promise(f"flow of {px:g} px: largest, relative", e.worst, WORST)
    promise(f"velocity of {px:g} px/s: median, relative", np.median(e.velocity), MEDIAN)
    promise(f"velocity of {px:g} px/s: largest, relative", e.velocity.max(), WORST)


@pytest.mark.parametrize("offset", [1e3, 1e6])
def test_far_from_the_origin(gl, promise, offset):
    """Poses are float64 and camera-relative before they are rounded. What is left is the resolution of the poses
    themselves, 1e6 x 2^-53 = 1.2e-10 units: f / Z times that is the smallest motion that exists there."""
    world = moved_scene(mixed_scene(textured=False), np.array([offset, -offset, 0.7 * offset]))
    e = compare(gl, world, 300 * MS, 400 * MS)
    promise(f"{offset:g} units from the origin: flow, median, relative", e.relative, MEDIAN)
    promise(f"{offset:g} units from the origin: flow, largest, relative", e.worst, WORST)
    promise(f"{offset:g} units from the origin: velocity, largest, relative", e.velocity.max(), WORST)
    with Renderer(gl, mixed_scene(textured=False), RenderConfig()) as renderer:
        here = renderer.labels(300 * MS, MOTION, 400 * MS)
    same = here.ids == e.frame.ids
    assert (~same).mean() < 1e-3
    change = length(here.forward.flow - e.frame.forward.flow)[same]
    # silhouettes inside one object (the box's edges) may fall on the other side of a pixel's centre: hence a quantile
    promise(
        f"{offset:g} units from the origin: flow against the scene at the origin",
        np.quantile(change, 0.999),
        max(1e-4, 10 * offset * 2.0**-53 * world.camera.fx),
        "px",
    )


@pytest.mark.parametrize("interval_ns", [1, 1000, 100 * SECOND])
def test_intervals_from_a_nanosecond_to_100_seconds(gl, promise, interval_ns):
    """Over a nanosecond the poses differ by 1e-10 of their size: float64 leaves 2^-53 / 1e-10 = 1e-6 of that. The
    reference sees the same rounded poses; the velocity does not."""
    seconds = interval_ns / SECOND
    pan = LEVEL * Rotation.from_rotvec([0.0, 0.01, 0.02])
    path = drift(
        (0, 4, 0), (1.0, 4.5, -0.4), FACING, FACING * Rotation.from_rotvec([0.1, 0.2, 0.1]), seconds=max(seconds, 1.0)
    )
    world = scene(
        [thing("wall", 1, quad(9, 9, 4), path)], rig(path=drift((0, 0, 0), (0.1, 0, 0), LEVEL, pan, max(seconds, 1.0)))
    )
    e = compare(gl, world, 0, interval_ns)
    name = f"flow over {seconds:g} s"
    promise(f"{name}: largest, relative", e.worst, WORST)
    if seconds < 1:
        flow, velocity = e.frame.forward.flow / seconds, e.frame.velocity
        promise(f"{name}, divided by it, against velocity", (length(flow - velocity) / length(velocity)).max(), 3e-5)


def test_a_clock_at_a_million_seconds_changes_no_bit(gl, promise):
    late = 10**6 * SECOND

    def world(t0):
        keys = np.array([0, SECOND // 3, SECOND]) + t0
        path = KeyframePath(
            keys,
            [(0, 4, 0), (0.3, 4.4, 0.1), (0.5, 4.2, -0.3)],
            Rotation.from_rotvec([[0, 0, 0], [0.2, 0.1, 0], [0.3, 0, 0.4]]),
        )
        return scene([thing("ball", 1, sphere(1.0, 3), path)])

    both = []
    for t0 in (0, late):
        with Renderer(gl, world(t0), RenderConfig()) as renderer:
            t = t0 + 123_456_789
            both.append((renderer.labels(t, MOTION, t + 1), renderer.luminance(t).read()))
    (a, la), (b, lb) = both
    for one, other in ((a.forward.flow, b.forward.flow), (a.velocity, b.velocity), (a.depth, b.depth), (la, lb)):
        np.testing.assert_array_equal(one, other)
    assert length(a.forward.flow).max() > 0
    promise("start at 1e6 s: change of any buffer", 0.0, 0.0)


@pytest.mark.parametrize("speed", [1e3, 1e6])
def test_a_million_pixels_per_second(gl, promise, speed):
    units = speed * 4 / 150
    world = scene([thing("wall", 1, quad(60 * units, 60, 64), drift((0, 4, 0), (units, 4, 0), FACING))])
    e = compare(gl, world, 0, 1000)  # a microsecond
    promise(f"{speed:g} px/s: velocity, largest, relative", e.velocity.max(), WORST)
    promise(f"{speed:g} px/s: flow over a microsecond, largest, relative", e.worst, WORST)
    with Renderer(gl, world, RenderConfig()) as renderer:
        fastest = lambda t: renderer.motion.look(t).largest
        ten_px = int(10 / speed * SECOND)
        times = np.array(list(displacement_times(0.5, 1, 20_000_000, 0, ten_px, fastest)))
        slow = np.array(list(displacement_times(0.5, 100_000, 20_000_000, 0, 400_000, fastest)))
    moved = np.diff(times) * 1e-9 * speed
    promise(f"{speed:g} px/s: displacement between two event frames", moved.max(), 0.5 * (1 + 1e-4), "px")
    assert np.diff(slow).min() >= 100_000  # documented saturation: never shorter than min_step_us, whatever the speed


@pytest.mark.parametrize("name", ["ground", "close ground", "wall comes through", "inside a box"])
def test_surfaces_crossing_the_camera_plane(gl, promise, name):
    """A point that comes near the camera plane has w' = w + d.w small: the error of w', eps (w + |d.w|), is then large
    beside it. The flow is as large, and the promise is relative to flow * (1 + Z / Z')."""
    turn, tip = Rotation.from_rotvec([0.3, 0.5, -0.2]), Rotation.from_rotvec([0.3, 0.2, 0])
    room = cube(3.0)
    room = type(room)(room.vertices, room.faces, room.normals, room.uvs, closed=False)
    world = scene(
        [
            {
                "ground": thing("ground", 1, quad(40, 40), drift((0, 0, -0.3), (0.1, 0, -0.3))),
                "close ground": thing("ground", 1, quad(40, 40), drift((0, 0, -0.051), (0.1, 0, -0.051))),
                "wall comes through": thing(
                    "wall",
                    1,
                    quad(3, 3, 4),
                    drift((0, 1.5, -0.3), (0, -1, -0.3), tip, tip * Rotation.from_rotvec([0, 0, 0.2])),
                ),
                "inside a box": thing(
                    "box",
                    1,
                    room,
                    drift((0, 0, 0), (0.3, -2.5, 0.1), turn, turn * Rotation.from_rotvec([0.01, -0.02, 0.03])),
                ),
            }[name]
        ],
        moving_camera(),
    )
    e = compare(gl, world)  # valid (in front of the camera then) agrees pixel by pixel, or compare() fails
    assert e.wrong_ids == 0
    promise(
        f"crossing the camera plane, {name}: error / (flow (1 + Z/Z'))",
        (e.flow / (e.size * (1 + e.approach))).max(),
        5e-6,
    )
    promise(f"crossing the camera plane, {name}: velocity, largest, relative", e.velocity.max(), WORST)


def test_no_motion_is_exactly_no_flow(gl, promise):
    """Shaking hands that hold still: poses equal, difference matrices zero, flow zero to
    the bit; also a million units away."""
    path = curve(1, (0.1, 4, 0.2), 0.3, 0.4)
    world = scene([thing("ball", 1, sphere(1.0, 3), path), thing("wall", 2, quad(9, 9), still((0, 8, 0), FACING))])
    for offset in (0, 1e6):
        with Renderer(gl, moved_scene(world, np.full(3, offset)), RenderConfig()) as renderer:
            flow = renderer.labels(5 * SECOND, MOTION, 9 * SECOND)  # both after the last key frame: the pose is held
        promise(
            f"no motion, {offset:g} units from the origin: flow and velocity",
            length(flow.forward.flow).max() + length(flow.velocity).max(),
            0.0,
            "px",
        )


def test_frame_times_at_both_ends():
    assert list(uniform_times(1e9, 5, 9)) == [5, 6, 7, 8, 9]
    assert list(uniform_times(0.01, 10**15, 10**15 + 250 * SECOND)) == [
        10**15,
        10**15 + 100 * SECOND,
        10**15 + 200 * SECOND,
        10**15 + 250 * SECOND,
    ]
    day = list(uniform_times(1 / 3600, 0, 86_400 * SECOND))
    assert len(day) == 25 and np.abs(np.diff(day) - 3600 * SECOND).max() <= 3600 * SECOND * 1e-6
    still_day = list(displacement_times(0.5, 200_000, 10**12, 0, 86_400 * SECOND, lambda t: 0.0))
    assert len(still_day) == 88 and still_day[-1] == 86_400 * SECOND


def test_everything_behind_the_camera_is_invalid_and_zero(gl):
    world = scene([thing("wall", 1, quad(9, 9), drift((0, 2, 0), (0, -2, 0), FACING))])
    with Renderer(gl, world, RenderConfig()) as renderer:
        flow = renderer.labels(0, LabelRequest("flow_forward", "occlusion_forward"), SECOND).forward
    assert not flow.valid.any() and (flow.flow == 0).all() and not flow.occluded.any()
