"""The emulators where thresholds, intervals, clocks, counts and durations are extreme;
against closed forms and exact integers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Esim, make_emulator
from blinkgl.events.arith import Q_ONE, log_q25
from blinkgl.labels import LabelRequest
from blinkgl.render.renderer import Renderer
from blinkgl.scene.types import Light, Material, Texture
from blinkgl.tools.shader_debugger import reference
from tests.render.render_scenes import FACING, LEVEL, SECOND, drift, quad, rig, scene, still, thing

DAY = 86_400 * SECOND
LONGEST = 1000 * SECOND  # below the emulators' limit of 17 minutes
EVERY = {"esim": EsimConfig(), "v2e": V2eConfig(), "voltmeter": VoltmeterConfig()}
QUIET = {
    "esim": EsimConfig(threshold_sigma=0.02),
    "v2e": V2eConfig(preset="clean"),
    "voltmeter": VoltmeterConfig(k3=0, k4=0, k5=0, k6=0),
}


def picture(seed=0, shape=(12, 16), low=0.05, high=1.0):
    return np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)


def plain(c, **keys):
    return EsimConfig(contrast_threshold=c, threshold_sigma=0, log_eps=1e-9, **keys)


@pytest.mark.parametrize("c", [1e-3, 1e-2, 1.0, 10.0])
def test_thresholds_from_a_thousandth_to_ten(promise, c):
    """Times on a straight line in ln I. The level is a multiple of C rounded to 2^-25 (1.5e-8 each): the j-th is j
    1.5e-8 off, and the line's ends 1.3e-7."""
    rise = 35.0
    esim = Esim(1, 1, plain(c))
    esim.step(np.full((1, 1), 1e-9 + 1e-7, np.float32), 0)
    start = np.log(np.float64(np.float32(1e-9 + 1e-7)) + 1e-9)
    top = np.float32(np.exp(start + rise))
    events = esim.step(np.full((1, 1), top, np.float32), 100 * SECOND)
    rise = np.log(np.float64(top) + 1e-9) - start
    count = int(rise / c)
    promise(f"C = {c:g}: events too many or few of {count}", abs(len(events) - count), 1)
    n = min(len(events), count)
    expected = np.arange(1, n + 1) * c / rise * 1e8  # us
    bound = (n * 1.5e-8 + 2.6e-7) / rise * 1e8 + 1.0
    promise(f"C = {c:g}: event times over 100 s", np.abs(events.t[:n] - expected).max(), bound, "us")


@pytest.mark.parametrize("interval_ns", [1, 999, 10**6, 100 * SECOND])
@pytest.mark.parametrize("emulator", EVERY)
def test_frame_intervals_from_a_nanosecond_to_100_seconds(emulator, interval_ns):
    """Sorted, inside the interval, to the microsecond; nothing more is promised of noise over 100 s."""
    run, last = make_emulator(EVERY[emulator], 12, 16, 3), 0
    total = 0
    for k in range(6):
        t = 7_777_777 + k * interval_ns
        events = run.step(picture(k % 2), t)
        assert (np.diff(events.t) >= 0).all()
        if len(events):
            assert events.t[0] >= last // 1000 and events.t[-1] <= t // 1000
        last, total = t, total + len(events)
    if emulator != "v2e" or interval_ns > 1e5:  # its low-pass sees nothing of a change within a microsecond
        assert total > 100


def test_times_are_exact_at_any_clock(promise):
    """Shifting the clock by 10^6 s, or 10^9, shifts the events and changes nothing else: times
    are integers throughout."""
    frames, times = [picture(k) for k in range(6)], np.cumsum([0, 1, 999_999, 10**6, 33_333_333, SECOND])
    runs = []
    for shift in (0, 10**6 * SECOND, 10**9 * SECOND):
        esim = Esim(12, 16, EsimConfig(threshold_jitter=0.02, refractory_us=100), seed=5)
        events = [esim.step(f, int(t) + shift) for f, t in zip(frames, times)]
        runs.append(
            [np.concatenate([getattr(e, k) for e in events]) - (shift // 1000 if k == "t" else 0) for k in "xytp"]
        )
    for other in runs[1:]:
        for a, b in zip(runs[0], other):
            np.testing.assert_array_equal(a, b)
    assert len(runs[0][0]) > 2000
    promise("ESIM, clock at 1e6 s and 1e9 s: change of any event", 0, 0)


def test_ten_thousand_events_per_pixel(promise):
    """One frame pair, every one of the events at its own time: ln I rises by 10, C = 0.001."""
    esim = Esim(3, 4, plain(0.001))
    low, high = np.full((3, 4), 1e-3, np.float32), np.full((3, 4), 1e-3 * np.exp(10.0005), np.float32)
    esim.step(low, 0)
    events = esim.step(high, SECOND)
    per_pixel = np.bincount(events.y.astype(int) * 4 + events.x, minlength=12)
    promise("10^4 events per pixel: too many or few", np.abs(per_pixel - 10_000).max(), 1)
    mine = events.t[(events.x == 1) & (events.y == 2)]
    expected = np.arange(1, len(mine) + 1) * 1e-3 / 10.0005 * 1e6
    # 10^4 x 1.5e-8 / 10 of 1 s, + 1 us + ends.
    promise("10^4 events per pixel: event times over 1 s", np.abs(mine - expected).max(), 18.0, "us")
    assert esim.saturated == 0 and (np.diff(events.t) >= 0).all()
    back = esim.step(low, 2 * SECOND)
    assert len(back) == len(events)


def test_more_events_than_asked_for_are_cut_and_counted():
    esim = Esim(32, 32, plain(0.001, max_events_per_step=10_000))
    esim.step(np.full((32, 32), 1e-3, np.float32), 0)
    events = esim.step(np.full((32, 32), 1e3, np.float32), SECOND)
    wanted = 1024 * int(np.log(1e6) / 0.001)
    assert len(events) <= 10_000 and abs(len(events) + esim.saturated - wanted) <= 1024


def soak(frames: int, emulator, shape=(4, 8)):
    """A flickering picture with a slow trend: (ON - OFF events per pixel, first frame, last frame)."""
    base, net, t = picture(1, shape), np.zeros((2, *shape), np.int64), 0
    wobble = picture(2, (64, *shape), 0.3, 3.0)
    first = last = (base * wobble[0]).astype(np.float32)
    emulator.step(first, 0)
    for k in range(1, frames):
        last = base * wobble[k % 64] if k < frames - 1 else first
        t += 1_000_003
        events = emulator.step(last, t)
        np.add.at(net, (events.p, events.y, events.x), 1)
    return net, first, last


@pytest.mark.parametrize("frames", [20_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_references_do_not_drift(promise, frames):
    """ESIM's reference after N frames is the first log plus (ON C+ - OFF C-), in integers: exact, hence no drift at any
    N. (A float32 reference would have moved by 2^-24 x 4 x sqrt(events): 1e-4 to 1e-3 after 10^6 frames.)"""
    esim = Esim(4, 8, EsimConfig(threshold_sigma=0.03), seed=1)
    net, first, _ = soak(frames, esim)
    assert net.sum() > 50 * frames
    reference = esim._upper.astype(np.int64) - esim._on
    expected = (
        log_q25(first + np.float32(1e-3)).ravel().astype(np.int64)
        + net[1].ravel() * esim._on
        - net[0].ravel() * esim._off
    )
    promise(
        f"ESIM, {frames:.0e} frames, {net.sum():.0e} events: drift of the reference",
        np.abs(reference - expected).max() / Q_ONE,
        0.0,
        "ln",
    )


@pytest.mark.parametrize("frames", [5_000, pytest.param(200_000, marks=pytest.mark.slow)])
def test_v2e_reference_drift(promise, frames):
    """V2E keeps float32 levels of size 4 to 8 ln units, rounded to 4.8e-7 at every event, 1.4e-7 rms. A clip that
    repeats after 150 events per pixel repeats its roundings, so that their mean, 1.4e-7 / sqrt(150), adds up: 1.1e-8
    per event, three times that in the worst of 32 pixels. (At the default leak rate the leak moves
    the reference a hundred times faster.)"""
    run = make_emulator(V2eConfig(preset="clean", threshold_sigma=0.0), 4, 8, 1)
    net, _first, _ = soak(frames, run)
    assert net.sum() > 20 * frames
    start = run._x.astype(np.float64)  # the last frame is the first one
    expected = start + (net[1] - net[0]).ravel() * np.float64(np.float32(0.2))
    drift = np.abs(run._upper.astype(np.float64) - np.float64(np.float32(0.2)) - expected).max()
    promise(
        f"V2E, {frames:.0e} frames, {net.sum():.0e} events: drift of the reference",
        drift,
        4e-8 * net.sum(0).max(),
        "ln",
    )


@pytest.mark.parametrize("emulator", QUIET)
@pytest.mark.parametrize("interval", [LONGEST, 1, 30 * SECOND])
def test_a_still_day_makes_no_event(promise, emulator, interval):
    run, frame = make_emulator(QUIET[emulator], 12, 16, 2), picture()
    steps = min(DAY // interval, 3000)
    events, t = len(run.step(frame, 0)), 0
    for k in range(1, steps + 1):
        t = DAY * k // steps if interval > 1 else k
        events += len(run.step(frame, t))
    state = run.state_dict()
    promise(f"{emulator}, a still day in {steps} frames: events", events, 0)
    moved = picture() * np.float32(np.exp(0.5))
    a = run.step(moved, t + SECOND)
    other = make_emulator(QUIET[emulator], 12, 16, 2)
    other.step(frame, t)
    b = other.step(moved, t + SECOND)
    assert len(a) > 100 and state["clock"][3] == 0
    for k in "xytp":
        np.testing.assert_array_equal(getattr(a, k), getattr(b, k))  # as if the day had not been


def test_beyond_the_limits_there_is_a_message():
    esim, frame = Esim(2, 2), np.ones((2, 2), np.float32)
    esim.step(frame, 0)
    with pytest.raises(EventDataError, match="time stamp out of range .* at most 17 minutes between two frames"):
        esim.step(frame, 2000 * SECOND)
    with pytest.raises(EventDataError, match="time stamp out of range"):
        Esim(2, 2).step(frame, 2**61)
    for c in (9e-4, 10.1):
        with pytest.raises(ValueError):
            EsimConfig(contrast_threshold=c)


def test_a_still_day_of_v2e_noise_keeps_its_rate(promise):
    """Leak and shot noise over 24 h at their configured rates, to the counting error: nothing accumulates in float32
    (the leak's epoch moves along)."""
    config = V2eConfig(
        leak_rate_hz=0.02,
        leak_cov_decades=0.0,
        leak_jitter=0.1,
        shot_noise_rate_hz=0.01,
        threshold_sigma=0.0,
        cutoff_hz=0.0,
        refractory_us=0.0,
    )
    run, frame = make_emulator(config, 8, 8, 4), np.zeros((8, 8), np.float32)
    run.step(frame, 0)
    halves = np.zeros((2, 2))
    for k in range(1, 288 + 1):
        events = run.step(frame, DAY * k // 288)
        halves[(k - 1) // 144] += (events.p == 0).sum(), (events.p == 1).sum()
    off, on = halves.sum(0)
    pixels, seconds = 64, 86_400
    # Half of the shot noise, v2e's rate at intensity 0.
    expected_off = 0.5 * 0.01 * (1 - 0.75 * 20 / 275) * pixels * seconds
    promise(
        "V2E, a still day: OFF noise against its rate, sigmas", abs(off - expected_off) / np.sqrt(expected_off), 4.0
    )
    # A shot-noise ON resets the leak's progress, an OFF too: the leak's own count is below its rate; the two halves
    # agree.
    promise(
        "V2E, a still day: ON events, second half against first, sigmas",
        abs(halves[1, 1] - halves[0, 1]) / np.sqrt(2 * halves[0, 1]),
        4.0,
    )
    assert on > 0.5 * 0.02 * pixels * seconds
    assert stats.norm.sf(4.0) < 1e-4


# --- Light from nothing to 1e9, in the passes and in the emulators.

TILTED = LEVEL * Rotation.from_euler("x", 160, degrees=True)
RADIANCES = [0.0, 1e-12, 1e-9, 1e-6, 1e-3, 1.0, 1e3, 1e6, 1e9]


def bars(**keys):
    """One upright bar per radiance, side by side before a LEVEL camera."""
    return [
        thing(f"bar{k}", k + 1, quad(0.4, 2), still((k - 4, 8, 0), FACING), Material(base_color=(v, v, v), **keys))
        for k, v in enumerate(RADIANCES)
    ]


@pytest.mark.parametrize("antialiasing", ["none", "ssaa4"])
def test_radiance_of_twenty_one_decades(gl, promise, antialiasing):
    """Float32 targets keep 2^-24 of any radiance; the luma weights' sum and the box filter round a few times more."""
    world = scene(bars(unlit=True), rig(90, 24, 80.0))
    with Renderer(gl, world, RenderConfig(antialiasing=antialiasing)) as renderer:
        luminance, colour = renderer.luminance(0).read(), renderer.labels(0, LabelRequest("images", "ids"))
    worst = 0.0
    for k, v in enumerate(RADIANCES):
        inside = np.zeros(luminance.shape, bool)
        inside[1:-1, 1:-1] = colour.ids[1:-1, 1:-1] == k + 1
        inside &= np.roll(inside, 1, 1) & np.roll(inside, -1, 1)  # not the bar's edge, which super-sampling blends
        assert inside.sum() > 20
        if v == 0.0:
            assert (luminance[inside] == 0).all() and (colour.colour[inside] == 0).all()
        else:
            worst = max(worst, np.abs(luminance[inside] / v - 1).max(), np.abs(colour.colour[inside] / v - 1).max())
    promise(f"radiance 1e-12 to 1e9, {antialiasing}: relative", worst, 5e-7)


@pytest.mark.parametrize("sun, sky", [(1e9, 0.0), (0.0, 1e-12), (1e9, 1e-12), (0.0, 0.0)])
def test_suns_from_nothing_to_1e9(gl, promise, sun, sky):
    light = Light(sun=sun, sky=sky)
    world = scene([thing("wall", 1, quad(9, 9), still((0, 4, 0), TILTED))], light=light)
    true = reference.render(world, 0)
    with Renderer(gl, world, RenderConfig()) as renderer:
        luminance = renderer.luminance(0).read()
    assert np.isfinite(luminance).all()
    scale = np.abs(true.luminance).max()
    promise(
        f"sun {sun:g}, sky {sky:g}: luminance, relative",
        np.abs(luminance - true.luminance).max() / max(scale, 1e-300),
        1e-6,
    )


def test_a_hot_texel_among_black_ones(gl, promise):
    """One texel of 1e9 in a black HDR texture: mip levels keep its mean (they are box means
    in float32), nothing overflows."""
    image = np.zeros((64, 64, 3), np.float32)
    image[20, 30] = 1e9
    paint = Material(texture=Texture(image), unlit=True)
    world = scene([thing("sky", 1, quad(4, 4), still((0, 8, 0), FACING), paint)], rig(32, 32, 40.0))
    # Every pixel holds 2.7 x 2.7 whole textures.
    wide = scene(
        [
            thing(
                "sky",
                1,
                quad(40, 40),
                still((0, 4, 0), FACING),
                Material(texture=Texture(image), unlit=True, uv_scale=(1600.0, 1600.0)),
            )
        ],
        rig(32, 32, 30.0),
    )
    with Renderer(gl, world, RenderConfig()) as renderer:
        near = renderer.luminance(0).read()
        assert np.isfinite(near).all() and near.min() == 0 and near.max() > 1e8
    with Renderer(gl, wide, RenderConfig()) as renderer:
        luminance = renderer.luminance(0).read()
    promise(
        "a texel of 1e9 among 4095 black ones, minified: mean, relative",
        np.abs(luminance.mean() / (1e9 / 4096) - 1),
        1e-5,
    )


@pytest.mark.parametrize("low, high", [(0.0, 1e9), (1e-12, 1e9), (1e-9, 1e-3), (1e3, 1e9), (0.0, 1e-12)])
def test_esim_between_any_two_radiances(promise, low, high):
    """Events count |d ln(I + eps)| / C, the logarithm in 2^-25 steps: off by one at most,
    where a level is all but reached."""
    config = EsimConfig(contrast_threshold=0.1, threshold_sigma=0, log_eps=1e-9)
    esim = Esim(1, 1, config)
    esim.step(np.full((1, 1), low, np.float32), 0)
    up = esim.step(np.full((1, 1), high, np.float32), SECOND)
    down = esim.step(np.full((1, 1), low, np.float32), 2 * SECOND)
    wanted = np.log((np.float64(np.float32(high)) + 1e-9) / (np.float64(np.float32(low)) + 1e-9)) / 0.1
    promise(f"ESIM from {low:g} to {high:g}: events too many or few", abs(len(up) - int(wanted)), 1)
    assert (up.p == 1).all() and (down.p == 0).all() and abs(len(up) - len(down)) <= 1


def test_the_logarithm_against_float64(promise):
    """Fixed point with 2^-25 steps: absolute, not relative, so that levels are equally spaced everywhere."""
    from blinkgl.events.arith import Q_ONE, log_q25

    v = np.concatenate([np.logspace(-9, 9, 100_001), [2.0**-30, 2.0**30]]).astype(np.float32)
    promise("ln of 2^-30 to 2^30: absolute", np.abs(log_q25(v) / Q_ONE - np.log(v.astype(np.float64))).max(), 1.3e-7)


def test_more_light_than_the_emulators_take_is_refused(gl):
    """2^30 is where fixed-point logarithms end: the pass draws 1e12 well, the emulator says
    what it cannot use, and where."""
    world = scene(
        [thing("wall", 1, quad(9, 9), still((0, 4, 0), FACING), Material(base_color=(1e6,) * 3))],
        rig(8, 6, 8.0),
        Light((0, -1, 0), 1e6, 0.0),
    )
    with Renderer(gl, world, RenderConfig()) as renderer:
        luminance = renderer.luminance(0).read()
    np.testing.assert_allclose(luminance, 1e12, rtol=1e-6)
    with pytest.raises(EventDataError, match="frame 0: intensity at pixel x=0, y=0 cannot be used .* 0 to 1.07e\\+09"):
        Esim(6, 8).step(luminance, 0)


def test_a_moving_dark_thing_before_a_black_sky_fires_nothing(gl):
    """Radiances below log_eps are the same darkness: 1e-12 against 0 is a change of 1e-9 in the logarithm."""
    world = scene(
        [
            thing(
                "ghost",
                1,
                quad(0.5, 0.5),
                drift((-1, 4, 0), (1, 4, 0), FACING),
                Material(base_color=(1e-12,) * 3, unlit=True),
            )
        ],
        rig(40, 30, 40.0),
    )
    esim, events = Esim(30, 40, EsimConfig(contrast_threshold=0.001)), 0
    with Renderer(gl, world, RenderConfig()) as renderer:
        for k in range(11):
            events += len(esim.step(renderer.luminance(k * SECOND // 10).read(), k * SECOND // 10))
    assert events == 0
