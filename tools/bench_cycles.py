"""What rasterising costs beside a path tracer: Blender's Cycles (extra [cycles], see
``peer_cycles.py``) on the default random scene.

    python -m blinkgl.tools.bench_cycles [CONFIG] [--frames 32] [--samples 128] [--set a.b=c …]
                                         [--json FILE] [--pictures FOLDER]

1. A short clip at low resolution (--width; the camera of the configuration, shrunk), frame times with at most --max-px
   of motion between two, the same for every renderer; ESIM with the same thresholds on each, linear in time. Errors of
   the events, one cause at a time:

   filtering   our frames against path-traced ones under our own light model (no shadows,
               no bounces): mip maps, anti-aliasing
   shadows     without them against with them, both path-traced: of the lamps alone, of the sky, of both; and ours,
               light.shadows: hard, on path-traced frames without any (times the ratio of our own frames with and
               without), so that filtering is not in it (--only shadows: these alone)
   bounces     direct light against four diffuse bounces, both path-traced
   all         our frames against everything
   noise       everything again with another seed: what cannot be told from no difference at all

2. Seconds per frame at full size, wall and processor time, of all renderers in the same run.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from importlib import resources
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from blinkgl.blender.process import available
from blinkgl.config.events import EsimConfig
from blinkgl.config.quality import DEFAULT, load_quality
from blinkgl.config.sequence import RenderConfig, load_run
from blinkgl.errors import BlinkGLError
from blinkgl.events import Events
from blinkgl.events.camera import EventCamera, EventFrame, emulate
from blinkgl.gl import create_context
from blinkgl.machine import bench
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.types import Scene
from blinkgl.srgb import to_srgb8
from blinkgl.timeline.sampling import displacement_times
from blinkgl.timeline.speed import largest_speed
from blinkgl.tools.peer_cycles import Cost, CyclesSettings, frames
from blinkgl.trade.metrics import SpeedMaps, event_errors

DRAWN = {
    **{name: RenderConfig(antialiasing=name) for name in ("none", "ssaa2", "ssaa4")},
    f"quality: {DEFAULT}": RenderConfig(**load_quality(DEFAULT)["render"]),
}
"""Ways to draw that are compared, the default among them."""
SHADED = "our light, our shadows"


def smaller(scene: Scene, width: int) -> Scene:
    """The same view on ``width`` columns."""
    camera = scene.camera
    return scene.with_camera(camera.resized(width, max(1, round(camera.height * width / camera.width))))


def rasterised(gl, scene: Scene, times: list[int], how: str, cost: Cost) -> Iterator[np.ndarray]:
    """how : of :data:`DRAWN`."""
    with Renderer(gl, scene, DRAWN[how]) as renderer:
        renderer.luminance(times[-1]).read()  # compiles and uploads
        for t in times:
            wall, cpu = time.perf_counter(), time.process_time()
            frame = renderer.luminance(t).read()
            cost.wall_s.append(time.perf_counter() - wall)
            cost.cpu_s.append(time.process_time() - cpu)
            yield frame


def shares(gl, scene: Scene, times: list[int], size: int, cost: Cost) -> Iterator[np.ndarray]:
    """(H, W) of the light that our hard shadows leave at each time, ssaa4. size : of their maps, texels."""
    light = scene.light
    shaded, plain = (
        rasterised(gl, replace(scene, light=replace(light, shadows=word, shadow_size=size)), times, "ssaa4", cost)
        for word in ("hard", "off")
    )
    for dark, bright in zip(shaded, plain):
        yield np.where(bright > 0, dark / np.where(bright > 0, bright, 1.0), 1.0)


def clip(gl, scene: Scene, options, console: Console) -> dict:
    """Part 1. Returns {"costs": name -> …, "errors": rows, "pictures": …} of one clip."""
    config = EsimConfig(threshold_sigma=0.0)
    height, width = scene.camera.height, scene.camera.width
    with Renderer(gl, scene, RenderConfig()) as renderer:
        times = list(
            islice(
                displacement_times(
                    options.max_px,
                    1000,
                    20_000_000,
                    scene.t0_ns,
                    scene.t1_ns,
                    lambda t: largest_speed(renderer.velocity_of_movers(t).read()),
                ),
                options.frames,
            )
        )
        maps = np.stack([np.linalg.norm(renderer.velocity(t).read(), axis=-1) for t in times])
    speeds = SpeedMaps(np.array(times) // 1000, maps)
    step = float(np.median(np.diff(times)))
    everything = CyclesSettings(samples=options.samples, bounces=4)
    traced = {
        "our light": replace(everything, shadows=False, bounces=0),
        "lamps' shadows": replace(everything, occlusion=False, bounces=0),
        "shadows": replace(everything, bounces=0),
        "everything": everything,
        "everything, another seed": replace(everything, seed=1),
    }
    costs, streams, first = {}, {}, {}
    if options.only == "shadows":
        traced = {name: one for name, one in traced.items() if "everything" not in name}
    names = [*traced, SHADED] if options.only == "shadows" else [*DRAWN, *traced, SHADED]
    open_: list[np.ndarray] = []  # path-traced frames without shadows
    for name in names:
        cost = costs[name] = Cost()
        if name in traced:
            source = frames(scene, times, traced[name], cost)
        elif name == SHADED:
            source = (frame * share for frame, share in zip(open_, shares(gl, scene, times, options.shadow_size, cost)))
        else:
            source = rasterised(gl, scene, times, name, cost)

        def event_frames(name=name, source=source):
            for t, frame in zip(times, source):
                first.setdefault(name, frame.copy())
                if name == "our light":
                    open_.append(frame.copy())
                yield EventFrame(t, frame)

        camera = EventCamera(config, None, height, width, seed=1)
        streams[name] = Events.concatenate([events for _, events in emulate(event_frames(), camera)])
        console.print(
            f"{name}: {len(streams[name]):,} events, {np.median(cost.wall_s):.3f} s per frame", highlight=False
        )
    rows = [("filtering", a, "our light") for a in DRAWN]
    rows += [("lamps' shadows", "our light", "lamps' shadows"), ("lamps' shadows", SHADED, "lamps' shadows")]
    rows += [("sky's shadows", "lamps' shadows", "shadows"), ("shadows", "our light", "shadows")]
    rows += [("shadows", SHADED, "shadows"), ("bounces", "shadows", "everything")]
    rows += [("all", a, "everything") for a in DRAWN] + [("noise", "everything, another seed", "everything")]
    rows = [row for row in rows if {*row[1:]} <= set(names)]
    limit = round(options.partners * step / 1000)
    t0, t1 = times[0] // 1000, times[-1] // 1000 + 1
    errors = []
    for cause, judged, truth in rows:
        e = event_errors(streams[truth], streams[judged], speeds, t0, t1, limit_us=limit)
        log = lambda name: np.log(first[name] + config.log_eps)
        errors.append(
            {
                "cause": cause,
                "judged": judged,
                "reference": truth,
                **e.to_dict(),
                "log_rmse": float(np.sqrt(np.mean((log(judged) - log(truth)) ** 2))),
            }
        )
    if options.pictures:
        folder = Path(options.pictures)
        folder.mkdir(parents=True, exist_ok=True)
        for name, frame in first.items():
            cv2.imwrite(
                str(folder / f"{name.replace(': ', '-').replace(', ', '-').replace(' ', '-')}.png"), to_srgb8(frame)
            )
    return {
        "width": width,
        "height": height,
        "frames": len(times),
        "milliseconds": (times[-1] - times[0]) / 1e6,
        "median_step_us": step / 1000,
        "limit_us": limit,
        "samples": options.samples,
        "costs": {name: asdict(cost) for name, cost in costs.items()},
        "errors": errors,
    }


def speed(gl, scene: Scene, max_px: float, options) -> dict:
    """Part 2. EEVEE and Cycles draw two frames; the first (shader compilation, acceleration structure) is set apart."""
    with Renderer(gl, scene, RenderConfig()) as renderer:
        times = list(
            displacement_times(
                max_px,
                1000,
                20_000_000,
                scene.t0_ns,
                scene.t1_ns,
                lambda t: largest_speed(renderer.velocity_of_movers(t).read()),
            )
        )
        triangles = renderer.triangles
    few = [times[0], times[len(times) // 2]]
    rows = []

    def add(name: str, cost: Cost, first: bool):
        skip = 1 if first else 0
        rows.append(
            {
                "renderer": name,
                "wall_s": float(np.median(cost.wall_s[skip:])),
                "cpu_s": float(np.median(cost.cpu_s[skip:])),
                "first_wall_s": cost.wall_s[0],
                "first_cpu_s": cost.cpu_s[0],
                "frames": len(cost.wall_s) - skip,
            }
        )

    for how in DRAWN:
        cost = Cost()
        for _ in rasterised(gl, scene, times[::10], how, cost):
            pass
        add(f"BlinkGL luminance, {how}", cost, first=False)
    for name, settings in (
        ("EEVEE, 1 sample", CyclesSettings(1, engine="eevee")),
        ("EEVEE, 16 samples", CyclesSettings(16, engine="eevee")),
        ("Cycles, 1 path", CyclesSettings(1)),
        ("Cycles, 16 paths", CyclesSettings(16)),
        (f"Cycles, {options.samples} paths", CyclesSettings(options.samples)),
    ):
        if settings.engine == "eevee" and options.no_eevee:
            continue
        cost = Cost()
        for _ in frames(scene, few, settings, cost):
            pass
        add(name, cost, first=True)
    return {
        "width": scene.camera.width,
        "height": scene.camera.height,
        "triangles": triangles,
        "max_px": max_px,
        "rows": rows,
        "frames_per_simulated_second": (len(times) - 1) / ((times[-1] - times[0]) / 1e9),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", nargs="?", default=str(resources.files("blinkgl.configs") / "flying_objects.yaml"))
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="a.b=c")
    parser.add_argument("--sequence", type=int, default=0)
    parser.add_argument("--frames", type=int, default=32, help="of the clip")
    parser.add_argument("--width", type=int, default=160, help="of the clip, px")
    parser.add_argument("--samples", type=int, default=128, help="paths per pixel")
    parser.add_argument("--max-px", type=float, default=0.5, help="largest motion between two frames of the clip")
    parser.add_argument(
        "--partners", type=float, default=4.0, help="events are partners up to this many median frame steps apart"
    )
    parser.add_argument("--only", choices=["clip", "speed", "shadows"])
    parser.add_argument("--shadow-size", type=int, default=2048, help="of our shadow maps, texels")
    parser.add_argument("--no-eevee", action="store_true")
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--pictures", metavar="FOLDER", help="first frame of each renderer as PNG")
    options = parser.parse_args()
    console = Console()
    console.width = max(console.width, 130)
    if missing := available():  # `make bench` runs all benchmarks, and this extra is rarely there
        console.print(f"nothing measured: {missing}", highlight=False, soft_wrap=True, markup=False)
        return
    template = load_run(options.config, options.overrides)
    config = template.sequence(options.sequence)
    scene = sequence_scene(config, options.sequence, template.base)
    result: dict = {}
    with create_context() as gl:
        result["machine"], result["load_before"] = bench.machine_line(gl.renderer), os.getloadavg()
        console.print(result["machine"], highlight=False, soft_wrap=True)
        if options.only != "speed":
            result["clip"] = clip(gl, smaller(scene, options.width), options, console)
            _show_clip(console, result["clip"])
        if options.only not in ("clip", "shadows"):
            result["speed"] = speed(gl, scene, getattr(config.timeline, "max_px", 1.0), options)
            _show_speed(console, result["speed"])
        result["load_after"] = os.getloadavg()
    console.print(
        "load, 1 and 5 minutes, before and after:",
        *(f"{n:.1f}" for n in (*result["load_before"][:2], *result["load_after"][:2])),
    )
    if options.json:
        Path(options.json).write_text(json.dumps(result, indent=1))


def _show_clip(console: Console, r: dict) -> None:
    table = Table(
        title=f"events, {r['width']}x{r['height']}, {r['frames']} frames of {r['milliseconds']:.0f} ms, {r['samples']} "
        f"paths; partners within {r['limit_us'] / 1000:.1f} ms",
        title_justify="left",
    )
    for name in (
        "cause",
        "judged",
        "by",
        "events",
        "missed",
        "extra",
        "time median, p95 / µs",
        "px",
        "voxel L2",
        "log RMSE",
    ):
        table.add_column(name, justify="left" if name in ("cause", "judged", "by") else "right")
    for e in r["errors"]:
        table.add_row(
            e["cause"],
            e["judged"],
            e["reference"],
            f"{100 * e['count']:+.1f} %",
            f"{100 * e['missed']:.1f} %",
            f"{100 * e['extra']:.1f} %",
            f"{e['time_median_us']:.0f}, {e['time_p95_us']:.0f}",
            f"{e['shift_median_px']:.3f}, {e['shift_p95_px']:.2f}",
            f"{e['voxel']:.2f}",
            f"{e['log_rmse']:.3f}",
        )
    console.print(table)


def _show_speed(console: Console, r: dict) -> None:
    rate = r["frames_per_simulated_second"]
    table = Table(
        title=f"{r['width']}x{r['height']}, {r['triangles']:,} triangles, {rate:.0f} frames per simulated second "
        f"(displacement {r['max_px']:g} px)",
        title_justify="left",
    )
    for name in ("renderer", "s per frame", "processor s", "first frame", "s per simulated s", "times BlinkGL"):
        table.add_column(name, justify="left" if name == "renderer" else "right")
    for row in r["rows"]:
        table.add_row(
            row["renderer"],
            f"{row['wall_s']:.4f}",
            f"{row['cpu_s']:.4f}",
            f"{row['first_wall_s']:.3f}",
            f"{row['wall_s'] * rate:.1f}",
            f"{row['cpu_s'] / r['rows'][0]['cpu_s']:.1f}",
        )
    console.print(table)


if __name__ == "__main__":
    try:
        main()
    except BlinkGLError as error:
        raise SystemExit(f"error: {error}") from None
