"""How wrong are events that are made of interpolated frames, and which measure of the frames says so beforehand?

    python -m blinkgl.tools.validate_interpolation [--only TEXT] [--rates 5 10 20 40] [--json FILE] [--plot FILE]
    python -m blinkgl.tools.validate_interpolation --read FILE [--plot FILE]

Scenes whose in-between frames are known: each is drawn so densely that nothing moves by more than --dense px between
two frames, and these make the reference's events (ESIM, no noise). Then single frames at each rate are kept, as 8-bit
sRGB, converted as ``frames:`` converts them, and judged, pair of frames by pair. Wrong: events without a partner within
the pixel, the polarity and the time in which the image moves by one pixel (the median speed at the reference's events),
missed and extra together, over the reference's count. Beside that stand the measures that ``blinkgl qualify`` takes of
the same pair, with the exact flow both ways.

A pair is bad where more than --bad of its events are wrong. On half of the scenes the limit of each measure is set to
what --keep of the good pairs are within; the other scenes say what these limits are worth together.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import rankdata, spearmanr

from blinkgl.config.base import validate
from blinkgl.config.events import EsimConfig
from blinkgl.config.frames import QualifyConfig
from blinkgl.config.sequence import RenderConfig, SequenceConfig
from blinkgl.events import Events
from blinkgl.events.camera import EventCamera, EventFrame
from blinkgl.gl import GLContext, create_context
from blinkgl.labels import LabelRequest
from blinkgl.machine import bench
from blinkgl.recordings import artefacts
from blinkgl.recordings.simulation import Decoder, frames_to_events
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.sequence.qualify import MEASURES, measure
from blinkgl.srgb import to_srgb8
from blinkgl.timeline import displacement_times
from blinkgl.timeline.speed import largest_speed
from blinkgl.trade.metrics import SpeedMaps, event_errors

WIDTH, HEIGHT, SPAN_S = 192, 144, 1.0
MIN_EVENTS = 500
"""A pair of frames with fewer is not judged."""
EMULATOR = EsimConfig(contrast_threshold=0.2, threshold_sigma=0.0)
RENDER = RenderConfig(antialiasing="ssaa4", mip_bias=-0.5, image_antialiasing="none")
RATES = (5.0, 10.0, 20.0, 40.0)


# ---- scenes ----------------------------------------------------------------------------------------------------------


def _explicit(wall: dict[str, Any], camera: list[dict[str, Any]], movers: list[dict[str, Any]], **meshes: Any) -> dict:
    """A wall 6 m ahead of a camera that looks along +x from the origin; movers before it."""
    return {
        "kind": "explicit",
        "meshes": {
            "wall": {"primitive": "cuboid", "parameters": {"extents": [0.2, 24, 18], "subdivisions": 16}},
            **meshes,
        },
        "materials": {
            "wall": {"uv_scale": [6, 4.5], "unlit": True, **wall},
            "glyphs": {"procedural": "glyphs", "seed": 4, "unlit": True, "uv_scale": [2, 2]},
            "photo": {"photograph": "astronaut", "unlit": True},
            "dark": {"color": [0.05, 0.05, 0.06], "unlit": True},
            "light": {"color": [0.9, 0.9, 0.85], "unlit": True},
        },
        "objects": [{"mesh": "wall", "material": "wall", "category": "wall", "position": [6, 0, 0]}, *movers],
        "camera": {"keyframes": camera, "interpolation": "spline"},
        "background": 0.2,
    }


def _keys(*poses: dict[str, Any]) -> list[dict[str, Any]]:
    return [{"time": SPAN_S * 1.5 * k / (len(poses) - 1), **pose} for k, pose in enumerate(poses)]


STILL = _keys({"position": [0, 0, 0], "look_at": [6, 0, 0]}, {"position": [0, 0, 0], "look_at": [6, 0, 0]})
SLIDE = _keys(
    {"position": [0, -0.8, 0], "look_at": [6, -0.8, 0]}, {"position": [0, 0.8, 0.3], "look_at": [6, 0.8, 0.3]}
)
PAN = _keys({"position": [0, 0, 0], "look_at": [6, -2, 0]}, {"position": [0, 0, 0], "look_at": [6, 2, 0.4]})
ZOOM = _keys({"position": [-1, 0, 0], "look_at": [6, 0, 0]}, {"position": [2.5, 0, 0.1], "look_at": [6, 0, 0]})
ROLL = _keys(*({"position": [0, 0, 0], "euler": [turn, 0, 0]} for turn in (0, 20, 40)))
SHAKE = _keys(
    *(
        {"position": [0, y, z], "look_at": [6, y, z]}
        for y, z in ((0, 0), (0.3, 0.1), (-0.2, 0.2), (0.25, -0.1), (0, 0.1))
    )
)
FBM, GLYPHS, BRICKS = ({"procedural": kind, "seed": 2} for kind in ("fbm", "glyphs", "bricks"))
CHECKS = {"procedural": "checks", "seed": 1}
GRAVEL, COFFEE = {"photograph": "gravel"}, {"photograph": "coffee"}
SMOOTH = {"procedural": "perlin", "seed": 5, "uv_scale": [1, 1]}


def _bars(
    width: float, count: int, travel: float, material: str = "dark"
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Upright bars 3 m ahead that move sideways by ``travel`` m."""
    places = np.linspace(-1.2, 1.2, count)
    return (
        [
            {
                "mesh": "bar",
                "material": material,
                "keyframes": _keys({"position": [3, y - travel / 2, 0]}, {"position": [3, y + travel / 2, 0]}),
                "interpolation": "linear",
            }
            for y in places
        ],
        {"bar": {"primitive": "cuboid", "parameters": {"extents": [width, width, 3.0], "subdivisions": 1}}},
    )


def _boxes(travel: float, size: float = 0.8) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Two boxes that cross before the wall, one before the other."""
    return (
        [
            {
                "mesh": "box",
                "material": material,
                "keyframes": _keys(
                    {"position": [x, -s * travel, z]}, {"position": [x, s * travel, z], "euler": [0, 20, 30]}
                ),
                "interpolation": "linear",
            }
            for x, s, z, material in ((3.0, 1, 0.2, "glyphs"), (3.8, -1, -0.3, "photo"))
        ],
        {"box": {"primitive": "cuboid", "parameters": {"extents": [size, size, size], "subdivisions": 2}}},
    )


def _random(speed: list[float], turn: list[float], count: int, **motion: Any) -> dict[str, Any]:
    return {
        "kind": "random",
        "objects": {"count": count, "distance": [2, 8]},
        "camera_motion": {"speed": speed, "rotation_rate": turn, **motion},
    }


def scenes() -> dict[str, tuple[dict[str, Any], int]]:
    """name -> (``scene:`` table, seed)."""
    made: dict[str, tuple[dict[str, Any], int]] = {}
    for name, wall, camera in (
        ("slide, fbm", FBM, SLIDE),
        ("slide, glyphs", GLYPHS, SLIDE),
        ("slide, checks", CHECKS, SLIDE),
        ("slide, coffee", COFFEE, SLIDE),
        ("pan, gravel", GRAVEL, PAN),
        ("pan, bricks", BRICKS, PAN),
        ("pan, smooth", SMOOTH, PAN),
        ("zoom, glyphs", GLYPHS, ZOOM),
        ("zoom, coffee", COFFEE, ZOOM),
        ("roll, fbm", FBM, ROLL),
        ("shake, gravel", GRAVEL, SHAKE),
        ("shake, bricks", BRICKS, SHAKE),
    ):
        made[name] = _explicit(wall, camera, []), 0
    for width in (0.02, 0.05, 0.1, 0.2, 0.4):
        for name, wall, camera, travel in (("still", FBM, STILL, 2.0), ("sliding", COFFEE, SLIDE, 0.7)):
            movers, meshes = _bars(width, 7 if width < 0.3 else 4, travel, "dark" if name == "still" else "light")
            made[f"bars {width:g} m, {name}"] = _explicit(wall, camera, movers, **meshes), 0
    for travel in (0.5, 1.5):
        for name, wall, camera in (("still", GRAVEL, STILL), ("sliding", BRICKS, SLIDE)):
            movers, meshes = _boxes(travel)
            made[f"crossing {travel:g} m, {name}"] = _explicit(wall, camera, movers, **meshes), 0
    for seed in range(8):
        made[f"random {seed}, slow"] = _random([0.1, 0.4], [2, 10], 10), seed
        made[f"random {seed}, quick"] = _random([0.3, 1.2], [5, 30], 16), 100 + seed
    return made


# ---- one scene -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Dense:
    """What is true of a scene: frames at all times, and those at the times that are kept."""

    events: Events
    frames: int
    kept: dict[int, np.ndarray]
    flows: dict[tuple[int, int], dict[str, Any]]


def frame_times(rate: float) -> list[int]:
    return [round(k * 1e9 / rate) for k in range(int(SPAN_S * rate) + 1)]


def config_of(scene: dict[str, Any], seed: int) -> SequenceConfig:
    """A sequence of the scene that lasts longer than what is looked at."""
    camera = {"width": WIDTH, "height": HEIGHT, "fov": 60}
    return validate(
        SequenceConfig, {"seed": seed, "camera": camera, "time": {"duration": SPAN_S, "label_rate": 5}, "scene": scene}
    )


def draw(gl: GLContext, scene: dict[str, Any], seed: int, rates: tuple[float, ...], dense_px: float) -> Dense:
    """The scene, densely, with the exact flows of every pair of frames at every rate."""
    config = config_of(scene, seed)
    keep = sorted({t for rate in rates for t in frame_times(rate)})
    request = LabelRequest("flow_forward")
    kept, flows = {}, {}
    with Renderer(gl, sequence_scene(config, 0), RENDER) as renderer:
        dense = displacement_times(
            dense_px,
            100_000,
            20_000_000,
            0,
            keep[-1],
            lambda t: largest_speed(renderer.velocity_of_movers(t, 4).read()),
        )
        camera, parts, count = EventCamera(EMULATOR, None, HEIGHT, WIDTH, 0), [], 0
        for t in sorted({*dense, *keep}):
            frame = renderer.luminance(t).read().copy()
            parts.append(camera.step(EventFrame(t, frame)))
            count += 1
            if t in keep:
                kept[t] = frame
        for rate in rates:
            for a, b in itertools.pairwise(frame_times(rate)):
                if (a, b) not in flows:
                    ahead = renderer.labels(a, request, b, b)
                    back = renderer.labels(b, request, a, a)
                    pair = ahead.values["flow_forward"], back.values["flow_forward"]
                    flows[a, b] = {name: (one.flow, one.valid) for name, one in zip(("forward", "backward"), pair)}
    return Dense(Events.concatenate(parts), count, kept, flows)


def rows_of(name: str, dense: Dense, rate: float, interpolate: str) -> list[dict[str, Any]]:
    """One row per pair of frames: measures and errors."""
    times = frame_times(rate)
    codes = [to_srgb8(dense.kept[t]) for t in times]
    options = dict(emulator=EMULATOR, gamma="srgb", interpolate=interpolate)
    made = Events.concatenate(list(frames_to_events(zip(codes, times), **options)))
    decode = Decoder("srgb")
    given = [dense.flows[ends] for ends in itertools.pairwise(times)]
    measured = measure(
        [decode(code, "") for code in codes],
        interpolate,
        lambda k: (*given[k]["forward"], artefacts.hidden(*given[k]["forward"], *given[k]["backward"])),
    )
    rows = []
    for k, (values, (t0, t1)) in enumerate(zip(measured, itertools.pairwise(times))):
        flow, _ = given[k]["forward"]
        speed = np.hypot(flow[..., 0], flow[..., 1]) / ((t1 - t0) * 1e-9)
        true = dense.events.window(t0 // 1000, t1 // 1000)
        pace = float(np.median(speed[true.y, true.x])) if len(true) else 0.0
        errors = event_errors(
            dense.events,
            made,
            SpeedMaps(np.array([t0 // 1000]), speed[None]),
            t0 // 1000,
            t1 // 1000,
            limit_us=int(np.clip(1e6 / max(pace, 1e-9), 1000, (t1 - t0) // 1000)),
        )
        rows.append({"scene": name, "rate": rate, "pair": k, "interpolate": interpolate, **values, **errors.to_dict()})
    return rows


# ---- limits ----------------------------------------------------------------------------------------------------------


def usable(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Pairs with enough events to tell a share of them."""
    return [row for row in rows if row["reference_events"] >= MIN_EVENTS]


def area(bad: np.ndarray, values: np.ndarray) -> float:
    """Chance that a bad pair measures more than a good one (area under the ROC curve); NaN without both."""
    if bad.all() or not bad.any():
        return float("nan")
    ranks = rankdata(values)
    count = int(bad.sum())
    return float((ranks[bad].sum() - count * (count + 1) / 2) / (count * (len(bad) - count)))


def limits_of(rows: list[dict[str, Any]], bad: float, keep: float) -> dict[str, float]:
    """What ``keep`` of the good pairs are within, for each measure by itself; every frame rate counts the same, however
    many pairs it has."""
    good = [row for row in rows if row["wrong"] <= bad]
    many = Counter(row["rate"] for row in good)
    weights = np.array([1 / many[row["rate"]] for row in good])
    limits = {}
    for name in MEASURES:
        values = np.array([row[name] for row in good])
        order = np.argsort(values)
        share = np.cumsum(weights[order]) / weights.sum()
        limits[name] = float(values[order][min(np.searchsorted(share, keep), len(good) - 1)])
    return limits


def sides(rows: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Pairs of the scenes that limits are set on, and of the others: of four scenes in a row the first and the last."""
    names = list(dict.fromkeys(row["scene"] for row in rows))
    first = {name for number, name in enumerate(names) if number % 4 in (0, 3)}
    return [row for row in rows if row["scene"] in first], [row for row in rows if row["scene"] not in first]


def judged(rows: list[dict[str, Any]], limits: dict[str, float], bad: float) -> dict[str, float]:
    """Of all pairs and those within the limits: how many, how many are good, and how wrong their events are."""
    within = np.array([all(row.get(name, 0.0) <= limit for name, limit in limits.items()) for row in rows])
    wrong = np.array([row["wrong"] for row in rows])
    good = wrong <= bad
    share = lambda part, whole: float(part.sum() / whole.sum()) if whole.any() else float("nan")
    return {
        "pairs": len(rows),
        "good": share(good, np.ones_like(good)),
        "accepted": share(within, np.ones_like(good)),
        "good_accepted": share(within & good, good),
        "bad_refused": share(~within & ~good, ~good),
        "accepted_good": share(within & good, within),
        "wrong_median": float(np.median(wrong)),
        "wrong_median_accepted": float(np.median(wrong[within])) if within.any() else float("nan"),
        "wrong_p95_accepted": float(np.percentile(wrong[within], 95)) if within.any() else float("nan"),
        "wrong_median_refused": float(np.median(wrong[~within])) if not within.all() else float("nan"),
    }


def report(rows: list[dict[str, Any]], bad: float, keep: float, plot: str | None) -> None:
    rows = usable(rows)
    names = list(dict.fromkeys(row["scene"] for row in rows))
    fitted, held = sides(rows)
    limits = limits_of(fitted, bad, keep)
    shipped = {name: limit for name in MEASURES if (limit := getattr(QualifyConfig(), name)) is not None}
    wrong = np.array([row["wrong"] for row in rows])
    print(f"{len(rows)} pairs of {len(names)} scenes, {100 * np.mean(wrong > bad):.0f} % bad (more than {bad:g} wrong)")
    print("measure        Spearman   area    limit  shipped  refused by it alone: bad, good pairs of the other scenes")
    bad_held = np.array([row["wrong"] > bad for row in held])
    for name in MEASURES:
        values = np.array([row[name] for row in rows])
        beyond = np.array([row[name] > limits[name] for row in held])
        told, rank = area(wrong > bad, values), spearmanr(values, wrong).statistic
        ours, theirs = limits[name], shipped.get(name, float("nan"))
        alone = " ".join(f"{beyond[those].mean():.2f}" if those.any() else "–" for those in (bad_held, ~bad_held))
        print(f"{name:14s} {rank:8.2f} {told:6.2f} {ours:8.4g} {theirs:8.4g}  {alone}")
    for title, part, those in (
        ("limits here, scenes they were set on", fitted, limits),
        ("limits here, other scenes", held, limits),
        ("shipped limits, scenes they were set on", fitted, shipped),
        ("shipped limits, other scenes", held, shipped),
        ("shipped limits, all", rows, shipped),
    ):
        print(f"{title}: " + ", ".join(f"{key} {value:.3g}" for key, value in judged(part, those, bad).items()))
    for rate in sorted({row["rate"] for row in rows}):
        part = [row for row in rows if row["rate"] == rate]
        print(f"{rate:g} frames/s: " + ", ".join(f"{k} {v:.3g}" for k, v in judged(part, shipped, bad).items()))
    if plot:
        _plot(rows, shipped, bad, plot)


def _plot(rows: list[dict[str, Any]], limits: dict[str, float], bad: float, path: str) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 5, figsize=(15, 6), sharey=True, layout="constrained")
    rates = np.array([row["rate"] for row in rows])
    wrong = np.array([row["wrong"] for row in rows])
    for axis, name in zip(axes.flat, MEASURES):
        values = np.array([row[name] for row in rows])
        for rate in sorted(set(rates)):
            axis.plot(values[rates == rate], wrong[rates == rate], ".", ms=3, alpha=0.6, label=f"{rate:g} frames/s")
        axis.axhline(bad, color="grey", lw=0.8)
        if name in limits:
            axis.axvline(limits[name], color="black", lw=0.8)
        axis.set_title(f"{name}, px" if name == "displacement" else name, fontsize=10)
        axis.set_xscale("symlog" if name == "displacement" else "linear")
        axis.set_ylim(0, 2)
    axes.flat[-1].axis("off")
    axes.flat[-1].legend(*axes.flat[0].get_legend_handles_labels(), loc="center")
    for axis in axes[:, 0]:
        axis.set_ylabel("wrong events, share")
    figure.savefig(path, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="scenes whose name contains this")
    parser.add_argument("--rates", type=float, nargs="+", default=list(RATES), help="frames per second that are kept")
    parser.add_argument("--interpolate", default="motion", choices=("linear", "cubic", "motion"))
    parser.add_argument("--dense", type=float, default=0.25, help="displacement between the reference's frames, px")
    parser.add_argument("--bad", type=float, default=0.5, help="share of wrong events that makes a pair a bad one")
    parser.add_argument("--keep", type=float, default=0.95, help="share of the good pairs within each limit")
    parser.add_argument("--json", help="file to write all pairs to")
    parser.add_argument("--read", nargs="+", help="files of all pairs, instead of making them")
    parser.add_argument("--plot", help="picture of errors over measures to write")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for path in arguments.read or ():
        with open(path, encoding="utf-8") as file:
            rows += json.load(file)["rows"]
    if not arguments.read:
        with create_context() as gl:
            for name, (scene, seed) in scenes().items():
                if arguments.only not in name:
                    continue
                began = time.process_time()
                dense = draw(gl, scene, seed, tuple(arguments.rates), arguments.dense)
                for rate in arguments.rates:
                    rows += rows_of(name, dense, rate, arguments.interpolate)
                spent = time.process_time() - began
                print(f"{name}: {dense.frames} frames, {len(dense.events)} events, {spent:.1f} s", flush=True)
            machine = bench.machine_line(gl.renderer)
        print(machine)
        if arguments.json:
            with open(arguments.json, "w", encoding="utf-8") as file:
                json.dump({"machine": machine, "rows": rows}, file)
    if len({row["scene"] for row in usable(rows)}) > 1:
        report(rows, arguments.bad, arguments.keep, arguments.plot)


if __name__ == "__main__":
    main()
