"""Rendered scenes whose event times are known in closed form: the whole way from texture to microsecond.

A camera slides past a wall painted so that ln(luminance) at a pixel is a sinusoid, or a ramp, in time. Linear
reconstruction between frames is then off by O(step²) for the sinusoid and exact for the ramp.
"""

import numpy as np
import pytest

from blinkgl.camera import PinHole
from blinkgl.config.events import EsimConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.events import Esim, Events
from blinkgl.render.renderer import Renderer
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Material, Texture
from render_scenes import LEVEL, SECOND, drift, mixed_scene, quad, scene, still, thing

PLAIN = RenderConfig(image_antialiasing="none")
THRESHOLD, PERIODS_PER_SECOND, AMPLITUDE, TEXELS, WIDTH, HEIGHT = 0.1, 4.0, 1.0, 2048, 24, 6
DURATION, FOCAL = 0.2, 6000.0
RAMP_PER_PERIOD = 3.0  # ln units


def profile(kind: str, u: np.ndarray) -> np.ndarray:
    """ln(luminance) along the wall, u in periods of the texture."""
    return AMPLITUDE * np.sin(2 * np.pi * u) if kind == "sinusoid" else RAMP_PER_PERIOD * (u - np.floor(u)) - 1.0


def wall(kind: str, texels: int = TEXELS):
    """One texture period per 2 world units; a pixel covers a fraction of a texel, so that filtering plays no part."""
    u = (np.arange(texels) + 0.5) / texels
    image = np.repeat(np.exp(profile(kind, u)).astype(np.float32)[None, :, None], 3, axis=2)
    texture = Texture(np.repeat(image, 2, axis=0))
    sheet = quad(2.0, 2.0)  # 2 periods wide: uv_scale below
    speed = 2.0 * PERIODS_PER_SECOND * DURATION
    start = 0.2 if kind == "ramp" else 0.0  # the ramp's jump stays out of sight
    facing = drift((start, -1.0, 0.0), (start + speed, -1.0, 0.0), LEVEL, LEVEL, DURATION)
    upright = LEVEL * LEVEL.from_euler("x", 180, degrees=True)  # the quad's +z towards the camera, its +x to the right
    material = Material(texture, unlit=True, uv_scale=(2.0, 2.0))
    return scene(
        [thing("wall", 1, sheet, still(rotation=upright), material)],
        Rig.alone(PinHole(WIDTH, HEIGHT, FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2), facing),
    )


def simulate(gl, kind: str, step_ns: int, world, config=PLAIN) -> Events:
    emulator = Esim(HEIGHT, WIDTH, EsimConfig(contrast_threshold=THRESHOLD, threshold_sigma=0.0, log_eps=1e-9), 1)
    chunks = []
    with Renderer(gl, world, config) as renderer:
        for t in range(0, int(DURATION * SECOND) + 1, step_ns):
            chunks.append(emulator.step(renderer.luminance(t).read(), t))
        return Events.concatenate(chunks)


def closed_form(kind: str, column: int, polarity_of_motion: float) -> tuple[np.ndarray, np.ndarray]:
    """Times (s) and polarities of every crossing at one column, from ln(luminance) as a function of time alone."""
    x = (column - (WIDTH - 1) / 2) / FOCAL  # world offset of the pixel's ray on the wall, one unit away
    start = 0.2 if kind == "ramp" else 0.0
    t = np.linspace(0, DURATION, 400_001)
    u = (start + 2.0 * PERIODS_PER_SECOND * t + x) / 2.0 * polarity_of_motion + 4.0
    level = profile(kind, u)
    times, polarities, reference = [], [], level[0]
    # 0.5 µs sampling of the exact curve; the crossing inside a sample is found linearly (error far below 1 µs).
    for i in range(1, len(t)):
        while abs(level[i] - reference) >= THRESHOLD:
            sign = np.sign(level[i] - reference)
            reference += sign * THRESHOLD
            times.append(t[i - 1] + (reference - level[i - 1]) / (level[i] - level[i - 1]) * (t[i] - t[i - 1]))
            polarities.append(sign > 0)
    return np.array(times), np.array(polarities)


def errors(events: Events, kind: str, sign: float) -> np.ndarray:
    """|time - closed form| in µs for every event of three columns; the counts and polarities have to agree."""
    found = []
    for column in (0, WIDTH // 2, WIDTH - 1):
        times, polarities = closed_form(kind, column, sign)
        at = (events.x == column) & (events.y == HEIGHT // 2)
        n = min(at.sum(), len(times))
        assert abs(int(at.sum()) - len(times)) <= 1, "an event at the very end may fall on either side of it"
        np.testing.assert_array_equal(events.p[at][:n].astype(bool), polarities[:n])
        found.append(np.abs(events.t[at][:n] + 0.5 - times[:n] * 1e6))  # stamps are floored to the microsecond
    return np.concatenate(found)


@pytest.fixture
def direction(gl):
    """+1 or -1: whether u grows along +x on the rendered wall (read off one frame, so the
    test asks physics, not layout)."""
    world = wall("ramp")
    with Renderer(gl, world, PLAIN) as renderer:
        row = renderer.luminance(0).read()[HEIGHT // 2]
    return 1.0 if row[-1] > row[0] else -1.0


def test_a_ramp_is_exact_at_any_frame_rate(gl, direction):
    world = wall("ramp")
    for step in (20_000_000, 2_500_000):
        off = errors(simulate(gl, "ramp", step, world), "ramp", direction)
        assert len(off) > 40 and np.median(off) < 1.0 and off.max() < 3.0


def test_a_sinusoid_converges_with_second_order(gl, direction):
    world = wall("sinusoid")
    steps = [8_000_000, 4_000_000, 2_000_000]
    medians = [np.median(errors(simulate(gl, "sinusoid", step, world), "sinusoid", direction)) for step in steps]
    order = np.polyfit(np.log(steps), np.log(medians), 1)[0]
    assert abs(order - 2) < 0.3, f"order {order:.2f}, median errors {medians} µs"
    assert medians[-1] < 50


def test_rates_are_those_of_finer_and_finer_differences(gl):
    """dL/dt of the shader against central differences of rendered frames, on curved, lit, textured, turning things."""
    world = mixed_scene()
    h = 100_000
    with Renderer(gl, world, RenderConfig()) as renderer:
        frame, rate = np.moveaxis(renderer.brightness(SECOND // 3).read(), -1, 0)
        np.testing.assert_array_equal(frame, renderer.luminance(SECOND // 3).read())
        ahead, behind = (renderer.luminance(SECOND // 3 + s).read().astype(float) for s in (h, -h))
        small = renderer.brightness(SECOND // 3, 4).read()
    difference = (ahead - behind) / (2e-9 * h)
    off = np.abs(rate - difference)
    assert np.median(off) < 0.03 * np.median(np.abs(difference)) and np.percentile(off, 85) < 0.1 * np.percentile(
        np.abs(difference), 85
    )
    # The small picture sees the same rates, though its own pixels are four times as large.
    for q in (50, 90):
        assert np.percentile(np.abs(small[..., 1]), q) == pytest.approx(np.percentile(np.abs(rate), q), rel=0.1)


def test_the_rate_is_taken_over_half_a_pixel(gl):
    """Stripes of six texels, a pixel each, that slide by. Straight lines between texels keep sinc²(1/6) of the true
    rate, a difference over half a pixel sinc(0.5/6) of that, one over two pixels sinc(2/6): 0.75 in all. Much less than
    half a pixel is no better: the rate of a straight line between two texels is off by
    more than the mean over half of it."""
    texels, period, speed, focal = 64, 6.0, 3.0, 64.0
    stripes = 0.5 + 0.3 * np.sin(2 * np.pi * (np.arange(texels) + 0.5) / period)
    paint = Material(texture=Texture(np.tile(stripes.astype(np.float32)[None, :, None], (texels, 1, 3))), unlit=True)
    facing = LEVEL * LEVEL.from_euler("x", 180, degrees=True)
    slides = drift((0, 1, 0), (speed / focal, 1, 0), facing)
    world = scene(
        [thing("wall", 1, quad(0.5, 0.5), slides, paint)],
        Rig.alone(PinHole(48, 16, focal, focal, 23.5, 7.5), still(rotation=LEVEL)),
    )
    found, true = [], []
    with Renderer(gl, world, RenderConfig()) as renderer:
        for t in np.linspace(0.05, 0.9, 23):
            rate = renderer.brightness(int(t * SECOND)).read()[..., 1]
            at = np.arange(48) - 23.5 - speed * t + texels / 2
            found.append(rate[8, 4:-4])
            true.append(-speed * 0.3 * 2 * np.pi / period * np.cos(2 * np.pi * at / period)[4:-4])
    found, true = np.array(found), np.array(true)
    assert (found * true).sum() / (true * true).sum() == pytest.approx(np.sinc(1 / 6) ** 2 * np.sinc(0.5 / 6), rel=0.02)
    assert np.sqrt(((found - true) ** 2).mean() / (true**2).mean()) < 0.21
