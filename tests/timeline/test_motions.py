"""What adaptive times see of fast motion: the events of a dense fixed rate, in eighteen scenes in which both ends of a
step do not show what happens inside it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.config.events import EsimConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.config.timeline import DisplacementTimeline, UniformTimeline
from blinkgl.events import Esim, Events
from blinkgl.events.camera import EventCamera, emulate
from blinkgl.render.renderer import Renderer
from blinkgl.scene.geometry import BUILDERS
from blinkgl.scene.motion.paths import CutPath, KeyframePath
from blinkgl.scene.shapes.clips import Clip, Playing, Track
from blinkgl.scene.shapes.skeleton import Locals, Skeleton
from blinkgl.scene.shapes.skin import Skin
from blinkgl.scene.types import Lamp, Light, Material, Scene
from blinkgl.sequence.rendered import drawn
from blinkgl.timeline import make_timeline
from blinkgl.tools.trade.matching import match_events
from tests.render.render_scenes import (
    FACING,
    LEVEL,
    SECOND,
    drift,
    quad,
    rig,
    scene,
    smooth_texture,
    sphere,
    still,
    thing,
)
from tests.skinned import Swinging

MS = 1_000_000
WIDTH, HEIGHT, FOCAL = 80, 60, 80.0
ESIM = EsimConfig(contrast_threshold=0.15, threshold_sigma=0.0)
GREY, WHITE = Material(base_color=(0.1,) * 3, unlit=True), Material(base_color=(0.9,) * 3, unlit=True)
PICTURE = Material(smooth_texture(1), unlit=True, uv_scale=(3.0, 3.0))
SHARP = Material(smooth_texture(2), unlit=True)
DENSE = UniformTimeline(fps=10_000)
END = 80 * MS


def keyed(position: Callable[[float], tuple], turn: Callable[[float], tuple] = lambda t: (0, 0, 0), base=LEVEL):
    """A path through poses every quarter of a millisecond. turn : rotation vector before ``base``."""
    times = np.arange(0, END + MS, MS // 4)
    s = times * 1e-9
    return KeyframePath(
        times, [position(t) for t in s], Rotation.concatenate([Rotation.from_rotvec(turn(t)) * base for t in s])
    )


def wall(material=PICTURE, half=3.0, away=3.0):
    return thing("wall", 1, quad(half, half), still((0, away, 0), FACING), material)


def seen(objects, path=None, light=None, background=0.1, focal=FOCAL) -> Scene:
    return replace(scene(objects, rig(WIDTH, HEIGHT, focal, path), light, background), t1_ns=END)


def pixel_steps(renderer):
    """Times at most a pixel apart."""
    return make_timeline(DisplacementTimeline(max_px=1.0), 0, END, renderer, Esim.response(ESIM))


def sine(amplitude: float, hertz: float):
    return lambda t: amplitude * math.sin(2 * math.pi * hertz * t)


def fan() -> Scene:
    """3,000 rev/min: two and a half turns in the time of a longest step."""
    turns = keyed(lambda t: (0, 2.0, 0), lambda t: (0, 2 * math.pi * 50 * t, 0), FACING)
    return seen([wall(GREY), thing("fan", 2, quad(0.6, 0.12), turns, SHARP)])


def hand_shake() -> Scene:
    """12 Hz, 6 px, about two axes."""
    x, y = sine(6 / FOCAL, 12), sine(4 / FOCAL, 9)
    return seen([wall()], keyed(lambda t: (0, 0, 0), lambda t: (y(t), 0, x(t))))


def pendulum() -> Scene:
    """It turns round at 40 ms."""
    angle = lambda t: 0.6 * math.sin(2 * math.pi * t / 0.16)
    swing = keyed(lambda t: (math.sin(angle(t)), 3.0, 0.6 - math.cos(angle(t))))
    return seen([wall(GREY, 6), thing("bob", 2, sphere(0.2, 2), swing, WHITE)])


def bouncing_ball() -> Scene:
    """An impact every 20 ms, at 4 m/s."""
    bounce = keyed(lambda t: (0, 2.0, -0.3 + 0.04 * (1 - (2 * (t / 0.02 % 1) - 1) ** 2) * 8))
    return seen([wall(GREY), thing("ball", 2, sphere(0.15, 2), bounce, SHARP)])


def flash() -> Scene:
    """A beam sweeps over a wall within 8 ms of 80, and back."""
    swing = lambda t: (0, 0, 1.0 if abs(t - 0.04) > 0.008 else 1 - math.cos(math.pi / 2 * (t - 0.04) / 0.008))
    path = keyed(lambda t: (0, 0.5, 0), swing, FACING)
    spot = Lamp("spot", (40.0,) * 3, path, inner=0.1, outer=0.25)
    lit = Material(base_color=(0.8,) * 3)
    return seen([wall(lit)], light=replace(Light(), sun=0.0, sky=0.05, lamps=(spot,)))


class _Waving(Swinging):
    """Nine times as fast."""

    period_ns = span_ns = SECOND // 9
    timescale_ns = period_ns // 16

    def locals(self, t_ns: int) -> Locals:
        slow = Swinging(self.count, self.angle).locals(9 * t_ns)
        return Locals(*slow[:3], *(9 * rate for rate in slow[3:]))


def waving_arm() -> Scene:
    """A skinned arm that waves at 9 Hz."""
    from tests.skinned import arm

    mesh = arm()
    skin = mesh.deformer
    skeleton = Skeleton([-1, 0], _Waving(2, 0.5))
    waving = Skin(skeleton, skin.bones, skin.inverse_bind, skin.joints, skin.weights)
    return seen([wall(GREY, 9, 9), thing("arm", 2, replace(mesh, deformer=waving), still((0, 6, -1)), WHITE)])


def passing_car() -> Scene:
    """From outside on one side to outside on the other within 8 ms."""
    drives = keyed(lambda t: (-60 + 1000 * t, 4.0, 0), base=FACING)
    return seen([wall(GREY, 40, 30), thing("car", 2, quad(0.8, 0.3), drives, SHARP)])


def from_behind() -> Scene:
    """A card comes out from behind a post and goes back within 6 ms."""
    out = lambda t: 1.2 * math.cos(math.pi * (t - 0.05) / 0.006) if abs(t - 0.05) < 0.003 else 0
    darts = keyed(lambda t: (out(t), 4, 0), base=FACING)
    post = thing("post", 3, quad(0.4, 3), still((0, 3, 0), FACING), PICTURE)
    return seen([wall(GREY, 9, 9), post, thing("card", 2, quad(0.3, 0.3), darts, WHITE)])


def to_and_fro_along_the_axis() -> Scene:
    """A zoom: the camera jumps forth and back at 20 Hz."""
    return seen([wall()], keyed(lambda t: (0, 0.25 * math.sin(2 * math.pi * 20 * t), 0)))


def vibration() -> Scene:
    """100 Hz, 3 px."""
    return seen([wall()], keyed(lambda t: (3 * 3.0 / FOCAL * math.sin(2 * math.pi * 100 * t), 0, 0)))


def ball_through_the_picture() -> Scene:
    """At 10,000 px/s."""
    flies = keyed(lambda t: (-5.5 + 250 * (t - 0.02), 2.0, 0))
    return seen([thing("ball", 2, sphere(0.25, 3), flies, WHITE)])


def stopped_body() -> Scene:
    """It moves until a collision cuts its path, within a step that stands at its end."""
    path = CutPath(keyed(lambda t: (-0.6 + 12 * t, 2.9, 0), base=FACING), 53 * MS)
    return seen([wall(GREY), thing("card", 2, quad(0.4, 0.4), path, SHARP)])


def jumping(there: tuple[float, float, float], turn=FACING, back: bool = True) -> KeyframePath:
    """A path that stands at (0, 2, 0), from 30.3 to 31.2 ms elsewhere, and needs a microsecond for the way."""
    here, times = (0.0, 2.0, 0.0), [0, 30.3, 30.301, 31.2, 31.201, 80]
    places = [here, here, there, there, *((here, here) if back else (there, there))]
    return KeyframePath([round(t * MS) for t in times], places, Rotation.concatenate([turn] * 6), "linear")


def camera_that_jumps() -> Scene:
    return seen([wall(away=6.0)], jumping((0.5, 2.0, 0.0), LEVEL))


def body_that_jumps() -> Scene:
    return seen([wall(GREY), thing("card", 2, quad(0.4, 0.4), jumping((0.5, 2.0, 0.0)), SHARP)])


def body_that_vanishes() -> Scene:
    """It is behind the camera from then on."""
    card = thing("card", 2, quad(0.4, 0.4), jumping((0.0, -5.0, 0.0), back=False), SHARP)
    return seen([wall(GREY), card])


def lamp_that_jumps() -> Scene:
    lamp = Lamp("point", (3.0,) * 3, jumping((1.0, 2.0, 0.0)))
    return seen([wall(Material(base_color=(0.8,) * 3))], light=replace(Light(), sun=0.0, sky=0.05, lamps=(lamp,)))


def card_of_a_clip(times, places, kind: str, loop: bool = True) -> Scene:
    track = Track(0, "translation", np.array(times), np.array(places), kind)
    skeleton = Skeleton([-1], Clip(Locals.rest(1), [track], Playing(0, times[-1], loop=loop)))
    mesh = quad(0.3, 0.3)
    mesh = replace(mesh, deformer=Skin.rigid(skeleton, 0, len(mesh.vertices)))
    return seen([wall(GREY), thing("card", 2, mesh, still((0, 2, 0), FACING), SHARP)])


def stepped_body() -> Scene:
    """A clip whose keys hold (STEP), as files of stop motion have it, which begins anew every 30 ms elsewhere."""
    places = [[-0.4, 0, 0], [0.4, 0, 0], [0.1, 0, 0.2], [0, 0, -0.2]]
    return card_of_a_clip([0, 0.011, 0.0117, 0.03], places, "STEP")


def leaping_body() -> Scene:
    """The same as programs without STEP write it: two keys close to each other."""
    places = [[-0.4, 0, 0], [-0.4, 0, 0], [0.4, 0, 0], [0.4, 0, 0], [-0.4, 0, 0], [-0.4, 0, 0]]
    return card_of_a_clip([0, 0.011, 0.01101, 0.0117, 0.01171, 0.06], places, "LINEAR", loop=False)


WORLDS = (
    fan, hand_shake, pendulum, bouncing_ball, flash, waving_arm, passing_car, from_behind, to_and_fro_along_the_axis,
    vibration, ball_through_the_picture, stopped_body, camera_that_jumps, body_that_jumps,
    body_that_vanishes, lamp_that_jumps, stepped_body, leaping_body,
)  # fmt: skip


def events(renderer: Renderer, timeline) -> tuple[Events, int]:
    made = make_timeline(timeline, 0, END, renderer, Esim.response(ESIM))
    camera = EventCamera(ESIM, None, HEIGHT, WIDTH, 0)
    return Events.concatenate([e for _, e in emulate(drawn(renderer, made), camera)]), camera.frames


@pytest.mark.parametrize("world", WORLDS, ids=lambda world: world.__name__)
def test_no_motion_between_two_frames_goes_unseen(gl, world):
    """97 % of the events of frames at 10 kHz, and their times within what a step of a pixel takes."""
    with Renderer(gl, world(), RenderConfig()) as renderer:
        dense, _ = events(renderer, DENSE)
        made, frames = events(renderer, DisplacementTimeline(max_px=1.0, min_step_us=20))
    assert len(dense) > 400 and frames < 1500
    assert len(made) == pytest.approx(len(dense), rel=0.03)
    matching = match_events(dense, made, HEIGHT, WIDTH, 4000)
    assert matching.matched.mean() > 0.95


@pytest.mark.parametrize("world", [stepped_body, leaping_body])
def test_jumps_of_clips_cost_two_frames_each_and_are_no_motion_too_fast(gl, world):
    with Renderer(gl, world(), RenderConfig()) as renderer:
        made = pixel_steps(renderer)
        jumps = renderer.motion.jumps(0, END)
        times = list(made)
    assert jumps and {t + after for t in jumps for after in (0, 1)} <= set(times)
    assert len(times) <= 2 * len(jumps) + 12 and made.notes == ()


# --- what cannot be held is said


def test_motion_too_fast_for_the_shortest_step_is_said(gl):
    """50,000 px/s, at most a pixel a step: 11 px in 200 µs; and a ball that passes within 8 µs."""
    flies = drift((-40, 2, 0), (85, 2, 0), seconds=0.1)
    world = seen([thing("ball", 2, sphere(0.25, 3), flies, WHITE)])
    with Renderer(gl, world, RenderConfig()) as renderer:
        made = pixel_steps(renderer)
        times = list(made)
    assert len(times) < 100 and made.longest == pytest.approx(1250 * FOCAL / 1.75 * 200e-6, rel=0.01)
    (note,) = made.notes
    assert note.startswith(f"{made.too_long} steps between event frames are 200 µs long and would have to be up to ")
    assert note.endswith("times shorter for this motion; expected a smaller timeline.min_step_us")
    flies = drift((-5e3, 2, 0), (2e4, 2, 0), seconds=0.1)
    with Renderer(gl, seen([thing("ball", 2, sphere(0.25, 3), flies, WHITE)]), RenderConfig()) as renderer:
        made = pixel_steps(renderer)
        assert len(list(made)) < 20
    (note,) = made.notes
    assert note.startswith("something may pass, or move to and fro, unseen within 200 µs, first at 0.01")


def test_many_keys_close_to_each_other_cost_no_more_than_looks(gl):
    """100,000 key frames a microsecond apart, of a tremble of a thousandth of a pixel."""
    times = np.arange(0, END, 1000)
    tremble = 1e-3 / FOCAL * np.random.default_rng(0).normal(0, 1, (len(times), 3))
    path = KeyframePath(times, tremble, Rotation.concatenate([LEVEL] * len(times)))
    with Renderer(gl, seen([wall()], path), RenderConfig()) as renderer:
        made = pixel_steps(renderer)
        assert len(list(made)) < 600 and made.looks < 6000


def test_a_deformer_without_a_time_scale_is_named(gl):
    mesh = BUILDERS["flag"]()
    mesh.deformer.timescale_ns = None
    body = thing("flag", 2, mesh, still((0, 3, 0)), SHARP)
    with Renderer(gl, seen([wall(GREY), body]), RenderConfig()) as renderer:
        made = pixel_steps(renderer)
        assert made.notes == (
            "the deformer of 'flag' has no timescale_ns, so steps are examined every timeline.min_step_us",
        )
