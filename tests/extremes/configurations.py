"""Hypothesis strategies over the configuration space: plain YAML trees, extreme values
first, small images, few frames."""

from __future__ import annotations

from hypothesis import strategies as st


def magnitude(low: float, high: float, *also: float):
    """Floats spread over the decades of [low, high], and the given values."""
    import math

    decades = st.floats(math.log10(low), math.log10(high)).map(lambda e: min(max(10.0**e, low), high))
    return st.sampled_from([low, high, *also]) | decades


def signed(largest: float):
    return st.builds(lambda m, s: s * m, magnitude(1e-6, largest), st.sampled_from([-1.0, 0.0, 1.0]))


def some(**keys):
    """A table of any subset of the keys, often none: what is left out has its default, so that an example is ordinary
    except in a few places. (All extremes at once are mostly black images without an event.)"""
    return st.just({}) | st.fixed_dictionaries({}, optional=keys)


cameras = st.builds(
    lambda size, more: {"width": size[0], "height": size[1], **more},
    st.sampled_from([(24, 16), (1, 1), (1, 16), (24, 1)]) | st.tuples(st.integers(1, 24), st.integers(1, 16)),
    some(
        fov=magnitude(0.02, 179.0, 1.0, 170.0), cx=st.floats(-40, 60), cy=st.floats(-40, 60), near=magnitude(1e-6, 10.0)
    ),
)

# duration and rate together, so that few labels and few frames come out of all of them
times = st.builds(
    lambda interval, labels, start, extra: {
        "label_rate": 1.0 / interval,
        "duration": interval * (labels + extra),
        "start": start,
    },
    magnitude(1e-5, 100.0),
    st.integers(1, 3),
    st.sampled_from([0.0, 0.1, 1e6, 9e6]),
    st.floats(0.001, 0.9),
)


def timelines(interval: float):
    """At most some tens of event frames per label interval."""
    uniform = st.builds(lambda n: {"kind": "uniform", "fps": min(n / interval, 1e9)}, magnitude(0.5, 20.0))
    steps = st.builds(
        lambda n, longest: {
            "min_step_us": max(interval / n * 1e6, 0.001),
            "max_step_us": max(interval * longest * 1e6, interval / n * 1e6, 0.001),
        },
        magnitude(1.0, 20.0),
        magnitude(0.1, 10.0),
    )
    percentile = st.sampled_from([50.0, 99.0, 100.0])
    displacement = st.builds(
        lambda px, peak, p: {"kind": "displacement", "max_px": px, "max_px_peak": peak, "percentile": p},
        magnitude(1e-3, 1e4),
        st.none() | magnitude(1e-3, 1e4),
        percentile,
    )
    brightness = st.builds(
        lambda part, p: {"kind": "brightness", "max_fraction_of_threshold": part, "percentile": p},
        magnitude(1e-3, 100),
        percentile,
    )
    adaptive = st.builds(
        lambda way, longest: {**way, **longest},
        displacement | brightness,
        steps,
    )
    return uniform | adaptive


lights = some(
    sun=magnitude(1e-12, 1e9, 0.0, 1.0, 10.0),
    sky=magnitude(1e-12, 1e9, 0.0, 1.0),
    unlit=st.booleans(),
    sun_elevation=st.sampled_from([-90.0, 0.0, 90.0]),
)
positions = st.lists(signed(1e6), min_size=3, max_size=3)
near_positions = st.lists(st.floats(-5, 5), min_size=3, max_size=3)


def motion(interval: float, start: float, where):
    keyframes = st.builds(
        lambda poses, eulers: {
            "keyframes": [
                {"time": start + k * max(interval, 2e-6), "position": p, "euler": e}
                for k, (p, e) in enumerate(zip(poses, eulers))
            ]
        },
        st.lists(where, min_size=2, max_size=4),
        st.lists(st.lists(st.floats(-360, 360), min_size=3, max_size=3), min_size=4, max_size=4),
    )
    still = st.builds(
        lambda p, e: {"position": p, "euler": e}, where, st.lists(st.floats(-360, 360), min_size=3, max_size=3)
    )
    return still | keyframes


@st.composite
def in_view(draw, interval: float, start: float):
    """An object that fills much of the image of a level camera near the origin, whatever
    its size, and moves across it."""
    size = draw(magnitude(1e-4, 1e5, 1.0))
    share = st.floats(-0.6, 0.6)
    place = lambda: [size * draw(st.floats(0.2, 4.0)), size * draw(share), size * draw(share)]
    keys = [{"time": start + k * max(interval, 2e-6), "position": place()} for k in range(draw(st.integers(2, 4)))]
    return {"keyframes": keys, "scale": size, "interpolation": draw(st.sampled_from(["spline", "linear"]))}


def explicit_scenes(interval: float, start: float):
    meshes = {
        "box": {"primitive": "cuboid"},
        "ball": {"primitive": "icosphere"},
        "plane": {"primitive": "grid"},
        "cone": {"primitive": "cone"},
    }
    material = some(
        procedural=st.sampled_from(["checks", "fbm", "gradient"]),
        max_size=st.sampled_from([1, 7, 32]),
        color=st.lists(magnitude(1e-12, 1e9, 0.0, 1.0), min_size=3, max_size=3),
        unlit=st.booleans(),
        both_sides=st.booleans(),
        uv_scale=st.lists(signed(1e5), min_size=2, max_size=2),
    )

    def thing(where):
        return st.builds(
            lambda path, mesh, scale, category: {
                **path,
                "mesh": mesh,
                "material": "paint",
                "scale": scale,
                "category": category,
            },
            motion(interval, start, where),
            st.sampled_from(sorted(meshes)),
            magnitude(1e-4, 1e5, 1.0),
            st.sampled_from(["object", "ground", "sky"]),
        )

    def scene(where, things=None):
        return st.builds(
            lambda objects, camera, paint, light, background: {
                "kind": "explicit",
                "meshes": meshes,
                "materials": {"paint": paint},
                "objects": [{**o, "name": str(k)} for k, o in enumerate(objects)],
                "camera": camera,
                "light": light,
                "background": background,
            },
            st.lists(thing(where), min_size=1, max_size=3) if things is None else things,
            motion(interval, start, where),
            material,
            lights,
            magnitude(1e-12, 1e9, 0.0),
        )

    ahead = st.lists(
        st.builds(
            lambda path, mesh: {**path, "mesh": mesh, "material": "paint"},
            in_view(interval, start),
            st.sampled_from(sorted(meshes)),
        ),
        min_size=1,
        max_size=2,
    )
    facing = scene(near_positions, ahead).map(lambda tree: {**tree, "camera": {"position": [0.0, 0.0, 0.0]}})
    return st.one_of(facing, facing, scene(near_positions), scene(positions))


def random_scenes():
    # one set of pools, made once per process; the rest of the world varies
    return st.builds(
        lambda count, size, speed, turn, shake, light, static: {
            "kind": "random",
            "objects": {"count": count, "size": sorted([size, 2 * size])},
            "pool": {"primitives": ["cuboid", "sphere"], "variants": 1, "test_fraction": 0},
            "textures": {
                "procedural": ["checks"],
                "variants": 1,
                "photographs": False,
                "max_size": 16,
                "test_fraction": 0,
            },
            "light": light,
            "object_motion": {"speed": speed, "rotation_rate": turn},
            "camera_motion": {"kind": "static"} if static else {"speed": speed, "rotation_rate": turn, "shake": shake},
        },
        st.integers(0, 3),
        magnitude(1e-3, 4.0),
        magnitude(1e-3, 1e3, 0.0),
        magnitude(1e-3, 1e3, 0.0),
        st.sampled_from([0.0, 5.0]),
        lights,
        st.booleans(),
    )


threshold = magnitude(1e-3, 10.0, 0.2)
# The events of a run are bounded by events per step times steps: most of them are cut, and counted as cut.
most = st.just(20_000)
esim = some(
    contrast_threshold=threshold,
    contrast_threshold_off=threshold,
    threshold_sigma=magnitude(1e-3, 5.0, 0.0),
    threshold_jitter=magnitude(1e-3, 5.0, 0.0),
    log_eps=magnitude(1e-9, 1e6),
    refractory_us=magnitude(1e-3, 1e9, 0.0),
).map(lambda d: {"emulator": "esim", **d})
v2e = some(
    preset=st.sampled_from(["default", "clean", "noisy"]),
    contrast_threshold=threshold,
    contrast_threshold_off=threshold,
    threshold_sigma=magnitude(1e-3, 5.0, 0.0),
    full_scale=magnitude(1e-6, 1e9, 255.0),
    cutoff_hz=magnitude(1e-3, 1e7, 0.0),
    leak_rate_hz=magnitude(1e-3, 1e2, 0.0),
    leak_jitter=st.floats(0, 1),
    leak_cov_decades=st.floats(0, 1),
    shot_noise_rate_hz=magnitude(1e-3, 1e2, 0.0),
    photoreceptor_noise=st.booleans(),
    refractory_us=magnitude(1e-3, 1e9, 0.0),
    hot_pixel_fraction=st.sampled_from([0.0, 0.01, 1.0]),
    hot_pixel_rate_hz=magnitude(1e-3, 1e3, 0.0),
).map(lambda d: {"emulator": "v2e", **d})
voltmeter = some(
    preset=st.sampled_from(["DVS346", "DVS240"]),
    k1=magnitude(1e-2, 100.0),
    k2=magnitude(1e-3, 1e4),
    k3=magnitude(1e-6, 1.0, 0.0),
    k4=magnitude(1e-9, 1e-3, 0.0),
    k5=magnitude(1e-12, 1e-6, 0.0),
    k6=magnitude(1e-8, 1e-2, 0.0),
    full_scale=magnitude(1e-6, 1e9, 255.0),
    refractory_us=magnitude(1e-3, 1e9, 0.0),
).map(lambda d: {"emulator": "voltmeter", **d})


@st.composite
def runs(draw, emulators=esim):
    time = draw(times)
    interval = 1.0 / time["label_rate"]
    return {
        "seed": draw(st.integers(0, 2**63 - 1)),
        "camera": draw(cameras),
        "time": time,
        "timeline": draw(timelines(interval)),
        "scene": draw(explicit_scenes(interval, time["start"]) | random_scenes()),
        "events": {**draw(emulators), "max_events_per_step": draw(most)},
        "render": draw(
            some(
                antialiasing=st.sampled_from(["none", "taps4", "edges", "ssaa2"]),
                anisotropy=st.sampled_from([1.0, 16.0]),
                mip_bias=st.sampled_from([-8.0, -0.5, 8.0]),
            )
        ),
        "labels": {
            "flow": ["forward", "backward"],
            "float_flow": ["npy"],
            "depth": True,
            "ids": True,
            "normals": True,
            "velocity": True,
            "images": draw(st.booleans()),
            "occlusion": draw(st.booleans()),
        },
        "preview": {"enabled": False},
    }
